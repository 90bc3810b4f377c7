"""The map from the autopilot's clock to ours, against simulated clocks whose truth is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from swarmtrack.autopilot.clock_map import ClockMap, Exchange, slopes_through, supporting_line
from swarmtrack.autopilot.limits import CLOCK_CROSSING_S, CLOCK_MAX_SLEW, CLOCK_RESYNC_S

OFFSET = 958.0  # s: our clock at the autopilot's boot
RATE = 200.0


def truth(stamp: np.ndarray | float, skew: float = 0.0) -> np.ndarray | float:
    return OFFSET + stamp * (1.0 + skew)


def play(
    clock_map: ClockMap, seconds: float, *, latency, skew: float = 0.0, start: float = 40.0, timesync=None
):
    """Feed `seconds` of IMU stamps that arrive `latency(n)` late; return the stamps and the mapped times.

    timesync: (up, down) latencies of one exchange a second, or None.
    """
    stamps = start + np.arange(int(seconds * RATE)) / RATE
    arrivals = truth(stamps, skew) + latency(len(stamps))
    mapped = np.empty_like(stamps)
    for i, (stamp, arrival) in enumerate(zip(stamps, arrivals, strict=True)):
        clock_map.observe(stamp, arrival)
        mapped[i] = clock_map.to_ours(stamp)
        if timesync is not None and i % int(RATE) == 0:
            up, down = timesync()
            clock_map.exchange(float(truth(stamp, skew)) - up, stamp, float(truth(stamp, skew)) + down)
    return stamps, mapped


def jitter(rng: np.random.Generator, least: float = 2e-4, mean: float = 2e-3):
    """One-sided, like a link's: `least` plus an exponential, and now and then a stall."""

    def draw(n: int) -> np.ndarray:
        return least + rng.exponential(mean, n) + 0.06 * (rng.random(n) < 1e-3)

    return draw


@pytest.mark.parametrize("skew", [0.0, 90e-6, -90e-6])
def test_the_lower_envelope_finds_offset_and_skew_below_the_jitter(skew):
    clock_map = ClockMap()
    stamps, mapped = play(clock_map, 60.0, latency=jitter(np.random.default_rng(4)), skew=skew)
    error = mapped - truth(stamps, skew)
    assert np.abs(error[stamps > 55.0]).max() < 1e-3  # the jitter's standard deviation is 2.7 ms
    assert clock_map.skew == pytest.approx(skew, abs=15e-6)
    assert clock_map.resyncs == 0


def test_mapped_time_is_smooth_whatever_the_jitter():
    stamps, mapped = play(ClockMap(), 20.0, latency=jitter(np.random.default_rng(5), mean=8e-3), skew=90e-6)
    stretch = np.diff(mapped) / np.diff(stamps)
    assert (np.abs(stretch - 1.0) <= CLOCK_MAX_SLEW + 1e-9).all()


def test_timesync_takes_out_the_latency_that_the_envelope_cannot_see():
    rng = np.random.default_rng(6)
    slow = 30e-3  # s each way at least: a radio
    alone, synced = ClockMap(), ClockMap()
    play(alone, 30.0, latency=jitter(rng, least=slow))

    def exchange() -> tuple[float, float]:
        return slow + rng.exponential(5e-3), slow + rng.exponential(2e-3)

    play(synced, 30.0, latency=jitter(rng, least=slow), timesync=exchange)
    assert alone.offset == pytest.approx(OFFSET + slow, abs=2e-3)
    assert synced.offset == pytest.approx(OFFSET, abs=3e-3)
    assert 0.3 * slow < synced.sigma < 1.5 * slow  # what is asymmetric in it nobody can see


def test_congestion_does_not_move_the_map():
    clock_map, rng = ClockMap(), np.random.default_rng(7)
    play(clock_map, 20.0, latency=jitter(rng))
    _, mapped = play(clock_map, 20.0, latency=lambda n: 0.3 + jitter(rng)(n), start=60.0)
    assert np.abs(mapped - truth(60.0 + np.arange(len(mapped)) / RATE)).max() < 5e-3
    assert clock_map.resyncs == 0


def test_a_stepped_clock_is_noticed_by_timesync_and_resynced_once():
    clock_map = ClockMap()
    play(clock_map, 20.0, latency=lambda n: np.full(n, 1e-3), timesync=lambda: (1e-3, 1e-3))
    # The autopilot stood still for a second: its stamps are now that much behind.
    stamps = 60.0 + np.arange(400) / RATE
    for i, stamp in enumerate(stamps):
        clock_map.observe(stamp, truth(stamp) + 1.0 + 1e-3)
        if i % 40 == 0:
            clock_map.exchange(float(truth(stamp)) + 1.0 - 1e-3, stamp, float(truth(stamp)) + 1.0 + 1e-3)
    assert clock_map.offset == pytest.approx(OFFSET + 1.0, abs=2e-3)
    assert clock_map.resyncs == 1


def test_an_early_backlog_is_one_hard_resync_not_a_slow_lie():
    clock_map = ClockMap()
    clock_map.observe(10.0, float(truth(10.0)) + 3 * CLOCK_RESYNC_S)  # waited in a buffer
    clock_map.observe(10.005, float(truth(10.005)))
    assert clock_map.to_ours(10.005) == pytest.approx(truth(10.005))
    assert clock_map.resyncs == 1


def test_an_offset_that_slides_to_its_place_owns_up_to_the_way_that_is_left():
    clock_map, late = ClockMap(), 0.8 * CLOCK_RESYNC_S
    errors, sigmas = [], []
    for i in range(int(6.0 * RATE)):
        stamp = 40.0 + i / RATE
        # The first second of a busy machine comes late.
        arrival = truth(stamp) + (late if i < RATE else 2e-4)
        clock_map.observe(stamp, arrival)
        if i > 1.2 * RATE:
            errors.append(clock_map.to_ours(stamp) - truth(stamp))
            sigmas.append(clock_map.sigma)
    assert errors[0] > 0.5 * late
    assert clock_map.resyncs == 0
    assert (np.abs(errors) < 2.0 * np.array(sigmas)).all()
    assert errors[-1] == pytest.approx(0.0, abs=1e-3)
    assert sigmas[-1] < 0.3 * sigmas[0]


def test_after_a_reboot_nothing_of_the_old_clock_remains():
    clock_map = ClockMap()
    play(clock_map, 15.0, latency=lambda n: np.full(n, 1e-3), skew=500e-6)
    clock_map.reset()
    clock_map.observe(0.5, 5000.5)
    assert clock_map.to_ours(0.5) == pytest.approx(5000.5)
    assert clock_map.skew == 0.0


def lockstep(clock_map: ClockMap, rate, seconds: float, *, step: float = 4e-3):
    """A simulator whose time passes at `rate(t)` of ours and stands still within a step, as a UDP link carries it.

    Return our times, what the map was off by then, and when something was first said of it [s].
    """
    rng = np.random.default_rng(9)
    ours = np.arange(0.0, seconds, 1 / RATE)
    theirs = 40.0 + np.concatenate([[0.0], np.cumsum(rate(ours[:-1]) / RATE)])
    errors, said, next_exchange, exchanges = [], math.inf, 0.0, 0
    for t, stamp in zip(ours, step * np.floor(theirs / step), strict=True):
        clock_map.observe(stamp, t + 3e-4 + rng.exponential(3e-4))
        errors.append(clock_map.to_ours(stamp) - np.interp(stamp, theirs, ours))
        if t >= next_exchange:
            exchanges += 1
            next_exchange += 0.2 if exchanges < 10 else 1.0
            at = t + 3e-4 + rng.exponential(3e-4)
            stamped = step * math.floor(np.interp(at, ours, theirs) / step)
            clock_map.exchange(t, stamped, at + 3e-4 + rng.exponential(3e-4))
        if clock_map.in_words:
            said = min(said, t)
    return ours, np.array(errors), said


@pytest.mark.parametrize("rate", [0.989, 0.997, 1.011, 1.05, 0.9])
def test_a_simulators_clock_is_followed_and_said(rate):
    clock_map = ClockMap()
    ours, errors, said = lockstep(clock_map, lambda t: np.full_like(t, rate), 40.0)
    assert said < 10.0
    assert f"{100 * abs(1 - rate):.1f} % {'slow' if rate < 1 else 'fast'}: a simulator?" in clock_map.in_words
    assert np.abs(errors[ours > 20.0]).max() < 3e-3
    assert clock_map.sigma < 3e-3
    assert clock_map.skew == pytest.approx(1 / rate - 1, abs=1e-4)


def test_px4_in_lockstep_is_known_to_milliseconds_within_ten_seconds():
    clock_map = ClockMap()
    lockstep(clock_map, lambda t: np.full_like(t, 0.989), 10.0)
    assert clock_map.sigma < 3e-3


def test_a_simulator_that_gets_up_to_speed_is_an_ordinary_clock_again():
    clock_map = ClockMap()
    ours, errors, _ = lockstep(clock_map, lambda t: np.where(t < 20.0, 0.989, 1.0), 150.0)
    assert clock_map.drift == 0.0
    assert clock_map.in_words == ""
    assert clock_map.sigma < 3e-3
    assert np.abs(errors[ours > 40.0]).max() < 3e-3


def test_a_clock_that_no_rate_explains_is_said_and_its_sigma_owns_up():
    clock_map = ClockMap()
    rates = np.random.default_rng(1).uniform(0.8, 1.0, 100)
    _, _, said = lockstep(clock_map, lambda t: rates[(2 * t).astype(int)], 40.0)
    assert said < 10.0
    assert "jumps against ours" in clock_map.in_words
    assert clock_map.sigma >= CLOCK_CROSSING_S


def stalling(seed):
    """The rate of a simulator on a machine that is too busy: every other second or so it stalls, and catches up."""
    rng = np.random.default_rng(seed)
    spans = [(begin + rng.uniform(0.0, 1.5), rng.uniform(0.05, 0.4)) for begin in np.arange(10.0, 40.0, 2.0)]

    def rate(t):
        rates = np.ones_like(t)
        for begin, lasts in spans:
            rates[(t >= begin) & (t < begin + lasts)] = 0.2
            rates[(t >= begin + lasts) & (t < begin + 1.8 * lasts)] = 2.0
        return rates

    return rate


@pytest.mark.parametrize("seed", range(4))
def test_the_sigma_of_a_clock_that_stalls_is_as_large_as_its_steps(seed):
    clock_map, sigmas = ClockMap(), []

    observe = clock_map.observe
    clock_map.observe = lambda stamp, arrival: (observe(stamp, arrival), sigmas.append(clock_map.sigma))
    ours, errors, _ = lockstep(clock_map, stalling(seed), 40.0)
    busy = ours > 14.0
    off = np.abs(errors[busy]) / np.array(sigmas)[busy]
    assert np.abs(errors[busy]).max() > 0.1
    assert np.mean(off > 3.0) < 0.08
    assert np.mean(np.abs(errors[busy]) > 3.0 * CLOCK_CROSSING_S) > np.mean(off > 3.0)


@pytest.mark.parametrize("step", [0.03, 0.05, 0.3, -0.03, -0.05, -0.3])
@pytest.mark.parametrize("at", [3.0, 6.0, 20.0])
def test_a_step_is_no_drift(step, at):
    clock_map = ClockMap()
    # All in one sample: time stands still, or leaps.
    ours, errors, _ = lockstep(
        clock_map, lambda t: np.where(np.abs(t - at) < 0.4 / RATE, 1 - step * RATE, 1.0), 40.0
    )
    assert clock_map.restarts == 1
    assert clock_map.drift == 0.0
    assert clock_map.in_words == ""
    assert np.abs(errors[ours > 35.0]).max() < 3e-3


def test_slopes_through_bounds_are_those_of_brute_force():
    rng = np.random.default_rng(10)
    for _ in range(30):
        stamps = np.sort(rng.uniform(0.0, 10.0, 8))
        centre = 0.01 * stamps + rng.normal(0.0, 2e-3, 8)
        half = rng.uniform(1e-3, 4e-3, 8)
        found = slopes_through(
            [Exchange(*e) for e in zip(stamps, centre - half, centre + half, strict=True)], 1e-3
        )
        slopes = np.linspace(0.0, 0.02, 2001)
        floor = (centre - half - 1e-3 - slopes[:, None] * stamps).max(axis=1)
        ceiling = (centre + half + 1e-3 - slopes[:, None] * stamps).min(axis=1)
        possible = slopes[floor <= ceiling]
        if found is None:
            assert possible.size == 0
        elif possible.size:
            assert found == pytest.approx((possible[0], possible[-1]), abs=2e-5)


def test_the_supporting_line_is_the_best_of_all_lines_below_the_points():
    rng = np.random.default_rng(8)
    for _ in range(50):
        x = np.sort(rng.uniform(0, 60, 30))
        y = 0.1 + 1e-4 * x + rng.exponential(1e-2, 30)
        slope, at_zero = supporting_line(list(zip(x, y, strict=True)))
        height = y - slope * x - at_zero
        # Brute force: every line through two points that lies below all others.
        best = np.inf
        for i in range(30):
            for j in range(i):
                k = (y[i] - y[j]) / (x[i] - x[j])
                h = y - y[i] - k * (x - x[i])
                if h.min() > -1e-12:
                    best = min(best, h.sum())
        assert height.min() > -1e-12
        assert height.sum() == pytest.approx(best)
