"""How a program ends that has left a call to Zenoh behind."""

from __future__ import annotations

import os
import sys
import threading

ZENOH_THREADS = "zenoh "  # what `transport.zenoh_session.bounded` names its threads


def end_at_once_if_stuck(code: int) -> None:
    """A program's last act. Everything is closed and written, or was given up.

    A call that waits for a router, or closes sixty links, may come back while the interpreter ends; Rust's code cannot
    bear that and aborts the process.
    """
    if any(thread.name.startswith(ZENOH_THREADS) for thread in threading.enumerate()):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
