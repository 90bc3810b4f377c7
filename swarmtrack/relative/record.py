"""A relative state as JSON has it (DESIGN.md, contract 5)."""

from __future__ import annotations

from typing import Any

import numpy as np

from swarmtrack.messages import RelativeState


def relative_record(state: RelativeState) -> dict[str, Any]:
    """North, east, down; cov is the upper triangle of (position, velocity), row by row: 21 numbers."""
    upper = state.cov[np.triu_indices(6)]
    return {
        "position_m": [round(value, 4) for value in state.position.tolist()],
        "velocity_m_s": [round(value, 4) for value in state.velocity.tolist()],
        "cov": [float(f"{value:.6g}") for value in upper.tolist()],
        "range_sigma_log": round(state.range_sigma_log, 5),
        "sources": list(state.sources),
    }
