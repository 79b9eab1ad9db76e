"""The checkout under test: its folder, and Python run in it."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def run_python(*arguments, **environment):
    """Python on `arguments` in the checkout, under more environment variables."""
    command = [sys.executable, *arguments]
    environment = {**os.environ, **environment}
    return subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
