"""The page of a team that says nothing: whom one could hear instead."""

from __future__ import annotations

import asyncio
import re

from support import recorded_swarm
from support.patience import eventually
from swarmtrack.clock import ManualClock
from swarmtrack.errors import TransportError
from swarmtrack.monitor import live
from swarmtrack.monitor.live import LiveFeed
from swarmtrack.monitor.team import START_ONE, STARTING, MonitoredTeam
from swarmtrack.outputs.flight_end import FlightEnd
from swarmtrack.transport.base import Sample
from swarmtrack.transport.listening import hint_at, other_teams


class Silence:
    """A listener that hears nobody of its team. others: whose drones are within reach."""

    def __init__(self, *others: str) -> None:
        self.others = set(others)
        self.looks = 0
        self.ended = asyncio.Event()

    async def samples(self):
        await self.ended.wait()
        return
        yield

    async def teams(self) -> set[str]:
        self.looks += 1
        if self.looks == 3:
            self.ended.set()
        return self.others | {"red"}


class Somebody:
    """Looks at drone 1."""

    is_there = True
    watched = frozenset({(1, 0)})

    def __init__(self) -> None:
        self.told: list[dict] = []

    def broadcast(self, state: dict) -> None:
        self.told.append(state)


async def test_when_the_flight_is_over_the_page_keeps_what_it_showed_and_the_verdict(monkeypatch):
    monkeypatch.setattr(live, "STATE_HZ", 200.0)
    clock = ManualClock(0.0)
    team, listener, over, viewer = MonitoredTeam("red", clock), Silence(), asyncio.Event(), Somebody()
    rows = [("correct names", "90.00%", "≥ 97%", True)]
    ends = [
        FlightEnd("idle", "it is being judged", [], []),
        FlightEnd("bad", "FAILED: why", ["a line"], rows, "look"),
    ]

    async def ending() -> FlightEnd | None:
        await over.wait()
        return ends.pop(0) if ends else None

    feed = asyncio.create_task(LiveFeed(team, listener, ending).run(viewer))
    await eventually(lambda: viewer.told)
    assert viewer.told[-1]["starting"] is True
    assert viewer.told[-1]["light"]["also"] == [STARTING]
    team.on_sample(Sample("swarmtrack/red/v1/alive/1/00000001", b"", True, 0.0))
    over.set()
    await eventually(lambda: viewer.told[-1].get("over", {}).get("rows"))
    clock.set(60.0)  # drone 1 is long gone
    count = len(viewer.told)
    await eventually(lambda: len(viewer.told) >= count + 3)
    last = viewer.told[-1]
    assert last["light"] == {"kind": "bad", "text": "FAILED: why", "also": ["a line"]}
    assert last["over"] == {"rows": rows, "again": "look"}
    assert last["again"] is False, "nobody said a word that could be played again"
    assert [drone["gone_s"] for drone in last["drones"]] == [None]
    listener.ended.set()
    await feed


async def test_a_flight_that_is_over_is_played_again_as_it_was_heard(monkeypatch):
    monkeypatch.setattr(live, "STATE_HZ", 200.0)
    clock, spoken, viewer = ManualClock(0.0, recorded_swarm.UTC), asyncio.Event(), Somebody()
    ends = [FlightEnd("ok", "PASSED", [], [])]

    class Flight(Silence):
        async def samples(self):
            for t in range(4):
                clock.set(float(t))
                yield Sample(f"swarmtrack/red/v1/alive/{t + 1}/0000000{t + 1}", b"", True, clock.now())
            spoken.set()
            await self.ended.wait()

    async def ending() -> FlightEnd | None:
        await spoken.wait()
        return ends.pop(0) if ends else None

    listener = Flight()
    feed = LiveFeed(MonitoredTeam("red", clock), listener, ending)
    running = asyncio.create_task(feed.run(viewer))
    await eventually(lambda: viewer.told and viewer.told[-1].get("over"))
    assert viewer.told[-1]["again"] is True
    assert not feed.on_wish({"seek": 1.0}), "what is over is not wound back before it is played"
    assert feed.on_wish({"again": True})
    await eventually(lambda: "playback" in viewer.told[-1])
    assert viewer.told[-1]["playback"]["seconds"] == 3.0
    assert feed.on_wish({"seek": 1.5})
    await eventually(lambda: len(viewer.told[-1]["drones"]) == 2)
    assert feed.on_wish({"again": False})
    await eventually(lambda: viewer.told[-1].get("over"))
    listener.ended.set()
    await running


class Nobody:
    """Looks at the page."""

    is_there = False
    watched: frozenset[tuple[int, int]] = frozenset()


async def test_a_silent_teams_page_names_those_that_are_heard_and_the_terminal_once(monkeypatch, caplog):
    monkeypatch.setattr(live, "LIVE_PEERS_PERIOD_S", 0.01)
    listener, team = Silence("sim-1234", "blue"), MonitoredTeam("red", ManualClock(0.0))
    assert team.state()["light"]["also"] == [START_ONE]
    await LiveFeed(team, listener).run(Nobody())
    light = team.state()["light"]
    assert light["text"] == "no drone of team red is found"
    assert light["also"] == ["found drones of blue, sim-1234: --team blue"]
    assert caplog.messages == ["no drone of team red is found; found drones of blue, sim-1234: --team blue"]


async def test_a_network_that_does_not_answer_names_nobody():
    class Broken:
        async def teams(self) -> set[str]:
            raise TransportError("closed")

    assert await other_teams(Broken(), "red") == ()
    assert hint_at(()) == ""


def test_a_crowd_of_teams_is_counted_and_cannot_command_the_terminal():
    said = hint_at([f"team-{i}\x1b[2J" for i in range(100)])
    assert re.search(r"and 95 more: --team team-0", said)
    assert said.isprintable()
