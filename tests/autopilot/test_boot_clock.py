"""Stamps of our autopilot are told from late copies, from a second sender's, from wraps and from a reboot's."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmtrack.autopilot.boot_clock import MICROSECONDS_WRAP_S, MILLISECONDS_WRAP_S, BootClock, StampStep

NEXT, SAME, OTHER, REBOOT, REPLACED = StampStep


def clock(at: float, stamp: float, *, hz: float = 200.0, seconds: float = 1.0) -> BootClock:
    """Of an autopilot that was heard until `at`, when it read `stamp`."""
    read = BootClock(MICROSECONDS_WRAP_S)
    for k in range(round(hz * seconds), -1, -1):
        read.read(at - k / hz, stamp - k / hz)
    return read


def steps(read: BootClock, *readings: tuple[float, float]) -> list[StampStep]:
    return [read.read(t, stamp)[0] for t, stamp in readings]


@pytest.mark.parametrize("late", [0.003, 0.5, 1.3, 20.0, 90.0])
def test_a_late_reading_is_no_reboot_and_moves_nothing(late):
    read = clock(100.0, 100.0)
    for k in range(1, 400):
        t = 100.0 + k / 200
        assert steps(read, (t, t)) == [NEXT]
        if t - late > 1.0:
            assert steps(read, (t, t - late)) == [OTHER]


def test_a_rebooted_clock_counts_less_than_the_time_since_it_was_read():
    assert steps(clock(100.0, 100.0), (104.0, 3.2)) == [REBOOT]
    # It would have booted before it was heard last.
    assert steps(clock(100.0, 100.0), (104.0, 40.0)) == [OTHER]


def test_a_reboot_in_a_long_silence_is_one_though_the_clock_counts_more_than_before():
    # Up for 100 s; then nothing for 200 s, of which it has been up for the last 150.
    assert steps(clock(100.0, 100.0), (300.0, 150.0)) == [REBOOT]
    assert steps(clock(100.0, 100.0), (300.0, 299.0)) == [NEXT]


def test_a_simulator_that_reboots_at_once_needs_three_readings():
    assert steps(clock(100.0, 100.0), *((100.0 + s, s) for s in (0.005, 0.010, 0.015, 0.020))) == [
        OTHER, OTHER, REBOOT, NEXT,
    ]  # fmt: skip


@pytest.mark.parametrize("apart", [-60.0, -0.7, 2.0, 500.0])
def test_a_second_clock_is_followed_and_never_used(apart):
    read = clock(100.0, 100.0)
    for k in range(1, 2000):
        t = 100.0 + k / 200
        assert steps(read, (t, t), (t + 0.001, t + apart)) == [NEXT, OTHER]
    assert read.is_shared
    assert read.apart == pytest.approx(apart, abs=0.01)


@pytest.mark.parametrize("apart", [-60.0, 500.0])
def test_another_clock_takes_the_place_of_ours_once_that_has_been_silent_for_three_seconds(apart):
    read = clock(100.0, 100.0)
    times = [100.0 + 0.1 * k for k in range(1, 60)]
    found = steps(read, *((t, t + apart) for t in times))
    assert found.count(REPLACED) == 1
    assert found.index(REPLACED) == pytest.approx(29, abs=1)
    assert set(found[: found.index(REPLACED)]) == {OTHER}
    assert set(found[found.index(REPLACED) + 1 :]) == {NEXT}


@given(
    st.lists(
        st.tuples(st.floats(0.0, 0.5), st.integers(0, 2), st.floats(0.0, 2.0)), min_size=20, max_size=200
    )
)
def test_resets_are_bounded_whoever_speaks(said):
    """Three senders, of any delays, in any order."""
    read, t, resets = BootClock(MICROSECONDS_WRAP_S), 1000.0, []
    for wait, who, late in said:
        t += wait
        step, _ = read.read(t, t - (990.0, 700.0, 3.0)[who] - late)
        if step in (REBOOT, REPLACED):
            resets.append(t)
    assert all(later - before >= 1.0 for before, later in itertools.pairwise(resets))


@pytest.mark.parametrize("period", [MICROSECONDS_WRAP_S, MILLISECONDS_WRAP_S])
def test_a_counter_of_32_bits_goes_on_when_it_begins_again(period):
    read, found = BootClock(period), []
    for k in range(-200, 400):
        step, stamp = read.read(1000.0 + k / 100, math.fmod(3 * period + k / 100, period))
        assert step is NEXT
        found.append(stamp)
        if k == 10:
            # Sent before it wrapped.
            assert read.read(1000.0 + k / 100, period - 0.05)[0] is OTHER
    assert found[-1] - found[0] == pytest.approx(5.99)
    assert read.turns == 1


def test_milliseconds_of_a_clock_since_1970_follow_its_microseconds():
    read, since_1970 = BootClock(MILLISECONDS_WRAP_S), 1.764e9
    _, stamp = read.read(100.0, math.fmod(since_1970, MILLISECONDS_WRAP_S), near=since_1970 - 0.02)
    assert stamp == pytest.approx(since_1970, abs=1e-3)
    # Two clocks of one firmware that have nothing to do with each other.
    assert BootClock(MILLISECONDS_WRAP_S).read(100.0, 40.0, near=since_1970) == (NEXT, 40.0)


@pytest.mark.parametrize(("speed", "hz"), [(0.1, 200.0), (10.0, 3.5), (15.0, 1.0)])
def test_a_simulator_that_runs_slower_or_faster_than_time_is_one_clock(speed, hz):
    read = clock(100.0, 100.0)
    assert set(steps(read, *((100.0 + k / hz, 100.0 + speed * k / hz) for k in range(1, 100)))) == {NEXT}


def test_a_link_that_stood_still_and_lost_what_it_held_is_no_second_clock():
    read = clock(100.0, 100.0)
    # A sample that was held back for eight seconds, and the next one that was not.
    assert steps(read, (108.0, 100.005), (108.0, 108.0)) == [NEXT, NEXT]


def test_a_simulator_that_was_paused_goes_on():
    assert steps(clock(100.0, 100.0), (4000.0, 100.005), (4000.005, 100.010)) == [NEXT, NEXT]


def test_a_stamp_that_stands_still_is_no_clock():
    read = BootClock(MICROSECONDS_WRAP_S)
    assert steps(read, *((t, 0.0) for t in range(1, 5))) == [NEXT, SAME, SAME, SAME]
    assert not read.is_shared
    read = clock(100.0, 100.0)
    # Zeros between good ones.
    found = steps(read, *((100.0 + k / 200, 0.0 if k % 2 else 100.0 + k / 200) for k in range(1, 400)))
    assert set(found[::2]) == {OTHER}
    assert set(found[1::2]) == {NEXT}
    assert not read.is_shared
