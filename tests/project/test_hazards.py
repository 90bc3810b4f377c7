"""docs/hazards.md names tests: each exists, and each hazard has one."""

import ast
import re

from support.places import ROOT

PAGE = (ROOT / "docs" / "hazards.md").read_text(encoding="utf-8")
ROWS = [row for row in PAGE.splitlines() if row.startswith("| ") and not row.startswith("| hazard ")]
NAMED = re.compile(r"`([\w/]+\.py)::(\w+)`")


def names_in(file):
    tree = ast.parse((ROOT / "tests" / file).read_text(encoding="utf-8"))
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)}


def test_each_named_test_exists():
    named = NAMED.findall(PAGE)
    assert len(named) > 20
    missing = [f"{file}::{name}" for file, name in named if name not in names_in(file)]
    assert missing == []


def test_each_hazard_has_a_barrier_a_test_and_what_is_left():
    for row in ROWS:
        hazard, barrier, test, left = (cell.strip() for cell in row.strip("|").split("|"))
        assert hazard, row
        assert barrier, row
        assert left, row
        assert NAMED.search(test), f"{hazard}: names no test"
