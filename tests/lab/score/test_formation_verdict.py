"""What a flight in formation comes to: contract 7's record, what falls short, and the table."""

from dataclasses import replace

import pytest
from rich.console import Console

from support.swarm_report import GOOD
from swarmtrack.lab.score.formation_score import FormationScore, LeaderGone
from swarmtrack.lab.score.swarm_verdict import Verdict
from swarmtrack.lab.swarm.table import team_table

HELD = FormationScore(
    followers=2, error_p50_m=0.4, error_p95_m=1.2, end_p95_m=0.7, min_separation_m=4.1, lost=0, holds=3
)
GONE = LeaderGone((1.4, 0.9, 0.3, 0.1), 3.5)


def flown(**changes):
    return replace(GOOD, formation=replace(HELD, **changes))


def test_the_record_has_errors_separation_lost_and_holds():
    assert flown().as_record()["formation"] == {
        "error_m": {"p50": 0.4, "p95": 1.2, "end_p95": 0.7},
        "min_separation_m": 4.1,
        "followers": 2,
        "lost": 0,
        "holds": 3,
    }
    gone = flown(gone=GONE).as_record()["formation"]["leader_gone"]
    assert gone == {"speed_m_s_after_1_2_3_4_s": [1.4, 0.9, 0.3, 0.1], "flown_on_m": 3.5}
    assert "formation" not in GOOD.as_record()


def test_a_formation_that_was_held_passes():
    assert flown().verdict is Verdict.PASSED
    assert flown(gone=GONE).verdict is Verdict.PASSED


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"error_p50_m": 1.4}, "formation.error_m.p50: 1.40, expected 1 at most"),
        ({"error_p95_m": float("nan")}, "formation.error_m.p95: nan, expected 2.5 at most"),
        ({"end_p95_m": 1.6}, "formation.error_m.end_p95: 1.60, expected 1.5 at most"),
        ({"lost": 1}, "formation.lost: 1, expected 0 at most"),
        ({"gone": GONE._replace(speeds=(1.4, 1.4, 1.4, 1.4))}, "leader_gone.speed_m_s, after 4 s: 1.40, expected 0.5"),
        ({"gone": GONE._replace(flown_on_m=7.0)}, "formation.leader_gone.flown_on_m: 7.00, expected 6 at most"),
    ],
)  # fmt: skip
def test_what_falls_short_is_said_and_excused_on_a_machine_that_had_no_time(changes, said):
    report = flown(**changes)
    assert report.verdict is Verdict.FAILED
    (short,) = report.shortfalls
    assert said in str(short)
    assert replace(report, machine_busy=0.99).verdict is Verdict.NOT_JUDGED


def test_no_busy_machine_excuses_that_somebody_came_too_near():
    report = replace(flown(min_separation_m=1.4), machine_busy=0.99)
    assert report.verdict is Verdict.FAILED
    assert [str(short) for short in report.shortfalls] == [
        "formation.min_separation_m: 1.40, expected 1.5 at least"
    ]


def test_the_table_fits_into_eighty_columns():
    console = Console(width=80, record=True)
    console.print(team_table(flown(gone=GONE, error_p95_m=23.36)))
    lines = console.export_text().splitlines()
    assert max(map(len, lines)) <= 80
    for words in ("followers lost", "0 of 2", "smallest separation, m", "leader gone: distance flown on, m"):
        assert any(words in line for line in lines), words
    assert not any("…" in line for line in lines)
