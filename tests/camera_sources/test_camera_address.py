"""What is written in `camera.source`, and what is said about what is written wrongly."""

from __future__ import annotations

import asyncio
import contextlib
import math
import threading
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from swarmtrack.camera_sources.address import parse_address, server_url
from swarmtrack.camera_sources.http_stream import NetworkOptions
from swarmtrack.camera_sources.opening import CAMERA_SOURCES, open_camera
from swarmtrack.clock import ManualClock
from swarmtrack.errors import SourceError


@pytest.mark.parametrize(
    ("source", "normal"),
    [
        ("0", "v4l2:///dev/video0"),
        ("/dev/video2", "v4l2:///dev/video2"),
        ("/dev/v4l/by-id/usb-cam-index0?fps=60", "v4l2:///dev/v4l/by-id/usb-cam-index0?fps=60"),
        ("file:clips/a.mp4", "file://clips/a.mp4"),
        ("images:///flights/1?pattern=*.png", "images:///flights/1?pattern=*.png"),
        ("HTTP://cam:8080/stream", "http://cam:8080/stream"),
        ("rtsp://pilot:secret@cam/live?channel=1", "rtsp://pilot@cam/live?channel=1"),
    ],
)
def test_an_address_has_one_normal_form_without_its_password(source: str, normal: str) -> None:
    assert str(parse_address(source)) == normal


@pytest.mark.parametrize(
    ("source", "sentence"),
    [
        ("v4l3:///dev/video0", 'unknown scheme "v4l3", did you mean "v4l2"?'),
        ("clip.mp4", "file://clip.mp4"),
        ("v4l2:///dev/video0?widht=640", 'unknown option "widht", did you mean "width"?'),
        ("v4l2:///dev/video0?fps=fast", 'fps: found "fast", expected a number'),
        ("v4l2:///dev/video0?fps=nan", "fps: found nan, expected 0.1"),
        ("v4l2:///dev/video0?width=640", "width and height are given together"),
        ("v4l2:///dev/video0?fourcc=H264", 'fourcc: found "H264"'),
        ("v4l2:///dev/video0?fps=30&fps=60", "fps: given twice"),
        ("v4l2://video0", "expected a device"),
        ("file:///a.mp4?pace=quick", 'pace: found "quick"'),
        ("http:///stream", "no host"),
        ("rtsp://pilot:secret@cam..local/live", 'found host "cam..local"'),
        ("rtsp://pilot:secret@cam:70000/live", "found a port that is no number from 0 to 65535"),
        ("http://cam/stream?sigma_ms=-1", "sigma_ms: found -1.0, expected 0.1"),
        ("", "expected SCHEME://"),
    ],
)
def test_an_address_that_can_never_work_is_refused_with_what_was_found_and_expected(
    source: str, sentence: str
) -> None:
    with pytest.raises(SourceError) as error:
        open_camera(source, clock=ManualClock())
    assert sentence in str(error.value)
    assert "secret" not in str(error.value)


@given(
    st.one_of(
        st.text(), st.builds("{}:{}?{}".format, st.sampled_from(sorted(CAMERA_SOURCES)), st.text(), st.text())
    )
)
@example("file:" + 300 * "0")  # longer than a name may be: `Path.exists` raises OSError
@example("images:" + 300 * "0")
@example("FILE:~0")  # no such user
def test_no_text_whatever_makes_anything_but_a_camera_or_a_sentence(source: str) -> None:
    with contextlib.suppress(SourceError):
        assert not open_camera(source, clock=ManualClock()).status().ok


def test_options_of_ours_are_taken_out_of_a_url_and_the_servers_own_are_sent_on() -> None:
    address = parse_address("http://cam/video?resolution=640x480&resize=1&sigma_ms=20")
    assert server_url(address, NetworkOptions) == "http://cam/video?resolution=640x480"


@pytest.mark.parametrize("source", ["v4l2:///dev/video99", "http://127.0.0.1:9/", "rtsp://127.0.0.1:9/"])
async def test_a_closed_camera_stays_closed(source: str) -> None:
    threads = threading.enumerate()
    camera = open_camera(source, clock=ManualClock())
    await camera.close()
    assert [frame async for frame in camera.frames()] == []
    assert asyncio.all_tasks() == {asyncio.current_task()}
    assert threading.enumerate() == threads


@pytest.mark.parametrize("source", ["v4l2:///dev/video99", "http://127.0.0.1:9/", "rtsp://127.0.0.1:9/"])
def test_the_numbers_of_a_camera_that_never_gave_a_frame_are_finite(source: str) -> None:
    status = open_camera(source, clock=ManualClock()).status()
    assert not status.ok
    assert all(math.isfinite(value) for _, value in status.counters)


def test_relative_files_start_from_the_folder_of_the_config(tmp_path: Path) -> None:
    assert parse_address("file://clips/a%20b.mp4").path(tmp_path) == tmp_path / "clips" / "a b.mp4"
    assert parse_address("file:///clips/a.mp4").path(tmp_path) == Path("/clips/a.mp4")
