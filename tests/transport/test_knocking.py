"""The dialled end makes its kernel ask for those who dial it, until they are linked."""

from __future__ import annotations

import asyncio
import socket

import pytest

from support.patience import PATIENCE
from swarmtrack.transport.knocking import keep_knocking


async def knocks(at: socket.socket) -> bytes:
    async with asyncio.timeout(PATIENCE):
        return await asyncio.get_running_loop().sock_recv(at, 64)


async def test_who_dials_us_is_sent_an_empty_datagram_until_it_is_linked() -> None:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as absent,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as linked,
    ):
        for door, host in ((absent, "127.0.0.1"), (linked, "127.0.0.2")):
            door.bind((host, 0))
            door.setblocking(False)
        callers = [
            f"quic/{host}:{port}?mixed_rel=1" for host, port in (absent.getsockname(), linked.getsockname())
        ]
        knocking = asyncio.create_task(
            keep_knocking(["quic/by-name.invalid:7448", *callers], lambda: {"127.0.0.2"})
        )
        assert await knocks(absent) == b""
        knocking.cancel()
        with pytest.raises(BlockingIOError):
            linked.recv(64)


async def test_where_everybody_that_dials_us_has_a_name_there_is_nothing_to_do() -> None:
    await keep_knocking(["quic/by-name.invalid:7448"], frozenset)
