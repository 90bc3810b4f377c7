"""Settings of a flight in a recording: the config, and what only the agent could resolve."""

from __future__ import annotations

import json
import platform
import re
import tomllib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from swarmtrack import __version__
from swarmtrack.camera_sources.address import NETWORK_SCHEMES, parse_address
from swarmtrack.config.drone import DISTORTIONS, DroneConfig, MountedCamera, config_of, mount_camera
from swarmtrack.config.toml.layers import Layer, Layers, Table, merge
from swarmtrack.errors import ConfigError, RecordingError
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.recording.reader import RECORDING_FORMAT, Recording
from swarmtrack.recording.writer import Attachment
from swarmtrack.relative.box_width import BoxWidth
from swarmtrack.tracking import TRACKERS

CONFIG, RESOLVED, CALIBRATION = "config.json", "resolved_config.json", "calibration.json"
WHAT_IF = ("drone", "camera", "autopilot", "tracker", "identity", "motion", "detector", "formation")
"""Tables of the config that have a say in a replay."""


# Of the shipped model, while recordings did not say it: windows around tracks were enlarged less than they are now.
BOXES_OF_OLD = BoxWidth(
    factor=1.14, padding_px=16.2, drone_sigma=0.19, wander_sigma=0.133, wander_s=2.1, white_sigma=0.061
)


@dataclass(frozen=True, slots=True)
class FlightSettings:
    """cameras: in the order of the config. start: team_from_body, None where the autopilot provides it; box_width: the
    detector's model of its box widths.
    """

    config: DroneConfig
    cameras: tuple[MountedCamera, ...]
    start: Pose | None
    box_width: BoxWidth | None = None

    @property
    def mounted(self) -> MountedCamera:
        """The first camera, for uses with a single camera."""
        return self.cameras[0]


def preface(settings: FlightSettings, boot: str, now: float, utc: float) -> dict[str, str]:
    """Metadata of every segment. now [s] of our monotonic clock is utc."""
    config = settings.config
    return {
        "format": RECORDING_FORMAT,
        "kind": "drone",
        "drone_id": str(config.drone.id),
        "team": config.network.team,
        "boot": boot,
        "monotonic_s": repr(now),
        "utc_s": repr(utc),
        "tracker": config.tracker.name,
        **versions(),
    }


def versions() -> dict[str, str]:
    """Versions of all software that influences the last bit of a result."""
    found = {"swarmtrack": __version__, "python": platform.python_version(), "machine": platform.machine()}
    for package in ("numpy", "scipy"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "unknown"
    return found


def attachments(settings: FlightSettings) -> tuple[Attachment, ...]:
    """The config files as written, the config with all defaults (both without logins), and the numbers of the cameras
    and of the start."""
    start = settings.start
    first, *others = map(_camera_record, settings.cameras)
    calibration = {
        **first,
        "start": None if start is None else _pose_record(start),
        "box_width": None if settings.box_width is None else asdict(settings.box_width),
        **({"other_cameras": others} if others else {}),
    }
    resolved = _without_logins(settings.config.model_dump(mode="json", by_alias=True))
    layers = settings.config.layers
    return (
        _json(CONFIG, _without_logins(layers.table) if layers else resolved),
        _json(RESOLVED, resolved),
        _json(CALIBRATION, calibration),
    )


def _without_logins(table: Table) -> Table:
    """The config with its cameras' addresses as people are shown them: recordings are handed on."""
    cameras = table.get("camera", {})
    if not isinstance(cameras, list):
        return {**table, "camera": _shown(cameras, 1)}
    return {**table, "camera": [_shown(camera, number) for number, camera in enumerate(cameras, start=1)]}


def _shown(camera: Table, number: int) -> Table:
    address = parse_address(str(camera["source"]))
    if address.scheme not in NETWORK_SCHEMES:
        return camera
    # Two cameras of one address are refused: what is hidden of the second bears its number.
    return {**camera, "source": str(address).replace("…", f"…{number}" if number > 1 else "…")}


def read_settings(
    recording: Recording, tracker: str | None = None, changes: Sequence[str] = ()
) -> tuple[FlightSettings, list[str]]:
    """Settings of the flight, changed by `key=value` as written in the config; and notes for people.

    Another tracker gets those of the recorded parameters that it has. Raises RecordingError, and ConfigError as the
    config does.
    """
    table: Table = recording.attached(CONFIG)
    calibration = recording.attached(CALIBRATION)
    recorded = Layer(recording.segments[0].path, "", table)
    asked = _layer_of(changes)
    notes = []
    if tracker is not None:
        asked.table.setdefault("tracker", {})["name"] = tracker
    name = asked.table.get("tracker", {}).get("name")
    if name in TRACKERS and name != table.get("tracker", {}).get("name"):
        known = {field.name for field in fields(TRACKERS[name].Parameters)} | {"name"}
        section = table.setdefault("tracker", {})
        for key in sorted(section.keys() - known):
            del section[key]
            notes.append(f"tracker.{key} was recorded for another tracker: {name} has none")
    _by_camera(asked.table, table)
    merged = merge(table, asked.table)
    if isinstance(table.get("camera"), list):
        merged["camera"] = table["camera"]
    config = config_of(Layers([recorded, asked], merged))
    try:
        mounted = [_mounted(record) for record in (calibration, *calibration.get("other_cameras", ()))]
        if len(mounted) != len(config.cameras):
            raise ValueError(f"{len(mounted)} cameras, the config has {len(config.cameras)}")
        start = None if calibration["start"] is None else _pose(calibration["start"])
        box_width = _box_width(calibration, config)
    except (KeyError, TypeError, ValueError) as error:
        raise RecordingError(
            f"{recorded.path}: {CALIBRATION}: {error!r}, expected what an agent writes"
        ) from None
    changes = asked.table.get("camera", {})
    for number, changed in enumerate(changes if isinstance(changes, list) else [changes]):
        section = config.cameras[number]
        if changed and not section.simulated:
            mounted[number] = mount_camera(section)
        elif "time_offset_s" in changed:
            mounted[number] = mounted[number]._replace(time_offset_s=section.time_offset_s or 0.0)
    if "start" in asked.table.get("drone", {}):
        start = None if config.drone.start.source is not None else config.drone.start.pose()
    return FlightSettings(config, tuple(mounted), start, box_width), notes


def _by_camera(asked: Table, recorded: Table) -> None:
    """`camera.2.KEY` of a recording with several cameras, in the order of the config as the config has it; `camera.KEY`
    is said of all. Raises ConfigError."""
    cameras, changes = recorded.get("camera"), asked.get("camera")
    if not isinstance(cameras, list) or not isinstance(changes, dict):
        return
    of_each: list[Table] = [{} for _ in cameras]
    for key, value in changes.items():
        if not key.isdecimal():
            for one in of_each:
                one[key] = value
        elif 1 <= int(key) <= len(cameras) and isinstance(value, dict):
            of_each[int(key) - 1].update(value)
        else:
            raise ConfigError([f"--set camera.{key}: expected camera.N.KEY with N from 1 to {len(cameras)}"])
    recorded["camera"] = [merge(one, change) for one, change in zip(cameras, of_each, strict=True)]
    asked["camera"] = of_each


def _layer_of(changes: Sequence[str]) -> Layer:
    """`tracker.p_detection=0.8` and the like as a file of the config; a word needs no quotes."""
    lines = []
    for change in changes:
        key, equals, value = change.partition("=")
        key, value = key.strip(), value.strip()
        if not equals or not re.fullmatch(r"[A-Za-z0-9_]+(\.[A-Za-z0-9_]+)+", key):
            raise ConfigError([f"--set {change}: expected TABLE.KEY=VALUE, as in tracker.p_detection=0.8"])
        if key.partition(".")[0] not in WHAT_IF:
            raise ConfigError(
                [f"--set {change}: has no effect in a replay, expected a key of {', '.join(WHAT_IF)}"]
            )
        try:
            tomllib.loads(f"{key} = {value}")
        except tomllib.TOMLDecodeError:
            value = json.dumps(value)
        lines.append(f"{key} = {value}")
    text = "\n".join(lines)
    try:
        return Layer(Path("--set"), text, tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError([f"--set: {error}, expected each key once"]) from None


def _camera_record(mounted: MountedCamera) -> dict[str, Any]:
    lens = mounted.camera
    return {
        "intrinsics": {
            **{name: float(getattr(lens, name)) for name in ("fx", "fy", "cx", "cy")},
            **{name: int(getattr(lens, name)) for name in ("width", "height")},
        },
        "distortion": lens.distortion
        and {
            "model": type(lens.distortion).__name__.lower(),
            "coefficients": list(lens.distortion.coefficients),
        },
        "body_from_camera": _pose_record(mounted.body_from_camera),
        "time_offset_s": mounted.time_offset_s,
    }


def _mounted(record: dict[str, Any]) -> MountedCamera:
    lens = record["distortion"]
    distortion = None if lens is None else DISTORTIONS[lens["model"]](tuple(lens["coefficients"]))
    camera = PinholeCamera(**record["intrinsics"], distortion=distortion)
    return MountedCamera(camera, _pose(record["body_from_camera"]), record["time_offset_s"])


def _box_width(record: dict[str, Any], config: DroneConfig) -> BoxWidth | None:
    """As recorded. Older recordings do not hold it: their boxes are those that the shipped model drew then."""
    if "box_width" in record:
        said = record["box_width"]
        return None if said is None else BoxWidth(**said)
    if config.detector.model != "default" or config.camera.detects_by_itself:
        return None
    return BOXES_OF_OLD


def _pose_record(pose: Pose) -> dict[str, Any]:
    return {"rotation": pose.rotation.tolist(), "position_m": pose.position.tolist()}


def _pose(record: dict[str, Any]) -> Pose:
    return Pose(np.array(record["rotation"]), np.array(record["position_m"]))


def _json(name: str, value: Any) -> Attachment:
    return Attachment(name, "application/json", json.dumps(value, indent=1, default=str).encode())
