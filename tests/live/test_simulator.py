"""The simulator as the agents meet it: a real process, real sockets, and their own camera and autopilot sources."""

from __future__ import annotations

import asyncio
import json
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np
import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import common

from support.autopilot_flight import RealFlight
from support.patience import PATIENCE, eventually
from support.places import ROOT
from support.streams import first
from swarmtrack.camera_sources.address import parse_address
from swarmtrack.camera_sources.detection_stream import DetectionStream
from swarmtrack.camera_sources.opening import open_camera
from swarmtrack.clock import SystemClock
from swarmtrack.geometry.geodesy import Geodetic, to_ned
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.scenarios.scenario import as_told
from swarmtrack.lab.swarm.truth_feed import follow_truth
from swarmtrack.lab.world.rendering import Renderer
from swarmtrack.lab.world.sensors import Imu, visible
from swarmtrack.messages import Detections, EgoPose, Frame, ImuSample
from swarmtrack.sources import Camera, DetectionSource

# Detections that are exactly the truth, from drones that turn and fly from the start.
EXACT = """
about = "a detector without errors"
seconds = 60.0
[camera]
fps = 15.0
[detector]
p_detection = 1.0
centre_sigma = 0.0
size_sigma = 0.0
clutter_per_frame = 0.0
p_merged = 0.0
[formation]
drones = 3
ring = { radius_m = 2.9, heights_m = [3.0, 3.5] }
sway = { amplitude_m = [0.4, 0.4, 0.3], period_s = [2.0, 3.0] }
"""


class Simulator:
    """A simulator process; `drones` are the addresses it told."""

    def __init__(self, scenario: str | Path, *options: str, epoch: float | None = None) -> None:
        self.scenario = str(scenario)
        self.epoch = time.monotonic() if epoch is None else epoch
        self.process = subprocess.Popen(
            [
                *(sys.executable, "-m", "swarmtrack.agents.simulator", "--scenario", self.scenario),
                *("--epoch", str(self.epoch), *options),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            cwd=ROOT,
            text=True,
        )
        assert self.process.stdout is not None
        first = self.process.stdout.readline()
        assert first, self.process.communicate()[1]
        told = json.loads(first)
        assert told["ready"] is True
        self.truth: str | None = told.get("truth")
        self.drones: dict[int, dict[str, Any]] = {int(n): where for n, where in told["drones"].items()}

    def world_time(self, t: float) -> float:
        return t - self.epoch


@contextmanager
def simulator(scenario: str | Path, *options: str, epoch: float | None = None) -> Iterator[Simulator]:
    simulated = Simulator(scenario, *options, epoch=epoch)
    try:
        yield simulated
    finally:
        simulated.process.kill()
        simulated.process.communicate()


@pytest.fixture
def exact(tmp_path: Path) -> Path:
    path = tmp_path / "exact.toml"
    path.write_text(EXACT)
    return path


@asynccontextmanager
async def opened(address: str) -> Any:
    source: Camera | DetectionSource
    if address.startswith("detections:"):
        source = DetectionStream(parse_address(address), clock=SystemClock())
    else:
        source = open_camera(address, clock=SystemClock())
    yield source
    await source.close()


async def frames(camera: Camera, count: int) -> list[Frame]:
    return await first(count, camera.frames())


async def scans(source: DetectionSource, enough: Callable[[list[Detections]], bool]) -> list[Detections]:
    taken: list[Detections] = []
    async with asyncio.timeout(PATIENCE):
        async for detections in source.detections():
            taken.append(detections)
            if enough(taken):
                break
    return taken


async def test_every_member_has_a_camera_and_an_autopilot_and_a_stranger_has_none() -> None:
    with simulator("intruder", "--detector", "oracle") as simulated:
        scenario = load_scenario("intruder")
        assert scenario.strangers
        assert set(simulated.drones) == set(scenario.members)
        assert len({where["autopilot"] for where in simulated.drones.values()}) == len(scenario.members)


async def test_detections_and_their_stamps_are_those_of_the_true_flight(exact: Path) -> None:
    scenario = load_scenario(exact)
    with simulator(exact, "--detector", "oracle", epoch=time.monotonic() - 20.0) as simulated:
        async with opened(simulated.drones[2]["camera"]) as source:
            taken = await scans(source, lambda taken: len(taken) == 20)
        assert taken[-1].sequence > taken[0].sequence
        seen = 0
        for detections in taken:
            t = simulated.world_time(detections.t)
            truth = visible(scenario.world, 2, scenario.camera, scenario.body_from_camera, t)
            boxes = np.array(sorted(truth[n].tolist() for n in truth)).reshape(-1, 4)
            found = np.column_stack([detections.centre, detections.size])
            np.testing.assert_allclose(found[np.lexsort(found.T[::-1])], boxes, atol=2e-3)
            seen += len(boxes)
        assert seen > 20


async def test_each_camera_of_a_drone_is_served_by_itself_and_its_detections_say_nothing_of_it() -> None:
    scenario = load_scenario("two-cameras")
    with simulator("two-cameras", "--detector", "oracle", epoch=time.monotonic() - 8.0) as simulated:
        addresses = simulated.drones[1]["cameras"]
        assert addresses[0] == simulated.drones[1]["camera"]
        assert addresses[1] == f"{addresses[0]}/1"
        async with opened(addresses[0]) as left, opened(addresses[1]) as right:
            # Until enough was seen: the drone turns, and where it looks by then is the machine's.
            taken = [
                await scans(source, lambda taken: len(taken) >= 12 and sum(map(len, taken)) >= 16)
                for source in (left, right)
            ]
        absent = addresses[1].replace("detections:", "http:").removesuffix("1") + "2"
        async with aiohttp.ClientSession() as session, session.get(absent) as response:
            assert (response.status, await response.text()) == (404, "no such camera, known: 0 to 1\n")
    phases = []
    for camera, found in zip(scenario.cameras, taken, strict=True):
        times = np.array([simulated.world_time(detections.t) for detections in found])
        phases.append(float(np.median(times * camera.fps % 1.0)))
        near = 0
        for t, detections in zip(times.tolist(), found, strict=True):
            assert detections.camera == 0
            truth = visible(scenario.world, 1, camera.lens, camera.body_from_camera, t)
            near += sum(
                np.linalg.norm(detections.centre - box[:2], axis=1).min(initial=np.inf) < 6.0
                for box in truth.values()
            )
        assert near > 12
    assert (phases[1] - phases[0]) % 1.0 == pytest.approx(0.5, abs=0.02)


async def test_an_image_shows_the_world_at_the_time_of_its_stamp(exact: Path) -> None:
    scenario = load_scenario(exact)
    with simulator(exact, epoch=time.monotonic() - 20.0) as simulated:
        async with opened(simulated.drones[1]["camera"]) as camera:
            frame = (await frames(camera, 3))[-1]
    renderer = Renderer(scenario.world, scenario.camera, scenario.body_from_camera)

    def difference(late: float) -> float:
        drawn = renderer.image(1, simulated.world_time(frame.t) + late, 0)
        return float(np.abs(drawn.astype(float) - frame.image).mean())

    assert frame.stamp.value == "exposure"
    assert difference(0.0) < min(difference(-0.1), difference(0.1))


CLOCK_STANDS_S = 3e-3


async def steady_second(pilot: RealFlight) -> tuple[list[ImuSample], list[EgoPose]]:
    """A second's samples and poses in which the clock stood: a busy machine may begin with a backlog, after which the
    clock slides to its place, and says so."""
    samples, poses = pilot.listener.imu, pilot.listener.poses
    begun = (-1.0, 0, 0)

    def has_come() -> bool:
        nonlocal begun
        counters = dict(pilot.unit.status().counters)
        resyncs = counters["clock_resyncs"]
        if resyncs != begun[0] or counters["clock_sigma_s"] > CLOCK_STANDS_S:
            begun = resyncs, len(samples), len(poses)
        return len(samples) - begun[1] >= 200 and len(poses) - begun[2] >= 50

    await eventually(has_come)
    return samples[-200:], poses[-50:]


async def test_the_autopilot_streams_what_was_asked_on_its_own_clock_and_tells_the_true_flight(
    exact: Path,
) -> None:
    scenario = load_scenario(exact)
    with simulator(exact, "--detector", "oracle", epoch=time.monotonic() - 20.0) as simulated:
        async with RealFlight(simulated.drones[1]["autopilot"]) as pilot:
            await eventually(lambda: len(pilot.listener.imu) > 600 and len(pilot.listener.poses) > 100)
            imu, poses = await steady_second(pilot)
            assert pilot.unit.status().ok
            sigma = dict(pilot.unit.status().counters)["clock_sigma_s"]
    # By their stamps: when they are read is the machine's.
    assert np.median(np.diff([sample.t for sample in imu])) == pytest.approx(1 / 200.0, rel=0.1)
    drone = scenario.world.drones[1]
    bias = Imu(scenario.world, 1).gyro_bias
    told = np.array([sample.gyro for sample in imu])

    def errors(late: float) -> np.ndarray:
        true_rate = [drone.body_rate(simulated.world_time(sample.t - late)) for sample in imu]
        return told - np.array(true_rate) - bias

    # The mapped clock is off by a millisecond or two; on a machine that is busy with something else by more, and then
    # it says so.
    most = max(0.005, 4.0 * sigma)
    off = min(np.arange(-most, most, 5e-4), key=lambda late: np.abs(errors(late)).mean())
    error = errors(off)
    assert np.abs(error).max() < 0.05  # its noise
    assert np.abs(error.mean(axis=0)).max() < 0.005
    origin = scenario.world.pose(1, 0.0).position
    for pose in poses:
        truth = scenario.world.pose(1, simulated.world_time(pose.t))
        assert pose.position is not None
        np.testing.assert_allclose(pose.position, truth.position - origin, atol=0.15)
        np.testing.assert_allclose(pose.world_from_body, truth.rotation, atol=0.05)


FAULTS = (
    EXACT
    + """
[[fault]]
kind = "autopilot-reboot"
at_s = 4.0
seconds = 1.5
drones = [1]
[[fault]]
kind = "imu-gap"
at_s = 8.0
seconds = 1.0
[[fault]]
kind = "camera-stall"
at_s = 4.0
seconds = 2.0
drones = [1]
[[fault]]
kind = "clutter"
at_s = 8.0
seconds = 2.0
value = 20.0
"""
)


async def test_faults_come_at_their_times_to_whom_they_concern_and_are_healed(tmp_path: Path) -> None:
    path = tmp_path / "faults.toml"
    path.write_text(FAULTS)
    with simulator(path, "--detector", "oracle", epoch=time.monotonic() + 8.0) as simulated:
        now = time.monotonic
        async with (
            RealFlight(simulated.drones[1]["autopilot"]) as first,
            RealFlight(simulated.drones[2]["autopilot"]) as second,
            opened(simulated.drones[1]["camera"]) as stalled,
            opened(simulated.drones[2]["camera"]) as fine,
        ):
            over = lambda taken: simulated.world_time(taken[-1].t) > 10.5  # noqa: E731
            seen, seen_by_second = await asyncio.gather(scans(stalled, over), scans(fine, over))
            await eventually(lambda: simulated.world_time(now()) > 11.0 and first.unit.status().ok)
            assert (first.listener.reboots, second.listener.reboots) == (1, 0)
            assert second.count["gaps"] >= 1
            imu = np.array([simulated.world_time(sample.t) for sample in second.listener.imu])
            assert not ((imu > 8.1) & (imu < 8.9)).any()
            assert imu.max() > 10.0
    stall, no_stall = (
        np.array([simulated.world_time(detections.t) for detections in taken])
        for taken in (seen, seen_by_second)
    )
    assert not ((stall > 4.0) & (stall < 6.0)).any()
    assert ((no_stall > 4.0) & (no_stall < 6.0)).any()
    counts = [(simulated.world_time(detections.t), len(detections)) for detections in seen]
    assert max(count for t, count in counts if not 8.0 <= t < 10.0) <= 2
    assert max(count for t, count in counts if 8.0 <= t < 10.0) > 5


async def test_a_ground_station_listens_beside_the_agent_and_is_told_the_truth(exact: Path) -> None:
    scenario = load_scenario(exact)
    with simulator(exact, "--detector", "oracle", epoch=time.monotonic() - 20.0) as simulated:
        where = simulated.drones[2]
        async with RealFlight(where["autopilot"]) as agent:
            await eventually(lambda: len(agent.listener.imu) > 100)
            station = mavutil.mavlink_connection(where["ground"], dialect="common")
            station.mav.heartbeat_send(6, 8, 0, 0, 4)
            assert await asyncio.to_thread(station.wait_heartbeat, timeout=PATIENCE)
            interval = common.MAV_CMD_SET_MESSAGE_INTERVAL
            station.mav.command_long_send(
                2, 1, interval, 0, common.MAVLINK_MSG_ID_SIM_STATE, 20_000, 0, 0, 0, 0, 0
            )
            told = await asyncio.to_thread(
                station.recv_match, type="SIM_STATE", blocking=True, timeout=PATIENCE
            )
            t = simulated.world_time(time.monotonic())
            place = Geodetic.from_degrees(1e-7 * told.lat_int, 1e-7 * told.lon_int, told.alt)
            seen = len(agent.listener.imu)
            await eventually(lambda: len(agent.listener.imu) > seen + 200)
            station.close()
    truth = scenario.world.pose(2, t).position
    np.testing.assert_allclose(to_ned(place, scenario.origin), truth, atol=0.5)


def fly_up(address: str, system: int, height: float) -> None:
    """What a ground station does with pymavlink: arm in GUIDED, take off, and wait until the autopilot is up there."""
    station = mavutil.mavlink_connection(address, dialect="common")
    station.mav.heartbeat_send(6, 8, 0, 0, 4)
    assert station.wait_heartbeat(timeout=PATIENCE)

    def order(command: int, *values: float) -> None:
        station.mav.command_long_send(system, 1, command, 0, *values, *[0.0] * (7 - len(values)))
        ack = station.recv_match(type="COMMAND_ACK", blocking=True, timeout=PATIENCE)
        assert (ack.command, ack.result) == (command, common.MAV_RESULT_ACCEPTED)

    order(common.MAV_CMD_SET_MESSAGE_INTERVAL, common.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 100_000)
    order(common.MAV_CMD_DO_SET_MODE, 1, 4)
    order(common.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    order(common.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, height)
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        told = station.recv_match(type="LOCAL_POSITION_NED", blocking=True, timeout=PATIENCE)
        if told.z < -height + 0.3:
            station.close()
            return
    raise AssertionError("it never came up")


async def test_a_ground_station_flies_a_drone_which_the_others_camera_and_the_judge_then_see_up_there() -> (
    None
):
    scenario, followed = as_told(load_scenario("guided"))
    with simulator("guided", "--detector", "oracle") as simulated:
        assert simulated.truth is not None
        following = asyncio.create_task(follow_truth(simulated.truth, followed, print))
        async with opened(simulated.drones[2]["camera"]) as source:
            below = await scans(source, lambda taken: len(taken) == 5)
            await asyncio.to_thread(fly_up, simulated.drones[1]["ground"], 1, 2.0)
            above = await scans(source, lambda taken: len(taken) == 5)
        t = simulated.world_time(time.monotonic())
        await eventually(lambda: all(drone.newest > t for drone in followed.values()))
        following.cancel()
        places = {n: scenario.world.drones[n].position(t) for n in (1, 2)}
    assert places[1][2] == pytest.approx(-2.09, abs=0.4)
    np.testing.assert_allclose(places[2], (7.0, 1.0, -0.09), atol=1e-6)
    # 2 m at 7 m: 120 px further up, which are the smaller numbers.
    rows = [np.median([scan.centre[:, 1].min() for scan in seen if len(scan)]) for seen in (below, above)]
    assert rows[0] - rows[1] == pytest.approx(430.0 * 2.0 / 6.9, rel=0.25)


async def test_garbage_and_strangers_on_the_port_change_nothing_and_a_restarted_agent_is_answered(
    exact: Path,
) -> None:
    with simulator(exact, "--detector", "oracle") as simulated:
        link = simulated.drones[1]["autopilot"]
        host, port = link.removeprefix("udpout:").split(":")
        async with RealFlight(link) as pilot:
            await eventually(lambda: len(pilot.listener.imu) > 20)
            noise = random.Random(11)
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
                for _ in range(500):
                    stranger.sendto(noise.randbytes(noise.randrange(300)), (host, int(port)))
                seen = len(pilot.listener.imu)
                await eventually(lambda: len(pilot.listener.imu) > seen + 100)
                with pytest.raises(BlockingIOError):
                    stranger.recv(1, socket.MSG_DONTWAIT)
        async with RealFlight(link) as restarted:
            await eventually(lambda: len(restarted.listener.imu) > 100)
        assert simulated.process.poll() is None


async def test_a_client_that_leaves_in_mid_frame_harms_nobody_and_a_second_one_sees_the_same(
    exact: Path,
) -> None:
    with simulator(exact) as simulated:
        address = simulated.drones[1]["camera"]
        host, port = address.removeprefix("http://").removesuffix("/1").split(":")
        async with opened(address) as first, opened(address) as second:
            watching = asyncio.create_task(frames(first, 25))
            also = asyncio.create_task(frames(second, 25))
            for _ in range(5):
                _, writer = await asyncio.open_connection(host, int(port))
                writer.write(b"GET /1 HTTP/1.1\r\nHost: simulator\r\n\r\n")
                await writer.drain()
                await asyncio.sleep(0.1)
                writer.transport.abort()
            ours, theirs = await asyncio.gather(watching, also)
        assert {frame.t for frame in ours} & {frame.t for frame in theirs}
        async with opened(f"http://{host}:{port}/77") as nobody:
            watching = asyncio.create_task(frames(nobody, 1))
            await eventually(lambda: "HTTP 404" in nobody.status().text)
            await nobody.close()
            assert await watching == []
        assert simulated.process.poll() is None


async def test_a_client_that_does_not_read_finds_no_backlog_of_old_frames(exact: Path) -> None:
    with simulator(exact) as simulated:
        host, port = simulated.drones[1]["camera"].removeprefix("http://").removesuffix("/1").split(":")
        slow = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 14)
        slow.setblocking(False)
        loop = asyncio.get_running_loop()
        await loop.sock_connect(slow, (host, int(port)))
        await loop.sock_sendall(slow, b"GET /1 HTTP/1.1\r\nHost: simulator\r\n\r\n")
        async with opened(simulated.drones[1]["camera"]) as other:
            await frames(other, 60)  # four seconds, in which the slow client reads nothing
        resumed, old, text = time.monotonic(), 0, b""
        async with asyncio.timeout(PATIENCE):
            while True:
                text += await loop.sock_recv(slow, 1 << 16)
                *heads, text = text.split(b"X-Timestamp: ")
                stamps = [float(head[: head.index(b"\r")]) for head in heads[1:] if b"\r" in head]
                old += sum(t < resumed - 1.0 for t in stamps)
                if any(t > resumed for t in stamps):
                    break
                text = b"X-Timestamp: " + text if heads else text
        assert old < 20  # of sixty
        slow.close()


@pytest.mark.parametrize("how", ["stdin", "SIGTERM", "SIGINT"])
def test_it_ends_in_silence_when_its_parent_dies_or_it_is_told_to(how: str) -> None:
    with simulator("hover-triangle", "--detector", "oracle") as simulated:
        assert simulated.process.stdin is not None
        if how == "stdin":
            simulated.process.stdin.close()
            simulated.process.stdin = None
        else:
            simulated.process.send_signal(getattr(signal, how))
        out, err = simulated.process.communicate(timeout=PATIENCE)
        assert (simulated.process.returncode, out, err) == (0, "", "")


def test_what_it_cannot_fly_or_open_is_said_in_a_sentence() -> None:
    def run(*options: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "swarmtrack.agents.simulator", "--detector", "oracle", *options]
        return subprocess.run(
            command, capture_output=True, text=True, timeout=PATIENCE, cwd=ROOT, check=False
        )

    unknown = run("--scenario", "loop-the-loop")
    assert (unknown.returncode, unknown.stdout) == (2, "")
    assert "loop-the-loop" in unknown.stderr
    elsewhere = run("--host", "203.0.113.7")
    assert (elsewhere.returncode, elsewhere.stdout) == (1, "")
    assert elsewhere.stderr.startswith("--host 203.0.113.7: ")
    assert len(elsewhere.stderr.splitlines()) == 1
    assert "Example:" in run("--help").stdout
