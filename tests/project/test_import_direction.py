"""Imports go one way, and the core touches nothing outside itself (STYLE.md, "One direction of imports")."""

import ast
import re
import sys
from collections.abc import Callable, Iterable, Set
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

from support import sources
from support.places import ROOT

# From the bottom up: a module may import from its own layer and from those before it.
LAYERS: list[set[str]] = [
    {
        "errors",
        "messages",
        "clock",
        "arguments",
        "ending",
        "plain_text",
        "log_lines",
        "guard",
        "mavlink_dialect",
    },
    {"geometry"},
    {"motion", "tracking", "identity", "relative", "formation", "team", "strangers"},
    {"cameras", "carried"},
    {"onboard", "perceived", "follower"},
    {"wire", "security"},
    {"config"},
    {"sources", "detection", "camera_sources", "autopilot", "transport", "recording", "calibration"},
    {"diagnosis", "outputs"},
    {"runtime"},
    {"doctor", "setup"},
    {"lab.world", "lab.score", "lab.autopilots", "lab.scenarios", "lab.sources"},
    {"training", "lab.swarm"},
    {"replay"},
    {"monitor", "client", "review"},
    {"benchmarks"},
    {"agents"},
]
LAYER = {name: depth for depth, names in enumerate(LAYERS) for name in names}
CORE = {
    "errors", "messages", "plain_text", "geometry", "motion", "tracking", "identity", "relative", "team", "formation",
    "strangers", "carried", "onboard", "perceived", "follower",
}  # fmt: skip
# What judges and says, and touches nothing: facts in, sentences out.
JUDGES = {"diagnosis", "lab.score", "monitor.verdict", "monitor.team", "monitor.timeline"}
TOUCHES_THE_WORLD = {
    "asyncio",
    "threading",
    "socket",
    "subprocess",
    "aiohttp",
    "zenoh",
    "cv2",
    "serial",
    "onnxruntime",
}
# Of the standard library: no I/O, no clock, no concurrency.
PURE = {
    "__future__", "abc", "bisect", "collections", "contextlib", "copy", "dataclasses", "difflib", "enum", "fractions",
    "functools", "heapq", "itertools", "math", "operator", "random", "re", "statistics", "string", "struct", "types",
    "typing", "zlib",
}  # fmt: skip
STOPWATCHES = {"perf_counter", "process_time", "thread_time"}
CLOCKS = STOPWATCHES | {"time", "monotonic", "time_ns", "monotonic_ns", "clock_gettime"}


def modules() -> dict[str, Path]:
    """Every module of the project by its name under `swarmtrack`: `geometry.camera`, `agents.vehicle`."""
    found = {}
    for root in (ROOT / "swarmtrack", ROOT / "agents", ROOT / "benchmarks"):
        for path in root.rglob("*.py"):
            relative = path.relative_to(root if root.name == "swarmtrack" else ROOT)
            if root.name == "swarmtrack" and relative.parts[0] in ("agents", "benchmarks", "configs"):
                continue  # symbolic links to the folders of the same names
            name = ".".join(relative.with_suffix("").parts).removesuffix("__init__").rstrip(".")
            if name:
                found[name] = path
    return found


MODULES = modules()


def tree(name: str) -> ast.Module:
    return sources.tree(MODULES[name])


@cache
def imports(name: str) -> frozenset[str]:
    """The modules that a module imports, at its head or later; ours without `swarmtrack.`, others whole.

    Imports for types only count too: they tell which way the thoughts go.
    """
    package = name.split(".") if MODULES[name].name == "__init__.py" else name.split(".")[:-1]
    found = set()
    for node in ast.walk(tree(name)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                base = ".".join(
                    ["swarmtrack", *package[: len(package) - node.level + 1], *filter(None, [base])]
                )
            # `from package import module` imports the module; `from module import name` the module itself.
            for alias in node.names:
                inner = f"{base}.{alias.name}".removeprefix("swarmtrack.")
                found.add(f"swarmtrack.{inner}" if inner in MODULES else base)
    return frozenset(module.removeprefix("swarmtrack.") for module in found if module != "swarmtrack")


def package(name: str) -> str:
    """The room: `monitor` of `monitor.team`, `lab.world` of `lab.world.airframe`; a module that stands alone is one."""
    return ".".join(name.split(".")[: 2 if name.startswith("lab.") else 1])


def layer(name: str) -> int:
    return LAYER[package(name)]


def ours(names: Set[str]) -> set[str]:
    return {name for name in names if name in MODULES}


def found_in(names: Iterable[str], search: Callable[[str], Set[str]]) -> dict[str, list[str]]:
    """What a search finds in each of these modules, without those in which it finds nothing."""
    return {name: sorted(found) for name in sorted(names) if (found := search(name))}


def test_every_module_has_its_layer():
    assert {package(name) for name in MODULES} - {"lab"} <= set(LAYER)
    assert {"errors", "messages", "geometry.camera", "clock"} <= set(MODULES)  # the search finds modules


def test_nothing_imports_from_a_layer_above():
    above = found_in(
        MODULES, lambda name: {other for other in ours(imports(name)) if layer(other) > layer(name)}
    )
    assert not above, f"import from above: {above}"


def reached_from(name: str) -> set[str]:
    """Every module that a module imports, by itself or by what it imports."""
    reached, waiting = set(), [name]
    while waiting:
        for other in imports(waiting.pop()) - reached:
            reached.add(other)
            if other in MODULES:
                waiting.append(other)
    return reached


def test_what_flies_does_not_reach_the_lab():
    flying = [name for name in MODULES if layer_of_flight(name)]
    assert "runtime.agent" in flying
    for name in flying:
        lab = {other for other in reached_from(name) if other.startswith("lab.")}
        assert not lab, f"{name} imports, by itself or by what it imports, {', '.join(sorted(lab))}"


def layer_of_flight(name: str) -> bool:
    """Whether a module is in a layer below the lab's; the programs on top open simulated sources by name."""
    return name != "lab" and layer(name) < LAYER["lab.world"]


def test_the_page_on_rooms_lists_every_room_from_the_bottom_up():
    page = (ROOT / "docs" / "decisions" / "0015-rooms.md").read_text(encoding="utf-8")
    rows = [row for row in page.splitlines() if row.startswith("| ") and "`" in row]
    rooms = re.findall(r"`([\w.]+)`", "\n".join(rows))
    assert sorted(rooms) == sorted(LAYER)
    assert [LAYER[room] for room in rooms] == sorted(LAYER.values())


def test_no_module_imports_itself_in_a_circle():
    tuple(TopologicalSorter({name: ours(imports(name)) - {name} for name in MODULES}).static_order())


def test_packages_of_one_layer_do_not_import_each_other_both_ways():
    used = {(package(name), package(other)) for name in MODULES for other in ours(imports(name))}
    both = sorted({tuple(sorted(pair)) for pair in used if pair[0] != pair[1] and pair[::-1] in used})
    assert not both, f"import each other: {both}"


def test_packages_stand_in_no_circle():
    graph = {package(name): set() for name in MODULES}
    for name in MODULES:
        graph[package(name)] |= {package(other) for other in ours(imports(name))} - {package(name)}
    tuple(TopologicalSorter(graph).static_order())


def test_only_its_own_commands_and_benchmarks_import_what_trains():
    importing = {name for name in MODULES if any(package(other) == "training" for other in imports(name))}
    commands = {"agents.train", "agents.train_second_stage", "agents.export"}
    assert {name for name in importing if package(name) not in {"training", "benchmarks"}} == commands


def test_agents_holds_programs_only_one_file_each():
    assert len([name for name in MODULES if name.startswith("agents.")]) <= 29


def test_a_judge_imports_nothing_that_touches_the_world():
    judges = [name for name in MODULES if name in JUDGES or package(name) in JUDGES]
    assert judges
    touched = found_in(
        judges,
        lambda name: {other.split(".")[0] for other in reached_from(name) - set(MODULES)} & TOUCHES_THE_WORLD,
    )
    assert not touched, f"import, by themselves or by what they import: {touched}"


def test_the_core_imports_only_numpy_scipy_and_what_is_pure():
    core = [name for name in MODULES if package(name) in CORE]
    assert {package(name) for name in core} == CORE
    impure = found_in(
        core,
        lambda name: (
            {other.split(".")[0] for other in imports(name) - set(MODULES)} - {"", "numpy", "scipy"} - PURE
        ),
    )
    assert not impure, f"import what is not pure: {impure}"


def clocks_read(name: str) -> set[str]:
    """Where a module reads a clock that it should not. Training may say how long it took."""
    clocks = CLOCKS - STOPWATCHES if name.startswith("training") else CLOCKS
    reads = set()
    for node in ast.walk(tree(name)):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if node.value.id == "time" and node.attr in clocks:
                reads.add(f"time.{node.attr} in line {node.lineno}")
            if node.value.id in ("datetime", "date") and node.attr in ("now", "utcnow", "today"):
                reads.add(f"{node.value.id}.{node.attr} in line {node.lineno}")
        if isinstance(node, ast.ImportFrom) and node.module == "time":
            reads |= {
                f"time.{alias.name} in line {node.lineno}" for alias in node.names if alias.name in clocks
            }
    return reads


def test_only_one_module_reads_a_clock():
    # The second sets wrong what the first reads; the third is a program of its own, of the standard library alone.
    # Benchmarks are no part of an agent: from outside they hold a stopwatch to it.
    may = {"clock", "lab.swarm.skewed_clock", "guard"}
    assert may <= set(MODULES)
    assert clocks_read("clock")  # the search finds clocks
    reads = found_in(
        [name for name in MODULES if package(name) != "benchmarks" and name not in may], clocks_read
    )
    assert not reads, f"read a clock: {reads}"


def test_what_counts_as_pure_is_in_the_standard_library():
    assert PURE - {"__future__"} <= sys.stdlib_module_names
    assert not PURE & {
        "asyncio",
        "time",
        "socket",
        "threading",
        "logging",
        "os",
        "pathlib",
        "subprocess",
        "sys",
    }


def test_tests_take_what_they_share_from_support():
    rooms = {path.name for path in (ROOT / "tests").iterdir() if path.is_dir()} - {"support"}
    for path in (ROOT / "tests").rglob("*.py"):
        for node in ast.walk(sources.tree(path)):
            taken = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            taken += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            assert not {name.split(".")[0] for name in taken} & rooms, f"{path.relative_to(ROOT)}: {taken}"
