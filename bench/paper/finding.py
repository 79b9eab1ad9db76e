"""A statement, what the numbers of a run say about it, and the verdict in one line."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Claim:
    """A statement of the paper, or a target of this project.

    label: where the paper makes it, by the label in its LaTeX source; "" for a target of ours
    title: what it is about, in a few words
    text: the statement in one sentence, in words of our own
    number: the number that comes with it, or the words that stand for one
    """

    label: str
    title: str
    text: str
    number: str


@dataclass(frozen=True)
class Finding:
    """Result of a run about a claim.

    claim: the statement
    number: ours, to be read beside the claim's
    found: what was measured, in one sentence
    holds: whether the claim holds; None where the numbers cannot tell
    better: of a claim that does not hold, whether we are better than it says rather than worse
    more: further sentences, for the details
    figure: name of a PNG in the report's folder
    table: rows of texts, the first being the head
    """

    claim: Claim
    number: str
    found: str
    holds: bool | None
    better: bool = False
    more: str = ""
    figure: str | None = None
    table: list | None = None


def verdict(finding, departs="", original=None):
    """The verdict on a claim in one line: it holds, or not and the reason.

    departs: "setting" or "start", in which a run differs from the paper's; "" where it does not
    original: the finding about the same claim in the paper's own setting, if it was run
    """
    if finding.holds is None:
        return "Not decided."
    if finding.holds:
        return "Holds."
    if finding.better:
        return "Does not hold: we are better."
    if not (departs and finding.claim.label):  # targets of ours are meant for every setting
        return "Does not hold: we fall short."
    about = f"Does not hold: the statement is about another {departs}"
    if original is None or original.holds is None:
        return f"{about}."
    there = {"setting": "in that one", "start": "from that one"}[departs]
    if original.holds:
        return f"{about}, and {there} it holds."
    return f"{about}, and {there} " + (
        "we are better." if original.better else "we fall short too."
    )
