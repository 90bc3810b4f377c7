"""Tracks as boxes in the picture of a view: from the tracker's undistorted pixels to those of the JPEG."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from swarmtrack.messages import Array
from swarmtrack.monitor.drone_cameras import FAR_M, DroneCameras, distances, tracks_of
from swarmtrack.wire.lens import camera_from
from swarmtrack.wire.tracks import TrackMessage, TracksMessage, track_cov
from swarmtrack.wire.video import VideoMessage

AHEAD_S = 0.25  # s: how far an arrow shows where a track goes
SIGMAS = 3.0  # of an ellipse


class _Placed(NamedTuple):
    """A track in the picture: centre (2,), by_ideal (2, 2): d pixel here / d its own undistorted pixel, size (2,)."""

    track: TrackMessage
    centre: Array
    by_ideal: Array
    size: Array


def boxes(
    view: VideoMessage, tracks: TracksMessage | None, camera: int = 0, rig: DroneCameras | None = None
) -> list[dict[str, Any]]:
    """What to draw, in pixels of the picture: centre, size, arrow's tip, ellipse (radii px, angle rad).

    camera: whose picture it is. rig: all cameras of the drone, where it has several. A track is in the pixels of one
    camera; where pictures overlap it is drawn in the others' as well, by how they are mounted.
    """
    if tracks is None or not tracks.tracks:
        return []
    share = view.width / view.lens.width
    proved = {proof.track_id: round(proof.proved_s, 1) for proof in tracks.proofs}
    away = distances(tracks)
    placed = list(_own(view, tracks, camera))
    if rig is not None and camera < len(rig.lenses):
        placed += _of_others(tracks, away, camera, rig)
    found = []
    for track, uv, by_ideal, size in placed:
        cov = by_ideal @ track_cov(track)[::2, ::2] @ by_ideal.T
        variances, axes = np.linalg.eigh(cov)
        minor, major = share * SIGMAS * np.sqrt(np.maximum(variances, 0.0))
        tip = share * (uv + AHEAD_S * (by_ideal @ (track.vu_px_s, track.vv_px_s)))
        found.append(
            {
                "track": track.id,
                "identity": track.identity,
                "probability": round(track.identity_probability, 3),
                "lost": track.status == "lost",
                "proved_s": proved.get(track.id),
                "distance_m": away.get(track.id),
                "box": [round(float(x), 1) for x in share * np.concatenate([uv, size])],
                "tip": [round(float(x), 1) for x in tip],
                "ellipse": [round(float(x), 2) for x in (major, minor, np.arctan2(axes[1, 1], axes[0, 1]))],
            }
        )
    return found


def _own(view: VideoMessage, tracks: TracksMessage, number: int) -> Iterator[_Placed]:
    """Tracks in this camera's pixels."""
    camera = camera_from(view.lens)
    shown = tracks_of(tracks, number)
    centre = camera.distort(np.array([(track.u_px, track.v_px) for track in shown]).reshape(-1, 2))
    for track, uv, J in zip(shown, centre, camera.undistort_jacobian(centre), strict=True):
        # Else it is outside what the lens can show.
        if np.isfinite(uv).all() and np.isfinite(J).all():
            yield _Placed(track, uv, np.linalg.inv(J), np.array([track.w_px, track.h_px]))


def _of_others(
    tracks: TracksMessage, away: dict[int, float], camera: int, rig: DroneCameras
) -> Iterator[_Placed]:
    """Tracks in other cameras' pixels that this one sees, too."""
    for number in range(len(rig.lenses)):
        for track in tracks_of(tracks, number) if number != camera else ():
            uv, half = np.array([track.u_px, track.v_px]), 0.5 * np.array([track.w_px, track.h_px])
            corners = uv + half * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
            beside = uv + np.eye(2)
            points = np.vstack([uv, corners, beside])
            pixels = rig.carried(points, away.get(track.id, FAR_M), source=number, target=camera)
            if not np.isfinite(pixels).all() or not rig.lenses[camera].contains(pixels[:1])[0]:
                continue
            size = pixels[1:5].max(axis=0) - pixels[1:5].min(axis=0)
            yield _Placed(track, pixels[0], (pixels[5:] - pixels[0]).T, size)
