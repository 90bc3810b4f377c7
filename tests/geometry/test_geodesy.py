"""Places on the Earth in a team's frame, against published numbers and against another way to compute them."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmtrack.geometry.geodesy import Geodetic, ecef_from_ned, from_ned, to_ecef, to_ned

EQUATOR_RADIUS, POLE_RADIUS = 6_378_137.0, 6_356_752.314245  # m, WGS-84: NIMA TR8350.2
places = st.builds(
    Geodetic.from_degrees,
    st.floats(-90.0, 90.0),
    st.floats(-180.0, 180.0),
    st.floats(-400.0, 9000.0),
)
origins = st.builds(
    Geodetic.from_degrees, st.floats(-89.0, 89.0), st.floats(-180.0, 180.0), st.floats(-400.0, 9000.0)
)
nearby = st.tuples(st.floats(-7e3, 7e3), st.floats(-7e3, 7e3), st.floats(-2e3, 2e3)).map(np.array)


@pytest.mark.parametrize(
    ("latitude", "longitude", "height", "expected"),
    [
        (0.0, 0.0, 0.0, (EQUATOR_RADIUS, 0.0, 0.0)),
        (0.0, 90.0, 100.0, (0.0, EQUATOR_RADIUS + 100.0, 0.0)),
        (90.0, 0.0, 0.0, (0.0, 0.0, POLE_RADIUS)),
        (-90.0, 17.0, 50.0, (0.0, 0.0, -POLE_RADIUS - 50.0)),
        # The worked example of the aerospace toolboxes: 42° N, 82° W, 200 m.
        (42.0, -82.0, 200.0, (660_675.2518247, -4_700_948.68316, 4_245_737.66222)),
    ],
)
def test_known_places_have_their_published_earth_centred_coordinates(latitude, longitude, height, expected):
    found = to_ecef(Geodetic.from_degrees(latitude, longitude, height))
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_minute_of_arc_is_as_long_as_the_tables_say():
    """At 45° N: 1852.2 m to the north (1 nautical mile there), 1315.1 m to the east; by series, not by our formulas."""
    origin = Geodetic.from_degrees(45.0, 7.0, 0.0)
    lat = math.radians(45.0)
    north = (111_132.954 - 559.822 * math.cos(2 * lat) + 1.175 * math.cos(4 * lat)) / 60
    east = (111_412.84 * math.cos(lat) - 93.5 * math.cos(3 * lat) + 0.118 * math.cos(5 * lat)) / 60
    half = 0.5 / 60
    up = to_ned(Geodetic.from_degrees(45.0 + half, 7.0, 0.0), origin)
    down = to_ned(Geodetic.from_degrees(45.0 - half, 7.0, 0.0), origin)
    assert (up - down)[0] == pytest.approx(north, abs=0.02)
    right = to_ned(Geodetic.from_degrees(45.0, 7.0 + half, 0.0), origin)
    left = to_ned(Geodetic.from_degrees(45.0, 7.0 - half, 0.0), origin)
    assert (right - left)[1] == pytest.approx(east, abs=0.02)


@given(origin=origins, position=nearby)
def test_within_ten_kilometres_there_and_back_is_exact_to_a_tenth_of_a_millimetre(origin, position):
    np.testing.assert_allclose(to_ned(from_ned(position, origin), origin), position, atol=1e-4)


@given(place=places)
def test_the_origin_is_at_zero_and_higher_is_up(place):
    np.testing.assert_allclose(to_ned(place, place), 0.0, atol=1e-9)
    above = Geodetic(place.latitude, place.longitude, place.height + 12.5)
    np.testing.assert_allclose(to_ned(above, place), (0.0, 0.0, -12.5), atol=1e-8)


@given(origin=places)
def test_north_east_and_down_are_a_right_handed_frame(origin):
    axes = ecef_from_ned(origin)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)


def test_the_date_line_is_no_border():
    origin = Geodetic.from_degrees(10.0, 179.99999, 0.0)
    north, east, _ = to_ned(Geodetic.from_degrees(10.0, -179.99999, 0.0), origin)
    assert (north, east) == pytest.approx((0.0, 2e-5 * 109_639.0), abs=0.01)  # m per degree at 10°
