"""`swarmtrack calibrate board|intrinsics|extrinsics|size`: what a camera's and a detector's config need, measured."""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import sys
from contextlib import suppress
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from swarmtrack.agents.calibrate_intrinsics import add_board_command, add_intrinsics_command
from swarmtrack.agents.calibrate_intrinsics import run as run_intrinsics
from swarmtrack.agents.calibrate_size import add_size_command
from swarmtrack.agents.calibrate_size import run as run_size
from swarmtrack.arguments import add_action, add_file, add_flag, add_seconds, page
from swarmtrack.log_lines import log_to_stderr

if TYPE_CHECKING:
    from swarmtrack.config.drone import DroneConfig, MountedCamera
    from swarmtrack.doctor.watching import SensorWatch

DONE, FAILED = 0, 1
SECONDS = 60.0
LIVE_REACH, RECORDED_REACH = 0.3, 3.0  # s


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = f"Step by step, with pictures: {page('calibration.md')}"
    steps = parser.add_subparsers(dest="step", required=True, metavar="STEP")
    add_board_command(steps)
    add_intrinsics_command(steps)
    extrinsics = add_action(
        steps,
        "extrinsics",
        "mounting of the camera relative to the gyro, and the offset of their clocks",
        description="Mounting of the camera relative to the gyro, and the offset of their clocks. Take the "
        "propellers off. Turn the drone by hand for a minute, back and forth about all its axes, in a room or yard "
        "with plenty of texture and nothing closer than three metres. Exit code 0: good. 1: not good, with the reason.",
    )
    add_file(extrinsics, "--config", "the drone's config: its camera and autopilot")
    add_file(extrinsics, "--video", "instead of a config: a recorded minute, …")
    add_file(extrinsics, "--tlog", "… its telemetry, …")
    add_file(extrinsics, "--calibration", "… and the camera's intrinsics")
    add_seconds(extrinsics, "--seconds", f"how long (default: {SECONDS:g}; a recording: to its end)")
    add_seconds(
        extrinsics,
        "--reach",
        f"largest offset to search for (default: {LIVE_REACH:g}; recordings: {RECORDED_REACH:g})",
    )
    extrinsics.add_argument(
        "--camera",
        type=int,
        default=1,
        metavar="N",
        help="number of the camera, if the config has several (default: 1)",
    )
    add_file(extrinsics, "--write", "write the result into this config, if it is good")
    add_flag(extrinsics, "--json", "print JSON")
    add_size_command(steps)


class RecordedTime:
    """The clock of recordings that are read as fast as they go: both begin at its 0, and it stands."""

    def now(self) -> float:
        return 0.0

    def utc(self) -> float:
        return 0.0


def run(args: argparse.Namespace) -> int:
    log_to_stderr(logging.CRITICAL)
    if args.step == "extrinsics":
        return asyncio.run(_extrinsics(args))
    if args.step == "size":
        return run_size(args)
    return run_intrinsics(args)


async def _extrinsics(args: argparse.Namespace) -> int:
    from swarmtrack.calibration.extrinsics import doubts, for_the_config, toml_lines, write_into
    from swarmtrack.clock import SystemClock
    from swarmtrack.doctor.watching import SensorWatch
    from swarmtrack.errors import SourceError
    from swarmtrack.motion.hand_eye import compare, solve
    from swarmtrack.runtime.assembly import make_simulation, mount

    config = _config(args)
    recorded = args.video is not None
    clock = RecordedTime() if recorded else SystemClock()
    simulation = make_simulation(config, clock)
    number, count = args.camera - 1, len(config.cameras)
    if not 0 <= number < count:
        raise SourceError(f"--camera {args.camera}: expected 1 to {count}")
    # The others are not looked at.
    config = config.model_copy(update={"cameras": (config.cameras[number],)})
    mounted = mount(config.camera, simulation)
    seconds = args.seconds or (1e6 if recorded else SECONDS)
    reach = args.reach or (RECORDED_REACH if recorded else LIVE_REACH)
    watch = SensorWatch(config, [mounted], clock, simulation)
    progress = asyncio.create_task(_tell(watch, seconds if args.seconds or not recorded else None))
    watched = await watch.run(seconds)
    progress.cancel()
    motion, heard = watch.motion(0), watch.heard
    found = agreement = None
    if motion is not None and motion.found and len(heard.samples) > 10:
        turns, gyro = motion.turns(), heard.gyro()
        found = solve(turns, gyro, reach=reach, centre=mounted.time_offset_s)
    if found is None:
        return _nothing(watched, motion.frames if motion else 0)
    agreement = compare(turns, gyro, found.camera_from_body, reach=reach, centre=mounted.time_offset_s)
    span = float(turns.end[-1] - turns.start[0])
    problems = doubts(found, agreement, seconds=span, reach=reach)
    lines = toml_lines(found, mounted.body_from_camera.position)
    if args.json:
        print(json.dumps(_record(found, problems, lines, mounted), indent=1))
    else:
        _say(found, problems, for_the_config(lines, number, count), mounted)
    if args.write is not None and not problems:
        write_into(args.write, lines, number)
        print(f"written into {args.write}", file=sys.stderr)
    return FAILED if problems else DONE


def _config(args: argparse.Namespace) -> DroneConfig:
    from swarmtrack.config.drone import DroneConfig, load_config
    from swarmtrack.errors import SourceError

    recording = (args.video, args.tlog, args.calibration)
    if args.config is not None and not any(recording):
        return load_config(args.config)
    if args.config is not None or not all(recording):
        raise SourceError("expected either --config FILE, or all of --video, --tlog and --calibration")
    table: dict[str, Any] = {
        "drone": {"id": 1},
        "camera": {
            "source": f"file://{quote(str(args.video.absolute()))}?pace=fast",
            "calibration": str(args.calibration),
        },
        "autopilot": {"link": f"tlog:{args.tlog.absolute()}?speed=0"},
        "network": {"transport": "memory"},
    }
    return DroneConfig.model_validate(table)


async def _tell(watch: SensorWatch, seconds: float | None) -> None:
    """A line of progress on a terminal: what was turned so far, about which axis."""
    if not sys.stderr.isatty():
        return
    import numpy as np
    from rich.console import Console
    from rich.live import Live

    with suppress(asyncio.CancelledError), Live(console=Console(stderr=True), transient=True) as live:
        for tick in range(10**9):
            rates = np.array([sample.gyro for sample in watch.heard.samples[-20000:]]).reshape(-1, 3)
            about = rates.std(axis=0) if len(rates) > 1 else np.zeros(3)
            axes = "   ".join(
                f"{name} {'█' * min(int(20 * rate), 12):12}"
                for name, rate in zip(("roll", "pitch", "yaw"), about, strict=True)
            )
            motion = watch.motion(0)
            turns = len(motion.found) if motion else 0
            of = f" of {seconds:.0f}" if seconds else ""
            live.update(f"{tick / 2:5.1f}{of} s   {axes}   {turns} frames used")
            await asyncio.sleep(0.5)


def _nothing(watched: Any, frames: int) -> int:
    from swarmtrack.diagnosis.sources import check_autopilot, check_camera

    print("calibrate extrinsics: too little data for a result:", file=sys.stderr)
    for finding in check_camera(watched.cameras[0].facts) + check_autopilot(watched.autopilot):
        print(
            f"  {finding.check}: {finding.found}{' -> ' if finding.remedy else ''}{finding.remedy}",
            file=sys.stderr,
        )
    print(f"  {frames} frames seen", file=sys.stderr)
    return FAILED


def _record(found: Any, problems: list[str], lines: list[str], mounted: MountedCamera) -> dict[str, Any]:
    import numpy as np

    from swarmtrack.calibration.extrinsics import rpy_deg

    return {
        "rpy_deg": rpy_deg(found).round(4).tolist(),
        "rotation_sigma_deg": np.degrees(found.rotation_sigma).round(4).tolist(),
        "time_offset_s": round(found.time_offset_s, 6),
        "time_offset_sigma_s": round(found.time_offset_sigma_s, 6),
        "gyro_bias_rad_s": found.bias.round(6).tolist(),
        "residual_rad": round(found.residual, 7),
        "outliers": round(found.outliers, 4),
        "turns": found.turns,
        "rates_rad_s": found.rates.round(4).tolist(),
        "changed_by_deg": round(_change_deg(found, mounted), 3),
        "doubts": problems,
        "toml": lines,
    }


def _change_deg(found: Any, mounted: MountedCamera) -> float:
    import numpy as np

    from swarmtrack.geometry import rotation

    apart = rotation.log(found.camera_from_body @ mounted.body_from_camera.rotation)
    return float(np.degrees(np.linalg.norm(apart)))


def _say(found: Any, problems: list[str], for_the_config: str, mounted: MountedCamera) -> None:
    import numpy as np

    from swarmtrack.calibration.extrinsics import rpy_deg

    sigma = np.degrees(found.rotation_sigma)
    angles = ", ".join(f"{angle:.2f}" for angle in rpy_deg(found))
    print(
        f"rotation   rpy_deg = [{angles}] ± {sigma.max():.2f}°, {_change_deg(found, mounted):.2f}° from the config's"
    )
    print(
        f"clocks     time_offset_s = {found.time_offset_s:.4f} ± {found.time_offset_sigma_s:.4f} "
        f"(config: {mounted.time_offset_s:g})"
    )
    bias = ", ".join(f"{np.degrees(rate):.2f}" for rate in found.bias)
    print(f"gyro       bias [{bias}]°/s")
    rates = ", ".join(f"{rate:.2f}" for rate in found.rates)
    print(
        f"evidence   {found.turns} turns at [{rates}] rad/s about x, y, z; {found.outliers:.0%} rejected, "
        f"residual {np.degrees(found.residual):.3f}°"
    )
    print()
    if problems:
        print("Not reliable:")
        for problem in problems:
            print(f"  {problem}")
        return
    print("Good. For the config:")
    print()
    print(for_the_config)
