"""Each of these faults, made in the recording of a healthy flight, is among the first three lines of its review."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("foxglove", reason="foxglove-sdk has no wheel here")

from support.reviewed_flight import (
    BEGINS,
    ENDS,
    TOPIC,
    Change,
    Record,
    both,
    fly_healthy,
    health_of,
    keep,
    link_of,
    rewrite,
    without,
)
from swarmtrack.diagnosis.readiness import SELF_DOUBT
from swarmtrack.messages import DoubtNews, OwnFault
from swarmtrack.outputs.wording import describe
from swarmtrack.review.checks import review
from swarmtrack.review.read import read_flight

HIGHEST_LINES = 3
SIM_END_S = 99.0


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> Path:
    return fly_healthy(tmp_path_factory.mktemp("flown"))


def said_by(name: str, text: str, *, ok: bool = False, **counters: float) -> Change:
    """Drone 2's health says this of one of its links for a while."""

    def alter(record: Record, t: float) -> None:
        link = link_of(record, name)
        link["ok"], link["text"] = ok, text
        link["counters"].update(counters)

    return health_of(2, alter)


def counted(name: str, **counters: float) -> Change:
    def alter(record: Record, t: float) -> None:
        link_of(record, name)["counters"].update(counters)

    return health_of(2, alter, begins=0.0, ends=SIM_END_S)


def dropped(**drops: int) -> Change:
    return health_of(2, lambda record, t: record["drops"].update(drops), ends=SIM_END_S)


def doubts(fault: OwnFault) -> Change:
    sentence = describe(DoubtNews(0.0, True, fault))

    def alter(record: Record, t: float) -> None:
        record["events"].append(sentence)
        record["readiness"] = {"ready": False, "reasons": [f"{SELF_DOUBT}: check drone.start"]}

    return health_of(2, alter, ends=SIM_END_S)


def every(n: int, topic: str, *, observer: int) -> Change:
    """Of drone 2 two of n of the observer's records are lost."""

    def change(drone: int, of: str, t: float, record: Record) -> Record | None:
        lost = (
            drone == 2 and of == topic and record.get("observer") == observer and record["sequence"] % n < 2
        )
        return None if lost else record

    return change


def unheard(observer: int, since_s: float) -> Change:
    """Nobody receives any more of a drone's reports."""

    def change(drone: int, topic: str, t: float, record: Record) -> Record | None:
        return (
            None
            if topic == "/peers/sightings" and record["observer"] == observer and t >= since_s
            else record
        )

    return change


def placeless(drone: int, topic: str, t: float, record: Record) -> Record:
    return {**record, "position_m": None} if (drone, topic) == (2, "/ego") and BEGINS <= t < ENDS else record


def fires_on_everything(drone: int, topic: str, t: float, record: Record) -> Record:
    if (drone, topic) == (2, "/detections"):
        record["score"] = [0.5] * 40
    return record


def rarely(drone: int, topic: str, t: float, record: Record) -> Record | None:
    return None if (drone, topic) == (2, "/detections") and record["sequence"] % 4 else record


def rebooted(drone: int, topic: str, t: float, record: Record) -> Record | None:
    """Drone 2's autopilot is away for three seconds, then its clock begins again."""
    if drone == 2 and topic == "/imu" and 10.0 <= t < 13.0:
        return None
    if drone == 2 and topic == "/autopilot/flight" and 13.0 <= t < 14.0:
        return {"n": record["n"], TOPIC: "/autopilot/rebooted"}
    return record


def clashes(drone: int, topic: str, t: float, record: Record) -> Record:
    if drone == 1 and topic == "/peers/arrived" and record["drone_id"] == 2:
        boots = ["00000002", "000000aa"]
        return {"n": record["n"], "drone_id": 2, "boots": boots, "ours": False, TOPIC: "/peers/clash"}
    return record


def turned(degrees: float) -> Change:
    """The mount in drone 2's config."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    yaw = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def attached(drone: int, name: str, t: float, record: Record) -> Record:
        if (drone, name) == (2, "calibration.json"):
            record["body_from_camera"]["rotation"] = (yaw @ record["body_from_camera"]["rotation"]).tolist()
        return record

    return attached


def zoomed(drone: int, name: str, t: float, record: Record) -> Record:
    if (drone, name) == (2, "calibration.json"):
        record["intrinsics"]["fx"] *= 0.7
        record["intrinsics"]["fy"] *= 0.7
    return record


FAULTS: dict[str, tuple[str, Change]] = {
    "a camera that stops": (
        "camera.silent",
        both(
            without(2, "/detections", "/tracks"),
            said_by("v4l2", "no frame for 3.0 s (cable, power, USB bandwidth?)", fps=0.0),
        ),
    ),
    "a camera that stops without a word": ("camera.gap", without(2, "/detections", "/tracks")),
    "a camera that is unplugged": (
        "camera.missing",
        said_by("v4l2", "/dev/video0 was unplugged; waiting for it", fps=0.0),
    ),
    "late frames": ("camera.stale", counted("v4l2", age_p50_ms=420.0)),
    "damaged frames": ("camera.damaged", counted("v4l2", corrupt=90.0)),
    "a low frame rate": ("camera.rate", rarely),
    "a clock that is set": (
        "clock.step",
        health_of(2, lambda record, t: record.update(t_utc_s=record["t_utc_s"] + 3600.0), ends=SIM_END_S),
    ),
    "a silent gyro": (
        "autopilot.no_imu",
        both(without(2, "/imu"), said_by("autopilot", "serial:/dev/ttyAMA0: heartbeat, no IMU for 2 s")),
    ),
    "a gyro that stops without a word": ("autopilot.gap", without(2, "/imu")),
    "an autopilot's clock that jumps": ("autopilot.unsteady", counted("autopilot", clock_restarts=9.0)),
    "a wrong key": ("autopilot.signature", said_by("autopilot", "serial:…: signs with another key")),
    "samples that are no numbers": ("autopilot.invalid", counted("autopilot", invalid=75.0)),
    "detections that are no numbers": ("detector.unusable", dropped(unusable_detections=12)),
    "GPS loss": ("autopilot.place_lost", placeless),
    "an autopilot's reboot": ("autopilot.rebooted", rebooted),
    "a detector that fires on everything": ("detector.clutter", fires_on_everything),
    "a heading that is off": ("pose.heading", doubts(OwnFault(heading=np.radians(30.0)))),
    "swapped pads": ("pose.pads", doubts(OwnFault(pad_of=3))),
    "a wrong start": ("pose.start", doubts(OwnFault(start=(3.0, 0.0)))),
    "a dead peer": ("team.gone", both(without(3, begins=12.0, ends=SIM_END_S), unheard(3, 12.0))),
    "lost messages": ("team.loss", every(5, "/peers/sightings", observer=1)),
    "a dropped link": ("team.dropped", without(2, "/peers/sightings")),
    "keys of another CA": ("team.deaf", without(2, "/peers/sightings", begins=0.0, ends=SIM_END_S)),
    "two agents of one ID": ("network.id_clash", clashes),
    "a busy machine": (
        "machine.busy",
        health_of(2, lambda record, t: record["latencies"]["loop_lag"].update(p95_s=0.4)),
    ),
    "a full disk": (
        "recording.lost",
        said_by("recording", "cannot be written: No space left on device", lost=812.0),
    ),
}
WRONG_CONFIGS: dict[str, tuple[str, Change]] = {
    "a wrong mount": ("mount.direction", turned(12.0)),
    "a wrong field of view": ("calibration.scale", zoomed),
}


def highest(folder: Path) -> list[str]:
    return [line.first.finding.fault for line in review(read_flight([folder]))[:HIGHEST_LINES]]


def test_a_healthy_flight_has_no_line(flown, tmp_path):
    assert review(read_flight([rewrite(flown, tmp_path / "healthy")])) == []


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_among_the_first_three_lines(flown, tmp_path, name):
    fault, change = FAULTS[name]
    assert fault in highest(rewrite(flown, tmp_path / "flight", change))


@pytest.mark.parametrize("name", WRONG_CONFIGS)
def test_a_wrong_config_is_among_the_first_three_lines(flown, tmp_path, name):
    fault, attached = WRONG_CONFIGS[name]
    assert fault in highest(rewrite(flown, tmp_path / "flight", keep, attached=attached))


def test_a_truncated_file_is_among_the_first_three_lines(flown, tmp_path):
    folder = rewrite(flown, tmp_path / "flight")
    file = folder / "drone-2" / "life" / "0001.mcap"
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])
    assert "recording.cut" in highest(folder)


def test_clocks_apart_are_among_the_first_three_lines(flown, tmp_path):
    flight = read_flight([rewrite(flown, tmp_path / "flight")])
    flight = dataclasses.replace(flight, clock_shifts={1: 0.0, 2: 40.0, 3: 0.1})
    line = review(flight)[0]
    assert (line.first.finding.fault, line.drones) == ("network.clock", (2,))
