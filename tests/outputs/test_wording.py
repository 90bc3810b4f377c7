"""What the flight says of the mounting of cameras, in words (outputs/wording.py)."""

import math

import numpy as np

from swarmtrack.cameras.picture_turn import MountingNews
from swarmtrack.cameras.seams import FoundTurn, SeamNews
from swarmtrack.carried.own_place import CarriedNews
from swarmtrack.geometry import rotation
from swarmtrack.outputs.wording import describe


def test_a_camera_that_is_turned_is_said_with_the_angles_that_would_fit():
    fits = rotation.from_euler(0.0, 0.0, math.radians(92.0)) @ rotation.BODY_FROM_FORWARD_CAMERA
    turn = FoundTurn(np.array([0.0, math.radians(-2.0), 0.0]), math.radians(0.2), 9)
    said = describe(SeamNews(0, 1, turn, fits))
    assert said.startswith("cameras 1 and 2 are turned by 2.0° against the config")
    assert said.endswith("9 times. If camera 1 is right, rpy_deg = [0, 0, 92] would fit camera 2")


def test_a_camera_of_which_only_an_overlap_tells_says_so():
    fits = rotation.from_euler(0.0, 0.0, math.radians(92.0)) @ rotation.BODY_FROM_FORWARD_CAMERA
    turn = FoundTurn(np.array([0.0, math.radians(-2.0), 0.0]), math.radians(0.2), 0, 300)
    said = describe(SeamNews(0, 1, turn, fits))
    assert (
        "by teammates that both show. If camera 1 is right, rpy_deg = [0, 0, 92] would fit camera 2" in said
    )


def test_cameras_that_do_not_fit_together_make_one_think_of_the_cables():
    said = describe(SeamNews(1, 3, None, None))
    assert said.startswith("cameras 2 and 4 do not match")
    assert "cables swapped" in said
    assert "upside down" in said


def test_a_camera_whose_picture_turns_the_wrong_way_is_said_with_what_may_be_wrong():
    said = describe(MountingNews(9.0, 1, fits=False, like=None))
    assert said.startswith("the picture of camera 2 turns against the gyro: is it upside down")
    assert said.endswith("Its tracks get no names meanwhile")
    swapped = describe(MountingNews(9.0, 1, fits=False, like=0))
    assert "turns as camera 1 should: are their cables swapped?" in swapped
    assert "again" in describe(MountingNews(9.0, 1, fits=True, like=None))


def test_a_carried_drone_is_said_with_its_holders_and_its_sigma():
    assert describe(CarriedNews(9.0, (1, 3), 0.41)) == (
        "our position: our autopilot has none, held by 1 and 3, ±0.4 m"
    )
    off = describe(CarriedNews(9.0, (2,), 0.2, 1.62))
    assert off == "our position: our autopilot is 1.6 m off, held by 2, ±0.2 m"
    assert "held by nobody, ±12 m and growing: only what is relative counts" in describe(
        CarriedNews(9.0, (), 12.2)
    )
    assert describe(CarriedNews(9.0, None)) == "our autopilot's position counts again"
