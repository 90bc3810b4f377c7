"""What is no news to a planner: repeated, out of order, of another time."""

from __future__ import annotations

import msgspec
import pytest

from support.seen_swarm import seen
from swarmtrack.client.axes import Axes
from swarmtrack.client.freshness import CLOCK_LEARNED_OF, LEARNED_ANEW_AFTER_S, Mark, MessageOrder
from swarmtrack.client.heard import HeardTeam
from swarmtrack.clock import ManualClock
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind, Sample
from swarmtrack.wire import codec

NOW, DAY, YEAR = 1.7e9, 86400.0, 365 * 86400.0
REPEATED, OUT_OF_ORDER, OFF_TIME = ({mark} for mark in Mark)


def flown(
    freshness: MessageOrder, sequences: range, *, off: float = 0.0, hz: float = 50.0
) -> list[set[Mark]]:
    """Marks of messages that come in time, from a drone whose clock is `off` behind ours."""
    return [set(freshness.marks(k, NOW + k / hz - off, NOW + k / hz + 0.01)) for k in sequences]


def test_what_comes_in_order_and_in_time_is_news_though_some_are_lost():
    assert not any(flown(MessageOrder(), range(1, 1000, 3)))


def test_a_repeated_and_an_overtaken_message_are_told_apart():
    freshness = MessageOrder()
    for k in (1, 2, 4):
        assert not freshness.marks(k, NOW, NOW)
    assert freshness.marks(4, NOW, NOW) == REPEATED
    assert freshness.marks(3, NOW, NOW) == OUT_OF_ORDER
    assert freshness.marks(3, NOW, NOW) == REPEATED
    assert not freshness.marks(5, NOW, NOW)


@pytest.mark.parametrize("off", [DAY, -YEAR, 2.5, -2.5])
def test_a_message_of_another_time_is_marked_from_the_first_and_between_others(off: float):
    assert MessageOrder().marks(7, NOW - off, NOW) == OFF_TIME
    freshness = MessageOrder()
    flown(freshness, range(1, 100))
    assert freshness.marks(100, NOW + 2.0 - off, NOW + 2.0) >= OFF_TIME
    assert not any(flown(freshness, range(101, 200)))


def test_a_drone_whose_clock_is_hours_off_is_soon_known_and_another_time_is_seen_by_its_own_clock():
    freshness = MessageOrder()
    marked = flown(freshness, range(1, 200), off=7200.0)
    assert marked[: CLOCK_LEARNED_OF - 1] == [OFF_TIME] * (CLOCK_LEARNED_OF - 1)
    assert not any(marked[CLOCK_LEARNED_OF:])
    assert freshness.marks(200, NOW + 4.0, NOW + 4.0) == OFF_TIME


def test_old_messages_that_are_played_again_beside_new_ones_never_become_news():
    freshness, old = MessageOrder(), iter(range(10_000, 20_000))
    for k in range(1, 1000):
        assert not freshness.marks(20_000 + k, NOW + k / 50, NOW + k / 50)
        assert freshness.marks(next(old), NOW - DAY + k / 50, NOW + k / 50) == {
            Mark.OUT_OF_ORDER,
            Mark.OFF_TIME,
        }


def test_messages_that_waited_in_a_queue_are_off_time_to_the_last_however_the_queue_grew():
    freshness = MessageOrder()
    flown(freshness, range(1, 100))
    grown = [set(freshness.marks(k, NOW + k / 50, NOW + k / 50 + (k - 100) / 40)) for k in range(100, 300)]
    assert grown[100:] == [OFF_TIME] * 100
    assert not any(flown(freshness, range(300, 320)))


def test_what_is_played_again_to_a_silence_is_no_news_and_the_drone_itself_is_when_it_comes_back():
    freshness = MessageOrder()
    flown(freshness, range(1, 100))
    played = [set(freshness.marks(10_000 + k, NOW - DAY + k / 50, NOW + 2 + k / 50)) for k in range(200)]
    assert played == [OFF_TIME] * 200
    assert not any(flown(freshness, range(300, 400)))


def test_a_clock_that_was_set_is_known_at_once_if_forward_and_after_a_minute_or_a_restart_if_back():
    freshness = MessageOrder()
    flown(freshness, range(1, 100), off=7200.0)
    assert not any(flown(freshness, range(100, 200))[CLOCK_LEARNED_OF:])
    back = flown(freshness, range(200, 3500), off=60.0)
    late_s = next(k for k, marks in enumerate(back) if not marks) / 50
    assert LEARNED_ANEW_AFTER_S < late_s < LEARNED_ANEW_AFTER_S + 1.0
    freshness.restart()
    assert not any(flown(freshness, range(3500, 3600), off=7200.0)[CLOCK_LEARNED_OF:])


def test_the_client_hands_over_marked_sights_and_counts_them_and_a_restart_begins_again():
    clock = ManualClock(now=12.5, utc=seen().t_utc_s)
    team = HeardTeam("red", Axes.NED, clock)
    team.on_token(keys.key("red", Kind.ALIVE, 1, "0123abcd"), True, 0.0)

    def sight(sequence: int, late_s: float = 0.0):
        message = msgspec.structs.replace(seen(), sequence=sequence, t_utc_s=seen().t_utc_s - late_s)
        return team.on_tracks(Sample(keys.key("red", Kind.TRACKS, 1), codec.encode(message), True, 12.5))

    sights = [sight(5), sight(6), sight(6), sight(4), sight(7, late_s=DAY), sight(8, late_s=-YEAR)]
    assert [set(each.marks) for each in sights] == [set(), set(), REPEATED, OUT_OF_ORDER, OFF_TIME, OFF_TIME]
    assert [each.is_news for each in sights] == [True, True, False, False, False, False]
    assert all(each.targets for each in sights)
    assert team.counters == {"tracks_repeated": 1, "tracks_out_of_order": 1, "tracks_off_time": 2}
    team.on_token(keys.key("red", Kind.ALIVE, 1, "89abcdef"), True, 0.0)
    assert sight(1).is_news
