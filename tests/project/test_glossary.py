"""The glossary gives each word one meaning, and names a module for each term of the code."""

import importlib.util
import re

import pytest

from support.places import ROOT

ROW = re.compile(r"^\| (?P<words>[^|]+) \| [^|]+ \| `(?P<module>[\w.]+)` \|$", re.MULTILINE)
TERMS = {m["words"]: m["module"] for m in ROW.finditer((ROOT / "docs" / "glossary.md").read_text("utf-8"))}


def section(heading):
    text = (ROOT / "docs" / "glossary.md").read_text("utf-8")
    return re.search(rf"^## {heading}$(.*?)(?=^## |\Z)", text, re.DOTALL | re.MULTILINE)[1]


def rows(text):
    return [line for line in text.splitlines() if line.startswith("| ") and not line.startswith("| word ")]


def test_a_word_has_one_meaning():
    vocabulary = [row.split(" | ") for row in rows(section("Vocabulary"))]
    assert 40 <= len(vocabulary) <= 55
    words = [word for row in vocabulary for word in row[0].removeprefix("| ").split(", ")]
    words += [word for terms in TERMS for word in terms.split(", ")]
    assert len(words) == len(set(words))


def test_every_term_names_a_module():
    assert len(rows(section("Where the terms live"))) == len(TERMS) >= 30


@pytest.mark.parametrize("module", sorted(set(TERMS.values())))
def test_the_module_of_a_word_exists(module):
    assert importlib.util.find_spec(f"swarmtrack.{module}") is not None
