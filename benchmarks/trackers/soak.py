"""Trackers under a million random scans: does anything ever become NaN, lose its positive covariance, or grow?

A scan may hold anything: targets, clutter, nothing, the same detection ten times, NaN, infinity, points a million
pixels off, noise of a thousandth and of a thousand pixels. Time steps are between a microsecond and three seconds, some
scans are late, and the camera turns, now and then by more than it can see. After every scan every number of every
track is looked at; memory is looked at in between: blocks are what Python has allocated, arrays included, and must stay
as many; resident memory also grows by how an allocator tears its heap, and gets a bound.
"""

from __future__ import annotations

import argparse
import gc
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.harness import Benchmark, amount, pool
from swarmtrack.benchmarks.processes import rss_mb
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Array, Track
from swarmtrack.tracking import TRACKERS, Scan, create_tracker

NAME = "soak"
CAMERA = PinholeCamera(430.0, 430.0, 319.5, 239.5, 640, 480)
TARGETS = 6
WARM_UP_TENTHS = 2  # of the scans, after which memory must not grow
MAX_GROWTH_MB = 5.0
# Many times what a track is made of; one block leaked per scan would be 200 000.
MAX_GROWTH_BLOCKS = 2000


@dataclass(frozen=True, slots=True)
class Endurance:
    """What one tracker did. Faults are tracks, counted once a scan; resident_mb, blocks: memory after each tenth of the
    scans; what has grown has done so after the warm-up."""

    tracker: str
    scans: int
    tracks_seen: int
    not_finite: int
    not_positive: int
    not_a_probability: int
    resident_mb: list[float]
    blocks: list[int]

    @property
    def grown_blocks(self) -> int:
        return self.blocks[-1] - self.blocks[WARM_UP_TENTHS - 1]

    @property
    def grown_mb(self) -> float:
        return self.resident_mb[-1] - self.resident_mb[WARM_UP_TENTHS - 1]

    @property
    def ok(self) -> bool:
        faults = self.not_finite + self.not_positive + self.not_a_probability
        return faults == 0 and self.grown_mb < MAX_GROWTH_MB and self.grown_blocks < MAX_GROWTH_BLOCKS


def endure(tracker_name: str, scans: int, seed: int = 0) -> Endurance:
    rng = np.random.default_rng(seed)
    tracker = create_tracker(tracker_name, camera=CAMERA, clutter_per_scan=3.0, lag_s=0.3)
    place = rng.uniform([0.0, 0.0], [640.0, 480.0], (TARGETS, 2))
    t, seen = 0.0, 0
    resident_mb: list[float] = []
    blocks: list[int] = []
    faults = np.zeros(3, int)
    for k in range(scans):
        t += float(rng.choice([1e-6, 1 / 60, 1 / 15, 1 / 7, 3.0], p=[0.01, 0.3, 0.4, 0.28, 0.01]))
        angle = rng.normal(0.0, rng.choice([0.0, 0.02, 1.5], p=[0.5, 0.48, 0.02]), 3)
        tracker.predict(t, rotation.exp(angle), float(rng.choice([0.0, 1e-6, 1e-2])))
        gone, anew = rng.random((TARGETS, 1)) < 0.002, rng.uniform([0.0, 0.0], [640.0, 480.0], (TARGETS, 2))
        place = np.where(gone, anew, place) + rng.normal(0.0, 2.0, (TARGETS, 2))
        tracker.update(_scan(t if rng.random() < 0.99 else t - 1.0, place, rng))
        tracks = (*tracker.tracks, *tracker.smoothed, *tracker.at(t + 0.1, rotation.exp(angle)))
        seen += len(tracks)
        faults += _faults(tracks)
        if 10 * (k + 1) // scans > len(resident_mb):
            gc.collect()  # what waits for its collector is no leak
            resident_mb.append(rss_mb())
            blocks.append(sys.getallocatedblocks())
    finite, positive, probability = faults.tolist()
    return Endurance(tracker_name, scans, seen, finite, positive, probability, resident_mb, blocks)


def _scan(t: float, place: Array, rng: np.random.Generator) -> Scan:
    z = place[rng.random(len(place)) < 0.85]
    z = z + rng.normal(0.0, 1.5, z.shape)
    z = np.concatenate([z, rng.uniform([-50.0, -50.0], [690.0, 530.0], (rng.poisson(3.0), 2))])
    mischief = rng.random()
    if mischief < 0.02:
        z = z[:0]
    elif mischief < 0.04 and len(z):
        z = np.concatenate([z, np.repeat(z[:1], 10, axis=0)])
    elif mischief < 0.08:
        z = np.concatenate([z, [[np.nan, 1.0], [np.inf, -np.inf], [1e6, -1e6], [1e300, 0.0]]])
    m = len(z)
    R = score = size = None
    if rng.random() < 0.3:
        R = (10.0 ** rng.uniform(-6.0, 6.0, m))[:, None, None] * np.eye(2)
    if rng.random() < 0.5:
        score = rng.uniform(0.0, 1.0, m)
        size = rng.choice([np.nan, 0.0, 8.0, 30.0, 1e4], (m, 2))
    return Scan(t, z, R, size, score)


def _faults(tracks: Sequence[Track]) -> tuple[int, int, int]:
    """How many are not finite, have no positive covariance, or an existence that is no probability."""
    if not tracks:
        return 0, 0, 0
    mean, cov = np.array([track.mean for track in tracks]), np.array([track.cov for track in tracks])
    existence = np.array([track.probability for track in tracks])
    finite = np.isfinite(mean).all(axis=1) & np.isfinite(cov).all(axis=(1, 2))
    cov = cov[finite]
    scale = np.sqrt(np.einsum("nii->ni", np.maximum(cov, 1e-300)))
    correlation = cov / (scale[:, :, None] * scale[:, None])
    positive = np.linalg.eigvalsh(correlation)[:, 0] > 0.0
    sound = (existence >= 0.0) & (existence <= 1.0)
    return int((~finite).sum()), int((~positive).sum()), int((~sound).sum())


def _measured(args: argparse.Namespace) -> list[Endurance]:
    """The scans are shared by the trackers, each in a process of its own."""
    rows = []
    one = partial(endure, scans=args.scans // len(TRACKERS))
    with pool(None) as each, report.progress(NAME, len(TRACKERS)) as advance:
        for row in each(one, list(TRACKERS)):
            rows.append(row)
            advance(row.tracker)
    return rows


def _record(rows: list[Endurance]) -> dict[str, Any]:
    derived = ("grown_mb", "grown_blocks", "ok")
    return {"rows": [{**asdict(row), **{name: getattr(row, name) for name in derived}} for row in rows]}


COLUMNS: report.Columns = (
    ("tracker", "{tracker}"),
    ("scans", "{scans:,}"),
    ("tracks looked at", "{tracks_seen:,}"),
    ("not finite", "{not_finite}"),
    ("not positive", "{not_positive}"),
    ("no probability", "{not_a_probability}"),
    ("memory, MB", "{grown_mb:+.1f}"),
    ("blocks", "{grown_blocks:+,}"),
    ("", lambda row: report.verdict(row.ok)),
)


def _page(rows: list[Endurance]) -> str:
    about = (__doc__ or "").split("\n", 2)[2].strip()
    return report.page("# Soak", about, report.table_of(COLUMNS, rows))


BENCH = Benchmark(
    NAME, _measured, _page, options=(amount("--scans", 1_000_000, 4_000, "in all"),), record=_record
)
