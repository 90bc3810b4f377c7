"""The charts: numeric derivatives, rotations of the rays as the independent witness, and limits."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmtrack.geometry import rotation
from swarmtrack.geometry.charts import Gnomonic, Stereographic, cross

CHARTS = [Gnomonic(300.0, 320.0, 310.0, 250.0), Stereographic(200.0, 190.0, 320.0, 300.0)]
FARTHEST = {Gnomonic: 75.0, Stereographic: 140.0}
ANGLES = st.floats(-1.5, 1.5)


def some_rays(chart, n=60, seed=4, farthest=None):
    rng = np.random.default_rng(seed)
    off = np.radians(rng.uniform(0.0, farthest or FARTHEST[type(chart)], n))
    about = rng.uniform(-math.pi, math.pi, n)
    return np.column_stack([np.sin(off) * np.cos(about), np.sin(off) * np.sin(about), np.cos(off)])


def pixels_of(chart, rays):
    places, _, valid = chart.places(rays)
    assert valid.all()
    return chart.denormalised(places)


def moving_of(pixels, motion):
    return np.stack([pixels.T, motion.T], axis=1)


def numeric(f, x, step=1e-6):
    """d f / d x (n, m, k) of f: (n, k) -> (n, m), by central differences."""
    steps = step * np.eye(x.shape[1])
    return np.stack([(f(x + h) - f(x - h)) / (2.0 * step) for h in steps], axis=-1)


@pytest.fixture(params=CHARTS, ids=lambda chart: type(chart).__name__)
def chart(request):
    return request.param


def test_a_ray_has_a_place_and_comes_back(chart):
    rays = some_rays(chart)
    places, _, _ = chart.places(7.0 * rays)
    assert np.allclose(chart.rays(places), rays, atol=1e-14)


def test_the_radius_is_m_f_tan_of_the_mth_of_the_angle(chart):
    off = np.radians([10.0, 50.0, 74.0])
    places, _, _ = chart.places(np.column_stack([np.sin(off), 0.0 * off, np.cos(off)]))
    assert places[:, 0] == pytest.approx(chart.halves * np.tan(off / chart.halves))


def test_what_the_charts_say_of_small_changes_is_what_happens(chart):
    rays = some_rays(chart)
    points = np.random.default_rng(1).uniform(0.5, 40.0, (len(rays), 1)) * rays
    places, by_point, _ = chart.places(points)
    assert np.allclose(by_point, numeric(lambda p: chart.places(p)[0], points), rtol=1e-5, atol=1e-6)
    assert np.allclose(chart.rays_by_place(places), numeric(chart.rays, places), atol=1e-8)
    pixels = chart.denormalised(places)

    def after(angle):
        return np.concatenate([pixels_of(chart, rays @ rotation.exp(-angle[0]).T)]).reshape(1, -1)

    flow = numeric(after, np.zeros((1, 3))).reshape(-1, 2, 3)
    assert np.allclose(chart.flow(pixels), flow, rtol=1e-5, atol=1e-4)
    angle = np.array([0.2, -0.5, 0.7])
    gradient = numeric(lambda p: chart.flow(p) @ angle, pixels, step=1e-3)
    assert np.allclose(chart.flow_gradient(pixels, angle), gradient, rtol=1e-6, atol=1e-8)


def test_the_flow_of_an_error_is_that_of_the_flow(chart):
    pixels = pixels_of(chart, some_rays(chart))
    cov = np.zeros((len(pixels), 4, 4))
    chart.add_flow_of_error(cov, pixels, 0.3)
    flow = chart.flow(pixels)
    assert np.allclose(cov[:, ::2, ::2], 0.3 * flow @ flow.swapaxes(1, 2), rtol=1e-9, atol=1e-6)


@given(st.tuples(ANGLES, ANGLES, ANGLES), st.sampled_from(CHARTS))
def test_a_turn_moves_places_as_it_moves_rays_and_its_derivatives_are_the_numeric_ones(angle, chart):
    R = rotation.exp(np.array(angle))
    rays = some_rays(chart)
    turned = rays @ R.T
    # Away from where either picture must end.
    limit = math.cos(math.radians(FARTHEST[type(chart)]))
    rays, turned = rays[turned[:, 2] > limit], turned[turned[:, 2] > limit]
    pixels = pixels_of(chart, rays)
    motion = np.random.default_rng(2).normal(0.0, 30.0, pixels.shape)
    found = chart.turn(moving_of(pixels, motion), R)
    assert np.allclose(found.moving[:, 0].T, pixels_of(chart, turned), rtol=1e-9, atol=1e-6)

    def place(p):
        return chart.turn(moving_of(p, motion), R).moving[:, 0].T

    def moved(p):
        return chart.turn(moving_of(p, motion), R).moving[:, 1].T

    J, bend = numeric(place, pixels, 1e-4), numeric(moved, pixels, 1e-4)
    assert np.allclose(found.by_state[:, ::2, ::2], J, rtol=1e-4, atol=1e-4)
    assert np.allclose(found.by_state[:, 1::2, ::2], bend, rtol=1e-4, atol=1e-4)
    assert np.array_equal(found.by_state[:, 1::2, 1::2], found.by_state[:, ::2, ::2])
    assert not found.by_state[:, ::2, 1::2].any()
    assert np.allclose(found.moving[:, 1].T, (J @ motion[:, :, None])[:, :, 0], rtol=1e-4, atol=1e-3)


def test_what_turns_straight_behind_is_held_far_outside():
    chart = CHARTS[1]
    middle = np.array([[[320.0, 321.0, 400.0], [0.0, 1.0, 2.0]], [[300.0, 300.0, 290.0], [0.0, 0.0, 0.0]]])
    turned = chart.turn(middle, rotation.exp([math.pi, 0.0, 0.0])).moving
    assert np.isfinite(turned).all()
    away = np.linalg.norm(turned[:, 0, :2].T - [320.0, 300.0], axis=1)
    assert (away > 7.0 * chart.fx).all()


def test_a_stereographic_pixel_is_stretched_alike_all_ways(chart):
    if isinstance(chart, Gnomonic):
        pytest.skip("the tangent plane is not")
    rays = some_rays(chart)
    pixels = pixels_of(chart, rays)
    by = chart.rays_by_place(chart.normalised(pixels))
    lengths = np.linalg.norm(by, axis=1)
    assert np.allclose(lengths[:, 0], lengths[:, 1])
    assert np.allclose(np.einsum("nij,nij->nj", by, by[:, :, ::-1]), 0.0, atol=1e-12)
    assert np.allclose(chart.per_radian(pixels), [chart.fx, chart.fy] / lengths)
    ninety_five = chart.denormalised(np.array([[2.0 * math.tan(math.radians(47.5)), 0.0]]))
    assert chart.per_radian(ninety_five)[0, 0] / chart.fx == pytest.approx(2.19, abs=0.01)


def test_the_angle_that_a_square_pixel_covers(chart):
    pixels = pixels_of(chart, some_rays(chart))
    by = chart.rays_by_place(chart.normalised(pixels))
    area = np.linalg.norm(np.cross(by[:, :, 0], by[:, :, 1]), axis=1) / (chart.fx * chart.fy)
    assert np.allclose(chart.solid_angle(pixels), area)


@pytest.mark.parametrize("way", [(0, 1), (1, 0), (0, 0), (1, 1)])
def test_from_one_chart_to_another_a_direction_stays_and_so_does_its_motion(way):
    here, there = (CHARTS[k] for k in way)
    rays = some_rays(here, farthest=70.0)
    pixels, motion = pixels_of(here, rays), np.random.default_rng(2).normal(0.0, 30.0, (len(rays), 2))
    found = cross(moving_of(pixels, motion), here, there)
    assert np.allclose(found.moving[:, 0].T, pixels_of(there, rays), atol=1e-8)
    J = numeric(lambda p: cross(moving_of(p, motion), here, there).moving[:, 0].T, pixels, 1e-4)
    bend = numeric(lambda p: cross(moving_of(p, motion), here, there).moving[:, 1].T, pixels, 1e-4)
    assert np.allclose(found.by_state[:, ::2, ::2], J, rtol=1e-5, atol=1e-5)
    assert np.allclose(found.by_state[:, 1::2, ::2], bend, rtol=1e-4, atol=1e-5)
    assert np.array_equal(found.by_state[:, 1::2, 1::2], found.by_state[:, ::2, ::2])
    assert not found.by_state[:, ::2, 1::2].any()
    assert np.allclose(found.moving[:, 1].T, (J @ motion[:, :, None])[:, :, 0], rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("squared", [0.0, 0.1, 1.0, 2.5])
def test_the_radial_factors_derivatives_are_the_numeric_ones(chart, squared):
    q, h = np.array([squared]), 1e-5
    _, first, second = chart.radial(q)
    assert first == pytest.approx((chart.radial(q + h)[0] - chart.radial(q - h)[0]) / (2 * h), rel=1e-6)
    assert second == pytest.approx((chart.radial(q + h)[1] - chart.radial(q - h)[1]) / (2 * h), rel=1e-6)


def test_beyond_its_reach_and_without_a_direction_nothing_has_a_place(chart):
    points = np.array([[0, 0, -1.0], [0, 0, 0], [np.nan, 0, 1], [0.1, 0.1, -1.0], [0, 0, 2.0]])
    assert chart.places(points)[2].tolist() == [False] * 4 + [True]
