"""What an agent's line of each second says of what does not work."""

from swarmtrack.messages import LinkStatus
from swarmtrack.runtime.publishers import Troubles


def test_a_reason_is_said_once_and_then_only_who_is_waited_for():
    troubles = Troubles()
    camera = LinkStatus("camera", False, "/dev/video0 is not there; waiting for it")
    autopilot = LinkStatus("autopilot", False, "nothing from autopilot 1 for 4 s")
    network = LinkStatus("zenoh", True, "linked")
    assert troubles.notes([camera, autopilot, network], 100.0) == [
        "camera: /dev/video0 is not there; waiting for it",
        "autopilot: nothing from autopilot 1 for 4 s",
    ]
    later = LinkStatus("autopilot", False, "nothing from autopilot 1 for 5 s")
    assert troubles.notes([camera, later, network], 112.0) == ["waiting for camera 12 s, autopilot 12 s"]
    busy = LinkStatus("camera", False, "/dev/video0: busy, held by cheese")
    assert troubles.notes([busy, later], 113.0) == [
        "camera: /dev/video0: busy, held by cheese",
        "waiting for autopilot 13 s",
    ]
    assert troubles.notes([LinkStatus("camera", True, "streaming")], 114.0) == []
    assert troubles.notes([camera], 120.0) == ["camera: /dev/video0 is not there; waiting for it"]
