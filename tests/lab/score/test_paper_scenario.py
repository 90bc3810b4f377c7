"""The paper's scenario by a formula, beside its digitised record."""

import numpy as np
import pytest

from support.places import SHARED
from swarmtrack.lab.score import paper_scenario
from swarmtrack.lab.score.paper_scenario import CONDITIONS, HERE, PUBLISHED_RMSE_PX, THERE

RECORD = SHARED / "paper_scenario" / "truth.csv"


@pytest.mark.shared
@pytest.mark.skipif(not RECORD.exists(), reason="needs ../shared/data/paper_scenario/truth.csv")
def test_the_formula_stays_within_half_a_pixel_of_the_digitised_truth():
    table = np.genfromtxt(RECORD, delimiter=",", names=True)
    digitised = np.array([[table[f"u{i}"], table[f"v{i}"]] for i in (1, 2, 3)]).transpose(2, 0, 1)
    assert table["t_s"] == pytest.approx(paper_scenario.times(), abs=1e-3)
    apart = np.linalg.norm(paper_scenario.truth(paper_scenario.times()) - digitised, axis=2)
    assert apart.max() < 0.5
    assert apart.mean() < 0.1


def test_the_drones_change_places_and_come_back_and_go_again():
    truth = paper_scenario.truth(paper_scenario.times())
    assert truth.shape == (160, 3, 2)
    for step, place in ((0, HERE), (55, THERE), (105, HERE), (159, THERE)):
        assert truth[step] == pytest.approx(place, abs=1e-9)


def test_it_has_the_facts_of_the_record():
    """Closest approach and peak speeds as the record's description states them."""
    t = np.linspace(0.0, 19.2, 20_000)
    truth = paper_scenario.truth(t)
    speed = np.linalg.norm(np.diff(truth, axis=0), axis=2).max(axis=0) / (t[1] - t[0])
    assert speed == pytest.approx([84.8, 58.9, 46.7], rel=0.05)
    at_steps = paper_scenario.truth(paper_scenario.times())
    assert np.linalg.norm(at_steps[:, 0] - at_steps[:, 1], axis=1).min() == pytest.approx(7.9, abs=0.6)
    to_third = np.linalg.norm(at_steps[:, :2] - at_steps[:, 2:], axis=2).min()
    assert to_third == pytest.approx(17.7, abs=1.0)


def test_nobody_jumps():
    """Velocity is continuous where a way begins and ends."""
    t = np.linspace(0.0, 19.2, 20_000)
    velocity = np.diff(paper_scenario.truth(t), axis=0) / (t[1] - t[0])
    acceleration = np.abs(np.diff(velocity, axis=0)).max() / (t[1] - t[0])
    assert acceleration < 90.0  # px/s²; the record peaks at 65


def test_thirteen_conditions_and_figures_for_some():
    assert len(CONDITIONS) == 13
    for figures in PUBLISHED_RMSE_PX.values():
        assert figures.keys() <= CONDITIONS.keys()
