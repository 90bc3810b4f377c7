"""Who engages, and what ends it: heartbeats, silence, failures."""

import itertools

import pytest
from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.engagement import (
    ENGAGEMENT_TRANSITIONS,
    EngagementEvent,
    EngagementStage,
    PilotEngagement,
)
from swarmtrack.autopilot.limits import ENGAGEMENT_SILENT_S
from swarmtrack.autopilot.pilot_switch import PilotSwitch
from swarmtrack.mavlink_dialect import CurrentMode

ARDU, PX4 = common.MAV_AUTOPILOT_ARDUPILOTMEGA, common.MAV_AUTOPILOT_PX4
GUIDED, LOITER, OFFBOARD, HOLD = 4, 5, 6 << 16, 4 << 16 | 3 << 24
POSITION, RTL = 3 << 16, 4 << 16 | 5 << 24
ARMED = common.MAV_MODE_FLAG_SAFETY_ARMED
CUSTOM = common.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED


def heartbeat(mode, *, armed=True, kind=ARDU, vehicle=common.MAV_TYPE_QUADROTOR, flags=CUSTOM):
    base = flags | (ARMED if armed else 0)
    return common.MAVLink_heartbeat_message(vehicle, kind, base, mode, common.MAV_STATE_ACTIVE, 3)


class Pilot:
    """Changes modes; a heartbeat each time."""

    def __init__(self, kind=ARDU):
        self.engagement, self.kind, self.t = PilotEngagement(), kind, 0.0

    def to(self, mode, *, airborne=True, **more):
        self.t += 0.5
        message = heartbeat(mode, kind=self.kind, **more)
        self.engagement.on_heartbeat(self.t, message, self.kind, airborne=airborne)
        return self.engagement.engaged


@pytest.mark.parametrize(("kind", "off", "on"), [(ARDU, LOITER, GUIDED), (PX4, HOLD, OFFBOARD)])
def test_a_pilot_engages_by_the_mode_and_leaves_by_any_other(kind, off, on):
    pilot = Pilot(kind)
    pilot.to(off, armed=False)
    assert not pilot.to(off)
    assert pilot.to(on)
    assert pilot.to(on)
    assert pilot.engagement.number == 1
    assert not pilot.to(off)
    assert pilot.engagement.take_end() == f"mode is {'LOITER' if kind == ARDU else 'HOLD'} now"
    assert pilot.engagement.take_end() == ""
    # A PX4 that does not tell its intention may have been made to leave by a failsafe that returns.
    pilot.to(off, armed=kind == ARDU)
    pilot.to(off)
    assert pilot.to(on)
    assert pilot.engagement.number == 2


def test_who_finds_the_mode_on_waits_until_the_pilot_comes_again():
    pilot = Pilot()
    assert not pilot.to(GUIDED)
    assert not pilot.to(GUIDED)
    assert not pilot.to(LOITER)
    assert pilot.to(GUIDED)


def test_nobody_is_flown_on_the_ground_or_disarmed():
    pilot = Pilot()
    pilot.to(LOITER)
    assert not pilot.to(GUIDED, armed=False)
    assert not pilot.to(GUIDED, airborne=False)
    # Taking off in GUIDED, as ArduCopter does it by command, is not for us to steer.
    assert not pilot.to(GUIDED)
    assert not pilot.to(LOITER)
    assert pilot.to(GUIDED)
    assert not pilot.to(GUIDED, armed=False)
    assert pilot.engagement.take_end() == "disarmed"


def test_a_take_off_in_the_mode_does_not_engage_however_fast_a_program_is():
    pilot = Pilot()
    pilot.to(LOITER, armed=False, airborne=False)
    # Armed, in GUIDED and off the ground within one heartbeat.
    assert not pilot.to(GUIDED)
    assert not pilot.to(GUIDED)
    assert not pilot.to(LOITER)
    assert pilot.to(GUIDED)


def test_landing_in_the_mode_ends_it():
    pilot = Pilot()
    pilot.to(LOITER)
    pilot.to(GUIDED)
    assert not pilot.to(GUIDED, airborne=False)
    assert pilot.engagement.take_end() == "on the ground"
    assert not pilot.to(GUIDED)


@pytest.mark.parametrize(
    "not_ours",
    [
        {"vehicle": common.MAV_TYPE_FIXED_WING},
        {"vehicle": common.MAV_TYPE_GROUND_ROVER},
        {"flags": 0},
    ],
)
def test_modes_of_other_vehicles_mean_nothing(not_ours):
    """Of a plane, mode 4 is ACRO."""
    pilot = Pilot()
    pilot.to(LOITER, **not_ours)
    assert not pilot.to(GUIDED, **not_ours)


def test_a_firmware_that_is_not_known_is_never_flown():
    pilot = Pilot(common.MAV_AUTOPILOT_GENERIC)
    pilot.to(0)
    assert not any(pilot.to(mode) for mode in (GUIDED, OFFBOARD))


def test_silence_ends_it_for_good_until_the_pilot_engages_anew():
    pilot = Pilot()
    pilot.to(LOITER)
    pilot.to(GUIDED)
    for k in range(24):
        pilot.engagement.tick(pilot.t + 0.1 * k)
    assert pilot.engagement.engaged
    pilot.engagement.tick(pilot.t + ENGAGEMENT_SILENT_S + 0.1)
    assert pilot.engagement.take_end() == "the autopilot is silent"
    assert not pilot.to(GUIDED)
    pilot.to(LOITER)
    assert pilot.to(GUIDED)


def test_a_failure_ends_it_for_good_until_the_pilot_engages_anew():
    pilot = Pilot()
    pilot.to(LOITER)
    pilot.to(GUIDED)
    pilot.engagement.fail("no decision")
    assert pilot.engagement.take_end() == "no decision"
    assert not pilot.to(GUIDED)
    pilot.to(LOITER)
    assert pilot.to(GUIDED)


def test_px4_is_let_into_the_mode_by_a_stream_and_ardupilot_needs_none():
    px4, ardupilot = Pilot(PX4), Pilot(ARDU)
    px4.to(HOLD, armed=False)
    px4.to(HOLD)
    ardupilot.to(LOITER)
    assert (px4.engagement.wants_stream, ardupilot.engagement.wants_stream) == (True, False)
    px4.to(HOLD, armed=False)
    assert not px4.engagement.wants_stream
    # After a failure nothing is sent, so that PX4 notices, and does what its pilot has told it to do then.
    px4.to(HOLD)
    px4.to(OFFBOARD)
    px4.engagement.fail("no decision")
    px4.to(OFFBOARD)
    assert not px4.engagement.wants_stream


class TellingPilot(Pilot):
    """Of a PX4 that tells what is intended, beside the mode that it is in."""

    def __init__(self, **options):
        super().__init__(PX4)
        self.engagement = PilotEngagement(**options)

    def to(self, mode, *, intended=None, **more):
        self.intend(mode if intended is None else intended)
        return super().to(mode, **more)

    def intend(self, mode):
        self.engagement.on_current_mode(self.t + 0.1, CurrentMode(0, 0, mode))


def test_a_mode_that_a_failsafe_left_is_not_left_until_the_intention_is():
    pilot = TellingPilot()
    pilot.to(HOLD)
    assert pilot.to(OFFBOARD)
    assert not pilot.to(POSITION, intended=OFFBOARD)
    assert not pilot.engagement.wants_stream
    # It goes back by itself.
    assert not pilot.to(OFFBOARD)
    assert not pilot.engagement.wants_stream
    pilot.to(POSITION)
    assert pilot.engagement.wants_stream
    assert pilot.to(OFFBOARD)


def test_an_agent_that_starts_in_a_failsafe_waits_for_the_intention_to_change():
    pilot = TellingPilot()
    pilot.to(POSITION, intended=OFFBOARD)
    assert not pilot.engagement.wants_stream
    assert not pilot.to(OFFBOARD)
    pilot.to(HOLD)
    assert pilot.to(OFFBOARD)


def test_a_px4_that_does_not_tell_its_intention_is_engaged_once_until_it_is_disarmed():
    pilot = Pilot(PX4)
    pilot.to(HOLD, armed=False, airborne=False)
    pilot.to(HOLD)
    assert pilot.to(OFFBOARD)
    pilot.to(POSITION)
    assert not pilot.engagement.wants_stream
    assert not pilot.to(OFFBOARD)
    pilot.to(HOLD, armed=False, airborne=False)
    pilot.to(HOLD)
    assert pilot.to(OFFBOARD)


def test_an_intention_that_is_not_told_is_none():
    pilot = Pilot(ARDU)
    pilot.engagement.on_current_mode(0.0, CurrentMode(0, LOITER, 0))
    pilot.to(LOITER)
    assert pilot.to(GUIDED)


@pytest.mark.parametrize("tick_first", [False, True])
def test_what_is_heard_after_the_agent_stood_still_engages_nobody(tick_first):
    pilot = TellingPilot()
    pilot.to(HOLD)
    pilot.to(OFFBOARD)
    pilot.engagement.tick(pilot.t)
    asleep = pilot.t
    if tick_first:
        pilot.engagement.tick(asleep + 8.0)
    pilot.to(OFFBOARD)
    pilot.t = asleep + 0.9
    for _ in range(6):
        pilot.to(POSITION, intended=OFFBOARD)
    pilot.engagement.tick(asleep + 8.0)
    assert pilot.engagement.take_end(asleep + 8.0) == "the agent stalled for 8.0 s"
    assert not pilot.engagement.wants_stream
    assert not pilot.to(OFFBOARD)


@pytest.mark.parametrize("kind", [ARDU, PX4])
def test_a_pilot_who_left_and_came_again_while_the_agent_stood_still_is_not_flown_when_it_wakes(kind):
    """Also where it looks at the clock first, and reads then what had waited."""
    off, on = (LOITER, GUIDED) if kind == ARDU else (HOLD, OFFBOARD)
    pilot = Pilot() if kind == ARDU else TellingPilot()
    pilot.to(off)
    pilot.to(on)
    pilot.engagement.tick(pilot.t)
    asleep = pilot.t
    pilot.engagement.tick(asleep + 8.0)
    assert not pilot.to(off)
    assert not pilot.to(on)
    # Over a serial line what had waited has no stamp of its own.
    pilot.t = asleep + 7.6
    assert not pilot.to(off)
    pilot.t -= 0.4
    assert not pilot.to(on)
    pilot.t += 1.0
    pilot.engagement.tick(pilot.t - 0.4)
    pilot.engagement.tick(pilot.t + 0.4)
    assert not pilot.to(off)
    assert pilot.to(on)


def test_after_a_failure_disarming_makes_up_for_no_intention():
    pilot = TellingPilot()
    pilot.to(HOLD)
    pilot.to(OFFBOARD)
    pilot.engagement.fail("no decision")
    pilot.to(POSITION, intended=OFFBOARD)
    # Its failsafe lands it. Whoever arms it again is sent no zeros that would take it into OFFBOARD.
    pilot.to(POSITION, intended=OFFBOARD, armed=False, airborne=False)
    pilot.to(POSITION, intended=OFFBOARD, airborne=False)
    assert not pilot.engagement.wants_stream
    pilot.to(POSITION, intended=OFFBOARD)
    assert not pilot.engagement.wants_stream
    assert not pilot.to(OFFBOARD)
    pilot.to(HOLD)
    assert pilot.engagement.wants_stream
    assert pilot.to(OFFBOARD)


def test_words_say_who_ended_it():
    pilot = TellingPilot()
    pilot.to(HOLD)
    pilot.to(OFFBOARD)
    # The heartbeat comes first; whose doing it is takes a moment to be known.
    pilot.t += 1.0
    pilot.engagement.on_heartbeat(pilot.t, heartbeat(HOLD, kind=PX4), PX4, airborne=True)
    assert pilot.engagement.take_end(pilot.t) == ""
    pilot.intend(HOLD)
    assert pilot.engagement.take_end(pilot.t + 0.2) == "the pilot left the mode"
    pilot.to(OFFBOARD)
    pilot.engagement.on_text(pilot.t, "Battery unhealthy Failsafe activated\x1b[2J")
    pilot.to(RTL, intended=OFFBOARD)
    assert (
        pilot.engagement.take_end(pilot.t + 1.0)
        == "mode is RTL now (Battery unhealthy Failsafe activated�[2J)"
    )
    ardupilot = Pilot()
    ardupilot.to(LOITER)
    ardupilot.to(GUIDED)
    ardupilot.to(6)
    assert ardupilot.engagement.take_end(ardupilot.t) == "mode is RTL now"


def channels(us):
    return common.MAVLink_rc_channels_message(0, 8, *[1500] * 6, us, *[1500] * 11, 255)


def test_where_a_switch_is_asked_for_mode_and_switch_engage_and_either_ends_it():
    switch = PilotSwitch(7, 1700.0)
    pilot = TellingPilot(switch=switch)

    def throw(us):
        pilot.engagement.on_channels(pilot.t, channels(us))
        return pilot.engagement.engaged

    throw(1100)
    pilot.to(HOLD)
    # A ground station's "fly here" changes the mode alone.
    throw(1100)
    assert not pilot.to(OFFBOARD)
    assert throw(1900)
    assert not throw(1100)
    assert pilot.engagement.take_end() == "the pilot's switch is off"
    assert throw(1900)
    pilot.engagement.tick(pilot.t + 2.1)
    assert not pilot.engagement.engaged
    assert pilot.engagement.take_end() == "no signal from the transmitter"


def test_a_switch_that_is_on_at_take_off_engages_nobody_without_the_mode():
    switch = PilotSwitch(7, 1700.0)
    pilot = TellingPilot(switch=switch)
    for mode in (HOLD, HOLD, OFFBOARD):
        pilot.engagement.on_channels(pilot.t, channels(1900))
        pilot.to(mode)
    assert pilot.engagement.engaged


def test_after_a_failure_the_switch_makes_up_for_no_intention():
    """Zeros would end the failsafe of a PX4 whose pilot has just thrown the switch off."""
    pilot = TellingPilot(switch=PilotSwitch(7, 1700.0))

    def to(mode, us, **more):
        pilot.engagement.on_channels(pilot.t, channels(us))
        return pilot.to(mode, **more)

    to(HOLD, 1900)
    assert to(OFFBOARD, 1900)
    pilot.engagement.fail("no decision")
    to(POSITION, 1900, intended=OFFBOARD)
    to(POSITION, 1100, intended=OFFBOARD)
    assert not pilot.engagement.wants_stream
    assert not to(OFFBOARD, 1900)
    to(HOLD, 1900)
    assert to(OFFBOARD, 1900)


def test_a_failsafe_while_the_switch_is_off_is_a_failure_too():
    pilot = TellingPilot(switch=PilotSwitch(7, 1700.0))
    pilot.to(HOLD)
    pilot.to(OFFBOARD)
    # It waits for the switch, and streams as long as that takes.
    assert pilot.engagement.wants_stream
    pilot.to(POSITION, intended=OFFBOARD)
    assert not pilot.engagement.wants_stream
    pilot.engagement.on_channels(pilot.t, channels(1900))
    assert not pilot.to(OFFBOARD)


def test_every_pair_of_stage_and_event_ends_where_the_table_says():
    leads_to_engaged = {
        pair for pair, then in ENGAGEMENT_TRANSITIONS.items() if then is EngagementStage.ENGAGED
    }
    assert leads_to_engaged == {(EngagementStage.AWAY, EngagementEvent.ENTERED)}
    for stage, event in itertools.product(EngagementStage, EngagementEvent):
        engagement = PilotEngagement()
        engagement.stage = stage
        engagement._fire(event, "because")
        then = ENGAGEMENT_TRANSITIONS.get((stage, event), stage)
        assert engagement.stage is then
        ended = stage is EngagementStage.ENGAGED and then is not stage
        assert bool(engagement.take_end()) == ended
