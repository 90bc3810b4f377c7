"""A slot keeps the newest, and its source's status tells what became of the rest: in simulated time."""

from __future__ import annotations

import logging

import pytest

from swarmtrack.camera_sources.newest_slot import NewestSlot
from swarmtrack.camera_sources.source_status import SourceStatus
from swarmtrack.clock import ManualClock


async def test_what_nobody_took_gives_way_once_to_the_newest_and_is_counted():
    gone: list[int] = []
    slot = NewestSlot[int]("camera", ManualClock(), gone.append)
    for item in (1, 2, 3):
        slot.put(item)
    assert await slot.get() == 3
    slot.put(4)
    slot.clear()
    slot.end()
    slot.put(5)
    assert await slot.get() is None
    assert gone == [1, 2, 4, 5]
    assert slot.source.counts.dropped == 2


async def test_the_consumer_gets_what_waits_and_then_the_error_that_ended_it():
    slot = NewestSlot[int]("camera", ManualClock())
    slot.put(1)
    slot.end(OSError("unplugged"))
    assert await slot.get() == 1
    with pytest.raises(OSError, match="unplugged"):
        await slot.get()


def at(clock: ManualClock, begin: float, hz: float, seconds: float, source: SourceStatus) -> None:
    """Frames come at an even rate, 40 ms old, and every second one is of use."""
    for k in range(1, round(hz * seconds) + 1):
        clock.set(begin + k / hz)
        source.came()
        if k % 2 == 0:
            source.given(clock.now() - 0.04, 1e-3)


def test_rates_are_of_the_last_two_seconds():
    clock = ManualClock(100.0)
    source = SourceStatus("camera", clock)
    source.report(True, "streaming")
    at(clock, 100.0, 30.0, 1.0, source)  # before two seconds have passed: over the time since the first
    assert dict(source.status().counters)["fps"] == pytest.approx(30.0)
    at(clock, 101.0, 10.0, 3.0, source)
    numbers = dict(source.status().counters)
    assert (numbers["fps"], numbers["used_fps"]) == (
        pytest.approx(10.0, abs=0.5),
        pytest.approx(5.0, abs=0.5),
    )
    assert numbers["frames"] == 30
    assert numbers["age_p50_ms"] == pytest.approx(40.0)
    assert source.status().text == "streaming; 10.0 fps, age 40 ms"
    clock.set(110.0)
    assert dict(source.status().counters)["fps"] == 0.0


def test_a_line_is_logged_when_it_changes_and_trouble_lasts_until_a_frame_is_of_use(caplog):
    caplog.set_level(logging.INFO)
    source = SourceStatus("front", ManualClock())
    for _ in range(3):
        source.report(True, "open")
        source.refuse("wrong size")
    assert caplog.messages == ["camera front: open", "camera front: wrong size"]
    assert (source.status().ok, source.status().text) == (False, "wrong size")
    source.given(0.0, 1e-3)
    assert source.status().ok
