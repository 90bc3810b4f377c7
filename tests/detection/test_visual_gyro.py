"""Images tell how a camera has turned, and own up to it where they do not."""

import numpy as np
import pytest

from swarmtrack.benchmarks import visual_gyro as bench
from swarmtrack.detection.visual_gyro import VisualGyro
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.lab.world.hand_turned import Room
from swarmtrack.messages import Frame, StampKind
from swarmtrack.motion.priors import UNKNOWN_ANGLE_VARIANCE_RAD2

LENS = PinholeCamera(215.0, 215.0, 159.5, 119.5, 320, 240)
FORWARD = rotation.BODY_FROM_FORWARD_CAMERA


def turns(images):
    """Of frames at 10 Hz, without the first one's, which is None."""
    gyro = VisualGyro(LENS)
    seen = [gyro.turn_to(Frame(0.1 * k, 0.0, k, image, StampKind.EXPOSURE)) for k, image in enumerate(images)]
    assert seen[0] is None
    return seen[1:]


def is_unknown(turn):
    return turn.variance == UNKNOWN_ANGLE_VARIANCE_RAD2


def room():
    return Room(np.random.default_rng(3), LENS)


def looks(yaw=0.0, pitch=0.0, roll=0.0):
    return rotation.from_euler(roll, pitch, yaw) @ FORWARD


@pytest.mark.parametrize("by", [(0.0, 0.0, 0.0), (0.2, 0.0, 0.0), (-0.05, 0.04, 0.1)])
def test_a_turn_about_any_axis_is_measured_to_a_third_of_a_pixel(by):
    before, after = looks(), looks(*by)
    (turn,) = turns([room().image(pose, np.zeros(3)) for pose in (before, after)])
    assert np.linalg.norm(turn.turn - rotation.log(before.T @ after)) * LENS.fx < 0.33
    assert np.sqrt(turn.variance) * LENS.fx < 0.5


def test_what_is_burned_into_the_picture_is_outvoted():
    images = [room().image(pose, np.zeros(3)).copy() for pose in (looks(), looks(0.1))]
    for image in images:
        image[20:24, 20:300:6] = 255
        image[210:214, 20:300:6] = 255
    (turn,) = turns(images)
    assert turn.turn == pytest.approx([0.0, 0.1, 0.0], abs=2e-3)


@pytest.mark.parametrize("noise", [0.0, 2.0, 8.0])
def test_before_a_clear_sky_nothing_is_known_although_a_drone_flies_there(noise):
    rng = np.random.default_rng(0)
    images = []
    for k in range(4):
        image = np.linspace(150.0, 220.0, 240)[:, None] + rng.normal(0.0, noise, (240, 320))
        image[100:108, 50 + 4 * k : 70 + 4 * k] = 30.0
        images.append(np.clip(image, 0, 255).astype(np.uint8))
    assert all(map(is_unknown, turns(images)))


def test_a_step_aside_in_a_room_costs_certainty():
    stands, steps = (
        [room().image(looks(), np.array([0.0, y, 0.0])) for y in way] for way in ((0, 0), (0, 0.1))
    )
    (still,), (aside,) = turns(stands), turns(steps)
    assert aside.variance > 30.0 * still.variance


def test_a_clock_that_goes_back_or_another_size_starts_again():
    gyro, image = VisualGyro(LENS), room().image(looks(), np.zeros(3))
    frames = [Frame(t, 0.0, k, image, StampKind.EXPOSURE) for k, t in enumerate((1.0, 0.5, 0.6))]
    assert [gyro.turn_to(frame) is None for frame in frames] == [True, True, False]
    assert gyro.turn_to(Frame(0.7, 0.0, 3, image[:200], StampKind.EXPOSURE)) is None


def test_in_drawn_flights_the_error_is_small_and_the_claim_honest():
    found = bench.measure("fast-yaw", 1)
    assert np.nanmedian(found.error) < 0.3
    assert np.isnan(found.error).mean() < 0.05
    assert 0.1 < np.nanmean(found.claim) < 1.5


@pytest.mark.parametrize(
    "image", [np.zeros((0, 0), np.uint8), np.zeros((20, 300, 3), np.uint8), np.zeros((240, 320))]
)
def test_what_is_no_image_is_skipped(image):
    gyro = VisualGyro(LENS)
    for k, one in enumerate((image, room().image(looks(), np.zeros(3)), image)):
        assert gyro.turn_to(Frame(0.1 * k, 0.0, k, one, StampKind.EXPOSURE)) is None
