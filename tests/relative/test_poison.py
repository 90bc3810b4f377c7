"""What is poisoned costs nothing but a count: the states that are stated are those without it."""

import math
from dataclasses import replace

import numpy as np
import pytest

from swarmtrack.messages import Announcement, MotionReport, RangeReport, Sighting, SightingReport
from swarmtrack.relative.looks import TeamLook
from swarmtrack.relative.parameters import RelativeParameters
from swarmtrack.relative.reading import OwnMotion
from swarmtrack.relative.states import RelativeStates

DT = 1.0 / 7.0
STILL = OwnMotion(np.zeros(3), np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3)))
PLACE = np.array([8.0, 2.0, -1.0])
TWO_HOURS = 7200.0
COV = 0.05**2 * np.eye(3)


def look(t, place=PLACE, track=7, width=0.57):
    rho = float(np.linalg.norm(place))
    ray = (place / rho)[None]
    cov = 2.5e-3**2 * np.eye(3)[None]
    keys = ((2, track),)
    return TeamLook(t, np.zeros(3), np.zeros(3), keys, ray, cov, np.array([width / rho]), np.ones(1))


def announced(place, t, sigma=0.1):
    return Announcement(2, "0000000a", 0, t, 0.0, np.array(place, float), np.eye(3), sigma**2 * np.eye(3))


def moves(velocity, t, cov=COV, t_sigma=0.0):
    return MotionReport(2, "0000000a", 0, t, t_sigma, np.zeros(3), COV, np.array(velocity, float), cov)


def stands(place, t, *rays):
    return SightingReport(2, "0000000a", 0, t, 0.0, np.array(place, float), 0.1, (), rays)


def sees(t, direction):
    ray = Sighting(2, 0.99, direction, 1e-3)
    return SightingReport(5, "0000000b", 0, t, 0.0, np.array([8.0, -6.0, -1.0]), 0.05, (), (ray,))


def lies(t):
    """By what each says: the lie, told at t."""
    there = np.array([0.0, 1.0, 0.0])
    return {
        "velocity 200 m/s": lambda s: s.hear_motion(moves([200.0, 0.0, 0.0], t)),
        "velocity 200 m/s down": lambda s: s.hear_motion(moves([0.0, 0.0, 200.0], t, t_sigma=0.5)),
        "velocity at no time": lambda s: s.hear_motion(moves([0.0, 0.0, 0.0], math.nan)),
        "velocity two hours ago": lambda s: s.hear_motion(moves([0.5, 0.0, 0.0], t - TWO_HOURS)),
        "velocity in two hours": lambda s: s.hear_motion(moves([0.5, 0.0, 0.0], t + TWO_HOURS)),
        "velocity of a clock that may be hours off": lambda s: s.hear_motion(
            moves([0.5, 0.0, 0.0], t - TWO_HOURS, t_sigma=TWO_HOURS)
        ),
        "range 250 m": lambda s: s.hear_range(RangeReport(1, 2, t, 0.0, 250.0, 0.01)),
        "range 1 mm": lambda s: s.hear_range(RangeReport(1, 2, t, 0.0, 1e-3, 0.01)),
        "range two hours ago": lambda s: s.hear_range(RangeReport(1, 2, t - TWO_HOURS, 0.0, 8.3, 0.1)),
        "range in two hours": lambda s: s.hear_range(RangeReport(1, 2, t + TWO_HOURS, 0.0, 8.3, 0.1)),
        "place 10 000 km off": lambda s: s.hear_sightings(stands(1e7 * there, t)),
        "place behind": lambda s: s.hear_sightings(stands(-PLACE, t)),
        "place two hours ago": lambda s: s.hear_sightings(stands(PLACE, t - TWO_HOURS)),
        "place in two hours": lambda s: s.hear_sightings(stands(PLACE, t + TWO_HOURS)),
        "start elsewhere": lambda s: s.hear_announcement(announced(30.0 * there, t)),
        "start in two hours": lambda s: s.hear_announcement(announced(PLACE, t + TWO_HOURS)),
        "start two hours ago": lambda s: s.hear_announcement(announced(30.0 * there, t - TWO_HOURS)),
        "ray to elsewhere": lambda s: s.hear_sightings(sees(t, -there)),
    }


def same(one, other, t):
    a, b = one.at(t, STILL), other.at(t, STILL)
    assert a.keys() == b.keys()
    for key in a:
        assert a[key].position.tobytes() == b[key].position.tobytes()
        assert a[key].velocity.tobytes() == b[key].velocity.tobytes()
        assert a[key].cov.tobytes() == b[key].cov.tobytes()
        assert a[key].sources == b[key].sources
    return a


@pytest.mark.parametrize("span", [0.5, None], ids=["span told", "span unknown"])
@pytest.mark.parametrize("lie", lies(0.0))
def test_a_lie_is_counted_and_what_is_stated_is_what_it_was(lie, span):
    poisoned, honest = (RelativeStates(RelativeParameters(airframe_span_m=span)) for _ in range(2))
    for states in (poisoned, honest):
        states.hear_announcement(announced(PLACE, 0.0))
        for k in range(10):
            states.observe(look(k * DT))
    t = 9 * DT
    lies(t)[lie](poisoned)
    assert sum(poisoned.counters.values()) == sum(honest.counters.values()) + 1
    assert same(poisoned, honest, t)
    for k in range(10, 20):
        for states in (poisoned, honest):
            states.observe(look(k * DT))
    assert same(poisoned, honest, 19 * DT)


@pytest.mark.parametrize("lie", lies(0.0))
def test_a_lie_spoils_nothing_for_when_the_name_comes_back(lie):
    poisoned, honest = (RelativeStates() for _ in range(2))
    for k in range(30):
        t = k * DT
        for states in (poisoned, honest):
            if k == 0:
                states.hear_announcement(announced(PLACE, 0.0))
            # The same teammate on another track.
            states.observe(look(t, track=7 if k < 15 else 8))
        if k == 10:
            lies(t)[lie](poisoned)
    assert same(poisoned, honest, 29 * DT)


@pytest.mark.parametrize("lie", lies(0.0))
def test_a_lie_that_is_repeated_for_ever_costs_as_little(lie):
    poisoned, honest = (RelativeStates(RelativeParameters(airframe_span_m=0.5)) for _ in range(2))
    for states in (poisoned, honest):
        states.hear_announcement(announced(PLACE, 0.0))
    for k in range(60):
        for states in (poisoned, honest):
            states.observe(look(k * DT))
        lies(k * DT)[lie](poisoned)
    assert same(poisoned, honest, 59 * DT)
    assert sum(poisoned.counters.values()) >= 59


@pytest.mark.parametrize("span", [0.0, 0.04, 100.0, math.nan, -1.0])
def test_a_span_that_no_airframe_has_is_refused(span):
    with pytest.raises(ValueError, match=r"airframe_span_m: found .*, expected 0.05 to 10"):
        RelativeParameters(airframe_span_m=span)


@pytest.mark.parametrize("span", [0.05, 10.0])
def test_a_span_that_is_wrong_moves_the_range_within_its_bounds_and_is_counted(span):
    """Nobody can tell a wrong span from a wrong start: that they contradict each other is counted."""
    states = RelativeStates(RelativeParameters(airframe_span_m=span))
    states.hear_announcement(announced(PLACE, 0.0))
    for k in range(20):
        states.observe(look(k * DT))
    assert states.counters["relative_refused"] > 0
    (state,) = states.at(19 * DT, STILL).values()
    assert 0.3 <= float(np.linalg.norm(state.position)) <= 300.0
    assert np.isfinite(state.cov).all()


@pytest.mark.parametrize("width", [math.nan, 0.0, -1.0, math.inf, 1e-12])
def test_a_box_of_no_size_tells_no_range(width):
    poisoned, honest = (RelativeStates(RelativeParameters(airframe_span_m=0.5)) for _ in range(2))
    for k in range(20):
        honest.observe(look(k * DT, width=math.nan if 5 <= k < 8 else 0.57))
        with np.errstate(all="ignore"):
            poisoned.observe(look(k * DT, width=width if 5 <= k < 8 else 0.57))
    (one,), (other,) = (states.at(19 * DT, STILL).values() for states in (poisoned, honest))
    assert one.position == pytest.approx(other.position, rel=1e-6)
    assert np.isfinite(one.cov).all()


def test_a_covariance_that_claims_everything_moves_a_state_by_no_more_than_the_gate():
    states = RelativeStates(RelativeParameters(airframe_span_m=0.5))
    states.hear_announcement(announced(PLACE, 0.0))
    for k in range(10):
        states.observe(look(k * DT))
        states.hear_motion(moves([0.0, 0.0, 0.0], k * DT))
    before = next(iter(states.at(9 * DT, STILL).values()))
    states.hear_motion(replace(moves([0.2, 0.0, 0.0], 9 * DT), velocity_cov=np.zeros((3, 3))))
    after = next(iter(states.at(9 * DT, STILL).values()))
    off = after.position - before.position
    assert off @ np.linalg.solve(before.cov[:3, :3], off) < 25.0
