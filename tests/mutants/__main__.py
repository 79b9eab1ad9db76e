"""Tries whether the tests notice slips in a module or a package: `make mutants MODULE=PATH`.

    python -m tests.mutants PATH [--n 20] [--seed 0] [--lines 10,12] [--tests FILE ...]

PATH is a file or a folder of the package or of kernels/. Each mutation changes one token as a
typing error would: a sign, a comparison, a factor, a number, min for max. Tests of the module's
package that run the changed line are tried on a copy of the checkout, the quickest first, until one
fails. A mutation that runs too long counts as killed; one that does not compile is not counted.
equivalent.toml lists mutations that no test can detect. The exit status is 0 if all others were
killed.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

from .changes import mutations
from .covering import KEPT, ROOT, Covering, test_files


def copied(folder):
    """The checkout's files, without what git ignores, in another folder."""
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(listed, cwd=ROOT, capture_output=True, check=True).stdout.split(b"\0")
    for name in filter(None, map(os.fsdecode, names)):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)


def sources(path):
    """The files at PATH that can be changed."""
    files = [path] if path.is_file() else sorted(path.rglob("*.*"))
    return [file for file in files if file.suffix in (".py", ".cl", ".h")]


def equivalents():
    """{(file, line's text, change, place or None)} of equivalent.toml."""
    text = Path(__file__).with_name("equivalent.toml").read_text(encoding="utf-8")
    found = set()
    for one in tomllib.loads(text)["equivalent"]:
        changes = one["change"] if isinstance(one["change"], list) else [one["change"]]
        found |= {(one["file"], one["line"], change, one.get("place")) for change in changes}
    return found


class Trial:
    """Mutations of a copy of the checkout, each under the tests that may notice it.

    seconds: of tests, as they take without a mutation, that one mutation is worth
    """

    def __init__(self, folder, files, seconds):
        self.folder, self.seconds = folder, seconds
        environment = {
            **os.environ,
            "PYTHONPATH": str(folder),
            "OMP_NUM_THREADS": "1",
            "POCL_CACHE_DIR": str(KEPT / "pocl"),
            "PYOPENCL_NO_CACHE": "1",
        }
        (KEPT / "pocl").mkdir(parents=True, exist_ok=True)
        self.server = subprocess.Popen(
            [sys.executable, "tests/mutants/serve.py"],
            cwd=folder,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.covering = Covering(files, self.serve, folder)

    def serve(self, request):
        """The answer of serve.py to a request."""
        print(json.dumps(request), file=self.server.stdin, flush=True)
        return json.loads(self.server.stdout.readline())

    def outcome(self, mutation):
        """("killed", by what), ("no build", ...), ("SURVIVES", of how many tests)."""
        tests = self.covering.tests(mutation)
        if not tests:
            return "SURVIVES", "no test runs this"
        chosen, total = [], 0.0
        for test in tests:
            total += self.covering.seconds[test]
            if chosen and total > self.seconds:
                break
            chosen.append(test)
        target = self.folder / mutation.path.relative_to(ROOT)
        text = target.read_text(encoding="utf-8")
        for old in target.parent.glob(f"__pycache__/{target.stem}.*.pyc"):
            old.unlink()
        target.write_text(mutation.applied(text), encoding="utf-8")
        try:
            limit = 30 + 3 * min(total, self.seconds)
            answer = self.serve({"arguments": ["-x", *chosen], "seconds": limit})
        finally:
            target.write_text(text, encoding="utf-8")
        if answer["status"] == 0:
            return "SURVIVES", f"{len(chosen)} of {len(tests)} tests"
        if not answer.get("built", True):
            return "no build", ""
        return "killed", answer.get("failed", f"status {answer['status']}")[:160]


def sample_of(options):
    """The Mutations to try, in random order, and how many are possible."""
    possible = [m for file in sources(options.path) for m in mutations(file)]
    if options.lines:
        lines = set(map(int, options.lines.split(",")))
        possible = [m for m in possible if m.line in lines]
    order = random.Random(options.seed).sample(possible, len(possible))
    return order, len(possible)


def main():
    """Runs the sample; the exit status says whether all mutations were killed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("path", type=Path, help="module, kernel file or folder to change")
    parser.add_argument("--n", type=int, default=20, help="how many mutations (default 20)")
    parser.add_argument("--seed", type=int, default=0, help="which ones")
    parser.add_argument("--lines", help="mutations of these lines only, with commas between")
    parser.add_argument("--tests", nargs="*", help="test files that should notice")
    parser.add_argument("--seconds", type=float, default=30, help="of tests for each mutation")
    options = parser.parse_args()
    options.path = options.path.resolve()
    order, possible = sample_of(options)
    known = equivalents()
    counts = dict.fromkeys(("killed", "SURVIVES", "equivalent", "no build"), 0)
    with tempfile.TemporaryDirectory(prefix="mutants-") as name:
        folder = Path(name).resolve()
        copied(folder)
        trial = Trial(folder, options.tests or test_files(options.path), options.seconds)
        for mutation in order:
            if sum(counts.values()) - counts["no build"] == options.n:
                break
            file = str(mutation.path.relative_to(ROOT))
            if not mutation.parses(mutation.path.read_text(encoding="utf-8")):
                continue
            same = file, mutation.shown, mutation.change
            if {(*same, None), (*same, mutation.place)} & known:
                what, why = "equivalent", ""
            else:
                what, why = trial.outcome(mutation)
            counts[what] += 1
            at = f"{file}:{mutation.line}: {mutation.change} (place {mutation.place})"
            shown = f"{at}: {mutation.shown}"
            print(f"{what:10}  {shown}  [{why}]", flush=True)
        trial.server.stdin.close()
        trial.server.wait()
    tried = sum(counts.values()) - counts["no build"]
    print(
        f"{counts['killed']} of {tried} mutations killed, {counts['equivalent']} equivalent, "
        f"{counts['SURVIVES']} survive; {possible} are possible"
    )
    return 1 if counts["SURVIVES"] else 0


if __name__ == "__main__":
    sys.exit(main())
