"""What people read of a relative state, against closed forms and samples."""

from __future__ import annotations

import math

import numpy as np
import pytest

from swarmtrack.relative.read_out import flat_ellipses, read_out


def test_a_distance_is_as_sure_as_the_position_along_the_line_of_sight():
    cov = np.diag([0.09, 4.0, 4.0, 1.0, 1.0, 1.0])
    read = read_out(np.array([8.0, 0.0, 0.0]), np.array([-0.5, 3.0, 1.0]), cov)
    assert read == pytest.approx((8.0, 0.3, 0.5))


def test_who_flies_across_neither_closes_in_nor_leaves():
    read = read_out(np.array([3.0, 4.0, 0.0]), np.array([-4.0, 3.0, 0.0]), np.eye(6))
    assert read.closing == pytest.approx(0.0)


@pytest.mark.parametrize("bearing_deg", [-80, -45, 0, 10, 89])
def test_the_ellipse_lies_along_the_largest_spread(bearing_deg):
    c, s = math.cos(math.radians(bearing_deg)), math.sin(math.radians(bearing_deg))
    turn = np.array([[c, -s], [s, c]])
    cov = np.zeros((6, 6))
    cov[:2, :2] = turn @ np.diag([4.0, 0.25]) @ turn.T
    long, short, bearing = flat_ellipses(cov[None], 3.0)[0]
    assert (long, short) == pytest.approx((6.0, 1.5))
    assert math.degrees(bearing) == pytest.approx(bearing_deg)


def test_nearly_all_of_what_is_drawn_lies_in_the_ellipse():
    rng = np.random.default_rng(1)
    A = rng.normal(size=(6, 6))
    cov = A @ A.T
    drawn = rng.multivariate_normal(np.zeros(6), cov, 20000)[:, :2]
    long, short, bearing = flat_ellipses(cov[None], 3.0)[0]
    along = drawn @ (math.cos(bearing), math.sin(bearing))
    aside = drawn @ (-math.sin(bearing), math.cos(bearing))
    inside = (along / long) ** 2 + (aside / short) ** 2 < 1.0
    assert inside.mean() == pytest.approx(1.0 - math.exp(-4.5), abs=0.003)
