"""`swarmtrack healthy`, and systemd's watchdog: whether whoever looks after an agent learns how it is."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from support.patience import PATIENCE, until
from support.places import ROOT
from swarmtrack.agents import main as swarmtrack
from swarmtrack.agents.healthy import HEALTHY, UNHEALTHY
from swarmtrack.runtime.health_file import ENVIRONMENT, HealthFile


@pytest.fixture
def start(tmp_path):
    """Starts an agent in the simulation, or a program with its config; all are ended."""
    processes = []

    def start(*program, env=None, config=f'extends = "{ROOT}/configs/sim.toml"\n'):
        file = tmp_path / "drone.toml"
        file.write_text(config, encoding="utf-8")
        argv = [sys.executable, *(program or ("-m", "swarmtrack.agents.vehicle", "--quiet", "--config"))]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), **(env or {})}
        process = subprocess.Popen([*argv, str(file)], cwd=ROOT, env=environment, stderr=subprocess.DEVNULL)
        processes.append(process)
        return process

    yield start
    for process in processes:
        process.send_signal(signal.SIGCONT)
        process.kill()
        process.wait()


def healthy(capsys, *arguments):
    code = swarmtrack.main(["healthy", *map(str, arguments)])
    said = capsys.readouterr()
    return code, said.out + said.err


# --- the file -------------------------------------------------------------------------------------


def link(name, *, ok=True):
    return {"name": name, "ok": ok, "text": f"how {name} is", "counters": {}}


@pytest.fixture
def written(tmp_path):
    """Writes a health file as of so many seconds ago."""

    def write(*links, age=0.0, frame_age=0.1, uptime=100.0):
        path = tmp_path / "health.json"
        health = {"links": [link("camera"), link("detector"), *links], "uptime_s": uptime}
        HealthFile(path).write(health, drone_id=7, now=time.monotonic() - age, frame_age_s=frame_age)
        return path

    return write


def test_an_agent_that_works_is_healthy(written, capsys):
    assert healthy(capsys, written(link("autopilot"))) == (
        HEALTHY,
        "healthy: drone 7: camera: how camera is; detector: how detector is; autopilot: how autopilot is\n",
    )


def test_an_agent_alone_is_healthy(written, capsys):
    assert healthy(capsys, written(link("zenoh", ok=False)))[0] == HEALTHY


def test_an_agent_without_its_autopilot_is_not(written, capsys):
    code, said = healthy(capsys, written(link("autopilot", ok=False)))
    assert code == UNHEALTHY
    assert "autopilot: how autopilot is" in said


def test_an_agent_that_went_silent_is_not(written, capsys):
    assert healthy(capsys, written(age=4.0))[0] == HEALTHY
    code, said = healthy(capsys, written(age=6.0))
    assert code == UNHEALTHY
    assert "last written 6 s ago, expected within 5 s" in said
    assert healthy(capsys, written(age=6.0), "--max-age", "10")[0] == HEALTHY


def test_what_was_written_before_the_machine_was_started_is_old(written, capsys):
    """A file that outlives the boot has a time that has not come yet."""
    code, said = healthy(capsys, written(age=-1000.0))
    assert code == UNHEALTHY
    assert "before this machine was started" in said


def test_an_agent_that_tracks_no_frame_is_blind(written, capsys):
    code, said = healthy(capsys, written(frame_age=12.0))
    assert code == UNHEALTHY
    assert "no frame was tracked for 12 s" in said
    assert healthy(capsys, written(frame_age=None, uptime=3.0))[0] == HEALTHY  # it has just started
    assert healthy(capsys, written(frame_age=None, uptime=30.0))[0] == UNHEALTHY


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "null", "7", '{"written_monotonic_s": "now"}', '{"written_monotonic_s": NaN}']
)
def test_what_is_no_health_file_is_said(text, tmp_path, capsys):
    path = tmp_path / "health.json"
    path.write_text(text, encoding="utf-8")
    code, said = healthy(capsys, path)
    assert code == UNHEALTHY
    assert str(path) in said


def test_a_file_that_is_not_there_is_said(tmp_path, capsys):
    code, said = healthy(capsys, tmp_path / "none.json")
    assert code == UNHEALTHY
    assert "No such file" in said


def test_without_a_file_to_look_at_the_usage_is_wrong(monkeypatch, capsys):
    monkeypatch.delenv(ENVIRONMENT, raising=False)
    code, said = healthy(capsys)
    assert code == 2
    assert ENVIRONMENT in said


def test_a_reader_never_sees_half_a_file(tmp_path):
    path = tmp_path / "deep" / "health.json"
    file = HealthFile(path)
    file.write({"links": []}, drone_id=1, now=1.0, frame_age_s=None)
    with path.open(encoding="utf-8") as reader:
        file.write({"links": []}, drone_id=2, now=2.0, frame_age_s=None)
        assert json.load(reader)["drone_id"] == 1  # whoever has opened the old one reads it to its end
    assert json.loads(path.read_text(encoding="utf-8"))["drone_id"] == 2
    file.close()
    assert list(path.parent.iterdir()) == []


def test_a_file_that_cannot_be_written_is_counted_and_said_once(tmp_path, caplog):
    (tmp_path / "file").touch()
    file = HealthFile(tmp_path / "file" / "health.json")
    for _ in range(3):
        file.write({}, drone_id=1, now=1.0, frame_age_s=None)
    assert file.failed == 3
    assert len(caplog.records) == 1


# --- the agent ------------------------------------------------------------------------------------


def test_an_agent_is_healthy_while_it_flies_not_while_it_hangs_and_not_when_it_has_ended(
    start, tmp_path, capsys
):
    path = tmp_path / "health.json"
    agent = start(env={ENVIRONMENT: str(path)})
    until(lambda: healthy(capsys, path)[0] == HEALTHY)
    agent.send_signal(signal.SIGSTOP)
    time.sleep(1.5)
    assert "last written" in healthy(capsys, path, "--max-age", "1")[1]
    agent.send_signal(signal.SIGCONT)
    until(lambda: healthy(capsys, path, "--max-age", "2")[0] == HEALTHY)
    agent.send_signal(signal.SIGTERM)
    assert agent.wait(PATIENCE) == 0
    assert not path.exists()


def test_the_config_names_the_file_before_the_environment_does(start, tmp_path, capsys):
    named = tmp_path / "named.json"
    start(
        env={ENVIRONMENT: str(tmp_path / "other.json")},
        config=f'extends = "{ROOT}/configs/sim.toml"\noutput.health = "{named}"\n',
    )
    until(named.exists)
    assert not (tmp_path / "other.json").exists()
