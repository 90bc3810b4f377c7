"""What a viewer reads of a recording: protobuf messages, decoded by the schemas in the file and nothing of ours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from swarmtrack.recording.reader import recordings_below


def message_class(name: str, schema: bytes) -> Any:
    """schema: a compiled description, as a channel of a recording has it."""
    pb2 = pytest.importorskip("google.protobuf.descriptor_pb2", reason="protobuf is not installed")
    from google.protobuf import descriptor_pool, message_factory  # noqa: PLC0415

    pool = descriptor_pool.DescriptorPool()
    for file in pb2.FileDescriptorSet.FromString(schema).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


def decoded(folder: Path) -> dict[str, list[Any]]:
    """All protobuf messages of the one recording there, by topic."""
    (recording,) = recordings_below(folder)
    messages = list(recording.messages())
    classes = {}
    for segment in recording.segments:
        for channel in segment.channels.values():
            schema = segment.schemas[channel.schema_id]
            if schema.encoding == "protobuf" and channel.topic not in classes:
                classes[channel.topic] = message_class(schema.name, schema.data)
    found: dict[str, list[Any]] = {topic: [] for topic in classes}
    for message in messages:
        if message.topic in classes:
            found[message.topic].append(classes[message.topic].FromString(message.data))
    return found
