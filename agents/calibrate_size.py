"""`swarmtrack calibrate size`: how wide a detector's boxes are, relative to the drones, from a recorded flight."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from typing import TYPE_CHECKING, Any

from swarmtrack.arguments import add_action, add_file, add_flag, positive

if TYPE_CHECKING:
    from swarmtrack.calibration.box_width import WidthFit

DONE = 0
# Smaller errors than these are those of one flight, with one kind of drone in one light.
MODEST = ("drone_sigma", "wander_sigma", "white_sigma")


def add_size_command(steps: Any) -> None:
    size = add_action(
        steps,
        "size",
        "width of the detector's boxes relative to the drones, from a recorded flight",
        description="Width of the detector's boxes relative to the drones. Do this for a model of your own: the size "
        "of a box then gives a range. Fly two or more drones, at short and at long range, and record on all of them. "
        "Their positions come from their recordings and reports, or from the truth of a simulation. "
        "Prints the lines for the config. Exit code 0: good. 2: too little data, with what is missing.",
    )
    add_file(size, "recordings", "recordings of one flight", metavar="FILE|DIR", nargs="+")
    size.add_argument(
        "--span",
        type=positive,
        metavar="M",
        help="width of the drones, from the outer rim of one rotor disc to that of its neighbour (default: from "
        "their configs)",
    )
    add_flag(size, "--json", "print JSON")


def run(args: argparse.Namespace) -> int:
    from swarmtrack.calibration.box_width import fit_box_width
    from swarmtrack.errors import CalibrationError, SourceError
    from swarmtrack.recording.reader import recordings_below
    from swarmtrack.replay.flight_widths import FlightWidths

    recordings = [recording for path in args.recordings for recording in recordings_below(path)]
    flight = FlightWidths(recordings, args.span)
    if not flight.observers:
        raise SourceError("found no drone's recording, expected those of a flight of two drones or more")
    if flight.span is None:
        raise SourceError(
            "the width of the drones is missing: found no [team] airframe_span_m in their configs, expected it or "
            "--span"
        )
    try:
        found = fit_box_width(flight.widths())
    except CalibrationError:
        for why, many in flight.skipped.most_common():
            print(f"{many} left out: {why}", file=sys.stderr)
        raise
    if args.json:
        print(json.dumps(_record(found, flight.skipped), indent=1))
    else:
        _say(found, flight.skipped)
    return DONE


def lines(found: WidthFit) -> list[str]:
    """For the config. What one flight shows of errors is not all that there is: they are no smaller than usual."""
    from swarmtrack.relative.box_width import BoxWidth

    usual = BoxWidth()
    values = dataclasses.asdict(found.width)
    for name in MODEST:
        values[name] = max(values[name], getattr(usual, name))
    return ["[detector.box_width]", *(f"{name} = {value:g}" for name, value in values.items())]


def _record(found: WidthFit, skipped: dict[str, int]) -> dict[str, Any]:
    return {
        **dataclasses.asdict(found.width),
        "boxes": found.boxes,
        "drones": found.drones,
        "padding_measured": found.padded,
        "drone_sigma_measured": found.drones_told,
        "left_out": dict(skipped),
        "toml": lines(found),
    }


def _say(found: WidthFit, skipped: dict[str, int]) -> None:
    width = found.width
    print(f"boxes      {found.boxes}, of {found.drones} pairs of drones")
    print(f"width      {width.factor:.3f} spans + {width.padding_px:.1f} px")
    if not found.padded:
        print("           the padding is unknown: the range between the drones hardly changed")
    print(
        f"errors     {width.drone_sigma:.0%} from drone to drone{'' if found.drones_told else ' (as usual: too few)'}, "
        f"{width.wander_sigma:.0%} within {width.wander_s:g} s, {width.white_sigma:.0%} from frame to frame"
    )
    for why, many in sorted(skipped.items()):
        print(f"left out   {many}: {why}")
    print()
    print("For the config; errors are stated no smaller than those of the shipped detector on real drones:")
    print()
    for line in lines(found):
        print(line)
