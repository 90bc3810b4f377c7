"""A recorded flight as tables, a CSV file each (docs/recording.md lists the columns)."""

from __future__ import annotations

import csv
import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

from swarmtrack.client.recorded import heard_timeline, with_progress
from swarmtrack.errors import RecordingError
from swarmtrack.geometry.rotation import to_quaternion
from swarmtrack.messages import EgoPose
from swarmtrack.recording import inputs
from swarmtrack.recording.merge import utc_offset
from swarmtrack.recording.reader import FLIGHT_PLAN, Recording
from swarmtrack.runtime.swarm_recorder import TRUTH_TOPIC, read_truth
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind
from swarmtrack.wire import codec
from swarmtrack.wire.checks import DecodeError
from swarmtrack.wire.health import HealthMessage
from swarmtrack.wire.sightings import SightingsMessage, is_from_nowhere
from swarmtrack.wire.tracks import TracksMessage

Row = Sequence[Any]
EGO_TOPIC: Final = inputs.FORM_OF_KIND[EgoPose].topic

_AXES = ("north", "east", "down")
_STATE = (*(f"{axis}_m" for axis in _AXES), *(f"v_{axis}_m_s" for axis in _AXES))
_COV = tuple(f"cov_{i}{j}" for i, j in itertools.combinations_with_replacement(range(6), 2))
_QUATERNION = ("qw", "qx", "qy", "qz")
TABLES: Final[dict[str, tuple[str, ...]]] = {
    "tracks": (
        "t_s", "t_utc_s", "observer", "track", "camera", "identity", "identity_probability", "status", "probability",
        "coasting_s", "u_px", "v_px", "vu_px_s", "vv_px_s", "var_u_px2", "var_v_px2", "w_px", "h_px",
    ),
    "places": (
        "t_s", "t_utc_s", "observer", "track", "teammate", *_STATE, *_COV, "range_sigma_log", "sources",
    ),
    "identities": (
        "t_s", "t_utc_s", "observer", "observer_north_m", "observer_east_m", "observer_down_m", "observer_sigma_m",
        "teammate", "probability", *_AXES, "sigma_rad",
    ),
    "health": (
        "t_s", "t_utc_s", "drone", "uptime_s", "cpu_percent", "rss_mb", "ready", "reasons", "clock_offset_s",
        "dropped", "links_down", "events",
    ),
    "ego": (
        "t_s", "t_utc_s", "drone", *_STATE[:3], *_QUATERNION, "position_sigma_m", "attitude_sigma_rad",
    ),
    "truth": ("t_s", "t_utc_s", "drone", *_STATE[:3], *_QUATERNION),
}  # fmt: skip
"""Columns by table."""


def write_tables(paths: tuple[Path, ...], out: Path, progress: Callable[[str], None]) -> dict[str, int]:
    """Rows of each table that was written, of those that hold any. Raises RecordingError."""
    timeline, recordings = heard_timeline(paths)
    for note in timeline.notes:
        progress(note)
    rows: dict[str, int] = dict.fromkeys(TABLES, 0)
    refused = 0
    try:
        out.mkdir(parents=True, exist_ok=True)
        with ExitStack() as files:
            writers = {}
            for name, columns in TABLES.items():
                file = files.enter_context((out / f"{name}.csv").open("w", newline="", encoding="utf-8"))
                writers[name] = csv.writer(file)
                writers[name].writerow(columns)
            for sample in with_progress(timeline.samples(), timeline, progress):
                try:
                    for name, t, row in _rows(sample.key, sample.payload):
                        writers[name].writerow((round(t - timeline.begin, 6), t, *row))
                        rows[name] += 1
                except DecodeError:
                    refused += 1
            for name, t, row in itertools.chain(_ego(recordings), _truth(recordings)):
                writers[name].writerow((round(t - timeline.begin, 6), t, *row))
                rows[name] += 1
        for name in [name for name, count in rows.items() if not count]:
            (out / f"{name}.csv").unlink()
    except OSError as error:
        raise RecordingError(
            f"--out {out}: {error.strerror}, expected a folder that can be written"
        ) from error
    if refused:
        progress(f"{refused} messages cannot be read and are left out")
    return {name: count for name, count in rows.items() if count}


def write_parquet(folder: Path, names: Sequence[str]) -> None:
    """The same tables as Parquet. Raises RecordingError."""
    from pyarrow import csv as arrow_csv
    from pyarrow import parquet, string

    # A column that is empty, or begins with numbers, has its type all the same.
    texts = dict.fromkeys(("identity", "status", "sources", "reasons", "links_down", "events"), string())
    options = arrow_csv.ConvertOptions(column_types=texts)
    for name in names:
        try:
            table = arrow_csv.read_csv(folder / f"{name}.csv", convert_options=options)
            parquet.write_table(table, folder / f"{name}.parquet")
        except OSError as error:
            raise RecordingError(f"{folder / name}.parquet: {error}, expected room to write it") from error


def _rows(key: str, payload: bytes) -> Iterator[tuple[str, float, Row]]:
    address = keys.parse(key)
    if address is None:
        return
    match address.kind:
        case Kind.TRACKS:
            yield from _tracks(address.drone_id, codec.decode(TracksMessage, payload))
        case Kind.IDENTITIES:
            said = codec.decode(SightingsMessage, payload)
            if is_from_nowhere(said):
                return
            here = (said.drone_id, *said.position_m, said.position_sigma_m)
            for one in said.sightings:
                row = (*here, one.drone_id, one.probability, *one.direction, one.sigma_rad)
                yield "identities", said.t_utc_s - said.age_s, row
        case Kind.HEALTH:
            health = codec.decode(HealthMessage, payload)
            yield "health", health.t_utc_s, _health(address.drone_id, health)


def _tracks(observer: int, message: TracksMessage) -> Iterator[tuple[str, float, Row]]:
    t, named = message.t_utc_s, {}
    for k, one in enumerate(message.tracks):
        named[one.id] = one.identity
        yield "tracks", t, (
            observer, one.id, message.camera_of(k), one.identity, one.identity_probability, one.status,
            one.probability, one.coasting_s, one.u_px, one.v_px, one.vu_px_s, one.vv_px_s, one.cov_upper[0],
            one.cov_upper[7], one.w_px, one.h_px,
        )  # fmt: skip
    for there in message.relatives:
        state = (*there.position_m, *there.velocity_m_s, *there.cov, there.range_sigma_log)
        yield "places", t, (observer, there.track_id, named[there.track_id], *state, " ".join(there.sources))


def _health(drone_id: int, said: HealthMessage) -> Row:
    ready = said.readiness
    return (
        drone_id, said.uptime_s, said.cpu_percent, said.rss_mb,
        None if ready is None else ready.ready, "" if ready is None else "; ".join(ready.reasons),
        said.clock_offset_s, sum(said.drops.values()), " ".join(link.name for link in said.links if not link.ok),
        "; ".join(said.events),
    )  # fmt: skip


def _ego(recordings: list[Recording]) -> Iterator[tuple[str, float, Row]]:
    for recording in recordings:
        if recording.kind != "drone":
            continue
        offset = utc_offset(recording)
        for message in recording.messages({EGO_TOPIC}):
            _, pose = inputs.decode(message.topic, message.data)
            assert isinstance(pose, EgoPose), "by its topic"
            place = ("", "", "") if pose.position is None else pose.position.tolist()
            turn = to_quaternion(pose.world_from_body).tolist()
            yield "ego", pose.t + offset, (
                recording.drone_id, *place, *turn, pose.position_sigma, pose.attitude_sigma,
            )  # fmt: skip


def _truth(recordings: list[Recording]) -> Iterator[tuple[str, float, Row]]:
    for recording in recordings:
        if recording.is_simulated_flight:
            epoch = recording.attached(FLIGHT_PLAN)["epoch_s"] + utc_offset(recording)
            for message in recording.messages({TRUTH_TOPIC}):
                true = read_truth(message)
                row = (true.drone_id, *true.position_m, *true.quaternion_wxyz)
                yield "truth", epoch + true.t_s, row
