"""Recorded flights through the real perception: every number of every scan, published list and set point.

The recordings are inputs: one agent of each scenario in tests/golden/flights, and the flights behind ArduPilot's SITL
in ../shared/data, where that is present.
"""

from __future__ import annotations

import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from support.golden import FOLDER, Moved, Part
from support.places import SHARED
from swarmtrack.messages import FOREIGN, IdentifiedTrack, Identity, ScanReport, TrackList, TrackStatus
from swarmtrack.recording.reader import Recording, recordings_below
from swarmtrack.recording.settings import read_settings
from swarmtrack.replay.replayer import Replayed, Replayer

RECORDINGS = FOLDER / "flights"
FOREIGN_RECORDINGS = SHARED / "sitl_flights"
KEPT = FOLDER / "flights.npz"

COLUMNS = {
    "scans": (
        "scan", "camera", "track", "status", "identity", "identity probability", "track probability",
        "u px", "u velocity px/s", "v px", "v velocity px/s", "u variance px²", "v variance px²", "width px",
        "height px", "teammate", "north m", "east m", "down m", "north variance m²", "east variance m²",
        "down variance m²",
    ),
    "published": ("time s", "tracks", "sum of u px", "sum of v px"),
    "set points": ("time s", "north m/s", "east m/s", "down m/s", "yaw rate rad/s"),
}  # fmt: skip
COUNTS = {"scan", "camera", "track", "status", "identity", "teammate", "tracks"}
ROUNDING = 1e-5
"""Of numbers above 1 relative, else absolute. Processors differ in last bits, and filters carry these on."""
STATUSES = list(TrackStatus)


def compute() -> dict[str, np.ndarray]:
    """The results of all recordings that are here, by drone and kind."""
    found = {}
    drones = {_name(recording): recording for recording in _recordings()}
    with ProcessPoolExecutor(len(os.sched_getaffinity(0)), mp_context=get_context("spawn")) as pool:
        for name, results in zip(drones, pool.map(replay, drones.values()), strict=True):
            found |= {f"{name}: {kind}": rows for kind, rows in results.items()}
    return found


def _recordings() -> list[Recording]:
    folders = [folder for folder in (RECORDINGS, FOREIGN_RECORDINGS) if folder.is_dir()]
    return [recording for recording in recordings_below(*folders) if recording.kind == "drone"]


def _name(recording: Recording) -> str:
    """`hover-triangle/drone-2`."""
    return "/".join(Path(recording.folder).parts[-3:-1])


def replay(recording: Recording) -> dict[str, np.ndarray]:
    """Tables of one recording, (rows, columns) as `COLUMNS` names them."""
    published: list[TrackList] = []
    replayer = Replayer(recording, read_settings(recording)[0], watcher=published.append)
    replayed = replayer.run()
    return {
        "scans": _table(
            "scans", [_scan_row(scan, entry) for scan in replayed.scans for entry in scan.tracks.tracks]
        ),
        "published": _table("published", [_published_row(tracks, replayed) for tracks in published]),
        "set points": _table(
            "set points",
            [(s.setpoint.t - replayed.begin, *s.velocity, s.yaw_rate) for s in replayed.setpoints],
        ),
    }


def _table(kind: str, rows: list[tuple[float, ...]]) -> np.ndarray:
    return np.array(rows, float).reshape(len(rows), len(COLUMNS[kind]))


def _scan_row(scan: ScanReport, entry: IdentifiedTrack) -> tuple[float, ...]:
    track, place = entry.track, entry.relative
    metres = (
        (np.nan,) * 7 if place is None else (place.drone_id, *place.position, *np.diagonal(place.cov)[:3])
    )
    return (
        scan.sequence, scan.camera, track.id, STATUSES.index(track.status), _number(entry.identity),
        entry.identity_probability, track.probability, *track.mean, track.cov[0, 0], track.cov[2, 2], *track.size,
        *metres,
    )  # fmt: skip


def _number(identity: Identity) -> float:
    return {None: np.nan, FOREIGN: -1.0}.get(identity, identity)


def _published_row(tracks: TrackList, replayed: Replayed) -> tuple[float, ...]:
    places = np.array([entry.track.mean[[0, 2]] for entry in tracks.tracks]).reshape(-1, 2)
    return (tracks.t - replayed.begin, len(places), *places.sum(axis=0))


def load() -> dict[str, np.ndarray]:
    with np.load(KEPT) as kept:
        return dict(kept)


def save(found: dict[str, np.ndarray]) -> None:
    np.savez_compressed(KEPT, **found)


def absent() -> set[str]:
    """What cannot be computed here."""
    ours = {folder.name for folder in RECORDINGS.iterdir()}
    if FOREIGN_RECORDINGS.is_dir():
        return set()
    return {name for name in load() if name.partition("/")[0] not in ours}


def compare(name: str, kept: np.ndarray, found: np.ndarray) -> list[Moved]:
    if len(kept) != len(found):
        return [Moved(name, f"{len(found)} rows, kept are {len(kept)}")]
    columns = COLUMNS[name.rpartition(": ")[2]]
    moved = []
    for column, was, now in zip(columns, kept.T, found.T, strict=True):
        same = (was == now) | (np.isnan(was) & np.isnan(now))
        if same.all():
            continue
        first = int(np.argmin(same))
        apart = np.abs(now - was)
        how = f"{column}: {(~same).sum()} of {len(was)} rows, first {first}: {was[first]:.9g} → {now[first]:.9g}"
        beyond = (
            column in COUNTS or not (apart[~same] <= ROUNDING * np.maximum(1.0, np.abs(was[~same]))).all()
        )
        moved.append(Moved(name, f"{how}, at most {np.nanmax(apart[~same], initial=0.0):.3g}", beyond))
    return moved


PART = Part(compute, load, save, compare, absent)
