"""Errors: whole on the other side of a process, too."""

from __future__ import annotations

import ast
import functools
import importlib
import pickle

from support.places import ROOT
from support.sources import tree
from swarmtrack.errors import ConfigError, SwarmtrackError


@functools.cache
def error_classes():
    """(module, name) of every class of ours that is an exception, by what it inherits from."""
    bases: dict[str, tuple[str, set[str]]] = {}
    for folder in ("swarmtrack", "agents", "benchmarks"):
        for path in (ROOT / folder).rglob("*.py"):
            below = path.relative_to(ROOT)
            if folder == "swarmtrack" and below.parts[1] in ("agents", "benchmarks", "configs"):
                continue  # symbolic links
            module = ".".join(below.with_suffix("").parts)
            module = module if folder == "swarmtrack" else f"swarmtrack.{module}"
            for node in ast.walk(tree(path)):
                if isinstance(node, ast.ClassDef):
                    bases[node.name] = (
                        module,
                        {base.id for base in node.bases if isinstance(base, ast.Name)},
                    )
    found = {"Exception"}
    while more := {name for name, (_, above) in bases.items() if above & found} - found:
        found |= more
    return sorted((bases[name][0], name) for name in found - {"Exception"})


def test_the_search_finds_them():
    assert {"ConfigError", "RecordingError", "ServeError", "LinkDown", "BadImage"} <= {
        name for _, name in error_classes()
    }


def test_every_error_survives_the_way_from_one_process_to_another():
    for module, name in error_classes():
        try:
            kind = getattr(importlib.import_module(module), name)
        except ModuleNotFoundError as missing:
            if (missing.name or "swarmtrack").startswith("swarmtrack"):
                raise
            continue  # it belongs to an extra that is not installed here
        error = kind(["first", "second"]) if issubclass(kind, ConfigError) else kind("what, where")
        again = pickle.loads(pickle.dumps(error))
        assert type(again) is kind
        assert str(again) == str(error), name
        assert vars(again) == vars(error), name


def test_the_problems_of_a_config_stay_a_list():
    again = pickle.loads(pickle.dumps(ConfigError(["a.toml:1: x", "a.toml:2: y"])))
    assert again.problems == ["a.toml:1: x", "a.toml:2: y"]
    assert isinstance(again, SwarmtrackError)
