"""A recorded flight through the interface of `Swarm`."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

from swarmtrack.client.axes import Axes
from swarmtrack.client.heard import HeardTeam
from swarmtrack.client.sight import DroneHealth, Sight
from swarmtrack.client.swarm import TeamReader
from swarmtrack.clock import ManualClock
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind, Sample

if TYPE_CHECKING:
    from swarmtrack.monitor.timeline import Timeline
    from swarmtrack.recording.reader import Recording


PROGRESS_EVERY_S = 60.0  # s of flight


class RecordedSwarm(TeamReader):
    """Plays once, from the moment that the first reader waits, as fast as the slowest reader reads; nothing is dropped.
    Iterated without `async`, it yields every `Sight` and `DroneHealth` in time order.
    """

    def __init__(self, paths: tuple[Path, ...], axes: Axes) -> None:
        self._paths, self._axes = paths, axes
        self._timeline, self._recordings = heard_timeline(paths)
        super().__init__(self._new_team())
        self._task: asyncio.Task[None] | None = None

    @property
    def notes(self) -> list[str]:
        """What is wrong with the recording, a sentence each."""
        return self._timeline.notes

    def __iter__(self) -> Iterator[Sight | DroneHealth]:
        self._heard = self._new_team()
        for sample in self._samples():
            address = keys.parse(sample.key)
            item: Sight | DroneHealth | None = None
            if address is not None and address.kind is Kind.TRACKS:
                item = self._heard.on_tracks(sample)
            elif address is not None and address.kind is Kind.HEALTH:
                item = self._heard.on_health(sample)
            else:
                self._on_sample(sample)
            if item is not None:
                yield item

    async def __aenter__(self) -> Self:
        self._heard = self._new_team()
        self._task = asyncio.create_task(self._play(), name="play")
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._task is not None:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task

    async def _play(self) -> None:
        try:
            await self._until_read()
            await asyncio.sleep(0.0)  # so that tasks that were started together all read from the beginning
            for sample in self._samples():
                self._on_sample(sample)
                await self._until_read()
        finally:
            for outlets in self._outlets:
                outlets.close()

    async def _until_read(self) -> None:
        """Until there are readers, and all of them wait."""
        every = self._outlets
        while not (any(each.has_readers for each in every) and all(each.is_read for each in every)):
            self._changed.clear()
            await self._changed.wait()

    def _samples(self) -> Iterator[Sample]:
        return with_cameras(self._timeline, self._recordings)

    def _new_team(self) -> HeardTeam:
        # Samples are stamped in UTC, so both clocks are one.
        return HeardTeam(self._timeline.team, self._axes, ManualClock(0.0, 0.0))

    async def _silence(self, drone_id: int | None, patience_s: float | None) -> str:
        where = ", ".join(map(str, self._paths))
        return f"{where}: not read on within {patience_s:g} s: does another reader of this recording wait?"


def recorded(*paths: str | Path, axes: str | Axes = Axes.NED) -> RecordedSwarm:
    """A recording as a team to read, with the same iterators and objects as `Swarm`.

        async with recorded("flight") as swarm:
            async for sight in swarm.tracks(1):
                ...

    paths: files or folders, as `sim --record`, `swarmtrack record` and agents write them. What was heard of a team
    comes first; without it, tracks are those of each image. Raises RecordingError.
    """
    return RecordedSwarm(tuple(map(Path, paths)), Axes(axes))


def heard_timeline(paths: tuple[Path, ...]) -> tuple[Timeline, list[Recording]]:
    """What was heard of a team, else what its drones recorded; and all recordings. Raises RecordingError."""
    from swarmtrack.monitor.recorded import read_timeline
    from swarmtrack.recording.reader import recordings_below

    recordings = recordings_below(*paths)
    heard = [one.folder for one in recordings if one.kind == "swarm"]
    return read_timeline(heard or paths), recordings


def with_progress(
    samples: Iterator[Sample], timeline: Timeline, progress: Callable[[str], None]
) -> Iterator[Sample]:
    """The same samples; a line for each minute of the flight."""
    due = PROGRESS_EVERY_S
    for sample in samples:
        if sample.arrived - timeline.begin >= due:
            progress(f"{due:.0f} of {timeline.seconds:.0f} s")
            due += PROGRESS_EVERY_S
        yield sample


def with_cameras(
    timeline: Timeline, recordings: list[Recording], *, pictures: bool = False
) -> Iterator[Sample]:
    """Samples of a timeline, and after the token of a drone that recorded itself its cameras."""
    from swarmtrack.recording.settings import read_settings
    from swarmtrack.wire import codec
    from swarmtrack.wire.camera import camera_message

    cameras: dict[tuple[int, str], bytes] = {}
    for one in recordings:
        if one.kind == "drone":
            mounted, boot = read_settings(one)[0].cameras, one.preface["boot"]
            lenses, mountings = [each.camera for each in mounted], [each.body_from_camera for each in mounted]
            said = camera_message(one.drone_id, boot, lenses, mountings)
            cameras[one.drone_id, boot] = codec.encode(said)
    for sample in timeline.samples(pictures=pictures):
        yield sample
        address = keys.parse(sample.key)
        if address is None or address.kind is not Kind.ALIVE or not sample.alive:
            continue
        camera = cameras.get((address.drone_id, address.rest[0])) if address.rest else None
        if camera is not None:
            key = keys.key(timeline.team, Kind.CAMERA, address.drone_id)
            yield Sample(key, camera, True, sample.arrived)
