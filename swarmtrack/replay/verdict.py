"""Verdict on a recorded simulated flight, computed again by the judge of `sim` with the tracks of a replay."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from swarmtrack.config.toml.layers import Layer, Layers
from swarmtrack.errors import ConfigError, RecordingError
from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import from_quaternion
from swarmtrack.lab.scenarios.files import limits_of, scenario_of
from swarmtrack.lab.scenarios.scenario import Scenario, as_told
from swarmtrack.lab.score.swarm_verdict import SwarmReport
from swarmtrack.lab.swarm.detail import Detail
from swarmtrack.lab.swarm.watch import HeldClock, Watch
from swarmtrack.lab.swarm.world_file import world_of
from swarmtrack.lab.world.followed import FollowedDrone
from swarmtrack.recording.reader import FLIGHT_PLAN, Message, Recording
from swarmtrack.replay.replayer import Published
from swarmtrack.runtime.swarm_recorder import (
    FLIGHT_TOPIC,
    HEARD_TOPIC,
    TRUTH_TOPIC,
    VERDICT_TOPIC,
    Heard,
    read_flight,
    read_heard,
    read_truth,
)
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind, Sample
from swarmtrack.wire import codec
from swarmtrack.wire.checks import DecodeError
from swarmtrack.wire.tracks import TracksMessage, tracks_message, tracks_sequence

VERDICT_TOPICS = frozenset({HEARD_TOPIC, FLIGHT_TOPIC, TRUTH_TOPIC, VERDICT_TOPIC})
SAME_VERDICT_PLACE_M = 1e-6  # of a pose computed again


Answers = Mapping[tuple[int, str], Published]
"""By drone and boot."""
NOTHING_PUBLISHED = Published(0, None)


@dataclass(slots=True)
class Judged:
    """report: judged again; recorded: the verdict of the flight, as JSON has it; None where it was cut off.

    numbers: of the track messages that were heard, by drone and boot.
    """

    report: SwarmReport
    recorded: dict[str, Any] | None
    numbers: dict[tuple[int, str], list[int]]

    def unreplayed(self, answers: Answers) -> int:
        """Number of received track messages that the replay did not produce."""
        return sum(
            not 1 <= number <= answers.get(life, NOTHING_PUBLISHED).messages
            for life, numbers in self.numbers.items()
            for number in numbers
        )

    @property
    def differences(self) -> list[str]:
        """Differences of the two verdicts, as `key: recorded, now`."""
        if self.recorded is None:
            return []
        return list(_differences("", self.recorded, self.report.as_record()))


def judge(recording: Recording, answers: Answers | None, tracker: str) -> Judged:
    """answers None: all as received in flight. tracker: the one in the replay. Raises RecordingError where the
    truth cannot be reproduced.
    """
    plan = recording.attached(FLIGHT_PLAN)
    layers = Layers([Layer(recording.folder / FLIGHT_PLAN, "", plan["files"])], plan["files"])
    detail = Detail(plan.get("detail", Detail.FULL))
    try:
        limits = limits_of(layers)
        if plan.get("outside", False):
            world = world_of(layers, plan["scenario"], seed=plan["seed"], keep_s=math.inf)
            followed = {drone_id: one.drone for drone_id, one in world.outsiders.items()}
            scenario = world.scenario
        else:
            planned = scenario_of(layers, plan["scenario"], seed=plan["seed"], drones=plan["drones"])
            whole, followed = as_told(planned)
            scenario = detail.of(whole)
            limits = detail.expected(whole, limits)
        tell_truth(recording, followed)
    except ConfigError as error:
        raise RecordingError(f"{recording.folder}: this program cannot fly its scenario: {error}") from None
    clock = HeldClock()
    watch = Watch(scenario, clock, clock, epoch=plan["epoch_s"], seconds=plan["seconds"])
    stage = _Stage(recording, scenario, answers, clock, watch)
    asyncio.run(stage.play())
    report = watch.report(
        seconds=plan["seconds"],
        seed=plan["seed"],
        tracker=tracker,
        detector=plan["detector"],
        limits=limits,
        machine_busy=_share(stage.verdict, "machine_busy"),
        others_busy=_share(stage.verdict, "others_busy"),
        detail=detail,
        cut_off_s=math.nan if stage.verdict is not None else watch.ends_at,
    )
    return Judged(report, stage.verdict, stage.numbers)


def _share(recorded: dict[str, Any] | None, name: str) -> float:
    """How busy the machine was in flight; NaN where the verdict does not say."""
    busy = (recorded or {}).get(name)
    return math.nan if busy is None else float(busy)


def tell_truth(recording: Recording, followed: Mapping[int, FollowedDrone]) -> None:
    """Give the followed drones their recorded truth: nothing else is known of drones that others flew."""
    if not followed:
        return
    for message in recording.messages(frozenset({TRUTH_TOPIC})):
        true = read_truth(message)
        if true.drone_id in followed:
            pose = Pose(from_quaternion(true.quaternion_wxyz), np.array(true.position_m))
            followed[true.drone_id].add_pose(true.t_s, pose)


class _Stage:
    """Says everything again that was heard in flight, the tracks as they came out of the replay."""

    def __init__(
        self,
        recording: Recording,
        scenario: Scenario,
        answers: Answers | None,
        clock: HeldClock,
        watch: Watch,
    ) -> None:
        self.verdict: dict[str, Any] | None = None
        self.numbers: dict[tuple[int, str], list[int]] = {}
        self._recording = recording
        self._scenario = scenario
        self._answers = answers
        self._clock = clock
        self._watch = watch
        self._boots: dict[int, str] = {}

    async def play(self) -> None:
        await self._watch.listen(self._samples())
        if self.verdict is None:
            self._watch.cut_off(self._watch.t)
        await self._watch.judge_the_rest()

    async def _samples(self) -> AsyncIterator[Sample]:
        for message in self._recording.messages(VERDICT_TOPICS):
            if message.topic == HEARD_TOPIC:
                heard = read_heard(message)
                self._clock.set(heard.t, heard.utc)
                sample = self._instead(heard)
                if sample is not None:
                    yield sample
            elif message.topic == FLIGHT_TOPIC:
                event = read_flight(message)
                self._clock.set(event.t_s, event.utc_s)
                if event.event == "started":
                    self._watch.started(event.drone_id)
                else:
                    self._watch.ended(event.drone_id)
            elif message.topic == TRUTH_TOPIC:
                self._check_truth(message)
            elif message.topic == VERDICT_TOPIC:
                self.verdict = msgspec.json.decode(message.data)

    def _check_truth(self, message: Message) -> None:
        """The recorded truth is what the flight was judged by; another version may fly the same scenario otherwise."""
        true = read_truth(message)
        flown = self._scenario.world.drones.get(true.drone_id)
        if flown is None or np.abs(flown.position(true.t_s) - true.position_m).max() > SAME_VERDICT_PLACE_M:
            raise RecordingError(
                f"{self._recording.folder}: drone {true.drone_id} flew elsewhere at {true.t_s:.1f} s than in this "
                f"program's scenario {self._scenario.name}, expected the version that recorded it "
                f"({self._recording.preface.get('swarmtrack')})"
            )

    def _instead(self, heard: Heard) -> Sample | None:
        address = keys.parse(heard.key)
        if address is None:
            return heard.sample
        if address.kind is Kind.ALIVE and heard.alive and len(address.rest) == 1:
            self._boots[address.drone_id] = address.rest[0]
        if address.kind is not Kind.TRACKS:
            return heard.sample
        if address.drone_id not in self._boots:
            return heard.sample  # before its process was known to live; the judge pays no heed to it
        life = (address.drone_id, self._boots[address.drone_id])
        try:
            number = tracks_sequence(heard.payload)
            self.numbers.setdefault(life, []).append(number)
            if self._answers is None:
                return heard.sample
            published = self._answers.get(life, NOTHING_PUBLISHED)
            if not 1 <= number <= published.messages:
                return None
            if published.changed is None:
                return heard.sample
            message = codec.decode(TracksMessage, heard.payload)
        except DecodeError:
            return heard.sample  # the judge counts it
        answer = published.changed[number - 1]
        fresh = tracks_message(answer, number, 0.0, message.t_sigma_s)
        said = msgspec.structs.replace(fresh, t_utc_s=message.t_utc_s)
        try:
            return heard.sample._replace(payload=codec.encode(said))
        except ValueError:  # as in flight: what no reader would accept is not said
            return None


def _differences(key: str, recorded: Any, now: Any) -> list[str]:
    if isinstance(recorded, dict) and isinstance(now, dict):
        return [
            line
            # What an older program did not judge is no difference.
            for name in sorted(recorded)
            for line in _differences(f"{key}.{name}".removeprefix("."), recorded[name], now.get(name))
        ]
    if isinstance(recorded, list) and isinstance(now, list) and len(recorded) == len(now):
        return [
            line
            for k, (one, other) in enumerate(zip(recorded, now, strict=True))
            for line in _differences(f"{key}[{k}]", one, other)
        ]
    return [] if recorded == now else [f"{key}: {recorded}, now {now}"]
