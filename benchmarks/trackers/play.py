"""One tracker through one take, and its score. `play` is the whole of it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Protocol

import numpy as np

from swarmtrack.benchmarks.report import BenchmarkError
from swarmtrack.benchmarks.trackers import oracle
from swarmtrack.benchmarks.trackers.oracle import ConstantVelocity, Interacting, OracleFilter
from swarmtrack.benchmarks.trackers.scenes import SCENES, Scene, Take, film
from swarmtrack.lab.score.gospa import gospa
from swarmtrack.lab.score.track_score import FoundScore, StatedTracks, score_found, score_named
from swarmtrack.messages import Array, Scan, Track, TrackStatus
from swarmtrack.tracking import AGENT_PARAMETERS, TRACKERS, create_tracker

ORACLES: dict[str, Callable[[int, Scene], OracleFilter]] = {
    "oracle_cv": ConstantVelocity,
    "oracle_imm": Interacting,
}
SMOOTHER = "oracle_cv_rts"
SETTLED = 0.5  # share of a take after which `at(now)` is judged


class Player(Protocol):
    """What of a tracker the benchmark needs; peers come as this, too."""

    @property
    def tracks(self) -> tuple[Track, ...]: ...

    def initiate(self, t: float, points: Array) -> list[int]: ...

    def predict(self, t: float, rotation: Array | None = None, rotation_variance: float = 0.0) -> None: ...

    def update(self, scan: Scan) -> bool: ...

    def at(self, t: float) -> tuple[Track, ...]: ...


MakePlayer = Callable[[Scene, Mapping[str, Any]], Player]


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """One tracker in one run. found: where starts were not told; at_px: RMSE [px] of `at(now)` by latency [s];
    ms_per_scan: median processor time of predict and update."""

    rmse_px: float
    gospa_px: float
    swapped: bool
    lost: bool
    ms_per_scan: float
    found: FoundScore | None = None
    at_px: Mapping[float, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """What a tracker said. claims: of each scan; named (k, n, 2) px: of the tracks started on the targets, NaN once
    gone, None where nobody told the starts; ahead: the same of `at(now)` by latency [s].
    """

    claims: list[StatedTracks]
    named: Array | None
    ahead: dict[float, Array]
    ms_per_scan: float


def play(
    scene: Scene,
    tracker: str,
    parameters: Mapping[str, Any] | None = None,
    run: int = 0,
    *,
    peers: Mapping[str, MakePlayer] | None = None,
) -> Score:
    """Show a tracker (or oracle, or peer) one run of a scene. parameters: over those that the scene tells."""
    take = film(scene, run)
    return score(scene, take, record(scene, take, tracker, parameters, peers=peers))


def record(
    scene: Scene,
    take: Take,
    tracker: str,
    parameters: Mapping[str, Any] | None = None,
    *,
    peers: Mapping[str, MakePlayer] | None = None,
) -> Recording:
    if tracker == SMOOTHER:
        return _oracle_recording(take, {0.0: oracle.smooth(scene, take)}, math.nan)
    if tracker in ORACLES:
        begin = time.thread_time()
        ahead = oracle.follow(ORACLES[tracker](take.truth.shape[1], scene), take, ahead=scene.latencies_s)
        return _oracle_recording(take, ahead, 1e3 * (time.thread_time() - begin) / len(take.t))
    if peers and tracker in peers:
        return _listen(scene, take, peers[tracker](scene, parameters or {}))
    return _listen(scene, take, make_tracker(scene, tracker, parameters))


def make_tracker(scene: Scene, tracker: str, parameters: Mapping[str, Any] | None = None) -> Any:
    """By name, told what the scene tells as far as it has names for it. parameters: over those, by exact names."""
    if tracker not in TRACKERS:
        known = ", ".join([*TRACKERS, *ORACLES, SMOOTHER])
        raise BenchmarkError(f"--tracker: found {tracker!r}, expected one of {known}")
    names = {entry.name for entry in fields(TRACKERS[tracker].Parameters)}
    scene_tells = AGENT_PARAMETERS | dict(scene.told) if scene.untold else scene.parameters()
    told = {name: value for name, value in scene_tells.items() if name in names}
    return create_tracker(tracker, camera=scene.camera, **{**told, **(parameters or {})})


def applies(tracker: str, scene: Scene) -> bool:
    """Whether a tracker can be shown a scene: smoothers need known starts and an observer at rest."""
    return tracker != SMOOTHER or (scene.known_starts and scene.gyro is None)


def _listen(scene: Scene, take: Take, player: Player) -> Recording:
    k, n = take.truth.shape[:2]
    ids: list[int] = []
    claims, named = [], None
    ahead = {latency: np.full((k, n, 2), np.nan) for latency in scene.latencies_s}
    if take.start is not None:
        named = np.full((k, n, 2), np.nan)
        ids = player.initiate(float(take.t[0]), take.start)
        named[0] = take.start
        claims.append(_claim(player.tracks))
    spent = []
    for step, (scan, _, rotation, variance) in enumerate(take.observations, start=len(claims)):
        begin = time.thread_time()
        player.predict(scan.t, rotation, variance)
        player.update(scan)
        spent.append(time.thread_time() - begin)
        tracks = player.tracks
        claims.append(_claim(tracks))
        if named is not None:
            named[step] = _positions(tracks, ids)
            for latency, positions in ahead.items():
                positions[step] = _positions(player.at(scan.t + latency), ids)
    return Recording(claims, named, ahead, 1e3 * float(np.median(spent)))


def late_difference(tracker: str) -> float:
    """The largest difference in the state at the exposures between a tracker that is read at 100 Hz, 300 ms after the
    exposure, and one that is not, over ten seconds: px and px/s."""
    scene = SCENES["latency_manoeuvring"]
    take = film(scene, 0)
    assert take.start is not None
    read, unread = make_tracker(scene, tracker), make_tracker(scene, tracker)
    for player in (read, unread):
        player.initiate(float(take.t[0]), take.start)
    worst = 0.0
    for observation in take.observations[:150]:
        scan = observation.scan
        for player in (read, unread):
            player.predict(scan.t)
            player.update(scan)
        for k in range(7):
            read.at(scan.t + 0.3 + 0.01 * k)
        pairs = zip(read.tracks, unread.tracks, strict=True)
        worst = max(worst, *(float(np.abs(a.mean - b.mean).max()) for a, b in pairs))
    return worst


def _positions(tracks: tuple[Track, ...], ids: list[int]) -> Array:
    """(n, 2) px of the tracks of these ids, NaN for those that are gone."""
    by_id = {track.id: track.mean[::2] for track in tracks}
    gone = np.full(2, np.nan)
    return np.array([by_id.get(track_id, gone) for track_id in ids])


def _claim(tracks: tuple[Track, ...]) -> StatedTracks:
    held = [track for track in tracks if track.status is not TrackStatus.TENTATIVE]
    return StatedTracks(
        np.array([track.id for track in held], np.int64),
        np.array([track.mean[::2] for track in held]).reshape(-1, 2),
        np.array([track.status is TrackStatus.CONFIRMED for track in held], np.bool_),
    )


def _oracle_recording(take: Take, found: dict[float, Array], ms_per_scan: float) -> Recording:
    now = found[0.0]
    claims = []
    for positions in now:
        there = np.flatnonzero(np.isfinite(positions[:, 0]))
        claims.append(StatedTracks(there.astype(np.int64), positions[there], np.ones(len(there), np.bool_)))
    return Recording(claims, None if take.start is None else now, found, ms_per_scan)


def score(scene: Scene, take: Take, recording: Recording) -> Score:
    cost = _mean_gospa(take, recording)
    ms = recording.ms_per_scan
    if recording.named is None:
        found = score_found(take.t, take.truth, recording.claims)
        return Score(found.rmse_px, cost, found.switches > 0, found.untracked_at_end > 0, ms, found)
    judged = score_named(take.truth, recording.named)
    known = [latency for latency in scene.latencies_s if latency in recording.ahead]
    late = {latency: _late_error(take, recording, latency) for latency in known}
    swapped, lost = bool(judged.swapped.any()), bool(judged.lost.any())
    return Score(judged.rmse_px, cost, swapped, lost, ms, at_px=late)


def _late_error(take: Take, recording: Recording, latency: float) -> float:
    settled = int(SETTLED * len(take.t))
    error = recording.ahead[latency][settled:] - take.ahead[latency][settled:]
    return math.sqrt(float(np.nanmean((error**2).sum(axis=2))))


def _mean_gospa(take: Take, recording: Recording) -> float:
    """GOSPA (c = 20 px, p = 2, α = 2), mean over scans; a known start is no scan."""
    begin = 0 if take.start is None else 1
    total = 0.0
    for truth, claim in zip(take.truth[begin:], recording.claims[begin:], strict=True):
        total += gospa(truth[np.isfinite(truth[:, 0])], claim.position).distance
    return total / max(len(take.t) - begin, 1)
