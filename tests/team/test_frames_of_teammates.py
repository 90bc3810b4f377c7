"""How a teammate's frame stands to that of this drone's rays, by the posterior."""

import math

import numpy as np
import pytest

from support.observer import SCAN_S, Observer
from swarmtrack.geometry import rotation

START = {2: np.array([9.0, -2.5, -1.0]), 3: np.array([9.0, 2.5, 0.5])}
NAMED = {"a": 2, "b": 3}


def place_at(drone, t):
    """A circle for one, and an eight for the other."""
    way = {
        2: (1.5 * math.sin(0.6 * t), 1.5 - 1.5 * math.cos(0.6 * t), 0.3 * math.sin(0.4 * t)),
        3: (1.5 * math.sin(1.0 * t), 1.5 * math.sin(0.5 * t), 0.0),
    }
    return START[drone] + way[drone]


def flown(turn, off, seconds=30.0, *, still=False):
    """Drone 2 says that it started `off` m from where it did, and its compass is off by `turn` rad."""
    observer = Observer()
    back = rotation.from_euler(0.0, 0.0, turn).T

    def said(place):
        return START[2] - off + back @ (place - START[2])

    observer.hears_at(2, START[2] - off)
    observer.hears_at(3, START[3])
    for k in range(round(seconds / SCAN_S)):
        now, places = (
            {drone: START[drone] if still else place_at(drone, t) for drone in START}
            for t in (observer.t, observer.t + SCAN_S)
        )
        if k % 5 == 0:
            observer.is_told_at(2, said(now[2]))
            observer.is_told_at(3, now[3])
        observer.sees(
            SCAN_S, **{name: observer.pixel_of(places[drone], 0.0) for name, drone in NAMED.items()}
        )
    return observer, said


@pytest.mark.parametrize("degrees", [8.0, -8.0, 40.0])
def test_a_frame_that_is_turned_and_shifted_is_found(degrees):
    turn = math.radians(degrees)
    observer, said = flown(turn, np.array([1.0, -1.0, 0.2]))
    assert observer.names() == {"a": 2, "b": 3}
    found = observer.identities.frame(2)
    assert found.turn == pytest.approx(turn, abs=math.radians(4.0))
    for t in (3.0, 7.0, 11.0):
        where, cov = found.place(said(place_at(2, t)))
        error = where - place_at(2, t)
        assert np.linalg.norm(error) < 0.5
        assert error @ np.linalg.solve(cov + 1e-3 * np.eye(3), error) < 16.0


def test_a_frame_that_is_as_announced_is_found_to_be_so():
    observer, _ = flown(0.0, np.zeros(3))
    for drone in (2, 3):
        found = observer.identities.frame(drone)
        assert abs(found.turn) < math.radians(2.0)
        where, _ = found.place(START[drone])
        assert np.linalg.norm(where - START[drone]) < 0.2


def test_of_a_teammate_that_stays_where_it_is_no_more_is_known_than_was_announced():
    observer, _ = flown(0.0, np.zeros(3), still=True)
    found = observer.identities.frame(2)
    assert math.sqrt(found.cov[3, 3]) > math.radians(1.5)


def test_who_is_not_in_view_has_none():
    observer, _ = flown(0.0, np.zeros(3), 5.0)
    assert observer.identities.frame(4) is None
    for _ in range(30):
        observer.sees(SCAN_S)
    assert observer.identities.frame(2) is None
