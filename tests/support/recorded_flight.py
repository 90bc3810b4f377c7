"""A simulated flight, recorded as agents record it, in a fraction of its time: real configs, doors and recorders.

Only what is between the sensors and the door is left out: processes, sockets and the clocks of this machine.
"""

from __future__ import annotations

import dataclasses
import heapq
from pathlib import Path

import numpy as np

from swarmtrack.clock import ManualClock, SystemClock
from swarmtrack.config.drone import load_config, mount_camera
from swarmtrack.follower import Engagement
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.swarm.configs import Sources, write_configs
from swarmtrack.lab.world.sensors import Ego, EgoParameters, Imu, ImuParameters, detect, visible
from swarmtrack.messages import (
    Announcement,
    AutopilotRebooted,
    FlightState,
    Frame,
    IdClash,
    PeerArrived,
    PeerDeparted,
    ScanReport,
    StampKind,
)
from swarmtrack.recording.settings import FlightSettings
from swarmtrack.relative.box_width import BoxWidth
from swarmtrack.runtime.door import Door
from swarmtrack.runtime.flight_recorder import FlightRecorder
from swarmtrack.runtime.perception import make_follower, make_onboard

LATENCY_S = 0.08
# With RTK, so that pictures can be labelled by it.
EGO = EgoParameters(heading_error_deg=(0.0, 0.0), aligned_error_deg=0.0, height_error_m=(0.0, 0.0))
# Of its boxes, by the detector.
SAID = BoxWidth(drone_sigma=0.1)
BEGIN = {1: 500.0, 2: 81234.5, 3: 7.25}  # s on each drone's own monotonic clock at world time 0
UTC_ERROR = {1: 0.0, 2: 0.4, 3: -1.5}  # s by which each drone's wall clock is wrong


class Flight:
    """One drone on its way: a door, and whoever listens at it."""

    def __init__(self, folder: Path, drone_id: int, scenario, extra: str) -> None:
        config_file = folder / f"drone-{drone_id}.toml"
        # This autopilot's heading is no worse than its tilt.
        heading = f"[autopilot]\nheading_sigma_deg = {np.degrees(EGO.attitude_sigma):.3f}\n"
        config_file.write_text(config_file.read_text().replace("[autopilot]\n", heading) + extra)
        self.config = load_config(config_file)
        mounted = mount_camera(self.config.camera)
        self.drone_id, self.begin = drone_id, BEGIN[drone_id]
        self.clock = ManualClock(self.begin - 1.0, 1.8e9 - 1.0 + UTC_ERROR[drone_id])
        self.door = Door(make_onboard(self.config, [mounted], None, SAID), make_follower(self.config))
        self.boot = f"{drone_id:08x}"
        settings = FlightSettings(self.config, (mounted,), None, SAID)
        self.recorder = FlightRecorder(settings, self.boot, self.clock, SystemClock(), waits=True)
        self.recorder.open()
        self.door.listener = self.recorder
        self.imu = Imu(scenario.world, drone_id, ImuParameters(rate_hz=scenario.imu_rate_hz))
        self.ego = Ego(scenario.world, drone_id, EGO)
        self.scans = []
        self.answers = []
        self.setpoints = []
        self.reports = 0

    def collect(self) -> None:
        self.scans += [event for event in self.door.events() if isinstance(event, ScanReport)]

    def tell(self, event) -> None:
        self.door.tell(event)
        self.collect()

    def ask(self, t: float) -> None:
        self.answers.append(self.door.tracks(t))
        self.collect()


def fly(
    folder: Path, seconds: float, *, drones=(1, 2, 3), extra: str = "", faults: bool = True
) -> list[Flight]:
    """Record into folder/rec/drone-N. extra: of each config; faults: an autopilot reboots, a stranger's ID clashes."""
    scenario = load_scenario("hover-triangle")
    # A link that is never opened: the config wants one for a start by the autopilot.
    sources = {d: Sources(f"detections://127.0.0.1:9/{d}", "udpin:127.0.0.1:9") for d in scenario.members}
    write_configs(
        folder, scenario, team="t", tracker="mbm", sources=sources, simulator="…", recordings=folder / "rec"
    )
    flights = {d: Flight(folder, d, scenario, extra) for d in drones}
    rates = {
        "imu": scenario.imu_rate_hz,
        "pose": EGO.rate_hz,
        "scan": scenario.fps,
        "ask": scenario.tracks_hz,
    }
    queue = []
    for d in drones:
        if flights[d].config.flies_in_formation:
            queue.append((1.05, d, "command", 11, 10.0))
        for what, rate in rates.items():
            heapq.heappush(queue, (0.0, d, what, 0, rate))
        for other in drones:
            if other != d:
                queue += [(0.3, d, "arrived", other, 0.0), (0.4, d, "announced", other, 0.0)]
        queue += [(1.0 + k + 0.1 * d, d, "said", k, 0.0) for k in range(int(seconds))]
        if faults:
            queue += [(1.2, d, "rebooted", 0, 0.0), (1.3, d, "clash", 0, 0.0), (1.5, d, "departed", 0, 0.0)]
    heapq.heapify(queue)
    while queue:
        t, d, what, index, rate = heapq.heappop(queue)
        if t >= seconds:
            break
        flight = flights[d]
        flight.clock.set(flight.begin + t)
        if what == "pose" and index % int(EGO.rate_hz) == 0:
            flight.tell(FlightState(flight.begin + t, -np.inf))
        _happen(flights, flight, scenario, what, index, t)
        if rate:
            late = LATENCY_S if what == "scan" else 0.0
            heapq.heappush(queue, ((index + 1) / rate + late, d, what, index + 1, rate))
    for flight in flights.values():
        flight.recorder.close()
    return list(flights.values())


def _happen(flights, flight, scenario, what, index, t) -> None:
    world, d, begin = scenario.world, flight.drone_id, flight.begin
    match what:
        case "imu":
            sample = flight.imu.sample(index)
            flight.tell(dataclasses.replace(sample, t=begin + sample.t))
        case "pose":
            pose = flight.ego.pose(index)
            sure = {"position_sigma": EGO.position_sigma, "attitude_sigma": EGO.attitude_sigma}
            flight.tell(dataclasses.replace(pose, t=begin + pose.t, **sure))
        case "command":
            # Engaged anew on the way, and once with a clock that is not known.
            engagement = Engagement(1 if t < 3.0 else 2, clock_known=not 2.0 < t < 2.2)
            flight.setpoints.append(flight.door.command(begin + t, engagement))
            flight.collect()
        case "scan":
            exposed = index / scenario.fps
            boxes = visible(world, d, scenario.camera, scenario.body_from_camera, exposed)
            rng = world.chance("detector", d, index)
            seen = detect(boxes, scenario.camera, scenario.detector, rng, t=exposed, sequence=index)
            picture = np.full((scenario.camera.height, scenario.camera.width, 3), 90, np.uint8)
            flight.recorder.frame(Frame(begin + exposed, 0.0, index, picture, StampKind.MEDIA))
            flight.tell(dataclasses.replace(seen, t=begin + exposed))
        case "ask":
            flight.ask(begin + t)
        case "arrived":
            flight.tell(PeerArrived(index, f"{index:08x}"))
        case "announced":
            flight.tell(_announcement(scenario, index, begin + t))
        case "said":
            report = flight.door.perceived.sighting_report(flight.boot, index + 1)
            if report is None:
                return
            flight.recorder.record_sighting(report)
            for other in flights.values():
                if other is not flight:  # 20 ms of radio that nobody knows of
                    heard_t = other.begin + (report.t - begin) + 0.02
                    other.tell(dataclasses.replace(report, t=heard_t, t_sigma=0.01))
        case "rebooted":
            flight.tell(AutopilotRebooted())
        case "clash":
            flight.tell(IdClash(99, ("000000aa", "000000bb"), ours=False))
        case "departed":
            flight.tell(PeerDeparted(99, "000000aa"))


def _announcement(scenario, drone_id: int, t: float) -> Announcement:
    pose = scenario.initial_poses[drone_id]
    return Announcement(
        drone_id, f"{drone_id:08x}", 1, t, 0.05, pose.position, pose.rotation, 0.01 * np.eye(3)
    )
