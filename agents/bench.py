"""`swarmtrack bench NAME`: re-make a published table, NAME.json + NAME.md + plots in the folder `--out`."""

from __future__ import annotations

import argparse
from importlib import import_module

from swarmtrack.arguments import add_commands
from swarmtrack.errors import SourceError

BENCHMARKS = {
    "all-round": (
        "swarmtrack.benchmarks.all_round",
        "names with several cameras per drone, and what seams cost them",
    ),
    "box-width": ("swarmtrack.benchmarks.box_width", "how wide a detector's boxes are beside the drones"),
    "calibration": (
        "swarmtrack.benchmarks.calibration",
        "calibrations by hand and by board, against the truth",
    ),
    "clients": (
        "swarmtrack.benchmarks.hundred_clients",
        "time until all drones know each other, up to 100 drones",
    ),
    "clips": ("swarmtrack.benchmarks.real_clips", "real drones on labelled clips, through the agent"),
    "cost": (
        "swarmtrack.benchmarks.cost",
        "what an agent, metres, a command in formation and being watched cost; or all beside another checkout",
    ),
    "detection-noise": (
        "swarmtrack.benchmarks.detection_noise",
        "how far the shipped detector's boxes are off, and which pairs it resolves",
    ),
    "detector": (
        "swarmtrack.benchmarks.detector",
        "how good a detector is on labelled images and clips",
    ),
    "endurance": (
        "swarmtrack.benchmarks.endurance.benchmark",
        "half an hour of a swarm: what grows, falls behind, is lost",
    ),
    "errand": (
        "swarmtrack.benchmarks.errands.benchmark",
        "take-off, go-tos and turns: the camera's clock, names among ghosts",
    ),
    "first-command": (
        "swarmtrack.benchmarks.first_command",
        "what `swarmtrack sim` says, how long it takes and what it costs, again and again",
    ),
    "fixed-lag": (
        "swarmtrack.benchmarks.trackers.fixed_lag",
        "what a delay of some scans is worth to a tracker's estimates",
    ),
    "flood": ("swarmtrack.benchmarks.flood", "what a member that floods does to the others"),
    "formation": (
        "swarmtrack.benchmarks.formation.benchmark",
        "flying in formation by sight, the loop closed: slots, separations, who is lost",
    ),
    "guard": (
        "swarmtrack.benchmarks.guard",
        "what an autopilot hears when its engaged agent is killed, frozen or breaks",
    ),
    "identity": (
        "swarmtrack.benchmarks.identity.layouts",
        "who is who from one look: the paper's rule and ours",
    ),
    "misconfigured": (
        "swarmtrack.benchmarks.misconfigured",
        "names when pads, compasses, mountings or starts are wrong",
    ),
    "motion": ("swarmtrack.benchmarks.motion", "who is who by how drones move alone"),
    "offset": (
        "swarmtrack.benchmarks.time_offset",
        "how well the camera's clock and the gyro's bias are estimated",
    ),
    "recognition": (
        "swarmtrack.benchmarks.identity.recognition",
        "who is who over a hundred flights, in one process",
    ),
    "recording": (
        "swarmtrack.benchmarks.recorded_flights",
        "what kill -9 costs a recording, and how fast it replays",
    ),
    "relative": (
        "swarmtrack.benchmarks.relative",
        "where teammates are in metres, and whether that is known",
    ),
    "relative-flights": (
        "swarmtrack.benchmarks.relative_flights",
        "places in metres over whole flights, with trackers and names",
    ),
    "rotation": (
        "swarmtrack.benchmarks.rotating_observer",
        "what the gyro is worth to an observer that turns",
    ),
    "scenery": (
        "swarmtrack.benchmarks.scenery",
        "what is taken for a drone among houses, poles and trees, in drawn flights",
    ),
    "seams": (
        "swarmtrack.benchmarks.seams",
        "tracks that go over from one camera of a drone to the next",
    ),
    "silent": ("swarmtrack.benchmarks.silent", "who is who with nothing on the air: by a file, by codes"),
    "soak": ("swarmtrack.benchmarks.trackers.soak", "every tracker under a million random scans"),
    "swarm": ("swarmtrack.benchmarks.swarm_runs", "whole local swarms: who knows whom, and at what cost"),
    "trackers": (
        "swarmtrack.benchmarks.trackers.benchmark",
        "every tracker: the paper's figures, and harder scenes",
    ),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_commands(parser, BENCHMARKS, dest="benchmark", metavar="NAME")


def run(args: argparse.Namespace) -> int:
    try:  # now, not when an hour of results has nowhere to go
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SourceError(
            f"--out {args.out}: {error.strerror}, expected a folder that can be made"
        ) from error
    import_module(BENCHMARKS[args.benchmark][0]).run(args)
    print((args.out / f"{args.benchmark}.md").read_text(encoding="utf-8"))
    print(f"{args.out}: {args.benchmark}.json, {args.benchmark}.md")
    return 0
