"""`pose/<id>`, the announcement: ID and start pose of a drone; signed in a team that has keys."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
from msgspec import Meta

from swarmtrack.geometry.rotation import from_quaternion, is_rotation, to_quaternion
from swarmtrack.messages import Announcement
from swarmtrack.wire.checks import check_covariances, check_unit, symmetric, upper_triangle
from swarmtrack.wire.fields import (
    SIGNATURE_BYTES,
    Moment,
    PeerMessage,
    Position,
    Quaternion,
    Seconds,
    peer_fields,
)


class AnnouncementMessage(PeerMessage, frozen=True):
    """`pose/<id>`: ID and start pose of the sender, in the team's NED frame.

    t_utc_s: when the pose held, by the sender's UTC; age_s: how long ago that was when these bytes were made.
    quaternion_wxyz: world from body; position_cov_m2: upper triangle, row by row. signature: see `signed_part`.
    """

    what: ClassVar[str] = "announcement"
    position_m: Position
    quaternion_wxyz: Quaternion
    position_cov_m2: Annotated[tuple[Moment, ...], Meta(min_length=6, max_length=6)]
    age_s: Seconds
    signature: Annotated[bytes, Meta(min_length=SIGNATURE_BYTES, max_length=SIGNATURE_BYTES)] | None = None


def announcement_message(announcement: Announcement, utc_offset: float, now: float) -> AnnouncementMessage:
    """The own announcement as sent at `now`, unsigned. Raises ValueError where its attitude is not a rotation."""
    a = announcement
    if not is_rotation(a.world_from_body):
        raise ValueError("announcement: world_from_body is not a rotation")
    return AnnouncementMessage(
        *peer_fields(a.drone_id, a, utc_offset),
        position_m=tuple(a.position.tolist()),
        quaternion_wxyz=tuple(to_quaternion(a.world_from_body).tolist()),
        position_cov_m2=upper_triangle(a.position_cov),
        age_s=max(0.0, float(now - a.t)),
    )


def check(message: AnnouncementMessage) -> None:
    """Raise DecodeError for an invalid message. Its signature, if any, is not checked."""
    check_unit("announcement: quaternion_wxyz", message.quaternion_wxyz, "a unit quaternion")
    check_covariances("announcement: position_cov_m2", [message.position_cov_m2], 3)


def announcement_from(message: AnnouncementMessage, t: float, t_sigma: float) -> Announcement:
    """A teammate's announcement as the core takes it. t: when the pose held, on our monotonic clock."""
    m = message
    return Announcement(
        drone_id=m.drone_id,
        boot=m.boot,
        sequence=m.sequence,
        t=t,
        t_sigma=t_sigma,
        position=np.array(m.position_m),
        world_from_body=from_quaternion(m.quaternion_wxyz),
        position_cov=symmetric(np.array([m.position_cov_m2]), 3)[0],
    )


# The signature is the last field of eleven. What it covers is the same array without it, so with another first
# byte; the bytes between are taken as they are, which spares signer and reader a canonical form.
_ARRAY_OF_10, _ARRAY_OF_11 = b"\x9a", b"\x9b"
_SIGNATURE_HEAD = bytes([0xC4, SIGNATURE_BYTES])


class SignedPart(NamedTuple):
    """The signed bytes and their signature."""

    signed: bytes
    signature: bytes


def sign_announcement(unsigned: bytes, key: str, sign: Callable[[bytes], bytes]) -> bytes:
    """An announcement's bytes from `encode` with the signature filled in as the last field. key: the key it is sent
    on.
    """
    assert unsigned[:1] == _ARRAY_OF_11, "as encode makes it"
    signature = sign(_signed(key, unsigned[1:-1]))
    return unsigned[:-1] + _SIGNATURE_HEAD + signature


def signed_part(data: bytes, key: str) -> SignedPart | None:
    """Signed part of an announcement's bytes that came on `key`; None unless they are signed in the one valid form."""
    head = data[-SIGNATURE_BYTES - 2 : -SIGNATURE_BYTES]
    if data[:1] != _ARRAY_OF_11 or head != _SIGNATURE_HEAD:
        return None
    return SignedPart(_signed(key, data[1 : -SIGNATURE_BYTES - 2]), data[-SIGNATURE_BYTES:])


def _signed(key: str, fields: bytes) -> bytes:
    return key.encode() + b"\0" + _ARRAY_OF_10 + fields
