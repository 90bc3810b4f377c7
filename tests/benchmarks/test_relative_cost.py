"""`swarmtrack bench relative-cost`: what it times is what it says. How long that takes is no test's business."""

import json

from swarmtrack.benchmarks import relative_cost as bench


def test_every_figure_is_of_as_many_teammates_as_it_says(tmp_path):
    result = bench.publish(tmp_path, 5)
    whats = [cost["what"] for cost in result["costs"]]
    assert [*whats[:7], whats[-2]] == [
        "read 1", "read 5", "read 10", "scan of 1", "scan of 5", "scan of 10", "align 150 mutual sightings",
        "metres in a message",
    ]  # fmt: skip
    assert (
        json.loads((tmp_path / "relative-cost.json").read_text(encoding="utf-8"))["costs"] == result["costs"]
    )
    drone = bench.Hovering(announced=True)
    drone.fly_on()
    assert all(entry.relative is not None for entry in drone.tracks().tracks)
