"""Endless HTTP stream from a camera that may come and go: opened, reopened, and stamped.

A stream rarely states when its images were exposed. If it does, in seconds as a decimal number, that is taken as the
time of exposure: on our monotonic clock (a sender on the same machine) or in UTC of a sender whose clock is
synchronised with ours. `stamp_clock` judges which. A stamp that is on neither is counted as `bad_stamps` and the time
of arrival is used instead, with `latency_ms` taken off and `sigma_ms` as its uncertainty; the status says by how much
the clocks differ.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from swarmtrack.camera_sources.address import Login, in_range
from swarmtrack.camera_sources.limits import CAMERA_FIRST_BACKOFF_S, CAMERA_LONGEST_BACKOFF_S
from swarmtrack.camera_sources.newest_slot import NewestSlot, start, stop
from swarmtrack.camera_sources.stamp_clock import StampClock
from swarmtrack.clock import Clock
from swarmtrack.messages import LinkStatus, StampKind

if TYPE_CHECKING:
    import aiohttp

HINTS = {
    401: ": give user and password, {scheme}://USER:PASSWORD@HOST/…",
    403: ": check user, password and their rights",
    404: ": check the path",
}


@dataclass(frozen=True, slots=True)
class StreamOptions:
    """Options of network streams, which may lack exposure times."""

    latency_ms: float = 0.0  # from exposure to arrival, where only the arrival is known
    sigma_ms: float = 50.0  # of the same
    timeout_s: float = 3.0  # without a byte, then the stream is opened anew

    def __post_init__(self) -> None:
        in_range("latency_ms", self.latency_ms, 0, 10_000)
        in_range("sigma_ms", self.sigma_ms, 0.1, 10_000)
        in_range("timeout_s", self.timeout_s, 0.5, 60)


@dataclass(frozen=True, slots=True)
class NetworkOptions(StreamOptions):
    """Options of `http:` and `rtsp:`."""

    resize: bool = False


def refusal(scheme: str, status: int, reason: str, asked: Sequence[str] | None) -> str:
    """Sentence on a server's answer that is no stream. asked: for which schemes of login, None where none is given."""
    hint = HINTS.get(status, "").format(scheme=scheme)
    if status == 401 and asked is not None:
        hint = f": user or password is not accepted (asked for: {', '.join(asked) or 'no known scheme'})"
    return f"{'RTSP' if scheme == 'rtsp' else 'HTTP'} {status} {reason}{hint}"


Read = Callable[["aiohttp.ClientResponse"], Awaitable[None]]


class StreamEnded(Exception):
    """End of a stream, with the reason; the stream is reopened."""


class Exposure(NamedTuple):
    """Exposure time of an image [s], its standard deviation [s], and the source of both."""

    stamp: StampKind
    t: float
    t_sigma: float


class HttpStream:
    """received: images (or lines, or other items) since the start."""

    def __init__(
        self, url: str, options: StreamOptions, clock: Clock, slot: NewestSlot[Any], login: Login | None
    ) -> None:
        self.received = 0
        self._url = url
        self._options = options
        self._clock = clock
        self._slot = slot
        self._login = login
        slot.source.stamps = StampClock(clock, same_machine=False)
        self._task: asyncio.Task[None] | None = None

    def start(self, read: Read) -> None:
        """Read the answer of each connection with `read`, until `stop`. `read` may raise StreamEnded."""
        self._task = self._task or start(partial(self._run, read), self._slot)

    async def stop(self) -> None:
        await stop(self._task, self._slot)

    def status(self) -> LinkStatus:
        return self._slot.source.status()

    async def _run(self, read: Read) -> None:
        """Connect, read, say why it broke, and again; until cancelled."""
        # Here, not above: 20 MB and 0.2 s that only such a camera needs.
        import aiohttp  # noqa: PLC0415

        backoff = CAMERA_FIRST_BACKOFF_S
        timeout = aiohttp.ClientTimeout(
            total=None, sock_connect=self._options.timeout_s, sock_read=self._options.timeout_s
        )
        login = None
        if self._login is not None:
            from swarmtrack.camera_sources.http_login import LoginMiddleware  # noqa: PLC0415

            login = LoginMiddleware(self._login)
        middlewares = () if login is None else (login,)
        async with aiohttp.ClientSession(
            timeout=timeout, read_bufsize=1 << 20, middlewares=middlewares
        ) as session:
            while True:
                received = self.received
                try:
                    async with session.get(self._url) as response:
                        if response.status != 200:
                            asked = None if login is None else login.schemes
                            scheme, reason = self._url.partition(":")[0], response.reason or ""
                            raise StreamEnded(refusal(scheme, response.status, reason, asked))
                        self._slot.source.counts.reconnects += received > 0
                        same_machine = _from_here(response)
                        self._slot.source.stamps = StampClock(self._clock, same_machine=same_machine)
                        await read(response)
                    reason = "the server ended the stream"
                except StreamEnded as ended:
                    reason = str(ended)
                except TimeoutError:  # before ClientError: aiohttp's own are both
                    reason = f"nothing for {self._options.timeout_s:g} s"
                except aiohttp.ClientConnectorError as error:
                    why = os.strerror(error.errno) if error.errno and error.errno > 0 else error.strerror
                    reason = f"cannot connect to {error.host} port {error.port}: {why}"
                except aiohttp.ClientError as error:
                    reason = f"lost: {error}"
                except ValueError as error:  # of a server's challenge or redirect
                    reason = f"lost: the answer cannot be understood ({error})"
                self._slot.source.report(False, f"{reason}; trying again")
                if self.received > received:
                    backoff = CAMERA_FIRST_BACKOFF_S
                await asyncio.sleep(backoff)
                backoff = min(2 * backoff, CAMERA_LONGEST_BACKOFF_S)

    def exposure(self, stamp: float | None, arrived: float) -> Exposure:
        """Exposure time. stamp [s]: from the stream, NaN for an invalid one, None without one; arrived: on our
        clock.
        """
        if stamp is not None and (found := self._slot.source.exposure(stamp, arrived)) is not None:
            return Exposure(StampKind.EXPOSURE, *found)
        options = self._options
        return Exposure(StampKind.ARRIVAL, arrived - 1e-3 * options.latency_ms, 1e-3 * options.sigma_ms)


def _from_here(response: aiohttp.ClientResponse) -> bool:
    """Whether the server runs on this machine: both ends of the connection have one address."""
    transport = None if response.connection is None else response.connection.transport
    if transport is None:
        return False
    ours, theirs = (transport.get_extra_info(end) for end in ("sockname", "peername"))
    return bool(ours and theirs and ours[0] == theirs[0])
