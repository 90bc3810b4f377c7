"""Answer of an RTSP server to DESCRIBE (RFC 2326). FFmpeg gets it as well, but OpenCV passes on only that it failed."""

from __future__ import annotations

import http.client
import io
import socket
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from swarmtrack.camera_sources.address import Login
from swarmtrack.camera_sources.challenges import authorization, challenges_of, schemes_of
from swarmtrack.camera_sources.http_stream import refusal
from swarmtrack.camera_sources.limits import MAX_PART_HEADER_BYTES

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer


class RtspAnswer(NamedTuple):
    """The last one. challenges: of the last refusal that had some; login_sent: whether the question had the login."""

    status: int
    reason: str
    challenges: list[str]
    login_sent: bool = False

    @property
    def refuses_login(self) -> bool:
        return self.login_sent and self.status == http.client.UNAUTHORIZED

    @property
    def schemeless(self) -> bool:
        """Whether the login is accepted though no scheme was asked for."""
        return self.login_sent and self.status == http.client.OK and not self.challenges


class _InTime(io.RawIOBase):
    """A connection's bytes, until the time is up. left: s until then."""

    def __init__(self, connection: socket.socket, left: Callable[[], float]) -> None:
        self._connection = connection
        self._left = left

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: WriteableBuffer, /) -> int:
        left = self._left()
        if left <= 0.0:
            raise TimeoutError
        self._connection.settimeout(left)
        return self._connection.recv_into(buffer)


def describe(
    connection: socket.socket, url: str, login: Login | None, left: Callable[[], float]
) -> RtspAnswer | None:
    """What the server at the other end answers; None where that is no RTSP, or does not come in time.

    url: without the login, which is sent once at most, and not before it is asked for; left: s until the time is up.
    """
    file = io.BufferedReader(_InTime(connection, left))

    def ask(number: int, more: str = "") -> RtspAnswer:
        words = f"DESCRIBE {url} RTSP/1.0\r\nCSeq: {number}\r\nAccept: application/sdp\r\n{more}\r\n"
        connection.sendall(words.encode())
        return _read(file)

    try:
        answer = ask(1)
        if answer.status == http.client.UNAUTHORIZED and login is not None:
            asked = answer.challenges
            if words := authorization(asked, "DESCRIBE", url, login):
                answer = ask(2, f"Authorization: {words}\r\n")
                # The second refusal may be without a challenge.
                answer = answer._replace(challenges=answer.challenges or asked, login_sent=True)
    except (OSError, ValueError, http.client.HTTPException):
        return None
    return answer


def _read(file: io.BufferedReader[_InTime]) -> RtspAnswer:
    """Raises OSError, ValueError or HTTPException."""
    version, status, *reason = file.readline(MAX_PART_HEADER_BYTES).decode("latin-1").split(maxsplit=2)
    if not version.startswith("RTSP/"):
        raise ValueError(f"found {version}, expected RTSP")
    headers = http.client.parse_headers(file)
    file.read(min(max(0, int(headers.get("Content-Length", "0"))), MAX_PART_HEADER_BYTES))
    challenges = challenges_of(headers.get_all("WWW-Authenticate", []))
    return RtspAnswer(int(status), "".join(reason).strip(), challenges)


def why_no_video(where: tuple[str, int], answer: RtspAnswer | None, login: Login | None) -> str:
    """Sentence on a server that gives no video. where: its host and port; answer: see `describe`."""
    silent = f"{where[0]} port {where[1]} answers, but gives no video"
    if answer is None:
        return f"{silent}: check path, user and password"
    if answer.schemeless:
        return (
            "RTSP 401 without a scheme (WWW-Authenticate): the login is right, but is never asked for: select digest "
            "or basic authentication in the camera's settings"
        )
    if answer.status == http.client.OK:
        return (
            f"{silent} that can be read, though it accepts path and login: select H.264 in its settings, or set "
            "OPENCV_FFMPEG_CAPTURE_OPTIONS=rtsp_transport;udp"
        )
    asked = None if login is None else schemes_of(answer.challenges)
    return refusal("rtsp", answer.status, answer.reason, asked)
