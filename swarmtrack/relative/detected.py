"""Which detection of a scan is which teammate's: the raw one, not the track that smoothed it.

A track is an average over the past, so its errors last; a filter that takes it for a fresh measurement is too sure.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from swarmtrack.messages import Array, IdentifiedTrack, Scan, TrackStatus
from swarmtrack.relative.looks import NamedBox
from swarmtrack.relative.priors import TAKEN_DETECTION_GATE
from swarmtrack.tracking.gaussian import innovations

_NOWHERE, _NOTHING = np.full(2, np.nan), np.full((2, 2), np.nan)


def named_boxes(tracks: Sequence[IdentifiedTrack], scan: Scan, R: Array, camera: int = 0) -> list[NamedBox]:
    """The teammates among the tracks after a scan of a camera, each with its detection. R (m, 2, 2) px²: of the scan's
    detections.

    A detection that is the nearest of two confirmed tracks may be a box around both, and is left out.
    """
    named = [entry for entry in tracks if isinstance(entry.identity, int)]
    shown = [
        entry.track
        for entry in tracks
        if entry.track.status is TrackStatus.CONFIRMED
        and entry.track.coasting_since is None
        and entry.track.camera == camera
    ]
    mine: dict[int, int] = {}
    if named and shown and len(scan.z):
        mean, cov = np.array([track.mean for track in shown]), np.array([track.cov for track in shown])
        distance = innovations(mean, cov, scan.z, R).distance
        nearest = distance.argmin(axis=1).tolist()
        mine = {
            track.id: j
            for i, (track, j) in enumerate(zip(shown, nearest, strict=True))
            if distance[i, j] < TAKEN_DETECTION_GATE and nearest.count(j) == 1
        }
    boxes = []
    for entry in named:
        assert isinstance(entry.identity, int)
        j = mine.get(entry.track.id)
        if j is None:
            boxes.append(NamedBox(entry.identity, entry.track.id, _NOWHERE, _NOTHING, _NOWHERE))
        else:
            size = _NOWHERE if scan.size is None else scan.size[j]
            boxes.append(NamedBox(entry.identity, entry.track.id, scan.z[j], R[j], size))
    return boxes
