"""What goes wrong in `swarmtrack bench formation` truly goes wrong there, as it is told."""

import itertools

import numpy as np
import pytest

from swarmtrack.benchmarks.formation.benchmark import FAULTS, FLIGHTS
from swarmtrack.benchmarks.formation.faults import (
    BOOTS_S,
    CLOCK_OFF_S,
    GLITCH_M,
    RETURN_HEIGHT_M,
    FailingSwarm,
    Failure,
    Fault,
)
from swarmtrack.benchmarks.formation.flights import FlightPlan, FormationFlight
from swarmtrack.benchmarks.virtual_swarm import Exposure
from swarmtrack.formation.setpoint import Why
from swarmtrack.messages import AutopilotRebooted, EgoPose, MotionReport, PeerArrived, PeerDeparted


class Told(FormationFlight):
    """A pair, of which the follower is drone 2; `heard` is what each was told, with the time."""

    def __init__(self, fault, victim, ends_s=8.0, begins_s=5.0, lasts_s=1.0, speed_m_s=0.0):
        failure = Failure(
            fault=fault, victim=victim, begins_s=begins_s, ends_s=5.0 + lasts_s, speed_m_s=speed_m_s
        )
        super().__init__(FlightPlan(name="pair", drones=2, ends_s=ends_s, failure=failure), seed=4)
        self.now = 0.0
        self.heard = {drone: [] for drone in (1, 2)}
        for drone, heard in self.heard.items():
            self._listen(self.onboard(drone), heard)

    def _listen(self, onboard, heard):
        tell = onboard.tell

        def told(event):
            heard.append((self.now, event))
            tell(event)

        onboard.tell = told

    def _also(self, drone_id, now):
        self.now = now
        super()._also(drone_id, now)

    def times(self, drone, kind):
        return np.array([t for t, event in self.heard[drone] if isinstance(event, kind)])


def test_each_fault_has_a_row():
    assert {failure.fault for _, failure in FAULTS} == set(Fault)
    assert all(FLIGHTS[name].failure is failure for name, failure in FAULTS)
    assert all(FLIGHTS[name].ends_s > failure.begins_s + 10.0 for name, failure in FAULTS)


@pytest.mark.parametrize("fault", [Fault.KILLED, Fault.CLOCK, Fault.STUCK_CAMERA])
def test_a_swarm_fails_by_what_it_was_made_with_and_nothing_else_has_to_be_called(fault):
    plan = FlightPlan(name="pair", drones=2)
    swarm = FailingSwarm(FormationFlight(plan, seed=4).scenario, Failure(fault=fault, victim=2, begins_s=0.5))
    for _ in swarm.fly(1.0):
        pass
    swarm.fail(1.0)
    assert swarm._runs(2, 1.0) == (fault is not Fault.KILLED)


def test_a_swapped_id_is_a_swapped_start():
    flight = Told(Fault.SWAPPED, 2)
    says = {drone: start.position_m for drone, start in flight.scenario.announced.items()}
    for drone, other in itertools.permutations((1, 2)):
        assert np.linalg.norm(says[drone] - flight.scenario.world.flown(other).position(0.0)) < 2.0


def test_a_stuck_camera_shows_the_same_picture_with_new_stamps_and_its_drone_holds():
    flight = Told(Fault.STUCK_CAMERA, 2, lasts_s=2.5)
    frames = [flight._eyes(Exposure(2, k, k / 7.0, k / 7.0, flight.onboard(2))) for k in range(int(7 * 8.0))]
    same = [
        len(b) > 0 and a.centre.shape == b.centre.shape and (a.centre == b.centre).all()
        for a, b in itertools.pairwise(frames)
    ]
    assert [k for k, is_same in enumerate(same) if is_same] == list(range(34, 52))
    assert len({frame.t for frame in frames}) == len(frames)
    whys = [(sample.t, sample.whys[0]) for sample in Told(Fault.STUCK_CAMERA, 2, lasts_s=2.5).run()]
    assert any(why is Why.CAMERA for t, why in whys if 6.3 < t < 7.5)


def test_an_agent_that_is_killed_says_and_hears_nothing_and_is_missed():
    flight = Told(Fault.KILLED, 2, ends_s=9.0, lasts_s=100.0)
    flight.run()
    assert 4.5 < flight.times(1, MotionReport).max() <= 5.1
    assert flight.times(2, (MotionReport, EgoPose)).max() <= 5.1
    assert flight.times(1, PeerDeparted) == pytest.approx([7.0], abs=0.11)


def test_in_a_partition_nobody_hears_anybody_and_then_they_meet_again():
    flight = Told(Fault.PARTITION, 1, ends_s=10.0, lasts_s=3.0)
    flight.run()
    for drone in (1, 2):
        heard = flight.times(drone, MotionReport)
        assert not ((heard > 5.1) & (heard < 8.0)).any()
        assert (heard > 8.0).any()
        assert flight.times(drone, PeerDeparted) == pytest.approx([7.0], abs=0.11)
        assert flight.times(drone, PeerArrived).max() >= 7.9


@pytest.mark.long(
    "27 s of flight; test_onboard.py and runtime/test_formation_pilot.py have reboots in the default run"
)
def test_an_autopilot_that_reboots_is_silent_and_its_drone_is_not_flown_until_it_is_engaged_again():
    flight = Told(Fault.REBOOT, 2, ends_s=22.0, lasts_s=100.0)
    whys = {round(sample.t, 1): sample.whys[0] for sample in flight.run()}
    poses = flight.times(2, EgoPose)
    assert not ((poses > 5.1) & (poses < 5.0 + BOOTS_S - 0.1)).any()
    assert (poses > 5.0 + BOOTS_S).any()
    assert len(flight.times(2, AutopilotRebooted)) == 1
    assert whys[4.5] is not Why.NOT_ENGAGED
    assert {whys[t] for t in (6.0, 12.0, 18.0)} == {Why.NOT_ENGAGED}
    assert whys[21.0] is not Why.NOT_ENGAGED


@pytest.mark.long("20 s of flight; formation/test_heights.py has drifting heights in the default run")
def test_a_drift_of_the_height_is_believed_and_flown_down_and_the_other_is_honest():
    flight = Told(Fault.HEIGHT_DRIFT, 2, ends_s=15.0, lasts_s=100.0, speed_m_s=0.3)
    samples = {round(sample.t, 1): sample for sample in flight.run()}
    sunk = samples[14.0].positions[:, 2] - samples[5.0].positions[:, 2]
    assert sunk == pytest.approx([0.0, 2.7], abs=0.4)
    poses = [event for _, event in flight.heard[2] if isinstance(event, EgoPose)]
    believed = {round(pose.t, 1): pose.position[2] for pose in poses}
    assert believed[14.0] - believed[5.0] == pytest.approx(0.0, abs=0.4)
    assert flight.height_drift(2, 14.0) == pytest.approx(2.7)
    assert flight.height_drift(1, 14.0) == flight.height_drift(2, 4.0) == 0.0


@pytest.mark.long(
    "17 s of flight; formation/test_divergence.py and test_formation.py push drones in the default run"
)
def test_a_push_is_flown_beside_what_is_told_and_its_drone_notices_and_holds():
    flight = Told(Fault.PUSHED, 2, ends_s=12.0, lasts_s=100.0, speed_m_s=1.0)
    samples = {round(sample.t, 1): sample for sample in flight.run()}
    assert samples[5.0].whys[0] is not Why.DIVERGES
    assert samples[11.0].whys == (Why.DIVERGES,)
    moved = samples[11.5].positions[1] - samples[10.5].positions[1]
    assert np.linalg.norm(moved[:2]) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("victim", [2, pytest.param(1, marks=pytest.mark.long("the leader's clock, too"))])
def test_a_clock_that_is_hours_off_costs_the_time_on_the_way_and_no_more(victim):
    flight = Told(Fault.CLOCK, victim, begins_s=-np.inf, ends_s=4.0, lasts_s=np.inf)
    flight.run()
    for drone in (1, 2):
        said = [(t, event) for t, event in flight.heard[drone] if isinstance(event, MotionReport)]
        assert len(said) > 10
        # By the pace of the reports: they are of the middle of the last 0.3 s.
        assert all(-0.2 < t - event.t < 1.0 for t, event in said)
        assert all(event.t_sigma >= 0.2 for _, event in said)
    assert CLOCK_OFF_S == 7200.0


@pytest.mark.long("22 s of flight; test_follower.py has leaps in the default run")
def test_a_glitch_is_a_leap_of_the_own_place_and_back_and_its_drone_follows_on():
    # The filter resists for ten seconds, and for ten more after its end.
    flight = Told(Fault.GLITCH, 2, begins_s=-5.0, lasts_s=0.5, ends_s=17.0)
    whys = [sample.whys[0] for sample in flight.run() if sample.t > 4.5]
    assert set(whys) == {Why.FOLLOW}
    poses = [event for _, event in flight.heard[2] if isinstance(event, EgoPose)]
    leaps = [
        (b.t, np.linalg.norm(b.position - a.position))
        for a, b in itertools.pairwise(poses)
        if np.linalg.norm(b.position - a.position) > 1.0
    ]
    assert [t for t, _ in leaps] == pytest.approx([5.0, 15.5], abs=0.021)
    assert [way for _, way in leaps] == pytest.approx([GLITCH_M] * 2, abs=0.2)


def test_a_glitch_that_is_shorter_than_a_filter_resists_changes_nothing():
    flight = Told(Fault.GLITCH, 2, begins_s=-5.0, lasts_s=-2.0, ends_s=7.0)
    flight.run()
    places = np.array([event.position for _, event in flight.heard[2] if isinstance(event, EgoPose)])
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() < 0.2


def test_a_drone_that_is_denied_has_no_position_from_then_on_and_attitudes():
    flight = Told(Fault.DENIED, 1, begins_s=0.5, ends_s=1.5)
    flight.run()
    poses = [event for _, event in flight.heard[1] if isinstance(event, EgoPose)]
    assert {pose.position is None for pose in poses if pose.t < 0.5} == {False}
    assert {pose.position is None for pose in poses if pose.t >= 0.5} == {True}


@pytest.mark.long("35 s of flight; runtime/test_px4_failsafe.py has failsafes in the default run")
def test_a_failsafe_takes_a_follower_up_and_home_and_it_is_engaged_no_more():
    flight = Told(Fault.RETURNS, 2, ends_s=30.0, lasts_s=100.0)
    samples = flight.run()
    heights = [-sample.positions[1, 2] for sample in samples]
    assert max(heights) == pytest.approx(RETURN_HEIGHT_M, abs=1.0)
    assert heights[-1] == pytest.approx(0.0, abs=0.1)
    assert {sample.whys[0] for sample in samples if sample.t > 5.2} == {Why.NOT_ENGAGED}


def test_who_has_no_position_tells_none_and_lands_where_it_is():
    flight = Told(Fault.LANDS, 2, ends_s=22.0, lasts_s=100.0)
    flight.run()
    poses = [event for _, event in flight.heard[2] if isinstance(event, EgoPose)]
    assert {pose.position is None for pose in poses if pose.t >= 5.0} == {True}
    assert {pose.position is None for pose in poses if pose.t < 5.0} == {False}
    drone = flight.scenario.world.flown(2)
    before, after = drone.position(5.0), drone.position(21.0)
    assert np.linalg.norm((after - before)[:2]) < 1.5
    # Down by half a metre per second.
    assert after[2] == pytest.approx(min(before[2] + 0.5 * 16.0, 0.0), abs=1.5)
    assert {sample.whys[0] for sample in flight.samples if sample.t > 6.0} == {Why.NOT_ENGAGED}
    assert flight.times(1, MotionReport).max() < 6.0, (
        "who does not know where it is does not say how it moves"
    )
