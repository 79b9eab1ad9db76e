"""Runs `python -m clresample.cli` like the command `clresample`, where that is not installed."""

import sys

from . import main

sys.exit(main())
