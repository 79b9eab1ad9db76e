"""The mutations of a source file: one token changed, as a slip of the pen would change it."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

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


C_SWAPS = {**SWAPS, "sqrt": "fabs", "abs": "(int)"}
C_TYPES = {"REAL", "float", "double", "int", "uint", "long", "ulong", "char", "void"}


@dataclass(frozen=True)
class Mutation:
    """A change of one token of a file.

    `old` at character `start` became `new`. `shown` is the file's line before it, on which it is
    number `place`, from 1, of equal changes.
    """

    path: Path
    line: int
    start: int
    old: str
    new: str
    shown: str
    place: int

    @property
    def change(self):
        """Shown change, for example "< -> <="."""
        return f"{self.old} -> {self.new or 'nothing'}"

    def applied(self, text):
        """The file's text with it."""
        return text[: self.start] + self.new + text[self.start + len(self.old) :]

    def parses(self, text):
        """False of Python that is none after it; C is left to the compiler."""
        try:
            return self.path.suffix != ".py" or bool(ast.parse(self.applied(text)))
        except SyntaxError:
            return False


def mutations(path):
    """Every Mutation of a source file."""
    text = path.read_text(encoding="utf-8")
    lines, swaps = text.splitlines(), SWAPS if path.suffix == ".py" else C_SWAPS
    found, places = [], Counter()
    for line, start, old in _tokens(path, text):
        if re.fullmatch(r"\d+\.?\d*(?:[eE][-+]?\d+)?f?", old):
            changed = [f"({old} + 1)"]
            if float(old.rstrip("f")) > 1:
                changed.append(f"({old} - 1)")
        else:
            changed = [swaps[old]] if old in swaps else []
        shown = lines[line - 1].strip()
        places[line, old] += 1
        at = places[line, old]
        found += [Mutation(path, line, start, old, new, shown, at) for new in changed]
    return found


def _tokens(path, text):
    """(line, offset, text) of every token that may be changed."""
    if path.suffix != ".py":
        previous = ""
        for match in C_TOKENS.finditer(text):
            pointer = match[0] == "*" and previous in C_TYPES
            if match.lastgroup != "skip" and not pointer:
                yield text.count("\n", 0, match.start()) + 1, match.start(), match[0]
            previous = match[0]
        return
    starts = [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    previous = ""
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type in (tokenize.OP, tokenize.NAME, tokenize.NUMBER):
            unpacked = token.string in ("*", "**") and previous in ("(", ",", "[", "{")
            head = token.line.lstrip().startswith(("def ", "class ", "@"))
            imported = "import" in token.line
            strict = previous == "=" and "strict=" + token.string in token.line
            annotated = token.string == "|" and (":" in token.line or "->" in token.line)
            if not (unpacked or head or imported or annotated or strict):
                yield token.start[0], starts[token.start[0] - 1] + token.start[1], token.string
        if token.type != tokenize.NL:
            previous = token.string
