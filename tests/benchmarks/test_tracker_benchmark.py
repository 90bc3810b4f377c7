"""`swarmtrack bench trackers`: its scenes, its scores on cases made by hand, its oracles, and what it leaves behind."""

import json
import math

import numpy as np
import pytest

from swarmtrack.agents import main as swarmtrack
from swarmtrack.benchmarks.trackers import play as play_module
from swarmtrack.benchmarks.trackers import timing
from swarmtrack.benchmarks.trackers.benchmark import Block, Entrant, load_peers, play_all
from swarmtrack.benchmarks.trackers.play import ORACLES, SMOOTHER, make_tracker, play
from swarmtrack.benchmarks.trackers.results import paired_ratio
from swarmtrack.benchmarks.trackers.scenes import MOST_P_DETECTION, SCENES, film
from swarmtrack.errors import MissingExtraError
from swarmtrack.lab.score.paper_scenario import CONDITIONS
from swarmtrack.lab.score.track_score import FAR_TRACK_PX, StatedTracks, score_found, score_named
from swarmtrack.tracking import TRACKERS, Scan
from swarmtrack.tracking.gaussian import innovations
from swarmtrack.tracking.motion_model import propagate

T = np.arange(50) / 10.0


def two_targets():
    """(50, 2, 2) px: one flies right, one stands 100 px below."""
    truth = np.zeros((50, 2, 2))
    truth[:, 0, 0] = 10.0 * T
    truth[:, 1, 1] = 100.0
    return truth


# --- scores, on cases made by hand ---------------------------------------------------------------------


def test_a_track_on_its_target_has_the_error_it_has():
    truth = two_targets()
    score = score_named(truth, truth + np.array([3.0, 4.0]))
    assert score.rmse_px == pytest.approx(5.0)
    assert score.squared_error == pytest.approx(np.full(50, 25.0))
    assert not score.swapped.any()
    assert not score.lost.any()


def test_tracks_that_change_places_are_swapped_and_cost_their_distance():
    truth = two_targets()
    estimate = truth.copy()
    estimate[25:] = truth[25:, ::-1]
    score = score_named(truth, estimate)
    assert score.swapped.all()
    assert not score.lost.any()
    squared = ((truth[25:, 0] - truth[25:, 1]) ** 2).sum(axis=1)
    assert score.rmse_px == pytest.approx(math.sqrt(squared.sum() / 50.0))


def test_a_swap_that_heals_is_none():
    truth = two_targets()
    estimate = truth.copy()
    estimate[20:30] = truth[20:30, ::-1]
    assert not score_named(truth, estimate).swapped.any()


def test_two_tracks_on_one_target_are_one_swap():
    truth = two_targets()
    estimate = truth.copy()
    estimate[30:, 1] = truth[30:, 0]
    score = score_named(truth, estimate)
    assert score.swapped.tolist() == [False, True]
    assert score.lost.tolist() == [False, False]


def test_a_track_that_is_gone_is_lost_and_stands_where_it_was():
    truth = two_targets()
    estimate = truth.copy()
    estimate[40:, 0] = np.nan
    score = score_named(truth, estimate)
    assert score.lost.tolist() == [True, False]
    assert not score.swapped.any()
    assert score.rmse_px == pytest.approx(math.sqrt(sum(float(k) ** 2 for k in range(1, 11)) / 100.0))


def test_a_track_in_the_void_is_lost():
    truth = two_targets()
    estimate = truth.copy()
    estimate[-1, 1] += [0.0, FAR_TRACK_PX + 1.0]
    score = score_named(truth, estimate)
    assert score.lost.tolist() == [False, True]


def claim(**tracks):
    """claim(a1=(u, v)): confirmed track 1 at (u, v); b2: lost track 2."""
    return StatedTracks(
        np.array([int(name[1:]) for name in tracks], np.int64),
        np.array(list(tracks.values()), float).reshape(-1, 2),
        np.array([name[0] == "a" for name in tracks], bool),
    )


def test_what_was_found_when_and_dropped_when():
    truth = np.full((10, 1, 2), np.nan)
    truth[2:7] = 50.0
    claims = [claim()] * 3 + [claim(a7=(50, 53))] * 5 + [claim(b7=(50, 50))] + [claim()]
    score = score_found(T[:10], truth, claims)
    assert score.find_s == pytest.approx((0.1,))
    assert score.drop_s == pytest.approx((0.3,))
    assert score.tracked == pytest.approx(0.8)
    assert score.rmse_px == pytest.approx(3.0)
    assert score.false_tracks == 0  # it was late, not false


def test_a_track_of_nobody_is_false_once_and_only_when_confirmed():
    truth = np.full((10, 1, 2), 50.0)
    score = score_found(T[:10], truth, [claim(a1=(50, 50), a2=(200, 200), b3=(300, 300))] * 10)
    assert score.false_tracks == 1
    assert score.switches == 0


def test_a_target_that_changes_hands_is_a_switch_and_pairs_last_while_they_fit():
    truth = np.full((4, 1, 2), 50.0)
    nearer = claim(a1=(50, 60), a2=(50, 51))
    assert score_found(T[:4], truth, [claim(a1=(50, 50))] * 2 + [nearer] * 2).switches == 0
    assert score_found(T[:4], truth, [claim(a1=(50, 50))] * 2 + [claim(a2=(50, 50))] * 2).switches == 1


def test_a_target_never_found_is_infinitely_late():
    score = score_found(T[:4], np.full((4, 1, 2), 50.0), [claim()] * 4)
    assert score.find_s == (math.inf,)
    assert score.tracked == 0.0
    assert math.isnan(score.rmse_px)
    assert score.untracked_at_end == 1


# --- scenes --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCENES)
def test_a_take_is_the_same_again_and_its_secret_is_true(name):
    scene = SCENES[name]
    take, again = film(scene, 3), film(scene, 3)
    assert len(take.observations) == scene.scans - scene.known_starts
    for one, two in zip(take.observations, again.observations, strict=True):
        assert np.array_equal(one.scan.z, two.scan.z)
        assert np.array_equal(one.made, two.made)
    if not scene.sensor.merge_px:
        first = scene.scans - len(take.observations)
        for step, (scan, made, _, _) in enumerate(take.observations, start=first):
            seen = np.flatnonzero(made >= 0)
            apart = np.abs(scan.z[made[seen]] - take.truth[step, seen])
            assert apart.max(initial=0.0) <= 6.0 * scene.sensor.sigma_px + 1e-9


def test_other_runs_show_other_scans():
    first, second = (film(SCENES["noise.75"], run).observations[0].scan.z for run in (0, 1))
    assert not np.array_equal(first, second)


def test_all_thirteen_conditions_are_scenes_with_their_sensor():
    for name, condition in CONDITIONS.items():
        take = film(SCENES[name], 0)
        false = [len(o.scan.z) - (o.made >= 0).sum() for o in take.observations]
        assert set(false) == {condition.clutter}
        detected = np.mean([(o.made >= 0).mean() for o in take.observations])
        assert detected == pytest.approx(condition.p_detection, abs=0.07)


def test_detections_merge_where_targets_meet():
    """Run by run: nobody's detection is nearer than the merging distance to another's, unless a chain's mean is."""
    merged = 0
    for run in range(4):
        for scan, made, _, _ in film(SCENES["slow_merged"], run).observations:
            columns = sorted(set(made[made >= 0].tolist()))
            sharing = [(made == column).sum() for column in columns]
            merged += max(sharing, default=0) > 1
            if max(sharing, default=0) == 1:
                own = scan.z[columns]
                gaps = np.linalg.norm(own[:, None] - own[None], axis=2)[np.triu_indices(len(own), 1)]
                assert (gaps >= 8.0).all()
    assert merged > 10


def test_who_is_told_nothing_sees_what_the_told_sees_and_is_told_by_how_much_detections_merge(monkeypatch):
    told = []
    monkeypatch.setattr(play_module, "create_tracker", lambda name, *, camera, **of: told.append(of))
    untold, right = SCENES["untold_slow_merged"], SCENES["slow_merged"]
    for scene in (untold, right):
        play_module.make_tracker(scene, "mbm")
    assert told[0] == {"resolution_px": 8.0, "learn_noise": "both"}
    assert told[1]["acceleration_psd"] == 600.0
    # Oracles are told all of it.
    assert untold.parameters() == right.parameters()
    for one, two in zip(film(untold, 5).observations, film(right, 5).observations, strict=True):
        assert np.array_equal(one.scan.z, two.scan.z)


def test_who_is_told_wrong_sees_what_the_rightly_told_sees():
    wrong, right = SCENES["told_wrong_R_x4_noise.50"], SCENES["noise.50"]
    for one, two in zip(film(wrong, 2).observations, film(right, 2).observations, strict=True):
        assert np.array_equal(one.scan.z, two.scan.z)
    assert wrong.parameters()["measurement_sigma"] == 2.0 * right.parameters()["measurement_sigma"]
    assert SCENES["told_wrong_pd_plus.20_pd.80"].parameters()["p_detection"] == MOST_P_DETECTION


def test_the_gyro_tells_how_the_scene_turns():
    """Carried by the told rotation, a target far away stays where it is seen, to within the gyro's noise."""
    scene = SCENES["rotating"]
    take, still = film(scene, 0), film(SCENES["rotating_still"], 0)
    assert np.linalg.norm(take.truth - still.truth, axis=2).max() > 50.0
    for step in range(2, 60):
        observation = take.observations[step - 1]
        before = np.zeros((4, 4))
        before[:, ::2] = take.truth[step - 1]
        carried, _ = propagate(
            before,
            np.tile(np.eye(4), (4, 1, 1)),
            0.0,
            psd=1.0,
            camera=scene.camera,
            rotation=observation.rotation,
        )
        own_motion = np.linalg.norm(still.truth[step] - still.truth[step - 1], axis=1).max()
        apart = np.linalg.norm(carried[:, ::2] - take.truth[step], axis=1)
        assert apart.max() < 2.0 * own_motion + 2.0


# --- oracles -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("scene", "expected"), [("control", 0.076), ("noise.75", 1.66), ("noise.50", 1.16)])
def test_the_oracle_has_the_error_that_was_measured_before(scene, expected):
    rmse = np.mean([play(SCENES[scene], "oracle_cv", run=run).rmse_px for run in range(6)])
    assert rmse == pytest.approx(expected, rel=0.05)


def test_the_smoother_beats_the_filter():
    for run in range(3):
        scene = SCENES["noise.75"]
        assert play(scene, SMOOTHER, run=run).rmse_px < 0.75 * play(scene, "oracle_cv", run=run).rmse_px


@pytest.mark.parametrize("oracle", ORACLES)
@pytest.mark.parametrize("scene", ["slow_merged", "births", "rotating", "latency_steady"])
def test_oracles_never_swap_or_lose(oracle, scene):
    score = play(SCENES[scene], oracle, run=1)
    assert not score.swapped
    assert not score.lost


def test_without_clutter_or_misses_the_kalman_filter_is_its_oracle():
    scene = SCENES["noise.50"]
    assert play(scene, "kalman", {"learn_noise": "no"}).rmse_px == pytest.approx(
        play(scene, "oracle_cv").rmse_px, rel=1e-6
    )


@pytest.mark.parametrize("tracker", TRACKERS)
def test_every_tracker_plays_the_papers_scene_without_a_swap(tracker):
    score = play(SCENES["mixedB"], tracker)
    assert not score.swapped
    assert not score.lost
    assert score.rmse_px < 1.0


def test_parameters_reach_the_tracker_and_unknown_ones_of_a_scene_are_left_out():
    scene = SCENES["slow_merged"]
    assert "resolution_px" in scene.parameters()
    make_tracker(scene, "kalman")
    with pytest.raises(ValueError, match="max_coast_s"):
        make_tracker(scene, "kalman", {"max_coast_s": -1.0})


def test_a_ratio_of_equals_is_one():
    scores = [play(SCENES["mixedB"], "oracle_cv", run=run) for run in range(3)]
    assert paired_ratio(scores, scores) == pytest.approx((1.0, 1.0, 1.0))


# --- costs ---------------------------------------------------------------------------------------------


def test_in_the_crowd_every_gate_holds_every_detection():
    scene, points = timing.laid_out("crowded", 32)
    tracker = make_tracker(scene, "kalman")
    rng = np.random.default_rng(0)
    tracker.initiate(0.0, points)
    for k in range(1, timing.WARM_UP + 1):
        tracker.predict(0.1205 * k)
        tracker.update(Scan(0.1205 * k, timing.detect(points, 32, rng)))
    tracker.predict(0.1205 * (timing.WARM_UP + 1))
    z = timing.detect(points, 40, rng)
    assert len(z) == 40
    mean, cov = (np.array([getattr(track, name) for track in tracker.tracks]) for name in ("mean", "cov"))
    distance, _ = innovations(mean[:32], cov[:32], z, np.tile(np.eye(2), (40, 1, 1)))
    assert (distance < 13.8).mean() > 0.99


def test_enumeration_counts_and_weighs_joint_events():
    assert timing.events_of(2, 2) == 7
    assert timing.events_of(8, 8) == 1_441_729
    weights = np.array([[1.0, 2.0, 3.0], [1.0, 1.0, 4.0]])
    events = {(0, 0): 1, (0, 1): 1, (0, 2): 4, (1, 0): 2, (1, 2): 8, (2, 0): 3, (2, 1): 3}
    total = sum(events.values())
    expected = [[sum(w for e, w in events.items() if e[i] == j) / total for j in range(3)] for i in range(2)]
    assert timing.enumerated_marginals(weights) == pytest.approx(np.array(expected))


# --- the command ---------------------------------------------------------------------------------------


@pytest.mark.long("plays twice; benchmarks/test_identity_layouts.py compares processes in the default run")
def test_scores_are_the_same_for_any_number_of_jobs():
    entrants = (
        Entrant("kalman", "kalman"),
        Entrant("limit", "oracle_cv"),
        Entrant("agile", "kalman", (("acceleration_psd", 5e3),)),
    )
    blocks = [
        Block("mixedB", entrants, range(1)),
        Block("births", entrants[:1], range(2, 3)),
        Block("mixedB", entrants, range(1, 2)),
    ]
    alone, together = play_all(blocks, jobs=1), play_all(blocks, jobs=2)
    assert list(alone) == list(together)
    assert len(alone["mixedB", "agile"]) == 2
    for cell, scores in alone.items():
        assert [score.rmse_px for score in scores] == [score.rmse_px for score in together[cell]]
        assert [score.gospa_px for score in scores] == [score.gospa_px for score in together[cell]]
    assert alone["mixedB", "agile"][0].rmse_px != alone["mixedB", "kalman"][0].rmse_px


def test_the_command_leaves_rows_a_page_and_plots(tmp_path, capsys):
    command = ["bench", "trackers", "--out", str(tmp_path), "--runs", "2", "--jobs", "1"]
    assert swarmtrack.main([*command, "--scene", "noise.75", "latency_steady", "--tracker", "kalman"]) == 0
    result = json.loads((tmp_path / "trackers.json").read_text())
    rows = result["rows"]
    assert {(row["scene"], row["tracker"]) for row in rows} >= {
        ("noise.75", "kalman"),
        ("noise.75", "oracle_cv"),
        ("noise.75", SMOOTHER),
        ("latency_steady", "kalman"),
    }
    for row in rows:
        assert row["runs"] == 2
        low, high = row["rmse_px"]["ci95"]
        assert low <= row["rmse_px"]["mean"] <= high
        assert {"median"} < row["rmse_px"].keys()
        assert {"swap_fraction", "lost_fraction", "gospa_px", "ms_per_scan"} <= row.keys()
    page = (tmp_path / "trackers.md").read_text()
    assert "## What must hold" in page
    assert "kalman" in page
    assert result["machine"]["cores"]
    assert "What must hold" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--scene", "crosing"], "crosing"),
        (["--tracker", "karlman"], "karlman"),
        (["--runs", "0"], "runs"),
        (["--jobs", "-1"], "jobs"),
    ],
)
def test_what_cannot_be_run_is_refused_in_one_line(tmp_path, capsys, arguments, word):
    assert swarmtrack.main(["bench", "trackers", "--out", str(tmp_path), *arguments]) == 2
    message = capsys.readouterr().err.strip()
    assert word in message
    assert "expected" in message
    assert len(message.splitlines()) == 1


def test_missing_peers_are_said_with_their_remedy(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "stonesoup", None)
    with pytest.raises(MissingExtraError, match=r"\.\[peers\]"):
        load_peers()
