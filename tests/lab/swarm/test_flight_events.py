"""What drones on errands are told is written beside their recordings."""

from __future__ import annotations

import json

from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.swarm.recording import EVENTS_FILE, write_events


def test_events_are_listed_in_order_on_the_clock_of_the_recordings(tmp_path):
    scenario = load_scenario("errand", drones=2)
    write_events(tmp_path / EVENTS_FILE, scenario, epoch=5000.0)
    rows = json.loads((tmp_path / EVENTS_FILE).read_text())
    assert [words for _, words in rows[:2]] == ["drone 1 takes off", "drone 2 takes off"]
    assert rows[0][0] == round(5000.0 + scenario.world.flown(1).takes_off_s, 3)
    assert rows == sorted(rows)


def test_where_nobody_is_told_anything_there_is_no_file(tmp_path):
    write_events(tmp_path / EVENTS_FILE, load_scenario("crossing"), epoch=5000.0)
    assert list(tmp_path.iterdir()) == []
