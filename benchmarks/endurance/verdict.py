"""What a long flight showed, window by window, and whether it is what should last.

Judged is from `settled_s` on: before, caches fill, clocks converge and everybody still learns who is who.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

MAX_GROWTH = 0.05  # of the resident memory, from when the flight has settled to its end
MAX_LAG_S = 0.1
MAX_UNSTEADY = 0.05  # of its median, that a rate may differ in one window
SETTLED_S, SETTLED_SHARE = 300.0, 0.2  # of a short flight, so much of it
# Windows at either end whose median is compared: one sample may meet a buffer that is full just then.
ENDS = 6
# The process of `swarmtrack sim` keeps the whole flight to judge it, so it is not held to memory.
JUDGE = "judge"
RATES = ("tracks", "detections", "imu")


class AgentWindow(NamedTuple):
    """One agent in one window, by its own health messages; what is counted: since the window before.

    rates_hz by name; lag of its event loop, the largest p95 and the largest of all [s]; frames_dropped: before or after
    the detector; recorded, unrecorded: entries of its recording.
    """

    healths: int
    rates_hz: Mapping[str, float]
    lag_p95_s: float
    lag_max_s: float
    imu_samples: int
    imu_expected: float
    imu_lost: int
    imu_gaps: int
    frames_dropped: int
    recorded: int
    unrecorded: int


class ViewerWindow(NamedTuple):
    """What came to the one who looks at the monitor. longest_wait_s: for the next state."""

    states_hz: float
    views_hz: float
    kilobytes_per_s: float
    longest_wait_s: float


@dataclass(frozen=True, slots=True)
class Window:
    """One window; t_s: its end, seconds of flight. Memory [10⁶ bytes] at its end and CPU [% of a core] by process;
    elsewhere_percent: of a core, what the whole machine did beside them."""

    t_s: float
    seconds: float
    rss_mb: Mapping[str, float]
    cpu_percent: Mapping[str, float]
    elsewhere_percent: float
    agents: Mapping[int, AgentWindow]
    viewer: ViewerWindow


class Claim(NamedTuple):
    """One thing that should last, and what was found, in `unit`; ok: written so that NaN fails."""

    what: str
    who: str
    found: float
    limit: float
    unit: str
    ok: bool


def settled_s(flight_s: float) -> float:
    """From when on a flight of this length is judged."""
    return min(SETTLED_S, SETTLED_SHARE * flight_s)


def judged(windows: Sequence[Window], since_s: float) -> list[Window]:
    """Those that begin after `since_s`, allowing for windows that are a moment late."""
    return [window for window in windows if window.t_s - window.seconds > since_s - 0.5 * window.seconds]


def judge(windows: Sequence[Window]) -> list[Claim]:
    """Of windows that are to be judged; none of them: no claims."""
    if not windows:
        return []
    agents = sorted({drone_id for window in windows for drone_id in window.agents})
    return [
        *(
            _at_most("memory grown", name, 100.0 * growth(windows, name), 100.0 * MAX_GROWTH, "%")
            for name in processes(windows)
            if name != JUDGE
        ),
        *(
            _at_most("event loop late, at most", f"drone {i}", 1e3 * _worst_lag(windows, i), 1e3 * MAX_LAG_S, "ms")
            for i in agents
        ),
        *(_at_most("IMU samples lost", f"drone {i}", lost(windows, i), 0.0, "") for i in agents),
        *(
            _at_most(
                f"{name} a second, farthest from the median", f"drone {i}",
                100.0 * unsteadiness(rates(windows, i, name)), 100.0 * MAX_UNSTEADY, "%",
            )
            for i in agents
            for name in RATES
        ),
    ]  # fmt: skip


def processes(windows: Iterable[Window]) -> list[str]:
    """Of whom memory was read, in the order in which they came."""
    return list(dict.fromkeys(name for window in windows for name in window.rss_mb))


def growth(windows: Sequence[Window], name: str) -> float:
    """Of a process' resident memory, as a share of what it was at the beginning; NaN: it was not there all the time."""
    sizes = [window.rss_mb.get(name, math.nan) for window in windows]
    n = max(1, min(ENDS, len(sizes) // 3))
    return statistics.median(sizes[-n:]) / statistics.median(sizes[:n]) - 1.0 if _finite(sizes) else math.nan


def rates(windows: Iterable[Window], drone_id: int, name: str) -> list[float]:
    """One a window, NaN where nothing was heard of it [Hz]."""
    return of_agent(windows, drone_id, lambda agent: agent.rates_hz.get(name, math.nan))


def of_agent(windows: Iterable[Window], drone_id: int, figure: Callable[[AgentWindow], float]) -> list[float]:
    """A figure of one agent in every window; NaN where it was not heard."""
    agents = (window.agents.get(drone_id) for window in windows)
    return [math.nan if agent is None else figure(agent) for agent in agents]


def lost(windows: Iterable[Window], drone_id: int) -> float:
    """IMU samples that never came, by their stamps; NaN: there were windows in which nothing was heard of them."""
    return sum(of_agent(windows, drone_id, lambda agent: float(agent.imu_lost)))


def unsteadiness(values: Sequence[float]) -> float:
    """The largest distance from the median, as a share of it; NaN where a value is, or the median is 0."""
    median = statistics.median(values) if _finite(values) else 0.0
    return max(abs(value - median) for value in values) / median if median > 0.0 else math.nan


def _worst_lag(windows: Iterable[Window], drone_id: int) -> float:
    lags = of_agent(windows, drone_id, lambda agent: agent.lag_max_s)
    return max(lags) if _finite(lags) else math.nan


def _finite(values: Sequence[float]) -> bool:
    return bool(values) and all(map(math.isfinite, values))


def _at_most(what: str, who: str, found: float, limit: float, unit: str) -> Claim:
    return Claim(what, who, found, limit, unit, found <= limit)
