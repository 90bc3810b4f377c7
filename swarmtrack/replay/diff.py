"""Difference of two replays of one flight: shared tracks, their distances, and different names.

Scans are paired by the number of their frame, and in each the confirmed tracks one to one within `SAME_TRACK_PX`, the
smallest sum of distances, as many as possible.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from swarmtrack.messages import FOREIGN, Identity, RelativeState, ScanReport, TrackStatus
from swarmtrack.relative.record import relative_record
from swarmtrack.tracking.association import most_likely_matching

SAME_TRACK_PX = 15.0
TRACKS_PARTED_PX = 1.0  # from here on two tracks have parted


class ConfirmedTrack(NamedTuple):
    """One confirmed track, undistorted px; relative: where that teammate is."""

    id: int
    identity: Identity
    u: float
    v: float
    relative: RelativeState | None = None


class SeenScan(NamedTuple):
    """t [s] since the beginning of the recording."""

    sequence: int
    t: float
    tracks: tuple[ConfirmedTrack, ...]


@dataclass(frozen=True, slots=True)
class ScanDiff:
    """One scan in both. rmse_px: of the tracks that were matched, NaN where there are none."""

    t: float
    tracks: tuple[int, int]
    matched: int
    rmse_px: float
    other_names: int


@dataclass(frozen=True, slots=True)
class ReplayDiff:
    """Difference for one drone. one, other: confirmed tracks in all scans; other_names: matched tracks called
    otherwise, of which in unknown_in_one either side does not know. parted_s: the first scan with a track that
    the other does not have, or has elsewhere, or calls otherwise; None: never.
    """

    scans: int
    only_one: int
    only_other: int
    one: int
    other: int
    matched: int
    rmse_px: float
    max_px: float
    other_names: int
    unknown_in_one: int
    parted_s: float | None
    course: tuple[ScanDiff, ...]

    def as_record(self) -> dict[str, Any]:
        """The difference as a record for JSON, without the time series."""
        return {
            "scans": self.scans,
            "scans_only_in_one": self.only_one,
            "scans_only_in_other": self.only_other,
            "tracks_one": self.one,
            "tracks_other": self.other,
            "tracks_matched": self.matched,
            "rmse_px": _number(self.rmse_px),
            "max_px": _number(self.max_px),
            "identities_different": self.other_names,
            "identities_unknown_in_one": self.unknown_in_one,
            "parted_s": self.parted_s,
        }


def seen_scans(reports: Iterable[ScanReport], begin: float) -> list[SeenScan]:
    """Confirmed tracks per scan. begin [s]: of the recording, on the agent's clock."""
    return [
        SeenScan(
            report.sequence,
            report.tracks.t - begin,
            tuple(
                ConfirmedTrack(
                    entry.track.id,
                    entry.identity,
                    float(entry.track.mean[0]),
                    float(entry.track.mean[2]),
                    entry.relative,
                )
                for entry in report.tracks.tracks
                if entry.track.status is TrackStatus.CONFIRMED
            ),
        )
        for report in reports
    ]


def compare(one: Iterable[SeenScan], other: Iterable[SeenScan]) -> ReplayDiff:
    """Compare two lists of scans of the same recording."""
    ones, others = {scan.sequence: scan for scan in one}, {scan.sequence: scan for scan in other}
    common = [sequence for sequence in ones if sequence in others]
    course, squares, unknown = [], [], 0
    parted = None
    for sequence in common:
        a, b = ones[sequence], others[sequence]
        pairs = _pairs(a.tracks, b.tracks)
        distances = [math.hypot(p.u - q.u, p.v - q.v) for p, q in pairs]
        renamed = [(p, q) for p, q in pairs if p.identity != q.identity]
        unknown += sum(None in (p.identity, q.identity) for p, q in renamed)
        squares += [d * d for d in distances]
        rmse = math.sqrt(float(np.mean(np.square(distances)))) if distances else math.nan
        course.append(ScanDiff(a.t, (len(a.tracks), len(b.tracks)), len(pairs), rmse, len(renamed)))
        alike = len(pairs) == len(a.tracks) == len(b.tracks) and not renamed
        if parted is None and not (alike and max(distances, default=0.0) <= TRACKS_PARTED_PX):
            parted = a.t
    return ReplayDiff(
        scans=len(common),
        only_one=len(ones) - len(common),
        only_other=len(others) - len(common),
        one=sum(scan.tracks[0] for scan in course),
        other=sum(scan.tracks[1] for scan in course),
        matched=len(squares),
        rmse_px=math.sqrt(float(np.mean(squares))) if squares else math.nan,
        max_px=math.sqrt(max(squares)) if squares else math.nan,
        other_names=sum(scan.other_names for scan in course),
        unknown_in_one=unknown,
        parted_s=parted,
        course=tuple(course),
    )


def _pairs(
    one: tuple[ConfirmedTrack, ...], other: tuple[ConfirmedTrack, ...]
) -> list[tuple[ConfirmedTrack, ConfirmedTrack]]:
    if not one or not other:
        return []
    a = np.array([(track.u, track.v) for track in one])
    b = np.array([(track.u, track.v) for track in other])
    distance = np.linalg.norm(a[:, None] - b[None], axis=2)
    # A pair is worth more than any sum of distances within the gate, so there are as many as possible.
    rows, columns = most_likely_matching(np.where(distance <= SAME_TRACK_PX, 1e6 - distance, -np.inf))
    return [(one[i], other[j]) for i, j in zip(rows, columns, strict=True)]


def scans_record(scans: Iterable[SeenScan]) -> list[dict[str, Any]]:
    """For JSON; `scans_of` reads it, but for the metres."""
    return [
        {
            "frame": scan.sequence,
            "t_s": scan.t,
            "tracks": [
                {
                    "id": track.id,
                    "identity": track.identity,
                    "u_px": track.u,
                    "v_px": track.v,
                    "relative": None if track.relative is None else relative_record(track.relative),
                }
                for track in scan.tracks
            ],
        }
        for scan in scans
    ]


def scans_of(record: Any) -> list[SeenScan]:
    """Raises KeyError, TypeError or ValueError for what `scans_record` did not write."""
    return [
        SeenScan(
            int(scan["frame"]),
            float(scan["t_s"]),
            tuple(
                ConfirmedTrack(
                    int(part["id"]), _identity(part["identity"]), float(part["u_px"]), float(part["v_px"])
                )
                for part in scan["tracks"]
            ),
        )
        for scan in record
    ]


def _identity(value: Any) -> Identity:
    if value is None or value == FOREIGN:
        return value  # type: ignore[no-any-return]
    return int(value)


def _number(value: float) -> float | None:
    return round(value, 4) if math.isfinite(value) else None
