"""Who engages, and what ends it: heartbeats, silence, failures."""

import itertools

import pytest
from pymavlink.dialects.v20 import common

from swarmtrack.sensors.mavlink.engagement import (
    SILENT_S,
    TRANSITIONS,
    EngagementEvent,
    EngagementStage,
    PilotEngagement,
)

ARDU, PX4 = common.MAV_AUTOPILOT_ARDUPILOTMEGA, common.MAV_AUTOPILOT_PX4
GUIDED, LOITER, OFFBOARD, HOLD = 4, 5, 6 << 16, 4 << 16 | 3 << 24
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
    assert not pilot.to(off)
    assert pilot.to(on)
    assert pilot.to(on)
    assert pilot.engagement.number == 1
    assert not pilot.to(off)
    assert pilot.engagement.take_end() == "the pilot left the mode"
    assert pilot.engagement.take_end() == ""
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
    pilot.engagement.tick(pilot.t + SILENT_S - 0.1)
    assert pilot.engagement.engaged
    pilot.engagement.tick(pilot.t + SILENT_S + 0.1)
    assert pilot.engagement.take_end() == "the autopilot is silent"
    pilot.t += 10.0
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


def test_every_pair_of_stage_and_event_ends_where_the_table_says():
    leads_to_engaged = {pair for pair, then in TRANSITIONS.items() if then is EngagementStage.ENGAGED}
    assert leads_to_engaged == {(EngagementStage.AWAY, EngagementEvent.ENTERED)}
    for stage, event in itertools.product(EngagementStage, EngagementEvent):
        engagement = PilotEngagement()
        engagement.stage = stage
        engagement._fire(event, "because")
        then = TRANSITIONS.get((stage, event), stage)
        assert engagement.stage is then
        ended = stage is EngagementStage.ENGAGED and then is not stage
        assert bool(engagement.take_end()) == ended
