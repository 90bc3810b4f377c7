"""Rooms add up to a scan, and who is watched is left as it was."""

import pytest

from swarmtrack.benchmarks import scale
from swarmtrack.onboard import Onboard


def test_three_know_each_other_and_their_rooms_add_up():
    track = Onboard._track
    found = scale.measure(3, 4.0)
    assert Onboard._track is track
    assert found["wrong"] == 0.0 < found["correct"]
    assert 1.0 < found["tracks"] <= 2.5
    assert sum(found["rooms_ms"].values()) == pytest.approx(found["scan_ms"], rel=0.05)
    assert found["rooms_ms"].keys() == {"names", "metres", "tracker", "the rest"}
    assert found["report_us"] > 0.0
    (row,) = [line for line in scale.BENCH.page({"teams": [found]}).splitlines() if line.startswith("| 3 |")]
    assert row.count("|") == len(scale.COLUMNS) + 1
