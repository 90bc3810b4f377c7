"""MJPEG over HTTP, from a small server that sends what cameras send, and what they should not."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator
from itertools import pairwise

import cv2
import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from support.patience import PATIENCE
from support.streams import (
    Send,
    StreamServer,
    assert_two_are_stamped,
    counters,
    first,
    hang_up,
    jpeg,
    nothing_comes_but,
    part,
    repeating,
    sending,
    stream_server,
)
from swarmtrack.camera_sources.decode import decode_jpeg
from swarmtrack.camera_sources.frame_slot import BadImage
from swarmtrack.camera_sources.limits import MAX_PART_BYTES
from swarmtrack.camera_sources.multipart import MultipartReader
from swarmtrack.camera_sources.opening import open_camera
from swarmtrack.clock import SystemClock
from swarmtrack.messages import StampKind
from swarmtrack.wire.health import link_health


@pytest.fixture
async def server() -> AsyncIterator[StreamServer]:
    async with stream_server("/stream", "multipart/x-mixed-replace; boundary=frame") as server:
        yield server


@pytest.mark.parametrize("length", [True, False])
async def test_images_arrive_with_and_without_their_length_told(server: StreamServer, length: bool) -> None:
    camera = open_camera(server.url, clock=SystemClock(), size=(64, 48))
    server.script = sending(*(part(jpeg(level), length=length) for level in (20, 90, 160)), source=camera)
    frames = await first(3, camera.frames())  # the last too, though no delimiter follows it
    assert [round(frame.image.mean()) for frame in frames] == pytest.approx([20, 90, 160], abs=2)
    assert {frame.stamp for frame in frames} == {StampKind.ARRIVAL}
    assert frames[0].t_sigma == pytest.approx(0.05)
    async with asyncio.timeout(PATIENCE):
        await camera.close()


async def test_a_stamp_is_taken_as_exposure_on_our_clock_or_in_utc_and_else_not_at_all(
    server: StreamServer,
) -> None:
    clock = SystemClock()
    now, utc = clock.now(), clock.utc()
    stamps = [now - 0.3, utc - 0.3, now - 3600, now + 30, "yesterday", "nan"]
    camera = open_camera(server.url + "?latency_ms=40", clock=clock)
    server.script = sending(*(part(jpeg(9), f"X-Timestamp: {stamp}") for stamp in stamps), source=camera)
    frames = await first(len(stamps), camera.frames())
    assert_two_are_stamped([frame.t for frame in frames], now, after=clock.now())
    assert [frame.stamp for frame in frames] == [StampKind.EXPOSURE] * 2 + [StampKind.ARRIVAL] * 4
    assert counters(camera)["bad_stamps"] == 4
    await camera.close()


async def test_damaged_images_are_counted_and_the_stream_goes_on(server: StreamServer) -> None:
    whole = jpeg(50)
    at = whole.index(b"\xff\xc0")
    bomb = whole[: at + 5] + b"\xff\xff\xff\xff" + whole[at + 9 :]  # claims 65535 x 65535
    bad = [b"no jpeg", whole[: len(whole) // 2], bomb]
    camera = open_camera(server.url, clock=SystemClock())
    server.script = sending(*(part(body) for body in (*bad, jpeg(200))), source=camera)
    assert round((await first(1, camera.frames()))[0].image.mean()) == pytest.approx(200, abs=2)
    assert counters(camera)["corrupt"] == 3
    await camera.close()


async def test_a_frame_of_another_size_is_counted_and_said(server: StreamServer) -> None:
    server.script = sending(part(jpeg(9, 32, 32)), part(jpeg(9, 32, 32)))
    camera = open_camera(server.url, clock=SystemClock(), size=(64, 48))
    await nothing_comes_but("frames are 32x32, the calibration is for 64x48", camera, camera.frames())


async def test_a_frame_of_another_size_is_refused_by_its_header_and_not_decoded(
    server: StreamServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoded: list[object] = []
    monkeypatch.setattr(cv2, "imdecode", lambda *arguments: decoded.append(arguments))
    camera = open_camera(server.url, clock=SystemClock(), size=(32, 24))
    server.script = sending(part(jpeg(9)), source=camera)
    await nothing_comes_but("frames are 64x48, the calibration is for 32x24", camera, camera.frames())
    assert counters(camera)["wrong_size"] == 1
    assert not decoded


async def test_a_slow_consumer_gets_the_newest(server: StreamServer) -> None:
    first_taken = asyncio.Event()

    async def script(send: Send) -> None:
        await send(part(jpeg(0)))
        await first_taken.wait()
        for level in range(10, 200, 10):
            await send(part(jpeg(level)))
        await asyncio.Event().wait()

    server.script = script
    camera = open_camera(server.url, clock=SystemClock())
    frames = camera.frames()
    async with asyncio.timeout(PATIENCE):
        await anext(frames)
        first_taken.set()
        while counters(camera)["dropped"] < 18:  # noqa: ASYNC110
            await asyncio.sleep(0.01)
        assert round((await anext(frames)).image.mean()) == pytest.approx(190, abs=2)
    await camera.close()


async def test_a_server_that_hangs_up_is_said_and_asked_again(server: StreamServer) -> None:
    server.script = sending(part(jpeg(9)), then=hang_up)
    camera = open_camera(server.url, clock=SystemClock())
    frames = await first(2, camera.frames())
    assert server.connections == 2
    assert frames[1].sequence > frames[0].sequence
    assert counters(camera)["reconnects"] == 1
    await camera.close()


@pytest.mark.parametrize(
    ("status", "content_type", "sentence"),
    [
        (404, "text/html", "HTTP 404 Not Found: check the path"),
        (401, "text/html", "user and password"),
        (200, "text/html", "is text/html, expected a stream of JPEGs"),
        (200, "image/jpeg", "is image/jpeg, a single picture, expected a stream"),
        (200, "multipart/x-mixed-replace", "nothing for 0.5 s"),
    ],
)
async def test_what_is_no_stream_is_said(
    server: StreamServer, status: int, content_type: str, sentence: str
) -> None:
    server.status, server.content_type = status, content_type
    camera = open_camera(server.url + "?timeout_s=0.5", clock=SystemClock())
    await nothing_comes_but(sentence, camera, camera.frames())


async def test_nobody_there_and_somebody_silent_are_told_apart(server: StreamServer) -> None:
    for url, sentence in (
        ("http://127.0.0.1:9/stream", "cannot connect to 127.0.0.1 port 9: Connection refused"),
        (server.url + "?timeout_s=0.5", "nothing for 0.5 s"),
    ):
        camera = open_camera(url, clock=SystemClock())
        await nothing_comes_but(sentence, camera, camera.frames())


async def test_bytes_without_a_picture_are_a_state_of_their_own(server: StreamServer) -> None:
    server.script = repeating(b"nothing to be seen here\r\n" * 10)
    camera = open_camera(server.url + "?timeout_s=0.5", clock=SystemClock())
    words = 'bytes come, but no picture: no line holds the boundary "frame"'
    await nothing_comes_but(words, camera, camera.frames())


@pytest.mark.parametrize(
    ("body", "kind", "words"),
    [
        (b"no jpeg", "image/jpeg", "no picture can be read from them; the last: not a JPEG"),
        (b"<html>", "text/html", "no picture: a part of the stream is text/html, expected image/jpeg"),
        (b"", "image/jpeg", "bytes come, but no picture: its parts are empty"),
    ],
)
async def test_parts_that_are_no_pictures_are_a_state_of_their_own(
    server: StreamServer, body: bytes, kind: str, words: str
) -> None:
    server.script = repeating(part(body).replace(b"image/jpeg", kind.encode()))
    camera = open_camera(server.url + "?timeout_s=0.5", clock=SystemClock())
    await nothing_comes_but(words, camera, camera.frames())
    assert (counters(camera)["corrupt"] > 0) == (body == b"no jpeg")


async def test_what_comes_between_pictures_is_not_counted_as_damage(
    server: StreamServer, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "swarmtrack")
    text = part(b"hello").replace(b"image/jpeg", b"text/plain")
    server.script = repeating(text + part(jpeg(50)) + part(b""))
    camera = open_camera(server.url, clock=SystemClock())
    assert len(await first(3, camera.frames())) == 3
    assert counters(camera)["corrupt"] == 0
    assert "streaming" in caplog.text
    assert [message for message in caplog.messages if "streaming" not in message] == []
    await camera.close()


@pytest.mark.parametrize(
    "kind",
    [
        "Multipart/X-Mixed-Replace; Boundary=frame",
        'multipart/mixed;charset=x; boundary="frame"',
        "application/octet-stream",
        "video/x-motion-jpeg",
    ],
)
async def test_a_type_is_read_as_mime_writes_it(server: StreamServer, kind: str) -> None:
    server.content_type = kind
    camera = open_camera(server.url, clock=SystemClock())
    server.script = sending(part(jpeg(20)), source=camera)
    assert len(await first(1, camera.frames())) == 1
    await camera.close()


@pytest.mark.parametrize(
    ("age_s", "problem"),
    [
        (1.2, "1.2 s behind this machine's monotonic clock by the youngest of 20 frames"),
        (-0.1, " s ahead of this machine's monotonic clock by the youngest of 20 frames"),
    ],
)
async def test_an_uptime_near_ours_is_not_taken_for_it(
    server: StreamServer, age_s: float, problem: str
) -> None:
    clock = SystemClock()
    camera = open_camera(server.url, clock=clock)

    async def script(send: Send) -> None:
        while True:
            await send(part(jpeg(9), f"X-Timestamp: {clock.now() - age_s:.6f}"))
            await asyncio.sleep(0.02)

    server.script = script
    frames = await first(25, camera.frames())
    assert {frame.stamp for frame in frames} == {StampKind.ARRIVAL}
    assert "stamps are not used: their clock is" in camera.status().text
    assert problem in camera.status().text
    assert camera.status().ok
    assert counters(camera)["bad_stamps"] >= 25
    await camera.close()


# The parser alone -------------------------------------------------------------------------------------------------

BODIES = [jpeg(level, 16, 16) for level in (10, 100, 200)]


def bodies(stream: bytes, cuts: list[int], boundary: str = "frame") -> list[bytes]:
    reader = MultipartReader(boundary)
    places = sorted({min(cut, len(stream)) for cut in cuts} | {0, len(stream)})
    parts = []
    for start, end in pairwise(places):
        parts += reader.feed(stream[start:end], now=float(end))
    return [part.body for part in parts]


@given(st.lists(st.integers(0, 5000)), st.booleans())
def test_how_the_stream_is_cut_into_packets_does_not_matter(cuts: list[int], length: bool) -> None:
    stream = b"".join(part(body, length=length) for body in BODIES)
    assert [body.rstrip(b"\r\n") for body in bodies(stream, cuts)] == BODIES


@given(st.binary(max_size=200), st.binary(max_size=200), st.lists(st.integers(0, 5000)))
def test_garbage_between_images_costs_at_most_the_image_it_touches(
    before: bytes, between: bytes, cuts: list[int]
) -> None:
    stream = before + part(BODIES[0]) + between + part(BODIES[1]) + part(BODIES[2])
    assert bodies(stream, cuts)[-1] == BODIES[2]


@given(st.lists(st.binary(max_size=2000)))
def test_no_bytes_whatever_make_the_parser_raise_or_grow(chunks: list[bytes]) -> None:
    reader = MultipartReader("frame")
    for chunk in chunks:
        reader.feed(chunk, 0.0)
        reader.feed(b"--frame\r\nContent-Length: 9\r\n", 0.0)


@pytest.mark.parametrize(
    ("boundary", "delimiter"),
    [
        ("frame", "--frame"),
        ("--frame", "--frame"),
        ('"--frame"', "----frame"),
        ("---frame", "-----frame"),
        ("frame", "frame"),
        ("--video boundary--", "--video boundary--"),
        ("video boundary--", "--video boundary--"),
        ("x", "--x"),
        ("", "--frame"),
        ("--", "--frame"),
        ("other", "--frame"),
    ],
)
@pytest.mark.parametrize("length", [True, False])
def test_boundaries_are_found_as_cameras_write_them(boundary: str, delimiter: str, length: bool) -> None:
    stream = b"".join(part(body, length=length) for body in BODIES).replace(b"--frame", delimiter.encode())
    for cuts in ([], list(range(0, len(stream), 7))):
        assert [body.rstrip(b"\r\n") for body in bodies(stream, cuts, boundary)] == BODIES
    assert bodies(stream.replace(b"\r\n", b"\n"), [], boundary)[0][:3] == BODIES[0][:3]


@pytest.mark.parametrize("boundary", ["", "other"])
@pytest.mark.parametrize(
    "between", [b"", b"\r\n", b"\0\0", b"\r\n--frame\r\n\r\n", b"\r\n--frame\r\nX-A: 1\r\n\r\n"]
)
@pytest.mark.parametrize("step", [7, 100, 10_000])
def test_images_are_found_without_any_header(boundary: str, between: bytes, step: int) -> None:
    small = BODIES[0]
    thumbnail = b"\xff\xe1" + (len(small) + 2).to_bytes(2) + small
    pictures = [body[:2] + thumbnail + body[2:] for body in BODIES]
    stream = b"".join(between + picture for picture in (b"\xff\xd8\xff\xe0\0\2 none", *pictures))
    cuts = list(range(0, len(stream), step))
    assert [body.rstrip(b"\r\n\0") for body in bodies(stream, cuts, boundary)] == pictures


@pytest.mark.parametrize("step", [7, 10_000])
def test_a_boundary_is_learnt_from_a_part_that_tells_its_length_only(step: int) -> None:
    parts = (part(body).replace(b"Content-Type: image/jpeg", b"X-Timestamp: 5") for body in BODIES)
    stream = b"".join(parts).replace(b"--frame", b"--other")
    reader, found = MultipartReader("frame"), []
    for start in range(0, len(stream), step):
        found += reader.feed(stream[start : start + step], 0.0)
    assert [one.body for one in found] == BODIES
    assert {one.headers["x-timestamp"] for one in found} == {"5"}


def test_a_stream_of_dashes_takes_no_longer_than_another() -> None:
    reader = MultipartReader("frame")
    for _ in range(64):
        assert reader.feed(b"-" * 65536, 0.0) == []
    assert reader.feed(b"frame\n" * 20_000, 0.0) == []
    assert reader.feed(part(BODIES[0]), 0.0)[-1].body == BODIES[0]


@pytest.mark.parametrize(
    "bytes_of_jpegs",
    [b"\xff\xd8\xff\xe0\0\2?", b"\xff\xd8\xff\xda\0\0", b"\xff\xd8\xff", b"\xff\xd8\xff\xe0\0\0", b"\xff"],
)
def test_a_stream_of_beginnings_takes_no_longer_than_another(bytes_of_jpegs: bytes) -> None:
    """Each is looked at once: if each were followed by a look at all the rest, this would take hours."""
    reader = MultipartReader("frame")
    chunk = b"\xff\xd8\xff" + bytes_of_jpegs * (65536 // len(bytes_of_jpegs))
    for _ in range(64):
        reader.feed(chunk, 0.0)
    assert reader.feed(part(BODIES[0]), 0.0)[-1].body == BODIES[0]


@pytest.mark.parametrize("before", [b"", b"\r\n", b"\0\0"])
@pytest.mark.parametrize("behind", [b"", b"\0" * 4000, b"\xff" * 4000, b" \r\n" * 900])
def test_an_image_may_be_padded(before: bytes, behind: bytes) -> None:
    assert decode_jpeg(before + BODIES[1] + behind).shape == (16, 16, 3)


def test_the_end_of_a_thumbnail_is_not_the_end_of_the_image() -> None:
    small, whole = BODIES[0], jpeg(50)
    thumbnail = b"\xff\xe1" + (len(small) + 2).to_bytes(2) + small
    inside = whole[:2] + thumbnail + whole[2:]
    assert decode_jpeg(inside).shape == (48, 64, 3)
    with pytest.raises(BadImage, match="cut short"):
        decode_jpeg(inside[:-20])


@pytest.mark.parametrize("claimed", [10, 100_000, MAX_PART_BYTES + 1, -1, "many"])
def test_a_wrong_length_costs_that_image_only(claimed: object) -> None:
    wrong = part(BODIES[0], length=False).replace(
        b"\r\n\r\n", f"\r\nContent-Length: {claimed}\r\n\r\n".encode(), 1
    )
    assert bodies(wrong + part(BODIES[1]), [])[-1] == BODIES[1]


def test_a_part_without_end_is_given_up_at_the_bound() -> None:
    reader = MultipartReader("frame")
    reader.feed(b"--frame\r\n\r\n", 0.0)
    for _ in range(MAX_PART_BYTES // 2**20 + 2):
        reader.feed(bytes(2**20), 0.0)
    assert reader.oversized == 1
    assert reader.garbage > MAX_PART_BYTES
    assert [found.body for found in reader.feed(part(BODIES[0]), 0.0)] == [BODIES[0]]


def test_an_image_ended_by_the_next_ones_delimiter_arrived_when_its_own_bytes_did() -> None:
    reader = MultipartReader("frame")
    reader.feed(b"--frame\r\n\r\nnot a jpeg", 1.0)
    assert [found.arrived for found in reader.feed(b"\r\n--frame\r\n", 2.0)] == [1.0]


@given(st.binary(max_size=3000), st.integers(0, 400))
def test_no_bytes_whatever_make_the_decoder_do_more_than_refuse(tail: bytes, keep: int) -> None:
    for data in (tail, BODIES[0][:keep] + tail):
        with contextlib.suppress(BadImage):
            assert decode_jpeg(data).ndim in (2, 3)


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (b"HTTP/1.1 302 Found\r\nLocation: http://[::bad/\xff\x1b[2J\r\n\r\n", "trying again"),
        (b"HTTP/1.1 500 \x1b]0;pwned\x07 " + 2000 * b"x" + b"\r\n\r\n", "HTTP 500"),
    ],
    ids=["a redirect to nowhere", "a reason that commands the terminal"],
)
async def test_what_a_server_says_cannot_spoil_the_log_or_the_health(
    answer: bytes, words: str, caplog: pytest.LogCaptureFixture
) -> None:
    async def serve(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(answer)
        await writer.drain()
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    async with server:
        camera = open_camera(f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/", clock=SystemClock())
        await nothing_comes_but(words, camera, camera.frames())
    said = [camera.status().text, *caplog.messages]
    assert all(text.isprintable() and len(text) < 1000 for text in said), said
    msgspec.msgpack.encode(link_health(camera.status()))
