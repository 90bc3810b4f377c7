"""Sockets that Zenoh has open but does not expose, from the system's list for this process."""

from __future__ import annotations

import contextlib
import os
import socket
import stat
from collections.abc import Iterator, Set
from pathlib import Path
from typing import Final

DESCRIPTORS: Final = Path("/proc/self/fd")


def own_streams() -> Iterator[socket.socket]:
    """A duplicate of each TCP socket, for the duration of the iteration. None where the system does not list
    descriptors.
    """
    return (copy for _, copy in _ip_sockets() if copy.type == socket.SOCK_STREAM)


def cut_off(ports: Set[int]) -> int:
    """Take from this process every IP socket with one of these ports at either end: the ports become free, and links
    end at their other ends as well. Returns how many there were.

    An unconnected socket takes the place of each, so the descriptors stay valid for their owner, which may close them.
    """
    count = 0
    for descriptor, copy in _ip_sockets():
        if not ports & _ports_of(copy):
            continue
        with socket.socket(copy.family, copy.type) as unconnected, contextlib.suppress(OSError):
            # Where it was closed meanwhile, the descriptor may be that of another file.
            if os.path.sameopenfile(descriptor, copy.fileno()):
                os.dup2(unconnected.fileno(), descriptor, inheritable=False)
                count += 1
    return count


def _ports_of(own: socket.socket) -> set[int]:
    ports = {own.getsockname()[1]}
    with contextlib.suppress(OSError):  # it is not connected
        ports.add(own.getpeername()[1])
    return ports


def _ip_sockets() -> Iterator[tuple[int, socket.socket]]:
    """Descriptor and duplicate of each."""
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
                if copy.family in (socket.AF_INET, socket.AF_INET6):
                    yield descriptor, copy


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
