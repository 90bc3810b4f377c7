"""`monitor --foxglove`: what a viewer that knows nothing of ours reads from the socket."""

from __future__ import annotations

import asyncio
import json
import re
import secrets
import socket
from contextlib import asynccontextmanager

import aiohttp
import numpy as np
import pytest

from support.monitor_process import monitor_lines
from support.patience import PATIENCE, eventually
from support.places import DOCS

pytest.importorskip("foxglove", reason="foxglove-sdk has no wheel here")
pytest.importorskip("google.protobuf", reason="protobuf is not installed")
pytest.importorskip("zenoh", reason="Zenoh has no wheel here")

from foxglove.messages import Timestamp

from support.foxglove_client import FoxgloveClient
from support.recorded_flight import fly
from support.recorded_swarm import DEPARTED, PLACES, TEAM, UTC, record_swarm, sightings
from support.seen_swarm import seen, stranger, teammate
from swarmtrack.agents import main as swarmtrack
from swarmtrack.benchmarks.scripted_team import scripted_team
from swarmtrack.clock import ManualClock
from swarmtrack.monitor import foxglove_scenes
from swarmtrack.monitor.foxglove_scenes import identified_tracks, log_of, scene_of
from swarmtrack.monitor.team import MonitoredTeam
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind, Sample
from swarmtrack.wire import codec

PLAYING, PAUSED, ENDED = 0, 1, 3
STAMP = Timestamp(sec=1, nsec=0)


@pytest.fixture(scope="module")
def heard(tmp_path_factory):
    folder = tmp_path_factory.mktemp("heard")
    record_swarm(folder)
    return folder


@asynccontextmanager
async def connected(*arguments, leaves=()):
    """A client of a monitor of its own process, and the monitor's page."""
    async with (
        monitor_lines("--foxglove", "0", *arguments) as lines,
        asyncio.timeout(PATIENCE),
        aiohttp.ClientSession() as http,
    ):
        page = re.search(r"http\S+", (await lines.readline()).decode())[0]
        url = re.search(r"ws://127\.0\.0\.1:\d+", (await lines.readline()).decode())[0]
        async with http.ws_connect(url, protocols=("foxglove.sdk.v1",)) as viewer:
            yield FoxgloveClient(viewer, leaves), http, page


def place_of(client, frame):
    """Origin in the team's frame, by the newest transforms."""
    (found,) = (t for t in client.messages["/tf"][-1][1].transforms if t.child_frame_id == frame)
    assert found.parent_frame_id == "team"
    return [found.translation.x, found.translation.y, found.translation.z]


async def test_a_recording_is_played_sought_and_paused_by_the_viewer(heard):
    async with connected("--recording", str(heard)) as (client, *_):
        await client.until(lambda: client.messages["/drone-3/camera/image"])
        assert set(client.info["capabilities"]) >= {"playbackControl", "time"}
        assert client.info["dataStartTime"]["sec"] == UTC
        assert client.info["dataEndTime"]["sec"] == UTC + 40
        await client.until(lambda: client.shown("/drones") == {"1", "2", "3"})
        for drone, place in PLACES.items():
            assert place_of(client, f"drone-{drone}/ned") == pytest.approx(place.tolist())
        image = client.messages["/drone-1/camera/image"][0][1]
        assert (image.format, image.data[:2]) == ("jpeg", b"\xff\xd8")
        # Its picture is a quarter as wide as its calibration, and so are the boxes in it.
        lens = client.messages["/drone-1/camera/calibration"][0][1]
        assert (lens.width, lens.K[0]) == (160, 100.0)
        (box,) = client.messages["/drone-1/camera/annotations"][-1][1].points
        assert max(p.x for p in box.points) - min(p.x for p in box.points) == pytest.approx(
            30.0 / 4.0, abs=0.1
        )

        await client.control(play=False, speed=2.0, seek=UTC + DEPARTED + 5.0, request="later")
        await client.until(lambda: any(state[4] == "later" for state in client.states))
        (state,) = (state for state in client.states if state[4] == "later")
        assert state[:4] == (PAUSED, pytest.approx(UTC + 35.0, abs=1e-3), 2.0, True)
        await client.until(lambda: abs(client.messages["/drones"][-1][0] - UTC - 35.0) < 0.05)
        assert client.shown("/drones") == {"1", "2"}, "the third is gone"
        await client.until(lambda: "is gone" in [line.message for _, line in client.messages["/log"]])

        # Back, which the page may ask for as well; then to the end.
        await client.control(play=True, speed=8.0, seek=UTC + 39.0, request="")
        await client.until(lambda: client.states[-1][0] == ENDED)


async def test_metres_stand_where_the_drone_sees_them(tmp_path):
    fly(tmp_path, 4.0, faults=False)
    async with connected("--recording", str(tmp_path / "rec")) as (client, *_):
        await client.until(lambda: any(m.entities for _, m in client.messages["/scene"]))
        await client.until(lambda: any(m.entities for _, m in client.messages["/rays"]))
        entity = next(m for _, m in reversed(client.messages["/scene"]) if m.entities).entities[0]
        own, whom = entity.id.split("/")
        assert entity.frame_id == f"drone-{own}/ned"
        assert re.fullmatch(rf"drone {whom} \d+\.\d m ± \d+\.\d", entity.texts[0].text)
        frames = {t.child_frame_id for t in client.messages["/tf"][-1][1].transforms}
        rays = next(m for _, m in reversed(client.messages["/rays"]) if m.entities).entities
        assert {ray.frame_id for ray in rays} <= frames


async def test_a_running_swarm_sends_pictures_only_while_a_viewer_subscribes_to_them():
    team = f"test-{secrets.token_hex(4)}"
    async with (
        scripted_team(team, 2) as (one, two),
        connected("--team", team, leaves=("image",)) as (client, http, page),
    ):
        await client.until(lambda: client.shown("/drones") == {"1", "2"})
        await client.until(lambda: "/drone-1/camera/image" in client.topics)
        assert (one.is_watched, two.is_watched) == (False, False)
        assert not client.shown("/cameras")
        await client.subscribe("/drone-1/camera/image")
        # With its picture comes where its camera looks.
        await client.until(lambda: client.messages["/drone-1/camera/image"] and client.shown("/cameras"))
        assert (one.is_watched, two.is_watched) == (True, False)
        assert client.shown("/cameras") == {"drone-1/camera"}
        assert all(name.startswith("1/") for name in client.shown("/rays"))
        async with http.get(page) as response:
            assert response.status == 200, "the page is there as ever"
        await client.close()
        await eventually(lambda: not one.is_watched, "nobody looks any more")


def layout_topics(node):
    """All topics in a layout, as strings that begin with a slash."""
    if isinstance(node, dict):
        for key, value in node.items():
            yield from (key,) if key.startswith("/") else ()
            yield from layout_topics(value)
    elif isinstance(node, str) and node.startswith("/"):
        yield node


async def test_the_layout_names_topics_that_are_served_and_panels_that_it_holds(heard):
    layout = json.loads((DOCS / "examples" / "foxglove-layout.json").read_text())
    async with connected("--recording", str(heard)) as (client, *_):
        wanted = set(layout_topics(layout))
        assert len(wanted) == 4 + 3 * 3 + 1
        await client.until(lambda: wanted <= client.topics)

    def panels(node):
        return [node] if isinstance(node, str) else panels(node["first"]) + panels(node["second"])

    assert sorted(panels(layout["layout"])) == sorted(layout["configById"])


def test_a_port_that_is_taken_is_a_sentence(heard, capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        arguments = ["monitor", "--recording", str(heard), "--port", "0", "--foxglove", port]
        assert swarmtrack.main(arguments) == 1
    assert f"--foxglove {port}: " in capsys.readouterr().err


# ── hostile words ────────────────────────────────────────────────────────────────────────────────────────────────────


def watching(*payloads):
    clock = ManualClock(100.0, UTC)
    team = MonitoredTeam(TEAM, clock)
    for kind, drone, payload in payloads:
        team.on_sample(Sample(keys.key(TEAM, kind, drone), payload, True, 100.0))
    return team


def test_a_drone_whose_words_cannot_be_shown_is_left_out_and_the_others_stay(monkeypatch):
    team = watching(
        *((Kind.IDENTITIES, drone, sightings(drone, 0.1, 1)) for drone in (1, 2)),
        *((Kind.TRACKS, drone, codec.encode(seen())) for drone in (1, 2)),
    )
    whole = dict(scene_of(team, STAMP))
    real = foxglove_scenes.teammate_of

    def odd(state, frame, stamp, *, owner):
        if owner == "1/":
            raise ValueError("odd")
        return real(state, frame, stamp, owner=owner)

    monkeypatch.setattr(foxglove_scenes, "teammate_of", odd)
    rest = dict(scene_of(team, STAMP))
    scene = next(topic for topic in whole if topic.name == "/scene")
    assert 0 < len(rest[scene]) < len(whole[scene])
    assert team.state()["unreadable"] == 1


def test_a_text_of_a_drone_is_plain_in_the_log():
    event = {"n": 1, "t_utc_s": 1.0, "drone": 7, "text": "\x1b[31mred\u202e<script>", "kind": "bad"}
    _, data = log_of(event, STAMP)
    assert b"\x1b" not in data
    assert "\u202e".encode() not in data
    assert b"drone 7" in data


def test_tracks_come_from_the_wire_as_their_drone_had_them():
    known, unknown = identified_tracks(seen(1, teammate(), stranger()))
    np.testing.assert_allclose(known.relative.position, teammate().relative.position)
    np.testing.assert_allclose(known.relative.cov, teammate().relative.cov, rtol=1e-6)
    np.testing.assert_allclose(known.track.mean, teammate().track.mean)
    np.testing.assert_allclose(known.track.cov, teammate().track.cov)
    assert (known.identity, unknown.identity, unknown.relative) == (2, None, None)
