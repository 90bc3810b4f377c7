"""What the benchmark of the first command reads off a run, and what it makes of many."""

import asyncio
import os
import sys

import pytest

from swarmtrack.benchmarks.first_command import Run, Usage, _Heard, _kind, _page, _summary, others_busy


def figures(rmse=1.8, wrong=0.0):
    return {
        "tracking": {"rmse_px": {"1": rmse, "2": 0.5, "3": None}},
        "identity": {"correct": 0.99, "wrong": wrong},
        "relative": {"range_error": {"p95": 0.03}},
    }


def run(code=0, words="PASSED", cores=0.9, **more):
    return Run(code, words, figures(**more), 27.0, 5.0, 20.0, {"agents": 0.6, "judge": cores - 0.6}, 0.95)


def test_processes_are_told_apart_by_their_command_lines():
    assert _kind(b"python\0-m\0swarmtrack.agents.vehicle\0--config\0x") == "agents"
    assert _kind(b"python\0-m\0swarmtrack.agents.simulator\0") == "simulator"
    assert _kind(b"python\0-m\0swarmtrack.agents.main\0sim") == "judge"
    assert _kind(b"nice\0") == "others"


async def test_what_a_run_uses_is_what_the_kernel_counted_of_its_processes():
    busy = "import time\nt = time.process_time()\nwhile time.process_time() < t + 0.4: pass\nprint(); time.sleep(60)"
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", busy, stdout=asyncio.subprocess.PIPE, env={**os.environ, "MARK": "abc"}
    )
    try:
        usage = Usage(b"MARK=abc")
        await process.stdout.readline()
        usage.sample()
        assert 0.35 <= sum(usage.by_kind().values()) < 5.0
        assert os.getpid() not in usage.seconds
    finally:
        process.kill()
        await process.wait()


def test_a_flight_is_between_its_first_and_its_last_line():
    heard = _Heard(Usage(b"MARK=nobody"), began=0.0)
    for line in (
        "waiting for the simulator …",
        "   0 s  nothing to judge yet",
        "  12 s  names 100% correct",
        "PASSED",
    ):
        heard.line(line)
    assert heard.verdict == "PASSED"
    assert heard.flown_s >= 0.0
    heard.line("NOT JUDGED: this machine was too busy (cores 100%). No wrong name was given.")
    assert heard.verdict.startswith("NOT JUDGED")


def test_all_runs_have_to_pass_and_to_fit():
    good = _summary([run(), run(rmse=2.1)])
    assert good["ok"]
    assert good["rmse_px"] == pytest.approx({"p50": 1.95, "max": 2.1})
    assert good["cores"]["max"] == pytest.approx(0.9)
    assert not _summary([run(), run(code=3, words="NOT JUDGED")])["ok"]
    assert not _summary([run(cores=1.3)])["ok"]


def test_the_table_has_a_row_for_each_scenario_and_says_beside_what():
    text = _page({"busy": 2, "scenarios": {"crossing": _summary([run(), run(code=1, words="FAILED")])}})
    assert "| crossing | 1 of 2 |" in text
    assert "Beside 2 other processes" in text
    assert "crossing: PASSED: 1; FAILED: 1." in text


async def test_the_other_processes_end_with_the_benchmark():
    async with others_busy(2) as processes:
        assert [process.returncode for process in processes] == [None, None]
    assert None not in [process.returncode for process in processes]
