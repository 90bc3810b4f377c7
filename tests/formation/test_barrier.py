import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from support.formation_states import Flying, in_slot, parameters, state, track
from swarmtrack.formation.barrier import HalfSpace, binding, keep_clear, nearest_velocity, sidestep
from swarmtrack.formation.formation import Formation
from swarmtrack.messages import TrackStatus

NORTH = (1.0, 0.0, 0.0)
number = st.floats(-3.0, 3.0)
vector = st.tuples(number, number, number)


def directed(v):
    length = float(np.linalg.norm(v))
    return tuple((np.array(v) / length).tolist()) if length > 0.1 else NORTH


@given(vector, st.lists(st.tuples(vector, st.floats(0.0, 2.0)), max_size=4))
@settings(max_examples=60, deadline=None)
def test_the_velocity_is_the_nearest_that_is_allowed(wanted, said):
    """Against a general optimiser. All bounds hold at rest, so that there is an answer."""
    spaces = [HalfSpace(directed(v), bound, k) for k, (v, bound) in enumerate(said)]
    found = np.array(nearest_velocity(wanted, spaces, sweeps=3000))
    constraints = [{"type": "ineq", "fun": lambda v, s=s: s.bound - np.dot(s.normal, v)} for s in spaces]
    best = minimize(lambda v: ((v - wanted) ** 2).sum(), np.zeros(3), constraints=constraints, method="SLSQP")
    assert ((found - wanted) ** 2).sum() == pytest.approx(best.fun, abs=0.05)
    assert all(np.dot(s.normal, found) <= s.bound + 0.01 for s in spaces)
    soon = np.array(nearest_velocity(wanted, spaces))
    assert all(np.dot(s.normal, soon) <= s.bound + 0.3 for s in spaces)


@given(vector)
def test_nobody_in_the_way_changes_nothing(wanted):
    assert nearest_velocity(wanted, []) == wanted
    assert binding(wanted, []) == ()


def test_the_distance_left_is_used_up_by_half_per_second():
    space = keep_clear(7, NORTH, 3.5, 0.0, clearance=1.5, fastest=2.5)
    assert space.bound == pytest.approx(1.0)
    assert nearest_velocity((2.0, 1.0, 0.0), [space]) == pytest.approx((1.0, 1.0, 0.0))


def test_somebody_that_comes_is_retreated_from_as_fast_and_somebody_that_leaves_is_followed_by_less():
    def bound(speed):
        return keep_clear(7, NORTH, 1.5, speed, clearance=1.5, fastest=2.5).bound

    assert bound(-1.5) == pytest.approx(-1.5)
    assert bound(1.5) == pytest.approx(1.2)
    assert bound(-9.0) == -2.5


def test_who_passes_near_is_stepped_aside_from_to_the_other_side():
    # It comes from the north, and passes a metre in the east of here.
    north, east, _ = sidestep((6.0, 1.0, 0.0), (-2.0, 0.0, 0.0))
    assert north == pytest.approx(0.0, abs=1e-9)
    assert east < -0.5


def test_two_that_come_straight_on_both_step_to_their_right():
    assert sidestep((6.0, 0.0, 0.0), (-2.0, 0.0, 0.0))[1] == pytest.approx(2.0)
    assert sidestep((-6.0, 0.0, 0.0), (2.0, 0.0, 0.0))[1] == pytest.approx(-2.0)


@pytest.mark.parametrize(
    ("place", "motion"),
    [
        ((6.0, 0.0, 0.0), (2.0, 0.0, 0.0)),
        ((6.0, 0.0, 0.0), (0.3, 0.0, 0.0)),
        ((60.0, 0.0, 0.0), (-2.0, 0.0, 0.0)),
        ((6.0, 4.0, 0.0), (-2.0, 0.0, 0.0)),
        ((6.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    ],
    ids=["leaves", "slow", "later", "passes far off", "stands"],
)
def test_who_does_not_come_near_is_not_stepped_aside_from(place, motion):
    assert sidestep(place, motion) == (0.0, 0.0, 0.0)


def test_somebody_whose_speed_is_not_known_may_come():
    def retreat(sigma):
        flying = Flying(Formation(parameters()))
        seen = state((0.0, -2.2, 0.0), drone_id=0, sigma=0.01)
        seen.cov[3:, 3:] = sigma**2 * np.eye(3)
        return flying.tell(in_slot(), {12: seen}, [track(None, 12)], seconds=1.0).velocity[1]

    assert retreat(0.1) == pytest.approx(0.0, abs=1e-6)
    assert retreat(0.8) == pytest.approx(0.8 - 0.5 * 0.7, abs=0.02)


@pytest.mark.parametrize("identity", [None, 3, "foreign"])
def test_everybody_who_is_seen_is_kept_clear_of_named_or_not(identity):
    flying = Flying(Formation(parameters()))
    setpoint = flying.tell(
        in_slot(), {12: state((0.0, -1.0, 0.0), drone_id=0)}, [track(identity, 12)], seconds=1.0
    )
    assert setpoint.velocity[1] > 0.2
    assert setpoint.clear_of == (12,)
    assert "keeps clear" in setpoint.text


def test_what_is_not_confirmed_moves_nobody():
    flying = Flying(Formation(parameters()))
    doubtful = track(None, 12, status=TrackStatus.TENTATIVE)
    setpoint = flying.tell(in_slot(), {12: state((0.0, -1.0, 0.0), drone_id=0)}, [doubtful], seconds=1.0)
    assert setpoint.velocity == (0.0, 0.0, 0.0)


def test_a_distance_that_is_known_badly_counts_as_the_least_that_it_may_be():
    def retreat(sigma):
        flying = Flying(Formation(parameters()))
        seen = {12: state((0.0, -2.0, 0.0), drone_id=0, sigma=sigma)}
        seen[12].cov[3:, 3:] = 0.0
        return flying.tell(in_slot(), seen, [track(None, 12)], seconds=1.0).velocity[1]

    assert retreat(0.05) == pytest.approx(0.0, abs=1e-9)
    assert retreat(0.4) == pytest.approx(0.5 * (1.5 - 2.0 * math.exp(-0.4)), abs=1e-6)


def test_evading_changes_a_command_by_its_own_acceleration_and_no_faster():
    flying = Flying(Formation(parameters(limits={"acceleration": 0.2, "evasion": 6.0})))
    flying.tell(in_slot())
    seen = {12: state((0.0, -2.0, 0.0), (0.0, 2.0, 0.0), drone_id=0)}
    told = [flying.tell(in_slot(), seen, [track(None, 12)]).velocity for _ in range(6)]
    steps = [math.dist(before, after) for before, after in itertools.pairwise(((0.0, 0.0, 0.0), *told))]
    assert max(steps) <= 0.6 + 1e-9
    assert steps[:3] == pytest.approx([0.6, 0.6, 0.6])
    assert math.hypot(*told[-1]) > 2.4


@pytest.mark.parametrize(("speed", "seed"), [(1.0, 1), (1.0, 2), (1.5, 3), (1.5, 4)])
def test_a_drone_that_is_flown_at_keeps_its_distance(speed, seed):
    """Seen 150 ms late, by a vehicle that takes 0.3 s to do what it is told."""
    rng = np.random.default_rng(seed)
    flying = Flying(Formation(parameters(limits={"fence_radius": 100.0})))
    here, velocity = np.zeros(3), np.zeros(3)
    other, nearest = np.array([8.0, rng.normal(), 0.0]), np.inf
    past = [(other - here, -velocity)] * 3
    told = np.zeros(3)
    for k in range(200):
        other = other + 0.05 * np.array([-speed, 0.0, 0.0])
        velocity = velocity + 0.05 * (told - velocity) / 0.3
        here = here + 0.05 * velocity
        past = [*past[1:], (other - here, np.array([-speed, 0.0, 0.0]) - velocity)]
        nearest = min(nearest, np.linalg.norm(other - here))
        if k % 2 == 0:
            own = in_slot(off=here, velocity=tuple(velocity.tolist()))
            seen = state(*past[0], drone_id=0, sigma=0.15)
            told = np.array(flying.tell(own, {12: seen}, [track("foreign", 12)]).velocity)
    assert nearest > 1.4
