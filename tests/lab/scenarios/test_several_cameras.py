"""Drones with several cameras: what a scenario's file says of them, and what each of them sees."""

import math
from dataclasses import replace

import numpy as np
import pytest

from support.places import writer
from swarmtrack.clock import ManualClock
from swarmtrack.errors import ConfigError, SourceError
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import RadTan
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.scenarios.oracle import OracleDetector
from swarmtrack.lab.scenarios.scenario import BODY_FROM_CAMERA, CAMERA
from swarmtrack.lab.sources import open_simulation
from swarmtrack.lab.world.rendering import Renderer
from swarmtrack.lab.world.sensors import visible

HEAD = "about = 'x'\nseconds = 9\n[formation]\ndrones = 3\nring = { radius_m = 3.0 }\n"
INTRINSICS = "intrinsics = { fx = 320, fy = 321, cx = 319.5, cy = 239.5, width = 640, height = 480 }\n"
BACK = "body_from_camera = { rpy_deg = [0, 0, 180], position_m = [-0.1, 0, 0] }\n"


@pytest.fixture
def write(tmp_path):
    return writer(tmp_path, "flight.toml")


def test_one_table_is_one_camera_and_what_it_does_not_say_is_as_it_was(write):
    scenario = load_scenario(write(HEAD + "[camera]\nfps = 7\n"))
    (camera,) = scenario.cameras
    assert (camera.lens, camera.body_from_camera) == (CAMERA, BODY_FROM_CAMERA)
    assert (camera.fps, camera.phase, camera.mounting_sigma) == (7.0, 0.0, 0.0)
    assert (scenario.camera, scenario.body_from_camera, scenario.fps) == (CAMERA, BODY_FROM_CAMERA, 7.0)
    assert scenario.told_mounting(2, 0) is BODY_FROM_CAMERA


def test_each_of_several_tables_is_a_camera_with_its_own_lens_place_and_time(write):
    bent = INTRINSICS + 'distortion = { model = "radtan", coefficients = [-0.1, 0.01, 0, 0] }\n'
    tables = f"[[camera]]\n[[camera]]\nfps = 5\n{bent}{BACK}[[camera]]\nphase = 0.9\n[[camera]]\n"
    first, back, third, last = load_scenario(write(HEAD + tables)).cameras
    assert (first.lens, first.fps) == (CAMERA, 15.0)
    assert (back.lens.fx, back.lens.fy, back.lens.width, back.fps) == (320.0, 321.0, 640, 5.0)
    assert back.lens.distortion == RadTan((-0.1, 0.01, 0.0, 0.0))
    assert back.body_from_camera.transform(np.array([[0.0, 0.0, 5.0]])) == pytest.approx(
        np.array([[-5.1, 0.0, 0.0]]), abs=1e-12
    )
    assert [camera.phase for camera in (first, back, third, last)] == [0.0, 0.25, 0.9, 0.75]
    assert back.exposure(10) == pytest.approx(10.25 / 5.0)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[[camera]]\n" * 9, "flight.toml:6: camera: 9 cameras, expected 1 to 8"),
        (
            "[[camera]]\n[[camera]]\nfbs = 3\n",
            'flight.toml:8: camera[1].fbs: unknown key, did you mean "fps"?',
        ),
        ("[camera]\nfbs = 3\n", 'flight.toml:7: camera.fbs: unknown key, did you mean "fps"?'),
        ("[camera]\nphase = 1.0\n", "flight.toml:7: camera.phase: 1.0, expected less than 1"),
        (
            "[[camera]]\nmounting_sigma_deg = 11\n",
            "flight.toml:7: camera[0].mounting_sigma_deg: 11, expected less than or equal to 10",
        ),
        (
            '[[camera]]\ndistortion = { model = "radtan", coefficients = [0, 0, 0, 0] }\n',
            "flight.toml:6: camera[0]: distortion without intrinsics, expected both",
        ),
    ],
)
def test_what_is_wrong_with_a_camera_is_said_with_its_line(write, text, complaint):
    path = write(HEAD + text)
    with pytest.raises(ConfigError) as caught:
        load_scenario(path)
    problems = [problem.removeprefix(f"{path.parent}/") for problem in caught.value.problems]
    assert any(problem.startswith(complaint) for problem in problems), problems


def test_no_camera_at_all_is_said(write):
    with pytest.raises(ConfigError, match="camera: 0 cameras, expected 1 to 8"):
        load_scenario(write("camera = []\n" + HEAD))


def test_a_mounting_is_told_as_wrong_as_is_said_differently_for_each_camera_and_drone():
    scenario = load_scenario("all-round")
    angles = []
    for seed in range(60):
        flown = replace(scenario, world=replace(scenario.world, seed=seed))
        for drone in flown.members:
            for k, camera in enumerate(flown.cameras):
                told = flown.told_mounting(drone, k)
                assert told.position is camera.body_from_camera.position
                angles.append(rotation.log(camera.body_from_camera.rotation.T @ told.rotation))
    degrees = np.degrees(angles)
    assert np.unique(degrees.round(9), axis=0).shape == degrees.shape
    assert degrees.std(axis=0) == pytest.approx(0.5, rel=0.1)
    assert np.abs(degrees.mean(axis=0)).max() < 0.05


def test_the_first_camera_sees_what_it_would_see_if_it_were_the_only_one():
    several = load_scenario("two-cameras")
    alone = replace(several, cameras=several.cameras[:1])
    for index in range(40, 60):
        t = several.cameras[0].exposure(index)
        one, other = (OracleDetector(scenario).detections(1, index, t) for scenario in (several, alone))
        np.testing.assert_array_equal(one.centre, other.centre)


def test_each_camera_finds_what_is_in_its_own_picture_by_chances_of_its_own():
    scenario = load_scenario("all-round")
    oracle, found = OracleDetector(scenario), []
    for k, camera in enumerate(scenario.cameras):
        hits = drones = 0
        for index in range(20, 80):
            t = camera.exposure(index)
            scan = oracle.detections(1, index, t, k)
            assert scan.camera == 0
            for box in visible(scenario.world, 1, camera.lens, camera.body_from_camera, t).values():
                drones += 1
                hits += bool((np.linalg.norm(scan.centre - box[:2], axis=1) < 5.0).any())
        found.append((hits, drones))
    assert sum(drones for _, drones in found) > 200
    assert all(hits / drones > 0.85 for hits, drones in found if drones)
    # The same exposure twice: the same chance would find the same clutter.
    clutter = replace(scenario.detector, p_detection=0.0, clutter_per_frame=5.0)
    oracle = OracleDetector(replace(scenario, detector=clutter, cameras=(scenario.cameras[0],) * 2))
    one, other = (oracle.detections(1, 3, 0.3, k).centre for k in (0, 1))
    assert len(one) != len(other) or not np.allclose(one, other)


def test_all_round_shows_everybody_to_everybody_nearly_all_the_time():
    scenario = load_scenario("all-round", seed=5)
    seen = pairs = 0
    for t in np.arange(0.0, 30.0, 1.5).tolist():
        for observer in scenario.members:
            views = (
                visible(scenario.world, observer, camera.lens, camera.body_from_camera, t)
                for camera in scenario.cameras
            )
            seen += len({drone for view in views for drone in view})
            pairs += len(scenario.members) - 1
    assert seen / pairs > 0.95


def test_in_two_cameras_the_observer_s_neighbours_cross_the_seam_again_and_again():
    scenario = load_scenario("two-cameras")
    left = []
    for t in np.arange(5.0, 30.0, 0.1).tolist():
        view, _ = (
            visible(scenario.world, 1, camera.lens, camera.body_from_camera, t) for camera in scenario.cameras
        )
        left.append([drone in view for drone in (2, 3)])
    assert (np.abs(np.diff(np.array(left, int), axis=0)).sum(axis=0) >= 6).all()


def test_a_picture_of_the_second_camera_shows_what_is_ahead_of_it():
    scenario = load_scenario("two-cameras")
    camera, t = scenario.cameras[1], 1.0
    renderer = Renderer(scenario.world, camera.lens, camera.body_from_camera, number=1)
    boxes = visible(scenario.world, 1, camera.lens, camera.body_from_camera, t)
    assert boxes
    with_them, without = (renderer.image(1, t, 15, targets).astype(int) for targets in (None, []))
    rows, columns = np.nonzero(np.abs(with_them - without).max(axis=2) > 12)
    middle = np.array([columns, rows]).T
    for box in boxes.values():
        assert (np.abs(middle - box[:2]) < box[2:] / 2.0 + 2.0).all(axis=1).any()
    first = Renderer(scenario.world, camera.lens, camera.body_from_camera)
    assert not np.array_equal(first.image(1, t, 15), renderer.image(1, t, 15)), "the same noise"


def test_a_simulated_address_names_the_camera():
    scenario = load_scenario("two-cameras")
    opened = open_simulation("sim://two-cameras?camera=1&fps=10", 1, ManualClock())
    assert opened.camera.body_from_camera.position.tolist() == [0.1, 0.04, 0.0]
    with pytest.raises(SourceError, match="camera: 2, expected 0 to 1"):
        open_simulation("sim://two-cameras?camera=2", 1, ManualClock())
    assert math.isclose(scenario.cameras[1].phase, 0.5)
