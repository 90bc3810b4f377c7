"""Where each identified teammate is: the filter of `log_range.py`, told of scans and of what teammates say.

Theory of operation. A row begins with a name: from the place that the teammate said, where that tells its range better
than the size of its box does, else from that size. It ends with the name and is never handed on to another: a key is a
drone and a track. The belief stands at the last scan. What comes with a time of its own is compared with the belief
of the last scan before that time, and corrects the belief of now by what the two share; `History` keeps, for a second,
how errors moved from scan to scan. That is exact until a row has been corrected so: what is older than that is let go.

Of several cameras one may be late: its look comes after that of another which was exposed later. The belief stays where
it stands, and the look is compared with what the belief makes of that time. What may have happened since is counted as
its noise, which a look some hundredths of a second late hardly feels.

What contradicts the belief is refused and counted: a liar, or a clock that is hours off, costs nothing but the count.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from swarmtrack.messages import (
    RELATIVE_SOURCES,
    Announcement,
    Array,
    MotionReport,
    RangeReport,
    RelativeSource,
    RelativeState,
    SightingReport,
)
from swarmtrack.relative import measurements
from swarmtrack.relative.gates import GATE
from swarmtrack.relative.log_range import (
    ACROSS_RAY,
    HEADING_OFFSET,
    LASTING_SIZE,
    LOG_RANGE,
    PLACE_ERROR,
    STATE_SIZE,
    WANDERING_SIZE,
    Beliefs,
    Drift,
    OwnWay,
    SizeErrors,
    VelocityPrior,
    across,
    cartesian,
    corrected,
    corrected_late,
    decay,
    decay_back,
    nobody,
    predicted,
)
from swarmtrack.relative.looks import TeamLook
from swarmtrack.relative.measurements import Carried, Measured, SizedRange
from swarmtrack.relative.parameters import RelativeParameters
from swarmtrack.relative.priors import (
    BELIEF_HISTORY_S,
    FRAME_RESET_SPEED_M_S,
    MESSAGE_AHEAD_S,
    MOST_INFLATION,
    ODD_BOX_LASTS_S,
    RELATIVE_FARTHEST_M,
    RELATIVE_NEAREST_M,
    REPORTED_PLACE_LASTING_SIGMA_M,
    REPORTED_PLACE_WHITE_SIGMA_M,
    REPORTED_SPEED_CHANGE_M_S2,
    REPORTED_SPEED_WHITE_SIGMA_M_S,
    SURE_SIGHTING_PROBABILITY,
    UNREPORTED_PLACE_SIGMA_M,
    VAGUE_LOG_RANGE,
    VAGUE_PLACE_SIGMA_M,
)
from swarmtrack.relative.reading import OwnMotion, Reading


class _SaidPlace(NamedTuple):
    t: float
    position: Array
    lasting: float
    """m² per axis."""
    source: RelativeSource


@dataclass(slots=True)
class _Moment:
    """The beliefs at a scan; onward (n, 12, 12): by how much of each row's error is left at the next."""

    t: float
    camera: Array
    velocity: Array
    keys: tuple[tuple[int, int], ...]
    beliefs: Beliefs
    onward: Array


class RelativeStates:
    """Filter of all teammates: `observe` every scan, add reports, and read `at` any time."""

    def __init__(self, parameters: RelativeParameters | None = None) -> None:
        self._p = parameters or RelativeParameters()
        width = self._p.box_width
        self._errors = SizeErrors(width.wander_sigma, width.wander_s)
        self._drift = Drift(self._p.place_drift, self._p.turn_drift)
        self._now: _Moment | None = None
        self._before: deque[_Moment] = deque()
        self._said: dict[int, _SaidPlace] = {}
        self._sources: dict[tuple[int, int], set[RelativeSource]] = {}
        self._exact_since: dict[tuple[int, int], float] = {}
        """s: scans before say nothing any more of how errors moved: something late was folded in, or it had ended."""
        self._pace: dict[tuple[int, int], float] = {}
        """m²/s² per axis: how fast each flies."""
        self._odd_since: dict[tuple[int, int], float] = {}
        """s: since when its sizes have been unexpected."""
        self._rays: dict[tuple[int, int], float] = {}
        """By observer and drone: when it last told a ray."""
        self._looked_t = -math.inf
        self._reading: Reading | None = None
        """None: to be made when somebody reads."""
        self.refused = 0
        self.surprised = 0
        self.late = 0

    @property
    def counters(self) -> dict[str, int]:
        """Rejected measurements, unexpected rays, and late reports."""
        return {
            "relative_refused": self.refused,
            "relative_surprised": self.surprised,
            "relative_late": self.late,
        }

    # --- what is seen ---

    def observe(self, look: TeamLook) -> None:
        """A scan; of another camera than the last one also one that was exposed before that."""
        self._reading, self._looked_t = None, look.t
        last = self._now
        late = 0.0 if last is None else max(last.t - look.t, 0.0)
        kept = nobody() if last is None else self._carry(look) if not late else self._look_back(look, late)
        known = () if self._now is None else tuple(key for key in self._now.keys if key in look.keys)
        self._sources = {key: self._sources[key] for key in known}
        self._exact_since, self._pace, self._odd_since = (
            {key: value for key, value in of.items() if key in known}
            for of in (self._exact_since, self._pace, self._odd_since)
        )
        fresh = [
            i for i, key in enumerate(look.keys) if key not in known and math.isfinite(float(look.ray[i, 0]))
        ]
        begun = [self._begun(look, i) for i in fresh]
        t, camera, velocity = look.t, look.camera, look.velocity
        if last is not None and late:
            t, camera, velocity = last.t, last.camera, last.velocity
            keyed = zip(fresh, begun, strict=True)
            u = camera - look.camera
            begun = [self._carried_on(row, look.keys[i], late, u, look.walk) for i, row in keyed]
        beliefs = kept
        for row in begun:
            beliefs = beliefs.joined(row)
        # A name that comes back starts again: what is older is of another row.
        self._exact_since |= {look.keys[i]: t for i in fresh}
        keys = known + tuple(look.keys[i] for i in fresh)
        self._now = _Moment(t, camera, velocity, keys, beliefs, np.empty((0, STATE_SIZE, STATE_SIZE)))

    def _carry(self, look: TeamLook) -> Beliefs:
        """The rows that go on, at the time of the look and corrected by it."""
        last = self._now
        assert last is not None
        dt, u = look.t - last.t, look.camera - last.camera
        if not self._go_on(last, look, dt, u):
            return nobody()
        step = decay(dt, self._prior(last.keys))
        prior, F = predicted(
            last.beliefs, step, self._own_way(u, dt, look.walk), dt=dt, errors=self._errors, drift=self._drift
        )
        found = self._measured(prior, look, last.keys)
        posterior, A = self._corrected(prior, found, look.t, last.keys)
        self._learn_pace(dt, posterior)
        last.onward = A @ F
        self._before.append(last)
        while self._before and self._before[0].t < look.t - BELIEF_HISTORY_S:
            self._before.popleft()
        return posterior

    def _look_back(self, look: TeamLook, late: float) -> Beliefs:
        """The rows that go on, where they are, corrected by a look that was exposed `late` s before."""
        last = self._now
        assert last is not None
        u = look.camera - last.camera
        if not self._go_on(last, look, late, u):
            return nobody()
        step = decay_back(late, self._prior(last.keys))
        then, F = predicted(
            last.beliefs,
            step,
            self._own_way(u, late, look.walk),
            dt=late,
            errors=self._errors,
            drift=self._drift,
        )
        nu, H, R = self._measured(then, look, last.keys)
        since = then.P - F @ last.beliefs.P @ F.swapaxes(1, 2)
        found = Measured(nu, H @ F, R + H @ since @ H.swapaxes(1, 2))
        posterior, last.onward = self._corrected(last.beliefs, found, look.t, last.keys)
        self._before.append(last)
        return posterior

    def _go_on(self, last: _Moment, look: TeamLook, dt: float, u: Array) -> bool:
        """Leave of the last scan only the rows that a look dt s before or after it has as well, none if the own camera
        has leapt by u; whether any is left."""
        stay = [i for i, key in enumerate(last.keys) if key in look.keys]
        if len(stay) < len(last.keys):
            last.keys, last.beliefs = tuple(last.keys[i] for i in stay), last.beliefs.rows(stay)
        if float(u @ u) > (FRAME_RESET_SPEED_M_S * dt + 1.0) ** 2:
            last.keys, last.beliefs, stay = (), nobody(), []
        if not stay:
            self._before.clear()
        return bool(stay)

    def _own_way(self, u: Array, dt: float, walk: float) -> OwnWay:
        return OwnWay(
            u, (self._p.odometry**2 + walk) * dt, self._p.jitter_m**2, self._p.attitude_walk**2 * dt
        )

    def _carried_on(self, row: Beliefs, key: tuple[int, int], dt: float, u: Array, walk: float) -> Beliefs:
        step = decay(dt, self._prior([key]))
        way = self._own_way(u, dt, walk)
        return predicted(row, step, way, dt=dt, errors=self._errors, drift=self._drift)[0]

    def _measured(self, prior: Beliefs, look: TeamLook, keys: tuple[tuple[int, int], ...]) -> Measured:
        """What the look tells of these rows, which stand at its time."""
        rows = [look.keys.index(key) for key in keys]
        near = np.exp(-2.0 * prior.log_range)
        ray_cov = look.ray_cov[rows] + (self._p.jitter_m**2 * near)[:, None, None] * np.eye(3)
        return measurements.seen(prior, look.ray[rows], ray_cov, self._sized(look, rows))

    def _corrected(
        self, prior: Beliefs, found: Measured, t: float, keys: tuple[tuple[int, int], ...]
    ) -> tuple[Beliefs, Array]:
        prior = self._surprised(prior, found, t, keys)
        for key, sized in zip(keys, found.H[:, 2, LOG_RANGE].tolist(), strict=True):
            if sized:
                self._sources[key].add("size")
        return corrected(prior, found.H, found.nu, found.R)

    def _sized(self, look: TeamLook, rows: list[int]) -> SizedRange:
        """What the boxes of these rows of a look tell of their range."""
        gain = look.gain[rows]
        return SizedRange(
            np.log(self._p.width_m / look.width[rows]),
            self._p.lasting_by(gain),
            gain,
            (gain * self._p.box_width.white_sigma) ** 2,
        )

    def _surprised(
        self, prior: Beliefs, found: Measured, t: float, keys: Sequence[tuple[int, int]]
    ) -> Beliefs:
        """The prior, as uncertain as its rays show it to be: the track is the teammate, so that a ray that was not
        expected tells that the belief was wrong. A size may for a moment be that of two drones: it is zeroed, in place;
        for longer it is right, too."""
        S = found.H @ prior.P @ found.H.swapaxes(1, 2) + found.R
        a, b, c = S[:, 0, 0], S[:, 0, 1], S[:, 1, 1]
        x, y = found.nu[:, 0], found.nu[:, 1]
        times = (c * x * x - 2.0 * b * x * y + a * y * y) / (a * c - b * b) / GATE[2]
        by_size = found.nu[:, 2] ** 2 / S[:, 2, 2] / GATE[1]
        for i in np.flatnonzero(found.H[:, 2, LOG_RANGE]).tolist():
            if by_size[i] <= 1.0:
                self._odd_since.pop(keys[i], None)
            elif t - self._odd_since.setdefault(keys[i], t) < ODD_BOX_LASTS_S:
                found.H[i, 2], found.nu[i, 2] = 0.0, 0.0
                self.refused += 1
            else:
                times[i] = max(times[i], by_size[i])
        if not (times > 1.0).any():
            return prior
        self.surprised += int((times > 1.0).sum())
        return replace(prior, P=prior.P * np.clip(times, 1.0, MOST_INFLATION)[:, None, None])

    def _prior(self, keys: Iterable[tuple[int, int]]) -> VelocityPrior:
        return VelocityPrior(np.sqrt([self._pace[key] for key in keys]), self._p.forget_s)

    def _learn_pace(self, dt: float, beliefs: Beliefs) -> None:
        """How fast each teammate flies, from how fast it is known to: soon when it is faster, slowly when not."""
        assert self._now is not None
        found = cartesian(beliefs)
        moves = (found.v * found.v).sum(axis=1) + np.trace(found.cov[:, 3:, 3:], axis1=1, axis2=2)
        for key, pace in zip(self._now.keys, (moves / 3.0).tolist(), strict=True):
            before = self._pace[key]
            over = self._p.quickens_s if pace > before else self._p.calms_s
            share = -math.expm1(-dt / over)
            self._pace[key] = max(before + share * (pace - before), self._p.least_speed**2)

    def _begun(self, look: TeamLook, i: int) -> Beliefs:
        """A row of its own, for look.keys[i]."""
        key, ray = look.keys[i], look.ray[i]
        p = self._p
        P = np.zeros((STATE_SIZE, STATE_SIZE))
        E = across(ray[None])
        P[ACROSS_RAY, ACROSS_RAY] = E[0].T @ look.ray_cov[i] @ E[0]
        P[LASTING_SIZE, LASTING_SIZE], P[WANDERING_SIZE, WANDERING_SIZE] = (
            p.lasting**2,
            p.box_width.wander_sigma**2,
        )
        P[HEADING_OFFSET, HEADING_OFFSET] = p.turn_sigma**2
        said = self._said.get(key[0])
        lasting = UNREPORTED_PLACE_SIGMA_M**2 if said is None else said.lasting
        P[PLACE_ERROR, PLACE_ERROR] = lasting * np.eye(3)
        sized = self._sized(look, [i])
        lasts, wanders = float(sized.lasting[0]), float(sized.wandering[0])
        by_size = (
            (lasts * p.lasting) ** 2 + (wanders * p.box_width.wander_sigma) ** 2 + float(sized.variance[0])
        )
        range_by_size = float(sized.log_range[0])
        sources: set[RelativeSource] = set()
        log_range, variance = math.log(10.0), 1.0
        placed = None if said is None else _along(said, look, i, p.drift_speed)
        if placed is not None and math.isfinite(range_by_size):
            apart = (placed[0] - range_by_size) ** 2 / (placed[1] + by_size)
            self.refused += apart >= GATE[1]
            placed = placed if placed[1] < by_size and apart < GATE[1] else None
        if placed is not None:
            log_range, variance = placed
            # What it says is its place less f: as far as that is wrong, so is the range.
            P[LOG_RANGE, PLACE_ERROR] = P[PLACE_ERROR, LOG_RANGE] = -ray * lasting * math.exp(-log_range)
            assert said is not None
            sources.add(said.source)
        elif math.isfinite(range_by_size):
            log_range, variance = range_by_size, by_size
            P[LOG_RANGE, LASTING_SIZE] = P[LASTING_SIZE, LOG_RANGE] = -lasts * P[LASTING_SIZE, LASTING_SIZE]
            P[LOG_RANGE, WANDERING_SIZE] = P[WANDERING_SIZE, LOG_RANGE] = (
                -wanders * P[WANDERING_SIZE, WANDERING_SIZE]
            )
            sources.add("size")
        log_range = min(max(log_range, math.log(RELATIVE_NEAREST_M)), math.log(RELATIVE_FARTHEST_M))
        P[LOG_RANGE, LOG_RANGE] = variance
        pace = max(p.speed_sigma, p.fellows * math.sqrt(float(look.velocity @ look.velocity)))
        self._pace[key] = pace**2
        speed = pace * math.exp(-log_range)
        for k in (3, 4, 5):
            P[k, k] = speed**2
        row = Beliefs(
            ray[None], E, np.array([log_range]), np.zeros((1, 3)), np.zeros((1, 2)), np.zeros((1, 3)),
            np.zeros(1), P[None],
        )  # fmt: skip
        self._sources[key] = sources
        if "size" not in sources and math.isfinite(range_by_size):
            sources.add("size")
            row = _corrected_by_size(row, look, i, sized)
        return row

    # --- what is said ---

    def hear_announcement(self, said: Announcement) -> None:
        """A teammate's place, and how well it knows it."""
        lasting = 2.0 * float(np.trace(said.position_cov)) / 3.0 + REPORTED_PLACE_LASTING_SIGMA_M**2
        if lasting > VAGUE_PLACE_SIGMA_M**2:
            # It doubts its own place.
            self._said.pop(said.drone_id, None)
            return
        place = _SaidPlace(said.t, said.position, lasting, "announcement")
        self._hear_place(said.drone_id, place, said.t_sigma)

    def hear_motion(self, said: MotionReport) -> None:
        """A teammate's own velocity, at its own time."""
        cov = said.velocity_cov + (
            REPORTED_SPEED_WHITE_SIGMA_M_S**2 + (REPORTED_SPEED_CHANGE_M_S2 * said.t_sigma) ** 2
        ) * np.eye(3)

        def measured(at: Carried, _: _Moment) -> Measured:
            return measurements.said_velocity(at, said.velocity, cov)

        self._fold(said.drone_id, said.t, "velocity", measured)

    def hear_range(self, said: RangeReport) -> bool:
        """A distance to a teammate from this drone. False where that teammate is not in view, or the range was
        rejected.
        """
        sigma = math.hypot(said.sigma, self._p.speed_sigma * said.t_sigma)

        def measured(at: Carried, then: _Moment) -> Measured:
            return measurements.ranged(at, said.distance, sigma, (said.t - then.t) * then.velocity)

        return self._fold(said.other, said.t, "range", measured)

    def hear_sightings(
        self, said: SightingReport, lasting: float | None = None, *, own_var: float = 0.0
    ) -> None:
        """Where a teammate says it is, and on which rays it sees others. lasting: variance per axis of its frame, m²;
        None: as announced. own_var: m², of the own place."""
        if math.hypot(said.position_sigma, math.sqrt(own_var)) > VAGUE_PLACE_SIGMA_M:
            return
        drone = said.observer
        known = self._said.get(drone)
        if lasting is None:
            lasting = UNREPORTED_PLACE_SIGMA_M**2 if known is None else known.lasting
        lasting += own_var
        self._hear_place(drone, _SaidPlace(said.t, said.position, lasting, "pose"), said.t_sigma)
        for seen in said.sightings:
            if seen.probability < SURE_SIGHTING_PROBABILITY or self._row(seen.drone_id) is None:
                continue
            since = min(max(said.t - self._rays.get((drone, seen.drone_id), -math.inf), 0.05), 1e3)
            # Its frame is off for long: many rays count as one.
            often = max(2.0 * self._p.ray_lasts_s / since, 1.0) ** 0.5
            sigma = math.hypot(seen.sigma, often * self._p.ray_sigma)
            origin_sigma = often * math.hypot(said.position_sigma, lasting**0.5)
            if self._fold(seen.drone_id, said.t, "sighting", _ray(said, seen.direction, sigma, origin_sigma)):
                self._rays[drone, seen.drone_id] = said.t

    def reset(self, drone_id: int) -> None:
        """Restart a teammate's state at its next ray, because its reports turned out to be in another frame."""
        self._said.pop(drone_id, None)
        self._reading = None
        now = self._now
        if now is not None:
            stay = [i for i, key in enumerate(now.keys) if key[0] != drone_id]
            now.keys, now.beliefs = tuple(now.keys[i] for i in stay), now.beliefs.rows(stay)

    def _hear_place(self, drone: int, said: _SaidPlace, t_sigma: float) -> None:
        """Fold it in; and keep it for when the name comes back, unless it contradicts what is believed, or is of no
        time that can be: a liar must not spoil what was said before."""
        cov = (REPORTED_PLACE_WHITE_SIGMA_M**2 + (self._p.speed_sigma * t_sigma) ** 2) * np.eye(3)

        def measured(at: Carried, then: _Moment) -> Measured:
            return measurements.said_place(at, said.position - then.camera, cov)

        refused = self.refused
        self._fold(drone, said.t, said.source, measured)
        if self.refused == refused and self._is_newer(drone, said.t):
            self._said[drone] = said

    def _is_newer(self, drone: int, t: float) -> bool:
        """Whether a word of t is newer than what that drone said, and not yet to come."""
        latest = math.inf if self._now is None else self._now.t + MESSAGE_AHEAD_S
        known = self._said.get(drone)
        return t < latest and (known is None or self._now is None or not t < known.t <= latest)

    def _row(self, drone_id: int) -> int | None:
        keys = () if self._now is None else self._now.keys
        return next((i for i, key in enumerate(keys) if key[0] == drone_id), None)

    def _fold(
        self, drone_id: int, t: float, source: RelativeSource, measure: Callable[[Carried, _Moment], Measured]
    ) -> bool:
        """Fold in what was measured at t. False where it is of nobody who is seen, or was not believed."""
        now, row = self._now, self._row(drone_id)
        if now is None or row is None:
            return False
        key = now.keys[row]
        chain = self._chain(key, t)
        if chain is None:
            self.late += 1
            return False
        then = chain[0]
        mine = then.beliefs.row(then.keys.index(key))
        at = Carried.of(mine, decay(t - then.t, self._prior([key])))
        found = measure(at, then)
        shared = mine.P[0] @ found.H.T
        V = found.H @ shared + found.R
        for moment in chain[:-1]:
            shared = moment.onward[moment.keys.index(key)] @ shared
        if not float(found.nu @ np.linalg.solve(V, found.nu)) < GATE[len(found.nu)]:
            self.refused += 1
            return False
        better = corrected_late(now.beliefs.row(row), shared, found.nu, V)
        now.beliefs = now.beliefs.with_row(row, better)
        self._exact_since[key] = now.t
        self._sources[key].add(source)
        self._reading = None
        return True

    def _chain(self, key: tuple[int, int], t: float) -> list[_Moment] | None:
        """The scans from the last before t until now; None where that is too long ago, or t is yet to come."""
        assert self._now is not None
        if not t < self._now.t + MESSAGE_AHEAD_S:
            return None
        chain = [self._now]
        for moment in reversed(self._before):
            if chain[0].t <= t:
                break
            chain.insert(0, moment)
        first = chain[0]
        usable = first.t <= t and key in first.keys and first.t >= self._exact_since.get(key, -math.inf)
        return chain if usable else None

    # --- what is known ---

    def at(self, t: float, own: OwnMotion) -> dict[int, RelativeState]:
        """By track: the states carried on to t, seen from where the own camera is then; of those whose range is known
        at all."""
        if self._now is None:
            return {}
        if self._reading is None:
            self._reading = self._read(self._now)
        return self._reading.at(t, own)

    def _read(self, now: _Moment) -> Reading:
        """For all readers until something changes."""
        stated = np.flatnonzero(now.beliefs.P[:, LOG_RANGE, LOG_RANGE] < VAGUE_LOG_RANGE**2).tolist()
        keys = [now.keys[i] for i in stated]
        sources = [tuple(name for name in RELATIVE_SOURCES if name in self._sources[key]) for key in keys]
        return Reading(
            now.t, now.camera, keys, now.beliefs.rows(stated), self._prior(keys),
            sources=sources, jitter_m=self._p.jitter_m, looked_t=min(self._looked_t, now.t),
        )  # fmt: skip


def _ray(
    said: SightingReport, direction: Array, sigma: float, origin_sigma: float
) -> Callable[[Carried, _Moment], Measured]:
    def measured(at: Carried, then: _Moment) -> Measured:
        return measurements.ray_of_another(at, said.position - then.camera, direction, sigma, origin_sigma)

    return measured


def _corrected_by_size(row: Beliefs, look: TeamLook, i: int, sized: SizedRange) -> Beliefs:
    """A row whose ray was used already, corrected by the size of look.keys[i] alone."""
    missing = np.full_like(look.ray_cov[i], np.nan)
    found = measurements.seen(row, look.ray[i][None], missing[None], sized)
    found.H[:, :2], found.R[:, :2, :2] = 0.0, np.eye(2)
    return corrected(row, found.H, found.nu, found.R)[0]


def _along(said: _SaidPlace, look: TeamLook, i: int, drift_speed: float) -> tuple[float, float] | None:
    """ln(range) and its variance by a said place; None where the ray does not lead there."""
    away = said.position - look.camera
    distance = float(look.ray[i] @ away)
    spread = said.lasting + REPORTED_PLACE_WHITE_SIGMA_M**2 + (drift_speed * (look.t - said.t)) ** 2
    if distance < RELATIVE_NEAREST_M or spread > (VAGUE_LOG_RANGE * distance) ** 2:
        return None
    aside = away - distance * look.ray[i]
    if float(aside @ aside) > GATE[2] * (spread + 0.03**2 * distance**2):
        return None
    return math.log(distance), spread / distance**2
