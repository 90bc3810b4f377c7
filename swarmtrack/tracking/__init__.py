"""Multi-target tracking in the image plane. `create_tracker` makes any of `TRACKERS` by name."""

from __future__ import annotations

from dataclasses import fields
from difflib import get_close_matches
from typing import Any

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Scan
from swarmtrack.tracking.base import Filter, Tracker
from swarmtrack.tracking.gmphd import GmPhd
from swarmtrack.tracking.jpdaf import Jpdaf
from swarmtrack.tracking.kalman import Kalman
from swarmtrack.tracking.mbm import Mbm
from swarmtrack.tracking.sensor_model import SensorModel

__all__ = ["AGENT_PARAMETERS", "DEFAULT_TRACKER", "TRACKERS", "Scan", "Tracker", "create_tracker"]

DEFAULT_TRACKER = "mbm"
TRACKERS: dict[str, type[Filter]] = {  # a visible table: add a tracker by its module and one line here
    "kalman": Kalman,
    "jpdaf": Jpdaf,
    "gmphd": GmPhd,
    "mbm": Mbm,
}
# What an agent tells its tracker, unless its config says otherwise: nobody measured this detector on this flight.
AGENT_PARAMETERS: dict[str, Any] = {"learn_noise": "both"}


def create_tracker(name: str, *, camera: PinholeCamera, **parameters: Any) -> Tracker:
    """A tracker by name; parameters as its `Parameters` names them.

    Raises ValueError for an unknown name, an unknown parameter or a value out of range, naming what was expected.
    """
    if name not in TRACKERS:
        raise ValueError(f"tracker.name: found {name!r}, expected one of {', '.join(TRACKERS)}")
    kind = TRACKERS[name]
    known = [field.name for field in fields(kind.Parameters)]
    for key in parameters:
        if key not in known:
            nearest = get_close_matches(key, known, n=1, cutoff=0.0)[0]
            raise ValueError(f"tracker.{key}: unknown parameter of {name}, did you mean {nearest}?")
    told = kind.Parameters(**parameters)
    sensor = SensorModel(camera, told)
    return Tracker(sensor, kind(sensor, told))
