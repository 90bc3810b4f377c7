"""Reload of a roster or certificate that is copied to an agent in flight.

A revoked drone remains a member for all drones with an old roster, and a restart in the air costs a drone its start.
So the folder's files are checked now and then. The CA has signed the roster, and its number only rises: a file that is
half copied, signed by another key or older is rejected, with one log line.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Final

from swarmtrack.clock import Clock
from swarmtrack.errors import KeysError
from swarmtrack.security.credentials import Credentials
from swarmtrack.security.keyfiles import ROSTER, ROSTER_SIGNATURE, certificate_file
from swarmtrack.security.loading import load_credentials

log = logging.getLogger(__name__)

ROSTER_PERIOD_S: Final = 2.0
"""s between two looks at the files."""


class RosterWatch:
    """Watch of the folder that `credentials` were read from."""

    def __init__(self, folder: Path, credentials: Credentials, clock: Clock) -> None:
        self._folder = folder
        self._credentials = credentials
        self._clock = clock
        files = (ROSTER, ROSTER_SIGNATURE, certificate_file(credentials.name))
        self._files = [folder / file for file in files]
        self._seen = self._look()

    def news(self) -> Credentials | None:
        """Content of the files, if newer than the last one. Blocks while files are read."""
        look = self._look()
        if look == self._seen:
            return None
        self._seen = look
        before = self._credentials
        try:
            found = load_credentials(self._folder, before.name, self._clock.utc())
        except KeysError as error:
            log.warning("changed, and rejected: %s", error)
            return None
        if found.roster.number < before.roster.number:
            log.warning(
                "%s: found number %d, expected %d or higher: an old roster is rejected",
                self._folder / ROSTER,
                found.roster.number,
                before.roster.number,
            )
            return None
        if (found.roster, found.expires) == (before.roster, before.expires):
            return None
        self._credentials = found
        return found

    def _look(self) -> list[tuple[int, int] | None]:
        """When each file was written, and how long it is."""
        return [_written(file) for file in self._files]


def _written(file: Path) -> tuple[int, int] | None:
    try:
        status = file.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size
