"""Parser of HTTP `multipart/x-mixed-replace` streams. No I/O: bytes and times in, parts out.

Real servers announce boundaries with any number of dashes around them and send another, or announce none, send bare
line feeds, no Content-Length or a wrong one, and may be joined in the middle of a part. So what is looked for is the
boundary without its dashes; and where it does not come, the line that stands in front of an image's header, or without
any, the images themselves.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from swarmtrack.camera_sources.limits import (
    MAX_PART_BYTES,
    MAX_PART_HEADER_BYTES,
    MOST_BOUNDARY_DASHES,
    MOST_JPEG_SEGMENTS,
    SHORT_BOUNDARY,
)

JPEG_START, JPEG_END = b"\xff\xd8", b"\xff\xd9"
_DELIMITER_LINE = re.compile(
    rb"(?:\A|\n)(?![A-Za-z-]{1,40}:[ \t])(-{0,8}[!-~][ -~]{0,70})\r?\n"
    rb"(?:[A-Za-z-]{1,40}:[^\r\n]{0,200}\r?\n){0,8}?(?:Content-Type:[ \t]*image/|Content-Length:[ \t]*\d)",
    re.IGNORECASE,
)
_BARE_START = JPEG_START + b"\xff"


@dataclass(frozen=True, slots=True)
class Part:
    """headers: names in lower case; arrived: time of its last byte."""

    headers: dict[str, str]
    body: bytes
    arrived: float


class MultipartReader:
    """garbage: bytes outside of all parts; oversized: parts beyond MAX_PART_BYTES, dropped."""

    def __init__(self, boundary: str) -> None:
        """boundary: as announced, empty for none."""
        said = boundary.strip().strip('"')
        self._set_boundary(said.encode("latin-1", "replace"))
        self._buffer = bytearray()
        self._old = 0  # bytes of the buffer that came before the present feed
        self._now = self._before = 0.0  # times of this feed and of the one before it
        self._headers: dict[str, str] | None = None  # of the part whose body is being read
        self._searched = 0  # bytes of the body, or of an image without delimiters, that hold no end
        self._has_parts = False
        self._is_bare = False  # images came without any delimiter
        self.garbage = 0
        self.oversized = 0
        self.ended = False  # the closing delimiter was seen

    def feed(self, data: bytes, now: float) -> list[Part]:
        """Take the next bytes; return the parts that are complete."""
        self._old = len(self._buffer)
        self._before, self._now = self._now, now
        self._buffer += data
        parts: list[Part] = []
        while not self.ended:
            if self._headers is None:
                if not self._read_header() and not self._add_bare_to(parts):
                    break
            elif (part := self._read_body(self._headers)) is not None:
                parts.append(part)
            elif self._headers is not None:  # incomplete, not thrown away
                break
        return parts

    def missing(self) -> str:
        """What would have to come for a picture, where none does."""
        if self._headers is not None:
            return f"a part of {len(self._buffer)} bytes so far has no end"
        name = self._core.decode("latin-1")
        return f'no line holds the boundary "{name}"' if name else "no line is a boundary between images"

    def _set_boundary(self, boundary: bytes) -> None:
        self._core = boundary.strip(b"-")
        # Of such a boundary, the two dashes that end a stream cannot be told from its own.
        self._may_end = not boundary.endswith(b"-")
        self._dashes = 2 if len(self._core) < SHORT_BOUNDARY else 0

    def _find(self, start: int, *, in_line: bool = False) -> tuple[int, int]:
        """(first, behind last) byte of the next delimiter, with its dashes in front; (-1, -1) where there is none.

        in_line: at the beginning of a line only.
        """
        while self._core:
            core = self._buffer.find(self._core, start)
            if core < 0:
                break
            before = bytes(self._buffer[max(0, core - MOST_BOUNDARY_DASHES) : core])
            at = core - (len(before) - len(before.rstrip(b"-")))
            if core - at >= self._dashes and (not in_line or self._buffer[max(at - 1, 0) : at] == b"\n"):
                return at, core + len(self._core)
            start = core + 1
        return -1, -1

    def _learn(self) -> bool:
        """Take the line in front of an image's header as the delimiter, whatever was announced."""
        if self._has_parts or self._is_bare:
            return False
        # What came before was searched then, but for a header that came in part.
        found = _DELIMITER_LINE.search(self._buffer, max(0, self._old - MAX_PART_HEADER_BYTES))
        if found is None:
            return False
        dashes, core = len(found[1]) - len(found[1].lstrip(b"-")), found[1].strip(b"-")
        if not core or (core == self._core and dashes >= self._dashes):
            return False
        self._set_boundary(found[1])
        self._dashes = min(self._dashes, dashes)
        return True

    def _drop(self, count: int) -> None:
        del self._buffer[:count]
        self._old = max(0, self._old - count)
        self._searched = max(0, self._searched - count)

    def _read_header(self) -> bool:
        """Find the next delimiter and the headers behind it; False: more bytes are needed."""
        at, start = self._find(0)
        if at < 0:
            if self._learn():
                return True
            # It may have come in part.
            kept = MAX_PART_HEADER_BYTES if not self._has_parts else len(self._core) + MOST_BOUNDARY_DASHES
            at = max(0, len(self._buffer) - kept)
            if not self._has_parts and (bare := self._buffer.find(_BARE_START)) >= 0:
                at = bare
            self.garbage += len(self._buffer[:at].strip())
            self._drop(at)
            return False
        self.garbage += len(self._buffer[:at].strip())
        self._drop(at)
        start -= at
        if self._buffer[start : start + 2] == b"--" and self._may_end:
            self.ended = True
            return False
        ends = [
            (found, len(blank))
            for blank in (b"\r\n\r\n", b"\n\n")
            if (found := self._buffer.find(blank, start)) >= 0
        ]
        end, blank_length = min(ends, default=(len(self._buffer), 0))
        again = self._find(start, in_line=True)[0]
        again = again if again < end else -1
        if again >= 0 or (
            not ends and end > MAX_PART_HEADER_BYTES
        ):  # cut off inside a header, or none at all
            skip = again if again >= 0 else start
            self.garbage += skip
            self._drop(skip)
            return True
        if not ends:
            return False
        lines = bytes(self._buffer[start:end]).decode("latin-1").splitlines()
        pairs = (line.partition(":") for line in lines if ":" in line)
        self._headers = {name.strip().lower(): value.strip() for name, _, value in pairs}
        self._searched = 0
        self._has_parts = True
        self._drop(end + blank_length)
        return True

    def _add_bare_to(self, parts: list[Part]) -> bool:
        """Add the image at the start of the buffer, where there are no delimiters; False: more bytes are needed."""
        while not self._has_parts and self._buffer.startswith(_BARE_START):
            scan = _scan_of(self._buffer)
            if scan is None:
                following = self._buffer.find(_BARE_START, len(JPEG_START))
                self._drop(following if following >= 0 else len(self._buffer) - len(JPEG_START))
                continue
            if (end := self._buffer.find(JPEG_END, max(scan, self._searched - 1))) >= 0:
                self._is_bare = True
                parts.append(self._part({}, end + len(JPEG_END)))
                return True
            self._searched = len(self._buffer)
            if len(self._buffer) <= MAX_PART_BYTES:
                return False
            self.oversized += 1
            self._drop(len(self._buffer))
        return False

    def _read_body(self, headers: dict[str, str]) -> Part | None:
        """The part if it is complete. A part that is thrown away leaves `_headers` None."""
        text = headers.get("content-length", "")
        length = int(text) if text.isascii() and text.isdigit() and len(text) < 16 else 0
        # At the beginning of a line: a short boundary alone does occur by chance in a JPEG.
        at, _ = self._find(max(0, self._searched - len(self._core) - MOST_BOUNDARY_DASHES), in_line=True)
        cut = at - 1 if at > 0 else -1
        self._searched = len(self._buffer)
        if length > MAX_PART_BYTES:
            pass
        elif length and len(self._buffer) >= length and not 0 <= cut < length:
            return self._part(headers, length)
        elif cut >= 0:
            return self._part(headers, cut - self._buffer[:cut].endswith(b"\r"))
        elif not length and self._ends_as_jpeg():
            # The delimiter comes only with the next image: waiting for it would cost a whole period.
            return self._part(headers, len(self._buffer))
        if length > MAX_PART_BYTES or len(self._buffer) > MAX_PART_BYTES:
            self.oversized += 1
            self._headers = None
        return None

    def _ends_as_jpeg(self) -> bool:
        return self._buffer.startswith(JPEG_START) and self._buffer[-4:].rstrip(b"\r\n").endswith(JPEG_END)

    def _part(self, headers: dict[str, str], length: int) -> Part:
        arrived = self._before if length <= self._old else self._now
        part = Part(headers, bytes(self._buffer[:length]), arrived)
        self._drop(length)
        self._headers = None
        return part


def _scan_of(jpeg: bytearray) -> int | None:
    """Where the scan of a JPEG begins, or its end where it has not come; None: it is no JPEG.

    Thumbnails, which have an end of their own, stand in segments in front of it.
    """
    at = len(JPEG_START)
    for _ in range(MOST_JPEG_SEGMENTS):
        if at + 4 > len(jpeg):
            return len(jpeg)
        if jpeg[at] != 0xFF:
            return None
        if jpeg[at + 1] == 0xDA:
            return at
        at += 2 + int.from_bytes(jpeg[at + 2 : at + 4])
    return None
