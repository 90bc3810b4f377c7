"""What the flight says of how the cameras sit, as a sentence."""

from __future__ import annotations

import numpy as np

from swarmtrack.cameras.picture_turn import MountingNews
from swarmtrack.cameras.seams import SeamNews
from swarmtrack.geometry import rotation


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


def describe_mounting(news: MountingNews) -> str:
    """Cameras are counted from 1, as people do."""
    camera = f"camera {news.camera + 1}"
    if news.fits:
        return f"{camera} turns with the gyro again, as it is written: who it shows gets a name again"
    if news.like is not None:
        it_is = f"as camera {news.like + 1} should: are their cables swapped?"
    else:
        it_is = "against the gyro: is it upside down, or its picture mirrored, or body_from_camera wrong?"
    return f"the picture of {camera} turns {it_is} Who it shows has no name meanwhile"
