"""Logs of other programs: which kind a file is of, and an end to reading one that never ends."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import NamedTuple, NoReturn

from swarmtrack.autopilot.limits import LOG_READ_S, LOG_READ_S_PER_MB
from swarmtrack.autopilot.tlog import STAMP_AND_MAGIC, STAMP_LENGTH
from swarmtrack.errors import SourceError

ULOG_MAGIC = b"ULog\x01\x12\x35"
DATAFLASH_MAGIC = b"\xa3\x95"


class LogKind(NamedTuple):
    """scheme: of its address, and the option of `swarmtrack import`; name: in a sentence."""

    scheme: str
    name: str


LOG_KINDS = {
    "tlog": LogKind("tlog", "a ground station's telemetry log (.tlog)"),
    "ulog": LogKind("ulog", "a ULog of PX4 (.ulg)"),
    "bin": LogKind("bin", "a DataFlash log of ArduPilot (.bin)"),
}
# What else people have, and what to do with it.
OTHER_FILES = {
    b"FMT, ": "is a DataFlash log that was turned into text, expected the .bin that it was made of",
    b"PK\x03\x04": "is a ZIP archive, expected the log in it",
    b"\x1f\x8b": "is compressed by gzip, expected the log in it",
    b"\x89MCAP": "is an MCAP recording, expected a log: of swarmtrack's own ones, see `swarmtrack replay`",
    b"\xfd": "is MAVLink without times, as a router or a raw log writes it, expected a telemetry log, which has a "
    "time in front of each frame",
    b"\xfe": "is MAVLink without times, as a router or a raw log writes it, expected a telemetry log, which has a "
    "time in front of each frame",
}


def check_kind(path: Path, scheme: str) -> None:
    """Raises SourceError for a file that cannot be read, or is of another kind than its scheme's."""
    wanted = LOG_KINDS[scheme]
    try:
        with path.open("rb") as file:
            begin = file.read(STAMP_LENGTH + 1)
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror}), expected {wanted.name}") from None
    found = _kind(begin)
    if found is not None and found != wanted:
        raise SourceError(
            f"{path}: is {found.name}, expected {wanted.name}: import it with --{found.scheme}, or write its "
            f"address as {found.scheme}:FILE"
        )
    other = next((text for magic, text in OTHER_FILES.items() if begin.startswith(magic)), None)
    if found is None and other is not None:
        raise SourceError(f"{path}: {other}")
    if found is None and wanted.scheme != "tlog":
        raise SourceError(f"{path}: begins with {begin.hex(' ') or 'nothing'}, expected {wanted.name}")


def _kind(begin: bytes) -> LogKind | None:
    """None for what has no mark of its own: so may a telemetry log whose beginning is damaged."""
    marks = {"ulog": begin.startswith(ULOG_MAGIC[:4]), "bin": begin.startswith(DATAFLASH_MAGIC)}
    marks["tlog"] = STAMP_AND_MAGIC.match(begin) is not None
    return next((LOG_KINDS[scheme] for scheme, marked in marks.items() if marked), None)


@contextlib.contextmanager
def time_limit(path: Path) -> Iterator[None]:
    """Raises SourceError once reading the file has taken much more of the processor than a log of its size does.

    Only Python's main thread can be interrupted; elsewhere nothing is limited.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    seconds = LOG_READ_S + LOG_READ_S_PER_MB * 1e-6 * path.stat().st_size

    def stop(number: int, frame: FrameType | None) -> NoReturn:
        raise SourceError(f"{path}: is not read after {seconds:.2g} s of work: is it damaged?")

    # The system's work for us counts too: a reader that goes through a file byte by byte has it read again and again.
    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)
