"""Cameras of a drone with several: fields of view, and directions of their tracks around the drone."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from swarmtrack.cameras.field_of_view import around, outline_around
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Array
from swarmtrack.monitor.metres import RELATIVE_ORIGIN
from swarmtrack.wire.camera import CameraMessage, OtherCamera, mounting_from
from swarmtrack.wire.lens import camera_from
from swarmtrack.wire.tracks import TrackMessage, TracksMessage
from swarmtrack.wire.video import VideoMessage

ViewKey = tuple[int, int]
"""A drone's ID, and which of its cameras, from 0."""
UNKNOWN_DISTANCE_M = 1e4  # where somebody is whose distance is not known: cameras then sit in one place


class CameraView(NamedTuple):
    """Field of view of one camera."""

    key: ViewKey
    message: VideoMessage


class SeenAround(NamedTuple):
    """To the page a plain array: a track by its direction in body axes. right: of the nose, -180 … 180; camera: in
    whose picture it is, from 0; distance_m: where that is known."""

    identity: int | str | None
    right_deg: float
    up_deg: float
    width_deg: float
    height_deg: float
    is_lost: bool
    camera: int
    distance_m: float | None


@dataclass(frozen=True)
class DroneCameras:
    """lenses, mountings (body_from_camera): in the order of the drone's config."""

    lenses: tuple[PinholeCamera, ...]
    mountings: tuple[Pose, ...]

    @classmethod
    def of(cls, message: CameraMessage) -> DroneCameras:
        cameras: tuple[CameraMessage | OtherCamera, ...] = (message, *message.others)
        return cls(
            tuple(camera_from(one.lens) for one in cameras), tuple(mounting_from(one) for one in cameras)
        )

    @cached_property
    def outlines(self) -> list[list[list[float]]]:
        """Outline of each camera's field of view, for the page: right of the nose and up, degrees; behind it goes
        on beyond ±180.
        """
        return [
            np.degrees(outline_around(lens, mounting)).round(1).tolist()
            for lens, mounting in zip(self.lenses, self.mountings, strict=True)
        ]

    def around(self, tracks: TracksMessage) -> list[SeenAround]:
        """All but tentative tracks, of all cameras."""
        away = distances(tracks)
        found = []
        for number, (lens, mounting) in enumerate(zip(self.lenses, self.mountings, strict=True)):
            shown = tracks_of(tracks, number)
            if not shown:
                continue
            rays = lens.bearing_undistorted(np.concatenate([_cross(track) for track in shown]))
            where = np.degrees(around(mounting, rays)).reshape(-1, 5, 2)
            rays = rays.reshape(-1, 5, 3)
            for track, (centre, *_), (_, left, right, top, bottom) in zip(shown, where, rays, strict=True):
                if not (np.isfinite(centre).all() and np.isfinite([left, right, top, bottom]).all()):
                    continue
                to_right, up = centre.round(1).tolist()
                found.append(
                    SeenAround(
                        track.identity,
                        to_right,
                        up,
                        _angle_deg(left, right),
                        _angle_deg(top, bottom),
                        track.status == "lost",
                        number,
                        away.get(track.id),
                    )
                )
        return found

    def carried(self, pixels: Array, metres: float, *, source: int, target: int) -> Array:
        """Undistorted pixels (n, 2) of a camera, of what is so far away, to those of the picture of another; NaN where
        that does not see it."""
        points = metres * self.lenses[source].bearing_undistorted(pixels)
        there = self.mountings[target].inverse().transform(self.mountings[source].transform(points))
        return self.lenses[target].project(there)[0]


def tracks_of(tracks: TracksMessage, camera: int) -> list[TrackMessage]:
    """Visible tracks in the pixels of one camera."""
    return [
        track
        for index, track in enumerate(tracks.tracks)
        if track.status != "tentative" and tracks.camera_of(index) == camera
    ]


def distances(tracks: TracksMessage) -> dict[int, float]:
    """Range [m] by track, of teammates whose position is known."""
    return {said.track_id: round(math.dist(said.position_m, RELATIVE_ORIGIN), 2) for said in tracks.relatives}


def _cross(track: TrackMessage) -> Array:
    """Undistorted pixels (5, 2): the centre of its box, and the middles of its left, right, upper and lower side."""
    u, v, w, h = track.u_px, track.v_px, 0.5 * track.w_px, 0.5 * track.h_px
    return np.array([(u, v), (u - w, v), (u + w, v), (u, v - h), (u, v + h)])


def _angle_deg(a: Array, b: Array) -> float:
    """Between unit vectors (3,)."""
    return round(math.degrees(2.0 * math.asin(min(1.0, 0.5 * float(np.linalg.norm(a - b))))), 2)
