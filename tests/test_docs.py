"""The documentation's sources: every public name is in it, every link leads somewhere.

`make docs` executes the examples and fails on any of Sphinx's warnings; this is what can be seen
without Sphinx, in a second.
"""

import importlib
import re
import zlib
from pathlib import Path

import pytest
from helpers.checkout import ROOT

import clresample

DOCS = ROOT / "docs"
PAGES = sorted(path for path in DOCS.rglob("*.md") if "_build" not in path.parts)
TEXTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *PAGES]


def links(text):
    """Links and images of a Markdown text, code blocks apart."""
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    return re.findall(r"\]\(([^)\s]+)\)", prose)


def toctree(text):
    """The pages that a text's toctrees name."""
    for block in re.findall(r"```\{toctree\}(.*?)```", text, flags=re.DOTALL):
        yield from (line for line in block.splitlines() if line and not line.startswith(":"))


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_link_leads_somewhere(path):
    for link in links(path.read_text()):
        if not link.startswith(("http://", "https://", "#")):
            assert (path.parent / link.partition("#")[0]).exists(), link


def test_every_page_is_in_the_contents():
    listed = {DOCS / "index.md"}
    for path in PAGES:
        listed |= {(path.parent / f"{name}.md") for name in toctree(path.read_text())}
    assert set(PAGES) == listed


def test_every_public_name_is_in_the_reference_once():
    reference = (DOCS / "reference.md").read_text()
    kinds = r"auto(?:class|function)|py:data"
    found = re.findall(rf"^\.\. (?:{kinds}):: ([A-Za-z_]+)$", reference, re.MULTILINE)
    assert sorted(found) == sorted(clresample.__all__)


def test_links_to_other_packages_lead_to_what_there_is(monkeypatch, tmp_path):
    """In files that need no network; as intersphinx reads them."""
    monkeypatch.syspath_prepend(str(DOCS))
    elsewhere = importlib.import_module("elsewhere")
    mapping = elsewhere.write_inventories(tmp_path / "inventories")
    assert set(mapping) == set(elsewhere.PROJECTS)
    for address, path in mapping.values():
        *head, rest = Path(path).read_bytes().split(b"\n", 4)
        assert head[0] == b"# Sphinx inventory version 2" and address.endswith("/")
        for line in zlib.decompress(rest).decode().splitlines():
            name, kind, priority, page, shown = line.split()
            module, _, last = name.rpartition(".")
            if module.startswith("matplotlib"):
                pytest.importorskip("matplotlib")
            found = getattr(importlib.import_module(module), last)
            assert isinstance(found, type) == (kind == "py:class")
            assert priority == "1" and shown == "-" and page.endswith(f".html#{name}")


def test_docstrings_link_classes_of_others_and_leave_code_alone(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS))
    docstrings = importlib.import_module("docstrings")
    link = ":py:class:`~astropy.table.QTable`"
    assert docstrings.linked("a QTable, `QTable` of QTables") == f"a {link}, `QTable` of QTables"
    assert docstrings.linked("QTable.read") == "QTable.read"


def test_a_broken_link_is_seen():
    assert links("see [here](missing.md) and ```[x](y)```") == ["missing.md"]
