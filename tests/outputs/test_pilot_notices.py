"""What the ground station hears: the autopilot's side of the link, read with pymavlink."""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import socket
import subprocess
import sys
import time
import tty
from dataclasses import replace

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from support.autopilot_flight import Flight, Listener, SimulatedLink
from support.drone_on_the_bench import written
from support.fake_autopilot import FakeAutopilot, serve_udp
from support.ports import free_port
from swarmtrack.autopilot.mavlink_autopilot import MavlinkAutopilot
from swarmtrack.autopilot.notices import LONGEST_CALLSIGN, Severity, image_status, named_value, status_text
from swarmtrack.clock import ManualClock, SystemClock
from swarmtrack.config.drone import load_config
from swarmtrack.errors import ConfigError
from swarmtrack.identity.consensus import Disagreement
from swarmtrack.messages import (
    Announcement,
    IdClash,
    IdentifiedTrack,
    LinkStatus,
    MotionReport,
    PeerDeparted,
    RelativeState,
    ScanReport,
    Sighting,
    SightingReport,
    Track,
    TrackList,
    TrackStatus,
)
from swarmtrack.outputs import pilot_notices
from swarmtrack.outputs.status_lines import LINE_EVERY, Debounced, StatusLines
from swarmtrack.outputs.wording import place_in_words
from swarmtrack.runtime.agent import make_notices
from swarmtrack.runtime.assembly import assemble
from swarmtrack.wire.health import link_health

TIMEOUT = 180.0  # s: ends a hang, and says nothing of speed
CAMERA = """
source = "http://127.0.0.1:9/"
intrinsics = { fx = 600.0, fy = 600.0, cx = 319.5, cy = 255.5, width = 640, height = 512 }
"""
ORIGIN = "origin = { lat_deg = 47.4, lon_deg = 8.5, alt_m = 488.0 }"


class Ground(FakeAutopilot):
    """An autopilot that keeps what its companion says, as it would hand it on to a ground station."""

    def __init__(self, **options):
        super().__init__(**options)
        self.heard = []

    def understand(self, message, now, channel):
        self.heard.append(message)
        super().understand(message, now, channel)

    def of(self, kind):
        return [m for m in self.heard if m.get_type() == kind]

    @property
    def texts(self):
        return [(m.severity, m.text) for m in self.of("STATUSTEXT")]


# ── the agent, whole ─────────────────────────────────────────────────────────────────────────────────────────────────


async def test_the_ground_station_reads_who_we_are_that_we_are_ready_and_how_many_we_see(tmp_path):
    port = free_port()
    config = written(
        tmp_path,
        camera='source = "sim://hover-triangle?seed=1"',
        autopilot=f'link = "udpin:127.0.0.1:{port}"\ntell = ["status", "camera_tracking"]',
    )
    ground = Ground(system=7, boot_at=time.monotonic() - 40.0)
    ground.gyro = np.zeros(3)
    agent = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "swarmtrack.agents.vehicle", "--config", str(config), "--quiet")
    )
    try:
        async with serve_udp(ground, "127.0.0.1", port), asyncio.timeout(TIMEOUT):
            while not (  # noqa: ASYNC110 (what is waited for happens outside)
                any("sees 2 of 2" in text for _, text in ground.texts)
                and len(ground.of("NAMED_VALUE_FLOAT")) > 3
            ):
                await asyncio.sleep(0.05)
    finally:
        agent.terminate()
        assert await asyncio.wait_for(agent.wait(), TIMEOUT) == 0
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m in ground.heard[1:]} == {(7, 191)}
    heartbeat = ground.of("HEARTBEAT")[-1]
    assert heartbeat.type == common.MAV_TYPE_ONBOARD_CONTROLLER
    assert heartbeat.autopilot == common.MAV_AUTOPILOT_INVALID
    assert (common.MAV_SEVERITY_INFO, "swarmtrack: ready, drone 1") in ground.texts
    assert (common.MAV_SEVERITY_INFO, "swarmtrack: sees 2 of 2") in ground.texts
    assert (ground.of("NAMED_VALUE_FLOAT")[-1].name, ground.of("NAMED_VALUE_FLOAT")[-1].value) == (
        "trk_n",
        2.0,
    )
    box = next(m for m in ground.of("CAMERA_TRACKING_IMAGE_STATUS") if m.tracking_status)
    assert box.tracking_mode == common.CAMERA_TRACKING_MODE_RECTANGLE
    assert 0.0 <= box.rec_top_x < box.rec_bottom_x <= 1.0
    assert 0.0 <= box.rec_top_y < box.rec_bottom_y <= 1.0
    assert math.isnan(box.radius)
    # Nothing else: what moves a vehicle is never among it.
    assert {m.get_type() for m in ground.heard} <= {
        *("PARAM_REQUEST_READ", "HEARTBEAT", "TIMESYNC", "COMMAND_LONG"),
        *("STATUSTEXT", "NAMED_VALUE_FLOAT", "CAMERA_TRACKING_IMAGE_STATUS"),
    }


# ── what is news, in our own time ────────────────────────────────────────────────────────────────────────────────────


class Source:
    """In place of a camera or a network: up or not."""

    def __init__(self, name):
        self.name, self.ok = name, True

    def status(self):
        return LinkStatus(self.name, self.ok, "")


def telling(tmp_path, tell, **tables):
    return written(tmp_path, camera=CAMERA, autopilot=f'link = "udpin:127.0.0.1:1"\ntell = {tell}', **tables)


class Told:
    """A notices and the autopilot that it tells, on a perfect link in simulated time."""

    def __init__(self, tmp_path, tell='["status"]', *, looking=False, cameras=1):
        path = telling(tmp_path, tell, team=ORIGIN)
        self.ground = Ground(boot_at=60.0)
        self.flight = Flight(self.ground)
        names = ["camera"] if cameras == 1 else [f"camera {k}" for k in range(1, cameras + 1)]
        self.cameras, self.network = [Source(name) for name in names], Source("zenoh")
        self.camera = self.cameras[0]
        self.parts = assemble(load_config(path), self.flight.clock)
        self.parts.autopilot = self.flight.unit
        if looking:
            self.parts.door.perceived = Looking(self.flight.clock)
        self.notices = make_notices(self.parts)
        self.sequence = 0
        self.camera_of = {}
        """By identity: whose picture it is in, where that is not the first."""

    def fly(self, seconds, identities=(), box=(20.0, 10.0), place=None):
        """identities: of the tracks in view, from left to right; None: unknown. place: by drone and time, where it is
        measured."""
        for _ in range(round(seconds / 0.2)):
            self.flight.fly(0.2)
            now = self.flight.clock.now()
            tracks = tuple(
                IdentifiedTrack(
                    Track(
                        i,
                        now,
                        np.array((100.0 * i, 0.0, 200.0, 0.0)),
                        np.eye(4),
                        TrackStatus.CONFIRMED,
                        1.0,
                        size,
                        camera=self.camera_of.get(identity, 0),
                    ),
                    identity,
                    0.99,
                    relative=place and place(identity, now),
                )
                for i, (identity, size) in enumerate(
                    ((identity, (1.0 + i) * np.array(box)) for i, identity in enumerate(identities, 1)), 1
                )
            )
            self.sequence += 1
            self.notices.see_links(link_health(link.status()) for link in (*self.cameras, self.network))
            if any(camera.ok for camera in self.cameras):
                self.notices.on_scan(ScanReport(self.sequence, TrackList(now, now, tracks)))
            self.notices.tick(now)

    @property
    def texts(self):
        return [text.removeprefix("swarmtrack: ") for _, text in self.ground.texts]


async def test_what_is_lost_and_comes_back_is_told_once_it_lasts(tmp_path):
    told = Told(tmp_path)
    async with told.flight:
        told.fly(8.0)
        told.camera.ok = False
        told.fly(2.0)
        told.camera.ok = True  # too short to be news
        told.fly(4.0)
        assert told.texts == ["ready, drone 1"]
        told.camera.ok = told.network.ok = False
        told.fly(5.0)
        told.camera.ok = told.network.ok = True
        told.ground.imu_gap = True
        told.ground.offered = ()
        told.ground.reboot(told.flight.clock.now())
        told.fly(12.0)
        assert told.texts[1:] == ["no camera", "no network", "camera is there", "network is there", "no IMU"]
        severities = {text: severity for severity, text in told.ground.texts}
        assert severities["swarmtrack: no camera"] == common.MAV_SEVERITY_WARNING
        assert severities["swarmtrack: camera is there"] == common.MAV_SEVERITY_INFO


async def test_of_several_cameras_it_is_told_which_one_is_gone_and_no_camera_only_if_all_are(tmp_path):
    told = Told(tmp_path, cameras=4)
    told.cameras[2].ok = False
    async with told.flight:
        told.fly(8.0)
        # The others see, and it flies with them.
        assert told.texts == ["ready, drone 1", "camera 3 gone"]
        for camera in told.cameras:
            camera.ok = False
        told.fly(5.0)
        assert told.texts[2:] == ["no camera"]
        for camera in told.cameras[:2]:
            camera.ok = True
        told.fly(8.0)
        assert told.texts[3:] == ["camera is there", "camera 4 gone"]
        told.cameras[2].ok = told.cameras[3].ok = True
        told.fly(8.0)
        assert told.texts[5:] == ["camera 3 is there", "camera 4 is there"]


async def test_teammates_that_come_and_go_make_no_stream_of_lines(tmp_path):
    told = Told(tmp_path)
    for drone_id in (2, 3, 4):
        told.parts.door.tell(
            Announcement(drone_id, "0000000a", 1, 0.0, 0.0, np.zeros(3), np.eye(3), np.eye(3))
        )
    async with told.flight:
        told.fly(15.0, [2, 3])
        assert told.texts == ["ready, drone 1", "sees 2 of 3"]
        for _ in range(40):  # in and out of view for 40 s, as at the border of the image
            told.fly(0.6, [2, 3])
            told.fly(0.4, [2])
        assert len(told.texts) <= 2 + 4
        values = [m.value for m in told.ground.of("NAMED_VALUE_FLOAT")]
        assert 50 <= len(values) <= 60
        assert {2.0} <= set(values) <= {1.0, 2.0}
        told.fly(15.0, [None, "foreign"])
        assert told.texts[-1] == "sees 0 of 3"
        assert told.ground.of("NAMED_VALUE_FLOAT")[-1].value == 0.0


async def test_disputes_and_departures_are_told_with_their_severity(tmp_path):
    told = Told(tmp_path)
    async with told.flight:
        told.fly(4.0)
        told.notices.on_peer(PeerDeparted(3, "0000000a"))
        told.notices.on_peer(IdClash(2, ("0000000a", "0000000b"), ours=False))
        told.notices.on_peer(IdClash(1, ("0000000a", "0000000b"), ours=True))
        told.notices.on_disagreement(Disagreement(3, 2, 4.0))
        told.fly(12.0)
    assert told.ground.texts[1:] == [
        (common.MAV_SEVERITY_WARNING, "swarmtrack: drone 3 is gone"),
        (common.MAV_SEVERITY_WARNING, "swarmtrack: two agents are drone 2"),
        (common.MAV_SEVERITY_ERROR, "swarmtrack: another agent is drone 1 too"),
        (common.MAV_SEVERITY_WARNING, "swarmtrack: drone 3 disputes drone 2"),
    ]
    assert all(len(text) <= 50 for _, text in told.ground.texts)


async def test_a_flood_of_events_fills_no_radio(tmp_path):
    told = Told(tmp_path)
    async with told.flight:
        told.fly(4.0)
        for drone_id in range(2, 1002):
            told.notices.on_peer(PeerDeparted(drone_id, "0000000a"))
        told.fly(60.0)
    assert len(told.texts) <= 40
    assert told.notices.lines.untold > 900


async def test_what_nobody_heard_is_told_when_the_autopilot_is_back_unless_it_is_old(tmp_path):
    told = Told(tmp_path)
    async with told.flight:
        told.fly(4.0)
        told.ground.mute = True
        told.fly(8.0)
        sent = len(told.ground.of("STATUSTEXT")) + len(told.ground.of("NAMED_VALUE_FLOAT"))
        told.notices.on_peer(PeerDeparted(3, "0000000a"))
        told.fly(20.0)
        assert len(told.ground.of("STATUSTEXT")) + len(told.ground.of("NAMED_VALUE_FLOAT")) == sent
        told.notices.on_peer(PeerDeparted(4, "0000000a"))
        told.ground.mute = False
        told.fly(6.0)
    assert "drone 4 is gone" in told.texts
    assert "drone 3 is gone" not in told.texts
    assert told.notices.lines.untold == 1


async def test_the_box_is_of_one_teammate_with_a_name_and_stays_with_it(tmp_path):
    told = Told(tmp_path, '["camera_tracking"]')
    async with told.flight:
        told.fly(4.0, [None])
        boxes = told.ground.of("CAMERA_TRACKING_IMAGE_STATUS")
        assert boxes
        assert {m.tracking_status for m in boxes} == {common.CAMERA_TRACKING_STATUS_FLAGS_IDLE}
        told.fly(2.0, [2])  # at (100, 200), 40 x 20 px
        box = told.ground.of("CAMERA_TRACKING_IMAGE_STATUS")[-1]
        assert box.tracking_status == common.CAMERA_TRACKING_STATUS_FLAGS_ACTIVE
        corners = (box.rec_top_x, box.rec_top_y, box.rec_bottom_x, box.rec_bottom_y)
        assert corners == pytest.approx((80.5 / 640, 190.5 / 512, 120.5 / 640, 210.5 / 512), abs=1e-6)
        told.fly(2.0, [2, 3])  # 3 is larger, and does not take its place
        assert told.ground.of("CAMERA_TRACKING_IMAGE_STATUS")[-1].rec_top_x == pytest.approx(80.5 / 640)
        told.fly(2.0, [None, 3])
        assert told.ground.of("CAMERA_TRACKING_IMAGE_STATUS")[-1].rec_top_x > 150 / 640
    assert not told.ground.of("STATUSTEXT")
    assert not told.ground.of("NAMED_VALUE_FLOAT")


async def test_of_several_cameras_each_box_is_said_to_be_in_its_camera_s_picture(tmp_path):
    told = Told(tmp_path, '["camera_tracking"]')
    lens = told.parts.lens
    told.parts.lenses = (lens, lens, lens)
    told.notices = make_notices(told.parts)
    told.camera_of = {2: 0, 3: 2}
    async with told.flight:
        told.fly(4.0, [2, 3])
        boxes = told.ground.of("CAMERA_TRACKING_IMAGE_STATUS")[-10:]
        active = {
            m.camera_device_id: (m.rec_top_x + m.rec_bottom_x) / 2
            for m in boxes
            if m.tracking_status == common.CAMERA_TRACKING_STATUS_FLAGS_ACTIVE
        }
        assert active == pytest.approx({1: 100.5 / 640, 3: 200.5 / 640}, abs=1e-6)
        idle = {m.camera_device_id for m in boxes if not m.tracking_status}
        assert idle == {2}
        before = len(told.ground.of("CAMERA_TRACKING_IMAGE_STATUS"))
        told.fly(2.0, [2, 3])
        # As often as of one camera: they take turns.
        assert len(told.ground.of("CAMERA_TRACKING_IMAGE_STATUS")) - before <= 10


class Looking:
    """In place of Onboard: sees drone 2 from the team's origin, straight north."""

    def __init__(self, clock, sigma=0.01):
        self.teammates = {}
        self.velocity = None
        self.position_sigma = 0.1
        self._clock, self._sigma = clock, sigma

    def sighting_report(self, boot, sequence):
        north = np.array((1.0, 0.0, 0.0))
        ray = Sighting(2, 0.99, north, self._sigma)
        now, origin, sigma = self._clock.now(), np.zeros(3), self.position_sigma
        return SightingReport(1, boot, sequence, now, 0.0, origin, sigma, (2, 3), (ray,))

    def motion_report(self, boot, sequence):
        if self.velocity is None:
            return None
        cov, now = 0.01 * np.eye(3), self._clock.now()
        return MotionReport(1, boot, sequence, now - 0.1, 0.0, np.zeros(3), cov, np.array(self.velocity), cov)


def says_it_stands(drone_id, t, position, sigma=0.1):
    return SightingReport(drone_id, "0000000a", 1, t, 0.05, np.array(position), sigma, (), ())


async def test_a_teammate_is_on_the_map_where_it_says_it_is_while_the_camera_sees_it_there(tmp_path):
    told = Told(tmp_path, '["adsb"]', looking=True)
    clock = told.flight.clock
    async with told.flight:
        told.fly(4.0)
        assert not told.ground.of("ADSB_VEHICLE")  # nobody has said where it is
        for _ in range(3):
            told.notices.on_peer(says_it_stands(2, clock.now(), (100.0, 1.0, -20.0 + 20.5)))
            told.notices.on_peer(says_it_stands(3, clock.now(), (50.0, 0.0, 0.0)))  # not in view
            told.fly(1.0)
        places = told.ground.of("ADSB_VEHICLE")
        assert len(places) == 3
        place = places[-1]
        assert (place.callsign, place.emitter_type) == ("ST2?", common.ADSB_EMITTER_TYPE_UAV)
        assert place.tslc <= 1
        assert place.lat == pytest.approx(474000000 + 100.0 / 111_180.0 * 1e7, abs=20)
        assert place.lon == pytest.approx(85000000 + 1.0 / 75_460.0 * 1e7, abs=20)
        assert place.altitude == pytest.approx(487_500, abs=10)
        assert place.flags & common.ADSB_FLAGS_VALID_COORDS
        assert not place.flags & (common.ADSB_FLAGS_VALID_HEADING | common.ADSB_FLAGS_VALID_VELOCITY)
        assert len({m.ICAO_address for m in places}) == 1
        assert 0 < place.ICAO_address < 1 << 24
        told.fly(5.0)  # silent since
        silent = len(told.ground.of("ADSB_VEHICLE"))
        assert silent <= 5
        # Words that the camera gives the lie to; the last one lies where it looks, but no camera sees so far.
        for elsewhere in ((0.0, 100.0, 0.0), (-100.0, 0.0, 0.0), (1e7, 0.0, 0.0)):
            told.notices.on_peer(says_it_stands(2, clock.now(), elsewhere))
            told.fly(2.0)
        # Too vague to be wrong.
        told.notices.on_peer(says_it_stands(2, clock.now(), (100.0, 0.0, 0.0), sigma=50.0))
        told.fly(2.0)
        assert len(told.ground.of("ADSB_VEHICLE")) == silent
    assert not told.ground.of("STATUSTEXT")


def measured(sigma=0.5, velocity=(0.0, 0.0, 0.0), velocity_sigma=0.2):
    """Drone 2, 80 m north, 30 m east and 10 m above us, at any time."""
    cov = np.diag([sigma**2] * 3 + [velocity_sigma**2] * 3)

    def place(drone_id, now):
        return RelativeState(
            drone_id, now, np.array((80.0, 30.0, -10.0)), np.array(velocity), cov, sigma / 85.0, ("size",)
        )

    return place


async def test_a_teammate_is_on_the_map_where_we_measure_it_whatever_it_says(tmp_path):
    told = Told(tmp_path, '["adsb"]', looking=True)
    async with told.flight:
        told.fly(4.0)
        told.parts.door.perceived.velocity = (1.0, 0.0, 0.0)
        told.notices.on_peer(says_it_stands(2, told.flight.clock.now(), (100.0, 0.0, 0.0)))
        told.fly(3.0, [2], place=measured(velocity=(2.0, 3.0, -1.5)))
        places = told.ground.of("ADSB_VEHICLE")
        assert 2 <= len(places) <= 4
        place = places[-1]
        assert place.callsign == "ST2 1m"
        assert place.lat == pytest.approx(474000000 + 80.0 / 111_180.0 * 1e7, abs=20)
        assert place.lon == pytest.approx(85000000 + 30.0 / 75_460.0 * 1e7, abs=30)
        assert place.altitude == pytest.approx(498_000, abs=10)
        # It flies 3 m/s north and 3 east over the ground, and climbs at 1.5.
        moving = (
            common.ADSB_FLAGS_VALID_HEADING
            | common.ADSB_FLAGS_VALID_VELOCITY
            | common.ADSB_FLAGS_VERTICAL_VELOCITY_VALID
        )
        assert place.flags & moving == moving
        assert (place.heading, place.hor_velocity, place.ver_velocity) == (4500, 424, 150)
        # Without a velocity of our own, its one over the ground is not known.
        told.parts.door.perceived.velocity = None
        told.fly(2.0, [2], place=measured())
        assert not told.ground.of("ADSB_VEHICLE")[-1].flags & moving
        sent = len(told.ground.of("ADSB_VEHICLE"))
        told.fly(4.0, [None])
        told.fly(4.0, [2])
        assert len(told.ground.of("ADSB_VEHICLE")) == sent  # its word is old, and nobody measures it


@pytest.mark.parametrize(("own_sigma", "sigma"), [(0.1, 5.0), (1000.0, 0.5)])
async def test_what_is_measured_badly_or_from_nobody_knows_where_is_not_on_the_map(
    tmp_path, own_sigma, sigma
):
    told = Told(tmp_path, '["adsb"]', looking=True)
    async with told.flight:
        told.fly(4.0)
        told.parts.door.perceived.position_sigma = own_sigma
        told.fly(3.0, [2], place=measured(sigma))
    assert not told.ground.of("ADSB_VEHICLE")


@pytest.mark.parametrize(
    ("drone_id", "sigma", "callsign"),
    [(2, 0.3, "ST2 1m"), (999, 2.01, "ST999 3m"), (1000, 0.3, "ST1000"), (65535, None, "ST65535?")],
)
def test_a_callsign_fits_its_field_and_never_calls_a_report_measured(drone_id, sigma, callsign):
    assert pilot_notices._callsign(drone_id, sigma) == callsign
    assert len(callsign.encode()) <= LONGEST_CALLSIGN


async def test_a_ground_station_decodes_places_and_texts_from_a_real_socket(tmp_path):
    port, clock = free_port(), SystemClock()
    config = written(
        tmp_path,
        camera=CAMERA,
        autopilot=f'link = "udpin:127.0.0.1:{port}"\ntell = ["adsb", "teammates"]',
        team=ORIGIN,
    )
    parts = assemble(load_config(config), clock)
    parts.door.perceived = Looking(clock)
    parts.door.perceived.velocity = (1.0, 0.0, 0.0)
    notices = make_notices(parts)
    ground = Ground(system=7, boot_at=clock.now() - 40.0)
    link = asyncio.create_task(parts.autopilot.run(Listener()))
    try:
        async with serve_udp(ground, "127.0.0.1", port), asyncio.timeout(TIMEOUT):
            while not (ground.of("ADSB_VEHICLE") and ground.texts):
                now = clock.now()
                size, mean = np.array((20.0, 10.0)), np.array((100.0, 0.0, 200.0, 0.0))
                track = Track(1, now, mean, np.eye(4), TrackStatus.CONFIRMED, 1.0, size)
                place = measured(velocity=(0.0, -2.0, 0.0))(2, now)
                seen = IdentifiedTrack(track, 2, 0.99, relative=place)
                notices.on_scan(ScanReport(1, TrackList(now, now, (seen,))))
                notices.tick(now)
                await asyncio.sleep(0.02)
    finally:
        link.cancel()
        await asyncio.gather(link, return_exceptions=True)
    place = ground.of("ADSB_VEHICLE")[0]
    assert (place.get_srcSystem(), place.get_srcComponent()) == (7, 191)
    assert place.callsign == "ST2 1m"
    assert place.lat == pytest.approx(474000000 + 80.0 / 111_180.0 * 1e7, abs=20)
    assert place.heading == pytest.approx(36000 - 6343, abs=1)
    assert place.hor_velocity == pytest.approx(224, abs=1)
    assert ground.texts[0] == (common.MAV_SEVERITY_INFO, "swarmtrack: drone 2: 85 m N, 10 m up, +-1 m")


async def test_texts_of_places_take_turns_leave_room_for_news_and_keep_silent_about_guesses(tmp_path):
    told = Told(tmp_path, '["teammates"]', looking=True)
    assert pilot_notices.periods.PLACE_TEXTS >= 2.0 * LINE_EVERY
    async with told.flight:
        told.fly(16.0, [2, None, 3], place=lambda i, now: measured()(i, now) if i else None)
        assert set(told.texts) == {
            "drone 2: 85 m N, 10 m up, +-1 m",
            "drone 3: 85 m N, 10 m up, +-1 m",
        }
        assert 2 <= len(told.texts) <= 4
        before = len(told.texts)
        told.fly(12.0, [2], place=measured(sigma=90.0))  # more than the distance
        told.fly(12.0, [2])
        assert len(told.texts) == before
    # News of the agent itself, and the number of teammates, belong to "status".
    assert not told.ground.of("NAMED_VALUE_FLOAT")


def test_a_place_below_and_to_the_northwest_is_said_so():
    state = replace(measured(sigma=2.4)(65535, 0.0), position=np.array((30.0, -30.0, 7.0)))
    assert place_in_words(state) == "drone 65535: 42 m NW, 7 m down, ±3 m"


async def test_a_flood_of_places_is_not_remembered(tmp_path):
    told = Told(tmp_path, '["adsb"]')
    for drone_id in range(2, 5000):
        told.notices.on_peer(says_it_stands(drone_id, 0.0, (1.0, 0.0, 0.0)))
    assert len(told.notices._positions._reported._reports) <= 256


async def test_with_an_empty_list_only_our_heartbeat_goes_out(tmp_path):
    told = Told(tmp_path, "[]")
    async with told.flight:
        told.fly(6.0, [2, 3])
        told.notices.on_peer(PeerDeparted(3, "0000000a"))
        await asyncio.wait_for(told.notices.run(), 1.0)  # nobody to tell: done
    assert {m.get_type() for m in told.ground.heard} == {
        "HEARTBEAT",
        "TIMESYNC",
        "COMMAND_LONG",
        "PARAM_REQUEST_READ",
    }


async def test_nothing_is_said_into_a_recording():
    link = SimulatedLink()
    link.recording = True
    unit = MavlinkAutopilot(link, clock=ManualClock(100.0))
    task = asyncio.create_task(unit.run(Listener()))
    await asyncio.sleep(0)
    ground = Ground(boot_at=60.0)
    for data in ground.step(100.0):
        unit.received(100.0, data)
    assert dict(unit.status().counters)["frames"] == 1
    assert not unit.send_message(named_value(100.0, "trk_n", 1.0))
    assert link.sent == []
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


# ── other links ──────────────────────────────────────────────────────────────────────────────────────────────────────


async def drive(unit, ground, read, write):
    """Hand bytes to and fro until the ground has heard the text."""
    task = asyncio.create_task(unit.run(Listener()))
    try:
        async with asyncio.timeout(TIMEOUT):
            while not ground.texts:
                with contextlib.suppress(BlockingIOError):
                    ground.receive(read(), time.monotonic())
                for data in ground.step(time.monotonic()):
                    write(data)
                if dict(unit.status().counters)["imu_samples"] > 5:
                    for message in status_text(Severity.NOTICE, "hello", 1):
                        unit.send_message(message)
                await asyncio.sleep(0.005)
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def test_a_text_arrives_over_a_serial_port():
    ours, theirs = os.openpty()
    tty.setraw(ours)
    os.set_blocking(ours, False)
    ground = Ground(boot_at=time.monotonic() - 40.0)
    unit = MavlinkAutopilot(f"serial:{os.ttyname(theirs)}:921600", clock=SystemClock())
    await drive(unit, ground, lambda: os.read(ours, 4096), lambda data: os.write(ours, data))
    assert ground.texts[0] == (common.MAV_SEVERITY_NOTICE, "hello")
    os.close(ours)
    os.close(theirs)


async def test_a_text_arrives_over_tcp():
    with socket.create_server(("127.0.0.1", 0)) as server:
        ground = Ground(boot_at=time.monotonic() - 40.0)
        unit = MavlinkAutopilot(f"tcp:127.0.0.1:{server.getsockname()[1]}", clock=SystemClock())
        server.setblocking(False)
        peers = []

        def read():
            if not peers:
                peer, _ = server.accept()
                peer.setblocking(False)
                peers.append(peer)
            return peers[0].recv(4096)

        def write(data):
            if peers:
                peers[0].send(data)

        await drive(unit, ground, read, write)
        peers[0].close()
    assert ground.texts[0] == (common.MAV_SEVERITY_NOTICE, "hello")


async def test_a_port_that_takes_no_bytes_blocks_nobody():
    ours, theirs = os.openpty()
    tty.setraw(ours)
    ground = Ground(boot_at=time.monotonic() - 40.0)
    unit = MavlinkAutopilot(f"serial:{os.ttyname(theirs)}:921600", clock=SystemClock())
    task = asyncio.create_task(unit.run(Listener()))
    async with asyncio.timeout(TIMEOUT):
        while not unit.send_message(named_value(0.0, "trk_n", 0.0)):
            for data in ground.step(time.monotonic()):
                os.write(ours, data)
            await asyncio.sleep(0.01)
        # Nobody reads at the other end: far more than the kernel and we keep, and the loop still turns.
        for _ in range(10_000):
            unit.send_message(next(status_text(Severity.INFO, "x" * 50, 1)))
        await asyncio.sleep(0)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    os.close(ours)
    os.close(theirs)


# ── the messages ─────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("length", [0, 1, 49, 50, 51, 99, 100, 101, 150, 200, 500])
def test_a_long_text_comes_in_chunks_that_ground_stations_put_together(length):
    text = "".join(chr(ord("a") + i % 26) for i in range(length))
    writer, reader = common.MAVLink(None, 1, 191), common.MAVLink(None)
    chunks = [reader.decode(bytearray(m.pack(writer))) for m in status_text(Severity.INFO, text, 9)]
    assert [m.chunk_seq for m in chunks] == list(range(len(chunks)))
    # As QGroundControl does: a sequence ends with the first chunk that is not full.
    assert all(len(m.text) == 50 for m in chunks[:-1])
    assert len(chunks) == 1 or len(chunks[-1].text) < 50
    assert {m.id for m in chunks} == ({0} if len(chunks) == 1 else {9})
    assert "".join(m.text for m in chunks) == text[:200]


def test_signs_that_ground_stations_may_not_know_are_replaced():
    assert next(status_text(Severity.INFO, "±2 m … σ", 1)).text == "+-2 m ... ?"


def test_numbers_out_of_range_still_make_a_message():
    mav = common.MAVLink(None, 1, 191)
    named_value(1e12, "a name that is too long", math.nan).pack(mav)
    message = image_status(np.array(((-5.0, 0.5), (7.0, 0.6))))
    message.pack(mav)
    assert (message.rec_top_x, message.rec_bottom_x) == (0.0, 1.0)


def test_a_state_is_news_once_it_has_lasted_and_not_too_often():
    sight = Debounced(0, hold=2.0, rest=10.0)
    assert not sight.is_news(0, 0.0)
    assert not sight.is_news(3, 1.0)
    assert not sight.is_news(2, 2.0)
    assert not sight.is_news(3, 3.0)
    assert sight.is_news(3, 5.0)
    assert not sight.is_news(2, 6.0)
    assert not sight.is_news(2, 9.0)
    assert sight.is_news(2, 15.0)


def test_of_too_many_lines_the_least_severe_go_first():
    lines = StatusLines()
    lines.add(Severity.ERROR, "first", 0.0)
    for i in range(30):
        lines.add(Severity.INFO, f"line {i}", 0.0)
    assert lines.untold == 15
    assert lines.next(0.0).text == "first"


# ── the config ───────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("tell", "words"),
    [
        ('["adsb"]', '"adsb" without an origin of the team frame, expected [team] origin'),
        ('["follow_target"]', "one camera measures no range"),
        ('["follow_target"]', "docs/telling.md"),
        ('["sms"]', "'status', 'teammates', 'camera_tracking' or 'adsb'"),
        ('"status"', "a list"),
        ("3", "a list"),
    ],
)
def test_what_cannot_be_told_is_refused_with_the_reason(tmp_path, tell, words):
    path = telling(tmp_path, tell)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    (problem,) = caught.value.problems
    line = path.read_text().splitlines().index(f"tell = {tell}") + 1
    assert problem.startswith(f"{path}:{line}: autopilot.tell")
    assert words in problem


def test_check_says_what_is_told_and_warns(tmp_path):
    path = telling(tmp_path, '["status", "camera_tracking", "adsb"]', team=ORIGIN)
    result = subprocess.run(
        [sys.executable, "-m", "swarmtrack.agents.vehicle", "--config", str(path), "--check"],
        capture_output=True,
        text=True,
        timeout=TIMEOUT,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert "sending    status, camera_tracking, adsb" in result.stdout
    assert (
        "warning: autopilot.tell: adsb: an ArduPilot with ADSB_TYPE = 1 and AVD_ENABLE = 1 evades"
        in result.stdout
    )
    assert "warning: autopilot.tell: camera_tracking" in result.stdout
