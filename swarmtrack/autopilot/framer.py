"""Finds MAVLink frames, version 1 and 2, in the bytes of a link.

pymavlink's own parser throws away the whole length that a false header claims, and with it the good frames inside: one
stray 0xFD in front of each frame costs nine frames of ten. This framer accepts a header only when the CRC behind it
agrees, and otherwise goes on at the next byte, so garbage between frames never costs one of them.
"""

from __future__ import annotations

import re
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import NamedTuple

from pymavlink.dialects.v20 import common

import swarmtrack.mavlink_dialect  # noqa: F401 (adds a message to `common`)
from swarmtrack.autopilot.limits import FRAMED_SENDERS

V1, V2 = 0xFE, 0xFD
HEADER_V1, HEADER_V2 = 6, 10  # bytes, magic included
CRC_LENGTH = 2
SIGNATURE_LENGTH = 13
SIGNED_FRAME_FLAG = 0x01  # the only incompatibility flag there is
LONGEST_FRAME = HEADER_V2 + 255 + CRC_LENGTH + SIGNATURE_LENGTH

HEARTBEAT: int = common.MAVLINK_MSG_ID_HEARTBEAT
# MAVLink 2 and 1: length, flags, sequence, sender and message.
HEARTBEAT_HEADER = re.compile(rb"\xfd\x09[\x00\x01]\x00...\x00\x00\x00|\xfe\x09...\x00", re.DOTALL)
FRAME_MAGIC = re.compile(b"[\xfd\xfe]")
CRC_EXTRA_OF_MESSAGE: dict[int, bytes] = {i: bytes((m.crc_extra,)) for i, m in common.mavlink_map.items()}
PAYLOAD_SIZE: dict[int, int] = {i: m.unpacker.size for i, m in common.mavlink_map.items()}

_crc: Callable[[bytes], int]
try:
    from fastcrc.crc16 import mcrf4xx as _crc

    FAST_CRC = True
except ImportError:
    FAST_CRC = False

    def _crc(data: bytes) -> int:
        return int(common.x25crc(bytearray(data)).crc)


class MavlinkFrame(NamedTuple):
    """One frame with a correct CRC; `data` is all of it, from magic to signature."""

    id: int
    system: int
    component: int
    sequence: int
    signed: bool
    data: bytes


class Framer:
    """Splits a stream, datagrams or records into frames and counts the rest.

    good: frames; good_bytes: in them; bad_bytes: outside of all frames; crc_failures: headers of known messages with a
    wrong CRC; unknown: frames of messages that the dialect lacks. These cannot be checked, so they are never delivered;
    they are distinguished from garbage by ending exactly where the next frame begins.
    """

    def __init__(self) -> None:
        self.good = self.good_bytes = 0
        self.bad_bytes = 0
        self.crc_failures = 0
        self.unknown = 0
        self._sender: Hashable = None
        self._rests: OrderedDict[Hashable, bytes] = OrderedDict()
        """By the sender, the beginning of a frame: of those that do not send just now."""
        self._buffer = bytearray()
        # Offsets into the buffer (negative: already gone). Bytes before `_counted` are accounted for; `_explained`
        # goes further, by `_claims` headers of unknown messages whose claimed ends are not confirmed yet.
        self._counted = 0
        self._explained = 0
        self._claims = 0

    @property
    def pending(self) -> bool:
        """Whether bytes wait for the rest of a frame."""
        return bool(self._buffer)

    def feed(self, data: bytes) -> list[MavlinkFrame]:
        """Take the next bytes of a stream; return the frames that are complete. Holds back at most 280 bytes."""
        if not (self._buffer or self._claims) and (frame := self._whole(data)) is not None:
            return [frame]
        self._buffer += data
        return self._scan(final=False)

    def flush(self) -> list[MavlinkFrame]:
        """The stream fell silent: the pending bytes are not a frame, but may contain one."""
        return self._scan(final=True)

    def feed_from(self, sender: Hashable, data: bytes) -> list[MavlinkFrame]:
        """Take the next datagram of a sender; return the frames that are complete.

        A bridge may cut its stream into datagrams of any length, so the beginning of a frame waits for its rest. Of
        each sender for itself, FRAMED_SENDERS at most.
        """
        if sender != self._sender:
            rest = bytes(self._buffer)
            self.bad_bytes += max(0, -self._counted)
            self._buffer.clear()
            self._counted = self._explained = self._claims = 0
            if rest:
                self._rests[self._sender] = rest
            self._sender = sender
            self._buffer += self._rests.pop(sender, b"")
            while len(self._rests) > FRAMED_SENDERS:
                _, lost = self._rests.popitem(last=False)
                self.bad_bytes += len(lost)
        return self.feed(data)

    def datagram(self, data: bytes) -> list[MavlinkFrame]:
        """The frames of one datagram or record, of which none spans two: a truncated one spoils nothing after it."""
        self.reset()
        self._buffer += data
        return self._scan(final=True)

    def reset(self) -> None:
        """Drop pending bytes (a new connection): they count as bad."""
        self.bad_bytes += sum(map(len, self._rests.values()))
        self._rests.clear()
        self._settle(len(self._buffer), confirmed=False)
        self._cut(len(self._buffer))

    def _scan(self, final: bool) -> list[MavlinkFrame]:
        buffer = self._buffer
        size = len(buffer)
        frames: list[MavlinkFrame] = []
        position = 0
        while (magic := FRAME_MAGIC.search(buffer, position)) is not None:
            start = magic.start()
            if start > self._explained:
                self._settle(start, confirmed=False)
            position = start + 1
            version_2 = buffer[start] == V2
            header = HEADER_V2 if version_2 else HEADER_V1
            if version_2 and size - start >= 3 and buffer[start + 2] & ~SIGNED_FRAME_FLAG:
                continue  # flags that nobody has defined: not a header, or one we could not read
            if size - start < header:
                if final:
                    continue
                position = start
                break
            length = buffer[start + 1]
            total = header + length + CRC_LENGTH
            signed = version_2 and buffer[start + 2] == SIGNED_FRAME_FLAG
            if signed:
                total += SIGNATURE_LENGTH
            message_id = (
                int.from_bytes(buffer[start + 7 : start + 10], "little") if version_2 else buffer[start + 5]
            )
            extra = CRC_EXTRA_OF_MESSAGE.get(message_id)
            if extra is None:
                if start == self._explained:
                    self._claims += 1
                    self._explained = start + total
                continue
            # Newer peers append fields to version 2, so its length proves nothing; version 1 never grows.
            if not version_2 and length > PAYLOAD_SIZE[message_id]:
                continue
            if size - start < total:
                if final:
                    continue
                position = start
                break
            end = start + header + length
            if _crc(bytes(buffer[start + 1 : end]) + extra) != buffer[end] | buffer[end + 1] << 8:
                self.crc_failures += 1
                continue
            position = start + total
            frames.append(self._accept(start, position, message_id, signed))
        else:
            position = size
            if final or self._explained < size:
                self._settle(size, confirmed=self._explained == size)
        self._cut(position)
        return frames

    def _whole(self, data: bytes) -> MavlinkFrame | None:
        """The frame that these bytes are, no less and no more: as most datagrams are. Nothing is pending."""
        size = len(data)
        if size <= HEADER_V2 or data[0] != V2 or size != HEADER_V2 + data[1] + CRC_LENGTH or data[2]:
            return None
        message_id = data[7] | data[8] << 8 | data[9] << 16
        extra = CRC_EXTRA_OF_MESSAGE.get(message_id)
        if extra is None or _crc(data[1:-CRC_LENGTH] + extra) != data[-2] | data[-1] << 8:
            return None
        self.good += 1
        self.good_bytes += size
        return MavlinkFrame(message_id, data[5], data[6], data[4], signed=False, data=data)

    def _accept(self, start: int, end: int, message_id: int, signed: bool) -> MavlinkFrame:
        """Count the frame that stands between these offsets into the buffer, and what is in front of it."""
        self._settle(start, confirmed=start == self._explained)
        self._counted = self._explained = end
        self.good += 1
        self.good_bytes += end - start
        data = bytes(self._buffer[start:end])
        sequence, system, component = data[4:7] if data[0] == V2 else data[2:5]
        return MavlinkFrame(message_id, system, component, sequence, signed, data)

    def _settle(self, end: int, confirmed: bool) -> None:
        """Count the bytes up to `end`: unknown frames where their claimed ends were confirmed, garbage otherwise."""
        if confirmed:
            self.unknown += self._claims
        else:
            self.bad_bytes += end - self._counted
        self._claims = 0
        self._counted = self._explained = end

    def _cut(self, position: int) -> None:
        del self._buffer[:position]
        self._counted -= position
        self._explained -= position
