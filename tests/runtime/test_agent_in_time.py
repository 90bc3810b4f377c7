"""What an agent does when: stale frames, watchdog, rates, lag, readiness. In simulated time, without a real wait."""

from __future__ import annotations

import json
import logging
import re

import numpy as np
import pytest

from support.simulated_agent import BEGIN, SimulatedFlight
from swarmtrack.agents.healthy import find_troubles
from swarmtrack.messages import Announcement
from swarmtrack.transport.base import Kind
from swarmtrack.wire.camera import CameraMessage, mounting_from
from swarmtrack.wire.health import HealthMessage
from swarmtrack.wire.tracks import TracksMessage
from swarmtrack.wire.video import VideoMessage


def health(flight, t):
    """What was said of it at t [s]."""
    return next(
        message for said_t, message in flight.messages(HealthMessage, Kind.HEALTH) if said_t > t - 1e-6
    )


# ── frames ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_frame_that_is_too_old_is_not_looked_at(tmp_path, caplog):
    flight = SimulatedFlight(tmp_path, "camera.max_age_s = 0.3\n")
    for t, age in ((2.05, 0.29), (4.05, 0.31), (6.05, 0.02), (8.05, 0.5), (9.05, 0.02)):
        flight.at(t, setattr, flight.camera, "age_s", age)
    flight.fly(10.06)
    assert health(flight, 4.0).drops.get("stale_frames", 0) == 0
    assert health(flight, 4.0).latencies["exposure_to_detector"].max_s == pytest.approx(0.29, abs=1e-6)
    assert health(flight, 6.0).rates["detections"].got_hz == 0.0
    assert health(flight, 7.0).drops["stale_frames"] == 20  # two seconds of ten frames
    assert health(flight, 8.0).rates["detections"].got_hz == pytest.approx(10.0)
    assert health(flight, 10.0).drops["stale_frames"] == 30
    warnings = [line for line in caplog.messages if "skipped what is" in line]
    assert warnings == [  # one for each time that it became so
        "camera: skipped what is 0.31 s old, expected camera.max_age_s = 0.3",
        "camera: skipped what is 0.50 s old, expected camera.max_age_s = 0.3",
    ]


def test_a_slow_detector_sees_the_newest_frames_and_the_others_are_counted(tmp_path):
    flight = SimulatedFlight(tmp_path)
    flight.at(1.05, setattr, flight.loop, "in_thread_s", 0.25)
    flight.fly(11.0)
    said = health(flight, 10.0)
    # Of three frames it sees one: that which waits when it comes back, 50 ms after it came.
    assert said.rates["detections"].got_hz == pytest.approx(4.0, abs=0.7)
    assert said.latencies["detector"].p50_s == pytest.approx(0.25, abs=1e-6)
    camera = next(link for link in said.links if link.name == "camera")
    assert camera.counters["dropped"] == pytest.approx(9 * 6, abs=4)
    assert said.drops.get("stale_frames", 0) == 0


# ── what is published, how often ─────────────────────────────────────────────────────────────────────────────────────


def test_tracks_are_published_at_their_rate_and_at_once_after_each_scan(tmp_path):
    flight = SimulatedFlight(tmp_path, "output.tracks_hz = 4.0\n")
    flight.at(1.0, setattr, flight.loop, "in_thread_s", 0.015)
    flight.at(3.05, setattr, flight.camera, "away", True)
    flight.fly(6.0)
    scans = np.arange(1.1, 3.0, 0.1) + 0.015
    np.testing.assert_allclose(flight.times(Kind.TRACKS, 1.05, 3.0), scans, atol=1e-6)
    assert np.diff(flight.times(Kind.TRACKS, 3.1, 6.0)) == pytest.approx(0.25)
    sequences = [message.sequence for _, message in flight.messages(TracksMessage, Kind.TRACKS)]
    assert sequences == list(range(1, len(sequences) + 1))


def test_tracks_that_nobody_listens_to_are_carried_on_ten_times_a_second(tmp_path):
    flight = SimulatedFlight(tmp_path, heard=False)
    flight.at(2.0, flight.hub.listeners.append, flight.hear)
    asked, tracks = [], flight.parts.door.tracks
    flight.parts.door.tracks = lambda now: (asked.append(now - BEGIN), tracks(now))[1]
    flight.fly(4.0)
    unheard = [t for t in asked if 1.0 < t < 1.99]
    assert len(unheard) == pytest.approx(9, abs=1)
    assert np.diff(unheard).max() < 0.13
    assert np.diff(flight.times(Kind.TRACKS, 2.0, 4.0)).max() < 0.021
    # What the rate says is how often they could be had.
    assert health(flight, 4.0).rates["tracks"].got_hz == pytest.approx(60.0, abs=2.0)


def test_the_camera_is_told_once_before_the_first_tracks(tmp_path):
    flight = SimulatedFlight(
        tmp_path, "camera.body_from_camera = { rpy_deg = [0, 10, 0], position_m = [0.1, 0, 0] }\n"
    )
    flight.fly(1.0)
    ((t, camera),) = flight.messages(CameraMessage, Kind.CAMERA)
    assert t < flight.times(Kind.TRACKS)[0]
    assert (camera.drone_id, camera.boot) == (1, flight.parts.boot)
    assert (camera.lens.fx, camera.lens.cx, camera.lens.width) == (600.0, 31.5, 64)
    assert camera.position_m == (0.1, 0.0, 0.0)
    ahead = mounting_from(camera).rotation @ [0.0, 0.0, 1.0]
    assert ahead == pytest.approx([np.cos(np.radians(10)), 0.0, -np.sin(np.radians(10))])


def test_health_says_what_rates_were_asked_for_and_came(tmp_path):
    flight = SimulatedFlight(
        tmp_path, "output.tracks_hz = 20.0\nautopilot.imu_rate_hz = 100\n", autopilot=True
    )
    flight.at(5.0, setattr, flight.parts.autopilot, "hz", 50.0)
    flight.fly(8.0)
    rates = health(flight, 4.0).rates
    assert {name: rate.asked_hz for name, rate in rates.items()} == {
        "imu": 100.0,
        "detections": None,
        "tracks": 20.0,
    }
    assert rates["imu"].got_hz == pytest.approx(200.0, abs=1.5)
    assert rates["detections"].got_hz == pytest.approx(10.0)
    assert rates["tracks"].got_hz == pytest.approx(30.0)  # and at once after each of ten scans
    assert health(flight, 7.0).rates["imu"].got_hz == pytest.approx(50.0, abs=1.5)
    assert np.diff(flight.times(Kind.HEALTH)) == pytest.approx(1.0)


def test_a_picture_is_sent_ten_times_a_second_while_somebody_listens(tmp_path):
    flight = SimulatedFlight(tmp_path, heard=False)
    flight.camera._period = 1 / 30
    flight.at(2.0, flight.hub.listeners.append, flight.hear)
    flight.at(4.0, flight.hub.listeners.clear)
    flight.fly(6.0)
    times = flight.times(Kind.VIDEO)
    assert times[0] == pytest.approx(2.0, abs=0.04)
    assert times[-1] == pytest.approx(3.95, abs=0.06)
    assert np.diff(times) == pytest.approx(0.1, abs=0.01)
    assert all(message.jpeg for _, message in flight.messages(VideoMessage, Kind.VIDEO))


def test_who_is_seen_as_whom_is_told_once_a_second_and_at_once_when_it_changed(tmp_path):
    flight = SimulatedFlight(tmp_path)
    # As far away as its box looks.
    place = np.array([50.0, 0.0, 0.0])
    somewhere = Announcement(2, "0000000b", 1, BEGIN, 0.01, place, np.eye(3), np.eye(3))
    flight.at(5.45, flight.parts.door.tell, somewhere)
    flight.fly(9.0)
    times = np.array(flight.times(Kind.IDENTITIES))
    assert np.diff(times[times < 5.4]) == pytest.approx(1.05, abs=0.06)
    # That the drone is known, and with the next scan that it is seen.
    assert times[times > 5.45][:2] == pytest.approx([5.5, 5.6], abs=0.06)
    assert np.diff(times[times > 5.55]) == pytest.approx(1.05, abs=0.06)


def test_while_the_detector_warms_up_the_team_hears_of_us_and_no_frame_is_looked_at(tmp_path):
    flight = SimulatedFlight(tmp_path)
    flight.loop.in_thread_s = 20.0
    flight.at(20.0, setattr, flight.loop, "in_thread_s", 0.01)
    flight.fly(22.0)
    assert flight.times(Kind.POSE)[0] < 0.1
    assert flight.times(Kind.HEALTH)[0] == pytest.approx(1.0)
    assert flight.supervisor.times("READY=1") == [pytest.approx(20.0)]
    assert min(flight.times(Kind.TRACKS)) >= 20.0
    assert min(flight.supervisor.times("WATCHDOG=1")) >= 20.0
    assert health(flight, 22.0).rates["detections"].got_hz == pytest.approx(10.0)


# ── whoever looks after it ───────────────────────────────────────────────────────────────────────────────────────────


def test_a_stuck_detector_starves_the_watchdog_and_a_slow_one_does_not(tmp_path):
    flight = SimulatedFlight(tmp_path)
    flight.at(2.05, setattr, flight.loop, "in_thread_s", 9.0)  # the look of 2.1 s
    flight.at(11.05, setattr, flight.loop, "in_thread_s", 30.0)  # that of 11.1 s
    flight.at(41.05, setattr, flight.loop, "in_thread_s", 0.01)
    flight.fly(45.0)
    fed = np.array(flight.supervisor.times("WATCHDOG=1"))
    assert np.diff(fed[fed < 21.0]).max() < 0.03
    assert not fed[(fed > 21.12) & (fed < 41.09)].size
    assert np.diff(fed[fed > 41.2]).max() < 0.03
    # It speaks all the same: its tracks go on, and once a second it says how it is.
    assert len(flight.times(Kind.TRACKS, 22.0, 41.0)) == pytest.approx(19 * 50, abs=2)
    assert sum(text.startswith("STATUS=") for t, text in flight.supervisor.said if 22.0 < t < 41.0) == 19
    assert flight.supervisor.said[-1][1] == "STOPPING=1"


def test_a_camera_that_goes_and_comes_back_is_said_and_starves_nobody(tmp_path):
    flight = SimulatedFlight(tmp_path)
    flight.at(3.05, setattr, flight.camera, "away", True)
    flight.at(8.05, setattr, flight.camera, "away", False)
    flight.fly(12.05)
    fed = flight.supervisor.times("WATCHDOG=1")
    assert np.diff(fed).max() < 0.03
    statuses = [text for _, text in flight.supervisor.said if text.startswith("STATUS=")]
    assert [text == "STATUS=ready" for text in statuses] == [True] * 3 + [False] * 5 + [True] * 4
    assert "unplugged" in statuses[3]


def test_a_camera_that_is_open_and_sends_nothing_is_no_camera(tmp_path):
    flight = SimulatedFlight(tmp_path)
    flight.camera.silent = True
    flight.at(4.05, setattr, flight.camera, "silent", False)
    flight.fly(5.5)
    statuses = [text for _, text in flight.supervisor.said if text.startswith("STATUS=")]
    assert [re.findall(r"in (\d) s", text) for text in statuses] == [["1"], ["2"], ["3"], ["4"], []]
    assert statuses[-1] == "STATUS=ready"


def test_an_agent_is_ready_from_its_first_frame(tmp_path):
    flight = SimulatedFlight(tmp_path)
    flight.camera.away = True
    flight.at(3.05, setattr, flight.camera, "away", False)
    flight.fly(5.05)
    assert [message.readiness.ready for _, message in flight.messages(HealthMessage, Kind.HEALTH)] == [
        *(False, False, False),
        *(True, True),
    ]


def test_the_health_file_says_how_long_ago_a_frame_was_tracked(tmp_path):
    path, said = tmp_path / "health.json", {}
    flight = SimulatedFlight(tmp_path, f'output.health = "{path}"\n')
    flight.at(3.05, setattr, flight.camera, "away", True)
    for t in (1.5, 3.5, 12.5, 14.5):
        flight.at(t, lambda t=t: said.update({t: json.loads(path.read_text(encoding="utf-8"))}))
    flight.fly(15.0)
    assert [record["frame_age_s"] for record in said.values()] == pytest.approx(
        [0.05, 0.05, 9.05, 11.05], abs=0.06
    )
    troubles = {
        t: find_troubles(record, BEGIN + t, max_age_s=5.0, max_frame_age_s=10.0) for t, record in said.items()
    }
    assert troubles[1.5] == []
    assert troubles[12.5] == ["camera: unplugged; waiting for it"]
    assert troubles[14.5][1:] == ["no frame was tracked for 11 s, expected one within 10 s"]
    assert find_troubles(said[1.5], BEGIN + 6.5, max_age_s=5.0, max_frame_age_s=10.0) == [
        "last written 6 s ago, expected within 5 s"
    ]
    assert not path.exists()  # who has ended has no health


def test_health_says_how_long_it_was_held_up_and_forgets_it(tmp_path):
    flight = SimulatedFlight(tmp_path)
    # As SIGSTOP does: two seconds in which nothing runs.
    flight.at(5.3, lambda: flight.clock.set(BEGIN + 7.3))
    flight.fly(11.0)
    lags = [message.latencies["loop_lag"].max_s for _, message in flight.messages(HealthMessage, Kind.HEALTH)]
    assert max(lags[:5]) < 1e-6
    assert lags[5] == pytest.approx(2.0, abs=0.05)
    assert max(lags[7:]) < 1e-6


def test_a_flight_without_trouble_is_quiet(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    flight = SimulatedFlight(tmp_path)
    flight.fly(30.0)
    assert caplog.messages == ["camera camera: open"]
    said = health(flight, 29.0)
    assert said.events == ()
    assert {name for name, count in said.drops.items() if count} == {
        "scans",
        "detections",
    }  # no drops: they count all
