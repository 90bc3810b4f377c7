"""Findings of a flight as sentences for health, log and console: news of the team, of starts, headings and cameras.

People count cameras from 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from swarmtrack.cameras.picture_turn import MountingNews
from swarmtrack.cameras.seams import SeamNews
from swarmtrack.carried.own_place import CarriedNews
from swarmtrack.diagnosis.readiness import SELF_DOUBT
from swarmtrack.geometry import rotation
from swarmtrack.identity.consensus import Disagreement
from swarmtrack.identity.news import Astray
from swarmtrack.messages import (
    Announcement,
    AnnouncementRequested,
    DoubtNews,
    HeadingNews,
    IdClash,
    LeapNews,
    MotionReport,
    OwnFault,
    PeerArrived,
    PeerDeparted,
    PeerEvent,
    PeerExpelled,
    RangeReport,
    RelativeState,
    SightingReport,
    StrangerReport,
)
from swarmtrack.motion.ground_heights import GroundHeightNews
from swarmtrack.outputs.teammates_on_earth import worst_sigma
from swarmtrack.relative.frames import FrameNews
from swarmtrack.relative.range_watch import RangeNews
from swarmtrack.strangers.claims import RemoteIdNews

COMPASS_POINTS = ("north", "northeast", "east", "southeast", "south", "southwest", "west", "northwest")
COMPASS_INITIALS = ("N", "NE", "E", "SE", "S", "SW", "W", "NW")

News = (
    PeerEvent
    | HeadingNews
    | LeapNews
    | GroundHeightNews
    | Astray
    | FrameNews
    | RangeNews
    | DoubtNews
    | Disagreement
    | SeamNews
    | MountingNews
    | RemoteIdNews
    | CarriedNews
)


def place_in_words(state: RelativeState) -> str:
    """`drone 2: 85 m NE, 10 m up, ±1 m`: from this drone, in team axes; empty where the distance is only a guess."""
    north, east, down = state.position.tolist()
    sigma = worst_sigma(state.cov[:3, :3])
    if not sigma < math.hypot(north, east, down):
        return ""
    side = round(math.atan2(east, north) / (math.pi / 4.0)) % 8
    height = f"{abs(down):.0f} m {'down' if down > 0.0 else 'up'}"
    ahead = f"{math.hypot(north, east):.0f} m {COMPASS_INITIALS[side]}"
    return f"drone {state.drone_id}: {ahead}, {height}, ±{math.ceil(sigma)} m"


def held_in_words(by: Sequence[int], sigma_m: float) -> str:
    """`held by 1 and 3, ±0.4 m`: on whom the position of a drone rests that its teammates carry."""
    if not by:
        return f"held by nobody, ±{sigma_m:.0f} m and growing: only what is relative counts"
    *others, last = map(str, by)
    who = f"{', '.join(others)} and {last}" if others else last
    return f"held by {who}, ±{sigma_m:.1f} m"


def fault_in_words(fault: OwnFault) -> str:
    """What is probably wrong with this drone's own pose, and by how much."""
    match fault:
        case OwnFault(heading=float(heading)):
            return f"our heading is off by about {abs(math.degrees(heading)):.0f}°"
        case OwnFault(start=(north, east)):
            side = COMPASS_POINTS[round(math.atan2(east, north) / (math.pi / 4.0)) % 8]
            return f"we started about {math.hypot(north, east):.1f} m {side} of the stated start"
        case _:
            return f"we stand where drone {fault.pad_of} is stated to start"


def warning(event: object) -> str:
    """What people are warned of; empty for what goes as it should."""
    if not isinstance(event, News) or (isinstance(event, HeadingNews) and not event.doubt):
        return ""
    return describe(event)


def teammate_carried_in_words(drone_id: int, leans_on: Sequence[int]) -> str:
    """`drone 1 has no position of its own: held by 2 and 3`, or that it has one again."""
    if not leans_on:
        return f"drone {drone_id} has a position of its own again"
    return f"drone {drone_id} has no position of its own: held by {' and '.join(map(str, leans_on))}"


def describe(news: News) -> str:
    match news:
        case HeadingNews():
            return _describe_heading(news)
        case LeapNews() | DoubtNews() | CarriedNews():
            return _describe_own_place(news)
        case GroundHeightNews():
            side = "above" if news.above_m > 0.0 else "below"
            return (
                f"drone {news.drone_id} is announced {abs(news.above_m):.0f} m {side} us, and we stand on the ground: "
                "if it stands there too, one of the two receivers reports heights above the ellipsoid for those above "
                "the sea: compare GPS_RAW_INT.alt, and set up the one that is wrong (ArduPilot: GPS_DRV_OPTIONS)"
            )
        case Astray(miss_m=None):
            return (
                f"track {news.track_id} does not move as drone {news.drone_id} reports: it has lost that name"
            )
        case Astray():
            return (
                f"drone {news.drone_id} moves like track {news.track_id}, {news.miss_m:.1f} m from its stated "
                "position: its start or our heading is wrong, and its name follows the motion"
            )
        case FrameNews(off_m=None):
            return f"drone {news.drone_id}'s start fits what we see again"
        case FrameNews():
            return (
                f"drone {news.drone_id}'s start is {news.off_m:.1f} m and {abs(math.degrees(news.turn)):.0f}° off, or "
                "ours is: its reports are turned and shifted into our frame"
            )
        case RangeNews(drone_id=drone_id, distance=distance):
            radio = f"the distance to drone {drone_id} by our ranging radio"
            if distance is None:
                return f"{radio} fits what we see again"
            return f"{radio}, {distance:.1f} m, does not fit what we see and is not used: is it set up for that drone?"
        case Disagreement():
            return (
                f"drone {news.observer} and we see drone {news.drone_id} in different places "
                f"({news.miss_m:.1f} m apart)"
            )
        case RemoteIdNews(number=None, off_m=off_m):
            where = "nothing is there" if math.isnan(off_m) else f"its drone is {off_m:.0f} m away"
            return f"the Remote ID of {news.uas_id!r} is false: {where}"
        case RemoteIdNews():
            return f"stranger {news.number} is {news.uas_id!r} by Remote ID"
        case SeamNews():
            return _describe_seam(news)
        case MountingNews():
            return _describe_mounting(news)
        case _:
            return _describe_peer(news)


def _describe_own_place(news: LeapNews | DoubtNews | CarriedNews) -> str:
    match news:
        case LeapNews(off_m=off_m):
            return f"our autopilot's position jumped by {off_m:.1f} m, which was not flown: we go on from where we were"
        case DoubtNews(doubted=True, fault=fault):
            likely = f" ({fault_in_words(fault)})" if fault else ""
            return f"{SELF_DOUBT}{likely}: until they agree, we announce our position as unknown"
        case DoubtNews():
            return "our start and heading fit what we see again: announced again"
        case CarriedNews(by=None):
            return "our autopilot's position counts again"
        case CarriedNews():
            of_autopilot = "has none" if news.off_m is None else f"is {news.off_m:.1f} m off"
            return f"our position: our autopilot {of_autopilot}, {held_in_words(news.by or (), news.sigma_m)}"


def _describe_heading(news: HeadingNews) -> str:
    match news:
        case HeadingNews(step=step, doubt=doubt) if step and doubt:
            return (
                f"our heading was reset by {math.degrees(step):+.1f}° against the gyro: the old one or the new one is "
                f"wrong, so until we land it counts as known to ±{math.degrees(doubt):.0f}°; announced again"
            )
        case HeadingNews(step=step) if step:
            return f"our heading stepped by {math.degrees(step):+.1f}° against the gyro: announced again"
        case HeadingNews():
            return "our heading has been aligned in flight: announced again"


def _describe_peer(event: PeerEvent) -> str:
    match event:
        case Announcement(drone_id=drone_id, boot=boot, sequence=sequence):
            again = f", number {sequence}" if sequence > 1 else ""
            return f"drone {drone_id} announced itself (boot {boot}{again})"
        case PeerArrived(drone_id=drone_id, boot=boot):
            return f"drone {drone_id} is alive (boot {boot})"
        case PeerDeparted(drone_id=drone_id, boot=boot):
            return f"drone {drone_id} is gone (boot {boot})"
        case PeerExpelled(drone_id=drone_id):
            return f"drone {drone_id} is no longer in the team's roster, its messages are ignored"
        case IdClash(drone_id=drone_id, boots=boots, ours=True):
            said = f"another agent uses our drone.id = {drone_id} (boots {', '.join(boots)})"
            return f"{said}: change drone.id of one of them"
        case IdClash(drone_id=drone_id, boots=boots):
            return (
                f"two agents use drone.id = {drone_id} (boots {', '.join(boots)}): change drone.id of one of them; "
                f"until then no track gets this ID"
            )
        case AnnouncementRequested():
            return "a teammate asked for our pose: announced again"
        case SightingReport(observer=observer):
            return f"drone {observer} reported sightings"
        case StrangerReport(observer=observer):
            return f"drone {observer} reported strangers"
        case MotionReport(drone_id=drone_id):
            return f"drone {drone_id} reported its motion"
        case RangeReport(other=other):
            return f"our ranging radio measured the range to drone {other}"


def describe_filed(announcement: Announcement) -> str:
    """The sentence for an announcement from the team file."""
    north, east, down = announcement.position
    return (
        f"drone {announcement.drone_id} starts at [{north:.1f}, {east:.1f}, {down:.1f}] m, by the team's file"
    )


def _describe_seam(news: SeamNews) -> str:
    first, second = news.first + 1, news.second + 1
    if news.turn is None or news.body_from_second is None:
        return (
            f"cameras {first} and {second} do not match: drones that leave one do not enter the other. Are "
            "their cables swapped, is one of them upside down, or is a body_from_camera wrong?"
        )
    turned = np.degrees(np.linalg.norm(news.turn.angle))
    forward = rotation.BODY_FROM_FORWARD_CAMERA
    roll, pitch, yaw = np.degrees(rotation.to_euler(news.body_from_second @ forward.T)).round(1) + 0.0
    by = f"went from one to the other {news.turn.crossings} times" if news.turn.crossings else "both show"
    return (
        f"cameras {first} and {second} are turned by {turned:.1f}° against the config, by teammates that {by}. "
        f"If camera {first} is right, rpy_deg = [{roll:g}, {pitch:g}, {yaw:g}] would fit camera {second}"
    )


def _describe_mounting(news: MountingNews) -> str:
    camera = f"camera {news.camera + 1}"
    if news.fits:
        return f"{camera} turns with the gyro again, as configured: its tracks get names again"
    if news.like is not None:
        it_is = f"as camera {news.like + 1} should: are their cables swapped?"
    else:
        it_is = "against the gyro: is it upside down, or its picture mirrored, or body_from_camera wrong?"
    return f"the picture of {camera} turns {it_is} Its tracks get no names meanwhile"
