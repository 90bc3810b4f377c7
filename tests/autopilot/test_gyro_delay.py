"""How late an autopilot's gyro is: asked for once, taken off its stamps, and nothing else is touched."""

from __future__ import annotations

import logging
import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import common
from scipy import signal

from support.autopilot_flight import Flight, Listener
from support.fake_autopilot import FakeAutopilot, FakePx4
from support.places import SHARED
from swarmtrack.autopilot.gyro_delay import GyroDelays, low_pass_delay, mean_delay
from swarmtrack.autopilot.limits import PARAMETER_REQUESTS
from swarmtrack.autopilot.mavlink_autopilot import MavlinkAutopilot
from swarmtrack.autopilot.streams import ATTITUDE_QUATERNION, HIGHRES_IMU
from swarmtrack.clock import ManualClock
from swarmtrack.lab.autopilots.vehicle_parameters import PX4_PARAMETERS, VehicleParameters

RECORDED = SHARED / "mavlink" / "ardupilot_sitl.tlog"


def seconds_late(fed, said, rate_hz):
    """By how many seconds a slow sine comes out later than it went in."""
    phase = [np.angle(np.exp(-2j * np.pi * np.arange(len(x)) / rate_hz) @ x) for x in (fed, said)]
    return (phase[0] - phase[1]) / (2 * np.pi)


@pytest.mark.parametrize("cutoff_hz", [20.0, 40.0, 80.0])
def test_a_low_pass_is_as_late_as_a_filter_shows(cutoff_hz):
    rate_hz = 8000.0
    turned = np.sin(2 * np.pi * np.arange(int(10 * rate_hz)) / rate_hz)
    filtered = signal.lfilter(*signal.butter(2, cutoff_hz, fs=rate_hz), turned)
    whole = slice(int(2 * rate_hz), None)
    assert low_pass_delay(cutoff_hz) == pytest.approx(
        seconds_late(turned[whole], filtered[whole], rate_hz), rel=0.01
    )


def test_a_mean_is_as_late_as_averaging_shows():
    rate_hz, fine = 200.0, 40
    t = (np.arange(int(4 * rate_hz * fine)) + 0.5) / (rate_hz * fine)
    means = np.sin(2 * np.pi * t).reshape(-1, fine).mean(axis=1)
    at_its_end = np.sin(2 * np.pi * np.arange(1, len(means) + 1) / rate_hz)
    assert mean_delay(rate_hz) == pytest.approx(seconds_late(at_its_end, means, rate_hz), rel=0.01)


def asked(autopilot):
    """Names that are asked for from now on, as the autopilot hears them."""
    names, answers = [], autopilot.parameters.answers

    def heard(message):
        names.append(message.param_id)
        return answers(message)

    autopilot.parameters.answers = heard
    return names


async def test_it_is_read_once_and_taken_off_the_gyro_and_not_off_the_attitude(caplog):
    autopilot = FakeAutopilot()
    names = asked(autopilot)
    with caplog.at_level(logging.INFO):
        async with Flight(autopilot) as flight:
            flight.fly(10.0)
    assert names == ["INS_GYRO_FILTER"]
    assert autopilot.parameters.written == 0
    sample, pose = flight.listener.imu[-1], flight.listener.poses[-1]
    assert sample.gyro_delay == pytest.approx(0.01125, abs=1e-5)
    assert sample.t + sample.gyro_delay == pytest.approx(flight.clock.now(), abs=6e-3)
    assert pose.t == pytest.approx(flight.clock.now(), abs=21e-3)
    assert flight.count["gyro_delay_s"] == sample.gyro_delay
    assert "gyro 11.3 ± 1.0 ms late" in flight.text
    said = [r.getMessage() for r in caplog.records if "INS_GYRO_FILTER" in r.getMessage()]
    assert said == ["udpin:localhost:1: gyro taken to be 11.3 ± 1.0 ms late: INS_GYRO_FILTER is 20 Hz"]


async def test_another_filter_is_believed_and_after_a_reboot_it_is_asked_again():
    autopilot = FakeAutopilot()
    autopilot.parameters.values["INS_GYRO_FILTER"] = 80
    names = asked(autopilot)
    async with Flight(autopilot) as flight:
        flight.fly(5.0)
        assert flight.listener.imu[-1].gyro_delay == pytest.approx(0.0028, abs=2e-5)
        autopilot.parameters.values["INS_GYRO_FILTER"] = 0
        autopilot.reboot(flight.clock.now())
        flight.fly(5.0)
    assert flight.listener.imu[-1].gyro_delay == 0.0
    assert names == ["INS_GYRO_FILTER"] * 2
    assert (np.diff([sample.t for sample in flight.listener.imu]) > 0).all()


async def test_who_does_not_answer_is_taken_to_be_as_usual_and_is_not_asked_for_ever(caplog):
    autopilot = FakeAutopilot()
    del autopilot.parameters.values["INS_GYRO_FILTER"]
    names = asked(autopilot)
    with caplog.at_level(logging.INFO):
        async with Flight(autopilot) as flight:
            flight.fly(20.0)
    assert names == ["INS_GYRO_FILTER"] * PARAMETER_REQUESTS
    assert flight.listener.imu[-1].gyro_delay == pytest.approx(0.01125, abs=1e-5)
    assert flight.count["gyro_delay_sigma_s"] == 4e-3
    assert (
        sum(
            "INS_GYRO_FILTER was not reported, and usually is 20 Hz" in r.getMessage() for r in caplog.records
        )
        == 1
    )


async def test_a_px4_is_late_by_half_of_its_interval_of_integration():
    autopilot = FakePx4()
    autopilot.parameters = VehicleParameters({**PX4_PARAMETERS, "IMU_INTEG_RATE": 250}, bytewise=True)
    names = asked(autopilot)
    async with Flight(autopilot, imu_rate_hz=250.0) as flight:
        flight.fly(5.0)
    assert sorted(names) == ["IMU_GYRO_CUTOFF", "IMU_INTEG_RATE"]
    assert flight.listener.imu[-1].gyro_delay == pytest.approx(0.002)


async def test_what_the_user_says_is_asked_of_nobody():
    autopilot = FakeAutopilot()
    names = asked(autopilot)
    async with Flight(autopilot, gyro_delay_s=0.004) as flight:
        flight.fly(5.0)
    assert names == []
    assert flight.listener.imu[-1].gyro_delay == 0.004


def told(kind, **values):
    """The delays of an autopilot of a kind that has told these parameters, as floats."""
    delays = GyroDelays(None, asks=True, name="here")
    delays.meet(kind)
    for name, value in values.items():
        message = common.MAVLink_param_value_message(name.encode(), value, common.MAV_PARAM_TYPE_REAL32, 1, 0)
        delays.on_value(0.0, common.MAVLink(None).decode(bytearray(message.pack(common.MAVLink(None)))))
    return delays


def test_the_rates_next_to_an_attitude_have_passed_another_filter():
    px4 = told(common.MAV_AUTOPILOT_PX4, IMU_GYRO_CUTOFF=30.0)
    assert px4.of(ATTITUDE_QUATERNION).seconds == pytest.approx(0.0075, abs=1e-5)
    assert px4.of(HIGHRES_IMU).seconds == 0.0025


@pytest.mark.parametrize("value", [math.nan, -20.0, 1.0, 1e-30])
def test_a_filter_that_nobody_flies_with_is_not_believed(value):
    ardupilot = told(common.MAV_AUTOPILOT_ARDUPILOTMEGA, INS_GYRO_FILTER=value)
    delay = ardupilot.of(HIGHRES_IMU)
    assert delay.seconds == pytest.approx(0.01125, abs=1e-5)


def test_of_an_autopilot_of_another_kind_nothing_is_known_and_nothing_asked():
    other = told(common.MAV_AUTOPILOT_GENERIC, INS_GYRO_FILTER=20.0)
    assert other.of(HIGHRES_IMU)[:2] == (0.0, 10e-3)
    assert other.tick(0.0, 1) == []


@pytest.mark.shared
@pytest.mark.parametrize(
    ("told_s", "left_ms"),
    [
        (None, 0.0),
        pytest.param(0.0, 11.25, marks=pytest.mark.long("what is left where it is not made good")),
    ],
)
async def test_a_recorded_ardupilot_s_gyro_then_agrees_with_its_own_attitude(told_s, left_ms):
    """The shift at which the gyro, integrated from one attitude to the next, fits these best."""
    if not RECORDED.exists():
        pytest.skip(f"needs {RECORDED}")
    listener = Listener()
    unit = MavlinkAutopilot(f"tlog:{RECORDED}?pace=fast", clock=ManualClock(1000.0), gyro_delay_s=told_s)
    await unit.run(listener)
    t, gyro = np.array([s.t for s in listener.imu]), np.array([s.gyro for s in listener.imu])
    turned = np.vstack([np.zeros(3), np.cumsum((gyro[1:] + gyro[:-1]) / 2 * np.diff(t)[:, None], axis=0)])
    at, attitude = (
        np.array([p.t for p in listener.poses]),
        np.array([p.world_from_body for p in listener.poses]),
    )
    close = np.flatnonzero(np.diff(at) < 0.05)
    turn = attitude[close].transpose(0, 2, 1) @ attitude[close + 1]
    angles = (turn - turn.transpose(0, 2, 1))[:, [2, 0, 1], [1, 2, 0]] / 2

    def misfit(shift):
        def by_gyro(when):
            return np.stack([np.interp(when + shift, t, turned[:, axis]) for axis in range(3)], axis=1)

        off = (by_gyro(at[close + 1]) - by_gyro(at[close]) - angles) / np.diff(at)[close, None]
        return ((off - off.mean(axis=0)) ** 2).sum()

    shifts = np.arange(-4, 21) * 1e-3
    assert 1e3 * shifts[np.argmin([misfit(shift) for shift in shifts])] == pytest.approx(left_ms, abs=1.5)
