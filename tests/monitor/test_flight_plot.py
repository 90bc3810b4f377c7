"""`swarmtrack plot`: what a recorded flight comes to on one page."""

from __future__ import annotations

import sys

import numpy as np
import pytest

pytest.importorskip("foxglove", reason="foxglove-sdk has no wheel here")

from support.recorded_swarm import PLACES, record_swarm
from swarmtrack.agents import main as swarmtrack
from swarmtrack.monitor.flight_course import SeenTeammate, read_course


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flown")
    record_swarm(folder, 12.0, video=False)
    return folder


def test_a_course_has_places_and_names_as_they_were_told(flown):
    course = read_course([flown])
    assert course.seconds == pytest.approx(12.0, abs=0.3)
    for drone, rows in course.places.items():
        assert rows[:, 1:] == pytest.approx(np.broadcast_to(PLACES[drone], (len(rows), 3)))
    assert {one.identity for one in course.seen[1]} == {2}
    assert len(course.seen[1]) == pytest.approx(12.0 * 5.0, abs=3)
    assert course.truth == {}


def test_an_error_is_measured_from_the_truth_at_that_time(flown):
    course = read_course([flown])
    course.truth = {
        1: np.array([[0.0, 0.0, 0.0, -2.0], [10.0, 0.0, 10.0, -2.0]]),
        2: np.array([[0.0, 4.0, 0.0, -2.0], [10.0, 4.0, 0.0, -2.0]]),
    }
    assert course.true_offset(1, SeenTeammate(5.0, 2, None, 0.1)).tolist() == [4.0, -5.0, 0.0]
    assert course.true_offset(1, SeenTeammate(11.0, 2, None, 0.1)) is None
    assert course.true_offset(1, SeenTeammate(5.0, None, None, 0.1)) is None


def test_the_command_draws_a_page_and_says_what_is_not_on_it(flown, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    out = tmp_path / "flight.svg"
    assert swarmtrack.main(["plot", str(flown), "--out", str(out)]) == 0
    assert "3 drones; the truth is not in it" in capsys.readouterr().out
    drawn = out.read_text()
    for words in ("From above: reported paths", "Names: given 100%"):
        assert f"<!-- {words}" in drawn


def test_without_matplotlib_it_says_what_to_install(flown, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setattr("swarmtrack.arguments.find_spec", lambda package: None)
    assert swarmtrack.main(["plot", str(flown)]) == 2
    assert "swarmtrack plot needs matplotlib" in capsys.readouterr().err
