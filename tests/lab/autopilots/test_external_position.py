"""A simulated estimator goes by ODOMETRY where a real one would."""

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.odometry import no_odometry, odometry
from swarmtrack.lab.autopilots.autopilot import SimulatedArduPilot
from swarmtrack.lab.autopilots.external_position import EXTERNAL_LASTS_S
from swarmtrack.lab.autopilots.px4 import SimulatedPx4
from swarmtrack.lab.autopilots.senses import DroneSenses
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.motion.ego import AutopilotPlace

ARDUPILOT, PX4 = common.MAV_AUTOPILOT_ARDUPILOTMEGA, common.MAV_AUTOPILOT_PX4
KINDS = {ARDUPILOT: SimulatedArduPilot, PX4: SimulatedPx4}
SET_UP = {"VISO_TYPE": 1, "EK3_SRC2_POSXY": 6, "EKF2_EV_CTRL": 1}
OFF = np.array([0.4, -0.2, 0.1])
EYE = np.eye(3)


class Lost:
    """A drone in the air whose receiver finds nothing from second 10 on, told where it is, by OFF wrong."""

    def __init__(self, kind, **parameters):
        scenario = load_scenario("gps-denied", seed=1)
        self.world = scenario.world
        self.senses = DroneSenses(scenario.world, 1, 0.0, earth=scenario.origin)
        self.kind, self.vehicle = kind, KINDS[kind](self.senses, boot_at=-60.0)
        self.vehicle.parameters.values.update(SET_UP | parameters)
        self.senses.position_lost = True
        if kind == ARDUPILOT:
            self.vehicle.select_source_set(2)

    def own(self, t):
        """Where the estimator would be without any error."""
        return self.senses._ego.estimate(self.world.flown(1).motion(t), t, np.zeros((2, 3)))[0]

    def feed(self, begin, seconds, change=lambda m: None, sigma=0.2, resets=0):
        for t in np.arange(begin, begin + seconds, 0.05):
            place = AutopilotPlace(
                t + 500.0, self.own(t) + OFF, sigma**2 * EYE, np.zeros(3), EYE, EYE, EYE, t + 500.0, (2,)
            )  # fmt: skip
            m = odometry(place, kind=self.kind, origin=np.zeros(3), quality=80, resets=resets)
            change(m)
            self.vehicle.receive(m.pack(common.MAVLink(None, 1, 191)), t)

    def off(self, t):
        position = self.senses.at(t).position
        return None if position is None else position - self.own(t)


@pytest.fixture(params=KINDS)
def lost(request):
    return Lost(request.param)


def test_without_a_fed_place_it_has_no_position(lost):
    assert lost.off(10.0) is None
    assert not lost.senses.is_located(10.0)


def test_its_position_follows_the_fed_place(lost):
    lost.feed(10.0, 3.0)
    assert lost.senses.is_located(13.0)
    assert lost.senses.at(13.0).gps is None
    # The white noise of its own estimate is beside that.
    assert lost.off(13.0) == pytest.approx(OFF, abs=0.1)
    assert lost.off(13.0 + EXTERNAL_LASTS_S + 0.1) is None


def test_it_filters_what_it_is_fed_and_follows_a_step_only_where_it_is_told_of_one(lost):
    lost.feed(10.0, 3.0)
    off = 5.0

    def step(m):
        m.x += off

    lost.feed(13.0, 0.05, step)
    assert 0.0 < lost.off(13.0)[0] - OFF[0] < 0.6 * off
    lost.feed(13.05, 0.05, step, resets=1)
    assert lost.off(13.05)[0] == pytest.approx(OFF[0] + off, abs=0.1)


def test_with_a_fix_it_goes_by_its_receiver(lost):
    lost.senses.position_lost = False
    if lost.kind == ARDUPILOT:
        lost.vehicle.select_source_set(1)
    lost.feed(10.0, 3.0)
    assert lost.off(13.0) == pytest.approx(np.zeros(3), abs=0.1)


@pytest.mark.parametrize("kind", KINDS)
def test_that_there_is_no_place_moves_nothing(kind):
    lost = Lost(kind)
    for t in np.arange(10.0, 12.0, 0.1):
        lost.vehicle.receive(no_odometry(t, resets=0).pack(common.MAVLink(None, 1, 191)), t)
    assert lost.off(12.0) is None


@pytest.mark.parametrize(
    ("kind", "parameters"),
    [
        (ARDUPILOT, {"VISO_TYPE": 0}),
        (ARDUPILOT, {"EK3_SRC2_POSXY": 0}),
        (ARDUPILOT, {"VISO_QUAL_MIN": 90}),
        (PX4, {"EKF2_EV_CTRL": 0}),
        (PX4, {"EKF2_EV_CTRL": 14}),
    ],
)
def test_its_parameters_have_to_let_it(kind, parameters):
    lost = Lost(kind, **parameters)
    lost.feed(10.0, 2.0)
    assert lost.off(12.0) is None


@pytest.mark.parametrize("frame", ["frame_id", "child_frame_id"])
def test_ardupilot_drops_all_other_frames_without_a_word(frame):
    lost = Lost(ARDUPILOT)
    lost.feed(10.0, 2.0, lambda m: setattr(m, frame, common.MAV_FRAME_LOCAL_NED))
    assert lost.off(12.0) is None


def test_of_an_ardupilot_the_set_that_its_pilot_has_selected_counts():
    lost = Lost(ARDUPILOT)
    lost.vehicle.select_source_set(1)
    lost.feed(10.0, 2.0)
    assert lost.off(12.0) is None
