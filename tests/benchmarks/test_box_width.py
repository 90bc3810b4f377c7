"""`swarmtrack bench box-width`: what it says of a detector is what its boxes are like."""

import json

import numpy as np
import pytest

from swarmtrack.benchmarks import box_width as bench
from swarmtrack.calibration.box_width import WidthFit
from swarmtrack.detection.detector import Detector
from swarmtrack.relative.box_width import BoxWidth


@pytest.mark.long("draws two flights for the second stage; the default run draws one for the detector alone")
def test_spans_that_the_shipped_second_stage_tells_are_as_wide_as_its_metadata_say(tmp_path):
    result = bench.BENCH.publish(tmp_path, seeds=2, processes=1)
    said = Detector().second_stage.box_width
    drawn = result["rows"]["drawn"]
    assert drawn["boxes"] > 300
    for span_px in (15.0, 50.0):
        width = drawn["factor"] * span_px + drawn["padding_px"]
        assert width == pytest.approx(said.factor * span_px + said.padding_px, rel=0.12)
    assert abs(drawn["ranges"]["bias"]) < 0.03
    assert drawn["ranges"]["within"] < 0.1
    written = json.loads((tmp_path / "box-width.json").read_text(encoding="utf-8"))
    assert written["stated"] == result["stated"]
    assert "for the metadata" in (tmp_path / "box-width.md").read_text(encoding="utf-8")


@pytest.mark.long("draws and detects for seconds; what it measures changes with the detector alone")
def test_boxes_of_the_detector_alone_are_loose(tmp_path):
    result = bench.BENCH.publish(tmp_path, seeds=1, second_stage="none", processes=1)
    said, drawn = Detector(second_stage="none").box_width, result["rows"]["drawn"]
    for span_px in (15.0, 50.0):
        width = drawn["factor"] * span_px + drawn["padding_px"]
        assert width == pytest.approx(said.factor * span_px + said.padding_px, rel=0.2)


def test_errors_of_ranges_are_those_of_the_believed_line():
    t, span = np.arange(100) / 10.0, np.full(100, 20.0)
    off = 0.1 * (-1.0) ** np.arange(100)
    some = [bench.Widths(t, span, (1.5 * span * np.exp(lasting + off) + 4.0)) for lasting in (0.0, 0.2)]
    bias, drone, within = bench.range_errors(some, BoxWidth(factor=1.5, padding_px=4.0))
    assert (bias, drone, within) == pytest.approx((-0.1, 0.1, 0.1))


def test_a_model_states_errors_as_large_as_on_any_drone():
    drawn = BoxWidth(
        factor=1.1, padding_px=16.0, drone_sigma=0.04, wander_sigma=0.2, wander_s=1.0, white_sigma=0.02
    )
    real = BoxWidth(factor=0.8, drone_sigma=0.19, wander_sigma=0.13, wander_s=2.0, white_sigma=0.06)
    stated = bench.stated(WidthFit(drawn, 1000, 24, True, True, ()), real)
    assert stated == BoxWidth(
        factor=1.1, padding_px=16.0, drone_sigma=0.19, wander_sigma=0.2, wander_s=2.0, white_sigma=0.06
    )
