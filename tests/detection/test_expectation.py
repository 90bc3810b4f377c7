"""Where the detector is told to look in the frames of each of several cameras."""

import math

import numpy as np
import pytest

from swarmtrack.detection.detector import Detector
from swarmtrack.detection.expectation import PerceivedExpectation
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.messages import Detections, Frame, ImuSample, StampKind
from swarmtrack.motion.ego import EgoHistory
from swarmtrack.motion.gyro import GyroHistory
from swarmtrack.motion.mounting import Mounting
from swarmtrack.onboard import Onboard, OnboardCamera
from swarmtrack.tracking import create_trackers

LEFT = PinholeCamera(320.0, 320.0, 319.5, 239.5, 640, 480)
RIGHT = PinholeCamera(160.0, 160.0, 159.5, 119.5, 320, 240)
YAWS = (-40.0, 40.0)
NO_ACCEL = np.full(3, np.nan)


def looking(yaw_deg):
    return Pose(
        rotation.from_euler(0.0, 0.0, math.radians(yaw_deg)) @ rotation.BODY_FROM_FORWARD_CAMERA, np.zeros(3)
    )


def two_cameras():
    lenses = (LEFT, RIGHT)
    trackers = create_trackers("mbm", cameras=lenses)
    cameras = [
        OnboardCamera(lens, Mounting(looking(yaw), sigma=0.01), tracker)
        for lens, yaw, tracker in zip(lenses, YAWS, trackers, strict=True)
    ]
    return Onboard(
        1, cameras=cameras, gyro=GyroHistory(), ego=EgoHistory(start=None), identity=IdentityParameters()
    )


def pixel(camera, bearing_deg):
    """Of what is so far clockwise from the nose."""
    lens = (LEFT, RIGHT)[camera]
    return lens.cx + lens.fx * math.tan(math.radians(bearing_deg - YAWS[camera])), lens.cy


def watch(drone, camera, *bearings_deg, seconds=1.0, yaw_rate=0.0):
    """What one of the cameras sees at 15 Hz; the drone may turn to the right, and it does so under what it sees."""
    gyro = np.array([0.0, 0.0, yaw_rate])
    fed = 0
    for k in range(int(15 * seconds)):
        t = k / 15
        while fed / 200.0 <= t:
            drone.tell(ImuSample(fed / 200.0, gyro, NO_ACCEL))
            fed += 1
        centre = np.array([pixel(camera, b - math.degrees(yaw_rate) * t) for b in bearings_deg]).reshape(
            -1, 2
        )
        n = len(centre)
        drone.tell(Detections(t, k, centre, np.full((n, 2), 12.0), np.full(n, 0.95), camera=camera))
    return (int(15 * seconds) - 1) / 15


def test_a_camera_is_told_of_its_own_tracks_and_not_of_what_only_another_sees():
    drone = two_cameras()
    last = watch(drone, 0, -70.0)
    (box,) = PerceivedExpectation(drone, 0).boxes(last)
    assert box[:2] == pytest.approx(pixel(0, -70.0), abs=1.0)
    # Far behind the edge of the other's picture, where no window is made of it.
    inside = [one for one in PerceivedExpectation(drone, 1).boxes(last) if 0.0 <= one[0] <= 319.0]
    assert inside == []


def test_where_two_pictures_overlap_both_are_told_in_their_own_pixels():
    drone = two_cameras()
    last = watch(drone, 0, -2.0)
    assert {entry.track.camera for entry in drone.tracks(last).tracks} == {0}
    (own,) = PerceivedExpectation(drone, 0).boxes(last)
    (other,) = PerceivedExpectation(drone, 1).boxes(last)
    assert own[:2] == pytest.approx(pixel(0, -2.0), abs=1.0)
    assert other[:2] == pytest.approx(pixel(1, -2.0), abs=1.0)
    # Half as large in a picture of half as many pixels, and less certain by the mounting.
    assert other[4:] == pytest.approx(0.5 * own[4:], rel=1e-6)
    assert other[2] > 3.0 * math.hypot(0.01, 0.01) * RIGHT.fx


def test_the_turn_of_the_drone_is_that_of_each_camera():
    """To the right by 0.5 rad/s: what stands still wanders to the left in either picture, by its own focal length."""
    drone = two_cameras()
    last = watch(drone, 1, 60.0, yaw_rate=0.5)
    fed = int(last * 200.0) + 1
    while fed / 200.0 <= last + 0.25:
        drone.tell(ImuSample(fed / 200.0, np.array([0.0, 0.0, 0.5]), NO_ACCEL))
        fed += 1
    (box,) = PerceivedExpectation(drone, 1).boxes(last + 0.2)
    assert box[:2] == pytest.approx(pixel(1, 60.0 - math.degrees(0.5 * (last + 0.2))), abs=1.5)
    earlier = PerceivedExpectation(drone, 1).pixels_at(last - 0.1, last)
    assert earlier is not None
    here, then = (pixel(1, 50.0 - math.degrees(0.5 * t)) for t in (last, last - 0.1))
    assert earlier(np.array([here]))[0] == pytest.approx(then, abs=0.5)


def test_the_detector_remembers_each_camera_by_itself():
    """A frame of one is never compared with one of another, and each has its own turn of whole frames."""

    class Nothing:
        def boxes(self, exposed):
            return np.array([[100.0, 100.0, 3.0, 3.0, 20.0, 20.0]])

        def pixels_at(self, then, now):
            return lambda pixels: pixels

    detector = Detector(look="guided", motion=True, input_scale=0.5)
    grey = np.full((240, 320, 3), 100, np.uint8)
    whole = {0: [], 1: []}
    for k in range(10):
        camera = 0 if k < 6 else 1
        frame = Frame(0.1 * k, 0.0, k, grey, StampKind.MEDIA, camera)
        look = detector.plan(frame, Nothing())
        whole[camera].append(any((w.width, w.height) == (320, 240) for w in look.windows))
        # The first of each camera has nothing to be compared with.
        assert (look.comparison is None) == (k in (0, 6)), k
        assert detector.detect(look).camera == camera
    assert whole == {0: [True, False, False, False, False, True], 1: [True, False, False, False]}
