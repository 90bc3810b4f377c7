"""The two locks, which `.ci/lock` makes: requirements.lock to fly, requirements-dev.lock to test."""

import ast
import os
import re
import sys
import tomllib
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import pytest

from support.places import ROOT
from support.sources import tree
from swarmtrack.agents.main import main

requirements = pytest.importorskip("packaging.requirements", reason="packaging is in the locks")

FLY, DEV = ROOT / "requirements.lock", ROOT / "requirements-dev.lock"
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = PYPROJECT["project"]
EXTRAS = PROJECT["optional-dependencies"]
OLDEST = {"python_version": "3.11", "python_full_version": "3.11.0"}


class Pin(NamedTuple):
    """An entry of a lock."""

    name: str
    version: str
    marker: str
    hashes: frozenset[str]


def pins(lock: Path) -> list[Pin]:
    text = re.sub(r"^#.*\n", "", lock.read_text(encoding="utf-8"), flags=re.MULTILINE).replace("\\\n", " ")
    found = []
    for line in text.splitlines():
        pinned, *hashes = line.split("--hash=sha256:")
        name, version, marker = re.fullmatch(r"([a-z0-9-]+)==(\S+)(?: ; (.+?))?\s*", pinned.strip()).groups()
        found.append(Pin(name, version, marker or "", frozenset(each.strip() for each in hashes)))
    return found


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def names(lock: Path) -> set[str]:
    return {pin.name for pin in pins(lock)}


def wanted(*texts: str) -> list[requirements.Requirement]:
    """Requirements as pyproject.toml writes them; an extra of ours stands for its own list."""
    found = []
    for requirement in map(requirements.Requirement, texts):
        if canonical(requirement.name) == PROJECT["name"]:
            found += wanted(*(text for extra in requirement.extras for text in EXTRAS[extra]))
        else:
            found.append(requirement)
    return found


TO_FLY = wanted(*PROJECT["dependencies"], *PYPROJECT["build-system"]["requires"])


def needed(roots: list[requirements.Requirement]) -> set[str]:
    """What these need, and what that needs, according to the packages installed here."""
    reached: set[tuple[str, frozenset[str]]] = set()
    waiting = [(canonical(root.name), frozenset(root.extras)) for root in roots]
    while waiting:
        name, extras = each = waiting.pop()
        if each in reached:
            continue
        reached.add(each)
        try:
            its = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            pytest.skip(f"{name} is not installed here")
        waiting += [
            (canonical(requirement.name), frozenset(requirement.extras))
            for requirement in map(requirements.Requirement, its)
            if applies(requirement.marker, extras)
        ]
    return {name for name, _ in reached}


def applies(marker, extras) -> bool:
    """Here, or with the oldest Python that the locks are for."""
    return marker is None or any(
        marker.evaluate({"extra": extra, **python}) for extra in extras | {""} for python in ({}, OLDEST)
    )


@pytest.mark.parametrize("lock", [FLY, DEV], ids=lambda lock: lock.name)
def test_every_version_has_its_hashes_and_none_an_address(lock):
    assert "://" not in lock.read_text(encoding="utf-8")
    assert len(pins(lock)) > 40
    for pin in pins(lock):
        assert pin.hashes, pin.name
        assert all(re.fullmatch("[0-9a-f]{64}", each) for each in pin.hashes), pin.name


def test_what_flies_is_tested_in_the_same_version_and_the_same_files():
    """So whoever ran the README's first command adds to it by the second, and replaces nothing."""
    assert set(pins(FLY)) < set(pins(DEV))


@pytest.mark.parametrize(
    ("lock", "roots"),
    [(FLY, TO_FLY), (DEV, [*TO_FLY, *wanted(*EXTRAS["dev"])])],
    ids=[FLY.name, DEV.name],
)
def test_a_lock_holds_what_pyproject_asks_for_in_versions_that_it_allows(lock, roots):
    for requirement in roots:
        versions = [pin.version for pin in pins(lock) if pin.name == canonical(requirement.name)]
        assert versions, requirement.name
        assert all(version in requirement.specifier for version in versions), requirement


def test_what_flies_comes_without_anything_that_only_developers_need():
    assert names(FLY) == needed(TO_FLY)


def test_no_lock_holds_torch_whose_builds_differ_by_accelerator():
    assert "torch" in {requirement.name for requirement in wanted(*EXTRAS["train"])}
    assert "torch" not in names(DEV)


def test_both_locks_say_how_they_are_made():
    assert os.access(ROOT / ".ci" / "lock", os.X_OK)
    for lock in (FLY, DEV):
        assert lock.read_text(encoding="utf-8").splitlines()[1] == "#    .ci/lock"


EXTRA = ("replay/plot.py", "monitor/flight_plot.py", "trackers/peers.py")


def imported_at_its_head(path: Path) -> set[str]:
    found = set()
    for node in tree(path).body:
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(str(node.module).split(".")[0])
    return found


def test_a_module_imports_at_its_head_only_what_flies():
    """All but training, and those in EXTRA: their commands ask for an extra first."""
    homes, flies = metadata.packages_distributions(), names(FLY)
    for root in (ROOT / "swarmtrack", ROOT / "agents", ROOT / "benchmarks"):
        for path in root.rglob("*.py"):
            if "training" in path.parts or any(map(path.match, EXTRA)):
                continue
            for module in imported_at_its_head(path) - set(sys.stdlib_module_names) - {PROJECT["name"]}:
                assert {canonical(home) for home in homes.get(module, [module])} & flies, (path, module)


@pytest.mark.parametrize(
    ("command", "missing", "extra"),
    [
        (["train", "--out", "OUT/a.onnx"], ["torch", "onnx"], "train"),
        (["train-second-stage", "--out", "OUT/a.onnx"], ["torch", "onnx"], "train"),
        (["export", "default", "--out", "OUT/a.onnx"], ["onnx"], "train"),
        (["export", "OUT/a.pt", "--out", "OUT/a.onnx"], ["torch", "onnx"], "train"),
        (["bench", "box-width", "--out", "OUT", "--write"], ["onnx"], "train"),
        (["bench", "trackers", "--out", "OUT"], ["matplotlib"], "bench"),
        (["bench", "trackers", "--out", "OUT", "--peers"], ["stonesoup"], "peers"),
        (["bench", "calibration", "--out", "OUT"], ["matplotlib"], "bench"),
        (["bench", "cost", "--of", "monitor", "--out", "OUT"], ["playwright"], "dev"),
        (["replay", "OUT", "--plot", "OUT/a.png"], ["matplotlib"], "bench"),
        (["calibrate", "intrinsics", "images://OUT", "--plot", "OUT/a.png"], ["matplotlib"], "bench"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else value,
)
def test_a_command_that_needs_more_says_in_one_line_which_extra_brings_it(
    command, missing, extra, tmp_path, monkeypatch, capsys
):
    (tmp_path / "a.pt").write_bytes(b"")
    for package in missing:
        monkeypatch.setitem(sys.modules, package, None)
    assert main([word.replace("OUT", str(tmp_path)) for word in command]) == 2
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    assert said[0].endswith(
        f" needs {' and '.join(missing)}: pip install {' '.join(missing)}, "
        f"or in swarmtrack's source pip install '.[{extra}]'"
    )
    brought = {requirement.name for requirement in wanted(*EXTRAS[extra])}
    assert set(missing) <= brought
