"""What the monitor costs those who are watched, and whether its page keeps up with thirty drones (docs/monitor.md).

Of the drones: the scripted agent at 20 Hz of frames, unwatched and watched in turns, so that what else the machine does
meets both alike. Of the page: thirty scripted drones over real Zenoh, and a headless Chromium.
"""

from __future__ import annotations

import argparse
import asyncio
import re
import secrets
import shutil
import time
from contextlib import asynccontextmanager
from typing import Any

import numpy as np

from swarmtrack.benchmarks.figures import Figure
from swarmtrack.benchmarks.lone_agent import CAMERA, scripted_agent
from swarmtrack.benchmarks.processes import OURS, cpu_seconds, module_process
from swarmtrack.benchmarks.report import BenchmarkError
from swarmtrack.benchmarks.scripted_team import scripted_team
from swarmtrack.clock import SystemClock
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.world.rendering import Renderer
from swarmtrack.outputs.live_video import with_picture
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind
from swarmtrack.transport.settings import NetworkSettings
from swarmtrack.transport.zenoh_listener import ZenohListener
from swarmtrack.wire.lens import lens_message
from swarmtrack.wire.video import VideoMessage

FPS = 20.0
TURNS = 4  # of watched and unwatched
DRONES = 30
SETTLE_S = 3.0
MEASURE_RAF = """seconds => new Promise(done => {
  let n = 0; const began = performance.now(), states = stats.states, pictures = stats.pictures;
  const tick = () => { n++; const s = (performance.now() - began) / 1e3;
    s < seconds ? requestAnimationFrame(tick)
      : done([n / s, (stats.states - states) / s, (stats.pictures - pictures) / s]); };
  requestAnimationFrame(tick);
})"""


async def measure_agent(seconds: float) -> list[Figure]:
    """Of an agent that nobody, then somebody looks at; `seconds` a turn."""
    sizes: list[int] = []
    shares: dict[bool, list[float]] = {False: [], True: []}
    async with scripted_agent(["--fps", str(FPS)]) as agent:
        pid, video = agent.process.pid, keys.key(agent.team, Kind.VIDEO, 1)
        network, poses = NetworkSettings(team=agent.team), keys.key(agent.team, Kind.POSE, "*")
        viewer = ZenohListener(network, poses, SystemClock(), newest_per_key=True)
        await viewer.open()

        async def look() -> None:
            async for sample in viewer.samples():
                if f"/{Kind.VIDEO}/" in sample.key:
                    sizes.append(len(sample.payload))  # noqa: PERF401 - it ends by being cancelled

        looking = asyncio.create_task(look())
        await asyncio.sleep(SETTLE_S)
        for _ in range(TURNS):
            for watched in (False, True):
                if watched:
                    await viewer.listen_to(video)
                await asyncio.sleep(0.5)
                began, used = time.monotonic(), cpu_seconds(pid)
                await asyncio.sleep(seconds)
                share = (cpu_seconds(pid) - used) / (time.monotonic() - began)
                shares[watched].append(100.0 * share)
            await viewer.leave(video)
        looking.cancel()
        await viewer.close()
    if not sizes:
        raise BenchmarkError("monitor: no picture was heard of a watched agent")
    rate = len(sizes) / (TURNS * (seconds + 0.5))
    return [
        Figure("agent unwatched, CPU, median of turns", float(np.median(shares[False])), "% of a core"),
        Figure("agent watched, CPU, median of turns", float(np.median(shares[True])), "% of a core"),
        Figure("pictures of a watched agent", rate, "Hz"),
        Figure("their size (of noise, the worst there is)", float(np.mean(sizes)) / 1e3, "kB"),
    ]


def picture_ms(image: np.ndarray[Any, np.dtype[np.uint8]], times: int = 100) -> tuple[float, float]:
    """CPU time of one picture [ms] in the thread that encodes, and its size [kB]."""
    view = VideoMessage(1, 1.7e9, 0.05, 1, CAMERA.width, CAMERA.height, b"", lens_message(CAMERA), None, None)
    sent = with_picture(view, image)
    assert sent is not None
    began = time.thread_time()
    for _ in range(times):
        with_picture(view, image)
    return 1e3 * (time.thread_time() - began) / times, len(sent.jpeg) / 1e3


@asynccontextmanager
async def _page(url: str) -> Any:
    from playwright.async_api import async_playwright  # noqa: PLC0415 - for developers only

    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        raise BenchmarkError("monitor: no chromium is installed here")
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = await browser.new_page(viewport={"width": 1280, "height": 800})
        await page.goto(url)
        try:
            yield page
        finally:
            await browser.close()


async def measure_page(seconds: float) -> tuple[float, float, float, float]:
    """Thirty drones: animation frames, states and pictures a second, and the monitor's CPU in % of a core."""
    team = f"bench-{secrets.token_hex(4)}"
    async with (
        scripted_team(team, DRONES),
        module_process(OURS, "monitor", "--team", team, "--port", "0", patience_s=10.0) as process,
    ):
        assert process.stdout is not None
        found = re.search(r"http\S+", (await process.stdout.readline()).decode())
        assert found is not None, "the monitor prints its address"
        async with _page(found[0]) as page:
            seen = "n => document.querySelectorAll('#matrix .seen').length > n"
            await page.wait_for_function(seen, arg=DRONES)
            # Down to the matrix: there the pictures are out of sight, and nobody sends any.
            await page.evaluate("document.querySelector('#low').scrollIntoView()")
            await asyncio.sleep(2.0)
            used, began = cpu_seconds(process.pid), time.monotonic()
            frames, states, pictures = await page.evaluate(MEASURE_RAF, seconds)
            share = (cpu_seconds(process.pid) - used) / (time.monotonic() - began)
            return frames, states, pictures, 100.0 * share


def measured(args: argparse.Namespace) -> list[Figure]:
    """Of an agent that is watched, and of the page."""
    seconds = 2.0 if args.quick else 5.0
    noise = np.random.default_rng(0).integers(90, 160, (CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
    scenario = load_scenario("hover-triangle", seed=1)
    scene = Renderer(scenario.world, scenario.camera, scenario.body_from_camera).image(1, 1.0, 1)
    watched = asyncio.run(measure_agent(seconds))
    frames, states, pictures, share = asyncio.run(measure_page(2.0 * seconds))
    (noise_ms, _), (scene_ms, scene_kb) = picture_ms(noise), picture_ms(scene)
    return [
        *watched,
        Figure("one picture of noise, CPU in its thread", noise_ms, "ms"),
        Figure("one picture of a scene, CPU in its thread", scene_ms, "ms"),
        Figure("its size", scene_kb, "kB"),
        Figure(f"page with {DRONES} drones: animation frames", frames, "Hz"),
        Figure(f"page with {DRONES} drones: states drawn, of 5 told", states, "Hz"),
        Figure("pictures meanwhile, none of them in sight", pictures, "Hz"),
        Figure(f"monitor of {DRONES} drones, CPU", share, "% of a core"),
    ]
