"""Types of fields on the wire with their bounds, and the largest number of entries of each kind.

The bounds are not physics; they only keep later arithmetic far from overflow.
"""

from __future__ import annotations

from typing import Annotated, Final, Literal, Protocol

import msgspec
from msgspec import Meta

from swarmtrack.messages import MOST_CAMERAS

WIRE_VERSION: Final = 1
# Bytes of one message; checked before anything is decoded.
MAX_MESSAGE_BYTES: Final = 64 * 1024
# 255 tracks of at most 200 bytes stay below MAX_MESSAGE_BYTES.
MAX_TRACKS: Final = 255
MAX_SIGHTINGS: Final = 255
# Leaves room for everything else in a video message.
MAX_JPEG: Final = MAX_MESSAGE_BYTES - 512
# As many drones as a transport remembers.
MAX_KNOWN: Final = 1024
# How arrays begin in MessagePack: of up to 15 elements, and of up to 65535.
_ARRAY, _LONG_ARRAY = 0x90, 0xDC
# Of Ed25519.
SIGNATURE_BYTES: Final = 64

DroneId = Annotated[int, Meta(ge=1, le=65535)]
Boot = Annotated[str, Meta(pattern="^[0-9a-f]{8}$", min_length=8, max_length=8)]
Sequence = Annotated[int, Meta(ge=0, le=2**32 - 1)]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
CameraNumber = Annotated[int, Meta(ge=0, lt=MOST_CAMERAS)]
"""Which of a drone's cameras, from 0."""
Side = Annotated[int, Meta(ge=1, le=65535)]
"""Of an image, px."""

UtcSeconds = Annotated[float, Meta(ge=0.0, le=2.0**32)]
"""Until the year 2106."""
Seconds = Annotated[float, Meta(ge=0.0, le=1e9)]
SignedSeconds = Annotated[float, Meta(ge=-(2.0**33), le=2.0**33)]
Metres = Annotated[float, Meta(ge=-1e7, le=1e7)]
Length = Annotated[float, Meta(ge=0.0, le=1e7)]
Component = Annotated[float, Meta(ge=-1.1, le=1.1)]
"""Of a unit quaternion or vector."""
Pixels = Annotated[float, Meta(ge=-1e7, le=1e7)]
"""Or px/s."""
Moment = Annotated[float, Meta(ge=-1e15, le=1e15)]
"""An entry of a covariance."""
Probability = Annotated[float, Meta(ge=0.0, le=1.0)]
Rate = Annotated[float, Meta(ge=-1e3, le=1e3)]
"""rad/s."""
Quantity = Annotated[float, Meta(ge=-1e15, le=1e15)]

Speed = Annotated[float, Meta(ge=-1e3, le=1e3)]
"""m/s."""

Position = tuple[Metres, Metres, Metres]
Velocity = tuple[Speed, Speed, Speed]
Direction = tuple[Component, Component, Component]
Quaternion = tuple[Component, Component, Component, Component]

LONGEST_NAME: Final = 64
LONGEST_LINE: Final = 256
"""Characters."""
Name = Annotated[str, Meta(max_length=LONGEST_NAME)]
Line = Annotated[str, Meta(max_length=LONGEST_LINE)]


class Record(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True):
    """An array on the wire: fields are positional, none may be missing and none added."""


class PeerMessage(Record, frozen=True):
    """First fields of a message that counts only while its boot lives: sender, sequence number, time."""

    version: Literal[1]
    drone_id: DroneId
    boot: Boot
    sequence: Sequence
    t_utc_s: UtcSeconds
    t_sigma_s: Seconds


def without_last(data: bytes) -> bytes:
    """Bytes of a message without its last field, which is empty or null: of one byte."""
    if data[0] == _LONG_ARRAY:
        fields = int.from_bytes(data[1:3], "big") - 1
        head = bytes([_ARRAY | fields]) if fields < 16 else bytes([_LONG_ARRAY]) + fields.to_bytes(2, "big")
        return head + data[3:-1]
    return bytes([data[0] - 1]) + data[1:-1]


class MessageHeader(Protocol):
    """Header of an own message about one instant."""

    @property
    def boot(self) -> str: ...
    @property
    def sequence(self) -> int: ...
    @property
    def t(self) -> float: ...
    @property
    def t_sigma(self) -> float: ...


def peer_fields(
    drone_id: int, said: MessageHeader, utc_offset: float
) -> tuple[Literal[1], int, str, int, float, float]:
    """Values of the fields of `PeerMessage` for an own message."""
    return WIRE_VERSION, drone_id, said.boot, said.sequence, float(said.t + utc_offset), float(said.t_sigma)
