"""A recorded flight as a bag of ROS 2, with the topics that `swarmtrack ros2` publishes."""

from __future__ import annotations

import json
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any, Final

from swarmtrack.client.recorded import with_cameras, with_progress
from swarmtrack.client.ros2_bridge import TeamBridge
from swarmtrack.clock import ManualClock
from swarmtrack.errors import RecordingError
from swarmtrack.monitor.recorded import read_timeline
from swarmtrack.outputs import ros2
from swarmtrack.outputs.ros2.cdr import Leaves, encode
from swarmtrack.outputs.ros2.node import QOS_DEFAULT
from swarmtrack.recording.reader import recordings_below

BAG_VERSION: Final = 9
"""Of its metadata: what Jazzy and later write."""


class BagTopics:
    """A `RosPublisher` that writes all that it is offered. t: UTC of the next messages, s."""

    def __init__(self, writer: Any, store: Any) -> None:
        self.t = 0.0
        self.written = 0
        self._writer, self._store = writer, store
        self._connections: dict[str, Any] = {}

    def declare(self, topic: str, kind: str, qos: str = QOS_DEFAULT) -> None:
        """Topics are in the bag from their first message on."""

    def offer(self, topic: str, kind: str, make: Callable[[], Leaves], qos: str = QOS_DEFAULT) -> None:
        """Write a message."""
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        self._writer.write(self._connections[topic], round(self.t * 1e9), encode(kind, make()))
        self.written += 1

    def has_listener(self, topic: str) -> bool:
        """Every topic is written."""
        return True

    async def forget(self, prefix: str) -> None:
        """What is written stays."""


def write_bag(paths: tuple[Path, ...], out: Path, *, hz: float, progress: Callable[[str], None]) -> int:
    """Number of messages written. out: a new folder. hz: of each drone's tracks, at most. Raises RecordingError."""
    from rosbags.rosbag2 import StoragePlugin, Writer, WriterError

    timeline = read_timeline(paths)
    for note in timeline.notes:
        progress(note)
    clock = ManualClock(0.0, 0.0)
    try:
        with Writer(out, version=BAG_VERSION, storage_plugin=StoragePlugin.MCAP) as writer:
            topics = BagTopics(writer, _typestore())
            bridge = TeamBridge(timeline.team, topics, namespace="swarm", hz=hz, clock=clock)
            samples = with_cameras(timeline, recordings_below(*paths), pictures=True)
            for sample in with_progress(samples, timeline, progress):
                topics.t = sample.arrived
                bridge.on_sample(sample)
    except (OSError, WriterError) as error:
        raise RecordingError(f"--out {out}: {error}, expected a new folder that can be written") from error
    return topics.written


def _typestore() -> Any:
    """Types of Jazzy, and vision_msgs, which rosbags has not."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    fields = json.loads(resources.files(ros2).joinpath("types.json").read_text("utf-8"))["fields"]
    for kind, entries in fields.items():
        if kind.startswith("vision_msgs/"):
            text = "\n".join(f"{of.replace('/msg/', '/')} {name}" for name, of in entries)
            store.register(get_types_from_msg(text, kind))
    return store
