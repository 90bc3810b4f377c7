"""Which clock a stream's stamps are on."""

from __future__ import annotations

import re

import pytest

from swarmtrack.camera_sources.limits import STAMPS_COMPARED
from swarmtrack.camera_sources.stamp_clock import StampBounds, StampClock
from swarmtrack.clock import ManualClock


def stamp_clock(*, same_machine: bool = True) -> tuple[StampClock, ManualClock]:
    clock = ManualClock()
    return StampClock(clock, same_machine=same_machine), clock


def test_a_frame_that_waited_is_believed_by_the_others_that_did_not() -> None:
    stamps, clock = stamp_clock()
    for age in (0.08, 0.06, 0.9, 0.07):
        clock.set(clock.now() + 1.0)
        t, sigma = stamps.exposure(clock.now() - age, clock.now()) or (None, None)
        assert t == pytest.approx(clock.now() - age)
        assert sigma == 1e-3
    assert stamps.problem == ""


@pytest.mark.parametrize(("least", "sigma"), [(0.04, 1e-3), (0.14, 1e-3), (0.3, 0.15 / 12**0.5)])
def test_an_age_beyond_usual_latencies_may_be_the_clocks(least: float, sigma: float) -> None:
    stamps, clock = stamp_clock()
    stamps.exposure(clock.now() - least, clock.now())
    _, found = stamps.exposure(clock.now() - 0.4, clock.now()) or (0.0, 0.0)
    assert found == pytest.approx(sigma, rel=1e-3)
    words = "stamps are 300 ms old or more: the stream is late, or their clock is behind this machine's"
    assert stamps.doubt.startswith(words) == (least == 0.3)
    assert bool(stamps.doubt) == (least == 0.3)


@pytest.mark.parametrize("offset", [0.8, -0.3])
def test_a_clock_that_is_set_right_is_believed_again(offset: float) -> None:
    stamps, clock = stamp_clock()
    used = []
    for count in range(3 * STAMPS_COMPARED):
        clock.set(clock.now() + 0.1)
        wrong = offset if count < STAMPS_COMPARED else 0.0
        used.append(stamps.exposure(clock.utc() - 0.05 - wrong, clock.now()) is not None)
    assert not any(used[:STAMPS_COMPARED])
    assert all(used[2 * STAMPS_COMPARED :])


def test_the_monotonic_clock_is_that_of_this_machine_only() -> None:
    stamps, clock = stamp_clock(same_machine=False)
    clock.set(clock.now() + 5.0)
    assert stamps.exposure(clock.now() - 0.05, clock.now()) is None
    assert stamps.exposure(clock.utc() - 0.05, clock.now()) is not None


@pytest.mark.parametrize(
    ("stamp", "words"),
    [
        (float("nan"), "no numbers"),
        (float("inf"), "inf s ahead of"),
        (1e300, "1e.300 s ahead of"),
        (-7.0, "behind"),
        (1.7e12, "they are milliseconds, expected seconds"),
        (1.7e18, "they are nanoseconds, expected seconds"),
    ],
)
def test_a_stamp_of_no_clock_is_said(stamp: float, words: str) -> None:
    stamps, clock = stamp_clock()
    assert stamps.exposure(stamp, clock.now()) is None
    assert re.search(words, stamps.problem)


def test_with_credit_old_frames_are_held_against_their_clock_only_after_so_many() -> None:
    clock = ManualClock()
    bounds = StampBounds(-0.005, 0.15, 0.5, 60.0, credit=3)
    for ages, used in (
        ((3.0, 2.0, 1.0, 0.9, 0.9), [True, True, True, False, False]),
        ((3.0, 2.0, 1.0, 0.1, 3.0), [True] * 5),
        ((-0.1, 61.0, 0.1), [False] * 3),
    ):
        stamps = StampClock(clock, same_machine=True, utc=False, bounds=bounds)
        assert [stamps.exposure(clock.now() - age, clock.now()) is not None for age in ages] == used
