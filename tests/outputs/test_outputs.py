"""What is written for people: pixels as the camera gave them, lines that are whole, numbers that are sound."""

import io
import json
import math
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from swarmtrack.errors import SourceError
from swarmtrack.geometry.camera import PinholeCamera, RadTan
from swarmtrack.messages import (
    Frame,
    IdentifiedTrack,
    MotionProof,
    RelativeState,
    ScanReport,
    StampKind,
    Track,
    TrackList,
    TrackStatus,
)
from swarmtrack.outputs.annotated_video import MOST_REPEATED, AnnotatedVideo, annotate
from swarmtrack.outputs.console import Console
from swarmtrack.outputs.destinations import VIDEO_SUFFIXES, JsonLines, video_paths
from swarmtrack.outputs.drawing import Trails, as_seen, drawn
from swarmtrack.outputs.palette import colour_of
from swarmtrack.runtime.meters import LatencyMeter, RateMeter

PINHOLE = PinholeCamera(430.0, 430.0, 320.0, 240.0, 640, 480)
LENS = PinholeCamera(430.0, 430.0, 320.0, 240.0, 640, 480, RadTan((-0.28, 0.07, 0.001, 0.0)))


def report(t, *tracks, sequence=0):
    return ScanReport(sequence, TrackList(t, t, tracks))


def track(u, v, identity=None, size=(30.0, 20.0), status=TrackStatus.CONFIRMED, t=0.0, id=7):
    mean = np.array([u, 40.0, v, -20.0])
    cov = np.diag([4.0, 100.0, 9.0, 100.0])
    return IdentifiedTrack(Track(id, t, mean, cov, status, 0.99, np.array(size)), identity, 0.97)


def test_pixels_are_those_of_the_distorted_image():
    (seen,) = as_seen(report(0.0, track(60.0, 50.0)), LENS)
    assert LENS.undistort(seen.centre[None])[0] == pytest.approx([60.0, 50.0], abs=1e-6)
    step = 1e-4
    moved = LENS.distort(np.array([[60.0 + 40.0 * step, 50.0 - 20.0 * step]]))[0]
    assert seen.velocity == pytest.approx((moved - seen.centre) / step, rel=1e-3)


def test_a_json_line_has_no_nan_and_time_counts_from_the_first_frame(tmp_path):
    lines = JsonLines(tmp_path / "deep" / "tracks.jsonl")
    for t in (100.0, 100.5):
        scan = report(t, track(300.0, 200.0, identity=2, size=(np.nan, np.nan)), sequence=3)
        lines.write(scan, as_seen(scan, LENS))
    lines.close()
    written = [json.loads(line) for line in (tmp_path / "deep" / "tracks.jsonl").read_text().splitlines()]
    assert [line["t_s"] for line in written] == [0.0, 0.5]
    assert written[0]["tracks"][0]["w_px"] is None
    assert written[0]["tracks"][0]["identity"] == 2


WIDE = PinholeCamera(200.0, 200.0, 160.0, 120.0, 320, 240, RadTan((-0.1, 0.0, 0.0, 0.0)))


def of_two_cameras():
    """Tracks in turn of the first camera and of the second, which has just looked."""
    tracks = [track(100.0 + 20.0 * k, 90.0) for k in range(4)]
    numbered = [replace(one, track=one.track._replace(id=k, camera=k % 2)) for k, one in enumerate(tracks)]
    return ScanReport(3, TrackList(0.0, 0.0, tuple(numbered)), camera=1)


def test_each_track_is_seen_through_the_lens_of_its_own_camera():
    scan = of_two_cameras()
    seen = as_seen(scan, LENS, WIDE)
    assert [one.entry.track.id for one in seen] == [0, 1, 2, 3]
    for one in seen:
        lens = (LENS, WIDE)[one.entry.track.camera]
        assert lens.undistort(one.centre[None])[0] == pytest.approx(one.entry.track.mean[::2], abs=1e-6)


def test_a_line_of_several_cameras_says_whose_frame_and_whose_pixels_and_one_of_a_single_camera_does_not(
    tmp_path,
):
    for cameras in (1, 2):
        lines = JsonLines(tmp_path / f"{cameras}.jsonl", cameras=cameras)
        lines.write(of_two_cameras(), as_seen(of_two_cameras(), LENS, WIDE))
        lines.close()
    (several,) = [json.loads(text) for text in (tmp_path / "2.jsonl").read_text().splitlines()]
    assert several["camera"] == 1
    assert [one["camera"] for one in several["tracks"]] == [0, 1, 0, 1]
    (single,) = [json.loads(text) for text in (tmp_path / "1.jsonl").read_text().splitlines()]
    assert "camera" not in single
    assert not any("camera" in one for one in single["tracks"])


def test_each_camera_has_a_video_of_its_own():
    assert [str(path) for path in video_paths(Path("out/annotated.mp4"), 3)] == [
        "out/annotated.mp4",
        "out/annotated-2.mp4",
        "out/annotated-3.mp4",
    ]


def test_the_console_says_through_which_of_several_cameras():
    stream = io.StringIO()
    console = Console(LENS, WIDE, quiet=False, stream=stream)
    console.on_scan(of_two_cameras())
    console.line([])
    assert stream.getvalue().count("of camera 1") == 2
    assert stream.getvalue().count("of camera 2") == 2


def test_a_name_that_motion_proves_says_so_and_no_other(tmp_path):
    plain = track(300.0, 200.0, identity=2, t=100.0)
    proved = replace(plain, proof=MotionProof(0.9995, 88.0))
    lines = JsonLines(tmp_path / "tracks.jsonl")
    scan = report(100.0, plain, proved)
    lines.write(scan, as_seen(scan, LENS))
    lines.close()
    first, second = json.loads((tmp_path / "tracks.jsonl").read_text())["tracks"]
    assert "proof" not in first
    assert second["proof"] == {"probability": 0.9995, "proved_s": 12.0}


def test_a_line_says_in_metres_where_a_teammate_is_as_contract_5_has_it(tmp_path):
    cov = np.arange(36.0).reshape(6, 6)
    state = RelativeState(
        2, 100.0, np.array([8.0, -1.5, 0.5]), np.array([0.1, 0.2, -0.3]), cov + cov.T, 0.05, ("size",)
    )
    named = replace(track(300.0, 200.0, identity=2), relative=state)
    lines = JsonLines(tmp_path / "tracks.jsonl")
    scan = report(100.0, named, track(10.0, 10.0))
    lines.write(scan, as_seen(scan, LENS))
    lines.close()
    first, second = json.loads((tmp_path / "tracks.jsonl").read_text())["tracks"]
    assert second["relative"] is None
    assert first["relative"]["position_m"] == [8.0, -1.5, 0.5]
    assert first["relative"]["velocity_m_s"] == [0.1, 0.2, -0.3]
    assert first["relative"]["cov"] == [(cov + cov.T)[i, j] for i in range(6) for j in range(i, 6)]
    assert (first["relative"]["range_sigma_log"], first["relative"]["sources"]) == (0.05, ["size"])


def test_the_console_says_metres_where_they_are_known():
    stream = io.StringIO()
    console = Console(LENS, quiet=False, stream=stream)
    position = np.array([8.0, -1.5, 0.5])
    state = RelativeState(2, 0.0, position, np.zeros(3), 0.09 * np.eye(6), 0.04, ("size",))
    left = LENS.distort(np.array([[320.0 - 430.0 * math.tan(math.radians(12.0)), 240.0]]))[0]
    (ideal,) = LENS.undistort(left[None])
    console.on_scan(report(0.0, replace(track(*ideal, identity=2), relative=state)))
    console.line([])
    assert f"drone 2: {np.linalg.norm(position):.1f} m ± 0.3, 12° left" in stream.getvalue()


def test_a_full_disk_loses_lines_and_nothing_else():
    lines = JsonLines(Path("/dev/full"))
    for k in range(3):
        lines.write(report(0.1 * k), [])
    lines.close()
    assert lines.failed == 3


@pytest.mark.parametrize("name", ["annotated", "annotated.jpg", "a-file/annotated.mp4"])
def test_a_video_that_cannot_be_written_is_refused_with_a_sentence(tmp_path, name):
    (tmp_path / "a-file").touch()
    with pytest.raises(SourceError, match=r"output\.video: .*annotated.*expected"):
        AnnotatedVideo(tmp_path / name, lossless=True)


@pytest.mark.parametrize("suffix", VIDEO_SUFFIXES)
def test_a_video_can_be_read_back_in_every_container_we_accept(tmp_path, suffix):
    path = tmp_path / f"annotated{suffix}"
    video = AnnotatedVideo(path, lossless=True)
    for k in range(3):
        video.add_frame(frame(k, 0.1 * k))
        video.write(report(0.1 * k, sequence=k), [])
    video.close()
    assert cv2.VideoCapture(str(path)).read()[0]


def frame(sequence, t):
    return Frame(t, 0.0, sequence, np.zeros((480, 640), np.uint8), StampKind.MEDIA)


def test_a_track_far_outside_or_without_a_size_is_drawn_without_complaint():
    everything = [
        track(320.0, 240.0, size=(np.nan, np.nan)),
        track(-500.0, 90.0, "foreign"),
        track(300.0, 90.0, 3),
    ]
    image = annotate(frame(0, 0.0), 0.0, drawn(as_seen(report(0.0, *everything), LENS)))
    assert image.shape == (480, 640, 3)
    assert image.any()


def test_a_name_is_readable_wherever_the_drone_is():
    for u, v in [(300.0, 12.0), (630.0, 200.0), (5.0, 300.0)]:
        scan = report(0.0, track(u, v, identity=2))
        named = annotate(frame(0, 0.0), 0.0, drawn(as_seen(scan, PINHOLE)))
        unnamed = annotate(frame(0, 0.0), 0.0, [])
        # The box takes 30 x 20 px and the arrow 10 more: what is coloured beyond them is the name.
        coloured = (named != unnamed).any(axis=2)
        coloured[max(0, int(v) - 16) : int(v) + 17, max(0, int(u) - 21) : int(u) + 22] = False
        assert coloured.sum() > 300, (u, v)


def placed(seen, distance: float):
    state = RelativeState(
        2, 0.0, np.array([0.6, 0.0, -0.8]) * distance, np.zeros(3), 0.09 * np.eye(6), 0.04, ("size",)
    )
    return replace(seen, relative=state)


def test_the_name_in_the_video_says_how_far_its_drone_is():
    near, far = placed(track(320.0, 240.0, identity=2), 8.4), placed(track(320.0, 240.0, identity=2), 123.0)
    lost = placed(track(320.0, 240.0, identity=2, status=TrackStatus.LOST), 8.4)
    labels = [one.label for one in drawn(as_seen(report(0.0, near, far, lost), LENS))]
    assert labels == ["drone 2 8.4 m", "drone 2 123.0 m", "drone 2 8.4 m (lost)"]
    images = [annotate(frame(0, 0.0), 0.0, drawn(as_seen(report(0.0, one), LENS))) for one in (near, far)]
    assert (images[0] != images[1]).any()


def test_who_has_no_place_has_its_name_alone():
    entries = [track(320.0, 240.0, identity=2), track(320.0, 240.0), track(320.0, 240.0, identity="foreign")]
    assert [one.label for one in drawn(as_seen(report(0.0, *entries), LENS))] == [
        "drone 2",
        "track 7",
        "stranger, track 7",
    ]


def frames_of(path, times):
    """How many frames a video has whose camera exposed at these times [s]; its rate is that of the first two."""
    video = AnnotatedVideo(path, lossless=True)
    for k, t in enumerate(times):
        video.add_frame(frame(k, t))
        video.write(report(t, sequence=k), [])
    video.close()
    capture, n = cv2.VideoCapture(str(path)), 0
    while capture.read()[0]:
        n += 1
    return n


def test_frames_stand_at_their_own_times_and_one_lasts_until_the_next(tmp_path):
    assert frames_of(tmp_path / "even.webm", [5.0, 5.1, 5.2, 5.3]) == 4
    assert frames_of(tmp_path / "slow.webm", [5.0, 5.1, 5.5, 5.6]) == 7
    assert frames_of(tmp_path / "quick.webm", [5.0, 5.1, 5.12, 5.14, 5.2]) == 3
    # Nobody wants to watch a stall of an hour.
    assert frames_of(tmp_path / "stall.webm", [0.0, 0.1, 3600.0, 3600.1]) == 2 + MOST_REPEATED + 2


def test_without_a_team_each_track_has_a_colour_and_a_way_of_its_own():
    def picture(*, alone):
        trails, image = Trails(), None
        for k in range(5):
            seen = as_seen(report(0.2 * k, track(300.0 + 30.0 * k, 200.0)), PINHOLE)
            image = annotate(frame(k, 0.2 * k), 0.2 * k, drawn(seen, alone=alone), trails)
        return image

    with_team, alone = picture(alone=False), picture(alone=True)
    assert (alone[200, 310:390].max(axis=1) > 0).sum() > 60  # where it came from
    assert len({tuple(pixel) for pixel in alone[200, 320:380] if pixel.any()}) > 0
    assert tuple(alone[190, 420]) == tuple(reversed(colour_of(7)))  # the edge of its box
    assert tuple(with_team[190, 420]) != tuple(alone[190, 420])


def test_a_video_of_a_single_frame_is_still_a_video(tmp_path):
    video = AnnotatedVideo(tmp_path / "one.mp4", lossless=True)
    video.add_frame(frame(0, 1.0))
    video.write(report(1.0, sequence=0), [])
    video.write(report(1.1, sequence=9), [])  # its frame is gone
    video.close()
    assert cv2.VideoCapture(str(tmp_path / "one.mp4")).read()[0]
    assert video.dropped == 1


def test_the_console_tells_who_is_seen_and_sums_up():
    stream = io.StringIO()
    console = Console(LENS, quiet=False, stream=stream)
    console.line(["camera 0 Hz"])
    for k in range(4):
        scan = report(10.0 + 0.5 * k, track(320.0, 240.0, identity=2 if k else None))
        console.on_scan(scan)
    console.line(["gyro 200 Hz"])
    console.line(["camera 0 Hz"])
    console.summary(["one fact"])
    text = stream.getvalue()
    assert "sees drone 2 at (320, 240) ± 3.0 px   (gyro 200 Hz)" in text
    assert text.startswith("           no frame yet   (camera 0 Hz)")
    assert "    1.5 s  no frame since   (camera 0 Hz)" in text  # not where somebody was seen before it
    assert "drone 2    in  75 % of scans, first at 0.5 s, as 1 track" in text
    assert "one fact" in text


def test_the_summary_counts_tracks_and_not_their_turns():
    stream = io.StringIO()
    console = Console(LENS, quiet=False, stream=stream)
    for k in range(4):
        console.on_scan(report(0.5 * k, track(100.0, 240.0, id=3), track(320.0, 240.0, id=4)))
    console.summary([])
    assert "in 100 % of scans, first at 0.0 s, as 2 tracks" in stream.getvalue()


def test_a_console_that_nobody_reads_any_more_falls_silent():
    reader, writer = os.pipe()
    stream = os.fdopen(writer, "w")
    console = Console(LENS, quiet=False, stream=stream)
    console.line(["still read"])
    os.close(reader)
    console.line(["not read"])
    console.summary(["nor this"])
    assert stream.closed


def test_meters_tell_rates_and_spreads():
    rate, latency = RateMeter(), LatencyMeter()
    rate.read(10.0)
    rate.tick(30)
    assert rate.read(12.0) == pytest.approx(15.0)
    assert latency.read() is None
    for k in range(101):
        latency.add(0.01 * k)
    assert latency.read() == pytest.approx((0.5, 0.95, 1.0))
