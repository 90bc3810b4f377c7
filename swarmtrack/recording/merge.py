"""Several recordings merged on one timeline.

Theory of operation. Each drone's times are on its own clock. Sightings are sent to the team with a running number, and
both ends of each are recorded: the exposure on the sender's clock, and the same instant as the receiver reconstructed
it on its own. A late message is reconstructed too late, never too early, so the smallest difference is nearest to the
truth; where both drones receive each other, half of the two smallest differences cancels the remaining delay.
Recordings that share no message are aligned by each one's estimate of UTC.
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import msgspec
from mcap.writer import Writer

from swarmtrack.errors import RecordingError
from swarmtrack.recording.limits import RECORDING_CHUNK_BYTES
from swarmtrack.recording.reader import Message, Recording

SAID_TOPIC, SIGHTINGS_TOPIC = "/said", "/peers/sightings"

SightingKey = tuple[int, str, int]  # drone ID, boot, sequence


class Shift(NamedTuple):
    """Offset from a recording's times to those of the first; by: "messages" or "UTC"."""

    seconds: float
    by: str


@dataclass(slots=True)
class SightingTimes:
    """Sightings sent and received in one recording: their exposures, by its clock [s]."""

    sent: dict[SightingKey, float] = field(default_factory=dict)
    received: dict[SightingKey, float] = field(default_factory=dict)

    def note(self, message: Message) -> None:
        """Take note of any message of a drone's recording."""
        if message.topic == SAID_TOPIC:
            record = msgspec.json.decode(message.data)
            self.sent[record["drone_id"], record["boot"], record["sequence"]] = float(record["t_s"])
        elif message.topic == SIGHTINGS_TOPIC:
            record = msgspec.json.decode(message.data)
            self.received[record["observer"], record["boot"], record["sequence"]] = float(record["t_s"])


def shifts(recordings: Sequence[Recording]) -> list[Shift]:
    """Offset of each recording, in order; the first is 0."""
    sightings = []
    for recording in recordings:
        sightings.append(SightingTimes())
        for message in recording.messages({SAID_TOPIC, SIGHTINGS_TOPIC}):
            sightings[-1].note(message)
    return shifts_by(sightings, [utc_offset(recording) for recording in recordings])


def shifts_by(sightings: Sequence[SightingTimes], utc: Sequence[float]) -> list[Shift]:
    """Offset of each recording, from the messages that it sent and received. utc: its estimate of UTC minus its
    monotonic clock [s].
    """
    found: dict[int, float] = {0: 0.0}  # a clock minus the first one's
    waiting = deque([0])
    while waiting:
        i = waiting.popleft()
        for j in range(len(sightings)):
            if j not in found and (offset := _offset(sightings[i], sightings[j])) is not None:
                found[j] = found[i] + offset
                waiting.append(j)
    return [
        Shift(utc[0] - utc[i] - found[i], "messages") if i in found else Shift(0.0, "UTC")
        for i in range(len(sightings))
    ]


def merge(recordings: Sequence[Recording], target: Path) -> tuple[list[Shift], int]:
    """Write one file with the topics of each recording under /drone-N or /swarm. Raises RecordingError."""
    names = _names(recordings)
    moved = shifts(recordings)
    streams = [
        _shifted(recording, name, round(shift.seconds * 1e9))
        for recording, name, shift in zip(recordings, names, moved, strict=True)
    ]
    try:
        with target.open("xb") as file:
            writer = Writer(file, chunk_size=RECORDING_CHUNK_BYTES)
            writer.start(profile="swarmtrack")
            for recording, name, shift in zip(recordings, names, moved, strict=True):
                added = {"shift_s": repr(shift.seconds), "shifted_by": shift.by}
                writer.add_metadata(f"swarmtrack.merged{name}", {**recording.preface, **added})
            count = _write(heapq.merge(*streams, key=lambda entry: entry[0]), writer)
            writer.finish()  # type: ignore[no-untyped-call]
    except FileExistsError:
        raise RecordingError(f"{target}: exists already, expected the name of a new file") from None
    except OSError as error:
        raise RecordingError(f"{target}: {error.strerror}, expected a file that can be written") from error
    return moved, count


_Entry = tuple[int, str, Message, Recording]


def _shifted(recording: Recording, name: str, shift_ns: int) -> Iterator[_Entry]:
    for message in recording.messages():
        own = message.topic.startswith("/drone-")  # a swarm's recording says of whom it speaks
        yield (
            message.log_time_ns + shift_ns,
            message.topic if own else name + message.topic,
            message,
            recording,
        )


def _write(entries: Iterator[_Entry], writer: Writer) -> int:
    schemas: dict[tuple[str, bytes], int] = {}
    channels: dict[str, int] = {}
    count = 0
    for log_time, topic, message, recording in entries:
        if topic not in channels:
            known = next(
                (
                    s.schemas[message.channel.schema_id]
                    for s in recording.segments
                    if message.channel.schema_id in s.schemas
                ),
                None,
            )
            schema_id = 0
            if known is not None:
                key = (known.name, known.data)
                if key not in schemas:
                    schemas[key] = writer.register_schema(known.name, known.encoding, known.data)
                schema_id = schemas[key]
            channels[topic] = writer.register_channel(topic, message.channel.message_encoding, schema_id)
        writer.add_message(channels[topic], log_time, message.data, publish_time=log_time)
        count += 1
    return count


def _names(recordings: Sequence[Recording]) -> list[str]:
    """/drone-1, and /drone-1/2 for a second life of the same drone."""
    seen: dict[str, int] = {}
    names = []
    for recording in recordings:
        name = f"/drone-{recording.drone_id}" if recording.kind == "drone" else "/swarm"
        seen[name] = seen.get(name, 0) + 1
        names.append(name if seen[name] == 1 else f"{name}/{seen[name]}")
    return names


def utc_offset(recording: Recording) -> float:
    """A recording's first estimate of UTC minus its monotonic clock [s]."""
    return float(recording.preface["utc_s"]) - float(recording.preface["monotonic_s"])


def _offset(one: SightingTimes, other: SightingTimes) -> float | None:
    """The other's clock minus the one's [s]; None where neither received the other."""
    there = min(
        (other.received[key] - t for key, t in one.sent.items() if key in other.received), default=math.inf
    )
    back = min(
        (one.received[key] - t for key, t in other.sent.items() if key in one.received), default=math.inf
    )
    if math.isinf(there) and math.isinf(back):
        return None
    if math.isinf(back):
        return there
    return -back if math.isinf(there) else 0.5 * (there - back)
