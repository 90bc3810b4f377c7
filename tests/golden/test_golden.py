"""The golden set: results stay as they are unless a commit changes them on purpose."""

from __future__ import annotations

import pytest

pytest.importorskip("foxglove", reason="foxglove-sdk has no wheel here")

from support.golden import differences
from support.golden.parts import PARTS


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(
            name,
            marks=pytest.mark.long("replays and flies for two minutes; `.ci/run` does")
            if name in ("flights", "tables")
            else (),
        )
        for name in PARTS
    ],
)
def test_nothing_moves_by_accident(name):
    moved = [f"{each.name}: {each.how}" for each in differences(PARTS[name]) if each.beyond_rounding]
    assert not moved, "\n".join([*moved, "", "if this is meant: python tests/golden --accept, and say why"])
