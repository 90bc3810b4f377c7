"""A reader of `tracks/<id>` and `camera/<id>` makes directions as docs/wire.md says, whatever the lens."""

import math

import numpy as np
import pytest

from swarmtrack.geometry.camera import Equidistant, PinholeCamera, RadTan
from swarmtrack.wire.lens import camera_from, lens_message

LENSES = [
    PinholeCamera(320.0, 321.0, 319.5, 239.5, 640, 480),
    PinholeCamera(458.0, 457.0, 367.0, 248.0, 752, 480, RadTan((-0.28, 0.07, 0.0, 0.0))),
    # Below and above 80 degrees in the corner, and one that is not in its middle.
    PinholeCamera(300.0, 300.0, 319.5, 239.5, 640, 480, Equidistant((0.01, 0.0, 0.0, 0.0))),
    PinholeCamera(280.0, 280.0, 319.5, 239.5, 640, 480, Equidistant((0.01, 0.0, 0.0, 0.0))),
    PinholeCamera(300.0, 300.0, 260.0, 239.5, 640, 480, Equidistant((0.01, 0.0, 0.0, 0.0))),
    PinholeCamera(193.0, 191.0, 319.5, 310.0, 640, 640, Equidistant((0.0034, 7.65e-4, -8.2e-4, 1.1e-4))),
]


def is_wide(lens):
    """docs/wire.md, in Python."""
    if lens.distortion != "equidistant":
        return False
    theta, k = math.radians(80.0), lens.coefficients
    s = theta * theta
    edge = theta * (1 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3]))))
    u = max(lens.cx + 0.5, lens.width - 0.5 - lens.cx) / lens.fx
    v = max(lens.cy + 0.5, lens.height - 0.5 - lens.cy) / lens.fy
    return edge < math.hypot(u, v)


@pytest.mark.parametrize("camera", LENSES)
def test_a_track_has_the_direction_that_its_reader_computes(camera):
    message = lens_message(camera)
    assert camera_from(message) == camera
    assert is_wide(message) == camera.is_wide
    image = np.random.default_rng(1).uniform([5.0, 5.0], [camera.width - 5.0, camera.height - 5.0], (50, 2))
    pixels, rays = camera.undistort(image), camera.bearing(image)
    seen = np.isfinite(rays).all(axis=1)
    assert seen.sum() > 30
    for (u_px, v_px), ray in zip(pixels[seen], rays[seen], strict=True):
        x, y = (u_px - message.cx) / message.fx, (v_px - message.cy) / message.fy
        q = (x * x + y * y) / 4.0
        found = np.array([x, y, 1.0 - q if is_wide(message) else 1.0])
        assert np.allclose(found / np.linalg.norm(found), ray, atol=1e-9)


def test_the_lenses_of_the_list_are_of_both_kinds():
    assert [camera.is_wide for camera in LENSES] == [False, False, False, True, True, True]
