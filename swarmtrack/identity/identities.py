"""Who is who: gives drones' IDs to tracks, keeps them, and asks again when something changed.

Theory of operation. An announced pose tells where a drone *was*. A track that is assigned its ID carries it from there,
so an ID is kept until its track ends, or until something speaks against it: `standing.py` says what.

Every scan, what is undecided (`candidates.py`: tracks without an ID, drones without a track, IDs in doubt) is matched
again. The posterior over all one-to-one matchings assigns an ID where it is likely enough, and "unknown" elsewhere
(`judgement.py`). It goes by residuals averaged over a short window, by how large tracks look (`spans.py`), by whether
they move as their drones say (`motion_evidence.py`), and by what the scene is like (`scene.py`); and by whether this
drone is itself where it thinks (`self_doubt.py`). A track that no drone explains for a while is foreign.

Who there is to be named is in `teammates.py`, where they are in `whereabouts.py`, and the names that tracks have are in
`names.py`. Where two drones hide each other, their tracks may change places unseen (`occlusion.py`). While two
processes speak as one drone, that ID is assigned to no track.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.identity.assignment import HELD_LOG_ODDS, Assignment
from swarmtrack.identity.candidates import CandidateDrones
from swarmtrack.identity.disputes import Disputes
from swarmtrack.identity.judgement import Judgement
from swarmtrack.identity.names import Names
from swarmtrack.identity.occlusion import OcclusionWatch
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.identity.pose_requests import PoseRequests
from swarmtrack.identity.posterior import nearest
from swarmtrack.identity.proof import Astray
from swarmtrack.identity.reprojection import LastSeen, ObserverCamera, is_vague, joined, seen_from
from swarmtrack.identity.self_doubt import SelfDoubt
from swarmtrack.identity.standing import Event
from swarmtrack.identity.team_fit import TeamFit
from swarmtrack.identity.teammates import Teammates
from swarmtrack.identity.weighing import PLACE_ALONE, Weighing
from swarmtrack.messages import (
    AgreedMotion,
    Announcement,
    IdentifiedTrack,
    Membership,
    MotionReport,
    OwnFault,
    PeerExpelled,
    SightingReport,
    Track,
    TrackStatus,
)
from swarmtrack.motion.ego import TeamPose
from swarmtrack.relative.alignment import FrameTransform

# s: what another camera saw so shortly before or after is part of what this drone sees now, until that camera looks
# again.
RECENT_S = 1.0


class IdentityNews(NamedTuple):
    """What a scan showed of identities, besides the names. vouched: the tracks that are a teammate although they
    look weak; astray: the drones that motion finds elsewhere than they report; wanted: those that should announce their
    pose again."""

    vouched: tuple[int, ...]
    astray: tuple[Astray, ...]
    wanted: tuple[int, ...]


NO_NEWS = IdentityNews((), (), ())


class Identities:
    """Announced poses, and the IDs assigned to tracks."""

    def __init__(
        self,
        drone_id: int,
        *,
        cameras: Sequence[tuple[PinholeCamera, Pose]],
        parameters: IdentityParameters,
        start_sigma_m: float = 0.0,
    ) -> None:
        """cameras: of each its lens and body_from_camera. start_sigma_m: how well this drone knows where it starts, m
        per axis, beside its autopilot's sigma."""
        self._cameras = tuple(cameras)
        self._view: ObserverCamera | None = None
        """Of the last scan."""
        self._parameters = parameters
        self._teammates = Teammates(drone_id)
        self._names = Names()
        self._disputes = Disputes()
        self._pose_requests = PoseRequests()
        self._weighing = Weighing([camera for camera, _ in cameras], parameters.window_s)
        self._self_doubt = SelfDoubt(
            drone_id,
            start_sigma_m=start_sigma_m,
            drift_speed=parameters.drift_speed,
            stay_s=parameters.stay_s,
        )
        self._occlusion = OcclusionWatch(self._names, self._weighing, self._pose_requests)
        self._candidates = CandidateDrones(parameters, self._teammates, self._names, self._weighing)
        self._team_fit = TeamFit(self._teammates, self._names, self._weighing)
        self._judgement = Judgement(
            parameters,
            teammates=self._teammates,
            names=self._names,
            weighing=self._weighing,
            disputes=self._disputes,
            pose_requests=self._pose_requests,
            occlusion=self._occlusion,
            team_fit=self._team_fit,
            self_doubt=self._self_doubt,
        )

    @property
    def self_doubt(self) -> bool:
        """Whether this drone says that its own start or heading is wrong."""
        return self._self_doubt.said

    @property
    def fault(self) -> OwnFault | None:
        """None: these rules do not know what is wrong."""
        return None

    @property
    def has_own_clash(self) -> bool:
        """Whether another process uses this drone's ID."""
        return bool(self._teammates.own_clash)

    @property
    def announced(self) -> dict[int, Announcement]:
        """The latest announcement of every teammate."""
        return dict(self._teammates.announced)

    # --- what teammates say ---

    def announce(self, announcement: Announcement) -> bool:
        """Take in a teammate's pose. Returns False for our own ID, or for one that is not newer."""
        if not self._teammates.is_news(announcement):
            return False
        drone = announcement.drone_id
        known = self._teammates.announced.get(drone)
        self._disputes.settle(drone)
        if is_vague(announcement) and self._weighing.proofs.track_of(drone) is None:
            # It knows no more where it is: neither do we.
            self._names.withdraw(drone, Event.OVERRULED)
        self._teammates.announce(announcement)
        self._weighing.proofs.forget(drone)
        held = self._names.holder(drone)
        if held is not None and known is not None:
            self._names.fire(held, Event.ANNOUNCED)
            if held.undecided:
                # Of a process that started again, what was believed before says nothing.
                held.weaken(HELD_LOG_ODDS if known.boot == announcement.boot else 0.0)
        if known is not None and known.boot != announcement.boot:
            self._weighing.forget(drone)
            self._disputes.begin_life(drone)
            self._team_fit.forget(drone)
            self._weighing.proved_places.forget(drone)
        return True

    def agree(self, motion: AgreedMotion) -> None:
        """A teammate moves like that, as was agreed before the flight."""
        self._weighing.agree(motion)

    def on_report(self, report: SightingReport) -> None:
        """A teammate says with what it sees where it is: nobody has to ask it."""
        if self._teammates.is_heard(report.observer):
            self._teammates.whereabouts.report(report)
            self._self_doubt.hear(report)

    def align(self, drone_id: int, frame: FrameTransform | None) -> None:
        """How the frame of a teammate stands to ours; None: as it announced."""
        if drone_id in self._teammates.announced:
            self._teammates.whereabouts.align(drone_id, frame)

    def on_motion(self, report: MotionReport) -> None:
        """A teammate says how it moves."""
        if self._teammates.is_heard(report.drone_id):
            self._weighing.hear(report)

    def on_membership(self, event: Membership) -> None:
        """Who lives. While two processes speak as one drone, nobody can tell which pose is its own."""
        self._teammates.on_membership(event)
        if isinstance(event, PeerExpelled):
            self._names.withdraw(event.drone_id, Event.OVERRULED)
        if event.drone_id in self._teammates.clashing:
            self._names.withdraw(event.drone_id, Event.CLASHED)

    def overrule(self, drone_id: int, t: float) -> bool:
        """Others see it elsewhere: no track is this drone until it announces itself again, or the dispute is old. What
        motion proves is not for them to say. Returns whether it should announce its pose again."""
        if self._weighing.proofs.track_of(drone_id) is not None:
            return False
        self._names.withdraw(drone_id, Event.OVERRULED)
        self._disputes.overrule(drone_id, t)
        return True

    # --- what this drone sees ---

    def step_heading(self, t: float, turned: float) -> None:
        """By t the autopilot's heading has stepped, and the drone has not turned; turned [rad]: the axes of its rays,
        clockwise from above."""
        self._weighing.step_heading(t)
        self._names.reconsider_strangers()

    def lose_place(self) -> None:
        """This drone may be elsewhere than it thinks: places that were right as seen from there may be so no more."""
        self._weighing.proved_places.forget_all()
        self._names.reconsider_strangers()

    def turn_unmeasured(self) -> None:
        """The camera has turned since the last scan, and nobody knows how far."""
        if self._parameters.profile != "paper":
            self._occlusion.turn_unmeasured()

    def observe(self, tracks: Iterable[Track], observer: TeamPose, camera: int = 0) -> IdentityNews:
        """Look at all tracks after a scan of a camera, with this drone's own pose at its exposure."""
        t = observer.t
        self._view = view = ObserverCamera.of(observer, *self._cameras[camera], camera)
        self._names.follow({track.id: track for track in tracks}, t, camera)
        self._teammates.forget(t, self._names.drones)
        self._disputes.forget(t)
        if self._parameters.profile == "paper":
            self._assign_nearest(view)
            return NO_NEWS
        self._occlusion.look(t)
        self._names.remember_rays(view)
        astray = self._watch(view)
        vouched, disproved = self._assign_by_posterior(view)
        wanted = self._pose_requests.of_this_scan()
        return IdentityNews(tuple(sorted(vouched)), (*astray, *disproved), wanted)

    def label(self, tracks: Iterable[Track]) -> tuple[IdentifiedTrack, ...]:
        """The same tracks, with who they are."""
        return tuple(self._labelled(track) for track in tracks)

    def sightings(self, t: float) -> list[tuple[LastSeen, float]]:
        """The rays to identified drones that were detected in the scan of t, and to those that another camera shows and
        has just detected; and how surely it is they."""
        here = self._names.sightings(t)
        if self._view is None:
            return here
        latest = self._teammates.whereabouts.latest
        return here + [
            (seen_from(ray, latest(ray.drone_id).position, self._view), p)
            for ray, p in self._names.sightings_elsewhere(t, RECENT_S)
        ]

    def _labelled(self, track: Track) -> IdentifiedTrack:
        name, probability = self._names.stated_of(track)
        if not isinstance(name, int):
            return IdentifiedTrack(track, name, probability)
        proofs = self._weighing.proofs
        proof = proofs.of(track.id, name)
        if proof is not None and proofs.lasts(track.id, name, track.t):
            # Its place gave the name, and motion has made it surer since.
            probability = max(probability, proof.probability * track.probability)
        # Or the places of those who move alike have, which are known to be right.
        by_place = self._weighing.proved_places.probability(track.id, name, track.t)
        probability = max(probability, by_place * track.probability)
        return IdentifiedTrack(track, name, probability, proof)

    def _assign_nearest(self, view: ObserverCamera) -> None:
        """Of every confirmed track, once, and again when its drone announces itself again."""
        self._names.remember_rays(view)
        undecided = [track for track in self._names.shown.values() if self._is_undecided_in_paper(track)]
        self._names.keep_unassigned(undecided, view.observer.t)
        mean = np.array([track.mean for track in undecided]).reshape(-1, 4)
        for row, drone in nearest(mean, self._candidates.expected(view)).items():
            self._names.assign(Assignment(undecided[row].id, drone, 1.0))

    def _is_undecided_in_paper(self, track: Track) -> bool:
        held = self._names.of(track.id)
        if held is None:
            return track.status is TrackStatus.CONFIRMED
        return held.undecided and track.coasting_since is None

    def _assign_by_posterior(self, view: ObserverCamera) -> tuple[list[int], list[Astray]]:
        """Returns the tracks to vouch for, and the drones whose IDs motion disproves."""
        t = view.observer.t
        undecided = self._candidates.undecided()
        self._names.keep_unassigned(undecided, t)
        contested, held = self._candidates.contested(undecided, view)
        tracks, predicted = [*undecided, *held], joined(self._candidates.expected(view), contested)
        predicted = joined(predicted, self._candidates.unexpected(tracks, predicted))
        self._candidates.ask_who_enters(predicted, view, self._pose_requests)
        own = self._self_doubt.own
        every = self._weighing.weigh(tracks, predicted, view, own)
        probability, ratios = own.mixed(every, self._judgement.with_history(every, tracks, predicted))
        p_drone = probability[:, : len(predicted.drone_id)]
        p_none = np.maximum(own.turned - probability.sum(axis=1), 0.0)
        nameless = [
            pair for pair in zip(tracks, p_none.tolist(), strict=True) if pair[0].id in self._names.unassigned
        ]
        self._weighing.learn(view, nameless, predicted, p_drone, self._names.stated_here)
        # Of a team that nobody has heard of, anybody may be.
        foreign = bool(self._teammates.announced) and not self._self_doubt.said
        foreign &= not self._weighing.misses_somebody(predicted, p_drone)
        self._team_fit.look(tracks, predicted, p_drone, t)
        located = self._judgement.located(t)
        vouched: list[int] = []
        disproved: list[Astray] = []
        for i, track in enumerate(tracks):
            matches = self._weighing.matches(
                i, track, predicted, t, p_drone=p_drone[i], p_seen=p_drone.sum(axis=0), ratios=ratios[i]
            )
            assigned = self._names.of(track.id)
            if assigned is not None and track.coasting_since is None:
                found = self._judgement.judge(assigned, matches, t)
                disproved += [found] if found is not None else []
            if self._is_candidate(track, seen_in=self._weighing.seen_in(i)):
                vouched += [track.id] if self._judgement.assign_likeliest(track, matches, t) else []
            if self._names.of(track.id) is None and track.status is TrackStatus.CONFIRMED:
                p = min(p_none[i], PLACE_ALONE)
                may_be_foreign = foreign and not self._team_fit.may_be_missing(track, view)
                self._judgement.leave_unassigned(
                    track, matches, p, t, may_be_foreign=may_be_foreign, located=located
                )
        return vouched, disproved

    def _watch(self, view: ObserverCamera) -> list[Astray]:
        """What all tracks tell, named or not: how they move, and whether this drone is where it thinks it is. Returns
        the drones that are elsewhere than they report."""
        whereabouts = self._teammates.whereabouts
        places = {drone: whereabouts.latest(drone) for drone in self._teammates.announced}
        self._weighing.watch(self._names.alive, view, places)
        astray = self._judgement.call_out(view, places)
        if self._shows_most(view.number):
            self._self_doubt.look(
                self._names.shown,
                self._names,
                self._names.lost.values(),
                view=view,
                whereabouts=whereabouts,
                weighing=self._weighing,
            )
        t = view.observer.t
        proofs = self._weighing.proofs
        for name in [name for name in self._names if proofs.of(name.track_id, name.drone_id) is None]:
            if self._self_doubt.forbids(name, self._weighing) or self._team_fit.forbids(name, t):
                self._names.fire(name, Event.OVERRULED)
        if self.self_doubt:
            self.lose_place()
            for held in self._names.settled:
                if not proofs.lasts(held.track_id, held.drone_id, t):
                    self._names.fire(held, Event.SELF_DOUBTED)
                    held.weaken(0.0)
        return astray

    def _shows_most(self, camera: int) -> bool:
        """Whether that camera shows as many tracks as any: of several, one that sees nobody would tell that nothing is
        wrong."""
        shown = [0] * len(self._cameras)
        for track in self._names.alive.values():
            shown[track.camera] += track.status is TrackStatus.CONFIRMED
        return camera == shown.index(max(shown))

    def _is_candidate(self, track: Track, *, seen_in: int) -> bool:
        """Whether a track may get a name: one without, that was detected in enough scans."""
        is_new = self._names.of(track.id) is None and track.status is not TrackStatus.LOST
        return is_new and seen_in >= self._parameters.scans
