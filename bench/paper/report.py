"""The report: every figure beside the paper's statement and what was found here.

    python -m bench.paper.report [--folder FOLDER]

Each benchmark of the paper writes FOLDER/NAME.json, NAME as in `SECTIONS`, and its figures:

record     where, when and with what it ran: names and values
findings   list of `Finding`s, made from the run's own numbers

A benchmark that has not run is left out.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

from ..harness import records
from ..harness.options import BadOption, Parser, run

SECTIONS = {
    "accuracy": "Section 5: accuracy",
    "accuracy-wide": "Section 5: accuracy, drawn so that no light folds in",
    "accuracy-printed": "Section 5: accuracy, survey parameters as printed",
    "timing": "Section 4: speed",
    "joint": "Section 6: joint deblending",
}
VERDICTS = {True: "Holds.", False: "Does not hold.", None: "Not decided."}


@dataclass(frozen=True)
class Finding:
    """A statement beside what the numbers of a run say about it.

    label: of the paper's figure or equation, or "" for a statement of this project
    title: of the finding
    claim: the statement, in the paper's sense
    found: what was measured, as sentences made from the numbers
    holds: whether the statement holds; None where the numbers cannot tell
    figure: name of a PNG in the report's folder
    table: rows of texts, the first being the head
    """

    label: str
    title: str
    claim: str
    found: str
    holds: bool | None
    figure: str | None = None
    table: list | None = None


def save(folder, name, record, findings, **numbers):
    """Write FOLDER/NAME.json: the record, the findings, and the numbers they were made from."""
    content = {"record": record, "findings": [asdict(f) for f in findings], **numbers}
    records.write_json(folder / f"{name}.json", content)


def load(folder):
    """What has run, by name, in the order of `SECTIONS`."""
    paths = {name: folder / f"{name}.json" for name in SECTIONS}
    return {n: json.loads(path.read_text()) for n, path in paths.items() if path.exists()}


def markdown(results):
    """The report as text."""
    findings = [(name, f) for name, result in results.items() for f in result["findings"]]
    rows = [["statement", "where", "holds"]]
    rows += [[f["title"], SECTIONS[name], VERDICTS[f["holds"]]] for name, f in findings]
    lines = [
        "# The paper's evidence, recomputed",
        "",
        "Joseph, Melchior & Moolekamp, *Joint survey processing*: its figures and statements, each",
        "beside what this library, the paper's own scheme and GalSim do here. The sentences and",
        "verdicts are computed from the run's numbers, which lie beside this file as JSON.",
        "",
        *_table(rows),
    ]
    for name, result in results.items():
        lines += ["", f"## {SECTIONS[name]}", ""]
        lines += ["<details><summary>Device, versions, date</summary>", ""]
        lines += [f"- {key}: {value}" for key, value in result["record"].items()]
        lines += ["", "</details>"]
        for finding in result["findings"]:
            lines += ["", *_section(Finding(**finding))]
    return "\n".join(lines) + "\n"


def _section(finding):
    yield f"### {finding.title}" + (f" (`{finding.label}`)" if finding.label else "")
    if finding.figure:
        yield from ("", f"![{finding.title}]({finding.figure})")
    speaker = "The paper" if finding.label else "To be shown"
    yield from ("", f"*{speaker}:* {finding.claim}", "")
    yield f"*Here:* {finding.found} **{VERDICTS[finding.holds]}**"
    if finding.table:
        yield from ("", *_table(finding.table))


def _table(rows):
    head, *body = rows
    for row in (head, ["---"] * len(head), *body):
        yield "| " + " | ".join(map(str, row)) + " |"


def main(options):
    results = load(options.folder)
    if not results:
        raise BadOption(f"--folder {options.folder} holds no results yet")
    path = options.folder / "report.md"
    records.write_text(path, markdown(results))
    print(f"{path}: {', '.join(results)}")


def parser():
    parser = Parser("bench.paper.report", description=__doc__.splitlines()[0])
    parser.add_folder()
    return parser


if __name__ == "__main__":
    run(main, parser())
