"""Messages that an agent sends by the clock."""

from types import SimpleNamespace

import pytest

from swarmtrack.clock import ManualClock, utc_offset
from swarmtrack.messages import TrackList
from swarmtrack.runtime.publishers import TracksPublisher
from swarmtrack.wire import codec
from swarmtrack.wire.tracks import TracksMessage

WORK_S = 0.005


def test_tracks_are_stamped_as_of_when_they_are_not_later_by_the_work_that_they_are():
    clock, sent = ManualClock(100.0), []

    def tracks(now):
        clock.set(now + WORK_S)
        return TrackList(now, now - 0.03, ())

    publisher = TracksPublisher(
        SimpleNamespace(listener=None, tracks=tracks),
        SimpleNamespace(
            is_narrow=False,
            has_listener=lambda kind: True,
            publish=lambda kind, payload: sent.append(payload) or True,
        ),
        SimpleNamespace(published=SimpleNamespace(tick=lambda: None), drops={}),
        SimpleNamespace(feed=lambda now: None),
        clock=clock,
        wall=clock,
        hz=50.0,
    )
    publisher._publish()
    message = codec.decode(TracksMessage, sent[0])
    assert message.t_utc_s == pytest.approx(100.0 + utc_offset(clock), abs=1e-4)
