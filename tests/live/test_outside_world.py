"""`swarmtrack sim --world`: drones that others fly. The others are simulated autopilots, in a process of their own."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from support.launcher import finish, living, pid_of, start
from support.pair_scenario import PAIR, is_fair, is_judged
from support.patience import PATIENCE, until
from support.places import DOCS, ROOT

pytest.importorskip("zenoh", reason="Zenoh has no wheel here")

from swarmtrack.agents import main as swarmtrack
from swarmtrack.clock import SystemClock
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.score.swarm_verdict import BUSY
from swarmtrack.lab.swarm.outside import NoTruth, Outside
from swarmtrack.lab.swarm.world_file import load_world
from swarmtrack.recording.reader import recordings_below
from swarmtrack.runtime.swarm_recorder import FLIGHT_TOPIC, TRUTH_TOPIC, read_flight, read_truth

# PX4 stamps its truth by 0.
MIXED_PAIR = PAIR.replace("drones = 2", 'drones = 2\nautopilots = ["ardupilot", "px4"]')
LENGTHS = (6, 24)  # s: the second where the machine is so busy that the first flight was over too soon


class Others(NamedTuple):
    """The process that flies, and the world file that says where it tells the truth."""

    process: subprocess.Popen[str]
    world: Path
    drones: dict[str, dict[str, str]]


@contextmanager
def others(folder: Path, scenario: str = PAIR, seconds: float = 6.0, seed: int = 1) -> Iterator[Others]:
    """Simulated autopilots that fly a scenario, and a world file with what that expects, and the same starts."""
    flown = folder / "flown.toml"
    flown.write_text(scenario, encoding="utf-8")
    process = subprocess.Popen(
        [
            *(sys.executable, "-m", "swarmtrack.agents.simulator", "--scenario", str(flown)),
            *("--detector", "oracle", "--seed", str(seed), "--lead", "20"),
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )
    try:
        told = json.loads(process.stdout.readline())
        text = world_file(told["origin"], told["drones"], flown, seconds=seconds, seed=seed)
        world = folder / "world.toml"
        world.write_text(text, encoding="utf-8")
        yield Others(process, world, told["drones"])
    finally:
        process.kill()
        process.communicate()


def world_file(
    origin: dict[str, float], drones: dict[str, dict[str, str]], flown: Path, **values: float
) -> str:
    scenario = load_scenario(flown)
    place = ", ".join(f"{name} = {value!r}" for name, value in origin.items())
    lines = ["[world]", f"origin = {{ {place} }}", *(f"{name} = {value}" for name, value in values.items())]
    lines += ["[agents]", f"imu_rate_hz = {scenario.imu_rate_hz}", f"tracks_hz = {scenario.tracks_hz}"]
    for n, where in drones.items():
        announced = scenario.announced[int(n)]
        offset = [round(float(x), 4) for x in announced.position_m]
        lines += [
            *("[[drone]]", f"id = {n}", f'link = "{where["autopilot"]}"', f'truth = "{where["truth"]}"'),
            f'start = {{ from = "local", offset_m = {offset}, position_sigma_m = {announced.position_sigma_m} }}',
        ]
    return "\n".join([*lines, "[expected]", flown.read_text().partition("[expected]")[2]])


def fly(folder: Path, world: Path, *options: str) -> tuple[int, str, str]:
    return finish(start(folder, "--world", str(world), "--detector", "oracle", *options))


# --- a flight -------------------------------------------------------------------------------------


class Flown(NamedTuple):
    said: str
    complained: str
    code: int
    verdict: dict[str, Any]
    recording: Path


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> Flown:
    """A recorded flight of an ArduPilot and a PX4, in whose midst their simulator stands still for two seconds."""
    for seconds in LENGTHS:
        folder = tmp_path_factory.mktemp("outside")
        with others(folder, MIXED_PAIR, seconds=seconds) as flying:
            record = ("--record", str(folder / "recording"), "--json", str(folder / "out.json"))
            process = start(
                folder, "--world", str(flying.world), "--detector", "oracle", "--seed", "1", *record
            )
            lines: list[str] = []
            while not lines or not ("names " in lines[-1] or "nothing to judge yet" in lines[-1]):
                lines.append(process.stdout.readline())
                assert lines[-1], process.communicate()[1]
            flying.process.send_signal(signal.SIGSTOP)
            # Both drones miss it, but not in the same millisecond.
            while sum("sent nothing for" in line for line in lines) < 2:
                lines.append(process.stdout.readline())
                assert lines[-1], process.communicate()[1]
            flying.process.send_signal(signal.SIGCONT)
            # `communicate` would lose what was read ahead with the last line.
            lines.append(process.stdout.read())
            code, _, complained = finish(process)
        said = "".join(lines)
        if is_judged(said):
            break
    verdict = json.loads((folder / "out.json").read_text())
    return Flown(said, complained, code, verdict, folder / "recording")


def test_drones_that_others_fly_are_seen_named_and_judged(flown):
    assert flown.complained == ""
    assert is_fair(flown.code, flown.said), flown.said
    assert (flown.verdict["scenario"], flown.verdict["drones"]) == ("world", 2)
    assert flown.verdict["identity"]["wrong"] == 0.0
    assert flown.verdict["tracking"]["rmse_px"]
    assert max(flown.verdict["tracking"]["rmse_px"].values()) < 15.0


def test_a_simulator_that_stands_still_is_said_once_for_each_drone_and_heals(flown):
    for n in (1, 2):
        stale = [
            line for line in flown.said.splitlines() if line.startswith(f"drone {n}: truth link udpout:")
        ]
        assert len(stale) == 1, flown.said
        assert "is its simulator paused, slow or gone? No frame is exposed meanwhile" in stale[0]
        back = [line for line in flown.said.splitlines() if f"drone {n}: its truth is back after" in line]
        assert len(back) == 1, flown.said


def test_the_truth_is_recorded_as_it_was_told(flown):
    (swarm,) = [recording for recording in recordings_below(flown.recording) if recording.kind == "swarm"]
    truths = [read_truth(message) for message in swarm.messages(frozenset({TRUTH_TOPIC}))]
    count = Counter(true.drone_id for true in truths)
    assert set(count) == {1, 2}
    assert min(count.values()) > 20.0 * flown.verdict["seconds"]
    for true in truths:
        # Two drones on a ring of 2 m: south and north of the origin.
        assert true.position_m[0] == pytest.approx(-2.0 if true.drone_id == 1 else 2.0, abs=0.5)


def test_the_recording_is_judged_as_the_flight_was(flown, capsys):
    assert swarmtrack.main(["replay", str(flown.recording)]) == flown.code
    said = capsys.readouterr()
    assert "the verdict is the recorded one" in said.out, said.out + said.err


@pytest.mark.long("two flights of 15 s each; the default run flies a mixed pair behind --world")
@pytest.mark.parametrize(
    "autopilots", [("px4", "px4"), ("ardupilot", "px4"), ("px4", "px4", "px4"), ("ardupilot", "px4", "px4")]
)
def test_the_verdict_is_that_of_the_same_flight_in_our_own_simulation(tmp_path, autopilots):
    drones = f"drones = {len(autopilots)}\nautopilots = {json.dumps(autopilots)}"
    scenario = PAIR.replace("drones = 2", drones)
    with others(tmp_path, scenario, seconds=15.0) as flying:
        code, said, _ = fly(tmp_path, flying.world, "--seed", "1", "--json", str(tmp_path / "world.json"))
    options = ("--scenario", str(tmp_path / "flown.toml"), "--detector", "oracle", "--seconds", "15")
    process = start(tmp_path, *options, "--seed", "1", "--json", str(tmp_path / "sim.json"))
    own_code, own_said, _ = finish(process)
    assert is_fair(code, said), said
    assert is_fair(own_code, own_said), own_said
    verdicts = [json.loads((tmp_path / name).read_text()) for name in ("world.json", "sim.json")]
    assert [verdict["identity"]["wrong"] for verdict in verdicts] == [0.0, 0.0]
    if all(verdict["machine_busy"] <= BUSY for verdict in verdicts):
        assert code == own_code


# --- an agent dies --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def killed(tmp_path_factory) -> Flown:
    """A recorded flight, one agent of which somebody kills, then ended by Ctrl-C."""
    folder = tmp_path_factory.mktemp("killed")
    with others(folder, seconds=600.0) as flying:
        recording = folder / "recording"
        options = ("--world", str(flying.world), "--detector", "oracle", "--record", str(recording))
        process = start(folder, *options)
        lines: list[str] = []

        def read_until(*words: str, without: str = "Traceback") -> None:
            line = ""
            while not any(word in line for word in words) or without in line:
                line = process.stdout.readline()
                assert line, ("".join(lines), process.communicate()[1])
                lines.append(line)

        read_until("names ", "nothing to judge yet", without="not received yet")
        first = until(lambda: pid_of(folder, "drone-2.toml"), "drone 2 is started")
        os.kill(first, signal.SIGKILL)
        read_until("its agent was killed")
        until(
            lambda: (pid_of(folder, "drone-2.toml") or first) != first,
            "the agent of drone 2 is started again",
        )
        process.send_signal(signal.SIGINT)
        lines.append(process.stdout.read())
        code, _, complained = finish(process)
    return Flown("".join(lines), complained, code, {}, recording)


def test_an_agent_that_somebody_kills_is_said_and_started_again(killed):
    assert killed.said.count("drone 2: its agent was killed (SIGKILL), and is started again in 1 s") == 1
    assert "NOT JUDGED: cut off after" in killed.said
    assert "ended by itself" not in killed.complained
    (swarm,) = [recording for recording in recordings_below(killed.recording) if recording.kind == "swarm"]
    events = [read_flight(message) for message in swarm.messages(frozenset({FLIGHT_TOPIC}))]
    of_drone_2 = [event for event in events if event.drone_id == 2]
    assert [event.event for event in of_drone_2] == ["started", "ended", "started"]
    assert of_drone_2[2].t_s - of_drone_2[1].t_s > 1.0


def test_the_truth_of_a_flight_that_was_cut_short_is_recorded(killed):
    (swarm,) = [recording for recording in recordings_below(killed.recording) if recording.kind == "swarm"]
    truths = [read_truth(message) for message in swarm.messages(frozenset({TRUTH_TOPIC}))]
    assert {true.drone_id for true in truths} == {1, 2}
    # 50 times a second, from before the first frame on.
    assert len(truths) > 50


# --- what goes wrong ------------------------------------------------------------------------------


def test_an_origin_that_is_elsewhere_ends_it_at_once_and_says_where_the_drones_are(tmp_path):
    with others(tmp_path) as flying:
        text = flying.world.read_text().replace("lat_deg = 47.39", "lat_deg = 47.49")
        flying.world.write_text(text)
        code, said, complained = fly(tmp_path, flying.world)
    assert code == 1
    assert said.splitlines()[-1] == "FAILED"
    for n in (1, 2):
        assert f"drone {n}: truth link udpout:" in complained
    assert "11.1 km from world.origin" in complained
    assert "lat_deg = 47.397" in complained
    assert "Traceback" not in complained
    assert not living(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"flown.toml", "world.toml"}


@pytest.fixture
def nobody_flies(tmp_path: Path) -> Iterator[tuple[Path, list[int]]]:
    """A world file whose two truth links nobody is at, and their ports."""
    with socket.socket() as one, socket.socket() as other:
        ports = []
        for kept in (one, other):
            # Bound and not listening: nobody answers, and nobody else takes the port meanwhile.
            kept.bind(("127.0.0.1", 0))
            ports.append(kept.getsockname()[1])
        drones = {
            str(n): {"autopilot": f"udpin:127.0.0.1:{port}", "truth": f"tcp:127.0.0.1:{port}"}
            for n, port in enumerate(ports, 1)
        }
        flown = tmp_path / "flown.toml"
        flown.write_text(PAIR, encoding="utf-8")
        world = tmp_path / "world.toml"
        world.write_text(world_file({"lat_deg": 47.0, "lon_deg": 8.0, "alt_m": 400.0}, drones, flown))
        yield world, ports


def assert_each_is_named(ports: list[int], said: str) -> None:
    for n, port in enumerate(ports, 1):
        assert (
            f"drone {n}: truth link tcp:127.0.0.1:{port} is silent: nothing listens at 127.0.0.1:{port}"
            in said
        )


async def test_links_that_nobody_is_at_are_each_named_once_patience_ends(nobody_flies):
    world, ports = nobody_flies
    outside = Outside(load_world(world), SystemClock())
    links = [asyncio.create_task(link.run()) for link in outside.links.values()]
    try:
        with pytest.raises(NoTruth) as refusal:
            await outside.ready(patience_s=0.0)
    finally:
        for link in links:
            link.cancel()
        await asyncio.gather(*links, return_exceptions=True)
    assert_each_is_named(ports, str(refusal.value))


@pytest.mark.long("20 s of patience; the default run waits within its own process")
def test_links_that_nobody_is_at_end_the_command(tmp_path, nobody_flies):
    world, ports = nobody_flies
    code, said, complained = fly(tmp_path, world)
    assert code == 1
    assert said.splitlines()[-1] == "FAILED"
    assert_each_is_named(ports, complained)
    assert not living(tmp_path)


def test_while_it_waits_for_the_truth_it_can_be_interrupted(tmp_path):
    flown = tmp_path / "flown.toml"
    flown.write_text(PAIR, encoding="utf-8")
    drones = {"1": {"autopilot": "udpin:127.0.0.1:5", "truth": "tcp:127.0.0.1:5"}}
    world = tmp_path / "world.toml"
    world.write_text(world_file({"lat_deg": 47.0, "lon_deg": 8.0, "alt_m": 400.0}, drones, flown))
    process = start(tmp_path, "--world", str(world))
    until(lambda: any("agents.simulator" in line for line in living(tmp_path)), "the simulator is started")
    process.send_signal(signal.SIGINT)
    code, _, complained = finish(process)
    assert code == 1
    assert "interrupted" in complained
    until(lambda: not living(tmp_path), "all processes have ended")


def test_a_world_file_that_is_wrong_is_wrong_usage(tmp_path):
    world = tmp_path / "world.toml"
    world.write_text("[world]\n")
    code, said, complained = fly(tmp_path, world)
    assert code == 2
    assert said == ""
    assert f"{world}:1: world.origin: missing, expected {{ lat_deg, lon_deg, alt_m }}" in complained


# --- in formation -----------------------------------------------------------------------------------

BEHIND = """
about = "two on the ground, one behind the other"
seconds = 200.0
[camera]
fps = 7.0
[[drone]]
id = 1
position_m = [0.0, 0.0, -0.09]
guided = true
autopilot = "{}"
[[drone]]
id = 2
position_m = [-6.0, 0.0, -0.09]
guided = true
autopilot = "{}"
"""
FORMATION = """
[formation]
leader = 1
height_m = 6.0
judged_from_s = 38.0
slots = { 2 = [-6.0, 0.0, -1.0] }
"""


@pytest.mark.long("62 s in formation each; the default run flies the script of one drone")
@pytest.mark.parametrize("autopilots", [("ardupilot", "ardupilot"), ("px4", "px4"), ("ardupilot", "px4")])
def test_the_pilots_of_the_docs_fly_a_formation(tmp_path, autopilots):
    """docs/examples/formation_pilots.py at the ground stations' ports; two agents of ours, one of which flies."""
    with others(tmp_path, BEHIND.format(*autopilots) + "[expected]\n", seconds=62.0) as flying:
        text = flying.world.read_text().replace("[agents]", f"{FORMATION}\n[agents]")
        text = text.replace("[world]", '[world]\ncounts_from = "take-off"')
        flying.world.write_text(text)
        links = [flying.drones[n]["ground"] for n in ("1", "2")]
        script = str(DOCS / "examples" / "formation_pilots.py")
        pilots = subprocess.Popen(
            [sys.executable, script, str(flying.world), *links, "--hover", "18"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        process = start(
            tmp_path,
            "--world",
            str(flying.world),
            "--detector",
            "oracle",
            "--json",
            str(tmp_path / "out.json"),
        )
        try:
            line = ""
            while "names " not in line and "nothing to judge yet" not in line:
                line = process.stdout.readline()
                assert line, process.communicate()[1]
            told, complained = pilots.communicate("\n", timeout=PATIENCE)
            said = process.stdout.read()
            finish(process)
        finally:
            pilots.kill()
    assert pilots.returncode == 0, complained
    assert told.splitlines()[-1] == "all land"
    assert "take-off; the flight ends at" in said
    verdict = json.loads((tmp_path / "out.json").read_text())
    formation = verdict["formation"]
    assert formation["followers"] == 1
    assert formation["min_separation_m"] > 1.5
    if verdict["machine_busy"] <= BUSY:
        # The leader has flown 25 m off: who stays is lost.
        assert formation["lost"] == 0, said


# --- as the docs say ------------------------------------------------------------------------------


def test_the_script_of_the_docs_flies_both_simulated_autopilots(tmp_path):
    """docs/rehearse.md: arm, take off, go, land, by pymavlink on the ground station's port; not its waits."""
    page = (DOCS / "rehearse.md").read_text(encoding="utf-8")
    (script,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    scenario = (ROOT / "configs" / "scenarios" / "guided.toml").read_text(encoding="utf-8")
    orders = {"1": ["176", "400", "22", "176"], "2": ["176", "400", "176"]}  # of ArduPilot and of PX4
    with others(tmp_path, scenario) as flying:
        path = tmp_path / "fly.py"
        path.write_text(script.replace("SECONDS = 8", "SECONDS = 3"), encoding="utf-8")
        pilots = {
            drone: subprocess.Popen(
                [sys.executable, str(path), flying.drones[drone]["ground"], drone],
                stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            )
            for drone in orders
        }  # fmt: skip
        try:
            ends = {drone: finish(pilot) for drone, pilot in pilots.items()}
        finally:
            for pilot in pilots.values():
                pilot.kill()
    for drone, (code, said, complained) in ends.items():
        assert code == 0, complained
        assert said.splitlines() == [f"{order} accepted" for order in orders[drone]]
