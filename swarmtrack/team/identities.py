"""Which track is which teammate, from one posterior of the whole team.

A track gets a name once its teammate is likely enough, and keeps it while that teammate is likelier than not. It is
foreign once it has been unlikely to be any teammate for a while. There are no other states: all evidence against a name
is in the posterior (`posterior.py`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.frame_transform import FrameTransform
from swarmtrack.geometry.pose import Pose
from swarmtrack.identity.consensus import OwnSighting
from swarmtrack.identity.news import Astray, IdentityNews
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.identity.pose_requests import PoseRequests
from swarmtrack.identity.reprojection import LastSeen, ObserverCamera, rays_to, seen_from
from swarmtrack.identity.teammates import Teammates
from swarmtrack.messages import (
    FOREIGN,
    AgreedMotion,
    Announcement,
    Array,
    IdentifiedTrack,
    Membership,
    MotionProof,
    MotionReport,
    OwnFault,
    SightingReport,
    Track,
    TrackStatus,
)
from swarmtrack.motion.ego import TeamPose
from swarmtrack.team.mixture import OwnKnowledge
from swarmtrack.team.own_errors import ConfigFault
from swarmtrack.team.posterior import BearingScan, TeamPosterior
from swarmtrack.team.priors import (
    ASK_AFTER_S,
    ASKED_AT_ONCE,
    BEARING_SIGMA_RAD,
    BOX_SPAN_M,
    CENTRE_SIGMA_PX2,
    FARTHEST_BOX_M,
    FAULT_SAID_AFTER_S,
    NEAREST_BOX_M,
    P_ASKED,
    P_FAULT_SAID,
    P_FAULT_SILENT,
    P_NAME_KEPT,
    P_NAME_MOST,
    P_STRANGER,
    SMALLEST_BOX_PX,
)
from swarmtrack.team.proof import PROOF_LASTS_S, proof_after
from swarmtrack.team.reported_places import SaidPlace
from swarmtrack.team.track_evidence import Bearing

# s: what another camera saw so shortly before or after is part of what this drone sees now, until that camera looks
# again.
_RECENT_S = 1.0


class Identities:
    """Announced poses, and the IDs that tracks have."""

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
        self.self_doubt = False
        """Whether this drone says that its own start or heading is wrong."""
        self._cameras = tuple(cameras)
        self._parameters = parameters
        self.teammates = Teammates(drone_id)
        self._posterior = TeamPosterior(drone_id, cameras=len(cameras), start_sigma_m=start_sigma_m)
        self._pose_requests = PoseRequests()
        self._view: ObserverCamera | None = None
        self._alive: dict[int, Track] = {}
        self._directions: dict[int, Array] = {}
        """By track, where it was detected last (3,), in team axes."""
        self._looked: dict[int, float] = {}
        """By camera, when its last scan was, s."""
        self._names: dict[int, tuple[int, float]] = {}
        """By track: drone and probability."""
        self._strange_since: dict[int, float] = {}
        self._nameless_since: dict[int, float] = {}
        self._seen: dict[int, LastSeen] = {}
        """By track with a name, its last ray."""
        self._doubt_since: float | None = None
        self._proofs: dict[tuple[int, int], MotionProof] = {}
        """By track and drone: names, by motion alone."""
        self._astray: set[int] = set()
        """The drones of which was said that they are elsewhere than they say."""
        self._unnamed: dict[int, int] = {}
        """By track that has lost its name: which drone it was."""

    @property
    def fault(self) -> OwnFault | None:
        """The likeliest fault of this drone's own pose, while it doubts it."""
        return self._posterior.mixture.fault if self.self_doubt else None

    def by_fault(self) -> dict[str, float]:
        """The probability of each kind of fault: `own_errors.ConfigFault`, by its words."""
        return {fault.value: p for fault, p in self._posterior.mixture.by_fault().items()}

    def p_as_configured(self) -> float:
        """The probability that nothing about this drone, or the team's pads, was wrong from the start."""
        return self._posterior.mixture.by_fault()[ConfigFault.NONE]

    def is_confirmed(self, drone_id: int) -> bool:
        """Whether motion alone gives a track this drone's name as well."""
        return any(drone == drone_id for _, drone in self._proofs)

    # --- what teammates say ---

    def announce(self, announcement: Announcement) -> bool:
        """Take in a teammate's pose. Returns False for our own ID, or for one that is not newer."""
        if not self.teammates.is_news(announcement):
            return False
        self.teammates.announce(announcement)
        self._posterior.announce(announcement)
        self._astray.discard(announcement.drone_id)
        self._pose_requests.answered(announcement.drone_id)
        return True

    def agree(self, motion: AgreedMotion) -> None:
        """A teammate moves like that, as was agreed before the flight."""
        self._posterior.agree(motion)

    def on_report(self, report: SightingReport) -> None:
        """A teammate says with what it sees where it is."""
        mate = self._posterior.teammates.get(report.observer)
        if mate is not None and self.teammates.is_heard(report.observer):
            mate.report(report)
            self.teammates.whereabouts.report(report)
            self._posterior.hear_rays(report)

    def on_motion(self, report: MotionReport) -> None:
        """A teammate says how it moves."""
        mate = self._posterior.teammates.get(report.drone_id)
        if mate is not None and self.teammates.is_heard(report.drone_id):
            mate.move(report)

    def on_membership(self, event: Membership) -> None:
        """Membership changes. While two processes use one ID, no track has it."""
        self.teammates.on_membership(event)
        self._forget_gone()

    def _forget_gone(self) -> None:
        """Of whom no pose is known any more, because two processes speak as it or its process is long gone, there is
        nothing to compare with a track."""
        for drone in self._posterior.teammates.keys() - self.teammates.announced.keys():
            self._posterior.expel(drone)
        self._names = {id: name for id, name in self._names.items() if name[0] in self._posterior.teammates}

    def said_place(self, drone_id: int, t: float) -> SaidPlace | None:
        """Where a teammate says that it was at t [s]; None where it has said nothing of that time, or has no place."""
        mate = self._posterior.teammates.get(drone_id)
        if mate is None or not mate.is_placed or not mate.knows(t):
            return None
        return mate.at(t)

    def frame(self, drone_id: int) -> FrameTransform | None:
        """How the frame of a teammate in view stands to that of the own rays; None where it is not in view."""
        return self._posterior.frame(drone_id)

    # --- what this drone sees ---

    def step_heading(self, t: float, turned: float) -> None:
        """By t the autopilot's heading has stepped, and the drone has not turned; turned [rad]: the axes of its rays,
        clockwise from above."""
        if turned:
            self._posterior.turn_rays(turned)

    def lose_place(self) -> None:
        """This drone may be elsewhere than it thinks."""
        self._posterior.lose_place()
        self._strange_since = {}

    def doubt_origin(self, sigma: float) -> None:
        """This drone was within sigma [m per axis] of where it thought, in the scans that are not compared yet."""
        self._posterior.doubt_origin(sigma)

    def autopilot_rebooted(self) -> None:
        """This drone goes on from where it was last, and that is not where it was meanwhile."""
        self._posterior.begin_frame_next()

    def turn_unmeasured(self) -> None:
        """The camera has turned by an unknown angle since the last scan: each track may have another target."""
        self._posterior.begin_again()
        self._strange_since = {}

    def observe(self, tracks: Iterable[Track], observer: TeamPose, camera: int = 0) -> IdentityNews:
        """Look at all tracks after a scan of a camera, with this drone's own pose at its exposure."""
        t = observer.t
        self._view = view = ObserverCamera.of(observer, *self._cameras[camera], camera)
        self._alive = {track.id: track for track in tracks}
        self._looked[camera] = t
        shown = [track for track in self._alive.values() if track.camera == camera]
        scan = _bearings(shown, view)
        directions = self._directions | {id: bearing.direction for id, bearing in scan.bearings.items()}
        self._directions = {id: directions[id] for id in self._alive if id in directions}
        self._posterior.observe(
            scan,
            self._alive.keys(),
            observer.position,
            OwnKnowledge(observer.position_sigma, math.sqrt(float(observer.attitude_cov[2, 2]))),
            unlocated=self.teammates.unlocated,
        )
        self._name(t)
        self._prove(t)
        self._ask(t)
        self._remember_rays(shown, view)
        self.teammates.forget(t, {drone for drone, _ in self._names.values()})
        self._forget_gone()
        self._doubt(t)
        vouched = tuple(
            id
            for id, track in self._alive.items()
            if track.status is TrackStatus.TENTATIVE and id in self._names
        )
        astray = *self._find_astray(t), *self._find_impostors(t)
        return IdentityNews(vouched, astray, self._pose_requests.of_this_scan())

    def label(self, tracks: Iterable[Track]) -> tuple[IdentifiedTrack, ...]:
        """The same tracks, with who they are."""
        return tuple(self._labelled(track) for track in tracks)

    def directions(self) -> Array:
        """(n, 3): where tracks were detected last, in team axes."""
        return np.array(list(self._directions.values())).reshape(-1, 3)

    def p_none(self) -> dict[int, float]:
        """By track, the probability that it is none of the teammates; nothing where one of these may be anywhere."""
        known = bool(self.teammates.announced) and not self.teammates.unlocated and not self.self_doubt
        return {id: named.p_none for id, named in self._posterior.named.items()} if known else {}

    def sightings(self, t: float) -> list[OwnSighting]:
        """The identified drones that were detected in the scan of t, and those that another camera shows and has just
        detected."""
        if self._view is None:
            return []
        found = []
        for id, ray in self._seen.items():
            p = self._names[id][1] * self._alive[id].probability
            is_confirmed = (id, ray.drone_id) in self._proofs
            if self._alive[id].camera == self._view.number:
                found += [OwnSighting(ray, p, is_confirmed)] if ray.t == t else []
            elif abs(ray.t - t) <= _RECENT_S and ray.t >= self._looked.get(self._alive[id].camera, -math.inf):
                place = self.teammates.whereabouts.latest(ray.drone_id).position
                found.append(OwnSighting(seen_from(ray, place, self._view), p, is_confirmed))
        return found

    def _name(self, t: float) -> None:
        names: dict[int, tuple[int, float]] = {}
        since: dict[int, float] = {}
        for id, named in self._posterior.named.items():
            if id not in self._alive:
                continue
            drone, p = named.likeliest
            held = self._names.get(id)
            least = P_NAME_KEPT if held is not None and held[0] == drone else self._parameters.probability
            if p >= least:
                names[id] = drone, min(p, P_NAME_MOST)
            if named.p_none >= P_STRANGER:
                since[id] = self._strange_since.get(id, t)
        lost = {id: drone for id, (drone, _) in self._names.items() if id not in names}
        self._unnamed = {
            id: drone
            for id, drone in (self._unnamed | lost).items()
            if id in self._alive and id not in names and drone in self._posterior.teammates
        }
        self._names, self._strange_since = names, since

    def _prove(self, t: float) -> None:
        """Which names motion alone gives as well."""
        named = self._posterior.named
        found = {
            (id, drone): proof_after(self._proofs.get((id, drone)), named[id].by_motion[drone], t)
            for id, (drone, _) in self._names.items()
        }
        self._proofs = {id: proof for id, proof in found.items() if proof is not None}

    def _find_astray(self, t: float) -> tuple[Astray, ...]:
        """The drones that are elsewhere than they say, once each; looked for when names are weighed."""
        found: list[Astray] = []
        if self._posterior.p_fault > P_FAULT_SILENT or self._posterior.weighed_t != t:
            return ()
        for (id, drone), proof in self._proofs.items():
            is_shown = self._alive[id].t == t and self._alive[id].coasting_since is None
            if drone in self._astray or not is_shown or t - proof.since < PROOF_LASTS_S:
                continue
            miss = self._posterior.miss_m(id, t)
            if miss is not None:
                self._astray.add(drone)
                found.append(Astray(drone, id, miss))
        return tuple(found)

    def _find_impostors(self, t: float) -> tuple[Astray, ...]:
        """The tracks that had a name and are nobody by now, once for each drone. Of a team that is not where it says,
        as far as this drone can tell, nothing is said."""
        if self._posterior.p_fault > P_FAULT_SILENT:
            return ()
        found = tuple(
            Astray(drone, id, None)
            for id, drone in self._unnamed.items()
            if drone not in self._astray
            and id in self._posterior.named
            and self._posterior.named[id].p_none >= P_STRANGER
        )
        self._astray |= {astray.drone_id for astray in found}
        return found

    def _ask(self, t: float) -> None:
        """Ask those that a track may be which has no name for a while, where they are."""
        nameless = [
            id
            for id, named in self._posterior.named.items()
            if id in self._alive and id not in self._names and named.p_none < P_STRANGER
        ]
        self._nameless_since = {id: self._nameless_since.get(id, t) for id in nameless}
        for id, since in self._nameless_since.items():
            if t - since <= ASK_AFTER_S:
                continue
            p = self._posterior.named[id].p
            for drone in sorted(p, key=lambda drone: p[drone])[-ASKED_AT_ONCE:]:
                if p[drone] > P_ASKED:
                    self._pose_requests.ask_again(self.teammates.whereabouts.latest(drone), t)

    def _remember_rays(self, shown: Sequence[Track], view: ObserverCamera) -> None:
        detected = [track for track in shown if track.coasting_since is None and track.id in self._names]
        rays = rays_to([(self._names[track.id][0], track) for track in detected], view)
        self._seen |= {track.id: ray for track, ray in zip(detected, rays, strict=True)}
        self._seen = {
            id: ray
            for id, ray in self._seen.items()
            if id in self._names and self._names[id][0] == ray.drone_id
        }

    def _doubt(self, t: float) -> None:
        if self._posterior.p_fault <= P_FAULT_SAID:
            self._doubt_since = None
        elif self._doubt_since is None:
            self._doubt_since = t
        self.self_doubt = self._doubt_since is not None and t - self._doubt_since > FAULT_SAID_AFTER_S

    def _labelled(self, track: Track) -> IdentifiedTrack:
        held = self._names.get(track.id)
        if held is not None and track.status is not TrackStatus.TENTATIVE:
            probability = held[1] * track.probability
            if probability > 0.5:
                return IdentifiedTrack(track, held[0], probability, self._proofs.get((track.id, held[0])))
        elif self._is_foreign(track):
            return IdentifiedTrack(track, FOREIGN, self._posterior.named[track.id].p_none)
        return IdentifiedTrack(track, None, 0.0)

    def _is_foreign(self, track: Track) -> bool:
        since = self._strange_since.get(track.id)
        known = bool(self.teammates.announced) and not self.teammates.unlocated and not self.self_doubt
        return known and since is not None and track.t - since >= self._parameters.foreign_s


def _bearings(shown: Sequence[Track], view: ObserverCamera) -> BearingScan:
    """The tracks that were detected, as bearings."""
    t = view.observer.t
    is_vague = view.observer.is_carried or not view.observer.is_stated
    origin_sigma = view.observer.position_sigma if is_vague else 0.0
    detected = [
        track for track in shown if track.coasting_since is None and track.status is not TrackStatus.LOST
    ]
    missed = {track.id: track.coasting_since for track in shown if track.coasting_since is not None}
    if not detected:
        return BearingScan(
            t, view.number, view.team_from_camera.position, {}, missed, view.observer.t_sigma, origin_sigma
        )
    pixel = np.array([track.mean[::2] for track in detected])
    focal = view.camera.per_radian(pixel)[..., 0]
    ray = view.rays(pixel)
    own = np.array([track.cov[0, 0] + track.cov[2, 2] for track in detected]) / 2.0
    variance = (own + CENTRE_SIGMA_PX2) / focal**2 + BEARING_SIGMA_RAD**2
    side = np.array([max(float(np.nan_to_num(track.size).max()), SMALLEST_BOX_PX) for track in detected])
    distance = np.clip(BOX_SPAN_M * focal / side, NEAREST_BOX_M, FARTHEST_BOX_M)
    camera = view.team_from_camera.position.copy()
    bearings = {
        track.id: Bearing(
            t,
            camera,
            pixel[i],
            ray[i],
            float(variance[i]),
            float(distance[i]),
            weak=track.status is TrackStatus.TENTATIVE,
        )
        for i, track in enumerate(detected)
    }
    return BearingScan(t, view.number, camera, bearings, missed, view.observer.t_sigma, origin_sigma)
