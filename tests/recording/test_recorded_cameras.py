"""What a recording holds of several cameras; and that one of a single camera is what it always was."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from support.protobuf_topics import decoded
from support.recorded_cameras import TURNED, recorded, settings_of
from swarmtrack.agents.main import main
from swarmtrack.errors import ConfigError, RecordingError
from swarmtrack.messages import (
    Detections,
    IdentifiedTrack,
    ScanReport,
    Track,
    TrackList,
    TrackStatus,
)
from swarmtrack.monitor.overlay import boxes
from swarmtrack.monitor.player import Playback
from swarmtrack.monitor.recorded import read_timeline
from swarmtrack.recording import inputs, outputs
from swarmtrack.recording.reader import Recording
from swarmtrack.recording.settings import attachments, read_settings
from swarmtrack.replay.flight_labels import Body, FlightLabels
from swarmtrack.replay.replayer import Replayer
from swarmtrack.replay.tiled_video import WIDEST_TILED_PX, Tiles


def test_a_flight_with_two_cameras_is_replayed_bit_for_bit(tmp_path):
    recording = recorded(tmp_path)
    settings, notes = read_settings(recording)
    assert notes == []
    for read, flown in zip(settings.cameras, settings_of(tmp_path, "", TURNED).cameras, strict=True):
        assert read.camera == flown.camera
        assert read.time_offset_s == flown.time_offset_s
        np.testing.assert_array_equal(read.body_from_camera.rotation, flown.body_from_camera.rotation)
        np.testing.assert_array_equal(read.body_from_camera.position, flown.body_from_camera.position)
    replayed = Replayer(recording, settings, every_answer=True).run()
    assert replayed.exact
    assert replayed.scans_compared.recorded == 30
    assert {track.track.camera for scan in replayed.scans for track in scan.tracks.tracks} == {0, 1}


def test_the_detector_sees_the_recorded_frames_of_each_camera_anew(tmp_path):
    recording = recorded(tmp_path)
    settings, _ = read_settings(recording)
    shades = {}

    class Shades:
        """Stands for a detector; tells how bright the frame of each camera was."""

        box_width = None

        def plan(self, frame, expectation):
            return frame

        def detect(self, frame):
            shades.setdefault(frame.camera, []).append((frame.sequence, round(float(frame.image.mean()))))
            empty = np.empty((0, 2))
            return Detections(frame.t, frame.sequence, empty, empty, np.empty(0), camera=frame.camera)

    Replayer(recording, settings, detector=Shades()).run()
    assert {camera: {shade for _, shade in seen} for camera, seen in shades.items()} == {0: {40}, 1: {100}}
    # 5 Hz of 15, of each, the second one a little early.
    assert [len(seen) for seen in shades.values()] == [6, 6]


def test_the_page_of_a_recording_shows_the_pictures_of_each_camera(tmp_path):
    recorded(tmp_path)
    playback = Playback(read_timeline([tmp_path / "rec"]))
    playback.seek(playback.steps)
    assert playback.timeline.notes == []
    assert playback.cameras == ((3, 0), (3, 1))
    (drone,) = playback.state()["drones"]
    assert [round(np.ptp(np.array(line)[:, 0])) for line in drone["around"]["outlines"]] == [56, 56]
    # The first sees one left of its middle, the second, which looks right, one where its middle is.
    assert [(round(track.right_deg), track.camera) for track in drone["around"]["tracks"]] == [
        (-11, 0),
        (88, 1),
    ]
    for camera, shade in ((0, 40), (1, 100)):
        view, tracks = playback.view(3, camera)
        picture = cv2.imdecode(np.frombuffer(view.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
        assert round(float(picture.mean())) == shade
        (box,) = boxes(view, tracks, camera, playback.rig(3))
        assert box["box"][0] == pytest.approx(100.0 + 50.0 * camera, abs=2.0)


def test_a_viewer_finds_the_pictures_of_each_camera_in_its_frame(tmp_path):
    recorded(tmp_path)
    told = decoded(tmp_path / "rec")
    assert {image.frame_id for image in told["/camera/image"]} == {"drone-3/camera"}
    assert {image.frame_id for image in told["/camera/2/image"]} == {"drone-3/camera-2"}
    assert {entity.frame_id for entity in told["/cameras"][0].entities} == {
        "drone-3/camera",
        "drone-3/camera-2",
    }


def test_pictures_of_every_camera_are_labelled_each_by_its_own_lens_and_mounting(tmp_path):
    """One metre north and eight east: in the picture of the second camera, which looks right, not in the first's."""
    recording = recorded(tmp_path, teammate=np.array([1.0, 8.1, 0.0]))
    labels = FlightLabels([recording], Body(3.0, 1.0))
    pictures = list(labels.pictures())
    by_camera = {k: [one for one in pictures if one.camera == k] for k in (0, 1)}
    assert [len(by_camera[k]) >= 4 for k in (0, 1)] == [True, True]
    assert all(picture.labels == [] for picture in by_camera[0])
    for picture in by_camera[1]:
        (label,) = picture.labels
        assert label.drone_id == 5
        # Of a cuboid of 3 m its near face is the larger, 6.5 m away; north is left.
        left, right = (159.5 - 300.0 * side / 6.5 for side in (1.0 + 1.5, 1.0 - 1.5))
        assert label.box[0] == pytest.approx(left, abs=0.5)
        assert label.box[0] + label.box[2] == pytest.approx(right, abs=0.5)
    out = tmp_path / "data"
    assert main(["label", str(tmp_path / "rec"), "--span", "3", "--out", str(out)]) == 0
    names = {path.name.rpartition("_")[0] for path in (out / "images").iterdir()}
    assert names == {"drone-3", "drone-3_camera-2"}


def pictures_of(path: Path) -> list[np.ndarray]:
    video = cv2.VideoCapture(str(path))
    found = []
    while (read := video.read())[0]:
        found.append(read[1])
    return found


def test_a_replay_shows_the_pictures_of_all_cameras_side_by_side_with_the_boxes_of_each(tmp_path, capsys):
    recorded(tmp_path)
    whole, one = tmp_path / "whole.webm", tmp_path / "one.mp4"
    assert main(["replay", str(tmp_path / "rec"), "--video", str(whole)]) == 0
    assert f"12 pictures in {whole}" in capsys.readouterr().out
    last = pictures_of(whole)[-1]
    assert last.shape == (240, 640, 3)
    # Above the boxes and below the line at the top.
    assert last[60:80, :320].mean() == pytest.approx(40, abs=5)
    assert last[60:80, 320:].mean() == pytest.approx(100, abs=5)
    assert main(["replay", str(tmp_path / "rec"), "--video", str(one), "--camera", "2"]) == 0
    last = pictures_of(one)[-1]
    assert last.shape == (240, 320, 3)
    assert last[60:80].mean() == pytest.approx(100, abs=5)
    # Its own target is at 150, and that of the other camera at 100 is not drawn here.
    columns = np.flatnonzero((np.ptp(last[105:135].astype(int), axis=2) > 60).any(axis=0))
    assert 135 < columns.min() < columns.max() < 215


def test_of_cameras_that_a_drone_had_not_there_is_no_video(tmp_path, capsys):
    recorded(tmp_path)
    words = ["replay", str(tmp_path / "rec"), "--video", str(tmp_path / "x.mp4"), "--camera", "3"]
    assert main(words) == 2
    assert "--camera 3: expected 1 to 2" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--camera", "2"], "swarmtrack replay: --camera needs --video"),
        (["--video", "x.txt"], "swarmtrack replay: --video: x.txt: expected a name that ends in .mp4"),
        (["--video", "folder.mp4"], "swarmtrack replay: --video: folder.mp4 is a folder, expected a file"),
    ],
)
def test_what_is_wrong_with_a_video_is_said_of_the_option(tmp_path, capsys, monkeypatch, words, said):
    recorded(tmp_path)
    (tmp_path / "folder.mp4").mkdir()
    monkeypatch.chdir(tmp_path)
    assert main(["replay", "rec", *words]) == 2
    assert capsys.readouterr().err.startswith(said)


def test_eight_pictures_fit_into_one_and_each_has_its_place():
    tiles = Tiles([(640, 480)] * 8)
    for k in range(8):
        tiles.paste(k, np.full((480, 640, 3), 20 * (k + 1), np.uint8))
    height, width, _ = tiles.picture.shape
    assert width <= WIDEST_TILED_PX + 8
    assert height % 2 == width % 2 == 0
    at = [
        (tiles.picture[height // 4 + row * height // 2, width // 8 + k * width // 4, 0])
        for row in (0, 1)
        for k in range(4)
    ]
    assert at == [20 * (k + 1) for k in range(8)]


@pytest.mark.parametrize(
    ("change", "offsets"),
    [
        ("camera.2.time_offset_s=0.05", (0.0, 0.05)),
        ("camera.1.time_offset_s=0.05", (0.05, 0.01)),
        ("camera.time_offset_s=0.05", (0.05, 0.05)),
    ],
)
def test_a_replay_may_ask_what_if_one_camera_were_otherwise(tmp_path, change, offsets):
    settings, _ = read_settings(recorded(tmp_path), changes=[change])
    assert tuple(camera.time_offset_s for camera in settings.cameras) == offsets


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("camera.3.time_offset_s=0.05", r"camera\.3: expected camera\.N\.KEY with N from 1 to 2"),
        ("camera.0.time_offset_s=0.05", r"camera\.0: expected"),
        ("camera.2.offset=0.05", r"camera\[1\]\.offset: unknown key"),
    ],
)
def test_what_cannot_be_asked_of_a_camera_is_said(tmp_path, change, words):
    with pytest.raises(ConfigError, match=words):
        read_settings(recorded(tmp_path), changes=[change])


def test_a_calibration_of_fewer_cameras_than_the_config_has_is_refused(tmp_path, monkeypatch):
    recording = recorded(tmp_path)
    attached = Recording.attached

    def fewer(self, name):
        value = attached(self, name)
        return (
            {k: v for k, v in value.items() if k != "other_cameras"} if name == "calibration.json" else value
        )

    monkeypatch.setattr(Recording, "attached", fewer)
    with pytest.raises(RecordingError, match="1 cameras, the config has 2"):
        read_settings(recording)


def test_of_one_camera_nothing_is_written_that_was_not_written_before(tmp_path):
    files = {one.name: json.loads(one.data) for one in attachments(settings_of(tmp_path, ""))}
    assert set(files["calibration.json"]) == {
        *("intrinsics", "distortion", "body_from_camera", "time_offset_s", "start", "box_width")
    }
    assert isinstance(files["resolved_config.json"]["camera"], dict)
    seen = Detections(1.0, 5, np.ones((1, 2)), np.ones((1, 2)), np.ones(1))
    assert "camera" not in json.loads(inputs.encode(1, seen))
    track = Track(4, 1.0, np.ones(4), np.eye(4), TrackStatus.CONFIRMED, 0.9, np.ones(2))
    report = ScanReport(5, TrackList(1.0, 1.0, (IdentifiedTrack(track, None, 0.0),)))
    record = json.loads(outputs.encode_report(report))
    assert "camera" not in record
    assert "camera" not in record["tracks"][0]
    # As before there were several.
    assert record["digest"] == "abb5b75b8b6fb1fb"


@pytest.mark.parametrize(
    ("sources", "shown"),
    [
        (["http://pilot:hunter2@cam/x?channel=1&resize=1"], ["http://pilot@cam/x?channel=1&resize=1"]),
        (["rtsp://cam/user=admin&p=hunter2"], ["rtsp://cam/user=…"]),
        (["sim://hover-triangle?seed=1234"], ["sim://hover-triangle?seed=1234"]),
        (
            ["https://cam/x?auth=hunter2&sigma_ms=20", "https://cam/x?auth=hunter22&sigma_ms=20"],
            ["https://cam/x?auth=…&sigma_ms=20", "https://cam/x?auth=…2&sigma_ms=20"],
        ),
    ],
)
def test_no_login_of_a_camera_is_recorded_and_the_recording_is_replayed(
    tmp_path, monkeypatch, sources, shown
):
    settings = settings_of(tmp_path, *["", TURNED][: len(sources)], sources=sources)
    written = {one.name: one.data for one in attachments(settings)}
    assert b"hunter2" not in b"".join(written.values())
    for name in ("config.json", "resolved_config.json"):
        cameras = json.loads(written[name])["camera"]
        assert [camera["source"] for camera in (cameras if isinstance(cameras, list) else [cameras])] == shown
    recording = recorded(tmp_path)
    monkeypatch.setattr(Recording, "attached", lambda self, name: json.loads(written[name]))
    read, notes = read_settings(recording)
    assert ([camera.source for camera in read.config.cameras], notes) == (shown, [])


def test_inputs_and_tracks_of_another_camera_come_back_as_they_went():
    seen = Detections(1.0, 5, np.ones((1, 2)), np.ones((1, 2)), np.ones(1), camera=2)
    _, back = inputs.decode("/detections", inputs.encode(1, seen))
    assert back.camera == 2
    track = Track(4, 1.0, np.ones(4), np.eye(4), TrackStatus.CONFIRMED, 0.9, np.ones(2), camera=2)
    report = ScanReport(5, TrackList(1.0, 1.0, (IdentifiedTrack(track, None, 0.0),)), camera=1)
    read = outputs.decode_report(outputs.encode_report(report))
    assert (read.report.camera, read.report.tracks.tracks[0].track.camera) == (1, 2)
    first = TrackList(1.0, 1.0, (IdentifiedTrack(track._replace(camera=0), None, 0.0),))
    assert outputs.digest(first) != outputs.digest(report.tracks) == read.digest
