"""What an agent makes of what its transport tells, event by event: no network, no tasks but one."""

import asyncio
import logging
from dataclasses import replace

import numpy as np
import pytest

from support.patience import PATIENCE, eventually
from support.ports import free_port
from swarmtrack.clock import ManualClock, SystemClock
from swarmtrack.config.drone import load_config
from swarmtrack.config.team import TeamSection
from swarmtrack.diagnosis.readiness import SELF_DOUBT
from swarmtrack.messages import (
    Announcement,
    DoubtNews,
    EgoPose,
    HeadingNews,
    IdClash,
    LeapNews,
    MotionReport,
    OwnFault,
    PeerArrived,
    PeerDeparted,
    PeerExpelled,
    RangeReport,
    SightingReport,
)
from swarmtrack.outputs import periods
from swarmtrack.relative.range_watch import RangeNews
from swarmtrack.runtime.agent import make_health, make_notices, make_teamwork
from swarmtrack.runtime.assembly import assemble
from swarmtrack.runtime.health import HEALTH_EVENTS_KEPT
from swarmtrack.runtime.teamwork import LOG_LINES_PER_PERIOD, Teamwork
from swarmtrack.transport.memory import MemoryHub, MemoryTransport
from swarmtrack.wire import codec
from swarmtrack.wire.sightings import SightingsMessage, is_from_nowhere

CONFIG = """
drone.id = 1
network.transport = "memory"
autopilot.link = "none"
[camera]
source = "http://127.0.0.1:9/"
intrinsics = { fx = 600.0, fy = 600.0, cx = 320.0, cy = 256.0, width = 640, height = 512 }
"""


class Told:
    """In place of a transport: one whose events are known."""

    def __init__(self, events):
        self._events = events

    async def events(self):
        for event in self._events:
            yield event


@pytest.fixture
def parts(tmp_path):
    config = tmp_path / "drone.toml"
    config.write_text(CONFIG, encoding="utf-8")
    return assemble(load_config(config), SystemClock())


def listen(parts, events):
    told = replace(parts, transport=Told(events))
    health = make_health(parts)
    asyncio.run(make_teamwork(told, health, make_notices(told), told.door.tell).listen())
    return health


def announced(drone_id, sequence):
    return Announcement(drone_id, "0000000a", sequence, 0.0, 0.0, np.zeros(3), np.eye(3), np.eye(3))


def test_a_teammate_that_others_carry_is_said_once_and_so_is_its_return(parts):
    def report(leans_on):
        return SightingReport(2, "0000000a", 1, 0.0, 0.01, np.zeros(3), 0.2, (), (), leans_on)

    events = [
        PeerArrived(2, "0000000a"),
        announced(2, 1),
        report(()),
        report((3, 4)),
        report((3,)),
        report(()),
    ]
    assert [line for line in listen(parts, events).events if "position" in line] == [
        "drone 2 has no position of its own: held by 3 and 4",
        "drone 2 has a position of its own again",
    ]


def test_each_event_is_a_line_for_people(parts):
    story = [PeerArrived(2, "0000000a"), announced(2, 1), PeerDeparted(2, "0000000a")]
    assert [line.split(" (")[0] for line in listen(parts, story).events] == [
        "drone 2 is alive",
        "drone 2 announced itself",
        "drone 2 is gone",
    ]


def test_whoever_is_no_member_any_more_is_said_to_be(parts):
    (line,) = listen(parts, [PeerExpelled(3)]).events
    assert line == "drone 3 is no longer in the team's roster, its messages are ignored"


@pytest.mark.parametrize(
    "flood",
    [
        [announced(2, k) for k in range(1, 1001)],
        [IdClash(2, ("0000000a", f"{k:08x}"), ours=False) for k in range(1000)],
        [event for k in range(500) for event in (PeerArrived(2, f"{k:08x}"), PeerDeparted(2, f"{k:08x}"))],
    ],
    ids=["announcements", "clashes", "tokens"],
)
def test_a_teammate_that_floods_fills_no_log_and_what_the_others_do_is_still_told(parts, flood, caplog):
    caplog.set_level(logging.INFO, "swarmtrack.runtime.teamwork")
    health = listen(parts, [*flood, PeerArrived(3, "0000000b")])
    assert (
        LOG_LINES_PER_PERIOD < len(caplog.messages) <= 2 * LOG_LINES_PER_PERIOD + 1
    )  # as if ten seconds began anew meanwhile
    assert health.drops["events_untold"] >= len(flood) - 2 * LOG_LINES_PER_PERIOD
    assert health.events[-1] == "drone 3 is alive (boot 0000000b)"
    assert len(health.events) == HEALTH_EVENTS_KEPT


@pytest.mark.parametrize(
    ("happens", "news", "line"),
    [
        (
            Teamwork.on_heading,
            HeadingNews(5.0, -0.035),
            "our heading stepped by -2.0° against the gyro: announced again",
        ),
        (
            Teamwork.on_heading,
            HeadingNews(5.0, 2.618, 1.309),
            "our heading was reset by +150.0° against the gyro: the old one or the new one is wrong, so until we land "
            "it counts as known to ±75°; announced again",
        ),
        (
            Teamwork.on_heading,
            HeadingNews(5.0, 0.0),
            "our heading has been aligned in flight: announced again",
        ),
        (
            Teamwork.on_doubt,
            DoubtNews(5.0, doubted=True),
            f"{SELF_DOUBT}: until they agree, we announce our position as unknown",
        ),
        (
            Teamwork.on_doubt,
            DoubtNews(5.0, doubted=True, fault=OwnFault(heading=-0.52)),
            f"{SELF_DOUBT} (our heading is off by about 30°): until they agree, we announce our position as unknown",
        ),
        (
            Teamwork.on_doubt,
            DoubtNews(5.0, doubted=True, fault=OwnFault(start=(-2.1, 2.1))),
            f"{SELF_DOUBT} (we started about 3.0 m southeast of the stated start): until they agree, we announce our "
            "position as unknown",
        ),
        (
            Teamwork.on_doubt,
            DoubtNews(5.0, doubted=True, fault=OwnFault(pad_of=2)),
            f"{SELF_DOUBT} (we stand where drone 2 is stated to start): until they agree, we announce our position as "
            "unknown",
        ),
        (
            Teamwork.on_doubt,
            DoubtNews(5.0, doubted=False),
            "our start and heading fit what we see again: announced again",
        ),
    ],
)
async def test_a_pose_that_is_known_otherwise_is_announced_again_and_said_in_one_line(
    parts, happens, news, line
):
    hub = MemoryHub()
    transport = MemoryTransport(hub, "swarm", 1, parts.boot, parts.clock)
    listener = MemoryTransport(hub, "swarm", 9, "00000009", parts.clock)
    ours = replace(parts, transport=transport)
    health = make_health(ours)
    team = make_teamwork(ours, health, make_notices(ours), ours.door.tell)
    await listener.open()
    await transport.open()
    # Before the first announcement there is nothing to say again.
    team.on_heading(HeadingNews(4.0, 0.1))
    assert list(health.events) == []
    announcing = asyncio.create_task(team.announce())
    heard = []
    async with asyncio.timeout(PATIENCE):
        async for event in listener.events():
            if isinstance(event, Announcement):
                heard.append(event.sequence)
                if len(heard) == 1:
                    happens(team, news)
                else:
                    break
    announcing.cancel()
    await asyncio.gather(announcing, return_exceptions=True)
    await transport.close()
    await listener.close()
    assert heard == [1, 2]
    assert list(health.events) == [line]


@pytest.mark.parametrize(
    ("distance", "line"),
    [
        (
            206.0,
            "the distance to drone 2 by our ranging radio, 206.0 m, does not fit what we see and is not used: "
            "is it set up for that drone?",
        ),
        (None, "the distance to drone 2 by our ranging radio fits what we see again"),
    ],
)
def test_a_radio_that_does_not_fit_is_said_in_one_line(parts, distance, line):
    health = make_health(parts)
    team = make_teamwork(parts, health, make_notices(parts), parts.door.tell)
    team.on_range_news(RangeNews(5.0, 2, distance))
    assert list(health.events) == [line]


def test_a_position_that_jumped_is_said_in_one_line(parts):
    health = make_health(parts)
    make_teamwork(parts, health, make_notices(parts), parts.door.tell).on_leap(LeapNews(5.0, 10.02))
    assert list(health.events) == [
        "our autopilot's position jumped by 10.0 m, which was not flown: we go on from where we were"
    ]


def test_distances_are_told_to_onboard_without_a_line(parts):
    health = listen(parts, [PeerArrived(2, "0000000a"), RangeReport(1, 2, 0.0, 0.0, 8.0, 0.1)])
    assert len(health.events) == 1


FILED = """
[team]
announce = false
drones = { 1 = {}, 2 = { position_m = [5.0, 1.0, -0.1], position_sigma_m = 0.3 } }
"""


class Listening:
    """In place of a transport: one that nobody may send on."""

    async def events(self):
        return
        yield


def test_a_silent_drone_knows_its_teammates_from_the_file_and_says_nothing(parts, tmp_path):
    config = tmp_path / "silent.toml"
    config.write_text(CONFIG + FILED, encoding="utf-8")
    silent = replace(assemble(load_config(config), SystemClock()), transport=Listening())
    health = make_health(silent)
    team = make_teamwork(silent, health, make_notices(silent), silent.door.tell)

    async def fly():
        await team.listen()
        await asyncio.wait_for(asyncio.gather(team.announce(), team.report()), PATIENCE)
        team.ask_for_pose(2)

    asyncio.run(fly())
    assert list(silent.door.perceived.teammates) == [2]
    assert list(health.events) == ["drone 2 starts at [5.0, 1.0, -0.1] m, by the team's file"]


SWITCHED = """
[team]
code.switch = { channel = 8 }
drones = { 1 = {}, 2 = {}, 3 = {} }
"""


@pytest.mark.parametrize(
    ("second", "begins"), [(13.0, [20.0]), (19.5, [20.0, 30.0]), (20.5, [20.0, 30.0])], ids=str
)
def test_a_switch_starts_the_codes_of_all_others_at_the_next_full_ten_seconds(tmp_path, second, begins):
    """Also at those at which others may begin who saw it on the other side of a full ten seconds."""
    config = tmp_path / "drone.toml"
    link = f'"udpin:127.0.0.1:{free_port()}"'
    config.write_text(CONFIG.replace('"none"', link) + SWITCHED, encoding="utf-8")
    utc = 1777629600.0  # 2026-05-01T10:00:00Z
    clock = ManualClock(500.0, utc + second)
    switched = assemble(load_config(config), clock)
    health, told = make_health(switched), []
    team = make_teamwork(switched, health, make_notices(switched), told.append)
    team.on_switch(500.0)
    said = [(one.drone_id, round(one.t[0] - 500.0 + second, 6), one.tried) for one in told]
    assert [one for one in said if one[0] != 1] == [
        (drone_id, begin, True) for begin in begins for drone_id in (2, 3)
    ]
    # We ourselves begin at the one that our own clock says.
    assert [one for one in said if one[0] == 1] == [(1, 30.0 if second > 20.0 else 20.0, True)]
    own = "10:00:30" if second > 20.0 else "10:00:20"
    assert list(health.events) == [f"the pilot's switch: codes are flown from {own} UTC on"]


@pytest.fixture
def moving(parts):
    """Parts of a drone that flies north at 2 m/s and climbs at 1 m/s, two seconds long."""
    begin = parts.clock.now()
    for k in range(100):
        t = 0.02 * k
        flown = np.array([2.0 * t, 5.0, -1.0 * t])
        parts.door.tell(EgoPose(begin + t, flown, np.eye(3)))
    return parts


async def heard_of_sharing(parts):
    """All that is said of its motion until half a second after the first word, or in half a second."""
    hub = MemoryHub()
    transport = MemoryTransport(hub, "swarm", 1, parts.boot, parts.clock)
    listener = MemoryTransport(hub, "swarm", 9, "00000009", parts.clock)
    ours = replace(parts, transport=transport)
    team = make_teamwork(ours, make_health(ours), make_notices(ours), ours.door.tell)
    await listener.open()
    await transport.open()
    heard, spoken = [], asyncio.Event()

    async def listen():
        async for event in listener.events():
            if isinstance(event, MotionReport):
                heard.append(event)
                spoken.set()

    tasks = [asyncio.create_task(team.share()), asyncio.create_task(listen())]
    if parts.config.team.share == "velocity":
        await asyncio.wait_for(spoken.wait(), PATIENCE)
    await asyncio.sleep(0.5)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    await transport.close()
    await listener.close()
    return heard


async def test_a_drone_that_shares_its_velocity_tells_how_it_moves_and_nothing_twice(moving):
    team = TeamSection(share="velocity", share_hz=10.0)
    config = moving.config.model_copy(update={"team": team}, deep=True)
    # Its autopilot has fallen silent, so there is no second word.
    (said,) = await heard_of_sharing(replace(moving, config=config))
    np.testing.assert_allclose(said.velocity, [2.0, 0.0, -1.0], atol=1e-6)
    # Counted from the first word, wherever that was.
    np.testing.assert_allclose(said.displacement, 0.0, atol=1e-6)


async def test_by_default_nothing_is_said_of_the_motion(moving):
    assert await heard_of_sharing(moving) == []


async def test_a_drone_that_does_not_know_where_it_is_reports_that_it_lives(parts):
    hub = MemoryHub()
    transport = MemoryTransport(hub, "swarm", 1, parts.boot, parts.clock)
    ours = replace(parts, transport=transport)
    told: list[SightingsMessage] = []
    hub.listeners.append(
        lambda key, payload: (
            told.append(codec.decode(SightingsMessage, payload)) if "/identities/1" in key else None
        )
    )
    assert ours.door.perceived.sighting_report(parts.boot, 1) is None
    team = make_teamwork(ours, make_health(ours), make_notices(ours), ours.door.tell)
    await transport.open()
    reporting = asyncio.create_task(team.report())
    await eventually(lambda: told)
    reporting.cancel()
    await transport.close()
    assert (told[0].drone_id, told[0].boot, told[0].sightings) == (1, parts.boot, ())
    assert is_from_nowhere(told[0])


async def test_in_a_large_team_the_nearest_are_received_and_who_has_flown_far_announces_itself_again(
    parts, monkeypatch
):
    monkeypatch.setattr(periods, "NEIGHBOURS", 0.01)
    hub = MemoryHub()
    transport = MemoryTransport(hub, "swarm", 1, parts.boot, parts.clock)
    ours = replace(parts, transport=transport)
    announced: list[str] = []
    hub.listeners.append(lambda key, payload: announced.append(key) if key.endswith("/pose/1") else None)
    chosen: list[frozenset[int] | None] = []
    monkeypatch.setattr(transport, "receive_only", chosen.append)

    def fly(east):
        now = parts.clock.now()
        for k in range(-20, 1):
            parts.door.tell(EgoPose(now + 0.02 * k, np.array([0.0, east, -5.0]), np.eye(3)))

    team = make_teamwork(ours, make_health(ours), make_notices(ours), ours.door.tell)
    fly(0.0)
    await transport.open()
    tasks = [asyncio.create_task(team.announce()), asyncio.create_task(team.receive())]
    await eventually(lambda: announced and chosen)
    assert chosen[-1] is None
    fly(40.0)
    await asyncio.sleep(0.05)
    assert len(announced) == 1
    for drone in range(2, 62):
        place = np.array([0.0, 100.0 * drone, -5.0])
        parts.door.tell(
            Announcement(drone, "0000000a", 1, parts.clock.now(), 0.0, place, np.eye(3), np.eye(3))
        )
    await eventually(lambda: len(announced) == 2)
    assert chosen[-1] == set(range(2, 22))
    for task in tasks:
        task.cancel()
    await transport.close()
