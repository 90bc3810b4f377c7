"""What can go wrong where a user can mend it. Bugs raise ordinary exceptions; these carry a sentence for people."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from swarmtrack.plain_text import hide_logins, plain_lines


class SwarmtrackError(Exception):
    """Base of all errors whose text is meant for the person at the keyboard, and may quote anything."""

    def __str__(self) -> str:
        return plain_lines(hide_logins(super().__str__()))


class ConfigError(SwarmtrackError):
    """One or more wrong entries of a config: `problems` holds one line each, `FILE:LINE: key: found, expected`."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems

    def __reduce__(self) -> tuple[type[ConfigError], tuple[list[str]]]:
        """For a process that hands it to another: made again of its problems, not of their text."""
        return type(self), (self.problems,)


class CalibrationError(SwarmtrackError):
    """A camera calibration that cannot be read, or contradicts itself or the stream."""


class ModelError(SwarmtrackError):
    """A detector model that cannot be loaded or whose outputs are not understood."""


class SourceError(SwarmtrackError):
    """A camera or autopilot address that can never work (wrong scheme, missing file), not one that is away."""


class TransportError(SwarmtrackError):
    """The network layer refused to start."""


class KeysError(SwarmtrackError):
    """Keys, certificates or a roster that are missing, unsafe, out of date, or another's."""


class RecordingError(SwarmtrackError):
    """A recording that cannot be read, is none of ours, or cannot be written."""


class MissingExtraError(SwarmtrackError):
    """A package that only some commands need, and that is not installed."""


@contextmanager
def ungrouped(kind: type[SwarmtrackError] = SwarmtrackError) -> Iterator[None]:
    """Raise the first error of a kind by itself, where tasks raise nothing else, however deep: groups of tasks lie in
    groups of tasks. Not by `except*`: before Python 3.11.4 whatever that raises is in a group again."""
    try:
        yield
    except BaseExceptionGroup as group:
        found, others = group.split(kind)
        if found is None or others is not None:
            raise
        error: BaseException = found
        while isinstance(error, BaseExceptionGroup):
            error = error.exceptions[0]
        raise error from None
