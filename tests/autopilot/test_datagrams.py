"""Datagrams that have waited keep the times of their arrival."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import closing

import pytest

from support.ports import free_port
from swarmtrack.autopilot.datagrams import DatagramSocket, open_socket
from swarmtrack.autopilot.limits import DATAGRAMS_PER_TURN
from swarmtrack.clock import SystemClock


class LaterClock:
    """The system's clocks, `passed` seconds later than they are, the wall clock `stepped` seconds more."""

    def __init__(self) -> None:
        self.passed = self.stepped = 0.0
        self._system = SystemClock()

    def now(self) -> float:
        return self._system.now() + self.passed

    def utc(self) -> float:
        return self._system.utc() + self.passed + self.stepped


@pytest.fixture
def sender() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        yield opened


async def listening(clock: LaterClock, port: int) -> DatagramSocket:
    opened = await open_socket("127.0.0.1", port, clock, listens=True)
    assert list(opened.waiting()) == []
    return opened


async def test_what_has_waited_is_stamped_as_it_came(sender):
    port, clock = free_port(), LaterClock()
    with closing(await listening(clock, port)) as opened:
        before = clock.now()
        sender.sendto(b"first", ("127.0.0.1", port))
        between = clock.now()
        sender.sendto(b"second", ("127.0.0.1", port))
        after = clock.now()
        clock.passed = 5.0
        first, second = opened.waiting()
    rounding = 1e-4  # s: of the two clocks, that are not read at the same instant
    assert (first.data, second.data) == (b"first", b"second")
    assert before - rounding < first.arrival < between + rounding
    assert between - rounding < second.arrival < after + rounding
    assert first.sender == ("127.0.0.1", sender.getsockname()[1])


@pytest.mark.parametrize("stepped", [-3600.0, 3600.0])
async def test_a_step_of_the_wall_clock_moves_no_arrival_beyond_the_last_look_or_this_one(sender, stepped):
    port, clock = free_port(), LaterClock()
    with closing(await listening(clock, port)) as opened:
        looked = clock.now()
        sender.sendto(b"data", ("127.0.0.1", port))
        clock.passed, clock.stepped = 5.0, stepped
        (datagram,) = opened.waiting()
        assert looked - 1.0 < datagram.arrival <= clock.now()


async def test_a_flood_is_read_in_pieces_and_in_order(sender):
    port, clock = free_port(), LaterClock()
    with closing(await listening(clock, port)) as opened:
        numbers = [b"%d" % i for i in range(DATAGRAMS_PER_TURN + 3)]
        for number in numbers:
            sender.sendto(number, ("127.0.0.1", port))
        pieces = [[datagram.data for datagram in opened.waiting()] for _ in range(3)]
    assert pieces[0] == numbers[:DATAGRAMS_PER_TURN]
    assert pieces[1:] == [numbers[DATAGRAMS_PER_TURN:], []]


async def test_what_comes_while_the_ones_before_are_handled_is_not_stamped_early(sender):
    port, clock = free_port(), LaterClock()
    with closing(await listening(clock, port)) as opened:
        sender.sendto(b"first", ("127.0.0.1", port))
        waiting = opened.waiting()
        next(waiting)
        time.sleep(0.01)  # noqa: ASYNC251 – as a handler that holds the event loop
        sent = clock.now()
        sender.sendto(b"second", ("127.0.0.1", port))
        second = next(waiting)
    assert second.data == b"second"
    assert sent - 1e-4 < second.arrival <= clock.now()


async def test_a_pause_between_the_readings_of_two_clocks_stamps_nothing_early(sender):
    """As of a process that loses its core there."""

    class Pausing(LaterClock):
        def utc(self) -> float:
            utc = super().utc()
            self.passed += 0.02
            return utc

    port, clock = free_port(), Pausing()
    with closing(await listening(clock, port)) as opened:
        sent = clock.now()
        sender.sendto(b"data", ("127.0.0.1", port))
        (datagram,) = opened.waiting()
    assert datagram.arrival > sent - 1e-4
