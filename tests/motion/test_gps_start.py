"""`start = { from = "gps" }`: drones whose autopilots count from different places agree on where they are."""

from __future__ import annotations

import asyncio
import math
import time

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from support.autopilot_flight import Flight
from support.fake_autopilot import FakeAutopilot, serve_udp
from support.patience import PATIENCE
from support.ports import free_port
from swarmtrack.autopilot.global_position import GlobalPosition
from swarmtrack.clock import SystemClock
from swarmtrack.config.drone import load_config
from swarmtrack.errors import ConfigError
from swarmtrack.geometry.geodesy import Geodetic, from_ned
from swarmtrack.lab.autopilots.autopilot import SimulatedArduPilot
from swarmtrack.lab.autopilots.senses import DroneSenses, GpsFix
from swarmtrack.lab.world.trajectory import Lissajous, SteadyYaw, Trajectory
from swarmtrack.lab.world.world import World
from swarmtrack.messages import Announcement, EgoPose
from swarmtrack.motion.ego import EgoHistory
from swarmtrack.outputs.console import Console
from swarmtrack.runtime.agent import Agent
from swarmtrack.runtime.assembly import assemble
from swarmtrack.transport.memory import MemoryHub, MemoryTransport

ORIGIN = Geodetic.from_degrees(47.3977, 8.5456, 488.0)
GLOBAL = {common.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, common.MAVLINK_MSG_ID_GPS_RAW_INT}
LOCAL = {common.MAVLINK_MSG_ID_LOCAL_POSITION_NED}


def at(*ned: float, sigma: float = 0.9) -> GpsFix:
    """A receiver at that place of the team frame."""
    return GpsFix(from_ned(np.array(ned), ORIGIN), sigma)


def positions(flight: Flight) -> list[EgoPose]:
    return [pose for pose in flight.listener.poses if pose.position is not None]


async def test_the_position_is_the_global_one_from_the_teams_origin_and_knows_its_sigma():
    autopilot = FakeAutopilot()
    autopilot.gps, autopilot.position = at(30.0, -40.0, -12.0), np.zeros(3)
    async with Flight(autopilot, gps=GlobalPosition(ORIGIN)) as flight:
        flight.fly(3.0)
        pose = positions(flight)[-1]
        np.testing.assert_allclose(pose.position, (30.0, -40.0, -12.0), atol=0.02)  # a grid of 11 mm
        assert pose.position_sigma == pytest.approx(0.9)
        assert flight.unit.status().ok


async def test_what_the_user_states_goes_before_what_the_receiver_says():
    autopilot = FakeAutopilot()
    autopilot.gps = at(0.0, 0.0, 0.0)
    async with Flight(autopilot, gps=GlobalPosition(ORIGIN, 0.05)) as flight:
        flight.fly(3.0)
        assert positions(flight)[-1].position_sigma == 0.05


@pytest.mark.parametrize(
    ("h_acc", "v_acc", "sigmas"),
    [(900, 1780, (0.9, 1.78)), (900, 0, (0.9, 0.9)), (0, 1780, (1.78, 1.78)), (0, 0, (1.5, 1.5))],
)
def test_north_and_east_are_as_sure_as_the_receiver_says_and_the_height_too(h_acc, v_acc, sigmas):
    fix = common.MAVLink_gps_raw_int_message(0, 3, 0, 0, 0, 0, 0, 0, 0, 9, h_acc=h_acc, v_acc=v_acc)
    gps = GlobalPosition(ORIGIN)
    gps.on_fix(1.0, fix)
    assert (gps.sigma, gps.vertical_sigma) == pytest.approx(sigmas)
    stated = GlobalPosition(ORIGIN, 0.05)
    stated.on_fix(1.0, fix)
    assert (stated.sigma, stated.vertical_sigma) == (0.05, 0.05)


@pytest.mark.parametrize(
    ("gps", "wanted", "unwanted"), [(None, LOCAL, GLOBAL), (GlobalPosition(ORIGIN), GLOBAL, LOCAL)]
)
async def test_only_the_positions_that_are_needed_are_asked_for(gps, wanted, unwanted):
    autopilot = FakeAutopilot()
    async with Flight(autopilot, gps=gps) as flight:
        flight.fly(3.0)
    asked = {message for message, _ in autopilot.commands}
    assert wanted <= asked
    assert not unwanted & asked


@pytest.mark.parametrize(
    ("fix", "lack"),
    [
        (None, "GPS fix 1 with 0 satellites, expected a 3D fix"),
        (at(0.0, 0.0, 0.0, sigma=30.0), "GPS ±30.0 m, expected ±5 m or better"),
        (at(3e5, 0.0, 0.0), "km from the team's origin, expected at most 100 km"),
    ],
)
async def test_a_position_that_is_not_to_be_trusted_is_none_and_the_reason_is_named(fix, lack, caplog):
    autopilot = FakeAutopilot()
    autopilot.gps = fix
    async with Flight(autopilot, gps=GlobalPosition(ORIGIN)) as flight:
        flight.fly(4.0)
        assert flight.listener.poses
        assert not positions(flight)
        assert "but no position: " in flight.text
        assert lack in flight.text
        assert not flight.unit.status().ok
        assert lack in caplog.text
        autopilot.gps = at(1.0, 2.0, 3.0)
        flight.fly(1.0)
        assert positions(flight)
        assert flight.unit.status().ok


@pytest.mark.parametrize("silent", ["GPS_RAW_INT", "GLOBAL_POSITION_INT"])
async def test_what_falls_silent_is_not_believed_for_long_and_is_named(silent):
    autopilot = FakeAutopilot()
    autopilot.gps = at(1.0, 2.0, 3.0)
    async with Flight(autopilot, gps=GlobalPosition(ORIGIN)) as flight:
        flight.fly(2.0)
        autopilot.set_interval(getattr(common, f"MAVLINK_MSG_ID_{silent}"), -1, flight.clock.now())
        autopilot.offered = ()
        flight.fly(5.0)
        assert f"no {silent} comes" in flight.text
        assert positions(flight)[-1].t < flight.clock.now() - 1.0


def test_after_a_reboot_in_the_air_a_global_position_is_still_itself_and_a_local_one_goes_on():
    def pose(t: float, *position: float) -> EgoPose:
        return EgoPose(t, np.array(position), np.eye(3), position_sigma=0.9)

    by_gps, local = EgoHistory(absolute=True), EgoHistory()
    for history in (by_gps, local):
        history.append(pose(0.0, 10.0, 0.0, -5.0))
        history.restart()
        history.append(pose(1.0, 13.0, 0.0, -5.0))
    np.testing.assert_allclose(by_gps.at(1.0).position, (13.0, 0.0, -5.0))
    np.testing.assert_allclose(local.at(1.0).position, (10.0, 0.0, -5.0))
    assert by_gps.at(1.0).position_sigma == pytest.approx(0.9)


def test_a_position_that_is_lost_in_flight_grows_uncertain():
    history = EgoHistory(absolute=True, history_s=20.0)
    history.append(EgoPose(0.0, np.array((10.0, 0.0, -5.0)), np.eye(3), position_sigma=0.9))
    history.append(EgoPose(10.0, None, np.eye(3)))
    assert history.at(10.0).position_sigma > 5.0


# ── two drones of a world ────────────────────────────────────────────────────────────────────────────────────────────


def two_in_the_air() -> World:
    """Each on a circle of its own, 25 m apart; each autopilot's local frame begins where its drone is at t = 0."""
    circle = {"amplitude": (5.0, 5.0, 0.0), "frequency": (0.05, 0.05, 0.0), "phase": (math.pi / 2, 0.0, 0.0)}
    return World(
        7,
        {
            1: Trajectory(Lissajous((0.0, 0.0, -10.0), **circle), SteadyYaw(0.5)),
            2: Trajectory(Lissajous((3.0, 25.0, -12.0), **circle), SteadyYaw(-2.0, 0.1)),
        },
    )


async def own_poses(world: World, drone_id: int, gps: GlobalPosition | None, **errors: float) -> EgoHistory:
    """What an agent makes of its autopilot within 8 s of flight; world time 0 is at 100 s."""
    senses = DroneSenses(world, drone_id, epoch=100.0, earth=ORIGIN, **errors)
    ego = EgoHistory(absolute=gps is not None, history_s=20.0)
    async with Flight(SimulatedArduPilot(senses, boot_at=80.0 + drone_id), gps=gps) as flight:
        flight.fly(8.0)
    for pose in flight.listener.poses:
        ego.append(pose)
    return ego


async def test_drones_with_local_frames_of_their_own_agree_in_the_team_frame():
    world = two_in_the_air()
    for drone_id in world.drones:
        truth = world.pose(drone_id, 6.0)
        by_gps = (await own_poses(world, drone_id, GlobalPosition(ORIGIN), gps_sigma=0.0)).at(106.0)
        np.testing.assert_allclose(by_gps.position, truth.position, atol=0.15)
        assert np.trace(by_gps.world_from_body.T @ truth.rotation) > 1.0 + 2.0 * math.cos(0.05)
        # The same drone's local frame begins elsewhere: without a start it would be 10 m and more off.
        local = (await own_poses(world, drone_id, None)).at(106.0)
        assert np.linalg.norm(local.position - truth.position) > 10.0


async def test_the_error_of_the_receiver_is_within_the_sigma_that_is_told():
    world = two_in_the_air()
    for drone_id in world.drones:
        found = (await own_poses(world, drone_id, GlobalPosition(ORIGIN), gps_sigma=1.2)).at(106.0)
        error = found.position - world.pose(drone_id, 6.0).position
        assert found.position_sigma == pytest.approx(1.2, rel=0.05)
        assert 0.05 < np.linalg.norm(error) < 4.0 * 1.2


CONFIG = """
[team]
origin = {{ lat_deg = 47.3977, lon_deg = 8.5456, alt_m = 488.0 }}
[drone]
id = {id}
start = {{ from = "gps" }}
[camera]
source = "detections://127.0.0.1:9/"
intrinsics = {{ fx = 430.0, fy = 430.0, cx = 319.5, cy = 239.5, width = 640, height = 480 }}
[autopilot]
link = "udpin:127.0.0.1:{port}"
[network]
transport = "memory"
"""


async def test_agents_announce_where_gps_says_they_are_and_how_well_it_knows(tmp_path):
    hub, clock, heard = MemoryHub(), SystemClock(), {}
    listener = MemoryTransport(hub, "swarm", 9, "00000009", clock)
    await listener.open()
    places = {1: (0.0, 0.0, -2.0), 2: (12.0, -9.0, -3.0)}

    async def fly(drone_id: int) -> None:
        port = free_port()
        path = tmp_path / f"drone-{drone_id}.toml"
        path.write_text(CONFIG.format(id=drone_id, port=port), encoding="utf-8")
        parts = assemble(load_config(path), SystemClock())
        parts.transport = MemoryTransport(hub, "swarm", drone_id, parts.boot, clock)
        autopilot = FakeAutopilot(boot_at=time.monotonic() - 40.0)
        autopilot.gps = at(*places[drone_id], sigma=0.7)
        async with serve_udp(autopilot, "127.0.0.1", port):
            await Agent(parts, console=Console(parts.lens, quiet=True)).run()

    flights = [asyncio.create_task(fly(drone_id)) for drone_id in places]
    async with asyncio.timeout(PATIENCE):
        async for event in listener.events():
            if isinstance(event, Announcement):
                heard[event.drone_id] = event
                if heard.keys() == places.keys():
                    break
    for flight in flights:
        flight.cancel()
    await asyncio.gather(*flights, return_exceptions=True)
    await listener.close()
    for drone_id, place in places.items():
        np.testing.assert_allclose(heard[drone_id].position, place, atol=0.05)
        sigma = np.sqrt(np.diag(heard[drone_id].position_cov))
        # What the receiver says, and more where the machine is busy and the clocks are known less well.
        assert (sigma > 0.8 * 0.7).all()
        assert (sigma < 3 * 0.7).all()


# ── config, and a start that is none ─────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("lat_deg = 47.3977", "lat_deg = 91", "team.origin.lat_deg: 91, expected less than or equal to 90"),
        ("alt_m = 488.0", "alt_m = 488000.0", "team.origin.alt_m: 488000.0, expected less than or equal to"),
        ("lon_deg = 8.5456,", "", "team.origin.lon_deg: missing, expected longitude"),
        ("origin =", "orgin =", 'team.orgin: unknown key, did you mean "origin"?'),
        ('link = "udpin', 'signing_key = "udpin', 'drone.start.from: "gps" without a MAVLink autopilot'),
        ('"gps"', '"gps", offset_m = [1, 2, 3]', 'offset_m together with from = "gps"'),
    ],
)
def test_what_a_start_by_gps_needs_is_named_where_it_is_missing(tmp_path, old, new, problem):
    path = tmp_path / "drone.toml"
    path.write_text(CONFIG.format(id=1, port=14540).replace(old, new), encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert any(problem in line for line in caught.value.problems), caught.value.problems


@pytest.mark.parametrize(
    ("armed", "status", "flying"),
    [
        (True, common.MAV_STATE_ACTIVE, 1),
        (True, common.MAV_STATE_CRITICAL, 1),
        (True, common.MAV_STATE_STANDBY, 0),  # ArduPilot, armed on its pad
        (False, common.MAV_STATE_ACTIVE, 0),
    ],
)
async def test_a_drone_that_is_found_flying_is_told_of_once(armed, status, flying):
    autopilot = FakeAutopilot()
    autopilot.pilot.armed, autopilot.pilot.status = armed, status
    async with Flight(autopilot) as flight:
        flight.fly(3.5)
    assert flight.listener.found_flying == flying


@pytest.mark.parametrize(("start", "warned"), [("position_m = [1, 2, 0]", True), ('from = "local"', False)])
async def test_an_agent_that_wakes_up_in_the_air_says_that_its_fixed_start_is_wrong(
    tmp_path, caplog, start, warned
):
    port = free_port()
    path = tmp_path / "drone.toml"
    path.write_text(CONFIG.format(id=1, port=port).replace('from = "gps"', start), encoding="utf-8")
    agent = Agent(
        parts := assemble(load_config(path), SystemClock()), console=Console(parts.lens, quiet=True)
    )
    task = asyncio.create_task(agent.run())
    async with serve_udp(FakeAutopilot(boot_at=time.monotonic() - 40.0), "127.0.0.1", port):
        async with asyncio.timeout(PATIENCE):
            while not dict(parts.autopilot.status().counters)["imu_samples"]:  # noqa: ASYNC110
                await asyncio.sleep(0.01)
        agent.stop()
        await task
    line = "in the air already, but announced at its fixed drone.start"
    assert (line in caplog.text) == warned
    assert any(line in event for event in agent.health.events) == warned
