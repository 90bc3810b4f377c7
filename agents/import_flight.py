"""`swarmtrack import`: turn the log and the video of a past flight into a recording.

Both go through the agent's own parts: the log is read as from a link, every frame is seen by the detector. Nothing is
live, so nothing is dropped and nothing depends on how fast this machine is: what the autopilot said and what was
detected reach Onboard in the order of their times.
"""

from __future__ import annotations

import argparse
import asyncio
import math
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from swarmtrack.arguments import add_file, add_flag, add_folder
from swarmtrack.errors import RecordingError, SourceError

if TYPE_CHECKING:
    from swarmtrack.clock import ManualClock
    from swarmtrack.messages import EgoPose, FlightState, ImuSample, Input, RemoteIdClaim
    from swarmtrack.runtime.assembly import Parts

BEGIN_S = 1000.0  # of our clock, at the log's first record
DETECTOR_S = 0.03  # s from an exposure to its detections, as they would have come in flight


def add_arguments(parser: argparse.ArgumentParser) -> None:
    log = parser.add_mutually_exclusive_group(required=True)
    log.add_argument("--tlog", type=Path, metavar="FILE", help="the telemetry log of a ground station")
    log.add_argument("--ulog", type=Path, metavar="FILE", help="PX4's own log (.ulg)")
    log.add_argument("--bin", type=Path, metavar="FILE", help="ArduPilot's own log (.bin)")
    add_file(parser, "--video", "video of the drone's camera", required=True)
    add_file(parser, "--config", "the drone's config: camera, mount, tracker, detector", required=True)
    add_folder(parser, "--out", "folder for recordings; a subfolder is made for each", required=True)
    parser.add_argument(
        "--offset",
        type=float,
        default=0.0,
        metavar="S",
        help="time from the log's first record to the exposure of the video's first frame (default: 0)",
    )
    add_flag(parser, "--frames", "keep the images in the recording")


class _Log:
    """Implements `AutopilotListener`: keeps everything, by its time."""

    def __init__(self) -> None:
        self.said: list[tuple[float, Input]] = []
        self.samples = 0

    def on_imu(self, sample: ImuSample) -> None:
        self.samples += 1
        self.said.append((sample.t, sample))

    def on_pose(self, pose: EgoPose) -> None:
        self.said.append((pose.t, pose))

    def on_flight_state(self, state: FlightState) -> None:
        self.said.append((state.t, state))

    def on_autopilot_reboot(self) -> None:
        from swarmtrack.messages import AutopilotRebooted

        self.said.append((self.said[-1][0] if self.said else BEGIN_S, AutopilotRebooted()))

    def on_switch(self, t: float) -> None:
        """No switch is watched."""

    def on_remote_id(self, claim: RemoteIdClaim) -> None:
        self.said.append((claim.t, claim))

    def on_found_flying(self) -> None:
        """Where it started is the config's to say."""


def run(args: argparse.Namespace) -> int:
    from swarmtrack.clock import ManualClock, SystemClock
    from swarmtrack.config.drone import load_config
    from swarmtrack.config.toml.layers import Layer
    from swarmtrack.runtime.assembly import assemble

    if not -1e6 < args.offset < 1e6:
        raise SourceError(f"--offset {args.offset:g}: expected seconds")
    logs = {"tlog": args.tlog, "ulog": args.ulog, "bin": args.bin}
    scheme, log = next((scheme, path) for scheme, path in logs.items() if path is not None)
    for name, path in ((f"--{scheme}", log), ("--video", args.video)):
        if not path.is_file():
            raise SourceError(f"{name} {path}: no such file")
    asked = {
        "camera": {"source": f"file://{quote(str(args.video.absolute()))}?pace=fast"},
        "autopilot": {"link": f"{scheme}:{log.absolute()}?speed=0"},
        "network": {"transport": "memory"},
        "recording": {"dir": str(args.out), "frames": "jpeg" if args.frames else "none"},
    }
    config = load_config(args.config, Layer(Path("swarmtrack import"), "", asked))
    clock = ManualClock(BEGIN_S, _first_utc(scheme, log.absolute()))
    parts = assemble(config, SystemClock(), clock)
    return asyncio.run(import_flight(parts, clock, args.offset, _seconds_of(args.video)))


def _seconds_of(video: Path) -> float:
    """How long it is, by its own word; infinite where it says nothing."""
    import cv2

    from swarmtrack.camera_sources.video import open_path

    capture = open_path(video)
    frames, fps = capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_FPS)
    capture.release()
    return frames / fps if frames > 0.0 and 0.0 < fps < math.inf else math.inf


def _check_offset(offset: float, video_s: float, log: _Log) -> None:
    """Raises SourceError where no frame lies within the log."""
    log_s = max((t for t, _ in log.said), default=BEGIN_S) - BEGIN_S
    if not -video_s < offset < log_s:
        length = "" if math.isinf(video_s) else f", and the video {video_s:.1f} s"
        raise SourceError(
            f"--offset {offset:g}: no frame lies within the log, which is {log_s:.1f} s long{length}; expected the "
            "seconds from the log's beginning to the video's"
        )


def _first_utc(scheme: str, log: Path) -> float:
    """UTC [s] of the first record; as if the file had been written with its last record where the log does not know.
    Raises SourceError for what is no log.
    """
    if scheme == "tlog":
        from swarmtrack.autopilot.tlog import CLOCK_WAS_SET

        first, last = _stamps(log)
        is_known, why = first > CLOCK_WAS_SET, "the clock of the computer that wrote the log was not set"
    else:
        from swarmtrack.autopilot.links import read_log

        flight = read_log(scheme, log)
        is_known, why = flight.utc_offset is not None, "no GPS time in the log"
        first, last = (t + (flight.utc_offset or 0.0) for t in (flight.records[0][0], flight.records[-1][0]))
    if is_known:
        return first
    print(f"swarmtrack import: --{scheme} {log}: {why}; the recording is dated by the file", file=sys.stderr)
    return log.stat().st_mtime - (last - first)


def _stamps(tlog: Path) -> tuple[float, float]:
    """UTC [s] of the first and the last record, by the first one's clock; all are read where that was not set."""
    from swarmtrack.autopilot.log_files import check_kind
    from swarmtrack.autopilot.tlog import CLOCK_WAS_SET, records

    check_kind(tlog, "tlog")
    with tlog.open("rb") as file:
        first = next((stamp for stamp, _ in records(file.read(1 << 20))), None)
    if first is None:
        raise SourceError(f"--tlog {tlog}: holds no record, is it a telemetry log (.tlog)?")
    if first > CLOCK_WAS_SET:
        return first, first
    return first, max(stamp for stamp, _ in records(tlog.read_bytes()))


async def import_flight(parts: Parts, clock: ManualClock, offset: float, video_s: float = math.inf) -> int:
    """Raises SourceError where the video is not of this flight."""
    from swarmtrack.autopilot.mavlink_autopilot import MavlinkAutopilot
    from swarmtrack.detection.expectation import PerceivedExpectation
    from swarmtrack.runtime.perception import make_visual_gyro
    from swarmtrack.sources import DetectionSource

    recorder, autopilot = parts.recorder, parts.autopilot
    assert recorder is not None
    assert autopilot is not None
    assert not isinstance(parts.camera, DetectionSource)
    assert parts.detector is not None
    log = _Log()
    await autopilot.run(log)
    if isinstance(autopilot, MavlinkAutopilot):
        for line in autopilot.account():
            print(f"swarmtrack import: {line}", file=sys.stderr)
    if log.samples:
        _check_offset(offset, video_s, log)
    recorder.open()
    parts.door.listener = recorder
    flight = _Flight(parts, clock, log)
    expectation = PerceivedExpectation(parts.door.perceived)
    visual_gyro = make_visual_gyro(parts.config, parts.lens)
    frames = 0
    try:
        async for frame in parts.camera.frames():
            exposed = replace(frame, t=frame.t + offset)
            flight.until(exposed.t)
            recorder.frame(exposed)
            # The gyro reaches the exposure before the detector asks it, as it does in flight and in a replay.
            flight.until(exposed.t + DETECTOR_S)
            turn = None if visual_gyro is None else visual_gyro.turn_to(exposed)
            if turn is not None:
                flight.deliver(turn)
            detections = parts.detector.detect(parts.detector.plan(exposed, expectation))
            if detections is not None:
                flight.deliver(detections)
            frames += 1
        flight.until(math.inf)
    finally:
        await parts.camera.close()
        recorder.close()
    status = recorder.status()
    counters = parts.door.perceived.counters
    print(f"{frames} frames, {log.samples} gyro samples, {counters.scans} scans: {status.text}")
    if counters.scans_ahead_of_gyro:
        print(
            f"  {counters.scans_ahead_of_gyro} scans lie beyond the gyro's samples: does --offset fit?",
            file=sys.stderr,
        )
    if not status.ok:
        raise RecordingError(status.text)
    return 0 if counters.scans else 1


class _Flight:
    """Lets time pass: what the autopilot said reaches the door, and tracks are asked for as an agent publishes."""

    def __init__(self, parts: Parts, clock: ManualClock, log: _Log) -> None:
        self._door = parts.door
        self._clock = clock
        self._said: Iterator[tuple[float, Input]] = iter(log.said)
        self._next = next(self._said, None)
        self._period = 1.0 / parts.config.output.tracks_hz
        self._publish = BEGIN_S

    def until(self, t: float) -> None:
        while self._next is not None and self._next[0] <= t:
            said_t, said = self._next
            self._ask(said_t)
            self._clock.set(said_t)
            self.deliver(said)
            self._next = next(self._said, None)
        if t < math.inf:
            self._ask(t)
            self._clock.set(t)

    def deliver(self, event: Input) -> None:
        self._door.tell(event)
        self._warn()

    def _warn(self) -> None:
        """Of what an agent in flight would have warned."""
        from swarmtrack.outputs.wording import warning

        for event in self._door.events():
            if line := warning(event):
                at = self._clock.now() - BEGIN_S
                print(f"swarmtrack import: at {at:.1f} s: {line}", file=sys.stderr)

    def _ask(self, t: float) -> None:
        while self._publish <= t:
            self._clock.set(self._publish)
            self._door.tracks(self._publish)
            self._warn()
            self._publish += self._period
