"""What a camera and an autopilot are, to the agent. One file implements each kind; the address tells which.

A source that is away (unplugged, not yet booted) is not an error: it says so once, waits and comes back. Only an
address that can never work raises `SourceError`."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from typing import Protocol, runtime_checkable

from swarmtrack.clock import Clock
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import (
    Announcement,
    Detections,
    EgoPose,
    FlightState,
    Frame,
    ImuSample,
    LinkStatus,
    RemoteIdClaim,
)

SIMULATIONS = "swarmtrack.simulations"
"""Entry points by scheme: each is an `OpenSimulation`. swarmtrack's own lab registers `sim`."""


class Camera(Protocol):
    """A source of frames."""

    def frames(self) -> AsyncIterator[Frame]:
        """Yield the newest frame whenever asked for one; ends only where the source does (a file).

        Frames that came while the consumer was busy are dropped and counted, except from a file at pace `fast`,
        which yields every frame in order.
        """
        ...

    def status(self) -> LinkStatus:
        """One line and the counters (fps, dropped, stale, reconnects, age) for the health message."""
        ...

    async def close(self) -> None: ...


@runtime_checkable
class AnnouncingCamera(Camera, Protocol):
    """A camera that says that there is a frame before it is taken: the one that is taken later is the newest then."""

    async def arrived(self) -> None:
        """Until a frame waits, or nothing more will come. Once `frames` has been called."""
        ...


@runtime_checkable
class DetectionSource(Protocol):
    """A camera that detects by itself, or a detector in another process: no picture ever reaches us."""

    def detections(self) -> AsyncIterator[Detections]:
        """Yield the newest detections whenever asked for them, those of an empty frame too; never ends by itself."""
        ...

    def status(self) -> LinkStatus:
        """As of a camera."""
        ...

    async def close(self) -> None: ...


class AutopilotListener(Protocol):
    """Listener to an autopilot's events; called on the event loop, must return at once."""

    def on_imu(self, sample: ImuSample) -> None: ...
    def on_pose(self, pose: EgoPose) -> None: ...
    def on_flight_state(self, state: FlightState) -> None: ...
    def on_autopilot_reboot(self) -> None: ...
    def on_switch(self, t: float) -> None:
        """The pilot's switch was thrown at t [s, our clock], where one is watched."""
        ...

    def on_remote_id(self, claim: RemoteIdClaim) -> None:
        """Remote ID of another aircraft was received, where the team's origin is known."""
        ...

    def on_found_flying(self) -> None:
        """At most once, at the first contact: the drone was in the air already."""
        ...


class Autopilot(Protocol):
    """A source of gyro samples and ego poses."""

    async def run(self, listener: AutopilotListener) -> None:
        """Connect, reconnect and deliver until cancelled; returns only where a recording ends."""
        ...

    def status(self) -> LinkStatus: ...


class CalibratedCamera(Camera, Protocol):
    """A camera that is known, as simulated ones are."""

    @property
    def camera(self) -> PinholeCamera: ...
    @property
    def body_from_camera(self) -> Pose: ...


class SimulatedSources(Protocol):
    """What a simulated flight gives the agent of one drone. initial_pose: world_from_body, in the team frame;
    start_sigma_m: how well that start is known, m per axis."""

    @property
    def camera(self) -> CalibratedCamera: ...
    @property
    def autopilot(self) -> Autopilot: ...
    @property
    def initial_pose(self) -> Pose: ...
    @property
    def start_sigma_m(self) -> float: ...
    def teammates_announcements(self) -> list[Announcement]:
        """Those of teammates that have no agents."""
        ...


OpenSimulation = Callable[[str, int | None, Clock], SimulatedSources]
"""From an address, the drone's ID (None: as the address says) and its clock. Raises SourceError."""
