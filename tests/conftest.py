"""Who runs where: `pytest` takes all cores, and tests that wait run next to tests that compute.

Two kinds. `live` tests start processes, open sockets or wait in real time; the rest compute. Teams of agents fly one
after another in one worker; the other live tests have two queues more, and all begin at once. A worker whose queue is
done takes computing tests, file by file, and is niced from then on, so an agent that must answer in time is not starved
by arithmetic. `-s` and a single file run without workers.
"""

from __future__ import annotations

import fcntl
import functools
import os
import signal
import sys
from collections.abc import Generator
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from xdist.remote import Producer
from xdist.scheduler import LoadScopeScheduling

from support.places import SHARED

# A busy machine may take any time over an example. The same examples each time: what stops a change is that change, not
# luck. To look for new ones: pytest --hypothesis-profile=exploring
settings.register_profile("exploring", deadline=None, suppress_health_check=[HealthCheck.too_slow])
# Fifty examples, not Hypothesis's hundred: they are the same in each run, and `exploring` draws a hundred new ones.
settings.register_profile(
    "patient", settings.get_profile("exploring"), derandomize=True, database=None, max_examples=50
)
settings.load_profile("patient")

# What a script starts in its background ignores Ctrl-C, and so would every program that a test starts.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Where Python is told to keep no bytecode, as in containers, each worker would compile all tests, and each of the
# hundreds of processes that they start the whole package.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# As agents and benchmarks do, before NumPy is imported: threads of more than one worker keep each other from the cores.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

pytest_plugins = ("support.flown_pair",)

NICENESS = 10

# The beginnings of node IDs below tests/, by queue. Whole swarms: they never compete with each other.
TEAM = (
    "benchmarks/test_endurance.py::test_a_real_flight",
    "benchmarks/test_hundred_clients.py",
    "live/test_faults.py",
    "live/test_formation_flight.py",
    "live/test_guard_flight.py",
    "live/test_judge.py",
    "live/test_outside_world.py",
    "live/test_proof.py",
    "live/test_strangers_hour.py::test_a_flight",
    "live/test_swarm_command.py",
    "project/test_docs.py::test_a_flight",
    "project/test_readme.py::test_the_main_command",
    "replay/test_replay.py::test_the_verdict",
)
# Whatever else starts processes or waits in real time; what opens sockets within its own process.
ALONE = (
    "benchmarks/test_benchmarks.py::test_an_agent",
    "benchmarks/test_flood.py",
    "client/test_swarm.py",
    "calibration/test_calibrate.py::test_the_command_measures_a_live_drone",
    "live/",
    "monitor/test_monitor_recording.py",
    "motion/test_gps_start.py::test_agents_announce",
    "replay/test_replay.py::test_an_agent",
    "replay/test_replay.py::test_kill_9",
    "replay/test_replay.py::test_on_a_full_disk",
    "replay/test_replay.py::test_record_hears",
    "runtime/test_healthy.py",
    "outputs/test_live_video.py",
    "outputs/test_pilot_notices.py",
)
SOCKETS = (
    "diagnosis/test_advice.py::test_who_follows",
    "diagnosis/test_autopilot_limits.py::test_config_check_asks",
    "lab/swarm/",
    "monitor/test_entrance.py",
    "security/test_security.py",
    "camera_sources/test_camera_http.py",
    "camera_sources/test_camera_rtsp.py",
    "camera_sources/test_camera_v4l2.py",
    "camera_sources/test_detection_stream.py",
    "autopilot/test_mavlink_autopilot.py",
    "autopilot/test_mavlink_links.py",
    "transport/",
)


QUEUES = {"team": TEAM, "alone": ALONE, "sockets": SOCKETS}  # in the order in which they begin


def queue_of(nodeid: str) -> str:
    """The queue of a live test; of one that computes, its file, or the room whose files share what they parse."""
    below = nodeid.removeprefix("tests/")
    alone = "project" if below.startswith("project/") else below.partition("::")[0]
    return next((name for name, places in QUEUES.items() if below.startswith(places)), alone)


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Generator[None, Any, Any]:
    """Of a fresh checkout, the first worker at a file compiles it with pytest's asserts, and the others read that."""
    if "PYTEST_XDIST_WORKER" not in os.environ or not isinstance(collector, pytest.Module):
        return (yield)
    with collector.path.open() as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        return (yield)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    order = list(QUEUES)
    for item in items:
        if queue_of(item.nodeid) in QUEUES:
            item.add_marker("live")
    items.sort(
        key=lambda item: order.index(queue) if (queue := queue_of(item.nodeid)) in order else len(order)
    )


def pytest_report_collectionfinish(config: pytest.Config, items: list[pytest.Item]) -> list[str]:
    """With `--collect-only`, why each long test is long."""
    if not config.option.collectonly:
        return []
    marked = [(item, mark) for item in items if (mark := item.get_closest_marker("long")) is not None]
    return [f"{item.nodeid}: {mark.args[0]}" for item, mark in marked]


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Two more than there are cores: three queues mostly wait, and next to them computing begins at once.

    None where workers only cost time or hide prints.
    """
    one_file = len(config.args) == 1 and ".py" in config.args[0]
    if one_file or config.option.capture == "no":
        return 0
    return len(os.sched_getaffinity(0)) + 2


class Scheduling(LoadScopeScheduling):
    """By queues. `loadgroup` and its marker would do if xdist 3.8 could rename the nodes of pytest 9.2."""

    def _split_scope(self, nodeid: str) -> str:
        return queue_of(nodeid)


def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> Scheduling | None:
    return Scheduling(config, log) if config.getvalue("dist") == "loadscope" else None


@functools.cache
def yield_to_live_tests() -> None:
    """A worker never goes back: live tests come first, and only root could."""
    os.nice(NICENESS)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    if item.get_closest_marker("shared") is not None and not SHARED.is_dir():
        pytest.skip("../shared/data is absent")
    if "PYTEST_XDIST_WORKER" in os.environ and item.get_closest_marker("live") is None:
        yield_to_live_tests()
