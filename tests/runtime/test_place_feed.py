"""What an autopilot without a position is fed, when, and what is made of its answer: on a simulated link."""

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from support.autopilot_flight import Flight
from support.fake_autopilot import FakeAutopilot, FakePx4
from swarmtrack.autopilot.fed_position import FedPosition
from swarmtrack.autopilot.global_position import GlobalPosition
from swarmtrack.clock import ManualClock
from swarmtrack.config.drone import load_config
from swarmtrack.geometry.geodesy import Geodetic, from_ned
from swarmtrack.lab.autopilots.senses import GpsFix
from swarmtrack.motion.ego import AutopilotPlace
from swarmtrack.runtime.agent import make_health, make_notices, make_place_feed
from swarmtrack.runtime.assembly import assemble
from swarmtrack.runtime.place_feed import FeedParameters, PlaceFeed

HERE = np.array([4.0, 1.0, -6.0])
PLACE = Geodetic.from_degrees(47.4, 8.5, 500.0)


class Echo:
    """States what it is fed, as an estimator would that knows nothing else; keeps what came."""

    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self.heard = []
        self.position = None

    def understand(self, message, now, channel):
        if message.get_type() == "ODOMETRY":
            self.heard.append((now, message))
        super().understand(message, now, channel)

    def takes_odometry(self, message):
        return all(map(math.isfinite, (message.x, message.y, message.z)))

    def take_position(self, t, position, var, *, is_reset):
        self.position = position

    def fed(self, since=-math.inf):
        return [m for t, m in self.heard if t > since and m.quality > 0]


class EchoArduPilot(Echo, FakeAutopilot):
    """One that says so in its way."""


class EchoPx4(Echo, FakePx4):
    """One that says so in its way."""


class Feeding:
    """A flight of 20 ms steps in which the drone is held by teammates, or not."""

    def __init__(self, vehicle, *, gps=None, **parameters):
        self.vehicle, self.watch = vehicle, FedPosition()
        self.flight = Flight(vehicle, fed=self.watch, gps=gps)
        self.position, self.sigma, self.age, self.lost = HERE.copy(), 0.2, 0.0, True
        self.said = []
        parameters = FeedParameters(**parameters)
        self.feed = PlaceFeed(
            self, self.flight.unit, self.watch, self, clock=self.flight.clock, parameters=parameters
        )

    def add(self, severity, text):
        self.said.append(text)

    @property
    def now(self):
        return self.flight.clock.now()

    @property
    def place_for_autopilot(self):
        cov, eye = self.sigma**2 * np.eye(3), np.eye(3)
        if not self.lost:
            return None
        return AutopilotPlace(
            self.now, self.position.copy(), cov, np.zeros(3), 0.01 * eye, eye, 1e-4 * eye, self.now - self.age, (2, 3)
        )  # fmt: skip

    def fly(self, seconds):
        for _ in range(round(20 * seconds)):
            self.flight.fly(0.05)
            self.feed.feed(self.now)

    @property
    def poses(self):
        return self.flight.listener.poses

    @property
    def count(self):
        return dict(self.feed.status().counters)


@pytest.fixture(params=[EchoArduPilot, EchoPx4])
def feeding(request):
    return Feeding(request.param())


async def test_it_is_fed_twenty_times_a_second_and_says_by_whom(feeding):
    async with feeding.flight:
        feeding.fly(5.0)
        since = feeding.now
        feeding.fly(2.0)
        fed = feeding.vehicle.fed(since)
        assert len(fed) == pytest.approx(40, abs=1)
        assert (fed[-1].x, fed[-1].y, fed[-1].z) == pytest.approx(tuple(HERE))
        # A fifth of a metre of two.
        assert fed[-1].quality == 90
        assert feeding.said == ["place feed begins: held by 2 and 3, ±0.2 m"]
        assert feeding.feed.status().text == "feeds the autopilot our place"
        assert feeding.vehicle.parameters.written == 0


async def test_an_echo_of_what_it_was_fed_is_no_position_of_its_own(feeding):
    async with feeding.flight:
        feeding.fly(6.0)
        assert feeding.vehicle.position == pytest.approx(HERE)
        assert feeding.flight.unit.place is not None, "it states a position again"
        assert all(pose.position is None for pose in feeding.poses)
        assert feeding.flight.count["poses_fed"] > 100


async def test_some_time_after_the_last_fed_place_its_position_is_its_own(feeding):
    async with feeding.flight:
        feeding.fly(5.0)
        feeding.lost = False
        feeding.fly(29.0)
        assert all(pose.position is None for pose in feeding.poses)
        feeding.fly(2.0)
        assert feeding.poses[-1].position == pytest.approx(HERE)


async def test_a_place_that_nobody_holds_or_that_is_vague_is_not_sent(feeding):
    async with feeding.flight:
        feeding.fly(5.0)
        feeding.age = 1.1
        feeding.fly(1.0)
        assert feeding.vehicle.fed(feeding.now - 0.9) == []
        feeding.age = 0.1
        feeding.fly(0.2)
        feeding.sigma = 2.1
        feeding.fly(1.0)
        assert feeding.vehicle.fed(feeding.now - 0.9) == []
        assert feeding.said[1:] == [
            "place feed ends: no teammate has held us for 1.1 s",
            "place feed begins: held by 2 and 3, ±0.2 m",
            "place feed ends: ±2.1 m, expected ±2.0 m or better",
        ]
        assert feeding.count["withheld_old"] > 10
        assert feeding.count["withheld_vague"] > 10


async def test_on_the_edge_it_does_not_begin_and_end_all_the_time(feeding):
    async with feeding.flight:
        feeding.fly(4.0)
        for k in range(60):
            feeding.sigma = 1.95 + 0.1 * (k % 2)
            feeding.fly(0.05)
        assert len(feeding.said) == 2


async def test_only_a_step_of_the_place_counts_as_a_reset(feeding):
    async with feeding.flight:
        feeding.fly(4.0)
        feeding.position += (0.3, 0.0, 0.0)
        feeding.fly(1.0)
        assert feeding.vehicle.fed()[-1].reset_counter == 0
        feeding.position += (5.0, 0.0, 0.0)
        feeding.fly(1.0)
        assert feeding.vehicle.fed()[-1].reset_counter == 1
        assert feeding.count["resets"] == 1


async def test_before_it_is_needed_an_ardupilot_hears_that_there_is_no_place_and_a_px4_nothing():
    for vehicle, standbys in ((EchoArduPilot(), 25), (EchoPx4(), 0)):
        feeding = Feeding(vehicle)
        feeding.lost = False
        async with feeding.flight:
            feeding.fly(5.0)
            since = feeding.now
            feeding.fly(5.0)
            heard = [m for t, m in vehicle.heard if t > since]
            assert len(heard) == pytest.approx(standbys, abs=1)
            assert all(m.quality == -1 and math.isnan(m.x) for m in heard)
            assert feeding.said == []


async def test_once_its_receiver_has_had_a_fix_again_the_feed_ends(feeding):
    vehicle = feeding.vehicle
    async with feeding.flight:
        feeding.fly(5.0)
        vehicle.gps = GpsFix(PLACE, 0.8)
        feeding.fly(9.0)
        assert vehicle.fed(feeding.now - 0.5)
        feeding.fly(2.5)
        assert vehicle.fed(feeding.now - 0.5) == []
        assert feeding.said[1] == "GPS is back: the place feed ends in 10 s; select EKF source set 1"
        assert feeding.said[2] == "place feed ends: its receiver has had a fix for 10 s"


async def test_while_a_further_source_set_is_selected_the_position_is_not_its_own():
    """Also with GPS: the pilot tries the switch, or has forgotten it."""
    vehicle = EchoArduPilot()
    feeding = Feeding(vehicle)
    feeding.lost = False
    vehicle.gps, vehicle.position = GpsFix(PLACE, 0.8), HERE
    async with feeding.flight:
        feeding.fly(5.0)
        assert feeding.poses[-1].position is not None
        vehicle.select_source_set(2)
        feeding.fly(1.0)
        assert feeding.poses[-1].position is None
        feeding.lost = True
        feeding.fly(20.0)
        assert vehicle.fed(feeding.now - 0.5), "the fix does not count"
        vehicle.select_source_set(1)
        feeding.fly(11.0)
        assert vehicle.fed(feeding.now - 0.5) == []


async def test_after_a_reboot_all_begins_again(feeding):
    async with feeding.flight:
        feeding.fly(5.0)
        feeding.lost = False
        feeding.vehicle.reboot(feeding.now)
        feeding.fly(6.0)
        assert feeding.poses[-1].position == pytest.approx(HERE)
        assert not feeding.watch.rests(feeding.now)


def text(line):
    return common.MAVLink_statustext_message(common.MAV_SEVERITY_INFO, line.encode())


def test_other_texts_select_nothing():
    watch = FedPosition()
    for line in ("EKF3 IMU0 is using GPS", "Using EKF Source Set", "Source 2"):
        watch.on_text(1.0, text(line))
        assert not watch.rests(2.0)


async def test_of_a_drone_that_knows_itself_by_gps_the_local_frame_is_learned():
    """Its positions are in the team frame; the place is fed in the frame of LOCAL_POSITION_NED."""
    vehicle = EchoArduPilot()
    feeding = Feeding(vehicle, gps=GlobalPosition(PLACE))
    # It stands 10 m north of the team's origin, and its local frame began 3 m further east.
    vehicle.gps = GpsFix(from_ned(np.array([10.0, 0.0, -6.0]), PLACE), 0.8)
    vehicle.position = np.array([10.0, -3.0, -6.0])
    feeding.lost = False
    async with feeding.flight:
        feeding.fly(5.0)
        assert feeding.flight.unit.local_origin == pytest.approx((0.0, -3.0, 0.0), abs=0.05)
        feeding.lost, vehicle.gps = True, None
        feeding.fly(2.0)
        m = vehicle.fed()[-1]
        assert (m.x, m.y, m.z) == pytest.approx((HERE[0], HERE[1] - 3.0, HERE[2]), abs=0.05)


async def test_by_gps_too_it_flies_by_the_place_that_it_was_fed():
    """The guard checks set points against where the autopilot says the drone is. Without a fix that was nowhere: a
    real ArduCopter was released two seconds after its GPS had gone."""
    feeding = Feeding(EchoArduPilot(), gps=GlobalPosition(PLACE))
    feeding.vehicle.gps = GpsFix(from_ned(np.array([10.0, 0.0, -6.0]), PLACE), 0.8)
    feeding.vehicle.position = np.array([10.0, 0.0, -6.0])
    feeding.lost = False
    async with feeding.flight:
        feeding.fly(3.0)
        lost_at = feeding.now
        feeding.lost, feeding.vehicle.gps = True, None
        feeding.vehicle.globe = from_ned(HERE, PLACE)
        feeding.fly(3.0)
        arrived, place = feeding.flight.unit.place
        assert arrived > lost_at + 2.0
        assert place == pytest.approx(HERE, abs=0.1)
        assert feeding.poses[-1].position is None


AGENT = """
drone.id = 1
network.transport = "memory"
autopilot = {{ link = "udpin:127.0.0.1:14999", feed = "{feed}", feed_hz = 10.0, feed_max_sigma_m = 0.5 }}
[camera]
source = "http://127.0.0.1:9/"
intrinsics = {{ fx = 600.0, fy = 600.0, cx = 320.0, cy = 256.0, width = 640, height = 512 }}
"""


@pytest.mark.parametrize(("feed", "links"), [("odometry", ["feed"]), ("none", [])])
def test_an_agent_feeds_its_autopilot_only_where_its_config_says_so(tmp_path, feed, links):
    path = tmp_path / "drone.toml"
    path.write_text(AGENT.format(feed=feed), encoding="utf-8")
    parts = assemble(load_config(path), ManualClock(10.0))
    made = make_place_feed(parts, make_notices(parts))
    assert (made is not None) == bool(links)
    assert (parts.fed is not None) == bool(links)
    health = make_health(parts, None, made)
    assert [link.name for link in health.links() if link.name == "feed"] == links
