"""The camera against OpenCV as the independent witness, numeric derivatives, and round trips."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmtrack.geometry.camera import WIDE_LENS_RAD, WIDEST_LENS_RAD, Equidistant, PinholeCamera, RadTan

CAMERAS = {
    "ideal": PinholeCamera(600.0, 610.0, 320.0, 256.0, 640, 512),
    "euroc": PinholeCamera(
        458.654, 457.296, 367.215, 248.375, 752, 480,
        RadTan((-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)),
    ),
    "barrel": PinholeCamera(420.0, 420.0, 319.5, 239.5, 640, 480, RadTan((-0.34, 0.13, 1e-3, -2e-3, -0.022))),
    "pincushion": PinholeCamera(700.0, 700.0, 330.0, 230.0, 640, 480, RadTan((0.3, 0.2, -2e-3, 1e-3))),
    "rational": PinholeCamera(
        608.2, 608.1, 638.7, 366.9, 1280, 720,
        RadTan((0.62, -2.73, 6e-4, -2e-4, 1.61, 0.50, -2.55, 1.53)),
    ),
    "fisheye": PinholeCamera(
        190.98, 190.97, 254.93, 256.90, 512, 512, Equidistant((0.0034, 7.65e-4, -8.2e-4, 1.1e-4))
    ),
}  # fmt: skip
DISTORTED = [name for name in CAMERAS if name != "ideal"]


@pytest.fixture(params=CAMERAS)
def camera(request):
    return CAMERAS[request.param]


def pixels_of(camera, n=400, seed=0):
    return np.random.default_rng(seed).uniform([0, 0], [camera.width - 1, camera.height - 1], (n, 2))


def points_seen_by(camera, n=400, seed=1):
    """Points [m] whose image lies within the frame."""
    depth = np.random.default_rng(seed).uniform(0.5, 80.0, (n, 1))
    bearing = camera.bearing(pixels_of(camera, n, seed))
    return (depth * bearing)[np.isfinite(bearing).all(axis=1)]


def opencv_projection(camera, points):
    zero = np.zeros(3)
    if isinstance(camera.distortion, Equidistant):
        k = np.array(camera.distortion.coefficients)
        return cv2.fisheye.projectPoints(points[:, None], zero, zero, camera.K, k)[0][:, 0]
    k = np.array(camera.distortion.coefficients if camera.distortion else (0.0,) * 4)
    return cv2.projectPoints(points[:, None], zero, zero, camera.K, k)[0][:, 0]


def numeric_jacobian(f, x, step=1e-6):
    """d f / d x by central differences, row by row: f (n, k) -> (n, m), answer (n, m, k)."""
    columns = []
    for axis in range(x.shape[1]):
        h = np.zeros(x.shape[1])
        h[axis] = step
        columns.append((f(x + h) - f(x - h)) / (2 * step))
    return np.stack(columns, axis=-1)


def test_projection_is_opencvs(camera):
    points = points_seen_by(camera)
    pixels, _, valid = camera.project(points)
    assert len(points) > 300
    assert valid.all()
    # OpenCV's fisheye takes the angle from x/z and y/z: it knows nothing beyond 90 degrees.
    ahead = points[:, 2] > 0.0
    assert ahead.all() or camera.is_wide
    assert np.allclose(pixels[ahead], opencv_projection(camera, points[ahead]), atol=1e-8)


def test_jacobians_are_the_numeric_ones(camera):
    points = points_seen_by(camera, 50)
    pixels, jacobian, _ = camera.project(points)
    assert np.allclose(
        jacobian, numeric_jacobian(lambda p: camera.project(p)[0], points), rtol=1e-5, atol=1e-4
    )
    _, ideal_jacobian, _ = camera.project_undistorted(points)
    numeric = numeric_jacobian(lambda p: camera.project_undistorted(p)[0], points)
    assert np.allclose(ideal_jacobian, numeric, rtol=1e-5, atol=1e-4)
    for f, answer in (
        (camera.undistort, camera.undistort_jacobian),
        (camera.bearing, camera.bearing_jacobian),
    ):
        numeric = numeric_jacobian(f, pixels, step=1e-4)
        assert np.allclose(answer(pixels), numeric, rtol=1e-5, atol=1e-7)


def test_undistortion_and_distortion_undo_each_other_all_over_the_image(camera):
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.column_stack([u.ravel(), v.ravel()]).astype(float)
    ideal = camera.undistort(pixels)
    reached = np.isfinite(ideal).all(axis=1)
    # Corners of a fisheye image lie outside the image circle; no other camera here may lose a pixel.
    assert reached.all() or isinstance(camera.distortion, Equidistant)
    assert reached.mean() > 0.75
    assert np.abs(camera.distort(ideal[reached]) - pixels[reached]).max() < 1e-9


@given(
    name=st.sampled_from(list(CAMERAS)), u=st.floats(0.1, 0.9), v=st.floats(0.1, 0.9), z=st.floats(0.1, 500)
)
def test_a_pixel_lifted_to_any_depth_projects_onto_itself(name, u, v, z):
    camera = CAMERAS[name]
    pixel = np.array([[u * camera.width, v * camera.height]])
    bearing = camera.bearing(pixel)
    assert np.linalg.norm(bearing) == pytest.approx(1.0, abs=1e-12)
    back, _, valid = camera.project(z * bearing)
    assert valid.all()
    assert np.allclose(back, pixel, atol=1e-6)
    ideal, _, _ = camera.project_undistorted(z * bearing)
    assert np.allclose(ideal, camera.undistort(pixel), atol=1e-6)
    assert np.allclose(camera.bearing_undistorted(ideal), bearing, atol=1e-12)


@given(
    st.tuples(*(st.floats(-limit, limit) for limit in (0.5, 0.3, 0.01, 0.01, 0.1))),
    st.floats(-1.5, 1.5),
    st.floats(-1.5, 1.5),
)
def test_any_lens_is_undone_within_its_reach_and_answers_nan_beyond(coefficients, x, y):
    camera = PinholeCamera(500.0, 500.0, 320.0, 240.0, 640, 480, RadTan(coefficients))
    ideal = np.array([[320 + 500 * x, 240 + 500 * y]])
    distorted = camera.distort(ideal)
    back = camera.undistort(distorted)
    reach = camera.distortion.max_radius
    if np.hypot(x, y) > 1.001 * reach:
        assert np.isnan(distorted).all()
        assert np.isnan(back).all()
    elif np.hypot(x, y) < 0.999 * reach:
        assert np.allclose(back, ideal, atol=1e-6)


def test_no_two_points_within_a_lens_reach_share_a_pixel():
    # Decentred so strongly that the image folds on one side long before the radial curve turns.
    lens = RadTan((-0.3, 0.05, 0.01, -0.02, 0.0))
    camera = PinholeCamera(500.0, 500.0, 320.0, 240.0, 640, 480, lens)
    angle, radius = np.meshgrid(np.linspace(0, 2 * np.pi, 90), np.linspace(0, 0.999 * lens.max_radius, 60))
    rays = np.column_stack([(radius * np.cos(angle)).ravel(), (radius * np.sin(angle)).ravel()])
    ideal = rays * 500.0 + [320.0, 240.0]
    assert np.allclose(camera.undistort(camera.distort(ideal)), ideal, atol=1e-6)
    centre_only = RadTan((-0.3, 0.05, 0.0, 0.0, 0.0))
    assert lens.max_radius < centre_only.max_radius


def test_a_rational_lens_ends_at_its_pole():
    lens = RadTan((0.84, -0.62, -1e-3, 2e-3, -0.25, 0.56, 0.04, -0.57))
    assert 1.0 + lens.max_radius**2 * (0.56 + lens.max_radius**2 * (0.04 - 0.57 * lens.max_radius**2)) > 0.0


@pytest.mark.parametrize("name", DISTORTED)
def test_points_beyond_the_lens_models_fold_are_not_valid(name):
    camera = CAMERAS[name]
    just_within, beyond = 0.999 * camera.reach, camera.reach + 0.03 * (math.radians(120.0) - camera.reach)
    points = np.array(
        [[math.sin(off) * x, math.sin(off) * y, math.cos(off)]
         for off, x, y in ((just_within, 1, 0), (beyond, 1, 0), (beyond, 0, 1))]
    )  # fmt: skip
    pixels, jacobian, valid = camera.project(points)
    assert valid.tolist() == [True, False, False]
    assert np.isnan(pixels[1:]).all()
    assert np.isnan(jacobian[1:]).all()


def test_what_is_behind_the_camera_or_not_a_number_is_flagged(camera):
    points = np.array(
        [[0, 0, -1.0], [0, 0, 0], [1, 1, -5], [np.nan, 0, 1], [0, 0, np.inf], [1, 0, 1e-300], [0, 0, 2]]
    )
    for project in (camera.project, camera.project_undistorted):
        pixels, jacobian, valid = project(points)
        assert valid[-1]
        assert not valid[[0, 1, 2, 3]].any()
        # 90 degrees off the axis is nothing to a wide lens.
        assert valid[5] == camera.is_wide
        assert np.isfinite(pixels[valid]).all()
        assert np.isfinite(jacobian[valid]).all()
        assert np.isnan(pixels[~valid]).all()
    assert np.isnan(camera.undistort(np.array([[np.nan, 3.0]]))).any()
    assert not camera.contains(np.array([[np.nan, 3.0]])).any()


def test_no_points_is_an_ordinary_input(camera):
    none = np.empty((0, 2))
    pixels, jacobian, valid = camera.project(np.empty((0, 3)))
    assert (pixels.shape, jacobian.shape, valid.shape) == ((0, 2), (0, 2, 3), (0,))
    assert camera.undistort(none).shape == camera.distort(none).shape == (0, 2)
    assert camera.undistort_jacobian(none).shape == (0, 2, 2)
    assert camera.bearing(none).shape == (0, 3)
    assert camera.bearing_jacobian(none).shape == (0, 3, 2)
    assert camera.contains(none).shape == (0,)


def test_a_pixels_area_belongs_to_the_image_to_its_edge(camera):
    w, h = camera.width, camera.height
    edges = np.array([[-0.5, -0.5], [w - 0.5, h - 0.5], [-0.6, 0], [0, h - 0.4]])
    assert camera.contains(edges).tolist() == [True, True, False, False]
    assert camera.contains(edges, margin=1.0).all()
    assert not camera.contains(edges, margin=-1.0).any()


def test_a_scaled_camera_sees_the_same_ray_in_the_resized_pixel(camera):
    half = camera.scaled(camera.width // 2, camera.height // 2)
    pixels = pixels_of(camera, 20)
    resized = (pixels + 0.5) / 2 - 0.5
    assert np.allclose(half.bearing(resized), camera.bearing(pixels), atol=1e-12, equal_nan=True)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"fx": 0.0}, "fx: 0.0, expected a focal length"),
        ({"fy": float("nan")}, "fy: nan, expected a focal length"),
        ({"cx": float("inf")}, "cx: inf, expected a finite"),
        ({"width": 0}, "width: 0, expected a whole number"),
        ({"height": 480.5}, "height: 480.5, expected a whole number"),
    ],
)
def test_wrong_intrinsics_are_refused_by_name(change, words):
    numbers = {"fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0, "width": 2, "height": 2}
    with pytest.raises(ValueError, match=words):
        PinholeCamera(**{**numbers, **change})


def test_wrong_numbers_of_coefficients_are_refused():
    with pytest.raises(ValueError, match="expected finite numbers, 4"):
        RadTan((0.1, 0.2, 0.3))
    with pytest.raises(ValueError, match="expected 4 finite numbers"):
        Equidistant((0.1, 0.2, 0.3, float("nan")))


@pytest.mark.parametrize(
    "distortion", [None, RadTan((-0.28, 0.07, 0.001, 0.0)), Equidistant((0.0, 0.0, 0.0, 0.0))]
)
def test_the_ideal_bounds_hold_all_that_the_image_shows_and_little_more(distortion):
    camera = PinholeCamera(300.0, 310.0, 322.0, 238.0, 640, 480, distortion)
    rng = np.random.default_rng(3)
    shown = camera.undistort(rng.uniform([-0.5, -0.5], [639.5, 479.5], (20_000, 2)))
    low, high = camera.ideal_bounds
    assert ((shown >= low) & (shown <= high)).all()
    assert np.abs([shown.min(axis=0) - low, shown.max(axis=0) - high]).max() < 0.03 * (high - low).max()


def test_the_ideal_bounds_of_an_image_wider_than_its_lens_model_end_with_the_model():
    camera = PinholeCamera(150.0, 150.0, 320.0, 240.0, 640, 480, Equidistant((0.0, 0.0, 0.0, 0.0)))
    assert np.isnan(camera.undistort(np.array([[0.0, 0.0]]))).all()
    low, high = camera.ideal_bounds
    reach = 150.0 * 2.0 * math.tan(WIDEST_LENS_RAD / 2.0)
    assert low == pytest.approx([320.0 - reach, 240.0 - reach])
    assert high == pytest.approx([320.0 + reach, 240.0 + reach])


# --- a wide lens: undistorted pixels are stereographic ---

KB = (0.0034, 7.65e-4, -8.2e-4, 1.1e-4)
WIDE_LENS = PinholeCamera(193.0, 191.0, 319.5, 317.0, 640, 640, Equidistant(KB))


def at_angle(degrees, about=0.0):
    off, about = np.radians(degrees), np.radians(about)
    return np.stack(
        np.broadcast_arrays(np.sin(off) * np.cos(about), np.sin(off) * np.sin(about), np.cos(off)), axis=-1
    ).reshape(-1, 3)


def test_a_lens_is_wide_whose_corners_show_more_than_80_degrees_and_no_other():
    widths = [640, 480, 320]
    for width in widths:
        camera = PinholeCamera(190.0, 190.0, 0.5 * width - 0.5, 119.5, width, 240, Equidistant((0.0,) * 4))
        assert camera.is_wide == (math.hypot(width, 240) / 380.0 > WIDE_LENS_RAD)
    for lens in (None, RadTan((-0.28, 0.07, 0.0, 0.0)), Equidistant((-0.2, 0.0, 0.0, 0.0))):
        # The last one folds at 74 degrees.
        assert not PinholeCamera(100.0, 100.0, 319.5, 239.5, 640, 480, lens).is_wide


def test_a_wide_lens_shows_what_is_behind_the_camera_and_takes_it_back():
    rays = at_angle(np.linspace(0.0, 109.0, 50), np.linspace(0.0, 350.0, 50))
    image, _, valid = WIDE_LENS.project(4.0 * rays)
    assert valid.all()
    assert np.allclose(WIDE_LENS.bearing(image), rays, atol=1e-12)
    ideal = WIDE_LENS.undistort(image)
    radius = np.linalg.norm((ideal - [319.5, 317.0]) / [193.0, 191.0], axis=1)
    assert radius == pytest.approx(2.0 * np.tan(0.5 * np.arccos(rays[:, 2])), abs=1e-9)
    assert np.allclose(WIDE_LENS.project_undistorted(rays)[0], ideal, atol=1e-9)
    assert np.allclose(WIDE_LENS.bearing_undistorted(ideal), rays, atol=1e-12)
    # The image is the polynomial of the angle, whatever z is.
    theta = np.arccos(rays[:, 2])
    theta_d = theta * (1 + sum(k * theta ** (2 * n) for n, k in enumerate(KB, start=1)))
    found = np.linalg.norm((image - [319.5, 317.0]) / [193.0, 191.0], axis=1)
    assert found == pytest.approx(theta_d, abs=1e-12)


def test_the_field_of_a_wide_lens_is_that_of_its_edges():
    camera = PinholeCamera(193.0, 193.0, 319.5, 319.5, 640, 640, Equidistant((0.0,) * 4))
    assert np.degrees(camera.field) == pytest.approx([190.0, 190.0], abs=0.1)
    assert np.degrees(PinholeCamera(320.0, 320.0, 319.5, 239.5, 640, 480).field[0]) == pytest.approx(90.0)


def test_the_plane_of_a_wide_lens_image_goes_on_smoothly_beyond_its_reach():
    place = np.array(
        [[2.0 * math.tan(math.radians(off) / 2.0), 0.3] for off in (20.0, 80.0, 109.0, 112.0, 130.0)]
    )
    pixels = place * [193.0, 191.0] + [319.5, 317.0]
    at, scale = WIDE_LENS.framed(pixels)
    assert (np.diff(at[:, 0]) > 0.0).all()
    assert np.isnan(WIDE_LENS.distort(pixels[3:])).all()
    assert np.allclose(WIDE_LENS.distort(pixels[:3]), at[:3])
    by_pixel = numeric_jacobian(lambda p: WIDE_LENS.framed(p).at, pixels, step=1e-4)
    assert np.allclose(scale, np.linalg.norm(by_pixel, axis=2), rtol=1e-5)
    assert np.allclose(WIDE_LENS.rays_in_frame(at[:3]), WIDE_LENS.bearing_undistorted(pixels[:3]))


def test_a_box_of_a_wide_image_covers_an_angle_that_its_place_tells():
    rays = at_angle(np.array([5.0, 60.0, 94.0]), np.array([0.0, 30.0, 90.0]))
    pixels = WIDE_LENS.project_undistorted(rays)[0]
    image = WIDE_LENS.distort(pixels)
    angle = np.linalg.norm(WIDE_LENS.bearing_jacobian(image), axis=1)
    assert np.allclose(1.0 / WIDE_LENS.box_per_radian(pixels), angle, rtol=1e-9)
    ordinary = CAMERAS["ideal"]
    assert ordinary.box_per_radian(pixels).tolist() == ordinary.per_radian(pixels).tolist() == [600.0, 610.0]
