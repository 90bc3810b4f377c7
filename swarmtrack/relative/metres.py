"""Where the tracks of a drone are in metres: teammates by name, and any confirmed track by its size.

A scan's named tracks become rays and ranges in the team frame (`looks.py`), which correct the filter of `states.py`.
What teammates report is first brought into our frame (`frames.py`). A second filter, for collision avoidance, takes
every confirmed track for a drone of the configured size, whatever its name; of its tracks those that are far away by
parallax (`parallax.py`) are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import (
    ASSUMED_TILT,
    Announcement,
    Array,
    IdentifiedTrack,
    MotionReport,
    RangeReport,
    RelativeState,
    Scan,
    SightingReport,
    TrackStatus,
)
from swarmtrack.motion.ego import EgoHistory, TeamPose
from swarmtrack.relative.detected import named_boxes
from swarmtrack.relative.frames import FrameNews, FrameOf, Frames
from swarmtrack.relative.heights import HeightSight, SaidHeights
from swarmtrack.relative.held_names import HeldNames
from swarmtrack.relative.looks import NamedBox, TeamLook
from swarmtrack.relative.parallax import FarOff
from swarmtrack.relative.parameters import RelativeParameters
from swarmtrack.relative.priors import STRANGER_LEAST_SPEED_M_S
from swarmtrack.relative.range_watch import RangeNews, RangeWatch
from swarmtrack.relative.reading import OwnMotion
from swarmtrack.relative.states import RelativeStates
from swarmtrack.tracking.base import Tracker


class MeasuringCamera(NamedTuple):
    """One camera: its lens, its mounting, and the tracker that knows the noise of its detections."""

    camera: PinholeCamera
    body_from_camera: Pose
    tracker: Tracker


class Metres:
    """Corrected by every scan (`observe`) and by what teammates report, read at any time."""

    def __init__(
        self,
        drone_id: int,
        parameters: RelativeParameters,
        *,
        cameras: Sequence[MeasuringCamera],
        ego: EgoHistory,
        places_anybody: bool,
    ) -> None:
        """places_anybody: `anybody` is asked, by a drone that has to keep clear of all it sees."""
        self._drone_id = drone_id
        self._cameras = tuple(cameras)
        self._ego = ego
        self._tilt_var = parameters.tilt_sigma**2
        self._padding_px = parameters.box_width.padding_px
        self._teammates = RelativeStates(parameters)
        strangers = replace(parameters, least_speed=STRANGER_LEAST_SPEED_M_S)
        self._anybody = RelativeStates(strangers) if places_anybody else None
        self._far_off = FarOff()
        self._frames = Frames(parameters.turn_sigma)
        self._range_watch = RangeWatch()
        self._said_heights = SaidHeights()
        self._held_names = HeldNames()
        self.look: TeamLook | None = None
        """The last one, of teammates with a name, or with one until just now."""
        self.height_sights: tuple[HeightSight, ...] = ()
        """Of the last scan, where `places_anybody`: reported heights against the camera's."""

    @property
    def counters(self) -> dict[str, int]:
        """What was rejected."""
        return self._teammates.counters

    # --- what teammates report ---

    def announce(self, announcement: Announcement) -> None:
        """A teammate's pose that is news."""
        self._frames.announce(announcement)
        if self._frames.transform(announcement.drone_id) is None and self._ego.carried is None:
            self._teammates.hear_announcement(announcement)

    def forget(self, drone_id: int) -> None:
        """Nothing that was reported in its name counts any more."""
        self._teammates.reset(drone_id)
        self._said_heights.remove(drone_id)

    def hear_motion(self, report: MotionReport) -> None:
        """How a teammate moves."""
        if report.drone_id != self._drone_id:
            self._said_heights.hear_motion(report)
            self._teammates.hear_motion(self._frames.motion_in_ours(report))

    def hear_sightings(self, report: SightingReport, frame: FrameOf) -> FrameNews | None:
        """Where a teammate is and what it sees; frame: how its frame stands to ours. Returns news of that."""
        self._said_heights.hear_sightings(report)
        if report.observer == self._drone_id:
            return None
        news = self._frames.judge(report, frame)
        if news is not None:
            self._teammates.reset(report.observer)
        if self._drone_id not in report.leans_on:
            # Of a carried drone the own place is off as well.
            own = 0.0 if self._ego.carried is None else self._ego.carried.sigma_m**2
            self._teammates.hear_sightings(*self._frames.report_in_ours(report), own_var=own)
        return news

    def hear_range(self, report: RangeReport) -> RangeNews | None:
        """A distance to a teammate by this drone's own radio. Returns news of whether the radio fits what is seen."""
        if report.drone_id != self._drone_id:
            return None
        refused = self._teammates.refused
        believed = self._teammates.hear_range(report)
        if believed or self._teammates.refused > refused:
            return self._range_watch.add_range(report, believed=believed)
        return None

    # --- what this drone sees ---

    def observe(
        self, tracks: tuple[IdentifiedTrack, ...], scan: Scan, observer: TeamPose, number: int
    ) -> tuple[IdentifiedTrack, ...]:
        """The same tracks, with the relative states of teammates, after a scan of a camera by its number."""
        lens, body_from_camera, tracker = self._cameras[number]
        R = scan.R if scan.R is not None else tracker.measurement_noise(_sizes(scan), scan.score)
        camera = observer.pose @ body_from_camera
        velocity, velocity_cov = self._ego.velocity(observer.t)
        walk = 0.0 if self._ego.carried is None else self._ego.carried.walk

        def looked(boxes: Sequence[NamedBox]) -> TeamLook:
            return TeamLook.of(
                observer.t, boxes, lens, camera, velocity, padding_px=self._padding_px, walk=walk
            )

        if self._anybody is not None:
            nameless = looked(named_boxes(_nameless(tracks), scan, R, number))
            self._anybody.observe(nameless)
            named = {entry.track.id for entry in tracks if isinstance(entry.identity, int)}
            self._far_off.observe(nameless.without(named))
        look = looked(named_boxes(tracks, scan, R, number))
        held = self._held_names.of(tracks, observer.t)
        self.look = look if held is tracks else looked(named_boxes(held, scan, R, number))
        self._teammates.observe(look)
        first = observer.pose @ self._cameras[0].body_from_camera
        own = OwnMotion(first.position, velocity, velocity_cov, self._attitude_cov(observer))
        states = self._teammates.at(observer.t, own)
        if self._anybody is not None:
            # Of interest where the drone flies by what it sees.
            self.height_sights = self._said_heights.sights(look, states)
        return _with_states(tracks, states)

    def at(self, tracks: tuple[IdentifiedTrack, ...], now: float) -> tuple[IdentifiedTrack, ...]:
        """The same tracks, with the relative states of teammates by now: the own camera has flown on, too."""
        observer = self._ego.at(now) if any(isinstance(entry.identity, int) for entry in tracks) else None
        if observer is None:
            return tracks
        return _with_states(tracks, self._teammates.at(now, self._own_motion(observer, now)))

    def anybody(self, now: float) -> dict[int, RelativeState]:
        """By track: where confirmed ones are by their size, whatever their name (drone 0), from the own camera now;
        none unless `places_anybody`. Left out are tracks without a name that are far away by parallax, whatever their
        size: parts of a house."""
        observer = self._ego.at(now)
        if self._anybody is None or observer is None:
            return {}
        far = self._far_off.tracks
        states = self._anybody.at(now, self._own_motion(observer, now))
        return {track: state for track, state in states.items() if track not in far} if far else states

    def _own_motion(self, observer: TeamPose, now: float) -> OwnMotion:
        """Of the own camera by now, which has flown on since the newest pose."""
        camera = observer.position + observer.world_from_body @ self._cameras[0].body_from_camera.position
        path, velocity, velocity_cov = self._ego.flown_on(now)
        return OwnMotion(camera + path, velocity, velocity_cov, self._attitude_cov(observer))

    def _attitude_cov(self, observer: TeamPose) -> Array:
        """(3, 3) rad², for states in metres: the tilt is as good as configured, and not as bad as names allow for. What
        came by the age of the pose stays."""
        cov = observer.attitude_cov.copy()
        for i in (0, 1):
            cov[i, i] = max(float(cov[i, i]) - ASSUMED_TILT**2, 0.0) + self._tilt_var
        return cov


def _with_states(
    tracks: tuple[IdentifiedTrack, ...], states: dict[int, RelativeState]
) -> tuple[IdentifiedTrack, ...]:
    """states: by track; a state ends with the name that it was found for."""
    return tuple(
        IdentifiedTrack(entry.track, entry.identity, entry.identity_probability, entry.proof, state)
        if (state := states.get(entry.track.id)) is not None and state.drone_id == entry.identity
        else entry
        for entry in tracks
    )


def _nameless(tracks: tuple[IdentifiedTrack, ...]) -> list[IdentifiedTrack]:
    """The same tracks, as if all that were confirmed were a drone 0, and the others no drone."""
    return [
        IdentifiedTrack(entry.track, None if entry.track.status is TrackStatus.TENTATIVE else 0, 0.0)
        for entry in tracks
    ]


def _sizes(scan: Scan) -> Array:
    return scan.size if scan.size is not None else np.full((len(scan.z), 2), np.nan)
