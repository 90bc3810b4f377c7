"""The wire: what we write is pinned byte for byte, and no bytes at all can do more than be refused."""

import dataclasses
import json
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import msgpack  # type: ignore[import-untyped]
import msgspec
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from support.golden_bytes import (
    ANNOUNCEMENT_BYTES,
    CAMERA_BYTES,
    CAMERAS_BYTES,
    HEALTH_BYTES,
    MOTION_BYTES,
    PLACED_TRACKS_BYTES,
    RANGE_BYTES,
    SECOND_CAMERA_TRACKS_BYTES,
    SIGHTINGS_BYTES,
    STRANGERS_BYTES,
    TRACKS_BYTES,
    VIDEO_BYTES,
)
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import Equidistant, PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import (
    Announcement,
    IdentifiedTrack,
    LinkStatus,
    LocatedStranger,
    MotionProof,
    MotionReport,
    RangeReport,
    RelativeState,
    Sighting,
    SightingReport,
    StrangerRay,
    StrangerReport,
    Track,
    TrackList,
    TrackStatus,
)
from swarmtrack.wire import codec
from swarmtrack.wire.announcement import (
    AnnouncementMessage,
    announcement_from,
    announcement_message,
    sign_announcement,
    signed_part,
)
from swarmtrack.wire.camera import CameraMessage, camera_message, mounting_from
from swarmtrack.wire.checks import DecodeError
from swarmtrack.wire.codec import Message
from swarmtrack.wire.fields import MAX_JPEG, MAX_KNOWN, MAX_MESSAGE_BYTES, MAX_SIGHTINGS
from swarmtrack.wire.health import (
    CarriedHealth,
    ConsistencyHealth,
    GyroBiasHealth,
    HealthMessage,
    LatencyHealth,
    NoiseHealth,
    RateHealth,
    ReadinessHealth,
    TimeOffsetHealth,
    link_health,
)
from swarmtrack.wire.lens import LensMessage, camera_from, lens_message
from swarmtrack.wire.motion import MotionMessage, motion_from, motion_message
from swarmtrack.wire.ranging import RangeMessage, range_from, range_message
from swarmtrack.wire.records import as_record, from_record
from swarmtrack.wire.sightings import SightingsMessage, report_from, sightings_message
from swarmtrack.wire.strangers import StrangersMessage, located_in, strangers_from, strangers_message
from swarmtrack.wire.tracks import (
    ProofMessage,
    RelativeMessage,
    TrackMessage,
    TracksMessage,
    track_cov,
    tracks_message,
    tracks_sequence,
)
from swarmtrack.wire.video import VideoMessage

UTC_OFFSET = 1.7e9
NOW = 14.0  # four seconds after the pose of the announcement held
DECODERS: list[Callable[[bytes], Message]] = [
    partial(codec.decode, kind)
    for kind in (
        AnnouncementMessage,
        CameraMessage,
        SightingsMessage,
        MotionMessage,
        RangeMessage,
        StrangersMessage,
        TracksMessage,
        HealthMessage,
        VideoMessage,
    )
]

ANNOUNCEMENT = Announcement(
    drone_id=7,
    boot="0123abcd",
    sequence=2,
    t=10.0,
    t_sigma=0.25,
    position=np.array([1.0, 2.0, -3.0]),
    world_from_body=np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),  # q = (1, 1, 1, 1) / 2
    position_cov=np.diag([0.5, 0.5, 2.0]),
)

REPORT = SightingReport(
    observer=7,
    boot="0123abcd",
    sequence=9,
    t=13.75,
    t_sigma=0.5,
    position=np.array([1.0, 2.0, -3.0]),
    position_sigma=0.25,
    known=(2, 300),
    sightings=(Sighting(2, 0.75, np.array([0.0, 0.0, -1.0]), 0.125),),
)

MOTION = MotionReport(
    drone_id=7,
    boot="0123abcd",
    sequence=9,
    t=13.75,
    t_sigma=0.5,
    displacement=np.array([1.0, 2.0, -3.0]),
    displacement_cov=np.diag([0.5, 0.5, 2.0]),
    velocity=np.array([0.25, 0.0, -1.0]),
    velocity_cov=np.diag([0.25, 0.25, 0.5]),
)

RANGED = RangeReport(drone_id=7, other=300, t=13.75, t_sigma=0.5, distance=8.5, sigma=0.125)

TRACKS = TracksMessage(
    version=1,
    t_utc_s=1.7e9,
    t_sigma_s=0.5,
    sequence=3,
    scan_age_s=0.125,
    tracks=(
        TrackMessage(
            id=1,
            identity="foreign",
            identity_probability=0.75,
            u_px=320.0,
            vu_px_s=-4.0,
            v_px=256.0,
            vv_px_s=0.0,
            cov_upper=(4.0, 0.0, 0.0, 0.0, 9.0, 0.0, 0.0, 4.0, 0.0, 9.0),
            w_px=16.0,
            h_px=8.0,
            status="confirmed",
            probability=1.0,
            coasting_s=None,
        ),
    ),
)

PLACED = RelativeMessage(
    track_id=1,
    position_m=(8.0, -1.5, 0.5),
    velocity_m_s=(0.25, 0.0, -0.125),
    cov=tuple(np.diag([0.25, 0.25, 0.5, 0.125, 0.125, 0.125])[np.triu_indices(6)].tolist()),
    range_sigma_log=0.0625,
    sources=("size", "announcement"),
)

CAMERA = PinholeCamera(600.0, 601.0, 320.0, 256.0, 640, 512, Equidistant((0.5, 0.25, 0.0, 0.0)))
MOUNTING = Pose(rotation.BODY_FROM_FORWARD_CAMERA, np.array([0.125, 0.0, -0.25]))

HEALTH = HealthMessage(
    version=1,
    t_utc_s=1.7e9,
    boot="0123abcd",
    uptime_s=60.0,
    cpu_percent=5.5,
    rss_mb=96.0,
    rates={"imu": RateHealth(200.0, 199.0), "camera": RateHealth(None, 30.0)},
    latencies={"detect": LatencyHealth(0.01, 0.02, 0.5)},
    clock_offset_s=-0.5,
    clock_offset_sigma_s=0.001,
    links=(link_health(LinkStatus("camera", True, "30 fps", (("fps", 30.0), ("age_s", math.nan)))),),
    drops={"frames": 4},
    events=("camera came back",),
    time_offset=TimeOffsetHealth(0.0625, 0.0009765625, 0.0),
    gyro_bias=GyroBiasHealth(None, None, (0.5, 0.0, -0.25)),
    consistency=ConsistencyHealth(2.25, 1.5, 2.5),
    readiness=ReadinessHealth(False, ("no gyro",)),
    noise=NoiseHealth(0.25, None, "detections scatter", "look"),
)


def announced() -> bytes:
    return codec.encode(announcement_message(ANNOUNCEMENT, UTC_OFFSET, NOW))


def reported() -> bytes:
    return codec.encode(sightings_message(REPORT, UTC_OFFSET, NOW))


def moving() -> bytes:
    return codec.encode(motion_message(MOTION, UTC_OFFSET, NOW))


def ranged() -> bytes:
    return codec.encode(range_message(RANGED, "0123abcd", 9, UTC_OFFSET, NOW))


COV = np.diag([0.25, 0.25, 0.5, 1.0, 1.0, 0.5])
LOCATED = LocatedStranger(
    701, NOW - 0.25, np.array([8.0, -1.5, -7.0]), np.array([0.25, 0.0, -0.125]), COV, (3, 7), "UAS-1"
)
STRANGERS = StrangerReport(
    7, "0123abcd", 9, NOW - 0.25, 0.5, np.array([1.0, 2.0, -3.0]), 0.25, 0.0078125, 0.03125,
    (StrangerRay(701, np.array([0.0, 0.0, -1.0]), 0.00390625, 0.0625),), (LOCATED,),
)  # fmt: skip


def strangers() -> bytes:
    return codec.encode(strangers_message(STRANGERS, UTC_OFFSET, NOW))


def test_strangers_come_back_as_rays_for_agents_and_as_places_for_readers() -> None:
    message = codec.decode(StrangersMessage, strangers())
    report = strangers_from(message, STRANGERS.t, 0.5)
    assert report.rays[0].number == 701
    assert np.array_equal(report.rays[0].direction, STRANGERS.rays[0].direction)
    assert report.located == ()
    (place,) = located_in(message, STRANGERS.t)
    assert (place.number, place.observers, place.remote_id) == (701, (3, 7), "UAS-1")
    assert np.array_equal(place.cov, COV)


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        (7, [math.nan, 0.0, 0.0], "position_m"),
        (8, math.inf, "position_sigma_m"),
        (9, -0.1, "tilt_sigma_rad"),
        (11, [[0, [0.0, 0.0, -1.0], 0.01, 0.0]], "rays"),
        (11, [[701, [0.0, 0.0, -1.0], math.nan, 0.0]], "rays"),
        (11, [[701, [0.0, 0.0, -2e-3], 0.01, 0.0]], "unit vector"),
        (11, [[701, [0.0, 0.0, -1.0], 0.01, 0.0]] * 2, "twice"),
        (11, [[700 + k, [0.0, 0.0, -1.0], 0.01, 0.0] for k in range(17)], "rays"),
        (12, [[701, [0.0] * 3, [0.0] * 3, [-1.0, *[0.0] * 20], [3], ""]], "covariance"),
        (12, [[701, [0.0] * 3, [2e3, 0.0, 0.0], [0.0] * 21, [3], ""]], "located"),
        (12, [[701, [0.0] * 3, [0.0] * 3, [0.0] * 21, [3], "x" * 65]], "located"),
    ],
)
def test_a_report_of_strangers_that_cannot_be_is_refused(field: int, value: object, said: str) -> None:
    fields = msgpack.unpackb(strangers())
    fields[field] = value
    with pytest.raises(DecodeError, match=said):
        codec.decode(StrangersMessage, msgpack.packb(fields))


def described() -> bytes:
    return codec.encode(camera_message(7, "0123abcd", [CAMERA], [MOUNTING]))


def described_with_two() -> bytes:
    return codec.encode(camera_message(7, "0123abcd", [CAMERA, CAMERA], [MOUNTING, MOUNTING]))


def of_the_second_camera() -> TracksMessage:
    return msgspec.structs.replace(placed_and_proved(), cameras=(1,))


def placed(**changes: Any) -> TracksMessage:
    """Tracks of which the first is drone 2, with its place."""
    track = msgspec.structs.replace(TRACKS.tracks[0], identity=2)
    relative = msgspec.structs.replace(PLACED, **changes)
    return msgspec.structs.replace(TRACKS, tracks=(track,), relatives=(relative,))


def placed_and_proved() -> TracksMessage:
    message = placed()
    return msgspec.structs.replace(message, proofs=(ProofMessage(message.tracks[0].id, 0.9995, 12.0),))


def signed() -> bytes:
    return sign_announcement(announced(), "some/key", lambda text: bytes(64))


MESSAGES = [
    announced(),
    signed(),
    described(),
    reported(),
    ranged(),
    codec.encode(TRACKS),
    codec.encode(placed()),
    codec.encode(HEALTH),
]


# --- pinned -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("encoded", "pinned"),
    [
        pytest.param(announced(), ANNOUNCEMENT_BYTES, id="announcement"),
        pytest.param(codec.encode(TRACKS), TRACKS_BYTES, id="tracks"),
        pytest.param(reported(), SIGHTINGS_BYTES, id="sightings"),
        pytest.param(moving(), MOTION_BYTES, id="motion"),
        pytest.param(ranged(), RANGE_BYTES, id="range"),
        pytest.param(strangers(), STRANGERS_BYTES, id="strangers"),
        pytest.param(described(), CAMERA_BYTES, id="camera"),
        pytest.param(described_with_two(), CAMERAS_BYTES, id="two cameras"),
        pytest.param(
            codec.encode(of_the_second_camera()), SECOND_CAMERA_TRACKS_BYTES, id="tracks of the second camera"
        ),
        pytest.param(codec.encode(placed_and_proved()), PLACED_TRACKS_BYTES, id="tracks with a place"),
        pytest.param(codec.encode(HEALTH), HEALTH_BYTES, id="health"),
    ],
)
def test_a_message_is_these_bytes_for_ever(encoded: bytes, pinned: str) -> None:
    assert encoded.hex() == pinned


def test_plain_msgpack_reads_every_message_by_position() -> None:
    assert msgpack.unpackb(announced()) == [
        *[1, 7, "0123abcd", 2, 1700000010.0, 0.25, [1.0, 2.0, -3.0], [0.5, 0.5, 0.5, 0.5]],
        *[[0.5, 0.0, 0.0, 0.5, 0.0, 2.0], 4.0, None],
    ]
    assert msgpack.unpackb(reported()) == [
        *[1, 7, "0123abcd", 9, 1700000013.75, 0.5, 0.25, [1.0, 2.0, -3.0], 0.25, [2, 300]],
        [[2, 0.75, [0.0, 0.0, -1.0], 0.125]],
    ]
    health = msgpack.unpackb(codec.encode(HEALTH))
    assert health[:6] == [1, 1.7e9, "0123abcd", 60.0, 5.5, 96.0]
    assert health[6] == {"imu": [200.0, 199.0], "camera": [None, 30.0]}
    assert health[10] == [["camera", True, "30 fps", {"fps": 30.0}]]


def test_who_is_carried_is_on_the_wire_only_where_somebody_is() -> None:
    plain = codec.encode(sightings_message(REPORT, UTC_OFFSET, NOW))
    carried = codec.encode(sightings_message(dataclasses.replace(REPORT, leans_on=(3, 9)), UTC_OFFSET, NOW))
    assert len(msgpack.unpackb(plain)) == 11
    assert msgpack.unpackb(carried)[11:] == [[3, 9]]
    assert report_from(codec.decode(SightingsMessage, carried), NOW, 0.0).leans_on == (3, 9)
    assert report_from(codec.decode(SightingsMessage, plain), NOW, 0.0).leans_on == ()
    with pytest.raises(DecodeError, match="leans_on: names a drone twice"):
        codec.decode(SightingsMessage, msgpack.packb([*msgpack.unpackb(plain), [3, 3]]))
    confirmed = dataclasses.replace(
        REPORT, sightings=(dataclasses.replace(REPORT.sightings[0], is_confirmed=True),)
    )
    data = codec.encode(sightings_message(confirmed, UTC_OFFSET, NOW))
    assert msgpack.unpackb(data)[11:] == [[], [2]]
    assert report_from(codec.decode(SightingsMessage, data), NOW, 0.0).sightings[0].is_confirmed
    assert not report_from(codec.decode(SightingsMessage, plain), NOW, 0.0).sightings[0].is_confirmed
    for ids, error in (
        ([2, 2], "confirmed: names a drone twice"),
        ([3], "confirmed: has drone 3, expected only drones"),
    ):
        with pytest.raises(DecodeError, match=error):
            codec.decode(SightingsMessage, msgpack.packb([*msgpack.unpackb(plain), [], ids]))
    assert len(msgpack.unpackb(codec.encode(HEALTH))) == 18
    held = msgspec.structs.replace(HEALTH, carried=CarriedHealth((1, 3), 0.375, None))
    assert msgpack.unpackb(codec.encode(held))[18:] == [[[1, 3], 0.375, None]]
    assert codec.decode(HealthMessage, codec.encode(held)) == held


def test_health_may_be_short_of_what_came_later_and_long_by_what_is_still_to_come() -> None:
    fields = msgpack.unpackb(codec.encode(HEALTH))
    older = codec.decode(HealthMessage, msgpack.packb(fields[:13]))
    assert (older.events, older.time_offset, older.readiness) == (HEALTH.events, None, None)
    assert codec.decode(HealthMessage, msgpack.packb([*fields, None, {"of": "tomorrow"}])) == HEALTH
    with pytest.raises(DecodeError, match="version 2"):
        codec.decode(HealthMessage, msgpack.packb([2, *fields[1:]]))


def test_an_announcement_is_under_300_bytes_with_its_signature_whatever_it_says() -> None:
    largest = Announcement(
        65535, "ffffffff", 2**32 - 1, 0.1, 0.1, np.full(3, 0.1), np.eye(3), np.eye(3) * 0.1 + 0.1
    )
    unsigned = codec.encode(announcement_message(largest, UTC_OFFSET, NOW))
    assert len(unsigned) < 200
    assert len(sign_announcement(unsigned, "key", lambda text: bytes(64))) < 300


def test_as_many_tracks_as_are_allowed_fit_into_one_message() -> None:
    mean, cov = np.full(4, 0.1), np.eye(4)
    status = TrackStatus.CONFIRMED
    crowd = tuple(
        IdentifiedTrack(Track(2**53 - i, 5.0, mean, cov, status, i / 300, np.ones(2), 4.0), "foreign", 0.9)
        for i in range(300)
    )
    message = tracks_message(TrackList(5.0, 4.9, crowd), 0, UTC_OFFSET, 0.01)
    assert len(codec.encode(message)) <= MAX_MESSAGE_BYTES
    assert min(t.probability for t in message.tracks) == pytest.approx(45 / 300)  # the least probable go


# --- round trip -------------------------------------------------------------------------

metres = st.floats(-1e4, 1e4)


@settings(deadline=None)
@given(
    drone_id=st.integers(1, 65535),
    sequence=st.integers(0, 2**32 - 1),
    t=st.floats(0, 1e6),
    position=st.tuples(metres, metres, metres),
    rotation_vector=st.tuples(*[st.floats(-3, 3)] * 3),
    factor=st.lists(st.floats(-10, 10), min_size=9, max_size=9),
)
def test_an_announcement_comes_back_as_it_went(
    drone_id: int, sequence: int, t: float, position: Any, rotation_vector: Any, factor: Any
) -> None:
    A = np.reshape(factor, (3, 3))
    sent = Announcement(
        drone_id, "89abcdef", sequence, t, 0.1, np.array(position), rotation.exp(rotation_vector), A @ A.T
    )
    message = codec.decode(AnnouncementMessage, codec.encode(announcement_message(sent, UTC_OFFSET, t + 3.0)))
    assert (message.t_utc_s, message.t_sigma_s) == (pytest.approx(t + UTC_OFFSET, abs=1e-6), 0.1)
    assert message.age_s == pytest.approx(3.0, abs=1e-6)
    got = announcement_from(message, 5.0, 0.25)
    assert (got.drone_id, got.boot, got.sequence) == (drone_id, "89abcdef", sequence)
    assert (got.t, got.t_sigma) == (5.0, 0.25)
    np.testing.assert_array_equal(got.position, sent.position)
    np.testing.assert_allclose(got.world_from_body, sent.world_from_body, atol=1e-9)
    np.testing.assert_allclose(got.position_cov, sent.position_cov, atol=1e-12)


def test_sightings_come_back_as_they_went() -> None:
    message = codec.decode(SightingsMessage, reported())
    assert (message.t_utc_s, message.t_sigma_s, message.age_s) == (UTC_OFFSET + 13.75, 0.5, 0.25)
    got = report_from(message, 5.0, 0.75)
    assert (got.observer, got.boot, got.sequence, got.t, got.t_sigma) == (7, "0123abcd", 9, 5.0, 0.75)
    assert (got.position_sigma, got.known) == (0.25, (2, 300))
    np.testing.assert_array_equal(got.position, REPORT.position)
    ((sighting,), (sent,)) = (got.sightings, REPORT.sightings)
    assert (sighting.drone_id, sighting.probability, sighting.sigma) == (2, 0.75, 0.125)
    np.testing.assert_array_equal(sighting.direction, sent.direction)


def test_a_motion_comes_back_as_it_went() -> None:
    message = codec.decode(MotionMessage, moving())
    assert (message.t_utc_s, message.t_sigma_s, message.age_s) == (UTC_OFFSET + 13.75, 0.5, 0.25)
    got = motion_from(message, 5.0, 0.75)
    assert (got.drone_id, got.boot, got.sequence, got.t, got.t_sigma) == (7, "0123abcd", 9, 5.0, 0.75)
    for name in ("displacement", "displacement_cov", "velocity", "velocity_cov"):
        np.testing.assert_array_equal(getattr(got, name), getattr(MOTION, name))
    assert len(moving()) < 240


@pytest.mark.parametrize(
    ("place", "value", "why"),
    [
        (7, [0.0, 0.0, 1e8], "displacement_m"),
        (7, [0.0, math.nan, 0.0], "motion"),
        (8, [1.0, 0.0, 0.0, 1.0, 0.0, -1.0], "displacement_cov_m2: has the eigenvalue -1"),
        (9, [0.0, 0.0, 2e3], "velocity_m_s"),
        (10, [0.0, 0.0, 0.0, 0.0, 0.0, math.inf], "motion"),
        (10, [1.0, 2.0, 0.0, 1.0, 0.0, 1.0], "velocity_cov_m2_s2: has the eigenvalue -1"),
    ],
)
def test_a_motion_that_nobody_can_fly_is_refused(place: int, value: Any, why: str) -> None:
    fields = msgpack.unpackb(moving())
    fields[place] = value
    with pytest.raises(DecodeError, match=why):
        codec.decode(MotionMessage, msgpack.packb(fields))


def test_a_distance_comes_back_as_it_went() -> None:
    message = codec.decode(RangeMessage, ranged())
    assert (message.t_utc_s, message.t_sigma_s, message.age_s) == (UTC_OFFSET + 13.75, 0.5, 0.25)
    got = range_from(message, 5.0, 0.75)
    assert (got.drone_id, got.other, got.t, got.t_sigma) == (7, 300, 5.0, 0.75)
    assert (got.distance, got.sigma) == (8.5, 0.125)
    assert len(ranged()) < 100


@pytest.mark.parametrize(
    ("place", "value", "why"),
    [
        (7, 7, "other: found 7, expected another drone"),
        (7, 0, "other"),
        (8, math.nan, "range"),
        (8, math.inf, "range"),
        (8, 0.0, "distance_m"),
        (8, -8.5, "distance_m"),
        (8, 1e9, "distance_m"),
        (9, 0.0, "sigma_m"),
        (9, math.nan, "range"),
        (9, 1e9, "sigma_m"),
        (6, -1.0, "age_s"),
    ],
)
def test_a_distance_that_no_radio_measures_is_refused(place: int, value: Any, why: str) -> None:
    fields = msgpack.unpackb(ranged())
    fields[place] = value
    with pytest.raises(DecodeError, match=why):
        codec.decode(RangeMessage, msgpack.packb(fields))


def test_the_largest_report_fits_into_one_message() -> None:
    direction = np.array([0.6, 0.0, 0.8])
    crowd = tuple(Sighting(65535 - i, 0.9, direction, 0.1) for i in range(MAX_SIGHTINGS))
    known = tuple(range(60_000, 60_000 + MAX_KNOWN))
    full = dataclasses.replace(REPORT, known=known, sightings=crowd)
    assert len(codec.encode(sightings_message(full, UTC_OFFSET, NOW))) <= MAX_MESSAGE_BYTES
    more = tuple(Sighting(1 + i, 0.9, direction, 0.1) for i in range(MAX_SIGHTINGS + 1))
    with pytest.raises(ValueError, match="sightings"):
        codec.encode(sightings_message(dataclasses.replace(REPORT, sightings=more), UTC_OFFSET, NOW))
    with pytest.raises(ValueError, match="known"):
        codec.encode(sightings_message(dataclasses.replace(REPORT, known=(*known, 1)), UTC_OFFSET, NOW))


def test_a_signature_covers_the_key_and_every_field_before_it() -> None:
    """As docs/wire.md tells others to make it: the key, a zero byte, the array without its last field."""
    asked: list[bytes] = []
    signature = bytes(range(64))

    def sign(text: bytes) -> bytes:
        asked.append(text)
        return signature

    data = sign_announcement(announced(), "swarmtrack/red/v1/pose/7", sign)
    fields = msgpack.unpackb(announced())[:-1]
    assert asked == [b"swarmtrack/red/v1/pose/7\0" + msgpack.packb(fields)]
    assert msgpack.unpackb(data) == [*fields, signature]
    assert signed_part(data, "swarmtrack/red/v1/pose/7") == (asked[0], signature)
    assert signed_part(data, "swarmtrack/red/v1/pose/8") != (asked[0], signature)


@pytest.mark.parametrize("data", [announced(), announced()[:3], b"", b"\xdc\x00\x0b" + signed()[1:]])
def test_what_is_not_signed_in_the_one_way_has_no_signed_part(data: bytes) -> None:
    assert signed_part(data, "some/key") is None


def proved(*track_ids: int) -> TracksMessage:
    return msgspec.structs.replace(TRACKS, proofs=tuple(ProofMessage(k, 0.9995, 12.5) for k in track_ids))


def test_proofs_are_on_the_wire_only_where_there_are_some_so_that_older_readers_read_the_rest() -> None:
    assert len(msgpack.unpackb(codec.encode(TRACKS))) == 6
    assert codec.decode(TracksMessage, codec.encode(TRACKS)).proofs == ()
    data = codec.encode(proved(1))
    assert msgpack.unpackb(data)[6] == [[1, 0.9995, 12.5]]
    assert codec.decode(TracksMessage, data) == proved(1)
    assert tracks_sequence(data) == TRACKS.sequence


@pytest.mark.parametrize("ids", [(2,), (1, 1)], ids=["of no track", "twice"])
def test_proofs_that_cannot_be_are_refused(ids: tuple[int, ...]) -> None:
    fields = msgpack.unpackb(codec.encode(proved(*ids)))
    with pytest.raises(DecodeError, match="proofs"):
        codec.decode(TracksMessage, msgpack.packb(fields))


def test_a_proof_says_for_how_long_the_track_has_been_proved() -> None:
    track = Track(9, 5.0, np.ones(4), np.eye(4), TrackStatus.CONFIRMED, 1.0, np.ones(2))
    named = IdentifiedTrack(track, 2, 0.99, MotionProof(0.9999, 2.0))
    message = tracks_message(TrackList(5.0, 5.0, (named,)), 1, UTC_OFFSET, 0.01)
    assert message.proofs == (ProofMessage(9, 0.9999, 3.0),)


@pytest.mark.parametrize("identity", [None, "foreign", 1, 65535])
def test_tracks_come_back_as_they_went(identity: Any) -> None:
    A = np.arange(16.0).reshape(4, 4)
    track = Track(9, 5.0, np.array([1.0, 2, 3, 4]), A @ A.T, TrackStatus.LOST, 0.5, np.array([7.0, 8.0]), 4.0)
    tracks = TrackList(5.0, 4.75, (IdentifiedTrack(track, identity, 0.9),))
    sent = tracks_message(tracks, 12, UTC_OFFSET, 0.01)
    got = codec.decode(TracksMessage, codec.encode(sent))
    assert got == sent
    assert (got.t_utc_s, got.scan_age_s, got.tracks[0].coasting_s) == (UTC_OFFSET + 5.0, 0.25, 1.0)
    assert (got.tracks[0].identity, got.tracks[0].status) == (identity, "lost")
    np.testing.assert_array_equal(track_cov(got.tracks[0]), A @ A.T)


def test_health_comes_back_as_it_went() -> None:
    assert codec.decode(HealthMessage, codec.encode(HEALTH)) == HEALTH


def test_a_record_names_every_field_with_its_unit() -> None:
    assert from_record(HealthMessage, json.loads(json.dumps(as_record(HEALTH)))) == HEALTH
    for nonsense in ({}, {**as_record(HEALTH), "links": 3}, {**as_record(HEALTH), "rates": []}):
        with pytest.raises(DecodeError):
            from_record(HealthMessage, nonsense)
    record = as_record(TRACKS)
    assert record["tracks"][0]["vu_px_s"] == -4.0
    seen = as_record(codec.decode(SightingsMessage, reported()))["sightings"]
    assert seen == [{"drone_id": 2, "probability": 0.75, "direction": [0.0, 0.0, -1.0], "sigma_rad": 0.125}]
    assert as_record(codec.decode(AnnouncementMessage, announced()))["position_m"] == [1.0, 2.0, -3.0]


# --- places in metres, and cameras ------------------------------------------------------


def test_places_are_on_the_wire_only_where_there_are_some() -> None:
    data = codec.encode(placed())
    fields = msgpack.unpackb(data)
    assert fields[6:] == [
        [],
        [
            [1, [8.0, -1.5, 0.5], [0.25, 0.0, -0.125], list(PLACED.cov), 0.0625, ["size", "announcement"]],
        ],
    ]
    assert codec.decode(TracksMessage, data) == placed()
    assert len(msgpack.unpackb(codec.encode(TRACKS))) == 6
    assert tracks_sequence(data) == TRACKS.sequence


def test_tracks_may_grow_at_their_end() -> None:
    fields = msgpack.unpackb(codec.encode(of_the_second_camera()))
    longer = msgpack.packb([*fields, None, {"of": "tomorrow"}])
    assert codec.decode(TracksMessage, longer) == of_the_second_camera()
    assert codec.decode(TracksMessage, msgpack.packb(fields[:6])).relatives == ()


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"track_id": 2}, r"of tracks \[2\], expected each once and of a track with a drone's ID"),
        ({"position_m": (math.nan, 0.0, 0.0)}, "tracks"),
        ({"position_m": (0.0, 0.0, 1e8)}, "tracks"),
        ({"velocity_m_s": (0.0, 2e3, 0.0)}, "tracks"),
        ({"velocity_m_s": (0.0, math.inf, 0.0)}, "tracks"),
        ({"cov": (1.0,) * 20}, "tracks"),
        ({"cov": (-1.0, *PLACED.cov[1:])}, "relatives: cov: has the eigenvalue -1"),
        ({"cov": (math.nan, *PLACED.cov[1:])}, "tracks"),
        ({"range_sigma_log": -0.1}, "tracks"),
        ({"range_sigma_log": math.nan}, "tracks"),
        ({"sources": ("x" * 17,)}, "tracks"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_place_that_cannot_be_is_refused(changes: dict[str, Any], why: str) -> None:
    with pytest.raises(DecodeError, match=why):
        codec.decode(TracksMessage, msgspec.msgpack.encode(placed(**changes)))


def test_a_place_of_nobody_and_two_of_one_track_are_refused() -> None:
    stranger = msgspec.structs.replace(placed(), tracks=TRACKS.tracks)
    twice = msgspec.structs.replace(placed(), relatives=(PLACED, PLACED))
    for message in (stranger, twice):
        with pytest.raises(DecodeError, match="relatives"):
            codec.decode(TracksMessage, msgspec.msgpack.encode(message))


def identified(k: int) -> IdentifiedTrack:
    """Drone k, so many metres ahead."""
    track = Track(2**53 - k, 5.0, np.full(4, 0.1), np.eye(4), TrackStatus.CONFIRMED, 0.9, np.ones(2), 4.0)
    away = np.array([k + 0.1, 0.1, 0.1])
    sources = ("size", "announcement", "velocity", "range", "pose", "sighting")
    state = RelativeState(k, 5.0, away, np.full(3, 0.1), np.eye(6) * 0.1 + 0.1, 0.1, sources)
    return IdentifiedTrack(track, k, 0.99, MotionProof(0.999, 1.0), state)


def test_of_more_places_than_fit_into_one_message_the_nearest_go() -> None:
    order = np.random.default_rng(1).permutation(np.arange(1, 256))
    message = tracks_message(
        TrackList(5.0, 4.9, tuple(identified(int(k)) for k in order)), 0, UTC_OFFSET, 0.01
    )
    assert len(codec.encode(message)) <= MAX_MESSAGE_BYTES
    assert len(message.tracks) == 255
    distances = sorted(relative.position_m[0] for relative in message.relatives)
    assert distances == pytest.approx(np.arange(1, len(distances) + 1) + 0.1)
    assert len(distances) >= 20
    few = tracks_message(TrackList(5.0, 4.9, tuple(map(identified, range(1, 33)))), 0, UTC_OFFSET, 0.01)
    assert len(few.relatives) == 32
    assert codec.decode(TracksMessage, codec.encode(few)) == few


def test_a_record_has_a_place_in_its_track() -> None:
    (track,) = as_record(placed())["tracks"]
    assert track["relative"]["position_m"] == [8.0, -1.5, 0.5]
    assert len(track["relative"]["cov"]) == 21
    assert "track_id" not in track["relative"]
    assert "relatives" not in as_record(placed())
    assert as_record(TRACKS)["tracks"][0]["relative"] is None


def test_a_camera_comes_back_as_it_went() -> None:
    message = codec.decode(CameraMessage, described())
    assert (message.drone_id, message.boot) == (7, "0123abcd")
    assert camera_from(message.lens) == CAMERA
    mounting = mounting_from(message)
    np.testing.assert_allclose(mounting.rotation, MOUNTING.rotation, atol=1e-12)
    np.testing.assert_array_equal(mounting.position, MOUNTING.position)
    assert msgpack.unpackb(described()) == [
        *[1, 7, "0123abcd"],
        [640, 512, 600.0, 601.0, 320.0, 256.0, "equidistant", [0.5, 0.25, 0.0, 0.0]],
        *[[0.125, 0.0, -0.25], [0.5, 0.5, 0.5, 0.5]],
    ]
    longer = msgpack.packb([*msgpack.unpackb(described_with_two()), "of tomorrow"])
    assert codec.decode(CameraMessage, longer) == codec.decode(CameraMessage, described_with_two())


class CameraMessageOfOld(msgspec.Struct, array_like=True):
    """As readers from before there were several cameras have it."""

    version: int
    drone_id: int
    boot: str
    lens: Any
    position_m: Any
    quaternion_wxyz: Any


class TracksMessageOfOld(msgspec.Struct, array_like=True):
    """As readers from before there were several cameras have it."""

    version: int
    t_utc_s: float
    t_sigma_s: float
    sequence: int
    scan_age_s: float
    tracks: Any
    proofs: Any = ()
    relatives: Any = ()


def test_who_knows_of_no_second_camera_reads_all_else() -> None:
    old = msgspec.msgpack.decode(described_with_two(), type=CameraMessageOfOld)
    assert (old.drone_id, old.lens[:2]) == (7, [640, 512])
    tracks = msgspec.msgpack.decode(codec.encode(of_the_second_camera()), type=TracksMessageOfOld)
    assert tracks.relatives[0][0] == tracks.tracks[0][0] == placed().tracks[0].id


def test_each_camera_of_a_drone_comes_back_as_it_went() -> None:
    back = Pose(MOUNTING.rotation.T, np.array([-0.5, 0.25, 0.0]))
    small = PinholeCamera(300.0, 300.0, 160.0, 120.0, 320, 240)
    said = codec.encode(camera_message(7, "0123abcd", [CAMERA, small], [MOUNTING, back]))
    (other,) = codec.decode(CameraMessage, said).others
    assert camera_from(other.lens) == small
    np.testing.assert_allclose(mounting_from(other).rotation, back.rotation, atol=1e-12)
    np.testing.assert_array_equal(mounting_from(other).position, back.position)


@pytest.mark.parametrize(
    ("place", "value"), [(0, None), (1, [0.0, 0.0, math.nan]), (2, [0.5, 0.5, 0.5, 0.6])]
)
def test_a_second_camera_that_cannot_be_is_refused(place: int, value: Any) -> None:
    fields = msgpack.unpackb(described_with_two())
    fields[6][0][place] = value
    with pytest.raises(DecodeError):
        codec.decode(CameraMessage, msgpack.packb(fields))
    with pytest.raises(DecodeError, match="others"):
        codec.decode(CameraMessage, msgpack.packb([*fields[:6], fields[6] * 8]))


def test_tracks_say_of_which_camera_they_are_only_where_one_is_of_another() -> None:
    one, other = (identified(k) for k in (1, 2))
    other = of_camera(other, 1)
    message = tracks_message(TrackList(5.0, 4.75, (one, other)), 1, UTC_OFFSET, 0.01)
    assert message.cameras == (0, 1)
    got = codec.decode(TracksMessage, codec.encode(message))
    assert [got.camera_of(i) for i in range(2)] == [0, 1]
    assert [track["camera"] for track in as_record(got)["tracks"]] == [0, 1]
    assert "cameras" not in as_record(got)
    first = tracks_message(TrackList(5.0, 4.75, (one,)), 1, UTC_OFFSET, 0.01)
    assert first.cameras == ()
    assert len(msgpack.unpackb(codec.encode(first))) == 8
    assert "camera" not in as_record(first)["tracks"][0]


def of_camera(entry: IdentifiedTrack, camera: int) -> IdentifiedTrack:
    return dataclasses.replace(entry, track=entry.track._replace(camera=camera))


@pytest.mark.parametrize("cameras", [(0, 1), (8,), (-1,), ("1",)])
def test_cameras_that_cannot_be_are_refused(cameras: Any) -> None:
    message = msgspec.structs.replace(placed(), cameras=cameras)
    with pytest.raises(DecodeError, match="cameras"):
        codec.decode(TracksMessage, msgspec.msgpack.encode(message))


@pytest.mark.parametrize(
    ("place", "value", "why"),
    [
        (0, 2, "version 2"),
        (1, 0, "drone_id"),
        (2, "0123ABCD", "boot"),
        (3, [640, 512, 0.0, 601.0, 320.0, 256.0, None, []], "lens: focal lengths"),
        (3, [640, 512, 600.0, 1e-300, 320.0, 256.0, None, []], "lens: focal lengths"),
        (3, [640, 512, math.nan, 601.0, 320.0, 256.0, None, []], "camera"),
        (3, [0, 512, 600.0, 601.0, 320.0, 256.0, None, []], "lens"),
        (3, [640, 512, 600.0, 601.0, 320.0, 256.0, "radtan", [0.0] * 9], "lens"),
        (3, [640, 512, 600.0, 601.0, 320.0, 256.0, "radtan", [0.0] * 3], "coefficients"),
        (
            3,
            [640, 512, 200.0, 200.0, 3195.0, 256.0, "equidistant", [0.0] * 4],
            r"lens: .*cx, cy: \(3195, 256",
        ),
        (4, [0.0, 0.0, math.inf], "camera"),
        (4, [0.0, 0.0, 1e8], "position_m"),
        (5, [0.0, 0.0, 0.0, 0.0], "unit quaternion"),
        (5, [0.5, 0.5, 0.5, 0.6], "unit quaternion"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(place: int, value: Any, why: str) -> None:
    fields = msgpack.unpackb(described())
    fields[place] = value
    with pytest.raises(DecodeError, match=why):
        codec.decode(CameraMessage, msgpack.packb(fields))


# --- refused ----------------------------------------------------------------------------


def altered(index: int, value: object, *path: int) -> bytes:
    """The announcement with one field replaced."""
    fields = msgpack.unpackb(announced())
    if path:
        fields[index][path[0]] = value
    else:
        fields[index] = value
    packed: bytes = msgpack.packb(fields)
    return packed


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (altered(0, 2), "version 2"),
        (altered(1, 0), "drone_id"),
        (altered(1, True), "drone_id"),
        (altered(1, 65536), "drone_id"),
        (altered(2, "0123ABCD"), "boot"),
        (altered(2, "0123abc\n"), "boot"),
        (altered(3, -1), "sequence"),
        (altered(4, math.nan), "t_utc_s"),
        (altered(5, math.inf), "t_sigma_s"),
        (altered(6, math.nan, 1), "position_m"),
        (altered(6, 1e300, 1), "position_m"),
        (altered(6, [1.0, 2.0]), "position_m"),
        (altered(7, [0.0, 0.0, 0.0, 0.0]), "norm is 0"),
        (altered(7, 0.51, 3), "unit quaternion"),
        (altered(8, -0.5, 0), "eigenvalue"),
        (altered(8, 0.7, 1), "eigenvalue"),
        (altered(9, -1.0), "age_s"),
        (altered(9, math.nan), "age_s"),
        (altered(10, b"x" * 65), "signature"),
        (altered(10, b"x" * 63), "signature"),
        (msgpack.packb([*msgpack.unpackb(announced()), 0]), "length 11, got 12"),
        (msgpack.packb(dict(enumerate(msgpack.unpackb(announced())))), "array"),
        (announced() + b"\x00", "trailing"),
        (b"\x9b\x01\x07\xa8\xff" + announced()[5:], "utf-8"),
        (bytes(MAX_MESSAGE_BYTES + 1), "more than 65536 bytes"),
        (b"", "truncated"),
    ],
)
def test_an_announcement_that_cannot_be_is_refused_with_the_field_and_the_reason(
    data: bytes, says: str
) -> None:
    with pytest.raises(DecodeError, match=says):
        codec.decode(AnnouncementMessage, data)


@pytest.mark.parametrize(
    ("index", "value", "says"),
    [
        (1, 0, "drone_id"),
        (3, 2**32, "sequence"),
        (6, -0.1, "age_s"),
        (7, [0.0, math.inf, 0.0], "position_m"),
        (8, -1.0, "position_sigma_m"),
        (9, [2, 2], "known: names a drone twice"),
        (9, [0], "known"),
        (10, [[2, 0.5, [0.0, 0.0, 1.01], 0.1]], r"direction: norm is 1\.01"),
        (10, [[2, 0.5, [0.0, 0.0, math.nan], 0.1]], "sightings"),
        (10, [[2, 1.5, [0.0, 0.0, 1.0], 0.1]], "sightings"),
        (10, [[2, 0.5, [0.0, 0.0, 1.0], 3.2]], "sightings"),
        (10, [[2, 0.5, [0.0, 0.0, 1.0], 0.1]] * 2, "sightings: names a drone twice"),
    ],
)
def test_sightings_that_cannot_be_are_refused_with_the_field_and_the_reason(
    index: int, value: object, says: str
) -> None:
    fields = msgpack.unpackb(reported())
    fields[index] = value
    with pytest.raises(DecodeError, match=says):
        codec.decode(SightingsMessage, msgpack.packb(fields))


def test_a_track_whose_covariance_is_none_is_refused() -> None:
    fields = msgpack.unpackb(codec.encode(TRACKS))
    fields[5][0][7][1] = 6.1  # correlation above one: 6.1² > 4 x 9
    with pytest.raises(DecodeError, match="eigenvalue"):
        codec.decode(TracksMessage, msgpack.packb(fields))


def test_what_a_reader_would_refuse_is_not_sent() -> None:
    mean = np.array([1.0, math.nan, 1.0, 1.0])
    track = Track(1, 0.0, mean, np.eye(4), TrackStatus.CONFIRMED, 1.0, np.ones(2))
    message = tracks_message(TrackList(0.0, 0.0, (IdentifiedTrack(track, None, 0.0),)), 0, UTC_OFFSET, 0.1)
    with pytest.raises(ValueError, match=r"tracks\[0\]\[4\]"):
        codec.encode(message)


# --- hostile bytes ----------------------------------------------------------------------


def assert_refused_or_sound(data: bytes) -> None:
    """The claim for any bytes at all: DecodeError, or a message whose every number is finite."""
    for decode in DECODERS:
        try:
            message = decode(data)
        except DecodeError:
            continue
        for number in numbers(as_record(message)):
            assert math.isfinite(number)


def numbers(value: Any) -> list[float]:
    if isinstance(value, dict):
        return [n for v in value.values() for n in numbers(v)]
    if isinstance(value, list):
        return [n for v in value for n in numbers(v)]
    return [value] if isinstance(value, float) else []


@settings(deadline=None)
@given(st.binary(max_size=400))
def test_random_bytes_are_refused(data: bytes) -> None:
    assert_refused_or_sound(data)


@settings(deadline=None)
@given(st.sampled_from(MESSAGES), st.data())
def test_truncated_messages_are_refused(message: bytes, draw: st.DataObject) -> None:
    cut = message[: draw.draw(st.integers(0, len(message) - 1))]
    for decode in DECODERS:
        with pytest.raises(DecodeError):
            decode(cut)


@settings(deadline=None)
@given(
    st.sampled_from(MESSAGES), st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), max_size=8)
)
def test_mutated_messages_are_refused_or_sound(message: bytes, changes: list[tuple[int, int]]) -> None:
    mutated = bytearray(message)
    for position, value in changes:
        mutated[position % len(mutated)] = value
    assert_refused_or_sound(bytes(mutated))


anything = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner, max_size=12) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=40,
)


@settings(deadline=None)
@given(st.sampled_from(MESSAGES), st.integers(0, 30), anything)
def test_a_field_replaced_by_anything_is_refused_or_sound(message: bytes, index: int, value: object) -> None:
    fields = msgpack.unpackb(message)
    fields[index % len(fields)] = value
    data = msgpack.packb(fields, unicode_errors="surrogatepass")
    assume(len(data) <= MAX_MESSAGE_BYTES)
    assert_refused_or_sound(data)


@pytest.mark.parametrize(
    "data",
    [
        b"\xdd\xff\xff\xff\xff",  # an array that claims four thousand million elements
        b"\x96\x01\x01\x01\x01\x01\xdd\xff\xff\xff\xff",  # ... of tracks
        b"\x9d\x01\x01\xa8aaaaaaaa\x01\x01\x01\xdf\xff\xff\xff\xff",  # ... a map
        b"\xc6\xff\xff\xff\xff",
        b"\x91" * MAX_MESSAGE_BYTES,  # nesting as deep as it goes
        b"\x9b\x01" + b"\x91" * 60_000,
        b"\x81\x01" * 30_000,
    ],
)
def test_claimed_sizes_and_depths_cost_nothing(data: bytes) -> None:
    for decode in DECODERS:
        with pytest.raises(DecodeError):
            decode(data)


# --- video ----------------------------------------------------------------------------------------

VIDEO = VideoMessage(
    version=1,
    t_utc_s=1.7e9,
    t_sigma_s=0.5,
    frame=12,
    width=320,
    height=256,
    jpeg=b"\xff\xd8\xff\xd9",
    lens=LensMessage(640, 512, 600.0, 600.0, 320.0, 256.0, "radtan", (-0.25, 0.125, 0.0, 0.0)),
    position_m=(1.0, 2.0, -3.0),
    quaternion_wxyz=(0.5, 0.5, 0.5, 0.5),
)


def test_the_bytes_of_a_video_message_are_pinned():
    fields = [
        1, 1.7e9, 0.5, 12, 320, 256, b"\xff\xd8\xff\xd9",
        [640, 512, 600.0, 600.0, 320.0, 256.0, "radtan", [-0.25, 0.125, 0.0, 0.0]],
        [1.0, 2.0, -3.0], [0.5, 0.5, 0.5, 0.5],
    ]  # fmt: skip
    data = codec.encode(VIDEO)
    assert msgpack.unpackb(data) == fields
    assert data == msgpack.packb(fields)
    assert data.hex() == VIDEO_BYTES
    assert codec.decode(VideoMessage, data) == VIDEO


def test_a_lens_comes_back_as_the_camera_it_was():
    camera = camera_from(VIDEO.lens)
    assert (camera.width, camera.fx, camera.cy) == (640, 600.0, 256.0)
    assert lens_message(camera) == VIDEO.lens


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"jpeg": bytes(MAX_JPEG + 1)}, "jpeg"),
        ({"width": 0}, "width"),
        ({"t_utc_s": math.nan}, "video"),
        ({"quaternion_wxyz": (1.0, 1.0, 0.0, 0.0)}, "unit quaternion"),
        ({"lens": msgspec.structs.replace(VIDEO.lens, fx=0.0)}, "focal lengths"),
        ({"lens": msgspec.structs.replace(VIDEO.lens, coefficients=(0.1,))}, "coefficients"),
        ({"lens": LensMessage(640, 512, 200.0, 200.0, 3195.0, 256.0, "equidistant", (0.0,) * 4)}, "cx, cy"),
    ],
)
def test_a_video_message_that_cannot_be_is_not_sent(changes, says):
    with pytest.raises(ValueError, match=says):
        codec.encode(msgspec.structs.replace(VIDEO, **changes))


def test_the_largest_picture_fits_into_a_message():
    largest = msgspec.structs.replace(
        VIDEO,
        jpeg=bytes(MAX_JPEG),
        lens=msgspec.structs.replace(VIDEO.lens, coefficients=(0.1,) * 8),
    )
    assert len(codec.encode(largest)) <= MAX_MESSAGE_BYTES
