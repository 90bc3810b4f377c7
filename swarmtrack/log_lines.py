"""The log of a program: one line on stderr for each thing that happened, whatever a text from outside holds."""

from __future__ import annotations

import logging
import sys
from types import TracebackType

from swarmtrack.plain_text import LONGEST_OF_SEVERAL, plain, plain_lines

AGENT_FORMAT = "%(asctime)s %(levelname)-7s %(name)s: %(message)s"


def log_to_stderr(level: int, format: str = logging.BASIC_FORMAT) -> None:
    """Log from `level` on, unless a log has been set up already. Call once, at the start of a program."""
    shown = logging.StreamHandler(sys.stderr)
    shown.setFormatter(PlainFormatter(format))
    logging.basicConfig(level=level, handlers=[shown])


def plain_warnings() -> None:
    """Programs that set no log up show warnings all the same: Python's last resort, as plain lines."""
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(PlainFormatter("%(message)s"))


class PlainFormatter(logging.Formatter):
    """A message is one line of plain text; a traceback keeps its lines."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        record.message = plain(record.message, LONGEST_OF_SEVERAL)
        return super().formatMessage(record)

    def formatException(
        self,
        ei: tuple[type[BaseException], BaseException, TracebackType | None] | tuple[None, None, None],
    ) -> str:
        return plain_lines(super().formatException(ei))
