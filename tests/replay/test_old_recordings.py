"""Flights that were recorded long ago come out as they did: whatever changes results must change them on purpose."""

from __future__ import annotations

import hashlib

import pytest

pytest.importorskip("foxglove", reason="foxglove-sdk has no wheel here")

from support.places import SHARED
from swarmtrack.recording.reader import recordings_below
from swarmtrack.recording.settings import read_settings
from swarmtrack.replay.replayer import Replayer

FLIGHTS = SHARED / "sitl_flights"
# Of two drones flown by ArduPilot, as they are tracked now. Whoever changes a tracker, the camera's clock or who is
# who, so that old flights come out otherwise, replaces these and says so.
DIGESTS = {"D_gps/drone-2": (236, "a3606fad9152e920"), "B_gps/drone-1": (243, "b18167488da0072a")}


def digest(scans) -> str:
    """Of what people and planners see: who is where, to a hundredth of a pixel, so that another processor's last bits
    are no difference."""
    found = hashlib.blake2b(digest_size=8)
    for report in scans:
        for entry in report.tracks.tracks:
            track = entry.track
            state = [round(float(value), 2) + 0.0 for value in track.mean]
            found.update(repr((report.sequence, track.id, entry.identity, str(track.status), state)).encode())
    return found.hexdigest()


@pytest.mark.skipif(not FLIGHTS.exists(), reason="../shared/data is not here: no old recording")
@pytest.mark.parametrize("name", DIGESTS)
def test_an_old_flight_comes_out_as_it_did(name):
    (recording,) = recordings_below(FLIGHTS / name)
    scans = Replayer(recording, read_settings(recording)[0]).run().scans
    assert (len(scans), digest(scans)) == DIGESTS[name]
