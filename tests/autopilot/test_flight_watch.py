"""Whether the drone flies, by what its autopilot says."""

import math

from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.flight import FlightWatch
from swarmtrack.autopilot.limits import LANDED_STATE_AGE_S
from swarmtrack.messages import FlightState

ARMED = common.MAV_MODE_FLAG_SAFETY_ARMED
ON_GROUND, IN_AIR = common.MAV_LANDED_STATE_ON_GROUND, common.MAV_LANDED_STATE_IN_AIR


def heartbeat(status, mode=ARMED):
    return common.MAVLink_heartbeat_message(
        common.MAV_TYPE_QUADROTOR, common.MAV_AUTOPILOT_ARDUPILOTMEGA, mode, 0, status, 3
    )


def landed(state):
    return common.MAVLink_extended_sys_state_message(common.MAV_VTOL_STATE_UNDEFINED, state)


def test_an_ardupilot_flies_from_its_first_active_heartbeat_until_it_stands_by():
    watch = FlightWatch()
    assert watch.on_heartbeat(1.0, heartbeat(common.MAV_STATE_STANDBY, 0)) == FlightState(1.0, None)
    assert watch.on_heartbeat(2.0, heartbeat(common.MAV_STATE_STANDBY)) == FlightState(2.0, None)
    assert watch.on_heartbeat(3.0, heartbeat(common.MAV_STATE_ACTIVE)) == FlightState(3.0, 3.0)
    assert watch.on_heartbeat(4.0, heartbeat(common.MAV_STATE_CRITICAL)) == FlightState(4.0, 3.0)
    assert watch.on_heartbeat(5.0, heartbeat(common.MAV_STATE_STANDBY)) == FlightState(5.0, None)
    assert watch.on_heartbeat(6.0, heartbeat(common.MAV_STATE_ACTIVE)) == FlightState(6.0, 6.0)


def test_one_that_flies_when_it_is_first_heard_has_done_so_for_longer_than_we_know():
    assert FlightWatch().on_heartbeat(1.0, heartbeat(common.MAV_STATE_ACTIVE)) == FlightState(1.0, -math.inf)


def test_a_px4_that_is_armed_on_the_ground_stands_there_by_its_landed_state():
    watch = FlightWatch()
    watch.on_landed_state(0.5, landed(ON_GROUND))
    assert watch.on_heartbeat(1.0, heartbeat(common.MAV_STATE_ACTIVE)) == FlightState(1.0, None)
    watch.on_landed_state(2.0, landed(common.MAV_LANDED_STATE_TAKEOFF))
    watch.on_landed_state(3.0, landed(IN_AIR))
    assert watch.on_heartbeat(3.5, heartbeat(common.MAV_STATE_ACTIVE)) == FlightState(3.5, 2.0)


def test_without_a_landed_state_that_means_something_the_heartbeat_counts():
    watch = FlightWatch()
    watch.on_landed_state(0.5, landed(common.MAV_LANDED_STATE_UNDEFINED))
    assert watch.on_heartbeat(1.0, heartbeat(common.MAV_STATE_STANDBY)) == FlightState(1.0, None)
    watch.on_landed_state(1.5, landed(ON_GROUND))
    later = 1.5 + LANDED_STATE_AGE_S + 0.1
    assert watch.on_heartbeat(later, heartbeat(common.MAV_STATE_ACTIVE)) == FlightState(later, later)
