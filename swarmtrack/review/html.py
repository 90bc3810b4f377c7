"""One page of a flight that needs nothing else: findings as text, charts as data that its own script draws.

Texts from outside (drones' words, files' names) go through `html.escape`, or into JSON whose `<`, `>` and `&` are
escaped; the script only ever sets them as text. A content security policy forbids any request.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from html import escape
from pathlib import Path
from typing import Any

from swarmtrack.diagnosis.findings import Level
from swarmtrack.diagnosis.surroundings import in_words
from swarmtrack.plain_text import hide_logins, plain
from swarmtrack.review.charts import charts
from swarmtrack.review.checks import FlightFinding, ReviewLine
from swarmtrack.review.flight import ReviewedFlight

PAGE_PARTS = Path(__file__).parent / "page"
MOST_SHOWN = 10  # lines; the rest is folded
POLICY = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
REVIEW_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width,initial-scale=1">
<title>{title}</title><style>{style}</style></head><body>
<h1>{headline}</h1><p class="dim">{about}</p>
{lines}
<div id="bar"><button id="in">zoom in</button><button id="out">zoom out</button><button id="all">whole flight</button>
<span id="range"></span><span>Ctrl + wheel or pinch: zoom; drag: move; double click: all</span></div>
<noscript>The charts need JavaScript, which is in this file.</noscript>
<div id="charts"></div><div id="tip"></div>
<script type="application/json" id="flight">{data}</script><script>{script}</script></body></html>
"""


def headline(flight: ReviewedFlight, lines: list[ReviewLine]) -> str:
    """The flight in one sentence."""
    failures = sum(line.first.finding.level is Level.FAILURE for line in lines)
    warnings = len(lines) - failures
    drones = f"{len(flight.drones)} drone{'s' if len(flight.drones) != 1 else ''}"
    what = " and ".join(
        f"{count} {word}{'s' if count != 1 else ''}"
        for count, word in ((failures, "failure"), (warnings, "warning"))
        if count
    )
    return (
        f"Team {plain(flight.team, 80)}, {drones}, {in_words(flight.seconds)}: {what or 'no fault was found'}"
    )


def clock(t: float) -> str:
    """Minutes and seconds."""
    return f"{int(t) // 60}:{int(t) % 60:02d}"


def subject(line: ReviewLine) -> str:
    """Drones that a line is about, in words."""
    drones = line.drones
    if not drones:
        return "team"
    return f"drone{'s' if len(drones) > 1 else ''} {', '.join(map(str, drones))}"


def render(flight: ReviewedFlight, lines: list[ReviewLine]) -> str:
    """The whole page."""
    begin = datetime.fromtimestamp(flight.begin_utc_s, UTC)
    truth = "with the truth of a simulation" if flight.truth else "without a truth to compare with"
    unrecorded = [str(one.drone_id) for one in flight.drones.values() if not one.recorded]
    about = f"{begin:%Y-%m-%d %H:%M:%S} UTC, {truth}"
    if unrecorded:
        about += f"; drones {', '.join(unrecorded)} did not record: shown is what was heard of them"
    title = headline(flight, lines)
    data = {"seconds": round(flight.seconds, 3), "charts": charts(flight)}
    return REVIEW_PAGE.format(
        policy=escape(POLICY),
        title=escape(title),
        style=(PAGE_PARTS / "page.css").read_text(encoding="utf-8"),
        headline=escape(title),
        about=escape(about),
        lines=_lines(lines),
        data=_json(data),
        script=(PAGE_PARTS / "page.js").read_text(encoding="utf-8"),
    )


def _lines(lines: list[ReviewLine]) -> str:
    if not lines:
        return '<p class="fine">No fault was found.</p>'
    first = "".join(map(_item, lines[:MOST_SHOWN]))
    rest = "".join(map(_item, lines[MOST_SHOWN:]))
    more = (
        f"<details><summary>{len(lines) - MOST_SHOWN} more</summary><ol>{rest}</ol></details>" if rest else ""
    )
    return f"<ol>{first}</ol>{more}"


def _item(line: ReviewLine) -> str:
    finding = line.first.finding
    others = "".join(
        f"<li>{_text(f'drone {one.drone_id}: {one.finding.found}')} {_when(one)}</li>"
        for one in line.findings[1:]
    )
    more = f"<ul>{others}</ul>" if others else ""
    who = (
        subject(line)
        if len(line.findings) == 1 or len(line.drones) < 2
        else f"{subject(line)}; drone {line.first.drone_id}"
    )
    return (
        f'<li class="{finding.level}"><span class="level">{finding.level}</span> <b>{escape(who)}</b>: '
        f'{_text(finding.found)} {_when(line.first)}<span class="remedy">{_text(finding.remedy)}</span>{more}</li>'
    )


def _when(one: FlightFinding) -> str:
    """A button that shows this time in the charts."""
    at = clock(one.begin) if one.end - one.begin < 1.0 else f"{clock(one.begin)}–{clock(one.end)}"
    return f'<button data-from="{one.begin:.2f}" data-to="{one.end:.2f}">{at}</button>'


def _text(text: str) -> str:
    return escape(plain(hide_logins(text)))


def _json(value: Any) -> str:
    """For a script element: no text can end it."""
    text = json.dumps(_plain(value), ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    for sign in "<>&\u2028\u2029":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return text


def _plain(value: Any) -> Any:
    if isinstance(value, str):
        return plain(hide_logins(value))
    if isinstance(value, list):
        return [_plain(one) for one in value]
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items()}
    return value


def as_records(lines: list[ReviewLine]) -> list[dict[str, Any]]:
    """The findings for JSON, in their order."""
    return [
        {
            "drone_id": one.drone_id,
            "fault": one.finding.fault,
            "check": one.finding.check,
            "level": str(one.finding.level),
            "found": plain(hide_logins(one.finding.found)),
            "remedy": one.finding.remedy,
            "begin_s": round(one.begin, 3),
            "end_s": round(one.end, 3),
            "lasted_s": round(one.seconds, 3),
            "line": number,
        }
        for number, line in enumerate(lines, start=1)
        for one in line.findings
    ]
