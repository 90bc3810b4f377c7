"""An explained config with every key: required ones set, all others as comments with their defaults."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from typing import Any

from swarmtrack.setup.reference import about, parameters_schema, referred, tables, whole_schema
from swarmtrack.setup.texts import as_toml
from swarmtrack.tracking import AGENT_PARAMETERS, DEFAULT_TRACKER, TRACKERS

NAME = "example.toml"
EXAMPLE_COLUMNS = 110
EXAMPLE_HEAD = f"""\
# Every key of a drone's config. What must be there is written; the rest is a comment with its default, or with an
# example where there is no default. Take away the # to change a key. A page such as docs/wire.md is one of swarmtrack's
# documentation. Check this file with: swarmtrack config check {NAME}

# What several drones share may stand in a file of its own; this file overrides what it extends.
#extends = "team.toml"
"""
WRITTEN = {
    "drone.id": "1",
    "drone.start": "{ position_m = [0.0, 0.0, 0.0], yaw_deg = 0.0, position_sigma_m = 0.1 }",
    "camera.source": '"v4l2:///dev/video0?width=640&height=480&fps=30"',
    "camera.intrinsics": "{ fx = 457.0, fy = 457.0, cx = 319.5, cy = 239.5, width = 640, height = 480 }",
}
"""Keys that are no comments."""
SHOWN_VALUES = {
    "team.origin": "{ lat_deg = 47.397742, lon_deg = 8.545594, alt_m = 488.0 }",
    "team.airframe_span_m": "0.5",
    "team.drones": "{ 1 = { position_m = [0.0, 0.0, 0.0], yaw_deg = 0.0, position_sigma_m = 0.3 } }",
    "team.code": '{ begins = ["2026-05-01T10:00:00Z"] }',
    "team.plan": '{ file = "plan.csv", begins = "2026-05-01T10:00:00Z" }',
    "camera.calibration": '"camera.yaml"             # instead of intrinsics and distortion',
    "camera.calibration_camera": '"cam1"',
    "camera.distortion": '{ model = "radtan", coefficients = [-0.28, 0.07, 0.0, 0.0] }',
    "camera.body_from_camera": "{ rpy_deg = [0.0, 0.0, 0.0], position_m = [0.1, 0.0, 0.0] }",
    "camera.time_offset_s": "0.0",
    "autopilot.heading_sigma_deg": "{ ground = 3.0, flight = 1.5 }",
    "autopilot.link": '"serial:/dev/ttyAMA0:921600"',
    "autopilot.system_id": "1",
    "autopilot.signing_key": '"mavlink.key"',
    "detector.box_width": "{ factor = 1.28, padding_px = 8.3 }",
    "detector.score_threshold": "0.3",
    "detector.input_scale": "0.5",
    "detector.engine_cache": '"engines"',
    "detector.channel_order": '"RGB"',
    "detector.scale": "[0.00392, 0.00392, 0.00392]",
    "detector.mean": "[0.0, 0.0, 0.0]",
    "network.keys": '"keys/drone-{id}"',
    "network.peers": '{ 1 = "10.0.0.11", 2 = "10.0.0.12" }',
    "network.tracks_kbit_s": "200.0",
    "output.jsonl": '"tracks.jsonl"',
    "output.video": '"annotated.mp4"',
    "output.health": '"health.json"',
    "output.ros2": '{ domain = 0, distro = "jazzy" }',
    "recording.dir": '"recordings"',
    "motion.gyro_delay_s": "0.0",
    "formation.leader": "1",
    "formation.slots": "{ 2 = [-4.0, 3.0, -1.0], 3 = [-4.0, -3.0, 1.0] }",
    "formation.references": "{ 2 = [1], 3 = [1] }",
    "formation.switch": "{ channel = 7, above_us = 1700.0 }",
}
"""Values of keys without a default, or whose default shows little."""


def example() -> str:
    """Text of the file."""
    schema = whole_schema()
    parts = [EXAMPLE_HEAD]
    for section, kind in tables():
        said = re.sub(r"\[([^]]+)\]\(([^)]+)\)", r"docs/\2", about(kind))
        properties = schema["$defs"][referred(schema["properties"][section])]["properties"]
        keys = _tracker_keys(properties) if section == "tracker" else properties
        parts.append(f"\n# {said}\n[{section}]\n" + "".join(_lines(section, keys)))
    return "".join(parts)


def _tracker_keys(properties: dict[str, Any]) -> dict[str, Any]:
    """Those of the default tracker, with its defaults."""
    return {
        "name": properties["name"],
        **parameters_schema(TRACKERS[DEFAULT_TRACKER].Parameters, AGENT_PARAMETERS),
    }


def _lines(section: str, properties: dict[str, Any]) -> Iterator[str]:
    for key, entry in properties.items():
        name = f"{section}.{key}"
        for line in textwrap.wrap(entry.get("description", ""), EXAMPLE_COLUMNS - 2):
            yield f"# {line}\n"
        if name in WRITTEN:
            yield f"{key} = {WRITTEN[name]}\n"
        else:
            yield f"#{key} = {SHOWN_VALUES.get(name) or as_toml(entry['default'])}\n"
