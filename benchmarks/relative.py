"""How well one plain camera knows where its teammates are, in metres, and whether it knows how well (docs/metres.md).

Teammates wander around an observer that hovers or circles, at a given range at first. Sensors have the errors that were
measured on real frames. The bound is the posterior Cramér-Rao bound along the true flight, by rays and sizes.

* range error: rms of ln(range / truth) in the second half of a flight; NEES / 6: with its 95 % interval over flights.
* bound: of whoever knows by how much teammates' velocities wander: how fast they turn in the image is then a distance.
  The second bound believes in velocities `UNKNOWN_SPEED` times as large; the filter learns how fast they fly.
* to 10 %: s until the median error of the place is below a tenth of the range, and stays there.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from swarmtrack.arguments import count, positive
from swarmtrack.benchmarks.harness import PROCESSES, Flights, Row, option, seeds, several
from swarmtrack.geometry import rotation
from swarmtrack.lab.score.intervals import mean_interval
from swarmtrack.messages import Announcement, Array, MotionReport, RangeReport, SightingReport
from swarmtrack.relative.box_width import BoxWidth
from swarmtrack.relative.log_range import across
from swarmtrack.relative.looks import TeamLook
from swarmtrack.relative.parameters import RelativeParameters
from swarmtrack.relative.reading import OwnMotion
from swarmtrack.relative.states import RelativeStates

RANGES_M = (3.0, 10.0, 40.0)
TEAMMATES = 5
SECONDS, DT = 15.0, 1.0 / 7.0
RAY_SIGMA = 1.5 / 600.0  # rad: of a detection
SPAN_M = 0.5
WANDER_S = 3.0  # of a teammate's velocity; 1 m/s rms, less where it is near
ODOMETRY = 0.02  # m/√s
SAID_SPEED_SIGMA, UWB_SIGMA = 0.1, 0.1
FRAMES_APART_M = 0.42  # per axis, of two drones that started 0.3 m off
NEAREST_M = 1.0  # nobody comes closer
# Times the speed of teammates: who believes in that much learns nothing of a distance from how fast they turn.
UNKNOWN_SPEED = 4.0


class Mode(NamedTuple):
    """What a flight is like. apart: headings, one sigma [rad]; attitude [rad] off for 15 s; every: scans from one thing
    said to the next; late: scans."""

    words: str
    circles: bool = False
    size: tuple[float, float, float] = (0.18, 0.12, 0.06)
    announced: bool = False
    velocity_every: int = 0
    late: int = 0
    apart: float = 0.0
    attitude: float = 0.0
    uwb_every: int = 0
    pose_every: int = 0


GOOD = (0.10, 0.0, 0.11)
MODES = (
    Mode("size of a good detector", size=GOOD),
    Mode("size of a good detector, observer circles", size=GOOD, circles=True),
    Mode("size"),
    Mode("size, announcement", announced=True),
    Mode("size, velocity at 7 Hz", velocity_every=1),
    Mode("size, velocity at 7 Hz, real frames", velocity_every=1, apart=math.radians(3.0), attitude=0.015),
    Mode(
        "size, velocity at 2 Hz and 150 ms late, real frames",
        velocity_every=4,
        late=1,
        apart=math.radians(3.0),
        attitude=0.015,
    ),
    Mode("size, announcement, velocity at 7 Hz", announced=True, velocity_every=1),
    Mode("size, UWB at 2.3 Hz", uwb_every=3),
    Mode("size, announcement, pose at 1 Hz", announced=True, pose_every=7),
)


class Truth(NamedTuple):
    """At each scan: eye (k, 3) m of the observer, place (k, n, 3) m and speed (k, n, 3) m/s of n teammates; eye_speed
    (k, 3) m/s."""

    eye: Array
    eye_speed: Array
    place: Array
    speed: Array


class Judged(NamedTuple):
    """One flight: at each scan of each teammate, (k, n): squared error of place and velocity [m², m²/s²], of
    ln(range), NEES of six, the error of the place as a share of the range, and the bounds of the squared error of
    place, with speeds known and not known; NaN where nothing was stated."""

    place2: Array
    speed2: Array
    log_range2: Array
    nees: Array
    share: Array
    bound2: Array
    unknown2: Array


def speed_sigma(range_m: float) -> float:
    """m/s per axis, of a teammate at that range."""
    return min(1.0, range_m / 10.0)


def wandering(range_m: float, mode: Mode, rng: np.random.Generator) -> Truth:
    """Teammates whose velocity is an Ornstein-Uhlenbeck process, finely stepped; none comes nearer than `NEAREST_M`."""
    steps, fine = int(SECONDS / DT), 10
    t = np.arange(steps) * DT
    phase = rng.uniform(0.0, 2.0 * math.pi)
    eye, eye_speed = np.zeros((steps, 3)), np.zeros((steps, 3))
    if mode.circles:
        w, r = 0.75, 2.0
        eye[:, 0], eye[:, 1] = r * np.cos(w * t + phase), r * np.sin(w * t + phase)
        eye_speed[:, 0], eye_speed[:, 1] = -r * w * np.sin(w * t + phase), r * w * np.cos(w * t + phase)
    places: list[Array] = []
    speeds: list[Array] = []
    while len(places) < TEAMMATES:
        place, speed = _one_flight(range_m, steps * fine, DT / fine, rng)
        place = place[::fine] + eye[0]
        if np.linalg.norm(place - eye, axis=1).min() > NEAREST_M:
            places.append(place)
            speeds.append(speed[::fine])
    return Truth(eye, eye_speed, np.stack(places, axis=1), np.stack(speeds, axis=1))


def _one_flight(range_m: float, steps: int, h: float, rng: np.random.Generator) -> tuple[Array, Array]:
    sigma, left = speed_sigma(range_m), math.exp(-h / WANDER_S)
    kicks = sigma * math.sqrt(1.0 - left * left) * rng.standard_normal((steps, 3))
    v = sigma * rng.standard_normal(3)
    d = rng.standard_normal(3) * (1.0, 0.6, 0.25)
    p = range_m * d / np.linalg.norm(d)
    place, speed = np.empty((steps, 3)), np.empty((steps, 3))
    for k in range(steps):
        place[k], speed[k] = p, v
        new = left * v + kicks[k]
        # Of finely stepped motion: the mean of both ends.
        p, v = p + 0.5 * h * (v + new), new
    return place, speed


def parameters(range_m: float, mode: Mode) -> RelativeParameters:
    """The filter is told what the simulation does."""
    lasting, wander, white = mode.size
    errors = {"drone_sigma": lasting, "wander_sigma": wander, "wander_s": 1.0, "white_sigma": white}
    return RelativeParameters(
        airframe_span_m=SPAN_M,
        box_width=BoxWidth(factor=1.0, **errors),
        speed_sigma=speed_sigma(range_m),
        fellows=0.0,
        forget_s=WANDER_S,
        odometry=ODOMETRY,
        jitter_m=0.0,
        attitude_walk=mode.attitude * math.sqrt(2.0 / 15.0),
        turn_sigma=max(mode.apart, 1e-4),
        place_drift=1e-3,
        turn_drift=1e-4,
    )


def fly(range_m: float, mode: Mode, seed: int, told: RelativeParameters | None = None) -> Judged:
    """One flight; the same arguments give the same. told: what the filter believes, `parameters` by default."""
    rng = np.random.default_rng((seed, round(1000 * range_m)))
    truth = wandering(range_m, mode, rng)
    senses = _Senses(truth, mode, rng)
    states = RelativeStates(told or parameters(range_m, mode))
    bound, unknown = (_Bound(range_m, mode, truth, times) for times in (1.0, UNKNOWN_SPEED))
    for n in range(TEAMMATES if mode.announced else 0):
        states.hear_announcement(senses.announcement(n))
    rows = []
    for k in range(len(truth.eye)):
        look = senses.scan(k)
        states.observe(look)
        senses.deliver_reports(k, states)
        own = OwnMotion(look.camera, look.velocity, np.zeros((3, 3)), mode.attitude**2 * np.eye(3))
        rows.append([*_judged(states, look.t, own, truth, k), bound.step(k), unknown.step(k)])
    return Judged(*(np.array(column) for column in zip(*rows, strict=True)))


def _judged(states: RelativeStates, t: float, own: OwnMotion, truth: Truth, k: int) -> list[Array]:
    """Squared errors of all teammates at scan k, (n,) each."""
    out = np.full((5, TEAMMATES), np.nan)
    for n, state in states.at(t, own).items():
        r, v = truth.place[k, n] - truth.eye[k], truth.speed[k, n] - truth.eye_speed[k]
        e = np.concatenate([state.position - r, state.velocity - v])
        rho = float(np.linalg.norm(r))
        log_range = math.log(float(np.linalg.norm(state.position)) / rho)
        nees = float(e @ np.linalg.solve(state.cov, e))
        place2 = float(e[:3] @ e[:3])
        out[:, n] = place2, float(e[3:] @ e[3:]), log_range**2, nees, math.sqrt(place2) / rho
    return list(out)


def _next(of: Array, sigma: float, left: float, rng: np.random.Generator) -> Array:
    """A Gauss-Markov process one scan later, of which so much is left."""
    return left * of + sigma * math.sqrt(1.0 - left**2) * rng.standard_normal(of.shape)


class _Senses:
    """What the camera, and what the teammates say, of a flight."""

    def __init__(self, truth: Truth, mode: Mode, rng: np.random.Generator) -> None:
        self._truth, self._mode, self._rng = truth, mode, rng
        lasting, wander, _ = mode.size
        self._lasting = lasting * rng.standard_normal(TEAMMATES)
        self._wandering = wander * rng.standard_normal(TEAMMATES)
        self._attitude = mode.attitude * rng.standard_normal(3)
        self._walk = np.zeros(3)
        about = np.column_stack([np.zeros((TEAMMATES, 2)), mode.apart * rng.standard_normal(TEAMMATES)])
        self._turn = rotation.exp(about)
        self._off = FRAMES_APART_M * rng.standard_normal((TEAMMATES, 3))

    def scan(self, k: int) -> TeamLook:
        """Of scan k."""
        truth, mode, rng = self._truth, self._mode, self._rng
        _, wander, white = mode.size
        self._wandering = _next(self._wandering, wander, math.exp(-DT), rng)
        away = truth.place[k] - truth.eye[k]
        rho = np.linalg.norm(away, axis=1)
        d = away / rho[:, None]
        ray = d + (across(d) @ (RAY_SIGMA * rng.standard_normal((TEAMMATES, 2, 1))))[:, :, 0]
        ray = ray @ rotation.exp(self._attitude).T
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        self._attitude = _next(self._attitude, mode.attitude, math.exp(-DT / 15.0), rng)
        size = self._lasting + self._wandering + white * rng.standard_normal(TEAMMATES)
        if k:
            self._walk = self._walk + ODOMETRY * math.sqrt(DT) * rng.standard_normal(3)
        return TeamLook(
            k * DT,
            truth.eye[k] + self._walk,
            truth.eye_speed[k],
            tuple((n + 2, n) for n in range(TEAMMATES)),
            ray,
            np.tile(RAY_SIGMA**2 * np.eye(3), (TEAMMATES, 1, 1)),
            SPAN_M / rho * np.exp(-size),
            np.ones(TEAMMATES),
        )

    def announcement(self, n: int) -> Announcement:
        """Of teammate n, from where it begins."""
        place = self._truth.place[0, n] + self._off[n]
        cov = 0.5 * FRAMES_APART_M**2 * np.eye(3)
        return Announcement(n + 2, "00000000", 0, 0.0, 0.0, place, np.eye(3), cov)

    def deliver_reports(self, k: int, states: RelativeStates) -> None:
        """What is heard after scan k."""
        mode, truth, rng = self._mode, self._truth, self._rng
        for n in range(TEAMMATES):
            if mode.velocity_every and k % mode.velocity_every == 0 and k >= mode.late:
                then = k - mode.late
                said = self._turn[n] @ (truth.speed[then, n] + SAID_SPEED_SIGMA * rng.standard_normal(3))
                cov, t = SAID_SPEED_SIGMA**2 * np.eye(3), then * DT
                states.hear_motion(MotionReport(n + 2, "00000000", k, t, 0.0, np.zeros(3), cov, said, cov))
            if mode.uwb_every and k % mode.uwb_every == 0:
                rho = float(np.linalg.norm(truth.place[k, n] - truth.eye[k]))
                distance = max(rho + UWB_SIGMA * rng.standard_normal(), 0.01)
                states.hear_range(RangeReport(1, n + 2, k * DT, 0.0, distance, UWB_SIGMA))
            if mode.pose_every and k % mode.pose_every == 0:
                place = truth.place[k, n] + self._off[n] + 0.05 * rng.standard_normal(3)
                states.hear_sightings(SightingReport(n + 2, "00000000", k, k * DT, 0.0, place, 0.3, (), ()))


class _Bound:
    """The posterior Cramér-Rao bound of place, velocity and size errors, by rays and sizes alone.

    Tichavský, Muravchik & Nehorai (1998), linear motion.
    """

    def __init__(self, range_m: float, mode: Mode, truth: Truth, times: float) -> None:
        """times: the teammates' speed is believed in."""
        self._mode, self._truth = mode, truth
        self._sigma = times * speed_sigma(range_m)
        self._P: Array = np.empty(0)

    def step(self, k: int) -> Array:
        """(n,) m²: of the squared error of the place at scan k."""
        away = self._truth.place[k] - self._truth.eye[k]
        rho = np.linalg.norm(away, axis=1)
        d = away / rho[:, None]
        lasting, wander, white = self._mode.size
        if not self._P.size:
            self._P = np.zeros((TEAMMATES, 8, 8))
            self._P[:, :3, :3] = 1e4 * np.eye(3)
            self._P[:, 3:6, 3:6] = self._sigma**2 * np.eye(3)
            self._P[:, 6, 6], self._P[:, 7, 7] = lasting**2 + 1e-12, wander**2 + 1e-12
        else:
            F, Q = self._model(wander)
            self._P = F @ self._P @ F.T + Q
        H = np.zeros((TEAMMATES, 3, 8))
        H[:, :2, :3] = across(d).swapaxes(1, 2) / rho[:, None, None]
        H[:, 2, :3] = d / rho[:, None]
        H[:, 2, 6] = H[:, 2, 7] = 1.0
        weights = np.array([RAY_SIGMA, RAY_SIGMA, white]) ** -2.0
        J = np.linalg.inv(self._P) + H.swapaxes(1, 2) @ (weights[:, None] * H)
        self._P = np.asarray(np.linalg.inv(J))
        return np.asarray(np.trace(self._P[:, :3, :3], axis1=1, axis2=2))

    def _model(self, wander: float) -> tuple[Array, Array]:
        """F and Q (8, 8), by the integrals of the process, summed finely."""
        A, F, Q = np.eye(8), np.eye(8), np.zeros((8, 8))
        m = 50
        h = DT / m
        A[:3, 3:6] = h * np.eye(3)
        A[3:6, 3:6] = (1.0 - h / WANDER_S) * np.eye(3)
        A[7, 7] = 1.0 - h
        noise = np.zeros((8, 8))
        noise[:3, :3] = ODOMETRY**2 * np.eye(3)
        noise[3:6, 3:6] = 2.0 * self._sigma**2 / WANDER_S * np.eye(3)
        noise[7, 7] = 2.0 * wander**2
        for _ in range(m):
            F, Q = A @ F, A @ Q @ A.T + h * noise
        return F, Q


def summary(flights: Sequence[Judged]) -> dict[str, Any]:
    """Of one row."""
    half = slice(len(flights[0].nees) // 2, None)
    from_1s = slice(round(1.0 / DT), None)
    nees = np.array([np.nanmean(flight.nees[from_1s]) for flight in flights]) / 6.0
    share = np.nanmedian(np.concatenate([flight.share for flight in flights], axis=1), axis=1)
    far = np.flatnonzero(~(share < 0.1))
    settled = 0.0 if not len(far) else (float(far[-1]) + 1.0) * DT

    def rms(squares: str) -> float:
        found = np.concatenate([getattr(flight, squares)[half] for flight in flights])
        return math.sqrt(float(np.nanmean(found)))

    return {
        "rmse_m": rms("place2"),
        "bound_m": rms("bound2"),
        "bound_speeds_unknown_m": rms("unknown2"),
        "velocity_rmse_m_s": rms("speed2"),
        "range_error": rms("log_range2"),
        "nees6": mean_interval(nees)._asdict(),
        "to_10_percent_s": settled if settled < SECONDS - 1.0 else math.inf,
        "unstated": float(np.mean([np.isnan(flight.nees).mean() for flight in flights])),
    }


def _rows(args: argparse.Namespace) -> list[Row]:
    modes = [MODES[i - 1] for i in args.only or range(1, len(MODES) + 1)]
    return [
        Row(f"{mode.words}, {m:g} m", partial(fly, m, mode), summary, {"mode": mode.words, "range_m": m})
        for mode in modes
        for m in args.ranges
    ]


BENCH = Flights(
    name="relative",
    title="Where teammates are",
    about=f"{{seeds}} flights a row with {{teammates}} teammates each, {SECONDS:g} s at 7 Hz, rays of 2.5 mrad. "
    "The bounds are those of rays and sizes alone, with the speeds of teammates known, and not.",
    seeds=seeds(100, quick=10),
    options=(
        several("--ranges", "at first, m (default: 3 10 40)", RANGES_M, type=positive, metavar="M"),
        option("--only", "these kinds of flights, counted from 1", type=count, nargs="+", metavar="ROW"),
        PROCESSES,
    ),
    rows=_rows,
    facts=lambda args: {"seeds": args.seeds, "teammates": TEAMMATES},
    columns=(
        ("told by", "{mode}"),
        ("range, m", "{range_m:g}"),
        ("RMSE, m", "{rmse_m:.2f}"),
        ("bound, m", "{bound_m:.2f}"),
        ("speeds unknown", "{bound_speeds_unknown_m:.2f}"),
        ("range error, %", "{range_error:.1p}"),
        ("velocity, m/s", "{velocity_rmse_m_s:.2f}"),
        ("NEES / 6", "{nees6:.2f}"),
        ("to 10 %, s", "{to_10_percent_s:.1f}"),
    ),
)
