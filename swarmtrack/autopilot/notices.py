"""Messages to the ground station, through the autopilot, in the dialect."""

from __future__ import annotations

import enum
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common

from swarmtrack.geometry.geodesy import Geodetic
from swarmtrack.messages import Array
from swarmtrack.plain_text import plain

STATUSTEXT_BYTES = 50  # bytes of a STATUSTEXT
LONGEST_STATUSTEXT_BYTES = 4 * STATUSTEXT_BYTES
NAMED_VALUE_BYTES = 10  # bytes of a NAMED_VALUE_FLOAT's name
LONGEST_CALLSIGN = 8  # bytes, and a zero after them
NOT_USED = math.nan  # what the dialect asks for in fields that do not apply
# Cameras that a message can tell apart.
MOST_DEVICES = 6
# cm/s: the most that both velocities of ADSB_VEHICLE can say.
MOST_CM_S = 32767


class Severity(enum.IntEnum):
    """Severity of a STATUSTEXT. Ground stations show all, and speak warnings and worse."""

    ERROR = common.MAV_SEVERITY_ERROR
    WARNING = common.MAV_SEVERITY_WARNING
    NOTICE = common.MAV_SEVERITY_NOTICE
    INFO = common.MAV_SEVERITY_INFO


def status_text(severity: Severity, text: str, number: int) -> Iterator[Any]:
    """STATUSTEXT: one message, or several chunks that belong together by `number` (1 … 65535, another each time).

    Not every ground station expects more than ASCII, so other signs become `?`; no text from outside passes unread.
    """
    data = (
        plain(text)
        .replace("±", "+-")
        .replace("…", "...")
        .encode("ascii", "replace")[:LONGEST_STATUSTEXT_BYTES]
    )
    if len(data) <= STATUSTEXT_BYTES:
        yield common.MAVLink_statustext_message(severity, data)
        return
    # The last chunk is the first that is not full: a text that fills its last one needs an empty one after it.
    for index, start in enumerate(range(0, len(data) + 1, STATUSTEXT_BYTES)):
        chunk = data[start : start + STATUSTEXT_BYTES]
        yield common.MAVLink_statustext_message(severity, chunk, id=number, chunk_seq=index)


def named_value(now: float, name: str, value: float) -> Any:
    """NAMED_VALUE_FLOAT; now [s]: of our clock, which counts from this computer's boot as the message wants it."""
    return common.MAVLink_named_value_float_message(
        int(now * 1e3) % 2**32, name.encode("ascii")[:NAMED_VALUE_BYTES], value
    )


def adsb_vehicle(
    callsign: str, place: Geodetic, age: float, address: int, velocity: Array | None = None
) -> Any:
    """ADSB_VEHICLE: position with its height above mean sea level; age [s] of it; address: 24 bits, constant per
    vehicle.

    velocity (3,) m/s north, east, down over the ground; None: sent without velocity and course, and flagged so.
    """
    north, east, down = (0.0, 0.0, 0.0) if velocity is None else velocity.tolist()
    moving = (
        common.ADSB_FLAGS_VALID_HEADING
        | common.ADSB_FLAGS_VALID_VELOCITY
        | common.ADSB_FLAGS_VERTICAL_VELOCITY_VALID
    )
    return common.MAVLink_adsb_vehicle_message(
        ICAO_address=address,
        lat=round(1e7 * math.degrees(place.latitude)),
        lon=round(1e7 * math.degrees(place.longitude)),
        altitude_type=common.ADSB_ALTITUDE_TYPE_GEOMETRIC,
        altitude=round(1e3 * place.height),
        heading=round(1e2 * math.degrees(math.atan2(east, north))) % 36000,
        hor_velocity=min(round(1e2 * math.hypot(north, east)), MOST_CM_S),
        ver_velocity=min(max(round(-1e2 * down), -MOST_CM_S), MOST_CM_S),
        callsign=callsign.encode("ascii")[:LONGEST_CALLSIGN],
        emitter_type=common.ADSB_EMITTER_TYPE_UAV,
        tslc=min(round(age), 255),
        flags=common.ADSB_FLAGS_VALID_COORDS
        | common.ADSB_FLAGS_VALID_ALTITUDE
        | common.ADSB_FLAGS_VALID_CALLSIGN
        | (0 if velocity is None else moving),
        squawk=0,
    )


def image_status(corners: Array | None, device: int = 0) -> Any:
    """CAMERA_TRACKING_IMAGE_STATUS: a box as its top left and bottom right corner, (2, 2) as shares of width and
    height; None: nothing is tracked. device: number of a camera that is not a MAVLink component, 1 …
    MOST_DEVICES; 0: the only one.
    """
    if corners is None:
        return common.MAVLink_camera_tracking_image_status_message(
            common.CAMERA_TRACKING_STATUS_FLAGS_IDLE,
            common.CAMERA_TRACKING_MODE_NONE,
            common.CAMERA_TRACKING_TARGET_DATA_IN_STATUS,
            *[NOT_USED] * 7,
            camera_device_id=device,
        )
    left, top, right, bottom = np.clip(corners, 0.0, 1.0).ravel().tolist()
    return common.MAVLink_camera_tracking_image_status_message(
        common.CAMERA_TRACKING_STATUS_FLAGS_ACTIVE,
        common.CAMERA_TRACKING_MODE_RECTANGLE,
        common.CAMERA_TRACKING_TARGET_DATA_IN_STATUS,
        *[NOT_USED] * 3,  # point and radius, of the other mode
        left,
        top,
        right,
        bottom,
        camera_device_id=device,
    )
