"""Where an observer sees its teammates, in metres, as the page shows it on its map and in its pictures."""

from __future__ import annotations

from typing import Any

import numpy as np

from swarmtrack.relative.read_out import flat_ellipse, read_out
from swarmtrack.wire.checks import symmetric
from swarmtrack.wire.tracks import TracksMessage

SIGMAS = 3.0  # of an ellipse
MAPPED = 8  # drones, of whom all metres are told; of more those that somebody watches


def metres(tracks: TracksMessage | None) -> list[dict[str, Any]]:
    """Of each teammate with a known place. place_m: north and east of the observer's camera; ellipse: radii m and the
    bearing of the longer one, rad."""
    if tracks is None or not tracks.relatives:
        return []
    called = {track.id: track.identity for track in tracks.tracks}
    covs = symmetric(np.array([said.cov for said in tracks.relatives]), 6)
    found = []
    for said, cov in zip(tracks.relatives, covs, strict=True):
        position = np.array(said.position_m)
        if not position.any():
            continue
        read = read_out(position, np.array(said.velocity_m_s), cov)
        found.append(
            {
                "track": said.track_id,
                "called": called[said.track_id],
                "place_m": [round(x, 2) for x in said.position_m[:2]],
                "ellipse": [round(x, 3) for x in flat_ellipse(cov, SIGMAS)],
                "distance_m": round(read.distance, 2),
                "sigma_m": round(read.sigma, 2),
                "closing_m_s": round(read.closing, 2),
            }
        )
    return found
