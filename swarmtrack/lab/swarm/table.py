"""What somebody who watches a local swarm is shown: a live table, or a line a second; and the tables at the end."""

from __future__ import annotations

import math
import shlex
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

from rich.box import SIMPLE_HEAD
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from swarmtrack.lab.scenarios.scenario import ScenarioFault
from swarmtrack.lab.score.formation_score import FormationScore
from swarmtrack.lab.score.swarm_score import JudgedTrack, SwarmScore
from swarmtrack.lab.score.swarm_verdict import REFERENCE_WIDTH, Limits, Shortfall, SwarmReport, Verdict
from swarmtrack.lab.swarm.machine_load import lighter_flights
from swarmtrack.lab.swarm.watch import AgentView, Watch
from swarmtrack.messages import FOREIGN, Identity
from swarmtrack.outputs.flight_end import FlightEnd
from swarmtrack.wire.health import HealthMessage

LARGE_TEAM = 8  # from here on a line has no room for everybody
LAG_WORTH_A_WORD = 2.0  # s by which judging may be behind
MOST_CLAUSES = 2  # of a headline: the tables have the rest


class Spectator(Protocol):
    """Is told how it goes."""

    def note(self, text: str) -> None:
        """What is being done, before and after the flight."""

    def print_line(self, text: str) -> None:
        """What somebody may want to copy while the flight goes on."""

    def show(self, watch: Watch) -> None:
        """A few times a second."""

    def close(self) -> None: ...


class LiveTable:
    """Redraws one table in a terminal."""

    def __init__(self, console: Console, title: str) -> None:
        self._title = title
        self._live = Live(console=console, auto_refresh=False, transient=True)
        self._live.start()

    def note(self, text: str) -> None:
        self._live.update(Text(text, style="dim"), refresh=True)

    def print_line(self, text: str) -> None:
        self._live.console.print(text, highlight=False, soft_wrap=True)

    def show(self, watch: Watch) -> None:
        self._live.update(Group(flight_table(watch, self._title), team_line(watch)), refresh=True)

    def close(self) -> None:
        self._live.stop()


class PlainLines:
    """A line a second, where the output is no terminal."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._shown_second: int | None = None
        self._shown: dict[int, str] = {}

    def note(self, text: str) -> None:
        self._console.print(text, highlight=False, soft_wrap=True)

    print_line = note

    def show(self, watch: Watch) -> None:
        second = math.floor(watch.t)
        if second == self._shown_second or watch.t < 0.0:
            return
        self._shown_second = second
        line = team_line(watch)
        if len(watch.agents) < LARGE_TEAM:
            for drone_id, agent in watch.agents.items():
                seen = Text(f" | {drone_id} sees ").append_text(sightings(agent.seen, watch.team))
                # What does not fit comes a second later.
                if self._shown.get(drone_id) != seen.plain and len(line) + len(seen) <= self._console.width:
                    self._shown[drone_id] = seen.plain
                    line.append_text(seen)
        self._console.print(line, highlight=False, soft_wrap=True)

    def close(self) -> None: ...


class NoTable:
    """For programs."""

    def note(self, text: str) -> None: ...
    def print_line(self, text: str) -> None: ...
    def show(self, watch: Watch) -> None: ...
    def close(self) -> None: ...


# --- in flight ------------------------------------------------------------------------------------


def flight_table(watch: Watch, title: str) -> Table:
    table = _table(title)
    table.add_column("drone", justify="right")
    table.add_column("in view, as named")
    for heading in ("error px", "tracks Hz", "IMU Hz", "camera Hz", "CPU %", "RSS MB"):
        table.add_column(heading, justify="right")
    for drone_id, agent in watch.agents.items():
        table.add_row(
            str(drone_id),
            _state(agent, watch.team),
            _error(agent.seen),
            *_health_cells(agent.health[-1][1] if agent.health else None),
        )
    return table


def _state(agent: AgentView, team: Collection[int]) -> Text:
    if agent.boot is None:
        return Text("no agent yet" if agent.health == [] else "no agent now", style="dim")
    if math.isnan(agent.first_tracks_t):
        return Text("starting", style="dim")
    return sightings(agent.seen, team)


def sightings(seen: Sequence[JudgedTrack], team: Collection[int]) -> Text:
    """Every track: who it is in truth, and as whom it is known."""
    text = Text()
    for one in sorted(seen, key=lambda s: (s.drone_id is None, s.drone_id or 0)):
        text.append("  " if text else "").append_text(_sighting(one, team))
    return text or Text("no drone", style="dim")


def _sighting(seen: JudgedTrack, team: Collection[int]) -> Text:
    truth, said = seen.drone_id, seen.track.identity
    if said is None:
        return Text(f"{_who(truth)} unknown", style="yellow")
    if said == truth:
        return Text(str(said), style="green")
    if truth is None:
        return Text(f"no drone as {_who(said)}", style="yellow")
    right = said == FOREIGN and truth not in team
    return Text(f"{truth} as {_who(said)}", style="green" if right else "bold red")


def _who(identity: Identity) -> str:
    return "no drone" if identity is None else str(identity)


def _error(seen: Sequence[JudgedTrack]) -> str:
    """Root mean square of the tracks that are somebody."""
    squares = [one.error_px**2 for one in seen if one.drone_id is not None]
    return f"{math.sqrt(sum(squares) / len(squares)):.1f}" if squares else "–"


def _health_cells(health: HealthMessage | None) -> list[str]:
    if health is None:
        return ["–"] * 5
    rates = [
        health.rates[name].got_hz if name in health.rates else math.nan
        for name in ("tracks", "imu", "detections")
    ]
    return [*(f"{rate:.0f}" for rate in rates), f"{health.cpu_percent:.0f}", f"{health.rss_mb:.0f}"]


def team_line(watch: Watch) -> Text:
    if watch.t < 0.0:
        return Text(
            f"hovering until all drones are there; the flight begins in {-watch.t:.0f} s", style="dim"
        )
    score = watch.scorer.score()
    text = Text(f"{watch.t:4.0f} s  {_identity_figures(score)}")
    judged = [agent.judged_t for agent in watch.agents.values() if agent.boot is not None]
    unheard = [str(drone_id) for drone_id, agent in watch.agents.items() if agent.boot is None]
    if unheard:
        text.append(f"   (not received yet: drone {', '.join(unheard)})", style="yellow")
    for fault in watch.faults:
        text.append(f"   {describe_fault(fault)}", style="bold yellow")
    behind = watch.t - min((t for t in judged if not math.isnan(t)), default=watch.t)
    if behind > LAG_WORTH_A_WORD and watch.waiting:
        text.append(f"   (as of {behind:.0f} s ago: the rest is judged after landing)", style="dim")
    return text


def describe_fault(fault: ScenarioFault) -> str:
    """Kind, whose, how much."""
    whose = f" of {', '.join(map(str, fault.drones))}" if fault.drones else ""
    return f"{fault.kind}{whose}{f' {fault.value:g}' if fault.value else ''}"


def _identity_figures(score: SwarmScore) -> str:
    if not score.samples:
        return "nothing to judge yet"
    names = f"names {score.correct:.0%} correct, {score.wrong:.0%} wrong, {score.unknown:.0%} unknown"
    return (
        names
        if math.isnan(score.agreement) or score.agreement == 1.0
        else f"{names}, {score.agreement:.0%} agree"
    )


# --- after landing --------------------------------------------------------------------------------


def agents_table(report: SwarmReport) -> Table:
    table = _table("agents")
    table.caption = (
        "named: time until all teammates in view were named; delay: from a frame's exposure to its tracks on the "
        "network, median and 95th percentile"
    )
    table.caption_justify = "left"
    for heading in (
        "drone", "named s", "RMSE px", "tracks Hz", "IMU Hz", "camera Hz",
        "delay ms", "p95", "CPU %", "RSS MB",
    ):  # fmt: skip
        table.add_column(heading, justify="right")
    short = {short.key: short.drones for short in report.shortfalls}
    for agent in report.agents:
        named = report.score.time_to_identify_s.get(agent.drone_id, math.nan)
        rmse = report.score.rmse_px.get(agent.drone_id, math.nan)
        cells = [
            (named, 1, "identity.time_to_identify_s"),
            (rmse, 2, "tracking.rmse_px"),
            (agent.track_rate_hz, 1, "track_rate_hz"),
            (agent.imu_rate_hz, 1, "imu_rate_hz"),
            (agent.detection_rate_hz, 1, ""),
            (1e3 * agent.latency_p50_s, 0, ""),
            (1e3 * agent.latency_p95_s, 0, ""),
            (agent.cpu_percent, 0, ""),
            (agent.rss_mb, 0, ""),
        ]
        table.add_row(
            str(agent.drone_id),
            *(_found(number(x, digits), agent.drone_id in short.get(key, ())) for x, digits, key in cells),
        )
    return table


def _found(text: str, short: bool) -> Text:
    """Of a table; what falls short is red, and marked where there are no colours."""
    return Text(f"! {text}", style="bold red") if short else Text(text)


def team_table(report: SwarmReport) -> Table:
    """Found beside expected."""
    table = _table("team")
    for heading in ("", "found", "expected"):
        table.add_column(heading, justify="left" if not heading else "right")
    for row in team_rows(report):
        table.add_row(row.what, _found(row.found, row.short), row.expected)
    return table


class Row(NamedTuple):
    """What was judged, found, expected."""

    what: str
    found: str
    expected: str = ""
    short: bool = False


def team_rows(report: SwarmReport) -> list[Row]:
    """All figures of the team, and those of single drones that fall short."""
    short = {short.key: short for short in report.shortfalls}
    rows = _rows_of_team(report)
    known = {key for key, _ in rows}
    return [
        *(row._replace(short=key in short) for key, row in rows),
        *(_row_of(one) for one in report.shortfalls if one.key not in known),
    ]


def _row_of(short: Shortfall) -> Row:
    what, _, _ = str(short).partition(": ")
    expected = short.expected
    for words, sign in ((" at most", "≤"), (" at least", "≥")):
        if expected.endswith(words):
            expected = f"{sign} {expected.removesuffix(words)}"
    return Row(
        what.replace("_hz", ", Hz,").replace("imu", "IMU").replace("_", " "), short.found, expected, True
    )


def _rows_of_team(report: SwarmReport) -> list[tuple[str, Row]]:
    """Each with the key of its shortfall."""
    score, limits = report.score, report.limits
    slowest = max(score.time_to_identify_s.values(), default=math.nan)
    worst = max(score.rmse_px.values(), default=math.nan)
    most_px = limits.rmse_px * report.image_width / REFERENCE_WIDTH
    rows = [("identity.correct", Row("correct names", share(score.correct), f"≥ {_percent(limits.correct)}"))]
    if score.proved > 0.0 or limits.proved > 0.0:
        least = f"≥ {_percent(limits.proved)}"
        rows.append(("identity.proved", Row("of these confirmed by motion", share(score.proved), least)))
    rows += [
        ("identity.wrong", Row("wrong names", share(score.wrong), f"≤ {_percent(limits.wrong)}")),
        ("", Row("highest confidence of a wrong name", number(score.wrong_max_probability, 3))),
        ("", Row("unknown", share(score.unknown))),
        ("identity.agreement", Row("agreement", share(score.agreement), f"≥ {_percent(limits.agreement)}")),
        (
            "identity.time_to_identify_s",
            Row("slowest identification, s", number(slowest, 1), f"≤ {limits.time_to_identify_s:.4g}"),
        ),
        (
            "announcements",
            Row(
                "all announcements received, s", number(report.all_known_s, 1), f"≤ {limits.all_known_s:.4g}"
            ),
        ),
        ("tracking.rmse_px", Row("worst RMSE, px", number(worst, 2), f"≤ {most_px:.4g}")),
        ("", Row("recall", share(score.recall))),
        (
            "tracking.false_tracks_per_s",
            Row(
                "false tracks per second",
                number(score.false_tracks_per_s, 3),
                f"≤ {limits.false_tracks_per_s:.4g}",
            ),
        ),
        ("", Row("switches", str(score.switches))),
    ]
    if report.relative.samples:
        places = report.relative
        ranges = f"{places.range_p50:.1%}, {places.range_p95:.1%}"
        rows += [
            ("", Row("range error, median and 95th percentile", ranges)),
            ("", Row("NEES / 6 of relative states, median", number(places.nees6_median, 2))),
        ]
    if report.formation is not None:
        rows += _formation_rows(report.formation, limits)
    return rows


def _formation_rows(formation: FormationScore, limits: Limits) -> list[tuple[str, Row]]:
    p50, p95 = number(formation.error_p50_m, 2), number(formation.error_p95_m, 2)
    end, apart = number(formation.end_p95_m, 2), number(formation.min_separation_m, 2)
    lost = f"{formation.lost} of {formation.followers}"
    rows = [
        ("error_m.p50", Row("slot error, median, m", p50, f"≤ {limits.slot_p50_m:g}")),
        ("error_m.p95", Row("slot error, 95th percentile, m", p95, f"≤ {limits.slot_p95_m:g}")),
        ("error_m.end_p95", Row("slot error at the end, m", end, f"≤ {limits.slot_end_p95_m:g}")),
        ("min_separation_m", Row("smallest separation, m", apart, f"≥ {limits.separation_m:g}")),
        ("lost", Row("followers lost", lost, f"≤ {limits.lost}")),
        ("holds", Row("holds of followers", str(formation.holds))),
    ]
    if formation.gone is not None:
        speed, away = number(formation.gone.speeds[-1], 2), number(formation.gone.flown_on_m, 1)
        fastest = Row("leader gone for 4 s: fastest follower, m/s", speed, f"≤ {limits.leader_gone_m_s:g}")
        rows += [
            ("leader_gone.speed_m_s, after 4 s", fastest),
            (
                "leader_gone.flown_on_m",
                Row("leader gone: distance flown on, m", away, f"≤ {limits.leader_gone_m:g}"),
            ),
        ]
    return [(f"formation.{key}", row) for key, row in rows]


def headline(report: SwarmReport) -> str:
    """The verdict in one sentence; the tables have the rest, in red."""
    no_wrong = " No wrong name was given." if report.score.samples and not report.score.wrong else ""
    match report.verdict:
        case Verdict.PASSED:
            return "PASSED" if report.detail == "full" else f"PASSED with {report.detail} detail"
        case Verdict.FAILED:
            return f"FAILED: {_clauses(report)}.{no_wrong}"
        case Verdict.NOT_JUDGED if report.is_cut_off:
            return f"NOT JUDGED: cut off after {report.cut_off_s:.0f} of {report.seconds:g} s.{no_wrong}"
        case Verdict.NOT_JUDGED:
            others = "" if math.isnan(report.others_busy) else f", other programs {report.others_busy:.0%}"
            busy = f"this machine was too busy (cores {report.machine_busy:.0%}{others})"
            return f"NOT JUDGED: {busy}.{no_wrong}"


def _clauses(report: SwarmReport) -> str:
    """The worst of what falls short; what is wrong comes first."""
    rows = {key: row for key, row in _rows_of_team(report) if key}
    short = [rows.get(one.key) or _row_of(one) for one in report.shortfalls]
    said = [_clause(row) for row in short[:MOST_CLAUSES]]
    more = len(short) - MOST_CLAUSES
    return ", ".join(said) + (f", and {more} more (marked !)" if more > 0 else "")


def _clause(row: Row) -> str:
    """The unit behind the number."""
    what, _, unit = row.what.rpartition(", ")
    if not what or len(unit) > len("m/s"):
        what, unit = row.what, ""
    found = "never" if row.found == "–" else f"{row.found} {unit}".rstrip()
    return f"{what} {found}" + (f" (expected {row.expected})" if row.expected else "")


def advice(report: SwarmReport) -> str:
    """What to do about a verdict that was none."""
    if report.verdict is not Verdict.NOT_JUDGED or report.is_cut_off:
        return ""
    return f"try again {lighter_flights(report.drones, report.detector)}"


def flight_end(report: SwarmReport, record: Path | None) -> FlightEnd:
    """For the page. record: the folder of the flight's recording."""
    return FlightEnd(
        {Verdict.PASSED: "ok", Verdict.FAILED: "bad", Verdict.NOT_JUDGED: "warn"}[report.verdict],
        headline(report),
        [line for line in [advice(report)] if line],
        [(row.what, row.found, row.expected, row.short) for row in team_rows(report)],
        f"swarmtrack monitor --recording {shlex.quote(str(record))}" if record is not None else "",
    )


def _table(title: str) -> Table:
    return Table(
        title=title,
        title_justify="left",
        title_style="bold",
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        pad_edge=False,
    )


def share(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.2%}"


def _percent(limit: float) -> str:
    return f"{100.0 * limit:.4g}%"


def number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "–"
