"""What is missing in a stream, by its stamps alone: lost samples, and those that the sender leaves out by a rule."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from swarmtrack.autopilot.streams import Cadence

SENSOR_HZ = 250.0
STEADY = [4] * 30
LEFT_OUT = [4, 4, 4, 8]


def listen(
    milliseconds: list[float], *, lost: float = 0.0, cadence: Cadence | None = None
) -> tuple[Cadence, int]:
    """A stream of these intervals of which a share is lost at random; return how many were."""
    cadence = cadence or Cadence()
    stamps = 40.0 + 1e-3 * np.cumsum([0, *milliseconds])
    kept = np.random.default_rng(3).random(len(stamps)) >= lost
    # What is lost at the ends leaves no gap.
    kept[[0, -1]] = True
    for stamp in stamps[kept]:
        cadence.observe(float(stamp))
    return cadence, int((~kept).sum())


def newest_when_due(asked_hz: float, n: int) -> list[float]:
    """Intervals [ms] of a sender that takes the sensor's newest sample whenever one is due."""
    due = np.arange(1, n) / asked_hz
    return list(np.diff(np.unique(np.floor(due * SENSOR_HZ + 1e-9))) * 1e3 / SENSOR_HZ)


def test_samples_left_out_by_a_rule_are_not_lost():
    cadence, _ = listen(STEADY + 1000 * LEFT_OUT)
    assert (cadence.lost, cadence.gaps) == (0, 0)


@pytest.mark.parametrize("asked_hz", [240, 230, 220, 210, 190, 180, 170, 160, 150, 140, 130, 100, 90, 80, 50])
@pytest.mark.parametrize("before", [[], STEADY])
def test_no_rate_that_a_sender_makes_of_its_sensors_looks_like_loss(asked_hz, before):
    cadence, _ = listen(before + newest_when_due(asked_hz, 3000))
    assert (cadence.lost, cadence.gaps) == (0, 0)


@pytest.mark.parametrize("share", [0.01, 0.05, 0.2, 0.4])
def test_random_losses_are_counted(share):
    cadence, lost = listen([5] * 10_000, lost=share)
    assert cadence.lost == pytest.approx(lost, rel=0.02)


@pytest.mark.parametrize("before", [[], STEADY])
@pytest.mark.parametrize("share", [0.01, 0.05])
def test_losses_are_told_from_what_the_sender_leaves_out(share, before):
    cadence, lost = listen(before + 2500 * LEFT_OUT, lost=share)
    assert cadence.lost == pytest.approx(lost, rel=0.05)


def test_a_rhythm_that_has_ended_hides_no_losses():
    cadence, _ = listen(STEADY + 200 * LEFT_OUT)
    _, lost = listen([4] * 5000, lost=0.05, cadence=shifted(cadence))
    assert cadence.lost == pytest.approx(lost, abs=20)


def shifted(cadence: Cadence) -> Cadence:
    """As if its last sample had been the first of `listen`."""
    cadence.newest = 40.0
    return cadence


@pytest.mark.parametrize(("before", "after"), [*itertools.permutations([2.5, 4, 5, 8, 12.5, 20], 2)])
def test_a_new_rate_is_learned_and_is_no_loss(before, after):
    cadence, _ = listen([before] * 500 + [after] * 1500)
    assert (cadence.lost, cadence.gaps) == (0, 0)
    assert cadence.period == pytest.approx(1e-3 * after, rel=0.02)


def test_a_gap_counts_at_once():
    cadence, _ = listen([5] * 100 + [50])
    assert (cadence.lost, cadence.gaps) == (9, 1)


def test_a_sample_that_comes_doubled_after_a_gap_was_late_and_is_not_lost():
    cadence, _ = listen([5] * 100 + [10, 0, 5])
    assert (cadence.lost, cadence.repeated) == (0, 1)


def test_who_is_silent_and_agrees_to_its_rate_anew_before_it_speaks_has_a_gap():
    cadence, _ = listen(STEADY)
    assert cadence.newest is not None
    cadence.learn_again()
    cadence.observe(cadence.newest + 0.9)
    assert (cadence.lost, cadence.gaps) == (round(0.9 / cadence.period) - 1, 1)
    for _ in range(500):
        cadence.observe(cadence.newest + cadence.period)
    assert cadence.gaps == 1


@pytest.mark.parametrize("period", [0.5, 0.02])
def test_who_agrees_to_another_rate_has_no_gap(period):
    cadence, _ = listen([500.0] * 100)
    cadence.learn_again()
    for _ in range(100):
        cadence.observe(cadence.newest + period)
    assert cadence.gaps == 0


def sent_when_it_looks(n: int) -> list[float]:
    """Stamps [s] of samples of 266.7 Hz from a sender that was asked for 250 Hz and looks late now and then."""
    looks = np.cumsum(0.001 + 0.0006 * np.random.default_rng(5).random(n))
    stamps, due = [0.0], 0.0
    for look in looks.tolist():
        newest = 0.00375 * (look // 0.00375)
        if look >= due and newest > stamps[-1]:
            stamps.append(newest)
            due = max(due + 0.004, look - 0.002)
    return stamps


@pytest.mark.parametrize("share", [0.0, 0.02])
def test_what_has_no_number_was_left_out_whatever_its_rhythm_and_what_has_one_is_lost(share):
    stamps = sent_when_it_looks(60_000)
    kept = np.random.default_rng(3).random(len(stamps)) >= share
    kept[[0, -1]] = True
    by_stamps_alone, cadence, last = Cadence(), Cadence(), 0
    for k in np.flatnonzero(kept).tolist():
        between = [n for n in range(last + 1, k) if not kept[n]]
        by_stamps_alone.observe(stamps[k])
        cadence.observe(stamps[k], is_whole=not between)
        last = k
    lost = int((~kept).sum())
    assert by_stamps_alone.lost > lost + 0.02 * len(stamps), "no rule is found in it"
    # Where a lost one follows one that was left out, that one counts too.
    assert lost <= cadence.lost <= 1.2 * lost


def test_a_sender_that_halves_its_rate_is_followed():
    cadence = Cadence()
    for stamp in np.cumsum([0.004] * 100 + [0.008] * 500):
        cadence.observe(float(stamp), is_whole=True)
    assert (cadence.lost, cadence.gaps) == (0, 0)
    assert cadence.period == pytest.approx(0.008, rel=0.02)


def test_a_longer_silence_is_a_gap_although_no_number_is_missing():
    cadence, _ = listen(STEADY)
    cadence.observe(cadence.newest + 0.04, is_whole=True)
    assert (cadence.lost, cadence.gaps) == (9, 1)
