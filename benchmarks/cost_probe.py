"""What a checkout costs: run as a file, so that it times whichever `swarmtrack` PYTHONPATH names, old ones too.

    python -P benchmarks/cost_probe.py trackers 300
    python -P benchmarks/cost_probe.py parts 300
    python -P benchmarks/cost_probe.py agent 10

The second argument is how many scans are played, how often a part is timed, or for how many seconds an agent flies. The
answer is one line of JSON, {what: figure}: ms of processor time per scan, µs per call, % of a core, ms.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from functools import partial

import numpy as np
from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.framer import Framer
from swarmtrack.autopilot.signing import Codec
from swarmtrack.benchmarks import agent_budget
from swarmtrack.benchmarks.trackers.timing import at_cost, cost_of
from swarmtrack.clock import SystemClock
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Scan
from swarmtrack.tracking import AGENT_PARAMETERS, TRACKERS, create_tracker
from swarmtrack.tracking.marginals import matched

CAMERA = PinholeCamera(430.0, 430.0, 319.5, 239.5, 640, 480)
FPS = 15.0
SETTLED = 50  # scans that are not timed: by then tracks are confirmed and noise is learned
TURN = rotation.exp(np.array([1e-3, 2e-3, 5e-4]))  # back and forth, as the gyro of a hovering drone tells
TURN_VARIANCE = 1e-7
LOOK_MS = 20.0


def settled_ms(tracker: str, tracks: int, scans: int) -> float:
    """Median per scan of an agent's tracker, of so many tracks that nobody comes near; boxes, scores and a turn."""
    rng = np.random.default_rng(tracks)
    side = math.ceil(math.sqrt(tracks))
    points = 100.0 + 400.0 / side * np.stack(np.divmod(np.arange(tracks), side), axis=1)
    followed = create_tracker(tracker, camera=CAMERA, **AGENT_PARAMETERS)
    spent = []
    for k in range(SETTLED + scans):
        z, size = points + rng.normal(0.0, 0.5, points.shape), 30.0 + rng.normal(0.0, 0.5, points.shape)
        scan = Scan(k / FPS, z, None, size, np.full(tracks, 0.9))
        began = time.thread_time()
        followed.predict(scan.t, TURN if k % 2 else TURN.T, TURN_VARIANCE)
        followed.update(scan)
        spent.append(time.thread_time() - began)
    return 1e3 * float(np.median(spent[SETTLED:]))


def trackers(scans: int) -> dict[str, float]:
    """ms per scan, and µs per `at` of ten tracks."""
    figures = {
        f"{name}, {n} settled tracks, ms": settled_ms(name, n, scans) for name in TRACKERS for n in (2, 8)
    }
    for n, m in ((8, 8), (8, 18)):
        cost = cost_of("mbm", "budget", n, m, repeats=max(scans // 5, 1))
        figures[f"mbm, {n} × {m} in one gate, ms"] = cost.ms
    figures["mbm, `at` of 10 tracks, µs"] = 1e3 * at_cost("mbm", 10, repeats=scans).ms
    return figures


def parts(repeats: int) -> dict[str, float]:
    """Least µs of the marginals of matchings in which every pair is possible, and ms of a second of MAVLink at 200 Hz:
    gyro, attitude and place, from datagrams to messages."""
    rng, figures = np.random.default_rng(1), {}
    for n in (2, 4, 8):
        log_ratio = rng.normal(0.0, 2.0, (n, n))
        figures[f"marginals of {n} × {n}, µs"] = 1e3 * _least_ms(partial(matched, log_ratio), repeats)
    sender = common.MAVLink(None, srcSystem=1, srcComponent=1)
    datagrams = []
    for k in range(200):
        datagrams.append(sender.highres_imu_encode(5000 * k, *[0.1] * 13, 63).pack(sender))
        if not k % 4:
            datagrams.append(sender.attitude_quaternion_encode(5 * k, 1.0, *[0.1] * 6).pack(sender))
            datagrams.append(sender.local_position_ned_encode(5 * k, *[0.1] * 6).pack(sender))

    def read() -> None:
        framer, codec = Framer(), Codec(SystemClock(), 1, 191)
        for data in datagrams:
            for frame in framer.feed(bytes(data)):
                codec.decode(frame)

    figures[f"{len(datagrams)} MAVLink messages, ms"] = _least_ms(read, repeats)
    return figures


def _least_ms(call: Callable[[], object], repeats: int) -> float:
    spent = []
    for _ in range(repeats):
        began = time.thread_time()
        call()
        spent.append(time.thread_time() - began)
    return 1e3 * min(spent)


def agent(seconds: float) -> dict[str, float]:
    """An agent with five tracks, without detector: one that sleeps stands in for it, or one that answers at once."""
    usual = agent_budget.measure_agent("mbm", seconds, ["--look-ms", str(LOOK_MS)])
    prompt = agent_budget.measure_agent("mbm", seconds, ["--look-ms", "0"])
    return {
        "agent without detector, % of a core": usual.cpu_percent,
        "agent, memory, MB": usual.rss_mb,
        "exposed → heard elsewhere beyond the detector, p95, ms": usual.latency_ms[1] - LOOK_MS,
        "the same with a detector that takes no time, p95, ms": prompt.latency_ms[1],
    }


if __name__ == "__main__":
    kind, amount = sys.argv[1], int(sys.argv[2])
    print(json.dumps({"trackers": trackers, "parts": parts, "agent": agent}[kind](amount)))
