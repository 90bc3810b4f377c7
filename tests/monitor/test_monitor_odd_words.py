"""Whatever a drone says that can be decoded: the page goes on for everybody, and shows the other drones."""

from __future__ import annotations

import asyncio
import json
import math
import random
from collections.abc import Iterator
from typing import Any

import msgpack
import pytest

pytest.importorskip("zenoh", reason="Zenoh has no wheel here")

from support import golden_bytes
from support.seen_swarm import LENS, UTC, healthy, seen
from swarmtrack.clock import ManualClock
from swarmtrack.monitor import live
from swarmtrack.monitor import team as monitored
from swarmtrack.monitor.live import LiveFeed
from swarmtrack.monitor.player import Playback, RecordingPlayer
from swarmtrack.monitor.team import MonitoredTeam
from swarmtrack.monitor.timeline import BlobFile, Timeline, TimelineEvent
from swarmtrack.outputs.flight_end import FlightEnd
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind, Sample
from swarmtrack.wire import codec
from swarmtrack.wire.lens import lens_message
from swarmtrack.wire.video import VideoMessage

VIEW = VideoMessage(
    1, UTC, 0.05, 1, 320, 240, b"", lens_message(LENS), (0.0, 0.0, -2.0), (0.5, 0.5, 0.5, 0.5)
)
ODD, SOUND = 7, 2  # drones: who says odd words, and who does not
GOLDEN = {
    kind: bytes.fromhex(text)
    for kind, text in {
        Kind.POSE: golden_bytes.ANNOUNCEMENT_BYTES,
        Kind.CAMERA: golden_bytes.CAMERAS_BYTES,
        Kind.IDENTITIES: golden_bytes.SIGHTINGS_BYTES,
        Kind.MOTION: golden_bytes.MOTION_BYTES,
        Kind.RANGE: golden_bytes.RANGE_BYTES,
        Kind.STRANGER: golden_bytes.STRANGERS_BYTES,
        Kind.TRACKS: golden_bytes.SECOND_CAMERA_TRACKS_BYTES,
        Kind.HEALTH: golden_bytes.HEALTH_BYTES,
        Kind.VIDEO: golden_bytes.VIDEO_BYTES,
    }.items()
}
FLOATS = (
    *(0.0, -0.0, 1e-12, 1.0, -1.0, math.pi, 1e3, -1e3, 1e7, -1e7, 1e9, 1e15, -1e15, 2.0**32, -(2.0**33)),
    *(5e-324, 1e308, math.nan, math.inf, -math.inf),
)
INTEGERS = (0, 1, 2, 7, 255, 65535, 2**31, 2**53, 2**63 - 1, -1)
FORMATION = ("leader", "slot_north_m", "slot_east_m", "engaged", "error_m")
WORDS = (
    "",
    "foreign",
    "lost",
    "tentative",
    "radtan",
    "equidistant",
    "formation",
    "imu",
    *FORMATION,
    "\x1b[2J",
)


class Viewer:
    """Looks at both cameras of both drones, and is told as a page is."""

    is_there = True
    watched = frozenset((drone_id, camera) for drone_id in (ODD, SOUND) for camera in (0, 1))

    def __init__(self) -> None:
        self.states: list[dict[str, Any]] = []
        self.pictures = 0

    def broadcast(self, state: dict[str, Any]) -> None:
        self.states.append(json.loads(json.dumps(state, allow_nan=False)))

    def show(self, key: tuple[int, int], view: VideoMessage, boxes: list[dict[str, Any]]) -> None:
        json.dumps(boxes, allow_nan=False)
        self.pictures += 1


class Saying:
    """A listener that hears a list of messages, one every few milliseconds of the team's clock."""

    def __init__(self, clock: ManualClock, *words: tuple[Kind, int, bytes]) -> None:
        self._clock = clock
        self._words = words

    async def samples(self):
        for kind, drone_id, payload in self._words:
            yield said(kind, drone_id, payload, self._clock.now())
            self._clock.set(self._clock.now() + 0.6)
            await asyncio.sleep(0.01)

    async def listen_to(self, key_expression: str) -> None: ...
    async def leave(self, key_expression: str) -> None: ...


def said(kind: Kind, drone_id: int, payload: bytes, t: float, camera: int = 0) -> Sample:
    rest = {Kind.RANGE: ("3",), Kind.VIDEO: (str(camera),) if camera else (), Kind.ALIVE: ("0000000a",)}
    return Sample(keys.key("red", kind, drone_id, *rest.get(kind, ())), payload, True, t)


# --- odd words ------------------------------------------------------------------------------------


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Of all that is in a message."""
    if path:
        yield path
    parts = enumerate(value) if isinstance(value, list) else value.items() if isinstance(value, dict) else ()
    for name, part in parts:
        yield from places(part, (*path, name))


def instead(rng: random.Random, old: Any) -> Any:
    match old:
        case bool():
            return not old
        case float():
            return rng.choice(FLOATS)
        case int():
            return rng.choice(INTEGERS)
        case str():
            return rng.choice(WORDS)
        case list():
            return rng.choice(
                [[], old[:-1], old * 2, [*old, *old[-1:]], [rng.choice(FLOATS) for _ in old], None]
            )
        case dict():
            return rng.choice(
                [{}, {rng.choice(WORDS): one for one in old.values()}, dict.fromkeys(FORMATION, 1e15)]
            )
    return rng.choice([None, b"", b"\xff\xd8", 7, 1e9, "", [0.0] * 3])


def odd(rng: random.Random, kind: Kind) -> bytes:
    """A sound message with a few of its parts replaced."""
    fields = msgpack.unpackb(GOLDEN[kind])
    for _ in range(rng.choice((1, 1, 2, 3, 6))):
        *way, last = rng.choice(list(places(fields)))
        parent = fields
        for step in way:
            parent = parent[step]
        parent[last] = instead(rng, parent[last])
    return msgpack.packb(fields)


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("block", range(4))
def test_odd_words_of_every_kind_are_refused_or_shown(block, caplog):
    """All that the wire's checks let pass is shown: nothing comes as far as being left out for not being thought of."""
    taken = 0
    for seed in range(100 * block, 100 * (block + 1)):
        rng, clock, viewer = random.Random(seed), ManualClock(100.0, UTC), Viewer()
        team = MonitoredTeam("red", clock)
        feed = LiveFeed(team, Saying(clock))
        for _ in range(rng.choice((3, 8, 20))):
            kind = rng.choice(list(GOLDEN))
            payload = odd(rng, kind) if rng.random() < 0.7 else GOLDEN[kind]
            refused = team.unreadable
            view = team.on_sample(said(kind, ODD, payload, clock.now(), rng.choice((0, 1))))
            taken += team.unreadable == refused
            if view is not None:
                feed._show(viewer, view.key, view.message)
            clock.set(clock.now() + rng.choice((0.0, 0.05, 0.3, 1.0)))
            feed._tell(viewer)
        assert caplog.messages == [], f"seed {seed}"
    assert taken > 300


def test_who_says_only_what_cannot_be_read_is_counted_and_not_listed():
    """Such as a drone of another version; it has never been here, so it is not gone."""
    team, viewer = MonitoredTeam("red", ManualClock(100.0, UTC)), Viewer()
    team.on_sample(said(Kind.HEALTH, ODD, b"\x91\x02", 100.0))
    viewer.broadcast(team.state())
    assert (viewer.states[-1]["drones"], viewer.states[-1]["events"][1:]) == ([], [])
    assert viewer.states[-1]["unreadable"] == 1


# --- words that nobody thought of -----------------------------------------------------------------


def breaks(which: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """From now on some part of the monitor cannot cope with what drone ODD says, which has a picture and tracks."""

    def nan_of_odd(rig: Any, tracks: Any, *, few: bool) -> dict[str, Any] | None:
        return {"outlines": [[[math.nan, 0.0]]]} if tracks is not None else None

    def falls_over(*_: Any, **__: Any) -> Any:
        raise ZeroDivisionError("nobody thought of it")

    match which:
        case "state":
            monkeypatch.setattr(monitored, "around_state", nan_of_odd)
        case "bug":
            monkeypatch.setattr(
                monitored, "metres", lambda tracks: falls_over() if tracks is not None else []
            )
        case "hearing":
            monkeypatch.setattr(MonitoredTeam, "_on_health", falls_over)
        case "verdict":
            monkeypatch.setattr(monitored.Reports, "evaluate", falls_over)
        case "picture":
            monkeypatch.setattr(live, "boxes", falls_over)


WORDS_OF_BOTH = [
    (Kind.ALIVE, SOUND, b""),
    (Kind.ALIVE, ODD, b""),
    (Kind.HEALTH, ODD, codec.encode(healthy("0000000a"))),
    (Kind.VIDEO, ODD, codec.encode(VIEW)),
    (Kind.TRACKS, ODD, codec.encode(seen())),
    (Kind.VIDEO, ODD, codec.encode(VIEW)),
    *[(Kind.ALIVE, SOUND, b"")] * 4,
]


@pytest.mark.parametrize(
    ("which", "line"),
    [
        ("state", "the state of drone 7 is left out, it cannot be shown: ValueError"),
        ("bug", "the state of drone 7 is left out, it cannot be shown: ZeroDivisionError"),
        ("hearing", "a message (health) of drone 7 is left out, it cannot be shown: ZeroDivisionError"),
        ("verdict", "the table of identities is left out, it cannot be shown: ZeroDivisionError"),
        ("picture", "a picture of drone 7 is left out, it cannot be shown: ZeroDivisionError"),
    ],
)
async def test_a_word_that_nobody_thought_of_ends_the_page_for_nobody(which, line, monkeypatch, caplog):
    monkeypatch.setattr(live, "STATE_HZ", 500.0)
    breaks(which, monkeypatch)
    clock, viewer = ManualClock(100.0, UTC), Viewer()
    team = MonitoredTeam("red", clock)
    await LiveFeed(team, Saying(clock, *WORDS_OF_BOTH)).run(viewer)
    last = viewer.states[-1]
    assert [drone["id"] for drone in last["drones"]] == [SOUND, ODD]
    assert last["unreadable"] > 0
    lines = [said for said in caplog.messages if said.startswith(line)]
    assert len(lines) == 1, caplog.messages
    assert len(caplog.messages) == len(set(caplog.messages))


def test_when_the_flight_is_over_the_last_state_can_be_told(monkeypatch):
    breaks("state", monkeypatch)
    clock, viewer = ManualClock(100.0, UTC), Viewer()
    team = MonitoredTeam("red", clock)
    for kind, drone_id, payload in WORDS_OF_BOTH:
        team.on_sample(said(kind, drone_id, payload, 100.0))
    viewer.broadcast(team.state_at_end(FlightEnd("bad", "over", [], [], "again")))
    assert [drone["id"] for drone in viewer.states[-1]["drones"]] == [SOUND, ODD]


def test_a_recording_with_such_a_word_is_played_to_its_end(monkeypatch, caplog):
    breaks("hearing", monkeypatch)
    events = [
        TimelineEvent(100.0 + k, drone_id, said(kind, drone_id, payload, 100.0 + k))
        for k, (kind, drone_id, payload) in enumerate(WORDS_OF_BOTH)
    ]
    playback, viewer = Playback(Timeline("red", events, {}, BlobFile(), [])), Viewer()
    playback.seek(playback.steps)
    monkeypatch.setattr(
        Playback, "state", lambda *_: {"drones": math.nan} if not viewer.states else {"drones": []}
    )
    player = RecordingPlayer(playback, "flight")
    player._show(viewer)
    assert any("a message (health) of drone 7" in line for line in caplog.messages)
    assert any("the team's state is left out" in line for line in caplog.messages)
