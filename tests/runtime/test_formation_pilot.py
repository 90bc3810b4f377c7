"""What a follower's agent sends: in simulated time, and over real UDP; pymavlink decodes it."""

import asyncio
import itertools
import math
import time

import pytest
from pymavlink.dialects.v20 import common

from support.autopilot_flight import Flight, RealFlight
from support.fake_autopilot import FakeAutopilot, FakePx4, serve_udp
from support.inline_guard import InlineGuard
from support.ports import free_port
from swarmtrack.autopilot.engagement import EngagementStage, PilotEngagement
from swarmtrack.clock import SystemClock
from swarmtrack.follower import LocalSetpoint
from swarmtrack.formation.parameters import FormationParameters
from swarmtrack.formation.setpoint import Setpoint, Why
from swarmtrack.guard import SETPOINT_DEAD_S, SETPOINT_STALE_S
from swarmtrack.lab.autopilots.firmware import ARDUCOPTER, PX4_FIRMWARE, FlightMode
from swarmtrack.runtime.formation_pilot import FormationPilot
from swarmtrack.runtime.guard_process import GuardProcess

PLACE = FormationParameters(
    drone_id=2, leader=1, slots={1: (0.0, 0.0, 0.0), 2: (-4.0, 3.0, -1.0)}, references=(1,), height=5.0
)
VELOCITY, YAW_RATE = (1.0, -0.5, 0.25), 0.3


class Sky:
    """In place of a pilot: the mode and the rest are what a test says."""

    def __init__(self, firmware):
        self.firmware, self.armed, self.due = firmware, True, math.inf
        self.status, self.landed = common.MAV_STATE_ACTIVE, common.MAV_LANDED_STATE_IN_AIR
        self.to(FlightMode.HOLD)

    def to(self, mode):
        self.mode = self.firmware.modes[mode]

    @property
    def intended(self):
        return self.mode

    def poll(self, now): ...

    def command(self, command, now):
        return None

    def steer(self, message, now): ...

    def set_mode(self, custom, now):
        raise AssertionError("nobody may change the mode")

    def take_texts(self):
        return []


class Flown:
    """A simulated autopilot that keeps what came, by pymavlink, with when."""

    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self.pilot = Sky(self.firmware)
        self.heard = []

    def understand(self, message, now, channel):
        self.heard.append((now, message))
        super().understand(message, now, channel)

    def setpoints(self, since=-math.inf):
        return [
            (t, message)
            for t, message in self.heard
            if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED" and t > since
        ]


class FlownArduPilot(Flown, FakeAutopilot):
    """An ArduCopter."""


class FlownPx4(Flown, FakePx4):
    """A PX4."""


class ScriptedDoor:
    """Decides what a test says."""

    def __init__(self):
        self.velocity, self.why, self.asked, self.nearest = VELOCITY, Why.FOLLOW, [], None

    def command(self, now, engagement):
        self.asked.append((now, engagement))
        return LocalSetpoint(
            self.velocity,
            YAW_RATE,
            Setpoint(now, self.velocity, YAW_RATE, self.why, "words", nearest=self.nearest),
            room=8.0,
        )


class Notices:
    def __init__(self):
        self.said = []

    def add(self, severity, text):
        self.said.append(text)


class Companion:
    """A formation pilot on a simulated link, stepped by hand."""

    def __init__(self, autopilot, **options):
        self.autopilot, self.engagement = autopilot, PilotEngagement()
        self.flight = Flight(autopilot, engagement=self.engagement, **options)
        self.door, self.notices = ScriptedDoor(), Notices()
        self.guard = InlineGuard(PLACE.limits, self.flight)
        self.pilot = FormationPilot(
            self.door, self.flight.unit, self.engagement, self.guard, self.notices,
            clock=self.flight.clock, parameters=PLACE,
        )  # fmt: skip

    async def __aenter__(self):
        await self.flight.__aenter__()
        self.guard.start()
        self.fly(3.0)
        return self

    async def __aexit__(self, *error):
        await self.flight.__aexit__(*error)

    def fly(self, seconds, *, decides=True):
        for _ in range(round(seconds * 10.0)):
            if decides:
                self.pilot.decide(self.flight.clock.now())
            for _ in range(4):
                self.flight.fly(0.025)
                self.guard.tick()

    def to(self, mode):
        """And a heartbeat says it at once, as autopilots do."""
        self.autopilot.pilot.to(mode)
        self.flight.fly(0.002)

    @property
    def now(self):
        return self.flight.clock.now()

    def since(self, t):
        return self.autopilot.setpoints(t)


async def test_while_engaged_ten_setpoints_per_second_go_to_the_autopilot_with_nothing_but_velocity_and_yaw_rate():
    async with Companion(FlownArduPilot()) as companion:
        assert companion.autopilot.setpoints() == []
        companion.to(FlightMode.GUIDED)
        begun = companion.now
        companion.fly(2.0)
        sent = companion.since(begun)
        assert len(sent) == pytest.approx(20, abs=1)
        message = sent[-1][1]
        assert (message.vx, message.vy, message.vz) == VELOCITY
        assert message.yaw_rate == pytest.approx(YAW_RATE)
        assert message.type_mask == 0b010111000111
        assert message.coordinate_frame == common.MAV_FRAME_LOCAL_NED
        assert (message.target_system, message.target_component) == (1, 1)
        assert "formation engaged" in companion.notices.said
        assert "in formation" in companion.notices.said
        assert companion.pilot.status().ok


async def test_nothing_else_is_ever_sent_but_setpoints():
    """It never arms, takes off, lands, changes modes or parameters."""
    async with Companion(FlownArduPilot()) as companion:
        companion.to(FlightMode.GUIDED)
        companion.fly(3.0)
        companion.to(FlightMode.HOLD)
        companion.fly(1.0)
        kinds = {message.get_type() for _, message in companion.autopilot.heard}
        commands = {
            message.command
            for _, message in companion.autopilot.heard
            if message.get_type() == "COMMAND_LONG"
        }
        assert kinds <= {
            "HEARTBEAT", "COMMAND_LONG", "TIMESYNC", "PARAM_REQUEST_READ", "SET_POSITION_TARGET_LOCAL_NED",
        }  # fmt: skip
        assert commands <= {common.MAV_CMD_SET_MESSAGE_INTERVAL, common.MAV_CMD_REQUEST_MESSAGE}


async def test_leaving_the_mode_ends_it_at_once_and_for_good_until_it_is_engaged_anew():
    async with Companion(FlownArduPilot()) as companion:
        companion.to(FlightMode.GUIDED)
        companion.fly(1.0)
        companion.to(FlightMode.HOLD)
        left = companion.now
        companion.fly(2.0)
        assert companion.since(left) == []
        assert companion.notices.said[-1] == "formation released: mode is LOITER now"
        companion.to(FlightMode.GUIDED)
        again = companion.now
        companion.fly(1.0)
        assert len(companion.since(again)) >= 9
        assert [engagement.number for _, engagement in companion.door.asked][-1] == 2


async def test_an_agent_that_finds_the_mode_on_does_not_fly():
    autopilot = FlownArduPilot()
    autopilot.pilot.to(FlightMode.GUIDED)
    async with Companion(autopilot) as companion:
        companion.fly(2.0)
        assert autopilot.setpoints() == []
        assert "leave the mode" in companion.pilot.status().text


async def test_an_old_decision_is_zero_velocity_and_a_dead_one_hands_back_with_a_zero():
    async with Companion(FlownArduPilot()) as companion:
        companion.to(FlightMode.GUIDED)
        companion.fly(1.0)
        decided = companion.door.asked[-1][0]
        companion.fly(3.0, decides=False)
        ages = [(t - decided, message) for t, message in companion.since(decided + 1e-6)]
        fresh = [message.vx for age, message in ages if age < SETPOINT_STALE_S - 0.02]
        stale = [message.vx for age, message in ages if age > SETPOINT_STALE_S + 0.05]
        assert set(fresh) == {1.0}
        assert set(stale) == {0.0}
        assert all(message.yaw_rate == 0.0 for age, message in ages if age > SETPOINT_STALE_S + 0.05)
        assert max(age for age, _ in ages) == pytest.approx(SETPOINT_DEAD_S, abs=0.2)
        companion.fly(0.1)
        assert companion.notices.said[-1].startswith("formation released: the agent stalled for 3")
        # And for good: that decisions come again does not engage it.
        companion.fly(1.0)
        assert companion.since(decided + SETPOINT_DEAD_S + 0.2) == []
        assert dict(companion.pilot.status().counters)["stale"] >= 4.0


async def test_what_the_law_must_not_say_slows_the_drone_down_and_ends_the_engagement():
    async with Companion(FlownArduPilot()) as companion:
        companion.to(FlightMode.GUIDED)
        companion.fly(1.0)
        companion.door.velocity = (50.0, 0.0, 0.0)
        wrong = companion.now
        companion.fly(3.0)
        sent = [math.hypot(m.vx, m.vy, m.vz) for _, m in companion.since(wrong + 0.001)]
        assert max(sent) <= math.hypot(*VELOCITY)
        assert all(later <= sooner for sooner, later in itertools.pairwise(sent))
        assert sent[-1] == 0.0
        assert companion.since(wrong + 1.3) == []
        assert companion.notices.said[-1] == "formation released: refused: speed 50, at most 2.5"
        assert not companion.engagement.engaged


async def test_a_guard_that_dies_is_said_and_nobody_is_flown_until_one_is_started_on_the_ground():
    async with Companion(FlownArduPilot()) as companion:
        companion.to(FlightMode.GUIDED)
        companion.fly(1.0)
        companion.guard.die()
        dead = companion.now
        companion.fly(1.0)
        companion.to(FlightMode.HOLD)
        companion.fly(0.5)
        companion.to(FlightMode.GUIDED)
        companion.fly(1.0)
        assert companion.since(dead) == []
        assert "formation released: the guard has died" in companion.notices.said
        assert not companion.pilot.status().ok
        assert companion.guard.starts == 1
        companion.autopilot.pilot.armed = False
        companion.fly(1.5)
        assert companion.guard.starts == 2
        assert companion.pilot.status().ok


async def test_a_guard_that_stands_still_is_noticed_and_says_nothing_when_it_goes_on():
    async with Companion(FlownArduPilot()) as companion:
        companion.to(FlightMode.GUIDED)
        companion.fly(1.0)
        companion.guard.frozen = True
        frozen = companion.now
        companion.fly(2.0)
        assert companion.notices.said[-1] == "formation released: the guard sends nothing"
        assert not companion.engagement.engaged
        companion.guard.frozen = False
        companion.fly(2.0)
        assert companion.since(frozen) == []


async def test_a_decision_of_an_earlier_engagement_is_not_flown_in_the_next():
    async with Companion(FlownArduPilot()) as companion:
        companion.to(FlightMode.GUIDED)
        companion.fly(1.0)
        companion.to(FlightMode.HOLD)
        companion.fly(0.2)
        companion.to(FlightMode.GUIDED)
        begun = companion.now
        companion.fly(0.2, decides=False)
        assert companion.since(begun) == []


async def test_an_autopilot_that_falls_silent_or_reboots_ends_it():
    async with Companion(FlownArduPilot()) as companion:
        companion.to(FlightMode.GUIDED)
        companion.fly(1.0)
        companion.autopilot.mute = True
        companion.fly(5.0)
        companion.autopilot.mute = False
        back = companion.now
        companion.fly(3.0)
        assert companion.since(back) == []
        companion.to(FlightMode.HOLD)
        companion.fly(0.5)
        companion.to(FlightMode.GUIDED)
        companion.fly(0.5)
        assert companion.since(back)
        companion.pilot.on_reboot()
        rebooted = companion.now
        companion.fly(1.0)
        assert companion.since(rebooted) == []


async def test_holds_are_said_once_they_last_and_that_it_goes_on():
    async with Companion(FlownArduPilot()) as companion:
        companion.to(FlightMode.GUIDED)
        companion.fly(1.0)
        companion.door.why = Why.FADE
        companion.fly(0.3)
        companion.door.why = Why.FOLLOW
        companion.fly(1.0)
        assert not any("holds" in text for text in companion.notices.said)
        companion.door.why = Why.NO_REFERENCE
        companion.fly(2.0)
        assert not companion.pilot.status().ok
        companion.door.why = Why.FOLLOW
        companion.fly(1.0)
        assert companion.notices.said == [
            "formation engaged", "in formation", "formation holds: words", "in formation",
        ]  # fmt: skip
        counters = dict(companion.pilot.status().counters)
        assert (counters["holds"], counters["engaged"], counters["leader"]) == (1.0, 1.0, 1.0)
        assert (counters["slot_north_m"], counters["slot_east_m"]) == (-4.0, 3.0)
        companion.to(FlightMode.HOLD)
        companion.fly(0.5)
        assert dict(companion.pilot.status().counters)["engaged"] == 0.0


async def test_the_pilot_hears_of_whoever_is_nearer_than_one_and_a_half_times_the_clearance_once():
    async with Companion(FlownArduPilot()) as companion:
        companion.to(FlightMode.GUIDED)
        companion.door.nearest = 2.3
        companion.fly(1.0)
        assert not any("away" in text for text in companion.notices.said)
        companion.door.nearest = 2.2
        companion.fly(3.0)
        companion.door.nearest = None
        companion.fly(6.0)
        companion.door.nearest = 1.0
        companion.fly(1.0)
        heard = [text for text in companion.notices.said if "away" in text]
        assert heard == ["formation: another drone 2.2 m away", "formation: another drone 1.0 m away"]


async def test_what_may_drift_while_it_holds_asks_the_pilot_to_take_over():
    async with Companion(FlownArduPilot()) as companion:
        companion.to(FlightMode.GUIDED)
        companion.door.why = Why.HEIGHT_DOUBT
        companion.fly(2.0)
        assert companion.notices.said[-1] == "formation holds: words: take over"


async def test_px4_gets_zeros_before_it_is_engaged_and_velocities_after():
    async with Companion(FlownPx4()) as companion:
        companion.fly(1.0)
        before = companion.since(companion.now - 1.0)
        assert len(before) >= 9
        assert {(message.vx, message.vy, message.vz, message.yaw_rate) for _, message in before} == {
            (0, 0, 0, 0)
        }
        companion.to(FlightMode.GUIDED)
        companion.fly(0.3)
        assert companion.autopilot.setpoints()[-1][1].vx == 1.0


async def test_an_agent_that_stops_leaves_a_zero_behind():
    async with Companion(FlownArduPilot()) as companion:
        companion.to(FlightMode.GUIDED)
        companion.fly(1.0)
        companion.pilot.stop()
        companion.flight.fly(0.01)
        assert companion.autopilot.setpoints()[-1][1].vx == 0.0
        stopped = companion.now
        companion.fly(1.0)
        assert companion.since(stopped) == []


async def test_setpoints_are_signed_where_the_link_is(tmp_path):
    key = tmp_path / "key"
    key.write_bytes(bytes(range(32)))
    key.chmod(0o600)
    autopilot = FlownArduPilot(key=bytes(range(32)))
    companion = Companion(autopilot, signing_key=key)
    # Signing counts in wall time.
    companion.flight.clock.utc = SystemClock().utc
    async with companion:
        companion.to(FlightMode.GUIDED)
        companion.fly(1.0)
        sent = autopilot.setpoints()
        assert len(sent) >= 9
        assert all(message.get_signed() for _, message in sent)


async def test_over_real_udp_it_flies_and_stops_within_a_tenth_of_a_second_of_the_mode_s_end():
    port = free_port()
    autopilot = FlownArduPilot(boot_at=time.monotonic() - 40.0)
    engagement, door, notices = PilotEngagement(), ScriptedDoor(), Notices()
    link = RealFlight(f"udpin:127.0.0.1:{port}", engagement=engagement)
    async with serve_udp(autopilot, "127.0.0.1", port), link:
        guard = GuardProcess(PLACE.limits, None)
        pilot = FormationPilot(
            door, link.unit, engagement, guard, notices, clock=SystemClock(), parameters=PLACE
        )
        task = asyncio.create_task(pilot.run())
        await link.until(lambda: engagement.stage is EngagementStage.AWAY)
        autopilot.pilot.to(FlightMode.GUIDED)
        await link.until(lambda: len(autopilot.setpoints()) >= 10)
        assert autopilot.setpoints()[-1][1].vx == 1.0
        autopilot.pilot.to(FlightMode.HOLD)
        await link.until(lambda: not engagement.engaged)
        left = time.monotonic()
        await asyncio.sleep(0.5)
        assert autopilot.setpoints(left + 0.1) == []
        autopilot.pilot.to(FlightMode.GUIDED)
        again = time.monotonic()
        await link.until(lambda: len(autopilot.setpoints(again)) >= 2)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        await link.until(lambda: autopilot.setpoints()[-1][1].vx == 0.0)


def test_the_modes_that_engage_are_those_of_the_firmwares():
    assert ARDUCOPTER.modes[FlightMode.GUIDED].custom == 4
    assert PX4_FIRMWARE.modes[FlightMode.GUIDED].custom == 6 << 16
