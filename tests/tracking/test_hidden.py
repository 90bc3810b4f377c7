"""A camera that turns away and back finds its tracks again, with their numbers, where they must be."""

import numpy as np
import pytest

from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Scan, TrackStatus
from swarmtrack.tracking import TRACKERS, create_tracker

CAMERA = PinholeCamera(430.0, 430.0, 319.5, 239.5, 640, 480)
HZ = 10.0
TARGETS = CAMERA.bearing_undistorted(np.array([[250.0, 200.0], [400.0, 260.0]]))


def swing(degrees, seconds, begins=1.0):
    """Yaw [rad] at each scan: to one side and back, at rest before and after."""

    def yaw(t):
        share = np.clip((t - begins) / seconds, 0.0, 1.0)
        return np.radians(degrees) * np.sin(np.pi * share) ** 2

    return yaw


def seen(yaw):
    """Pixels (n, 2) of the targets in view."""
    there = TARGETS @ rotation.exp(np.array([0.0, -yaw, 0.0])).T
    pixels, _, ahead = CAMERA.project_undistorted(there)
    return pixels[ahead & CAMERA.contains(np.where(ahead[:, None], pixels, -1e9))]


def play(tracker, yaw, seconds, *, unsure=0.0, gone_from=np.inf):
    """Tracks that are no longer tentative, after each scan. unsure: rad², of each turn."""
    told = []
    for k in range(round(seconds * HZ)):
        t, before = k / HZ, (k - 1) / HZ
        turned = np.array([0.0, yaw(before) - yaw(t), 0.0])
        tracker.predict(t, rotation.exp(turned), unsure)
        tracker.update(Scan(t, seen(yaw(t)) if t < gone_from else np.empty((0, 2))))
        told.append([track for track in tracker.tracks if track.status is not TrackStatus.TENTATIVE])
    return told


def ids(tracks, status=None):
    return {track.id for track in tracks if status in (None, track.status)}


@pytest.mark.parametrize("degrees", [60.0, 110.0], ids=["in the plane", "on the sphere"])
@pytest.mark.parametrize("name", TRACKERS)
def test_tracks_come_back_with_their_numbers(name, degrees):
    yaw = swing(degrees, 2.2)
    tracker = create_tracker(name, camera=CAMERA, measurement_sigma=1.0, acceleration_psd=600.0)
    told = play(tracker, yaw, 4.0)
    before, after = told[9], told[-1]
    assert len(before) == 2
    assert sum(not len(seen(yaw(k / HZ))) for k in range(40)) >= 7  # scans without either
    assert ids(after, TrackStatus.CONFIRMED) == ids(before)
    for old, new in zip(sorted(before), sorted(after), strict=True):
        assert np.linalg.norm(new.mean[::2] - old.mean[::2]) < 5.0
    while_away = [track for tracks in told[15:27] for track in tracks]
    assert all(track.status is TrackStatus.LOST for track in while_away if not 0.0 < track.mean[0] < 640.0)


@pytest.mark.parametrize("name", TRACKERS)
def test_a_track_that_is_not_where_it_must_be_ends(name):
    tracker = create_tracker(name, camera=CAMERA, measurement_sigma=1.0, acceleration_psd=600.0)
    told = play(tracker, swing(110.0, 2.2), 5.0, gone_from=1.5)
    assert told[9]
    assert not told[-1]


@pytest.mark.parametrize("name", TRACKERS)
def test_a_track_whose_direction_is_no_longer_known_ends(name):
    tracker = create_tracker(name, camera=CAMERA, measurement_sigma=1.0, acceleration_psd=600.0)
    told = play(tracker, swing(110.0, 3.0), 5.0, unsure=0.3**2)
    assert not ids(told[9]) & ids(told[-1])


@pytest.mark.parametrize("name", TRACKERS)
def test_a_track_in_view_ends_as_before(name):
    tracker = create_tracker(name, camera=CAMERA, measurement_sigma=1.0, acceleration_psd=600.0)
    told = play(tracker, lambda t: 0.0, 3.5, gone_from=1.5)
    assert told[14]
    assert told[23]
    assert not told[26]
