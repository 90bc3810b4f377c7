"""Messages to bytes and back, signed where a key is configured (MAVLink 2 message signing).

pymavlink's check stores a frame's time stamp before it compares the hash, so one forged frame from the far future makes
it refuse every honest one for ever. Here the hash comes first. We never send SETUP_SIGNING: it would change all links
of the autopilot at once, and the key would travel in the clear.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import stat
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.framer import MavlinkFrame
from swarmtrack.autopilot.rapid_messages import RAPID, read_rapidly
from swarmtrack.clock import Clock
from swarmtrack.errors import SourceError

KEY_LENGTH = 32  # bytes
EPOCH = 1_420_070_400  # s UTC: 2015-01-01, where signing's time begins
TICKS_PER_SECOND = 100_000  # signing counts 10 µs
SIGNATURE = 6  # bytes of SHA-256 at the end of a signed frame


def read_key(path: Path) -> bytes:
    """The 32 bytes in `path`: raw, or as 64 hex digits. A file that others may read is refused."""
    try:
        mode = path.stat().st_mode
        content = path.read_bytes()
    except OSError as error:
        raise SourceError(f"MAVLink signing key {path}: {error.strerror}") from error
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise SourceError(
            f"MAVLink signing key {path}: mode is {stat.S_IMODE(mode):04o}, expected 0600 so that no other user "
            f"can read it; run: chmod 600 {path}"
        )
    if len(content) != KEY_LENGTH and re.fullmatch(rb"[0-9a-fA-F]{64}", content.strip()):
        content = bytes.fromhex(content.decode())
    if len(content) != KEY_LENGTH:
        raise SourceError(
            f"MAVLink signing key {path}: holds {len(content)} bytes, expected 32 raw bytes or 64 hex digits"
        )
    return content


class Codec:
    """Encodes messages as (system, component), decodes frames; signs and verifies where a key is given.

    speaks_version_1: whether messages are sent as MAVLink 1, which is never signed.

    signed_good, signed_bad (wrong hash), signed_old (replayed, or from the past), unsigned: frames seen with a key.
    """

    def __init__(self, clock: Clock, system: int, component: int, key: bytes | None = None) -> None:
        self.speaks_version_1 = False
        self.signed_good = 0
        self.signed_bad = 0
        self.signed_old = 0
        self.unsigned = 0
        self._clock = clock
        self._key = key
        self._mav = common.MAVLink(None, system, component)
        self._mav.check_signature = self._check_signature
        if key is not None:
            self._mav.signing.secret_key = key
            self._mav.signing.sign_outgoing = True
            self._mav.signing.link_id = component
            self._follow_wall_time()

    def again(self) -> Codec:
        """Another one that has decoded nothing yet."""
        return Codec(self._clock, self.system, self.component, self._key)

    @property
    def system(self) -> int:
        return int(self._mav.srcSystem)

    @system.setter
    def system(self, system: int) -> None:
        self._mav.srcSystem = system

    @property
    def component(self) -> int:
        return int(self._mav.srcComponent)

    @property
    def key(self) -> bytes | None:
        """32 bytes; None: nothing is signed."""
        return self._key

    @property
    def has_key(self) -> bool:
        return self._key is not None

    def encode(self, message: Any, *, version_2: bool = False) -> bytes:
        """The next frame, with `message` of the dialect as its content. version_2: whatever is spoken else."""
        if self._key is not None:
            self._follow_wall_time()
        # Version 1 has one byte for the message's ID.
        version_1 = self.speaks_version_1 and not version_2 and message.get_msgId() < 256
        data = bytes(message.pack(self._mav, force_mavlink1=version_1))
        self._mav.seq = (self._mav.seq + 1) % 256
        return data

    def decode(self, frame: MavlinkFrame) -> Any | None:
        """The message in the frame, or None: its signature is missing or wrong while we hold a key."""
        if self._key is not None and not frame.signed:
            self.unsigned += 1
            return None
        if frame.id in RAPID:
            is_ours = self._key is None or self._check_signature(
                bytearray(frame.data), frame.system, frame.component
            )
            return read_rapidly(frame) if is_ours else None
        try:
            return self._mav.decode(bytearray(frame.data))
        except common.MAVError:
            return None

    def _check_signature(self, data: bytearray, system: int, component: int) -> bool:
        assert self._key is not None
        expected = hashlib.sha256(self._key + data[:-SIGNATURE]).digest()[:SIGNATURE]
        if not hmac.compare_digest(expected, bytes(data[-SIGNATURE:])):
            self.signed_bad += 1
            return False
        # Only now may the parent touch its memory of time stamps, which is what stops replays.
        if not common.MAVLink.check_signature(self._mav, data, system, component):
            self.signed_old += 1
            return False
        self.signed_good += 1
        return True

    def _follow_wall_time(self) -> None:
        # pymavlink adds one tick a frame. A peer refuses what lags a minute behind, so follow the clock.
        now = int((self._clock.utc() - EPOCH) * TICKS_PER_SECOND)
        self._mav.signing.timestamp = max(self._mav.signing.timestamp, now)
