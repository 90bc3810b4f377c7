"""How wide boxes are: found again from boxes that were drawn with known widths and errors."""

import math

import numpy as np
import pytest

from swarmtrack.calibration.box_width import Widths, fit_box_width, level_width
from swarmtrack.errors import CalibrationError
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.rotation import BODY_FROM_FORWARD_CAMERA
from swarmtrack.relative.box_width import BoxWidth

TRUE = BoxWidth(
    factor=1.1, padding_px=14.0, drone_sigma=0.15, wander_sigma=0.1, wander_s=1.0, white_sigma=0.05
)
CAMERA = PinholeCamera(430.0, 440.0, 320.0, 240.0, 640, 480)


def drones(n, *, seed=1, seconds=40.0, fps=10.0, near=100.0, far=12.0, outliers=0.03):
    """Boxes of n drones that fly away."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 1.0 / fps)
    found = []
    for _ in range(n):
        x = near * (far / near) ** (t / seconds)
        left = math.exp(-1.0 / fps / TRUE.wander_s)
        wander = np.empty_like(t)
        wander[0] = rng.normal()
        for k in range(1, len(t)):
            wander[k] = left * wander[k - 1] + math.sqrt(1.0 - left**2) * rng.normal()
        off = (
            TRUE.drone_sigma * rng.normal()
            + TRUE.wander_sigma * wander
            + TRUE.white_sigma * rng.normal(size=len(t))
        )
        box = (TRUE.factor * x + TRUE.padding_px) * np.exp(off)
        other = rng.random(len(t)) < outliers
        box[other] *= 4.0
        found.append(Widths(t, x, box))
    return found


def test_widths_and_their_errors_are_found_again():
    found = fit_box_width(drones(40))
    assert found.padded
    assert found.drones_told
    assert found.drones == 40
    width = found.width
    assert width.factor == pytest.approx(TRUE.factor, rel=0.07)
    assert width.padding_px == pytest.approx(TRUE.padding_px, abs=1.5)
    assert width.drone_sigma == pytest.approx(TRUE.drone_sigma, rel=0.3)
    assert width.wander_sigma == pytest.approx(TRUE.wander_sigma, rel=0.25)
    assert width.wander_s == pytest.approx(TRUE.wander_s, rel=0.5)
    assert width.white_sigma == pytest.approx(TRUE.white_sigma, rel=0.3)


def test_one_drone_at_one_distance_tells_neither_padding_nor_what_drones_differ_by():
    found = fit_box_width(drones(1, near=41.0, far=40.0))
    assert not found.padded
    assert not found.drones_told
    assert found.width.padding_px == 0.0
    assert found.width.drone_sigma == BoxWidth().drone_sigma


def test_too_few_boxes_are_said_to_be():
    with pytest.raises(CalibrationError, match="found 50 boxes of drones at a known distance, expected 200"):
        fit_box_width(drones(1, seconds=5.0))
    with pytest.raises(CalibrationError, match="found 0 boxes"):
        fit_box_width([])


def test_a_level_line_is_as_wide_as_it_looks():
    assert level_width(np.array([10.0, 0.0, 0.0]), 0.5, CAMERA, BODY_FROM_FORWARD_CAMERA) == pytest.approx(
        430.0 * 0.05
    )
    assert math.isnan(level_width(np.array([-10.0, 0.0, 0.0]), 0.5, CAMERA, BODY_FROM_FORWARD_CAMERA))


@pytest.mark.parametrize(("key", "value"), [("factor", 0.0), ("padding_px", math.nan), ("white_sigma", -0.1)])
def test_a_width_that_cannot_be_is_refused(key, value):
    with pytest.raises(ValueError, match=rf"box_width\.{key}: found .*, expected a number from"):
        BoxWidth(**{key: value})
