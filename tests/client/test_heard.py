"""What a planner is told of a team, and what is refused: without a network."""

import math
from dataclasses import replace

import msgpack
import numpy as np
import pytest

from support.golden_bytes import STRANGERS_BYTES
from support.seen_swarm import COV, FORWARD, LENS, healthy, seen, stranger
from swarmtrack.client.axes import Axes
from swarmtrack.client.heard import HeardTeam
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import from_euler
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind, Sample
from swarmtrack.transport.limits import MAX_PEERS
from swarmtrack.wire import codec
from swarmtrack.wire.camera import camera_message

BOOT, OTHER = "0123abcd", "89abcdef"


def token(boot=BOOT, drone_id=1):
    return keys.key("red", Kind.ALIVE, drone_id, boot)


def sample(kind, message, key_id=1):
    payload = message if isinstance(message, bytes) else codec.encode(message)
    return Sample(keys.key("red", kind, key_id), payload, True, 12.5)


def described(boot=BOOT, drone_id=1, key_id=1):
    return sample(Kind.CAMERA, camera_message(drone_id, boot, [LENS], [FORWARD]), key_id)


@pytest.fixture
def team():
    team = HeardTeam("red", Axes.NED)
    team.on_token(token(), True, 0.0)
    return team


def test_pixels_become_directions_of_the_camera_the_body_and_the_world(team):
    team.on_camera(described())
    sight = team.on_tracks(sample(Kind.TRACKS, seen()))
    two, stranger = sight.targets
    ray = np.array([300.0 / 400.0, -62.5 / 500.0, 1.0])
    ray /= np.linalg.norm(ray)
    np.testing.assert_allclose(two.direction_camera, ray)
    np.testing.assert_allclose(two.direction_body, [ray[2], ray[0], ray[1]])  # forward, right, down
    np.testing.assert_allclose(two.direction_world, np.array([8.0, 6.0, -1.0]) / math.sqrt(101.0))
    np.testing.assert_allclose(two.direction_world, two.direction_body, atol=1e-12)  # it looks north
    assert two.direction_sigma == pytest.approx(2.0 / 400.0)
    np.testing.assert_allclose(stranger.direction_body, [1.0, 0.0, 0.0])
    assert (stranger.direction_world, stranger.relative) == (None, None)
    assert (sight.drone_id, sight.arrived, sight.sequence, sight.scan_age_s) == (1, 12.5, 1, 0.05)


def test_names_and_places_come_with_their_certainty(team):
    sight = team.on_tracks(sample(Kind.TRACKS, seen()))
    two = sight.of(2)
    assert (two.id, two.identity_probability, two.status, two.coasting_s) == (5, 0.99, "confirmed", None)
    assert two.relative.distance == pytest.approx(math.sqrt(101.0))
    assert two.relative.distance_sigma == pytest.approx(0.05 * math.sqrt(101.0))
    np.testing.assert_allclose(two.relative.velocity, [0.5, 0.0, -0.25])
    np.testing.assert_allclose(two.relative.cov, COV)
    assert two.relative.sources == ("size", "pose")
    assert sight.of(3) is None


def test_in_enu_the_world_is_east_north_up_and_the_body_forward_left_up():
    team = HeardTeam("red", Axes.ENU)
    team.on_token(token(), True, 0.0)
    team.on_camera(described())
    two = team.on_tracks(sample(Kind.TRACKS, seen())).of(2)
    np.testing.assert_allclose(two.relative.position, [6.0, 8.0, 1.0])
    np.testing.assert_allclose(two.relative.velocity, [0.0, 0.5, 0.25])
    np.testing.assert_allclose(np.diag(two.relative.cov), [0.09, 0.04, 0.01, 0.2, 0.1, 0.3])
    forward, left, up = two.direction_body
    assert forward > 0.0 > left
    assert up > 0.0
    assert two.direction_camera[2] > 0.0  # the camera's axes are as before


def test_with_the_attitude_of_the_observer_strangers_have_a_direction_in_the_world_too(team):
    team.on_camera(described())
    sight = team.on_tracks(sample(Kind.TRACKS, seen())).turned(from_euler(0.0, 0.0, math.pi / 2))
    _, stranger = sight.targets
    np.testing.assert_allclose(stranger.direction_world, [0.0, 1.0, 0.0], atol=1e-12)  # it looks east


def test_without_a_camera_there_are_names_and_places_but_no_directions(team):
    assert team.without_camera == (1,)
    two, stranger = team.on_tracks(sample(Kind.TRACKS, seen())).targets
    assert (two.direction_camera, two.direction_body, two.direction_sigma) == (None, None, None)
    assert two.direction_world is not None
    assert stranger.direction_world is None
    team.on_camera(described())
    assert team.without_camera == ()
    assert team.camera(1).lens == LENS


def test_a_camera_counts_only_of_its_own_drone_and_while_its_boot_lives(team):
    team.on_camera(described(drone_id=2, key_id=1))
    team.on_camera(described(boot=OTHER))
    team.on_camera(sample(Kind.CAMERA, b"garbage"))
    assert team.camera(1) is None
    assert team.counters == {"camera_on_wrong_key": 1, "camera_before_token": 1, "camera_malformed": 1}
    team.on_camera(described())
    team.on_token(token(), False, 0.0)
    team.on_token(token(), True, 0.0)
    assert team.camera(1) is None  # a healed partition: it is asked for again
    assert team.without_camera == (1,)


def test_after_a_restart_the_camera_of_the_new_life_counts_at_once(team):
    team.on_camera(described())
    team.on_token(token(OTHER), True, 12.0)
    assert (team.camera(1), team.without_camera) == (None, (1,))
    team.on_camera(described(boot=OTHER))
    assert team.camera(1) is not None
    team.on_token(token(), False, 14.0)  # what the killed process left behind
    assert team.camera(1) is not None


def test_while_two_processes_speak_as_one_drone_nobody_knows_through_which_lens(team):
    team.on_camera(described())
    team.on_token(token(OTHER), True, 0.0)
    team.on_camera(described(boot=OTHER))
    assert team.camera(1) is None
    team.on_token(token(), False, 0.0)
    assert team.camera(1) is not None


def test_nothing_counts_of_who_does_not_live_nor_what_cannot_be_read(team):
    assert team.on_tracks(sample(Kind.TRACKS, seen(), key_id=2)) is None
    assert team.on_health(sample(Kind.HEALTH, b"\xff")) is None
    assert team.on_tracks(sample(Kind.TRACKS, seen())._replace(key="swarmtrack/blue/v1/tracks/1")) is None
    fields = msgpack.unpackb(codec.encode(seen()))
    fields[7][0][1][0] = math.nan
    assert team.on_tracks(sample(Kind.TRACKS, msgpack.packb(fields))) is None
    assert team.counters == {
        "tracks_before_token": 1, "health_malformed": 1, "messages_on_no_key": 1, "tracks_malformed": 1
    }  # fmt: skip


def test_tokens_that_cannot_be_and_more_than_a_team_has_are_refused(team):
    for key in ("swarmtrack/blue/v1/alive/3/0123abcd", "swarmtrack/red/v1/alive/3", "nonsense", token("XYZ")):
        team.on_token(key, True, 0.0)
    assert team.counters["tokens_malformed"] == 4
    for k in range(2, MAX_PEERS + 10):
        team.on_token(token(drone_id=k), True, 0.0)
    assert len(team.drones) == MAX_PEERS
    assert team.counters["tokens_beyond_limit"] == 9


def test_health_says_whether_a_drone_could_fly_and_why_not(team):
    health = team.on_health(sample(Kind.HEALTH, healthy(BOOT)))
    assert (health.drone_id, health.ready, health.reasons) == (1, False, ("no gyro",))
    assert health.message.uptime_s == 60.0


def test_no_tracks_are_a_sight_too(team):
    team.on_camera(described())
    message = codec.encode(seen())
    fields = msgpack.unpackb(message)[:6]
    fields[5] = []
    sight = team.on_tracks(sample(Kind.TRACKS, msgpack.packb(fields)))
    assert sight.targets == ()


def test_a_track_of_another_camera_has_the_direction_in_which_that_one_looks(team):
    wide = PinholeCamera(200.0, 200.0, 160.0, 120.0, 320, 240)
    back = Pose(from_euler(0.0, 0.0, math.pi) @ FORWARD.rotation, np.array([-0.2, 0.0, 0.0]))
    team.on_camera(sample(Kind.CAMERA, camera_message(1, BOOT, [LENS, wide], [FORWARD, back])))
    behind = stranger()
    mean = np.array([160.0 + 200.0, 0.0, 120.0, 0.0])  # 45° to the right of that camera's axis
    behind = replace(behind, track=behind.track._replace(id=7, mean=mean, camera=1))
    sight = team.on_tracks(sample(Kind.TRACKS, seen(1, stranger(), behind)))
    ahead, other = sight.targets
    assert (ahead.camera, other.camera) == (0, 1)
    np.testing.assert_allclose(ahead.direction_body, [1.0, 0.0, 0.0], atol=1e-12)
    # Right of a camera that looks back is left of the drone.
    np.testing.assert_allclose(other.direction_body, [-math.sqrt(0.5), -math.sqrt(0.5), 0.0], atol=1e-12)
    assert other.direction_sigma == pytest.approx(1.0 / 200.0)
    assert [one.lens for one in team.camera(1).all] == [LENS, wide]


def test_a_track_of_a_camera_that_nobody_described_has_no_direction(team):
    team.on_camera(described())
    behind = replace(stranger(), track=stranger().track._replace(camera=1))
    (target,) = team.on_tracks(sample(Kind.TRACKS, seen(1, behind))).targets
    assert (target.camera, target.direction_camera, target.direction_body) == (1, None, None)


def test_a_stranger_is_handed_over_in_the_axes_that_are_asked_for():
    data = bytes.fromhex(STRANGERS_BYTES)
    for axes, position, variances in (
        (Axes.NED, [8.0, -1.5, -7.0], [0.25, 0.25, 0.5, 1.0, 1.0, 0.5]),
        (Axes.ENU, [-1.5, 8.0, 7.0], [0.25, 0.25, 0.5, 1.0, 1.0, 0.5]),
    ):
        team = HeardTeam("red", axes)
        team.on_token(token(drone_id=7), True, 0.0)
        (one,) = team.on_strangers(sample(Kind.STRANGER, data, key_id=7))
        assert (one.drone_id, one.number, one.observers, one.remote_id) == (7, 701, (3, 7), "UAS-1")
        np.testing.assert_allclose(one.position, position)
        np.testing.assert_allclose(np.diag(one.cov), variances)


def test_garbage_in_the_name_of_strangers_is_counted(team):
    assert team.on_strangers(sample(Kind.STRANGER, b"\x93\x01\xc1")) == ()
    assert team.counters["stranger_malformed"] == 1
