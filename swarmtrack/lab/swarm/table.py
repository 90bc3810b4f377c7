"""What somebody who watches a local swarm is shown: a live table, or a line a second; and the tables at the end."""

from __future__ import annotations

import math
import shlex
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Protocol

from rich.box import SIMPLE_HEAD
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from swarmtrack.lab.scenarios.scenario import ScenarioFault
from swarmtrack.lab.score.formation_score import FormationScore
from swarmtrack.lab.score.swarm_score import JudgedTrack, SwarmScore
from swarmtrack.lab.score.swarm_verdict import Limits, SwarmReport, Verdict
from swarmtrack.lab.swarm.machine_load import lighter_flights
from swarmtrack.lab.swarm.watch import AgentView, Watch
from swarmtrack.messages import FOREIGN, Identity
from swarmtrack.outputs.flight_end import FlightEnd
from swarmtrack.wire.health import HealthMessage

LARGE_TEAM = 8  # from here on a line has no room for everybody
LAG_WORTH_A_WORD = 2.0  # s by which judging may be behind


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
                seen = sightings(agent.seen, watch.team)
                if self._shown.get(drone_id) != seen.plain:
                    self._shown[drone_id] = seen.plain
                    line.append(f" | {drone_id} sees ").append_text(seen)
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
    for agent in report.agents:
        table.add_row(
            str(agent.drone_id),
            number(report.score.time_to_identify_s.get(agent.drone_id, math.nan), 1),
            number(report.score.rmse_px.get(agent.drone_id, math.nan), 2),
            number(agent.track_rate_hz, 1),
            number(agent.imu_rate_hz, 1),
            number(agent.detection_rate_hz, 1),
            number(1e3 * agent.latency_p50_s, 0),
            number(1e3 * agent.latency_p95_s, 0),
            number(agent.cpu_percent, 0),
            number(agent.rss_mb, 0),
        )
    return table


def team_table(report: SwarmReport) -> Table:
    """Found beside expected."""
    table = _table("team")
    for heading in ("", "found", "expected"):
        table.add_column(heading, justify="left" if not heading else "right")
    for row in team_rows(report):
        table.add_row(*row)
    return table


def team_rows(report: SwarmReport) -> list[tuple[str, str, str]]:
    """What was judged, found, expected."""
    score, limits = report.score, report.limits
    slowest = max(score.time_to_identify_s.values(), default=math.nan)
    worst = max(score.rmse_px.values(), default=math.nan)
    rows = [("correct names", share(score.correct), f"≥ {limits.correct:g}")]
    if score.proved > 0.0 or limits.proved > 0.0:
        rows.append(("of these confirmed by motion", share(score.proved), f"≥ {limits.proved:g}"))
    rows += [
        ("wrong names", share(score.wrong), f"≤ {limits.wrong:g}"),
        ("highest confidence of a wrong name", number(score.wrong_max_probability, 3), ""),
        ("unknown", share(score.unknown), ""),
        ("agreement", share(score.agreement), f"≥ {limits.agreement:g}"),
        ("slowest identification, s", number(slowest, 1), f"≤ {limits.time_to_identify_s:g}"),
        ("all announcements received, s", number(report.all_known_s, 1), f"≤ {limits.all_known_s:g}"),
        ("worst RMSE, px", number(worst, 2), f"≤ {limits.rmse_px:g}"),
        ("recall", share(score.recall), ""),
        ("false tracks per second", number(score.false_tracks_per_s, 3), f"≤ {limits.false_tracks_per_s:g}"),
        ("switches", str(score.switches), ""),
    ]
    if report.relative.samples:
        places = report.relative
        ranges = f"{places.range_p50:.1%}, {places.range_p95:.1%}"
        rows += [
            ("range error, median and 95th percentile", ranges, ""),
            ("NEES / 6 of relative states, median", number(places.nees6_median, 2), ""),
        ]
    if report.formation is not None:
        rows += _formation_rows(report.formation, limits)
    return rows


def _formation_rows(formation: FormationScore, limits: Limits) -> list[tuple[str, str, str]]:
    errors = f"{number(formation.error_p50_m, 2)}, {number(formation.error_p95_m, 2)}"
    lost = f"{formation.lost} of {formation.followers}"
    rows = [
        (
            "slot error, median and 95th percentile, m",
            errors,
            f"≤ {limits.slot_p50_m:g}, {limits.slot_p95_m:g}",
        ),
        ("slot error at the end, m", number(formation.end_p95_m, 2), f"≤ {limits.slot_end_p95_m:g}"),
        ("smallest separation, m", number(formation.min_separation_m, 2), f"≥ {limits.separation_m:g}"),
        ("followers lost", lost, f"≤ {limits.lost}"),
        ("holds of followers", str(formation.holds), ""),
    ]
    if formation.gone is not None:
        gone = formation.gone
        rows += [
            (
                "leader gone for 4 s: fastest follower, m/s",
                number(gone.speeds[-1], 2),
                f"≤ {limits.leader_gone_m_s:g}",
            ),
            ("leader gone: distance flown on, m", number(gone.flown_on_m, 1), f"≤ {limits.leader_gone_m:g}"),
        ]
    return rows


def conclusion(report: SwarmReport) -> tuple[str, list[str]]:
    """The verdict in words, and what fell short; with advice where the machine was short itself."""
    match report.verdict:
        case Verdict.PASSED:
            detail = "" if report.detail == "full" else f" with {report.detail} detail"
            return f"PASSED{detail}", []
        case Verdict.FAILED:
            return "FAILED", report.shortfalls
        case Verdict.NOT_JUDGED:
            others = "" if math.isnan(report.others_busy) else f", other programs {report.others_busy:.0%}"
            busy = f"this machine was too busy (cores {report.machine_busy:.0%}{others})"
            advice = f"try again {lighter_flights(report.drones, report.detector)}"
            return f"NOT JUDGED: {busy}. No wrong name was given.", [*report.shortfalls, advice]


def flight_end(report: SwarmReport, record: Path | None) -> FlightEnd:
    """For the page. record: the folder of the flight's recording."""
    words, lines = conclusion(report)
    return FlightEnd(
        {Verdict.PASSED: "ok", Verdict.FAILED: "bad", Verdict.NOT_JUDGED: "warn"}[report.verdict],
        f"the flight is over: {words}",
        lines,
        team_rows(report),
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
    return "–" if math.isnan(value) else f"{value:.4f}"


def number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "–"
