"""Messages of a simulator's truth: whose stamp counts, and what survives a pause, a reboot and a busy machine."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega

from support.places import SHARED
from swarmtrack.autopilot.framer import Framer
from swarmtrack.autopilot.tlog import records
from swarmtrack.geometry import rotation
from swarmtrack.geometry.geodesy import Geodetic, from_ned
from swarmtrack.lab.swarm.truth_messages import TrueSample, TruthReader

ORIGIN = Geodetic.from_degrees(-35.363262, 149.165237, 584.0)
EVERY = 0.02  # s
BOOTED = 100.0  # on our clock


def state(t: float, place: tuple[float, float, float] = (3.0, -2.0, -5.0)) -> ardupilotmega.MAVLink_message:
    """SIM_STATE of a drone that turns by 1 rad/s."""
    there = from_ned(np.array(place), ORIGIN)
    latitude, longitude = math.degrees(there.latitude), math.degrees(there.longitude)
    q = rotation.to_quaternion(rotation.from_euler(0.0, 0.0, t - BOOTED))
    return ardupilotmega.MAVLink_sim_state_message(
        *q, *(0.0,) * 9, latitude, longitude, there.height, 0.0, 0.0, 0.0, 0.0, 0.0,
        round(1e7 * latitude), round(1e7 * longitude),
    )  # fmt: skip


def attitude(t: float, booted: float = BOOTED) -> ardupilotmega.MAVLink_message:
    return ardupilotmega.MAVLink_attitude_quaternion_message(round(1e3 * (t - booted)), 1.0, 0, 0, 0, 0, 0, 0)


def hil(t: float, stamp: float | None = None) -> ardupilotmega.MAVLink_message:
    """stamp: None: t."""
    stamp = t - BOOTED if stamp is None else stamp
    there = from_ned(np.array([3.0, -2.0, -5.0]), ORIGIN)
    q = rotation.to_quaternion(rotation.from_euler(0.0, 0.0, t - BOOTED))
    return ardupilotmega.MAVLink_hil_state_quaternion_message(
        round(1e6 * stamp), list(q), 0, 0, 0, round(1e7 * math.degrees(there.latitude)),
        round(1e7 * math.degrees(there.longitude)), round(1e3 * there.height), 0, 0, 0, 0, 0, 0, 0, 0,
    )  # fmt: skip


def unstamped(t: float) -> ardupilotmega.MAVLink_message:
    """As every PX4 sends it."""
    return hil(t, stamp=0.0)


def standing_still(t: float) -> ardupilotmega.MAVLink_message:
    return hil(t, stamp=500.0)


def said(
    reader: TruthReader,
    times: Iterator[float],
    *kinds: Callable[[float], ardupilotmega.MAVLink_message],
    late: Callable[[int], float] = lambda k: 0.001,
) -> list[TrueSample]:
    """What the reader says of messages made at the times, which arrive late by so much."""
    return [
        truth for k, t in enumerate(times) for kind in kinds for truth in reader.read(kind(t), t + late(k))
    ]


def every_20_ms(start: float, seconds: float) -> list[float]:
    return [start + k * EVERY for k in range(round(seconds / EVERY))]


def error_s(truth: TrueSample) -> float:
    """How far its stamp is from when its attitude was true: it turns by 1 rad/s."""
    yaw = rotation.to_euler(truth.pose.rotation)[2]
    return math.remainder(truth.t - BOOTED - yaw, 2.0 * math.pi)


def test_position_and_attitude_are_those_of_the_world():
    (truth,) = said(TruthReader(ORIGIN), [BOOTED + 1.0], attitude, state)
    # 1e-7 degrees are 11 mm.
    assert truth.pose.position == pytest.approx([3.0, -2.0, -5.0], abs=0.012)
    assert rotation.to_euler(truth.pose.rotation) == pytest.approx([0.0, 0.0, 1.0], abs=1e-6)
    assert truth.place.height == pytest.approx(589.0, abs=1e-3)


@pytest.mark.parametrize(
    "kinds",
    [(state, attitude), (attitude, state), (hil,), (unstamped, attitude), (attitude, standing_still)],
)
def test_with_a_stamp_a_busy_machine_spoils_nothing(kinds):
    jitter = np.random.default_rng(1).exponential(0.008, 500)
    truths = said(
        TruthReader(ORIGIN), every_20_ms(BOOTED + 1.0, 10.0), *kinds, late=lambda k: 0.001 + jitter[k]
    )
    assert len(truths) == 500
    # The stamp is in milliseconds, and 1 ms of every way is unknown.
    assert max(abs(error_s(truth)) for truth in truths[50:]) < 2.5e-3


@pytest.mark.parametrize("kind", [state, unstamped, standing_still])
def test_without_a_stamp_the_arrival_counts(kind):
    truths = said(TruthReader(ORIGIN), every_20_ms(BOOTED + 1.0, 2.0), kind)
    assert len(truths) == 100
    assert max(abs(error_s(truth)) for truth in truths) < 1.5e-3


def test_stamps_of_other_times_are_nobodys():
    """ATTITUDE_QUATERNION comes at the same rate, but half an interval apart."""
    reader, truths = TruthReader(ORIGIN), []
    for t in every_20_ms(BOOTED + 1.0, 2.0):
        truths += reader.read(state(t), t + 0.001)
        truths += reader.read(attitude(t + 0.01), t + 0.011)
    assert len(truths) == 100
    assert max(abs(error_s(truth)) for truth in truths) < 1.5e-3


def test_a_simulator_that_stands_still_tells_nothing_new_and_goes_on_where_time_is():
    reader = TruthReader(ORIGIN)
    said(reader, every_20_ms(BOOTED + 1.0, 5.0), attitude, state)
    stopped = BOOTED + 5.98
    frozen = [reader.read(attitude(stopped), stopped + 0.02 * k) for k in range(1, 50)]
    assert not any(frozen)
    truths = said(reader, every_20_ms(stopped + 0.02, 5.0), attitude, state, late=lambda k: 8.0)
    assert reader.restarts == 1
    # 8 s late for ever: that is where its time is now.
    assert [truth.t - BOOTED for truth in truths[20:22]] == pytest.approx([14.40, 14.42], abs=5e-3)


def test_a_rebooted_simulator_is_followed_at_once():
    reader = TruthReader(ORIGIN)
    said(reader, every_20_ms(BOOTED + 1.0, 5.0), attitude, state)
    again = BOOTED + 20.0
    truths = said(reader, every_20_ms(again + 1.0, 1.0), lambda t: attitude(t, booted=again), state)
    assert reader.restarts == 1
    assert max(abs(error_s(truth)) for truth in truths) < 2e-3


def test_a_clock_that_runs_slow_is_soon_given_up():
    """PX4 in lockstep: 0.989 s of its time in a second of ours."""
    reader, errors = TruthReader(ORIGIN), []
    for t in every_20_ms(BOOTED + 1.0, 30.0):
        slow = hil(BOOTED + 0.989 * (t - BOOTED))
        errors += [truth.t - t for truth in reader.read(slow, t + 0.001)]
    assert max(map(abs, errors)) < 0.025
    assert max(map(abs, errors[250:])) < 0.002


def test_a_stamp_that_moved_and_stands_still_is_no_truth_and_said():
    reader = TruthReader(ORIGIN)
    said(reader, every_20_ms(BOOTED + 1.0, 2.0), hil)
    assert reader.refused is None
    frozen = [reader.read(hil(BOOTED + 2.98), BOOTED + 3.0 + 0.02 * k) for k in range(50)]
    assert not any(frozen)
    assert reader.refused == (pytest.approx(BOOTED + 3.98), "its stamp stands still at 2.980 s")
    assert said(reader, [BOOTED + 4.0], hil)
    assert reader.refused is None


def test_where_the_truth_has_a_stamp_of_its_own_another_clocks_is_not_heard():
    """Some simulators stamp by another clock than their autopilot does."""
    reader = TruthReader(ORIGIN)
    truths = said(
        reader,
        every_20_ms(BOOTED + 1.0, 2.0),
        lambda t: hil(t, stamp=t - BOOTED + 1000.0),
        lambda t: attitude(t, booted=BOOTED - 4000.0),
    )
    assert len(truths) == 100
    assert reader.restarts == 0
    assert max(abs(error_s(truth)) for truth in truths) < 1.5e-3


@pytest.mark.parametrize("broken", [(0.0, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 1.0), (5.0, 0.0, 0.0, 0.0)])
def test_a_quaternion_that_is_none_is_no_truth(broken):
    message = state(BOOTED)
    message.q1, message.q2, message.q3, message.q4 = broken
    reader = TruthReader(ORIGIN)
    assert reader.read(attitude(BOOTED), BOOTED) == []
    assert reader.read(message, BOOTED) == []
    assert reader.refused == (BOOTED, "its attitude or its position is no number")


@pytest.mark.shared
def test_a_real_autopilots_truth_agrees_with_its_estimate():
    """ArduPilot SITL, recorded: position and attitude of SIM_STATE beside its own EKF's."""
    home = Geodetic.from_degrees(-35.363261, 149.165230, 584.0)
    reader, framer = TruthReader(home), Framer()
    parser = ardupilotmega.MAVLink(None)
    truths, estimates, tilts = [], [], []
    for arrival, record in records((SHARED / "mavlink" / "ardupilot_sitl.tlog").read_bytes()):
        for frame in framer.feed(record):
            if (frame.system, frame.component) != (1, 1):
                continue
            message = parser.decode(bytearray(frame.data))
            if message.get_type() == "LOCAL_POSITION_NED":
                estimates.append((arrival, message.x, message.y, message.z))
            elif message.get_type() == "ATTITUDE":
                tilts.append((arrival, message.roll, message.pitch))
            truths += reader.read(message, arrival)
    t = np.array([truth.t for truth in truths])
    assert (np.diff(t) > 0).all()
    # The estimates come 10 s after the start.
    later = [truth for truth in truths if estimates[0][0] + 20.0 < truth.t < estimates[-1][0]]
    when = [truth.t for truth in later]
    found = np.array([truth.pose.position for truth in later])
    expected = np.column_stack([np.interp(when, *np.array(estimates)[:, (0, axis)].T) for axis in (1, 2, 3)])
    assert np.abs(np.median(found - expected, axis=0)).max() < 0.3
    assert np.abs(found - expected).max() < 1.0
    euler = np.array([rotation.to_euler(truth.pose.rotation)[:2] for truth in later])
    said_tilt = np.column_stack([np.interp(when, *np.array(tilts)[:, (0, axis)].T) for axis in (1, 2)])
    assert np.degrees(np.percentile(np.abs(euler - said_tilt), 95)) < 1.5
