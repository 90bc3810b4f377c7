"""World files: what they make, and what is said of a wrong one."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from support.places import CONFIGS
from swarmtrack.config.drone import DroneConfig, load_config
from swarmtrack.errors import ConfigError, SourceError
from swarmtrack.lab.scenarios.scenario import CAMERA
from swarmtrack.lab.swarm.configs import Sources, write_configs
from swarmtrack.lab.swarm.world_file import OutsideWorld, check_alone, load_world
from swarmtrack.lab.world.followed import FollowedDrone

WORLD = """
[world]
origin = { lat_deg = -35.363262, lon_deg = 149.165237, alt_m = 584.0 }
about = "two ArduCopters"
seed = 7
seconds = 45.0

[camera]
fps = 10.0

[[drone]]
id = 1
link = "tcp:127.0.0.1:5762"
truth = "tcp:127.0.0.1:5763"

[[drone]]
id = 2
link = "udp:127.0.0.1:14541"
truth = "tcp:127.0.0.1:5773"
system_id = 2
airframe = { span_m = 1.0 }
start = { from = "local", offset_m = [0.0, 6.0, 0.0], position_sigma_m = 0.2 }

[[intruder]]
id = 9
position_m = [10.0, 0.0, -5.0]
looks_at_m = [0.0, 0.0, -5.0]

[expected]
correct = 0.9
"""


def written(folder: Path, text: str = WORLD) -> Path:
    path = folder / "world.toml"
    path.write_text(text, encoding="utf-8")
    return path


def complaint(folder: Path, *changes: tuple[str, str]) -> str:
    text = WORLD
    for before, after in changes:
        assert before in text
        text = text.replace(before, after)
    with pytest.raises(ConfigError) as raised:
        load_world(written(folder, text))
    return str(raised.value)


def test_a_world_is_what_its_file_says(tmp_path):
    world = load_world(written(tmp_path))
    scenario = world.scenario
    assert scenario.members == (1, 2)
    assert scenario.strangers == {9}
    assert (scenario.name, scenario.about, scenario.seed) == ("world", "two ArduCopters", 7)
    assert (scenario.seconds, scenario.fps, scenario.camera) == (45.0, 10.0, CAMERA)
    assert scenario.origin.height == 584.0
    assert math.degrees(scenario.origin.latitude) == pytest.approx(-35.363262)
    assert all(isinstance(scenario.world.drones[n], FollowedDrone) for n in (1, 2))
    # An intruder has a flight of its own, which is known at all times.
    assert scenario.world.pose(9, 3.0).position == pytest.approx([10.0, 0.0, -5.0], abs=0.2)
    assert world.limits.correct == 0.9
    assert world.outsiders[2].truth.address == "tcp:127.0.0.1:5773"
    assert load_world(written(tmp_path), seed=3).scenario.seed == 3


@pytest.mark.parametrize("path", sorted((CONFIGS / "worlds").glob("*.toml")), ids=lambda path: path.stem)
def test_the_shipped_worlds_are_sound(path):
    world = load_world(path)
    assert world.scenario.members == tuple(range(1, len(world.outsiders) + 1))
    assert [one.truth.system_id for one in world.outsiders.values()] == list(world.scenario.members)


def test_an_airframe_of_another_span_has_the_same_shape(tmp_path):
    world = load_world(written(tmp_path)).scenario.world
    usual, large = world.airframe(1), world.airframe(2)
    assert large.span == 1.0
    assert large.outline() == pytest.approx(np.asarray(usual.outline()) / usual.span)


def configs(folder: Path, world: OutsideWorld, **changes: float) -> list[DroneConfig]:
    """Of the agents, in the order of their IDs; changes: of the world's scenario."""
    sources = {
        n: Sources(f"http://127.0.0.1:9/{n}", one.link, one.truth.system_id, one.start, 0.3)
        for n, one in world.outsiders.items()
    }
    files = write_configs(
        folder,
        replace(world.scenario, **changes),
        team="blue",
        tracker="mbm",
        sources=sources,
        simulator="…",
        origin=world.origin,
    )
    return [load_config(files[n]) for n in sorted(files)]


def test_the_agents_configs_are_those_of_the_world(tmp_path):
    world = load_world(written(tmp_path))
    first, second = configs(tmp_path, world)
    assert (first.autopilot.link, first.autopilot.system_id) == ("tcp:127.0.0.1:5762", None)
    assert (second.autopilot.link, second.autopilot.system_id) == ("udpin:127.0.0.1:14541", 2)
    assert first.drone.start.source == "gps"
    assert first.team.origin == world.origin
    assert second.drone.start.source == "local"
    assert second.drone.start.offset_m == (0.0, 6.0, 0.0)
    assert first.camera.max_age_s == 0.3


def test_a_flight_counts_from_its_take_off_where_the_file_says_so(tmp_path):
    assert not load_world(written(tmp_path)).scenario.from_take_off
    text = WORLD.replace("[world]", '[world]\ncounts_from = "take-off"')
    assert load_world(written(tmp_path, text)).scenario.from_take_off
    text = WORLD.replace("[world]", '[world]\ncounts_from = "takeoff"')
    with pytest.raises(ConfigError, match=r"world\.counts_from"):
        load_world(written(tmp_path, text))


def test_a_team_that_shares_its_motion_is_told_so_beside_its_origin(tmp_path):
    world = load_world(written(tmp_path))
    team = configs(tmp_path, world, share_hz=4.0)[0].team
    assert (team.share, team.share_hz, team.origin) == ("velocity", 4.0, world.origin)


FORMATION = """
[formation]
leader = 1
height_m = 9.0
judged_from_s = 20.0
limits = { fence_radius_m = 40.0 }
slots = { 2 = [-6.0, 0.0, 1.0] }

[expected]
"""


def in_formation(*changes: tuple[str, str]) -> str:
    text = WORLD.replace("airframe = { span_m = 1.0 }\n", "").replace("[expected]", FORMATION.strip())
    for before, after in changes:
        assert before in text
        text = text.replace(before, after)
    return text


def test_a_formation_of_the_world_is_that_of_its_agents_and_of_the_judge(tmp_path):
    world = load_world(written(tmp_path, in_formation()))
    formation = world.scenario.formation
    assert (formation.leader, formation.followers, formation.height_m) == (1, [2], 9.0)
    assert formation.judged_from_s == 20.0
    assert world.scenario.star is None
    config = configs(tmp_path, world)[1]
    assert (config.team.share, config.team.share_hz) == ("velocity", 5.0)
    assert config.formation.enabled
    assert config.formation.limits.fence_radius_m == 40.0
    assert config.formation.plan().slots == formation.slots


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        ("slots = { 2 =", "slots = { 3 =", "slots: leader and slots of the drones [1, 3], expected of [1, 2]"),
        ("[-6.0, 0.0, 1.0]", "[-1.0, 0.0, 1.0]", "formation.slots.2: "),
        ("[-6.0, 0.0, 1.0]", "[-6.0, 0.0, 5.0]", "formation.slots.2: "),
        ("system_id = 2", "system_id = 2\nairframe = { span_m = 1.0 }", "expected one span of all"),
        ("judged_from_s = 20.0", "judged_from_s = 50.0", "formation.judged_from_s: 50 s, expected less than world.sec"),
        ("leader = 1", "leadr = 1", 'formation.leadr: unknown key, did you mean "leader"?'),
    ],
)  # fmt: skip
def test_a_formation_that_its_agents_would_refuse_is_refused_with_the_world(
    tmp_path, before, after, expected
):
    with pytest.raises(ConfigError) as raised:
        load_world(written(tmp_path, in_formation((before, after))))
    assert expected in str(raised.value)


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        ("origin =", "orgin =", 'world.toml:3: world.orgin: unknown key, did you mean "origin"?'),
        ("origin =", "# origin =", "world.origin: missing, expected { lat_deg, lon_deg, alt_m }"),
        ("lat_deg = -35.363262", "lat_deg = 135.0", "world.origin.lat_deg: 135.0, expected"),
        ('truth = "tcp:127.0.0.1:5763"', "", "drone[0].truth: missing, expected another MAVLink link"),
        ("tcp:127.0.0.1:5763", "tlog:flight.tlog", "expected a link of a simulator: tcp:HOST:PORT"),
        ("tcp:127.0.0.1:5763", "tpc:127.0.0.1:5763", "drone[0].truth: 'tpc:127.0.0.1:5763': unknown scheme"),
        ("tcp:127.0.0.1:5763", "tcp:127.0.0.1", "expected HOST:PORT"),
        ("system_id = 2", "system_id = 300", "drone[1].system_id: 300, expected"),
        ("id = 9", "id = 2", "intruder[0].id: 2, expected an ID that no other drone has"),
        ("fps = 10.0", "fps = 10.0\ndistortion = { model = \"radtan\", coefficients = [0, 0, 0, 0] }",
         "distortion without intrinsics"),
        ("correct = 0.9", "corect = 0.9", 'expected.corect: unknown key, did you mean "correct"?'),
        ("span_m = 1.0", "span_m = 0.0", "drone[1].airframe.span_m: 0.0, expected"),
        ("position_m = [10.0, 0.0, -5.0]", "stranger = true", "intruder[0].stranger: unknown key"),
    ],
)  # fmt: skip
def test_a_wrong_file_says_where_what_and_what_was_expected(tmp_path, before, after, expected):
    assert expected in complaint(tmp_path, (before, after))


@pytest.mark.parametrize(
    ("address", "owner"),
    [("tcp:127.0.0.1:5763", "truth of drone 1"), ("tcp:127.0.0.1:5762", "link of drone 1")],
)
def test_two_drones_on_one_address_are_named(tmp_path, address, owner):
    said = complaint(tmp_path, ("tcp:127.0.0.1:5773", address))
    assert f'world.toml:19: drone[1].truth: "{address}" is {owner} too, expected a port of its own' in said


def test_one_address_written_in_two_ways_is_one(tmp_path):
    said = complaint(tmp_path, ("tcp:127.0.0.1:5773", "udpin:127.0.0.1:14541"))
    assert "is link of drone 2 too" in said


def test_a_world_without_drones_is_none(tmp_path):
    text = WORLD.partition("[[drone]]")[0]
    with pytest.raises(ConfigError, match="drone: missing, expected tables"):
        load_world(written(tmp_path, text))


def test_a_world_file_and_a_scenario_exclude_each_other():
    with pytest.raises(SourceError, match=r"--drones 3 with --world w\.toml, expected one of them"):
        check_alone(Path("w.toml"), scenario=None, drones=3, detail="auto")
    with pytest.raises(SourceError, match="--detail low with --world"):
        check_alone(Path("w.toml"), scenario=None, drones=None, detail="low")
    check_alone(Path("w.toml"), scenario=None, drones=None, detail="full")
