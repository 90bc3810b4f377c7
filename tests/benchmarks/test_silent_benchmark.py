"""Who is who without a word on the air, in a few flights: nobody is called by another's name."""

from __future__ import annotations

import pytest

from swarmtrack.benchmarks import report, silent


@pytest.mark.parametrize("seeds", [(1,), pytest.param((2, 3), marks=pytest.mark.long("two seeds more"))])
@pytest.mark.parametrize(
    "mode",
    [
        *silent.MODES[1::2],
        *(
            pytest.param(
                mode, marks=pytest.mark.long("wider slots, and slots with codes, are in the default run")
            )
            for mode in silent.MODES[::2]
        ),
    ],
    ids=lambda mode: mode.words,
)
def test_nobody_is_called_by_another_s_name(mode, seeds):
    flights = [silent.look(3, mode, "mbm", seed) for seed in seeds]
    assert sum(flight.wrong for flight in flights) == 0
    if mode.code:
        assert max(flight.all_named_s for flight in flights) < 8.0


def test_codes_name_a_team_within_seconds():
    flight = silent.look(5, silent.MODES[2], "mbm", 2)
    assert (flight.named, flight.wrong) == (5, 0)
    assert flight.all_named_s < 5.0


def test_the_page_says_what_was_flown():
    flights = [silent.Flight(2.0, 3, 0), silent.Flight(float("inf"), 2, 1)]
    row = silent.summary(3, flights)
    assert row["all_named_s"] == {"p50": 2.0, "p95": float("inf")}
    assert row["named"]["value"] == pytest.approx(5 / 6)
    assert (row["wrong_names"], row["names"]) == (1, 6)
    page = report.table_of(silent.BENCH.columns, [{"mode": "code", "drones": 3, **row}])
    assert "| code | 3 | 2.0 | – | 83.3 (" in page
