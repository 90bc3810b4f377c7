"""`swarmtrack bench NAME`: re-make a published table, NAME.json + NAME.md + plots in the folder `--out`."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from swarmtrack.arguments import positive
from swarmtrack.errors import SourceError

DEFAULT_OUT = Path("bench")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    from swarmtrack.tracking import DEFAULT_TRACKER, TRACKERS

    names = parser.add_subparsers(dest="benchmark", required=True, metavar="NAME")
    agent = names.add_parser("agent", help="what an agent costs, beside the design's budgets")
    clips = names.add_parser("clips", help="real drones on labelled clips, through the agent")
    rotation = names.add_parser("rotation", help="what the gyro is worth to an observer that turns")
    offset = names.add_parser("offset", help="how well the camera's clock and the gyro's bias are found")
    calibration = names.add_parser("calibration", help="calibrations by hand and by board, against the truth")
    clients = names.add_parser("clients", help="how long until everybody knows everybody, to 100 drones")
    flood = names.add_parser("flood", help="a member that floods, and the others")
    identity = names.add_parser("identity", help="who is who from one look: the paper's rule and ours")
    recognition = names.add_parser("recognition", help="who is who over a hundred flights, in one process")
    swarm = names.add_parser("swarm", help="whole local swarms: who knows whom, and at what cost")
    trackers = names.add_parser("trackers", help="every tracker: the paper's figures, and harder scenes")
    monitor = names.add_parser("monitor", help="what being watched costs, and the page with thirty drones")
    soak = names.add_parser("soak", help="every tracker under a million random scans")
    endurance = names.add_parser(
        "endurance", help="half an hour of a swarm: what grows, falls behind, is lost"
    )
    recording = names.add_parser("recording", help="what kill -9 costs a recording, and how fast it replays")
    detector = names.add_parser("detector", help="how good a detector is on labelled images and clips")
    for name in (
        detector,
        agent,
        clips,
        rotation,
        offset,
        calibration,
        clients,
        flood,
        identity,
        recognition,
        swarm,
        trackers,
        soak,
        monitor,
        endurance,
        recording,
    ):
        name.add_argument(
            "--out",
            type=Path,
            default=DEFAULT_OUT,
            metavar="DIR",
            help="for the results (default: %(default)s)",
        )
        if name in (agent, clips, rotation, recognition, swarm, endurance):
            name.add_argument(
                "--tracker", default=DEFAULT_TRACKER, choices=list(TRACKERS), help="(default: %(default)s)"
            )
        name.add_argument("--quick", action="store_true", help="a fraction of the work, for orientation")
    clips.add_argument(
        "data", type=Path, metavar="DATA", help="a folder with pairs of NAME.mp4 and NAME_gt.csv"
    )
    clips.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="of the agent's config; tracker.KEY if bare",
    )
    clips.add_argument("--video", action="store_true", help="keep annotated videos and JSON lines, too")
    endurance.add_argument(
        "--minutes", type=positive, metavar="M", help="of flight (default: 30; with --quick a half)"
    )
    _add_tracker_arguments(trackers)
    _add_detector_arguments(detector)


def _add_detector_arguments(detector: argparse.ArgumentParser) -> None:
    detector.add_argument(
        "model", metavar="MODEL", help='an .onnx file, or "default" for the one that is shipped'
    )
    detector.add_argument(
        "data",
        type=Path,
        metavar="DATA",
        help="a folder of labelled images (CSV, COCO or YOLO), of clips, or both",
    )
    detector.add_argument("--input-scale", type=float, default=1.0, metavar="S", help="input px per image px")
    detector.add_argument(
        "--scene", action="append", default=[], metavar="NAME", help="of the images only this one"
    )
    detector.add_argument("--every", type=int, default=1, metavar="N", help="of the clips each N-th frame")
    detector.add_argument(
        "--motion", action="store_true", help="of clips count what moved; their camera must stand"
    )
    detector.add_argument(
        "--scenario",
        action="append",
        default=[],
        metavar="NAME",
        help="also a flight of the simulation, rendered",
    )
    detector.add_argument(
        "--held-out-negatives",
        action="store_true",
        help="beside the scenes, the drone-free clips that `train --hold-out-negatives` kept unseen",
    )


def _add_tracker_arguments(trackers: argparse.ArgumentParser) -> None:
    trackers.add_argument(
        "--runs", type=int, metavar="N", help="of every scene (default: its own, 100 or 300)"
    )
    trackers.add_argument(
        "--tracker", action="extend", nargs="+", default=[], metavar="NAME", help="(default: all)"
    )
    trackers.add_argument(
        "--scene", action="extend", nargs="+", default=[], metavar="NAME", help="(default: all)"
    )
    trackers.add_argument("--peers", action="store_true", help="Stone Soup's, too (needs swarmtrack[peers])")
    trackers.add_argument("--jobs", type=int, metavar="N", help="processes (default: one a core)")
    trackers.add_argument(
        "--data",
        type=Path,
        metavar="DIR",
        help="real detections, too: a folder with NAME.mp4 and NAME_gt.csv",
    )


def run(args: argparse.Namespace) -> int:
    try:  # now, not when an hour of results has nowhere to go
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SourceError(
            f"--out {args.out}: {error.strerror}, expected a folder that can be made"
        ) from error
    BENCHMARKS[args.benchmark](args)
    print((args.out / f"{args.benchmark}.md").read_text(encoding="utf-8"))
    print(f"{args.out}: {args.benchmark}.json, {args.benchmark}.md")
    return 0


# Each imports its benchmark only when called: `swarmtrack bench --help` answers at once.


def _agent(args: argparse.Namespace) -> None:
    from swarmtrack.benchmarks import agent_budget

    agent_budget.run(args.out, tracker=args.tracker, quick=args.quick)


def _clips(args: argparse.Namespace) -> None:
    from swarmtrack.benchmarks import real_clips

    real_clips.run(
        args.out,
        args.data,
        tracker=args.tracker,
        settings=real_clips.parse_settings(args.set),
        limit=2 if args.quick else None,
        video=args.video,
    )


def _rotation(args: argparse.Namespace) -> None:
    from swarmtrack.benchmarks import rotating_observer

    if args.quick:
        rotating_observer.run(args.out, seeds=4, tracker=args.tracker, experiment=rotating_observer.QUICK)
    else:
        rotating_observer.run(args.out, tracker=args.tracker)


def _offset(args: argparse.Namespace) -> None:
    from swarmtrack.benchmarks import time_offset

    time_offset.run(args.out, seeds=4 if args.quick else 100)


def _clients(args: argparse.Namespace) -> None:
    from swarmtrack.benchmarks import hundred_clients

    hundred_clients.run(args.out, quick=args.quick)


def _flood(args: argparse.Namespace) -> None:
    from swarmtrack.benchmarks import flood

    flood.run(args.out, seconds=1.0 if args.quick else flood.SECONDS)


def _identity(args: argparse.Namespace) -> None:
    from swarmtrack.benchmarks.identity import layouts as identity

    layouts = identity.QUICK_LAYOUTS if args.quick else identity.LAYOUTS
    identity.run(args.out, layouts=layouts)


def _recognition(args: argparse.Namespace) -> None:
    from swarmtrack.benchmarks.identity import recognition

    programme = recognition.QUICK if args.quick else None
    recognition.run(args.out, tracker=args.tracker, programme=programme)


def _swarm(args: argparse.Namespace) -> None:
    from swarmtrack.benchmarks import swarm_runs

    swarm_runs.run(args.out, tracker=args.tracker, programme=swarm_runs.QUICK if args.quick else None)


def _trackers(args: argparse.Namespace) -> None:
    from swarmtrack.benchmarks.trackers import benchmark as trackers
    from swarmtrack.benchmarks.trackers.programme import Programme

    trackers.run(
        args.out,
        Programme(
            trackers=tuple(args.tracker),
            scenes=tuple(args.scene),
            runs=args.runs,
            quick=args.quick,
            peers=args.peers,
            data=args.data,
            **({} if args.jobs is None else {"jobs": args.jobs}),
        ),
    )


def _calibration(args: argparse.Namespace) -> None:
    from swarmtrack.benchmarks import calibration

    calibration.run(args.out, seeds=4 if args.quick else calibration.SEEDS)


def _endurance(args: argparse.Namespace) -> None:
    from swarmtrack.benchmarks.endurance import benchmark as endurance

    usual = endurance.QUICK_MINUTES if args.quick else endurance.MINUTES
    endurance.run(args.out, minutes=args.minutes or usual, tracker=args.tracker)


def _soak(args: argparse.Namespace) -> None:
    from swarmtrack.benchmarks.trackers import soak

    soak.run(args.out, scans=soak.QUICK_SCANS if args.quick else soak.SCANS)


def _detector(args: argparse.Namespace) -> None:
    from swarmtrack.benchmarks import detector

    detector.run(
        args.model,
        args.data,
        args.out,
        quick=args.quick,
        input_scale=args.input_scale,
        scenes=args.scene,
        every=max(args.every, 1),
        held_out_negatives=args.held_out_negatives,
        motion=args.motion,
        scenarios=args.scenario,
    )


def _monitor(args: argparse.Namespace) -> None:
    from swarmtrack.benchmarks import monitor_cost

    monitor_cost.run(args.out, quick=args.quick)


def _recording(args: argparse.Namespace) -> None:
    from swarmtrack.benchmarks import recorded_flights

    recorded_flights.run(args.out, quick=args.quick)


BENCHMARKS: dict[str, Callable[[argparse.Namespace], None]] = {
    "agent": _agent,
    "calibration": _calibration,
    "clients": _clients,
    "clips": _clips,
    "detector": _detector,
    "endurance": _endurance,
    "flood": _flood,
    "identity": _identity,
    "offset": _offset,
    "recognition": _recognition,
    "recording": _recording,
    "rotation": _rotation,
    "monitor": _monitor,
    "soak": _soak,
    "swarm": _swarm,
    "trackers": _trackers,
}
