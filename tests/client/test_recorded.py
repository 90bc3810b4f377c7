"""A recording as data: through the client's interface, as tables, and as a bag of ROS 2."""

from __future__ import annotations

import asyncio
import csv
import runpy
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("foxglove", reason="foxglove-sdk has no wheel here")
pytest.importorskip("zenoh", reason="Zenoh has no wheel here")

from support.places import DOCS
from support.recorded_flight import fly
from support.recorded_swarm import DEPARTED, TEAM, UTC, record_swarm
from swarmtrack.agents import main as swarmtrack
from swarmtrack.client import Sight, recorded
from swarmtrack.client.axes import Axes
from swarmtrack.client.heard import HeardTeam
from swarmtrack.clock import ManualClock
from swarmtrack.errors import RecordingError
from swarmtrack.monitor.recorded import read_timeline
from swarmtrack.recording.reader import recordings_below
from swarmtrack.runtime.swarm_recorder import HEARD_TOPIC, read_heard

SECONDS = 40.0


@pytest.fixture(scope="module")
def heard(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("heard") / "flight"
    record_swarm(folder, SECONDS)
    return folder


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> Path:
    """What three drones recorded themselves."""
    folder = tmp_path_factory.mktemp("flown")
    fly(folder, 4.0, faults=False)
    return folder / "rec"


def table(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))


def summary(sight: Sight) -> tuple:
    targets = [(t.id, t.identity, t.probability, *t.pixel.tolist()) for t in sight.targets]
    return sight.drone_id, sight.t_utc_s, sight.sequence, tuple(targets)


async def planner(swarm, found: list) -> None:
    """Code of a planner: it cannot know whether its team is live."""
    async with swarm:
        found.extend([summary(sight) async for sight in swarm.tracks(1)])


def test_a_recording_yields_what_the_live_client_did(heard):
    # The live client's own reading of the same bytes.
    live, team = [], HeardTeam(TEAM, Axes.NED, ManualClock(100.0, UTC))
    for message in recordings_below(heard)[0].messages({HEARD_TOPIC}):
        sample = read_heard(message).sample
        if "/alive/" in sample.key:
            team.on_token(sample.key, sample.alive, sample.arrived)
        elif "/tracks/1" in sample.key:
            live.append(summary(team.on_tracks(sample)))
    found: list = []
    asyncio.run(planner(recorded(heard), found))
    assert len(found) == SECONDS * 5
    assert found == live


def test_it_is_in_time_order_and_news(heard, flown):
    for folder in (heard, flown):
        items = list(recorded(folder))
        assert len(items) > 50
        arrived = [item.arrived for item in items if isinstance(item, Sight)]
        assert arrived == sorted(arrived)
        assert all(item.is_news for item in items)


async def test_a_reader_that_leaves_leaves_the_rest_to_the_next(heard):
    async with recorded(heard) as swarm:
        sights = swarm.tracks(1)
        first = await anext(sights)
        await sights.aclose()
        rest = [sight async for sight in swarm.tracks(1)]
        assert [sight async for sight in swarm.tracks(1)] == []
    assert (first.sequence, rest[-1].sequence - first.sequence) == (1, len(rest))


def test_a_drone_that_recorded_itself_has_directions(flown):
    swarm = recorded(flown, axes="enu")
    list(swarm)
    assert swarm.camera(1) is not None
    targets = [target for item in recorded(flown) if isinstance(item, Sight) for target in item.targets]
    assert targets
    assert all(target.direction_body is not None for target in targets)


async def test_two_readers_of_different_speed_lose_nothing(heard):
    counts: Counter[int] = Counter()

    async def read(swarm, drone_id: int) -> None:
        async for _ in swarm.tracks(drone_id, keep=1):
            counts[drone_id] += 1
            if drone_id == 2:
                await asyncio.sleep(0.0)

    async with recorded(heard) as swarm, asyncio.TaskGroup() as tasks:
        for drone_id in (1, 2, 3):
            tasks.create_task(read(swarm, drone_id))
    assert counts == {1: SECONDS * 5, 2: SECONDS * 5, 3: DEPARTED * 5 - 1}
    assert not swarm.counters


def test_nothing_to_read_is_an_error(tmp_path):
    with pytest.raises(RecordingError, match=r"holds no \.mcap"):
        recorded(tmp_path)


# --- tables ---------------------------------------------------------------------------------------


def test_tables_hold_every_message_and_name_what_is_missing(heard, tmp_path, capsys):
    out = tmp_path / "tables"
    assert swarmtrack.main(["log", "csv", str(heard), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "not in this recording: " in said
    assert "ego, truth" in said
    items = [item for item in recorded(heard) if isinstance(item, Sight)]
    rows = table(out / "tracks.csv")
    assert len(rows) == sum(len(item.targets) for item in items)
    (first, *_), target = rows, items[0].targets[0]
    assert float(first["t_utc_s"]) == items[0].t_utc_s
    assert float(first["u_px"]) == target.pixel[0]
    assert float(first["var_v_px2"]) == target.pixel_cov[2, 2]
    assert {row["teammate"] for row in table(out / "identities.csv")} <= {"1", "2", "3"}
    assert not (out / "truth.csv").exists()


def test_places_have_the_covariance_of_the_client(flown, tmp_path):
    out = tmp_path / "tables"
    assert swarmtrack.main(["log", "csv", str(flown), "--out", str(out)]) == 0
    relatives = [
        (item.drone_id, target.relative)
        for item in recorded(flown)
        if isinstance(item, Sight)
        for target in item.targets
        if target.relative is not None
    ]
    rows = table(out / "places.csv")
    assert len(rows) == len(relatives) > 10
    for row, (observer, relative) in zip(rows, relatives, strict=True):
        assert int(row["observer"]) == observer
        cov = [float(row[f"cov_{i}{j}"]) for i in range(6) for j in range(i, 6)]
        assert cov == pytest.approx(relative.cov[np.triu_indices(6)].tolist(), rel=1e-9, abs=1e-12)
    assert {row["drone"] for row in table(out / "ego.csv")} == {"1", "2", "3"}


def test_a_folder_of_something_else_is_not_replaced(heard, tmp_path, capsys):
    out = tmp_path / "tables"
    command = ["log", "csv", str(heard), "--out", str(out)]
    assert swarmtrack.main(command) == 0
    assert swarmtrack.main(command) != 0
    assert "--force" in capsys.readouterr().err
    (out / "letter.txt").write_text("mine")
    assert swarmtrack.main([*command, "--force"]) == 0
    for tables in out.glob("*.csv"):
        tables.unlink()
    assert swarmtrack.main([*command, "--force"]) != 0
    assert "is no output of swarmtrack log csv" in capsys.readouterr().err
    assert (out / "letter.txt").read_text() == "mine"


def test_without_a_destination_folders_are_counted(heard, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("flight-csv", "flight-csv-2"):
        assert swarmtrack.main(["log", "csv", str(heard)]) == 0
        assert (tmp_path / name / "tracks.csv").is_file()


def test_parquet_holds_the_same(heard, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra parquet")
    out = tmp_path / "tables"
    assert swarmtrack.main(["log", "csv", str(heard), "--out", str(out), "--parquet"]) == 0
    found = parquet.read_table(out / "tracks.parquet").to_pylist()
    rows = table(out / "tracks.csv")
    assert [row["t_utc_s"] for row in found] == [float(row["t_utc_s"]) for row in rows]
    assert [row["identity"] or "" for row in found] == [row["identity"] for row in rows]


def test_the_example_draws_three_plots(flown, tmp_path, monkeypatch, capsys):
    pytest.importorskip("matplotlib", reason="needs the extra bench")
    out = tmp_path / "tables"
    assert swarmtrack.main(["log", "csv", str(flown), "--out", str(out)]) == 0
    (out / "truth.csv").write_text(
        "t_s,drone,north_m,east_m,down_m\n"
        + "".join(f"{t},{drone},{drone},0,-2\n" for drone in (1, 2, 3) for t in (0, 10))
    )
    monkeypatch.setattr(sys, "argv", ["plot_flight.py", str(out)])
    runpy.run_path(str(DOCS / "examples" / "plot_flight.py"), run_name="__main__")
    assert "not drawn" not in capsys.readouterr().out
    for name in ("paths", "distances", "errors"):
        assert (out / f"{name}.png").stat().st_size > 10_000


# --- ROS 2 ----------------------------------------------------------------------------------------


def test_a_bag_reads_as_the_recording(flown, tmp_path):
    highlevel = pytest.importorskip("rosbags.highlevel", reason="needs the extra rosbag")
    out = tmp_path / "bag"
    assert swarmtrack.main(["log", "rosbag", str(flown), "--out", str(out)]) == 0
    timeline = read_timeline([flown])
    with highlevel.AnyReader([out]) as reader:
        topics = {connection.topic: connection for connection in reader.connections}
        assert {"/tf", "/swarm/d1/odometry", "/swarm/markers"} <= set(topics)
        ((_, _, raw), *_) = reader.messages([topics["/swarm/d1/teammate2/pose"]])
        pose = reader.deserialize(raw, topics["/swarm/d1/teammate2/pose"].msgtype)
    t = pose.header.stamp.sec + 1e-9 * pose.header.stamp.nanosec
    said = timeline.tracks_at(1, t)
    (track,) = [track for track in said.tracks if track.identity == 2]
    (there,) = [one for one in said.relatives if one.track_id == track.id]
    north, east, down = there.position_m
    position = pose.pose.pose.position
    assert (position.x, position.y, position.z) == pytest.approx((east, north, -down), abs=1e-9)
