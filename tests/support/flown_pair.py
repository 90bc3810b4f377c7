"""One flight of `swarmtrack sim` for all tests that read what a flight says, shows and leaves behind."""

from __future__ import annotations

import asyncio
import json
import re
import struct
import subprocess
from pathlib import Path
from typing import Any, NamedTuple
from urllib.request import urlopen

import aiohttp
import pytest

from support.launcher import finish, living, start
from support.pair_scenario import PAIR, is_judged
from support.patience import PATIENCE

# Two drones that sway a lot, so that also the few scans of a busy machine prove them; and a limit that no drone keeps.
SWAYING = (
    PAIR.replace("imu_rate_hz = 50.0\n", "imu_rate_hz = 50.0\nshare_hz = 5.0\n").replace(
        "ring = { radius_m = 2.0 }\n",
        "ring = { radius_m = 2.0 }\nsway = { amplitude_m = [0.3, 0.3, 0.3], period_s = [4.0, 7.0] }\n",
    )
    + "announcement_bytes = 10\n"
)
LENGTHS = (14, 48)  # s: the longer one where the machine is busy


class FlownPair(NamedTuple):
    """Two drones, recorded, with the monitor's page; its scenario file is gone, and its own folder was kept."""

    seconds: int
    folder: Path
    code: int
    said: str
    complained: str
    page: bytes
    url: str
    proved: set[tuple[int, int]]
    """(observer, name) of the boxes of the page that motion proved during the flight."""
    living: list[str]
    """Command lines of the processes that outlived it."""

    @property
    def recording(self) -> Path:
        return self.folder / "recording"

    @property
    def verdict(self) -> dict[str, Any]:
        return json.loads((self.folder / "out.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="session")
def flown_pair(tmp_path_factory: pytest.TempPathFactory) -> FlownPair:
    pytest.importorskip("zenoh", reason="Zenoh has no wheel here")
    for seconds in LENGTHS:
        flown = asyncio.run(fly_pair(tmp_path_factory.mktemp("pair"), seconds))
        if is_judged(flown.said) and flown.proved:
            break
    return flown


async def fly_pair(folder: Path, seconds: int) -> FlownPair:
    scenario = folder / "pair.toml"
    scenario.write_text(SWAYING, encoding="utf-8")
    files = ("--record", str(folder / "recording"), "--json", str(folder / "out.json"), "--keep")
    options = ("--detector", "oracle", "--seconds", str(seconds), "--monitor", *files)
    flight = start(folder, "--scenario", str(scenario), *options)
    said, url = await address(flight)
    with await asyncio.to_thread(urlopen, url, timeout=PATIENCE) as answer:
        page = answer.read()
    proved = await proofs_shown(url)
    code, rest, complained = await asyncio.to_thread(finish, flight)
    scenario.unlink()
    return FlownPair(seconds, folder, code, said + rest, complained, page, url, proved, living(folder))


async def address(flight: subprocess.Popen[str]) -> tuple[str, str]:
    """What the flight says until it names its page, and where that is."""
    assert flight.stdout is not None
    said = ""
    while True:
        line = await asyncio.wait_for(asyncio.to_thread(flight.stdout.readline), PATIENCE)
        assert line, f"the flight ended without naming a page: {said}"
        said += line
        if found := re.search(r"http://127\.0\.0\.1:\d+/", line):
            return said, found[0]


async def proofs_shown(url: str) -> set[tuple[int, int]]:
    """Until each of both drones has a box that motion proves, or the flight ends."""
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
