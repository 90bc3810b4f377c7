"""`swarmtrack bench cost`: two checkouts by turns, and the ratio of the two. How fast is no test's business."""

from __future__ import annotations

import json

import pytest

from swarmtrack.benchmarks import cost, cost_probe
from swarmtrack.benchmarks.report import BenchmarkError


def test_two_checkouts_are_probed_by_turns_and_compared(tmp_path, monkeypatch):
    monkeypatch.setattr(cost, "QUICK", {"trackers": 3})
    result = cost.BENCH.publish(tmp_path, quick=True, beside=cost.HERE)
    assert result["here"].keys() == result["beside"].keys()
    assert "mbm, 2 settled tracks, ms" in result["here"]
    assert json.loads((tmp_path / "cost.json").read_text(encoding="utf-8"))["here"] == result["here"]
    assert "| here / beside |" in (tmp_path / "cost.md").read_text(encoding="utf-8")


def test_a_checkout_that_is_none_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(cost_probe, "__file__", str(tmp_path / "missing.py"))
    with pytest.raises(BenchmarkError, match=r"trackers of .* failed"):
        cost.probed(tmp_path, "trackers", 1)
