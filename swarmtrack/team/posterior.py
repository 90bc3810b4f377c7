"""One posterior of all lasting unknowns about a team, as one drone sees it.

Theory of operation. Its discrete part is the component of the observer's errors (`own_errors.py`) and the teammate of
each track; given both, headings and starts are Gaussian (`evidence.py`). All tracks are compared with all teammates in
rounds, in the same scans, once all teammates that report have reported for that time: a drone whose report comes
earlier must not explain a climb for a moment in which others cannot. New tracks are compared at once. After that the
components are weighed, and names with them (`mixture.py`).

When a track ends, its evidence about its teammate's frame stays with the teammate, and its evidence about the
observer's errors with the components.
"""

from __future__ import annotations

import math
from collections import defaultdict, deque
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.geometry import rotation
from swarmtrack.geometry.frame_transform import FrameTransform
from swarmtrack.messages import AgreedMotion, Announcement, Array, Sighting, SightingReport
from swarmtrack.team.adrift import Adrift, sigma_per_axis
from swarmtrack.team.comparison import Compared, ComparedTrack, compare
from swarmtrack.team.deviation import Deviation
from swarmtrack.team.evidence import design, turned_back
from swarmtrack.team.last_seen import LastSeenRay
from swarmtrack.team.mixture import JointMixture, OwnKnowledge
from swarmtrack.team.priors import (
    ALL_COMPARED_EVERY_S,
    BEARING_SIGMA_RAD,
    BELIEVED_ENDED_S,
    BOX_LEARNED_EVERY_S,
    BOX_SIZE_SIGMA_LN,
    BOX_SPAN_LEAST_SIGMA_LN,
    BOX_SPAN_SIGMA_LN,
    CALM_WEIGHED_EVERY_S,
    CARRIED_MOST,
    ELSEWHERE_GATE,
    ELSEWHERE_LEAST_M,
    FARTHEST_COMPARED_M,
    HEADING_LEAST_SIGMA_RAD,
    LOG_ANYWHERE,
    MOTION_WEIGHED_EVERY,
    NEAREST_BOX_M,
    P_BELIEVED,
    P_ELSEWHERE,
    P_FRAME_KEPT,
    P_HELD,
    P_RAY_COUNTS,
    P_SAME_DRONE,
    P_SIZE_LEARNED,
    P_SUPPOSED,
    PAIR_WAKES_RAD,
    RAY_M_S,
    RAY_NEAR_S,
    REBOOTED_M,
    REPORT_WAIT_S,
    REPORTED_DEVIATION,
    ROUND_NEAR_S,
    ROUND_S,
    START_LEAST_SIGMA_M,
    START_OFF_SIGMA_M,
    TRACKED_ERROR_LASTS_S,
)
from swarmtrack.team.reported_places import SaidPlace
from swarmtrack.team.scan_attitude import NamedRay, ScanAttitude
from swarmtrack.team.teammate_rays import TeammateRay
from swarmtrack.team.teammates import Teammate
from swarmtrack.team.track_evidence import Bearing, TrackEvidence

# s of scans that wait for reports of their time.
_SCANS_KEPT_S = 2.5


class BearingScan(NamedTuple):
    """The tracks that one camera detected at t [s], from origin (3,) m.

    bearings: by track; missed: the tracks that it shows and did not detect, by since when [s]. t_sigma [s]: of when
    this drone was at the origin, by its autopilot's clock. origin_sigma [m per axis]: of where that is, where teammates
    carry it.
    """

    t: float
    camera: int
    origin: Array
    bearings: Mapping[int, Bearing]
    missed: Mapping[int, float]
    t_sigma: float = 0.0
    origin_sigma: float = 0.0

    def turned(self, forward: Array) -> BearingScan:
        """The same in axes that have turned: forward (3, 3) takes directions along."""
        turned = {id: one._replace(direction=forward @ one.direction) for id, one in self.bearings.items()}
        return self._replace(bearings=turned)


class Named(NamedTuple):
    """A track's probability of being each drone, and of being none; by_motion: of each if all starts were unknown."""

    p: Mapping[int, float]
    p_none: float
    by_motion: Mapping[int, float]
    likeliest: tuple[int, float]
    """A drone and its probability; 0 and 0 where no teammate is known."""

    @classmethod
    def by(cls, p: Mapping[int, float], p_none: float, by_motion: Mapping[int, float]) -> Named:
        """By these probabilities."""
        drone = max(p, key=p.__getitem__, default=0)
        return cls(p, p_none, by_motion, (drone, p.get(drone, 0.0)))


class TeamPosterior:
    """Takes reports and scans. `named`, by track, and `p_fault` hold after each; weighed_t [s]: the scan in which they
    were worked out last."""

    def __init__(self, own: int, *, cameras: int, start_sigma_m: float) -> None:
        """own: our ID. start_sigma_m: how well this drone knows where it starts, m per axis."""
        self.own = own
        self.teammates: dict[int, Teammate] = {}
        self.named: dict[int, Named] = {}
        self.mixture = JointMixture(own)
        self._start: Array | None = None
        self._start_sigma_m = max(start_sigma_m, START_LEAST_SIGMA_M)
        self._adrift = Adrift(self._start_sigma_m)
        self._known = OwnKnowledge(self._start_sigma_m)
        self._tracks: dict[int, TrackEvidence] = {}
        self._scans: list[deque[BearingScan]] = [deque() for _ in range(cameras)]
        self._round = [-math.inf] * cameras
        """By camera, the time of the last round, s."""
        self._followed = [-math.inf] * cameras
        """By camera, the last scan that was compared with known motions, s."""
        self._watched = [math.nan] * cameras
        self._missed: dict[int, float] = {}
        self._sure_t: dict[int, float] = {}
        """By track, when it was named surely, s."""
        self._agreed: defaultdict[int, list[AgreedMotion]] = defaultdict(list)
        self.weighed_t = -math.inf
        self._weighed_since_motion = 0
        """How often, since what motion alone says was worked out last."""
        self._team_has_changed = False
        self._has_turned = False
        """Whether the own heading has stepped since names were weighed."""

    @property
    def p_fault(self) -> float:
        """The probability that the own heading or start is wrong."""
        return self.mixture.p_fault

    def miss_m(self, track_id: int, t: float) -> float | None:
        """How far the teammate that is that track is from where it says, m; None where it seems to be there."""
        drone, p = self.named[track_id].likeliest
        mate = self.teammates.get(drone)
        if mate is None or p < P_ELSEWHERE or not mate.knows_start or mate.doubting:
            return None
        G = self._design(mate, mate.at(t), self._tracks[track_id].camera)
        place, cov = self.place(track_id, drone, t)
        stated, stated_cov = self.mixture.stated_place(mate, G, self._known)
        off = place - stated
        miss = float(np.linalg.norm(off))
        is_off = float(off @ np.linalg.solve(stated_cov + cov, off)) > ELSEWHERE_GATE
        return miss if is_off and miss > ELSEWHERE_LEAST_M else None

    # --- what teammates say ---

    def announce(self, announcement: Announcement) -> None:
        """A teammate says where it is."""
        drone = announcement.drone_id
        known = self.teammates.get(drone)
        if known is not None and known.boot == announcement.boot:
            known.announce(announcement)
            if known.doubting:
                self._forget_rays(drone)
            return
        column = len(self.teammates) if known is None else known.column
        self.teammates[drone] = mate = Teammate.of(announcement, column, self._agreed[drone])
        if known is not None:
            self._forget_rays(drone)
            self._carry(mate, announcement.t, p_same=P_SAME_DRONE, is_ours=False)
        else:
            for track in self._tracks.values():
                track.grow(len(self.teammates))
        self._team_has_changed = True

    def hear_rays(self, report: SightingReport) -> None:
        """A teammate says along which rays it sees others, or this drone. Between drones that doubt where they are no
        ray counts, nor one of a drone that others carry."""
        mate = self.teammates.get(report.observer)
        if mate is None or self._start is None or report.leans_on or self.mixture.is_large:
            return
        if report.boot != mate.boot or not mate.is_placed:
            return
        for seen in report.sightings:
            other = self.teammates.get(seen.drone_id)
            if seen.probability < P_RAY_COUNTS or not seen.is_confirmed:
                continue
            if seen.drone_id == self.own:
                own = self._origin_at(report.t)
                if own is not None:
                    self._add_ray(mate, report, seen, own, self._start_sigma_m)
            elif other is not None and other.is_placed and other.has_spoken_since(report.t - RAY_NEAR_S):
                said = other.at(report.t)
                sigma = math.hypot(said.sigma, sigma_per_axis(other.start_cov))
                self._add_ray(mate, report, seen, said.place, sigma)
                self._add_ray(other, report, seen, report.position, sigma_per_axis(mate.start_cov))

    def _add_ray(
        self, mate: Teammate, report: SightingReport, seen: Sighting, place: Array, sigma: float
    ) -> None:
        """Between a teammate and another drone at place (3,) m, within sigma per axis."""
        assert self._start is not None
        said = mate.at(report.t)
        sigma_m = math.hypot(sigma, said.sigma, math.sqrt(said.white), RAY_M_S * report.t_sigma)
        starts, places = (mate.start, self._start), (said.place, place)
        ray = TeammateRay.between(starts, places, seen, report.t, sigma_m)
        mate.rays.add(report.observer, seen.drone_id, ray)

    def _origin_at(self, t: float) -> Array | None:
        """Where the own camera was at about t, team frame."""
        kept = [scan for scans in self._scans for scan in scans if abs(scan.t - t) < RAY_NEAR_S]
        return min(kept, key=lambda scan: abs(scan.t - t)).origin if kept else None

    def _forget_rays(self, drone_id: int) -> None:
        """That drone is elsewhere than it said, or is gone."""
        for mate in self.teammates.values():
            mate.rays.forget(drone_id)

    def agree(self, motion: AgreedMotion) -> None:
        """A teammate moves like that, as was agreed before the flight."""
        self._agreed[motion.drone_id].append(motion)

    def expel(self, drone_id: int) -> None:
        """No track has this drone's name any more. Whatever was it still is, and hence is no other teammate."""
        gone = self.teammates.pop(drone_id)
        self._forget_rays(drone_id)
        for id, named in self.named.items():
            others = [mate.column for mate in self.teammates.values()]
            was_gone = math.log1p(named.p.get(drone_id, 0.0) / max(named.p_none, 1e-9))
            self._tracks[id].hold_back(others, min(was_gone, CARRIED_MOST))
        for mate in self.teammates.values():
            mate.column -= mate.column > gone.column
        for track in self._tracks.values():
            track.remove(gone.column)
        for id, named in self.named.items():
            left = {other: p for other, p in named.p.items() if other != drone_id}
            self.named[id] = Named.by(left, named.p_none, named.by_motion)
        self._team_has_changed = True

    def _set_team(self) -> None:
        """Make the components of the team as it is now: once for all that has changed since the last weighing."""
        assert self._start is not None
        pads = {mate.drone_id: mate.start for mate in self.teammates.values() if mate.knows_start}
        self.mixture.set_team(self.teammates, {self.own: self._start, **pads}, list(self._tracks.values()))
        self._team_has_changed = False

    # --- what this drone sees ---

    def turn_rays(self, angle: float) -> None:
        """The own heading has stepped by angle [rad], clockwise from above, and the drone has not: every ray is turned
        from now on, and what was seen before turns along."""
        to_old, forward = turned_back(angle), rotation.from_euler(0.0, 0.0, angle)
        for track in self._tracks.values():
            track.turn(to_old, forward)
        for mate in self.teammates.values():
            mate.turn(to_old, forward)
        self.mixture.turn(angle, list(self._tracks.values()))
        self._has_turned = True
        self._scans = [deque(scan.turned(forward) for scan in scans) for scans in self._scans]

    def begin_again(self) -> None:
        """Each track may be anybody."""
        self._tracks, self.named = {}, {}
        for mate in self.teammates.values():
            mate.seen = None

    def doubt_origin(self, sigma: float) -> None:
        """This drone was within sigma [m per axis] of where it thought, in the scans that are not compared yet."""
        self._scans = [deque(scan._replace(origin_sigma=sigma) for scan in scans) for scans in self._scans]

    def lose_place(self) -> None:
        """This drone looked elsewhere than it thought: nothing that it saw says where anybody is."""
        self.begin_again()
        self.mixture.forget()
        for mate in self.teammates.values():
            mate.forget_frame()

    def begin_frame_next(self) -> None:
        """With the next place that this drone knows: it may have moved a little since the last one."""
        self._adrift.lose(self._adrift.stated_t, REBOOTED_M)

    def _begin_frame(self, place: Array, t: float) -> None:
        """This drone was adrift, and its frame is another: what it saw says who is who, and not where."""
        self._start, self._start_sigma_m = place.copy(), self._adrift.begin_frame()
        self._scans = [deque([scans[-1]] if scans else []) for scans in self._scans]
        self._round = [-math.inf] * len(self._round)
        self.mixture.forget()
        for mate in self.teammates.values():
            mate.forget_frame()
            self._carry(mate, t, is_ours=True)

    def _carry(self, mate: Teammate, t: float, *, p_same: float = 1.0, is_ours: bool) -> None:
        """A track that was that teammate still is with probability p_same, whatever the frames; others are compared
        with it anew. is_ours: our frame is another, and not that of the teammate alone, of which the track has said
        what stays of our errors."""
        for id, track in self._tracks.items():
            named = self.named.get(id)
            p = 0.0 if named is None else named.p.get(mate.drone_id, 0.0)
            if named is None or p < P_SUPPOSED:
                track.forget(mate.column)
                continue
            if not is_ours and p > P_FRAME_KEPT and track.whole is not None:
                self.mixture.keep(track.whole, t)
            log_odds = _carried_log_odds(p, named.p_none, p_same)
            moved = named.by_motion[mate.drone_id]
            none_moved = max(1.0 - sum(named.by_motion.values()), 0.0)
            more = max(log_odds - _carried_log_odds(moved, none_moved, p_same), 0.0) + LOG_ANYWHERE
            track.carry(mate.column, log_odds - self.mixture.log_seen + LOG_ANYWHERE, t, by_place=more)
        self._team_has_changed = True

    def observe(
        self,
        scan: BearingScan,
        alive: Collection[int],
        place: Array,
        known: OwnKnowledge,
        *,
        unlocated: int = 0,
    ) -> None:
        """alive: the tracks of all cameras; place (3,) m: of this drone, team frame, as well known as its autopilot
        says; unlocated: how many teammates live and have not said where."""
        self.mixture.unlocated = unlocated
        if self._start is None:
            self._start = place.copy()
            self._adrift.first = math.hypot(self._adrift.first, known.start_sigma_m)
            self._start_sigma_m = self._adrift.first
        self._adrift.is_at(scan.t, known.start_sigma_m)
        if self._adrift.found:
            self._begin_frame(place, scan.t)
        for mate in self.teammates.values():
            if mate.adrift.found:
                mate.begin_frame()
                self._forget_rays(mate.drone_id)
                self._carry(mate, scan.t, is_ours=False)
        self._known = OwnKnowledge(self._start_sigma_m, max(known.heading_sigma, HEADING_LEAST_SIGMA_RAD))
        t, scans = scan.t, self._scans[scan.camera]
        scans.append(scan)
        while scans[0].t < t - _SCANS_KEPT_S:
            scans.popleft()
        for id in [id for id in self._tracks if id not in alive]:
            self._end(id, t)
        # Pasts are of what was compared before; but a teammate that has just come is compared first.
        any_back = self._watch(scan)
        if (any_back or self._has_turned) and not self._team_has_changed:
            self._weigh(t)
        compared = self._compare_rounds(scan)
        # A teammate that has just come is new to all.
        new = [
            id
            for id, bearing in scan.bearings.items()
            if not bearing.weak and (self._team_has_changed or id not in self._tracks)
        ]
        self._compare(scan, new, self.teammates.values())
        if self._team_has_changed:
            self._compare_undetected(scan)
        compared |= self._follow(scan) and t - self.weighed_t >= ROUND_S
        is_due = t - self.weighed_t >= CALM_WEIGHED_EVERY_S
        if new or self._team_has_changed or is_due or (compared and not self._is_calm):
            self._weigh(t)
        self._remember(scan)

    def _is_held(self, id: int) -> bool:
        """Whether a track has a name rather than not."""
        return id in self.named and self.named[id].likeliest[1] > P_HELD

    @property
    def _is_calm(self) -> bool:
        """Whether everything is settled, and no track waits to be one."""
        return self.mixture.is_settled and not any(track.weak for track in self._tracks.values())

    def _compare_rounds(self, scan: BearingScan) -> bool:
        """Returns whether any round was due."""
        t, number, before = scan.t, scan.camera, self._round[scan.camera]
        if not math.isfinite(self._round[number]):
            self._round[number] = ROUND_S * math.floor(t / ROUND_S)
        reporting = [mate for mate in self.teammates.values() if mate.goes_on(t)]
        while (due := self._round[number] + ROUND_S) <= t:
            if due >= t - REPORT_WAIT_S and not all(mate.has_said(due) for mate in reporting):
                break
            self._round[number] = due
            nearest = min(self._scans[number], key=lambda kept: abs(kept.t - due))
            if abs(nearest.t - due) < ROUND_NEAR_S:
                # What has a name in a large team that is calm is compared as often as it is weighed.
                rest = self.mixture.is_large and self._is_calm and due % CALM_WEIGHED_EVERY_S > 0.0
                ids = [
                    id
                    for id in nearest.bearings
                    if (id in self._tracks or id in scan.bearings) and not (rest and self._is_held(id))
                ]
                others = [mate for mate in self.teammates.values() if not mate.is_followed(t)]
                self._compare(nearest, ids, others)
        return self._round[number] > before

    def _follow(self, scan: BearingScan) -> bool:
        """Compare scans with the teammates whose motion then was agreed. Returns whether there was any."""
        number, t = scan.camera, scan.t
        followed = [mate for mate in self.teammates.values() if mate.is_followed(t)]
        if not followed:
            self._followed[number] = t
            return False
        any_compared = False
        for kept in self._scans[number]:
            if kept.t < self._followed[number] + TRACKED_ERROR_LASTS_S:
                continue
            self._followed[number] = kept.t
            ids = [id for id in kept.bearings if id in self._tracks]
            self._compare(kept, ids, followed)
            any_compared = True
        return any_compared

    def _compare(self, scan: BearingScan, ids: Sequence[int], mates: Collection[Teammate]) -> None:
        """Tracks with teammates, in one scan."""
        assert self._start is not None
        some = [] if self._adrift.lost or not ids else [mate for mate in mates if not mate.adrift.lost]
        placed = [(mate, mate.at(scan.t)) for mate in some]
        within = [one for one in placed if math.dist(one[1].place, one[0].start) < FARTHEST_COMPARED_M]
        if not within:
            return
        near, said = zip(*within, strict=True)
        place = np.array([one.place for one in said])
        knows_start = np.array([mate.knows_start for mate in near])
        distance = np.linalg.norm(place - scan.origin, axis=1)
        away = np.where(knows_start, distance.clip(NEAREST_BOX_M), np.inf)
        compared = Compared(
            columns=np.array([mate.column for mate in near]),
            design=design(place - np.array([mate.start for mate in near]), scan.origin - self._start),
            deviation=self._deviation(scan, said),
            log_span=np.array([mate.log_span for mate in near]),
            span_variance=np.array([mate.span_variance for mate in near]),
            is_near=knows_start,
            log_there=np.array([mate.log_waits(scan.t) for mate in near]),
            farthest=away + 2.0 * START_OFF_SIGMA_M[-1],
            within=_within(away),
            team_span=self._team_span(),
        )
        expected = self.mixture.expected_places([mate.drone_id for mate in near], compared.design)
        bearings = self._without_attitude(scan, near, compared.deviation, expected)
        self._wake(ids, bearings, compared.columns, expected)
        knows = np.array([mate.knows(scan.t) for mate in near])
        with_far = (scan.t + ROUND_NEAR_S) % ALL_COMPARED_EVERY_S < ROUND_S
        pairs = []
        for id in ids:
            if id not in self._tracks:
                weak = scan.bearings[id].weak
                self._tracks[id] = TrackEvidence(len(self.teammates), scan.camera, weak=weak)
            self._expect(id, scan, mates)
            track = self._tracks[id]
            which = knows | ~track.compared[compared.columns]
            if not with_far:
                which &= np.isnan(track.faint[compared.columns])
            pairs.append(ComparedTrack(track, bearings[id], np.flatnonzero(which)))
        compare(pairs, compared)

    def _team_span(self) -> float:
        """Size of the team's drones as a share of `BOX_SPAN_M`: those of a team are alike, as far as is known."""
        learned = [
            (mate.log_span, BOX_SPAN_SIGMA_LN**2 / mate.span_variance - 1.0)
            for mate in self.teammates.values()
            if math.isfinite(mate.sized_t)
        ]
        known = sum(weight for _, weight in learned)
        return math.exp(sum(log_span * weight for log_span, weight in learned) / (known + 1.0))

    def _wake(
        self, ids: Sequence[int], bearings: Mapping[int, Bearing], columns: NDArray[np.intp], expected: Array
    ) -> None:
        """Wake the pairs of tracks that are seen near where a teammate should be: expected (m, 3) m."""
        far = [id for id in ids if id in self._tracks and np.isfinite(self._tracks[id].faint).any()]
        if far:
            seen = np.array([bearings[id].direction for id in far])
            is_near = seen @ expected.T > math.cos(PAIR_WAKES_RAD) * np.linalg.norm(expected, axis=1)
            for id, near in zip(far, is_near, strict=True):
                self._tracks[id].wake(columns[near])

    def _without_attitude(
        self, scan: BearingScan, mates: Sequence[Teammate], deviation: Deviation, expected: Array
    ) -> Mapping[int, Bearing]:
        """The bearings of a scan, turned back by the attitude's error where two teammates show it. expected (m, 3)
        m: where they should be."""
        at = {mate.drone_id: i for i, mate in enumerate(mates)}
        named = {id: self.named[id].likeliest for id in scan.bearings if id in self.named}
        seen = {id: (at[drone], p) for id, (drone, p) in named.items() if p > P_HELD and drone in at}
        if len(seen) < 2:
            return scan.bearings
        rays = {}
        for id, (i, p) in seen.items():
            bearing, place = scan.bearings[id], expected[i]
            distance = max(float(np.linalg.norm(place)), NEAREST_BOX_M)
            place_var = (
                deviation.sigma[i] ** 2 + deviation.white[i] + float(np.trace(mates[i].start_cov)) / 3.0
            )
            variance = bearing.variance - BEARING_SIGMA_RAD**2 + place_var / distance**2
            rays[id] = NamedRay(bearing.direction, place / distance, p, variance)
        found = ScanAttitude(rays).turned_back({id: one.direction for id, one in scan.bearings.items()})
        return {id: bearing.turned(*found[id]) for id, bearing in scan.bearings.items()}

    def _deviation(self, scan: BearingScan, said: Sequence[SaidPlace]) -> Deviation:
        """How far teammates may be from where they say, and this drone along its way: by their clocks and its own."""
        deviation = Deviation(*np.array([place[1:] for place in said]).T)
        before = next((kept for kept in reversed(self._scans[scan.camera]) if kept.t < scan.t), None)
        if before is None or not (scan.t_sigma or scan.origin_sigma):
            return deviation
        late = scan.t_sigma * float(np.linalg.norm(scan.origin - before.origin)) / (scan.t - before.t)
        late = math.hypot(late, scan.origin_sigma)
        # A walk of reported places is too slow for it.
        lasts = deviation.bandwidth > REPORTED_DEVIATION[1]
        return deviation._replace(
            sigma=np.where(lasts, np.hypot(deviation.sigma, late), deviation.sigma),
            white=deviation.white + np.where(lasts, 0.0, late**2),
        )

    def _compare_undetected(self, scan: BearingScan) -> None:
        """Compare tracks that a scan did not detect with a teammate that has just come, by their last bearings: else it
        would be the only one that they cannot be."""
        last = {id: kept for scans in self._scans for kept in scans for id in kept.bearings}
        for id in self._tracks.keys() & last.keys() - scan.bearings.keys():
            self._compare(last[id], [id], self.teammates.values())

    def _expect(self, id: int, scan: BearingScan, mates: Collection[Teammate]) -> None:
        """Compare a new track with where teammates were seen that have said nothing since, and are not seen now."""
        track, bearing = self._tracks[id], scan.bearings[id]
        for mate in mates:
            seen = mate.seen
            if seen is None or seen.track in scan.bearings or track.compared[mate.column]:
                continue
            if not mate.knows(bearing.t) and not mate.has_spoken_since(seen.bearing.t):
                track.expect(bearing, mate.column, seen.log_density(bearing))

    def _remember(self, scan: BearingScan) -> None:
        """Where each teammate is seen."""
        for id, bearing in scan.bearings.items():
            named = self.named.get(id)
            drone, p = (0, 0.0) if named is None else named.likeliest
            mate = self.teammates.get(drone)
            if mate is not None and p > P_HELD:
                mate.seen = LastSeenRay.after(mate.seen, id, bearing, p)

    def _watch(self, scan: BearingScan) -> bool:
        """Which tracks are confirmed, and which may have gone over to another target. Returns whether one has come
        back after a miss, as another perhaps."""
        t, number = scan.t, scan.camera
        passed = 0.0 if math.isnan(self._watched[number]) else max(t - self._watched[number], 0.0)
        self._watched[number] = t
        at = np.array([bearing.pixel for bearing in scan.bearings.values()]).reshape(-1, 2)
        gap = np.linalg.norm(at[:, None] - at, axis=2) + np.diag(np.full(len(at), np.inf))
        any_back = False
        for id, near in zip(scan.bearings, gap, strict=True):
            # Another camera may have missed it since, and its scan have come first.
            missed = max(t - self._missed.pop(id, t), 0.0)
            if id in self._tracks:
                self._tracks[id].weak = scan.bearings[id].weak
                any_back |= self._tracks[id].watch(t, passed, missed, float(near.min()))
        self._missed |= scan.missed
        return any_back

    def _end(self, id: int, t: float) -> None:
        """What an ended track said stays: the frame of whom it was, and which component that speaks for. Of a track
        that was nobody, nothing: a ghost that fits a wrong component comes again and again at its place."""
        track, named = self._tracks.pop(id), self.named.pop(id, None)
        self._missed.pop(id, None)
        sure_t = self._sure_t.pop(id, -math.inf)
        if track.whole is None or named is None:
            return
        drone, p = named.likeliest
        mate, best = self.teammates.get(drone), track.likeliest_segment
        if mate is not None and mate.knows_start and P_SUPPOSED < p <= P_FRAME_KEPT:
            mate.suppose(track.told().of_segment(best, mate.column), p, t, track.t)
        if t - sure_t > BELIEVED_ENDED_S:
            return
        told = track.whole
        if mate is not None and p > P_FRAME_KEPT:
            mate.keep(track.told().of_segment(best, mate.column), t)
            told = track.pasts(len(told)).log[best]
        self.mixture.keep(told, t)

    # --- what it makes of it ---

    def _weigh(self, t: float) -> None:
        self.weighed_t, self._has_turned = t, False
        if not self.teammates:
            self.named = {}
            return
        if self._team_has_changed:
            self._set_team()
        mates = list(self.teammates.values())
        ids, tracks = [mate.drone_id for mate in mates], list(self._tracks.values())
        for track in tracks:
            track.begin_due_segment()
        P = self.mixture.weigh(tracks, mates, t, self._known).tolist()
        moved = {id: named.by_motion for id, named in self.named.items()}
        self._weighed_since_motion += 1
        if self.mixture.looks_at_all or self._weighed_since_motion >= MOTION_WEIGHED_EVERY:
            self._weighed_since_motion = 0
            rows = self.mixture.by_motion(tracks, mates, self._known).tolist() if tracks else []
            moved = {id: dict(zip(ids, row, strict=True)) for id, row in zip(self._tracks, rows, strict=True)}
        for id, p in zip(self._tracks, P, strict=True):
            p_none = max(1.0 - sum(p), 0.0)
            # Of a track that has come since, motion says nothing yet.
            by_motion = moved.get(id) or dict.fromkeys(ids, 0.0)
            self.named[id] = named = Named.by(dict(zip(ids, p, strict=True)), p_none, by_motion)
            if named.likeliest[1] >= P_BELIEVED:
                self._sure_t[id] = t
        self._learn_sizes(t)

    def _learn_sizes(self, t: float) -> None:
        """How large a named drone is, by where it is: a box a second; all its boxes share a part of their error."""
        for id, named in self.named.items():
            drone, p = named.likeliest
            mate = self.teammates.get(drone)
            if p < P_SIZE_LEARNED or mate is None or t - mate.sized_t < BOX_LEARNED_EVERY_S:
                continue
            bearing = self._scans[self._tracks[id].camera][-1].bearings.get(id)
            if bearing is None:
                continue
            position, cov = self.place(id, drone, bearing.t)
            distance = float(np.linalg.norm(position))
            if not distance < FARTHEST_COMPARED_M:
                continue
            variance = float(position @ cov @ position) / distance**4 + BOX_SIZE_SIGMA_LN**2
            gain = mate.span_variance / (mate.span_variance + variance)
            mate.log_span += gain * (math.log(distance / bearing.distance) - mate.log_span)
            mate.span_variance = max((1.0 - gain) * mate.span_variance, BOX_SPAN_LEAST_SIGMA_LN**2)
            mate.sized_t = t

    def place(self, track_id: int, drone_id: int, t: float) -> tuple[Array, Array]:
        """Where a teammate is that is that track, at t: mean (3,) m from the own camera and covariance (3, 3), in the
        axes of the own rays."""
        mate, track = self.teammates[drone_id], self._tracks[track_id]
        said = mate.at(t)
        G = self._design(mate, said, track.camera)
        mean, cov = self.mixture.place(track, mate, G, t, self._known)
        return mean, cov + (said.sigma**2 + said.white) * np.eye(3)

    def frame(self, drone_id: int) -> FrameTransform | None:
        """How the frame of a teammate that is surely in view stands to that of the own rays."""
        mate = self.teammates.get(drone_id)
        track_id = next((id for id, named in self.named.items() if named.likeliest[0] == drone_id), None)
        if mate is None or track_id is None or self.named[track_id].likeliest[1] < P_FRAME_KEPT:
            return None
        track = self._tracks[track_id]
        scan = self._scans[track.camera][-1]
        assert self._start is not None
        G = design(-mate.start[None], scan.origin - self._start)[0]
        mean, cov = self.mixture.frame(track, mate, G, scan.t, self._known)
        return FrameTransform(float(mean[3]), scan.origin + mean[:3], cov)

    def _design(self, mate: Teammate, said: SaidPlace, camera: int) -> Array:
        """(3, 8): `evidence.design` of where a teammate says that it is, from a camera's last scan."""
        assert self._start is not None
        return np.asarray(
            design((said.place - mate.start)[None], self._scans[camera][-1].origin - self._start)[0]
        )


def _within(away: Array) -> tuple[float, float]:
    """The least and the largest of the distances at which teammates say that they are; any, where one may be
    anywhere."""
    least, most = float(away.min()), float(away.max())
    return (least, most) if math.isfinite(most) else (0.0, math.inf)


def _carried_log_odds(p: float, p_none: float, p_same: float) -> float:
    """Of a track that was a teammate with probability p and nobody with p_none, and still is with p_same."""
    return min(math.log(max(p_same * p, 1e-9) / max(p_none + (1.0 - p_same) * p, 1e-9)), CARRIED_MOST)
