"""Who runs where: `pytest` takes all cores, and tests that wait run next to tests that compute.

Two kinds. `live` tests start processes, open sockets or wait in real time; the rest compute. Teams of agents fly one
after another in one worker ("team"), the other live tests in a second ("live"), and both begin at once. Every other
worker takes computing tests, file by file, and is niced, so an agent that must answer in time is not starved by
arithmetic. `-s` and a single file run without workers.
"""

from __future__ import annotations

import functools
import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from xdist.remote import Producer
from xdist.scheduler import LoadGroupScheduling

# A busy machine may take any time over an example.
settings.register_profile("patient", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")

TESTS = Path(__file__).parent
NICENESS = 10

# Whole swarms: they never compete with each other.
TEAM = (
    "benchmarks/test_endurance.py",
    "benchmarks/test_hundred_clients.py",
    "live/test_faults.py",
    "live/test_judge.py",
    "live/test_swarm_command.py",
)
# Files and folders; a single test elsewhere bears the marker itself.
LIVE = (
    *TEAM,
    "benchmarks/test_flood.py",
    "live",
    "localswarm",
    "runtime/test_healthy.py",
    "runtime/test_live_video.py",
    "runtime/test_pilot_notices.py",
    "security/test_security.py",
    "sensors/test_camera_http.py",
    "sensors/test_camera_rtsp.py",
    "sensors/test_camera_v4l2.py",
    "sensors/test_detection_stream.py",
    "sensors/test_mavlink_links.py",
    "transport",
)


def lies_in(item: pytest.Item, places: tuple[str, ...]) -> bool:
    return any(item.path.is_relative_to(TESTS / place) for place in places)


def group_of(item: pytest.Item) -> str:
    """The worker's queue that a live test is in: the one it names, or that of its file."""
    named = item.get_closest_marker("xdist_group")
    if named is not None:
        return str(named.args[0])
    return "team" if lies_in(item, TEAM) else "live"


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    order = {"team": 0, "live": 1}
    places: dict[str, int] = {}
    for item in items:
        places[item.nodeid] = len(order)
        if lies_in(item, LIVE):
            item.add_marker("live")
        if item.get_closest_marker("live") is not None:
            group = group_of(item)
            item.add_marker(pytest.mark.xdist_group(group))
            places[item.nodeid] = order[group]
    items.sort(key=lambda item: places[item.nodeid])


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """One more than there are cores, for the two that mostly wait; none where workers only cost time or hide prints."""
    one_file = len(config.args) == 1 and ".py" in config.args[0]
    if one_file or config.option.capture == "no":
        return 0
    return len(os.sched_getaffinity(0)) + 1


class Scheduling(LoadGroupScheduling):
    """Tests of no group go by files, so that a fixture of a module is made once."""

    def _split_scope(self, nodeid: str) -> str:
        return super()._split_scope(nodeid).partition("::")[0]


def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> Scheduling | None:
    return Scheduling(config, log) if config.getvalue("dist") == "loadgroup" else None


@functools.cache
def yield_to_live_tests() -> None:
    """A worker never goes back: live tests come first, and only root could."""
    os.nice(NICENESS)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    if "PYTEST_XDIST_WORKER" in os.environ and item.get_closest_marker("live") is None:
        yield_to_live_tests()
