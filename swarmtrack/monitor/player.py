"""The page of a recording: the same `MonitoredTeam` as of a running swarm, told again what was said.

Theory of operation. Playing goes in steps of PLAYER_STEP_S of the recording. In a step the team is told all words up to
its end and then looks around once, so the state is a function of the step, however it was reached. To seek back, the
nearest checkpoint (the team, pickled every CHECKPOINT_S) is taken and told the rest. All viewers share one position, as
before one screen: a viewer that moves the slider moves it for all.
"""

from __future__ import annotations

import asyncio
import math
import pickle
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import msgspec

from swarmtrack.monitor.drone_cameras import DroneCameras, ViewKey
from swarmtrack.monitor.metres import MAPPED, metres
from swarmtrack.monitor.overlay import boxes
from swarmtrack.monitor.server import Audience
from swarmtrack.monitor.team import VIEW_S, MonitoredTeam, around_state
from swarmtrack.monitor.timeline import Blob, Timeline
from swarmtrack.wire.tracks import TracksMessage
from swarmtrack.wire.video import VideoMessage

if TYPE_CHECKING:
    from foxglove.messages import Timestamp

    from swarmtrack.monitor.foxglove_scenes import Written

PLAYER_STEP_S = 0.1
STEPS_PER_CHECKPOINT = 100
STEPS_PER_COUNT = 5  # between two looks at how many are named: as often as a team is judged
MAX_SEEK_S = 1e9  # beyond it a page talks nonsense
SPEEDS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)


class PlayedClock:
    """Both clocks, as of the recording's time."""

    def __init__(self, t: float) -> None:
        self.t = t

    def now(self) -> float:
        return self.t

    def utc(self) -> float:
        return self.t


@dataclass(slots=True)
class View:
    """The newest of one camera. picture: where it lies."""

    t: float
    message: VideoMessage
    picture: Blob | None


@dataclass(slots=True)
class _Scene:
    """All that changes while it is played. told: how many events."""

    clock: PlayedClock
    team: MonitoredTeam
    told: int
    views: dict[ViewKey, View]


class Playback:
    """A recording at one of its steps, 0 … `steps`. Reads no clock."""

    def __init__(self, timeline: Timeline) -> None:
        self.timeline = timeline
        self.steps = math.ceil(timeline.seconds / PLAYER_STEP_S)
        self.step = 0
        clock = PlayedClock(timeline.begin)
        self._scene = _Scene(clock, MonitoredTeam(timeline.team, clock), 0, {})
        self._checkpoints: list[bytes] = []
        self._take_step(0)
        while self.step < self.steps:  # so that all checkpoints are there: seconds for ten minutes, once
            self._take_step(self.step + 1)
        self.seek(0)

    @property
    def team(self) -> MonitoredTeam:
        """State of the team at this step."""
        return self._scene.team

    @property
    def cameras(self) -> tuple[ViewKey, ...]:
        return self._scene.team.cameras

    @property
    def views(self) -> dict[ViewKey, View]:
        """The newest of each camera that is not too old to be looked at."""
        return {i: view for i, view in self._scene.views.items() if self._scene.clock.t - view.t < VIEW_S}

    def state(self, watched: frozenset[ViewKey] = frozenset()) -> dict[str, Any]:
        """As of a running swarm. watched: cameras of drones whose metres are told, however many there are."""
        team = self._scene.team
        state = team.state()
        few, whom = len(team.drones) <= MAPPED, {drone_id for drone_id, _ in watched}
        for drone in state["drones"]:
            # The team is told no tracks, which wait in their file until they are shown.
            if few or drone["id"] in whom:
                tracks = self.newest_tracks(drone["id"])
                drone["metres"] = metres(tracks)
                drone["around"] = around_state(team.rig(drone["id"]), tracks, few=few)
        return state

    def seek(self, step: int) -> None:
        """Move forward or back, within the ends."""
        step = max(0, min(step, self.steps))
        checkpoint = step // STEPS_PER_CHECKPOINT
        if step < self.step or checkpoint > self.step // STEPS_PER_CHECKPOINT:
            # Pickled by us a moment ago, in memory.
            self._scene = pickle.loads(self._checkpoints[checkpoint])
            self.step = checkpoint * STEPS_PER_CHECKPOINT
        while self.step < step:
            self._take_step(self.step + 1)

    def view(self, drone_id: int, camera: int = 0) -> tuple[VideoMessage, TracksMessage | None] | None:
        """Current view of a drone's camera with its picture, and its tracks at that time."""
        view = self.views.get((drone_id, camera))
        if view is None:
            return None
        message = view.message
        if view.picture is not None:
            message = msgspec.structs.replace(message, jpeg=self.timeline.blob_file.get(view.picture))
        return message, self.timeline.tracks_at(drone_id, message.t_utc_s)

    def newest_tracks(self, drone_id: int) -> TracksMessage | None:
        """What a drone tracks at this step."""
        return self.timeline.newest_tracks(drone_id, self._scene.clock.t, max_age=VIEW_S)

    def rig(self, drone_id: int) -> DroneCameras | None:
        """The cameras of a drone with several."""
        return self._scene.team.rig(drone_id)

    def _take_step(self, step: int) -> None:
        scene, events = self._scene, self.timeline.events
        end = self.timeline.begin + step * PLAYER_STEP_S
        while scene.told < len(events) and events[scene.told].t <= end:
            event = events[scene.told]
            scene.told += 1
            scene.clock.t = event.t
            if event.sample is None:
                scene.team.on_sign_of_life(event.drone_id, event.t)
                continue
            view = scene.team.on_sample(event.sample)
            if view is not None:
                scene.views[view.key] = View(event.t, view.message, event.picture)
        scene.clock.t = end
        if step % STEPS_PER_COUNT == 0:
            for drone_id in scene.team.drones:
                scene.team.on_tracks(drone_id, self.timeline.newest_tracks(drone_id, end, max_age=VIEW_S))
        scene.team.refresh()
        self.step = step
        if step == len(self._checkpoints) * STEPS_PER_CHECKPOINT:
            self._checkpoints.append(pickle.dumps(scene))


class RecordingPlayer:
    """Plays a recording to the viewers, at the speed they ask for."""

    def __init__(self, playback: Playback, name: str, more: dict[str, Any] | None = None) -> None:
        """name: of the recording, for people; more: for the page, beside every state."""
        self._more = more or {}
        self._playback = playback
        self._name = name
        self._playing = True
        self._speed = 1.0
        self._sought: float | None = None
        self._owed = 0.0
        """Part of a step that is due but not taken."""
        self._shown: dict[ViewKey, float] = {}
        """Whose view of which time the viewers have."""
        self._news = asyncio.Event()

    @property
    def cameras(self) -> tuple[ViewKey, ...]:
        return self._playback.cameras

    @property
    def span(self) -> tuple[float, float]:
        """Begin, UTC [s], and length [s]."""
        return self._playback.timeline.begin, self._playback.steps * PLAYER_STEP_S

    async def run(self, audience: Audience) -> None:
        """Until cancelled. It does not stop without viewers: it is paused by hand, or stops at its end."""
        loop = asyncio.get_running_loop()
        before = loop.time()
        while True:
            try:
                async with asyncio.timeout(PLAYER_STEP_S):
                    await self._news.wait()
            except TimeoutError:
                pass
            news, now = self._news.is_set(), loop.time()
            self._news.clear()
            moved = self._play(now - before) if audience.is_there else False
            before = now
            if moved or news:
                self._show(audience)

    def on_watched(self) -> None:
        self._shown.clear()  # who just came has seen nothing yet
        self._news.set()

    def on_wish(self, wish: dict[str, Any]) -> bool:
        """`{"seek": s}`, `{"play": true}`, `{"speed": 2}`."""
        match wish:
            case {"seek": int() | float() as t} if -MAX_SEEK_S < t < MAX_SEEK_S:
                bounded = max(0.0, min(float(t), self._playback.steps * PLAYER_STEP_S))
                self._playback.seek(round(bounded / PLAYER_STEP_S))
                self._sought, self._owed = float(t), 0.0
                self._shown.clear()
            case {"play": bool() as play}:
                if play and self._playback.step == self._playback.steps:
                    self._playback.seek(0)
                self._playing = play
            case {"speed": int() | float() as speed} if speed in SPEEDS:
                self._speed = float(speed)
            case _:
                return False
        self._news.set()
        return True

    def scene(self, stamp: Timestamp) -> list[Written]:
        # Here, not above: only `--foxglove` needs the SDK.
        from swarmtrack.monitor.foxglove_scenes import scene_of  # noqa: PLC0415

        return scene_of(self._playback.team, stamp, self._playback.newest_tracks)

    def _play(self, seconds: float) -> bool:
        """Whether it moved on."""
        if not self._playing:
            return False
        # A machine that was asleep does not skip the flight.
        self._owed += min(seconds, 1.0) * self._speed / PLAYER_STEP_S
        steps = int(self._owed)
        self._owed -= steps
        if steps:
            self._playback.seek(self._playback.step + steps)
        if self._playback.step == self._playback.steps:
            self._playing = False
            return True
        return steps > 0

    def _show(self, audience: Audience) -> None:
        """Where the playback stands, and pictures that are new."""
        playback = self._playback
        self._tell(audience)
        for key, view in playback.views.items():
            if key in audience.watched and self._shown.get(key) != view.t:
                self._shown[key] = view.t
                with playback.team.leaves_out("a picture", key[0]):
                    seen = playback.view(*key)
                    if seen is not None:
                        audience.show(key, seen[0], boxes(*seen, key[1], playback.rig(key[0])))

    def _tell(self, audience: Audience) -> None:
        with self._playback.team.leaves_out("the team's state"):
            audience.broadcast(self._state(audience.watched))
            return
        self._playback.team.forget_untellable()

    def _state(self, watched: frozenset[ViewKey]) -> dict[str, Any]:
        playback = self._playback
        state = playback.state(watched) | self._more
        state["playback"] = {
            "name": self._name,
            "t_s": round(playback.step * PLAYER_STEP_S, 1),
            "seconds": round(playback.steps * PLAYER_STEP_S, 1),
            "begin_utc_s": round(playback.timeline.begin, 1),
            "playing": self._playing,
            "speed": self._speed,
            "sought_s": self._sought,
            "views": sorted(playback.views),
        }
        return state
