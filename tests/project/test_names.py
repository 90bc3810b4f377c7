"""One subject, one name: no two classes of the package are called the same."""

import ast
from collections import defaultdict

from support.places import ROOT
from support.sources import tree

PACKAGE = ROOT / "swarmtrack"


def test_no_class_name_stands_twice():
    where = defaultdict(list)
    for path in sorted(PACKAGE.rglob("*.py")):
        # The programs and benchmarks below the package are links.
        module = path.relative_to(PACKAGE)
        if module.parts[0] in ("agents", "benchmarks"):
            continue
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.ClassDef):
                where[node.name].append(f"{module}:{node.lineno}")
    assert len(where) > 300
    assert {name: places for name, places in where.items() if len(places) > 1} == {}
