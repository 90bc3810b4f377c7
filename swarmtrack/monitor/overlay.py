"""Tracks as boxes in the picture of a view: from the tracker's undistorted pixels to those of the JPEG."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from swarmtrack.monitor.metres import ORIGIN
from swarmtrack.wire.checks import DecodeError
from swarmtrack.wire.lens import camera_from
from swarmtrack.wire.tracks import TracksMessage, track_cov
from swarmtrack.wire.video import VideoMessage

AHEAD_S = 0.25  # s: how far an arrow shows where a track goes
SIGMAS = 3.0  # of an ellipse


def boxes(view: VideoMessage, tracks: TracksMessage | None) -> list[dict[str, Any]]:
    """What to draw, in pixels of the picture: centre, size, arrow's tip, ellipse (radii px, angle rad). A picture is
    always the first camera's, so tracks of the others are not in it."""
    if tracks is None or not tracks.tracks:
        return []
    try:
        camera = camera_from(view.lens)
    except DecodeError:
        return []
    shown = [
        track
        for index, track in enumerate(tracks.tracks)
        if track.status != "tentative" and tracks.camera_of(index) == 0
    ]
    ideal = np.array([(track.u_px, track.v_px) for track in shown]).reshape(-1, 2)
    velocity = np.array([(track.vu_px_s, track.vv_px_s) for track in shown]).reshape(-1, 2)
    centre = camera.distort(ideal)
    undo = camera.undistort_jacobian(centre)
    share = view.width / view.lens.width
    proved = {proof.track_id: round(proof.proved_s, 1) for proof in tracks.proofs}
    away = {said.track_id: round(math.dist(said.position_m, ORIGIN), 2) for said in tracks.relatives}
    found = []
    for track, uv, J, v in zip(shown, centre, undo, velocity, strict=True):
        if not (np.isfinite(uv).all() and np.isfinite(J).all()):
            continue  # outside what the lens can show
        by_ideal = np.linalg.inv(J)
        cov = by_ideal @ track_cov(track)[::2, ::2] @ by_ideal.T
        variances, axes = np.linalg.eigh(cov)
        minor, major = share * SIGMAS * np.sqrt(np.maximum(variances, 0.0))
        u, v_px = share * uv
        tip = share * (uv + AHEAD_S * (by_ideal @ v))
        found.append(
            {
                "track": track.id,
                "identity": track.identity,
                "probability": round(track.identity_probability, 3),
                "lost": track.status == "lost",
                "proved_s": proved.get(track.id),
                "distance_m": away.get(track.id),
                "box": [round(float(x), 1) for x in (u, v_px, share * track.w_px, share * track.h_px)],
                "tip": [round(float(x), 1) for x in tip],
                "ellipse": [round(float(x), 2) for x in (major, minor, np.arctan2(axes[1, 1], axes[0, 1]))],
            }
        )
    return found
