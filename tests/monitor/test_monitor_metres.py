"""Where observers see their teammates, in metres, as the page gets it."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest

pytest.importorskip("zenoh", reason="Zenoh has no wheel here")

from support.golden_bytes import STRANGERS_BYTES
from support.seen_swarm import LENS, UTC, seen, teammate
from swarmtrack.clock import ManualClock
from swarmtrack.monitor.metres import MAPPED, metres
from swarmtrack.monitor.overlay import boxes
from swarmtrack.monitor.team import STRANGERS_SHOWN_S, VIEW_S, MonitoredTeam
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind, Sample
from swarmtrack.wire import codec
from swarmtrack.wire.checks import upper_triangle
from swarmtrack.wire.lens import lens_message
from swarmtrack.wire.strangers import StrangersMessage
from swarmtrack.wire.video import VideoMessage


def test_a_teammate_has_its_distance_its_place_and_how_fast_it_comes():
    """8 m north, 6 m east, 1 m up, with 0.2, 0.3 and 0.1 m of uncertainty; it flies 0.5 m/s north and rises."""
    (one,) = metres(seen())
    distance = math.sqrt(101.0)
    assert (one.called, one.north_m, one.east_m) == (2, 8.0, 6.0)
    assert one.distance_m == pytest.approx(distance, abs=0.005)
    assert one.sigma_m == pytest.approx(math.sqrt(64 * 0.04 + 36 * 0.09 + 0.01) / distance, abs=0.005)
    assert one.closing_m_s == pytest.approx(-(4.0 + 0.25) / distance, abs=0.005)
    assert (one.long_m, one.short_m, one.bearing) == pytest.approx((0.9, 0.6, math.pi / 2), abs=0.005)


@pytest.mark.parametrize("position", [(0.0, 0.0, 0.0), (1e-200, 0.0, 0.0), (1e7, -1e7, 1e7)])
@pytest.mark.parametrize("scale", [0.0, 1e15])
def test_whatever_a_liar_says_is_numbers_that_the_page_can_be_sent(position, scale):
    message = seen()
    cov = tuple(scale * float(x) for x in upper_triangle(np.eye(6)))
    lie = msgspec.structs.replace(
        message.relatives[0], position_m=position, velocity_m_s=(1e3, -1e3, 1e3), cov=cov
    )
    heard = Heard(1)
    heard.say(Kind.TRACKS, 1, codec.encode(msgspec.structs.replace(message, relatives=(lie,))))
    json.dumps(heard.team.state(), allow_nan=False)
    assert len(heard.metres()) == (position[0] > 1.0)


def test_without_a_place_there_are_no_metres():
    assert metres(None) == []


def view() -> VideoMessage:
    return VideoMessage(1, UTC, 0.05, 1, 320, 240, b"", lens_message(LENS), None, None)


def test_a_box_says_how_far_its_teammate_is_and_a_stranger_says_nothing():
    """The stranger's track is tentative: it has no box at all."""
    (box,) = boxes(view(), seen())
    assert (box["identity"], box["distance_m"]) == (2, pytest.approx(math.sqrt(101.0), abs=0.005))


def test_the_picture_of_the_first_camera_has_no_boxes_of_what_another_sees_but_metres_are_of_all():
    behind = teammate()
    behind = replace(behind, track=behind.track._replace(camera=1))
    assert boxes(view(), seen(1, behind)) == []
    assert metres(seen(1, behind)) == metres(seen(1, teammate())) != []


class Heard:
    """A monitored team that hears drones 1 … n, with what each is told to say."""

    def __init__(self, n: int) -> None:
        self.clock = ManualClock(100.0, UTC)
        self.team = MonitoredTeam("red", self.clock)
        for drone in range(1, n + 1):
            self.say(Kind.ALIVE, drone, b"", f"{drone:08x}")

    def say(self, kind: Kind, drone: int, payload: bytes, *rest: str) -> None:
        self.team.on_sample(Sample(keys.key("red", kind, drone, *rest), payload, True, self.clock.now()))

    def metres(self, drone: int = 1) -> list:
        return next(d["metres"] for d in self.team.state()["drones"] if d["id"] == drone)


def test_metres_are_told_though_nobody_looks_at_the_pictures_and_end_with_the_tracks():
    heard = Heard(2)
    heard.say(Kind.TRACKS, 1, codec.encode(seen()))
    assert [one.called for one in heard.metres()] == [2]
    assert heard.metres(2) == []
    heard.clock.set(100.0 + VIEW_S + 0.1)
    assert heard.metres() == []


def test_of_a_large_team_only_those_who_are_watched_tell_metres():
    heard = Heard(MAPPED + 1)
    heard.say(Kind.TRACKS, 1, codec.encode(seen()))
    heard.say(Kind.VIDEO, 2, codec.encode(view()))
    heard.say(Kind.TRACKS, 2, codec.encode(seen()))
    assert heard.metres(1) == []
    assert [one.called for one in heard.metres(2)] == [2]


def test_tracks_that_cannot_be_read_are_counted_once():
    heard = Heard(1)
    heard.say(Kind.TRACKS, 1, b"\xc1")
    assert heard.metres() == []
    assert heard.metres() == []
    assert heard.team.unreadable == 1


STRANGERS = bytes.fromhex(STRANGERS_BYTES)


def test_a_stranger_is_on_the_map_as_long_as_it_is_reported():
    heard = Heard(7)
    heard.say(Kind.STRANGER, 7, STRANGERS)
    (one,) = heard.team.state()["strangers"]
    assert (one.number, one.north_m, one.east_m, one.down_m) == (701, 8.0, -1.5, -7.0)
    assert (one.long_m, one.short_m) == (1.5, 1.5)
    assert (one.observers, one.remote_id) == (2, "UAS-1")
    heard.clock.set(100.0 + STRANGERS_SHOWN_S + 0.1)
    assert heard.team.state()["strangers"] == []


def test_of_several_that_see_a_stranger_the_one_that_knows_it_best_is_shown():
    heard = Heard(7)
    message = codec.decode(StrangersMessage, STRANGERS)
    vague = msgspec.structs.replace(message.located[0], cov=tuple(9.0 * c for c in message.located[0].cov))
    other = msgspec.structs.replace(message, drone_id=3, boot="00000003", located=(vague,))
    heard.say(Kind.STRANGER, 3, codec.encode(other))
    heard.say(Kind.STRANGER, 7, STRANGERS)
    assert [one.long_m for one in heard.team.state()["strangers"]] == [1.5]


def test_strangers_in_anothers_name_are_not_shown():
    heard = Heard(7)
    heard.say(Kind.STRANGER, 3, STRANGERS)
    assert heard.team.state()["strangers"] == []
