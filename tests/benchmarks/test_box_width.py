"""`swarmtrack bench box-width`: what it says of a detector is what its boxes are like."""

import json

import pytest

from swarmtrack.benchmarks import box_width as bench
from swarmtrack.calibration.box_width import WidthFit
from swarmtrack.relative.box_width import BoxWidth


def test_boxes_of_the_shipped_detector_are_as_wide_as_its_metadata_say(tmp_path):
    pytest.importorskip("matplotlib", reason="plots are an extra")
    result = bench.publish(tmp_path, 2, processes=1)
    said = bench.detector_of(bench.DetectorSection(), bench.SystemClock()).description.box_width
    drawn = result["drawn"]
    assert drawn["boxes"] > 300
    for span_px in (15.0, 50.0):
        width = drawn["factor"] * span_px + drawn["padding_px"]
        assert width == pytest.approx(said.factor * span_px + said.padding_px, rel=0.12)
    written = json.loads((tmp_path / "box-width.json").read_text(encoding="utf-8"))
    assert written["stated"] == result["stated"]
    assert (tmp_path / "box-width.png").exists()
    assert "for the metadata" in (tmp_path / "box-width.md").read_text(encoding="utf-8")


def test_a_model_states_errors_as_large_as_on_any_drone():
    drawn = BoxWidth(
        factor=1.1, padding_px=16.0, drone_sigma=0.04, wander_sigma=0.2, wander_s=1.0, white_sigma=0.02
    )
    real = BoxWidth(factor=0.8, drone_sigma=0.19, wander_sigma=0.13, wander_s=2.0, white_sigma=0.06)
    stated = bench.stated(WidthFit(drawn, 1000, 24, True, True, ()), real)
    assert stated == BoxWidth(
        factor=1.1, padding_px=16.0, drone_sigma=0.19, wander_sigma=0.2, wander_s=2.0, white_sigma=0.06
    )
