"""The client on a real network, against a drone that says real messages; its page and its examples, run as they are."""

from __future__ import annotations

import asyncio
import csv
import json
import math
import re
import secrets
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from support.patience import PATIENCE, eventually
from support.places import ROOT

pytest.importorskip("zenoh", reason="Zenoh has no wheel here")

from support.network_of_keys import Team, free_addresses
from support.seen_swarm import LENS, UTC, seen, speaking
from swarmtrack.client import Ranging, Swarm
from swarmtrack.clock import SystemClock
from swarmtrack.config.drone import NetworkSection
from swarmtrack.errors import KeysError, TransportError
from swarmtrack.messages import RangeReport
from swarmtrack.transport import topology, zenoh_config
from swarmtrack.transport.base import Kind
from swarmtrack.transport.settings import NetworkSettings
from swarmtrack.transport.zenoh_speaker import ZenohSpeaker
from swarmtrack.wire import codec
from swarmtrack.wire.ranging import range_message

EXAMPLES = ROOT / "docs" / "examples"
CLOCK = SystemClock()


@pytest.fixture
def team() -> str:
    return f"test-{secrets.token_hex(4)}"


def network(team: str) -> NetworkSettings:
    return NetworkSettings(team=team)


async def first(iterator):
    return await asyncio.wait_for(anext(iterator), PATIENCE)


async def with_directions(swarm, drone_id=1):
    """A sight of when the camera is known."""
    await eventually(lambda: swarm.camera(drone_id))
    return await first(swarm.tracks(drone_id, patience_s=None))


async def test_a_planner_reads_tracks_directions_places_and_health(team):
    async with speaking(network(team)), Swarm(team) as swarm:
        sight = await with_directions(swarm)
        two, stranger = sight.targets
        assert (sight.drone_id, two.identity, stranger.identity) == (1, 2, None)
        np.testing.assert_allclose(two.relative.position, [8.0, 6.0, -1.0])
        np.testing.assert_allclose(stranger.direction_body, [1.0, 0.0, 0.0])
        health = await first(swarm.health(1))
        assert (health.ready, health.reasons) == (False, ("no gyro",))
        assert swarm.drones == (1,)
        assert swarm.camera(1).lens == LENS


async def test_a_camera_that_was_told_long_before_is_asked_for_and_known_in_enu_too(team):
    async with (
        speaking(network(team)),
        Swarm(team, axes="enu") as first_swarm,
        Swarm(team, axes="enu") as second,
    ):
        for swarm in (first_swarm, second):
            sight = await with_directions(swarm)
            np.testing.assert_allclose(sight.of(2).relative.position, [6.0, 8.0, 1.0])


async def test_all_drones_are_read_unless_one_is_asked_for_and_who_leaves_is_gone(team):
    async with speaking(network(team), 1), Swarm(team) as swarm:
        async with speaking(network(team), 7):
            heard = set()
            async for sight in swarm.tracks(patience_s=None):
                heard.add(sight.drone_id)
                if heard == {1, 7}:
                    break
            assert swarm.drones == (1, 7)
            only = swarm.tracks(7)
            assert {(await first(only)).drone_id for _ in range(5)} == {7}
        await eventually(lambda: swarm.drones == (1,))


async def test_a_slow_reader_gets_the_newest_and_the_rest_is_counted(team):
    async with speaking(network(team)) as drone, Swarm(team) as swarm:
        sights = swarm.tracks(1, keep=1)
        before = (await first(sights)).sequence
        await eventually(lambda: swarm.counters["dropped"] > 5)
        assert (await first(sights)).sequence > before + 5
        drone.publish(Kind.TRACKS, codec.encode(seen())[:-1])
        await eventually(lambda: swarm.counters["tracks_malformed"])
        with pytest.raises(ValueError, match="keep: found 0"):
            await first(swarm.tracks(1, keep=0))


async def test_iterators_end_when_the_swarm_is_left(team):
    async with speaking(network(team)):
        async with Swarm(team) as swarm:
            sights = swarm.tracks(1)
            await first(sights)
            rest = asyncio.create_task(_drain(sights))
            await asyncio.sleep(0)
        await asyncio.wait_for(rest, PATIENCE)


async def _drain(sights):
    async for _ in sights:
        pass


# --- what goes wrong --------------------------------------------------------------------


async def test_where_nothing_answers_the_error_says_what_to_check(team):
    port = free_addresses(1)[0]
    async with Swarm(team, connect=[port]) as swarm:
        with pytest.raises(TransportError, match=f"nothing answers at tcp/{port}; does an agent run there"):
            await first(swarm.tracks(patience_s=0.1))


async def test_the_name_of_another_team_is_said(team):
    wrong = f"{team}-typo"
    async with speaking(network(team)), Swarm(wrong) as swarm:
        await eventually(lambda: swarm._listener.links().count)
        with pytest.raises(TransportError, match=f"no drone of team '{wrong}'.*but drones of .*'{team}'"):
            await first(swarm.tracks(patience_s=0.5))


async def test_a_drone_that_is_not_there_is_told_from_a_team_that_is_not(team):
    async with speaking(network(team)), Swarm(team) as swarm:
        await eventually(lambda: swarm.drones)
        with pytest.raises(TransportError, match=f"drone 7 of team '{team}' was not heard .*; alive are 1"):
            await first(swarm.tracks(7, patience_s=0.1))


async def test_a_router_that_does_not_answer_is_an_error_at_once(team, tmp_path, monkeypatch):
    monkeypatch.setattr(zenoh_config, "CLIENT_CONNECT_MS", 200)
    router = free_addresses(1)[0]
    file = tmp_path / "team.toml"
    file.write_text(f'[network]\nteam = "{team}"\ntopology = "routers"\nrouters = ["{router}"]\n')
    with pytest.raises(TransportError, match="no router answers"):
        async with Swarm(config=file):
            pass


def test_what_contradicts_itself_is_refused_with_a_sentence(tmp_path):
    with pytest.raises(TransportError, match="not on loopback"):
        Swarm("red", connect=["10.0.0.1"])
    with pytest.raises(KeysError, match="is not a folder"):
        Swarm("red", keys=tmp_path / "nowhere")
    with pytest.raises(ValueError, match="'nwu' is not a valid Axes"):
        Swarm("red", axes="nwu")


async def test_with_the_keys_of_a_monitor_a_protected_team_is_read(tmp_path):
    team = Team(tmp_path / "keys", "1", "monitor")
    address = free_addresses(1)[0]
    section = NetworkSection(team=team.name, peers={"1": address})
    file = tmp_path / "team.toml"
    file.write_text(
        f'[network]\nteam = "{team.name}"\npeers = {{ 1 = "{address}" }}\nkeys = "{team.folder}/drone-{{id}}"\n'
    )
    async with speaking(topology.of_drone(section, 1, team.credentials("1"))):
        async with Swarm(config=file, keys=team.folder / "monitor") as swarm:
            sight = await with_directions(swarm)
            assert sight.of(2) is not None
        with pytest.raises(TransportError, match="this team has keys"):
            Swarm(config=file)


# --- a ranging radio --------------------------------------------------------------------


class HeardRanges:
    """Distances that an agent's end of the network was told."""

    def __init__(self, transport) -> None:
        self.ranges: list[RangeReport] = []
        self._task = asyncio.create_task(self._hear(transport))

    async def _hear(self, transport) -> None:
        async for event in transport.events():
            if isinstance(event, RangeReport):
                self.ranges.append(event)


async def say_until_heard(ranging, heard, *distance) -> None:
    async with asyncio.timeout(PATIENCE):
        while not heard.ranges:  # again: what is put before the links stand is lost
            await ranging.say(*distance)
            await asyncio.sleep(0.02)


async def test_an_agent_hears_what_the_radio_on_its_own_drone_measures(team):
    async with speaking(network(team)) as one, speaking(network(team), 2) as two, Ranging(1, team) as ranging:
        heard, other = HeardRanges(one), HeardRanges(two)
        before = CLOCK.now()
        await say_until_heard(ranging, heard, 2, 8.5, 0.125)
        said = heard.ranges[0]
        assert (said.drone_id, said.other, said.distance, said.sigma) == (1, 2, 8.5, 0.125)
        assert before - 0.1 < said.t < CLOCK.now()
        assert ranging.linked
        assert other.ranges == []


async def test_what_no_radio_measures_is_refused_where_it_is_said(team):
    lies = [(2, math.nan, 0.1), (2, 0.0, 0.1), (2, 1e9, 0.1), (2, 5.0, 0.0), (1, 5.0, 0.1)]
    async with Ranging(1, team) as ranging:
        for other, distance, sigma in lies:
            with pytest.raises(ValueError, match=r"expected|Expected"):
                await ranging.say(other, distance, sigma)
        with pytest.raises(ValueError, match="age_s: found 2"):
            await ranging.say(2, 5.0, 0.1, age_s=2)


async def test_with_keys_a_drone_s_own_folder_speaks_for_its_radio_and_no_other(tmp_path):
    team = Team(tmp_path / "keys", "1", "2", "monitor")
    addresses = dict(zip(("1", "2"), free_addresses(2), strict=True))
    section = NetworkSection(team=team.name, peers=addresses)
    file = tmp_path / "team.toml"
    table = ", ".join(f'{i} = "{address}"' for i, address in addresses.items())
    file.write_text(
        f'[network]\nteam = "{team.name}"\npeers = {{ {table} }}\nkeys = "{team.folder}/drone-{{id}}"\n'
    )
    with pytest.raises(KeysError, match="found those of drone-2, expected those of drone-1"):
        Ranging(1, config=file, keys=team.folder / "drone-2")
    with pytest.raises(TransportError, match="this team has keys, expected the folder with those of a drone"):
        Ranging(1, config=file)
    with pytest.raises(TransportError, match="has no address for drone 7"):
        topology.of_companion(section, 7, None)
    async with speaking(topology.of_drone(section, 1, team.credentials("1"))) as one:
        heard = HeardRanges(one)
        # Drone 2's keys, and a program that speaks as if it were drone 1's radio.
        liar = ZenohSpeaker(topology.of_companion(section, 1, team.credentials("2")), Kind.RANGE, 1, CLOCK)
        await liar.open()
        try:
            await eventually(lambda: liar.links().count)
            await liar.prepare(2)
            now = CLOCK.now()
            lie = range_message(
                RangeReport(1, 2, now, 0.01, 99.0, 0.1), "0123abcd", 1, CLOCK.utc() - now, now
            )
            for _ in range(20):
                liar.put(2, codec.encode(lie))
                await asyncio.sleep(0.02)
            async with Ranging(1, config=file, keys=team.folder / "drone-1") as ranging:
                await say_until_heard(ranging, heard, 2, 8.5, 0.1)
                # A newer roster reaches it, too: links are renewed, and it is received again.
                team.issue("3")
                await eventually(lambda: not ranging.linked)
                await eventually(lambda: ranging.linked)
                before = [said.distance for said in heard.ranges]
                heard.ranges.clear()
                await say_until_heard(ranging, heard, 2, 9.5, 0.1)
        finally:
            await liar.close()
        assert set(before) == {8.5}
        assert {said.distance for said in heard.ranges} == {9.5}


async def test_the_radio_example_passes_on_what_its_driver_prints(team):
    async with speaking(network(team)) as one:
        heard = HeardRanges(one)
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, str(EXAMPLES / "ranging_radio.py"), "--team", team, "--drone", "1"),
            stdin=subprocess.PIPE, stderr=subprocess.PIPE, cwd=ROOT, env={"PYTHONPATH": str(ROOT), "PATH": ""},
        )  # fmt: skip
        async with asyncio.timeout(PATIENCE):
            while not heard.ranges:
                process.stdin.write(b"2 8.25\nhello\n2 nan\n")
                await asyncio.sleep(0.05)
            process.stdin.close()
            errors = await process.stderr.read()
            await process.wait()
    assert process.returncode == 0
    assert (heard.ranges[0].distance, heard.ranges[0].sigma) == (8.25, 0.1)
    assert "'hello' is no distance" in errors.decode()
    assert "'2 nan' is no distance" in errors.decode()


# --- the page and the examples ----------------------------------------------------------


async def ran(*words: str, until: str | None = None) -> tuple[int | None, str, str]:
    """Exit code and output of a Python program; until: stopped once it has printed a line that has this in it."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, *words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=ROOT,
        env={"PYTHONPATH": str(ROOT), "PATH": ""},
    )  # fmt: skip
    said = ""
    async with asyncio.timeout(PATIENCE):
        while until is not None and until not in said:
            line = (await process.stdout.readline()).decode()
            assert line, (await process.stderr.read()).decode()
            said += line
        if until is not None:
            process.terminate()
        out, err = await process.communicate()
    return process.returncode, said + out.decode(), err.decode()


async def test_the_first_lines_of_the_page_run_as_they_stand(team, tmp_path):
    page = (ROOT / "docs" / "client.md").read_text(encoding="utf-8")
    code = re.search(r"```python\n(.*?)```", page, re.DOTALL)[1]
    assert len(code.strip().splitlines()) <= 21
    program = tmp_path / "planner.py"
    program.write_text(code.replace('team="swarm"', f'team="{team}"'))
    async with speaking(network(team)):
        _, said, _ = await ran("-u", str(program), until="None [1. 0. 0.]")
    assert "2 [ 8.  6. -1.] ± 0.5" in said


def test_the_page_shows_a_node_for_ros_that_compiles():
    page = (ROOT / "docs" / "client.md").read_text(encoding="utf-8")
    (node,) = (block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "rclpy" in block)
    assert "rclpy.spin(node)" in node
    compile(node, "docs/client.md", "exec")


async def test_the_subscriber_says_who_is_where(team):
    async with speaking(network(team)):
        _, said, _ = await ran(str(EXAMPLES / "subscriber.py"), "--team", team, until="towards")
    assert "drone 1 sees: 2 at [8.0 6.0 -1.0] m, sigma 0.5 m, unknown towards [1.00 0.00 0.00] (body)" in said


async def test_the_follower_prints_set_points(team):
    async with speaking(network(team)):
        words = ("--team", team, "--drone", "1", "--follow", "2", "--distance", "8")
        _, said, _ = await ran(str(EXAMPLES / "follow_me.py"), *words, until="move_m")
    point = json.loads(said.splitlines()[-1])
    away = np.array([8.0, 6.0, -1.0])
    assert point["move_m"] == pytest.approx((away * (1 - 8 / np.linalg.norm(away))).tolist(), abs=1e-3)
    assert point["teammate_velocity_m_s"] == [0.5, 0.0, -0.25]
    assert point["t_utc_s"] > UTC


async def test_the_follower_holds_where_it_does_not_know(team):
    async with speaking(network(team)):
        words = ("--team", team, "--drone", "1", "--follow", "3")
        _, said, _ = await ran(str(EXAMPLES / "follow_me.py"), *words, until="hold")
    assert "drone 3 is not identified" in json.loads(said.splitlines()[0])["hold"]


def table(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))


async def test_the_recorder_writes_csv_and_numpy(team, tmp_path):
    name = tmp_path / "flight"
    async with speaking(network(team)):
        code, said, error = await ran(
            str(EXAMPLES / "to_csv.py"), str(name), "--team", team, "--seconds", "4"
        )
    assert (code, error) == (0, "")
    assert "rows in" in said
    rows = table(Path(f"{name}.csv"))
    two = [row for row in rows if row["identity"] == "2"]
    assert (float(two[0]["north_m"]), float(two[0]["down_m"])) == (8.0, -1.0)
    columns = np.load(f"{name}.npz")
    assert len(columns["t_utc_s"]) == len(rows)
    assert set(columns["identity"]) == {0.0, 2.0}
    assert np.isnan(columns["north_m"][columns["identity"] == 0]).all()


async def test_an_example_that_hears_nobody_says_why(team):
    code, _, error = await ran(
        "-c",
        f"""
import asyncio
from swarmtrack.client import Swarm
async def main():
    async with Swarm({team!r}) as swarm:
        async for _ in swarm.tracks(patience_s=0.2): pass
asyncio.run(main())
""",
    )
    assert code == 1
    assert f"TransportError: no drone of team '{team}' was heard within 0.2 s" in error
