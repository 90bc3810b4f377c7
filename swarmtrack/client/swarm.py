"""Python client of a team of drones, for planners."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
from collections import Counter, deque
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Final, Generic, Self, TypeVar

from swarmtrack.client.axes import Axes
from swarmtrack.client.heard import HeardTeam
from swarmtrack.client.sight import DroneCamera, DroneHealth, Sight, Stranger
from swarmtrack.clock import SystemClock
from swarmtrack.errors import TransportError
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind, Sample
from swarmtrack.transport.listening import network_of_listener
from swarmtrack.transport.zenoh_listener import ZenohListener

T = TypeVar("T")

CLIENT_ASK_PERIOD_S: Final = (
    0.5  # s until a camera that is missing is asked for, then twice as long, and so on,
)
CLIENT_ASK_BACK_OFFS: Final = 7  # so many times: each minute at last
CLIENT_MESSAGES_KEPT: Final = (
    64  # messages that wait for a reader who is busy: more than a second of one drone's tracks
)
CLIENT_PATIENCE_S: Final = 10.0
QUIET_KINDS: Final = (Kind.CAMERA, Kind.TRACKS, Kind.HEALTH, Kind.STRANGER)


class TeamReader:
    """Iterators over a team's messages, wherever those come from."""

    def __init__(self, heard: HeardTeam) -> None:
        self._heard = heard
        self._changed = asyncio.Event()
        """Set when a reader comes, has read everything, or leaves."""
        self._sights = Outlets[Sight](self._changed)
        self._healths = Outlets[DroneHealth](self._changed)
        self._strangers = Outlets[Stranger](self._changed)

    @property
    def drones(self) -> tuple[int, ...]:
        """IDs of all live drones, in order."""
        return self._heard.drones

    @property
    def counters(self) -> Counter[str]:
        """Rejected messages, by reason; `dropped`: those that came faster than they were read."""
        return self._heard.counters + Counter(dropped=sum(one.dropped for one in self._outlets))

    def camera(self, drone_id: int) -> DroneCamera | None:
        """A drone's lens and mounting; None while it is unknown, or while two processes use this ID."""
        return self._heard.camera(drone_id)

    def tracks(
        self,
        drone_id: int | None = None,
        *,
        keep: int = CLIENT_MESSAGES_KEPT,
        patience_s: float | None = CLIENT_PATIENCE_S,
    ) -> AsyncIterator[Sight]:
        """Tracks of a drone, 50 times per second by default; drone_id None: of all drones.

        keep: size of the queue while the reader is busy, the oldest are dropped; 1 for a controller that wants the
        newest only. patience_s: raises TransportError with what to check if nothing arrives from the drone within this
        time; None: waits. Ends when the swarm is left.
        """
        return self._read(self._sights, drone_id, keep, patience_s)

    def health(
        self,
        drone_id: int | None = None,
        *,
        keep: int = CLIENT_MESSAGES_KEPT,
        patience_s: float | None = CLIENT_PATIENCE_S,
    ) -> AsyncIterator[DroneHealth]:
        """Health of a drone's agent, once per second; arguments as in `tracks`."""
        return self._read(self._healths, drone_id, keep, patience_s)

    def strangers(
        self,
        drone_id: int | None = None,
        *,
        keep: int = CLIENT_MESSAGES_KEPT,
        patience_s: float | None = None,
    ) -> AsyncIterator[Stranger]:
        """Strangers as the drones that see them locate them, 2.5 times per second and drone, while one is in view;
        arguments as in `tracks`, but it waits, because usually there is none."""
        return self._read(self._strangers, drone_id, keep, patience_s)

    @property
    def _outlets(self) -> tuple[Outlets[Sight], Outlets[DroneHealth], Outlets[Stranger]]:
        return self._sights, self._healths, self._strangers

    async def _read(
        self, outlets: Outlets[T], drone_id: int | None, keep: int, patience_s: float | None
    ) -> AsyncIterator[T]:
        if keep < 1:
            raise ValueError(f"keep: found {keep}, expected 1 or more")
        outlet = outlets.open(drone_id, keep)
        try:
            try:
                async with asyncio.timeout(patience_s):
                    first = await outlet.get()
            except TimeoutError:
                raise TransportError(await self._silence(drone_id, patience_s)) from None
            while first is not None:
                yield first
                first = await outlet.get()
        finally:
            outlets.remove(outlet)

    def _on_sample(self, sample: Sample) -> None:
        address = keys.parse(sample.key)
        if address is None:
            return
        match address.kind:
            case Kind.ALIVE:
                self._heard.on_token(sample.key, sample.alive, sample.arrived)
            case Kind.CAMERA:
                self._heard.on_camera(sample)
            case Kind.TRACKS if self._sights.wanted(address.drone_id):
                self._sights.put(address.drone_id, self._heard.on_tracks(sample))
            case Kind.HEALTH if self._healths.wanted(address.drone_id):
                self._healths.put(address.drone_id, self._heard.on_health(sample))
            case Kind.STRANGER if self._strangers.wanted(address.drone_id):
                for stranger in self._heard.on_strangers(sample):
                    self._strangers.put(address.drone_id, stranger)

    async def _silence(self, drone_id: int | None, patience_s: float | None) -> str:
        """Why nothing is heard."""
        raise NotImplementedError


class Swarm(TeamReader):
    """Receives a team's messages without being a member. It costs the drones one more subscriber, and stays
    unnoticed.

        async with Swarm(team="red") as swarm:
            async for sight in swarm.tracks(1):
                ...

    team: its name; None: as the keys or the file say, else "swarm". config: the team's file, for its `[network]`.
    connect: where agents listen ("10.0.0.1:7447"), if not on this machine. keys: the folder of a monitor, which
    `swarmtrack keys issue` made. insecure: beyond this machine without keys. axes: "ned" (world NED, body FRD) or "enu"
    (world ENU, body FLU).

    Raises ConfigError, KeysError or TransportError where these contradict each other, TransportError on entering where
    no router answers. Only one event loop may use it.
    """

    def __init__(
        self,
        team: str | None = None,
        *,
        config: str | Path | None = None,
        connect: Sequence[str] = (),
        keys: str | Path | None = None,
        insecure: bool = False,
        axes: str | Axes = Axes.NED,
    ) -> None:
        self._network = network_of_listener(
            team=team,
            config=None if config is None else Path(config),
            connect=connect,
            keys=None if keys is None else Path(keys),
            insecure=insecure,
        )
        clock = SystemClock()
        super().__init__(HeardTeam(self._network.team, Axes(axes), clock))
        self._listener = ZenohListener(self._network, _expressions(self._network.team), clock)
        self._tasks: list[asyncio.Task[None]] = []

    async def __aenter__(self) -> Self:
        await self._listener.open()
        self._tasks = [
            asyncio.create_task(self._hear(), name="hear"),
            asyncio.create_task(ask_for_cameras(self._heard, self._listener), name="cameras"),
        ]
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for task in self._tasks:
            task.cancel()
        for task in self._tasks:
            with contextlib.suppress(asyncio.CancelledError):
                await task
        await self._listener.close()

    @property
    def counters(self) -> Counter[str]:
        """Rejected messages, by reason; `dropped`: those that came faster than they were read."""
        return super().counters + Counter(dropped=self._listener.dropped)

    async def _hear(self) -> None:
        try:
            async for sample in self._listener.samples():
                self._on_sample(sample)
        finally:
            for outlets in self._outlets:
                outlets.close()

    async def _silence(self, drone_id: int | None, patience_s: float | None) -> str:
        """Why nothing is heard, as far as one can tell."""
        team, here = self._network.team, self.drones
        who = "no drone" if drone_id is None else f"drone {drone_id}"
        said = f"{who} of team {team!r} was {'' if drone_id is None else 'not '}heard within {patience_s:g} s"
        if drone_id in here:
            return f"{said}, though it is alive: has its agent found its camera?"
        if here:
            alive = ", ".join(map(str, here))
            return f"{said}; alive are {alive}"
        others = sorted(await self._listener.teams() - {team})
        if others:
            names = ", ".join(map(repr, others))
            return f"{said}, but drones of {names}: is that the team's name?"
        if self._listener.links().count:
            return f"{said}: something answers there, but no agent of this team; expected team= as in its [network]"
        where = ", ".join(self._network.connect) or "this machine"
        return f"{said}: nothing answers at {where}; does an agent run there, or is connect= missing?"


async def ask_for_cameras(heard: HeardTeam, listener: ZenohListener) -> None:
    """Until cancelled: request each camera that is missing. A request may overtake the links, and what was put before
    them is lost. A drone that does not answer is asked ever more rarely.
    """
    asked: Counter[int] = Counter()
    for turn in itertools.count(1):
        await asyncio.sleep(CLIENT_ASK_PERIOD_S)
        without = heard.without_camera
        asked = Counter({drone_id: asked[drone_id] for drone_id in without})
        for drone_id in without:
            if turn % 2 ** min(asked[drone_id], CLIENT_ASK_BACK_OFFS) == 0:
                asked[drone_id] += 1
                listener.request(Kind.CAMERA, drone_id)


class _Outlet(Generic[T]):
    """What waits for one reader."""

    def __init__(self, drone_id: int | None, keep: int, changed: asyncio.Event) -> None:
        self.drone_id = drone_id
        self._changed = changed
        self.waiting: deque[T] = deque(maxlen=keep)
        self.news = asyncio.Event()
        self.closed = False

    async def get(self) -> T | None:
        """The next item; None after the end."""
        while not self.waiting:
            if self.closed:
                return None
            self.news.clear()
            self._changed.set()
            await self.news.wait()
        return self.waiting.popleft()


class Outlets(Generic[T]):
    """All readers of one kind of message; the oldest message goes where a reader is too slow."""

    def __init__(self, changed: asyncio.Event) -> None:
        self._all: list[_Outlet[T]] = []
        self._changed = changed
        self._closed = False
        self.dropped = 0

    def open(self, drone_id: int | None, keep: int) -> _Outlet[T]:
        self._all.append(_Outlet[T](drone_id, keep, self._changed))
        self._all[-1].closed = self._closed
        self._changed.set()
        return self._all[-1]

    def remove(self, outlet: _Outlet[T]) -> None:
        self._all.remove(outlet)
        self._changed.set()

    def wanted(self, drone_id: int) -> bool:
        return any(outlet.drone_id in (None, drone_id) for outlet in self._all)

    def put(self, drone_id: int, what: T | None) -> None:
        if what is None:
            return
        for outlet in self._all:
            if outlet.drone_id in (None, drone_id):
                self.dropped += len(outlet.waiting) == outlet.waiting.maxlen
                outlet.waiting.append(what)
                outlet.news.set()

    @property
    def is_read(self) -> bool:
        """Whether every reader waits for the next."""
        return not any(outlet.waiting or outlet.news.is_set() for outlet in self._all)

    @property
    def has_readers(self) -> bool:
        return bool(self._all)

    def close(self) -> None:
        self._closed = True
        for outlet in self._all:
            outlet.closed = True
            outlet.news.set()


def _expressions(team: str) -> list[str]:
    return [keys.key(team, Kind.ALIVE, "*", "*"), *(keys.key(team, kind, "*") for kind in QUIET_KINDS)]
