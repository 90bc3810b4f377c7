"""Recordings: what is written comes back, whatever happens to the disk or the process."""

from __future__ import annotations

import errno
import json
import math
import os
import random
import struct
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

pytest.importorskip("foxglove", reason="foxglove-sdk has no wheel here")

from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from support.recorded_flight import BEGIN, UTC_ERROR, fly
from swarmtrack.agents import main as swarmtrack
from swarmtrack.clock import SystemClock
from swarmtrack.errors import RecordingError
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import (
    AgreedMotion,
    Announcement,
    AutopilotRebooted,
    Detections,
    EgoPose,
    FlightState,
    IdClash,
    ImuSample,
    LocatedStranger,
    MotionReport,
    PeerArrived,
    PeerDeparted,
    PeerExpelled,
    RangeReport,
    RemoteIdClaim,
    ScanReport,
    Sighting,
    SightingReport,
    StrangerRay,
    StrangerReport,
    TrackList,
    VisualTurn,
)
from swarmtrack.recording import inputs, outputs
from swarmtrack.recording.info import summarise
from swarmtrack.recording.merge import merge, shifts
from swarmtrack.recording.reader import files_below, recordings_below
from swarmtrack.recording.repair import repair
from swarmtrack.recording.writer import Bounds, Preface, RecordingWriter, Topic
from swarmtrack.runtime.recording_thread import MAX_QUEUED
from swarmtrack.runtime.swarm_recorder import TRUTH_TOPIC, VERDICT_TOPIC, SwarmRecorder, TruePose

TOPIC = Topic.of_json(
    "/x", {"title": "swarmtrack.X", "type": "object", "properties": {"k": {"type": "integer"}}}
)
PREFACE = Preface(
    {
        **{"format": "1", "kind": "drone", "drone_id": "7", "boot": "0000000a", "team": "t"},
        **{"monotonic_s": "12.5", "utc_s": "1700000000.0"},
    }
)
EYE = np.eye(3)
AWKWARD = [0.1, 1e-300, -0.0, 2.0**53 + 2, math.pi]

EVENTS = [
    ImuSample(0.1 + 0.2, np.array([1 / 3, -0.0, 5e-324]), np.array([math.nan, math.inf, -math.inf]), 0.1),
    EgoPose(1e9 + 1e-6, np.array(AWKWARD[:3]), EYE, 0.1, 0.02),
    EgoPose(2.0, None, EYE, math.inf, math.nan),
    EgoPose(2.5, np.array(AWKWARD[:3]), EYE, 0.9, 0.02, 1.8),
    FlightState(2.6, None),
    FlightState(2.7, -math.inf),
    FlightState(2.8, 1 / 3),
    AutopilotRebooted(),
    Detections(3.3, 2**40, np.empty((0, 2)), np.empty((0, 2)), np.empty(0), None, 0.25),
    Detections(
        3.4,
        8,
        np.array([[1.1, 2.2]]),
        np.array([[3.3, 4.4]]),
        np.array([0.7]),
        np.array([[[1.0, 0.1], [0.1, 2.0]]]),
    ),
    Announcement(65535, "0123abcd", 3, -1.5, 0.05, np.array(AWKWARD[2:]), EYE, EYE / 3),
    PeerArrived(2, "0123abcd"),
    PeerDeparted(2, "0123abcd"),
    PeerExpelled(2),
    IdClash(3, ("a", "b"), ours=True),
    IdClash(3, (), ours=False),
    SightingReport(
        2, "0123abcd", 9, 5.5, 0.01, np.zeros(3), 0.1, (1, 3),
        (Sighting(3, 0.99, np.array([0.6, 0.8, 0.0]), 0.01, True), Sighting(4, 0.99, EYE[0], 0.01)),
    ),
    MotionReport(2, "0123abcd", 4, 5.7, 0.01, np.array(AWKWARD[:3]), EYE / 3, np.array(AWKWARD[1:4]), EYE),
    RangeReport(1, 2, 5.8, 0.01, 1 / 3, 0.1),
    RemoteIdClaim(5.5, "UAS-1", np.array(AWKWARD[:3]), np.array(AWKWARD[1:4]), 1 / 3, 5.0),
    StrangerReport(
        2, "0123abcd", 9, 5.5, 0.01, np.zeros(3), 0.1, 0.01, 1 / 30,
        (StrangerRay(201, np.array([0.6, 0.8, 0.0]), 0.01, 1 / 30), StrangerRay(202, EYE[2], 0.1, 0.0)),
    ),
    AgreedMotion(2, np.array([-0.1, 0.3]), np.array([AWKWARD[:3], AWKWARD[1:4]]), planned=True),
    AgreedMotion(2, np.array([-0.1, 0.3]), np.array([AWKWARD[:3], AWKWARD[1:4]]), planned=False, tried=True),
    VisualTurn(0.1, 0.1 + 0.2, np.array(AWKWARD[:3]), 1 / 3),
    SightingReport(2, "0123abcd", 10, 5.6, 0.01, np.zeros(3), 0.1, (), ()),
]  # fmt: skip


def bits(value: object) -> object:
    """What two messages must share to be the same, bit for bit."""
    if isinstance(value, np.ndarray):
        return (value.shape, value.dtype.str, value.flags.c_contiguous, value.tobytes())
    if isinstance(value, float):
        return "nan" if math.isnan(value) else struct.pack("<d", value)
    if isinstance(value, tuple):
        return [bits(part) for part in value]
    if hasattr(value, "__slots__"):
        return (type(value), [bits(getattr(value, name)) for name in type(value).__dataclass_fields__])
    return (type(value), value)


def test_every_kind_of_input_has_an_example_here():
    assert {type(event) for event in EVENTS} == set(inputs.FORM_OF_KIND)


def test_a_pose_that_was_recorded_before_it_told_of_its_height_is_as_sure_on_all_axes():
    data = msgspec.json.decode(inputs.encode(1, EVENTS[1]))
    del data["vertical_sigma_m"]
    _, pose = inputs.decode("/ego", msgspec.json.encode(data))
    assert bits(pose) == bits(EVENTS[1])


@pytest.mark.parametrize("event", EVENTS, ids=lambda event: type(event).__name__)
def test_an_input_comes_back_bit_for_bit(event):
    data = inputs.encode(4711, event)
    json.loads(data, parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))
    n, back = inputs.decode(inputs.FORM_OF_KIND[type(event)].topic, data)
    assert (n, bits(back)) == (4711, bits(event))


@settings(max_examples=60)
@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=4, max_size=4))
def test_any_float_survives(numbers):
    sample = ImuSample(numbers[0], np.array(numbers[1:]), np.array(numbers[1:]))
    assert bits(inputs.decode("/imu", inputs.encode(1, sample))[1]) == bits(sample)


def test_a_gyro_recorded_before_its_delay_was_known_had_nothing_taken_off():
    _, sample = inputs.decode(
        "/imu", b'{"n":1,"t_s":2.5,"gyro_rad_s":[1,2,3],"accel_m_s2":["nan","nan","nan"]}'
    )
    assert (sample.t, sample.gyro_delay) == (2.5, 0.0)


def test_arrays_of_other_layouts_are_put_into_one_before_anything_is_computed_with_them():
    turned = EgoPose(0.0, None, np.asfortranarray(np.arange(9.0).reshape(3, 3)))
    narrow = Detections(
        0.0, 1, np.ones((2, 4), np.float32)[:, :2], np.ones((2, 2), np.float32), np.ones(2, np.float32)
    )
    assert turned.world_from_body.flags.c_contiguous
    assert (narrow.centre.dtype, narrow.centre.flags.c_contiguous) == (np.float64, True)


@pytest.mark.parametrize(
    "data", [b"", b"{", b"[]", b"{}", b'{"n":1,"t_s":"x"}', b"\xff\xfe", b'{"n":1,"t_s":null}']
)
@pytest.mark.parametrize("topic", inputs.FORM_OF_TOPIC)
def test_a_record_that_is_none_is_refused_with_a_sentence(topic, data):
    if topic == "/autopilot/rebooted" and b"n" in data and data.startswith(b"{"):
        return  # of which nothing else is asked
    with pytest.raises(RecordingError, match=topic):
        inputs.decode(topic, data)


# --- files ----------------------------------------------------------------------------------------


def write(folder: Path, seconds: float, *, hz: int = 100, payload: int = 0, close: bool = True, **bounds):
    """A recording of numbered messages; its clock is made up."""
    writer = RecordingWriter(folder, PREFACE, Bounds(folder.parent, **bounds))
    for k in range(round(seconds * hz)):
        now = k / hz
        padding = random.Random(k).randbytes(payload).hex()
        writer.write(TOPIC, round(now * 1e9), b'{"k":%d,"p":"%s"}' % (k, padding.encode()), now)
        writer.tick(now)
    if close:
        writer.close(seconds)
    return writer


def numbers(path: Path) -> list[int]:
    return [json.loads(m.data)["k"] for r in recordings_below(path) for m in r.messages()]


def test_segments_are_complete_and_open_in_the_reader_of_mcap(tmp_path):
    write(tmp_path / "life", 10.0, segment_s=3.0)
    files = sorted((tmp_path / "life").iterdir())
    assert [file.name for file in files] == ["0001.mcap", "0002.mcap", "0003.mcap", "0004.mcap"]
    seen = []
    for file in files:
        with file.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            seen += [json.loads(message.data)["k"] for _, _, message in reader.iter_messages()]
            assert {c.topic for c in reader.get_summary().channels.values()} == {"/x"}
            assert next(reader.iter_metadata()).metadata["drone_id"] == "7"
    assert seen == numbers(tmp_path) == list(range(1000))


def test_what_is_being_written_can_be_read_but_not_repaired(tmp_path):
    writer = write(tmp_path / "life", 5.0, close=False)
    active = tmp_path / "life" / "0001.mcap.active"
    assert len(numbers(active)) > 450
    with pytest.raises(RecordingError, match="being written"):
        repair(active)
    writer.close(5.0)
    assert numbers(tmp_path) == list(range(500))


def test_at_any_moment_what_is_there_of_a_recording_can_be_read(tmp_path, monkeypatch):
    real, looks = os.write, []

    def watched(descriptor, data):
        if list(tmp_path.rglob("*.mcap*")):
            looks.append(len(numbers(tmp_path)))
        return real(descriptor, data)

    monkeypatch.setattr("swarmtrack.recording.writer.os.write", watched)
    write(tmp_path / "life", 10.0, segment_s=3.0)
    assert looks == sorted(looks)
    assert looks[0] == 0
    assert looks[-1] > 950


def test_a_file_that_is_completed_after_it_was_found_is_read_by_its_new_name(tmp_path, monkeypatch):
    writer = write(tmp_path / "life", 5.0, close=False)
    (found,) = files_below(tmp_path)
    assert found.name == "0001.mcap.active"
    (recording,) = recordings_below(tmp_path)
    writer.close(5.0)
    assert len(list(recording.messages())) == 500
    # A listing may have had both names.
    completed = found.with_suffix("")
    monkeypatch.setattr(Path, "rglob", lambda folder, pattern: [found, completed])
    assert files_below(tmp_path) == [completed]
    completed.unlink()
    with pytest.raises(RecordingError, match=r"0001\.mcap: No such file"):
        list(recording.messages())


def test_what_its_writer_completes_just_now_needs_no_repair(tmp_path, monkeypatch):
    writer = write(tmp_path / "life", 5.0, close=False)
    # The writer ends between the look at its lock and the reading.
    monkeypatch.setattr("swarmtrack.recording.repair._is_being_written", lambda path: writer.close(5.0))
    assert repair(tmp_path / "life" / "0001.mcap.active") is None
    assert [path.name for path in (tmp_path / "life").iterdir()] == ["0001.mcap"]


@pytest.mark.parametrize("seed", range(12))
def test_a_file_cut_anywhere_becomes_a_complete_one(tmp_path, seed):
    write(tmp_path / "life", 5.0)
    file = tmp_path / "life" / "0001.mcap"
    data, chance = file.read_bytes(), random.Random(seed)
    cut = chance.randrange(8, len(data))
    file.write_bytes(data[:cut] + (chance.randbytes(40) if seed % 3 == 0 else b""))
    before = numbers(file) if b"swarmtrack.recording" in data[:cut] and cut > 400 else None
    try:
        repaired = repair(file)
    except RecordingError:
        assert before is None
        return
    if repaired is None:
        return  # the cut fell into the index's last bytes, which we need not
    with file.open("rb") as stream:
        found = [json.loads(message.data)["k"] for _, _, message in make_reader(stream).iter_messages()]
    assert found == list(range(repaired.messages))
    assert before is None or found == before
    assert file.with_name("0001.mcap.cut").read_bytes()[:cut] == data[:cut]
    assert repair(file) is None


def test_a_file_named_twice_is_read_once(flown):
    whole = recordings_below(flown[0])
    again = recordings_below(*files_below(flown[0]), flown[0], flown[0] / "drone-1")
    assert [[segment.path for segment in r.segments] for r in again] == [
        [segment.path for segment in r.segments] for r in whole
    ]


def test_segments_are_read_in_order_however_they_are_named(tmp_path, monkeypatch):
    write(tmp_path / "life", 10.0, segment_s=3.0)
    (whole,) = recordings_below(tmp_path)
    first, *others = [segment.path for segment in whole.segments]
    assert others
    monkeypatch.chdir(tmp_path)
    (again,) = recordings_below(*reversed(others), first.relative_to(tmp_path))
    assert [segment.path.absolute() for segment in again.segments] == [first, *others]


def test_some_topics_are_read_as_if_there_were_no_others(flown):
    for recording in recordings_below(flown[0]):
        everything = list(recording.messages())
        for topics in ({"/imu"}, {"/imu", "/asked"}, {"/none"}, set()):
            wanted = [message for message in everything if message.topic in topics]
            assert list(recording.messages(topics)) == wanted


@pytest.mark.parametrize(
    "garbage",
    [b"", b"#!/bin/sh\n", b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" + bytes(100), random.Random(1).randbytes(999)],
)
def test_garbage_is_called_so(tmp_path, capsys, garbage):
    (tmp_path / "flight.mcap").write_bytes(garbage)
    for command in ("info", "repair"):
        swarmtrack.main(["log", command, str(tmp_path)])
    assert swarmtrack.main(["log", "info", str(tmp_path)]) == 2
    assert swarmtrack.main(["replay", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert "flight.mcap" in error
    assert "expected" in error
    assert "Traceback" not in error


def test_what_is_not_there_is_said(tmp_path, capsys):
    assert swarmtrack.main(["log", "info", str(tmp_path / "nothing")]) == 2
    assert swarmtrack.main(["replay", str(tmp_path)]) == 2
    assert "no such file or folder, expected a recording" in capsys.readouterr().err


@pytest.mark.parametrize("segment_s", [2.0, 1e9])
def test_the_oldest_go_where_the_bound_is_reached(tmp_path, segment_s):
    bound = 400_000
    write(tmp_path / "20260101-a", 8.0, payload=400, segment_s=2.0)
    writer = write(tmp_path / "20260102-b", 20.0, payload=400, segment_s=segment_s, max_bytes=bound)
    assert sum(f.stat().st_size for f in tmp_path.rglob("*.mcap*")) <= bound
    assert not (tmp_path / "20260101-a").exists()
    assert writer.counters.segments_dropped > 0
    kept = numbers(tmp_path)
    assert kept == list(range(kept[0], 2000))


def test_or_recording_stops_there(tmp_path):
    writer = write(tmp_path / "b", 20.0, payload=400, segment_s=2.0, max_bytes=400_000, drop_oldest=False)
    assert "as much as recording.max_mb allows" in writer.trouble
    kept = numbers(tmp_path)
    assert kept == list(range(len(kept)))
    assert len(kept) + writer.counters.lost == 2000
    assert sum(f.stat().st_size for f in tmp_path.rglob("*.mcap*")) <= 400_000


def test_a_full_disk_is_waited_out(tmp_path, monkeypatch):
    """The whole way, on a disk that really is full, is in test_replay.py; this one is emptied again."""
    room = {"bytes": 60_000}
    real = os.write

    def small(descriptor, data):
        room["bytes"] -= len(data)
        if room["bytes"] < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(descriptor, data)

    monkeypatch.setattr("swarmtrack.recording.writer.os.write", small)
    writer = RecordingWriter(tmp_path / "a", PREFACE, Bounds(tmp_path))
    troubles = []
    for k in range(4000):
        now = k / 100
        if k == 2000:
            room["bytes"] = 10**9
        padding = random.Random(k).randbytes(200).hex()
        writer.write(TOPIC, k, b'{"k":%d,"p":"%s"}' % (k, padding.encode()), now)
        writer.tick(now)
        if writer.trouble != (troubles[-1] if troubles else None):
            troubles.append(writer.trouble)
    writer.close(40.0)
    assert "No space left on device; trying again every 10 s" in troubles[0]
    assert troubles[-1] is None
    kept = numbers(tmp_path)
    assert kept == sorted(set(kept))
    assert kept[-1] == 3999
    # What foxglove had taken when the disk refused it counts as written; it is a chunk or two.
    assert 3999 - len(kept) - writer.counters.lost < 400


# --- info and merge -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flight")
    return folder / "rec", fly(folder, 4.0)


def test_info_tells_topics_rates_and_what_it_is(flown, capsys):
    folder, _ = flown
    summary = summarise(recordings_below(folder / "drone-1")[0])
    assert summary.topics["/imu"].rate_hz == pytest.approx(100.0, rel=0.02)
    assert summary.topics["/imu"].gap_ns == pytest.approx(1e7, abs=1e4)
    assert summary.seconds == pytest.approx(4.0, abs=0.1)
    assert swarmtrack.main(["log", "info", str(folder), "--json"]) == 0
    records = json.loads(capsys.readouterr().out)
    assert [record["drone_id"] for record in records] == ["1", "2", "3"]
    assert records[0]["files"][0]["damage"] is None
    assert swarmtrack.main(["log", "info", str(folder)]) == 0
    assert "drone 2 of team t" in capsys.readouterr().out


def test_a_recording_explains_itself(flown):
    recording = recordings_below(flown[0] / "drone-2")[0]
    assert recording.preface["kind"] == "drone"
    assert {"swarmtrack", "python", "numpy", "scipy", "machine"} <= recording.preface.keys()
    assert recording.attached("config.json")["tracker"]["name"] == "mbm"
    assert recording.attached("resolved_config.json")["motion"]["history_s"] == 2.0
    assert recording.attached("calibration.json")["intrinsics"]["width"] == 640


def test_viewers_find_their_own_schemas(flown):
    recording = recordings_below(flown[0] / "drone-1")[0]
    for _ in recording.messages():
        pass
    segment = recording.segments[0]
    schemas = {c.topic: segment.schemas[c.schema_id] for c in segment.channels.values()}
    assert schemas["/camera/annotations"].name == "foxglove.ImageAnnotations"
    assert schemas["/pose"].name == "foxglove.PoseInFrame"
    assert schemas["/imu"].encoding == "jsonschema"
    assert json.loads(schemas["/imu"].data)["properties"]["gyro_rad_s"]["type"] == "array"


def test_merge_lays_three_drones_on_one_timeline_by_what_they_heard_of_each_other(flown, tmp_path, capsys):
    folder, _ = flown
    recordings = recordings_below(folder)
    moved = shifts(recordings)
    # Their wall clocks are wrong by tenths of a second; the 20 ms of radio cancel between two that hear each other.
    for drone, shift in zip((1, 2, 3), moved, strict=True):
        assert shift.by == "messages"
        assert shift.seconds == pytest.approx(UTC_ERROR[1] - UTC_ERROR[drone], abs=2e-3), BEGIN
    out = tmp_path / "all.mcap"
    assert swarmtrack.main(["log", "merge", str(folder), "--out", str(out)]) == 0
    assert "-400.0" in capsys.readouterr().out
    firsts = {}
    with out.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            if channel.topic.endswith("/imu"):
                assert schema.name == "swarmtrack.ImuSample"
                firsts.setdefault(channel.topic, message.log_time)
    assert set(firsts) == {"/drone-1/imu", "/drone-2/imu", "/drone-3/imu"}
    assert max(firsts.values()) - min(firsts.values()) < 3e6
    assert swarmtrack.main(["log", "merge", str(folder), "--out", str(out)]) == 2
    assert "exists already" in capsys.readouterr().err


def test_the_truth_of_a_long_flight_is_recorded_to_its_end(tmp_path):
    """After landing it comes at once, and there is more of it than fits into the recorder's queue."""
    recorder = SwarmRecorder(SystemClock(), "blue")
    recorder.open(tmp_path)
    recorder.landed()
    for k in range(MAX_QUEUED + 500):
        recorder.truth(0.0, TruePose(0.1 * k, 1, Pose.identity()))
    recorder.verdict({"passed": True})
    recorder.close()
    (recording,) = recordings_below(tmp_path)
    topics = [message.topic for message in recording.messages()]
    assert topics.count(TRUTH_TOPIC) == MAX_QUEUED + 500
    assert topics.count(VERDICT_TOPIC) == 1
    assert recorder.thread.lost == 0


def test_strangers_are_merged_by_utc(flown, tmp_path):
    one, two = recordings_below(flown[0] / "drone-1"), recordings_below(flown[0] / "drone-2")
    two[0].segments = []
    moved, count = merge([*one, *two], tmp_path / "m.mcap")
    assert [shift.by for shift in moved] == ["messages", "UTC"]
    assert count > 1000


def test_where_strangers_are_is_recorded_with_each_scan_and_digested_bit_for_bit():
    found = LocatedStranger(
        101, 5.5, np.array(AWKWARD[:3]), np.array(AWKWARD[1:4]), np.eye(6) / 3, (1, 2), "UAS-1"
    )
    without = ScanReport(7, TrackList(5.5, 5.5, ()))
    assert b"stranger" not in outputs.encode_report(without)
    read = outputs.decode_report(outputs.encode_report(without._replace(strangers=(found,))))
    (one,) = read.report.strangers
    assert bits(one) == bits(found)
    assert read.strangers_digest == outputs.strangers_digest((found,)) == outputs.strangers_digest((one,))
    nudged = replace(found, position=np.nextafter(found.position, np.inf))
    assert outputs.strangers_digest((nudged,)) != read.strangers_digest
