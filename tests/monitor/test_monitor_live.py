"""The page of a team that says nothing: whom one could hear instead."""

from __future__ import annotations

import asyncio
import re

from swarmtrack.clock import ManualClock
from swarmtrack.errors import TransportError
from swarmtrack.monitor import live
from swarmtrack.monitor.live import LiveFeed
from swarmtrack.monitor.team import START_ONE, MonitoredTeam
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


class Nobody:
    """Looks at the page."""

    is_there = False
    watched: frozenset[int] = frozenset()


async def test_a_silent_teams_page_names_those_that_are_heard_and_the_terminal_once(monkeypatch, caplog):
    monkeypatch.setattr(live, "SILENT_S", 0.01)
    listener, team = Silence("sim-1234", "blue"), MonitoredTeam("red", ManualClock(0.0))
    assert team.state()["light"]["also"] == [START_ONE]
    await LiveFeed(team, listener).run(Nobody())
    light = team.state()["light"]
    assert light["text"] == "no drone of team red is heard"
    assert light["also"] == ["heard are drones of blue, sim-1234: --team blue"]
    assert caplog.messages == [
        "no drone of team red is heard; heard are drones of blue, sim-1234: --team blue"
    ]


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
