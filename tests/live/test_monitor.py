"""The monitor as a user meets it: the command, its page in a real Chromium, a team over real Zenoh on loopback."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import secrets
import signal
import ssl
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import aiohttp
import pytest

from support.browser import browser_page, needs_chromium, until_said
from support.called import called
from support.certificates import certificate
from support.patience import PATIENCE, eventually
from support.places import ROOT

pytest.importorskip("zenoh", reason="Zenoh has no wheel here")

from swarmtrack.agents import main as swarmtrack
from swarmtrack.benchmarks.scripted_team import scripted_team

# Whether the page fits a phone, test_it_fits_its_screen looks in the default run.
SCREENS = [(1280, 800), pytest.param(390, 844, marks=pytest.mark.long("once more on a phone, in Chromium"))]

PAGE = ROOT / "swarmtrack" / "monitor" / "page" / "index.html"


class Monitor:
    """A process of `swarmtrack monitor`."""

    def __init__(self, process: asyncio.subprocess.Process, url: str) -> None:
        self.process = process
        self.url = url

    async def end(self) -> int:
        if self.process.returncode is None:
            self.process.send_signal(signal.SIGTERM)
        return await asyncio.wait_for(self.process.wait(), PATIENCE)


async def start_monitor(team: str, *arguments: str) -> Monitor:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "swarmtrack.agents.main", "monitor", "--team", team),
        *(arguments if "--port" in arguments else ("--port", "0", *arguments)),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        cwd=ROOT,
    )
    assert process.stdout is not None
    line = (await asyncio.wait_for(process.stdout.readline(), PATIENCE)).decode()
    found = re.search(r"http\S+", line)
    if found is None:
        assert process.stderr is not None
        raise AssertionError((await process.stderr.read()).decode())
    return Monitor(process, found[0])


@asynccontextmanager
async def monitor(team: str, *arguments: str) -> AsyncIterator[Monitor]:
    one = await start_monitor(team, *arguments)
    try:
        yield one
    finally:
        await one.end()


@pytest.fixture
def team() -> str:
    return f"test-{secrets.token_hex(4)}"


# --- the page in a browser ------------------------------------------------------------------------


@needs_chromium
async def test_three_drones_agree_then_one_errs_one_has_no_imu_and_one_is_gone(team: str) -> None:
    async with scripted_team(team, 3) as drones, monitor(team) as served, browser_page() as (page, misdeeds):
        await page.goto(served.url)
        await until_said(page, "3 drones agree", "ok")
        await page.wait_for_function("() => stats.pictures > 6")
        assert await page.locator(".camera").count() == 3
        assert await page.locator("#matrix .seen").count() == 6

        drones[1].calls = {3: 1, 1: 3}
        await until_said(page, "drone 2 calls drone ", "bad")
        assert await page.locator("#matrix .wrong").count() == 2
        drones[1].calls = {}
        await until_said(page, "3 drones agree", "ok")

        drones[1].imu_hz = 0.0
        await until_said(page, "drone 2 lost its IMU", "warn")
        drones[1].imu_hz = 200.0
        await until_said(page, "3 drones agree", "ok")

        drones[2].die()
        await page.wait_for_selector(".camera.gone")
        await until_said(page, "drone 3 is gone", "warn")
        assert await page.locator("#health tr.gone").count() == 1
        assert misdeeds == []


@needs_chromium
@pytest.mark.parametrize(("width", "height"), SCREENS)
async def test_the_map_shows_each_teammate_where_the_observer_sees_it_in_metres(
    team: str, width: int, height: int
) -> None:
    """Three on a circle of 5.8 m, each told the truth."""
    async with (
        scripted_team(team, 3),
        monitor(team) as served,
        browser_page(width, height) as (page, misdeeds),
    ):
        await page.goto(served.url)
        await until_said(page, "3 drones agree", "ok")
        await page.wait_for_function("() => ellipses.length === 6")
        assert "choose a drone" in await page.inner_text("#scale")
        # Now the cameras may be out of sight: the map must not depend on them.
        await page.locator("#map").scroll_into_view_if_needed()
        await page.locator("#matrix .head").nth(1).click()
        await page.wait_for_function("() => ellipses.length === 2 && ellipses.every(e => e.observer === 1)")
        off = await page.evaluate(
            "ellipses.map(e => {const [, u, v] = spots.find(s => s[0] === e.called);"
            " return Math.hypot(u - e.x, v - e.y)})"
        )
        assert max(off) < 40.0  # px: a drone's place may be a second old
        said = await page.evaluate("metresOf(1).map(far)")
        assert all(re.fullmatch(r"10\.\d m ± 0\.5", text) for text in said), said
        cell = page.locator("#matrix .seen").first
        assert "10." in (await cell.get_attribute("title") or "")
        assert misdeeds == []


@needs_chromium
async def test_one_whose_radio_died_is_grey_within_three_seconds_though_its_token_stays(team: str) -> None:
    async with scripted_team(team, 3) as drones, monitor(team) as served, browser_page() as (page, _):
        await page.goto(served.url)
        await until_said(page, "3 drones agree", "ok")
        drones[0].fall_silent()
        await page.wait_for_selector(".camera.gone")
        await until_said(page, "drone 1 is gone", "warn")


# Collects what the page says before another state has come.
EARLY_WORDS = """() => {
    const last = state, send = WebSocket.prototype.send;
    window.early = [];
    WebSocket.prototype.send = function (word) { if (state === last) early.push(word); send.call(this, word) };
}"""


@needs_chromium
async def test_the_page_comes_back_by_itself_when_the_monitor_does(team: str) -> None:
    async with scripted_team(team, 2), browser_page() as (page, _):
        first = await start_monitor(team)
        await page.goto(first.url)
        await until_said(page, "2 drones agree", "ok")
        assert await first.end() == 0
        await until_said(page, "no link to the monitor", "idle")
        await page.evaluate(EARLY_WORDS)
        async with monitor(team, "--port", first.url.rsplit(":", 1)[1].strip("/")):
            await until_said(page, "2 drones agree", "ok")
            before = await page.evaluate("stats.pictures")
            await page.wait_for_function("n => stats.pictures > n + 2", arg=before)
            # What it asked for before the new monitor knew of any drone would be granted for none.
            assert await page.evaluate("early") == []


@needs_chromium
@pytest.mark.parametrize(("n", "width", "height"), [(12, 1280, 800), (3, 390, 844)])
async def test_it_fits_its_screen(team: str, n: int, width: int, height: int) -> None:
    async with (
        scripted_team(team, n),
        monitor(team) as served,
        browser_page(width, height) as (page, misdeeds),
    ):
        await page.goto(served.url)
        await until_said(page, f"{n} drones agree", "ok")
        await page.wait_for_function("() => stats.pictures > 3")
        assert await page.evaluate("document.documentElement.scrollWidth") <= width
        # Whatever is drawn lies within the screen, but for the table that scrolls by itself.
        beyond = await page.evaluate(
            "[...document.querySelectorAll('.pane, .camera, #matrix div, #light')]"
            ".filter(e => e.getBoundingClientRect().right > innerWidth + 1).length"
        )
        assert beyond == 0
        assert misdeeds == []


@needs_chromium
@pytest.mark.parametrize("drones", [10, pytest.param(30, marks=pytest.mark.long("thirty drones, not ten"))])
async def test_a_large_team_has_a_readable_matrix(team: str, drones: int) -> None:
    async with scripted_team(team, drones), monitor(team) as served, browser_page() as (page, misdeeds):
        await page.goto(served.url)
        await until_said(page, f"{drones} drones agree", "ok")
        assert await page.locator("#matrix div").count() == (drones + 1) ** 2
        cell = await page.locator("#matrix .seen").first.bounding_box()
        assert cell is not None
        assert cell["width"] >= 18
        assert misdeeds == []


# --- drones with several cameras ------------------------------------------------------------------


@needs_chromium
@pytest.mark.parametrize(("width", "height"), SCREENS)
async def test_a_drone_with_four_cameras_has_a_picture_of_each_and_all_directions_in_one_strip(
    team: str, width: int, height: int
) -> None:
    async with (
        scripted_team(team, 2, cameras=4) as drones,
        monitor(team) as served,
        browser_page(width, height) as (page, misdeeds),
    ):
        await page.goto(served.url)
        await page.wait_for_selector(".rig >> nth=1")
        assert await page.locator("#cameras .camera").count() == 0
        assert await page.locator(".rig").first.locator(".camera").count() == 4
        # The strip shows the teammate where the camera that sees it looks.
        marks = await page.wait_for_function(
            "() => { const off = [...rigs.values()].flatMap(r => r.marks.map(m => {"
            " const az = 360 * m.x / r.strip.clientWidth - 180, off = az - 90 * m.camera;"
            " return [m.identity, Math.abs(((off + 540) % 360) - 180)]})); return off.length ? off : null }"
        )
        off = await marks.json_value()
        assert {identity for identity, _ in off} <= {1, 2}
        assert max(angle for _, angle in off) < 46.0
        # Pictures of those on the screen, and of no others.
        await page.wait_for_function("() => cameras.get('1/0').last > 0 && cameras.get('1/1').last > 0")
        shown = await page.evaluate("[...visible].map(key => key.split('/').map(Number))")
        await eventually(
            lambda: [(d.drone_id, k) for d in drones for k in d.watched] == sorted((d, k) for d, k in shown),
            f"only {shown} are watched",
        )
        assert await page.evaluate("document.documentElement.scrollWidth") <= width
        beyond = await page.evaluate(
            "[...document.querySelectorAll('.pane, .camera, .strip, .rig .of')]"
            ".filter(e => e.getBoundingClientRect().right > innerWidth + 1).length"
        )
        assert beyond == 0
        assert misdeeds == []


@needs_chromium
async def test_drones_with_one_camera_and_with_several_share_a_page(team: str) -> None:
    """The one with one has its picture as ever."""
    async with (
        scripted_team(team, 2) as (one, two),
        monitor(team) as served,
        browser_page() as (page, misdeeds),
    ):
        await page.goto(served.url)
        await page.wait_for_selector("#cameras .camera >> nth=1")
        two.look_around(2)
        await page.wait_for_selector(".rig .camera >> nth=1")
        assert await page.locator("#cameras .camera").count() == 1
        await page.wait_for_function("() => cameras.get('1/0').last > 0 && cameras.get('2/1').last > 0")
        assert (len(one.pictures), len(two.pictures)) == (1, 2)
        assert misdeeds == []


def test_the_page_is_one_small_file_that_asks_for_nothing() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert len(text.encode()) < 150_000
    assert not re.search(r"https?://|@import|url\(|src=|innerHTML", text)


# --- video only while somebody looks --------------------------------------------------------------


async def watch(socket: aiohttp.ClientWebSocketResponse, *cameras: tuple[int, int]) -> None:
    await socket.send_str(json.dumps({"watch": cameras}))


async def until_listed(socket: aiohttp.ClientWebSocketResponse, n: int) -> None:
    async with asyncio.timeout(PATIENCE):
        while True:
            message = await socket.receive()
            await socket.send_str("+")
            if message.type is aiohttp.WSMsgType.TEXT and len(json.loads(message.data)["drones"]) == n:
                return


async def test_a_drone_is_watched_only_while_a_page_shows_it(team: str) -> None:
    async with scripted_team(team, 2) as (one, two), monitor(team) as served, aiohttp.ClientSession() as http:
        async with http.ws_connect(f"{served.url}ws") as socket:
            await until_listed(socket, 2)
            assert (one.is_watched, two.is_watched) == (False, False)
            await watch(socket, (2, 0))
            await eventually(lambda: two.is_watched, "drone 2 is watched")
            assert not one.is_watched
        await eventually(lambda: not two.is_watched, "nobody looks any more")


async def test_of_four_cameras_the_one_that_is_looked_at_sends_pictures_and_the_others_do_not(
    team: str,
) -> None:
    async with (
        scripted_team(team, 1, cameras=4) as (drone,),
        monitor(team) as served,
        aiohttp.ClientSession() as http,
        http.ws_connect(f"{served.url}ws") as socket,
    ):
        await until_listed(socket, 1)
        async with asyncio.timeout(PATIENCE):
            while True:  # until it has told of its cameras
                message = await socket.receive()
                await socket.send_str("+")
                if (
                    message.type is aiohttp.WSMsgType.TEXT
                    and json.loads(message.data)["drones"][0]["cameras"] == 4
                ):
                    break
        await watch(socket, (1, 2), (1, 7), (9, 0))
        await eventually(lambda: drone.pictures[2] > 3, "camera 3 is watched")
        assert drone.watched == [2]
        assert [n > 0 for n in drone.pictures] == [False, False, True, False]


async def test_a_page_that_draws_nothing_is_sent_nothing_more(team: str) -> None:
    """A slow phone: without its word that it drew, there is no queue that could grow."""
    async with (
        scripted_team(team, 1) as (drone,),
        monitor(team) as served,
        aiohttp.ClientSession() as http,
        http.ws_connect(f"{served.url}ws") as socket,
    ):
        await until_listed(socket, 1)
        await watch(socket, (1, 0))
        await eventually(lambda: drone.pictures[0] > 10, "pictures are sent")
        heard = 0
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(1.5):
                while True:
                    await socket.receive()
                    heard += 1
        assert heard <= 2  # of a state and a picture each the newest


# --- who may look ---------------------------------------------------------------------------------


async def test_beyond_this_machine_it_takes_the_token(team: str) -> None:
    async with monitor(team, "--bind", "0.0.0.0") as served, aiohttp.ClientSession() as http:
        port, token = re.search(r":(\d+)/\?token=(\S+)", served.url).groups()  # type: ignore[union-attr]
        base = f"http://127.0.0.1:{port}/"
        for url in (base, f"{base}?token=wrong", f"{base}ws", f"{base}ws?token={token}x"):
            async with http.get(url) as response:
                assert response.status == 403, url
        async with http.get(f"{base}?token={token}") as response:
            assert response.status == 200
            policy = response.headers["Content-Security-Policy"]
            assert "default-src 'none'" in policy
            assert "unsafe-inline" not in policy


async def test_with_a_certificate_the_page_and_its_token_travel_encrypted(team: str, tmp_path: Path) -> None:
    pem, key = certificate(tmp_path)
    trusted = ssl.create_default_context(cafile=str(pem))
    arguments = ("--bind", "0.0.0.0", "--certificate", str(pem), "--key", str(key))
    async with monitor(team, *arguments) as served, aiohttp.ClientSession() as http:
        port, query = re.search(r"^https://.*:(\d+)/(\?token=\S+)", served.url).groups()  # type: ignore[union-attr]
        async with http.get(f"https://localhost:{port}/{query}", ssl=trusted) as response:
            assert response.status == 200
        async with http.get(f"https://localhost:{port}/", ssl=trusted) as response:
            assert response.status == 403


async def test_a_page_of_another_site_hears_nothing(team: str) -> None:
    async with monitor(team) as served, aiohttp.ClientSession() as http:
        for headers in ({"Origin": "http://evil.example"}, {"Host": "evil.example"}):
            with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
                await http.ws_connect(f"{served.url}ws", headers=headers)


async def test_nonsense_from_a_page_ends_its_link_and_nothing_else(team: str) -> None:
    async with monitor(team) as served, aiohttp.ClientSession() as http:
        for word in ("[", "null", '{"watch": 3}', '{"watch": [[]]}', "[" * 2000, "x" * 5000):
            async with http.ws_connect(f"{served.url}ws") as socket:
                await socket.send_str(word)
                async with asyncio.timeout(PATIENCE):
                    while (await socket.receive()).type is aiohttp.WSMsgType.TEXT:
                        if word == '{"watch": [[]]}':
                            break  # no ID in it: nobody is watched
        async with http.get(served.url) as response:
            assert response.status == 200


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["--port", "99999"], 2, "expected a port"),
        (["--token", "short"], 2, "--token: expected 8 to 128"),
        (["--bind", "203.0.113.7", "--port", "0"], 1, "expected an address of this machine"),
        (["--connect", "192.168.1.5"], 2, "insecure"),
        (["--certificate", "page.pem"], 2, "--certificate alone, expected"),
    ],
)
def test_wrong_usage_is_a_sentence(
    arguments: list[str], code: int, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    said = called(swarmtrack.main, ["monitor", *arguments], capsys)
    assert said.code == code, said.err
    assert says in said.err
