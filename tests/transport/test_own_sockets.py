"""Sockets of a session that does not end are taken from it."""

import socket

import pytest

from swarmtrack.transport.own_sockets import cut_off


def test_a_listener_and_its_links_end_and_their_descriptors_stay_their_owners():
    listener = socket.create_server(("127.0.0.1", 0))
    port = listener.getsockname()[1]
    far = socket.create_connection(("127.0.0.1", port))
    near, _ = listener.accept()
    other = socket.create_server(("127.0.0.1", 0))
    descriptors = [own.fileno() for own in (listener, near, far)]

    assert cut_off({port}) == 3
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port))
    socket.create_server(("127.0.0.1", port)).close()  # it is free
    with pytest.raises(BrokenPipeError):
        near.send(b"anything")
    assert [own.fileno() for own in (listener, near, far)] == descriptors
    socket.create_connection(other.getsockname()).close()
    for own in (listener, near, far, other):
        own.close()


def test_a_datagram_socket_hears_nothing_more():
    own, far = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    own.bind(("127.0.0.1", 0))
    place = own.getsockname()
    assert cut_off({place[1]}) == 1
    own.setblocking(False)
    far.sendto(b"anything", place)
    with pytest.raises(BlockingIOError):
        own.recv(100)
    own.close()
    far.close()
