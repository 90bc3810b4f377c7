"""Names that motion proves, with real processes: on the wire, on the page and in the verdict."""

from __future__ import annotations

import asyncio
import json
import re
import struct
from pathlib import Path

import aiohttp
import pytest

from support.launcher import finish, start
from support.pair_scenario import PAIR, is_fair
from support.patience import PATIENCE

pytest.importorskip("zenoh", reason="Zenoh has no wheel here")

# Two drones that sway a lot, so that also the few scans of a busy machine prove them.
SWAYING = PAIR.replace("imu_rate_hz = 50.0\n", "imu_rate_hz = 50.0\nshare_hz = 5.0\n").replace(
    "ring = { radius_m = 2.0 }\n",
    "ring = { radius_m = 2.0 }\nsway = { amplitude_m = [0.3, 0.3, 0.3], period_s = [4.0, 7.0] }\n",
)
LENGTHS = ("9", "48")  # s: the longer one where the machine is busy


async def test_a_proof_is_on_the_page_and_in_the_verdict(tmp_path: Path) -> None:
    scenario, out = tmp_path / "swaying.toml", tmp_path / "out.json"
    scenario.write_text(SWAYING, encoding="utf-8")
    for seconds in LENGTHS:
        options = ("--detector", "oracle", "--seconds", seconds, "--json", str(out), "--monitor")
        flight = start(tmp_path, "--scenario", str(scenario), *options)
        shown = await proofs_shown(await address(flight))
        code, said, complained = await asyncio.to_thread(finish, flight)
        if shown:
            break
    assert complained == ""
    assert is_fair(code, said), said
    identity = json.loads(out.read_text(encoding="utf-8"))["identity"]
    assert identity["wrong"] == 0.0
    assert identity["proved"] > 0.0
    assert shown, "expected a proof on the page"


async def address(flight) -> str:
    """Where the page is, once the flight says so."""
    while True:
        line = await asyncio.wait_for(asyncio.to_thread(flight.stdout.readline), PATIENCE)
        assert line, "the flight ended without naming a page"
        if found := re.search(r"http://127\.0\.0\.1:\d+/", line):
            return found[0]


async def proofs_shown(url: str) -> set[tuple[int, int]]:
    """(observer, name) of the boxes of the page that motion proves: until each of both has one, or the flight ends."""
    shown: set[tuple[int, int]] = set()
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(f"{url}ws", origin=url.rstrip("/")) as page,
    ):
        async for message in page:
            if message.type is aiohttp.WSMsgType.TEXT:
                await page.send_str('{"watch":[[1,0],[2,0]]}')
            else:
                (length,) = struct.unpack_from("<I", message.data)
                header = json.loads(message.data[4 : 4 + length])
                boxes = (box for box in header["boxes"] if box["proved_s"] is not None)
                shown |= {(header["drone"], box["identity"]) for box in boxes}
            await page.send_str("+")
            if shown == {(1, 2), (2, 1)}:
                break
    return shown
