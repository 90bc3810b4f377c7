"""The scenario `fisheye`: one lens of 190° per drone, with neighbours beside and behind the camera."""

import math

import numpy as np
import pytest

from swarmtrack.benchmarks import all_round
from swarmtrack.benchmarks.identity import recognition
from swarmtrack.benchmarks.virtual_swarm import VirtualSwarm
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.world.rendering import Renderer
from swarmtrack.lab.world.scenery import Backdrop
from swarmtrack.lab.world.sensors import visible


def off_axis(scenario, observer, other, t):
    eye = scenario.world.pose(observer, t) @ scenario.body_from_camera
    away = eye.inverse().transform(scenario.world.pose(other, t).position[None])[0]
    return math.degrees(math.acos(away[2] / np.linalg.norm(away)))


def test_its_neighbours_are_seen_beside_and_behind_the_camera():
    scenario = load_scenario("fisheye")
    off = []
    for t in np.arange(0.0, 30.0, 0.25).tolist():
        boxes = visible(scenario.world, 1, scenario.camera, scenario.body_from_camera, t)
        assert {2, 3} <= set(boxes)
        off += [off_axis(scenario, 1, other, t) for other in (2, 3)]
    assert 84.0 < min(off) < 88.0
    assert 91.0 < max(off) < 95.0


def test_the_picture_shows_a_drone_that_is_behind_the_camera():
    scenario = load_scenario("fisheye")
    t = next(
        t
        for t in np.arange(0.0, 30.0, 0.1).tolist()
        if max(off_axis(scenario, 1, n, t) for n in (2, 3)) > 91.0
    )
    behind = max((2, 3), key=lambda other: off_axis(scenario, 1, other, t))
    renderer = Renderer(scenario.world, scenario.camera, scenario.body_from_camera)
    box = visible(scenario.world, 1, scenario.camera, scenario.body_from_camera, t)[behind]
    with_it, without = (renderer.image(1, t, 15, targets).astype(int) for targets in ([behind], []))
    rows, columns = np.nonzero(np.abs(with_it - without).max(axis=2) > 12)
    assert len(rows) > 10
    assert (np.abs(np.array([columns, rows]).T - box[:2]) < box[2:] / 2.0 + 3.0).all(axis=1).mean() > 0.9


def test_the_sky_is_above_and_the_ground_below_beside_the_camera_as_well():
    scenario = load_scenario("fisheye")
    backdrop = Backdrop(scenario.world, scenario.camera, 250.0)
    image = backdrop.draw(scenario.world.pose(1, 0.0) @ scenario.body_from_camera).astype(int)
    # Blue less green, 94 degrees to the right, above the horizon and below it.
    column = image[:, 636]
    blue = column[:, 0] - column[:, 1]
    assert blue[200:300].mean() > 0.0 > blue[340:440].mean()


@pytest.mark.long(
    "9 s of flight; tracking/test_wide_lens.py and cameras/test_rig.py have such lenses in the default run"
)
def test_drones_at_the_end_of_the_field_are_named():
    scenario = load_scenario("fisheye")
    named, wide = [], []

    def see(glance):
        if glance.observer != 1 or glance.t < 3.0:
            return
        names = {track.identity for track in glance.tracks or ()}
        for other in (2, 3):
            off = off_axis(scenario, 1, other, glance.t)
            if other in glance.in_view and off > 85.0:
                named.append(other in names)
                wide.append(off)

    score = recognition.judge(VirtualSwarm(scenario, tracker="mbm"), scenario, 9.0, see).score
    assert score.wrong == 0.0
    assert score.correct > 0.98
    assert max(wide) > 90.0
    assert np.mean(named) > 0.98
    assert len(named) > 60


@pytest.mark.long("20 s, every scan judged; the default run has nine")
def test_a_whole_flight_of_it_has_no_wrong_name():
    flight = all_round.fly("fisheye", 20.0, "mbm", 2)
    assert flight.score.wrong == 0.0
    assert flight.score.correct > 0.98
