"""Zenoh from asyncio: sessions that open and close in bounded time.

Opening, closing and blocking puts run on threads of ours, each with a time bound.

On loopback, agents meet on well-known ports: each takes the lowest that is free and dials those below it, again and
again, so an agent that comes or comes back is linked to all others, and none is special. When the ports are used up,
agents listen anywhere, dial all of them, and learn of each other by Zenoh's gossip.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import itertools
import logging
import re
import threading
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final, TypeVar

import zenoh

from swarmtrack.errors import TransportError
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind
from swarmtrack.transport.limits import SESSION_ANSWER_S, SESSION_CLOSE_S, SESSION_OPEN_S
from swarmtrack.transport.links import EndpointTemplate
from swarmtrack.transport.own_sockets import cut_off
from swarmtrack.transport.ports import wait_for_ports
from swarmtrack.transport.settings import Mode, NetworkSettings, parse_endpoint
from swarmtrack.transport.zenoh_bridge import Bridge
from swarmtrack.transport.zenoh_config import zenoh_config

log = logging.getLogger(__name__)

RENDEZVOUS_PORTS: Final = range(17447, 17447 + 32)  # on loopback, below Linux's ephemeral ports


_T = TypeVar("_T")


async def open_session(
    network: NetworkSettings, listening: bool = True, *, again: bool = False
) -> zenoh.Session:
    """Open a session. Raises TransportError, also where no router answers a client, which may try again. listening:
    accept diallers. again: this process had a session before. Zenoh keeps the port of its datagrams for half a
    minute after closing, and listens there once it is free; until then all goes over the other link.

    An address that this machine does not have yet (an interface that is down) is listened on as soon as it has.
    """
    if listening and not again:
        await wait_for_ports(network.listen)
    return await bounded(partial(_open, network, listening), SESSION_OPEN_S, "open", too_late=_close)


def _open(network: NetworkSettings, listening: bool) -> zenoh.Session:
    if network.mode == Mode.CLIENT:
        try:
            return zenoh.open(zenoh_config(network, (), network.connect))
        except zenoh.ZError:
            raise TransportError(f"network: no router answers at {' or '.join(network.connect)}") from None
    if not network.rendezvous:
        listen = network.listen if listening else ()
        return zenoh.open(zenoh_config(network, listen, network.connect))
    links = EndpointTemplate.direct(secured=network.credentials is not None)
    meeting_points = [links.at(f"127.0.0.1:{port}", "network") for port in RENDEZVOUS_PORTS]
    if not listening:
        return zenoh.open(zenoh_config(network, (), _joined(meeting_points)))
    for i, free in enumerate(meeting_points):
        try:
            return zenoh.open(zenoh_config(network, free, _joined(meeting_points[:i])))
        except zenoh.ZError as error:
            if f"os error {errno.EADDRINUSE}" not in str(error):
                raise
    return zenoh.open(zenoh_config(network, links.anywhere, _joined(meeting_points)))


def _joined(meeting_points: list[tuple[str, ...]]) -> tuple[str, ...]:
    return tuple(itertools.chain.from_iterable(meeting_points))


def ask_for_announcement(
    session: zenoh.Session,
    team: str,
    drone_id: int,
    answers: Bridge,
    *words: str,
    on_answer: Callable[[bytes], object] | None = None,
) -> None:
    """`ask` for a pose. words: parameters of the query, see `keys`."""
    ask(session, f"{keys.key(team, Kind.POSE, drone_id)}?{';'.join(words)}", answers, on_answer)


def ask(
    session: zenoh.Session, selector: str, answers: Bridge, on_answer: Callable[[bytes], object] | None = None
) -> None:
    """Query every process with the drone's ID, including a clone. Returns at once."""
    with contextlib.suppress(zenoh.ZError):  # the session is closing
        session.get(
            selector,
            answers.replies(on_answer),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.DROP,  # we ask again
            allowed_destination=zenoh.Locality.REMOTE,
            timeout=SESSION_ANSWER_S,
        )


def _close(session: zenoh.Session) -> None:
    session.close()  # type: ignore[no-untyped-call]


async def close_session(session: zenoh.Session, declared: list[Any], listen: Sequence[str] = ()) -> None:
    """Undeclare in order, then close. Where Zenoh does not end it within `SESSION_CLOSE_S`, its sockets are taken away:
    else it would keep links to teammates, which then wait for words that never come. listen: its own endpoints.
    """
    # Our ends of its links, and where it accepts them.
    ends = (*listen, *(str(link.src) for link in session.info.links()))
    ports = {port for end in ends if (port := parse_endpoint(end, "network").port) is not None}

    def close() -> None:
        for entity in declared:
            with contextlib.suppress(zenoh.ZError):
                entity.undeclare()
        _close(session)

    try:
        await bounded(close, SESSION_CLOSE_S, "close")
    except TransportError as error:
        log.warning("%s; %d sockets of its links are closed", error, cut_off(ports))


async def bounded(
    call: Callable[[], _T],
    seconds: float,
    what: str,
    too_late: Callable[[_T], None] = lambda result: None,
) -> _T:
    """call() on a thread of its own, for at most `seconds`; raises TransportError on ZError and timeout.

    The thread is a daemon, where asyncio's own pool would hold up the process's end for a call that hangs. too_late:
    called with a result after the timeout.
    """
    loop = asyncio.get_running_loop()
    answer: asyncio.Future[_T] = loop.create_future()

    def give(result: _T | None, error: BaseException | None) -> None:
        if answer.done():
            if error is None:
                threading.Thread(target=too_late, args=(result,), daemon=True).start()
        elif error is not None:
            answer.set_exception(error)
        else:
            answer.set_result(result)  # type: ignore[arg-type]

    def run() -> None:
        result, error = None, None
        try:
            result = call()
        except BaseException as raised:  # goes to whoever awaits
            error = raised
        with contextlib.suppress(RuntimeError):  # the loop is closed
            loop.call_soon_threadsafe(give, result, error)

    threading.Thread(target=run, name=f"zenoh {what}", daemon=True).start()
    try:
        # `wait_for` of Python 3.11 loses a cancellation that meets the answer
        async with asyncio.timeout(seconds):
            return await answer
    except zenoh.ZError as error:
        raise TransportError(f"network: cannot {what}: {plain(error)}") from None
    except TimeoutError:
        raise TransportError(f"network: cannot {what}: no answer from Zenoh within {seconds:g} s") from None


def plain(error: zenoh.ZError) -> str:
    """Zenoh's error message without source locations."""
    return re.sub(r" at /\S+?\.rs:\d+\.?", "", str(error)).strip().rstrip(".")
