"""`swarmtrack calibrate size`: widths of boxes out of recorded flights, against the boxes that were drawn."""

import json
import re
import tomllib

import numpy as np
import pytest

pytest.importorskip("foxglove", reason="foxglove-sdk has no wheel here")

from support.recorded_flight import BEGIN, fly
from swarmtrack.agents.main import main
from swarmtrack.calibration.box_width import level_width
from swarmtrack.clock import ManualClock
from swarmtrack.config.drone import DroneConfig
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.world.sensors import visible
from swarmtrack.recording.reader import FLIGHT_PLAN, recordings_below
from swarmtrack.recording.writer import Attachment
from swarmtrack.replay.flight_widths import FlightWidths
from swarmtrack.runtime.swarm_recorder import SwarmRecorder, TruePose

SPAN = 0.5


@pytest.fixture(scope="module")
def tight():
    """Width of the true boxes, over that of the span."""
    scenario = load_scenario("hover-triangle")
    shares = []
    for t in np.arange(0.0, 12.0, 0.5):
        for observer in scenario.members:
            eye = scenario.world.pose(observer, t) @ scenario.body_from_camera
            for other, box in visible(
                scenario.world, observer, scenario.camera, scenario.body_from_camera, t
            ).items():
                away = scenario.world.drones[other].position(t) - eye.position
                shares.append(box[2] / level_width(away, SPAN, scenario.camera, eye.rotation))
    return pytest.approx(float(np.median(shares)), rel=0.04)


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flight")
    fly(folder, 18.0, faults=False)
    return folder / "rec"


def test_tight_boxes_of_teammates_with_recordings_are_found_to_be_tight(flight, tight, capsys):
    assert main(["calibrate", "size", str(flight), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["boxes"] > 300
    assert found["drones"] == 6
    assert found["factor"] == tight
    assert found["drone_sigma_measured"]
    assert not found["padding_measured"]


def test_a_teammate_without_a_recording_is_where_it_said_it_was(flight, tight, capsys):
    assert main(["calibrate", "size", str(flight / "drone-1"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["drones"] == 2
    assert found["factor"] == tight


def test_what_is_printed_is_what_a_config_takes(flight, tight, capsys):
    assert main(["calibrate", "size", str(flight)]) == 0
    text = capsys.readouterr().out
    assert "the padding is unknown" in text
    table = tomllib.loads(text[text.index("[detector.box_width]") :])
    config = DroneConfig.model_validate(
        {
            "drone": {"id": 1},
            "camera": {
                "source": "v4l2:///dev/video0",
                "intrinsics": {"fx": 1.0, "fy": 1.0, "cx": 1.0, "cy": 1.0, "width": 2, "height": 2},
            },
            **table,
        }
    )
    assert config.detector.box_width.factor == tight
    # No smaller than what one flight cannot show.
    assert config.detector.box_width.drone_sigma >= 0.19


def test_another_span_makes_another_width(flight, capsys):
    assert main(["calibrate", "size", str(flight), "--span", "1.0", "--json"]) == 0
    half = json.loads(capsys.readouterr().out)["factor"]
    assert main(["calibrate", "size", str(flight), "--span", "0.5", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["factor"] == pytest.approx(2.0 * half, rel=0.01)


def test_too_little_is_said_to_be(tmp_path, capsys):
    fly(tmp_path, 2.5, drones=(1, 2), faults=False)
    assert main(["calibrate", "size", str(tmp_path / "rec")]) == 2
    error = capsys.readouterr().err
    assert re.search(r"found \d+ boxes of drones at a known distance, expected 200 or more", error)


def test_drones_that_nobody_knows_the_width_of_are_said_to_be(flight, capsys, monkeypatch):
    monkeypatch.setattr(FlightWidths, "span", None)
    assert main(["calibrate", "size", str(flight)]) == 2
    assert (
        "found no [team] airframe_span_m in their configs, expected it or --span" in capsys.readouterr().err
    )


def test_where_a_simulation_recorded_the_truth_it_counts(flight, tmp_path):
    """The truth says that all drones are twice as far from each other: then they are twice as wide."""
    scenario = load_scenario("hover-triangle")
    (drone,) = recordings_below(flight / "drone-1")
    plan = Attachment(FLIGHT_PLAN, "application/json", json.dumps({"epoch_s": BEGIN[1]}).encode())
    recorder = SwarmRecorder(ManualClock(BEGIN[1], 1.8e9), "t")
    recorder.open(tmp_path, attachments=[plan])
    recorder.landed()
    middle = np.mean([scenario.world.drones[d].position(0.0) for d in scenario.members], axis=0)
    for k in range(120):
        for d in scenario.members:
            pose = scenario.world.pose(d, 0.1 * k)
            # The camera is where it is on the drone.
            eye = scenario.body_from_camera.position @ pose.rotation.T if d == 1 else 0.0
            far = type(pose)(pose.rotation, middle + 2.0 * (pose.position - middle) + eye)
            recorder.truth(BEGIN[1], TruePose(0.1 * k, d, far))
    recorder.close()
    one = FlightWidths([drone], 0.5).widths()
    other = FlightWidths([drone, *recordings_below(tmp_path)], 0.5).widths()
    assert sum(len(widths.t) for widths in other) > 100
    for near, far in zip(one, other, strict=True):
        assert np.median(near.span_px) == pytest.approx(2.0 * np.median(far.span_px), rel=0.1)
