"""A valid member that floods, from a process of its own: the loop turns, memory stays, the others are heard.

The limits are far above what is measured, for a machine that is busy; `pytest -s` shows the figures, and
`swarmtrack bench flood` makes the table of docs/wire.md.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import pytest

pytest.importorskip("zenoh", reason="Zenoh has no wheel here")

from swarmtrack.benchmarks.flood import BENCH, Sort, measure

SECONDS = 2.0
VALID = {Sort.ANNOUNCEMENTS, Sort.SIGHTINGS, Sort.TOKENS}  # what an agent has to be told of, if not all of it
AT_MOST_HZ = 300.0  # of one key four, twenty times a second; of tokens those of three boots, and what follows from each


def floods() -> list[Any]:
    """Of every sort; in the default run one that is valid, one that is forged, and tokens."""
    long = pytest.mark.long("four more floods; the default run has three")
    short = {Sort.SIGHTINGS, Sort.FORGERIES, Sort.TOKENS}
    return [
        pytest.param(sort, marks=() if sort in short else long) for sort in Sort if sort is not Sort.NOTHING
    ]


@pytest.mark.parametrize("sort", floods())
async def test_a_flood_by_a_member_stops_neither_the_loop_nor_the_others(sort: Sort) -> None:
    outcome = await measure(sort, SECONDS)
    assert f"| {sort} | " in BENCH.page({"floods": [asdict(outcome)]})
    print(f"\n  {outcome}", end="")
    assert outcome.sent_hz > 100, "no flood: the test would show nothing"
    # A loop that a flood holds up lags as long as the flood lasts; a busy machine makes it late, but not so late.
    assert outcome.lag_p95_ms < 1e3 * SECONDS / 4
    assert outcome.rss_after_mb - outcome.rss_before_mb < 30.0
    assert outcome.friend_heard >= outcome.friend_announced / 2
    told = outcome.events_hz - outcome.friend_heard / SECONDS
    assert told < (AT_MOST_HZ if sort in VALID else 2.0)
