"""The rays of one scan to tracks that are none of the teammates."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import FOREIGN, Array, IdentifiedTrack, Scan, StrangerRay, TrackStatus
from swarmtrack.motion.ego import TeamPose
from swarmtrack.relative.detected import named_boxes
from swarmtrack.relative.looks import TeamLook
from swarmtrack.relative.metres import MeasuringCamera
from swarmtrack.strangers.claims import ClaimedPlace
from swarmtrack.strangers.priors import (
    CLAIM_MARGIN_PX,
    CLAIM_SEEN_PX,
    CLAIM_SIGMAS,
    P_STRANGER_KEPT,
    P_STRANGER_RAY,
    RAY_WHITE_RAD,
)
from swarmtrack.strangers.ray_filter import Errors


class ScannedTracks(NamedTuple):
    """All tracks after a scan of a camera, by its number. p_none: by track, the probability that it is none of the
    teammates."""

    tracks: Sequence[IdentifiedTrack]
    scan: Scan
    camera: int
    p_none: Mapping[int, float]


@dataclass(frozen=True, slots=True, eq=False)
class OwnSight:
    """At t [s] this drone, its camera at position (3,) m, saw strangers.

    tracks: by track that is hardly a teammate, its ray (of number 0); None where it was not detected, is another
    camera's, or may be a teammate more than before. foreign: those that are surely none. alive: all tracks.
    """

    t: float
    t_sigma: float
    position: Array
    errors: Errors
    tracks: dict[int, StrangerRay | None]
    foreign: frozenset[int]
    alive: frozenset[int]


def own_sight(
    scanned: ScannedTracks,
    R: Array,
    *,
    observer: TeamPose,
    lens: PinholeCamera,
    body_from_camera: Pose,
    tilt_sigma: float,
    padding_px: float,
    with_rays: bool = True,
) -> OwnSight:
    """R (m, 2, 2) px²: of the scan's detections; observer: as it states its pose. with_rays: else all are None."""
    pose = observer.pose @ body_from_camera
    errors = Errors(observer.position_sigma, tilt_sigma, math.sqrt(float(observer.attitude_cov[2, 2])))
    p_none = {entry.track.id: _p_none(entry, scanned.p_none) for entry in scanned.tracks}
    rays: dict[int, StrangerRay | None] = dict.fromkeys(
        id for id, p in p_none.items() if p >= P_STRANGER_KEPT
    )
    if rays and with_rays:
        as_named = [
            IdentifiedTrack(entry.track, 0 if p_none[entry.track.id] >= P_STRANGER_RAY else None, 0.0)
            for entry in scanned.tracks
        ]
        boxes = named_boxes(as_named, scanned.scan, R, scanned.camera)
        look = TeamLook.of(observer.t, boxes, lens, pose, np.zeros(3), padding_px=padding_px)
        for i, (_, track) in enumerate(look.keys):
            if math.isfinite(float(look.ray[i, 0])):
                sigma = math.hypot(math.sqrt(float(np.trace(look.ray_cov[i])) / 2.0), RAY_WHITE_RAD)
                width = float(np.nan_to_num(look.width[i]))
                rays[track] = StrangerRay(0, look.ray[i] / np.linalg.norm(look.ray[i]), sigma, width)
    foreign = frozenset(entry.track.id for entry in scanned.tracks if entry.identity == FOREIGN)
    return OwnSight(observer.t, observer.t_sigma, pose.position, errors, rays, foreign, frozenset(p_none))


def shows_nothing(
    place: ClaimedPlace, scanned: ScannedTracks, observer: TeamPose, mounted: MeasuringCamera, width_m: float
) -> bool:
    """Whether a camera has a claimed place in view, near enough for a usual drone of width_m [m] to be found there, and
    has no track of anything there."""
    lens, pose = mounted.camera, observer.pose @ mounted.body_from_camera
    ends = place.position + np.outer([-place.vertical, 0.0, place.vertical], [0.0, 0.0, 1.0])
    seen = pose.inverse().transform(ends)
    distance = float(np.linalg.norm(seen[1]))
    if width_m * lens.fx < CLAIM_SEEN_PX * distance:
        return False
    pixels, _, valid = lens.project(seen)
    angle = CLAIM_SIGMAS * math.hypot(place.sigma / distance, observer.attitude_sigma)
    margin = CLAIM_MARGIN_PX + lens.fx * angle
    corners = np.concatenate([pixels + margin, pixels - margin])
    if not valid.all() or not np.asarray(lens.contains(corners)).all():
        return False
    low, high = lens.undistort(pixels).min(axis=0) - margin, lens.undistort(pixels).max(axis=0) + margin
    return not any(
        (low <= entry.track.mean[::2]).all() and (entry.track.mean[::2] <= high).all()
        for entry in scanned.tracks
        if entry.track.camera == scanned.camera
    )


def _p_none(entry: IdentifiedTrack, p_none: Mapping[int, float]) -> float:
    """That a track is a stranger, as far as names may still change; 0 of one with a name, and of one that has just
    begun."""
    if entry.identity == FOREIGN:
        return 1.0
    if entry.identity is not None or entry.track.status is TrackStatus.TENTATIVE:
        return 0.0
    return p_none.get(entry.track.id, 0.0)
