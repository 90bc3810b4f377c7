"""When two tracks may be taken for one another, by their boxes."""

from __future__ import annotations

import numpy as np

from swarmtrack.messages import Track

# Between two boxes, so near that one of them may take the other's detections.
MEETING_PX = 10.0


def meet(one: Track, other: Track) -> bool:
    """Whether two boxes touch, nearly."""
    size = np.nan_to_num(one.size, nan=0.0) + np.nan_to_num(other.size, nan=0.0)
    return bool((np.abs(one.mean[::2] - other.mean[::2]) < 0.5 * size + MEETING_PX).all())


def coincide(one: Track, other: Track) -> bool:
    """Whether two boxes are around one thing: which of them has a name makes no difference to where it is."""
    size = np.fmin(one.size, other.size)
    return bool((np.abs(one.mean[::2] - other.mean[::2]) < 0.5 * np.nan_to_num(size, nan=0.0)).all())
