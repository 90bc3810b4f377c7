"""Names of a team whose configs are wrong, as the benchmark flies it."""

import pytest

from swarmtrack.benchmarks import misconfigured, report

ROWS = {row.name: row for row in misconfigured.rows()}


@pytest.mark.long("flies for 12 s with four drones; the golden table has this row")
def test_where_nothing_is_wrong_all_names_are_right_and_nobody_says_otherwise(monkeypatch):
    monkeypatch.setitem(misconfigured.SECONDS, "crossing", 12.0)
    flight = misconfigured.fly(ROWS["nothing"], "crossing", 0.1, "mbm", 1, share_hz=7.0)
    assert flight.score.wrong == 0.0
    assert flight.later.correct == 1.0
    assert flight.falsely == 0
    row = {"name": "nothing", **misconfigured.summary([flight])}
    assert report.table_of(misconfigured.BENCH.columns, [row]).endswith("| – | 0 of 0 | –, – | 0 | 100.0 |")


@pytest.mark.long(
    "flies for 12 s with four drones; team/test_names_by_motion.py swaps pads in the default run"
)
def test_one_posterior_names_drones_on_each_others_pads_and_they_say_so(monkeypatch):
    monkeypatch.setitem(misconfigured.SECONDS, "crossing", 12.0)
    row = ROWS["pads, moved on by one"]
    flight = misconfigured.fly(row, "crossing", 0.1, "mbm", 1, draws=True)
    assert flight.score.wrong == 0.0
    for faults in flight.faults.values():
        _, by_fault = faults[-1]
        assert sum(by_fault.values()) == pytest.approx(1.0)
        assert by_fault["mixed-up pads"] > 0.95
    assert flight.later.correct > 0.97
    assert sorted(flight.said_after) == [1, 2, 3, 4]
    assert max(flight.said_after.values()) < 2.0


@pytest.mark.long("20 s, until those that look to the other side have found out")
def test_a_team_that_looks_to_the_other_side_names_hardly_anybody_wrongly_and_never_surely():
    flight = misconfigured.fly(ROWS["compass, all 180°"], "crossing", 0.1, "mbm", 1, share_hz=7.0)
    assert flight.score.wrong < 0.005
    assert not flight.score.wrong_max_probability > 0.98
    assert flight.later.correct > 0.5
