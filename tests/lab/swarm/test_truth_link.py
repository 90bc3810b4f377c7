"""Truth links on real sockets: what they tell, and what is said of each way in which they can fail."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import math
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from support.patience import eventually
from support.ports import free_port
from support.telling_sitl import PATH, autopilot, telling_sitl
from swarmtrack.autopilot.signing import Codec
from swarmtrack.clock import ManualClock, SystemClock
from swarmtrack.geometry.geodesy import from_ned
from swarmtrack.lab.autopilots.autopilot import SimulatedArduPilot
from swarmtrack.lab.autopilots.px4 import SimulatedPx4
from swarmtrack.lab.scenarios.scenario import SCENARIO_ORIGIN
from swarmtrack.lab.swarm.truth_link import FATAL, TruthAddress, TruthFault, TruthLink
from swarmtrack.lab.swarm.truth_messages import TrueSample


@asynccontextmanager
async def following(
    address: str, system_id: int | None = None
) -> AsyncIterator[tuple[TruthLink, list[TrueSample]]]:
    told: list[TrueSample] = []
    link = TruthLink(TruthAddress(7, address, system_id), SCENARIO_ORIGIN, SystemClock(), told.append)
    task = asyncio.create_task(link.run())
    try:
        yield link, told
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


def trouble(link: TruthLink, *words: str) -> Callable[[], bool]:
    """Whether it is said, all of it."""

    def said() -> bool:
        found = link.trouble()
        return found is not None and all(word in found[1] for word in words)

    return said


@pytest.mark.parametrize("kind", [SimulatedArduPilot, SimulatedPx4])
async def test_a_simulator_that_tells_is_followed_to_a_centimetre(kind):
    """PX4 does not stamp its truth."""
    pilot = autopilot(kind=kind)
    async with telling_sitl(pilot) as sitl, following(sitl.address) as (link, told):
        await eventually(lambda: len(told) > 100, "two seconds of truth")
        assert link.trouble() is None
        for truth in told[20:]:
            expected = PATH.derivatives(truth.t - pilot.boot_at)[0]
            # 1e-7 degrees are 11 mm; it flies at 0.6 m/s, and a busy machine may stamp 20 ms late.
            assert np.abs(truth.pose.position - expected).max() < 0.03
        assert all(after.t > before.t for before, after in itertools.pairwise(told))


async def test_nobody_listens():
    async with following(f"tcp:127.0.0.1:{free_port(socket.SOCK_STREAM)}") as (link, _):
        await eventually(trouble(link, "drone 7: truth link tcp:127.0.0.1:", "nothing listens at"))
        fault, _ = link.trouble()
        assert fault is TruthFault.SILENT
        assert fault not in FATAL


async def test_on_udp_nobody_listens_either():
    async with following(f"udpout:127.0.0.1:{free_port()}") as (link, _):
        await eventually(trouble(link, "is silent: nothing listens there; is SITL running, with this port?"))


async def test_a_port_that_is_open_and_says_nothing():
    async with telling_sitl() as sitl, following(sitl.address) as (link, _):
        await eventually(trouble(link, "is silent: open, 0 bytes", "does no other program use it?"))


async def test_bytes_that_are_no_mavlink():
    async def chatter(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"SSH-2.0-OpenSSH_9.2\r\n" * 20)

    server = await asyncio.start_server(chatter, "127.0.0.1", 0)
    async with server, following(f"tcp:127.0.0.1:{server.sockets[0].getsockname()[1]}") as (link, _):
        await eventually(trouble(link, "bytes and no MAVLink frame, expected a MAVLink port of SITL"))


async def test_a_real_autopilot_has_no_truth():
    async with telling_sitl(autopilot(truth=False)) as sitl, following(sitl.address) as (link, _):
        await eventually(
            trouble(link, "heartbeats, and refuses it: SIM_STATE was asked for, which simulators send")
        )


async def test_an_origin_that_is_2_km_off_is_told_where_the_drone_is():
    elsewhere = from_ned(np.array([2000.0, 0.0, 0.0]), SCENARIO_ORIGIN)
    async with telling_sitl(autopilot(origin=elsewhere)) as sitl, following(sitl.address) as (link, _):
        await eventually(trouble(link, "puts it 2.0 km from world.origin (200", "less than 1 km. It is at"))
        fault, said = link.trouble()
        assert fault is TruthFault.FAR
        assert fault in FATAL
        assert "lat_deg = 47.4157" in said
        assert "alt_m = 493" in said


async def test_two_autopilots_on_one_link_are_named_and_none_is_followed():
    async with telling_sitl(autopilot(3), autopilot(5)) as sitl, following(sitl.address) as (link, told):
        await eventually(trouble(link, "carries the autopilots 3, 5, expected one"))
        assert link.trouble()[0] in FATAL
        pilots = sitl.autopilots
        count = len(told)
        # Both tell: what both say of the time is heard, and neither is believed.
        await eventually(lambda: all(pilot.channels[1].streams for pilot in pilots), "both were asked")
        await asyncio.sleep(0.5)
        assert len(told) == count


async def test_of_two_autopilots_on_one_link_the_one_that_was_asked_for_is_followed():
    async with telling_sitl(autopilot(3), autopilot(5)) as sitl, following(sitl.address, 5) as (link, told):
        await eventually(trouble(link, "carries the autopilots 3, 5, expected one"))
        await eventually(lambda: len(told) > 10, "the truth of system 5")


async def test_another_autopilot_than_expected():
    async with telling_sitl(autopilot(3)) as sitl, following(sitl.address, system_id=1) as (link, told):
        await eventually(trouble(link, "is of system 3, expected system_id 1"))
        assert link.trouble()[0] in FATAL
        assert not told


async def test_a_simulator_that_is_paused_is_said_and_followed_again():
    async with telling_sitl(autopilot()) as sitl, following(sitl.address) as (link, _):
        await eventually(lambda: link.trouble() is None, "truth flows")
        sitl.paused = True
        await eventually(trouble(link, "sent nothing for", "is its simulator paused, slow or gone?"))
        sitl.paused = False
        await eventually(lambda: link.trouble() is None, "truth flows again")


async def test_a_simulator_that_is_started_again_is_asked_again():
    async with telling_sitl(autopilot()) as sitl, following(sitl.address) as (link, told):
        await eventually(lambda: link.trouble() is None, "truth flows")
        # A new process: its time is 0, and it knows of no request.
        sitl.autopilots[:] = [autopilot()]
        count = len(told)
        await eventually(lambda: len(told) > count + 50, "truth flows again")


@pytest.mark.parametrize(
    ("stands_still", "words"),
    [
        (True, "brings nothing of use for 1.0 s: its stamp stands still at 2.980 s. No frame is exposed"),
        (False, "sent nothing for 1.0 s: is its simulator paused, slow or gone?"),
    ],
)
def test_messages_that_say_nothing_new_are_not_taken_for_silence(stands_still, words):
    clock = ManualClock()
    link = TruthLink(TruthAddress(7, "udpin:127.0.0.1:14700"), SCENARIO_ORIGIN, clock, lambda sample: None)
    codec = Codec(clock, 1, 1)

    def send(stamp: float) -> None:
        place = from_ned(np.zeros(3), SCENARIO_ORIGIN)
        message = common.MAVLink_hil_state_quaternion_message(
            round(1e6 * stamp), [1.0, 0, 0, 0], 0, 0, 0, round(1e7 * math.degrees(place.latitude)),
            round(1e7 * math.degrees(place.longitude)), round(1e3 * place.height), *(0,) * 8,
        )  # fmt: skip
        link.received(clock.now(), codec.encode(message))

    link.opened()
    link.received(
        0.0, codec.encode(common.MAVLink_heartbeat_message(2, common.MAV_AUTOPILOT_PX4, 0, 0, 0, 3))
    )
    for k in range(200):
        clock.set(0.02 * k)
        if k < 150 or stands_still:
            send(min(clock.now(), 2.98))
    assert trouble(link, words)()
