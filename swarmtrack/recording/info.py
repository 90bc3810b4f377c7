"""Contents of a recording: topics, counts, rates, gaps, and damage."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from swarmtrack.recording.limits import RATE_LEAST_MESSAGES
from swarmtrack.recording.reader import Message, Recording

HEADLINE_KEYS = (
    "kind",
    "drone_id",
    "team",
    "boot",
    "tracker",
    "swarmtrack",
    "python",
    "numpy",
    "scipy",
    "machine",
)


@dataclass(slots=True)
class TopicSummary:
    """Messages of one topic. Times [ns, UTC]."""

    schema: str
    count: int = 0
    bytes: int = 0
    first_ns: int = 0
    last_ns: int = 0
    gap_ns: int = 0
    """The longest time without a message."""

    def add(self, message: Message) -> None:
        t = message.log_time_ns
        if self.count == 0:
            self.first_ns = t
        else:
            self.gap_ns = max(self.gap_ns, t - self.last_ns)
        self.last_ns = t
        self.count += 1
        self.bytes += len(message.data)

    @property
    def rate_hz(self) -> float | None:
        span = (self.last_ns - self.first_ns) * 1e-9
        return (self.count - 1) / span if self.count >= RATE_LEAST_MESSAGES and span > 0.0 else None


@dataclass(slots=True)
class Summary:
    """Summary of a whole recording."""

    folder: str
    preface: Mapping[str, str]
    files: list[tuple[str, int, str | None]]
    """Name, bytes, damage."""
    topics: dict[str, TopicSummary] = field(default_factory=dict)

    @property
    def begin_ns(self) -> int:
        return min((topic.first_ns for topic in self.topics.values()), default=0)

    @property
    def seconds(self) -> float:
        end = max((topic.last_ns for topic in self.topics.values()), default=0)
        return (end - self.begin_ns) * 1e-9

    @property
    def damage(self) -> list[str]:
        return [f"{name} {what}" for name, _, what in self.files if what]

    def as_record(self) -> dict[str, Any]:
        """The summary as a record for JSON."""
        return {
            "folder": self.folder,
            **{key: self.preface[key] for key in HEADLINE_KEYS if key in self.preface},
            "begin_utc_s": self.begin_ns * 1e-9,
            "duration_s": round(self.seconds, 6),
            "bytes": sum(size for _, size, _ in self.files),
            "files": [{"name": name, "bytes": size, "damage": what} for name, size, what in self.files],
            "topics": {
                name: {
                    "schema": topic.schema,
                    "count": topic.count,
                    "bytes": topic.bytes,
                    "rate_hz": None if topic.rate_hz is None else round(topic.rate_hz, 3),
                    "longest_gap_s": round(topic.gap_ns * 1e-9, 6),
                }
                for name, topic in sorted(self.topics.items())
            },
        }


def summarise(recording: Recording) -> Summary:
    """Read a whole recording and summarise it."""
    topics: dict[str, TopicSummary] = {}
    for segment in recording.segments:
        _count(topics, segment.messages(), segment.schemas)
    files = [(s.path.name, s.path.stat().st_size, s.damage) for s in recording.segments]
    return Summary(str(recording.folder), recording.preface, files, topics)


def _count(topics: dict[str, TopicSummary], messages: Iterable[Message], schemas: Mapping[int, Any]) -> None:
    for message in messages:
        topic = topics.get(message.topic)
        if topic is None:
            schema = schemas.get(message.channel.schema_id)
            topic = topics[message.topic] = TopicSummary(schema.name if schema else "")
        topic.add(message)
