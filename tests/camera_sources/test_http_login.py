"""Users and passwords of HTTP cameras: digest and basic; and no part of a password is shown or sent elsewhere."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from support.mutants import MUTANTS, mutants
from support.patience import PATIENCE
from support.streams import first, jpeg, nothing_comes_but, part, status_with
from swarmtrack.camera_sources.address import parse_address
from swarmtrack.camera_sources.opening import open_camera
from swarmtrack.clock import SystemClock
from swarmtrack.errors import SwarmtrackError
from swarmtrack.plain_text import hide_logins

STREAM = b"HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=frame\r\n\r\n"
DIGEST = 'Digest realm="cam", nonce="abc123", qop="auth", algorithm=MD5'
BASIC = 'Basic realm="cam"'


class LoginServer:
    """A camera that asks for a login. requests: the Authorization of each, None without."""

    def __init__(self, *challenges: str) -> None:
        self.challenges = challenges
        self.password = "se@cr/et"
        self.requests: list[str | None] = []
        self.port = 0

    def url(self, password: str = "se%40cr%2Fet") -> str:
        return f"http://pilot:{password}@127.0.0.1:{self.port}/stream?x=1"

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        request = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1")
        found = re.search(r"^Authorization: (.*)\r$", request, re.MULTILINE)
        said = found[1] if found else None
        self.requests.append(said)
        if said is not None and self.is_right(said, request.split()[1]):
            writer.write(STREAM + part(jpeg(50)))
            await writer.drain()
            await asyncio.sleep(PATIENCE)
        lines = "".join(f"WWW-Authenticate: {each}\r\n" for each in self.challenges)
        head = f"HTTP/1.1 401 Unauthorized\r\n{lines}Content-Length: 5\r\nConnection: close\r\n\r\nno!!!"
        writer.write(head.encode("utf-8", "surrogateescape"))
        writer.close()

    def is_right(self, said: str, path: str) -> bool:
        if said.startswith("Basic "):
            return base64.b64decode(said[6:]).decode() == f"pilot:{self.password}"
        pairs = dict(re.findall(r'(\w+)="?([^",]*)"?', said))
        hashed = hashlib.sha256 if "SHA-256" in said else hashlib.md5

        def h(text: str) -> str:
            return hashed(text.encode()).hexdigest()

        both = h(f"pilot:cam:{self.password}"), h(f"GET:{path}")
        middle = (
            f"{pairs['nonce']}:{pairs['nc']}:{pairs['cnonce']}:auth" if "qop" in pairs else pairs["nonce"]
        )
        return pairs["uri"] == path and pairs["response"] == h(f"{both[0]}:{middle}:{both[1]}")


@asynccontextmanager
async def login_server(*challenges: str) -> AsyncIterator[LoginServer]:
    camera = LoginServer(*challenges)
    server = await asyncio.start_server(camera.serve, "127.0.0.1", 0)
    camera.port = server.sockets[0].getsockname()[1]
    yield camera
    server.close()


@pytest.mark.parametrize(
    ("challenges", "scheme"),
    [
        ([DIGEST], "Digest"),
        ([BASIC, DIGEST], "Digest"),
        ([DIGEST.replace("MD5", "SHA-256")], "Digest"),
        ([DIGEST.replace("MD5", "SHA-512-256"), DIGEST], "Digest"),
        (['Digest realm="cam", nonce="abc"'], "Digest"),
        (["digest realm=cam, nonce=abc"], "Digest"),
        ([f"{BASIC}, {DIGEST}"], "Digest"),
        ([f"{DIGEST}, {BASIC}"], "Digest"),
        ([f"Negotiate, , {BASIC},{DIGEST}"], "Digest"),
        ([BASIC.replace('"cam"', r'"a \", Digest x=\""')], "Basic"),
        ([BASIC], "Basic"),
        ([], "Basic"),
    ],
)
async def test_a_login_is_given_as_the_camera_asks_and_not_before(challenges: list[str], scheme: str) -> None:
    async with login_server(*challenges) as server:
        camera = open_camera(server.url(), clock=SystemClock())
        assert len(await first(1, camera.frames())) == 1
        await camera.close()
    assert server.requests[0] is None
    assert all(said.startswith(scheme) for said in server.requests[1:] if said)


@pytest.mark.parametrize("challenges", [[DIGEST], [BASIC], []])
async def test_a_wrong_password_is_said_and_not_shown(
    challenges: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    async with login_server(*challenges) as server:
        camera = open_camera(server.url("hunter2"), clock=SystemClock())
        scheme = challenges[0].split()[0].lower() if challenges else "no known scheme"
        words = f"HTTP 401 Unauthorized: user or password is not accepted (asked for: {scheme})"
        await nothing_comes_but(words, camera, camera.frames())
    shown = [camera.status().text, camera.status().name, *caplog.messages]
    assert not any("hunter2" in text for text in shown)
    assert "http://pilot@127.0.0.1" in camera.status().name


async def test_another_server_gets_no_login() -> None:
    async with login_server(DIGEST) as other, login_server() as server:

        async def redirect(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            writer.write(
                f"HTTP/1.1 302 Found\r\nLocation: {other.url().replace('pilot:se%40cr%2Fet@', '')}\r\n\r\n".encode()
            )
            writer.close()

        server.serve = redirect  # type: ignore[method-assign]
        away = await asyncio.start_server(redirect, "127.0.0.1", 0)
        url = f"http://pilot:secret@127.0.0.1:{away.sockets[0].getsockname()[1]}/"
        camera = open_camera(url, clock=SystemClock())
        await nothing_comes_but("HTTP 401", camera, camera.frames())
        away.close()
    assert set(other.requests) == {None}


@pytest.mark.parametrize(
    "challenge",
    [
        "Digest",
        "Digest ,,,=",
        'Digest realm="cam"',
        'Digest realm="cam", nonce=""',
        'Digest realm="cam", nonce="a", qop="auth-conf"',
        'Digest realm="cam", nonce="a", algorithm=ROT13',
        'Digest realm="cam", nonce="a", domain="http://[::bad/"',
        'Digest realm="cam", nonce="a\x0bb", opaque="\x7f"',
        "Negotiate",
        " ",
        "Digest " + "x" * 7000,
        'Digest realm="' + '\\"' * 3000,
    ],
)  # fmt: skip
async def test_no_challenge_whatever_ends_the_camera(challenge: str) -> None:
    async with login_server(challenge) as server:
        camera = open_camera(server.url("wrong"), clock=SystemClock())
        await nothing_comes_but("trying again", camera, camera.frames())


@pytest.mark.parametrize(
    "count",
    [25, pytest.param(MUTANTS // 50, marks=pytest.mark.long("hundreds of mutants, not 25"))],
    ids=["short", "long"],
)
async def test_any_mutation_of_a_challenge_is_answered_or_refused(count: int) -> None:
    async with login_server() as server:
        for mutant in mutants(DIGEST.encode(), count, seed=4, text=True):
            header = re.sub(rb"[\r\n\0]", b"", mutant)[:6000]
            server.challenges = (header.decode("utf-8", "surrogateescape"),)
            camera = open_camera(server.url("wrong"), clock=SystemClock())
            taking = asyncio.create_task(first(1, camera.frames()))
            async with asyncio.timeout(PATIENCE):
                await status_with(camera, "trying again")
                await camera.close()
            assert await taking == []


SECRET = "hunter2"
LEAKY = [
    f"rtsp://admin:{SECRET}#1@10.0.0.5:554/h264",
    f"rtsp://admin:1#{SECRET}@10.0.0.5:554/h264",
    f"rtsp://admin:12/{SECRET}@10.0.0.5:554/h264",
    f"rtsp://admin:12?{SECRET}@10.0.0.5:554/h264",
    f"http://admin:{SECRET}/stream",
    f"http://admin: {SECRET}@cam/stream",
    f"http:admin:{SECRET}@cam/stream",
    f"http://admin:{SECRET}@cam:99999/stream",
    f"http://admin:{SECRET}@[cam/stream",
    f"http://admin:{SECRET}@/stream",
    f"http://admin%3Ax:{SECRET}@cam/stream",
    f"http://admin:{SECRET}@cam/stream?sigma_ms=-1",
    f"rstp://admin:{SECRET}@cam/stream",
    f"admin:{SECRET}@cam/stream",
    f"htt p://admin:{SECRET}@cam/stream",
]


@pytest.mark.parametrize("source", LEAKY)
def test_no_error_shows_a_part_of_a_password(source: str) -> None:
    with pytest.raises(SwarmtrackError) as refused:
        open_camera(source, clock=SystemClock())
    assert SECRET not in str(refused.value)
    assert "camera source" in str(refused.value)


def test_a_sign_that_belongs_elsewhere_is_explained() -> None:
    with pytest.raises(SwarmtrackError, match="write # in a password as %23"):
        parse_address(f"rtsp://admin:pa#{SECRET}@10.0.0.5:554/h264")


@pytest.mark.parametrize(
    "source",
    [
        f"http://pilot:p@{SECRET}@cam/stream",
        f"http://cam/videostream.cgi?user=admin&pwd={SECRET}&x=1",
        f"http://cam/cgi?loginuse=admin&loginpas={SECRET}",
        f"rtsp://cam/user=admin_password={SECRET}_channel=1_stream=0.sdp",
        f"rtsp://cam/user=admin&pw={SECRET}/{SECRET}&channel=1",
        f"rtsp://cam/live?access_token={SECRET}",
        f"http://cam/v?u=a&p=a%20{SECRET}&resize=1",
        f"http://cam/v?auth={SECRET}==",
        f"http://cam/v?{SECRET}",
        f"https://{SECRET}@cam/v",
    ],
)
def test_no_address_shows_a_password(source: str) -> None:
    address = parse_address(source)
    assert SECRET not in str(address)
    assert SECRET not in repr(address).replace(repr(address.query), "").replace(repr(address.target), "")


def test_what_is_no_secret_of_an_address_is_shown() -> None:
    shown = "rtsp://cam:554/live/main?channel=1&resize=1&sigma_ms=20.5"
    assert str(parse_address(shown)) == shown


@pytest.mark.parametrize(
    "answer",
    [
        f"302 Found\r\nLocation: /v?user=admin&p={SECRET}",
        f"302 Found\r\nLocation: ftp://admin:{SECRET}@x/y?key={SECRET}",
        f"500 http://cam/v?key={SECRET}",
        f"500 /v?key={SECRET}",
    ],
    ids=["to itself", "to another scheme", "in its reason", "in its reason, without the host"],
)
async def test_no_answer_of_a_server_shows_a_password(answer: str, caplog: pytest.LogCaptureFixture) -> None:
    async def serve(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(f"HTTP/1.1 {answer}\r\nContent-Length: 0\r\nConnection: close\r\n\r\n".encode())
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    async with server:
        url = f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/v?user=admin&p={SECRET}"
        camera = open_camera(url, clock=SystemClock())
        await nothing_comes_but("trying again", camera, camera.frames())
    assert SECRET not in "".join((camera.status().text, camera.status().name, *caplog.messages))


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        (f'found "http://a:{SECRET}@cam/x", expected', 'found "http://…@cam/x", expected'),
        (f"url='http://cam/x?u=a&p={SECRET}'; again", "url='http://cam/x?u=…&p=…'; again"),
        (f"no '/x?p={SECRET}' here", "no '/x?p=…' here"),
        ("/dev/video0?width=640: busy", "/dev/video0?width=640: busy"),
        ("/clips/run=3/a.mp4: not found", "/clips/run=3/a.mp4: not found"),
        ("give http://USER:PASSWORD@HOST/…", "give http://USER:PASSWORD@HOST/…"),
        ("file:///clips/a@2x.mp4: not found", "file:///clips/a@2x.mp4: not found"),
        ("images://a@b: none", "images://a@b: none"),
        ("drone.toml:5: write to me@example.org", "drone.toml:5: write to me@example.org"),
    ],
)
def test_logins_are_hidden_in_any_sentence_and_other_signs_are_not(text: str, shown: str) -> None:
    assert hide_logins(text) == shown


def test_a_login_is_what_the_url_means() -> None:
    address = parse_address("http://p%20x:a%3Ab%40c:d@cam/stream?x=1")
    assert address.login == ("p x", "a:b@c:d")
    assert address.target == "http://cam/stream"
