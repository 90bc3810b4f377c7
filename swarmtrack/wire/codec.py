"""Messages to bytes and back: the messages of a team's drones, in MessagePack.

Every message is an array whose first element is its version; `docs/wire.md` lists the fields, and each kind has its
module here. The bytes are not trusted, so they are capped in size before anything reads them, then typed and bounded
by msgspec, then checked for what types cannot say. Anything else is a `DecodeError`, and nothing else is ever raised.

On the wire a time is told twice: as UTC, and as its age when the bytes were made, which no wall clock enters.
`utc_offset` is that of `swarmtrack/clock.py` as the bytes are made. Which of the two a reader believes is the
transport's to decide (`transport/sender_clock.py`); it hands over times on our own clock.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, TypeVar

import msgspec

from swarmtrack.wire import announcement, camera, motion, ranging, sightings, strangers, tracks, video
from swarmtrack.wire.announcement import AnnouncementMessage
from swarmtrack.wire.camera import CameraMessage
from swarmtrack.wire.checks import DecodeError, is_finite
from swarmtrack.wire.fields import MAX_MESSAGE_BYTES, WIRE_VERSION, without_last
from swarmtrack.wire.health import HealthMessage
from swarmtrack.wire.motion import MotionMessage
from swarmtrack.wire.ranging import RangeMessage
from swarmtrack.wire.short_form import long_form, short_form
from swarmtrack.wire.sightings import SightingsMessage
from swarmtrack.wire.strangers import StrangersMessage
from swarmtrack.wire.tracks import TracksMessage
from swarmtrack.wire.video import VideoMessage

Message = (
    AnnouncementMessage
    | CameraMessage
    | SightingsMessage
    | MotionMessage
    | RangeMessage
    | StrangersMessage
    | TracksMessage
    | HealthMessage
    | VideoMessage
)
AnyMessage = TypeVar("AnyMessage", bound=Message)

# What is checked of each kind beyond types and bounds.
_CHECKS: dict[type[Any], Callable[[Any], None] | None] = {
    AnnouncementMessage: announcement.check,
    CameraMessage: camera.check,
    SightingsMessage: sightings.check,
    MotionMessage: motion.check,
    RangeMessage: ranging.check,
    StrangersMessage: strangers.check,
    TracksMessage: tracks.check,
    HealthMessage: None,
    VideoMessage: video.check,
}
_DECODERS: dict[type[Any], msgspec.msgpack.Decoder[Any]] = {
    kind: msgspec.msgpack.Decoder(kind) for kind in _CHECKS
}
_ENCODER = msgspec.msgpack.Encoder()
# How NaN and infinity begin in MessagePack, as float64 and float32. Where these bytes do not occur, as nearly always,
# nothing need be looked through; a picture or half a number may hold them by chance.
_PERHAPS_NOT_FINITE = re.compile(rb"\xcb[\x7f\xff][\xf0-\xff]|\xca[\x7f\xff][\x80-\xff]", re.DOTALL)


def encode(message: Message, *, short: bool = False) -> bytes:
    """Bytes of a message. Raises ValueError where a reader would refuse it. short: tracks in their short form.

    Of tracks, fifty times a second, the bounds are checked, which NaN fails too, but not again that covariances are
    such: trackers update in Joseph form.
    """
    data = _ENCODER.encode(message)
    kind = type(message)
    try:
        if isinstance(message, TracksMessage):
            data = short_form(message) if short else tracks.shortened(data, message)
            _typed(kind, data)
        else:
            if isinstance(message, CameraMessage):
                data = camera.shortened(data, message)
            else:
                for _ in range(empty_at_end(message)):
                    data = without_last(data)
            decode(kind, data)
    except DecodeError as error:
        raise ValueError(str(error)) from None
    return data


def empty_at_end(message: Message) -> int:
    """How many of its last fields a message is sent without: those that are empty, and that older readers do not
    have."""
    if isinstance(message, SightingsMessage) and not message.confirmed:
        return 1 if message.leans_on else 2
    return int(isinstance(message, HealthMessage) and message.carried is None)


def decode(kind: type[AnyMessage], data: bytes) -> AnyMessage:
    """The message in these bytes. Raises DecodeError for anything else."""
    if len(data) > MAX_MESSAGE_BYTES:
        raise DecodeError(f"{kind.what}: has more than {MAX_MESSAGE_BYTES} bytes")
    # An array (0x90 | length, or 0xdc and two bytes of it) of another version deserves the better of two error texts.
    version = data[3:4] if data[:1] == b"\xdc" else data[1:2] if data[:1] and data[0] & 0xF0 == 0x90 else b""
    if version and version[0] < 0x80 and version[0] != WIRE_VERSION:
        raise DecodeError(
            f"{kind.what}: is of version {version[0]}, this program reads version {WIRE_VERSION}"
        )
    message = _typed(kind, data)
    if _PERHAPS_NOT_FINITE.search(data) and not is_finite(message):
        raise DecodeError(f"{kind.what}: holds NaN or infinity, expected finite numbers")
    check = _CHECKS[kind]
    if check is not None:
        check(message)
    return message


def _typed(kind: type[AnyMessage], data: bytes) -> AnyMessage:
    """Of the right types and inside the bounds, nothing else."""
    try:
        try:
            message: AnyMessage = _DECODERS[kind].decode(data)
        except msgspec.ValidationError:
            fields = long_form(data) if kind is TracksMessage else None
            if fields is None:
                raise
            message = msgspec.convert(fields, kind)
    except msgspec.ValidationError as error:
        raise DecodeError(f"{kind.what}: {_with_field_name(kind, str(error))}") from None
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise DecodeError(f"{kind.what}: {error} in {len(data)} bytes") from None
    return message


def _with_field_name(kind: type[msgspec.Struct], text: str) -> str:
    """msgspec counts (`$[6][0]`), people name (`position_m[0]`)."""

    def name(match: re.Match[str]) -> str:
        return f"`{kind.__struct_fields__[int(match[1])]}"

    return re.sub(r"`\$\[(\d+)\]", name, text)
