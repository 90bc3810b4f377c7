"""Telemetry logs: whatever the clock of the computer that wrote one did, time passes as the autopilot's."""

from __future__ import annotations

import random

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from support.autopilot_flight import Listener
from support.fake_autopilot import FakeAutopilot
from support.mutants import mutants
from support.places import SHARED
from swarmtrack.autopilot import tlog as tlog_module
from swarmtrack.autopilot.framer import HEARTBEAT, Framer, MavlinkFrame
from swarmtrack.autopilot.mavlink_autopilot import MavlinkAutopilot
from swarmtrack.autopilot.tlog import records
from swarmtrack.clock import ManualClock

UTC = 1_700_000_000.0
BOOT = 40.0  # s since its boot, at the first record
DAY = 86_400.0


def tlog(frames: list[tuple[float, bytes]], utc: float = UTC) -> bytes:
    """frames: (s since the first record, bytes)."""
    return b"".join(round(1e6 * (utc + t)).to_bytes(8, "big") + frame for t, frame in frames)


def flight(seconds: float, hz: float = 20.0, *, pauses=(), seed: int = 0) -> list[tuple[float, bytes]]:
    """Attitudes beside heartbeats, of some milliseconds of latency. pauses: (begin, end) s without reception."""
    mav, chance = common.MAVLink(None, 1, 1), random.Random(seed)
    found = []
    for k in range(round(seconds * hz)):
        t = k / hz
        if any(begin <= t < end for begin, end in pauses):
            continue
        quaternion = common.MAVLink_attitude_quaternion_message(
            round(1e3 * (BOOT + t)), 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        )
        beat = common.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3)
        found += [
            (t + chance.uniform(0.0, 0.02), bytes(m.pack(mav)))
            for m in (quaternion, beat)[: 1 + (k % 7 == 0)]
        ]
    return sorted(found)


def played(data: bytes) -> tuple[list[tuple[float, bytes]], list[tuple[float, float]]]:
    steps: list[tuple[float, float]] = []
    found = list(records(data, lambda at, by: steps.append((at, by))))
    return found, steps


@pytest.mark.parametrize("by", [10 * DAY, -10 * DAY, -3.0, 2.0, 40.0, -0.2, 7200.0, -7200.0])
@pytest.mark.parametrize("pauses", [(), [(9.0, 17.0)]])
def test_a_step_of_the_computers_clock_is_taken_out_and_told(by, pauses):
    frames = flight(30.0, pauses=pauses)
    found, steps = played(tlog([(t + by * (t >= 17.0), frame) for t, frame in frames]))
    assert [frame for _, frame in found] == [frame for _, frame in frames]
    assert [t - UTC for t, _ in found] == pytest.approx([t for t, _ in frames], abs=0.03)
    assert [(round(at), pytest.approx(by, abs=0.03)) for at, by in steps] == [
        (17, pytest.approx(by, abs=0.03))
    ]


def test_a_clock_that_begins_in_1970_and_is_set_twice_loses_nothing():
    frames = flight(60.0)
    set_at = lambda t: UTC if t > 40.0 else 315_532_800.0 if t > 20.0 else 12.0  # noqa: E731
    found, steps = played(tlog([(set_at(t) + t, frame) for t, frame in frames], utc=0.0))
    assert [frame for _, frame in found] == [frame for _, frame in frames]
    assert [t - 12.0 for t, _ in found] == pytest.approx([t for t, _ in frames], abs=0.03)
    assert len(steps) == 2


def test_a_pause_is_no_step():
    frames = flight(120.0, pauses=[(10.0, 10.7), (20.0, 25.0), (40.0, 100.0)])
    found, steps = played(tlog(frames))
    assert steps == []
    assert [t - UTC for t, _ in found] == pytest.approx([t for t, _ in frames], abs=1e-5)


def test_what_waited_during_a_pause_and_comes_in_a_burst_is_no_step():
    frames = [(max(t, 13.0) if t > 10.0 else t, frame) for t, frame in flight(30.0)]
    assert played(tlog(frames))[1] == []


def test_without_a_stamp_in_any_frame_going_back_is_a_step_and_less_than_a_day_a_pause():
    beat = FakeAutopilot().step(0.0)[0]
    found, steps = played(tlog([(0.0, beat), (3600.0, beat), (3590.0, beat), (3591.0, beat)]))
    assert [t - UTC for t, _ in found] == pytest.approx([0.0, 3600.0, 3600.0, 3601.0], abs=1e-5)
    assert steps == [(3600.0, pytest.approx(-10.0))]
    assert played(tlog([(0.0, beat), (30 * DAY, beat), (30 * DAY + 1.0, beat)]))[1] == [
        (0.0, pytest.approx(30 * DAY))
    ]


def test_another_program_on_the_same_computer_does_not_tell_how_long_it_took():
    """Its frames are stamped by the very clock that is set."""
    theirs = common.MAVLink(None, 1, 197)
    frames = flight(30.0)
    for k in range(600):
        stamped = lambda by, t=k / 20: bytes(  # noqa: E731
            common.MAVLink_vision_position_estimate_message(round(1e6 * (UTC + t + by)), *[0.0] * 6).pack(
                theirs
            )
        )
        frames.append((k / 20 + 1e-3, stamped(5.0 if k >= 340 else 0.0)))
    frames.sort()
    found, steps = played(tlog([(t + 5.0 * (t >= 17.0), frame) for t, frame in frames]))
    assert [round(by) for _, by in steps] == [5]
    assert found[-1][0] - UTC == pytest.approx(frames[-1][0], abs=0.03)


def test_garbage_in_a_log_is_handed_on_and_costs_no_record():
    frame = FakeAutopilot().step(0.0)[0]
    false = b"\xfd\xff\x00 false"
    data = tlog([(0, frame), (1, b"garbage without magic"), (2, frame), (3, false), (4, frame), (5, frame)])
    found, steps = played(data)
    assert b"".join(d for _, d in found).count(frame) == 4
    assert found[-1] == (pytest.approx(UTC + 5), frame)
    assert steps == []


async def test_a_log_of_a_streams_pieces_loses_no_frame(tmp_path):
    """As a program writes it that logs whatever it has read at once."""
    frames = flight(20.0)
    stream, pieces = b"", []
    for t, frame in frames:
        stream += frame
        while len(stream) >= 64:
            pieces.append((t, stream[:64]))
            stream = stream[64:]
    path = tmp_path / "flight.tlog"
    path.write_bytes(tlog([*pieces, (20.0, stream)]))
    autopilot, kept = MavlinkAutopilot(f"tlog:{path}?speed=0", clock=ManualClock(1000.0)), Listener()
    await autopilot.run(kept)
    assert len(kept.poses) == 400


# --- heartbeats are looked up, and the log is framed once ---------------------------------------------


def framed_heartbeats(data: bytes) -> list[MavlinkFrame]:
    """By framing all."""
    framer = Framer()
    return [frame for _, record in records(data) for frame in framer.feed(record) if frame.id == HEARTBEAT]


def looked_up(data: bytes) -> list[MavlinkFrame]:
    return [frame for frames in tlog_module.heartbeats(data) for frame in frames]


@pytest.mark.shared
@pytest.mark.parametrize("name", ["ardupilot_sitl", "dronekit_flight_2015"])
def test_the_heartbeats_of_a_real_log_are_found_and_little_of_it_is_framed(name, monkeypatch):
    data = (SHARED / "mavlink" / f"{name}.tlog").read_bytes()
    expected, fed = framed_heartbeats(data), [0]

    class Counting(Framer):
        def datagram(self, data: bytes) -> list[MavlinkFrame]:
            fed[0] += len(data)
            return super().datagram(data)

    monkeypatch.setattr(tlog_module, "Framer", Counting)
    assert looked_up(data) == expected
    assert fed[0] < 0.2 * len(data)


def test_heartbeats_are_found_over_the_seams_of_a_log_and_once_each(monkeypatch):
    data = tlog(flight(20.0))
    for piece in (7, 16, 64, 1000):
        monkeypatch.setattr(tlog_module, "TLOG_BYTES_PER_TURN", piece)
        assert looked_up(data) == framed_heartbeats(data)


def test_heartbeats_are_found_whatever_is_damaged():
    for mutant in mutants(tlog(flight(5.0)), 150, seed=5):
        assert {frame.data for frame in framed_heartbeats(mutant)} <= {
            frame.data for frame in looked_up(mutant)
        }


def test_a_heartbeat_in_a_tunnels_payload_is_nobodys_on_this_link():
    theirs = common.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3).pack(common.MAVLink(None, 9, 1))
    payload = list(theirs) + [0] * (128 - len(theirs))
    tunnel = common.MAVLink_tunnel_message(1, 1, 0, len(theirs), payload).pack(common.MAVLink(None, 1, 1))
    data = tlog([*flight(2.0), (2.1, bytes(tunnel))])
    assert {frame.system for frame in looked_up(data)} == {1}


def test_heartbeats_that_stamps_cut_in_pieces_are_found():
    stream = b"".join(frame for _, frame in flight(5.0))
    data = tlog([(0.01 * k, stream[at : at + 16]) for k, at in enumerate(range(0, len(stream), 16))])
    assert framed_heartbeats(data)
    assert looked_up(data) == framed_heartbeats(data)


@pytest.mark.parametrize("damage", [1 << 20, 1 << 33, 1 << 44, 1 << 47])
def test_one_damaged_stamp_moves_no_other_record(damage):
    frames = flight(10.0)
    data = bytearray(tlog(frames))
    at = len(tlog(frames[:100]))
    stamp = int.from_bytes(data[at : at + 8], "big") ^ damage
    data[at : at + 8] = stamp.to_bytes(8, "big")
    found, steps = played(bytes(data))
    assert steps == []
    assert b"".join(d for _, d in found).count(b"\xfd") == sum(frame.count(b"\xfd") for _, frame in frames)
    assert found[-1][0] - UTC == pytest.approx(frames[-1][0], abs=1e-5)


def test_times_never_go_back_whatever_is_damaged():
    data = tlog(flight(5.0))
    for mutant in mutants(data, 150, seed=3):
        found, _ = played(mutant)
        times = [t for t, _ in found]
        assert (np.diff(times) >= 0.0).all()


@pytest.mark.parametrize(
    ("gyro_since", "poses_since", "lost"),
    [(BOOT, BOOT, 0), (UTC, UTC, 0), (UTC, BOOT, 5), (4_294_960.0, 4_294_960.0, 0)],
    ids=["boot", "1970", "1970 and boot", "wrap"],
)
async def test_each_time_base_of_a_log_has_its_map(tmp_path, gyro_since, poses_since, lost):
    """Microseconds since one instant, milliseconds of 32 bits since the same or another."""
    mav, frames = common.MAVLink(None, 1, 1), []
    for k in range(3000):
        t = k / 200
        said = [
            common.MAVLink_highres_imu_message(round(1e6 * (gyro_since + t)), 0.0, 0.0, -9.8, *[0.0] * 10, 63)
        ]
        if k % 200 == 0:
            said.append(common.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3))
        if k % 4 == 0:
            ms = round(1e3 * (poses_since + t)) % 2**32
            said.append(common.MAVLink_attitude_quaternion_message(ms, 1.0, *[0.0] * 6))
            said.append(common.MAVLink_local_position_ned_message(ms, 1.0, 2.0, -3.0, 0.0, 0.0, 0.0))
        frames += [(t, bytes(m.pack(mav))) for m in said]
    path = tmp_path / "flight.tlog"
    path.write_bytes(tlog(frames))
    autopilot, kept = MavlinkAutopilot(f"tlog:{path}?speed=0", clock=ManualClock(1000.0)), Listener()
    await autopilot.run(kept)
    assert len(kept.imu) == 3000
    assert 750 - lost <= len(kept.poses) <= 750
    assert sum(pose.position is not None for pose in kept.poses) >= len(kept.poses) - 1
    assert [pose.t for pose in kept.poses[-700:]] == pytest.approx(
        (1015.0 - 0.02 * np.arange(700, 0, -1)).tolist(), abs=0.002
    )
    assert kept.reboots == 0


@pytest.mark.shared
@pytest.mark.parametrize("by", [10 * DAY, -3.0])
async def test_all_of_a_real_flight_is_imported_when_its_computers_clock_is_set(tmp_path, by, caplog):
    recorded = list(records((SHARED / "mavlink" / "ardupilot_sitl.tlog").read_bytes()[:300_000]))
    path = tmp_path / "flight.tlog"
    since = recorded[0][0]
    path.write_bytes(tlog([(t - since + by * (t - since >= 4.0), data) for t, data in recorded]))
    autopilot, kept = MavlinkAutopilot(f"tlog:{path}?speed=0", clock=ManualClock(1000.0)), Listener()
    await autopilot.run(kept)
    lasts = recorded[-1][0] - since
    assert len(kept.imu) == pytest.approx(200 * (lasts - 0.36), abs=4)
    assert kept.imu[-1].t == pytest.approx(1000.0 + lasts, abs=0.03)
    assert kept.poses[-1].t == pytest.approx(1000.0 + lasts, abs=0.03)
    assert np.diff([sample.t for sample in kept.imu]).max() < 0.02
    assert "was set by" in caplog.text


USELESS_STAMPS = {
    "zero": lambda t: bytes(8),
    "all equal": lambda t: round(1e6 * UTC).to_bytes(8, "big"),
    "milliseconds": lambda t: round(1e3 * (UTC + t)).to_bytes(8, "big"),
    "little-endian": lambda t: round(1e6 * (UTC + t)).to_bytes(8, "little"),
    "two by turns": lambda t: round(1e6 * (UTC + 3600.0 * (int(1e3 * t) % 2))).to_bytes(8, "big"),
}


@pytest.mark.parametrize("stamp", USELESS_STAMPS.values(), ids=USELESS_STAMPS)
def test_where_the_stamps_do_not_advance_as_time_does_the_autopilot_tells_all_times(stamp):
    frames, told = flight(60.0), []
    data = b"".join(stamp(t) + frame for t, frame in frames)
    found = list(records(data, on_useless=lambda: told.append(True)))
    assert told == [True]
    assert [frame for _, frame in found] == [frame for _, frame in frames]
    assert [t for t, _ in found] == pytest.approx([t for t, _ in frames], abs=0.08)


@pytest.mark.parametrize("speed", [0.2, 1.0, 10.0])
def test_a_simulation_may_be_slower_or_faster_than_time(speed):
    frames = [(t / speed, frame) for t, frame in flight(30.0)]
    told = []
    found = list(records(tlog(frames), on_useless=lambda: told.append(True)))
    assert [t - UTC for t, _ in found] == pytest.approx([t for t, _ in frames], abs=1e-5)
    assert told == []


def test_what_a_radio_had_held_back_at_the_beginning_is_no_useless_stamp():
    frames = [(max(t, 10.0), frame) for t, frame in flight(17.0)]
    told = []
    list(records(tlog(frames), on_useless=lambda: told.append(True)))
    assert told == []


@pytest.mark.parametrize("steps", [100, 110])
def test_of_a_clock_that_leaps_before_any_frame_is_stamped_time_goes_on(steps):
    beat = bytes(common.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3).pack(common.MAVLink(None, 1, 1)))
    leaping = [(0.1 * k - 10.0 * (k // 5), beat) for k in range(5 * steps + 1)]
    stamped = flight(30.0)
    found, told = played(tlog(leaping + [(leaping[-1][0] + t, frame) for t, frame in stamped]))
    assert len(told) >= 100
    times = [t for t, _ in found[len(leaping) :]]
    assert [t - times[0] for t in times] == pytest.approx([t - stamped[0][0] for t, _ in stamped], abs=0.1)


async def test_of_a_clock_that_leaps_all_the_time_the_first_steps_are_said_and_the_autopilot_tells(
    tmp_path, caplog
):
    frames, path = flight(300.0), tmp_path / "flight.tlog"
    path.write_bytes(tlog([(t + 3600.0 * (int(t) % 2 and t > 20.0), frame) for t, frame in frames]))
    autopilot, kept = MavlinkAutopilot(f"tlog:{path}?speed=0", clock=ManualClock(1000.0)), Listener()
    await autopilot.run(kept)
    assert len(kept.poses) == 6000
    assert kept.poses[-1].t == pytest.approx(1300.0, abs=0.5)
    said = [record.message for record in caplog.records if "was set" in record.message]
    assert len(said) == 4
    assert said[-1].endswith("that clock was set 100 times in all")
    assert "those of its autopilot are used from here on" in caplog.text
