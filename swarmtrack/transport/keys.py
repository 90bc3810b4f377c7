"""Key expressions `swarmtrack/<team>/v1/<kind>/<id>[/…]`, and the message type of each kind."""

from __future__ import annotations

import re
import secrets
from functools import lru_cache
from typing import Final, NamedTuple

from swarmtrack.messages import MOST_CAMERAS
from swarmtrack.transport.base import Kind
from swarmtrack.transport.limits import USUAL_KEY_LENGTH
from swarmtrack.wire.announcement import AnnouncementMessage
from swarmtrack.wire.camera import CameraMessage
from swarmtrack.wire.codec import Message
from swarmtrack.wire.health import HealthMessage
from swarmtrack.wire.motion import MotionMessage
from swarmtrack.wire.ranging import RangeMessage
from swarmtrack.wire.sightings import SightingsMessage
from swarmtrack.wire.strangers import StrangersMessage
from swarmtrack.wire.tracks import TracksMessage
from swarmtrack.wire.video import VideoMessage

ROOT = "swarmtrack"
KEY_VERSION = "v1"
# Parameters of a query for a pose: announce yourself anew; a put will do, the one that asks is subscribed; it wants to
# know whether you are there, not where.
ANEW, SUBSCRIBED_TOO, LIFE = "anew", "subscribed", "life"
# Answers without a pose: nothing announced yet; I am here.
NOTHING_YET, IS_HERE = b"nothing announced yet", b"here"

ENCODINGS: dict[Kind, str] = {
    Kind.POSE: "application/msgpack;swarmtrack.Announcement/1",
    Kind.CAMERA: "application/msgpack;swarmtrack.Camera/1",
    Kind.IDENTITIES: "application/msgpack;swarmtrack.Sightings/1",
    Kind.MOTION: "application/msgpack;swarmtrack.Motion/1",
    Kind.RANGE: "application/msgpack;swarmtrack.Range/1",
    Kind.STRANGER: "application/msgpack;swarmtrack.Strangers/1",
    Kind.TRACKS: "application/msgpack;swarmtrack.Tracks/1",
    Kind.HEALTH: "application/msgpack;swarmtrack.Health/1",
    Kind.VIDEO: "application/msgpack;swarmtrack.Video/1",
}

ASKED_KINDS: Final = (Kind.POSE, Kind.CAMERA)
"""What is said once, and to whoever asks."""

MESSAGES: dict[Kind, type[Message]] = {
    Kind.POSE: AnnouncementMessage,
    Kind.CAMERA: CameraMessage,
    Kind.IDENTITIES: SightingsMessage,
    Kind.MOTION: MotionMessage,
    Kind.RANGE: RangeMessage,
    Kind.STRANGER: StrangersMessage,
    Kind.TRACKS: TracksMessage,
    Kind.HEALTH: HealthMessage,
    Kind.VIDEO: VideoMessage,
}

_KEY = re.compile(
    rf"{ROOT}/(?P<team>[^/]+)/{KEY_VERSION}/(?P<kind>{'|'.join(Kind)})/(?P<id>[1-9][0-9]{{0,4}})(?P<rest>(/[^/]+)*)"
)
_BOOT = re.compile("[0-9a-f]{8}")
_OTHERS = tuple(map(str, range(1, MOST_CAMERAS)))
"""Numbers of cameras behind the first."""


class Address(NamedTuple):
    """A parsed key."""

    team: str
    kind: Kind
    drone_id: int
    rest: tuple[str, ...]


def key(team: str, kind: Kind | str, *rest: int | str) -> str:
    """`key("red", Kind.ALIVE, 3, "0123abcd")` is `swarmtrack/red/v1/alive/3/0123abcd`; `*` is a wildcard."""
    return "/".join([ROOT, team, KEY_VERSION, str(kind), *map(str, rest)])


def video_key(team: str, drone_id: int | str, camera: int = 0) -> str:
    """Zenoh key of one camera's video; camera 0 has no suffix."""
    return key(team, Kind.VIDEO, drone_id, *([camera] if camera else []))


def camera_of(address: Address) -> int | None:
    """Camera number of a key of `Kind.VIDEO`; None for an invalid one."""
    match address.rest:
        case ():
            return 0
        case (text,) if text in _OTHERS:
            return int(text)
        case _:
            return None


def all_but_video(team: str) -> list[str]:
    """Key expressions of everything except video, which is sent, at a cost, only while there is a subscriber."""
    quiet = (Kind.POSE, Kind.CAMERA, Kind.IDENTITIES, Kind.MOTION, Kind.STRANGER, Kind.TRACKS, Kind.HEALTH)
    in_two_parts = (key(team, kind, "*", "*") for kind in (Kind.ALIVE, Kind.RANGE))
    return [*in_two_parts, *(key(team, kind, "*") for kind in quiet)]


def parse(text: str) -> Address | None:
    """Parts of a key, or None for a foreign one."""
    return _parsed(text) if len(text) <= USUAL_KEY_LENGTH else _parsed.__wrapped__(text)


@lru_cache(maxsize=1024)  # a team says the same few again and again
def _parsed(text: str) -> Address | None:
    match = _KEY.fullmatch(text)
    if match is None or int(match["id"]) > 65535:
        return None
    return Address(match["team"], Kind(match["kind"]), int(match["id"]), tuple(match["rest"].split("/")[1:]))


def is_boot(text: str) -> bool:
    return _BOOT.fullmatch(text) is not None


def new_boot() -> str:
    """ID of one run of a process: 8 random hex digits, because nothing else survives every restart."""
    return secrets.token_hex(4)
