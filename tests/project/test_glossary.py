"""The glossary names a module for each word, and each is there."""

import importlib.util
import re

import pytest

from support.places import ROOT

ROW = re.compile(r"^\| (?P<words>[^|]+) \| [^|]+ \| `(?P<module>[\w.]+)` \|$", re.MULTILINE)
TERMS = {m["words"]: m["module"] for m in ROW.finditer((ROOT / "docs" / "glossary.md").read_text("utf-8"))}


def test_every_row_names_a_module():
    text = (ROOT / "docs" / "glossary.md").read_text("utf-8")
    rows = [line for line in text.splitlines() if line.startswith("| ") and not line.startswith("| word ")]
    assert len(rows) == len(TERMS) >= 30


@pytest.mark.parametrize("module", sorted(set(TERMS.values())))
def test_the_module_of_a_word_exists(module):
    assert importlib.util.find_spec(f"swarmtrack.{module}") is not None
