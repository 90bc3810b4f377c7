"""When tracks give way: the bucket, the sign that packets wait, and where it is read."""

from __future__ import annotations

import math
import os
import socket
from collections import deque
from collections.abc import Callable

import pytest

from swarmtrack.transport.congestion import Congestion, Sent, Waiting, look_at_links
from swarmtrack.transport.limits import MESSAGE_OVERHEAD_BYTES, PACE_LEAST_HZ, PACE_TRIAL_HZ
from swarmtrack.transport.own_sockets import DESCRIPTORS, own_streams
from swarmtrack.transport.pacing import Pacing

CLEAR = Waiting(0.0, 0)
MESSAGE = 1000 - MESSAGE_OVERHEAD_BYTES
LEAST = PACE_LEAST_HZ * 1000.0


class Radio:
    """A queue in front of `bytes_s`, of which `others` take a share. loss, far: why packets wait besides.

    What is measured is what waited when the packet that was answered last was sent.
    """

    def __init__(
        self, bytes_s: float, others: float = 0.0, *, besides: Callable[[float], float] = lambda t: 0.0
    ):
        self.bytes_s, self.others, self.besides = bytes_s, others, besides
        self.queue, self.most = 0.0, 0.0
        self._delays: deque[float] = deque([0.0, 0.0, 0.0], maxlen=3)

    def carry(self, said: float, seconds: float, now: float) -> Waiting:
        self.queue = min(16384.0, max(0.0, self.queue + said + (self.others - self.bytes_s) * seconds))
        self.most = max(self.most, self.queue / self.bytes_s)
        self._delays.append(self.queue / self.bytes_s)
        return Waiting(self._delays[0] + self.besides(now), 0, 0.02)


def fly(
    pacing: Pacing,
    t: float,
    seconds: float,
    waiting: Waiting | Radio = CLEAR,
    *,
    listeners: int = 1,
) -> int:
    """Fifty messages of a kilobyte each second; how many were said."""
    said = since = 0
    for step in range(round(50 * seconds)):
        now = t + step / 50
        allowed = pacing.allows(MESSAGE, listeners, now, tracks=True)
        said, since = said + allowed, since + allowed
        if step % 10 == 9:
            seen = waiting.carry(1000.0 * since, 0.2, now) if isinstance(waiting, Radio) else waiting
            pacing.adjust(seen, now)
            since = 0
    return said


def test_while_nothing_waits_all_is_said():
    pacing = Pacing()
    assert fly(pacing, 0.0, 10.0) == 500
    assert not pacing.gives_way


@pytest.mark.parametrize("kbyte_s", [12.0, 20.0, 40.0])
def test_on_a_full_radio_tracks_give_way_and_it_is_used_and_once_it_is_wide_again_all_is_said(kbyte_s):
    pacing, radio = Pacing(), Radio(1000.0 * kbyte_s, others=4000.0)
    pacing.begin()
    fly(pacing, 0.0, 20.0, radio)
    radio.most = 0.0
    said = fly(pacing, 20.0, 60.0, radio) / 60.0
    assert 0.6 * (kbyte_s - 4.0) < said <= 1.01 * (kbyte_s - 4.0)
    assert radio.most < 1.5  # no keep-alive waits for a lease
    assert pacing.gives_way
    fly(pacing, 80.0, 30.0)
    assert fly(pacing, 110.0, 1.0) == 50
    assert pacing.bytes_s == math.inf


@pytest.mark.parametrize("kbyte_s", [12.0, 20.0])
def test_a_radio_that_was_found_to_be_full_is_not_filled_again(kbyte_s):
    pacing, radio, t = Pacing(), Radio(1000.0 * kbyte_s, others=4000.0), 10.0
    fly(pacing, 0.0, t)
    while not pacing.is_full:
        assert t < 20.0
        fly(pacing, t, 0.2, radio)
        t += 0.2
    radio.most = 0.0
    fly(pacing, t, 20.0, radio)
    assert radio.most < 0.7  # a third of a lease


def spikes(t: float) -> float:
    """Two fifths lost: now and then nothing comes through for a second."""
    return 0.9 if t % 7.0 < 1.0 else 0.0


def jitter(t: float) -> float:
    return 0.4 + 0.3 * math.sin(7.0 * t)


@pytest.mark.parametrize(
    "besides", [spikes, jitter, lambda t: 0.6, lambda t: 0.0 if t < 30.0 else 0.9],
    ids=["loss", "jitter", "a longer way", "a way that becomes longer"],
)  # fmt: skip
def test_where_a_lower_rate_shortens_nothing_it_is_taken_back_and_hardly_tried_again(besides):
    pacing, radio = Pacing(), Radio(1e6, besides=besides)
    said = [fly(pacing, float(t), 1.0, radio) for t in range(300)]
    assert sum(said) / 300.0 > 0.8 * 50.0
    assert min(said) >= PACE_TRIAL_HZ - 1
    assert sum(each < PACE_LEAST_HZ - 1 for each in said) < 30
    assert sum(said[-100:]) / 100.0 > 0.8 * 50.0


def lost(t: float) -> Waiting:
    """Two fifths lost: what is answered is answered at once, and now and then nothing is for a second or two."""
    return Waiting(0.02, 0, 0.01, max(0.0, 1.8 * math.sin(1.3 * t) * math.sin(0.37 * t)))


def test_answers_that_are_lost_show_no_queue_whatever_the_rate_is_when_they_come_again():
    pacing, said = Pacing(), []
    for step in range(600):
        said.append(fly(pacing, 0.2 * step, 0.2, lost(0.2 * step)))
        assert not pacing.is_full
    assert sum(said) / 120.0 > 0.8 * 50.0


def test_where_losses_end_links_their_ends_do_not_lower_the_rate():
    pacing = Pacing()
    fly(pacing, 0.0, 10.0, Waiting(0.02, 0, 0.01, 0.6))
    fly(pacing, 10.0, 4.0)
    pacing.begin()
    assert fly(pacing, 14.0, 1.0) > 40


def test_a_radio_so_full_that_no_answer_comes_at_all_is_full():
    pacing = Pacing()
    fly(pacing, 0.0, 5.0)
    fly(pacing, 5.0, 5.0, Waiting(0.0, 0, 0.01, 3.0))
    assert pacing.is_full


def test_a_stream_that_sends_nothing_any_more_is_no_full_radio():
    pacing, stuck = Pacing(), Waiting(0.0, 100_000)
    said = [fly(pacing, float(t), 1.0, stuck) for t in range(120)]
    assert sum(said) / 120.0 > 0.75 * 50.0
    assert not pacing.gives_way


def test_a_radio_that_fills_after_a_vain_trial_is_noticed_though_the_next_is_not_due():
    pacing = Pacing()
    fly(pacing, 0.0, 10.0, Waiting(0.4, 0))
    assert not pacing.is_full
    radio = Radio(12_000.0, others=4000.0, besides=lambda t: 0.1)
    fly(pacing, 10.0, 8.0, radio)
    assert pacing.is_full


def test_nobody_is_denied_some_tracks_per_second_however_long_packets_wait():
    pacing, radio = Pacing(), Radio(4000.0, others=3900.0)
    fly(pacing, 0.0, 20.0, radio)
    said = [fly(pacing, 20.0 + t, 2.0, radio) / 2.0 for t in range(0, 60, 2)]
    assert min(said) >= PACE_LEAST_HZ - 0.5


def test_where_links_come_or_go_it_begins_low_and_is_soon_as_fast_as_it_was_without_a_word():
    pacing = Pacing()
    fly(pacing, 0.0, 5.0)
    pacing.begin()
    assert pacing.bytes_s == LEAST
    assert pacing.is_limited
    assert 1 <= fly(pacing, 5.0, 1.0) < 25
    assert not pacing.gives_way
    fly(pacing, 6.0, 4.0)
    assert fly(pacing, 10.0, 1.0) == 50
    assert not pacing.is_limited


@pytest.mark.parametrize(("listeners", "said"), [(1, 100), (2, 50), (4, 25)])
def test_a_budget_is_for_all_listeners_together(listeners, said):
    pacing = Pacing(budget_bytes_s=10_000.0)
    assert fly(pacing, 0.0, 10.0, listeners=listeners) == pytest.approx(said, abs=5)
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
    assert tracks == pytest.approx(50, abs=4)
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
    # The shorter of two in a row.
    assert seen == pytest.approx([0.0, 0.0, 0.0, 0.0, 0.0, 0.99, 0.99, 0.0], abs=1e-6)


def test_one_bad_link_is_no_full_radio_and_a_good_cable_does_not_hide_one():
    congestion = Congestion()
    radio = {str(i): link("radio", rtt=1.01 if i == 0 else 0.01) for i in range(3)}
    assert congestion.measure(radio).delay_s == 0.0
    cable = {f"cable {i}": link("cable", rtt=0.01) for i in range(5)}
    slow = {f"slow {i}": link("radio", rtt=1.01) for i in range(2)}
    assert Congestion().measure(cable | slow).delay_s == pytest.approx(1.0)
    lossy = {str(i): link("radio", rtt=0.01, unanswered=1.5 if i else 0.0) for i in range(3)}
    assert Congestion().measure(lossy) == CLEAR._replace(round_trip_s=0.01)
    one_stands = {str(i): link("radio", rtt=0.01, unsent=0 if i else 100_000) for i in range(3)}
    assert not Congestion().measure(one_stands).is_late
    assert congestion.measure({}) == CLEAR


def test_an_answer_that_does_not_come_is_late_and_bytes_that_wait_are_told():
    due = Congestion().measure({"peer": link("radio", rtt=0.01, unanswered=1.5)})
    assert (due.delay_s, due.silent_s) == (0.0, pytest.approx(1.0))
    assert due.is_late
    assert not due.is_queue
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
