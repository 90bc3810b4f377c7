"""Training labels of a recorded flight: where the teammates knew themselves to be."""

import csv

import numpy as np
import pytest

from support.recorded_flight import BEGIN, fly
from swarmtrack.agents.main import main
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.world.sensors import visible
from swarmtrack.recording.reader import recordings_below
from swarmtrack.replay.flight_labels import Body, FlightLabels
from swarmtrack.training.labelled_images import load_frames

WITH_PICTURES = '\n[recording]\nframes = "jpeg"\nframes_hz = 50.0\n'
BODY = Body(0.4, 0.15)


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flight")
    fly(folder, 6.0, extra=WITH_PICTURES, faults=False)
    return folder / "rec"


def off(picture, scenario):
    """How far each label's centre is from where that drone truly was, px."""
    exposed = picture.t - BEGIN[picture.observer]
    truth = visible(scenario.world, picture.observer, scenario.camera, scenario.body_from_camera, exposed)
    for label in picture.labels:
        if label.drone_id in truth:
            yield np.hypot(*(label.box[:2] + label.box[2:] / 2 - truth[label.drone_id][:2]))


def test_labels_are_where_the_drones_were(flight):
    scenario = load_scenario("hover-triangle")
    labels = FlightLabels(recordings_below(flight), BODY)
    pictures = list(labels.pictures())
    distances = [d for picture in pictures for d in off(picture, scenario)]
    assert labels.observers == [1, 2, 3]
    assert len(distances) > 100
    # As sure as the poses are: 5 cm at 5 m and 1° are some 8 px each way.
    assert np.median(distances) < 12.0
    assert np.percentile(distances, 95) < 25.0


def test_a_teammate_without_a_recording_is_where_it_said_it_was(flight):
    scenario = load_scenario("hover-triangle")
    labels = FlightLabels(recordings_below(flight / "drone-1"), BODY)
    distances = [d for picture in labels.pictures() for d in off(picture, scenario)]
    assert len(distances) > 20
    assert np.median(distances) < 15.0
    assert labels.skipped["a teammate's pose is not known"] > 0  # before the first report, after the last


def test_what_is_not_sure_enough_is_left_out(flight):
    """A body of 2 cm is smaller than a pose is sure: no picture can be labelled, and it is told why."""
    labels = FlightLabels(recordings_below(flight), Body(0.02, 0.01))
    assert list(labels.pictures()) == []
    assert labels.skipped["a teammate's position in it is too uncertain"] > 10


def test_the_command_writes_what_train_reads(flight, tmp_path, capsys):
    out = tmp_path / "data"
    assert main(["label", str(flight), "--span", "0.4", "--every", "5", "--out", str(out)]) == 0
    frames = load_frames(out)
    assert sum(len(frame.drones) for frame in frames) > 20
    assert {frame.source for frame in frames} == {"drone-1", "drone-2", "drone-3"}
    assert (out / "labels.jpg").stat().st_size > 1000
    assert f"{len(frames)} pictures" in capsys.readouterr().out
    with (out / "images.csv").open() as file:
        assert len(list(csv.reader(file))) == len(frames) + 1


def test_a_folder_that_holds_something_is_not_written_into(flight, tmp_path, capsys):
    (tmp_path / "mine.txt").write_text("mine")
    assert main(["label", str(flight), "--span", "0.4", "--out", str(tmp_path)]) == 2
    assert "expected a new folder" in capsys.readouterr().err


def test_recordings_without_pictures_are_told(tmp_path, capsys):
    fly(tmp_path, 1.0, drones=(1, 2), faults=False)
    assert main(["label", str(tmp_path / "rec"), "--span", "0.4", "--out", str(tmp_path / "data")]) == 2
    assert 'frames = "jpeg"' in capsys.readouterr().err
