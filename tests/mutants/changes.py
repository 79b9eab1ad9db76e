"""Mutations of one module, and whether its tests notice: `make mutants MODULE=FILE`.

    python tests/mutants.py FILE [--n 20] [--seed 0] [--tests PATH ...] [--seconds 600]

Each mutation changes one token as a slip of the pen would: a sign, a comparison, a factor, a
number, min for max. The tests of the module's room run on a copy of the checkout with it; one that
no test fails on is printed with its line. For Python and OpenCL C. What runs too long counts as
killed; a mutation that changes nothing that can be seen has to be recognised by its reader.
"""

from __future__ import annotations

import argparse
import io
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tokenize
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SWAPS = {
    "+": "-",
    "-": "+",
    "*": "/",
    "/": "*",
    "**": "*",
    "//": "*",
    "%": "*",
    "@": "*",
    "<": "<=",
    "<=": "<",
    ">": ">=",
    ">=": ">",
    "==": "!=",
    "!=": "==",
    "+=": "-=",
    "-=": "+=",
    "*=": "/=",
    "/=": "*=",
    "|=": "&=",
    "&": "|",
    "|": "&",
    "&&": "||",
    "||": "&&",
    "and": "or",
    "or": "and",
    "not": "",
    "~": "",
    "True": "False",
    "False": "True",
    "min": "max",
    "max": "min",
    "minimum": "maximum",
    "maximum": "minimum",
    "fmin": "fmax",
    "fmax": "fmin",
    "argmin": "argmax",
    "argmax": "argmin",
    "any": "all",
    "all": "any",
    "cos": "sin",
    "sin": "cos",
    "floor": "ceil",
    "ceil": "floor",
    "sqrt": "square",
    "abs": "",
    "continue": "break",
    "break": "continue",
}
# Of C: comments, directives and texts are skipped.
C_TOKENS = re.compile(
    r"(?P<skip>/\*.*?\*/|//[^\n]*|^[ \t]*#[^\n]*|\"[^\"\n]*\")|"
    r"(?P<word>[A-Za-z_]\w*)|(?P<number>\d+\.?\d*(?:[eE][-+]?\d+)?f?)|"
    r"(?P<op>&&|\|\||[-+*/<>=!]=|->|\+\+|--|<<|>>|[-+*/%<>&|])",
    re.DOTALL | re.MULTILINE,
)


def mutations(path, text):
    """Every mutation of a source: [(line, start, end, new text)]; offsets count characters."""
    found = []
    for line, start, old in _tokens(path, text):
        if re.fullmatch(r"\d+\.?\d*(?:[eE][-+]?\d+)?f?", old):
            found.append((line, start, start + len(old), f"({old} + 1)"))
            if float(old.rstrip("f")) > 1:
                found.append((line, start, start + len(old), f"({old} - 1)"))
        elif old in SWAPS:
            found.append((line, start, start + len(old), SWAPS[old]))
    return found


def _tokens(path, text):
    """(line, offset, text) of every token that may be changed."""
    if path.suffix != ".py":
        for match in C_TOKENS.finditer(text):
            if match.lastgroup != "skip":
                yield text.count("\n", 0, match.start()) + 1, match.start(), match[0]
        return
    starts = [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    previous = ""
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type in (tokenize.OP, tokenize.NAME, tokenize.NUMBER):
            keyword_only = token.string == "*" and previous in ("(", ",")
            imported = "import" in token.line or token.line.lstrip().startswith(("def ", "class "))
            annotated = token.string == "|" and (":" in token.line or "->" in token.line)
            if not (keyword_only or imported or annotated):
                yield token.start[0], starts[token.start[0] - 1] + token.start[1], token.string
        previous = token.string


def tests_of(path):
    """Tests of a module's room, those named after it first."""
    parts = path.relative_to(ROOT).parts
    room = parts[1] if parts[0] == "clresample" and len(parts) > 2 else "resampling"
    if parts[0] == "kernels":
        used = {"scene", "update", "prox", "project", "structure", "lbfgs"}
        room = "deblending" if path.stem in used else "resampling"
    files = sorted((ROOT / "tests" / room).glob("test_*.py"))
    return sorted(files, key=lambda file: path.stem not in file.stem)


def copied(folder):
    """The checkout's files, without what git ignores, in another folder."""
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(listed, cwd=ROOT, capture_output=True, check=True).stdout.split(b"\0")
    for name in filter(None, map(os.fsdecode, names)):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)


def survives(folder, tests, seconds):
    """Whether the tests pass on the checkout in a folder."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests]
    environment = {**os.environ, "PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, timeout=seconds, check=False
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


def main():
    """Run the sample; the exit status says whether all mutations were killed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path, help="module or kernel file to change")
    parser.add_argument("--n", type=int, default=20, help="how many mutations (default 20)")
    parser.add_argument("--seed", type=int, default=0, help="which ones")
    parser.add_argument("--tests", nargs="*", help="tests that should notice")
    parser.add_argument("--seconds", type=float, default=600, help="longest run of the tests")
    options = parser.parse_args()
    path = options.file.resolve()
    text = path.read_text(encoding="utf-8")
    possible = mutations(path, text)
    sample = random.Random(options.seed).sample(possible, min(options.n, len(possible)))
    tests = options.tests or [str(file.relative_to(ROOT)) for file in tests_of(path)]
    with tempfile.TemporaryDirectory(prefix="mutants-") as name:
        folder = Path(name)
        copied(folder)
        target = folder / path.relative_to(ROOT)
        began = time.monotonic()
        if not survives(folder, tests, options.seconds):
            print(f"the tests fail without any mutation: {' '.join(tests)}")
            return 2
        seconds = min(options.seconds, 30 + 5 * (time.monotonic() - began))
        alive = 0
        for line, start, end, new in sorted(sample):
            target.write_text(text[:start] + new + text[end:], encoding="utf-8")
            survived = survives(folder, tests, seconds)
            alive += survived
            shown = text.splitlines()[line - 1].strip()
            what = "SURVIVES" if survived else "killed"
            change = f"{text[start:end]} -> {new or 'nothing'}"
            print(f"{what:8}  {options.file}:{line}: {change}: {shown}", flush=True)
    print(f"{len(sample) - alive} of {len(sample)} mutations killed, of {len(possible)} possible")
    return 1 if alive else 0


if __name__ == "__main__":
    sys.exit(main())
