"""Sphinx extension: docstrings, plain text with a layout of their own, as reStructuredText.

What our docstrings do that reStructuredText would run together:

    name (shape) [unit]: text           a paragraph of parameters: one entry each
        continued
    formula = indented                   a formula or code, kept as it is
"""

import re

from elsewhere import SHORT

# A short name of another package's class, on its own: not a part of code or of a longer name.
ELSEWHERE = re.compile(rf"(?<![\w.`])({'|'.join(SHORT)})(?![\w`]|\.\w)")
PARAMETER = re.compile(
    r"^(?P<names>[\w*]+(?:, [\w*]+)*)"
    r"(?P<kind>(?: \([^:]*\))?(?: \[[^\]:]*\])?)"
    r"(?:: (?P<text>\S.*))?$"
)
SENTENCES = ("Raises", "Returns", "Source", "Sources", "Warns", "returns", "Words")


def blocks(lines):
    """Runs of lines between empty ones."""
    block = []
    for line in [*lines, ""]:
        if line.strip():
            block.append(line)
        elif block:
            yield block
            block = []


def described(line):
    """The parts of a line that begins to describe names; None for any other."""
    match = PARAMETER.match(line)
    plain = match and not match["text"] and not match["kind"]
    return None if not match or plain or match["names"].startswith(SENTENCES) else match


def entries(block):
    """A block that describes names, as definitions; None where it is plain text."""
    if not any(described(line) for line in block):
        return None
    out = []
    for line in block:
        match = described(line)
        if match:
            kind = f" : {match['kind'].strip()}" if match["kind"] else ""
            out += [
                "",
                f"{match['names'].replace('*', chr(92) + '*')}{kind}",
                f"    {match['text'] or '..'}",
            ]
        elif line.startswith("returns "):
            out += ["", "returns", f"    {line.removeprefix('returns ')}"]
        elif out:
            out.append(f"    {line.strip()}")
        else:
            return None
    return [*out, ""]


def _role(match):
    return f":py:class:`~{SHORT[match[1]]}`"


def _role(match):
    return f":py:class:`~{SHORT[match[1]]}`"


def linked(line):
    """A line with the classes of other packages as links, those between backticks apart."""
    parts = line.split("`")
    parts[::2] = [ELSEWHERE.sub(_role, part) for part in parts[::2]]
    return "`".join(parts)


def restructured(lines):
    """The lines of one docstring as reStructuredText."""
    out = []
    for block in blocks(lines):
        if block[0].startswith("    "):
            out += [
                "::",
                "",
                *(line if line[:4] == "    " else f"    {line}" for line in block),
                "",
            ]
            continue
        block = [line.replace("|", "\\|") for line in block]  # no substitution: an absolute value
        block = [linked(line) for line in block]
        out += entries(block) or [*(line.strip() for line in block), ""]
    return out


def process(app, what, name, obj, options, lines):
    """Sphinx calls this with each docstring."""
    lines[:] = restructured(lines)


def setup(app):
    """Register the conversion."""
    app.connect("autodoc-process-docstring", process)
    return {"parallel_read_safe": True}
