"""`swarmtrack echo` as a user starts it: a process that hears a swarm and prints what it says."""

from __future__ import annotations

import asyncio
import json
import secrets
import signal
import sys
from collections.abc import AsyncIterator
from typing import Any

import numpy as np
import pytest

from support.called import called
from support.patience import PATIENCE
from support.places import ROOT

pytest.importorskip("zenoh", reason="Zenoh has no wheel here")

from swarmtrack.agents import main as swarmtrack
from swarmtrack.clock import ManualClock
from swarmtrack.messages import Announcement, IdentifiedTrack, Track, TrackList, TrackStatus
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind
from swarmtrack.transport.settings import NetworkSettings
from swarmtrack.transport.zenoh_transport import ZenohTransport
from swarmtrack.wire import codec
from swarmtrack.wire.tracks import tracks_message

PROGRAM = (
    "import argparse, sys; from swarmtrack import ending; from swarmtrack.agents import echo\n"
    "p = argparse.ArgumentParser(); echo.add_arguments(p)\n"
    "with ending.reader_may_leave(): sys.exit(echo.run(p.parse_args()))"
)


@pytest.fixture
def team() -> str:
    return f"test-{secrets.token_hex(4)}"


@pytest.fixture
async def drone(team: str) -> AsyncIterator[ZenohTransport]:
    boot = keys.new_boot()
    transport = ZenohTransport(NetworkSettings(team=team), 7, boot, ManualClock(utc=1.7e9))
    await transport.open()
    await transport.announce(
        Announcement(7, boot, 0, 0.0, 0.01, np.array([1.0, 2, -3]), np.eye(3), np.eye(3))
    )
    yield transport
    await transport.close()


async def start_echo(*arguments: str) -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", PROGRAM, *arguments),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        cwd=ROOT,
    )


async def ended(process: asyncio.subprocess.Process) -> tuple[int | None, list[dict[str, Any]], str]:
    """Exit code, the JSON lines, and what went to stderr."""
    out, err = await asyncio.wait_for(process.communicate(), PATIENCE)
    return process.returncode, [json.loads(line) for line in out.splitlines()], err.decode()


async def keep_publishing(drone: ZenohTransport) -> None:
    track = Track(3, 0.0, np.array([320.0, 1, 256, 2]), np.eye(4), TrackStatus.CONFIRMED, 0.9, np.ones(2))
    tracks = TrackList(0.0, 0.0, (IdentifiedTrack(track, 2, 0.99),))
    payload = codec.encode(tracks_message(tracks, 1, 1.7e9, 0.01))
    while True:
        drone.publish(Kind.TRACKS, payload)
        drone.publish(Kind.HEALTH, b"garbage")
        await asyncio.sleep(0.02)


@pytest.fixture
async def publishing(drone: ZenohTransport) -> AsyncIterator[None]:
    task = asyncio.create_task(keep_publishing(drone))
    yield
    task.cancel()


async def test_an_announcement_made_long_ago_is_printed_with_units(drone: ZenohTransport, team: str) -> None:
    code, lines, _ = await ended(
        await start_echo("pose/*", "--team", team, "--count", "1", "--seconds", "10")
    )
    assert code == 0
    assert lines[0]["key"] == f"swarmtrack/{team}/v1/pose/7"
    assert lines[0]["position_m"] == [1.0, 2.0, -3.0]
    assert lines[0]["t_utc_s"] == 1.7e9


@pytest.mark.usefixtures("publishing")
async def test_tracks_are_printed_as_they_come_until_enough_were(team: str) -> None:
    code, lines, _ = await ended(await start_echo("tracks/*", "--team", team, "--count", "3"))
    assert code == 0
    assert [line["tracks"][0]["u_px"] for line in lines] == [320.0] * 3


@pytest.mark.usefixtures("publishing")
async def test_what_cannot_be_read_is_printed_with_the_reason(team: str) -> None:
    full_key = f"swarmtrack/{team}/v1/health/*"
    _, lines, _ = await ended(await start_echo(full_key, "--count", "1"))
    assert lines[0]["key"] == f"swarmtrack/{team}/v1/health/7"
    assert lines[0]["error"].startswith("health: ")
    assert lines[0]["bytes"] == len(b"garbage")


@pytest.mark.usefixtures("publishing")
async def test_ctrl_c_ends_it_without_a_trace(team: str) -> None:
    process = await start_echo("tracks/*", "--team", team)
    assert process.stdout is not None
    await asyncio.wait_for(process.stdout.readline(), PATIENCE)
    process.send_signal(signal.SIGINT)
    code, _, errors = await ended(process)
    assert (code, errors) == (0, "")


@pytest.mark.usefixtures("publishing")
async def test_a_reader_who_has_enough_ends_it_without_a_trace(team: str) -> None:
    """As in `swarmtrack echo … | head -1`."""
    process = await asyncio.create_subprocess_shell(
        f"'{sys.executable}' -c '{PROGRAM}' 'tracks/*' --team {team} | head -1",
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        cwd=ROOT,
    )
    _, lines, errors = await ended(process)
    assert (len(lines), errors) == (1, "")


async def test_silence_is_an_error_that_says_what_to_check(team: str) -> None:
    code, lines, errors = await ended(
        await start_echo("tracks/*", "--team", team, "--count", "1", "--seconds", "0.2")
    )
    assert (code, lines) == (1, [])
    assert f"does an agent of team '{team}' run here" in errors

    code, lines, errors = await ended(await start_echo("tracks/*", "--team", team, "--seconds", "0.2"))
    assert (code, lines) == (0, [])  # as asked, but worth a word
    assert "received no message" in errors


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["a//b"], "is not a key expression"),
        (["tracks/*", "--connect", "tcp/192.168.1.5:7447"], "--insecure"),
        (["tracks/*", "--count", "-1"], "found -1, expected a whole number above 0"),
        (["tracks/*", "--seconds", "nan"], "found nan, expected a number of seconds above 0"),
        (["tracks/*", "--connect", "tcp/192.168.1.5"], "expected PROTOCOL/HOST:PORT"),
        (["tracks/*", "--connect", "192.168.1.5:x"], "expected HOST or HOST:PORT"),
    ],
)
def test_wrong_usage_is_exit_code_2_and_a_sentence(
    arguments: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    said = called(swarmtrack.main, ["echo", *arguments], capsys)
    assert said.code == 2
    assert says in said.err
