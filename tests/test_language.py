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
PUBLIC = [
    name for name in sorted(clresample.__all__)
    if name not in MADE_ELSEWHERE and callable(getattr(clresample, name))
]  # fmt: skip


def trees_of(folder):
    """{path: syntax tree} of the Python files in a folder of the checkout."""
    paths = sorted((ROOT / folder).rglob("*.py"))
    return {path.relative_to(ROOT).as_posix(): ast.parse(path.read_text("utf-8")) for path in paths}


TREES = trees_of("clresample")
ALL_TREES = TREES | trees_of("bench") | trees_of("tools")


def faults_of(docstring):
    """Faults of the first line of a docstring, a word each."""
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
    found = [
        (path, name, faults_of(text))
        for path, tree in ALL_TREES.items()
        for name, text in documented(tree)
    ]
    assert len(found) > 1000 and [one for one in found if one[2]] == []


def test_first_lines_of_tests_are_no_questions():
    question = re.compile(rf'^ *"""{QUESTION.pattern}.*', re.MULTILINE)
    found = [
        (path.name, line[0])
        for path in (ROOT / "tests").rglob("*.py")
        for line in question.finditer(path.read_text("utf-8"))
    ]
    assert found == []


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


def members(node):
    """Names in a class: methods, arguments, fields, and attributes that it sets."""
    for inner in ast.walk(node):
        match inner:
            case ast.FunctionDef(name=name) | ast.arg(arg=name) | ast.Name(id=name):
                yield name
            case ast.Attribute(attr=name, ctx=ast.Store()):
                yield name


def all_members():
    """{class of the package: its members and those of its bases}, but for foreign bases."""
    nodes = [n for tree in TREES.values() for n in ast.walk(tree) if isinstance(n, ast.ClassDef)]
    own = {node.name: set(members(node)) for node in nodes}
    bases = {node.name: [ast.unparse(base) for base in node.bases] for node in nodes}

    def of(name):
        return own[name].union(*(of(base) for base in bases[name] if base in own))

    return {name: of(name) for name in own if not any("." in base for base in bases[name])}


def test_members_of_classes_in_texts_exist():
    """In docstrings, comments and pages: a name from before a change would mislead."""
    known, paths = all_members(), [ROOT / path for path in TREES]
    texts = [*paths, *(ROOT / "docs").rglob("*.md"), *(ROOT / "kernels").iterdir()]
    found = [
        (path.name, f"{owner}.{name}")
        for path in texts
        for owner, name in re.findall(r"(?<![\w.])([A-Z]\w+)\.([a-z_]\w*)", path.read_text("utf-8"))
        if owner in known and name not in known[owner]
    ]
    assert found == []
