"""A teammate that falls silent keeps its track, however well the motion of others fits, unless it is another's."""

import math

import pytest

from support.observer import SCAN_S, Observer
from swarmtrack.benchmarks.identity.recognition import PARTED, fly
from swarmtrack.tracking import DEFAULT_TRACKER

SILENT_S, CROSSING_S, SWAPPED_S = 8.0, 10.0, 12.0


@pytest.mark.long(
    "11 s of flight of four; benchmarks/test_silent_benchmark.py has silent teams in the default run"
)
def test_two_that_are_silent_are_not_taken_for_one_that_speaks():
    """All four swing to and fro with about the same period: by some error of the own heading each fits each."""
    score = fly(PARTED, 4, 11.0, DEFAULT_TRACKER, seed=1).score
    assert score.wrong == 0.0
    assert score.correct > 0.98


def pixel(drone, t):
    """Drones 2 and 3 change sides within four seconds, and sway a little."""
    over = 300.0 * min(max((t - CROSSING_S) / 4.0, 0.0), 1.0)
    if drone == 2:
        return 170.0 + over + 12.0 * math.sin(0.7 * t), 240.0 + 8.0 * math.sin(0.5 * t)
    return 470.0 - over + 12.0 * math.sin(0.55 * t + 1.0), 246.0 + 8.0 * math.cos(0.6 * t)


def test_one_that_speaks_is_found_in_the_track_of_one_that_is_silent():
    observer = Observer()
    for drone in (2, 3):
        observer.hears(drone, pixel(drone, 0.0))
    names = {}
    while observer.t < 17.0:
        scan = round(observer.t / SCAN_S)
        for drone, due in ((2, 0), (3, 4)):
            if scan % 10 == due and not (drone == 2 and observer.t > SILENT_S):
                observer.is_told(drone, pixel(drone, observer.t))
        places = [pixel(drone, observer.t + SCAN_S) for drone in (2, 3)]
        a, b = places if observer.t <= SWAPPED_S else places[::-1]
        names = observer.sees(SCAN_S, a=a, b=b)
    assert names["a"] == 3
    assert names["b"] != 3


def together(drone, t, swing, passing_s, within_s):
    """Both fly the same curve, abreast, and drone 2 passes drone 3. swing: px to the sides, and rad/s."""
    px, rate = swing
    over = 230.0 * min(max((t - passing_s) / within_s, 0.0), 1.0) if drone == 2 else 150.0
    return (
        150.0 + over + px * math.sin(rate * t),
        240.0 + 6.0 * (drone - 2) + 50.0 * math.sin(0.67 * rate * t),
    )


@pytest.mark.parametrize(
    "flight", [((60.0, 1.5), 15.0, 12.0), ((100.0, 1.2), 20.0, 6.0)], ids=["slowly", "in wide swings"]
)
def test_one_that_is_silent_and_moves_as_another_keeps_its_name_where_they_pass(flight):
    """Also where a segment of the track begins between two bearings, with what had been excused until then."""
    observer, ends_s = Observer(), 4.0 + sum(flight[1:])
    for drone in (2, 3):
        observer.hears(drone, together(drone, 0.0, *flight))
    while observer.t < ends_s:
        scan = round(observer.t / SCAN_S)
        for drone, due in ((2, 0), (3, 4)):
            if scan % 10 == due and not (drone == 2 and observer.t > SILENT_S):
                observer.is_told(drone, together(drone, observer.t, *flight))
        a, b = (together(drone, observer.t + SCAN_S, *flight) for drone in (2, 3))
        names = observer.sees(SCAN_S, a=a, b=b)
        assert names == {"a": 2, "b": 3} or observer.t < 2.0
