"""What the lifecycle leaves out because it is sure must not change what it says."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.tracking.lifecycle import probability_in_view, within_reach
from swarmtrack.tracking.priors import MAX_SLANT

CAMERA = PinholeCamera(430.0, 430.0, 320.0, 240.0, 640, 480)


@given(st.integers(0, 2**32 - 1), st.integers(0, 6))
@settings(max_examples=100, deadline=None)
def test_in_view_is_the_product_of_both_axes_wherever_the_target_is(seed, n):
    rng = np.random.default_rng(seed)
    mean, cov = rng.uniform(-300.0, 900.0, (n, 4)), np.zeros((n, 4, 4))
    sigma = 10.0 ** rng.uniform(-1.0, 2.5, (n, 2))
    cov[:, [0, 2], [0, 2]] = sigma**2
    low, high = CAMERA.ideal_bounds
    position = mean[:, ::2]
    expected = (ndtr((high - position) / sigma) - ndtr((low - position) / sigma)).prod(axis=1)
    np.testing.assert_allclose(probability_in_view(mean, cov, CAMERA), expected, rtol=1e-12, atol=1e-15)


def test_a_target_of_unknown_place_is_neither_surely_in_view_nor_within_reach():
    mean = np.array([[320.0, 0.0, 240.0, 0.0], [np.nan, 0.0, 240.0, 0.0]])
    inside = probability_in_view(mean, np.tile(np.eye(4), (2, 1, 1)), CAMERA)
    assert inside[0] == 1.0
    assert not inside[1] > 0.0
    assert within_reach(mean, CAMERA).tolist() == [True, False]


def test_what_grazes_the_image_plane_is_out_of_reach_unless_the_image_shows_it():
    edge = 320.0 + 430.0 * MAX_SLANT
    mean = np.array([[edge - 1.0, 0.0, 240.0, 0.0], [edge + 1.0, 0.0, 240.0, 0.0]])
    assert within_reach(mean, CAMERA).tolist() == [True, False]
    wide = PinholeCamera(50.0, 50.0, 320.0, 240.0, 640, 480)  # its corners look 83 degrees off the axis
    corners = np.array([[0.0, 0.0, 0.0, 0.0], [700.0, 0.0, 500.0, 0.0]])
    assert within_reach(corners, wide).tolist() == [True, False]
    assert within_reach(np.empty((0, 4)), CAMERA).shape == (0,)
