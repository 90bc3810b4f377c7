"""A real agent with two cameras: what goes over from one to the other, what is recorded, what a fault of one costs."""

from __future__ import annotations

import asyncio
import functools
import json
import math
import os
import re
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from support.drone_on_the_bench import Server
from support.patience import PATIENCE
from support.places import ROOT
from support.streams import Script, Send, StreamServer, stream_server
from swarmtrack.clock import SystemClock
from swarmtrack.config.drone import load_config
from swarmtrack.diagnosis.findings import Level
from swarmtrack.doctor.examination import examine
from swarmtrack.recording.reader import recordings_below
from swarmtrack.recording.settings import read_settings
from swarmtrack.replay.replayer import Replayer

# px: of 100° across 640.
FOCAL = 268.5
YAWS = (-45.0, 45.0)
FPS = 15.0

Bearings = Callable[[float], list[float]]
"""Of the targets, degrees clockwise from the nose, so many seconds after the start."""


def camera(source: str, yaw_deg: float, more: str = "") -> str:
    return (
        f'[[camera]]\nsource = "{source}"\n'
        f"intrinsics = {{ fx = {FOCAL}, fy = {FOCAL}, cx = 319.5, cy = 239.5, width = 640, height = 480 }}\n"
        f"body_from_camera = {{ rpy_deg = [0.0, 0.0, {yaw_deg}] }}\nmounting_sigma_deg = 0.5\nmax_age_s = 5.0\n{more}"
    )


def seen_by(yaw_deg: float, bearings: Bearings, began: Callable[[], float], frames: int = 10**6) -> Script:
    """What a camera sees that detects by itself, frame after frame; then it stalls, whoever connects again."""
    sequences = iter(range(frames))

    async def script(send: Send) -> None:
        clock = SystemClock()
        for sequence in sequences:
            t = clock.now()
            boxes = []
            for bearing in bearings(t - began()):
                aside = math.radians(bearing - yaw_deg)
                u = 319.5 + FOCAL * math.tan(aside)
                if abs(aside) < 1.5 and 0.0 <= u <= 639.0:
                    boxes.append([u, 239.5, 24.0, 14.0, 0.95])
            line = {"t_s": t, "sequence": sequence, "detections": boxes}
            await send(json.dumps(line).encode() + b"\n")
            await asyncio.sleep(1.0 / FPS)
        await asyncio.Event().wait()

    return script


def first_asked() -> Callable[[], float]:
    """The time of its first call: an agent starts when the machine lets it."""
    return functools.cache(SystemClock().now)


async def fly(path: Path, *options: str) -> tuple[str, str]:
    """Output and log of an agent in a process of its own, which must end well."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "swarmtrack.agents.vehicle", "--config", str(path), *options),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    out, err = await asyncio.wait_for(process.communicate(), PATIENCE)
    assert process.returncode == 0, err.decode()
    return out.decode(), err.decode()


def lines_of(path: Path) -> list[dict[str, Any]]:
    return [json.loads(text) for text in path.read_text().splitlines()]


@pytest.fixture
async def servers() -> AsyncIterator[list[StreamServer]]:
    async with AsyncExitStack() as stack:
        both = [
            await stack.enter_async_context(stream_server(f"/{side}", "application/x-ndjson"))
            for side in ("left", "right")
        ]
        for server in both:
            server.url = server.url.replace("http:", "detections:")
        yield both


def config(folder: Path, servers: list[StreamServer], more: str = "") -> Path:
    path = folder / "drone.toml"
    tables = "".join(camera(server.url, yaw) for server, yaw in zip(servers, YAWS, strict=True))
    path.write_text(
        'drone.id = 1\nnetwork.transport = "memory"\n'
        f'[output]\njsonl = "{folder}/tracks.jsonl"\n'
        f'[recording]\ndir = "{folder}/rec"\n{tables}{more}'
    )
    return path


async def test_a_target_keeps_its_track_from_one_camera_to_the_other_in_flight_and_in_a_replay(
    servers, tmp_path
):
    def bearings(t: float) -> list[float]:
        # One to and fro across the seam, 6 s there; the other stays with the right camera.
        return [35.0 * math.sin(2.0 * math.pi * t / 12.0), 70.0]

    began = first_asked()
    for server, yaw in zip(servers, YAWS, strict=True):
        server.script = seen_by(yaw, bearings, began)
    out, _ = await fly(config(tmp_path, servers), "--seconds", "9")
    lines = lines_of(tmp_path / "tracks.jsonl")
    assert {line["camera"] for line in lines} == {0, 1}
    cameras: dict[int, set[int]] = {}
    for line in lines[len(lines) // 4 :]:
        for track in line["tracks"]:
            if track["status"] == "confirmed":
                cameras.setdefault(track["id"], set()).add(track["camera"])
    assert sorted(map(sorted, cameras.values())) == [[0, 1], [1]]
    (one_that_moves,) = (number for number, seen in cameras.items() if seen == {0, 1})
    for line in lines[len(lines) // 4 :]:
        for track in line["tracks"]:
            if track["id"] == one_that_moves and track["camera"] == line["camera"]:
                assert -40.0 <= track["u_px"] <= 680.0
    assert "of camera 2" in out
    assert re.search(r"cameras \d+ \+ \d+ Hz", out)

    (recording,) = recordings_below(tmp_path / "rec")
    settings, _ = read_settings(recording)
    assert [
        round(math.degrees(math.atan2(*one.body_from_camera.rotation[1::-1, 2]))) for one in settings.cameras
    ] == [
        -45,
        45,
    ]
    replayed = Replayer(recording, settings, every_answer=True).run()
    assert replayed.exact
    assert replayed.refused == 0
    assert {scan.camera for scan in replayed.scans} == {0, 1}
    assert {
        entry.track.camera
        for scan in replayed.recorded_scans
        for entry in scan.tracks.tracks
        if entry.track.id == one_that_moves
    } == {0, 1}


async def test_a_camera_that_stalls_holds_up_no_other_its_tracks_end_and_it_is_named_in_the_health(
    servers, tmp_path
):
    began = first_asked()
    servers[0].script = seen_by(YAWS[0], lambda t: [-40.0], began, frames=30)
    servers[1].script = seen_by(YAWS[1], lambda t: [40.0], began)
    await fly(config(tmp_path, servers), "--seconds", "8")
    lines = lines_of(tmp_path / "tracks.jsonl")
    looked = max(line["t_s"] for line in lines if line["camera"] == 0)
    shown = [
        line["t_s"]
        for line in lines
        for track in line["tracks"]
        if track["camera"] == 0 and track["status"] == "confirmed"
    ]
    # As long as a track coasts; on it goes with the other camera.
    assert looked < max(shown) < looked + 1.2
    assert lines[-1]["t_s"] > looked + 3.0
    assert {line["camera"] for line in lines} <= {0, 1}
    assert len([line for line in lines if line["camera"] == 1]) > 20
    assert any(track["status"] == "confirmed" for line in lines for track in line["tracks"])
    (recording,) = recordings_below(tmp_path / "rec")
    health = [json.loads(message.data) for message in recording.messages({"/health"})][-1]
    links = {link["name"]: link for link in health["links"]}
    assert {"camera 1", "camera 2"} <= set(links)
    assert links["camera 2"]["counters"]["frames"] > 20
    assert links["camera 2"]["counters"]["stale_frames"] == 0
    assert links["camera 2"]["counters"]["time_offset_used_s"] == 0.0
    assert health["rates"]["detections_2"]["got_hz"] > 1.0
    assert health["rates"]["detections_1"]["got_hz"] == 0.0
    assert any(reason.startswith("camera 1: ") for reason in health["readiness"]["reasons"])
    assert not any(reason.startswith("camera 2: ") for reason in health["readiness"]["reasons"])


def folder_of(folder: Path, count: int) -> Path:
    folder.mkdir()
    rng = np.random.default_rng(count)
    for k in range(count):
        cv2.imwrite(str(folder / f"{k:03}.png"), rng.integers(90, 110, (480, 640, 3), dtype=np.uint8))
    return folder


async def test_recordings_of_two_cameras_are_seen_frame_by_frame_in_the_order_of_their_exposures(tmp_path):
    left, right = folder_of(tmp_path / "left", 12), folder_of(tmp_path / "right", 5)
    path = tmp_path / "drone.toml"
    path.write_text(
        'drone.id = 1\nnetwork.transport = "memory"\n'
        f'[output]\njsonl = "{tmp_path}/tracks.jsonl"\nvideo = "{tmp_path}/annotated.mp4"\n'
        f'[recording]\ndir = "{tmp_path}/rec"\nframes = "jpeg"\nframes_hz = 1000\n'
        + camera(f"images://{left}?fps=10&pace=fast", -45.0)
        + camera(f"images://{right}?fps=4&pace=fast", 45.0)
    )
    await fly(path)
    lines = lines_of(tmp_path / "tracks.jsonl")
    seen = [(line["camera"], line["frame"]) for line in lines]
    order = sorted([(k / 10.0, 0, k) for k in range(12)] + [(k / 4.0, 1, k) for k in range(5)])
    assert seen == [(camera, frame) for _, camera, frame in order]
    for name, count in (("annotated.mp4", 12), ("annotated-2.mp4", 5)):
        video = cv2.VideoCapture(str(tmp_path / name))
        assert video.get(cv2.CAP_PROP_FRAME_COUNT) == count
    (recording,) = recordings_below(tmp_path / "rec")
    topics = [message.topic for message in recording.messages({"/camera/image", "/camera/2/image"})]
    assert (topics.count("/camera/image"), topics.count("/camera/2/image")) == (12, 5)
    settings, _ = read_settings(recording)
    assert Replayer(recording, settings).run().exact


def lively(t: float) -> np.ndarray:
    return np.random.default_rng(int(10 * t)).integers(0, 255, (120, 160, 3), dtype=np.uint8)


def small_camera(source: str, yaw_deg: float) -> str:
    return (
        f'[[camera]]\nsource = "{source}"\nmax_age_s = 5.0\n'
        "intrinsics = { fx = 80.0, fy = 80.0, cx = 79.5, cy = 59.5, width = 160, height = 120 }\n"
        f"body_from_camera = {{ rpy_deg = [0.0, 0.0, {yaw_deg}] }}\n"
    )


async def test_live_pictures_go_through_one_detector_in_turn_and_a_silent_camera_holds_up_no_other(
    tmp_path,
):
    path = tmp_path / "drone.toml"
    async with (
        Server(lively, fps=20.0) as left,
        Server(lively, fps=20.0) as right,
        Server(lambda t: None) as silent,
    ):
        path.write_text(
            f'drone.id = 1\nnetwork.transport = "memory"\n[output]\njsonl = "{tmp_path}/tracks.jsonl"\n'
            + small_camera(left.url, -60.0)
            + small_camera(silent.url, 0.0)
            + small_camera(right.url, 60.0)
        )
        out, _ = await fly(path, "--seconds", "6")
    lines = lines_of(tmp_path / "tracks.jsonl")
    count = {camera: sum(line["camera"] == camera for line in lines) for camera in (0, 1, 2)}
    assert count[1] == 0
    assert min(count[0], count[2]) > 5
    # Each has its share, whatever this machine can do.
    assert max(count[0], count[2]) < 2 * min(count[0], count[2])
    assert "camera 2: " in out


async def test_doctor_looks_at_each_camera_and_says_which_one_is_wrong(tmp_path):
    path = tmp_path / "drone.toml"
    capped = Server(lambda t: np.full((120, 160, 3), 4, np.uint8))
    async with Server(lively) as good, capped:
        path.write_text(
            'drone.id = 1\nnetwork.transport = "memory"\n'
            + small_camera(good.url, 0.0)
            + small_camera(capped.url, 180.0)
            + '[[camera]]\nsource = "http://127.0.0.1:9/x"\ncalibration = "none.yaml"\n'
        )
        findings = await examine(load_config(path), SystemClock(), 3.0)
    by_check = {finding.check: finding for finding in findings}
    assert by_check["camera 1"].level is Level.OK, by_check["camera 1"]
    assert [finding.fault for finding in findings if finding.check == "camera 2"] == ["camera.blank"]
    assert by_check["camera 3"].level is Level.SKIPPED
    assert by_check["calibration 3"].fault == "calibration.unreadable"
    # One of several may well look back.
    assert by_check["mount 2"].level is Level.OK
    assert {"motion 1", "motion 2", "motion 3", "detector", "network"} <= set(by_check)


async def test_check_says_of_each_camera_where_it_looks(tmp_path, servers):
    out, _ = await fly(config(tmp_path, servers), "--check")
    found = re.findall(r"^(camera \d|looks) +(.*)$", out, re.MULTILINE)
    assert found == [
        ("camera 1", servers[0].url),
        ("looks", "-45° from the nose, clockwise, +0° up, known to 0.5°"),
        ("camera 2", servers[1].url),
        ("looks", "+45° from the nose, clockwise, +0° up, known to 0.5°"),
    ]
