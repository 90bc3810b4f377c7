"""What crossings from one camera to another say of how the cameras sit, as a sentence."""

from __future__ import annotations

import numpy as np

from swarmtrack.geometry import rotation
from swarmtrack.tracking.seams import SeamNews


def describe_seam(news: SeamNews) -> str:
    """Cameras are counted from 1, as people do."""
    first, second = news.first + 1, news.second + 1
    if news.turn is None or news.body_from_second is None:
        return (
            f"cameras {first} and {second} do not fit together: what leaves one does not come into the other. Are "
            "their cables swapped, is one of them upside down, or is a body_from_camera wrong?"
        )
    turned = np.degrees(np.linalg.norm(news.turn.angle))
    forward = rotation.BODY_FROM_FORWARD_CAMERA
    roll, pitch, yaw = np.degrees(rotation.to_euler(news.body_from_second @ forward.T)).round(1) + 0.0
    by = f"went from one to the other {news.turn.crossings} times" if news.turn.crossings else "both show"
    return (
        f"cameras {first} and {second} are turned by {turned:.1f}° against what is written, by teammates that {by}. "
        f"If camera {first} is right, rpy_deg = [{roll:g}, {pitch:g}, {yaw:g}] would fit camera {second}"
    )
