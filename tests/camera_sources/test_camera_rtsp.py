"""RTSP, against a small server: MJPEG in RTP (RFC 2435) interleaved with RTSP on one TCP connection (RFC 2326)."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import hashlib
import re
import struct
from collections.abc import AsyncIterator

import cv2
import numpy as np
import pytest

from support.patience import PATIENCE
from support.streams import first, nothing_comes_but, status_with
from swarmtrack.camera_sources.opening import open_camera
from swarmtrack.clock import SystemClock
from swarmtrack.diagnosis.sources import CameraFacts, check_camera
from swarmtrack.messages import Frame, LinkStatus, StampKind

PERIOD = 1 / 30


def rtp_packets(image: np.ndarray, sequence: int, timestamp: int) -> list[bytes]:
    """A picture as RTP packets: RFC 2435, type 1 (4:2:0), quantisation tables in band (Q = 255)."""
    jpeg: bytes = cv2.imencode(".jpg", image)[1].tobytes()
    tables, at = b"", 2
    while jpeg[at + 1] != 0xDA:  # up to the start of scan
        length = int.from_bytes(jpeg[at + 2 : at + 4])
        if jpeg[at + 1] == 0xDB:
            tables += jpeg[at + 5 : at + 2 + length]
        at += 2 + length
    scan = jpeg[at + 2 + int.from_bytes(jpeg[at + 2 : at + 4]) : -2]
    height, width = image.shape[:2]
    packets = []
    for start in range(0, len(scan), 1400):
        last = start + 1400 >= len(scan)
        header = struct.pack(
            ">BBHII", 0x80, 26 | last << 7, sequence & 0xFFFF, timestamp & 0xFFFFFFFF, 0x5EED
        )
        header += struct.pack(">I", start) + bytes((1, 255, width // 8, height // 8))
        if start == 0:
            header += struct.pack(">BBH", 0, 0, len(tables)) + tables
        packets.append(header + scan[start : start + 1400])
        sequence += 1
    return packets


class Server:
    """Plays grey pictures that get lighter; `silent` stops them, `hang_up` ends the connections.

    challenges: a login is asked for so, of pilot and `password`; always_asks: even without a challenge; described: the
    answer to DESCRIBE, if other than 200; logins: the Authorization of each request that had one.
    """

    def __init__(self) -> None:
        self.silent = False
        self.challenges: list[str] = []
        self.always_asks = False
        self.logins: list[str] = []
        self.password = "se@cr/et"
        self.described = ""
        self.plays = 0
        self.port = 0
        self._writers: list[asyncio.StreamWriter] = []

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.append(writer)
        playing: asyncio.Task[None] | None = None
        try:
            while line := (await reader.readline()).decode():
                method, *_ = line.split()
                headers = {}
                while (line := (await reader.readline()).decode().strip()) != "":
                    name, _, value = line.partition(":")
                    headers[name.lower()] = value.strip()
                writer.write(self._answer(method, headers))
                if method == "PLAY":
                    playing = asyncio.create_task(self._play(writer))
        except (ConnectionError, ValueError):
            pass
        finally:
            if playing is not None:
                playing.cancel()
            writer.close()

    def _answer(self, method: str, headers: dict[str, str]) -> bytes:
        self.logins += [headers["authorization"]] if "authorization" in headers else []
        lines = ["RTSP/1.0 200 OK", f"CSeq: {headers.get('cseq', '0')}", "Session: 1"]
        body = ""
        if method == "OPTIONS":
            lines.append("Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN")
        elif method == "DESCRIBE" and not self._is_right(headers.get("authorization", "")):
            lines[0] = "RTSP/1.0 401 Unauthorized"
            lines += [f"WWW-Authenticate: {challenge}" for challenge in self.challenges] + [
                "Content-Length: 3"
            ]
            body = "no!"
        elif method == "DESCRIBE" and self.described:
            lines[0] = f"RTSP/1.0 {self.described}"
        elif method == "DESCRIBE":
            body = "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=test\r\nt=0 0\r\nm=video 0 RTP/AVP 26\r\na=control:track\r\n"
            lines += ["Content-Type: application/sdp", f"Content-Length: {len(body)}"]
        elif method == "SETUP":
            if "TCP" not in headers.get("transport", ""):
                lines[0] = "RTSP/1.0 461 Unsupported Transport"
            lines.append("Transport: RTP/AVP/TCP;unicast;interleaved=0-1")
        return ("\r\n".join(lines) + "\r\n\r\n" + body).encode()

    def _is_right(self, said: str) -> bool:
        if not self.challenges and not self.always_asks:
            return True
        if said.startswith("Basic "):
            return base64.b64decode(said[6:]).decode() == f"pilot:{self.password}"
        pairs = dict(re.findall(r'(\w+)="?([^",]*)"?', said))

        def h(text: str) -> str:
            return hashlib.md5(text.encode()).hexdigest()

        both = h(f"pilot:cam:{self.password}"), h(f"DESCRIBE:{pairs.get('uri')}")
        middle = ":".join(pairs[key] for key in ("nc", "cnonce", "qop")) + ":" if "qop" in pairs else ""
        return pairs.get("response") == h(f"{both[0]}:abc:{middle}{both[1]}")

    async def _play(self, writer: asyncio.StreamWriter) -> None:
        self.plays += 1
        sequence = 0
        for number in range(10_000):
            image = np.full((48, 64, 3), number % 200, np.uint8)
            if not self.silent:
                for packet in rtp_packets(image, sequence, number * 3000):
                    writer.write(b"$\0" + struct.pack(">H", len(packet)) + packet)
                    sequence += 1
                await writer.drain()
            await asyncio.sleep(PERIOD)

    def hang_up(self) -> None:
        for writer in self._writers:
            writer.close()
        self._writers.clear()


@pytest.fixture
async def server() -> AsyncIterator[Server]:
    server = Server()
    listening = await asyncio.start_server(server.serve, "127.0.0.1", 0)
    server.port = listening.sockets[0].getsockname()[1]
    yield server
    listening.close()
    server.hang_up()


def url(port: int, query: str = "") -> str:
    return f"rtsp://127.0.0.1:{port}/live{query}"


async def test_a_stream_gives_its_pictures_with_the_time_of_arrival(server: Server) -> None:
    clock = SystemClock()
    camera = open_camera(url(server.port, "?latency_ms=80&sigma_ms=30"), clock=clock, size=(64, 48))
    frames: list[Frame] = []
    async with asyncio.timeout(PATIENCE):
        async for frame in camera.frames():
            frames.append(frame)
            assert clock.now() - frame.t > 0.08
            if len(frames) == 5:
                break
    assert frames[0].image.shape == (48, 64, 3)
    levels = [frame.image.mean() for frame in frames]
    assert levels == sorted(levels)
    assert levels[0] < levels[-1]
    assert {(frame.stamp, frame.t_sigma) for frame in frames} == {(StampKind.ARRIVAL, 0.03)}
    async with asyncio.timeout(PATIENCE):
        await camera.close()


async def test_a_stream_that_breaks_is_said_and_opened_again(server: Server) -> None:
    camera = open_camera(url(server.port, "?timeout_s=1"), clock=SystemClock())
    frames = camera.frames()
    async with asyncio.timeout(PATIENCE):
        last = await anext(frames)
        server.hang_up()
        await status_with(camera, "lost")
        while server.plays < 2 or not camera.status().ok:
            frame = await anext(frames)
            assert frame.sequence > last.sequence
            last = frame
    assert dict(camera.status().counters)["reconnects"] == 1
    await camera.close()


@pytest.mark.parametrize("timeout", [1, 30])
async def test_a_stream_that_falls_silent_is_said_within_its_timeout_and_can_be_closed_before(
    server: Server, timeout: int
) -> None:
    camera = open_camera(url(server.port, f"?timeout_s={timeout}"), clock=SystemClock())
    frames = camera.frames()
    async with asyncio.timeout(PATIENCE):
        await anext(frames)
        server.silent = True
        if timeout == 1:
            await status_with(camera, "nothing for 1 s")
            server.silent = False
            while server.plays < 2:
                await anext(frames)
    async with asyncio.timeout(PATIENCE):
        await camera.close()


async def test_nobody_there_and_no_stream_there_are_told_apart_and_close_at_once() -> None:
    async def hang_up(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        del reader
        writer.close()

    mute = await asyncio.start_server(hang_up, "127.0.0.1", 0)
    for port, sentence in (
        (9, "cannot connect to 127.0.0.1 port 9: Connection refused"),
        (mute.sockets[0].getsockname()[1], "answers, but gives no video"),
    ):
        camera = open_camera(url(port), clock=SystemClock())
        await nothing_comes_but(sentence, camera, camera.frames())
    mute.close()


DIGEST = 'Digest realm="cam", nonce="abc"'
BASIC = 'Basic realm="cam"'


@pytest.mark.parametrize("challenges", [[DIGEST], [BASIC], [BASIC, DIGEST]])
async def test_with_the_right_login_a_camera_is_read(server: Server, challenges: list[str]) -> None:
    server.challenges = challenges
    camera = open_camera(url(server.port).replace("://", "://pilot:se%40cr%2Fet@"), clock=SystemClock())
    assert len(await first(1, camera.frames())) == 1
    await camera.close()


@pytest.mark.parametrize("challenges", [[DIGEST], [BASIC], [BASIC, DIGEST], []])
async def test_a_wrong_login_is_sent_once_per_attempt(server: Server, challenges: list[str]) -> None:
    """Cameras count wrong ones, and lock the user out."""
    server.challenges, server.always_asks = challenges, True
    camera = open_camera(url(server.port).replace("://", "://pilot:hunter2@"), clock=SystemClock())
    taking = asyncio.create_task(first(1, camera.frames()))
    async with asyncio.timeout(PATIENCE):
        await status_with(camera, "user or password is not accepted")
        assert len(server.logins) == 1
        await camera.close()
    assert await taking == []


@pytest.mark.parametrize(
    ("login", "words"),
    [
        ("", "RTSP 401 Unauthorized: give user and password, rtsp://USER:PASSWORD@HOST/…"),
        ("pilot:hunter2@", "user or password is not accepted (asked for: no known scheme)"),
        ("pilot:se%40cr%2Fet@", "the login is right, but is never asked for: select digest or basic"),
    ],
)
async def test_a_camera_that_names_no_scheme_is_asked_by_basic_as_over_http(
    server: Server, login: str, words: str
) -> None:
    server.always_asks = True
    camera = open_camera(url(server.port).replace("://", f"://{login}"), clock=SystemClock())
    await nothing_comes_but(words, camera, camera.frames())
    assert [said.partition(" ")[0] for said in server.logins[:1]] == (["Basic"] if login else [])
    assert only_fault(camera.status()) == "camera.login"


@pytest.mark.parametrize("login", ["", "pilot:hunter2@"])
async def test_a_server_that_drips_bytes_holds_nobody_beyond_the_timeout(login: str) -> None:
    """Each byte comes in time, the whole answer never."""

    async def drip(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        del reader
        with contextlib.suppress(ConnectionError):
            writer.write(b"RTSP/1.0 200 OK\r\n")
            while True:
                writer.write(b"X")
                await writer.drain()
                await asyncio.sleep(0.05)

    dripping = await asyncio.start_server(drip, "127.0.0.1", 0)
    port = dripping.sockets[0].getsockname()[1]
    camera = open_camera(url(port, "?timeout_s=0.5").replace("://", f"://{login}"), clock=SystemClock())
    await nothing_comes_but("answers, but gives no video", camera, camera.frames())
    dripping.close()


@pytest.mark.parametrize(
    ("login", "challenges", "described", "words"),
    [
        ("", [DIGEST], "", "RTSP 401 Unauthorized: give user and password, rtsp://USER:PASSWORD@HOST/…"),
        ("pilot:hunter2@", [DIGEST], "", "user or password is not accepted (asked for: digest)"),
        ("pilot:hunter2@", [BASIC, f"{DIGEST}, qop=auth"], "", "not accepted (asked for: basic, digest)"),
        ("pilot:hunter2@", [BASIC], "", "user or password is not accepted (asked for: basic)"),
        ("pilot:hunter2@", [f"{DIGEST}, algorithm=ROT13"], "", "not accepted (asked for: digest)"),
        ("pilot:hunter2@", ["Digest realm=, nonce=abc"], "", "not accepted (asked for: digest)"),
        ("pilot:hunter2@", [f"{DIGEST}, qop=auth-int"], "", "not accepted (asked for: digest)"),
        ("pilot:hunter2@", ["Negotiate"], "", "not accepted (asked for: negotiate)"),
        ("pilot:se%40cr%2Fet@", [BASIC], "404 Not Found", "RTSP 404 Not Found: check the path"),
        ("pilot:se%40cr%2Fet@", [DIGEST], "404 Not Found", "RTSP 404 Not Found: check the path"),
        (
            "pilot:se%40cr%2Fet@",
            [f'{DIGEST}, qop="auth"'],
            "404 Not Found",
            "RTSP 404 Not Found: check the path",
        ),
        (
            "pilot:se%40cr%2Fet@",
            [f"{DIGEST}, algorithm=SHA-256", DIGEST],
            "404 Not Found",
            "404 Not Found: check",
        ),
        ("", [], "503 Service Unavailable", "RTSP 503 Service Unavailable"),
        ("", [], "404 Not Found\r\nContent-Length: -1", "RTSP 404 Not Found: check the path"),
        ("", [], "not RTSP", "answers, but gives no video: check path, user and password"),
        ("", [], "200 OK", "gives no video that can be read, though it accepts path and login"),
    ],
)
async def test_why_a_server_gives_no_video_is_said(
    server: Server,
    caplog: pytest.LogCaptureFixture,
    login: str,
    challenges: list[str],
    described: str,
    words: str,
) -> None:
    server.challenges, server.described = challenges, described
    camera = open_camera(url(server.port).replace("://", f"://{login}"), clock=SystemClock())
    await nothing_comes_but(words, camera, camera.frames())
    shown = (camera.status().text, camera.status().name, *caplog.messages)
    assert not any("hunter2" in text or "se@cr" in text for text in shown)
    assert (only_fault(camera.status()) == "camera.login") == ("RTSP 401" in camera.status().text)


def only_fault(status: LinkStatus) -> str:
    """What doctor calls it."""
    (finding,) = check_camera(CameraFacts(8.0, 0.5, status, kind="rtsp"))
    return finding.fault
