"""`python -m clresample.cli`: the command without its entry point."""

import sys

from .command import main

sys.exit(main())
