"""Parser of HTTP `multipart/x-mixed-replace` streams. No I/O: bytes and times in, parts out.

Real servers announce boundaries with and without the two dashes, send bare line feeds, no Content-Length or a wrong
one, and may be joined in the middle of a part.
"""

from __future__ import annotations

from dataclasses import dataclass

from swarmtrack.camera_sources.limits import MAX_PART_BYTES, MAX_PART_HEADER_BYTES

JPEG_START, JPEG_END = b"\xff\xd8", b"\xff\xd9"


@dataclass(frozen=True, slots=True)
class Part:
    """headers: names in lower case; arrived: time of its last byte."""

    headers: dict[str, str]
    body: bytes
    arrived: float


class MultipartReader:
    """garbage: bytes outside of all parts; oversized: parts beyond MAX_PART_BYTES, dropped."""

    def __init__(self, boundary: str) -> None:
        # Many cameras announce "--name" and send "--name", where the standard says "----name": look for either.
        self._delimiter = b"--" + boundary.strip().strip('"').lstrip("-").encode("latin-1", "replace")
        self._buffer = bytearray()
        self._old = 0  # bytes of the buffer that came before the present feed
        self._now = self._before = 0.0  # times of this feed and of the one before it
        self._headers: dict[str, str] | None = None  # of the part whose body is being read
        self._searched = 0  # bytes of the body that hold no delimiter
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
                if not self._read_header():
                    break
            elif (part := self._read_body(self._headers)) is not None:
                parts.append(part)
            elif self._headers is not None:  # incomplete, not thrown away
                break
        return parts

    def _drop(self, count: int) -> None:
        del self._buffer[:count]
        self._old = max(0, self._old - count)

    def _read_header(self) -> bool:
        """Find the next delimiter and the headers behind it; False: more bytes are needed."""
        at = self._buffer.find(self._delimiter)
        if at < 0:
            at = max(0, len(self._buffer) - len(self._delimiter) + 1)  # it may have come in part
            self.garbage += len(self._buffer[:at].strip())
            self._drop(at)
            return False
        self.garbage += len(self._buffer[:at].strip())
        self._drop(at)
        start = len(self._delimiter)
        if self._buffer[start : start + 2] == b"--":
            self.ended = True
            return False
        ends = [
            (found, len(blank))
            for blank in (b"\r\n\r\n", b"\n\n")
            if (found := self._buffer.find(blank, start)) >= 0
        ]
        end, blank_length = min(ends, default=(len(self._buffer), 0))
        again = self._buffer.find(self._delimiter, start, end)
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
        self._drop(end + blank_length)
        return True

    def _read_body(self, headers: dict[str, str]) -> Part | None:
        """The part if it is complete. A part that is thrown away leaves `_headers` None."""
        text = headers.get("content-length", "")
        length = int(text) if text.isascii() and text.isdigit() and len(text) < 16 else 0
        # With the line feed before it: a short boundary alone does occur by chance in a JPEG.
        cut = self._buffer.find(b"\n" + self._delimiter, max(0, self._searched - len(self._delimiter)))
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
