"""The config of one drone: TOML in, checked values out, every mistake named with its file and line.

The tables and keys are DESIGN's contract 4. Relative paths of what is read (calibration, recordings, keys, models)
start at the folder of the file that names them; those of what is written (`[output]`) at the working directory.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar
from urllib.parse import quote

import numpy as np
from pydantic import (
    ConfigDict,
    Field,
    PrivateAttr,
    Strict,
    field_serializer,
    field_validator,
    model_validator,
)

from swarmtrack.config.formation import TeamFormation, formation_problems
from swarmtrack.config.ros2 import Ros2Section, or_switch
from swarmtrack.config.team import TeamSection, resolve_plan, roster_problems, switch_problems, take_own_start
from swarmtrack.config.toml.layers import Key, Layer, Layers, Problem, Table, merge, read_layers
from swarmtrack.config.toml.sections import (
    Count,
    Number,
    ParameterSection,
    Place,
    Positive,
    Probability,
    Section,
    Switch,
    Text,
    Vector,
    check_drone_ids,
    found,
    key_text,
    one_of,
    parameter_problems,
    validated,
)
from swarmtrack.errors import ConfigError, SwarmtrackError
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import Distortion, Equidistant, PinholeCamera, RadTan
from swarmtrack.geometry.pose import Pose
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.messages import MOST_CAMERAS
from swarmtrack.motion.heading import HeadingSigma
from swarmtrack.relative.box_width import BoxWidth
from swarmtrack.tracking import DEFAULT_TRACKER, TRACKERS

DISTORTIONS: dict[str, type[RadTan] | type[Equidistant]] = {"radtan": RadTan, "equidistant": Equidistant}
TEAM_FRAME_ORIGIN: Vector = (0.0, 0.0, 0.0)
Angle = Annotated[Positive, Field(le=180.0)]
FRD_FROM = {"frd": np.eye(3), "flu": np.diag([1.0, -1.0, -1.0])}

# m: of a start of which nobody wrote how well it was measured.
UNWRITTEN_SIGMA_M = 1.0


class Start(Section):
    """Where the drone stands in the team frame when it announces itself: measured, or from its own autopilot."""

    position_m: Place = Field(
        default=TEAM_FRAME_ORIGIN, description="[north, east, down] in the team frame, m; up is negative"
    )
    yaw_deg: Number = Field(
        default=0.0, description="heading of the nose, clockwise from the team frame's north"
    )
    position_sigma_m: Positive = Field(
        default=UNWRITTEN_SIGMA_M,
        description="standard deviation of the start position, m per axis: 0.1 by a tape, 0.3 on a marked pad; "
        '1 m is assumed without it; with from = "gps" it replaces the receiver\'s own',
    )
    source: Literal["local", "gps"] | None = Field(
        default=None,
        alias="from",
        description='"local": the autopilot\'s own local pose, turned by offset_yaw_deg and shifted by offset_m; '
        '"gps": its global position '
        "relative to the origin in [team], and its heading from true north",
    )
    offset_m: Place = Field(
        default=TEAM_FRAME_ORIGIN, description="origin of the autopilot's local frame, in the team frame, m"
    )
    offset_yaw_deg: Number = Field(
        default=0.0,
        description="heading of the local frame's first axis, clockwise from the team frame's north: not 0 without "
        "a compass (motion capture, visual odometry)",
    )

    @model_validator(mode="after")
    def _one_way_only(self) -> Start:
        said = self.model_fields_set
        measured = " and ".join(sorted(said & {"position_m", "yaw_deg"}))
        if self.source is not None and measured:
            local = ": offset_m and offset_yaw_deg say where its local frame lies" * (self.source == "local")
            raise ValueError(
                f'{measured} together with from = "{self.source}", expected one or the other{local}'
            )
        instead = {"offset_m": "position_m", "offset_yaw_deg": "yaw_deg"}
        by_gps = {
            "offset_m": "the origin in [team] to be moved",
            "offset_yaw_deg": "a heading from true north",
        }
        for key in instead.keys() & said:
            if self.source is None:
                raise ValueError(f'{key} without from = "local", expected {instead[key]} instead')
            if self.source == "gps":
                raise ValueError(f'{key} together with from = "gps", expected {by_gps[key]}')
        return self

    @property
    def stated_sigma_m(self) -> float | None:
        """`position_sigma_m` where the user wrote it."""
        return self.position_sigma_m if "position_sigma_m" in self.model_fields_set else None

    @property
    def has_unknown_sigma(self) -> bool:
        """Whether a measured start is configured without its uncertainty; a receiver says so itself."""
        return self.source != "gps" and self.stated_sigma_m is None

    @property
    def frame_sigma_m(self) -> float:
        """How well the origin of the autopilot's positions is known; with GPS it is the team's origin itself."""
        return 0.0 if self.source == "gps" else self.position_sigma_m

    def pose(self) -> Pose:
        """team_from_body of a drone that stands level; its true roll and pitch are the autopilot's to say."""
        return Pose(rotation.from_euler(0.0, 0.0, np.radians(self.yaw_deg)), np.array(self.position_m))


class Vehicle(Section):
    """[drone]: this drone's ID and its start."""

    id: Annotated[int, Strict(), Field(ge=1, le=65535, description="1 … 65535, unique in the team")]
    start: Start = Field(default=Start(), description="pose in the team frame at the start of its agent")


class Intrinsics(Section):
    """A pinhole camera, for images of one size."""

    fx: Positive = Field(description="focal length along a row, px")
    fy: Positive = Field(description="focal length along a column, px")
    cx: Number = Field(description="column of the optical axis, px; the first pixel's centre is 0")
    cy: Number = Field(description="row of the optical axis, px")
    width: Count = Field(description="width of the image, px")
    height: Count = Field(description="height of the image, px")

    @model_validator(mode="after")
    def _of_one_image(self) -> Intrinsics:
        """A slip of the decimal point shows in the optical axis. That of a cropped image may lie beside it."""
        beside = (
            abs(self.cx - 0.5 * self.width) > self.width or abs(self.cy - 0.5 * self.height) > self.height
        )
        if beside:
            raise ValueError(
                f"found cx = {self.cx:g}, cy = {self.cy:g}, expected an optical axis in the image of {self.width} x "
                f"{self.height}, or near it"
            )
        return self


class Lens(Section):
    """How a lens bends straight lines."""

    model: Literal["radtan", "equidistant"] = Field(
        description="radtan (also called plumb_bob) for ordinary lenses, equidistant for fisheyes"
    )
    coefficients: tuple[Number, ...] = Field(
        description="radtan: k1 k2 p1 p2 [k3 [k4 k5 k6]]; equidistant: k1 … k4"
    )

    @model_validator(mode="after")
    def _right_number_of_coefficients(self) -> Lens:
        self.distortion()
        return self

    def distortion(self) -> Distortion:
        return DISTORTIONS[self.model](self.coefficients)


class Mount(Section):
    """Where a camera sits. With zero angles it looks along the nose, upright."""

    rpy_deg: Vector = Field(
        default=TEAM_FRAME_ORIGIN,
        description="roll, pitch, yaw of the camera as if it were a body, degrees; zeros look along the nose",
    )
    position_m: Vector = Field(
        default=TEAM_FRAME_ORIGIN, description="[forward, right, down] from the origin of the body, m"
    )

    def pose(self) -> Pose:
        """body_from_camera."""
        body_from_aimed = rotation.from_euler(*np.radians(self.rpy_deg))
        return Pose(body_from_aimed @ rotation.BODY_FROM_FORWARD_CAMERA, np.array(self.position_m))


class CameraSection(Section):
    """[camera]: where frames come from, what the lens does, how the camera sits on the drone. Of several cameras, up to
    eight, each has a table `[[camera]]` with the same keys (docs/calibration.md)."""

    source: Text = Field(
        description="v4l2:///dev/video0, file://, images://, rtsp://, http://, detections:// or sim://"
    )
    calibration: Path | None = Field(
        default=None,
        description="calibration file of Kalibr, ROS, OpenCV or another tool (docs/calibration.md)",
    )
    calibration_camera: Text | None = Field(
        default=None, description="which camera, where the file holds several, such as cam1"
    )
    intrinsics: Intrinsics | None = Field(
        default=None, description="the intrinsics as numbers, px, instead of a file"
    )
    distortion: Lens | None = Field(default=None, description="the distortion that goes with intrinsics")
    body_from_camera: Mount | None = Field(
        default=None, description="where the camera sits; overrides the file's"
    )
    imu_frame: Literal["frd", "flu"] = Field(
        default="frd", description="axes of the IMU used for the calibration file"
    )
    time_offset_s: Number | None = Field(
        default=None, description="exposure on the IMU's clock = stamp + this; overrides the file's"
    )
    estimate_time_offset: Switch = Field(
        default=True,
        description="estimate the offset in flight, starting at time_offset_s; used once it is certain",
    )
    max_age_s: Positive = Field(
        default=0.5, description="a frame older than this when its turn comes is skipped, s since exposure"
    )
    mounting_sigma_deg: Angle = Field(
        default=1.0,
        description="standard deviation of the camera's mounting angles, degrees per axis: added to a track's "
        "uncertainty at its passage from one camera to another; used only with several",
    )

    @model_validator(mode="after")
    def _one_calibration(self) -> CameraSection:
        if self.calibration is not None and self.intrinsics is not None:
            raise ValueError("both calibration and intrinsics, expected one of them")
        if self.calibration is None and self.intrinsics is None and not self.simulated:
            raise ValueError(
                'neither calibration nor intrinsics, expected calibration = "FILE", '
                "or intrinsics = { fx, fy, cx, cy, width, height }"
            )
        if self.distortion is not None and self.intrinsics is None:
            raise ValueError("distortion without intrinsics, expected both or a calibration file")
        if self.intrinsics is not None:
            try:
                self.lens_of(self.intrinsics)
            except ValueError:
                raise ValueError(
                    f"intrinsics: found cx = {self.intrinsics.cx:g}, cy = {self.intrinsics.cy:g}, expected an "
                    "optical axis so near to the image that the lens reaches a part of it"
                ) from None
        return self

    def lens_of(self, intrinsics: Intrinsics) -> PinholeCamera:
        """With the distortion. Raises ValueError where it reaches no part of its image."""
        lens = self.distortion.distortion() if self.distortion else None
        return PinholeCamera(**intrinsics.model_dump(), distortion=lens)

    @property
    def guessed_angle_deg(self) -> float | None:
        """Horizontal field of view of an ideal lens, as `swarmtrack config new` guesses one; None: it was measured."""
        lens = self.intrinsics
        if lens is None or self.distortion is not None or lens.fx != lens.fy:
            return None
        if (lens.cx, lens.cy) != (0.5 * (lens.width - 1), 0.5 * (lens.height - 1)):
            return None
        return math.degrees(2.0 * math.atan(0.5 * lens.width / lens.fx))

    @property
    def simulated(self) -> bool:
        return self.source.startswith("sim:")

    @property
    def detects_by_itself(self) -> bool:
        return self.source.strip().lower().startswith("detections:")

    @property
    def mounting_sigma(self) -> float:
        """rad"""
        return math.radians(self.mounting_sigma_deg)


def _one_or_several(entry: dict[str, Any]) -> None:
    """The schema of an entry that is a table, or an array of tables."""
    one = entry.pop("items")
    several = {"type": "array", "items": one, "minItems": 1, "maxItems": MOST_CAMERAS}
    entry.pop("type")
    entry["anyOf"] = [one, several]


class HeadingSigmas(Section):
    """How well an autopilot knows its heading."""

    ground: Angle = Field(default=3.0, description="on the ground, and in the first 20 s of flight, degrees")
    flight: Angle = Field(default=1.5, description="in flight, once the autopilot has aligned it, degrees")


def _or_one_number(entry: dict[str, Any]) -> None:
    """The schema of an entry that is a table, or one number for all of its keys."""
    entry["anyOf"] = [
        {"type": "number", "exclusiveMinimum": 0.0, "maximum": 180.0},
        {"$ref": entry.pop("$ref")},
    ]


class AutopilotSection(Section):
    """[autopilot]: the MAVLink link, what we request on it and what we send."""

    link: Text = Field(
        default="none",
        description="udpin:HOST:PORT, udpout:, tcp:, serial:DEVICE:BAUD, tlog:FILE, ulog:FILE, bin:FILE or none",
    )
    imu_rate_hz: Annotated[Positive, Field(le=1000.0)] = Field(
        default=200.0, description="IMU rate requested from the autopilot"
    )
    system_id: Annotated[int, Strict(), Field(ge=1, le=255)] | None = Field(
        default=None, description="system ID of our autopilot; needed where several share one link"
    )
    heading_sigma_deg: HeadingSigmas = Field(
        default=HeadingSigmas(),
        description="standard deviation of the autopilot's heading, degrees: one number, or { ground, flight }",
        json_schema_extra=_or_one_number,
    )
    tilt_sigma_deg: Angle = Field(
        default=0.5,
        description="standard deviation of the autopilot's roll and pitch, degrees, for relative states in metres; a "
        "simulated ArduPilot in flight had 0.15",
    )
    signing_key: Path | None = Field(default=None, description="file with the 32-byte key as 64 hex digits")
    component_id: Annotated[int, Strict(), Field(ge=191, le=194)] = Field(
        default=191, description="our own component ID; change it where another onboard computer uses 191"
    )
    tell: tuple[Literal["status", "teammates", "camera_tracking", "adsb"], ...] = Field(
        default=("status",),
        description='what to send to the ground station through the autopilot; "status": texts, and how many '
        'teammates are identified; "teammates": where each is, as texts; "camera_tracking": the box of one teammate; '
        '"adsb": their positions on the map, but read docs/telling.md first; []: only a heartbeat',
    )

    feed: Literal["none", "odometry"] = Field(
        default="none",
        description='"odometry": while the autopilot has no position and teammates hold the drone, its place by them '
        "is sent to the autopilot as ODOMETRY; parameters decide whether it flies by that (docs/feeding.md)",
    )
    feed_hz: Annotated[Number, Field(ge=10.0, le=30.0)] = Field(
        default=20.0, description="ODOMETRY per second, 250 bytes each"
    )
    feed_max_sigma_m: Annotated[Positive, Field(le=5.0)] = Field(
        default=2.0, description="a place whose worst axis is vaguer is not sent, m"
    )
    feed_max_age_s: Annotated[Positive, Field(le=2.0)] = Field(
        default=1.0, description="a place whose newest ray of a teammate, or to one, is older is not sent, s"
    )

    @field_validator("tell", mode="before")
    @classmethod
    def _nobody_is_followed(cls, tell: object) -> object:
        for word in tell if isinstance(tell, list | tuple) else ():
            if word == "follow_target":
                raise ValueError(
                    'found "follow_target", expected status, teammates, camera_tracking or adsb: a vehicle '
                    "follows that message, and one camera measures no range (docs/telling.md)"
                )
        return tell

    @field_validator("heading_sigma_deg", mode="before")
    @classmethod
    def _one_number_is_both(cls, said: object) -> object:
        if isinstance(said, float | int) and not isinstance(said, bool):
            return {"ground": said, "flight": said}
        if isinstance(said, dict | HeadingSigmas):
            return said
        raise ValueError(f"{found(said)}, expected degrees, or {{ ground = 3.0, flight = 1.5 }}")

    @property
    def tilt_sigma(self) -> float:
        """rad"""
        return math.radians(self.tilt_sigma_deg)

    @property
    def heading_sigma(self) -> HeadingSigma:
        said = self.heading_sigma_deg
        return HeadingSigma(math.radians(said.ground), math.radians(said.flight))


class BoxWidthSection(Section):
    """[detector.box_width]: how wide the detector draws its boxes; `swarmtrack calibrate size` measures it."""

    factor: Number | None = Field(
        default=None, description="width of a box without its padding, in spans of the airframe"
    )
    padding_px: Number | None = Field(default=None, description="padding of every box, px of the image")
    drone_sigma: Number | None = Field(
        default=None, description="standard deviation of the width between drones, as a share of it"
    )
    wander_sigma: Number | None = Field(
        default=None, description="standard deviation of its drift within one flight, as a share of it"
    )
    wander_s: Number | None = Field(default=None, description="time constant of that drift, s")
    white_sigma: Number | None = Field(
        default=None, description="standard deviation between frames, as a share of it"
    )

    @model_validator(mode="after")
    def _within_limits(self) -> BoxWidthSection:
        self.over(BoxWidth())
        return self

    def over(self, said: BoxWidth) -> BoxWidth:
        """What the detector says of itself, but for the keys that the user wrote."""
        return replace(said, **self.model_dump(exclude_none=True))


class DetectorSection(Section):
    """[detector]: which network looks at the frames, and how (docs/detector.md)."""

    model: Text = Field(default="default", description='"default" for the shipped model, or an .onnx file')
    score_threshold: Probability | None = Field(
        default=None, description="overrides the model's own threshold"
    )
    second_stage: Text = Field(
        default="auto",
        description='second network, which re-examines each detection: "default" for the shipped one, an .onnx file, '
        'or "none"; "auto": '
        "the shipped one with the shipped model, else none",
    )
    input_scale: Annotated[Positive, Field(le=4.0)] | None = Field(
        default=None,
        description="size of the detector's input relative to the image, for whole frames: below 1 is faster, above "
        '1 sees farther; 0.5 by default, or 1 with look = "whole"',
    )
    look: Literal["auto", "whole", "guided"] = Field(
        default="auto",
        description='"whole": whole frames; "guided": windows around the tracks in every frame, and the whole frame '
        'every whole_every frames; "auto": guided where the whole frame would be shrunk',
    )
    whole_every: Count = Field(
        default=5, description="with guided looks: frames from one whole frame to the next"
    )
    target_px: Positive = Field(
        default=48.0,
        description="with guided looks: windows are enlarged, up to three times, until a drone is this wide",
    )
    tiles: Switch = Field(
        default=True,
        description="with guided looks, where whole frames are shrunk: also one full-resolution tile per frame",
    )
    share: Annotated[Positive, Field(le=1.0)] = Field(
        default=1.0,
        description="share of the time for which the detector may run, per camera; with guided looks, tiles are left "
        "out above it",
    )
    motion: Switch = Field(
        default=True,
        description="compare with the frame a tenth of a second earlier, aligned by the gyro; a detection that moved "
        "becomes more likely",
    )
    threads: Count = Field(
        default=1, description="threads for inference; more than one is slower on a busy machine"
    )
    providers: tuple[Literal["cpu", "xnnpack", "openvino", "cuda", "tensorrt", "qnn", "coreml"], ...] = Field(
        default=("cpu",),
        min_length=1,
        description="ONNX Runtime providers, best first; those not installed are skipped",
    )
    engine_cache: Path | None = Field(
        default=None,
        description="folder for engines compiled by TensorRT or OpenVINO, instead of ~/.cache/swarmtrack",
    )
    head: Literal["auto", "centernet", "yolo_v5", "yolo_v8", "end_to_end", "detr", "labelled_boxes"] = Field(
        default="auto", description="format of your own network's outputs"
    )
    names: tuple[Text, ...] = Field(
        default=(), description="class names, where the model file does not give them"
    )
    classes: tuple[Text, ...] = Field(
        default=(), description="the classes that are drones; by default those with a drone's name"
    )
    veto: tuple[Text, ...] = Field(
        default=(),
        description="classes that rule out a drone in the same place; by default bird, airplane, …",
    )
    channel_order: Literal["BGR", "RGB"] | None = Field(
        default=None, description="channel order that your own network was trained on"
    )
    scale: tuple[Number, Number, Number] | None = Field(
        default=None, description="your own network gets scale * (pixel - mean) per channel"
    )
    mean: tuple[Number, Number, Number] | None = Field(default=None, description="see scale")
    box_width: BoxWidthSection = Field(
        default=BoxWidthSection(),
        description="width of its boxes relative to the drones' span; default: from the model's file, else tight "
        "boxes (docs/metres.md)",
    )


class TrackerSection(ParameterSection):
    """[tracker]: which tracker, and its parameters (docs/tracking.md)."""

    name: Text = Field(default=DEFAULT_TRACKER, description="which tracker")


class IdentitySection(ParameterSection):
    """[identity]: when a track gets a drone's ID (docs/identity.md)."""


class NetworkSection(Section):
    """[network]: the team, and how drones reach each other (docs/security.md)."""

    team: str = Field(
        default="swarm",
        pattern=r"^[A-Za-z0-9_-]{1,64}$",
        description="letters, digits, - and _",
    )
    transport: Literal["zenoh", "memory"] = Field(
        default="zenoh", description='"memory" works within one process only'
    )
    keys: Text | None = Field(
        default=None,
        description="folder that `swarmtrack keys issue` made for this drone; {id} stands for drone.id",
    )
    topology: Literal["mesh", "routers"] = Field(
        default="mesh",
        description='"mesh": each drone dials every other; "routers": all dial routers, which relay',
    )
    peers: dict[str, Text] = Field(
        default={}, description='for a mesh: ID = "HOST" or "HOST:PORT" for every drone of the team'
    )
    routers: tuple[Text, ...] = Field(
        default=(),
        description='for topology "routers": HOST or HOST:PORT of each, in the same order on every drone',
    )
    listen: tuple[Text, ...] = Field(
        default=(),
        description="HOST, HOST:PORT or Zenoh endpoints to listen on, instead of this drone's own entry in peers",
    )
    connect: tuple[Text, ...] = Field(
        default=(), description="HOST, HOST:PORT or Zenoh endpoints to dial, in addition to peers"
    )
    multicast: Switch = Field(default=False, description="also find teammates by multicast")
    interface: Text = Field(default="auto", description="interface for multicast, such as wlan0")
    insecure: Switch = Field(default=False, description="true allows traffic beyond this machine without TLS")
    lease_s: Annotated[Number, Field(ge=0.5, le=60.0)] = Field(
        default=2.0, description="a teammate that is silent for this long is gone"
    )
    tracks_kbit_s: Annotated[Number, Field(ge=8.0, le=1e6)] | None = Field(
        default=None,
        description="most that tracks and video take of the radio, all listeners together; no limit by default",
    )

    @field_validator("peers")
    @classmethod
    def _peers_by_id(cls, peers: dict[str, str]) -> dict[str, str]:
        check_drone_ids(peers, '1 = "HOST:PORT"')
        return peers

    @model_validator(mode="after")
    def _one_topology(self) -> NetworkSection:
        if self.topology == "routers" and not self.routers:
            raise ValueError('topology = "routers" without routers, expected routers = ["HOST:PORT", …]')
        if self.topology == "routers" and (self.listen or self.connect):
            raise ValueError(
                'listen or connect together with topology = "routers", expected neither: all dial the routers'
            )
        return self

    def keys_of(self, drone_id: int) -> Path | None:
        """The folder of a drone's keys. The path with {id} may stand in the team's file."""
        return None if self.keys is None else Path(self.keys.replace("{id}", str(drone_id)))


class OutputSection(Section):
    """[output]: files for people, in addition to the network. Paths are relative to the working directory."""

    jsonl: Path | None = Field(default=None, description="JSON lines, one per processed frame")
    video: Path | None = Field(default=None, description="video of the annotated frames, .mp4")
    health: Path | None = Field(
        default=None, description="the agent's health as JSON, replaced each second (`swarmtrack healthy`)"
    )
    tracks_hz: Annotated[Positive, Field(le=1000.0)] = Field(
        default=50.0, description="highest rate of published tracks"
    )
    ros2: Ros2Section | None = Field(
        default=None,
        description="also publish topics of ROS 2 (rmw_zenoh), without ROS; `true`, or a table of what differs",
        json_schema_extra=or_switch,
    )

    @field_validator("ros2", mode="before")
    @classmethod
    def _true_is_all_defaults(cls, said: object) -> object:
        """`true` is the same as an empty table."""
        return {True: Ros2Section(), False: None}[said] if isinstance(said, bool) else said


class RecordingSection(Section):
    """[recording]: off unless a folder is given."""

    dir: Path | None = Field(
        default=None,
        description="folder for recordings; each start of the agent makes a new one in its subfolder drone-ID",
    )
    frames: Literal["none", "jpeg"] = Field(
        default="none", description='"jpeg" also records images, at frames_hz; they take most of the space'
    )
    frames_hz: Annotated[Positive, Field(le=1000.0)] = Field(
        default=5.0, description="highest rate of recorded images"
    )
    segment_s: Annotated[Number, Field(ge=1.0, le=3600.0)] = Field(
        default=30.0, description="length of one file; complete files survive a power cut"
    )
    max_mb: Annotated[Number, Field(ge=1.0, le=1e7)] = Field(
        default=1000.0, description="limit for all recordings of this drone together, 10⁶ bytes"
    )
    when_full: Literal["oldest", "stop"] = Field(
        default="oldest", description='at max_mb: "oldest" deletes the oldest files, "stop" stops recording'
    )


class MotionSection(Section):
    """[motion]: the camera's rotation, which carries tracks from one exposure to the next."""

    turn_from: Literal["auto", "gyro", "images", "both", "nothing"] = Field(
        default="auto",
        description="source of the camera's rotation: the autopilot's gyro; the first camera's images, for a camera "
        "on a gimbal; both, where images replace a silent gyro and check one that is not; or nothing, for a tripod. "
        '"auto": the gyro, or both where autopilot.link is "none"',
    )

    history_s: Annotated[Number, Field(ge=0.1, le=60.0)] = Field(
        default=2.0, description="largest delay of a detection after its exposure"
    )
    # Ten times the white noise of a MEMS gyro, which is what the simulator has. In three recorded flights with SITL,
    # whose gyro has hardly any, rotations over 0.1 to 0.5 s were still 0.9e-3 to 5.9e-3 rad/√s off the truth (median
    # 1.7e-3): filters and stamps count too.
    gyro_noise_density_rad_s_sqrt_hz: Positive = Field(
        default=2e-3,
        description="growth of the uncertainty of a rotation by the gyro, rad per √s: white noise (about a tenth of "
        "the default), vibration, scale and time stamps",
    )
    angular_acceleration_psd_rad2_s3: Positive = Field(
        default=1.0,
        description="angular acceleration of the drone, which adds uncertainty where gyro samples are missing",
    )
    gyro_delay_s: Annotated[Number, Field(ge=0.0, le=0.1)] | None = Field(
        default=None,
        description="delay of the autopilot's gyro; default: from its filter's parameter, which is read once",
    )
    gyro_bias_rad_s: Vector = Field(
        default=TEAM_FRAME_ORIGIN, description="reading of the gyro at rest, body FRD"
    )
    estimate_gyro_bias: Switch = Field(
        default=True,
        description="estimate it in flight from the autopilot's attitude, starting at gyro_bias_rad_s",
    )


class LayeredConfig(Section):
    """A config that knows its files."""

    _layers: Layers | None = PrivateAttr(default=None)

    @property
    def layers(self) -> Layers | None:
        """The files that it was read from."""
        return self._layers

    def problem(self, key: Key, text: str) -> str:
        """A sentence on an entry, with the file and line that count: `FILE:LINE: KEY: text`."""
        named = f"{key_text(key)}: {text}"
        return str(self._layers.problem(key, named)) if self._layers else named

    @contextmanager
    def blamed(self, *key: str | int) -> Iterator[None]:
        """Errors inside that the user can mend become a ConfigError on this entry, with its file and line.

        An error that names another entry of the same table (`network.listen: found …`) is reported on that one.
        """
        try:
            yield
        except ConfigError:
            raise
        except SwarmtrackError as error:
            named, colon, _ = str(error).partition(": ")
            if colon and " " not in named and named.startswith(f"{key[0]}."):
                key, text = tuple(named.split(".")), str(error)
            else:
                text = f"{key_text(key)}: {error}"
            raise ConfigError([str(self._layers.problem(key, text)) if self._layers else text]) from error


class DroneConfig(LayeredConfig):
    """Everything one agent needs at its start."""

    team: TeamSection = TeamSection()
    drone: Vehicle = Field(description="a table [drone] with at least id")
    cameras: tuple[CameraSection, ...] = Field(
        alias="camera",
        description="a table [camera] with source and calibration, or one [[camera]] for each of several",
        json_schema_extra=_one_or_several,
    )
    autopilot: AutopilotSection = AutopilotSection()
    detector: DetectorSection = DetectorSection()
    tracker: TrackerSection = TrackerSection()
    identity: IdentitySection = IdentitySection()
    network: NetworkSection = NetworkSection()
    output: OutputSection = OutputSection()
    recording: RecordingSection = RecordingSection()
    motion: MotionSection = MotionSection()
    formation: TeamFormation = TeamFormation()

    @field_validator("cameras", mode="before")
    @classmethod
    def _one_is_several(cls, said: object) -> object:
        """A table [camera] is the same as one [[camera]]."""
        if isinstance(said, dict | CameraSection):
            return (said,)
        if not isinstance(said, list | tuple):
            raise ValueError(
                f"{found(said)}, expected a table [camera], or one [[camera]] for each of several"
            )
        if not 1 <= len(said) <= MOST_CAMERAS:
            raise ValueError(f"found {len(said)} cameras, expected 1 to {MOST_CAMERAS}")
        return said

    @field_serializer("cameras")
    def _as_written(self, cameras: tuple[CameraSection, ...]) -> Any:
        """One camera as the table that it is in most files."""
        tables = [camera.model_dump(mode="json", by_alias=True) for camera in cameras]
        return tables[0] if len(tables) == 1 else tables

    @property
    def camera(self) -> CameraSection:
        """The first one, where only that makes sense."""
        return self.cameras[0]

    def camera_key(self, number: int, *entries: str) -> tuple[str | int, ...]:
        """Where an entry of a camera stands in the files."""
        return ("camera", *([number] if len(self.cameras) > 1 else []), *entries)

    @property
    def flies_in_formation(self) -> bool:
        """Whether this drone's agent may fly it: it is a follower, and that is enabled."""
        return self.formation.enabled and self.formation.parameters(self.drone.id) is not None

    @property
    def turn_from(self) -> str:
        """`motion.turn_from`, "auto" resolved. Without a link a gyro may still come, from the log of an import."""
        if self.motion.turn_from != "auto":
            return self.motion.turn_from
        return "both" if self.autopilot.link == "none" and not self.camera.detects_by_itself else "gyro"

    @property
    def is_alone(self) -> bool:
        """Whether there is no network, and so no team."""
        return self.network.transport == "memory"

    def starting(self, start: Start) -> DroneConfig:
        """The same, with a start as if its files stated it: a recording of the flight holds it too."""
        drone = self.drone.model_copy(update={"start": start})
        placed = self.model_copy(update={"drone": drone})
        if self._layers:
            stated = {"drone": {"start": start.model_dump(mode="json", by_alias=True, exclude_unset=True)}}
            placed._layers = Layers(self._layers.files, merge(self._layers.table, stated))
        return placed


class TeamConfig(LayeredConfig):
    """What team members other than drones need: the network. The rest of the file is for agents to judge."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    network: NetworkSection = NetworkSection()


class MountedCamera(NamedTuple):
    """A calibrated camera on its drone. time_offset_s: exposure on the IMU's clock = frame stamp + time_offset_s."""

    camera: PinholeCamera
    body_from_camera: Pose
    time_offset_s: float


def load_config(path: str | Path, over: Layer | None = None) -> DroneConfig:
    """Read a drone's config and all it extends. Raises ConfigError with every problem that was found.

    over: what the command line says; it overrides all files.
    """
    layers = read_inputs(path)
    if over is not None:
        layers = Layers([*layers.files, over], merge(layers.table, over.table))
    return config_of(layers)


def read_inputs(path: str | Path) -> Layers:
    """The layers of a config's files, with absolute paths, not yet checked. Raises ConfigError."""
    return read_layers(Path(path), _resolve_inputs)


def config_of(layers: Layers) -> DroneConfig:
    """A drone's config from the layers of its files. Raises ConfigError with every problem that was found."""
    take_own_start(layers)
    problems = _tracker_problems(layers) + parameter_problems(layers, "identity", IdentityParameters)
    problems += _start_problems(layers) + _telling_problems(layers) + _feeding_problems(layers)
    problems += roster_problems(layers)
    problems += switch_problems(layers)

    def among(config: DroneConfig) -> Iterable[Problem]:
        yield from _camera_problems(config, layers)
        yield from formation_problems(
            config.formation, config.drone.id, config.team.airframe_span_m, config.autopilot.link, layers
        )

    return _validated(DroneConfig, layers, problems, among)


def load_team_config(path: str | Path) -> TeamConfig:
    """Read [network] from a team's file, or from a drone's. Raises ConfigError."""
    return _validated(TeamConfig, read_inputs(path), [])


_C = TypeVar("_C", bound=LayeredConfig)


def _validated(
    kind: type[_C],
    layers: Layers,
    problems: list[Problem],
    among: Callable[[_C], Iterable[Problem]] = lambda config: (),
) -> _C:
    """problems: those found already; among: what entries, each right by itself, have against each other."""
    config = validated(kind, layers, problems, among)
    config._layers = layers
    return config


def mount_camera(section: CameraSection) -> MountedCamera:
    """The calibrated camera that [camera] describes. Not for a simulated one (`section.simulated`): ask the simulation.

    Mount and time offset in the config override those in the file. With neither, the camera looks forward from the
    body's origin. Raises CalibrationError.
    """
    imu_from_camera: Pose | None = None
    file_offset_s: float | None = None
    if section.calibration is not None:
        # Here, not above: a drone with its numbers in the config does not pay for YAML.
        from swarmtrack.config.camera_files import load_calibration  # noqa: PLC0415

        file = load_calibration(section.calibration, section.calibration_camera)
        camera, imu_from_camera, file_offset_s = file.camera, file.imu_from_camera, file.time_offset_s
    elif section.intrinsics is not None:
        camera = section.lens_of(section.intrinsics)
    else:
        raise ValueError(
            f"camera.source {section.source}: no calibration, expected the simulation to be asked"
        )
    if section.body_from_camera is not None:
        body_from_camera = section.body_from_camera.pose()
    elif imu_from_camera is not None:
        body_from_camera = Pose(FRD_FROM[section.imu_frame], np.zeros(3)) @ imu_from_camera
    else:
        body_from_camera = Mount().pose()
    offsets = (section.time_offset_s, file_offset_s, 0.0)
    return MountedCamera(camera, body_from_camera, next(s for s in offsets if s is not None))


def _resolve_inputs(table: Table, folder: Path) -> None:
    """Make the relative paths of inputs absolute, from the folder of the file that names them."""
    rules: list[tuple[str, str, Callable[[str], str]]] = [
        ("camera", "calibration", lambda name: str(folder / os.path.expanduser(name))),
        ("camera", "source", lambda source: _beside(source, ("file", "images"), quote(str(folder)))),
        ("autopilot", "link", lambda link: _beside(link, ("tlog", "ulog", "bin", "file"), str(folder))),
        ("autopilot", "signing_key", lambda name: str(folder / os.path.expanduser(name))),
        ("network", "keys", lambda name: str(folder / os.path.expanduser(name))),
        *(
            ("detector", key, lambda name: str(folder / name) if name.endswith(".onnx") else name)
            for key in ("model", "second_stage")
        ),
    ]
    resolve_plan(table, folder)
    for section, key, resolve in rules:
        said = table.get(section)
        for entries in said if isinstance(said, list) else [said]:
            if isinstance(entries, dict) and isinstance(entries.get(key), str):
                entries[key] = resolve(entries[key])


def _beside(address: str, schemes: tuple[str, ...], folder: str) -> str:
    """scheme://relative/path -> scheme://folder/relative/path; other addresses unchanged."""
    scheme, _, rest = address.partition(":")
    target = rest.removeprefix("//")
    if scheme.lower() not in schemes or not target or target.startswith(("/", "~")):
        return address
    return f"{scheme}:{'//' if rest != target else ''}{folder}/{target}"


def _start_problems(layers: Layers) -> list[Problem]:
    """What a start from the autopilot needs elsewhere in the config."""
    tables = {
        name: table if isinstance(table := layers.table.get(name), dict) else {}
        for name in ("drone", "team", "autopilot")
    }
    start = tables["drone"].get("start")
    source = start.get("from") if isinstance(start, dict) else None
    if source not in ("local", "gps"):
        return []
    wants = []
    link = tables["autopilot"].get("link", "none")
    if link == "none" or (link == "sim" and source == "gps"):
        wants.append(f'without a MAVLink autopilot, expected autopilot.link as well, found "{link}"')
    if source == "gps" and "origin" not in tables["team"]:
        wants.append(
            "without an origin of the team frame, expected [team] origin = { lat_deg = …, lon_deg = …, alt_m = … }"
        )
    key = ("drone", "start", "from")
    return [layers.problem(key, f'drone.start.from: "{source}" {want}') for want in wants]


def _camera_problems(config: DroneConfig, layers: Layers) -> Iterator[Problem]:
    """What several cameras have against each other."""
    first = config.camera
    for k, camera in enumerate(config.cameras[1:], start=1):
        key = config.camera_key(k, "source")
        same = [i for i, other in enumerate(config.cameras[:k]) if other.source == camera.source]
        if same:
            other = key_text(config.camera_key(same[0], "source"))
            text = f"{found(camera.source)} is that of {other}, expected another for each camera"
            yield layers.problem(key, f"{key_text(key)}: {text}")
        elif camera.detects_by_itself != first.detects_by_itself:
            wanted = "detections:// as of the first camera" if first.detects_by_itself else "pictures"
            text = f"{found(camera.source)}, expected {wanted}: all cameras detect by themselves, or none"
            yield layers.problem(key, f"{key_text(key)}: {text}")
        elif camera.simulated or first.simulated:
            text = (
                f"{found(camera.source)}, expected no sim:// next to other cameras: it simulates one camera"
            )
            yield layers.problem(key, f"{key_text(key)}: {text}")


def _feeding_problems(layers: Layers) -> list[Problem]:
    """What a feed of the autopilot needs elsewhere in the config."""
    autopilot = layers.table.get("autopilot")
    said = autopilot if isinstance(autopilot, dict) else {}
    link = said.get("link", "none")
    if said.get("feed", "none") == "none" or (isinstance(link, str) and link not in ("none", "sim")):
        return []
    key = ("autopilot", "feed")
    text = f'expected autopilot.link to lead to a MAVLink autopilot as well, found "{link}"'
    return [layers.problem(key, f'autopilot.feed: "{said["feed"]}" without an autopilot, {text}')]


def _telling_problems(layers: Layers) -> list[Problem]:
    """What positions on the Earth need elsewhere in the config."""
    autopilot, team = layers.table.get("autopilot"), layers.table.get("team")
    tell = autopilot.get("tell") if isinstance(autopilot, dict) else None
    if not isinstance(tell, list) or "adsb" not in tell or (isinstance(team, dict) and "origin" in team):
        return []
    text = "expected [team] origin = { lat_deg = …, lon_deg = …, alt_m = … } as well"
    return [
        layers.problem(
            ("autopilot", "tell"), f'autopilot.tell: "adsb" without an origin of the team frame, {text}'
        )
    ]


def _tracker_problems(layers: Layers) -> list[Problem]:
    """[tracker] holds the parameters of the tracker that it names."""
    section = layers.table.get("tracker", {})
    name = section.get("name", DEFAULT_TRACKER) if isinstance(section, dict) else None
    if not isinstance(name, str):
        return []  # pydantic says so
    if name not in TRACKERS:
        text = f"tracker.name: {found(name)}, {one_of(name, list(TRACKERS))}"
        return [layers.problem(("tracker", "name"), text)]
    return parameter_problems(layers, "tracker", TRACKERS[name].Parameters, ignore="name")
