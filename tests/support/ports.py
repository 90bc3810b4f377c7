"""Ports that nobody else takes."""

import random
import socket

# Below those that the kernel gives to whoever asks for any.
PORTS = range(20_000, 32_000)


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    """Of this machine: free now, and only another that asks here can take it before it is used."""
    for port in random.SystemRandom().sample(PORTS, len(PORTS)):
        with socket.socket(socket.AF_INET, kind) as found:
            try:
                found.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise OSError("no port is free")
