"""Strangers in view of a team: located by all rays, and numbered.

Every drone computes the same from the same rays: those of its own scans, and those that its teammates send. It sends
rays and no estimates, because an estimate that comes back would count twice. Nothing is computed before the first
stranger is seen; then what teammates' reports of the last seconds show of their headings is taken in first.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from swarmtrack.identity.consensus import OwnView
from swarmtrack.messages import (
    Array,
    LocatedStranger,
    RelativeState,
    RemoteIdClaim,
    SightingReport,
    StrangerRay,
    StrangerReport,
)
from swarmtrack.motion.ego import TeamPose
from swarmtrack.relative.metres import MeasuringCamera
from swarmtrack.relative.parameters import RelativeParameters
from swarmtrack.relative.priors import USUAL_SPAN_M
from swarmtrack.strangers.claims import RemoteIdNews, RemoteIds
from swarmtrack.strangers.mates import MatePlace, MateSight, MateSights
from swarmtrack.strangers.numbers import OwnNumbers
from swarmtrack.strangers.priors import (
    BARRIER_STRANGER_SIGMA_LN,
    EARLY_RAY_S,
    LATE_RAY_S,
    MATE_HEADING_RAD,
    MATE_SIGHT_PERIOD_S,
    MATE_TILT_RAD,
    MAY_BE_MATE_M,
    MAY_BE_MATE_SIGMAS,
    MISFITS_FOR_S,
    MOST_RAY_OBSERVERS,
    MOST_RAYS_OF_REPORT,
    MOST_STRANGERS,
    OWN_RAY_PERIOD_S,
    STRANGER_LASTS_S,
    STRANGER_SEEN_S,
    VAGUE_OBSERVER_M,
    VAGUE_OBSERVER_RAD,
    VAGUE_RAY_S,
)
from swarmtrack.strangers.ray_filter import Errors, Ray, RayFilter
from swarmtrack.strangers.sights import OwnSight, ScannedTracks, own_sight, shows_nothing


class Strangers:
    """Grows by the scans of one drone and by what its teammates send, and is read at any time."""

    def __init__(
        self, drone_id: int, parameters: RelativeParameters, *, cameras: Sequence[MeasuringCamera]
    ) -> None:
        """parameters: of the detector's boxes and the autopilot's tilt; the team's span is none of a stranger's."""
        self._counters: Counter[str] = Counter()
        self._drone_id = drone_id
        self._cameras = tuple(cameras)
        self._tilt_sigma = parameters.tilt_sigma
        self._padding_px = parameters.box_width.padding_px
        self._width_m = USUAL_SPAN_M * parameters.box_width.factor
        self._filter = RayFilter()
        self._mates = MateSights()
        self._numbers = OwnNumbers(drone_id)
        self._errors: dict[int, Errors] = {}
        """By observer, what it states of what lasts."""
        self._seen: dict[int, dict[int, float]] = {}
        """By number and observer, when a ray last fitted, s."""
        self._misfits: dict[tuple[int, int], float] = {}
        """By number and observer, since when its rays do not fit, s."""
        self._sight: OwnSight | None = None
        self._viewed_t = -math.inf
        self._looked: dict[int, float] = {}
        """By own camera, when its rays were last used, s."""
        self._remote_ids = RemoteIds()

    @property
    def counters(self) -> Counter[str]:
        """What was rejected."""
        return self._counters + self._remote_ids.counters

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self._seen)

    # --- what this drone sees, and what its teammates send ---

    def observe(self, scanned: ScannedTracks, observer: TeamPose, view: OwnView | None) -> list[RemoteIdNews]:
        """A scan of one of the cameras. observer: the own pose, as it is stated; view: the rays to teammates in it.
        Returns news of claims by Remote ID."""
        t = observer.t
        if view is not None and t - self._viewed_t >= MATE_SIGHT_PERIOD_S:
            self._viewed_t = t
            self.hear_sightings(view.report(self._drone_id, "", 0, ()))
        lens, body_from_camera, tracker = self._cameras[scanned.camera]
        scan, due = scanned.scan, t - self._looked.get(scanned.camera, -math.inf) >= OWN_RAY_PERIOD_S
        sizes = scan.size if scan.size is not None else np.full((len(scan.z), 2), np.nan)
        sight = own_sight(
            scanned,
            scan.R if scan.R is not None else tracker.measurement_noise(sizes, scan.score),
            observer=observer,
            lens=lens,
            body_from_camera=body_from_camera,
            tilt_sigma=self._tilt_sigma,
            with_rays=due,
            padding_px=self._padding_px,
        )
        if any(sight.tracks.values()):
            self._looked[scanned.camera] = t
        self.take_sight(sight)
        if not self._remote_ids:
            return []
        return self._remote_ids.judge(
            t,
            self.located(t),
            self._mates.places(t).values(),
            lambda place: shows_nothing(
                place, scanned, observer, self._cameras[scanned.camera], self._width_m
            ),
        )

    def hear_claim(self, claim: RemoteIdClaim) -> None:
        """What a drone claims by Remote ID, as this drone's autopilot has received it."""
        self._remote_ids.hear(claim)

    def take_sight(self, sight: OwnSight) -> None:
        """What a scan of this drone shows of strangers."""
        t = sight.t
        for track, number in self._numbers.keep(sight.tracks.keys()).items():
            if track in sight.alive:
                # It may be a teammate after all; one that has left the picture still is a stranger.
                self._withdraw(number)
        if not sight.tracks or any(sight.tracks.values()):
            self._sight = sight
        if _is_vague(sight.errors) or not (sight.tracks or self._seen):
            self._forget_old(t)
            return
        self._errors[self._drone_id] = sight.errors
        if self._seen:
            self._calibrate()
        for track, seen in sight.tracks.items():
            if seen is not None:
                self._follow(track, self._ray(self._drone_id, sight, seen), sight.foreign)
        self._forget_old(t)

    def hear(self, report: StrangerReport, now: float | None) -> None:
        """A teammate sees strangers. now [s]; None: unknown, so that its time cannot be checked."""
        errors = Errors(report.position_sigma, report.tilt_sigma, report.heading_sigma)
        if _is_vague(errors) or report.t_sigma > VAGUE_RAY_S:
            self._counters["strangers_vague"] += 1
            return
        if now is None or not now - LATE_RAY_S <= report.t <= now + EARLY_RAY_S:
            self._counters["strangers_late"] += 1
            return
        if not self._admits(report.observer):
            self._counters["strangers_crowded"] += 1
            return
        self._errors[report.observer] = errors
        if self._seen:
            self._calibrate()
        self._counters["strangers_crowded"] += max(len(report.rays) - MOST_RAYS_OF_REPORT, 0)
        for seen in report.rays[:MOST_RAYS_OF_REPORT]:
            self._take(seen.number, self._ray(report.observer, report, seen))
        told = {seen.number for seen in report.rays}
        for number, by_observer in list(self._seen.items()):
            gone = report.t - by_observer.get(report.observer, math.inf) > STRANGER_SEEN_S
            if gone and number not in told and len(by_observer) == 1:
                # Its only observer reports others: it has taken another number.
                self._end(number)
        self._forget_old(report.t)

    def hear_sightings(self, report: SightingReport) -> None:
        """Where a drone of the team is, and on which rays it sees teammates."""
        self._mates.hear(report)

    def forget(self, drone_id: int) -> None:
        """Nothing that was sent in its name counts any more."""
        self._mates.forget(drone_id)
        self._filter.forget(drone_id)
        self._errors.pop(drone_id, None)
        for by_observer in self._seen.values():
            by_observer.pop(drone_id, None)
        self._seen = {n: seen for n, seen in self._seen.items() if seen and n in self._filter.numbers}

    # --- what is known ---

    def located(self, t: float) -> tuple[LocatedStranger, ...]:
        """All strangers at t, by number; those that are where a teammate is are left out."""
        if not self._seen:
            return ()
        mates, claimed = self._mates.places(t), self._remote_ids.of_number
        found = []
        for number in sorted(self._seen):
            place = self._filter.place(number, t)
            seen = self._seen[number]
            observers = tuple(sorted(o for o, last in seen.items() if t - last <= STRANGER_SEEN_S))
            one = LocatedStranger(number, t, *place, observers, claimed.get(number, ""))
            if not (len(seen) > 1 and _may_be_mate(one, mates)):
                found.append(one)
        return tuple(found)

    @property
    def by_track(self) -> dict[int, int]:
        """The numbers of this drone's own tracks of strangers."""
        return self._numbers.by_track

    def report(self, boot: str, sequence: int) -> StrangerReport | None:
        """What this drone sends of its last scan; None where it saw no stranger."""
        sight, numbers = self._sight, self._numbers.by_track
        if sight is None or _is_vague(sight.errors):
            return None
        seen = [(numbers[track], one) for track, one in sight.tracks.items() if one and track in numbers]
        if not seen:
            return None
        return StrangerReport(
            observer=self._drone_id,
            boot=boot,
            sequence=sequence,
            t=sight.t,
            t_sigma=sight.t_sigma,
            position=sight.position,
            position_sigma=sight.errors.place,
            tilt_sigma=sight.errors.tilt,
            heading_sigma=sight.errors.heading,
            rays=tuple(
                StrangerRay(number, one.direction, one.sigma, one.width)
                for number, one in seen[:MOST_RAYS_OF_REPORT]
            ),
            located=self.located(sight.t),
        )

    def obstacles(self, t: float, place: Array, velocity: Array) -> dict[int, RelativeState]:
        """Strangers that several observers have located, from a drone at place (3,) m with its velocity (3,) m/s; by
        the negative of their numbers. A guess by one teammate's boxes is none: this drone keeps clear of its own."""
        states = {}
        for one in self.located(t):
            r = one.position - place
            distance = float(np.linalg.norm(r))
            spread = math.sqrt(float(np.linalg.eigvalsh(one.cov[:3, :3])[-1]))
            if (
                distance > 0.0
                and len(self._seen[one.number]) > 1
                and spread < BARRIER_STRANGER_SIGMA_LN * distance
            ):
                states[-one.number] = RelativeState(
                    0, t, r, one.velocity - velocity, one.cov, spread / distance, ("sighting",)
                )
        return states

    # --- inside ---

    def _ray(self, observer: int, report: OwnSight | StrangerReport, seen: StrangerRay) -> Ray:
        range_ln = math.log(self._width_m / seen.width) if seen.width > 0.0 else math.nan
        return Ray(
            observer, report.t, report.position, seen.direction, seen.sigma, self._errors[observer], range_ln,
            report.t_sigma,
        )  # fmt: skip

    def _follow(self, track: int, ray: Ray, foreign: Collection[int]) -> None:
        """A ray of an own track: to the stranger whose number it has, and to those whose number it may take."""
        t, numbers = ray.t, self._numbers
        by_mates = {
            n
            for n, seen in self._seen.items()
            if any(o != self._drone_id and t - last <= STRANGER_SEEN_S for o, last in seen.items())
        }
        candidates = numbers.candidates(track, self._seen, by_mates, t)
        self._filter.predict(t)
        numbers.add_fits(track, {n: self._filter.fit(n, ray) for n in candidates}, t)
        number = numbers.chosen(track, t)
        if number is None and track in foreign:
            number = numbers.claims(track, t, self._seen.keys())
        if number is not None:
            had = numbers.take(track, number)
            if had is not None:
                self._withdraw(had)
        number = numbers.by_track.get(track)
        if number is not None:
            numbers.mark_fit(track, fits=self._take(number, ray), t=t)

    def _take(self, number: int, ray: Ray) -> bool:
        """A ray to a stranger of that number; one that is unknown begins with it. False where it does not fit."""
        key = number, ray.observer
        if number in self._seen:
            fits = self._filter.fold(number, ray)
            if not fits:
                self._counters["stranger_rays_refused"] += 1
                since = self._misfits.setdefault(key, ray.t)
                others = [last for o, last in self._seen[number].items() if o != ray.observer]
                if ray.t - since < MISFITS_FOR_S or ray.t - max(others, default=-math.inf) < STRANGER_SEEN_S:
                    return False
                # Nobody else sees it: it is not where it was.
                self._end(number)
        if number not in self._seen:
            if len(self._seen) >= MOST_STRANGERS:
                self._counters["strangers_crowded"] += 1
                return False
            if not self._seen:
                self._calibrate()
            self._filter.begin(number, ray)
        self._misfits.pop(key, None)
        self._seen.setdefault(number, {})[ray.observer] = ray.t
        return True

    def _withdraw(self, number: int) -> None:
        """What this drone saw is not that stranger. Without another observer it ends."""
        seen = self._seen.get(number)
        if seen is not None:
            seen.pop(self._drone_id, None)
            if not seen:
                self._end(number)

    def _end(self, number: int) -> None:
        self._filter.end(number)
        self._seen.pop(number, None)
        self._misfits = {key: since for key, since in self._misfits.items() if key[0] != number}

    def _forget_old(self, t: float) -> None:
        for number, seen in list(self._seen.items()):
            if number not in self._filter.numbers or t - max(seen.values()) > STRANGER_LASTS_S:
                self._end(number)
        if not self._seen and self._filter.observers:
            # The next one begins with what the observers' rays to each other show then.
            self._filter, self._errors = RayFilter(), {}

    def _admits(self, observer: int) -> bool:
        """Whether there is room for one more observer."""
        known = self._filter.observers
        return observer in known or len(known) < MOST_RAY_OBSERVERS

    def _calibrate(self) -> None:
        """What observers' rays to each other show; of the last seconds, where the first stranger is about to begin."""
        news = self._mates.take()
        for sight in news if self._seen else self._mates.kept:
            if self._admits(sight.observer) and self._admits(sight.mate):
                self._calibrate_by(sight)

    def _calibrate_by(self, sight: MateSight) -> None:
        def errors(drone: int, place_sigma: float) -> Errors:
            return self._errors.get(drone, Errors(place_sigma, MATE_TILT_RAD, MATE_HEADING_RAD))

        ray = Ray(
            sight.observer, sight.t, sight.camera, sight.direction, sight.sigma,
            errors(sight.observer, sight.camera_sigma),
        )  # fmt: skip
        if not self._filter.calibrate(ray, sight.mate, sight.place, errors(sight.mate, sight.place_sigma)):
            self._counters["mate_rays_refused"] += 1


def _is_vague(errors: Errors) -> bool:
    return errors.place > VAGUE_OBSERVER_M or max(errors.tilt, errors.heading) > VAGUE_OBSERVER_RAD


def _may_be_mate(one: LocatedStranger, mates: Mapping[int, MatePlace]) -> bool:
    """Whether a stranger is where a teammate states that it is."""
    for mate in mates.values():
        off = one.position - mate.position
        if float(off @ off) < MAY_BE_MATE_M**2:
            cov = one.cov[:3, :3] + mate.sigma**2 * np.eye(3)
            if float(off @ np.linalg.solve(cov, off)) < MAY_BE_MATE_SIGMAS**2:
                return True
    return False
