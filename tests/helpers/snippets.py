"""Code of Markdown pages, in its order, for tests that execute it."""

from __future__ import annotations

import re
import shlex

FENCED = re.compile(r"^```(\{?[\w-]*\}?)[^\n]*\n(.*?)^```$", flags=re.DOTALL | re.MULTILINE)


def snippets(text):
    """All that a page has to run: [("python", code) or ("command", words)].

    Python stands in fences, ```python or myst-nb's ```{code-cell}; a command is a line of an
    indented block that begins with `clresample`, its words those after the name, without comments.
    """
    found, end = [], 0
    for block in FENCED.finditer(text):
        found += _commands(text[end : block.start()])
        if block[1] in ("python", "{code-cell}"):
            lines = [line for line in block[2].splitlines() if not line.startswith(":tags:")]
            found.append(("python", "\n".join(lines)))
        end = block.end()
    return found + _commands(text[end:])


def _commands(prose):
    lines = re.findall(r"^    (clresample .*)$", prose, flags=re.MULTILINE)
    return [("command", shlex.split(line, comments=True)[1:]) for line in lines]
