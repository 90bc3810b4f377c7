"""Telling systemd how we are: readiness, a line of status, the watchdog (sd_notify(3)); silent without systemd."""

from __future__ import annotations

import os
import socket

STUCK_DETECTOR = 10.0  # s on one frame: no longer slow but stuck, and the supervisor should know


class Notifier:
    """Speaks to $NOTIFY_SOCKET when there is one."""

    def __init__(self, address: str | None = None) -> None:
        address = address if address is not None else os.environ.get("NOTIFY_SOCKET", "")
        # A leading @ names a socket in the abstract namespace, whose name begins with a NUL.
        self._address = "\0" + address[1:] if address.startswith("@") else address

    def ready(self) -> None:
        self._send("READY=1")

    def status(self, line: str) -> None:
        self._send(f"STATUS={line}")

    def alive(self) -> None:
        """Feed the watchdog."""
        self._send("WATCHDOG=1")

    def stopping(self) -> None:
        self._send("STOPPING=1")

    def _send(self, text: str) -> None:
        if not self._address:
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as notify:
            try:
                notify.connect(self._address)
                notify.send(text.encode())
            except OSError:
                pass  # a supervisor that has gone away must not stop a flight


class Watchdog:
    """Fed while the agent works: while its loop turns, and its detector comes back from every frame."""

    def __init__(self, supervisor: Notifier) -> None:
        self._supervisor = supervisor
        self._look_began: float | None = None

    def look_began(self, now: float) -> None:
        """The detector has got a frame."""
        self._look_began = now

    def look_ended(self) -> None:
        """It has come back from it."""
        self._look_began = None

    def feed(self, now: float) -> None:
        """Unless the detector is stuck."""
        if self._look_began is None or now - self._look_began < STUCK_DETECTOR:
            self._supervisor.alive()
