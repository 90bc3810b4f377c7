"""When tracks give way: the bucket, the sign that packets wait, and where it is read."""

from __future__ import annotations

import math
import os
import socket

import pytest

from swarmtrack.transport.congestion import Congestion, Sent, Waiting, look_at_links
from swarmtrack.transport.limits import (
    MESSAGE_OVERHEAD_BYTES,
    PACE_FIRST_BYTES_PER_S,
    PACE_LEAST_BYTES_PER_S,
    PACKETS_LATE_S,
    PACKETS_UNSENT_BYTES,
)
from swarmtrack.transport.own_sockets import DESCRIPTORS, own_streams
from swarmtrack.transport.pacing import Pacing

CLEAR, LATE, STUCK = Waiting(0.0, 0), Waiting(2.0 * PACKETS_LATE_S, 0), Waiting(0.0, 2 * PACKETS_UNSENT_BYTES)
MESSAGE = 1000 - MESSAGE_OVERHEAD_BYTES


def fly(pacing: Pacing, t: float, seconds: float, waiting: Waiting = CLEAR, *, listeners: int = 1) -> int:
    """Fifty messages of a kilobyte each second; how many were said."""
    said = 0
    for step in range(round(50 * seconds)):
        now = t + step / 50
        said += pacing.allows(MESSAGE, listeners, now, tracks=True)
        if step % 10 == 9:
            pacing.adjust(waiting, now)
    return said


def test_while_nothing_waits_all_is_said():
    pacing = Pacing()
    assert fly(pacing, 0.0, 10.0) == 500
    assert not pacing.gives_way


@pytest.mark.parametrize("waiting", [LATE, STUCK])
def test_while_packets_wait_less_and_less_is_said_down_to_a_floor_and_then_more_again(waiting):
    pacing = Pacing()
    fly(pacing, 0.0, 5.0)
    fly(pacing, 5.0, 5.0, waiting)
    assert pacing.gives_way
    assert pacing.bytes_s == PACE_LEAST_BYTES_PER_S
    floor = fly(pacing, 10.0, 10.0, waiting)
    assert floor == pytest.approx(10 * PACE_LEAST_BYTES_PER_S / 1000, abs=1)
    assert fly(pacing, 20.0, 5.0) < fly(pacing, 25.0, 5.0) < fly(pacing, 30.0, 5.0)
    fly(pacing, 35.0, 15.0)
    assert fly(pacing, 50.0, 1.0) == 50
    assert pacing.bytes_s == math.inf


def test_where_links_come_or_go_it_begins_low_and_is_soon_as_fast_as_it_was_without_a_word():
    pacing = Pacing()
    fly(pacing, 0.0, 5.0)
    pacing.begin()
    assert pacing.bytes_s == PACE_FIRST_BYTES_PER_S
    assert 1 <= fly(pacing, 5.0, 1.0) < 25
    assert not pacing.gives_way
    fly(pacing, 6.0, 2.0)
    assert fly(pacing, 8.0, 1.0) == 50


@pytest.mark.parametrize(("listeners", "said"), [(1, 100), (2, 50), (4, 25)])
def test_a_budget_is_for_all_listeners_together(listeners, said):
    pacing = Pacing(budget_bytes_s=10_000.0)
    assert fly(pacing, 0.0, 10.0, listeners=listeners) == pytest.approx(said, abs=3)
    assert pacing.gives_way


def test_whoever_is_on_board_costs_no_radio():
    pacing = Pacing(budget_bytes_s=1000.0)
    assert fly(pacing, 0.0, 10.0, listeners=0) == 500


def test_tracks_go_before_pictures_and_a_message_larger_than_the_bucket_is_said_at_last():
    pacing = Pacing(budget_bytes_s=5000.0)
    tracks = pictures = 0
    for step in range(500):
        tracks += pacing.allows(MESSAGE, 1, step / 50, tracks=True)
        pictures += pacing.allows(20_000, 1, step / 50, tracks=False)
    assert tracks == pytest.approx(50, abs=3)
    assert pictures <= 1
    alone = Pacing(budget_bytes_s=5000.0)
    assert sum(alone.allows(20_000, 1, step / 50, tracks=False) for step in range(1000)) == pytest.approx(
        5, abs=1
    )


def link(own: str, *, rtt: float, unanswered: float = 0.0, unsent: int = 0) -> Sent:
    return Sent(own, rtt, 0.01, unanswered, unsent)


def test_of_two_means_the_sample_between_them_is_known_and_one_late_answer_is_no_sign():
    congestion = Congestion()
    mean, seen = 0.01, []
    for sample in (0.01, 0.01, 1.0, 0.01, 1.0, 1.0, 1.0, 0.01):
        mean += (sample - mean) / 8
        seen.append(congestion.measure({"peer": link("radio", rtt=mean)}).delay_s)
    # The shortest of three in a row.
    assert seen == pytest.approx([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.99, 0.0], abs=1e-6)


def test_one_bad_link_is_no_full_radio_and_a_good_cable_does_not_hide_one():
    congestion = Congestion()
    radio = {str(i): link("radio", rtt=1.01 if i == 0 else 0.01) for i in range(3)}
    assert congestion.measure(radio).delay_s == 0.0
    cable = {f"cable {i}": link("cable", rtt=0.01) for i in range(5)}
    slow = {f"slow {i}": link("radio", rtt=1.01) for i in range(2)}
    assert Congestion().measure(cable | slow).delay_s == pytest.approx(1.0)
    assert congestion.measure({}) == CLEAR


def test_an_answer_that_does_not_come_is_late_and_bytes_that_wait_are_told():
    assert Congestion().measure({"peer": link("radio", rtt=0.01, unanswered=1.5)}).delay_s == pytest.approx(
        1.0
    )
    assert Congestion().measure({"peer": link("radio", rtt=0.01, unsent=5)}).unsent == 5


@pytest.mark.skipif(not DESCRIPTORS.exists(), reason="this system lists no descriptors")
def test_the_kernel_is_asked_about_the_links_that_zenoh_names_and_no_descriptor_is_left_open():
    with socket.create_server(("127.0.0.1", 0)) as server:
        here = server.getsockname()
        with socket.create_connection(here) as client, server.accept()[0] as accepted:
            for _ in range(3):
                client.sendall(b"sign of life")
                accepted.sendall(accepted.recv(100))
                client.recv(100)
            before = os.listdir(DESCRIPTORS)
            [found] = look_at_links({f"127.0.0.1:{here[1]}"}).values()
            assert look_at_links({"127.0.0.1:1"}) == {}
            assert {stream.getsockname()[1] for stream in own_streams()} >= {here[1]}
            assert os.listdir(DESCRIPTORS) == before
    assert found.own == "127.0.0.1"
    assert 0.0 < found.min_rtt_s <= found.rtt_s < 1.0
    assert found.unsent == 0
