"""CDR against rosbags, and the table of types against rosbags and real ROS 2."""

import json
import struct
import sys
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from swarmtrack.outputs.ros2 import cdr

TABLE = json.loads(resources.files("swarmtrack.outputs.ros2").joinpath("types.json").read_text())
SHARE = Path(sys.prefix) / "share"


@pytest.fixture(scope="module")
def types():
    pytest.importorskip("rosbags", reason="an extra: pip install '.[ros2-test]'")
    from support import ros2_types  # noqa: PLC0415 - needs rosbags

    return ros2_types


def leaves_of(rng, kind, fields):
    """Random leaves of a type, sequences of 0 to 3 elements."""
    inner, bracket, count = kind.partition("[")
    if bracket and count != "]":
        return [leaf for _ in range(int(count[:-1])) for leaf in leaves_of(rng, inner, fields)]
    if bracket:
        n = int(rng.integers(4))
        if inner in fields:
            return [[tuple(leaves_of(rng, inner, fields)) for _ in range(n)]]
        if inner == "uint8":
            return [rng.bytes(n)]
        return [[leaf for _ in range(n) for leaf in leaves_of(rng, inner, fields)]]
    if kind in fields:
        return [leaf for _, each in fields[kind] for leaf in leaves_of(rng, each, fields)]
    if kind == "string":
        return ["é" * int(rng.integers(4))]
    if kind == "bool":
        return [bool(rng.integers(2))]
    if kind.startswith("float"):
        return [float(np.float32(rng.normal()))]
    return [int(rng.integers(100))]


@pytest.mark.parametrize("name", TABLE["hashes"])
def test_any_message_is_read_by_rosbags_and_written_by_it_in_the_same_bytes(types, name):
    store = types.store_of(types.DISTRIBUTIONS[1])
    rng = np.random.default_rng(7)
    for _ in range(50):
        ours = cdr.encode(name, leaves_of(rng, name, TABLE["fields"]))
        theirs = bytes(store.serialize_cdr(store.deserialize_cdr(ours, name), name))
        assert theirs[: len(ours)] == ours
        assert not any(theirs[len(ours) :])  # padding at its end


def test_the_table_is_what_rosbags_makes_of_three_distributions(types):
    assert types.table() == TABLE


@pytest.mark.parametrize("name", TABLE["hashes"])
def test_hashes_are_those_that_ros_2_ships(name):
    path = SHARE / f"{name}.json"
    if not path.exists():
        pytest.skip(f"{name} is not installed here (pip install '.[ros2-test]', or in no registry)")
    hashes = {each["type_name"]: each["hash_string"] for each in json.loads(path.read_text())["type_hashes"]}
    assert hashes[name] == TABLE["hashes"][name]


def test_a_known_message_has_known_bytes():
    """geometry_msgs/PoseArray in the frame `map` with one pose, by hand."""
    head = b"\0\1\0\0" + struct.pack("<iII", 1, 2, 4) + b"map\0" + struct.pack("<I", 1)
    pose = (1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0)
    found = cdr.encode("geometry_msgs/msg/PoseArray", (1, 2, "map", [pose]))
    assert found == head + bytes(4) + struct.pack("<7d", *pose)  # doubles begin at a multiple of 8


@pytest.mark.parametrize("leaves", [(1, 2, "map", [], 3), (1, 2, "map", [(0.0,) * 8])])
def test_leaves_that_are_left_over_are_refused(leaves):
    with pytest.raises(ValueError, match=r"leaves, expected \d"):
        cdr.encode("geometry_msgs/msg/PoseArray", leaves)
