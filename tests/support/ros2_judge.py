"""A ROS 2 user in a process of its own: `python ros2_judge.py PORT TOPIC…` prints what it read as JSON.

It knows nothing of swarmtrack. `zenoh_ros2_sdk` opens the session as rmw_zenoh does and lists the topics. Keys are made
with the hashes in ROS 2's own JSON. Each payload goes through an rclpy node: published as bytes and received as a
message by real ROS 2. tf2_msgs and vision_msgs are in no registry, so `rosbags` decodes these.
"""

import json
import os
import sys
import time
from importlib import import_module
from pathlib import Path

import numpy as np
import rclpy
from rclpy.qos import QoSProfile
from zenoh_ros2_sdk import ZenohSession, get_topic_names_and_types
from zenoh_ros2_sdk.attachment import Attachment
from zenoh_ros2_sdk.keyexpr import topic_keyexpr
from zenoh_ros2_sdk.utils import ros2_to_dds_type

from support.ros2_types import DISTRIBUTIONS, store_of

SHARE = Path(sys.prefix) / "share"
DEADLINE = time.monotonic() + 60.0
KEPT = 2  # messages of each topic
STORE = store_of(DISTRIBUTIONS[-1])
FOREIGN_TO_RCLPY = ("tf2_msgs", "vision_msgs")


def hash_of(kind):
    """As ROS 2 ships it; of what is not installed, as rosbags computes it."""
    path = SHARE / f"{kind}.json"
    if kind.startswith(FOREIGN_TO_RCLPY):
        return STORE.hash_rihs01(kind)
    hashes = json.loads(path.read_text())["type_hashes"]
    return next(each["hash_string"] for each in hashes if each["type_name"] == kind)


def class_of(kind):
    package, _, name = kind.split("/")
    return getattr(import_module(f"{package}.msg"), name)


def plain(value):
    """A message as dictionaries, lists and numbers."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if hasattr(value, "__dataclass_fields__"):
        return {
            name: plain(getattr(value, name)) for name in value.__dataclass_fields__ if name != "__msgtype__"
        }
    if isinstance(value, bytes):
        return len(value)
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, str | int | float | bool):
        return value
    items = list(value)
    return len(items) if len(items) > 1000 else [plain(item) for item in items]


class Reader:
    """Of one topic."""

    def __init__(self, node, session, topic, kind):
        self.kind, self.messages, self.attachments, self.raw = kind, [], [], []
        self._publisher = None
        if not kind.startswith(FOREIGN_TO_RCLPY):
            message, qos = class_of(kind), QoSProfile(depth=10)
            self._publisher = node.create_publisher(message, f"/heard{topic}", qos)
            node.create_subscription(message, f"/heard{topic}", lambda m: self.messages.append(plain(m)), qos)
        key = topic_keyexpr(0, topic, ros2_to_dds_type(kind), hash_of(kind))
        self._subscriber = session.declare_subscriber(key, self._hear)

    def _hear(self, sample):
        self.raw.append((sample.payload.to_bytes(), sample.attachment.to_bytes()))

    def pass_on(self):
        """What has come to ROS 2."""
        while self.raw:
            payload, attachment = self.raw.pop(0)
            read = Attachment.from_bytes(attachment)
            self.attachments.append([read.sequence_id, read.timestamp_ns / 1e9, len(read.gid)])
            if self._publisher is None:
                self.messages.append(plain(STORE.deserialize_cdr(payload, self.kind)))
            else:
                self._publisher.publish(payload)


def main(port, wanted):
    """Until `KEPT` messages of each wanted topic are read, or the time is up."""
    rclpy.init()
    node = rclpy.create_node("judge")
    begin = time.monotonic()
    listed, readers = {}, {}
    while time.monotonic() < DEADLINE:
        if not set(wanted) <= set(listed):
            listed = {name: kinds[0] for name, kinds in get_topic_names_and_types(0, "127.0.0.1", port, 0.2)}
        session = ZenohSession.get_instance("127.0.0.1", port).session
        for topic in set(listed) & set(wanted) - set(readers):
            readers[topic] = Reader(node, session, topic, listed[topic])
        rclpy.spin_once(node, timeout_sec=0.01)
        for reader in readers.values():
            reader.pass_on()
        if set(wanted) <= set(readers) and all(len(reader.messages) >= KEPT for reader in readers.values()):
            break
    tokens = session.liveliness().get("@ros2_lv/**", timeout=1.0)
    found = {
        "seconds": time.monotonic() - begin,
        "topics": listed,
        "tokens": [str(reply.ok.key_expr) for reply in tokens if reply.ok],
        "messages": {topic: reader.messages for topic, reader in readers.items()},
        "attachments": {topic: reader.attachments for topic, reader in readers.items()},
    }
    print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2:])
    os._exit(0)  # neither session ends by itself
