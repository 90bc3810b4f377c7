"""Ranges measured by a ranging radio on board, sent to the drone's own agent."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from swarmtrack.clock import SystemClock, utc_offset
from swarmtrack.messages import RangeReport
from swarmtrack.transport import keys as wire_keys
from swarmtrack.transport.base import Kind
from swarmtrack.transport.listening import network_of_companion
from swarmtrack.transport.zenoh_speaker import ZenohSpeaker
from swarmtrack.wire import codec
from swarmtrack.wire.ranging import range_message

OLDEST_S: Final = 1.0
# s: of a driver that stamps what it reads, on the agent's own computer.
STAMP_SIGMA_S: Final = 0.005


class Ranging:
    """Tells drone `drone_id` how far its ranging radio finds teammates to be.

        async with Ranging(1, team="red") as ranging:
            await ranging.say(2, distance_m=8.42, sigma_m=0.1)

    drone_id: the drone that carries the radio. team, config, connect, insecure: as of `Swarm`; connect: where the
    agent of this drone listens, if not on this machine. keys: the folder of the drone itself (`drone-1`), because no
    other name may publish for it.

    Raises ConfigError, KeysError or TransportError where these contradict each other, TransportError on entering where
    no router answers. Only one event loop may use it.
    """

    def __init__(
        self,
        drone_id: int,
        team: str | None = None,
        *,
        config: str | Path | None = None,
        connect: Sequence[str] = (),
        keys: str | Path | None = None,
        insecure: bool = False,
    ) -> None:
        network = network_of_companion(
            drone_id,
            team=team,
            config=None if config is None else Path(config),
            connect=connect,
            keys=None if keys is None else Path(keys),
            insecure=insecure,
        )
        self._drone_id = drone_id
        self._boot = wire_keys.new_boot()
        self._clock = SystemClock()
        self._speaker = ZenohSpeaker(network, Kind.RANGE, drone_id, self._clock)
        self._said: dict[int, int] = {}

    async def __aenter__(self) -> Self:
        await self._speaker.open()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._speaker.close()

    @property
    def linked(self) -> bool:
        """Whether the agent is linked."""
        return self._speaker.links().count > 0

    @property
    def unsent(self) -> int:
        """Number of messages that the link did not take."""
        return self._speaker.unsent

    async def say(
        self,
        other: int,
        distance_m: float,
        sigma_m: float,
        *,
        age_s: float = 0.0,
        t_sigma_s: float = STAMP_SIGMA_S,
    ) -> None:
        """A distance to drone `other`, and its standard deviation, as the radio has them.

        age_s: how long ago it was measured; what is older than a second is of no use and refused. t_sigma_s: how well
        that is known by the agent's clock; more than a few ms where the radio is read on another computer. sigma_m
        should cover how far the antennas are from the camera here and from the middle of the drone there.

        Raises ValueError where no drone would believe it: distances from 0 to 10 km, of another drone.
        """
        if not 0.0 <= age_s <= OLDEST_S:
            raise ValueError(f"age_s: found {age_s}, expected 0 … {OLDEST_S:g} s")
        now = self._clock.now()
        report = RangeReport(self._drone_id, other, now - age_s, t_sigma_s, distance_m, sigma_m)
        sequence = self._said[other] = self._said.get(other, 0) + 1
        offset = utc_offset(self._clock)
        payload = codec.encode(range_message(report, self._boot, sequence, offset, now))
        await self._speaker.prepare(other)
        self._speaker.put(other, payload)
