"""`swarmtrack sim`: what it starts, what it says of it, and that it leaves nothing behind."""

from __future__ import annotations

import asyncio
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple
from urllib.request import urlopen

import pytest

from support.browser import browser_page, needs_chromium
from support.called import called
from support.flown_pair import address
from support.launcher import finish, living, pid_of, start
from support.pair_scenario import PAIR, is_fair, pair
from support.patience import PATIENCE, until
from support.places import ROOT

pytest.importorskip("zenoh", reason="Zenoh has no wheel here")

from swarmtrack.agents import main as swarmtrack
from swarmtrack.config.drone import load_config, mount_camera
from swarmtrack.errors import RecordingError
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.swarm.configs import RadioEnds, Sources, write_configs
from swarmtrack.lab.swarm.processes import Children
from swarmtrack.recording.reader import recordings_below

# --- the parts ------------------------------------------------------------------------------------


def test_the_configs_say_what_the_scenario_says(tmp_path):
    scenario = load_scenario("thirty")
    sources = {
        d: Sources(f"detections://127.0.0.1:9/{d}", f"udpout:127.0.0.1:{5000 + d}") for d in scenario.members
    }
    files = write_configs(tmp_path, scenario, team="blue", tracker="kalman", sources=sources, simulator="…")
    assert set(files) == set(scenario.members)
    config = load_config(files[17])
    mounted = mount_camera(config.camera)
    assert (config.drone.id, config.network.team, config.tracker.name) == (17, "blue", "kalman")
    assert (config.camera.source, config.autopilot.link) == (sources[17].camera, sources[17].autopilot)
    assert (config.autopilot.imu_rate_hz, config.output.tracks_hz) == (
        scenario.imu_rate_hz,
        scenario.tracks_hz,
    )
    assert config.camera.max_age_s == 0.15
    assert config.drone.start.source == "local"
    assert config.drone.start.offset_m == pytest.approx(scenario.announced[17].position_m, abs=1e-3)
    assert mounted.camera == scenario.camera
    assert mounted.body_from_camera.rotation == pytest.approx(scenario.body_from_camera.rotation)
    assert mounted.body_from_camera.position == pytest.approx(scenario.body_from_camera.position)


def test_with_a_radio_the_configs_name_its_ends(tmp_path):
    scenario = load_scenario("hover-triangle", drones=2)
    ends = {d: RadioEnds((f"tcp/198.18.0.{d}:7447",), ("tcp/198.18.0.1:7447",)[: d - 1]) for d in (1, 2)}
    sources = dict.fromkeys((1, 2), Sources("http://127.0.0.1:9/1", "udpout:127.0.0.1:5000"))
    files = write_configs(
        tmp_path, scenario, team="blue", tracker="kalman", sources=sources, simulator="…", radio=ends
    )
    network = load_config(files[2]).network
    assert (network.listen, network.connect) == (ends[2].listen, ends[2].connect)


async def test_a_child_that_ends_by_itself_is_told_of_and_one_that_we_end_is_not(tmp_path):
    folder = tmp_path / "flight"
    folder.mkdir()
    async with Children(folder, keep=False) as children:
        ended = await children.start("quiet one", [sys.executable, "-c", "import time; time.sleep(600)"])
        await children.end(ended)
        words = "import sys; print('no camera', file=sys.stderr); sys.exit(3)"
        died = await children.start("sad one", [sys.executable, "-c", words])
        assert await asyncio.wait_for(children.died, PATIENCE) is died
        assert died.describe_end() == "sad one ended by itself, exit code 3. Its last lines:\n  | no camera"
    assert not folder.exists()


async def test_a_child_that_has_another_in_its_place_is_not_missed(tmp_path):
    async with Children(tmp_path, keep=True) as children:
        ended = []
        sleeps = [sys.executable, "-c", "import time; time.sleep(600)"]
        child = await children.start("one", sleeps, replace=lambda child: bool(ended.append(child)) or True)
        os.kill(child.process.pid, signal.SIGKILL)
        async with asyncio.timeout(PATIENCE):
            while not ended:  # noqa: ASYNC110 (what is waited for happens in another process)
                await asyncio.sleep(0.02)
        assert ended == [child]
        assert child.killed_by is signal.SIGKILL
        assert not children.died.done()


async def test_a_child_that_does_not_listen_is_killed(tmp_path, monkeypatch):
    monkeypatch.setattr("swarmtrack.lab.swarm.processes.STOP_S", 0.2)
    async with Children(tmp_path, keep=True) as children:
        deaf = "import signal, time; signal.signal(15, signal.SIG_IGN); print('deaf', flush=True); time.sleep(600)"
        child = await children.start("deaf one", [sys.executable, "-c", deaf], talks=True)
        assert child.process.stdout is not None
        await asyncio.wait_for(child.process.stdout.readline(), PATIENCE)
    assert child.process.returncode == -signal.SIGKILL
    assert tmp_path.exists()


def test_a_module_runs_on_a_clock_that_is_wrong(tmp_path):
    (tmp_path / "tells.py").write_text(
        "import sys, time\nfrom swarmtrack.clock import SystemClock\n"
        "print(SystemClock().utc(), SystemClock().now() - time.monotonic(), sys.argv[1:], __name__)\n"
    )
    said = subprocess.run(
        [sys.executable, "-m", "swarmtrack.lab.swarm.skewed_clock", "-7200", "tells", "--config", "x"],
        env={**os.environ, "PYTHONPATH": f"{ROOT}:{tmp_path}"},
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    utc, monotonic, *rest = said.split(maxsplit=2)
    assert -7200 - PATIENCE < float(utc) - time.time() < -7100
    assert float(monotonic) == pytest.approx(0.0, abs=1.0)
    assert rest == ["['--config', 'x'] __main__\n"]


# --- a whole flight -------------------------------------------------------------------------------


def test_a_small_swarm_knows_itself_and_says_so_in_json(flown_pair):
    assert flown_pair.complained == ""
    result = flown_pair.verdict
    assert result["identity"]["wrong"] == 0.0
    agent_keys = {
        "id", "track_rate_hz", "imu_rate_hz", "detection_rate_hz", "latency_ms", "cpu_percent", "rss_mb",
        "announcement_bytes",
    }  # fmt: skip
    assert list(result) == [
        "scenario", "drones", "seconds", "seed", "tracker", "detector", "identity", "tracking", "relative", "agents",
        "detail", "machine_busy", "others_busy", "cut_off_s", "shortfalls", "verdict", "passed",
    ]  # fmt: skip
    assert (result["scenario"], result["drones"], result["seconds"]) == ("pair", 2, flown_pair.seconds)
    assert (result["seed"], result["tracker"], result["detector"]) == (1, "mbm", "oracle")
    assert list(result["identity"]) == [
        "time_to_identify_s", "correct", "proved", "wrong", "wrong_max_probability", "unknown", "agreement",
    ]  # fmt: skip
    assert set(result["identity"]["time_to_identify_s"]) <= {"1", "2"}
    assert list(result["tracking"]) == ["rmse_px", "recall", "false_tracks_per_s", "switches"]
    assert set(result["tracking"]["rmse_px"]) <= {"1", "2"}
    assert list(result["relative"]) == ["rmse_m", "range_error", "nees6", "samples"]
    assert [agent["id"] for agent in result["agents"]] == [1, 2]
    for agent in result["agents"]:
        assert set(agent) == agent_keys
        assert set(agent["latency_ms"]) == {"p50", "p95"}
        assert 0 < agent["announcement_bytes"] < 300
        assert agent["cpu_percent"] > 0
        assert agent["rss_mb"] > 10


def test_a_number_that_is_not_as_expected_fails_the_flight_and_is_named(flown_pair):
    assert flown_pair.code == 1
    assert flown_pair.verdict["passed"] is False
    headline = flown_pair.said[flown_pair.said.index("FAILED") :].splitlines()[0]
    assert "announcement bytes of 2 drones" in headline
    assert "(expected ≤ 9)" in headline


def test_the_monitor_serves_the_flights_page_and_ends_with_it(flown_pair):
    assert b"swarmtrack" in flown_pair.page
    with pytest.raises(OSError, match="refused"):
        urlopen(flown_pair.url, timeout=PATIENCE)


def test_kept_configs_are_those_of_real_agents_and_nothing_else_is_left(flown_pair):
    (folder,) = flown_pair.folder.glob("swarmtrack-sim-*")
    assert str(folder) in flown_pair.said
    names = {path.name for path in folder.iterdir()}
    assert {"team.toml", "drone-1.toml", "drone-2.toml", "drone-1.log", "simulator.log"} <= names
    assert load_config(folder / "drone-2.toml").drone.id == 2
    assert {path.name for path in flown_pair.folder.iterdir()} == {"out.json", "recording", folder.name}
    assert not flown_pair.living


@needs_chromium
async def test_the_page_stays_after_the_flight_with_its_verdict_until_ctrl_c(tmp_path):
    out = tmp_path / "out.json"
    options = ("--detector", "oracle", "--seconds", "6", "--stay", "--json", str(out))
    flight = start(tmp_path, *pair(tmp_path), *options)
    try:
        _, url = await address(flight)
        async with browser_page() as (page, misdeeds):
            await page.goto(url)
            said = [await asyncio.to_thread(flight.stdout.readline)]
            while said[-1] and not said[-1].endswith("it stays until Ctrl-C\n"):
                said.append(await asyncio.to_thread(flight.stdout.readline))
            await page.wait_for_selector("body.over #verdict dd")
            sentence = await page.inner_text("#sentence")
            assert f"{sentence.removeprefix('the flight is over: ')}\n" in said
            assert "correct names" in await page.inner_text("#verdict")
            await page.reload()
            await page.wait_for_selector("body.over #verdict dd")
            assert await page.locator(".camera").count() == 2
            flight.send_signal(signal.SIGINT)
            code, _, complained = await asyncio.to_thread(finish, flight)
            assert complained == ""
            assert is_fair(code, "".join(said[:-1])), said
            assert json.loads(out.read_text())["passed"] is (code == 0)
            # What is over is not out of date, and still says so.
            assert await page.inner_text("#sentence") == sentence
            assert [line for line in misdeeds if "ERR_CONNECTION_REFUSED" not in line] == []
    finally:
        flight.kill()
    assert {path.name for path in tmp_path.iterdir()} == {"out.json", "pair.toml"}
    assert not living(tmp_path)


class Heard(NamedTuple):
    """A recorded flight that was listened to, then ended by Ctrl-C."""

    team: str
    told: list[str]
    listener: subprocess.CompletedProcess[str]
    deaf: subprocess.CompletedProcess[str]
    """By who listens to another team."""
    recording: Path


@pytest.fixture(scope="module")
def heard(tmp_path_factory):
    folder = tmp_path_factory.mktemp("heard")
    team = f"test-{os.getpid()}-{time.monotonic_ns()}"
    _, scenario = pair(folder)
    recording = folder / "recording"
    options = ("--detector", "oracle", "--seconds", "600", "--team", team, "--record", str(recording))
    flight = start(folder, scenario, *options)
    try:
        told = [flight.stdout.readline() for _ in range(5)]
        (listen,) = (line for line in told if line.startswith("listen: "))
        program, *words = shlex.split(listen.removeprefix("listen: "))
        assert (program, team in words) == ("swarmtrack", True)
        listener = echo(*words, "--count", "1")
        deaf = echo("tracks/*", "--team", f"{team}-not", "--seconds", "4")
        until(
            lambda: any("tracks" in m.topic for m in messages_below(recording / "swarm")),
            "the swarm is heard",
        )
    finally:
        flight.send_signal(signal.SIGINT)
        finish(flight)
    return Heard(team, told, listener, deaf, recording)


def test_a_flight_says_how_to_listen_to_it_and_who_listens_elsewhere_is_told_of_it(heard):
    (look,) = (line for line in heard.told if line.startswith("look: "))
    assert look.split() == ["look:", "swarmtrack", "monitor", "--team", heard.team]
    assert heard.listener.returncode == 0, heard.listener.stderr
    assert json.loads(heard.listener.stdout)["key"].startswith(f"swarmtrack/{heard.team}/v1/identities/")
    complained = heard.deaf.stderr
    assert f"nothing of team '{heard.team}-not' yet; found drones of " in complained
    assert "Found drones of " in complained.splitlines()[-1]
    assert heard.team in complained.replace(f"{heard.team}-not", "")


def echo(*words):
    command = [
        sys.executable,
        "-m",
        "swarmtrack.agents.main",
        *(words if words[0] == "echo" else ("echo", *words)),
    ]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, cwd=ROOT, check=False)


def test_ctrl_c_closes_every_file_of_the_recording(heard):
    assert not list(heard.recording.rglob("*.active"))
    recordings = recordings_below(heard.recording)
    assert {recording.kind for recording in recordings} == {"drone", "swarm"}
    assert all(list(recording.messages()) for recording in recordings)
    assert [recording.damage for recording in recordings] == [[]] * len(recordings)


def messages_below(folder):
    try:
        return [message for recording in recordings_below(folder) for message in recording.messages()]
    except RecordingError:  # nothing there yet
        return []


# --- what goes wrong ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("--scenario", "hover-triangel"), 'did you mean "hover-triangle"'),
        (("--scenario", "no/such/file.toml"), "no/such/file.toml"),
        (("--drones", "1"), "expected a whole number, 2 or more"),
        (("--seconds", "-3"), "expected a number of seconds above 0"),
        (("--json", "no/such/folder/out.json"), "expected a file in a folder that exists"),
        (("--detector", "eyes"), "onnx"),
        (("crosing",), 'did you mean "crossing"'),
        (("crossing", "--scenario", "pair"), "expected one scenario"),
        (("--tracker", "jpdf"), "did you mean jpdaf?"),
        (("--team", "a b"), "expected 1 to 64 letters"),
    ],
)
def test_wrong_usage_says_what_was_expected_and_starts_nothing(
    tmp_path, arguments, named, capsys, monkeypatch
):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    code, said, complained = called(swarmtrack.main, ["sim", *arguments], capsys)
    assert code == 2
    assert named in complained
    assert said == ""
    assert not list(tmp_path.iterdir())


def test_a_scripted_radio_that_cannot_be_made_here_is_said_before_anything_starts(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr("swarmtrack.lab.swarm.radio.PROGRAMS", ("no-such-program",))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert swarmtrack.main(["sim", "--scenario", "lossy-radio", "--detector", "oracle"]) == 1
    said = capsys.readouterr()
    assert "no no-such-program here" in said.err
    assert said.out.splitlines()[-1] == "FAILED"
    assert not list(tmp_path.iterdir())


def test_an_agent_that_dies_is_reported_with_its_last_words_also_while_another_is_still_to_start(tmp_path):
    scenario = tmp_path / "waiting.toml"
    text = PAIR.replace("drones = 2", "drones = 3").replace(
        "[agents]", "[agents]\nlate = 1\nlate_by_s = 50.0"
    )
    scenario.write_text(text, encoding="utf-8")
    process = start(tmp_path, "--scenario", str(scenario), "--detector", "oracle", "--seconds", "60")
    agent = until(lambda: pid_of(tmp_path, "drone-2.toml"), "drone 2 is started")
    os.kill(agent, signal.SIGABRT)
    code, said, complained = finish(process)
    assert code == 1
    assert "drone 2 ended by itself, signal SIGABRT. Its last lines:" in complained
    assert "Traceback" not in complained
    assert said.splitlines()[-1] == "FAILED"
    assert list(tmp_path.iterdir()) == [scenario]
    assert not living(tmp_path)


def test_ctrl_c_lands_a_flight_and_its_figures_are_written(tmp_path):
    out, record = tmp_path / "out.json", tmp_path / "flight"
    words = ("--drones", "2", "--detector", "oracle", "--seconds", "600")
    process = start(tmp_path, *words, "--json", str(out), "--record", str(record))
    while not re.match(" +[23] s ", line := process.stdout.readline()):
        assert line, "it ended before it flew"
    process.send_signal(signal.SIGINT)
    code, said, complained = finish(process)
    assert (code, complained) == (3, "")
    assert re.search(r"^NOT JUDGED: cut off after \d+ of 600 s\.", said.splitlines()[-1])
    figures = json.loads(out.read_text())
    assert 2.0 <= figures["cut_off_s"] < 60.0
    assert figures["verdict"] == "not judged"
    again = subprocess.run(
        [sys.executable, "-m", "swarmtrack.agents.main", "replay", str(record)],
        capture_output=True, text=True, cwd=ROOT, timeout=PATIENCE, check=False,
    )  # fmt: skip
    assert again.returncode == 3, again.stderr
    assert "NOT JUDGED: cut off after" in again.stdout


@pytest.mark.parametrize(
    "number",
    [
        signal.SIGINT,
        signal.SIGKILL,
        pytest.param(
            signal.SIGTERM, marks=pytest.mark.long("a third flight; SIGTERM ends it as Ctrl-C does")
        ),
    ],
)
def test_whatever_ends_the_launcher_nothing_is_left(tmp_path, number):
    process = start(tmp_path, "--drones", "2", "--detector", "oracle", "--seconds", "60")
    until(lambda: pid_of(tmp_path, "drone-2.toml"), "drone 2 is started")
    process.send_signal(number)
    code, said, complained = finish(process)
    assert (
        code == -number if number == signal.SIGKILL else code in (1, 3)
    )  # 3: it flew already, and is judged
    assert ("interrupted" in said + complained) == (number != signal.SIGKILL)
    until(lambda: not living(tmp_path), "all processes have ended")
    until(lambda: not list(tmp_path.iterdir()), "the folder is removed")
