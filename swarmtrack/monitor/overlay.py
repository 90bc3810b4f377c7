"""Tracks as boxes in the picture of a view: from the tracker's undistorted pixels to those of the JPEG."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from swarmtrack.messages import Array, TrackStatus
from swarmtrack.monitor.drone_cameras import UNKNOWN_DISTANCE_M, DroneCameras, distances, tracks_of
from swarmtrack.outputs.drawing import DrawnTrack, in_picture
from swarmtrack.wire.lens import camera_from
from swarmtrack.wire.tracks import TrackMessage, TracksMessage, track_cov
from swarmtrack.wire.video import VideoMessage

MOST_CARRIED_S = (
    0.2  # s by which tracks are moved to the time of a picture: beyond it, neither tells of the other
)

Distances = dict[int, float]
"""By track, m."""


def boxes(
    view: VideoMessage, tracks: TracksMessage | None, camera: int = 0, rig: DroneCameras | None = None
) -> list[dict[str, Any]]:
    """What to draw, in pixels of the picture: centre, size, arrow's tip, ellipse (radii px, angle rad); and how long
    before the picture its camera last saw something that the tracks know [s].

    camera: whose picture it is. rig: all cameras of the drone, where it has several. A track is in the pixels of one
    camera; where pictures overlap it is drawn in the others' as well, by how they are mounted. Tentative tracks are
    not on the page: not here, on its map or in its strip of directions.
    """
    if tracks is None or not tracks.tracks:
        return []
    share = view.width / view.lens.width
    proved = {proof.track_id: round(proof.proved_s, 1) for proof in tracks.proofs}
    away = distances(tracks)
    shown = list(_own(view, tracks, away, camera))
    if rig is not None and camera < len(rig.lenses):
        shown += _of_others(tracks, away, camera, rig)
    # The nearest message is up to a period away: its tracks are carried on to the picture's own time.
    away_s = min(max(view.t_utc_s - tracks.t_utc_s, -MOST_CARRIED_S), MOST_CARRIED_S)
    seen_before_s = round(max(0.0, tracks.scan_age_s + away_s), 2)
    return [
        _record(track._replace(centre=track.centre + away_s * track.velocity), share)
        | {"proved_s": proved.get(track.track_id), "scan_age_s": seen_before_s}
        for track in shown
    ]


def _record(track: DrawnTrack, share: float) -> dict[str, Any]:
    """share: px of the JPEG per px of the camera."""
    long, short, angle = track.ellipse
    return {
        "track": track.track_id,
        "identity": track.identity,
        "lost": track.is_lost,
        "distance_m": track.distance_m,
        "box": (share * np.concatenate([track.centre, track.box[1] - track.box[0]])).round(1).tolist(),
        "tip": (share * track.arrow[1]).round(1).tolist(),
        "ellipse": [round(share * long, 2), round(share * short, 2), round(angle, 2)],
    }


def _own(view: VideoMessage, tracks: TracksMessage, away: Distances, number: int) -> Iterator[DrawnTrack]:
    """Tracks in this camera's pixels."""
    shown = tracks_of(tracks, number)
    ideal = np.array([(track.u_px, track.v_px) for track in shown]).reshape(-1, 2)
    for k, uv, by_ideal in in_picture(camera_from(view.lens), ideal):
        yield _drawn(shown[k], away, uv, by_ideal, np.array([shown[k].w_px, shown[k].h_px]))


def _of_others(
    tracks: TracksMessage, away: Distances, camera: int, rig: DroneCameras
) -> Iterator[DrawnTrack]:
    """Tracks in other cameras' pixels that this one sees, too."""
    for number in range(len(rig.lenses)):
        for track in tracks_of(tracks, number) if number != camera else ():
            uv, half = np.array([track.u_px, track.v_px]), 0.5 * np.array([track.w_px, track.h_px])
            corners = uv + half * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
            beside = uv + np.eye(2)
            points = np.vstack([uv, corners, beside])
            pixels = rig.carried(points, away.get(track.id, UNKNOWN_DISTANCE_M), source=number, target=camera)
            if not np.isfinite(pixels).all() or not rig.lenses[camera].contains(pixels[:1])[0]:
                continue
            size = pixels[1:5].max(axis=0) - pixels[1:5].min(axis=0)
            yield _drawn(track, away, pixels[0], (pixels[5:] - pixels[0]).T, size)


def _drawn(track: TrackMessage, away: Distances, centre: Array, by_ideal: Array, size: Array) -> DrawnTrack:
    """by_ideal (2, 2): d pixel here / d its own undistorted pixel."""
    return DrawnTrack(
        track.id,
        track.identity,
        TrackStatus(track.status),
        away.get(track.id),
        centre,
        by_ideal @ (track.vu_px_s, track.vv_px_s),
        by_ideal @ track_cov(track)[::2, ::2] @ by_ideal.T,
        size,
    )
