"""The report: the paper's statements beside what was found here, and our own targets.

    python -m bench.paper.report [--folder FOLDER]

Each benchmark of the paper writes FOLDER/NAME.json, NAME as in `SECTIONS`, and its figures: the
record, where, when and with what it ran, and its numbers.  The report is made from these files
alone, so that its sentences can change without a new run: report.md, the statements, and
details.md, a section for each run.  A benchmark that has not run is left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from ..harness import records
from ..harness.options import BadOption, Parser, run
from . import accuracy_findings, joint_findings, timing_findings
from .finding import Finding, verdict


@dataclass(frozen=True)
class Section:
    """One benchmark in one setting.

    name: of its file
    title: in the report
    findings: from the file's numbers to `Finding`s
    departs: "setting" or "start", in which it differs from the paper; "" where it does not
    how: in what way it differs
    """

    name: str
    title: str
    findings: Callable
    departs: str = ""
    how: str = ""


_ACCURACY, _JOINT = accuracy_findings.findings, joint_findings.findings
SECTIONS = (
    Section("timing", "Section 4: speed", timing_findings.findings),
    Section("accuracy", "Section 5: accuracy", partial(_ACCURACY, "accuracy")),
    Section(
        "accuracy-wide",
        "Section 5: accuracy, drawn so that no light folds in",
        partial(_ACCURACY, "accuracy-wide"),
        "setting",
        "stamps cut from wide drawings",
    ),
    Section(
        "accuracy-printed",
        "Section 5: accuracy, survey parameters as printed",
        partial(_ACCURACY, "accuracy-printed"),
        "setting",
        "survey parameters as the paper prints them",
    ),
    Section("joint", "Section 6: joint deblending", partial(_JOINT, "sersic")),
    Section(
        "joint",
        "Section 6: joint deblending, starting from positions alone",
        partial(_JOINT, "own"),
        "start",
        "positions alone",
    ),
)

INTRODUCTION = """\
# The paper's evidence, recomputed

What Joseph, Melchior & Moolekamp, *Joint survey processing: combined resampling and convolution
for galaxy modelling and deblending*, state about their scheme, each statement beside what was found
here; then what this project asks of itself. Every sentence and verdict is computed from the runs'
numbers. `make paper` measures them and writes figures, tables and the machine's record beside this
page, in details.md, with the numbers as JSON; of these only this page is kept.

- **Ours** is `Resampler`, in float32 where float64 is not named. **The paper's scheme** is the
  paper's own factorisation on OpenCL, `PaperResampler`. **GalSim's default** interpolates with a
  quintic kernel. Statements on accuracy and deblending are tested with ours, statements on speed
  with the paper's scheme.
- **SDR** [dB] is 10 log10(|X| / |X~ - X|) of an estimate X~ and the truth X, both of unit sum:
  residuals ten times smaller are 10 dB more.
- N x N are the pixels of the finer image, the model stamp; M x M those of the coarser one, the
  observed stamp. **On the diagonal** a survey is resampled onto itself.
- A statement that **does not hold** fails for one of three reasons, named beside it: we are better
  than the statement says; the statement is about another setting or start than the run's; or we
  fall short of it.
- The paper has 10 000 galaxies and 2315 blended scenes; the Makefile says how many
  `make paper` runs."""
PAPER = """\
## The paper's statements

In the paper's setting: survey parameters from the notebooks behind its figures, stamps drawn as
they are, and fits that start from Sersic profiles fitted to the truth. Where the paper gives no
number, its words stand for one. Labels such as `fig:SDR` are those of the paper's LaTeX source. Its
times with the full matrix R (section 3) are not measured again."""
ELSEWHERE = """\
### The same statements in other settings

Light that GalSim's drawing folds into a stamp is kept out by cutting stamps from *wide drawings*;
*printed* survey parameters are those of the paper's table, which differ from its notebooks'; fits
that start from *positions alone* know nothing else of the truth."""
TARGETS = """\
## Our own targets

What this project asks of itself, in the paper's setting and others; the paper states none of it."""
DETAILS = """\
# The paper's evidence, recomputed: details

A section for each run: what it ran on, its figures and its tables."""


@dataclass(frozen=True)
class _Entry:
    """One finding of one section, and its verdict."""

    section: Section
    finding: Finding
    verdict: str


def save(folder, name, record, **numbers):
    """Writes FOLDER/NAME.json, the record and the numbers, and prints the findings."""
    path = folder / f"{name}.json"
    records.write_json(path, {"record": record, **numbers})
    for entry in _entries({name: records.read_json(path)}):
        finding = entry.finding
        print(f"{entry.section.title}: {finding.claim.title}: {entry.verdict} {finding.found}")


def load(folder):
    """Records and numbers of what has run, by name."""
    paths = {section.name: folder / f"{section.name}.json" for section in SECTIONS}
    return {name: records.read_json(path) for name, path in paths.items() if path.exists()}


def statements(results):
    """The page of the statements as text; results: as `load` returns them."""
    entries = _entries(results)
    of_paper = [entry for entry in entries if entry.finding.claim.label]
    lines = [INTRODUCTION, "", PAPER]
    lines += _statements([entry for entry in of_paper if not entry.section.departs], results)
    lines += _elsewhere([entry for entry in of_paper if entry.section.departs])
    lines += _targets([entry for entry in entries if not entry.finding.claim.label])
    return "\n".join(lines) + "\n"


def details(results):
    """The page with a section for each run as text; results: as `load` returns them."""
    lines, section = [DETAILS], None
    for entry in _entries(results):
        if entry.section is not section:
            section = entry.section
            lines += _record(section.title, results[section.name]["record"])
        lines += _details(entry)
    return "\n".join(lines) + "\n"


def _entries(results):
    """Every finding of the runs; those of other settings are judged in view of the paper's own."""
    found = [(s, f) for s in SECTIONS if s.name in results for f in s.findings(results[s.name])]
    originals = {f.claim: f for s, f in found if not s.departs}
    return [_Entry(s, f, verdict(f, s.departs, originals.get(f.claim))) for s, f in found]


def _statements(entries, results):
    """The paper's statements in its own setting, a table for each of its sections."""
    for section in dict.fromkeys(entry.section for entry in entries):
        rows = [
            [
                f"**{f.claim.title}.** {f.claim.text} (`{f.claim.label}`)",
                f.claim.number,
                f.number,
                f"**{entry.verdict}** {f.found}",
            ]
            for entry in entries
            if entry.section is section
            for f in [entry.finding]
        ]
        record = results[section.name]["record"]
        run_on = f"{record['date'][:10]}, {record['device']}, clresample {record['clresample']}."
        yield from ("", f"### {section.title}", "", f"Measured on {run_on}", "")
        yield from _table(["the paper says", "its number", "here", "what was found"], rows)


def _elsewhere(entries):
    """The paper's statements in other settings, in one table."""
    rows = [
        [entry.section.how, f.claim.title, f.claim.number, f.number, f"**{entry.verdict}**"]
        for entry in entries
        for f in [entry.finding]
    ]
    if rows:
        yield from ("", ELSEWHERE, "")
        yield from _table(["setting or start", "statement", "its number", "here", "verdict"], rows)


def _targets(entries):
    """Our own targets in all settings, in one table."""
    rows = [
        [
            f"**{f.claim.title}.** {f.claim.text}",
            entry.section.how or "the paper's",
            f.claim.number,
            f.number,
            f"**{entry.verdict}** {f.found}",
        ]
        for entry in entries
        for f in [entry.finding]
    ]
    yield from ("", TARGETS, "")
    yield from _table(["target", "setting or start", "asked", "here", "what was found"], rows)


def _record(title, record):
    """The head of a section of details."""
    yield from ("", f"## {title}", "")
    yield from ("<details><summary>Device, versions, date</summary>", "")
    yield from (f"- {name}: {value}" for name, value in record.items())
    yield from ("", "</details>")


def _details(entry):
    """One finding with its figure and table."""
    finding, claim = entry.finding, entry.finding.claim
    yield from ("", f"### {claim.title}" + (f" (`{claim.label}`)" if claim.label else ""))
    if finding.figure:
        yield from ("", f"![{claim.title}]({finding.figure})")
    yield from ("", f"*{'The paper' if claim.label else 'Our target'}:* {claim.text}", "")
    yield f"*Here:* **{entry.verdict}** {finding.found} {finding.more}".rstrip()
    if finding.table:
        yield ""
        yield from _table(finding.table[0], finding.table[1:])


def _table(head, rows):
    for row in (head, ["---"] * len(head), *rows):
        yield "| " + " | ".join(map(str, row)) + " |"


def main(options):
    results = load(options.folder)
    if not results:
        raise BadOption(f"--folder {options.folder} holds no results yet")
    for name, page in {"report": statements, "details": details}.items():
        path = options.folder / f"{name}.md"
        records.write_text(path, page(results))
        print(f"{path}: {', '.join(results)}")


def parser():
    parser = Parser(__doc__)
    parser.add_folder()
    return parser


if __name__ == "__main__":
    run(main, parser())
