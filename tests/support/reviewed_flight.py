"""Recordings of a short flight of three drones, with one thing made wrong in them as the public symptoms have it.

The flight is that of `recorded_flight`: real configs, perception and recorders. Only the health messages, which an
agent's process would write, are added here once a second, as a healthy agent writes them.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
from mcap.writer import Writer

from support.recorded_flight import fly
from swarmtrack.recording.reader import Recording, recordings_below
from swarmtrack.recording.writer import PREFACE

SECONDS = 20.0
BEGINS, ENDS = 8.0, 16.0  # s: of what is wrong for a while
Record = dict[str, Any]
Change = Callable[[int, str, float, Record], Record | None]
"""Of drone, topic, time [s] and record: the record as it is written, or None; TOPIC in it: under that topic."""
TOPIC = "as topic"

AUTOPILOT = {
    "imu_rate_asked_hz": 200.0, "imu_rate_hz": 200.0, "imu_samples": 4000.0, "imu_lost": 0.0, "invalid": 0.0,
    "clock_sigma_s": 0.001, "clock_skew_ppm": 120.0, "clock_drift_ppm": 0.0, "clock_restarts": 0.0,
    "foreign_datagrams": 0.0, "autopilot_kind": 3.0,
}  # fmt: skip
CAMERA = {"fps": 15.0, "used_fps": 15.0, "corrupt": 0.0, "age_p50_ms": 45.0, "t_sigma_ms": 1.0}


def fly_healthy(folder: Path) -> Path:
    """Record into the folder that is returned; nothing is wrong with it but that it has no health messages."""
    fly(folder, SECONDS, faults=False)
    return folder / "rec"


def keep(drone: int, topic: str, t: float, record: Record) -> Record:
    return record


def rewrite(flown: Path, folder: Path, change: Change = keep, *, attached: Change = keep) -> Path:
    """The flight with health messages, as `change` has its records, and `attached` what is attached by name."""
    for recording in recordings_below(flown):
        target = folder / f"drone-{recording.drone_id}" / "life" / "0001.mcap"
        target.parent.mkdir(parents=True)
        with target.open("wb") as file:
            _write(recording, Writer(file), change, attached)
    return folder


def _write(recording: Recording, writer: Writer, change: Change, attached: Change) -> None:
    drone, begin = recording.drone_id, float(recording.preface["utc_s"])
    writer.start(profile="swarmtrack")
    writer.add_metadata(PREFACE, recording.preface)
    for name, attachment in recording.attachments.items():
        record = attached(drone, name, 0.0, msgspec.json.decode(attachment.data))
        writer.add_attachment(0, 0, name, attachment.media_type, msgspec.json.encode(record))
    channels: dict[str, int] = {}

    def put(topic: str, ns: int, data: bytes) -> None:
        if topic not in channels:
            channels[topic] = writer.register_channel(topic, "json", 0)
        writer.add_message(channels[topic], ns, data, ns)

    told = 0
    for message in recording.messages():
        t = message.log_time_ns * 1e-9 - begin
        while told < t:
            said = change(drone, "/health", float(told), healthy(begin + told, told))
            if said is not None:
                put("/health", round((begin + told) * 1e9), msgspec.json.encode(said))
            told += 1
        if message.channel.message_encoding != "json":
            continue
        record = change(drone, message.topic, t, msgspec.json.decode(message.data))
        if record is not None:
            put(record.pop(TOPIC, message.topic), message.log_time_ns, msgspec.json.encode(record))
    writer.finish()


def healthy(utc_s: float, uptime_s: float) -> Record:
    """A health message of an agent with which all is well."""
    links = [
        {"name": "autopilot", "ok": True, "text": "serial:/dev/ttyAMA0: streaming", "counters": dict(AUTOPILOT)},
        {
            "name": "v4l2:///dev/video0", "ok": True, "text": "streaming; 15.0 fps",
            "counters": {**CAMERA, "frames": 15.0 * uptime_s},
        },
        {"name": "zenoh", "ok": True, "text": "team t: 2 peers", "counters": {"peers": 2.0}},
        {"name": "recording", "ok": True, "text": "into rec", "counters": {"lost": 0.0}},
    ]  # fmt: skip
    return {
        "version": 1, "t_utc_s": utc_s, "boot": "00000001", "uptime_s": uptime_s, "cpu_percent": 12.0, "rss_mb": 120.0,
        "rates": {"imu": {"asked_hz": 200.0, "got_hz": 200.0}},
        "latencies": {"loop_lag": {"p50_s": 0.001, "p95_s": 0.004, "max_s": 0.01}},
        "clock_offset_s": 0.0, "clock_offset_sigma_s": 0.001, "links": links, "drops": {}, "events": [],
        "time_offset": {"found_s": 0.002, "sigma_s": 0.001, "used_s": 0.0}, "gyro_bias": None, "consistency": None,
        "readiness": {"ready": True, "reasons": []}, "noise": None,
    }  # fmt: skip


def link_of(said: Record, name: str) -> Record:
    """One of the links of a health message, to be changed: by the beginning of its name."""
    return next(link for link in said["links"] if link["name"].startswith(name))


def health_of(
    drone: int, alter: Callable[[Record, float], None], *, begins: float = BEGINS, ends: float = ENDS
) -> Change:
    """Alters one drone's health messages for a while."""

    def change(of: int, topic: str, t: float, record: Record) -> Record:
        if of == drone and topic == "/health" and begins <= t < ends:
            record = copy.deepcopy(record)
            alter(record, t)
        return record

    return change


def without(drone: int, *topics: str, begins: float = BEGINS, ends: float = ENDS) -> Change:
    """Leaves out one drone's records of these topics for a while; none named: of all."""

    def change(of: int, topic: str, t: float, record: Record) -> Record | None:
        return None if of == drone and begins <= t < ends and (not topics or topic in topics) else record

    return change


def both(*changes: Change) -> Change:
    def change(drone: int, topic: str, t: float, record: Record) -> Record | None:
        for one in changes:
            changed = one(drone, topic, t, record)
            if changed is None:
                return None
            record = changed
        return record

    return change
