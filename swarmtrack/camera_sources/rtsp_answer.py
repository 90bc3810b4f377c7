"""Answer of an RTSP server to DESCRIBE (RFC 2326). FFmpeg gets it as well, but OpenCV passes on only that it failed."""

from __future__ import annotations

import http.client
import socket
from io import BufferedRWPair
from typing import NamedTuple

from swarmtrack.camera_sources.address import Login
from swarmtrack.camera_sources.challenges import authorization, challenges_of, schemes_of
from swarmtrack.camera_sources.http_stream import refusal
from swarmtrack.camera_sources.limits import MAX_PART_HEADER_BYTES


class _RtspAnswer(NamedTuple):
    status: int
    reason: str
    challenges: list[str]


def why_no_video(where: tuple[str, int], url: str, login: Login | None, timeout_s: float) -> str:
    """Sentence on a server that FFmpeg got no video from.

    where: its host and port; url: without the login; timeout_s: without a byte.
    """
    silent = f"{where[0]} port {where[1]} answers, but gives no video"
    try:
        with (
            socket.create_connection(where, timeout=timeout_s) as connection,
            connection.makefile("rwb") as file,
        ):
            answer = _describe(file, url, 1)
            if answer.status == http.client.UNAUTHORIZED and login is not None:
                asked = answer.challenges
                if words := authorization(asked, "DESCRIBE", url, login):
                    answer = _describe(file, url, 2, f"Authorization: {words}\r\n")
                    # The second refusal may be without a challenge.
                    answer = answer._replace(challenges=answer.challenges or asked)
    except (OSError, ValueError, http.client.HTTPException):
        return f"{silent}: check path, user and password"
    if answer.status == http.client.OK:
        return (
            f"{silent} that can be read, though it accepts path and login: select H.264 in its settings, or set "
            "OPENCV_FFMPEG_CAPTURE_OPTIONS=rtsp_transport;udp"
        )
    return refusal(
        "rtsp", answer.status, answer.reason, None if login is None else schemes_of(answer.challenges)
    )


def _describe(file: BufferedRWPair, url: str, number: int, more: str = "") -> _RtspAnswer:
    """Ask on an open connection. Raises OSError, ValueError or HTTPException."""
    file.write(f"DESCRIBE {url} RTSP/1.0\r\nCSeq: {number}\r\nAccept: application/sdp\r\n{more}\r\n".encode())
    file.flush()
    version, status, *reason = file.readline(MAX_PART_HEADER_BYTES).decode("latin-1").split(maxsplit=2)
    if not version.startswith("RTSP/"):
        raise ValueError(f"found {version}, expected RTSP")
    headers = http.client.parse_headers(file)
    file.read(min(max(0, int(headers.get("Content-Length", "0"))), MAX_PART_HEADER_BYTES))
    challenges = challenges_of(headers.get_all("WWW-Authenticate", []))
    return _RtspAnswer(int(status), "".join(reason).strip(), challenges)
