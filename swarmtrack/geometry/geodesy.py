"""Geodetic positions in a team's frame: WGS-84 latitude, longitude and height to north, east, down of an origin.

Exact, through Earth-centred coordinates, so it holds at every latitude and distance. Heights may be above the
ellipsoid or above mean sea level, as long as the origin's is of the same kind: over the kilometres of a team the geoid
is a plane, tilted by a tenth of a metre per kilometre at most, the same for all drones.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarmtrack.messages import Array

# Standard gravity (CGPM 1901).
STANDARD_GRAVITY_M_S2 = 9.80665
EARTH_SEMI_MAJOR_M = 6_378_137.0  # m, WGS-84
EARTH_FLATTENING = 1.0 / 298.257223563
ECCENTRICITY_SQUARED = EARTH_FLATTENING * (2.0 - EARTH_FLATTENING)
CONVERGED = 1e-12  # rad of latitude: 6 µm on the ground


class Geodetic(NamedTuple):
    """Geodetic latitude and longitude [rad], height [m]."""

    latitude: float
    longitude: float
    height: float

    @classmethod
    def from_degrees(cls, latitude_deg: float, longitude_deg: float, height: float) -> Geodetic:
        return cls(math.radians(latitude_deg), math.radians(longitude_deg), height)


def to_ecef(place: Geodetic) -> Array:
    """Earth-centred, Earth-fixed coordinates (3,) m: x to 0° N 0° E, z to the north pole."""
    sin, cos = math.sin(place.latitude), math.cos(place.latitude)
    radius = EARTH_SEMI_MAJOR_M / math.sqrt(1.0 - ECCENTRICITY_SQUARED * sin**2)  # of curvature, east to west
    out = (radius + place.height) * cos
    return np.array(
        (
            out * math.cos(place.longitude),
            out * math.sin(place.longitude),
            (radius * (1.0 - ECCENTRICITY_SQUARED) + place.height) * sin,
        )
    )


def ecef_from_ned(origin: Geodetic) -> Array:
    """(3, 3): north, east and down at the origin as columns, in Earth-centred axes."""
    sin_lat, cos_lat = math.sin(origin.latitude), math.cos(origin.latitude)
    sin_lon, cos_lon = math.sin(origin.longitude), math.cos(origin.longitude)
    north = (-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat)
    east = (-sin_lon, cos_lon, 0.0)
    down = (-cos_lat * cos_lon, -cos_lat * sin_lon, -sin_lat)
    return np.array((north, east, down)).T


def to_ned(place: Geodetic, origin: Geodetic) -> Array:
    """Position (3,) m north, east, down of `place` in the level frame at `origin`."""
    return np.asarray((to_ecef(place) - to_ecef(origin)) @ ecef_from_ned(origin))


def from_ned(position: Array, origin: Geodetic) -> Geodetic:
    """Geodetic position of `position` (3,) m north, east, down of `origin`."""
    x, y, z = (to_ecef(origin) + ecef_from_ned(origin) @ position).tolist()
    out = math.hypot(x, y)
    # The latitude of a point on the ellipsoid, then corrected for height until it no longer moves: the error shrinks
    # to e² = 0.7 % of itself at each step.
    latitude = math.atan2(z, out * (1.0 - ECCENTRICITY_SQUARED))
    while True:
        sin = math.sin(latitude)
        radius = EARTH_SEMI_MAJOR_M / math.sqrt(1.0 - ECCENTRICITY_SQUARED * sin**2)
        better = math.atan2(z + ECCENTRICITY_SQUARED * radius * sin, out)
        if abs(better - latitude) < CONVERGED:
            break
        latitude = better
    # Along the normal: well conditioned at the poles and at the equator alike.
    sin, cos = math.sin(better), math.cos(better)
    height = out * cos + z * sin - EARTH_SEMI_MAJOR_M * math.sqrt(1.0 - ECCENTRICITY_SQUARED * sin**2)
    return Geodetic(better, math.atan2(y, x), height)
