"""The table of ROS 2 types that swarmtrack speaks:
`python tests/support/ros2_types.py > swarmtrack/outputs/ros2/types.json`.

Hashes and layouts are those of `rosbags`, which has the definitions of each distribution; vision_msgs 4.1.1 is below,
because it has not. A hash that differs between distributions ends the program: then the table needs a column for each.
"""

import json
import sys

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

DISTRIBUTIONS = (Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY, Stores.ROS2_KILTED)
SPOKEN = (
    "diagnostic_msgs/msg/DiagnosticArray",
    "geometry_msgs/msg/PoseArray",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TwistWithCovarianceStamped",
    "nav_msgs/msg/Odometry",
    "sensor_msgs/msg/CameraInfo",
    "sensor_msgs/msg/CompressedImage",
    "tf2_msgs/msg/TFMessage",
    "vision_msgs/msg/Detection2DArray",
    "visualization_msgs/msg/MarkerArray",
)
VISION = {
    "Detection2DArray": "std_msgs/Header header\nDetection2D[] detections",
    "Detection2D": "std_msgs/Header header\nObjectHypothesisWithPose[] results\nBoundingBox2D bbox\nstring id",
    "ObjectHypothesisWithPose": "ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose",
    "ObjectHypothesis": "string class_id\nfloat64 score",
    "BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y",
    "Pose2D": "vision_msgs/Point2D position\nfloat64 theta",
    "Point2D": "float64 x\nfloat64 y",
}


def store_of(distribution):
    """All types of a distribution, and vision_msgs."""
    store = get_typestore(distribution)
    store.register(
        {k: v for n, t in VISION.items() for k, v in get_types_from_msg(t, f"vision_msgs/msg/{n}").items()}
    )
    return store


def kind_of(description):
    """A field's type as ROS writes it: `float64`, `geometry_msgs/msg/Point[]`, `float64[36]`."""
    node, value = description
    match node:
        case Nodetype.BASE:
            return value[0]
        case Nodetype.NAME:
            return value
        case Nodetype.ARRAY:
            return f"{kind_of(value[0])}[{value[1]}]"
        case Nodetype.SEQUENCE:
            return f"{kind_of(value[0])}[]"


def table():
    """`hashes` of the types that are published, and `fields` of these and of all within."""
    stores = [store_of(distribution) for distribution in DISTRIBUTIONS]
    fields, waiting = {}, list(SPOKEN)
    while waiting:
        name = waiting.pop()
        found = [[[key, kind_of(kind)] for key, kind in store.fielddefs[name][1]] for store in stores]
        assert all(each == found[0] for each in found), f"{name} differs between distributions"
        fields[name] = found[0]
        waiting += {kind.partition("[")[0] for _, kind in found[0] if "/" in kind} - set(fields)
    hashes = {name: {store.hash_rihs01(name) for store in stores} for name in SPOKEN}
    assert all(len(each) == 1 for each in hashes.values()), "a hash differs between distributions"
    return {
        "hashes": {name: each.pop() for name, each in hashes.items()},
        "fields": dict(sorted(fields.items())),
    }


if __name__ == "__main__":
    text = json.dumps(table(), indent=1)
    # A field per line is enough.
    sys.stdout.write(
        text.replace('[\n    "', '["').replace('",\n    "', '", "').replace('"\n   ]', '"]') + "\n"
    )
