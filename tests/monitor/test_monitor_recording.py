"""The monitor plays recordings: what was heard of a swarm, and what drones recorded themselves."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import secrets
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import aiohttp
import msgspec
import numpy as np
import pytest

from support.monitor_process import monitor_lines
from support.patience import PATIENCE

pytest.importorskip("foxglove", reason="foxglove-sdk has no wheel here")
pytest.importorskip("zenoh", reason="Zenoh has no wheel here")

from support import recorded_swarm
from support.browser import browser_page, needs_chromium, until_said
from support.places import ROOT
from support.recorded_cameras import recorded
from support.recorded_flight import fly
from support.recorded_swarm import TEAM, UTC, record_swarm
from support.seen_swarm import seen, teammate
from swarmtrack.agents import main as swarmtrack
from swarmtrack.benchmarks.scripted_team import scripted_team
from swarmtrack.clock import ManualClock
from swarmtrack.errors import RecordingError
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.monitor.overlay import boxes
from swarmtrack.monitor.own_recording import DroneRecording
from swarmtrack.monitor.player import PLAYER_STEP_S, Playback, RecordingPlayer
from swarmtrack.monitor.recorded import read_timeline
from swarmtrack.monitor.team import MonitoredTeam
from swarmtrack.monitor.timeline import BlobFile
from swarmtrack.recording.reader import recordings_below
from swarmtrack.runtime.swarm_recorder import SwarmRecorder
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind, Sample
from swarmtrack.wire import codec
from swarmtrack.wire.sightings import SightingsMessage

# Whether the page fits a phone, test_it_fits_its_screen looks in the default run.
SCREENS = [(1280, 800), pytest.param(390, 844, marks=pytest.mark.long("once more on a phone, in Chromium"))]


@pytest.fixture(scope="module")
def heard(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("heard")
    record_swarm(folder)
    return folder


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> Path:
    """What three drones recorded themselves, with pictures, by wall clocks that are seconds apart."""
    folder = tmp_path_factory.mktemp("flown")
    fly(folder, 6.0, extra='\n[recording]\nframes = "jpeg"\n', faults=False)
    return folder / "rec"


def at(playback: Playback, t: float) -> dict:
    playback.seek(round(t / PLAYER_STEP_S))
    return playback.state()


# --- what was heard -------------------------------------------------------------------------------


def test_the_sentence_is_that_of_its_time(heard):
    playback = Playback(read_timeline([heard]))
    assert playback.timeline.begin == pytest.approx(UTC)
    assert playback.timeline.seconds == pytest.approx(40.0)
    expected = {
        0.0: ("idle", "3 drones here, no names to compare yet"),
        8.0: ("ok", "3 drones agree"),
        15.0: ("bad", "drone 2 calls drone 1 drone 3"),
        25.0: ("ok", "3 drones agree"),
        35.0: ("warn", "drone 3 is gone"),
    }
    for t in (8.0, 35.0, 15.0, 0.0, 25.0):
        light = at(playback, t)["light"]
        assert (light["kind"], light["text"]) == expected[t], t


def test_a_state_does_not_depend_on_how_it_was_reached(heard):
    timeline = read_timeline([heard])
    straight, jumping = Playback(timeline), Playback(timeline)
    states = [straight.state()]
    for step in range(1, straight.steps + 1):
        straight.seek(step)
        states.append(straight.state())
    for step in (399, 1, 100, 99, 101, 250, 249, 400, 0, 37, 350, 349):
        jumping.seek(step)
        assert jumping.state() == states[step], step


def test_events_have_the_times_of_the_flight(heard):
    playback = Playback(read_timeline([heard]))
    events = {
        event["text"]: event["t_utc_s"] - UTC for event in at(playback, 40.0)["events"] if event["drone"] == 3
    }
    assert events["is here"] == pytest.approx(0.0, abs=0.11)
    assert events["is gone"] == pytest.approx(30.0, abs=0.3)
    assert all(event["text"] != "is gone" for event in at(playback, 29.0)["events"])


def test_a_picture_is_shown_with_the_boxes_of_its_instant(heard):
    playback = Playback(read_timeline([heard]))
    for t in (20.0, 5.0):
        at(playback, t)
        view, tracks = playback.view(1)
        assert view.jpeg.startswith(b"\xff\xd8")
        assert view.t_utc_s == pytest.approx(UTC + t)
        assert tracks.tracks[0].u_px == pytest.approx(100.0 + 5.0 * t)
    at(playback, 39.0)
    assert playback.view(3) is None  # it has been gone for long


async def test_recording_a_swarm_switches_no_camera_on_unless_asked_to(tmp_path):
    team = f"test-{secrets.token_hex(4)}"
    async with scripted_team(team, 2) as drones:
        for arguments, watched in ((), False), (("--video",), True):
            folder = tmp_path / str(watched)
            process = await asyncio.create_subprocess_exec(
                *(sys.executable, "-m", "swarmtrack.agents.main", "record", str(folder)),
                *("--team", team, "--seconds", "2.5", *arguments),
                cwd=ROOT,
            )
            was_watched = False
            while process.returncode is None:
                was_watched |= any(drone.is_watched for drone in drones)
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(process.wait(), 0.05)
            assert (process.returncode, was_watched) == (0, watched)
            playback = Playback(read_timeline([folder]))
            assert at(playback, playback.timeline.seconds)["light"]["text"] == "2 drones agree"
            assert (playback.view(1) is not None) == watched


async def test_all_cameras_of_a_swarm_are_recorded_where_pictures_are_asked_for(tmp_path):
    team = f"test-{secrets.token_hex(4)}"
    async with scripted_team(team, 1, cameras=4) as (drone,):
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "swarmtrack.agents.main", "record", str(tmp_path)),
            *("--team", team, "--seconds", "3", "--video"),
            cwd=ROOT,
        )
        assert await asyncio.wait_for(process.wait(), PATIENCE) == 0
        assert all(drone.pictures)
    playback = Playback(read_timeline([tmp_path]))
    playback.seek(playback.steps)
    assert playback.cameras == ((1, 0), (1, 1), (1, 2), (1, 3))
    seen = [playback.view(1, k)[0] for k in range(4)]
    assert all(view.jpeg for view in seen)
    assert len({view.quaternion_wxyz for view in seen}) == 4
    topics = {message.topic for one in recordings_below(tmp_path) for message in one.messages()}
    assert {"/drone-1/video", "/drone-1/video/2", "/drone-1/video/4"} <= topics


# --- what drones recorded themselves --------------------------------------------------------------


@pytest.mark.parametrize(("named", "kind"), [(True, "ok"), (False, "idle")])
def test_a_tick_takes_more_than_that_nobody_contradicts(named, kind):
    clock = ManualClock(100.0, recorded_swarm.UTC)
    team = MonitoredTeam(recorded_swarm.TEAM, clock)

    def say(what, drone, payload, *rest):
        team.on_sample(Sample(keys.key(team.name, what, drone, *rest), payload, True, clock.now()))

    tracks = seen(1, teammate())
    if not named:
        unknown = tuple(msgspec.structs.replace(track, identity=None) for track in tracks.tracks)
        tracks = msgspec.structs.replace(tracks, tracks=unknown, relatives=(), proofs=())
    for drone in recorded_swarm.PLACES:
        say(Kind.ALIVE, drone, b"", f"{drone:08x}")
    for k in range(1, 6):
        clock.set(100.0 + k)
        for drone in recorded_swarm.PLACES:
            say(Kind.IDENTITIES, drone, recorded_swarm.sightings(drone, float(k), k))
            say(Kind.TRACKS, drone, codec.encode(tracks))
        team.refresh()
    light, drones = team.state()["light"], team.state()["drones"]
    assert light["kind"] == kind
    counted = f"{3 * named} of 3 drones in view are named"
    assert counted == (light["also"][0] if named else light["text"])
    assert [row[1:] for row in drones[0]["course"]] == [[int(named), 1, 0]] * 5
    assert drones[0]["course"][0][0] == pytest.approx((0.0, 0.0))


def test_drones_own_recordings_make_one_picture_of_the_team(flown):
    timeline = read_timeline([flown])
    assert timeline.notes == []
    assert timeline.seconds == pytest.approx(6.0, abs=0.3)  # though their wall clocks are 2 s apart
    playback = Playback(timeline)
    state = at(playback, 5.0)
    assert [drone["id"] for drone in state["drones"]] == [1, 2, 3]
    assert state["light"] == {
        "kind": "ok",
        "text": "3 drones agree",
        "also": ["6 of 6 drones in view are named"],
    }
    assert {(look[0], look[1]) for look in state["looks"] if look[3]} == {
        (a, b) for a in (1, 2, 3) for b in (1, 2, 3) if a != b
    }
    for drone in (1, 2, 3):
        view, tracks = playback.view(drone)
        assert view.jpeg.startswith(b"\xff\xd8")
        assert {track.identity for track in tracks.tracks} == {1, 2, 3} - {drone}
    assert at(playback, 5.9)["light"]["kind"] == "ok"  # nobody is gone just because the recording ends


def test_the_map_has_the_metres_of_that_time(flown):
    playback = Playback(read_timeline([flown]))
    state = at(playback, 5.0)
    places = load_scenario("hover-triangle").initial_poses
    for drone in state["drones"]:
        assert {one.called for one in drone["metres"]} == {1, 2, 3} - {drone["id"]}
        for one in drone["metres"]:
            away = places[one.called].position - places[drone["id"]].position
            assert one.distance_m == pytest.approx(np.linalg.norm(away), abs=4.0 * one.sigma_m + 0.3)
            assert one.long_m < 2.0
    for drone in (1, 2, 3):
        shown = boxes(*playback.view(drone))
        assert all(box["distance_m"] > 1.0 for box in shown)
    playback.seek(0)
    assert all(drone["metres"] == [] for drone in playback.state()["drones"])


def test_of_a_lone_drone_there_is_what_it_saw_and_heard(flown):
    timeline = read_timeline([flown / "drone-2"])
    assert timeline.notes == []
    state = at(Playback(timeline), 5.0)
    assert [drone["id"] for drone in state["drones"]] == [1, 2, 3]
    assert {look[1] for look in state["looks"] if look[0] == 2} == {1, 3}
    assert all(look[3] for look in state["looks"])
    assert all(drone["gone_s"] is None and drone["position_m"] for drone in state["drones"])


def sightings_of(events, observer: int) -> dict[int, SightingsMessage]:
    """By their number."""
    key = keys.key("t", Kind.IDENTITIES, observer)
    payloads = [event.sample.payload for event in events if event.sample and event.sample.key == key]
    return {(message := codec.decode(SightingsMessage, data)).sequence: message for data in payloads}


def test_what_a_drone_said_by_its_own_recording_is_what_its_team_heard(flown):
    told = {}
    for d in (1, 2):
        (recording,) = recordings_below(flown / f"drone-{d}")
        own = DroneRecording(recording, BlobFile())
        own.read()
        told[d] = list(own.events(0.0, lives=set(), says_itself=True))
    said, heard = sightings_of(told[2], observer=2), sightings_of(told[1], observer=2)
    assert len(said) >= 4
    assert all({s.drone_id for s in message.sightings} == {1, 3} for message in list(said.values())[1:])
    assert said.keys() == heard.keys()
    for number, ours in said.items():
        theirs = heard[number]
        assert ours.position_m == pytest.approx(theirs.position_m)
        assert ours.position_sigma_m == theirs.position_sigma_m
        assert [(s.drone_id, s.probability) for s in ours.sightings] == [
            (s.drone_id, s.probability) for s in theirs.sightings
        ]
        for s, t in zip(ours.sightings, theirs.sightings, strict=True):
            assert (*s.direction, s.sigma_rad) == pytest.approx((*t.direction, t.sigma_rad), abs=1e-9)


# --- what cannot be played ------------------------------------------------------------------------


def test_two_processes_that_speak_as_one_drone_are_played(tmp_path):
    fly(tmp_path, 3.0, faults=True)
    playback = Playback(read_timeline([tmp_path / "rec"]))
    light = at(playback, 1.4)["light"]
    assert (light["kind"], light["text"]) == ("bad", "2 processes use ID 99")
    assert "processes" not in json.dumps(at(playback, 2.0)["light"])


def test_what_is_cut_off_is_played_as_far_as_it_goes_and_told(heard, tmp_path):
    whole = min(heard.rglob("*.mcap"))  # a busy machine begins a second segment
    cut = tmp_path / "0001.mcap"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    timeline = read_timeline([cut])
    assert 5.0 < timeline.seconds < 35.0
    assert "is cut off after" in timeline.notes[0]


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (None, "holds no .mcap file"),
        (b"", "is not an MCAP file"),
        (b"\x89MCAP0\r\n", "is not a swarmtrack recording"),
    ],
)
def test_what_is_no_recording_is_refused_with_a_sentence(content, says, tmp_path, capsys):
    if content is not None:
        (tmp_path / "0001.mcap").write_bytes(content)
    assert swarmtrack.main(["monitor", "--port", "0", "--recording", str(tmp_path)]) == 2
    assert says in capsys.readouterr().err


def test_a_recording_without_a_word_is_refused(tmp_path):
    recorder = SwarmRecorder(ManualClock(), TEAM)
    recorder.open(tmp_path)
    recorder.flown("started", 1)
    recorder.close()
    with pytest.raises(
        RecordingError, match="holds no message of any drone, expected the recording of a flight"
    ):
        read_timeline([tmp_path])


def test_two_teams_are_not_one(heard, flown):
    with pytest.raises(RecordingError, match=f"teams {TEAM}, t, expected those of one"):
        read_timeline([heard, flown])


def test_a_recording_beside_a_swarm_is_a_mistake(heard, capsys):
    assert swarmtrack.main(["monitor", "--recording", str(heard), "--team", "x"]) == 2
    assert "expected a recording or a swarm" in capsys.readouterr().err


# --- the page -------------------------------------------------------------------------------------


@asynccontextmanager
async def playing(folder: Path) -> AsyncIterator[str]:
    """The address of `swarmtrack monitor --recording`."""
    async with monitor_lines("--recording", str(folder)) as lines:
        line = (await asyncio.wait_for(lines.readline(), PATIENCE)).decode()
        yield re.search(r"http\S+", line)[0]  # type: ignore[index]


def test_only_wishes_that_a_page_has_are_granted(heard):
    player = RecordingPlayer(Playback(read_timeline([heard])), "x")
    for wish in ({"seek": 3}, {"seek": -1.0}, {"seek": 1e6}, {"play": False}, {"speed": 0.25}):
        assert player.on_wish(wish), wish
    nonsense = ["NaN", "1e999", "9" * 400, '"3"', "null", "[1]"]
    for text in nonsense:
        assert not player.on_wish({"seek": json.loads(text)}), text
        assert not player.on_wish({"speed": json.loads(text)}), text
    assert not player.on_wish({"speed": 3})
    assert not player.on_wish({"fly": True})


async def test_two_viewers_share_one_position(heard):
    async with (
        playing(heard) as url,
        aiohttp.ClientSession() as http,
        http.ws_connect(f"{url}ws") as one,
        http.ws_connect(f"{url}ws") as two,
        asyncio.timeout(PATIENCE),
    ):
        await one.send_str('{"play": false}')
        await one.send_str('{"seek": 15}')
        state = {"playback": {"t_s": None}}
        while state["playback"]["t_s"] != 15.0:
            state = json.loads((await two.receive()).data)
            await two.send_str("+")
        assert state["light"]["text"] == "drone 2 calls drone 1 drone 3"
        assert state["playback"]["playing"] is False


@needs_chromium
@pytest.mark.parametrize(("width", "height"), SCREENS)
async def test_the_map_of_a_recording_has_the_ellipses_of_the_chosen_drone(flown, width, height):
    async with playing(flown) as url, browser_page(width, height) as (page, misdeeds):
        await page.goto(url)
        await page.wait_for_selector("#player:not([hidden])")
        await page.evaluate("() => {say({play: false}); seek(5)}")
        await page.wait_for_function("() => state.playback.t_s === 5 && ellipses.length === 6")
        await page.locator("#matrix .head").nth(2).click()
        await page.wait_for_function("() => ellipses.length === 2 && ellipses.every(e => e.observer === 2)")
        off = await page.evaluate(
            "ellipses.map(e => {const [, u, v] = spots.find(s => s[0] === e.called);"
            " return Math.hypot(u - e.x, v - e.y)})"
        )
        assert max(off) < 40.0
        assert await page.evaluate("document.documentElement.scrollWidth") <= width
        assert misdeeds == []


@needs_chromium
@pytest.mark.parametrize(("width", "height"), SCREENS)
async def test_a_recording_of_two_cameras_shows_both_pictures_and_all_directions(tmp_path, width, height):
    recorded(tmp_path)
    async with playing(tmp_path / "rec") as url, browser_page(width, height) as (page, misdeeds):
        await page.goto(url)
        await page.wait_for_selector(".rig .camera >> nth=1")
        await page.evaluate("() => {say({play: false}); seek(0.9)}")
        await page.wait_for_function(
            "() => state.playback.t_s === 0.9 && cameras.get('3/0').last > 0 && cameras.get('3/1').last > 0"
        )
        await page.wait_for_function("() => rigs.get(3).marks.length === 2")
        # The first camera's target is left of the nose, that of the second, which looks right, at its right.
        marks = await page.evaluate(
            "rigs.get(3).marks.map(m => [m.camera, m.x / rigs.get(3).strip.clientWidth])"
        )
        assert sorted(marks) == [[0, pytest.approx(0.47, abs=0.02)], [1, pytest.approx(0.745, abs=0.02)]]
        shades = await page.evaluate(
            "[0, 1].map(k => cameras.get(`3/${k}`).canvas.getContext('2d').getImageData(5, 5, 1, 1).data[0])"
        )
        assert shades == pytest.approx([40, 100], abs=5)
        assert await page.evaluate("document.documentElement.scrollWidth") <= width
        assert misdeeds == []


@needs_chromium
@pytest.mark.parametrize(("width", "height"), SCREENS)
async def test_the_slider_moves_the_time_and_the_sentence(heard, width, height):
    async with playing(heard) as url, browser_page(width, height) as (page, misdeeds):
        await page.goto(url)
        await page.wait_for_selector("#player:not([hidden])")
        await page.click("#play")
        await page.wait_for_function("() => state.playback.playing === false")
        slide = "t => {const s = document.querySelector('#time'); s.value = t; s.dispatchEvent(new Event('input'))}"
        for t, kind, text in (
            (15.0, "bad", "drone 2 calls drone 1 drone 3"),
            (8.0, "ok", "3 drones agree"),
            (35.0, "warn", "drone 3 is gone"),
        ):
            await page.evaluate(slide, t)
            await until_said(page, text, kind)
            assert (await page.inner_text("#clock")).startswith(f"0:{t:04.1f} / 0:40.0")
        await page.wait_for_selector(".camera.gone")
        await page.keyboard.press("Shift+ArrowLeft")
        await until_said(page, "3 drones agree", "ok")
        before = await page.evaluate("stats.pictures")
        await page.keyboard.press("Space")
        await page.wait_for_function("n => stats.pictures > n + 3 && state.playback.t_s > 25.5", arg=before)
        assert await page.evaluate("document.documentElement.scrollWidth") <= width
        assert misdeeds == []
