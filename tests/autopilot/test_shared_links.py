"""Links on which more comes than one autopilot's messages, once each and whole: what is used, and what is said."""

from __future__ import annotations

import math
import random
import re
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from support.autopilot_flight import Flight
from support.fake_autopilot import FakeAutopilot, FakePx4
from swarmtrack.autopilot.candidates import AutopilotAddress, AutopilotCandidates
from swarmtrack.autopilot.engagement import PilotEngagement
from swarmtrack.autopilot.framer import Framer
from swarmtrack.autopilot.global_position import GlobalPosition
from swarmtrack.diagnosis.sources import AutopilotFacts, check_autopilot
from swarmtrack.geometry.geodesy import Geodetic
from swarmtrack.lab.autopilots.autopilot import SimulatedArduPilot
from swarmtrack.lab.autopilots.firmware import ModeNumbers
from swarmtrack.lab.autopilots.senses import GpsFix, SensedState

ATTITUDE_QUATERNION: int = common.MAVLINK_MSG_ID_ATTITUDE_QUATERNION
ORIGIN = Geodetic.from_degrees(-35.363262, 149.165237, 584.0)


class Heard:
    """What a link brings of an autopilot: as it is sent. `brings` is overridden by what does otherwise."""

    def __init__(self, autopilot: Any) -> None:
        self.autopilot = autopilot

    def receive(self, data: bytes, now: float) -> None:
        self.autopilot.receive(data, now)

    def step(self, now: float) -> list[bytes]:
        return list(self.brings(now, self.autopilot.step(now)))

    def brings(self, now: float, sent: list[bytes]) -> Iterator[bytes]:
        yield from sent


class TwoWays(Heard):
    """Brings a share of all datagrams a second time, `late` seconds later."""

    def __init__(self, autopilot: Any, late: float, share: float = 1.0) -> None:
        super().__init__(autopilot)
        self._late, self._share, self._random = late, share, random.Random(3)
        self._second: deque[tuple[float, bytes]] = deque()

    def brings(self, now: float, sent: list[bytes]) -> Iterator[bytes]:
        yield from sent
        self._second.extend((now + self._late, data) for data in sent if self._random.random() < self._share)
        while self._second and self._second[0][0] <= now:
            yield self._second.popleft()[1]


class LossyWays(TwoWays):
    """Two ways that lose a share of all frames each; of the second one they come in MAVLink 1."""

    def __init__(self, autopilot: Any, late: float, lost: float) -> None:
        super().__init__(autopilot, late, 1.0 - lost)
        self._lost = lost
        self.is_off = False

    def brings(self, now: float, sent: list[bytes]) -> Iterator[bytes]:
        framer = Framer()
        frames = [frame.data for data in sent for frame in framer.datagram(data) if not self.is_off]
        self._second.extend(
            (now + self._late, as_version_1(message))
            for frame in frames
            if self._random.random() >= self._lost
            for message in self.autopilot.parse(frame)
        )
        yield from (frame for frame in frames if self._random.random() >= self._lost)
        while self._second and self._second[0][0] <= now:
            yield self._second.popleft()[1]


class Deaf(Heard):
    """An autopilot to which nothing gets."""

    def receive(self, data: bytes, now: float) -> None:
        """Nothing is heard."""


class Silent(Heard):
    """Heartbeats of an autopilot of another type, to which nothing gets."""

    def __init__(
        self, system: int, kind: int, component: int = 1, *, firmware: int = 3, after: float = 0.0
    ) -> None:
        super().__init__(FakeAutopilot(system=system, component=component))
        self._kind, self._firmware, self._due = kind, firmware, 100.0 + after

    def receive(self, data: bytes, now: float) -> None:
        """Nothing is heard."""

    def step(self, now: float) -> list[bytes]:
        if now < self._due:
            return []
        self._due += 1.0
        beat = common.MAVLink_heartbeat_message(self._kind, self._firmware, 81, 0, 3, 3)
        return [self.autopilot.frame(beat)]


# --- copies ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("late", "share"),
    [
        (0.004, 1.0),
        (12.0, 1.0),
        (1.3, 0.01),
        *(
            pytest.param(*of, marks=pytest.mark.long("delays between those of the default run"))
            for of in [(0.2, 1.0), (1.3, 1.0)]
        ),
    ],
)
async def test_what_a_second_way_brings_again_is_dropped_counted_and_said(late, share, caplog):
    autopilot = FakeAutopilot(boot_at=60.0)
    async with Flight(TwoWays(autopilot, late, share)) as flight:
        flight.fly(20.0)
        imu = [sample.t for sample in flight.listener.imu]
        assert flight.listener.reboots == flight.count["reboots"] == flight.count["clock_resyncs"] == 0
        assert flight.count["imu_samples"] == pytest.approx(200 * 18.8, abs=40)
        assert flight.count["poses_without_position"] <= 3
        assert (np.diff(imu) > 0.0).all()
        assert flight.unit.status().ok
        assert f", {flight.count['copies']:.0f} copies dropped" in flight.text
        assert ("come again by a second way" in caplog.text) == (share == 1.0)
        # One command for each stream, as without copies.
        assert len(autopilot.commands) < 10


async def test_a_late_copy_of_a_heartbeat_does_not_engage_a_drone_that_its_pilot_has_taken_back():
    autopilot = FakeAutopilot(boot_at=60.0)
    engagement = PilotEngagement()
    stages = []
    async with Flight(TwoWays(autopilot, 1.3), engagement=engagement) as flight:
        pilot = autopilot.pilot
        pilot.armed, pilot.status = True, common.MAV_STATE_ACTIVE
        for mode in (5, 4, 5):
            pilot.mode = ModeNumbers(0, common.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, mode)
            for _ in range(60):
                flight.fly(0.1)
                engagement.tick(flight.clock.now())
                stages.append(engagement.engaged)
    assert engagement.number == 1
    assert stages[-40:] == 40 * [False]


@pytest.mark.parametrize(
    ("late", "lost"),
    [
        (0.004, 0.4),
        (0.2, 0.1),
        (1.3, 0.4),
        *(
            pytest.param(*of, marks=pytest.mark.long("each delay and each loss is in the default run"))
            for of in [(0.004, 0.1), (0.2, 0.4), (1.3, 0.1)]
        ),
    ],
)
async def test_two_ways_that_lose_frames_are_one_autopilot(late, lost):
    autopilot = FakeAutopilot(boot_at=60.0)
    engagement = PilotEngagement()
    async with Flight(LossyWays(autopilot, late, lost), engagement=engagement) as flight:
        pilot = autopilot.pilot
        pilot.armed, pilot.status = True, common.MAV_STATE_ACTIVE
        for mode in (5, 4):
            pilot.mode = ModeNumbers(0, common.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, mode)
            flight.fly(8.0)
        assert engagement.engaged
        assert flight.unit.status().ok
        assert flight.listener.reboots == 0
        assert flight.count["copies"] > 200


async def test_a_reboot_is_one_by_two_ways_that_lose_frames():
    autopilot = FakeAutopilot(boot_at=60.0)
    ways = LossyWays(autopilot, 1.3, 0.2)
    async with Flight(ways) as flight:
        flight.fly(8.0)
        ways.is_off = True
        flight.fly(2.0)
        ways.is_off = False
        autopilot.reboot(flight.clock.now())
        for _ in range(8):
            flight.fly(1.0)
            assert "two autopilots" not in flight.text
        assert flight.listener.reboots == 1


# --- two under one ID --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "boot_at",
    [
        59.3,
        *(pytest.param(at, marks=pytest.mark.long("clocks that are farther apart")) for at in (-440.0, 90.0)),
    ],
)
async def test_two_vehicles_of_one_id_are_said_and_the_first_one_s_clock_is_kept(boot_at):
    ours, other = FakeAutopilot(boot_at=60.0), FakeAutopilot(boot_at=boot_at)
    other.gyro, other.position = np.array((1.0, 1.0, 1.0)), np.array((50.0, 0.0, -20.0))
    async with Flight(ours) as flight:
        flight.fly(4.0)
        flight.autopilots = (ours, other)
        for message_id, hz in ((105, 200), (ATTITUDE_QUATERNION, 50), (32, 25)):
            other.set_interval(message_id, 1e6 / hz, flight.clock.now())
        flight.fly(6.0)
        status = flight.unit.status()
        assert not status.ok
        assert ": faulty: two autopilots send as system 1 component 1, their clocks are " in status.text
        apart = float(status.text.partition("clocks are ")[2].partition(" s")[0])
        assert apart == pytest.approx(abs(60.0 - boot_at), abs=0.2)
        assert flight.listener.reboots == 0
        np.testing.assert_allclose(
            [s.gyro for s in flight.listener.imu], len(flight.listener.imu) * [ours.gyro]
        )
        assert flight.unit.trouble == "no single autopilot"
        assert [one.remedy for one in check_autopilot(AutopilotFacts(8.0, status=status))] == [
            "set another SYSID_THISMAV (newer: MAV_SYSID) in one of them and restart it, or take it off this link"
        ]
        flight.autopilots = (ours,)
        flight.fly(5.0)
        assert flight.unit.status().ok


def engage(flight: Flight, engagement: PilotEngagement, *autopilots: FakeAutopilot) -> None:
    for autopilot in autopilots:
        autopilot.pilot.armed, autopilot.pilot.status = True, common.MAV_STATE_ACTIVE
    for mode in (5, 4):
        for autopilot in autopilots:
            autopilot.pilot.mode = ModeNumbers(0, common.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, mode)
        tick(flight, engagement, 3.0)
    assert engagement.engaged


def tick(flight: Flight, engagement: PilotEngagement, seconds: float) -> None:
    for _ in range(round(10 * seconds)):
        flight.fly(0.1)
        engagement.tick(flight.clock.now())


async def test_another_vehicle_of_our_id_ends_the_engagement():
    ours, other = FakeAutopilot(boot_at=60.0), FakeAutopilot(boot_at=20.0)
    engagement = PilotEngagement()
    async with Flight(ours, engagement=engagement) as flight:
        engage(flight, engagement, ours, other)
        other.set_interval(ATTITUDE_QUATERNION, 20_000, flight.clock.now())
        flight.autopilots = (ours, other)
        tick(flight, engagement, 6.0)
        assert not engagement.engaged
        assert engagement.take_end() == "two autopilots send as system 1"


@pytest.mark.parametrize(
    ("kind", "system_id"),
    [
        ("quadrotor", None),
        ("tracker", None),
        pytest.param("quadrotor", 1, marks=pytest.mark.long("once more with its ID told")),
    ],
)
async def test_another_vehicle_that_comes_later_ends_the_engagement(kind, system_id):
    """For the first may have been a neighbour's."""
    ours, rival = FakeAutopilot(boot_at=60.0), Silent(2, QUADROTOR if kind == "quadrotor" else TRACKER)
    engagement = PilotEngagement()
    async with Flight(ours, engagement=engagement, system_id=system_id) as flight:
        engage(flight, engagement, ours)
        flight.autopilots = (ours, rival)
        tick(flight, engagement, 3.0)
        is_rival = kind == "quadrotor" and system_id is None
        assert engagement.engaged != is_rival
        assert engagement.take_end() == ("two autopilots send, 1/1 and 2/1" if is_rival else "")


class Circling(FakeAutopilot):
    """Flies a circle of 20 m at 10 m/s, and begins to count its frames anywhere."""

    def __init__(self, number: int = 0) -> None:
        super().__init__(boot_at=60.0)
        self.channels[0].mav.seq = number

    def at(self, t: float) -> SensedState:
        angle = 0.5 * t
        east, north = math.sin(angle), math.cos(angle)
        return (
            super()
            .at(t)
            ._replace(
                q=np.array((math.cos(0.5 * angle), 0.0, 0.0, math.sin(0.5 * angle))),
                position=np.array((20.0 * north, 20.0 * east, -5.0)),
                velocity=np.array((-10.0 * east, 10.0 * north, 0.0)),
            )
        )


@pytest.mark.parametrize("apart", [0.0, 0.0025])
async def test_two_vehicles_of_one_id_whose_clocks_agree_are_told_apart_by_their_places(apart):
    """As two simulations that were started together."""
    ours, other = FakeAutopilot(boot_at=60.0), FakeAutopilot(boot_at=60.0 - apart)
    other.position = np.array((51.0, 2.0, -3.0))
    other.channels[0].mav.seq = 100
    async with Flight(ours, other, engagement=PilotEngagement()) as flight:
        flight.fly(6.0)
        assert (
            ": faulty: two autopilots send as system 1 component 1, their places are 50 m apart: "
            in flight.text
        )


async def test_a_second_vehicle_of_our_id_is_told_apart_by_its_heartbeats_alone():
    ours = FakeAutopilot(boot_at=60.0)
    engagement = PilotEngagement()
    async with Flight(ours, Silent(1, common.MAV_TYPE_QUADROTOR), engagement=engagement) as flight:
        ours.pilot.armed, ours.pilot.status = True, common.MAV_STATE_ACTIVE
        flight.fly(8.0)
        assert "two autopilots send as system 1 component 1, their flight states differ: " in flight.text


async def test_a_slow_second_vehicle_of_our_id_is_told_apart_by_its_clock():
    ours, other = FakeAutopilot(boot_at=60.0), FakeAutopilot(boot_at=-440.0)
    async with Flight(ours) as flight:
        flight.fly(4.0)
        other.set_interval(ATTITUDE_QUATERNION, 250_000, flight.clock.now())
        flight.autopilots = (ours, Deaf(other))
        flight.fly(6.0)
        assert "two autopilots send as system 1 component 1, their clocks are 500 s apart: " in flight.text


async def test_two_ports_of_one_autopilot_are_one():
    """Each has its own sequence numbers and heartbeats."""
    ports = Circling(), Circling(number=77)
    async with Flight(*ports) as flight:
        for mode in (5, 4, 5):
            for port in ports:
                port.pilot.mode = ModeNumbers(0, common.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, mode)
                # A port that is slow sends the old mode for a while.
                flight.fly(2.5)
                assert flight.unit.status().ok
            flight.fly(3.0)
            assert flight.unit.status().ok


async def test_frames_that_are_lost_and_change_places_are_one_autopilot_s():
    class Router(Heard):
        """Loses every fifth frame and, now and then, a tenth of a second; changes the order of neighbours."""

        def brings(self, now: float, sent: list[bytes]) -> Iterator[bytes]:
            framer = Framer()
            frames = [frame.data for data in sent for frame in framer.datagram(data)]
            kept = [data for data in frames if chance.random() > 0.2 and now % 1.7 > 0.1]
            yield from reversed(kept)

    chance = random.Random(7)
    async with Flight(Router(Circling())) as flight:
        for _ in range(30):
            flight.fly(1.0)
            assert "two autopilots" not in flight.text


@pytest.mark.parametrize(
    ("kind", "named"),
    [(common.MAV_TYPE_FIXED_WING, "a plane"), (common.MAV_TYPE_ANTENNA_TRACKER, "an antenna tracker")],
)
async def test_two_kinds_of_vehicle_of_one_id_are_told_apart_by_their_heartbeats(kind, named):
    other = Silent(1, kind, after=3.0)
    async with Flight(FakeAutopilot(boot_at=60.0), other) as flight:
        flight.fly(8.0)
        assert f"two autopilots send as system 1 component 1, a quadrotor and {named}: " in flight.text


# --- who is ours -------------------------------------------------------------------------------------

TRACKER, ROVER, QUADROTOR, CAMERA = (
    common.MAV_TYPE_ANTENNA_TRACKER,
    common.MAV_TYPE_GROUND_ROVER,
    common.MAV_TYPE_QUADROTOR,
    common.MAV_TYPE_CAMERA,
)


@pytest.mark.parametrize(
    ("heard", "expected", "chosen"),
    [
        ({(1, 1): QUADROTOR}, None, "1/1"),
        ({(2, 1): TRACKER, (1, 1): QUADROTOR}, None, "1/1"),
        ({(2, 1): ROVER, (3, 1): QUADROTOR}, None, "3/1"),
        ({(2, 1): ROVER}, None, "2/1"),
        ({(2, 1): TRACKER}, None, None),
        ({(2, 1): 99}, None, "2/1"),
        ({(1, 5): QUADROTOR}, None, "1/5"),
        ({(1, 100): QUADROTOR, (1, 1): QUADROTOR}, None, "1/1"),
        ({(1, 1): CAMERA, (1, 7): QUADROTOR}, None, "1/7"),
        ({(2, 1): QUADROTOR, (1, 1): QUADROTOR}, None, None),
        ({(2, 50): QUADROTOR, (1, 1): QUADROTOR}, None, None),
        ({(2, 1): ROVER, (3, 1): ROVER}, None, None),
        ({(2, 1): QUADROTOR, (1, 1): QUADROTOR}, 2, "2/1"),
        ({(2, 1): QUADROTOR, (1, 1): QUADROTOR}, 3, None),
        ({(2, 1): ROVER, (1, 1): QUADROTOR}, 2, "2/1"),
        ({(1, 100): QUADROTOR, (1, 1): QUADROTOR}, 1, "1/1"),
    ],
)
@pytest.mark.parametrize("backwards", [False, True])
def test_what_flies_is_ours_and_two_vehicles_are_not_decided_between(heard, expected, chosen, backwards):
    candidates = AutopilotCandidates(expected)
    for number, (address, kind) in enumerate(sorted(heard.items(), reverse=backwards)):
        beat = common.MAVLink_heartbeat_message(kind, 3, 81, 0, 3, 3)
        candidates.on_heartbeat(10.0 + 0.9 * number, AutopilotAddress(*address), beat)
    found = candidates.choose(12.2)
    assert (None if found is None else str(found.address)) == chosen
    assert bool(candidates.ambiguous()) == (
        chosen is None and expected is None and TRACKER not in heard.values()
    )


def test_only_who_is_asked_for_by_id_is_not_waited_with():
    beat = common.MAVLink_heartbeat_message(QUADROTOR, 3, 81, 0, 3, 3)
    for expected, waited in ((None, True), (4, False)):
        candidates = AutopilotCandidates(expected)
        candidates.on_heartbeat(10.0, AutopilotAddress(4, 1), beat)
        assert (candidates.choose(10.0) is None) == waited
        assert candidates.choose(10.0, final=True) is not None


def test_nobody_keeps_ours_out_by_speaking_under_many_names():
    candidates = AutopilotCandidates(7)
    for system in range(20, 250):
        for component in (1, 2):
            camera = common.MAVLink_heartbeat_message(CAMERA, 3, 81, 0, 3, 3)
            candidates.on_heartbeat(10.0, AutopilotAddress(system, component), camera)
    beat = common.MAVLink_heartbeat_message(QUADROTOR, 3, 81, 0, 3, 3)
    candidates.on_heartbeat(10.0, AutopilotAddress(7, 1), beat)
    assert candidates.choose(12.0).address == (7, 1)
    assert len(candidates.beside(AutopilotAddress(7, 1), 10.0)) < 10


async def test_an_antenna_tracker_that_speaks_first_is_named_and_not_flown():
    async with Flight(Silent(2, TRACKER), FakeAutopilot(boot_at=60.0)) as flight:
        flight.fly(5.0)
        assert flight.unit.system == 1
        assert flight.unit.status().ok
        assert flight.text.endswith(", also on the link: 2/1 (antenna tracker)")
    async with Flight(Silent(2, TRACKER)) as flight:
        flight.fly(5.0)
        assert "no autopilot heartbeat (heard: 2/1 antenna tracker)" in flight.text


async def test_of_two_vehicles_none_is_chosen_and_nothing_is_asked_of_either(caplog):
    ours, neighbour = FakeAutopilot(), FakeAutopilot(system=2)
    async with Flight(neighbour, ours) as flight:
        flight.fly(6.0)
        expected = "two autopilots send, 1/1 (quadrotor) and 2/1 (quadrotor): set autopilot.system_id"
        assert expected in flight.text
        assert expected in caplog.text
        assert not flight.unit.status().ok
        assert ours.commands == neighbour.commands == []
        (finding,) = check_autopilot(AutopilotFacts(8.0, status=flight.unit.status()))
        assert (finding.check, finding.remedy[:24]) == ("autopilot", "set autopilot.system_id ")
    async with Flight(FakeAutopilot(system=2), FakeAutopilot(), system_id=2) as flight:
        flight.fly(6.0)
        assert flight.unit.status().ok
        assert flight.text.endswith(", also on the link: 1/1 (quadrotor)")


async def test_a_second_vehicle_that_comes_later_is_said_and_the_first_one_kept():
    ours = FakeAutopilot(boot_at=60.0)
    async with Flight(ours, Silent(2, QUADROTOR, after=4.0)) as flight:
        flight.fly(3.0)
        assert flight.unit.status().ok
        flight.fly(3.0)
        assert (
            "two autopilots send, 1/1 is used and 2/1 (quadrotor) came later: set autopilot.sys"
            in flight.text
        )
        assert not flight.unit.status().ok
        before = len(flight.listener.imu)
        flight.fly(1.0)
        assert len(flight.listener.imu) - before == pytest.approx(200, abs=3)


async def test_a_neighbour_that_was_first_at_a_udp_port_is_contested_by_ours():
    """The socket does not read what other addresses send, but heartbeats."""
    neighbour, ours = FakeAutopilot(system=2, boot_at=60.0), Silent(1, QUADROTOR)
    async with Flight(neighbour) as flight:
        flight.fly(4.0)
        assert flight.unit.status().ok
        for _ in range(3):
            flight.fly(1.0)
            for data in ours.step(flight.clock.now()):
                flight.unit.overheard(flight.clock.now(), data)
        assert "two autopilots send, 2/1 is used and 1/1 (quadrotor) came later" in flight.text


@pytest.mark.parametrize("same_state", [True, False])
async def test_heartbeats_of_our_id_from_another_port_are_a_second_autopilot_s_where_they_contradict(
    same_state,
):
    ours = FakeAutopilot(boot_at=60.0)
    copy = FakeAutopilot(boot_at=60.0)
    copy.pilot.armed = ours.pilot.armed == same_state
    async with Flight(ours) as flight:
        flight.fly(4.0)
        for _ in range(7000):
            flight.fly(0.001)
            for data in copy.step(flight.clock.now()):
                flight.unit.overheard(flight.clock.now(), data)
        assert ("their flight states differ" in flight.text) != same_state


async def test_overheard_senders_cost_little_and_never_feed_data():
    async with Flight(FakeAutopilot(boot_at=60.0)) as flight:
        flight.fly(3.0)
        beats = [FakeAutopilot(system=2 + n % 250) for n in range(500)]
        flood = [next(iter(beat.step(flight.clock.now()))) for beat in beats]
        samples = len(flight.listener.imu)
        for data in flood:
            flight.unit.overheard(flight.clock.now(), data)
        assert len(flight.listener.imu) == samples
        assert 0 < flight.text.count("/1 (quadrotor)") <= 20


@pytest.mark.parametrize("other", ["twin", "second way"])
async def test_two_ports_that_send_as_one_autopilot_are_not_chosen_between(other):
    ours, twin = FakePx4(boot_at=60.0), FakePx4(boot_at=90.0)
    async with Flight() as flight:
        for _ in range(4000):
            flight.fly(0.001)
            now = flight.clock.now()
            sent = ours.step(now)
            for port, frames in ((5001, sent), (5002, twin.step(now) if other == "twin" else sent)):
                for data in frames:
                    flight.unit.received(now, data, ("10.0.0.1", port))
        assert bool(flight.unit.system) != (other == "twin")
        if other == "twin":
            ports = "from 10.0.0.1 port 5001 and 10.0.0.1 port 5002: give each vehicle an ID of its own"
            assert f"two autopilots send under one ID, {ports}" in flight.text
            (finding,) = check_autopilot(AutopilotFacts(8.0, status=flight.unit.status()))
            assert finding.remedy.startswith("set another ID in one of them")


async def test_an_autopilot_that_is_not_component_1_is_asked_by_its_own():
    autopilot = FakeAutopilot(component=42, boot_at=60.0)
    async with Flight(autopilot) as flight:
        flight.fly(5.0)
        assert flight.unit.status().ok
        assert flight.unit.way().target == 42


# --- more thrown away than used ----------------------------------------------------------------------


class Spoiled(FakeAutopilot):
    """An ArduPilot that spoils some messages."""

    def __init__(self, spoil: Any, **options: Any) -> None:
        super().__init__(**options)
        self._spoil = spoil

    def _report(self, message_id: int, stamp: float) -> Any:
        report = super()._report(message_id, stamp)
        if report is not None:
            self._spoil(report)
        return report


WITHOUT_EULER_ANGLES = tuple(n for n in SimulatedArduPilot.offers if n != common.MAVLINK_MSG_ID_ATTITUDE)


def nan_gyro(m: Any) -> None:
    if m.get_type() == "HIGHRES_IMU" and m.time_usec // 5000 % 3:
        m.xgyro = math.nan


def no_quaternion(m: Any) -> None:
    if m.get_type() == "ATTITUDE_QUATERNION":
        m.q1 = m.q2 = m.q3 = m.q4 = 0.0


def standing_clock(m: Any) -> None:
    if m.get_type() == "HIGHRES_IMU":
        m.time_usec = 0
        m.xacc = random.random()


def another_clock(m: Any) -> None:
    if m.get_type() == "ATTITUDE_QUATERNION":
        m.time_boot_ms += 60_000


@pytest.mark.parametrize(
    ("spoil", "state", "said", "trouble"),
    [
        (nan_gyro, "faulty", "gyro samples in 2 s thrown away: impossible values", "no sound data"),
        (
            standing_clock,
            "faulty",
            "gyro samples in 2 s thrown away: stamps that stand still",
            "no sound data",
        ),
        (no_quaternion, "faulty", "attitudes in 2 s thrown away: impossible values", "no sound data"),
        (another_clock, "faulty", "attitudes in 2 s thrown away: stamps of another clock", "no sound data"),
    ],
)
async def test_where_more_is_thrown_away_than_used_the_link_is_not_ok_and_says_what(
    spoil, state, said, trouble
):
    async with Flight(Spoiled(spoil, boot_at=60.0, offered=WITHOUT_EULER_ANGLES)) as flight:
        flight.fly(8.0)
        status = flight.unit.status()
        assert not status.ok
        assert f": {state}: " in status.text
        assert said in status.text
        assert flight.unit.trouble == trouble
        (finding,) = check_autopilot(AutopilotFacts(8.0, status=status))
        assert finding.found.startswith("most of what the autopilot sends cannot be used: ")


class Damaged(Heard):
    """Spoils a share of all frames, and puts noise in front of others."""

    def __init__(self, autopilot: Any, share: float, *, noise: bytes = b"", left_out: float = 0.0) -> None:
        super().__init__(autopilot)
        self._share, self._noise, self._left_out, self._random = share, noise, left_out, random.Random(3)

    def brings(self, now: float, sent: list[bytes]) -> Iterator[bytes]:
        framer = Framer()
        for data in sent:
            for frame in framer.datagram(data):
                spoilt = bytearray(self._noise + frame.data)
                if self._random.random() < self._share:
                    spoilt[-1] ^= 0x55
                if self._random.random() >= self._left_out:
                    yield bytes(spoilt)


@pytest.mark.parametrize(
    ("link", "is_ok"),
    [
        ({"share": 0.65}, False),
        ({"share": 0.2}, True),
        ({"share": 0.0, "noise": 80 * b"\xfd"}, True),
        ({"share": 0.0, "left_out": 0.65}, True),
    ],
)
async def test_a_link_that_damages_most_frames_is_not_ok(link, is_ok):
    async with Flight(Damaged(FakeAutopilot(boot_at=60.0), **link)) as flight:
        flight.fly(14.0)
        assert flight.unit.status().ok == is_ok
        assert ("frames in 2 s thrown away: damaged on the way" in flight.text) != is_ok


WITHOUT_ATTITUDE = tuple(
    n for n in SimulatedArduPilot.offers if n not in (ATTITUDE_QUATERNION, common.MAVLINK_MSG_ID_ATTITUDE)
)


async def test_no_attitude_while_the_gyro_comes_is_a_state():
    autopilot = FakeAutopilot(boot_at=60.0, offered=WITHOUT_ATTITUDE)
    async with Flight(autopilot) as flight:
        flight.fly(8.0)
        assert ": no pose: IMU 200 Hz asked, 200 Hz got from HIGHRES_IMU" in flight.text
        assert "neither ATTITUDE_QUATERNION nor ATTITUDE comes" in flight.text
        assert not flight.unit.status().ok
        assert flight.unit.trouble == "no attitude"
        (finding,) = check_autopilot(AutopilotFacts(8.0, status=flight.unit.status()))
        assert finding.found.startswith("gyro samples come, but no attitude")
        flight.fly(60.0)
        # Both are looked for, and nobody is pestered.
        asked = [message for message, _ in autopilot.commands if message in (30, 31)]
        assert {30, 31} == set(asked)
        assert len(asked) < 68 * 3


@pytest.mark.parametrize(
    ("asked", "got", "is_slow"), [(200.0, 30.0, True), (20.0, 20.0, False), (200.0, 60.0, False)]
)
async def test_a_gyro_that_is_too_slow_is_no_link_that_is_ok(asked, got, is_slow):
    class Slow(FakeAutopilot):
        def grant(self, message_id: int, interval_us: float, stamp: float, channel: Any) -> int:
            return super().grant(message_id, max(interval_us, 1e6 / got), stamp, channel)

    async with Flight(Slow(boot_at=60.0), imu_rate_hz=asked) as flight:
        flight.fly(8.0)
        assert ("faulty: the gyro is too slow, at least 50 Hz are needed" in flight.text) == is_slow
        assert flight.unit.status().ok != is_slow


async def test_a_local_position_that_never_comes_is_said():
    offered = tuple(n for n in SimulatedArduPilot.offers if n != common.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
    async with Flight(FakeAutopilot(boot_at=60.0, offered=offered)) as flight:
        flight.fly(8.0)
        # On a table there is none.
        assert flight.unit.status().ok
        assert flight.text.endswith(", no LOCAL_POSITION_NED comes")


# --- one message for each thing is too few -----------------------------------------------------------


async def test_euler_angles_are_the_attitude_where_there_is_no_quaternion():
    offered = tuple(n for n in SimulatedArduPilot.offers if n != ATTITUDE_QUATERNION)
    autopilot = FakeAutopilot(boot_at=60.0, offered=offered)
    autopilot.q = np.array((math.cos(0.4), 0.0, 0.0, math.sin(0.4)))  # yaw 0.8
    async with Flight(autopilot) as flight:
        flight.fly(6.0)
        assert flight.unit.status().ok
        assert len(flight.listener.poses) == pytest.approx(50 * 4.5, abs=25)
        found = flight.listener.poses[-1].world_from_body @ (1, 0, 0)
        np.testing.assert_allclose(found, (math.cos(0.8), math.sin(0.8), 0.0), atol=1e-6)


def spoiled_quaternion(*numbers: float) -> Callable[[Any], None]:
    def spoil(m: Any) -> None:
        if m.get_type() == "ATTITUDE_QUATERNION":
            m.q1, m.q2, m.q3, m.q4 = numbers

    return spoil


@pytest.mark.parametrize(
    ("numbers", "comes_by_itself"),
    [
        ((math.nan,) * 4, True),
        ((0.0,) * 4, False),
        ((3.0, 0.0, 0.0, 0.0), True),
        ((math.inf, 0.0, 0.0, 0.0), False),
    ],
)
async def test_a_useless_quaternion_does_not_silence_the_euler_angles(numbers, comes_by_itself):
    autopilot = Spoiled(spoiled_quaternion(*numbers), boot_at=60.0)
    autopilot.q = np.array((math.cos(0.4), 0.0, 0.0, math.sin(0.4)))  # yaw 0.8
    async with Flight(autopilot) as flight:
        if comes_by_itself:
            autopilot.set_interval(common.MAVLINK_MSG_ID_ATTITUDE, 20_000, flight.clock.now())
            flight.fly(3.0)
            assert flight.listener.poses
        flight.fly(12.0)
        assert flight.unit.status().ok
        before = len(flight.listener.poses)
        flight.fly(4.0)
        assert flight.unit.status().ok
        assert len(flight.listener.poses) - before == pytest.approx(200, abs=5)
        found = flight.listener.poses[-1].world_from_body @ (1, 0, 0)
        np.testing.assert_allclose(found, (math.cos(0.8), math.sin(0.8), 0.0), atol=1e-6)
        # The autopilot still sends both.
        assert flight.count["invalid"] >= 4.0 * 50
        refused = re.search(
            r"(\d+) attitudes \(impossible values, and another message is used\)",
            " ".join(flight.unit.account()),
        )
        assert refused is not None
        assert int(refused[1]) >= 4.0 * 50


async def test_a_useless_quaternion_that_comes_by_two_ways_is_none_either():
    autopilot = Spoiled(spoiled_quaternion(0.0, 0.0, 0.0, 0.0), boot_at=60.0)
    async with Flight(TwoWays(autopilot, 0.2)) as flight:
        flight.fly(12.0)
        assert flight.unit.status().ok
        assert flight.listener.poses


async def test_a_quaternion_that_is_useless_now_and_then_is_thrown_away_and_no_other_asked_for():
    def spoil(m: Any) -> None:
        if m.get_type() == "ATTITUDE_QUATERNION" and m.time_boot_ms // 20 % 2:
            m.q1 = math.nan

    autopilot = Spoiled(spoil, boot_at=60.0)
    async with Flight(autopilot) as flight:
        flight.fly(8.0)
        assert common.MAVLINK_MSG_ID_ATTITUDE not in {message for message, _ in autopilot.commands}
        assert "attitudes (impossible values)" in " ".join(flight.unit.account())


async def test_a_gyro_of_impossible_values_does_not_silence_a_lesser_one():
    def spoil(m: Any) -> None:
        if m.get_type() == "HIGHRES_IMU":
            m.xgyro = math.nan

    autopilot = Spoiled(spoil, boot_at=60.0)
    async with Flight(autopilot) as flight:
        flight.fly(12.0)
        assert flight.unit.status().ok
        assert "200 Hz got from RAW_IMU" in flight.text
        assert flight.count["invalid"] > 0


class Odometry(FakeAutopilot):
    """Sends attitude and local position as ODOMETRY, alone or as well."""

    def __init__(self, *, alone: bool, boot_at: float = 60.0) -> None:
        super().__init__(boot_at=boot_at)
        self._alone = alone
        self.stands_still = False
        self.local_north: float | None = None
        """m, in a LOCAL_POSITION_NED that comes as well."""

    def _report(self, message_id: int, stamp: float) -> Any:
        if message_id == 32 and self.local_north is not None:
            report = super()._report(message_id, stamp)
            report.x = self.local_north
            return report
        if message_id == ATTITUDE_QUATERNION:
            unknown = [random.random() if self.stands_still else math.nan] * 21
            stamp = 0.0 if self.stands_still else stamp
            odometry = common.MAVLink_odometry_message(
                round(stamp * 1e6), 1, 12, *self.position, self.q, 2.0, 0.0, 0.0, 0, 0, 0, unknown, unknown
            )
            self.channels[0].send(odometry)
        spared = (30, ATTITUDE_QUATERNION, 32) if self._alone else ()
        return None if message_id in spared else super()._report(message_id, stamp)


@pytest.mark.parametrize("alone", [True, False])
async def test_odometry_is_attitude_and_place_where_neither_comes_by_itself(alone):
    autopilot = Odometry(alone=alone)
    autopilot.q = np.array((math.cos(0.4), 0.0, 0.0, math.sin(0.4)))  # yaw 0.8
    async with Flight(autopilot) as flight:
        autopilot.set_interval(ATTITUDE_QUATERNION, 20_000, flight.clock.now())
        flight.fly(4.0)
        before = len(flight.listener.poses)
        flight.fly(3.0)
        assert len(flight.listener.poses) - before == pytest.approx(150, abs=10)
        pose = flight.listener.poses[-1]
        np.testing.assert_allclose(
            pose.world_from_body @ (1, 0, 0), (math.cos(0.8), math.sin(0.8), 0.0), atol=1e-6
        )
        np.testing.assert_allclose(pose.position, autopilot.position, atol=1e-6)
        assert flight.unit.status().ok


@pytest.mark.parametrize("north", [math.nan, 1e7])
async def test_a_local_position_that_is_impossible_does_not_keep_odometry_s_out(north):
    autopilot = Odometry(alone=True)
    autopilot.local_north = north
    async with Flight(autopilot) as flight:
        autopilot.set_interval(ATTITUDE_QUATERNION, 20_000, flight.clock.now())
        flight.fly(4.0)
        np.testing.assert_allclose(flight.listener.poses[-1].position, autopilot.position, atol=1e-6)


async def test_odometry_whose_clock_stands_still_is_said():
    autopilot = Odometry(alone=True)
    autopilot.stands_still = True
    async with Flight(autopilot) as flight:
        autopilot.set_interval(ATTITUDE_QUATERNION, 20_000, flight.clock.now())
        flight.fly(8.0)
        assert "attitudes in 2 s thrown away: stamps that stand still" in flight.text


async def test_a_second_vehicle_of_our_id_is_told_apart_by_its_odometry(caplog):
    """By clocks so close that a slow way explains them as well."""
    ours, other = Odometry(alone=True), Odometry(alone=True, boot_at=58.0)
    async with Flight(ours) as flight:
        ours.set_interval(ATTITUDE_QUATERNION, 20_000, flight.clock.now())
        flight.fly(4.0)
        flight.autopilots = (ours, Deaf(other))
        other.set_interval(ATTITUDE_QUATERNION, 20_000, flight.clock.now())
        flight.fly(6.0)
        assert "two autopilots send as system 1 component 1, their clocks are 2 s apart" in caplog.text


@pytest.mark.parametrize("kind", ["ATTITUDE", "ODOMETRY"])
async def test_copies_of_a_lesser_attitude_are_not_counted_as_passed_over(kind):
    autopilot = Odometry(alone=False) if kind == "ODOMETRY" else FakeAutopilot(boot_at=60.0)
    async with Flight(TwoWays(autopilot, 0.2)) as flight:
        flight.fly(3.0)
        autopilot.set_interval(common.MAVLINK_MSG_ID_ATTITUDE, 20_000, flight.clock.now())
        flight.fly(4.0)
        unused = " ".join(flight.unit.account())
        count = re.search(rf"(\d+) attitudes \({kind}: a better message is used\)", unused)
        assert int(count[1]) < 50 * 7.0


async def test_both_attitudes_are_not_used_twice():
    autopilot = FakeAutopilot(boot_at=60.0)
    async with Flight(autopilot) as flight:
        flight.fly(3.0)
        autopilot.set_interval(common.MAVLINK_MSG_ID_ATTITUDE, 20_000, flight.clock.now())
        before = len(flight.listener.poses)
        flight.fly(4.0)
        assert len(flight.listener.poses) - before == pytest.approx(200, abs=3)


class OtherSensors(FakeAutopilot):
    """Of its first sensor nothing comes."""

    def __init__(self, kind: str) -> None:
        super().__init__(boot_at=60.0)
        self._kind = kind

    def _report(self, message_id: int, stamp: float) -> Any:
        report = super()._report(message_id, stamp)
        if report is None or message_id not in (27, 26, 105):
            return report
        milli = [round(1e3 * rate) for rate in self.gyro]
        match self._kind:
            case "SCALED_IMU2" if message_id == 105:
                return common.MAVLink_scaled_imu2_message(round(1e3 * stamp), 0, 0, -1000, *milli, 0, 0, 0)
            case "SCALED_IMU3" if message_id == 105:
                return common.MAVLink_scaled_imu3_message(round(1e3 * stamp), 0, 0, -1000, *milli, 0, 0, 0)
            case "HIGHRES_IMU":
                report.id = 1
                return report
        return None


@pytest.mark.parametrize("kind", ["SCALED_IMU2", "SCALED_IMU3", "HIGHRES_IMU"])
async def test_another_sensor_s_gyro_is_used_where_the_first_is_silent(kind):
    autopilot = OtherSensors(kind)
    async with Flight(autopilot) as flight:
        # As SRn_RAW_SENS makes it come.
        autopilot.set_interval(105, 5000, flight.clock.now())
        flight.fly(9.0)
        assert f"200 Hz got from {kind}" in flight.text
        np.testing.assert_allclose(flight.listener.imu[-1].gyro, autopilot.gyro, atol=1e-3)


async def test_of_several_sensors_by_turns_the_first_one_is_used():
    class Both(FakeAutopilot):
        def _report(self, message_id: int, stamp: float) -> Any:
            report = super()._report(message_id, stamp)
            if message_id == 105 and report is not None:
                second = super()._report(message_id, stamp + 1e-3)
                second.id, second.xgyro = 1, 2.0
                self.channels[0].send(second)
            return report

    async with Flight(Both(boot_at=60.0)) as flight:
        flight.fly(6.0)
        assert flight.count["imu_samples"] == pytest.approx(200 * 4.8, abs=20)
        assert max(sample.gyro[0] for sample in flight.listener.imu) < 1.0


async def test_an_old_autopilot_s_group_of_attitudes_is_read():
    """REQUEST_DATA_STREAM brings ATTITUDE, and rates next to it."""
    autopilot = FakeAutopilot(understands_intervals=False, offered=(common.MAVLINK_MSG_ID_ATTITUDE,))
    async with Flight(autopilot, imu_rate_hz=50.0) as flight:
        flight.fly(45.0)
        assert "50 Hz got from ATTITUDE" in flight.text
        assert flight.listener.poses[-1].t > flight.clock.now() - 0.1


@pytest.mark.parametrize("first", [{"fix_type": 1, "satellites": 0}, None])
async def test_a_second_receiver_with_a_fix_is_enough(first):
    class TwoReceivers(FakeAutopilot):
        """The first one is unplugged, or not even told of."""

        def _report(self, message_id: int, stamp: float) -> Any:
            if message_id != common.MAVLINK_MSG_ID_GPS_RAW_INT:
                return super()._report(message_id, stamp)
            second = common.MAVLink_gps2_raw_message(
                int(stamp * 1e6), 6, 0, 0, 0, 0, 0, 0, 0, 18, 0, 0, h_acc=20, v_acc=30
            )
            self.channels[0].send(second)
            us = int(stamp * 1e6)
            return first and common.MAVLink_gps_raw_int_message(us, first["fix_type"], 0, 0, 0, 0, 0, 0, 0, 0)

    autopilot = TwoReceivers(boot_at=60.0)
    autopilot.gps = GpsFix(ORIGIN, 0.9)
    async with Flight(autopilot, gps=GlobalPosition(ORIGIN)) as flight:
        flight.fly(5.0)
        assert flight.unit.status().ok
        assert flight.listener.poses[-1].position_sigma == pytest.approx(0.02)
        assert flight.listener.poses[-1].position is not None


class HearsVersion1(Heard):
    """Speaks MAVLink 1; hears that only, or speaks MAVLink 2 from when it has heard it."""

    def __init__(self, autopilot: FakeAutopilot, *, learns: bool) -> None:
        super().__init__(autopilot)
        self.learns, self.heard = learns, {0xFD: 0, 0xFE: 0}

    def receive(self, data: bytes, now: float) -> None:
        self.heard[data[0]] += 1
        if data[0] == 0xFE or self.learns:
            self.autopilot.receive(data, now)

    def brings(self, now: float, sent: list[bytes]) -> Iterator[bytes]:
        speaks_1 = not (self.learns and self.heard[0xFD])
        for data in sent:
            yield b"".join(map(as_version_1, self.autopilot.parse(data))) if speaks_1 else data


def as_version_1(message: Any) -> bytes:
    mav = common.MAVLink(None, message.get_srcSystem(), message.get_srcComponent())
    mav.seq = message.get_seq()
    message.pack(mav, force_mavlink1=True)
    return bytes(message.get_msgbuf())


@pytest.mark.parametrize("learns", [False, True])
async def test_who_speaks_mavlink_1_only_is_answered_in_it(learns):
    link = HearsVersion1(FakeAutopilot(boot_at=60.0), learns=learns)
    async with Flight(link) as flight:
        flight.fly(12.0)
        assert flight.unit.status().ok
        assert flight.count["imu_rate_hz"] == pytest.approx(200.0, abs=2.0)
        assert bool(link.heard[0xFE]) != learns
        assert flight.unit.way().version_1 != learns
        # It may learn MAVLink 2 at any time, from a heartbeat.
        link.learns = True
        flight.fly(6.0)
        assert not flight.unit.way().version_1


@pytest.mark.parametrize("size", [1, 7, 64, 1000])
async def test_datagrams_that_are_cut_anywhere_cost_nothing(size):
    class Bridge(Heard):
        """Brings the bytes in pieces of one size."""

        def __init__(self, autopilot: Any) -> None:
            super().__init__(autopilot)
            self._stream = bytearray()

        def brings(self, now: float, sent: list[bytes]) -> Iterator[bytes]:
            self._stream += b"".join(sent)
            while len(self._stream) >= size:
                yield bytes(self._stream[:size])
                del self._stream[:size]

    async with Flight(Bridge(FakePx4(boot_at=60.0))) as flight:
        flight.fly(6.0)
        assert flight.count["bad_bytes"] == flight.count["crc_failures"] == flight.count["imu_lost"] == 0
        assert flight.count["imu_rate_hz"] > 120.0


async def test_pieces_of_two_senders_are_not_mixed():
    """Before it is known which one is the autopilot."""
    ours, neighbour = FakeAutopilot(boot_at=60.0), FakeAutopilot(boot_at=50.0, system=2)
    stream = {1: b"", 2: b""}
    async with Flight(system_id=1) as flight:
        for k in range(200):
            flight.fly(0.01)
            now = flight.clock.now()
            for number, autopilot in ((1, ours), (2, neighbour)):
                stream[number] += b"".join(autopilot.step(now))
                piece, stream[number] = stream[number][: 5 + k % 9], stream[number][5 + k % 9 :]
                flight.unit.received(now, piece, ("10.0.0.1", number))
        assert flight.unit.system == 1
        assert flight.count["bad_bytes"] == flight.count["crc_failures"] == 0


# --- wraps -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wrap_s", [2**32 * 1e-6, 2**32 * 1e-3])
async def test_a_clock_of_32_bits_that_begins_again_costs_no_sample(wrap_s):
    def in_32_bits(m: Any) -> None:
        if m.get_type() == "HIGHRES_IMU" and wrap_s < 5000:
            m.time_usec %= 2**32
        elif hasattr(m, "time_boot_ms"):
            m.time_boot_ms %= 2**32

    autopilot = Spoiled(in_32_bits, boot_at=105.0 - wrap_s)
    async with Flight(autopilot) as flight:
        flight.fly(12.0)
        assert flight.listener.reboots == flight.count["out_of_step"] == flight.count["imu_lost"] == 0
        assert flight.count["invalid"] == flight.count["clock_resyncs"] == 0
        steps = np.diff([sample.t for sample in flight.listener.imu])
        assert np.abs(steps - 5e-3).max() < 1e-3
        assert flight.unit.status().ok
