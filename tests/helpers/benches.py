"""Benchmarks run in this process: their text and the JSON that they write."""

import contextlib
import importlib
import io
import json
import os
import sys

import pytest

from helpers.checkout import ROOT


def run_bench(module, *options):
    """Output of `python -m bench.MODULE OPTIONS`; raises SystemExit if it ends so.

    A process of its own would be started anew with one thread for each library.
    """
    from bench.harness.options import run

    command, said = importlib.import_module(f"bench.{module}"), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(said):
        patch.chdir(ROOT)
        patch.setattr(sys, "argv", ["bench", *map(str, options)])
        patch.setattr(os, "execve", lambda *_: None)
        run(command.main, command.parser())
    return said.getvalue()


def bench_json(folder, module, *options):
    """Content of the one file that a benchmark writes into the folder."""
    file = folder / f"{module}.json"
    run_bench(module, *options, "--json", file)
    return json.loads(file.read_text())
