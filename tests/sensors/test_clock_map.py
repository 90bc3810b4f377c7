"""The map from the autopilot's clock to ours, against simulated clocks whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest

from swarmtrack.sensors.mavlink.clock_map import HARD_RESYNC, MAX_SLEW, ClockMap, supporting_line

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
    assert (np.abs(stretch - 1.0) <= MAX_SLEW + 1e-9).all()


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
    clock_map.observe(10.0, float(truth(10.0)) + 3 * HARD_RESYNC)  # waited in a buffer
    clock_map.observe(10.005, float(truth(10.005)))
    assert clock_map.to_ours(10.005) == pytest.approx(truth(10.005))
    assert clock_map.resyncs == 1


def test_after_a_reboot_nothing_of_the_old_clock_remains():
    clock_map = ClockMap()
    play(clock_map, 15.0, latency=lambda n: np.full(n, 1e-3), skew=500e-6)
    clock_map.reset()
    clock_map.observe(0.5, 5000.5)
    assert clock_map.to_ours(0.5) == pytest.approx(5000.5)
    assert clock_map.skew == 0.0


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
