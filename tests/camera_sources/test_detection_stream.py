"""A camera that detects by itself: lines of JSON over HTTP, from a small server that sends what it should not, too."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import AsyncIterator, Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from support.patience import PATIENCE
from support.places import ROOT
from support.streams import (
    Script,
    Send,
    StreamServer,
    assert_two_are_stamped,
    counters,
    first,
    hang_up,
    nothing_comes_but,
    sending,
    stream_server,
)
from swarmtrack.camera_sources.address import parse_address
from swarmtrack.camera_sources.detection_stream import BadLine, DetectionStream, LineReader, parse_line
from swarmtrack.camera_sources.limits import MAX_DETECTION_LINE_BYTES, MAX_STREAMED_DETECTIONS
from swarmtrack.clock import SystemClock
from swarmtrack.config.drone import load_config
from swarmtrack.errors import ConfigError, SourceError
from swarmtrack.runtime.assembly import assemble
from swarmtrack.sources import DetectionSource

BOX = [320.5, 240.0, 31.0, 18.5, 0.87]


def line(t_s: float | None = None, sequence: int | None = None, *detections: list[float]) -> bytes:
    return json.dumps({"t_s": t_s, "sequence": sequence, "detections": detections}).encode() + b"\n"


@pytest.fixture
async def server() -> AsyncIterator[StreamServer]:
    async with stream_server("/front", "application/x-ndjson") as server:
        server.url = server.url.replace("http:", "detections:")
        yield server


def open_stream(address: str) -> DetectionStream:
    return DetectionStream(parse_address(address), clock=SystemClock())


async def test_a_line_is_a_scan_and_an_empty_one_says_that_nobody_was_seen(server: StreamServer) -> None:
    source = open_stream(server.url)
    lines = (line(None, 7, BOX), line(None, 8) + b"\n", line(None, 10, BOX, BOX))
    server.script = sending(*lines, source=source)
    seen, empty, last = await first(3, source.detections())
    np.testing.assert_array_equal(seen.centre, [[320.5, 240.0]])
    np.testing.assert_array_equal(seen.size, [[31.0, 18.5]])
    np.testing.assert_array_equal(seen.score, [0.87])
    assert (len(empty), len(last)) == (0, 2)
    assert [seen.sequence, empty.sequence, last.sequence] == [7, 8, 10]
    assert counters(source)["lost"] == 1
    assert source.status().ok
    await source.close()


async def test_a_stamp_is_exposure_on_our_clock_or_in_utc_and_else_the_arrival_counts(
    server: StreamServer,
) -> None:
    clock = SystemClock()
    now, utc = clock.now(), clock.utc()
    stamps = [now - 0.3, utc - 0.3, None, now - 3600.0, now + 30.0]
    source = open_stream(server.url + "?latency_ms=40")
    server.script = sending(*(line(stamp) for stamp in stamps), source=source)
    taken = await first(len(stamps), source.detections())
    assert_two_are_stamped([detections.t for detections in taken], now, after=clock.now())
    assert counters(source)["bad_stamps"] == 2
    await source.close()


BAD_LINES = [
    b"no json",
    b"[1, 2]",
    b'{"detections": [[1, 2, 3]]}',
    b'{"detections": [[1, 2, 3, 4, NaN]]}',
    b'{"detections": [[1e999, 2, 3, 4, 0.5]]}',
    b'{"detections": [[1, 2, -3, 4, 0.5]]}',
    b'{"detections": [[1, 2, 3, 4, 1.5]]}',
    b'{"detections": 7}',
    b'{"t_s": "now", "detections": []}',
    b'{"sequence": -1, "detections": []}',
    b'{"t_s": 1.0}',
    b"\xff\xfe{}",
    b"[" * 5000,
    b'{"detections": ' + b" " * MAX_DETECTION_LINE_BYTES + b"[]}",
]


async def test_bad_lines_are_counted_and_named_and_the_next_good_one_is_used(server: StreamServer) -> None:
    server.script = sending(*(bad + b"\n" for bad in BAD_LINES), line(None, 1, BOX))
    source = open_stream(server.url)
    assert len((await first(1, source.detections()))[0]) == 1
    assert counters(source)["corrupt"] == len(BAD_LINES)
    assert source.status().ok
    await source.close()


async def test_a_source_that_sends_only_garbage_says_what_was_found_and_expected(
    server: StreamServer,
) -> None:
    server.script = sending(b'{"detections": [[1, 2, -3, 4, 0.5]]}\n')
    source = open_stream(server.url)
    await nothing_comes_but("expected u, v, w >= 0", source, source.detections())


async def test_of_too_many_detections_the_best_are_kept(server: StreamServer) -> None:
    scores = np.linspace(0.0, 1.0, 3 * MAX_STREAMED_DETECTIONS)
    server.script = sending(line(None, 1, *([1.0, 2.0, 3.0, 4.0, float(score)] for score in scores)))
    source = open_stream(server.url)
    (detections,) = await first(1, source.detections())
    np.testing.assert_allclose(np.sort(detections.score), scores[-MAX_STREAMED_DETECTIONS:])
    await source.close()


async def test_a_slow_consumer_gets_the_newest_and_what_it_missed_is_counted(server: StreamServer) -> None:
    taken = asyncio.Event()

    async def script(send: Send) -> None:
        await send(line(None, 1))
        await taken.wait()
        for sequence in range(2, 20):
            await send(line(None, sequence))
        await asyncio.Event().wait()

    server.script = script
    source = open_stream(server.url)
    scans = source.detections()
    async with asyncio.timeout(PATIENCE):
        await anext(scans)
        taken.set()
        while counters(source)["dropped"] < 17:  # noqa: ASYNC110
            await asyncio.sleep(0.01)
        assert (await anext(scans)).sequence == 19
    await source.close()


async def test_a_source_that_hangs_up_is_asked_again_and_may_count_from_the_start(
    server: StreamServer,
) -> None:
    server.script = sending(line(None, 5), then=hang_up)
    source = open_stream(server.url)
    one, other = await first(2, source.detections())
    assert (one.sequence, other.sequence) == (5, 5)
    assert server.connections == 2
    assert (counters(source)["reconnects"], counters(source)["lost"]) == (1, 0)
    await source.close()


@pytest.mark.parametrize(
    ("status", "content_type", "sentence"),
    [
        (404, "text/plain", "HTTP 404 Not Found: check the path"),
        (200, "multipart/x-mixed-replace; boundary=frame", "expected a stream of JSON lines"),
    ],
)
async def test_what_is_no_such_stream_is_said(
    server: StreamServer, status: int, content_type: str, sentence: str
) -> None:
    server.status, server.content_type = status, content_type
    source = open_stream(server.url)
    await nothing_comes_but(sentence, source, source.detections())


@pytest.mark.parametrize("address", ["detections:///front", "detections://host:port/x"])
def test_an_address_that_can_never_work_is_refused(address: str) -> None:
    with pytest.raises(SourceError):
        open_stream(address)


# The lines alone --------------------------------------------------------------------------------------------------


def read(stream: bytes, cuts: list[int]) -> list[bytes | None]:
    reader, lines = LineReader(), []
    places = sorted({min(cut, len(stream)) for cut in cuts} | {0, len(stream)})
    for start, end in pairwise(places):
        lines += reader.feed(stream[start:end])
    return lines


@given(
    st.lists(st.binary(min_size=1, max_size=50).filter(lambda b: b.strip() and b"\n" not in b)),
    st.lists(st.integers(0, 3000)),
)
def test_how_the_stream_is_cut_into_packets_does_not_matter(lines: list[bytes], cuts: list[int]) -> None:
    assert read(b"".join(text + b"\n" for text in lines), cuts) == lines


@given(
    st.integers(MAX_DETECTION_LINE_BYTES + 1, 4 * MAX_DETECTION_LINE_BYTES),
    st.lists(st.integers(0, 4 * MAX_DETECTION_LINE_BYTES), max_size=9),
)
def test_a_line_too_long_is_told_once_and_the_next_is_whole(length: int, cuts: list[int]) -> None:
    assert read(b"x" * length + b"\n" + b"next\n", cuts) == [None, b"next"]


@given(st.lists(st.binary(max_size=3000)))
def test_no_bytes_whatever_make_the_reader_raise_or_grow(chunks: list[bytes]) -> None:
    reader = LineReader()
    for chunk in chunks:
        for found in reader.feed(chunk.replace(b"\n", b" ") * 40):
            assert found is None
    assert len(reader.feed(b"\nend\n")) <= 2


NUMBERS = st.floats(allow_nan=True, allow_infinity=True) | st.integers() | st.none() | st.text(max_size=3)


@given(
    st.binary(max_size=200)
    | st.builds(
        lambda t, n, rows: json.dumps({"t_s": t, "sequence": n, "detections": rows}).encode(),
        NUMBERS,
        NUMBERS,
        st.lists(st.lists(NUMBERS, max_size=6), max_size=4),
    )
)
def test_whatever_is_sent_is_refused_or_finite(text: bytes) -> None:
    try:
        sent = parse_line(text)
    except BadLine:
        return
    for u, v, w, h, score in sent.detections:
        assert np.isfinite([u, v, w, h]).all()
        assert min(w, h) >= 0.0
        assert 0.0 <= score <= 1.0


# The agent that has one -------------------------------------------------------------------------------------------

AGENT = """
import sys
from swarmtrack.agents.vehicle import main
code = main(sys.argv[1:])
print("loaded:", sorted({"cv2", "onnxruntime"} & set(sys.modules)))
sys.exit(code)
"""


def config(folder: Path, address: str, more: str = "") -> Path:
    path = folder / "drone.toml"
    path.write_text(
        f'drone.id = 1\nnetwork.transport = "memory"\n[camera]\nsource = "{address}"\n'
        "intrinsics = { fx = 430.0, fy = 430.0, cx = 319.5, cy = 239.5, width = 640, height = 480 }\n" + more,
        encoding="utf-8",
    )
    return path


async def fly(path: Path, *options: str) -> tuple[str, str]:
    """Output and log of an agent in a process of its own, which must end well."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", AGENT, "--config", str(path), *options),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        cwd=ROOT,
    )
    out, err = await asyncio.wait_for(process.communicate(), PATIENCE)
    assert process.returncode == 0, err.decode()
    return out.decode(), err.decode()


def at_20_hz(age_s: float, box: Callable[[int], list[float]]) -> Script:
    """A line each 50 ms, sent so long after its exposure; box(k): what is in frame k."""

    async def script(send: Send) -> None:
        clock = SystemClock()
        for sequence in range(100_000):
            await send(line(clock.now() - age_s, sequence, box(sequence)))
            await asyncio.sleep(0.05)

    return script


async def test_an_agent_tracks_what_the_camera_detected_without_opencv_and_onnx_runtime(
    server: StreamServer, tmp_path: Path
) -> None:
    server.script = at_20_hz(0.02, lambda k: [(300.0 + 0.5 * k) % 600.0, 240.0, 30.0, 20.0, 0.9])
    path = config(tmp_path, server.url, f'[output]\njsonl = "{tmp_path}/tracks.jsonl"\n')
    out, _ = await fly(path, "--seconds", "4")
    assert "loaded: []" in out
    lines = [json.loads(text) for text in (tmp_path / "tracks.jsonl").read_text().splitlines()]
    (track,) = lines[-1]["tracks"]
    assert track["status"] == "confirmed"
    assert track["v_px"] == pytest.approx(240.0, abs=2.0)


async def test_detections_too_old_to_be_used_are_skipped_and_it_is_said_once(
    server: StreamServer, tmp_path: Path
) -> None:
    server.script = at_20_hz(0.4, lambda k: BOX)
    path = config(tmp_path, server.url, f'max_age_s = 0.3\n[output]\njsonl = "{tmp_path}/tracks.jsonl"\n')
    _, log = await fly(path, "--seconds", "3")
    assert (tmp_path / "tracks.jsonl").read_text() == ""
    assert log.count("expected camera.max_age_s = 0.3") == 1


async def test_check_says_that_there_is_no_detector(tmp_path: Path) -> None:
    out, _ = await fly(config(tmp_path, "detections://127.0.0.1:8091/front"), "--check")
    assert "none: the camera detects by itself" in out
    assert "loaded: []" in out


def test_a_video_is_refused_where_no_pictures_come(tmp_path: Path) -> None:
    path = config(tmp_path, "detections://127.0.0.1:8091/front", '[output]\nvideo = "seen.mp4"\n')
    with pytest.raises(ConfigError, match=r"output\.video: found seen\.mp4, expected no video"):
        assemble(load_config(path), SystemClock())


def test_the_example_is_valid() -> None:
    parts = assemble(load_config(ROOT / "configs" / "smart-camera.toml"), SystemClock())
    assert isinstance(parts.camera, DetectionSource)
    assert parts.detector is None
