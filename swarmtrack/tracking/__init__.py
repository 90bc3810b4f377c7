"""Multi-target tracking in the image plane. `create_tracker` makes any of `TRACKERS` by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from difflib import get_close_matches
from typing import Any

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Scan
from swarmtrack.tracking.base import Filter, Tracker
from swarmtrack.tracking.gmphd import GmPhd
from swarmtrack.tracking.hidden import HiddenTracks, all_around
from swarmtrack.tracking.jpdaf import Jpdaf
from swarmtrack.tracking.kalman import Kalman
from swarmtrack.tracking.mbm import Mbm
from swarmtrack.tracking.parameters import CommonParameters
from swarmtrack.tracking.sensor_model import SensorModel
from swarmtrack.tracking.table import TrackIds

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
    (tracker,) = create_trackers(name, cameras=[camera], **parameters)
    return tracker


def create_trackers(name: str, *, cameras: Sequence[PinholeCamera], **parameters: Any) -> list[Tracker]:
    """One for each camera of a drone, for a `Rig`: no two of their tracks have the same number. Raises as
    `create_tracker` does."""
    told = parameters_of(name, **parameters)
    ids, kind = TrackIds(), TRACKERS[name]
    trackers = []
    for index, camera in enumerate(cameras):
        sensor, hidden = SensorModel(camera, told), None
        # Of several cameras the nearest one has what none of them sees, and a wide lens' plane holds nearly everything.
        if len(cameras) == 1 and not camera.is_wide:
            lens = all_around(camera)
            hidden = HiddenTracks(camera, lens, kind(SensorModel(lens, told), told, ids))
        trackers.append(Tracker(sensor, kind(sensor, told, ids), index, hidden))
    return trackers


def parameters_of(name: str, **parameters: Any) -> CommonParameters:
    """Parameters of a tracker by name.

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
    return kind.Parameters(**parameters)
