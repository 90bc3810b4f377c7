"""Who lives and says nothing, and sockets that do not linger."""

from __future__ import annotations

import os
import socket
import struct
from itertools import pairwise

from swarmtrack.transport.limits import REOPEN_REST_S
from swarmtrack.transport.silence import Silence
from swarmtrack.transport.tcp_options import set_options

LEASE_S = 2.0
TCP_THIN_LINEAR_TIMEOUTS = 16  # of linux/tcp.h


def test_who_says_nothing_is_asked_and_after_a_lease_told_of_once_and_when_it_is_heard_again() -> None:
    silence = Silence(LEASE_S)
    assert silence.news([2, 3], 0.0) == []
    silence.mark_heard(3, 1.5)
    assert silence.to_ask([2, 3], 1.6) == [2]
    assert silence.news([2, 3], 2.0) == []
    assert silence.news([2, 3], 2.1) == [
        "network: drone 2 is linked but silent: no reliable message for 2.1 s"
    ]
    assert list(silence.silent([2, 3], 2.1)) == [2]
    assert silence.news([2, 3], 3.0) == []
    silence.mark_heard(2, 3.2)
    assert silence.news([2, 3], 3.3) == ["network: drone 2 is received again"]


def test_who_is_gone_is_not_silent_and_begins_anew_when_it_comes_back() -> None:
    silence = Silence(LEASE_S)
    silence.news([2], 0.0)
    assert silence.news([], 2.0) == []
    assert silence.news([2], 20.0) == []
    assert silence.silent([2], 21.0) == {}


def test_nobody_closes_links_for_one_that_is_linked_and_silent_while_others_are_heard() -> None:
    silence = Silence(LEASE_S)
    silence.news([2, 3], 0.0)
    for second in range(3600):
        silence.mark_heard(3, float(second), report=True)
        assert silence.to_reopen([2, 3], second + 0.5) == []
    assert list(silence.silent([2, 3], 3600.0)) == [2]


def test_a_gap_of_all_others_is_no_reason_to_close_links_for_one_that_is_silent_for_good() -> None:
    silence = Silence(LEASE_S)
    silence.news([2, 3], 0.0)
    for second in range(30):
        silence.mark_heard(3, float(second), report=True)
    assert silence.to_reopen([2, 3], 31.5) == []
    assert silence.to_reopen([2, 3], 34.0) == [2, 3]


def test_where_nobody_is_heard_links_are_made_again_once_in_ten_minutes_and_then_ever_more_rarely() -> None:
    """A word after each renewal does not renew the budget."""
    silence = Silence(LEASE_S)
    renewed = []
    silence.news([2], 0.0)
    for half_second in range(2 * 4000):
        now = 0.5 * half_second
        silence.news([2], now)
        if silence.to_reopen([2], now) == [2]:
            renewed.append(now)
            silence.clear()
            silence.news([2], now)
            silence.mark_heard(2, now)
            silence.to_ask([2], now + 1.3)
    assert renewed == [4.5, 604.5, 1804.5]


def test_where_packets_wait_a_silent_teammate_is_given_four_times_as_long() -> None:
    silence = Silence(LEASE_S)
    silence.news([2], 0.0)
    assert silence.to_reopen([2], 15.5, queued=True) == []
    assert silence.to_reopen([2], 16.5, queued=True) == [2]


def test_links_are_left_in_peace_for_a_while_after_they_were_made_anew() -> None:
    silence = Silence(LEASE_S)
    silence.news([2], 0.0)
    assert silence.to_reopen([2], 5.0) == [2]
    silence.clear()
    silence.news([3], 6.0)
    assert silence.to_reopen([3], 5.0 + REOPEN_REST_S - 0.1) == []
    assert silence.to_reopen([3], 5.0 + REOPEN_REST_S) == [3]


def test_one_that_answers_but_never_speaks_by_itself_is_asked_ever_more_rarely_and_is_not_silent() -> None:
    silence = Silence(LEASE_S)
    silence.news([2], 0.0)
    silence.mark_heard(2, 0.0)
    asked = []
    for half_second in range(2 * 400):
        now = 0.5 * half_second
        if silence.to_ask([2], now):
            asked.append(now)
            silence.mark_answered(2, now)
        assert silence.silent([2], now) == {}
    apart = [later - earlier for earlier, later in pairwise(asked)]
    assert asked[0] <= 5.0
    assert apart[:3] == sorted(apart[:3])
    assert apart[-1] >= 38.0
    silence.mark_heard(2, 400.0, report=True)  # a word of its own: as at the beginning
    assert silence.to_ask([2], 401.5) == [2]


def test_an_answer_that_does_not_come_makes_silent_whoever_owes_no_report_too() -> None:
    silence = Silence(LEASE_S)
    silence.news([2], 0.0)
    silence.mark_heard(2, 0.0)
    assert silence.to_ask([2], 5.0) == [2]
    assert silence.silent([2], 5.5) == {}
    assert list(silence.silent([2], 6.0)) == [2]


def test_a_hundred_that_report_nothing_are_asked_one_at_a_time_and_honest_slow_ones_hardly_ever() -> None:
    silence, everybody = Silence(LEASE_S), list(range(2, 101))
    silence.news(everybody, 0.0)
    for drone in everybody:
        silence.mark_heard(drone, 0.0)
    questions = 0
    for half_second in range(2 * 60):
        for drone in silence.to_ask(everybody, 0.5 * half_second):
            questions += 1
            silence.mark_answered(drone, 0.5 * half_second)
    assert 0 < questions <= 60.0 / 4.8 + 1
    assert silence.silent(everybody, 60.0) == {}
    slow = Silence(LEASE_S)  # whose reports come 1.1 s apart, as a loop that polls sends them
    slow.news(everybody, 0.0)
    for tenth in range(600):
        if tenth % 11 == 0:
            for drone in everybody:
                slow.mark_heard(drone, 0.1 * tenth, report=True)
        assert slow.to_ask(everybody, 0.1 * tenth) == []


def test_we_declare_ourselves_again_to_whoever_is_silent_or_reports_without_knowing_us_and_ever_more_rarely() -> (
    None
):
    silence, all_linked = Silence(LEASE_S), [2, 3, 4, 5]
    silence.news(all_linked, 0.0)
    repeated = []
    for second in range(100):
        silence.news(all_linked, float(second))
        for drone in (3, 4):
            silence.mark_heard(drone, float(second), report=True)
        if second < 10:  # heard until then, and after that its link lost our subscription
            silence.mark_heard(5, float(second), report=True)
        silence.mark_known(3, float(second), known=False)
        silence.mark_known(4, float(second), known=second % 3 == 0)
        repeated += [(drone, second) for drone in silence.to_repeat(all_linked, float(second))]
    assert repeated == [(2, 5), (3, 5), (5, 14), (2, 35), (3, 35), (5, 44), (2, 95), (3, 95)]


def test_where_packets_wait_we_declare_ourselves_again_later() -> None:
    silence = Silence(LEASE_S)
    silence.news([2], 0.0)
    assert silence.to_repeat([2], 15.5, queued=True) == []
    assert silence.to_repeat([2], 16.5, queued=True) == [2]


def test_no_socket_of_this_process_lingers_or_backs_off_and_none_is_left_open_by_looking() -> None:
    option = struct.Struct("ii")
    with socket.socket() as one, socket.socket(socket.AF_INET6) as two:
        for lingering in (one, two):
            lingering.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, option.pack(1, 10))
        before = len(os.listdir("/proc/self/fd"))
        assert set_options() >= 2
        assert set_options() == 0
        assert len(os.listdir("/proc/self/fd")) == before
        for sock in (one, two):
            on, _ = option.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, option.size))
            assert not on
            assert sock.getsockopt(socket.IPPROTO_TCP, TCP_THIN_LINEAR_TIMEOUTS)


def test_who_dials_us_gets_the_options_of_the_socket_that_listens() -> None:
    with socket.create_server(("127.0.0.1", 0)) as door:
        set_options()
        with socket.create_connection(door.getsockname()) as caller, door.accept()[0] as accepted:
            assert accepted.getsockopt(socket.IPPROTO_TCP, TCP_THIN_LINEAR_TIMEOUTS)
            assert not caller.getsockopt(socket.IPPROTO_TCP, TCP_THIN_LINEAR_TIMEOUTS)


def test_segments_fit_into_frames_of_a_thousand_bytes_both_ways_wherever_one_of_ours_listens() -> None:
    with socket.create_server(("127.0.0.1", 0)) as door:
        set_options()
        with socket.create_connection(door.getsockname()) as caller, door.accept()[0] as accepted:
            for end in (caller, accepted):
                assert end.getsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG) + 54 + 20 < 1000
