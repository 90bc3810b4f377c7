"""The benchmarks' own promises: what they score, what they refuse, and that they run; never how fast."""

import asyncio
import csv
import json
import subprocess
import sys
from importlib import import_module
from unittest.mock import MagicMock

import cv2
import numpy as np
import pytest

from support.labelled_pictures import data_directory
from swarmtrack.agents import main as swarmtrack
from swarmtrack.agents.bench import BENCHMARKS
from swarmtrack.benchmarks import agent_budget, lone_agent, real_clips, report, rotating_observer
from swarmtrack.benchmarks.report import BenchmarkError
from swarmtrack.benchmarks.scripted_agent import centres
from swarmtrack.benchmarks.seen_team import IN_VIEW, SeenTeammate
from swarmtrack.config.drone import load_config
from swarmtrack.training import labelled_clips
from swarmtrack.training.labelled_clips import find_clips, read_truth
from swarmtrack.training.labelled_images import DataError, held_out
from swarmtrack.transport.base import Kind
from swarmtrack.wire import codec
from swarmtrack.wire.tracks import TrackMessage, TracksMessage

FPS = 10.0


def write_truth(path, rows):
    """rows (frame, id, x, y, w, h): the top left corner."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["frame", "id", "x", "y", "w", "h"])
        writer.writerows(rows)
    return path


def track(track_id, u, v, status="confirmed"):
    return {"id": track_id, "identity": None, "u_px": u, "v_px": v, "status": status}


def write_tracks(path, frames):
    lines = [{"t_s": k / FPS, "frame": k, "tracks": tracks} for k, tracks in frames.items()]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
    return path


def test_json_lines_are_scored_from_the_first_second_on_confirmed_tracks_only(tmp_path):
    truth = write_truth(tmp_path / "a_gt.csv", [(k, 1, 90, 90, 20, 20) for k in range(20)])
    jsonl = write_tracks(
        tmp_path / "a.jsonl",
        {
            **{k: [track(3, 0, 0)] for k in range(10)},  # nonsense, in the first second
            10: [track(4, 100, 100), track(5, 400, 400, "tentative")],
            11: [track(4, 103, 104)],
            12: [track(4, 100, 100, "lost")],
            # 13: a frame that was dropped
            14: [track(6, 100, 100), track(7, 100, 101)],  # a switch, and a double
        },
    )
    score = real_clips.score_file(jsonl, truth, fps=FPS)
    assert (score.frames, score.boxes, score.tracks, score.hits, score.switches) == (10, 10, 4, 3, 1)
    assert score.centre_rmse_px == pytest.approx(5.0 / np.sqrt(3.0))


def test_one_file_is_scored_from_the_command_line(tmp_path):
    truth = write_truth(tmp_path / "a_gt.csv", [(k, 1, 90, 90, 20, 20) for k in range(40)])
    jsonl = write_tracks(tmp_path / "a.jsonl", {k: [track(1, 100, 100)] for k in range(0, 40, 2)})
    files = ["--jsonl", str(jsonl), "--gt", str(truth), "--fps", "10"]
    assert swarmtrack.main(["bench", "clips", *files, "--out", str(tmp_path)]) == 0
    (record,) = json.loads((tmp_path / "clips.json").read_text(encoding="utf-8"))["clips"]
    assert (record["recall"], record["precision"], record["identity_switches"]) == (0.5, 1.0, 0)


def test_a_damaged_line_is_named_with_its_number(tmp_path):
    jsonl = write_tracks(tmp_path / "a.jsonl", {0: [], 1: []})
    jsonl.write_text(jsonl.read_text(encoding="utf-8") + '{"t_s": 0.2, "fra', encoding="utf-8")
    with pytest.raises(BenchmarkError, match=r"a\.jsonl:3: .*expected"):
        real_clips.read_tracks(jsonl)


def test_labels_without_a_column_or_with_words_are_refused(tmp_path):
    path = tmp_path / "a_gt.csv"
    for text in ("frame,id,x,y,w\n0,1,2,3,4\n", "frame,id,x,y,w,h\n0,1,2,3,four,5\n"):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(DataError, match=r"a_gt\.csv: .*expected a table"):
            read_truth(path)


def test_a_folder_without_labelled_clips_is_refused(tmp_path):
    write_truth(tmp_path / "lonely_gt.csv", [])
    with pytest.raises(DataError, match=r"no pair of NAME\.mp4 and NAME_gt\.csv"):
        find_clips(tmp_path)


def grey_clip(folder, frames=15, name="grey"):
    writer = cv2.VideoWriter(str(folder / f"{name}.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), FPS, (96, 64))
    for _ in range(frames):
        writer.write(np.full((64, 96, 3), 128, np.uint8))
    writer.release()
    write_truth(folder / f"{name}_gt.csv", [(k, 1, 40, 30, 8, 8) for k in range(frames)])


@pytest.mark.parametrize("name", BENCHMARKS)
def test_every_benchmark_of_the_table_says_its_arguments_and_writes_by_its_name(name, capsys):
    pytest.importorskip("zenoh", reason="Zenoh has no wheel here")
    with pytest.raises(SystemExit, match="0"):
        swarmtrack.main(["bench", name, "--help"])
    assert "--quick" in capsys.readouterr().out
    assert name == import_module(BENCHMARKS[name][0]).BENCH.name


def test_the_benchmarks_are_listed_without_importing_one():
    list_them = (
        "import contextlib, sys; from swarmtrack.agents import main\n"
        "with contextlib.suppress(SystemExit): main.main(['bench', '--help'])\n"
        "sys.exit(any(name.startswith('swarmtrack.benchmarks') for name in sys.modules))"
    )
    listed = subprocess.run([sys.executable, "-c", list_them], capture_output=True, text=True, check=True)
    assert "fixed-lag" in listed.stdout


def test_a_folder_for_results_that_cannot_be_made_is_refused_before_any_work(tmp_path, capsys):
    (tmp_path / "a-file").touch()
    assert swarmtrack.main(["bench", "cost", "--out", str(tmp_path / "a-file" / "bench")]) == 2
    assert "expected a folder" in capsys.readouterr().err


def test_the_config_of_a_clip_is_one_the_agent_takes_and_settings_go_before_it(tmp_path):
    grey_clip(tmp_path)
    (clip,) = find_clips(tmp_path)
    settings = real_clips.parse_settings(["p_detection=0.7", "detector.score_threshold=0.3", "profile=paper"])
    config_file = tmp_path / "drone.toml"
    config_file.write_text(
        real_clips.config_text(clip, "kalman", settings, tmp_path / "out.jsonl", None), encoding="utf-8"
    )
    config = load_config(config_file)
    assert config.tracker.parameters == {"p_detection": 0.7, "profile": "paper"}
    assert config.detector.score_threshold == 0.3
    with pytest.raises(BenchmarkError, match="KEY=VALUE"):
        real_clips.parse_settings(["p_detection"])


def test_a_clip_runs_through_the_agent_and_is_reported(tmp_path):
    grey_clip(tmp_path)
    out = tmp_path / "out"
    assert swarmtrack.main(["bench", "clips", str(tmp_path), "--out", str(out), "--video"]) == 0
    result = json.loads((out / "clips.json").read_text(encoding="utf-8"))
    (record,) = result["clips"]
    assert (record["clip"], record["frames"], record["boxes"], record["recall"]) == ("grey", 5, 5, 0.0)
    assert record["precision"] is None  # of no tracks at all: JSON knows no NaN
    assert len((out / "tracks" / "grey.jsonl").read_text(encoding="utf-8").splitlines()) == 15
    assert "| grey | 5 | 0.000 | – |" in (out / "clips.md").read_text(encoding="utf-8")


def test_tracks_where_no_drone_is_are_counted_by_what_flies_there(tmp_path):
    (clip,) = [labelled_clips.Clip("V_BIRD_001", tmp_path, tmp_path, 70, FPS, 96, 64)]
    frames = {5: [track(1, 0, 0)], 9: [track(2, 0, 0)], 10: [track(2, 0, 0), track(3, 9, 9, "tentative")]}
    frames |= {40: [track(4, 5, 5)], 41: [track(4, 5, 5), track(5, 50, 50)]}
    counted = real_clips.count_false_tracks(clip, write_tracks(tmp_path / "a.jsonl", frames))
    assert (counted.frames, counted.tracks, counted.frames_with) == (60, 3, 3)


def test_drone_free_clips_are_those_that_a_training_holds_out(tmp_path):
    data_directory(tmp_path)
    for name in ("V_BIRD_001", "V_BIRD_002", "V_BIRD_003", "V_BIRD_004", "V_DRONE_001"):
        grey_clip(tmp_path, name=name)
    assert swarmtrack.main(["bench", "clips", str(tmp_path), "--drone-free", "--out", str(tmp_path)]) == 0
    result = json.loads((tmp_path / "clips.json").read_text(encoding="utf-8"))
    wanted = [f"V_BIRD_00{k}" for k in range(1, 5) if held_out("negative", f"V_BIRD_00{k}")]
    assert 0 < len(wanted) < 4
    assert [record["clip"] for record in result["clips"]] == wanted
    assert set(result["by_kind"]) == {"bird"}
    assert result["total"]["tracks"] == 0
    assert "| bird |" in (tmp_path / "clips.md").read_text(encoding="utf-8")


def test_an_agent_that_fails_is_quoted(tmp_path):
    grey_clip(tmp_path)
    with pytest.raises(BenchmarkError, match="p_detection"):
        real_clips.BENCH.publish(tmp_path / "out", data=tmp_path, set=["p_detection=7"])


@pytest.mark.long(
    "four seeds of a benchmark; tracking/test_smoothing.py and cameras/test_rig.py turn cameras in the default run"
)
def test_the_gyro_keeps_a_turning_observer_s_tracks_where_the_drones_are(tmp_path):
    """Must hold 4 in small; the benchmark itself flies a hundred seeds."""
    assert swarmtrack.main(["bench", "rotation", "--quick", "--out", str(tmp_path)]) == 0
    result = json.loads((tmp_path / "rotation.json").read_text(encoding="utf-8"))
    assert result["rotating_over_still"]["value"] < 2.2  # four seeds
    assert result["no_gyro_over_gyro"]["value"] > 8.0
    assert result["rmse_px"]["still"]["value"] > 1.0  # noise of 1.5 px, carried on for 0.15 to 0.3 s
    assert result["untracked_share"]["rotating"] < 0.05
    assert all(row["ok"] for row in result["edge"].values())


def test_a_seed_flies_the_same_flight_bit_for_bit():
    experiment = rotating_observer.Experiment(ends_s=rotating_observer.HOVER_S + 1.5)
    first, second = (rotating_observer.fly(experiment, "kalman", 3) for _ in range(2))
    for name in rotating_observer.CONDITIONS:
        assert np.array_equal(first[name].error, second[name].error, equal_nan=True)
        assert np.isfinite(first[name].error).any()


def test_the_error_of_a_drone_is_that_of_the_nearest_free_track():
    truth = np.array([[100.0, 100.0], [np.nan, np.nan], [200.0, 100.0]])
    errors = rotating_observer._errors(truth, np.array([[203.0, 104.0], [500.0, 100.0], [100.0, 101.0]]))
    assert errors == pytest.approx([1.0, np.nan, 5.0], nan_ok=True)
    assert np.isnan(rotating_observer._errors(truth, np.empty((0, 2)))).all()


def message(t_utc, exposure, sequence, status="confirmed"):
    unit = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 1.0)
    one = TrackMessage(1, None, 0.0, 10.0, 0.0, 20.0, 0.0, unit, 5.0, 5.0, status, 0.9, None)
    return codec.encode(TracksMessage(1, t_utc, 0.01, sequence, t_utc - exposure, (one,)))


def test_latency_is_taken_at_the_first_message_with_a_new_scan(monkeypatch):
    heard = lone_agent.Heard()
    start = 1.7e9
    arrivals = [(0.004, 0.0, "tentative"), (0.024, 0.0, "confirmed"), (0.100, 0.0667, "confirmed")]
    for sequence, (arrival, exposure, status) in enumerate(arrivals):
        monkeypatch.setattr(lone_agent.time, "time", lambda arrival=arrival: start + arrival)
        monkeypatch.setattr(lone_agent.time, "monotonic", lambda arrival=arrival: arrival)
        heard.receive(Kind.TRACKS, message(start + arrival, start + exposure, sequence, status))
    assert heard.latencies == pytest.approx([0.004, 0.0333], abs=1e-5)
    assert heard.first_track_at == 0.024


def test_an_agent_of_its_own_process_is_heard_and_measured(monkeypatch):
    monkeypatch.setattr(agent_budget, "SETTLE_S", 0.5)
    lines = agent_budget.agent_lines("kalman", 1.5)
    found = {line.unit: line.value for line in lines}
    assert 0.0 < found["% of a core"] < 100.0
    assert 50.0 < found["MB"] < 1000.0
    assert next(line for line in lines if line.unit == "Hz").value > 50.0


def test_a_tracker_is_timed_against_its_budget():
    lines = agent_budget.tracker_lines("kalman", repeats=3)
    assert [line.budget for line in lines] == [50.0, None, 0.3]
    assert all(line.value > 0.0 for line in lines)


def test_what_is_not_finite_becomes_null_in_json(tmp_path):
    report.write(tmp_path, "x", {"a": float("nan"), "b": [float("inf"), 1.0]}, "# X")
    written = json.loads((tmp_path / "x.json").read_text(encoding="utf-8"))
    assert (written["a"], written["b"]) == (None, [None, 1.0])
    assert written["machine"]["python"]


def test_a_team_stands_where_the_scripted_detector_finds_it():
    drones = [SeenTeammate(MagicMock(), "team", drone_id) for drone_id in range(1, 31)]
    for drone in drones:
        drone.team = drones
    seen = drones[0]._in_view(5.0)
    assert set(IN_VIEW) <= set(seen)
    found = centres(5.0, lone_agent.CAMERA.width, lone_agent.CAMERA.height)
    for drone_id, pixel in zip(IN_VIEW, found, strict=True):
        assert lone_agent.CAMERA.project(seen[drone_id].vector[None])[0][0] == pytest.approx(pixel, abs=0.1)
    # All others are behind it, apart from each other, and look at it.
    behind = [drone for drone in drones if drone.drone_id > IN_VIEW[-1]]
    assert all(drone.position(5.0)[0] < -5.0 for drone in behind)
    assert len({tuple(drone.position(5.0)) for drone in behind}) == len(behind)
    assert all(1 in drone._in_view(5.0) for drone in drones[1:])


@pytest.mark.long("flies an agent in a team for ten seconds")
def test_an_agent_of_a_team_is_measured_once_it_names_all_that_it_sees(monkeypatch):
    monkeypatch.setattr(agent_budget, "SETTLE_S", 0.5)
    cpu, memory = agent_budget.team_lines("kalman", 1.5, [5])
    assert 0.0 < cpu.value < 100.0
    assert 50.0 < memory.value < 1000.0


def test_an_agent_that_ends_or_names_others_is_not_waited_for_forever(monkeypatch):
    monkeypatch.setattr(lone_agent, "PATIENCE_S", 0.05)
    heard = lone_agent.Heard(named={3})
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        asyncio.run(lone_agent.until_named(process, heard, {3}))
        with pytest.raises(BenchmarkError, match=r"expected tracks of drones \[2, 3\]"):
            asyncio.run(lone_agent.until_named(process, heard, {2, 3}))
        process.kill()
        process.wait()
        with pytest.raises(BenchmarkError, match="ended with"):
            asyncio.run(lone_agent.until_tracking(process, heard))
