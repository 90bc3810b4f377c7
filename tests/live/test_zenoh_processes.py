"""Real processes on loopback: they meet, they notice a death, a restart and a clone.

The times are printed, not asserted (`pytest -s tests/live/test_zenoh_processes.py` shows them); the claims behind them
are that an announcement is known within 1 s of the second start, and a kill -9 within 3 s.

This file is also the program of the processes it starts: `python test_zenoh_processes.py TEAM ID`.
"""

from __future__ import annotations

import asyncio
import json
import os
import queue
import secrets
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from support.patience import PATIENCE
from support.places import PYTHONPATH

pytest.importorskip("zenoh", reason="Zenoh has no wheel here")


class Process:
    """One drone's process and what it said: dicts of event, drone_id, boot(s), t (CLOCK_MONOTONIC, all share it)."""

    def __init__(self, team: str, drone_id: int) -> None:
        self.drone_id = drone_id
        self.started = time.monotonic()
        self.popen = subprocess.Popen(
            [sys.executable, __file__, team, str(drone_id)],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": PYTHONPATH},
        )
        self.said: list[dict[str, Any]] = []
        self._lines: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()
        self.boot = self.until(lambda e: e["event"] == "open")["boot"]

    def _read(self) -> None:
        assert self.popen.stdout is not None
        for line in self.popen.stdout:
            self._lines.put(line)

    def until(self, wanted: Callable[[dict[str, Any]], bool], since: float = 0.0) -> dict[str, Any]:
        """The first wanted event at or after `since`, waiting for it."""
        deadline = time.monotonic() + PATIENCE
        seen = 0
        while True:
            for event in self.said[seen:]:
                if event["t"] >= since and wanted(event):
                    return event
            seen = len(self.said)
            try:
                self.said.append(json.loads(self._lines.get(timeout=max(0.0, deadline - time.monotonic()))))
            except queue.Empty:
                raise AssertionError(f"drone {self.drone_id} said only {self.said}") from None

    def knows(self, other: Process, since: float = 0.0) -> float:
        """When this one knew the other's announcement."""
        known = self.until(lambda e: e["event"] == "Announcement" and e["boot"] == other.boot, since)
        return float(known["t"])

    def misses(self, other: Process, since: float) -> float:
        """When this one noticed that the other is gone."""
        gone = self.until(lambda e: e["event"] == "PeerDeparted" and e["boot"] == other.boot, since)
        return float(gone["t"])

    def reports_clash(self, *boots: str, ours: bool) -> float:
        wanted = {"event": "IdClash", "ours": ours, "boots": sorted(boots)}
        return float(self.until(lambda e: wanted.items() <= e.items())["t"])

    def signal(self, number: int) -> float:
        self.popen.send_signal(number)
        return time.monotonic()


@pytest.fixture
def start() -> Iterator[Callable[[int], Process]]:
    team = f"test-{secrets.token_hex(4)}"
    processes: list[Process] = []

    def start_process(drone_id: int) -> Process:
        processes.append(Process(team, drone_id))
        return processes[-1]

    yield start_process
    for process in processes:
        process.popen.kill()
        process.popen.wait()


def report(claim: str, seconds: float) -> None:
    print(f"\n  {claim}: {seconds:.3f} s", end="")


def test_two_processes_meet_and_a_kill_a_restart_and_a_clone_are_noticed(
    start: Callable[[int], Process],
) -> None:
    one, two = start(1), start(2)
    report("announcements known, after the second's start", max(one.knows(two), two.knows(one)) - two.started)

    killed = two.signal(signal.SIGKILL)
    report("kill -9 noticed", one.misses(two, killed) - killed)

    again = start(2)
    report("restart known by both, after its start", max(one.knows(again), again.knows(one)) - again.started)
    assert again.boot != two.boot

    clone = start(2)
    told = [
        again.reports_clash(again.boot, clone.boot, ours=True),
        clone.reports_clash(again.boot, clone.boot, ours=True),
        one.reports_clash(again.boot, clone.boot, ours=False),
    ]
    report("clone reported by both and by the witness, after its start", max(told) - clone.started)
    assert one.popen.poll() is again.popen.poll() is clone.popen.poll() is None  # nobody stops for it


def test_the_first_agent_is_no_special_one(start: Callable[[int], Process]) -> None:
    first, second = start(40000), start(3)
    first.knows(second)
    second.knows(first)
    killed = first.signal(signal.SIGKILL)
    second.misses(first, killed)
    third = start(2)
    report(
        "a third meets the second though the first is dead",
        max(second.knows(third), third.knows(second)) - third.started,
    )
    first_again = start(40000)
    for other in (second, third):
        other.knows(first_again)
        first_again.knows(other)


def test_a_frozen_process_is_noticed_after_the_lease_and_met_again(start: Callable[[int], Process]) -> None:
    """Frozen, its sockets stay open: as a radio that falls silent, only the lease can tell."""
    one, two = start(1), start(2)
    one.knows(two)
    two.knows(one)
    frozen = two.signal(signal.SIGSTOP)
    report("silence noticed, lease 2 s", one.misses(two, frozen) - frozen)
    thawed = two.signal(signal.SIGCONT)
    report("both know each other again", max(one.knows(two, thawed), two.knows(one, thawed)) - thawed)


def test_a_terminated_process_says_farewell_and_ends(start: Callable[[int], Process]) -> None:
    one, two = start(1), start(2)
    one.knows(two)
    terminated = two.signal(signal.SIGTERM)
    report("farewell heard", one.misses(two, terminated) - terminated)
    assert two.popen.wait(PATIENCE) == 0


def test_by_default_nothing_listens_beyond_loopback(start: Callable[[int], Process]) -> None:
    one = start(1)
    listening = listening_addresses(one.popen.pid)
    assert listening, "it must listen somewhere to be met"
    assert all(address.startswith("0100007F:") for address in listening)  # 127.0.0.1 as the kernel writes it


def listening_addresses(pid: int) -> list[str]:
    """Local addresses, hex, of all listening TCP and of all UDP sockets of a process."""
    links = [os.readlink(fd) for fd in Path(f"/proc/{pid}/fd").iterdir()]
    sockets = {link[len("socket:[") : -1] for link in links if link.startswith("socket:[")}
    addresses = []
    for table, state in (("tcp", "0A"), ("tcp6", "0A"), ("udp", "07"), ("udp6", "07")):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == state and fields[9] in sockets:
                addresses.append(fields[1])
    return addresses


# --- the process ------------------------------------------------------------------------


def say(event: str, **fields: object) -> None:
    sys.stdout.write(json.dumps({"event": event, "t": time.monotonic(), **fields}) + "\n")
    sys.stdout.flush()


async def live(team: str, drone_id: int) -> None:
    import numpy as np  # noqa: PLC0415

    from swarmtrack.clock import SystemClock  # noqa: PLC0415
    from swarmtrack.messages import Announcement, IdClash  # noqa: PLC0415
    from swarmtrack.transport import keys  # noqa: PLC0415
    from swarmtrack.transport.settings import NetworkSettings  # noqa: PLC0415
    from swarmtrack.transport.zenoh_transport import ZenohTransport  # noqa: PLC0415

    boot, clock = keys.new_boot(), SystemClock()
    transport = ZenohTransport(NetworkSettings(team=team), drone_id, boot, clock)
    await transport.open()
    say("open", boot=boot)
    asyncio.get_running_loop().add_signal_handler(
        signal.SIGTERM, lambda: asyncio.ensure_future(transport.close())
    )
    await transport.announce(
        Announcement(drone_id, boot, 0, clock.now(), 0.01, np.zeros(3), np.eye(3), 0.01 * np.eye(3))
    )
    async for event in transport.events():
        name = type(event).__name__
        if isinstance(event, IdClash):
            say(name, drone_id=event.drone_id, boots=sorted(event.boots), ours=event.ours)
        else:
            say(name, drone_id=event.drone_id, boot=event.boot)


if __name__ == "__main__":
    asyncio.run(live(sys.argv[1], int(sys.argv[2])))
