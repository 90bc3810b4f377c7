"""Names by motion alone: a flight is repeatable, names are right, and a liar is found."""

from swarmtrack.benchmarks.motion import BENCH, ROWS, STRANGER, summarise, trial

ROW = {row.name: row for row in ROWS}


def test_in_free_flight_all_are_named_in_seconds_and_the_same_seed_is_the_same_flight():
    flown, again = (trial(ROW["free flight"], 3, seed=0) for _ in range(2))
    assert flown.names == {0: 0, 1: 1, 2: 2}
    assert flown.named < 6.0
    assert (flown.named, flown.names) == (again.named, again.names)


def test_who_tells_another_motion_is_a_stranger_and_who_tells_another_s_has_its_name():
    spoofed = trial(ROW["free flight, one is spoofed"], 3, seed=1)
    swapped = trial(ROW["hover, two IDs swapped"], 3, seed=1)
    # What is left over at first is its own name.
    assert spoofed.names in ({0: STRANGER, 1: 1, 2: 2}, {0: 0, 1: 1, 2: 2})
    assert spoofed.said <= spoofed.found < 20.0
    assert spoofed.accused == swapped.accused == set()
    assert swapped.names == {0: 1, 1: 0, 2: 2}
    row = summarise(ROW["hover, two IDs swapped"], 3, [swapped])
    assert (row["names"], row["wrong"]) == (3, 0)


def test_the_page_has_a_row_for_each_way_to_fly_and_team(tmp_path):
    BENCH.publish(tmp_path, seeds=1, teams=[2])
    assert "| hover, two IDs swapped | 2 | 1 |" in (tmp_path / "motion.md").read_text(encoding="utf-8")
