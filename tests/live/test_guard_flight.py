"""Real, engaged agents that are stopped, killed, frozen or break: what their autopilot hears from the guard."""

import asyncio
import os
import signal
from pathlib import Path

import pytest

from support.patience import PATIENCE
from swarmtrack.benchmarks.guard import CASES, SPEED_M_S, Sky, engage, fly, flying_agent, guard_of
from swarmtrack.benchmarks.processes import free_port

# s: what a busy machine adds to the 0.35 and 1.3 s that `bench guard` judges.
ZERO_WITHIN_S, SILENT_AFTER_S = 1.2, 2.5


@pytest.mark.parametrize(
    "cases",
    [
        ("stopped", "frozen"),
        pytest.param(
            tuple(case for case in CASES if case not in ("stopped", "frozen")),
            marks=pytest.mark.long("the other ends of an agent"),
        ),
    ],
    ids=", ".join,
)
async def test_whatever_becomes_of_an_agent_its_drone_stops_and_is_let_go(cases):
    """Two drones fly at once: more would keep each other from the cores."""
    for pair in batched(cases, 2):
        async with asyncio.TaskGroup() as tasks:
            flights = {case: tasks.create_task(fly(case, seed=1)) for case in pair}
        for case, flight in flights.items():
            assert_stopped(case, flight.result())


def batched(cases, size):
    return [cases[i : i + size] for i in range(0, len(cases), size)]


def assert_stopped(case, flight):
    if case.startswith("guard-"):
        assert flight.last_s < ZERO_WITHIN_S
    else:
        assert flight.zero_s < ZERO_WITHIN_S
        assert flight.worst == 0.0 or flight.last_s < ZERO_WITHIN_S
        assert flight.flown_m < 3.0 * SPEED_M_S
    assert flight.last_s < SILENT_AFTER_S


async def until(condition):
    async with asyncio.timeout(PATIENCE):
        while not condition():  # noqa: ASYNC110 (what is waited for happens in another process)
            await asyncio.sleep(0.02)


def exists(pid):
    # A zombie is gone, too: its parent was killed, and nobody in this container may reap it.
    try:
        return "(zombie)" not in Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False


async def test_a_guard_ends_with_its_agent_and_not_with_a_terminal_s_signals():
    sky = Sky(free_port(), seed=1)
    async with flying_agent(sky, 1.0) as agent:
        await until(lambda: Path(f"/proc/{agent.pid}/task/{agent.pid}/children").read_text().strip())
        guard = guard_of(agent.pid)
        # A child that was forked is its parent's twin until it becomes the guard.
        await until(lambda: any(word.endswith("guard.py") for word in _words(guard)))
        await until(lambda: _ignores(guard, signal.SIGTERM))
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            os.kill(guard, number)
        await engage(sky, 1.0)
        assert exists(guard)
        agent.kill()
        await agent.wait()
        await until(lambda: not exists(guard))


def _words(pid):
    return Path(f"/proc/{pid}/cmdline").read_text().split("\0")


def _ignores(pid, number):
    line = next(
        line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith("SigIgn")
    )
    return int(line.split()[1], 16) >> (number - 1) & 1
