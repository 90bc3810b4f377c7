"""One word, one constant: names of the library's constants bear their subject, and none is defined in two modules.

Exempt for now: `identity`, and what of `relative` serves it. A leading underscore: the module's own.
"""

import ast
import re
from collections import Counter, defaultdict
from pathlib import Path

from support.places import ROOT
from support.sources import tree

LIBRARY = ROOT / "swarmtrack"
EXEMPT = {LIBRARY / "relative" / name for name in ("gates.py",)}
# Words that do not say of what: alone, or with nothing but a unit behind them, they are no name.
BARE = {
    "AHEAD", "APART", "ATTEMPTS", "BACKLOG", "BATCH", "BLOCK", "BORDER", "CAREFUL", "COARSEST", "DOUBT", "ENOUGH",
    "EVERY", "FAR", "FARTHEST", "FAST", "FASTER", "FASTEST", "FEWER", "FEWEST", "GAMMA", "GATE", "HALF", "HOLD",
    "HOLDS", "KEPT", "KNOWN", "LARGE", "LARGEST", "LASTS", "LATE", "LEAST", "LIMIT", "LONGEST", "LOOK", "LOWEST",
    "MAGIC", "MANY", "MARGIN", "MEMORY", "MOST", "NEAR", "NEAREST", "NOBODY", "NOTHING", "NOWHERE", "PATIENCE",
    "PERIOD", "PLACE", "QUIET", "RATE", "REACH", "REMEMBERED", "RETRY", "ROUNDING", "SAME", "SEEN", "SETTLED",
    "SETTLES", "SHORT", "SHORTEST", "SIGMA", "SIGMAS", "SILENT", "SLACK", "SLOWEST", "SMALL", "SMALLEST", "SOON",
    "SPEED", "STALE", "STEP", "STEPS", "STILL", "SURE", "SURELY", "TELLING", "TICK", "TURNED", "UNKNOWN", "VAGUE",
    "WIDE", "WIDEST", "WINDOW", "WITHIN",
}  # fmt: skip
UNIT = re.compile(r"_(S|MS|US|M|PX|PX2|RAD|DEG|HZ|M_S|M_S2|RAD_S|PER_S|BYTES)$")


def constants_of(module: ast.Module) -> list[str]:
    """Upper-case names that a module defines at its head; a single letter is a type variable."""
    found = []
    for node in module.body:
        targets = (
            node.targets
            if isinstance(node, ast.Assign)
            else [node.target]
            if isinstance(node, ast.AnnAssign)
            else []
        )
        for target in targets:
            names = target.elts if isinstance(target, ast.Tuple) else [target]
            found += [name.id for name in names if isinstance(name, ast.Name)]
    return [name for name in found if name.isupper() and len(name) > 1 and not name.startswith("_")]


def modules_of_each_constant() -> dict[str, list[Path]]:
    found = defaultdict(list)
    for path in sorted(LIBRARY.rglob("*.py")):
        if "identity" not in path.relative_to(LIBRARY).parts and path not in EXEMPT:
            for name in constants_of(tree(path)):
                found[name].append(path.relative_to(ROOT))
    return found


def test_the_search_finds_constants_alone_in_tuples_and_annotated():
    assert constants_of(ast.parse("A_B = 1\nC_D, E_F = 1, 2\nG_H: int = 3\nT = 4\n_OWN = 5\nword = 6\n")) == [
        "A_B",
        "C_D",
        "E_F",
        "G_H",
    ]


def test_no_constant_is_defined_in_two_modules():
    twice = {
        name: list(map(str, places)) for name, places in modules_of_each_constant().items() if places[1:]
    }
    assert not twice


def test_no_constant_is_a_bare_word():
    bare = {
        name: str(places[0])
        for name, places in modules_of_each_constant().items()
        if name in BARE or UNIT.sub("", name) in BARE
    }
    assert not bare


def test_every_constant_of_a_table_is_used():
    code = {path: path.read_text(encoding="utf-8") for path in LIBRARY.rglob("*.py")}
    tables = [path for path in code if path.name in ("priors.py", "limits.py", "margins.py")]
    words = Counter(re.findall(r"\b[A-Z][A-Z0-9_]+\b", "\n".join(code.values())))
    unused = {
        name: path.parent.name for path in tables for name in constants_of(tree(path)) if words[name] < 2
    }
    assert len(tables) > 8
    assert not unused
