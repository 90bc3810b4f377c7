"""How a program prints and ends, whatever its stdout is, though its reader has left or a call to Zenoh hangs."""

from __future__ import annotations

import errno
import io
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ZENOH_THREADS = "zenoh "  # what `transport.zenoh_session.bounded` names its threads


def end_at_once_if_stuck(code: int) -> None:
    """A program's last act. Everything is closed and written, or was given up.

    A call that waits for a router, or closes sixty links, may come back while the interpreter ends; Rust's code cannot
    bear that and aborts the process.
    """
    if any(thread.name.startswith(ZENOH_THREADS) for thread in threading.enumerate()):
        for stream in filter(None, (sys.stdout, sys.stderr)):
            stream.flush()
        os._exit(code)


def print_in_any_encoding() -> None:
    """Have what stdout's encoding lacks ("±" in ASCII, half a character in any) printed as "?" instead of an error."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace" if stream is sys.stdout else "backslashreplace")


@contextmanager
def reader_may_leave() -> Iterator[None]:
    """Around all that a program prints: `swarmtrack sim --list | head` has read enough, and nothing has failed. A full
    disk ends the program in a sentence.
    """
    try:
        try:
            yield
        finally:
            if sys.stdout is not None:  # it was closed before we began
                sys.stdout.flush()  # what is left is written as the interpreter ends, where nobody catches anything
    except OSError as error:
        if not isinstance(error, BrokenPipeError) and error.errno != errno.ENOSPC:
            raise
        if sys.stdout is not None:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if error.errno == errno.ENOSPC:
            raise SystemExit(
                f"{Path(sys.argv[0]).name}: {error}, expected space for all that is written"
            ) from None
