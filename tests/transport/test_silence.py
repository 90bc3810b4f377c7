"""Who lives and says nothing, and sockets that do not linger."""

from __future__ import annotations

import os
import socket
import struct

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


def test_one_that_is_deaf_behind_a_link_that_stands_has_the_links_made_anew_though_others_are_heard() -> None:
    silence = Silence(LEASE_S)
    silence.news([2, 3], 0.0)
    silence.mark_heard(3, 4.0)
    assert silence.to_reopen([2, 3], 4.0) == []
    assert silence.to_reopen([2, 3], 4.1) == [2]


def test_whoever_stays_silent_costs_the_others_their_links_ever_more_rarely() -> None:
    silence = Silence(LEASE_S)
    silence.news([2], 0.0)
    assert silence.to_reopen([2], 5.0) == [2]
    silence.clear()
    silence.news([2], 6.0)
    assert silence.to_reopen([2], 21.9) == []
    assert silence.to_reopen([2], 22.1) == [2]
    silence.clear()
    silence.news([2], 23.0)
    assert silence.to_reopen([2], 86.9) == []
    silence.mark_heard(2, 88.0)
    assert silence.to_reopen([2], 92.1) == [2]


def test_links_are_left_in_peace_for_a_while_after_they_were_made_anew() -> None:
    silence = Silence(LEASE_S)
    silence.news([2], 0.0)
    assert silence.to_reopen([2], 5.0) == [2]
    silence.clear()
    silence.news([2, 3], 6.0)
    silence.mark_heard(2, 17.0)
    assert silence.to_reopen([2, 3], 17.0) == []
    assert silence.to_reopen([2, 3], 5.0 + REOPEN_REST_S) == [3]


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
