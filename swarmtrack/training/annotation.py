"""Metadata of a net in a model's file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import onnx


def annotate(path: Path, changes: Mapping[str, str]) -> None:
    """Change metadata of a written model, such as a score threshold chosen after its evaluation."""
    model = onnx.load(str(path))
    present = {entry.key: entry for entry in model.metadata_props}
    for key, value in changes.items():
        entry = present.get(f"swarmtrack.{key}") or model.metadata_props.add()
        entry.key, entry.value = f"swarmtrack.{key}", value
    onnx.save(model, str(path))
