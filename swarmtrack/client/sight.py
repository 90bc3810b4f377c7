"""A planner's view of tracks with directions, names and relative states, in the chosen axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from swarmtrack.client.axes import Axes
from swarmtrack.client.freshness import Mark
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Array, Identity, TrackStatus
from swarmtrack.wire.camera import CameraMessage, mounting_from
from swarmtrack.wire.checks import symmetric
from swarmtrack.wire.health import HealthMessage
from swarmtrack.wire.lens import camera_from
from swarmtrack.wire.strangers import StrangersMessage, located_in
from swarmtrack.wire.tracks import RelativeMessage, TrackMessage, TracksMessage, track_cov


@dataclass(frozen=True, slots=True, eq=False)
class DroneCamera:
    """A drone's lens, and how it is mounted: body_from_camera, body FRD, camera x right, y down, z forward [m].

    others: its second camera, its third and so on, where it has several.
    """

    lens: PinholeCamera
    body_from_camera: Pose
    others: tuple[DroneCamera, ...] = ()

    @property
    def all(self) -> tuple[DroneCamera, ...]:
        """Its cameras, in the order of `Target.camera`."""
        return (self, *self.others)


@dataclass(frozen=True, slots=True, eq=False)
class Relative:
    """Position and velocity of a teammate relative to the observer's camera, along the world's axes.

    position (3,) m; velocity (3,) m/s; cov (6, 6) of both. range_sigma_log: uncertainty of the range, as a share of
    it. sources: measurements used ("size", "announcement", "velocity", "range", "pose", "sighting").
    """

    position: Array
    velocity: Array
    cov: Array
    range_sigma_log: float
    sources: tuple[str, ...]

    @property
    def distance(self) -> float:
        """Range, m."""
        return float(np.linalg.norm(self.position))

    @property
    def distance_sigma(self) -> float:
        """Standard deviation of the range, m."""
        return self.range_sigma_log * self.distance


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """One track. `id` is local to its observer and never reused.

    identity: a drone's ID, "foreign" (not of the team) or None (unknown), with its probability. probability: that there
    is anything. coasting_s: since when it was not detected, None while it is. pixel (4,) [u, vu, v, vv] px, px/s of
    undistorted pixels, pixel_cov (4, 4), size (2,) px.

    direction_camera, direction_body (3,): unit vectors from the camera, along its own axes and the body's; None while
    the drone's camera is not known. direction_sigma [rad]: their standard deviation along the worst axis.
    direction_world (3,): from `relative`, or by `Sight.turned`; None without either. relative: None while nothing tells
    the distance, and for all that have no drone's name. camera: which of the drone's cameras it is in the pixels of,
    from 0; a target that goes over from one to another stays the same track.
    """

    id: int
    identity: Identity
    identity_probability: float
    status: TrackStatus
    probability: float
    coasting_s: float | None
    pixel: Array
    pixel_cov: Array
    size: Array
    direction_camera: Array | None
    direction_body: Array | None
    direction_sigma: float | None
    direction_world: Array | None
    relative: Relative | None
    camera: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """All tracks of one drone at one instant.

    t_utc_s [s]: the instant, on the drone's wall clock, with uncertainty t_sigma_s. arrived [s]: time of reception, on
    our monotonic clock. scan_age_s: age of the last image. sequence: a jump by more than one is a lost message. marks:
    why it is no news (`freshness.Mark`); empty where it is.
    """

    drone_id: int
    t_utc_s: float
    t_sigma_s: float
    arrived: float
    scan_age_s: float
    sequence: int
    axes: Axes
    targets: tuple[Target, ...]
    marks: frozenset[Mark] = frozenset()

    @property
    def is_news(self) -> bool:
        """Whether it is neither repeated, nor out of order, nor of another time."""
        return not self.marks

    def of(self, drone_id: int) -> Target | None:
        """The track with this teammate's name; of several, the most probable."""
        named = [target for target in self.targets if target.identity == drone_id]
        return max(named, key=lambda target: target.identity_probability, default=None)

    def turned(self, world_from_body: Array) -> Sight:
        """The same with the direction of every target along the world's axes, those without a name, too.

        world_from_body (3, 3): the observer's attitude at `t_utc_s`, in the axes of this sight.
        """
        return replace(self, targets=tuple(_turned(target, world_from_body) for target in self.targets))


@dataclass(frozen=True, slots=True, eq=False)
class DroneHealth:
    """Health of an agent. message: all of it, fields as in docs/wire.md. marks: as in `Sight`."""

    drone_id: int
    message: HealthMessage
    marks: frozenset[Mark] = frozenset()

    @property
    def is_news(self) -> bool:
        """Whether it is neither repeated, nor out of order, nor of another time."""
        return not self.marks

    @property
    def ready(self) -> bool:
        """Whether the drone could fly now."""
        return self.message.readiness is not None and self.message.readiness.ready

    @property
    def held_by(self) -> tuple[int, ...] | None:
        """The teammates that carry it, whose autopilot has no position or a wrong one; None where that counts."""
        return None if self.message.carried is None else self.message.carried.by

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why it is not ready, for people."""
        return () if self.message.readiness is None else self.message.readiness.reasons


@dataclass(frozen=True, slots=True, eq=False)
class Stranger:
    """A drone that is not of the team, as `drone_id` has located it by the rays of all that see it.

    position (3,) m and velocity (3,) m/s in the world frame of `axes`, cov (6, 6) of both, at t_utc_s. observers: the
    drones that saw it within a second; with one of them the distance is a guess. remote_id: what it claims to be by
    Remote ID, where the claim fits it; else empty. marks: as in `Sight`.
    """

    drone_id: int
    t_utc_s: float
    number: int
    position: Array
    velocity: Array
    cov: Array
    observers: tuple[int, ...]
    remote_id: str
    marks: frozenset[Mark] = frozenset()


def strangers_of(
    drone_id: int, message: StrangersMessage, marks: frozenset[Mark], axes: Axes
) -> tuple[Stranger, ...]:
    """The strangers in a message in the client's form."""
    turn = np.kron(np.eye(2), axes.world_from_ned)
    return tuple(
        Stranger(
            drone_id,
            message.t_utc_s,
            one.number,
            axes.world_from_ned @ one.position,
            axes.world_from_ned @ one.velocity,
            turn @ one.cov @ turn.T,
            one.observers,
            one.remote_id,
            marks,
        )
        for one in located_in(message, message.t_utc_s)
    )


def camera_of(message: CameraMessage) -> DroneCamera:
    """The camera in a message. Raises DecodeError."""
    others = tuple(DroneCamera(camera_from(one.lens), mounting_from(one)) for one in message.others)
    return DroneCamera(camera_from(message.lens), mounting_from(message), others)


def sight_of(
    drone_id: int, message: TracksMessage, camera: DroneCamera | None, arrived: float, axes: Axes
) -> Sight:
    """A message in the client's form. camera: of that drone, its first with all others; None while it is unknown.
    arrived [s].
    """
    relatives = {said.track_id: _relative(said, axes) for said in message.relatives}
    cameras = () if camera is None else camera.all
    return Sight(
        drone_id=drone_id,
        t_utc_s=message.t_utc_s,
        t_sigma_s=message.t_sigma_s,
        arrived=arrived,
        scan_age_s=message.scan_age_s,
        sequence=message.sequence,
        axes=axes,
        targets=tuple(
            _target(track, relatives.get(track.id), number, cameras[number : number + 1], axes)
            for number, track in ((message.camera_of(i), track) for i, track in enumerate(message.tracks))
        ),
    )


def _target(
    track: TrackMessage, relative: Relative | None, number: int, known: Sequence[DroneCamera], axes: Axes
) -> Target:
    """number: of its camera; known: that one, or empty."""
    cov = track_cov(track)
    ray = body = sigma = None
    for camera in known:
        (ray,) = camera.lens.bearing_undistorted(np.array([(track.u_px, track.v_px)]))
        body = axes.body_from_frd @ camera.body_from_camera.rotation @ ray
        # Off an ordinary lens' axis a pixel is a smaller angle: on the safe side.
        spread = float(np.linalg.eigvalsh(cov[::2, ::2])[-1])
        per_radian = camera.lens.per_radian(np.array([(track.u_px, track.v_px)]))
        sigma = max(spread, 0.0) ** 0.5 / float(per_radian.min())
    world = None
    if relative is not None and relative.distance > 0.0:
        world = relative.position / relative.distance
    return Target(
        id=track.id,
        identity=track.identity,
        identity_probability=track.identity_probability,
        status=TrackStatus(track.status),
        probability=track.probability,
        coasting_s=track.coasting_s,
        pixel=np.array([track.u_px, track.vu_px_s, track.v_px, track.vv_px_s]),
        pixel_cov=cov,
        size=np.array([track.w_px, track.h_px]),
        direction_camera=ray,
        direction_body=body,
        direction_sigma=sigma,
        direction_world=world,
        relative=relative,
        camera=number,
    )


def _relative(said: RelativeMessage, axes: Axes) -> Relative:
    turn = axes.world_from_ned
    both = np.kron(np.eye(2), turn)
    return Relative(
        turn @ np.array(said.position_m),
        turn @ np.array(said.velocity_m_s),
        both @ symmetric(np.array([said.cov]), 6)[0] @ both.T,
        said.range_sigma_log,
        said.sources,
    )


def _turned(target: Target, world_from_body: Array) -> Target:
    if target.direction_body is None:
        return target
    return replace(target, direction_world=world_from_body @ target.direction_body)
