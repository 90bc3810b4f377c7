"""What every tracker is, whatever its mathematics (DESIGN.md, contract 1)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Array, Scan, Track


@dataclass(frozen=True, slots=True, kw_only=True)
class CommonParameters:
    """What every tracker needs to be told about the sensor and the targets."""

    measurement_sigma: float = 2.0
    """px, per axis, where a scan brings no R of its own."""
    acceleration_psd: float = 10_000.0
    """px²/s³, continuous white noise: 3 m/s² for half a second at 10 m and f = 430 px."""
    p_detection: float = 0.9
    """That a target in view is detected in one scan."""
    p_survival: float = 0.99
    """That a target present now is still present in one second."""
    clutter_per_scan: float = 1.0
    """Expected false detections in one image."""
    gate_probability: float = 0.999
    """That a true detection falls inside its target's gate."""

    def __post_init__(self) -> None:
        for name in ("measurement_sigma", "acceleration_psd", "clutter_per_scan"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"tracker.{name}: found {getattr(self, name)!r}, expected a number above 0")
        for name in ("p_detection", "p_survival", "gate_probability"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ValueError(
                    f"tracker.{name}: found {getattr(self, name)!r}, expected a probability between 0 and 1"
                )


class Tracker(Protocol):
    """Multi-target tracking in the image plane, clocked by the exposures of the scans."""

    Parameters: ClassVar[type[CommonParameters]]

    def __init__(self, camera: PinholeCamera, parameters: Any) -> None: ...

    @property
    def t(self) -> float | None:
        """Time of the state: that of the last scan; None before the first."""
        ...

    @property
    def tracks(self) -> tuple[Track, ...]: ...

    @property
    def counters(self) -> Mapping[str, int]:
        """What was refused or lost, by name, for health."""
        ...

    def initiate(self, t: float, points: Array) -> list[int]:
        """Start confirmed tracks at known places: points (n, 2) px. Returns their ids."""
        ...

    def predict(self, t: float, rotation: Array | None = None, rotation_variance: float = 0.0) -> None:
        """Carry the state to the next exposure. rotation (3, 3): camera axes now from camera axes then; None: still.

        rotation_variance rad² per axis: of the rotation's error.
        """
        ...

    def update(self, scan: Scan) -> bool:
        """Fold in a scan. One that is older than the last, or the same again, is refused (False) and counted."""
        ...

    def at(
        self, t: float, rotation: Array | None = None, rotation_variance: float = 0.0
    ) -> tuple[Track, ...]:
        """The tracks carried on to t, without those behind the camera then; the tracker itself is unchanged."""
        ...
