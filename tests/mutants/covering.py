"""Selects tests that may notice a mutation, the likeliest and quickest first.

What each test runs is recorded once (record.py) and kept in .mutants/ until the package, the tests'
helpers or the test's own file change.
"""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
KEPT = ROOT / ".mutants"
KERNEL = re.compile(r"^__kernel\b[^{;]*?\bvoid\s+(\w+)\s*\(.*?^\}", re.DOTALL | re.MULTILINE)


def test_files(path):
    """The test files, relative to the checkout, that may notice a change of a file or folder."""
    parts = path.relative_to(ROOT).parts
    if parts[0] == "kernels":
        packages = ["device", "resampling", "deblending", "paper", "measurement"]
    elif len(parts) > 2 or path.is_dir():
        packages = {"deblending": ["deblending", "measurement", "paper"]}.get(parts[1], [parts[1]])
    else:
        packages = ["resampling", "deblending"]
    return sorted(
        str(file.relative_to(ROOT))
        for package in packages
        for file in (ROOT / "tests" / package).glob("test_*.py")
    )


class Covering:
    """Lines of code that the tests of some files run.

    serve: a function that takes a request of serve.py and returns its answer
    folder: the copy of the checkout in which they ran
    """

    def __init__(self, files, serve, folder):
        self.folder = folder
        self.ran = {}  # (file, line or kernel): tests
        self.seconds = {}  # of each test
        self.width = {}  # of each test: how many places it runs
        shared = _digest([*sorted((ROOT / "clresample").rglob("*.py")), *_kernels(), *_helpers()])
        KEPT.mkdir(exist_ok=True)
        for file in files:
            kept = KEPT / f"{_digest([folder / file], shared)}.json"
            if not kept.exists():
                print(f"recording {file}", flush=True)
                raw = kept.with_suffix(".raw")
                answer = serve({"arguments": [file], "seconds": 1800, "record": str(raw)})
                if answer["status"] not in (0, 1, 5):
                    raise SystemExit(f"{file} does not run without any mutation: {answer}")
                if answer["status"] == 1:  # some do not like to be watched: they are left out
                    print(f"fails while it is recorded: {answer['failed']}", flush=True)
                tests = json.loads(raw.read_text())
                kept.write_text(json.dumps(self._relative(tests)))
                raw.unlink()
            for test, found in json.loads(kept.read_text()).items():
                self.seconds[test], self.width[test] = found["seconds"], len(found["ran"])
                for place in found["ran"]:
                    self.ran.setdefault(tuple(place), set()).add(test)

    def _relative(self, tests):
        start = f"{self.folder}/"
        for found in tests.values():
            found["ran"] = [[file.removeprefix(start), what] for file, what in found["ran"]]
        return tests

    def tests(self, mutation):
        """The tests that may notice a Mutation.

        A build of kernels for groups of work-items counts as a test of its own.

        Quick ones come first, and those that run little else: they look at this alone. The second
        variant of a test counts as twice as slow, the third as three times: one of each test comes
        early, and all variants of a quick one before a whole fit.
        """
        file = str(mutation.path.relative_to(ROOT))
        places = _kernel_places if file.startswith("kernels/") else _python_places
        near = set().union(*(self.ran.get(place, ()) for place in places(mutation, file)))
        if not near:  # of the file's lines: whichever tests run any
            near = set().union(*(tests for place, tests in self.ran.items() if place[0] == file))
        seen, order = {}, []
        cost = {test: self.seconds[test] * self.width[test] for test in near}
        for test in sorted(near, key=lambda test: (cost[test], test)):
            function = test.split("[")[0], "groups-" in test
            seen[function] = seen.get(function, -1) + 1
            order.append((cost[test] * (1 + seen[function]), test))
        return [test for _, test in sorted(order)]


def _python_places(mutation, file):
    """The mutation's line; of a constant all lines of the package that name it."""
    text = mutation.path.read_text(encoding="utf-8").splitlines()
    yield file, mutation.line
    first = mutation.line  # of the statement: what stands left of it begins it
    while first > 1 and text[first - 1][:1] in (" ", ")", "]", "}"):
        first -= 1
        if text[first - 1].startswith(("def ", "class ", "@")):
            break
    named = re.match(r"([A-Za-z_]\w*)\s*(?::[^=]+)?=", text[first - 1])
    if named:
        for path in sorted((ROOT / "clresample").rglob("*.py")):
            for i, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
                if re.search(rf"\b{named[1]}\b", line):
                    yield str(path.relative_to(ROOT)), i
    else:
        yield from ((file, line) for line in _statement(text, mutation.line))


def _statement(text, line):
    """Lines around one that an open bracket may join to it."""
    return range(max(1, line - 6), min(len(text), line + 3) + 1)


def _kernel_places(mutation, file):
    """The kernel around it; of what stands outside all kernels of the files that include it."""
    text = mutation.path.read_text(encoding="utf-8")
    for found in KERNEL.finditer(text):
        if found.start() <= mutation.start < found.end():
            yield file, found[1]
            return
    including = {mutation.path.name}
    for _ in range(3):  # a header may include another
        for path in _kernels():
            if any(f'#include "{name}"' in path.read_text(encoding="utf-8") for name in including):
                including.add(path.name)
    for name in including:
        for found in KERNEL.finditer((ROOT / "kernels" / name).read_text(encoding="utf-8")):
            yield f"kernels/{name}", found[1]


def _kernels():
    return sorted((ROOT / "kernels").iterdir())


def _helpers():
    tests = ROOT / "tests"
    return sorted([*(tests / "helpers").glob("*.py"), *tests.rglob("conftest.py")])


def _digest(paths, start=""):
    digest = hashlib.sha1(start.encode())
    for path in paths:
        digest.update(path.read_bytes())
    return digest.hexdigest()
