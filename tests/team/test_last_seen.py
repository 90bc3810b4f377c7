"""Where a teammate that says nothing is expected to come back."""

import math

import numpy as np
import pytest

from swarmtrack.geometry import rotation
from swarmtrack.team.last_seen import LastSeenRay
from swarmtrack.team.track_evidence import Bearing

ORIGIN = np.zeros(3)


def bearing(t, azimuth, camera=ORIGIN):
    return Bearing(t, camera, np.zeros(2), np.array([math.cos(azimuth), math.sin(azimuth), 0.0]), 1e-5, 8.0)


def seen(*azimuths, p=1.0):
    ray = None
    for k, azimuth in enumerate(azimuths):
        ray = LastSeenRay.after(ray, 1, bearing(0.5 * k, azimuth), p)
    return ray


def test_the_density_over_all_directions_is_one():
    ray, angle = seen(0.0), np.radians(np.linspace(0.0, 180.0, 20001))
    density = np.array([math.exp(ray.log_density(bearing(0.4, a))) for a in angle])
    assert np.trapezoid(density * 2.0 * math.pi * np.sin(angle), angle) == pytest.approx(1.0, rel=0.05)


def test_it_goes_on_along_its_course():
    ray = seen(0.0, 0.1, 0.2)
    there, back = (ray.log_density(bearing(1.5, 0.2 + turn)) for turn in (0.08, -0.08))
    assert there > back + 1.0


def test_the_longer_ago_the_less_it_says():
    ray = seen(0.0)
    soon, later = (ray.log_density(bearing(t, 0.0)) for t in (0.2, 20.0))
    assert soon > 3.0
    assert later == pytest.approx(-math.log(4.0 * math.pi), abs=1.0)


def test_what_was_hardly_it_says_hardly_anything():
    surely, hardly = (seen(0.0, p=p).log_density(bearing(0.2, 2.0)) for p in (1.0, 0.5))
    assert surely < hardly
    assert hardly == pytest.approx(math.log(0.5 / (4.0 * math.pi)), abs=0.1)


def test_the_own_way_blurs_it():
    still, moved = (
        seen(0.0).log_density(bearing(0.2, 0.0, np.array([0.0, east, 0.0]))) for east in (0.0, 2.0)
    )
    assert moved < still - 3.0


def test_another_track_begins_another_course():
    ray = LastSeenRay.after(seen(0.0, 0.2), 2, bearing(1.0, 0.4), 0.9)
    assert ray.track == 2
    assert not ray.rate.any()


def test_it_turns_along_with_the_axes():
    forward = rotation.from_euler(0.0, 0.0, 0.3)
    turned = seen(0.0, 0.1).turned(forward)
    assert turned.log_density(bearing(0.8, 0.4 + 0.05)) == pytest.approx(
        seen(0.0, 0.1).log_density(bearing(0.8, 0.1 + 0.05))
    )
