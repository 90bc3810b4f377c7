"""What is long says why: the reason is the marker's argument, and `pytest -m long --collect-only` lists them."""

import ast

from support.places import ROOT
from support.sources import tree


def reasons() -> list[tuple[str, str | None]]:
    """(place, reason) of every use of the marker; None where it has no reason."""
    found: list[tuple[str, str | None]] = []
    for path in sorted((ROOT / "tests").rglob("*.py")):
        nodes = list(ast.walk(tree(path)))
        called = {id(node.func): node for node in nodes if isinstance(node, ast.Call)}
        found += [
            (f"{path.relative_to(ROOT)}:{node.lineno}", reason(called.get(id(node))))
            for node in nodes
            if isinstance(node, ast.Attribute) and ast.unparse(node) == "pytest.mark.long"
        ]
    return found


def reason(call: ast.Call | None) -> str | None:
    if call is None or len(call.args) != 1 or not isinstance(call.args[0], ast.Constant):
        return None
    text = call.args[0].value
    return text if isinstance(text, str) and len(text.split()) >= 3 else None


def test_whatever_is_long_says_why():
    found = reasons()
    assert len(found) > 20
    assert [where for where, why in found if why is None] == []
