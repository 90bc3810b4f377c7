"""`swarmtrack bench endurance`: what it counts and judges on made-up flights, and that a short real one is measured."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("zenoh", reason="Zenoh has no wheel here")
pytest.importorskip("matplotlib", reason="matplotlib is an extra: swarmtrack[bench]")

from swarmtrack.agents import main as swarmtrack
from swarmtrack.benchmarks.endurance import verdict
from swarmtrack.benchmarks.endurance.flight import agent_window
from swarmtrack.benchmarks.endurance.plot import draw
from swarmtrack.benchmarks.endurance.verdict import AgentWindow, ViewerWindow, Window
from swarmtrack.wire.health import HealthMessage, LatencyHealth, LinkHealth, RateHealth

RATES = {"tracks": 20.0, "detections": 7.0, "imu": 200.0}
STEADY = AgentWindow(10, RATES, 0.002, 0.01, 2000, 2000.0, 0, 0, 0, 3000, 0)


def flight(n: int = 60, seconds: float = 10.0) -> list[Window]:
    """Nothing grows, lags or is lost."""
    sizes = {"drone 1": 90.0, "monitor": 60.0, verdict.JUDGE: 100.0}
    viewer = ViewerWindow(5.0, 20.0, 10.0, 0.21)
    return [
        Window((k + 1) * seconds, seconds, sizes, dict.fromkeys(sizes, 5.0), 10.0, {1: STEADY}, viewer)
        for k in range(n)
    ]


def broken(windows: list[Window]) -> list[tuple[str, str]]:
    return [(claim.what, claim.who) for claim in verdict.judge(windows) if not claim.ok]


def with_agent(window: Window, **changes) -> Window:
    return replace(window, agents={1: window.agents[1]._replace(**changes)})


def with_rss(window: Window, name: str, factor: float) -> Window:
    return replace(window, rss_mb={**window.rss_mb, name: factor * window.rss_mb[name]})


def test_a_flight_without_fault_holds_all_claims():
    assert len(verdict.judge(flight())) == 2 + 1 + 1 + 3  # processes but the judge; lag; IMU; rates
    assert broken(flight()) == []


def test_who_grows_is_named_and_one_full_buffer_is_no_growth():
    creeping = [with_rss(window, "monitor", 1.0 + 0.1 * k / 60) for k, window in enumerate(flight())]
    assert broken(creeping) == [("memory grown", "monitor")]
    once = flight()
    once[-1] = with_rss(once[-1], "monitor", 1.3)
    assert broken(once) == []
    assert broken([with_rss(w, verdict.JUDGE, 1.0 + k) for k, w in enumerate(flight())]) == []


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"lag_max_s": 0.12}, "event loop late, at most"),
        ({"imu_lost": 1}, "IMU samples lost"),
        ({"rates_hz": {**RATES, "tracks": 18.9}}, "tracks a second, farthest from the median"),
        ({"rates_hz": {**RATES, "imu": 211.0}}, "imu a second, farthest from the median"),
        ({"rates_hz": {}}, "tracks a second, farthest from the median"),
    ],
)
def test_one_bad_window_is_enough(changes, what):
    windows = flight()
    windows[30] = with_agent(windows[30], **changes)
    assert (what, "drone 1") in broken(windows)


def test_a_sample_that_came_late_after_all_is_not_lost():
    windows = flight()
    windows[30] = with_agent(windows[30], imu_lost=1, imu_gaps=1)
    windows[31] = with_agent(windows[31], imu_lost=-1)
    assert broken(windows) == []


def test_an_agent_that_fell_silent_holds_nothing():
    windows = flight()
    windows[30] = replace(windows[30], agents={})
    assert {who for _, who in broken(windows)} == {"drone 1"}
    assert len(broken(windows)) == 5


def test_what_happens_before_a_flight_has_settled_is_not_judged():
    assert verdict.settled_s(1800.0) == 300.0
    assert verdict.settled_s(60.0) == 12.0
    windows = flight()
    windows[0] = with_agent(windows[0], lag_max_s=3.0)
    assert broken(verdict.judged(windows, 300.0)) == []
    assert len(verdict.judged(windows, 300.0)) == 30
    assert verdict.judge([]) == []


def health(uptime_s: float, tracks_hz: float, imu: int, lost: int, *, lag_s: float = 0.001):
    return HealthMessage(
        version=1,
        t_utc_s=1.7e9,
        boot="0123abcd",
        uptime_s=uptime_s,
        cpu_percent=5.0,
        rss_mb=90.0,
        rates={"tracks": RateHealth(20.0, tracks_hz), "imu": RateHealth(200.0, 200.0)},
        latencies={"loop_lag": LatencyHealth(0.0, lag_s / 2, lag_s)},
        clock_offset_s=None,
        clock_offset_sigma_s=None,
        links=(
            LinkHealth("autopilot", True, "", {"imu_samples": imu, "imu_lost": lost, "gaps": 7 * lost}),
            LinkHealth("detections://localhost:9/1", True, "", {"frames": 50 * lost, "dropped": 2 * lost}),
            LinkHealth("recording", True, "", {"written": 10 * imu, "lost": 2}),
        ),
        drops={"stale_frames": lost, "late_scans": 4, "scans": 100 * lost},
        events=(),
    )


def test_counters_are_of_the_window_and_rates_are_weighted_by_time():
    before = health(10.0, 99.0, 2000, 1, lag_s=5.0)
    window = agent_window(before, [health(11.0, 10.0, 2200, 1, lag_s=0.04), health(14.0, 22.0, 2790, 3)])
    assert window.rates_hz == pytest.approx({"tracks": 19.0, "imu": 200.0})
    assert (window.imu_samples, window.imu_lost, window.imu_gaps, window.frames_dropped) == (790, 2, 14, 6)
    assert window.imu_expected == pytest.approx(800.0)
    assert (window.lag_max_s, window.lag_p95_s) == (0.04, 0.02)
    assert (window.recorded, window.unrecorded) == (7900, 0)


def test_a_flight_with_a_gap_is_drawn(tmp_path):
    windows = flight()
    windows[30] = replace(windows[30], agents={})
    windows[31] = with_agent(windows[31], rates_hz={}, lag_max_s=math.nan)
    draw(tmp_path / "endurance.png", windows, 300.0)
    assert (tmp_path / "endurance.png").stat().st_size > 10_000


@pytest.mark.long("a real flight of eight seconds, watched from outside")
def test_a_real_flight_is_measured_from_outside(tmp_path: Path, capsys) -> None:
    """Eight seconds; not how well it went, which is the machine's."""
    assert swarmtrack.main(["bench", "endurance", "--minutes", "0.13", "--out", str(tmp_path)]) == 0
    result = json.loads((tmp_path / "endurance.json").read_text(encoding="utf-8"))
    windows = result["windows"]
    assert windows
    assert set(windows[-1]["rss_mb"]) == {"drone 1", "drone 2", "drone 3", "monitor", "simulator", "judge"}
    assert all(size > 10.0 for window in windows for size in window["rss_mb"].values())
    agents = [agent for window in windows for agent in window["agents"].values()]
    assert sum(agent["imu_samples"] for agent in agents) > 1000
    assert sum(agent["recorded"] for agent in agents) > 1000
    assert all(agent["lag_max_s"] >= agent["lag_p95_s"] >= 0.0 for agent in agents)
    assert sum(window["viewer"]["states_hz"] for window in windows) > 0.0
    assert sum(window["viewer"]["views_hz"] for window in windows) > 0.0
    assert result["sim"]["agents"]
    assert result["recorded_mb"] > 0.1
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == []  # the recording is gone
    text = (tmp_path / "endurance.md").read_text(encoding="utf-8")
    assert "drone 3" in text
    assert "claims" in text
    assert "| drone 1 |" in capsys.readouterr().out
