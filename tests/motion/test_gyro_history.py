"""The gyro history against closed forms and against brute-force integration."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmtrack.geometry import rotation
from swarmtrack.messages import VisualTurn
from swarmtrack.motion.gyro import GyroHistory
from swarmtrack.motion.priors import UNKNOWN_ANGLE_VARIANCE_RAD2


def filled(rate_at, *, hz=200.0, seconds=1.5, start=10.0, **parameters):
    history = GyroHistory(**parameters)
    for k in range(int(seconds * hz) + 1):
        history.append(start + k / hz, tuple(rate_at(k / hz)))
    return history


def test_a_constant_rate_about_any_axis_is_integrated_exactly():
    rate = np.array([0.4, -1.2, 2.0])
    history = filled(lambda t: rate)
    turn = history.rotation(10.0, 11.2)
    assert turn.matrix == pytest.approx(rotation.exp(-1.2 * rate), abs=1e-12)


def test_a_point_straight_ahead_moves_left_when_the_camera_yaws_right():
    # Camera y is down: a positive rate turns the view to the right.
    history = filled(lambda t: (0.0, 1.0, 0.0))
    ahead = history.rotation(10.0, 10.5).matrix @ [0.0, 0.0, 1.0]
    assert ahead[0] == pytest.approx(-math.sin(0.5))


def test_a_coning_motion_is_followed_to_a_tenth_of_a_milliradian():
    def rate(t):
        return np.array([2.0 * math.cos(9.0 * t), 2.0 * math.sin(9.0 * t), 1.0])

    truth = np.eye(3)
    fine = 20_000
    for k in range(fine):
        truth = truth @ rotation.exp(rate((k + 0.5) / fine) / fine)
    turn = filled(rate).rotation(10.0, 11.0).matrix
    assert np.linalg.norm(rotation.log(turn @ truth)) < 1e-4


@given(st.lists(st.floats(10.0, 11.5), min_size=3, max_size=3))
@settings(max_examples=50, deadline=None)
def test_turns_compose(times):
    a, b, c = times
    history = filled(lambda t: (math.sin(3 * t), 1.0, t))
    composed = history.rotation(b, c).matrix @ history.rotation(a, b).matrix
    assert composed == pytest.approx(history.rotation(a, c).matrix, abs=1e-10)


def test_samples_after_an_exposure_change_nothing_there():
    early, late = GyroHistory(), GyroHistory()
    for k in range(300):
        sample = (10.0 + 0.005 * k, (math.sin(k), 0.3, -1.0))
        late.append(*sample)
        if k <= 100:
            early.append(*sample)
    assert early.orientation(10.497) == late.orientation(10.497)


def test_the_bias_is_taken_off():
    history = filled(lambda t: (0.1, -0.2, 0.3), bias=(0.1, -0.2, 0.3))
    assert history.rotation(10.0, 11.0).matrix == pytest.approx(np.eye(3))


def test_a_gap_is_counted_and_paid_for_by_its_length():
    whole, broken = GyroHistory(), GyroHistory()
    for k in range(200):
        whole.append(0.005 * k, (0.0, 0.0, 1.0))
        if not 100 <= k < 120:
            broken.append(0.005 * k, (0.0, 0.0, 1.0))
    assert (whole.gaps, broken.gaps) == (0, 1)
    assert broken.rotation(0.0, 0.9).variance > 10 * whole.rotation(0.0, 0.9).variance


def test_the_333_hz_of_an_autopilot_that_rounds_to_milliseconds_is_no_gap():
    history = GyroHistory()
    t = 0.0
    for k in range(600):
        history.append(t, (0.0, 0.0, 0.0))
        t += 0.005 if k % 5 == 0 else 0.0025
    assert history.gaps == 0


def test_a_silent_gyro_knows_less_every_moment():
    history = filled(lambda t: (0.0, 0.0, 1.0))
    variance = [history.rotation(11.0, 11.5 + silence).variance for silence in (0.0, 0.1, 1.0)]
    assert variance[0] < variance[1] < variance[2]
    assert math.sqrt(variance[2]) > 0.5


def test_duplicates_are_dropped_and_a_jump_back_in_time_starts_anew():
    history = filled(lambda t: (0.0, 0.0, 1.0))
    before = history.orientation(11.0)
    history.append(11.5, (9.0, 9.0, 9.0))
    assert (history.out_of_order, history.orientation(11.0)) == (1, before)
    history.append(1.0, (0.0, 0.0, 1.0))
    assert history.restarts == 1
    assert history.orientation(1.0).variance - before.variance > 3.0  # rad²: nothing is known across the jump


def test_an_hour_of_samples_takes_no_more_room_than_the_history():
    history = GyroHistory()
    for k in range(20_000):
        history.append(0.005 * k, (0.1, 0.0, 0.0))
    assert len(history._times) < 4.1 * 200
    assert history._times[0] <= 0.005 * 19_999 - 1.99


def test_without_a_gyro_the_camera_is_still_and_certain():
    turn = GyroHistory().rotation(1.0, 2.0)
    assert turn.matrix == pytest.approx(np.eye(3))
    assert turn.variance == 0.0


# ── without a gyro: turns by images ──────────────────────────────────────────────────────────────────────────────────

SEEN = 1e-7
YAW = np.array([0.0, 0.1, 0.0])


def seen(k, turn=YAW, variance=SEEN, hz=10.0):
    return VisualTurn(10.0 + (k - 1) / hz, 10.0 + k / hz, np.asarray(turn), variance)


def by_images(*turns):
    history = GyroHistory()
    for turn in turns:
        history.add_visual_turn(turn)
    return history


def test_turns_by_images_add_up_and_so_do_their_variances():
    turn = by_images(*(seen(k) for k in range(1, 6))).rotation(10.0, 10.5)
    assert turn.matrix == pytest.approx(rotation.exp(-5.0 * YAW), abs=1e-4)
    assert turn.variance == pytest.approx(5.0 * SEEN, rel=0.01)


def test_between_two_images_the_camera_turns_steadily():
    history = by_images(*(seen(k) for k in range(1, 6)))
    assert history.rotation(10.2, 10.25).matrix == pytest.approx(rotation.exp(-0.5 * YAW), abs=1e-4)


def test_images_that_show_nothing_leave_the_turn_to_its_rate_and_say_so():
    known, unknown = (
        [seen(1), seen(2)],
        [seen(k, np.zeros(3), UNKNOWN_ANGLE_VARIANCE_RAD2) for k in (3, 4, 5)],
    )
    history = by_images(*known, *unknown)
    turn = history.rotation(10.2, 10.5)
    assert rotation.log(turn.matrix) == pytest.approx(-3.0 * YAW, rel=0.1, abs=1e-6)
    assert turn.variance > 1e-3


def test_a_gyro_is_not_overruled_but_one_that_contradicts_is_counted():
    history = filled(lambda t: (0.0, 1.0, 0.0))
    before = history.rotation(10.0, 11.0)
    history.add_visual_turn(VisualTurn(10.0, 10.1, YAW, SEEN))
    assert history.counters["visual_turns_contradicted"] == 0
    history.add_visual_turn(VisualTurn(10.1, 10.2, -YAW, SEEN))
    assert history.counters["visual_turns_contradicted"] == 1
    assert history.rotation(10.0, 11.0).matrix == pytest.approx(before.matrix, abs=0.0)


def test_where_the_gyro_falls_silent_images_go_on():
    history = filled(lambda t: (0.0, 1.0, 0.0), seconds=0.5)
    for k in range(6, 10):
        history.add_visual_turn(seen(k))
    turn = history.rotation(10.0, 10.9)
    assert turn.matrix == pytest.approx(rotation.exp(-9.0 * YAW), abs=1e-3)
    assert history.counters["visual_turns"] == 4
    # And back again.
    history.append(10.95, (0.0, 1.0, 0.0))
    assert history.rotation(10.0, 10.95).matrix == pytest.approx(rotation.exp(-9.5 * YAW), abs=1e-2)


@pytest.mark.parametrize(("since", "t", "variance"), [(1.0, 1.0, 1.0), (1.0, 2.0, 0.0), (1.0, 2.0, math.nan)])
def test_a_turn_that_is_none_is_refused_at_birth(since, t, variance):
    with pytest.raises(ValueError, match="VisualTurn"):
        VisualTurn(since, t, np.zeros(3), variance)
