"""Who lives and says nothing, and sockets that do not linger."""

from __future__ import annotations

import os
import socket
import struct

from swarmtrack.transport.lingering import stop_lingering
from swarmtrack.transport.silence import Silence

LEASE_S = 2.0


def test_one_who_falls_silent_is_told_of_once_and_when_it_is_heard_again() -> None:
    silence = Silence(LEASE_S)
    silence.heard(2, 0.0)
    silence.heard(3, 0.0)
    silence.heard(3, 3.0)
    assert silence.news([2, 3, 4], 3.0) == []  # 4 never spoke: it may have nothing to say yet
    assert silence.news([2, 3, 4], 3.1) == ["network: drone 2 is linked and has said nothing for 3 s"]
    assert list(silence.silent([2, 3, 4], 3.1)) == [2]
    assert silence.news([2, 3, 4], 4.0) == []
    silence.heard(2, 4.5)
    assert silence.news([2, 3, 4], 4.6) == ["network: drone 2 is heard again"]


def test_who_is_gone_is_not_silent_and_begins_anew_when_it_comes_back() -> None:
    silence = Silence(LEASE_S)
    silence.heard(2, 0.0)
    assert silence.news([], 2.0) == []
    assert silence.news([2], 20.0) == []


def test_only_where_nobody_is_heard_we_are_deaf_and_that_is_said_once_until_somebody_is() -> None:
    silence = Silence(LEASE_S)
    assert not silence.is_deaf([], 100.0)
    silence.heard(2, 0.0)
    silence.heard(3, 0.0)
    assert not silence.is_deaf([2, 3], 9.9)
    silence.heard(3, 9.9)
    assert not silence.is_deaf([2, 3], 15.0)  # the other one has its own reasons
    assert silence.is_deaf([2, 3], 20.0)
    silence.forget()
    assert not silence.is_deaf([2, 3], 40.0)
    silence.heard(2, 41.0)
    assert silence.is_deaf([2], 51.1)
    assert not silence.is_deaf([2], 70.0)


def test_no_socket_of_this_process_lingers_and_none_is_left_open_by_looking() -> None:
    option = struct.Struct("ii")
    with socket.socket() as one, socket.socket(socket.AF_INET6) as two, socket.socket() as other:
        for lingering in (one, two):
            lingering.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, option.pack(1, 10))
        before = len(os.listdir("/proc/self/fd"))
        assert stop_lingering() == 2
        assert stop_lingering() == 0
        assert len(os.listdir("/proc/self/fd")) == before
        for sock in (one, two, other):
            on, _ = option.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, option.size))
            assert not on
