"""docs/examples: servers of cameras with libraries of their own, on fakes of these, read by the agent's sources."""

from __future__ import annotations

import asyncio
import os
import sys
import time
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np
import pytest

from support.patience import PATIENCE
from support.places import DOCS
from support.ports import free_port
from support.streams import counters, first
from swarmtrack.camera_sources.address import parse_address
from swarmtrack.camera_sources.detection_stream import DetectionStream
from swarmtrack.camera_sources.opening import open_camera
from swarmtrack.clock import SystemClock
from swarmtrack.messages import StampKind

LIBRARIES = Path(__file__).parents[1] / "support" / "camera_libraries"
ENDLESS = 10**9


@asynccontextmanager
async def serving(script, *options, last=ENDLESS):
    """A server of docs/examples; gives its port, its process and the middle of its first exposure."""
    port, start = free_port(), time.monotonic() + 0.1
    environment = os.environ | {
        "PYTHONPATH": str(LIBRARIES),
        "FAKE_START": str(start),
        "FAKE_LAST": str(last),
    }
    command = (sys.executable, str(DOCS / "examples" / script), "--port", str(port), *options)
    process = await asyncio.create_subprocess_exec(
        *command, env=environment, stderr=asyncio.subprocess.PIPE, limit=1 << 20
    )
    try:
        async with asyncio.timeout(PATIENCE):
            yield port, process, start
    finally:
        if process.returncode is None:
            process.terminate()
        await process.communicate()


def assert_at_exposures(times, start):
    """All at middles of exposures, thirty a second from start."""
    phases = 30.0 * (np.array(times) - start)
    np.testing.assert_allclose(phases, np.round(phases), atol=0.01)
    assert len(set(np.round(phases))) == len(times)


@pytest.mark.parametrize("options", [[], ["--utc"]])
async def test_pictures_of_a_raspberry_pi_carry_the_middle_of_their_exposure(options):
    options = [*options, "--readout-ms", "20", "--size", "64", "48"]
    async with serving("picamera2_mjpeg.py", *options) as (port, _, start):
        camera = open_camera(f"http://127.0.0.1:{port}/", clock=SystemClock(), size=(64, 48))
        frames = await first(4, camera.frames())
        assert {frame.stamp for frame in frames} == {StampKind.EXPOSURE}
        assert frames[0].image.shape[:2] == (48, 64)
        # In UTC as far as both programs see the two clocks alike.
        assert_at_exposures([frame.t for frame in frames], start)
        assert counters(camera)["bad_stamps"] == 0
        await camera.close()


async def detections_of(port, count=4):
    source = DetectionStream(parse_address(f"detections://127.0.0.1:{port}/"), clock=SystemClock())
    found = await first(count, source.detections())
    assert counters(source)["bad_stamps"] == 0
    assert counters(source)["corrupt"] == 0
    await source.close()
    return found


async def test_an_imx500_s_boxes_are_pixels_of_the_cropped_picture_and_not_rounded():
    options = ["net.rpk", "--label", "4", "--readout-ms", "20", "--size", "480", "480"]
    async with serving("imx500_detections.py", *options) as (port, _, start):
        found = await detections_of(port)
    assert_at_exposures([each.t for each in found], start)
    # The crop is the sensor's middle square, 3040 of 4056 px wide: 20 of 320 parts of the width.
    width = 20 / 320 * 4056 / 3040 * 480
    for each in found:
        np.testing.assert_allclose(each.centre, [[239.5, 239.5]], atol=1e-6)
        np.testing.assert_allclose(each.size, [[width, 15.0]], atol=1e-6)
        np.testing.assert_array_equal(each.score, [0.9])


async def test_an_imx500_s_network_that_needs_more_than_the_camera_is_refused():
    async with serving("imx500_detections.py", "undescribed.rpk") as (_, process, _):
        assert await process.wait() == 2
        assert b"undescribed.rpk: expected a network with" in await process.stderr.read()


async def test_an_oak_s_boxes_are_pixels_of_the_net_s_input_with_its_numbers():
    async with serving("oak_detections.py", "a/drone-net", "--label", "4") as (port, process, start):
        found = await detections_of(port)
        assert b"boxes are in pixels of 512 x 288" in await process.stderr.readline()
    assert_at_exposures([each.t for each in found], start)
    for each in found:
        np.testing.assert_allclose(each.centre, [[0.625 * 512 - 0.5, 0.375 * 288 - 0.5]])
        np.testing.assert_allclose(each.size, [[128.0, 72.0]])
        assert each.sequence - 100 == round(30.0 * (each.t - start))


async def test_a_camera_that_is_unplugged_ends_its_server_and_the_agent_waits_for_another():
    async with serving("oak_detections.py", "a/drone-net", last=40) as (port, process, _):
        source = DetectionStream(parse_address(f"detections://127.0.0.1:{port}/"), clock=SystemClock())
        await first(1, source.detections())
        assert await process.wait() == 1
        while source.status().ok:  # noqa: ASYNC110 (what is waited for happens outside)
            await asyncio.sleep(0.02)
        assert "trying again" in source.status().text
        await source.close()


async def test_a_server_takes_no_more_clients_than_it_can_feed():
    async with serving("oak_detections.py", "a/drone-net") as (port, _, _):

        async def connect():
            while True:
                try:
                    reader, writer = await asyncio.open_connection("127.0.0.1", port)
                    break
                except ConnectionRefusedError:
                    await asyncio.sleep(0.02)
            writer.write(b"GET / HTTP/1.0\r\n\r\n")
            return (await reader.readline()).split()[1], writer

        clients = [await connect() for _ in range(9)]
        assert [status for status, _ in clients] == [b"200"] * 8 + [b"503"]
        for _, writer in clients:
            writer.close()


@pytest.mark.parametrize("name", ["picamera2_mjpeg", "imx500_detections", "oak_detections", "stream_server"])
def test_they_are_short(name):
    assert len((DOCS / "examples" / f"{name}.py").read_text().splitlines()) <= 70
