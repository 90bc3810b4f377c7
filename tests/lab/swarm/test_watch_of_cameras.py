"""The watch takes each track in the pixels of the camera that the message names."""

import numpy as np

from swarmtrack.clock import ManualClock
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.swarm.watch import Watch
from swarmtrack.messages import IdentifiedTrack, Track, TrackList, TrackStatus
from swarmtrack.wire.tracks import tracks_message


def test_a_track_is_judged_in_the_pixels_of_the_camera_that_the_message_names():
    clock = ManualClock()
    watch = Watch(load_scenario("two-cameras"), clock, clock, epoch=0.0, seconds=10.0)
    watch.agents[1].boot = "a"
    mean = np.array([40.0, 0.0, 240.0, 0.0])
    tracks = tuple(
        IdentifiedTrack(
            Track(k, 2.0, mean, np.eye(4), TrackStatus.CONFIRMED, 1.0, np.array([60.0, 20.0]), camera=k % 2),
            None,
            0.0,
        )
        for k in (1, 2, 3)
    )
    message = tracks_message(TrackList(2.0, 1.98, tracks), 1, clock.utc() - clock.now(), 0.05)
    watch._on_tracks(1, watch.agents[1], message)
    (statement,) = watch._waiting
    assert {track.id: track.camera for track in statement.tracks} == {1: 1, 2: 0, 3: 1}
