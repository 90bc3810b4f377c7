"""The agent's health in a file, once a second, for its supervisor: a container, a person.

A file and no socket: it asks nothing of the agent, it needs no keys, and of an agent that hangs it goes out of date.
Its time is the machine's monotonic clock, which GPS and NTP do not set, and which all containers of a machine share.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

log = logging.getLogger(__name__)

# Names the file where the config does not: an image knows where it may write.
ENVIRONMENT = "SWARMTRACK_HEALTH"


def health_path(configured: Path | None) -> Path | None:
    """`output.health`, else what the environment says; None: not wanted."""
    if configured is not None:
        return configured
    return Path(path) if (path := os.environ.get(ENVIRONMENT)) else None


class HealthFile:
    """Replaced as a whole each time: a reader never sees half of it."""

    def __init__(self, path: Path) -> None:
        self.failed = 0
        self._path = path
        self._next = path.with_name(f".{path.name}.next")

    def write(
        self, health: Mapping[str, Any], *, drone_id: int, now: float, frame_age_s: float | None
    ) -> None:
        """health: a health message as a record. frame_age_s: since the last frame was tracked; None: none was."""
        record = {
            "drone_id": drone_id,
            "written_monotonic_s": round(now, 3),
            "frame_age_s": None if frame_age_s is None else round(frame_age_s, 3),
            "health": health,
        }
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._next.write_text(f"{json.dumps(record)}\n", encoding="utf-8")
            self._next.replace(self._path)
        except OSError as error:  # no reason to end a flight
            if not self.failed:
                log.warning("health file %s: %s; the health in it is out of date", self._path, error.strerror)
            self.failed += 1

    def close(self) -> None:
        """Remove the file: a process that ended has no health."""
        for path in (self._path, self._next):
            with suppress(OSError):
                path.unlink()
