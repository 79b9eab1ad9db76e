"""`python -m clresample.cli`: the same as the command `clresample`, where that is not installed."""

import sys

from . import main

sys.exit(main())
