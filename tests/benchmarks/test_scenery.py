"""`swarmtrack bench scenery`: what is counted as a track on something that stands still."""

import json

import numpy as np
import pytest

from swarmtrack.benchmarks import rendered_eyes, scenery
from swarmtrack.benchmarks.virtual_swarm import Exposure
from swarmtrack.errors import ConfigError
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.score.swarm_score import Glance, NamedTrack
from swarmtrack.lab.score.swarm_truth import SwarmTruth


def watched(*tracks, in_view=None, hidden=None):
    """After ten glances at the same tracks (u, v)."""
    watch = scenery.Watch(load_scenario("crossing"))
    for k in range(10):
        named = tuple(NamedTrack(7 + n, None, 0.0, u, v) for n, (u, v) in enumerate(tracks))
        watch.add_glance(Glance(1, "boot", k, 0.1 * k, in_view or {}, hidden or {}, named))
    return watch


def test_a_track_on_no_drone_stands_for_as_long_as_it_is_confirmed():
    drone = {2: np.array([300.0, 240.0, 60.0, 20.0])}
    watch = watched((310.0, 240.0), (420.0, 200.0), in_view=drone)
    (standing,) = watch.standing.values()
    assert (standing.observer, standing.since, standing.u) == (1, 0.0, 420.0)
    assert standing.seconds == pytest.approx(1.0)
    assert (watch.tracks, watch.glances) == (20, 10)


def test_a_track_on_a_hidden_drone_or_beside_the_picture_stands_on_nothing():
    hidden = {3: np.array([420.0, 200.0, 20.0, 20.0])}
    watch = watched((424.0, 205.0), (-30.0, 200.0), hidden=hidden)
    assert not watch.standing
    assert watch.tracks == 10


@pytest.mark.long("two rendered flights; live/test_agent.py sees rendered teammates in the default run")
def test_a_flight_is_the_same_twice_and_its_drones_are_followed():
    short = scenery.Programme(seeds=1, seconds=1.2)
    first, again = (scenery.fly(short, "hover-triangle", 1) for _ in range(2))
    assert first == again
    assert first.score.recall > 0.9
    assert first.observed_s == pytest.approx(3 * 1.2, abs=2.0)


class Nobody:
    """Expects nothing, and knows of no turns."""

    def __init__(self, perceived, camera):
        pass

    def boxes(self, exposed):
        return np.empty((0, 6))

    def pixels_at(self, then, now):
        return None


def test_each_camera_of_a_drone_has_a_picture_of_its_own(monkeypatch):
    monkeypatch.setattr(rendered_eyes, "PerceivedExpectation", Nobody)
    scenario = scenery.scenario_of_seed(scenery.Programme(), "two-cameras", 1)
    truth, eyes = SwarmTruth(scenario.world, scenario.cameras), rendered_eyes.rendered_eyes(scenario)
    seen = set()
    for observer in scenario.members:
        for camera, boxes in enumerate(truth.view(observer, 2.0).cameras):
            low, high = scenario.cameras[camera].lens.ideal_bounds
            inside = [box for box in boxes.values() if ((box[:2] > low + 40) & (box[:2] < high - 40)).all()]
            if not inside:
                continue
            # The first frame of a camera is looked at as a whole.
            found = eyes(Exposure(observer, 14, 2.0, 2.0, None, camera))
            assert min(np.hypot(*(found.centre - inside[0][:2]).T)) < 8.0
            seen.add(camera)
    assert seen == {0, 1}


def test_a_scenario_that_is_not_there_is_refused_before_any_flight(tmp_path):
    pytest.importorskip("matplotlib", reason="plots are an extra")
    with pytest.raises(ConfigError, match='scenario "moon", expected one of'):
        scenery.BENCH.publish(tmp_path, scenarios=["crossing", "moon"])


@pytest.mark.long(
    "rendered flights for a table of a benchmark; live/test_agent.py sees rendered teammates in the default run"
)
def test_the_table_counts_long_ones_and_the_pictures_show_them(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib", reason="plots are an extra")
    houses = (
        scenery.Standing(1, 0, 1.0, 320.0, 240.0, seconds=3.0),
        scenery.Standing(2, 0, 1.0, 50.0, 100.0, seconds=0.4),
    )
    short = scenery.Programme(seeds=1, seconds=1.0)
    flown = scenery.fly(short, "hover-triangle", 1)._replace(standing=houses, tracks=100, observed_s=120.0)
    row = scenery.summary([flown])
    assert (row["standing"], row["standing_long"], row["standing_longest_s"]) == (2, 1, 3.0)
    assert row["standing_per_minute"] == 1.0
    assert row["precision"]["value"] == pytest.approx(0.66)
    monkeypatch.setattr(scenery, "SECONDS", 1.0)
    result = scenery.BENCH.publish(tmp_path, seeds=1, scenarios=["hover-triangle"], processes=1)
    assert json.loads((tmp_path / "scenery.json").read_text(encoding="utf-8"))["seeds"] == 1
    assert list(result["scenarios"]) == ["hover-triangle"]
    picture = scenery.picture_of(short, "hover-triangle", 1, houses[0])
    assert picture.shape == (scenery.LOOKS_PX, scenery.LOOKS_PX, 3)
    assert picture.std() > 1.0
