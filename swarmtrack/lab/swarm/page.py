"""The web page of a flight: a monitor in a process of its own, which takes no time from judging.

When the flight is over, that and then its verdict are told to the page, which stays as it is from the flight's last
moment, for as long as the monitor lives.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

import msgspec

from swarmtrack.lab.swarm.processes import Child, Children, ProcessDied
from swarmtrack.outputs.flight_end import FlightEnd
from swarmtrack.transport.settings import NetworkSettings


class FlightPage:
    """said: the line that names its address."""

    def __init__(self, child: Child, said: str) -> None:
        self.child = child
        self.said = said

    def landed(self) -> None:
        """The flight is over. The page keeps what it shows now."""
        self.finish(FlightEnd("idle", "the flight is over and is being judged", [], []))

    def finish(self, end: FlightEnd) -> None:
        """Its verdict."""
        assert self.child.process.stdin is not None
        if self.child.process.returncode is None:
            self.child.process.stdin.write(msgspec.json.encode(end) + b"\n")

    async def gone(self) -> None:
        """Until its process ends."""
        await self.child.process.wait()


async def open_page(
    children: Children,
    program: Sequence[str],
    network: NetworkSettings,
    *,
    port: int,
    patience_s: float,
    show: bool,
) -> FlightPage:
    """program: that runs `swarmtrack`; show: in this machine's browser. Raises ProcessDied and TimeoutError."""
    arguments = ["monitor", "--flight", "--team", network.team, "--port", str(port)]
    for endpoint in network.connect:
        arguments += ["--connect", endpoint, "--insecure"]
    if show:
        arguments.append("--open")
    child = await children.start("monitor", [*program, *arguments], talks=True)
    assert child.process.stdout is not None
    async with asyncio.timeout(patience_s):
        line = await child.process.stdout.readline()
    if not line:
        raise ProcessDied((await children.died).describe_end())
    return FlightPage(child, line.decode().strip())
