"""Random and hostile scans leave every number sound: forty, 1000 in the long form, a million in `bench soak`."""

import numpy as np
import pytest

from swarmtrack.benchmarks.trackers import soak
from swarmtrack.messages import Track, TrackStatus
from swarmtrack.tracking import TRACKERS


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "scans", [20, pytest.param(1000, marks=pytest.mark.long("a thousand scans, not twenty"))]
)
@pytest.mark.parametrize("name", TRACKERS)
def test_hostile_scans_leave_every_number_sound(name, scans):
    found = soak.endure(name, scans, seed=3)
    assert found.tracks_seen > 12 * scans
    assert (found.not_finite, found.not_positive, found.not_a_probability) == (0, 0, 0)
    assert f"| {name} | {scans:,} | " in soak.BENCH.page([found])


def test_what_is_unsound_is_noticed():
    def track(mean=1.0, variance=1.0, probability=0.5):
        return Track(
            1,
            0.0,
            np.full(4, mean),
            np.diag([variance, 1.0, 1.0, 1.0]),
            TrackStatus.CONFIRMED,
            probability,
            np.ones(2),
        )

    tracks = [
        track(),
        track(mean=np.nan),
        track(variance=-1.0),
        track(probability=1.5),
        track(probability=np.nan),
    ]
    assert soak._faults(tracks) == (1, 1, 2)
