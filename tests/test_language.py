"""The language of the code, as far as a program can hold it: first lines, names, docstrings."""

import ast
import inspect
import re
from collections import Counter
from enum import Enum

import pytest
from helpers.checkout import ROOT

import clresample

MAX_FIRST_LINE = 93
MADE_ELSEWHERE = {"Device"}  # by `get_device`: users call no constructor
QUESTION = re.compile(r"(What|Who|Where|Which|How|Whether)\b")
FILES = sorted((ROOT / "clresample").rglob("*.py"))
PUBLIC = [
    name for name in sorted(clresample.__all__)
    if name not in MADE_ELSEWHERE and callable(getattr(clresample, name))
]  # fmt: skip
TREES = {path.relative_to(ROOT).as_posix(): ast.parse(path.read_text("utf-8")) for path in FILES}


def faults_of(docstring):
    """What is wrong with the first line of a docstring, a word each."""
    first, *rest = docstring.split("\n")
    return [
        *(["a question"] if QUESTION.match(first) else []),
        *(["too long"] if len(first) > MAX_FIRST_LINE else []),
        *(["goes on"] if rest and rest[0].strip() else []),
    ]


def documented(tree):
    """(name, docstring) of a module, its classes and functions."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            docstring = ast.get_docstring(node)
            if docstring:
                yield getattr(node, "name", "the module"), docstring


def test_first_lines_are_one_sentence_on_one_line():
    found = {
        (path, name): faults_of(text) for path in TREES for name, text in documented(TREES[path])
    }
    assert len(found) > 1000 and {one: faults for one, faults in found.items() if faults} == {}


@pytest.mark.parametrize(
    ("docstring", "faults"),
    [
        ("Renders a model.", []),
        ("Whichever is larger.", []),
        ("Which sources (S,) are fixed.", ["a question"]),
        ("Renders a model, in\nall channels.", ["goes on"]),
        ("Renders a model.\n\nIn all channels.", []),
        ("Renders " + "x" * 90, ["too long"]),
    ],
)
def test_faults_of_first_lines_are_found(docstring, faults):
    assert faults_of(docstring) == faults


def test_no_class_name_has_two_meanings():
    names = Counter(
        node.name
        for tree in TREES.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
    )
    assert [name for name, n in names.items() if n > 1] == []


def test_limits_are_called_max_and_min():
    names = {
        (path, node.id)
        for path, tree in TREES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Name) and re.match(r"_?(MOST|LEAST)(_|$)", node.id)
    }
    assert names == set()


def parameters_of(thing):
    """Names of the parameters of a function, or of what makes an instance of a class."""
    if isinstance(thing, type) and issubclass(thing, Enum | Exception):
        return []
    taken = inspect.signature(thing).parameters.values()
    return [p.name for p in taken if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]


def text_of(thing):
    """Docstring of a function, or of a class, its bases and what makes an instance."""
    if not isinstance(thing, type):
        return thing.__doc__ or ""
    own = [c for c in thing.__mro__ if c.__module__.startswith("clresample")]
    return "\n".join(filter(None, [*(c.__doc__ for c in own), *(c.__init__.__doc__ for c in own)]))


@pytest.mark.parametrize("name", PUBLIC)
def test_public_docstrings_name_each_parameter_and_say_what_is_raised(name):
    thing = getattr(clresample, name)
    text = text_of(thing)
    assert [p for p in parameters_of(thing) if not re.search(rf"\b{p}\b", text)] == []
    if inspect.isfunction(thing) and "raise " in inspect.getsource(thing):
        assert "Error" in text


UNITS = {"_px": "px", "_arcsec": "arcsec", "_deg": "deg", "_s": "s"}


@pytest.mark.parametrize("name", PUBLIC)
def test_public_parameters_with_a_unit_in_their_name_have_it_or_are_named_in_full(name):
    """`tile_px` in full says its unit; a docstring that gives another one is wrong."""
    thing = getattr(clresample, name)
    text = text_of(thing)
    for parameter in parameters_of(thing):
        unit = next((u for end, u in UNITS.items() if parameter.endswith(end)), None)
        given = re.search(rf"\b{parameter}\b(?: \([^)]*\))? \[([^\]]*)\]", text)
        if unit and given:
            assert unit in given[1].replace("pixel", "px"), (parameter, given[1])
