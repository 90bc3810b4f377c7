"""Console output of an agent: a line per second, and a summary at the end."""

from __future__ import annotations

import logging
import math
import sys
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TextIO

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import IdentifiedTrack, Identity, RelativeState, ScanReport, TrackStatus
from swarmtrack.outputs.drawing import SeenTrack, as_seen, name_of
from swarmtrack.relative.read_out import read_out

log = logging.getLogger(__name__)

# The eight-colour codes that resemble the colours of the annotated video.
ANSI = ["33", "36", "32", "93", "34", "31", "35"]


@dataclass(slots=True)
class TimeInView:
    """When someone was first and last tracked, over how many scans, as which tracks."""

    first_t: float
    last_t: float
    scans: int = 0
    tracks: set[int] = field(default_factory=set)


class Console:
    """Prints to `stream`; `quiet` counts without a word."""

    def __init__(self, *lenses: PinholeCamera, quiet: bool, stream: TextIO = sys.stdout) -> None:
        self._lenses = lenses
        self._quiet = quiet
        self._stream = stream
        self._colour = stream.isatty()
        self._start: float | None = None
        self._last_t = 0.0
        self._scans = self._scans_told = 0
        self._seen: dict[Identity, TimeInView] = {}
        self._report: ScanReport | None = None

    def on_scan(self, report: ScanReport) -> None:
        """Take note of a scan."""
        t = report.tracks.t
        self._start = t if self._start is None else self._start
        self._last_t = t
        self._scans += 1
        self._report = report
        for entry in filter(_is_confirmed, report.tracks.tracks):
            seen = self._seen.setdefault(entry.identity, TimeInView(t, t))
            seen.scans += seen.last_t < t or seen.scans == 0
            seen.last_t = t
            seen.tracks.add(entry.track.id)

    def line(self, footnotes: Iterable[str]) -> None:
        """One line: who is in view, where, how surely; then how the agent is doing."""
        seen = as_seen(self._report, *self._lenses) if self._report and not self._quiet else []
        now = sorted((s for s in seen if _is_confirmed(s.entry)), key=lambda s: _order(s.entry))
        who = ", ".join(map(self._describe, now))
        if self._scans == self._scans_told:  # what was seen once is not what is seen now
            what = "no frame since" if self._scans else "no frame yet"
        else:
            what = f"sees {who or 'no drone'}"
        self._scans_told = self._scans
        # A clock that stands at 0 looks like a program that hangs.
        when = f"{self._elapsed:7.1f} s" if self._scans else 9 * " "
        self._print(f"{when}  {what}   ({', '.join(footnotes)})")

    def summary(self, facts: Iterable[str]) -> None:
        """Teammates seen, and for how long; then the facts, one per line."""
        self._print("")
        self._print(f"Summary of {self._elapsed:.1f} s, {self._scans} scans:")
        for identity, seen in sorted(self._seen.items(), key=lambda item: str(item[0])):
            began = seen.first_t - (self._start or 0.0)
            share = 100.0 * seen.scans / max(self._scans, 1)
            tracks = f"{len(seen.tracks)} track{'s' if len(seen.tracks) > 1 else ''}"
            self._print(
                f"  {name_of(identity):10} in {share:3.0f} % of scans, first at {began:.1f} s, as {tracks}"
            )
        if not self._seen:
            self._print("  no drone was seen")
        for fact in facts:
            self._print(f"  {fact}")

    @property
    def _elapsed(self) -> float:
        return self._last_t - self._start if self._start is not None else 0.0

    def _describe(self, seen: SeenTrack) -> str:
        identity = seen.entry.identity
        sigma = max(seen.cov[0, 0], seen.cov[1, 1]) ** 0.5
        name = name_of(identity) if identity is not None else f"track {seen.entry.track.id} (unknown)"
        if self._colour and isinstance(identity, int):
            name = f"\x1b[1;{ANSI[identity % len(ANSI)]}m{name}\x1b[0m"
        camera = f" of camera {seen.entry.track.camera + 1}" if len(self._lenses) > 1 else ""
        if seen.entry.relative is not None:
            return f"{name}: {self._in_metres(seen, seen.entry.relative)}{camera}"
        return f"{name} at ({seen.centre[0]:.0f}, {seen.centre[1]:.0f}) ± {sigma:.1f} px{camera}"

    def _in_metres(self, seen: SeenTrack, state: RelativeState) -> str:
        """Range, its sigma, and how far to the left or right of the camera's axis."""
        read = read_out(state.position, state.velocity, state.cov)
        (ray,) = self._lenses[seen.entry.track.camera].bearing(seen.centre[None])
        right = round(math.degrees(math.atan2(ray[0], ray[2])))
        where = "ahead" if right == 0 else f"{abs(right)}° {'right' if right > 0 else 'left'}"
        return f"{read.distance:.1f} m ± {read.sigma:.1f}, {where}"

    def _print(self, text: str) -> None:
        if self._quiet:
            return
        try:
            print(text, file=self._stream, flush=True)
        except OSError:  # whoever read us (`| head`, a terminal) has gone: no reason to end a flight
            self._quiet = True
            log.warning("the console is closed: flying on without it")
            with suppress(OSError):
                self._stream.close()  # or Python tries to write the rest once more at its end, and fails


def _is_confirmed(entry: IdentifiedTrack) -> bool:
    return entry.track.status is TrackStatus.CONFIRMED


def _order(entry: IdentifiedTrack) -> tuple[bool, str, int]:
    return entry.identity is None, str(entry.identity), entry.track.id
