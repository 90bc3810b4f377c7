"""Scenarios: what the shipped ones show, and what a file may say."""

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support.places import ROOT, writer
from swarmtrack.clock import ManualClock
from swarmtrack.errors import ConfigError
from swarmtrack.geometry import rotation
from swarmtrack.lab.scenarios import files
from swarmtrack.lab.scenarios.files import load_scenario, scenario_names
from swarmtrack.lab.scenarios.scenario import FaultKind, Radio, Scenario, best_view
from swarmtrack.lab.sources import open_simulation
from swarmtrack.lab.world.sensors import Instant
from swarmtrack.motion.sway import sway

ASKED = [
    "clock-skew",
    "crossing",
    "errand",
    "fast-yaw",
    "faults",
    "fisheye",
    "gps-denied",
    "guided",
    "hover-triangle",
    "intruder",
    "late-joiner",
    "lossy-radio",
]
ASKED += [
    "all-round",
    "mixed",
    "occlusion",
    "power-on",
    "proof",
    "silent",
    "thirty",
    "two-cameras",
    "two-lines",
    "visitor",
    "yawing-observer",
]
STARS = ["formation-3", "formation-5", "formation-8", "intruder-crosses", "leader-lost", "swapped-id", "wind"]
ASKED = sorted([*ASKED, *STARS])
FIXED = "yawing-observer"  # its three drones are described one by one
ALSO_FIXED = ("two-cameras", "fisheye", "visitor")
FOR_FOUR = "gps-denied"  # its drones sway too far for a fuller ring
COMMANDED = "guided"  # its drones fly where somebody sends them
ON_THE_GROUND = ("errand", "power-on")  # at first
FREE = [
    name for name in ASKED if name not in (FIXED, *ALSO_FIXED, FOR_FOUR, COMMANDED, *ON_THE_GROUND, *STARS)
]
PLANNED = [name for name in ASKED if name not in (COMMANDED, *STARS)]
SIZES = [2, 3, 4, 5, 7, 8, 13, 16, 29, 30]
RING = "about = 'x'\nseconds = 9\n[formation]\ndrones = 3\nring = { radius_m = 3.0 }\n"
ONE_BY_ONE = """about = "x"
seconds = 9.0

[[drone]]
id = 3
position_m = [0, 0, -3]

[[drone]]
id = 7
position_m = [5, 0, -3]
heading_deg = 180
"""


def seen_by(scenario: Scenario, observer: int, t: float) -> dict[int, np.ndarray]:
    return Instant(scenario.world, t).visible(observer, scenario.camera, scenario.body_from_camera)


def views(scenario: Scenario, observer: int, times: np.ndarray) -> list[dict[int, np.ndarray]]:
    return [seen_by(scenario, observer, float(t)) for t in times]


# --- what is shipped ---------------------------------------------------------------------------------


def test_the_scenarios_that_are_asked_for_are_shipped_and_say_at_their_head_what_they_show():
    assert scenario_names() == ASKED
    for name in ASKED:
        text = (ROOT / "configs" / "scenarios" / f"{name}.toml").read_text()
        assert text.startswith("# ")
        assert load_scenario(name).name == name


@pytest.mark.parametrize("name", FREE)
@pytest.mark.parametrize("drones", SIZES)
def test_a_formation_makes_as_many_drones_as_are_asked_for_and_each_sees_another_while_they_hover(
    name, drones
):
    scenario = load_scenario(name, seed=5, drones=drones)
    assert scenario.members == tuple(range(1, drones + 1))
    assert set(scenario.announced) == set(scenario.members)
    instants = [Instant(scenario.world, t) for t in (-1.0, 0.5, 2.0, 3.5)]
    for member in scenario.members:
        company = [
            {
                drone
                for camera in scenario.cameras
                for drone in instant.visible(member, camera.lens, camera.body_from_camera)
                if drone in scenario.members
            }
            for instant in instants
        ]
        assert sum(bool(others) for others in company) >= 3


@settings(max_examples=40, deadline=None)
@given(
    name=st.sampled_from(FREE),
    drones=st.sampled_from(SIZES),
    seed=st.integers(0, 2**31),
    phase=st.floats(0.0, 1.0),
)
def test_drones_are_always_more_than_a_metre_apart_and_above_the_ground(name, drones, seed, phase):
    world = load_scenario(name, seed=seed, drones=drones).world
    for t in np.linspace(-3.0, 90.0, 150) + phase:
        points = np.stack([trajectory.position(t) for trajectory in world.drones.values()])
        apart = np.linalg.norm(points[:, None] - points, axis=2) + 10.0 * np.eye(len(points))
        assert apart.min() > 1.0
        assert points[:, 2].max() < -1.0


@pytest.mark.parametrize("name", PLANNED)
def test_everybody_hovers_at_first_and_at_every_time_before(name):
    scenario = load_scenario(name, seed=2)
    for drone_id, trajectory in scenario.world.drones.items():
        until = scenario.starts_s.get(drone_id, 0.0) + 4.0
        for t in (-1e4, -60.0, -1.0, 0.0, 2.0, until):
            assert np.linalg.norm(trajectory.position(t) - trajectory.position(0.0)) < 0.4
            assert np.linalg.norm(trajectory.velocity(t)) < 0.4
            assert np.linalg.norm(trajectory.body_rate(t)) < 0.4


@pytest.mark.parametrize("name", PLANNED)
def test_a_seed_decides_every_movement_and_another_seed_flies_otherwise(name):
    one, same, other = (load_scenario(name, seed=seed).world for seed in (3, 3, 4))
    t = 0.8 * load_scenario(name).seconds
    for drone_id in one.drones:
        np.testing.assert_array_equal(one.pose(drone_id, t).position, same.pose(drone_id, t).position)
        assert not np.array_equal(one.pose(drone_id, t).position, other.pose(drone_id, t).position)


@pytest.mark.parametrize("name", ASKED)
def test_only_the_lossy_radio_needs_a_radio(name):
    assert load_scenario(name).needs_radio == (name == "lossy-radio")


@pytest.mark.parametrize(("drones", "pairs"), [(2, 2), (3, 6), (4, 10)])
def test_a_hovering_triangle_or_rhombus_shows_as_many_pairs_as_its_cameras_can(drones, pairs):
    scenario = load_scenario("hover-triangle", drones=drones)
    for t in (0.0, 10.0, 20.0):
        assert sum(len(seen_by(scenario, member, t)) for member in scenario.members) == pairs


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.long("other seeds of the same")) for seed in (1, 2))]
)
def test_in_crossing_drones_change_sides_in_the_image_of_two_observers_or_more(seed):
    scenario = load_scenario("crossing", seed=seed)
    times = np.arange(5.0, scenario.seconds, 0.1)
    observers = 0
    for member in scenario.members:
        boxes = views(scenario, member, times)
        others = [
            drone for drone in scenario.members if sum(drone in view for view in boxes) > len(times) / 2
        ]
        for k, one in enumerate(others):
            for other in others[:k]:
                side = [view[one][0] > view[other][0] for view in boxes if one in view and other in view]
                observers += int(np.count_nonzero(np.diff(side))) >= 3
    assert observers >= 2


@pytest.mark.parametrize(
    ("seed", "drones"), [(0, 4), pytest.param(1, 6, marks=pytest.mark.long("a team of six, not four"))]
)
def test_in_occlusion_drones_vanish_behind_others_for_half_a_second_to_two(seed, drones):
    scenario = load_scenario("occlusion", seed=seed, drones=drones)
    period = 0.1
    times = np.arange(8.0, scenario.seconds, period)
    instants = [Instant(scenario.world, float(t)) for t in times]
    hidden_s = []
    for member in scenario.members:
        view = (member, scenario.camera, scenario.body_from_camera)
        ahead, seen = [i.boxes(*view) for i in instants], [i.visible(*view) for i in instants]
        for other in set(scenario.members) - {member}:
            inside = [other in a and scenario.camera.contains(a[other][:2])[0] for a in ahead]
            gone = np.array([i and other not in s for i, s in zip(inside, seen, strict=True)])
            edges = np.flatnonzero(np.diff(np.concatenate([[0], gone.astype(int), [0]])))
            hidden_s += list(period * (edges[1::2] - edges[::2]))
    assert sum(0.5 <= length <= 2.0 for length in hidden_s) >= 8
    assert np.percentile(hidden_s, 90) <= 2.0


@pytest.mark.parametrize("drones", [2, 4, pytest.param(9, marks=pytest.mark.long("a larger team, of nine"))])
def test_in_fast_yaw_every_drone_turns_at_two_radians_a_second_and_comes_back_to_the_others(drones):
    scenario = load_scenario("fast-yaw", seed=3, drones=drones)
    times = np.arange(8.0, 20.0, 0.1)
    for member in scenario.members:
        rates = [abs(scenario.world.drones[member].yaw_rate(t)) for t in times]
        assert 1.9 < max(rates) <= 2.0 + 1e-9
        assert np.mean([bool(view) for view in views(scenario, member, times)]) > 0.8


def test_the_late_joiner_hovers_in_view_until_its_agent_has_had_time_to_start():
    scenario = load_scenario("late-joiner")
    assert dict(scenario.starts_s) == {4: 8.0}
    late = scenario.world.drones[4]
    assert np.linalg.norm(late.position(12.0) - late.position(0.0)) < 0.4
    assert all(4 in seen_by(scenario, member, 6.0) for member in (1, 2, 3))


def tilted(scenario: Scenario, drone_id: int, t: float) -> float:
    """Degrees."""
    return math.degrees(math.acos(scenario.world.pose(drone_id, t).rotation[2, 2]))


@pytest.mark.parametrize("text", [(files.FOLDER / "formation-3.toml").read_text(encoding="utf-8"), RING])
def test_in_wind_everybody_leans_one_way_and_sways(write, text):
    calm, windy = load_scenario(write(text)), load_scenario(write(text + "[wind]\nspeed_m_s = 6.0\n"))
    ways = set()
    for drone_id in calm.members:
        times = np.arange(0.0, 4.0, 0.25)
        assert np.mean([tilted(calm, drone_id, t) for t in times]) < 2.0
        assert np.mean([tilted(windy, drone_id, t) for t in times]) == pytest.approx(10.0, abs=2.0)
        down = np.mean([windy.world.pose(drone_id, t).rotation[:, 2] for t in times], axis=0)
        ways.add(round(math.degrees(math.atan2(down[1], down[0])) / 15.0))
        # The gyro fits the attitude, whatever it leans for.
        t, step = 2.0, 1e-4
        turned = windy.world.pose(drone_id, t).rotation.T @ windy.world.pose(drone_id, t + step).rotation
        np.testing.assert_allclose(rotation.log(turned) / step, windy.world.body_rate(drone_id, t), atol=2e-3)
    assert max(ways) - min(ways) <= 1
    sway = np.array([windy.world.pose(2, t).position for t in np.arange(-120.0, 0.0, 0.5)]).std(axis=0)
    if "star" not in text:
        assert sway.mean() == pytest.approx(0.25, rel=0.4)


def test_who_takes_off_in_wind_leans_once_it_is_in_the_air(write):
    text = (files.FOLDER / "errand.toml").read_text(encoding="utf-8") + "[wind]\nspeed_m_s = 6.0\n"
    windy = load_scenario(write(text))
    takes_off = windy.world.flown(1).takes_off_s
    assert tilted(windy, 1, takes_off - 0.1) == pytest.approx(0.0, abs=0.01)
    assert np.mean([tilted(windy, 1, takes_off + s) for s in np.arange(4.0, 9.0, 0.5)]) > 7.0


def test_those_that_are_switched_on_stand_for_more_than_the_forty_seconds_that_they_need():
    scenario = load_scenario("power-on")
    for drone_id in scenario.members:
        ego, takes_off = scenario.ego(drone_id), scenario.world.flown(drone_id).takes_off_s
        assert not ego.is_awake(39.0)
        assert ego.is_awake(41.0)
        assert takes_off > 60.0
        swings = [
            ego.heading_error(t) - ego.heading_error(takes_off - 1.0) for t in np.arange(0.0, 40.0, 0.5)
        ]
        assert np.ptp(np.rad2deg(swings)) > 1.5
    assert {scenario.autopilot(drone_id) for drone_id in scenario.members} == {"ardupilot", "px4"}


@pytest.mark.parametrize("drones", [2, 4, pytest.param(8, marks=pytest.mark.long("a larger team, of eight"))])
def test_the_intruder_is_seen_by_all_and_belongs_to_nobody(drones):
    scenario = load_scenario("intruder", drones=drones)
    assert scenario.strangers == {999}
    assert 999 not in scenario.members
    assert 999 not in scenario.announced
    times = np.arange(5.0, scenario.seconds, 0.25)
    for member in scenario.members:
        assert 0.1 < np.mean([999 in view for view in views(scenario, member, times)]) < 0.8


def test_clock_skew_gives_every_machine_a_clock_of_its_own_kind_of_wrong():
    scenario = load_scenario("clock-skew", drones=4)
    assert dict(scenario.utc_offset_s) == {1: 0.0, 2: 7200.0, 3: -30.0, 4: 0.0}
    assert {round(1e6 * skew) for skew in scenario.autopilot_skew.values()} >= {50, -50}
    assert set(scenario.autopilot_boot_s) == {1, 2, 3, 4}
    # Plain numbers: they go into every time that the judge writes, and a recording takes no others.
    assert {type(offset) for offset in scenario.utc_offset_s.values()} == {float}


def test_the_lossy_radio_loses_delays_and_parts():
    scenario = load_scenario("lossy-radio")
    assert scenario.radio == Radio(loss=0.2, latency_s=0.02, jitter_s=0.01)
    (partition,) = scenario.faults
    assert (partition.kind, partition.seconds, partition.drones) == (FaultKind.PARTITION, 10.0, (1,))
    assert [partition.concerns(1, t) for t in (11.9, 12.0, 21.9, 22.0)] == [False, True, True, False]
    assert not partition.concerns(2, 15.0)


def test_thirty_all_see_several_others_whose_boxes_hardly_ever_overlap():
    scenario = load_scenario("thirty")
    assert (len(scenario.members), scenario.imu_rate_hz) == (30, 50.0)
    overlapping = total = 0
    for t in np.arange(0.0, 30.0, 3.0):
        for member in scenario.members:
            boxes = np.stack(list(seen_by(scenario, member, float(t)).values()))
            assert len(boxes) >= 8
            gap = np.abs(boxes[:, None, :2] - boxes[:, :2]) - (boxes[:, None, 2:] + boxes[:, 2:]) / 2.0
            overlapping += int((gap < 0.0).all(axis=2).sum()) - len(boxes)
            total += len(boxes)
    assert overlapping / total < 0.02


def test_the_faults_are_of_every_kind_that_needs_no_radio_and_leave_time_to_heal():
    faults = load_scenario("faults").faults
    assert {fault.kind for fault in faults} == {
        FaultKind.CAMERA_STALL, FaultKind.IMU_GAP, FaultKind.AUTOPILOT_REBOOT, FaultKind.CLUTTER, FaultKind.KILL,
    }  # fmt: skip
    for before, after in itertools.pairwise(faults):
        assert after.at_s >= before.at_s + before.seconds + 2.0


def test_starts_are_announced_within_what_is_claimed_of_them():
    errors = []
    for seed in range(60):
        scenario = load_scenario("hover-triangle", seed=seed)
        for drone_id, start in scenario.announced.items():
            truth = scenario.initial_poses[drone_id]
            errors.append((start.position_m - truth.position) / start.position_sigma_m)
            assert start.yaw == pytest.approx(scenario.world.drones[drone_id].yaw(0.0))
    # 540 numbers know their sigma to 3 %: four times that
    assert np.std(errors) == pytest.approx(1.0, rel=0.13)


def test_a_drone_looks_where_it_sees_most_of_the_others():
    eye = np.zeros(3)
    others = [(5.0, 0.0, 0.0), (4.0, 2.0, -1.0), (-3.0, 0.0, 0.0)]
    north, east, down = best_view(eye, others, math.radians(60.0))
    assert math.degrees(math.atan2(east, north)) == pytest.approx(math.degrees(math.atan2(2, 4)) / 2)
    assert (math.hypot(north, east), down) == (pytest.approx(5.0), 0.0)
    # Of two that cannot be seen together, the farther one.
    np.testing.assert_allclose(best_view(eye, others[::2], 1.0), (5.0, 0.0, 0.0), atol=1e-12)


# --- what a file may say ----------------------------------------------------------------------------


@pytest.fixture
def write(tmp_path):
    return writer(tmp_path, "flight.toml")


def problems_of(path, **wanted):
    with pytest.raises(ConfigError) as caught:
        load_scenario(path, **wanted)
    return [problem.removeprefix(f"{path.parent}/") for problem in caught.value.problems]


def test_a_few_lines_are_a_scenario_and_everything_else_has_a_default(write):
    scenario = load_scenario(write(RING))
    assert (scenario.name, scenario.seconds, scenario.members) == ("flight", 9.0, (1, 2, 3))
    assert (scenario.faults, scenario.strangers, scenario.needs_radio) == ((), frozenset(), False)


def test_drones_one_by_one_fly_beside_those_of_a_formation(write):
    text = (
        RING
        + "[[drone]]\nid = 2\nposition_m = [0, 0, -9]\n[[drone]]\nid = 9\nstranger = true\nposition_m = [0, 9, -9]\n"
    )
    scenario = load_scenario(write(text), drones=5)
    assert scenario.members == (1, 2, 3, 4, 5)
    assert set(scenario.world.drones) == {1, 2, 3, 4, 5, 9}
    assert scenario.world.pose(2, 0.0).position[2] == pytest.approx(-9.0, abs=0.2)


def test_drones_described_one_by_one_keep_their_ids_and_are_not_multiplied(write):
    path = write(ONE_BY_ONE)
    assert load_scenario(path).members == load_scenario(path, drones=2).members == (3, 7)
    assert problems_of(path, drones=4) == [
        "flight.toml:4: drone: 4 drones wanted, expected 2: it has no [formation] that makes others"
    ]
    with pytest.raises(ConfigError, match=r"yawing-observer\.toml:6: drone: 4 drones wanted, expected 3"):
        load_scenario(FIXED, drones=4)
    assert "0 drones wanted, expected 1 to 100" in problems_of(write(RING), drones=0)[0]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("secnds = 3\n" + RING, 'flight.toml:1: secnds: unknown key, did you mean "seconds"?'),
        (RING + "[camera]\nfbs = 7\n", 'flight.toml:7: camera.fbs: unknown key, did you mean "fps"?'),
        (RING + "[agents]\nfps = 7\n", "flight.toml:7: agents.fps: unknown key here, expected in [camera]"),
        (RING + "[detector]\np_merge = 0\n", 'flight.toml:7: detector.p_merge: unknown key, did you mean "p_merged"?'),
        (RING + "[detector]\np_merged = 2\n", "flight.toml:7: detector.p_merged: 2, expected 0 to 1"),
        (RING + "[radio]\nloss = 20\n", "flight.toml:7: radio.loss: 20, expected less than or equal to 1"),
        (RING + "[radio]\nloss = nan\n", "flight.toml:7: radio.loss: NaN, expected a finite number"),
        (RING.replace("ring", "rnig"), 'flight.toml:5: formation.rnig: unknown key, did you mean "ring"?'),
        (RING.replace("radius_m", "radius"), 'flight.toml:5: formation.ring.radius: unknown key, did you'),
        (RING.replace("= 3\n", '= "3"\n'), 'flight.toml:4: formation.drones: "3", expected a valid integer'),
        (RING + "weave = { reach_m = 1, period_s = [5, 9] }\n", "flight.toml:3: formation: weave with ring"),
        (RING + "errand = {}\n", "flight.toml:3: formation: 2 of ring, lanes, errand and star, expected one"),
        (RING.replace("ring = { radius_m = 3.0 }", "errand = {}\nswing = { peak_rad_s = 1, period_s = [1, 2] }"),
         "flight.toml:3: formation: errand with swing, expected one or the other"),
        (RING + "[ghosts]\ncont = 3\n", 'flight.toml:7: ghosts.cont: unknown key, did you mean "count"?'),
        (RING + "[clocks]\ncamera_offset_s = [3]\n", "flight.toml:7: clocks.camera_offset_s[0]: 3, expected less than"),
        (RING + "lanes = { gap_m = 5 }\n", "flight.toml:3: formation: 2 of ring, lanes, errand and star, expected one"),
        ("about = 'x'\nseconds = 9\n", "flight.toml:1: formation: missing, expected a table [formation]"),
        (ONE_BY_ONE.replace("id = 7", "id = 3"), "flight.toml:9: drone[1].id: 3, expected an ID that no other"),
        (ONE_BY_ONE.replace("heading_deg", "heeding_deg"), 'flight.toml:11: drone[1].heeding_deg: unknown key'),
        (ONE_BY_ONE + "looks_at_m = [0, 0, 0]\n", "flight.toml:8: drone[1]: looks_at_m with heading_deg or swing"),
        (
            ONE_BY_ONE + "waypoints = [{ at_s = 5, position_m = [1, 1, -9] }, { at_s = 4, position_m = [1, 2, -9] }]\n",
            "flight.toml:12: drone[1].waypoints: at_s [5.0, 4.0], expected each later than the one before",
        ),
        (RING + "seconds = =\n", "flight.toml:6: Invalid value, expected valid TOML"),
    ],
)  # fmt: skip
def test_every_mistake_is_named_with_its_file_and_line(write, text, complaint):
    assert any(problem.startswith(complaint) for problem in problems_of(write(text))), problems_of(
        write(text)
    )


@pytest.mark.parametrize(
    ("fault", "complaint"),
    [
        ("kind = 'camera'", "kind: \"camera\", expected 'camera-stall'"),
        ("kind = 'kill'", None),
        ("kind = 'kill'\nseconds = 2\ndrones = [3]", None),
        ("kind = 'kill'\ndrones = [4]", "drones: drone 4, which does not fly, expected some of [1, 2, 3]"),
        ("kind = 'imu-gap'", "seconds: 0, expected how long the imu-gap lasts, more than 0 s"),
        ("kind = 'imu-gap'\nseconds = -1", "seconds: -1, expected greater than or equal to 0"),
        ("kind = 'imu-gap'\nseconds = 1\nvalue = 3", "value: 3, expected none: imu-gap has no strength"),
        ("kind = 'partition'\nseconds = 2", "drones: none, expected the drones on one side of the partition"),
        ("kind = 'partition'\nseconds = 2\ndrones = [2]", None),
        ("kind = 'loss'\nseconds = 1\nvalue = 0.5", None),
        ("kind = 'loss'\nseconds = 1\nvalue = 20", "value: 20, expected the share of frames that are lost, 0 to 1"),
        ("kind = 'latency'\nseconds = 1", "value: missing, expected a delay of 0 to 60 s"),
        ("kind = 'clutter'\nseconds = 1\nvalue = -1", "value: -1, expected 0 to 1000 false detections per frame"),
        ("kind = 'clutter'\nsecond = 1\nvalue = 1", 'second: unknown key, did you mean "seconds"?'),
    ],
)  # fmt: skip
def test_faults_are_checked_each_by_its_kind(write, fault, complaint):
    first = "[[fault]]\nkind = 'kill'\nat_s = 1\n"
    path = write(f"{RING}{first}[[fault]]\nat_s = 2.5\n{fault}\n")
    if complaint is None:
        assert load_scenario(path).faults[1].at_s == 2.5
        return
    (problem,) = problems_of(path) if "second " not in fault else problems_of(path)[-1:]
    place, _, said = problem.partition(": fault[1].")
    assert said.startswith(complaint)
    assert 9 <= int(place.removeprefix("flight.toml:")) <= 13


def test_names_files_and_addresses_lead_to_scenarios(write):
    path = write(RING)
    assert load_scenario(path).world.drones.keys() == load_scenario(str(path)).world.drones.keys()
    with pytest.raises(ConfigError, match='scenario "crosing", did you mean "crossing"'):
        load_scenario("crosing")
    with pytest.raises(ConfigError, match=r"absent\.toml:1: cannot be read"):
        load_scenario("absent.toml")
    sim = open_simulation(f"sim://{path}?drones=5&drone=5", None, ManualClock())
    assert [a.drone_id for a in sim.teammates_announcements()] == [1, 2, 3, 4]


# --- autopilots ------------------------------------------------------------------------------------


def test_a_formation_takes_its_autopilots_in_turn_and_a_drone_by_itself_says_its_own(write):
    text = RING.replace("drones = 3", 'drones = 5\nautopilots = ["ardupilot", "px4", "px4-lockstep"]')
    scenario = load_scenario(write(text + '[[drone]]\nid = 9\nposition_m = [9, 9, -3]\nautopilot = "px4"\n'))
    kinds = [scenario.autopilot(drone_id).value for drone_id in scenario.members]
    assert kinds == ["ardupilot", "px4", "px4-lockstep", "ardupilot", "px4"]
    assert scenario.autopilot_skew[3] == -0.011
    assert 1e-4 <= abs(scenario.autopilot_skew[2]) <= 2e-4
    assert {load_scenario("hover-triangle").autopilot(n).value for n in (1, 2, 3)} == {"ardupilot"}


def test_an_errand_is_flown_as_the_autopilot_of_each_drone_flies(write):
    text = "about = 'x'\nseconds = 50\n[formation]\ndrones = 2\nautopilots = ['ardupilot', '{}']\nerrand = {{}}\n"
    first, second = (load_scenario(write(text.format(kind)), seed=5).world for kind in ("ardupilot", "px4"))
    times = np.linspace(0.0, 45.0, 200)
    same = [np.array_equal(first.drones[1].position(t), second.drones[1].position(t)) for t in times]
    assert all(same)
    fastest = [max(np.linalg.norm(world.body_rate(2, t)) for t in times) for world in (first, second)]
    assert fastest[1] > 1.3 * fastest[0]


def test_a_guided_drone_stands_where_it_was_put_and_has_no_plan(write):
    scenario = load_scenario("guided")
    for drone_id, north, yaw in ((1, 0.0, 0.0), (2, 7.0, math.pi)):
        drone = scenario.world.flown(drone_id)
        for t in (-100.0, 0.0, 50.0):
            assert drone.position(t)[0] == north
            assert drone.yaw(t) == pytest.approx(yaw)
        assert drone.takes_off_s == math.inf
        assert seen_by(scenario, drone_id, 1.0).keys() == {3 - drone_id}
    swings = ONE_BY_ONE + "guided = true\nswing = { peak_rad_s = 1.0, period_s = 2.0 }\n"
    assert problems_of(write(swings)) == [
        "flight.toml:8: drone[1]: guided with swing, expected one of them: who is guided has no plan"
    ]


# --- nothing on the air --------------------------------------------------------------------------------


def test_drones_that_say_nothing_sway_by_their_codes_when_the_scenario_says_so(write):
    text = RING + "[agents]\nannounce = false\n"
    silent, coded = load_scenario(write(text)), load_scenario(write("codes_s = [6.0]\n" + text))
    assert not coded.announces
    for drone_id in coded.members:
        for t in (5.9, 8.0, 11.0, 14.1):
            added = coded.world.flown(drone_id).position(t) - silent.world.flown(drone_id).position(t)
            assert added == pytest.approx(sway(drone_id, coded.members, t - 6.0)[0], abs=1e-9)


def test_codes_are_for_drones_that_fly_by_plan(write):
    errand = "codes_s = [3.0]\n" + RING.replace("ring = { radius_m = 3.0 }", "errand = {}")
    assert problems_of(write(errand)) == [
        "flight.toml:1: codes_s: with guided drones, errands or a star, expected drones that hover or fly by plan"
    ]


@pytest.mark.parametrize(
    ("team", "drones"),
    [("drones = 1000", None), ("drones = 3", 1000), ("drones = 99999999", None)],
)
def test_more_drones_than_a_local_swarm_has_are_refused_before_their_places_are_looked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, team: str, drones: int | None
) -> None:
    """To look for them takes minutes, and says nothing meanwhile."""
    monkeypatch.setattr(files, "form_up", lambda *_: pytest.fail("looked for places"))
    path = tmp_path / "many.toml"
    path.write_text(
        f'about = "many"\nseconds = 20.0\n[formation]\n{team}\nring = {{ radius_m = 300.0, heights_m = [3.0, 3.5] }}\n'
    )
    with pytest.raises(
        ConfigError, match=r"formation\.drones: (1000|99999999).*, expected (1 to|less than or equal to) 100"
    ):
        load_scenario(path, seed=1, drones=drones)
