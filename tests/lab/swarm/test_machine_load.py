"""A verdict on a machine without time to spare says so."""

import math
import os
from dataclasses import replace

import pytest
from rich.console import Console

from support.swarm_report import GOOD, GOOD_AGENT, GOOD_SCORE
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.score.swarm_verdict import Limits
from swarmtrack.lab.swarm.detail import Detail
from swarmtrack.lab.swarm.machine_load import (
    Capacity,
    MachineLoad,
    choose_detail,
    described,
    lighter_flights,
    too_large,
)
from swarmtrack.lab.swarm.table import advice, agents_table, headline, team_rows, team_table

WRONG = replace(GOOD_SCORE, wrong=0.01)


def stat(path, user, idle, waiting=0):
    path.write_text(f"cpu  {user} 0 0 {idle} {waiting} 0 0 0 0 0\ncpu0 0 0 0 0 0 0 0 0 0 0\n")


def process(folder, pid, user, system):
    """/proc/PID/stat of a process whose name is made to mislead."""
    (folder / str(pid)).mkdir(exist_ok=True)
    rest = " ".join(["S", *10 * ["0"], str(user), str(system), "0"])
    (folder / str(pid) / "stat").write_text(f"{pid} (a) b) {rest}\n")


def test_what_was_spent_is_that_of_the_time_since_it_was_made(tmp_path):
    stat(tmp_path / "stat", user=1000, idle=9000)
    load = MachineLoad(stat=tmp_path / "stat")
    stat(tmp_path / "stat", user=1090, idle=9005, waiting=5)
    assert load.spent() == pytest.approx((0.9, 0.9))


def test_what_others_spent_is_what_neither_we_nor_our_children_did(tmp_path):
    children = [7]
    stat(tmp_path / "stat", user=1000, idle=9000)
    process(tmp_path, os.getpid(), 100, 0)
    process(tmp_path, 7, 10, 10)
    load = MachineLoad(lambda: children, tmp_path / "stat")
    stat(tmp_path / "stat", user=1090, idle=9010)
    process(tmp_path, os.getpid(), 105, 5)
    process(tmp_path, 7, 30, 20)
    assert load.spent() == pytest.approx((0.9, 0.5))
    load.sample(1.0)
    children.clear()
    stat(tmp_path / "stat", user=1190, idle=9010)
    load.sample(2.0)
    assert load.spent_in([(1.0, 2.0)]) == pytest.approx((1.0, 1.0)), "who has ended spends nothing any more"
    assert load.spent() == pytest.approx((190 / 200, 150 / 200))


def test_what_was_spent_in_some_seconds_is_theirs_alone(tmp_path):
    file = tmp_path / "stat"
    stat(file, user=0, idle=0)
    load = MachineLoad(stat=file)
    for second, (user, idle) in enumerate([(0, 0), (50, 150), (250, 150), (440, 160), (460, 340)]):
        stat(file, user=user, idle=idle)
        load.sample(float(second))
    assert load.spent_in([(1.2, 1.9)]).busy == pytest.approx(1.0)
    assert load.spent_in([(1.5, 2.5)]).busy == pytest.approx(390 / 400)
    assert load.spent().busy == pytest.approx(0.575)
    assert math.isnan(load.spent_in([]).busy)
    assert math.isnan(load.spent_in([(10.0, 11.0)]).busy)


@pytest.mark.parametrize("content", ["", "cpu one two", "nonsense"])
def test_where_the_kernel_does_not_say_it_is_unknown(tmp_path, content):
    assert math.isnan(MachineLoad(stat=tmp_path / "missing").spent().busy)
    (tmp_path / "stat").write_text(content)
    assert math.isnan(MachineLoad(stat=tmp_path / "stat").spent().by_others)


def test_only_what_was_not_flown_yet_is_advised():
    assert lighter_flights(3, "onnx") == (
        "with fewer --drones or with --detector oracle or when nothing else runs on it"
    )
    assert lighter_flights(2, "oracle") == "when nothing else runs on it"


def test_this_machine_is_somewhere_between_idle_and_busy():
    load = MachineLoad()
    sum(range(3_000_000))
    for share in load.spent():
        assert math.isnan(share) or 0.0 <= share <= 1.0


@pytest.mark.parametrize(
    ("scenario", "others", "speed", "detail"),
    [
        ("hover-triangle", 0.0, 1.0, Detail.FULL),
        ("hover-triangle", 2.0, 1.0, Detail.LOW),
        ("hover-triangle", 2.0, 0.1, Detail.LOW),
        ("hover-triangle", 2.0, 4.0, Detail.FULL),
        ("crossing", 0.0, 1.0, Detail.REDUCED),
    ],
)
def test_as_much_is_simulated_as_the_machine_has_time_for(scenario, others, speed, detail):
    whole, capacity = load_scenario(scenario), Capacity(2, others, speed)
    assert choose_detail(whole, "onnx", capacity) is detail
    line = described(whole, "onnx", capacity, detail)
    assert f"{2 - others:.1f} of 2 cores are free" in line
    assert (f"with {detail} detail" in line) is (detail is not Detail.FULL)


def test_detail_that_would_save_nothing_is_not_given_up():
    assert choose_detail(load_scenario("thirty"), "oracle", Capacity(2, 0.0, 1.0)) is Detail.FULL


def test_less_detail_is_fewer_frames_of_the_same_flight():
    whole = load_scenario("crossing")
    low = Detail.LOW.of(whole)
    assert low.world is whole.world
    assert (low.fps, low.imu_rate_hz, low.tracks_hz) == (3.0, 50.0, 20.0)
    assert low.camera == whole.camera
    assert Detail.FULL.of(whole) is whole
    slow = load_scenario("thirty")
    assert Detail.REDUCED.of(slow).fps == slow.fps, "no rate is raised"


def test_what_comes_more_rarely_is_expected_later():
    whole = load_scenario("crossing")
    limits = Detail.LOW.expected(whole, Limits())
    assert limits.rmse_px == pytest.approx(2.5 * 15.0 / 3.0)
    assert limits.time_to_identify_s == pytest.approx(10.0)
    assert Detail.FULL.expected(whole, Limits()) == Limits()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, "PASSED"),
        ({"detail": "low"}, "PASSED with low detail"),
        (
            {"score": WRONG, "machine_busy": 1.0, "others_busy": 0.5},
            "FAILED: wrong names 1.00% (expected ≤ 0%).",
        ),
        (
            {"all_known_s": math.nan},
            "FAILED: all announcements received never (expected ≤ 5). No wrong name was given.",
        ),
        ({"cut_off_s": 7.3}, "NOT JUDGED: cut off after 7 of 20 s. No wrong name was given."),
        (
            {"all_known_s": math.nan, "machine_busy": 1.0, "others_busy": 0.85},
            "NOT JUDGED: this machine was too busy (cores 100%, other programs 85%). No wrong name was given.",
        ),
        (
            {"all_known_s": math.nan, "machine_busy": 0.97},
            "NOT JUDGED: this machine was too busy (cores 97%). No wrong name was given.",
        ),
    ],
)
def test_the_headline_says_what_the_flight_comes_to(changes, said):
    report = replace(GOOD, **changes)
    assert headline(report) == said
    assert bool(advice(report)) is ("too busy" in said)
    assert any(row.short for row in team_rows(report)) is bool(report.shortfalls)


def test_a_headline_has_two_clauses_and_the_tables_mark_the_rest():
    score = replace(GOOD.score, correct=0.34, time_to_identify_s={1: 16.5, 2: 0.9}, wrong=0.02)
    report = replace(GOOD, score=score, agents=(replace(GOOD_AGENT, track_rate_hz=40.0),))
    assert headline(report) == (
        "FAILED: wrong names 2.00% (expected ≤ 0%), slowest identification 16.5 s (expected ≤ 2), and 2 more "
        "(marked !)."
    )
    console = Console(width=80, record=True)
    console.print(agents_table(report), team_table(report))
    said = console.export_text()
    for words in ("! 16.5", "! 40.0", "! 2.00%", "! 34.00%"):
        assert words in said, words


def test_a_flight_that_does_not_fit_into_memory_says_how_large_one_may_be(tmp_path):
    memory = tmp_path / "meminfo"
    memory.write_text("MemTotal:       8000000 kB\nMemAvailable:   2097152 kB\n")
    assert too_large(24, "onnx", memory) == ""
    assert too_large(25, "onnx", memory) == (
        "25 drones: 25 agents need 2.1 GB of memory, 2.0 GB are free, expected 24 drones at most on this machine"
    )
    assert too_large(25, "oracle", memory) == ""
    assert too_large(1000, "oracle", tmp_path / "none") == ""
