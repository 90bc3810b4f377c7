"""OPEN_DRONE_ID_* as claims in the team frame."""

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.remote_id import BASIC_ID, LOCATION, RemoteIdReader
from swarmtrack.geometry.geodesy import Geodetic, from_ned

ORIGIN = Geodetic.from_degrees(47.0, 8.0, 400.0)
ADDRESS = b"\x01\x02\x03".ljust(20, b"\0")


def location(address=ADDRESS, place=(30.0, -40.0, -20.0), **changed):
    at = from_ned(np.array(place), ORIGIN)
    fields = {
        "target_system": 0, "target_component": 0, "id_or_mac": list(address), "status": 2, "direction": 9000,
        "speed_horizontal": 250, "speed_vertical": 50, "latitude": round(1e7 * np.degrees(at.latitude)),
        "longitude": round(1e7 * np.degrees(at.longitude)), "altitude_barometric": -1000.0, "altitude_geodetic": 468.0,
        "height_reference": 0, "height": 20.0, "horizontal_accuracy": 11, "vertical_accuracy": 4,
        "barometer_accuracy": 0, "speed_accuracy": 3, "timestamp": 1.0, "timestamp_accuracy": 1,
    }  # fmt: skip
    return common.MAVLink_open_drone_id_location_message(**fields | changed)


def basic_id(address=ADDRESS, name=b"UAS-1"):
    return common.MAVLink_open_drone_id_basic_id_message(
        0, 0, list(address), 1, 2, list(name.ljust(20, b"\0"))
    )


@pytest.fixture
def heard():
    claims = []
    reader = RemoteIdReader(ORIGIN, claims.append)

    def hear(message):
        kind = BASIC_ID if isinstance(message, common.MAVLink_open_drone_id_basic_id_message) else LOCATION
        reader.readers[kind](5.0, message)
        return claims, reader

    return hear


def test_a_location_is_a_claim_by_the_name_of_its_sender(heard):
    heard(basic_id())
    claims, _ = heard(location())
    (claim,) = claims
    assert (claim.uas_id, claim.t) == ("UAS-1", 5.0)
    assert np.allclose(claim.position, [30.0, -40.0, -20.0], atol=0.05)
    assert np.allclose(claim.velocity, [0.0, 2.5, -0.5], atol=1e-6)
    assert (claim.position_sigma, claim.vertical_sigma) == (1.5, 5.0)


def test_a_sender_without_a_name_goes_by_its_address(heard):
    claims, _ = heard(location())
    assert claims[0].uas_id == "010203"


def test_what_this_aircraft_broadcasts_of_itself_is_no_claim(heard):
    heard(basic_id(bytes(20)))
    claims, _ = heard(location(bytes(20)))
    assert claims == []


def test_without_a_height_above_the_ground_the_one_above_the_ellipsoid_is_vague(heard):
    claims, _ = heard(location(height=-1000.0))
    assert claims[0].vertical_sigma == 50.0
    assert claims[0].position[2] == pytest.approx(-68.0, abs=0.1)


@pytest.mark.parametrize(
    "changed",
    [
        {"latitude": 0, "longitude": 0},
        {"latitude": 950_000_000},
        {"horizontal_accuracy": 0},
        {"horizontal_accuracy": 15},
        {"height": float("nan"), "altitude_geodetic": -1000.0},
    ],
)
def test_a_location_that_is_none_is_counted(heard, changed):
    claims, reader = heard(location(**changed))
    assert claims == []
    assert reader.unusable == 1


def test_unknown_speeds_are_none(heard):
    claims, _ = heard(location(speed_horizontal=25500, speed_vertical=6300, direction=36100))
    assert np.array_equal(claims[0].velocity, np.zeros(3))


def test_a_hostile_name_is_plain_text(heard):
    heard(basic_id(name=b"\x1b[2J\xff"))
    claims, _ = heard(location())
    assert "\x1b" not in claims[0].uas_id
