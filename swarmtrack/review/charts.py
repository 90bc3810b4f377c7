"""The series of a flight as charts: plain records that the page draws. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from swarmtrack.messages import Array
from swarmtrack.outputs.palette import colour_of
from swarmtrack.review.flight import DroneFlight, ReviewedFlight
from swarmtrack.review.names import namings

Chart = dict[str, Any]
Series = dict[str, Any]

MOST_POINTS = 1500  # of one line: more than a screen has columns
BREAK_S = 1.5  # s without a value: the line is broken
BUCKET_S = 1.0  # s of one value of a rate
STATE_COLOURS = {
    "wrong": "#ff5a5f", "unnamed": "#c8c8c8", "undetected": "#7a5c1e", "away": "#333d47", "blind": "#5d3a6e",
    "held": "#f4b740", "flies": "#35c28f",
}  # fmt: skip
NAME_STATES = {
    "unnamed": "track without a name",
    "undetected": "in view, no track",
    "away": "out of view, or unknown",
    "blind": "no frame",
    "wrong": "wrong name",
}
DASHES = (None, [6, 3], [2, 3], [9, 3, 2, 3])


def charts(flight: ReviewedFlight) -> list[Chart]:
    """All that hold anything."""
    measured = _metres(flight)
    made = [
        _names(flight),
        _distances(flight, measured),
        _nees(measured),
        _camera_clocks(flight),
        *_rates(flight),
        _messages(flight),
        _links(flight),
        _cpu(flight),
        _lag(flight),
        _formation(flight),
    ]
    return [chart for chart in made if chart.get("rows") or chart.get("series")]


def colour(drone_id: int) -> str:
    """As everywhere, for CSS."""
    return "#{:02x}{:02x}{:02x}".format(*colour_of(drone_id))


def _names(flight: ReviewedFlight) -> Chart:
    rows = []
    states = set()
    for drone in flight.drones.values():
        for naming in namings(flight, drone):
            spans: list[list[Any]] = []
            for span in naming.spans:
                states.add(span.state)
                named = span.state == "named"
                shade = colour(naming.teammate) if named else STATE_COLOURS[span.state]
                words = (
                    f"named drone {naming.teammate}" if named else f"{NAME_STATES[span.state]}: {span.why}"
                )
                spans.append([round(span.begin, 2), round(span.end, 2), shade, words])
            name = f"drone {naming.observer} sees drone {naming.teammate}"
            rows.append({"name": name, "short": f"{naming.observer} sees {naming.teammate}", "spans": spans})
    key = [["named, in the drone's colour", "#56b4e9", "box"]]
    key += [[words, STATE_COLOURS[state], "box"] for state, words in NAME_STATES.items() if state in states]
    about = "Who was named by whom, and why not: point at a span."
    return {"title": "Names", "about": about, "rows": rows, "key": key}


class _Metres(NamedTuple):
    """Measured place (3,) m of a named teammate at t [s], its covariance (3, 3), and the true one where it is known."""

    t: float
    teammate: int
    position: Array
    cov: Array
    true: Array | None


def _metres(flight: ReviewedFlight) -> dict[int, list[_Metres]]:
    """By observer, in the order of time."""
    return {
        drone.drone_id: [
            _Metres(
                scan.t, look.identity, look.position, look.cov, _true(flight, drone, look.identity, scan.t)
            )
            for scan in drone.scans
            for look in scan.looks
            if isinstance(look.identity, int) and look.position is not None and look.cov is not None
        ]
        for drone in flight.drones.values()
    }


def _true(flight: ReviewedFlight, drone: DroneFlight, teammate: int, t: float) -> Array | None:
    here, there = flight.true_place(drone.drone_id, t), flight.true_place(teammate, t)
    return None if here is None or there is None else there - here


def _distances(flight: ReviewedFlight, measured: dict[int, list[_Metres]]) -> Chart:
    series: list[Series] = []
    for number, (observer, found) in enumerate(measured.items()):
        by_name: dict[int, list[tuple[float, float, float, float]]] = {}
        for one in found:
            metres = float(np.linalg.norm(one.position))
            ray = one.position / max(metres, 1e-6)
            sigma = math.sqrt(max(float(ray @ one.cov @ ray), 0.0))
            length = math.nan if one.true is None else float(np.linalg.norm(one.true))
            by_name.setdefault(one.teammate, []).append((one.t, metres, 2.0 * sigma, length))
        for whom, rows in sorted(by_name.items()):
            t, metres_then, band, true = np.array(rows).T
            label, dash = f"{observer}→{whom}", DASHES[number % len(DASHES)]
            series.append(_line(label, colour(whom), t, metres_then, band=band, dash=dash))
            if np.isfinite(true).any():
                series.append(_line(f"{label} true", "#ffffff", t, true, dash=[1, 3]))
    about = "Observer→teammate; band: ± 2σ" + ("; dotted white: the truth." if flight.truth else ".")
    return {**_chart("Distances, m", series, unit="m", low=0.0), "about": about}


def _nees(measured: dict[int, list[_Metres]]) -> Chart:
    series = []
    for observer, found in measured.items():
        rows = []
        for one in found:
            if one.true is not None:
                error = one.position - one.true
                rows.append((one.t, float(error @ np.linalg.pinv(one.cov) @ error) / 3.0))
        if rows:
            t, nees = np.array(rows).T
            series.append(_line(f"drone {observer}", colour(observer), *_bucketed(t, nees)))
    about = (
        "Squared error of teammates' positions over its covariance, per axis; 1 is honest, above: too sure."
    )
    chart = _chart("NEES of positions", series, low=0.0, marks=[1.0])
    return {**chart, "about": about}


def _camera_clocks(flight: ReviewedFlight) -> Chart:
    series: list[Series] = []
    for drone in flight.drones.values():
        rows = [
            (t, 1e3 * message.time_offset.found_s, 1e3 * (message.time_offset.sigma_s or 0.0))
            for t, message in drone.health
            if message.time_offset is not None and message.time_offset.found_s is not None
        ]
        if rows:
            t, found, sigma = np.array(rows).T
            name = f"drone {drone.drone_id}"
            series.append(_line(name, colour(drone.drone_id), t, found, band=2.0 * sigma))
    about = "Estimated: exposure by the gyro's clock = stamp + offset; band: ± 2σ."
    return {**_chart("Camera clock offset, ms", series, unit="ms"), "about": about}


def _rates(flight: ReviewedFlight) -> list[Chart]:
    frames, gyro = [], []
    for drone in flight.drones.values():
        name, shade = f"drone {drone.drone_id}", colour(drone.drone_id)
        if len(drone.frames):
            frames.append(_line(name, shade, *_per_second(drone.frames[:, 0], drone)))
        if len(drone.imu):
            gyro.append(_line(name, shade, *_per_second(drone.imu, drone)))
    return [
        _chart("Processed frames per second", frames, unit="Hz", low=0.0),
        _chart("Gyro samples per second", gyro, unit="Hz", low=0.0),
    ]


def _messages(flight: ReviewedFlight) -> Chart:
    """A row for each direction: filled where a report arrived, red where one was sent that did not."""
    rows = []
    for drone in flight.drones.values():
        for other in flight.drones.values():
            if other is drone or not drone.recorded or not (other.sent or drone.heard):
                continue
            arrived = {one.key: one for one in drone.heard if one.observer == other.drone_id}
            spans: list[list[Any]] = [
                [
                    round(one.sent_t, 2),
                    round(one.sent_t + 0.3, 2),
                    "#35c28f",
                    f"arrived after {1e3 * (one.t - one.sent_t):.0f} ms",
                ]
                for one in arrived.values()
            ]
            spans += [
                [round(t, 2), round(t + 0.3, 2), STATE_COLOURS["wrong"], "sent, and did not arrive"]
                for key, t in other.sent.items()
                if key not in arrived
            ]
            name = f"drone {other.drone_id} to drone {drone.drone_id}"
            spans.sort()
            rows.append({"name": name, "short": f"{other.drone_id} to {drone.drone_id}", "spans": spans})
    key = [["arrived", "#35c28f", "box"], ["sent, and did not arrive", STATE_COLOURS["wrong"], "box"]]
    return {"title": "Messages", "about": "Reports of sightings, once a second.", "rows": rows, "key": key}


def _links(flight: ReviewedFlight) -> Chart:
    rows = []
    for drone in flight.drones.values():
        spans: dict[str, list[list[Any]]] = {}
        for k, (t, message) in enumerate(drone.health):
            end = drone.health[k + 1][0] if k + 1 < len(drone.health) else t + 1.0
            for link in message.links:
                name = "camera" if "://" in link.name else link.name
                shade = "#2b7a5c" if link.ok else STATE_COLOURS["wrong"]
                of = spans.setdefault(name, [])
                if of and of[-1][2] == shade and t - of[-1][1] < 0.1:
                    of[-1][1] = round(end, 2)
                    of[-1][3] = link.text
                else:
                    of.append([round(t, 2), round(min(end, t + 3.0), 2), shade, link.text])
        for name, of in spans.items():
            rows.append(
                {"name": f"drone {drone.drone_id} {name}", "short": f"{drone.drone_id} {name}", "spans": of}
            )
    key = [["works", "#2b7a5c", "box"], ["does not", STATE_COLOURS["wrong"], "box"]]
    return {"title": "Links", "about": "As each agent's health reports them.", "rows": rows, "key": key}


def _cpu(flight: ReviewedFlight) -> Chart:
    return _of_health(flight, "CPU of the agents, % of a core", lambda message: message.cpu_percent, "%")


def _lag(flight: ReviewedFlight) -> Chart:
    def lag(message: Any) -> float:
        found = message.latencies.get("loop_lag")
        return math.nan if found is None else 1e3 * float(found.p95_s)

    return _of_health(flight, "Waiting for the processor, ms (95 %)", lag, "ms")


def _of_health(flight: ReviewedFlight, title: str, value: Any, unit: str) -> Chart:
    series = []
    for drone in flight.drones.values():
        rows = np.array([(t, value(message)) for t, message in drone.health]).reshape(-1, 2)
        if np.isfinite(rows[:, 1]).any():
            series.append(_line(f"drone {drone.drone_id}", colour(drone.drone_id), *rows.T, break_s=4.0))
    return _chart(title, series, unit=unit, low=0.0)


def _formation(flight: ReviewedFlight) -> Chart:
    rows = []
    for drone in flight.drones.values():
        spans: list[list[Any]] = []
        for one in drone.commands:
            shade = (
                STATE_COLOURS["away"]
                if one.why == "not_engaged"
                else STATE_COLOURS["held" if one.holds else "flies"]
            )
            t = round(one.t, 2)
            if spans and spans[-1][3] == one.text and t - spans[-1][1] < BREAK_S:
                spans[-1][1] = t
            else:
                spans.append([t, t, shade, one.text])
        if spans:
            name = f"drone {drone.drone_id}"
            rows.append({"name": name, "short": name, "spans": spans})
    key = [["flies", STATE_COLOURS["flies"], "box"], ["holds", STATE_COLOURS["held"], "box"]]
    return {"title": "Formation", "about": "What each follower did, and why.", "rows": rows, "key": key}


def _per_second(times: Array, drone: DroneFlight) -> tuple[Array, Array]:
    edges = np.arange(drone.begin, max(drone.end, drone.begin + BUCKET_S) + BUCKET_S, BUCKET_S)
    counts = np.histogram(times, edges)[0].astype(float) / BUCKET_S
    return (edges[:-1] + 0.5 * BUCKET_S)[:-1], counts[:-1]


def _bucketed(t: Array, values: Array) -> tuple[Array, Array]:
    """Mean of each second."""
    second = np.floor(t / BUCKET_S)
    which = np.unique(second)
    return (which + 0.5) * BUCKET_S, np.array([values[second == one].mean() for one in which])


def _chart(
    title: str,
    series: Sequence[Series],
    *,
    unit: str = "",
    low: float | None = None,
    marks: Iterable[float] = (),
) -> Chart:
    key = [[one["name"], one["colour"], ""] for one in series if not one["name"].endswith(" true")]
    return {
        "title": title,
        "unit": unit,
        "low": low,
        "marks": list(marks),
        "series": list(series),
        "key": key,
    }


def _line(
    name: str,
    shade: str,
    t: Array,
    y: Array,
    *,
    band: Array | None = None,
    dash: list[int] | None = None,
    break_s: float = BREAK_S,
) -> Series:
    """Thinned, rounded, and broken where there is a gap; what is no number is null, for JSON."""
    if len(t) > MOST_POINTS:
        keep = np.linspace(0, len(t) - 1, MOST_POINTS).round().astype(int)
        break_s = max(break_s, 3.0 * float(np.median(np.diff(t[keep]))))
        t, y, band = t[keep], y[keep], None if band is None else band[keep]
    gaps = np.flatnonzero(np.diff(t) > break_s) + 1
    parts = [np.insert(one, gaps, np.nan) for one in (y, *(() if band is None else (band,)))]
    times = np.insert(t, gaps, t[gaps - 1] + 1e-3) if len(gaps) else t
    made = {
        "name": name,
        "colour": shade,
        "t": np.round(times, 2).tolist(),
        "y": _plain(parts[0]),
        "dash": dash,
    }
    return made if band is None else {**made, "band": _plain(parts[1])}


def _plain(values: Array) -> list[float | None]:
    return [float(f"{value:.4g}") if math.isfinite(value) else None for value in values.tolist()]
