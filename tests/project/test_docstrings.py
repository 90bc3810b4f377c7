"""Docstrings of public names begin with a noun or a verb, and are free of the turns that test_prose.py refuses most.

Functions, classes and modules count whose names, and whose classes' names, begin without an underscore.
"""

import ast
import re

import pytest

from support.places import ROOT
from support.sources import tree

PACKAGE = ROOT / "swarmtrack"
OUTSIDE = ("agents", "benchmarks")  # links: the programs and benchmarks beside the package
WAITS = {"identity", "lab", "onboard.py", "perceived.py", "runtime/door.py"}
"""Rooms and modules that still have such docstrings. Identity's change with its rules."""

REFUSED = {
    "a headless relative at the beginning": r"\A(?:Who(?:m|se)?|That|Told) ",
    "a fragment with 'of' at the beginning": r"\AOf ",
    "a person's pronoun": r"\b(?:[Ww]ho(?:m|se)?ever|[Nn]obody|[Ss]omebody|[Ee]verybody)\b",
    "'anew' for 'again'": r"\banew\b(?!:)",
    "'beside' for 'next to' or 'and'": r"\b[Bb]eside\b",
}


def public_docstrings(tree):
    """(name, docstring) of a module and of the public classes and functions in it."""

    def walk(node, name):
        text = ast.get_docstring(node)
        if text:
            yield name or "the module", text
        for child in node.body:
            if isinstance(child, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                is_inner = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
                if not is_inner and not child.name.startswith("_"):
                    yield from walk(child, f"{name}.{child.name}".lstrip("."))

    yield from walk(tree, "")


def refused(text):
    text = re.sub(r"`[^`]*`", "`", text)
    return [what for what, pattern in REFUSED.items() if re.search(pattern, text)]


def place_of(path):
    """The room of a module, or the module itself where it waits alone."""
    module = path.relative_to(PACKAGE)
    return str(module) if str(module) in WAITS else module.parts[0]


MODULES = [
    path for path in sorted(PACKAGE.rglob("*.py")) if path.relative_to(PACKAGE).parts[0] not in OUTSIDE
]
PLACES = sorted({place_of(path) for path in MODULES})


def found_in(place):
    return [
        f"{path.relative_to(PACKAGE)}: {name}: {', '.join(what)}"
        for path in MODULES
        if place_of(path) == place
        for name, text in public_docstrings(tree(path))
        if (what := refused(text))
    ]


@pytest.mark.parametrize("place", [place for place in PLACES if place not in WAITS])
def test_docstrings_are_free_of_them(place):
    assert found_in(place) == []


@pytest.mark.parametrize("place", sorted(WAITS))
def test_a_place_that_waits_has_some_and_leaves_the_list_when_it_has_none(place):
    assert found_in(place) != []


@pytest.mark.parametrize(
    "text",
    [
        "Of the pictures of one of a drone's cameras, from 0: that of the first has no number.",
        "Who is linked, and yet not heard.",
        "Told of samples; answers with what they say.",
        "Ask a teammate to say anew where it is.",
        "What a drone listens to, beside tokens.",
        "A temporary file that nobody else sees.",
    ],
)
def test_what_docstrings_once_said_is_refused(text):
    assert refused(text) != []


@pytest.mark.parametrize(
    "text", ["Zenoh key of one camera's video; camera 0 has no suffix.", "Reads `anew` from `beside`."]
)
def test_plain_ones_and_quoted_names_are_not(text):
    assert refused(text) == []
