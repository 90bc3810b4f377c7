"""Who looks next, and at what, where several cameras share one detector."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import numpy as np

from swarmtrack.camera_sources.frame_slot import BadImage, FrameSlot, RawFrame
from swarmtrack.clock import ManualClock
from swarmtrack.messages import Frame, LinkStatus, StampKind
from swarmtrack.runtime.turns import FairTurns, NewestFrames, in_order

IMAGE = np.zeros((8, 8, 3), np.uint8)


def frame(t: float, sequence: int = 0) -> Frame:
    return Frame(t, 0.0, sequence, IMAGE, StampKind.MEDIA)


async def settled() -> None:
    for _ in range(10):
        await asyncio.sleep(0)


async def test_whoever_has_waited_longest_since_its_last_turn_is_next():
    turns, order, release = FairTurns(), [], asyncio.Event()

    async def look(who: int) -> None:
        async with turns.turn(who):
            order.append(who)
            await release.wait()

    # Their last turns, oldest first: 2, 0, 1; 3 never had one.
    release.set()
    for who in (2, 0, 1):
        await look(who)
    order.clear()
    release.clear()
    tasks = [asyncio.create_task(look(who)) for who in (1, 0, 2, 3)]
    await settled()
    assert order == [1]
    release.set()
    await asyncio.gather(*tasks)
    assert order == [1, 3, 2, 0]


async def test_a_camera_that_sends_without_pause_takes_no_more_than_its_share():
    turns, count, enough = FairTurns(), [0, 0, 0], asyncio.Event()

    async def look_for_ever(who: int) -> None:
        while True:
            async with turns.turn(who):
                count[who] += 1
                if sum(count) == 300:
                    enough.set()
                await asyncio.sleep(0)
            # The first one is there again at once; the others come a while later.
            for _ in range(who):
                await asyncio.sleep(0)

    tasks = [asyncio.create_task(look_for_ever(who)) for who in range(3)]
    await asyncio.wait_for(enough.wait(), 30.0)
    for task in tasks:
        task.cancel()
    assert max(count) - min(count) <= 3, count


async def test_who_gives_up_waiting_or_fails_leaves_the_turn_to_the_others():
    turns, release = FairTurns(), asyncio.Event()

    async def look(who: int) -> int:
        async with turns.turn(who):
            await release.wait()
            if who == 0:
                raise ValueError("a bug")
            return who

    first, second, third = (asyncio.create_task(look(who)) for who in range(3))
    await settled()
    second.cancel()
    await settled()
    release.set()
    assert await asyncio.wait_for(third, 5.0) == 2
    assert isinstance(first.exception(), ValueError)
    # One that is cancelled just as its turn has come.
    release.clear()
    holding = asyncio.create_task(look(1))
    await settled()
    waiting = asyncio.create_task(look(2))
    await settled()
    release.set()
    await holding
    waiting.cancel()
    await settled()
    assert await asyncio.wait_for(look(3), 5.0) == 3


async def test_all_may_give_up_at_once_as_at_the_end_of_a_flight_and_the_next_has_its_turn():
    turns = FairTurns()

    async def look(who: int) -> int:
        async with turns.turn(who):
            await asyncio.Event().wait()
        return who

    for _ in range(2):
        tasks = [asyncio.create_task(look(who)) for who in range(4)]
        await settled()
        for task in tasks:
            task.cancel()
        ended = await asyncio.gather(*tasks, return_exceptions=True)
        assert [type(error) for error in ended] == [asyncio.CancelledError] * 4
    async with asyncio.timeout(5.0), turns.turn(2):
        pass


class SlotCamera:
    """A camera as most are: a slot for its newest frame."""

    def __init__(self) -> None:
        self.slot = FrameSlot("camera", ManualClock(), None, resize=False)
        self.decoded: list[int] = []

    def sees(self, sequence: int, *, damaged: bool = False) -> None:
        def decode() -> np.ndarray:
            self.decoded.append(sequence)
            if damaged:
                raise BadImage("half of it")
            return IMAGE

        self.slot.put(RawFrame(0.1 * sequence, 0.0, sequence, StampKind.EXPOSURE, decode))

    def frames(self) -> AsyncIterator[Frame]:
        return self.slot.frames()

    async def arrived(self) -> None:
        await self.slot.arrived()

    def status(self) -> LinkStatus:
        return self.slot.source.status()

    async def close(self) -> None:
        self.slot.end()


async def test_what_is_taken_is_the_newest_when_the_turn_has_come_and_nothing_else_is_decoded():
    camera = SlotCamera()
    frames = NewestFrames(camera)
    camera.sees(1)
    await frames.arrived()
    camera.sees(2)
    camera.sees(3)
    taken = await frames.get()
    assert taken is not None
    assert taken.sequence == 3
    assert camera.decoded == [3]
    await camera.close()
    await frames.arrived()
    assert await frames.get() is None
    assert frames.ended


async def test_a_frame_that_is_none_keeps_the_turn_for_a_moment_only_and_the_next_good_one_is_not_lost(
    monkeypatch,
):
    monkeypatch.setattr("swarmtrack.runtime.turns.LONGEST_DECODE", 0.02)
    camera = SlotCamera()
    frames = NewestFrames(camera)
    camera.sees(1, damaged=True)
    await frames.arrived()
    assert await frames.get() is None
    assert not frames.ended
    waiting = asyncio.create_task(frames.arrived())
    await settled()
    assert not waiting.done()
    camera.sees(2)
    await asyncio.wait_for(waiting, 5.0)
    taken = await frames.get()
    assert taken is not None
    assert taken.sequence == 2
    frames.close()


class Reel:
    """A camera without a slot, which ends."""

    def __init__(self, *times: float) -> None:
        self._times = times

    async def frames(self) -> AsyncIterator[Frame]:
        for sequence, t in enumerate(self._times):
            yield frame(t, sequence)

    def status(self) -> LinkStatus:
        return LinkStatus("camera", True, "a reel")

    async def close(self) -> None:
        pass


async def test_a_camera_that_does_not_announce_its_frames_has_them_taken_all_the_same():
    frames, seen = NewestFrames(Reel(0.0, 0.5)), []
    while not frames.ended:
        await frames.arrived()
        taken = await frames.get()
        seen += [] if taken is None else [taken.t]
    assert seen == [0.0, 0.5]


async def test_recordings_come_in_the_order_of_their_exposures_and_to_the_end_of_the_longest():
    cameras = [Reel(0.0, 0.2, 0.4), Reel(0.1, 0.2), Reel()]
    seen = [(one.t, one.camera, one.sequence) async for one in in_order(cameras)]
    assert seen == [(0.0, 0, 0), (0.1, 1, 0), (0.2, 0, 1), (0.2, 1, 1), (0.4, 0, 2)]
