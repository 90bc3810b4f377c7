"""`swarmtrack bench cost --of metres`: what it times is what it says. How long that takes is no test's business."""

import argparse

from swarmtrack.benchmarks import relative_cost as bench


def test_every_figure_is_of_as_many_teammates_as_it_says(monkeypatch):
    monkeypatch.setattr(bench, "QUICK_REPEATS", 5)
    whats = [figure.what for figure in bench.measured(argparse.Namespace(quick=True))]
    assert [*whats[:6], whats[-2]] == [
        "read 1", "read 5", "read 10", "scan of 1", "scan of 5", "scan of 10",
        "metres in a message",
    ]  # fmt: skip
    drone = bench.Hovering(announced=True)
    drone.fly_on()
    assert all(entry.relative is not None for entry in drone.tracks().tracks)
