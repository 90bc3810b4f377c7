"""Two drones flown by ArduPilot, replayed: where they are in metres, against where the physics had them."""

from __future__ import annotations

import csv

import numpy as np
import pytest

pytest.importorskip("foxglove", reason="foxglove-sdk has no wheel here")

from support.places import SHARED
from swarmtrack.geometry import rotation
from swarmtrack.recording.reader import recordings_below
from swarmtrack.recording.settings import read_settings
from swarmtrack.replay.replayer import Replayer

FLIGHTS = SHARED / "sitl_flights"
CAMERA_M = np.array([0.1, 0.0, 0.0])
COLUMNS = ("t_s", "north_m", "east_m", "down_m", "q_w", "q_x", "q_y", "q_z", "v_north", "v_east", "v_down")


def truth(path):
    """By drone: rows of COLUMNS over time."""
    rows = {}
    with path.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            rows.setdefault(int(row["drone"]), []).append([float(row[name]) for name in COLUMNS])
    return {drone: np.array(sorted(values)) for drone, values in rows.items()}


def at(rows, t):
    return np.array([np.interp(t, rows[:, 0], column) for column in rows[:, 1:].T])


@pytest.mark.skipif(not FLIGHTS.exists(), reason="../shared/data is not here: no old recording")
@pytest.mark.parametrize(
    ("flight", "observer"),
    [
        ("A_gps_decoy", 1),
        pytest.param("D_gps", 2, marks=pytest.mark.long("another flight, twice as long")),
    ],
)
def test_a_flight_of_a_real_autopilot_has_its_metres_right_and_no_more_sure_than_that(flight, observer):
    true = truth(FLIGHTS / flight / "truth.csv")
    (recording,) = recordings_below(FLIGHTS / flight / f"drone-{observer}")
    ranges, nees = [], []
    for report in Replayer(recording, read_settings(recording)[0]).run().scans:
        for entry in report.tracks.tracks:
            state = entry.relative
            if state is None:
                continue
            own, other = at(true[observer], state.t), at(true[state.drone_id], state.t)
            away = other[:3] - own[:3] - rotation.from_quaternion(own[3:7]) @ CAMERA_M
            error = np.concatenate([state.position - away, state.velocity - (other[7:] - own[7:])])
            ranges.append(abs(np.linalg.norm(state.position) / np.linalg.norm(away) - 1.0))
            nees.append(error @ np.linalg.solve(state.cov, error) / 6.0)
    assert len(ranges) > 100
    assert np.median(ranges) < 0.06
    assert np.median(nees) < 1.0
    assert np.quantile(nees, 0.95) < 2.1  # that of six numbers' chi-square is 2.1
