"""`swarmtrack mission`: what autopilots are to fly, as files for whoever streams set points to them."""

from __future__ import annotations

import argparse
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from swarmtrack.arguments import add_action, add_file, count, positive, with_pages
from swarmtrack.errors import SourceError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from swarmtrack.messages import Array

ABOUT = """\
A drone's code: it sways up and down by 25 cm for 8 s, with a frequency given by its ID. Teammates that see it
identify it without any message (docs/silent.md). The file holds set points for each drone, relative to the position
where it hovers; the program that streams them adds that position.

  FILE.csv    id, t_s, north_m, east_m, down_m and the velocity. `[team] plan` can read it, too.
  FILE.json   fields of MAVLink's SET_POSITION_TARGET_LOCAL_NED, with frame and type_mask.

ArduPilot   GUIDED mode. Stream position and velocity. WPNAV_ACCEL_Z (100 cm/s² by default) must be 400 or more, or
            the quick codes are flown too small.
PX4         OFFBOARD mode. Stream the hover position for a second, then the set points, then that position again.
Missions    A mission of way points (QGC WPL) cannot fly it: way points have no times.
"""
EXAMPLE = """\
for example:
  swarmtrack mission sway 1 2 3 --out sway.csv
  swarmtrack mission sway 1 2 3 --begins 2026-05-01T10:00:00Z --out sway.json
"""
# Of POSITION_TARGET_TYPEMASK: yaw and its rate are the pilot's.
YAW_IS_NOT_TOLD = 1024 | 2048
MAV_FRAME_LOCAL_NED = 1
VELOCITY = ("north_m_s", "east_m_s", "down_m_s")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    sway = add_action(
        actions,
        "sway",
        "set points of the codes by which teammates recognise each other without messages",
        description=with_pages(ABOUT),
        epilog=EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    sway.add_argument("ids", type=count, nargs="+", metavar="ID", help="the IDs of the whole team")
    add_file(sway, "--out", "the file to write: .csv or .json", required=True)
    sway.add_argument(
        "--hz",
        type=positive,
        default=20.0,
        metavar="HZ",
        help="set points per second (default: %(default)g)",
    )
    sway.add_argument(
        "--begins",
        type=_utc,
        metavar="UTC",
        help="start, such as 2026-05-01T10:00:00Z, rounded up to the next full 10 s "
        "(default: left to the pilot's switch)",
    )


def run(args: argparse.Namespace) -> int:
    """Raises SwarmtrackError."""
    from swarmtrack.motion.sway import next_begin

    team = sorted(args.ids)
    twice = [drone_id for drone_id in team if team.count(drone_id) > 1]
    if twice or team[-1] > 65535:
        raise SourceError(f"ID: found {(twice or team)[-1]}, expected each of 1 to 65535 once")
    begins = None if args.begins is None else datetime.fromtimestamp(next_begin(args.begins), UTC)
    points = {drone_id: _set_points(drone_id, team, args.hz) for drone_id in team}
    if args.out.suffix not in (".csv", ".json"):
        raise SourceError(f"--out {args.out}: found {args.out.suffix or 'no ending'}, expected .csv or .json")
    try:
        if args.out.suffix == ".csv":
            _write_csv(args.out, points)
        else:
            _write_json(args.out, points, begins)
    except OSError as error:
        raise SourceError(
            f"--out {args.out}: {error.strerror}, expected a file that can be written"
        ) from error
    print(f"{args.out}: the codes of drones {', '.join(map(str, team))}")
    if begins is not None:
        print(f"in the team's config: [team] code = {{ begins = [{begins:%Y-%m-%dT%H:%M:%SZ}] }}")
    return 0


def _set_points(drone_id: int, team: Sequence[int], hz: float) -> list[tuple[float, Array]]:
    """t [s] from the beginning, and the derivatives (4, 3) of the way; the first and the last at rest."""
    from swarmtrack.motion.priors import SWAY_LASTS_S
    from swarmtrack.motion.sway import sway

    n = round(SWAY_LASTS_S * hz)
    return [(k * SWAY_LASTS_S / n, sway(drone_id, team, k * SWAY_LASTS_S / n)) for k in range(n + 1)]


def _write_csv(path: Path, points: dict[int, list[tuple[float, Array]]]) -> None:
    from swarmtrack.config.trajectories import write_trajectories

    rows = ((drone_id, t, *flat[0], *flat[1]) for drone_id, own in points.items() for t, flat in own)
    write_trajectories(path, rows, VELOCITY)


def _write_json(path: Path, points: dict[int, list[tuple[float, Array]]], begins: datetime | None) -> None:
    names = ("x", "y", "z", "vx", "vy", "vz", "afx", "afy", "afz")

    def set_point(t: float, flat: Array) -> dict[str, Any]:
        values = (round(value, 5) + 0.0 for value in flat[:3].ravel().tolist())
        return {"t_s": round(t, 4), **dict(zip(names, values, strict=True))}

    document = {
        "message": "SET_POSITION_TARGET_LOCAL_NED",
        "coordinate_frame": MAV_FRAME_LOCAL_NED,
        "type_mask": YAW_IS_NOT_TOLD,
        "begins_utc": None if begins is None else begins.isoformat(),
        "added_to_x_y_z": "the position where the drone hovers",
        "drones": {drone_id: [set_point(*point) for point in own] for drone_id, own in points.items()},
    }
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def _utc(text: str) -> float:
    """For `type=`: seconds since 1970."""
    try:
        when = datetime.fromisoformat(text)
    except ValueError:
        when = None
    if when is None or when.tzinfo is None:
        raise argparse.ArgumentTypeError(f"found {text}, expected a time such as 2026-05-01T10:00:00Z")
    return when.timestamp()
