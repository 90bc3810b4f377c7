"""Credentials of a process on its team's network. Contains no secret itself; `loading` creates it from files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from swarmtrack.security.roster import Roster


@dataclass(frozen=True, slots=True, eq=False)
class Credentials:
    """name: as in the certificate. ca, certificate, key: PEM files, for TLS. expires: end of the certificate's
    validity.

    sign: makes our Ed25519 signature; None for monitors and routers, who announce nothing.
    verify(drone_id, data, signature): whether that drone of the roster signed data.
    """

    name: str
    ca: Path
    certificate: Path
    key: Path
    expires: datetime
    roster: Roster
    sign: Callable[[bytes], bytes] | None
    verify: Callable[[int, bytes, bytes], bool]
