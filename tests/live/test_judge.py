"""`swarmtrack judge`: a verdict on agents that others started, against a simulator that others started."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import secrets
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from aiohttp import web
from aiohttp.test_utils import TestServer

from support.pair_scenario import is_fair, pair
from support.patience import PATIENCE
from support.places import ROOT
from swarmtrack.agents import main as swarmtrack
from swarmtrack.agents import simulator
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.swarm.configs import Sources, write_configs

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}


def free_ports(count: int) -> int:
    """The first of so many that follow each other, free for TCP and UDP a moment ago.

    And so were those 1000 higher, where the autopilots' second ports are.
    """
    while True:
        first = 20000 + secrets.randbelow(10000)
        try:
            for port in (*range(first, first + count), *range(first + 1000, first + 1000 + count)):
                for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM):
                    with socket.socket(socket.AF_INET, kind) as probe:
                        probe.bind(("127.0.0.1", port))
        except OSError:
            continue
        return first


@contextlib.contextmanager
def running(*words: object):
    process = subprocess.Popen(
        [sys.executable, "-m", *map(str, words)],
        cwd=ROOT,
        env=ENVIRONMENT,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


@contextlib.contextmanager
def simulated(port: int, scenario: str):
    options = ("--scenario", scenario, "--detector", "oracle", "--port", port)
    with running("swarmtrack.agents.simulator", *options) as process:
        told = json.loads(process.stdout.readline())
        yield {int(drone_id): where for drone_id, where in told["drones"].items()}


def configs_of(folder: Path, scenario: str, port: int, team: str) -> dict[int, Path]:
    """Of agents whose addresses were known before the simulator was started."""
    loaded = load_scenario(scenario)
    sources = {
        n: Sources(f"detections://127.0.0.1:{port}/{n}", f"udpout:127.0.0.1:{port + n}")
        for n in loaded.members
    }
    return write_configs(folder, loaded, team=team, tracker="kalman", sources=sources, simulator="…")


def flying(config: Path) -> contextlib.AbstractContextManager[subprocess.Popen[str]]:
    return running("swarmtrack.agents.vehicle", "--quiet", "--seconds", 120, "--config", config)


def new_team() -> str:
    return f"judged-{secrets.token_hex(4)}"


@pytest.fixture
def team() -> str:
    return new_team()


class Judgement(NamedTuple):
    """How the command ended, and what it said."""

    code: int
    out: str
    err: str


def judge(port: int, team: str, *options: object) -> Judgement:
    words = (f"http://127.0.0.1:{port}", "--team", team, "--seconds", 3, *options)
    with running("swarmtrack.agents.main", "judge", *words) as process:
        out, err = process.communicate(timeout=PATIENCE)
        return Judgement(process.returncode, out, err)


class Judged(NamedTuple):
    """Three judgements on one flight: while drone 2 is missing, of both drones, and by a limit that nobody keeps."""

    alone: Judgement
    both: Judgement
    verdict: dict[str, Any]
    limited: Judgement


@pytest.fixture(scope="module")
def judged(tmp_path_factory: pytest.TempPathFactory) -> Judged:
    folder, port, team = tmp_path_factory.mktemp("judged"), free_ports(3), new_team()
    _, scenario = pair(folder)
    configs = configs_of(folder, scenario, port, team)
    verdict = folder / "verdict.json"
    with simulated(port, scenario), flying(configs[1]):
        alone = judge(port, team, "--patience", 3)
        with flying(configs[2]):
            both = judge(port, team, "--json", verdict)
            pair(folder, announcement_bytes=10)
            limited = judge(port, team, "--seconds", 0.5)
    return Judged(alone, both, json.loads(verdict.read_text(encoding="utf-8")), limited)


def test_a_simulator_with_a_port_listens_where_the_configs_expect_it_and_says_what_it_flies(tmp_path):
    port = free_ports(3)
    _, scenario = pair(tmp_path)
    with simulated(port, scenario) as drones:
        assert drones[2] == {
            "camera": f"detections://127.0.0.1:{port}/2",
            "cameras": [f"detections://127.0.0.1:{port}/2"],
            "autopilot": f"udpout:127.0.0.1:{port + 2}",
            "ground": f"udpout:127.0.0.1:{port + 1002}",
            "truth": f"udpout:127.0.0.1:{port + 2002}",
        }
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=PATIENCE) as response:
            told = json.load(response)
    assert told.pop("world_time_s") < 60.0
    assert told == {"scenario": scenario, "seed": 1, "drones": None, "detector": "oracle", "detail": "full"}


def test_a_port_that_is_taken_is_said(tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with running("swarmtrack.agents.simulator", *pair(tmp_path), "--port", port) as process:
            _, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1
    assert f"--port {port}" in err


@pytest.mark.parametrize("port", ["-1", "65535", "eighty"])
def test_a_port_that_is_none_is_refused(port, capsys):
    with pytest.raises(SystemExit) as end:
        simulator.parser().parse_args(["--port", port])
    assert end.value.code == 2
    assert f"found {port}, expected a port number" in capsys.readouterr().err


def test_agents_that_name_each_other_right_pass_though_they_came_before_the_judge(judged):
    code, out, err = judged.both
    assert is_fair(code, out), out + err
    assert judged.verdict["passed"] is (code == 0)
    assert judged.verdict["identity"]["wrong"] in (
        0.0,
        None,
    )  # None: nothing was judged, the machine let nobody speak
    assert judged.verdict["seconds"] == 3.0
    assert [agent["id"] for agent in judged.verdict["agents"]] == [1, 2]


def test_what_falls_short_of_the_scenarios_limits_fails(judged):
    assert judged.limited.code == 1
    assert "FAILED: announcement bytes of 2 drones" in judged.limited.out


def test_who_is_missing_is_said(judged):
    assert judged.alone.code == 1
    # Within so few seconds a busy machine may not let drone 1 speak either.
    assert re.search("drone (1, )?2 has not announced itself", judged.alone.err)
    assert "FAILED" in judged.alone.out


def test_drones_that_a_ground_station_flies_are_not_judged_from_outside(team):
    port = free_ports(3)
    with simulated(port, "guided"):
        code, _, err = judge(port, team)
    assert code == 1
    assert "its drones 1, 2 are flown by a ground station" in err


def test_without_a_simulator_there_is_no_verdict(team):
    code, _, err = judge(free_ports(1), team, "--patience", 1)
    assert code == 1
    assert "is a simulator there" in err


@pytest.mark.parametrize(
    ("told", "expected"),
    [
        ({"hello": "world"}, "is not a swarmtrack simulator"),
        ({"world": "sitl.toml", "seed": 1, "world_time_s": 3.0}, "draws drones of another simulator"),
    ],
)
async def test_a_server_that_flies_no_scenario_is_said(team, told, expected):
    async def hello(_: web.Request) -> web.Response:
        return web.json_response(told)

    application = web.Application()
    application.router.add_get("/", hello)
    async with TestServer(application) as server:
        code, _, err = await asyncio.to_thread(judge, server.port, team)
    assert code == 1
    assert expected in err


@pytest.mark.parametrize("url", ["simulator", "tcp/127.0.0.1:8100", ""])
def test_what_is_no_url_is_wrong_usage(url, capsys):
    assert swarmtrack.main(["judge", url]) == 2
    assert "expected http://HOST:PORT" in capsys.readouterr().err
