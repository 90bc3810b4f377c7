"""Sockets that Zenoh has open but does not expose, from the system's list for this process."""

from __future__ import annotations

import contextlib
import os
import socket
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Final

DESCRIPTORS: Final = Path("/proc/self/fd")


def own_streams() -> Iterator[socket.socket]:
    """A duplicate of each TCP socket, for the duration of the iteration. None where the system does not list
    descriptors.
    """
    try:
        descriptors = [int(name) for name in os.listdir(DESCRIPTORS)]
    except OSError:
        return
    for descriptor in descriptors:
        with contextlib.suppress(OSError):  # it is gone
            copy = _copy(descriptor)
            if copy is None:
                continue
            with copy:
                if copy.type == socket.SOCK_STREAM and copy.family in (socket.AF_INET, socket.AF_INET6):
                    yield copy


def _copy(descriptor: int) -> socket.socket | None:
    """A descriptor of its own: Zenoh may close the original meanwhile."""
    if not stat.S_ISSOCK(os.fstat(descriptor).st_mode):
        return None
    own = os.dup(descriptor)
    try:
        return socket.socket(fileno=own)
    except OSError:
        os.close(own)
        raise
