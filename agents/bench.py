"""`swarmtrack bench NAME`: re-make a published table, NAME.json + NAME.md + plots in the folder `--out`."""

from __future__ import annotations

import argparse
from importlib import import_module

from swarmtrack.arguments import add_commands
from swarmtrack.errors import SourceError

BENCHMARKS = {
    "all-round": (
        "swarmtrack.benchmarks.all_round",
        "names with several cameras per drone, and errors at seams",
    ),
    "box-width": (
        "swarmtrack.benchmarks.box_width",
        "how wide a detector's boxes are, relative to the drones",
    ),
    "calibration": (
        "swarmtrack.benchmarks.calibration",
        "errors of calibrations by hand and by board",
    ),
    "carried": (
        "swarmtrack.benchmarks.carried",
        "own place by teammates: without a position, with one that drifts or is spoofed, with a liar",
    ),
    "clients": (
        "swarmtrack.benchmarks.hundred_clients",
        "time until all announcements are known, up to 100 drones",
    ),
    "clips": ("swarmtrack.benchmarks.real_clips", "real drones on labelled clips, tracked by the agent"),
    "cost": (
        "swarmtrack.benchmarks.cost",
        "cost of an agent, metres, formation commands and the monitor; or of everything, against another checkout",
    ),
    "detection-noise": (
        "swarmtrack.benchmarks.detection_noise",
        "errors of the shipped detector's boxes, and which pairs of drones it separates",
    ),
    "detector": (
        "swarmtrack.benchmarks.detector",
        "quality of a detector on labelled images and clips",
    ),
    "endurance": (
        "swarmtrack.benchmarks.endurance.benchmark",
        "half an hour of a swarm: memory, delays and losses",
    ),
    "errand": (
        "swarmtrack.benchmarks.errands.benchmark",
        "take-off, go-tos and turns: the camera's time offset, and names despite ghosts",
    ),
    "first-command": (
        "swarmtrack.benchmarks.first_command",
        "verdicts, duration and cost of `swarmtrack sim`, over repeated runs",
    ),
    "fixed-lag": (
        "swarmtrack.benchmarks.trackers.fixed_lag",
        "how much a lag of a few scans improves a tracker's estimates",
    ),
    "flood": ("swarmtrack.benchmarks.flood", "effects of a flooding member on its teammates"),
    "formation": (
        "swarmtrack.benchmarks.formation.benchmark",
        "formation flight by sight in closed loop: slot errors, separations, lost followers",
    ),
    "guard": (
        "swarmtrack.benchmarks.guard",
        "what an autopilot receives when its engaged agent is killed, freezes or crashes",
    ),
    "identity": (
        "swarmtrack.benchmarks.identity.layouts",
        "identification from a single scan: the paper's rule and ours",
    ),
    "misconfigured": (
        "swarmtrack.benchmarks.misconfigured",
        "names when pads, compasses, mountings or starts differ from the config",
    ),
    "motion": ("swarmtrack.benchmarks.motion", "identification by motion alone"),
    "offset": (
        "swarmtrack.benchmarks.time_offset",
        "errors of the estimated camera time offset and gyro bias",
    ),
    "recognition": (
        "swarmtrack.benchmarks.identity.recognition",
        "identification over a hundred flights, in one process",
    ),
    "recording": (
        "swarmtrack.benchmarks.recorded_flights",
        "what a recording loses by kill -9, and how fast it replays",
    ),
    "relative": (
        "swarmtrack.benchmarks.relative",
        "errors of relative states in metres, and their consistency",
    ),
    "relative-flights": (
        "swarmtrack.benchmarks.relative_flights",
        "relative states in metres over whole flights, with trackers and names",
    ),
    "rotation": (
        "swarmtrack.benchmarks.rotating_observer",
        "benefit of the gyro for a turning observer",
    ),
    "scale": (
        "swarmtrack.benchmarks.scale",
        "what a scan costs in teams of 3 to 100, by rooms, and their names",
    ),
    "strangers": (
        "swarmtrack.benchmarks.strangers",
        "where a team finds strangers, and what it makes of claims by Remote ID",
    ),
    "scenery": (
        "swarmtrack.benchmarks.scenery",
        "false detections among houses, poles and trees, in rendered flights",
    ),
    "mot": (
        "swarmtrack.benchmarks.mot",
        "our trackers and those of others: HOTA, IDF1, MOTA, switches",
    ),
    "seams": (
        "swarmtrack.benchmarks.seams",
        "handover of tracks between the cameras of a drone",
    ),
    "silent": ("swarmtrack.benchmarks.silent", "identification without messages: from a file, from codes"),
    "soak": ("swarmtrack.benchmarks.trackers.soak", "every tracker under a million random scans"),
    "swarm": (
        "swarmtrack.benchmarks.swarm_runs",
        "whole local swarms: names, and the cost of an agent",
    ),
    "trackers": (
        "swarmtrack.benchmarks.trackers.benchmark",
        "every tracker: the paper's figures, and harder scenes",
    ),
    "visual-gyro": (
        "swarmtrack.benchmarks.visual_gyro",
        "the camera's rotation by its images: error, cost, and tracks without a gyro",
    ),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_commands(parser, BENCHMARKS, dest="benchmark", metavar="NAME", of="BENCH")


def run(args: argparse.Namespace) -> int:
    try:  # now, not when an hour of results has nowhere to go
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SourceError(
            f"--out {args.out}: {error.strerror}, expected a folder that can be made"
        ) from error
    import_module(BENCHMARKS[args.benchmark][0]).BENCH.run(args)
    print((args.out / f"{args.benchmark}.md").read_text(encoding="utf-8"))
    print(f"{args.out}: {args.benchmark}.json, {args.benchmark}.md")
    return 0
