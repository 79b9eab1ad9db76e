"""The list of mutations that are taken to change nothing: of lines that are still there."""

import pytest
from helpers.checkout import ROOT
from mutants.__main__ import equivalents


@pytest.mark.parametrize("file", sorted({file for file, *_ in equivalents()}))
def test_equivalent_mutations_are_of_lines_that_are_there(file):
    lines = {line.strip() for line in (ROOT / file).read_text(encoding="utf-8").splitlines()}
    gone = [line for name, line, *_ in equivalents() if name == file and line not in lines]
    assert not gone
