"""`swarmtrack bench identity`: its layouts, its methods, its statistics, and what it leaves behind."""

import json

import numpy as np
import pytest

from swarmtrack.benchmarks.identity import layouts
from swarmtrack.benchmarks.identity.experiment import (
    AS_EXPECTED,
    COMPLETE,
    CROWDED,
    NOBODY,
    PRIOR,
    Cell,
    by_argmin,
    by_distance,
    by_margin,
    by_probability,
    draw,
    log_ratios_of,
    play,
    scores,
)
from swarmtrack.lab.score.intervals import fraction_interval
from swarmtrack.lab.score.reliability import Stated, reliability_of
from swarmtrack.tracking.marginals import matching_marginals


def test_a_layout_is_drawn_the_same_whenever_it_is_drawn():
    cell = Cell(CROWDED, 8, 10.0)
    once, again, other = draw(cell, 3), draw(cell, 3), draw(cell, 4)
    assert np.array_equal(once.tracks, again.tracks)
    assert np.array_equal(once.truth, again.truth)
    assert not np.array_equal(once.projected, other.projected)


def test_tracks_and_projections_are_as_far_apart_as_stated():
    """In all, with both covariances: what the observer is told of the error is the error."""
    offsets = []
    for k in range(200):
        layout = draw(Cell(COMPLETE, 16, 20.0), k)
        offsets.append(layout.tracks - layout.projected[layout.truth])
        told = layout.variance * np.eye(2)
        assert told == pytest.approx(20.0**2 * np.eye(2))
    assert np.std(np.concatenate(offsets)) == pytest.approx(20.0, rel=0.03)


def test_a_sky_has_the_strangers_and_the_misses_it_says():
    complete = draw(Cell(COMPLETE, 30, 10.0), 0)
    assert sorted(complete.truth) == list(range(30))
    truths = [draw(Cell(AS_EXPECTED, 10, 10.0), k).truth for k in range(300)]
    assert np.mean([(truth == NOBODY).sum() for truth in truths]) == pytest.approx(1.0, abs=0.25)
    assert np.mean([(truth != NOBODY).sum() for truth in truths]) == pytest.approx(9.0, abs=0.25)


def test_only_algorithm_1_gives_an_id_twice():
    for k in range(20):
        layout = draw(Cell(COMPLETE, 16, 30.0), k)
        log_ratio = log_ratios_of(layout, PRIOR)
        for given in (
            by_distance(layout),
            by_margin(log_ratio),
            by_probability(matching_marginals(log_ratio)),
        ):
            named = given[given != NOBODY]
            assert len(set(named)) == len(named)
    twice = play(Cell(COMPLETE, 16, 30.0), 0, 20).outcomes["argmin"].duplicate
    assert twice.mean() > 0.5
    assert len(by_argmin(layout)) == 16


def test_of_the_ids_given_by_the_posterior_nearly_all_are_right_where_the_paper_s_are_not():
    """Eight drones and 10 px, where a first trial had 0.06 % and 3.3 % beside 1.8 %."""
    found = scores([play(Cell(COMPLETE, 8, 10.0), 0, 150)])
    assert found["posterior"].wrong.value < 0.004
    assert found["posterior"].unknown.value < 0.06
    assert found["posterior"].duplicate.value == 0.0
    assert found["argmin"].wrong.value > 0.008


@pytest.mark.parametrize(("hits", "n", "low", "high"), [(0, 10, 0.0, 0.2775), (5, 10, 0.2366, 0.7634)])
def test_the_interval_of_independent_trials_is_wilson_s(hits, n, low, high):
    found = fraction_interval(np.array([1.0] * hits + [0.0] * (n - hits)), np.ones(n))
    assert found.value == hits / n
    # Groups of one have no more variance between them than trials have, but for n − 1 in place of n.
    assert (found.low, found.high) == pytest.approx((low, high), abs=0.02)


def test_trials_that_stand_and_fall_together_count_as_one():
    together = fraction_interval(np.array([10.0, 0.0] * 20), np.full(40, 10.0))
    as_one = fraction_interval(np.array([1.0, 0.0] * 20), np.ones(40))
    assert together == pytest.approx(as_one, abs=1e-9)


def test_where_nothing_was_hit_the_least_design_effect_is_all_that_is_known():
    alone = fraction_interval(np.zeros(100), np.full(100, 8.0))
    paired = fraction_interval(np.zeros(100), np.full(100, 8.0), 2.0)
    assert paired.high == pytest.approx(2.0 * alone.high, rel=0.01)
    assert fraction_interval(np.zeros(0), np.zeros(0))[1:] == (0.0, 1.0)


def test_statements_that_come_true_as_often_as_stated_are_calibrated_and_others_are_not():
    rng = np.random.default_rng(5)
    p = rng.uniform(0.5, 1.0, 40_000)
    group = np.arange(40_000)
    honest = reliability_of(Stated(p, rng.random(40_000) < p, group))
    boastful = reliability_of(Stated(p, rng.random(40_000) < p - 0.1, group))
    assert honest.expected_error < 0.01
    assert boastful.expected_error == pytest.approx(0.1, abs=0.01)
    for entry in honest.bins:
        assert entry.right.low - 0.02 < entry.stated < entry.right.high + 0.02
    assert sum(entry.statements for entry in honest.bins) == honest.overall.statements == 40_000


def test_groups_of_different_parts_are_different_whatever_their_numbers():
    part = Stated(np.array([0.9, 0.9]), np.array([True, False]), np.array([7, 7]))
    assert Stated.joined([part, part]).group.tolist() == [0, 0, 1, 1]
    assert len(Stated.joined([]).p) == 0


@pytest.mark.long("two layouts and their plots; the default run compares processes")
def test_the_benchmark_leaves_tables_and_plots_behind(tmp_path):
    layouts.BENCH.publish(tmp_path, layouts=2, processes=1)
    found = json.loads((tmp_path / "identity.json").read_text(encoding="utf-8"))
    assert len(found["cells"]) == 48 + 2 * 9
    assert all(cell["methods"]["posterior"]["duplicate"]["value"] == 0.0 for cell in found["cells"])
    assert {entry["sky"] for entry in found["calibration"]} == {"complete", "as expected", "crowded"}
    assert "Layouts in which the posterior gave an ID twice: 0" in (tmp_path / "identity.md").read_text()
    for plot in ("identity.png", "identity_calibration.png"):
        assert (tmp_path / plot).stat().st_size > 10_000


def test_processes_find_what_one_finds():
    todo = [(Cell(COMPLETE, 5, 20.0), first, first + 5) for first in (0, 5)]
    alone, shared = (layouts.play_all(todo, processes) for processes in (1, 2))
    for cell, chunks in alone.items():
        assert scores(chunks) == scores(shared[cell])
