"""What the page is told of a follower: its slot, how far off it is, and why it holds."""

from __future__ import annotations

from dataclasses import replace

import pytest

from swarmtrack.clock import ManualClock
from swarmtrack.messages import LinkStatus
from swarmtrack.monitor.team import MonitoredTeam
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind, Sample
from swarmtrack.wire import codec
from swarmtrack.wire.health import HealthMessage, link_health

FLIES = LinkStatus(
    "formation",
    True,
    "0.4 m off its slot",
    (("leader", 1.0), ("slot_north_m", -2.5), ("slot_east_m", 4.33), ("engaged", 1.0), ("error_m", 0.41)),
)


def told(link: LinkStatus) -> dict:
    """Of drone 2, whose agent says that in its health."""
    (drone,) = state(link)["drones"]
    return drone


def state(*links: LinkStatus) -> dict:
    """Of drones 2, 3 and so on, one per link."""
    team = MonitoredTeam("red", ManualClock())
    for drone_id, link in enumerate(links, start=2):
        message = HealthMessage(
            version=1, t_utc_s=1.7e9, boot=f"0123abc{drone_id}", uptime_s=60.0, cpu_percent=5.0, rss_mb=96.0, rates={},
            latencies={}, clock_offset_s=None, clock_offset_sigma_s=None, links=(link_health(link),), drops={},
            events=(),
        )  # fmt: skip
        key = keys.key("red", Kind.HEALTH, drone_id)
        team.on_sample(Sample(key, codec.encode(message), alive=True, arrived=0.0))
    return team.state()


def test_a_formation_that_nobody_flies_is_the_headline():
    waits = replace(FLIES, text="waits for its pilot", counters=(*FLIES.counters[:3], ("engaged", 0.0)))
    light = state(waits)["light"]
    assert (light["kind"], light["text"]) == ("warn", "formation not flown: drone 2 waits for its pilot")
    assert "formation" not in state(FLIES)["light"]["text"]
    light = state(FLIES, waits)["light"]
    assert (light["kind"], light["text"]) == ("warn", "drone 3 is not in formation: it waits for its pilot")


def test_a_follower_tells_its_slot_and_how_far_off_it_is():
    drone = told(FLIES)
    assert drone["formation"] == {
        "leader": 1,
        "slot_m": [-2.5, 4.33],
        "engaged": True,
        "holds": False,
        "text": "0.4 m off its slot",
        "error_m": 0.41,
    }
    assert drone["troubles"] == []


def test_who_holds_says_why_and_knows_no_error():
    drone = told(replace(FLIES, ok=False, text="drone 1 is not in view", counters=FLIES.counters[:-1]))
    assert drone["formation"]["holds"]
    assert drone["formation"]["error_m"] is None
    assert drone["troubles"] == ["holds: drone 1 is not in view"]


@pytest.mark.parametrize("link", [replace(FLIES, name="camera"), replace(FLIES, counters=())])
def test_who_flies_in_no_formation_or_does_not_tell_its_slot_has_none(link):
    assert told(link)["formation"] is None
