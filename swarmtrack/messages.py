"""What the parts of one agent say to each other: small frozen records, checked once at birth and trusted afterwards.

Times are seconds on the agent's monotonic clock, angles radians, lengths metres, image quantities pixels.
World is the team's local NED frame, body is FRD, the camera looks along z with x right and y down.
`a_from_b` takes coordinates in b to coordinates in a.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from swarmtrack.plain_text import plain

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

# rad per axis: of an autopilot that does not say how well it knows its tilt. Names allow for as much.
ASSUMED_TILT = 0.02

# Of one drone, at most.
MOST_CAMERAS = 8

FOREIGN: Literal["foreign"] = "foreign"
Identity = int | Literal["foreign"] | None
"""A drone's ID, `FOREIGN` (not of the team), or None (unknown)."""


def _hold(record: object, attribute: str, shape: tuple[int, ...], *, finite: bool = True) -> None:
    """Check an array of a record, and keep it as float64 in C order.

    Products of matrices round differently in another order, and a recorded flight is to be repeated bit for bit.
    """
    value = getattr(record, attribute)
    if value.shape != shape:
        raise ValueError(f"{type(record).__name__}.{attribute}: expected shape {shape}, got {value.shape}")
    # For few numbers this takes a third of NumPy's time.
    if finite and not all(map(math.isfinite, value.ravel().tolist())):
        raise ValueError(f"{type(record).__name__}.{attribute}: holds NaN or infinity")
    if value.dtype != np.float64 or not value.flags.c_contiguous:
        object.__setattr__(record, attribute, np.ascontiguousarray(value, dtype=np.float64))


def _check(value: Array, shape: tuple[int, ...], what: str) -> None:
    """Shape, order and finiteness of an array that is made here, in the form that it is to have."""
    if value.shape != shape or value.dtype != np.float64 or not value.flags.c_contiguous:
        raise ValueError(f"{what}: expected float64 of shape {shape} in C order, got {value.shape}")
    # The sum of squares is not finite where any of them is not: half of the time that asking each takes.
    if not math.isfinite(float(np.vdot(value, value))):
        raise ValueError(f"{what}: holds NaN or infinity")


class StampKind(enum.Enum):
    """What a frame's time stamp stands for, before it was moved to mid-exposure."""

    EXPOSURE = "exposure"  # start of exposure by the kernel or the camera
    READOUT = "readout"  # end of frame by the kernel
    ARRIVAL = "arrival"  # only our own clock at delivery: add the stream's latency to its uncertainty
    MEDIA = "media"  # time inside a recording


@dataclass(frozen=True, slots=True, eq=False)
class ImuSample:
    """One gyro sample. gyro (3,) rad/s in body FRD; accel (3,) m/s² in body FRD, NaN where not measured.

    t [s]: when the drone turned like that. gyro_delay: s by which the autopilot's filters are late; t has been moved
    back by it already.
    """

    t: float
    gyro: Array
    accel: Array
    gyro_delay: float = 0.0

    def __post_init__(self) -> None:
        _hold(self, "gyro", (3,))
        _hold(self, "accel", (3,), finite=False)


@dataclass(frozen=True, slots=True, eq=False)
class VisualTurn:
    """Rotation of the first camera between two of its exposures, by what its images show (`detection/visual_gyro.py`).

    since, t [s]: exposures; turn (3,) rad: rotation vector in the camera's axes; variance [rad²] of its error, per
    axis: that of any angle where the images do not show it.
    """

    since: float
    t: float
    turn: Array
    variance: float

    def __post_init__(self) -> None:
        _hold(self, "turn", (3,))
        if not (self.since < self.t < math.inf and 0.0 < self.variance < math.inf):
            raise ValueError(f"VisualTurn: expected since < t and a variance above 0, got {self}")


@dataclass(frozen=True, slots=True, eq=False)
class EgoPose:
    """Where this drone is, by its own autopilot: in the frame it started in (NED), or by GPS in the team frame.

    position (3,) m, None where the autopilot knows its attitude only (ArduPilot before its EKF has an origin);
    world_from_body (3, 3). position_sigma [m]: standard deviation north and east; vertical_sigma [m]: down, None where
    it is the same. attitude_sigma [rad]: of the tilt, per axis; how well the heading is known, `EgoHistory` says.
    ground [m]: how far below the drone its range finder has just measured the ground, or what is there; None with most
    poses. t_sigma [s]: standard deviation of t, by the autopilot's clock: for minutes the error is the same.
    """

    t: float
    position: Array | None
    world_from_body: Array
    position_sigma: float = 0.1
    attitude_sigma: float = ASSUMED_TILT
    vertical_sigma: float | None = None
    ground: float | None = None
    t_sigma: float = 0.0

    def __post_init__(self) -> None:
        if self.position is not None:
            _hold(self, "position", (3,))
        _hold(self, "world_from_body", (3, 3))


@dataclass(frozen=True, slots=True)
class AutopilotRebooted:
    """Its clock and its local frame start again; the drone itself is where it was."""


@dataclass(frozen=True, slots=True)
class FlightState:
    """Whether the drone flies, by its autopilot; told once a second, so that a recording may begin anywhere.

    airborne_since [s]: when it took off, −inf where it flew when it was first heard; None: it is on the ground.
    """

    t: float
    airborne_since: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image. t: middle of the exposure; image (h, w) grey or (h, w, 3) BGR, uint8, as the camera gave it.

    `sequence` counts what the camera exposed, so a jump by more than one is a dropped frame. camera: which of the
    drone's, by its place in the config.
    """

    t: float
    t_sigma: float
    sequence: int
    image: Image
    stamp: StampKind
    camera: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """All detections of one frame, pixels of the image as the camera gave it (distorted).

    t: time of exposure; sequence: of the frame; centre (n, 2) [u, v]; size (n, 2) [w, h]; score (n,) in 0…1;
    covariance (n, 2, 2) px² of the centre, or None where the detector does not know. coverage: share of the image that
    was looked at, 0…1; every track was. likeness (n,) in 0…1: how much it looks like a drone, whether it moves or not;
    None: it is the score. camera: which of the drone's, by its place in the config.
    """

    t: float
    sequence: int
    centre: Array
    size: Array
    score: Array
    covariance: Array | None = None
    coverage: float = 1.0
    likeness: Array | None = None
    camera: int = 0

    def __post_init__(self) -> None:
        n = len(self.score)
        _hold(self, "score", (n,))
        _hold(self, "centre", (n, 2))
        _hold(self, "size", (n, 2))
        if self.covariance is not None:
            _hold(self, "covariance", (n, 2, 2))
        if self.likeness is not None:
            _hold(self, "likeness", (n,))

    def __len__(self) -> int:
        return len(self.score)


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """What the tracker is told of one exposure, in undistorted pixels.

    z (m, 2) [u, v]; R (m, 2, 2) px² or None (the tracker's own `measurement_sigma`); size (m, 2) px or None;
    score (m,) or None; likeness (m,) or None, as in `Detections`. Whether a measurement is usable (finite, near the
    image) is the tracker's to judge. coverage: share of the image that was looked at, all tracks with it: so much less
    clutter is expected.
    """

    t: float
    z: Array
    R: Array | None = None
    size: Array | None = None
    score: Array | None = None
    coverage: float = 1.0
    likeness: Array | None = None

    def __post_init__(self) -> None:
        z = np.asarray(self.z, dtype=float)
        object.__setattr__(self, "z", z.reshape(0, 2) if z.size == 0 else z)
        m = len(self.z)
        for name, value, shape in (
            ("z", self.z, (m, 2)),
            ("R", self.R, (m, 2, 2)),
            ("size", self.size, (m, 2)),
            ("score", self.score, (m,)),
            ("likeness", self.likeness, (m,)),
        ):
            if value is not None and np.shape(value) != shape:
                raise ValueError(f"Scan.{name}: expected shape {shape} to match z, got {np.shape(value)}")


class TrackStatus(enum.StrEnum):
    """The stages of a track's life."""

    TENTATIVE = "tentative"
    CONFIRMED = "confirmed"
    LOST = "lost"  # was confirmed, carried on without detections, may still come back


class Track(NamedTuple):
    """One target in the image plane of one camera. mean (4,) [u, vu, v, vv] px, px/s; cov (4, 4); size (2,) px.

    A tuple and no dataclass, because `at` makes thousands of them a second.

    `id` is local to this drone and never reused. `probability` is that of existence. `coasting_since` is the
    time of the first scan that missed it, None while it is being detected. `camera`: in whose pixels it is, by its
    place in the config; a target that goes over from one camera to the next stays the same track.
    """

    id: int
    t: float
    mean: Array
    cov: Array
    status: TrackStatus
    probability: float
    size: Array
    coasting_since: float | None = None
    camera: int = 0


class MotionProof(NamedTuple):
    """A name confirmed by the track's motion alone: its probability, and since when [s]."""

    probability: float
    since: float


RelativeSource = Literal["size", "announcement", "velocity", "range", "pose", "sighting"]
RELATIVE_SOURCES: tuple[RelativeSource, ...] = get_args(RelativeSource)


@dataclass(frozen=True, slots=True, eq=False)
class RelativeState:
    """Where an identified teammate is, and how it moves, relative to this drone's camera, in team axes (NED).

    position (3,) m: the teammate minus the own camera; velocity (3,) m/s: of one against the other; cov (6, 6) of
    both. range_sigma_log: how well the distance is known, as a share of it. sources: measurements used in addition to
    the direction.
    """

    drone_id: int
    t: float
    position: Array
    velocity: Array
    cov: Array
    range_sigma_log: float
    sources: tuple[RelativeSource, ...]

    def __post_init__(self) -> None:
        _hold(self, "position", (3,))
        _hold(self, "velocity", (3,))
        _hold(self, "cov", (6, 6))

    @classmethod
    def of_rows(
        cls,
        t: float,
        keys: Sequence[tuple[int, int]],
        mean: Array,
        cov: Array,
        *,
        range_sigma_log: Sequence[float],
        sources: Sequence[tuple[RelativeSource, ...]],
    ) -> list[RelativeState]:
        """States of n teammates at once: keys, drone and track of each; mean (n, 6) m and m/s, cov (n, 6, 6).
        Checked as a whole, which takes a tenth of the time.
        """
        n = len(keys)
        _check(mean, (n, 6), f"{cls.__name__}.of_rows: mean")
        _check(cov, (n, 6, 6), f"{cls.__name__}.of_rows: cov")
        states, put = [], object.__setattr__
        for i, (drone_id, _) in enumerate(keys):
            state = object.__new__(cls)
            row = mean[i]
            put(state, "drone_id", drone_id)
            put(state, "t", t)
            put(state, "position", row[:3])
            put(state, "velocity", row[3:])
            put(state, "cov", cov[i])
            put(state, "range_sigma_log", range_sigma_log[i])
            put(state, "sources", sources[i])
            states.append(state)
        return states


@dataclass(frozen=True, slots=True, eq=False)
class IdentifiedTrack:
    """A track and who it is. `identity_probability`: that the stated identity is right; 0 while unknown. It falls
    with the track's own while that is not detected. proof: where motion alone says the same. relative: where
    that teammate is, in metres, at the time of the scan; None while nothing tells its range.
    """

    track: Track
    identity: Identity
    identity_probability: float
    proof: MotionProof | None = None
    relative: RelativeState | None = None


@dataclass(frozen=True, slots=True, eq=False)
class TrackList:
    """Everything one drone tracks at one instant; t: the instant; scan_t: exposure of the last scan in it."""

    t: float
    scan_t: float
    tracks: tuple[IdentifiedTrack, ...]


class ScanReport(NamedTuple):
    """What came of one scan: its frame's sequence number, the tracks at its exposure, which camera it was, and where
    the team finds strangers then."""

    sequence: int
    tracks: TrackList
    camera: int = 0
    strangers: tuple[LocatedStranger, ...] = ()


class HeadingNews(NamedTuple):
    """The own heading is known otherwise than before, so this drone should announce itself again.

    step [rad]: by how much it jumped, clockwise; 0 where the autopilot has had the time to align it in flight. doubt
    [rad]: standard deviation that the heading has since, of a step too large for an alignment; else 0.
    """

    t: float
    step: float
    doubt: float = 0.0


class LeapNews(NamedTuple):
    """At t [s] the autopilot's position jumped by off_m [m], which was not flown: the drone is where it was."""

    t: float
    off_m: float


class OwnFault(NamedTuple):
    """The likeliest fault of this drone's own pose; what is not at fault is None.

    heading [rad]: the true one less the autopilot's, clockwise from above; start (north, east) m: the true one less the
    stated one; pad_of: the drone on whose pad this one stands.
    """

    heading: float | None = None
    start: tuple[float, float] | None = None
    pad_of: int | None = None


class DoubtNews(NamedTuple):
    """Whether its sightings contradict this drone's own start or heading, since t [s]: it should announce itself again.
    fault: the likeliest, where the model of identities says so."""

    t: float
    doubted: bool
    fault: OwnFault | None = None


class PoseWanted(NamedTuple):
    """Request to a drone to announce its pose again: the last one is too old to identify it by."""

    drone_id: int


@dataclass(frozen=True, slots=True, eq=False)
class Announcement:
    """The one broadcast of the method: who I am, and my initial pose in the team frame.

    boot (8 hex digits) names one life of the sender's process, `sequence` counts its announcements.
    t: when the pose held, on *our* monotonic clock (converted by the transport), t_sigma its uncertainty.
    position (3,) m; world_from_body (3, 3); position_cov (3, 3) m².
    """

    drone_id: int
    boot: str
    sequence: int
    t: float
    t_sigma: float
    position: Array
    world_from_body: Array
    position_cov: Array

    def __post_init__(self) -> None:
        _hold(self, "position", (3,))
        _hold(self, "world_from_body", (3, 3))
        _hold(self, "position_cov", (3, 3))


@dataclass(frozen=True, slots=True)
class PeerArrived:
    """A teammate's process is alive (its liveliness token was seen)."""

    drone_id: int
    boot: str


@dataclass(frozen=True, slots=True)
class PeerDeparted:
    """A teammate's process is gone, or its radio has been silent for the lease."""

    drone_id: int
    boot: str


@dataclass(frozen=True, slots=True)
class IdClash:
    """Two live processes speak as one drone. `ours` when that drone is this one.

    Told at each that joins. It ends with the `PeerDeparted` of all but one, whose announcement, if it was told, is
    then told again: what was known of the drone meanwhile may have been the other's.
    """

    drone_id: int
    boots: tuple[str, ...]
    ours: bool


@dataclass(frozen=True, slots=True)
class PeerExpelled:
    """A drone is no member of the team any more, by a newer roster."""

    drone_id: int


@dataclass(frozen=True, slots=True)
class AnnouncementRequested:
    """A teammate requests our pose again: one of its tracks may be us, and our last announcement is too old to
    decide.
    """


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """One identified track, as its observer tells the team: the ray on which it sees that drone.

    direction (3,): unit vector from the observer's camera, team frame; sigma: of the direction [rad]. is_confirmed:
    whether motion alone gives the same name, so that it does not rest on a stated start.
    """

    drone_id: int
    probability: float
    direction: Array
    sigma: float
    is_confirmed: bool = False

    def __post_init__(self) -> None:
        _hold(self, "direction", (3,))


@dataclass(frozen=True, slots=True, eq=False)
class SightingReport:
    """Teammates in view of one drone, and its own position at that time.

    t: exposure, on *our* monotonic clock (converted by the transport), t_sigma its uncertainty; position (3,) m of the
    observer's camera in the team frame, position_sigma per axis. known: whose announcements the observer has.
    leans_on: of an observer that its teammates carry, those on whom its position rests.
    """

    observer: int
    boot: str
    sequence: int
    t: float
    t_sigma: float
    position: Array
    position_sigma: float
    known: tuple[int, ...]
    sightings: tuple[Sighting, ...]
    leans_on: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        _hold(self, "position", (3,))


@dataclass(frozen=True, slots=True, eq=False)
class MotionReport:
    """How one drone moves, by its own autopilot: for teammates that want to know a track by its motion.

    t: when it moved so, on *our* monotonic clock (converted by the transport), t_sigma its uncertainty. displacement
    (3,) m: of its body since its process first knew where it was, along the team frame's axes; velocity (3,) m/s;
    their covariances (3, 3).
    """

    drone_id: int
    boot: str
    sequence: int
    t: float
    t_sigma: float
    displacement: Array
    displacement_cov: Array
    velocity: Array
    velocity_cov: Array

    def __post_init__(self) -> None:
        for vector, cov in (("displacement", "displacement_cov"), ("velocity", "velocity_cov")):
            _hold(self, vector, (3,))
            _hold(self, cov, (3, 3))


@dataclass(frozen=True, slots=True, eq=False)
class AgreedMotion:
    """How a teammate moves, or this drone itself is to sway, by what was agreed before the flight; nothing of it was on
    the air.

    t (n,) s, increasing, n ≥ 2, on our monotonic clock; displacement (n, 3) m in the team frame's axes, counted from
    anywhere. planned: by a plan of its way, which is flown less exactly than a code. tried: whether it flies that then
    is not known.
    """

    drone_id: int
    t: Array
    displacement: Array
    planned: bool
    tried: bool = False

    def __post_init__(self) -> None:
        n = len(self.t)
        _hold(self, "t", (n,))
        _hold(self, "displacement", (n, 3))
        if n < 2 or not (np.diff(self.t) > 0.0).all():
            raise ValueError(f"AgreedMotion.t: expected two or more times that increase, got {n} that do not")


@dataclass(frozen=True, slots=True, eq=False)
class RangeReport:
    """A distance that a ranging radio measured between two drones, m from antenna to antenna; sigma m.

    t: when, on *our* monotonic clock (converted by the transport), t_sigma its uncertainty.
    """

    drone_id: int
    other: int
    t: float
    t_sigma: float
    distance: float
    sigma: float

    def __post_init__(self) -> None:
        sound = math.isfinite(self.distance) and self.distance > 0.0 and 0.0 < self.sigma < math.inf
        if not sound:
            raise ValueError(
                f"RangeReport: found {self.distance} m ± {self.sigma} m, expected finite numbers above 0"
            )


@dataclass(frozen=True, slots=True, eq=False)
class StrangerRay:
    """On which ray an observer sees a drone that is not of the team.

    number: the stranger's, as the observer has it; direction (3,): unit vector from the observer's camera, team frame;
    sigma [rad]: per axis, of what changes from scan to scan. width [rad]: of what its box is around; 0 where the box
    does not tell.
    """

    number: int
    direction: Array
    sigma: float
    width: float

    def __post_init__(self) -> None:
        _hold(self, "direction", (3,))


@dataclass(frozen=True, slots=True, eq=False)
class LocatedStranger:
    """A drone that is not of the team, by the rays of all that see it.

    position (3,) m and velocity (3,) m/s in the team frame at t, cov (6, 6) of both; observers: those that have seen it
    within a second. remote_id: what it claims to be, where a claim fits it; else empty.
    """

    number: int
    t: float
    position: Array
    velocity: Array
    cov: Array
    observers: tuple[int, ...]
    remote_id: str = ""

    def __post_init__(self) -> None:
        _hold(self, "position", (3,))
        _hold(self, "velocity", (3,))
        _hold(self, "cov", (6, 6))


@dataclass(frozen=True, slots=True, eq=False)
class StrangerReport:
    """Strangers in view of one drone, and its own position at that time.

    t: exposure, on *our* monotonic clock (converted by the transport), t_sigma its uncertainty; position (3,) m of the
    observer's camera in the team frame. position_sigma [m], tilt_sigma and heading_sigma [rad]: per axis, of what
    lasts. located: where the observer finds them, for readers; it is no evidence for its team.
    """

    observer: int
    boot: str
    sequence: int
    t: float
    t_sigma: float
    position: Array
    position_sigma: float
    tilt_sigma: float
    heading_sigma: float
    rays: tuple[StrangerRay, ...]
    located: tuple[LocatedStranger, ...] = ()

    def __post_init__(self) -> None:
        _hold(self, "position", (3,))


@dataclass(frozen=True, slots=True, eq=False)
class RemoteIdClaim:
    """What a drone claims by Remote ID of where it is and how it flies, as the autopilot has received it.

    t: when it was received; uas_id: by which the drone calls itself; position (3,) m and velocity (3,) m/s in the team
    frame; position_sigma and vertical_sigma [m].
    """

    t: float
    uas_id: str
    position: Array
    velocity: Array
    position_sigma: float
    vertical_sigma: float

    def __post_init__(self) -> None:
        _hold(self, "position", (3,))
        _hold(self, "velocity", (3,))
        object.__setattr__(self, "uas_id", plain(self.uas_id))


PeerEvent = (
    Announcement
    | PeerArrived
    | PeerDeparted
    | IdClash
    | PeerExpelled
    | AnnouncementRequested
    | SightingReport
    | MotionReport
    | RangeReport
    | StrangerReport
)

Membership = PeerArrived | PeerDeparted | IdClash | PeerExpelled
TeamEvent = (
    Announcement | Membership | SightingReport | MotionReport | RangeReport | StrangerReport | AgreedMotion
)
"""What a drone's perception is told of its team."""
Input = (
    ImuSample
    | EgoPose
    | FlightState
    | AutopilotRebooted
    | VisualTurn
    | Detections
    | RemoteIdClaim
    | TeamEvent
)
"""All that a drone's perception is ever told; that somebody asks for its tracks is the one thing beside it."""


@dataclass(frozen=True, slots=True)
class LinkStatus:
    """State of one source or link, as one line for people and numbers for the health message.

    name, text: may quote anything, and are plain text from birth on.
    """

    name: str
    ok: bool
    text: str
    counters: tuple[tuple[str, float], ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", plain(self.name))
        object.__setattr__(self, "text", plain(self.text))
