"""Metres of a drone: relative states of its named tracks, and of any confirmed track by size."""

import numpy as np
import pytest

from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Announcement, Detections, EgoPose, IdentifiedTrack, RangeReport
from swarmtrack.motion.ego import EgoHistory
from swarmtrack.relative.metres import MeasuringCamera, Metres
from swarmtrack.relative.parameters import RelativeParameters
from swarmtrack.tracking import create_tracker
from swarmtrack.tracking.scan import make_scan

CAMERA = PinholeCamera(430.0, 430.0, 320.0, 240.0, 640, 480)
FORWARD = Pose(rotation.BODY_FROM_FORWARD_CAMERA, np.zeros(3))
PLACE = np.array([6.0, 0.0, 0.0])
SPAN_M = 0.4


class Seeing:
    """Drone 1 at the origin facing north, with a drone 6 m ahead; `name` is the identity of its track."""

    def __init__(self, name, *, places_anybody=False):
        self.name = name
        self.tracker = create_tracker("kalman", camera=CAMERA, clutter_per_scan=0.5, measurement_sigma=1.0)
        self.ego = EgoHistory(start=Pose(np.eye(3), np.zeros(3)))
        self.metres = Metres(
            1,
            RelativeParameters(airframe_span_m=SPAN_M),
            cameras=[MeasuringCamera(CAMERA, FORWARD, self.tracker)],
            ego=self.ego,
            places_anybody=places_anybody,
        )
        self.t = 0.0
        self.metres.announce(Announcement(2, "0000000a", 0, 0.0, 0.0, PLACE, np.eye(3), 0.01 * np.eye(3)))

    def looks(self, scans=10):
        for k in range(scans):
            self.t += 0.1
            self.ego.append(EgoPose(self.t, np.zeros(3), np.eye(3), attitude_sigma=0.002))
            width = 430.0 * SPAN_M / 6.0
            found = Detections(
                self.t, k, np.array([[320.0, 240.0]]), np.array([[width, 0.4 * width]]), np.array([0.9])
            )
            scan = make_scan(found, self.t, CAMERA, self.tracker)
            self.tracker.predict(self.t)
            self.tracker.update(scan)
            (track,) = self.tracker.tracks
            labelled = (IdentifiedTrack(track, self.name, 0.99 if self.name else 0.0),)
            (self.entry,) = self.metres.observe(labelled, scan, self.ego.at(self.t), 0)
        return self.entry


def test_a_named_track_has_a_relative_state_and_one_without_a_name_has_none():
    state = Seeing(2).looks().relative
    assert state.drone_id == 2
    assert state.position == pytest.approx(PLACE, abs=0.5)
    assert Seeing(None).looks().relative is None


def test_a_name_that_has_just_ended_is_in_the_look_for_the_own_place_and_nowhere_else():
    seeing = Seeing(2)
    seeing.looks()
    seeing.name = None
    entry = seeing.looks(3)
    assert entry.relative is None
    assert seeing.metres.look.keys == ((2, entry.track.id),)
    assert np.isfinite(seeing.metres.look.ray).all()
    seeing.looks(40)
    assert seeing.metres.look.keys == ()


def test_a_state_ends_with_its_name():
    seeing = Seeing(2)
    entry = seeing.looks()
    (later,) = seeing.metres.at((entry,), seeing.t + 0.1)
    assert later.relative.t == pytest.approx(seeing.t + 0.1)
    (renamed,) = seeing.metres.at((IdentifiedTrack(entry.track, 3, 0.99),), seeing.t)
    assert renamed.relative is None


def test_any_confirmed_track_is_placed_by_its_size_where_that_is_asked_for():
    seeing = Seeing(None, places_anybody=True)
    entry = seeing.looks()
    (state,) = seeing.metres.anybody(seeing.t).values()
    assert (state.drone_id, entry.relative) == (0, None)
    assert np.linalg.norm(state.position) == pytest.approx(6.0, rel=0.5)
    without = Seeing(None)
    without.looks()
    assert without.metres.anybody(without.t) == {}


def test_only_the_own_radio_measures_own_ranges():
    seeing = Seeing(2)
    seeing.looks()
    before = seeing.metres.counters
    assert seeing.metres.hear_range(RangeReport(3, 2, seeing.t, 0.001, 206.0, 0.1)) is None
    assert seeing.metres.counters == before
    seeing.metres.hear_range(RangeReport(1, 2, seeing.t, 0.001, 206.0, 0.1))
    assert seeing.metres.counters["relative_refused"] == before["relative_refused"] + 1
