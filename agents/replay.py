"""`swarmtrack replay PATH`: a recorded flight through the real perception again, as it was or with changes."""

from __future__ import annotations

import argparse
import gc
import json
import math
import multiprocessing
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from swarmtrack.arguments import add_file, add_flag, add_list, count, one_of, require_extra
from swarmtrack.errors import RecordingError

if TYPE_CHECKING:
    from swarmtrack.messages import TrackList
    from swarmtrack.recording.reader import Recording
    from swarmtrack.replay.diff import ReplayDiff, SeenScan
    from swarmtrack.replay.replayer import Published, Replayed, Watcher
    from swarmtrack.replay.verdict import Judged

DONE, FAILED = 0, 1
RECORDED = "recorded"
# Of each drone.
WARNINGS_SHOWN = 5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported, as in flight
    from swarmtrack.tracking import TRACKERS

    add_file(
        parser,
        "paths",
        "recordings, or folders of several, such as sim --record writes",
        metavar="FILE|DIR",
        nargs="+",
    )
    parser.add_argument(
        "--tracker",
        type=one_of(TRACKERS, "tracker"),
        metavar="NAME",
        help=f"replay with this tracker instead: {', '.join(TRACKERS)}",
    )
    add_list(
        parser,
        "--set",
        "change a key of the config, such as tracker.p_detection=0.8; may be repeated",
        "KEY=VALUE",
        dest="changes",
    )
    add_flag(
        parser, "--detect", "run the detector on the recorded frames instead of using the recorded detections"
    )
    parser.add_argument(
        "--against",
        metavar="recorded|FILE",
        help="compare with the recording, or with another replay's --json (default: recorded, if anything changed)",
    )
    add_file(parser, "--json", "write results, tracks and differences to this file")
    add_file(parser, "--plot", "draw the differences, .png or .svg (needs matplotlib)")
    add_file(
        parser,
        "--video",
        "write the recorded pictures with tracks drawn in, several cameras side by side; .webm or .mp4",
    )
    parser.add_argument(
        "--camera", type=count, metavar="N", help="number of the only camera shown in --video, from 1"
    )
    add_flag(
        parser,
        "--exact",
        "compare every published list of tracks, not every tenth; exit code 1 unless all are the same bit for bit",
    )
    parser.add_argument(
        "--jobs", type=count, metavar="N", help="recordings to replay in parallel (default: two per core)"
    )


@dataclass(frozen=True, slots=True)
class _Task:
    """One recording to be replayed, for a process of its own."""

    recording: Recording
    tracker: str | None
    changes: tuple[str, ...]
    detect: bool
    for_verdict: bool
    every_answer: bool
    video: Path | None
    camera: int | None
    """From 0; None: all."""


@dataclass(slots=True)
class _Flown:
    """What came of one recording."""

    recording: Recording
    tracker: str
    replayed: Replayed
    seconds: float
    """That it took."""
    notes: list[str]
    published: Published
    scans: list[SeenScan]
    recorded_scans: list[SeenScan]
    pictures: int | None
    """In its video."""
    diff: ReplayDiff | None = None


def run(args: argparse.Namespace) -> int:
    from swarmtrack.recording.reader import recordings_below

    if args.json is not None and not args.json.absolute().parent.is_dir():
        raise RecordingError(
            f"--json {args.json}: cannot be written, expected a file in a folder that exists"
        )
    if args.camera is not None and args.video is None:
        raise RecordingError("--camera needs --video")
    if args.plot is not None:
        require_extra("bench", "matplotlib", of="--plot")
    recordings = recordings_below(*args.paths)
    drones = [recording for recording in recordings if recording.kind == "drone"]
    flight = next((recording for recording in recordings if recording.is_simulated_flight), None)
    if not drones:
        raise RecordingError(
            f"{', '.join(map(str, args.paths))}: no inputs of a drone in it, expected an agent's recording"
        )
    if args.detect:
        _check_pictures(drones, "--detect")
    if args.video is not None:
        _check_video(args, drones)
    other = None if args.against in (None, RECORDED) else _read_other(Path(args.against))
    tasks = [
        _Task(
            recording,
            args.tracker,
            tuple(args.changes),
            args.detect,
            flight is not None,
            args.exact,
            _video_of(args.video, recording, drones),
            None if args.camera is None else args.camera - 1,
        )
        for recording in drones
    ]
    what_if = bool(args.tracker or args.changes or args.detect)
    flown, as_heard = _replay_all(tasks, None if what_if else flight, args.jobs)
    if args.against is not None or what_if or args.plot:
        _compare(flown, other)
    for one, task in zip(flown, tasks, strict=True):
        _print(one, what_if)
        if task.video is not None:
            print(f"  {one.pictures} pictures in {task.video}")
    judged = None if flight is None else _judge(flight, flown, as_heard, what_if)
    if args.plot is not None:
        _plot(flown, args.plot, args.against or RECORDED)
    if args.json is not None:
        record = {"drones": [_record(one) for one in flown], "verdict": judged and judged.report.as_record()}
        args.json.write_text(json.dumps(record, allow_nan=False) + "\n", encoding="utf-8")
    if args.exact and not all(one.replayed.exact for one in flown):
        return FAILED
    if judged is None:
        return DONE
    from swarmtrack.agents.sim import exit_code

    return exit_code(judged.report)


def _check_video(args: argparse.Namespace, recordings: list[Recording]) -> None:
    from swarmtrack.outputs.destinations import check_outputs

    check_outputs(None, args.video, video_key="--video")
    _check_pictures(recordings, "--video")


def _video_of(path: Path | None, recording: Recording, recordings: list[Recording]) -> Path | None:
    """Of several drones each has its own, and each life of one."""
    if path is None or len(recordings) == 1:
        return path
    lives = [one for one in recordings if one.drone_id == recording.drone_id]
    life = "" if len(lives) == 1 else f"-{lives.index(recording) + 1}"
    return path.with_stem(f"{path.stem}-drone-{recording.drone_id}{life}")


def _check_pictures(recordings: list[Recording], wish: str) -> None:
    """Raises RecordingError where there would be nothing to look at."""
    from swarmtrack.messages import MOST_CAMERAS
    from swarmtrack.recording.outputs import image_topic

    for recording in recordings:
        if not any(True for _ in recording.messages({image_topic(k) for k in range(MOST_CAMERAS)})):
            raise RecordingError(
                f"{recording.folder}: {wish}: holds no pictures, expected a recording with [recording] "
                'frames = "jpeg"'
            )


def _replay_all(
    tasks: list[_Task], flight: Recording | None, jobs: int | None
) -> tuple[list[_Flown], Judged | None]:
    """Each in a process of its own, as many at a time as there are cores; and beside them the verdict on the flight, if
    all is as it was heard. None: that is yet to be judged."""
    at_once = min(len(tasks) + (flight is not None), jobs or 2 * len(os.sched_getaffinity(0)))
    if at_once == 1:
        return [_replay(task) for task in tasks], None
    import swarmtrack.replay.replayer  # noqa: F401  (loaded once, before the processes part)

    # Nothing in these processes leaves circles behind, and there is much to look through for them.
    fork = multiprocessing.get_context("fork")
    with ProcessPoolExecutor(at_once, mp_context=fork, initializer=gc.disable) as pool:
        judged = None if flight is None else pool.submit(_judge_as_heard, flight, tasks[0].recording)
        flown = list(pool.map(_replay, tasks))
        return flown, None if judged is None or judged.exception() else judged.result()


def _judge_as_heard(flight: Recording, drone: Recording) -> Judged:
    from swarmtrack.recording.settings import read_settings
    from swarmtrack.replay.verdict import judge

    settings, _ = read_settings(drone)
    return judge(flight, None, settings.config.tracker.name)


def _replay(task: _Task) -> _Flown:
    from swarmtrack.clock import SystemClock
    from swarmtrack.recording.settings import read_settings
    from swarmtrack.replay.diff import seen_scans
    from swarmtrack.replay.replayer import Published, Replayer
    from swarmtrack.runtime.perception import make_detector

    clock = SystemClock()
    settings, notes = read_settings(task.recording, task.tracker, task.changes)
    what_if = bool(task.tracker or task.changes or task.detect)

    def fly(watcher: Watcher | None) -> Replayed:
        detector = make_detector(settings.config, clock) if task.detect else None
        return Replayer(
            task.recording, settings, detector=detector, watcher=watcher, every_answer=task.every_answer
        ).run()

    changed: list[TrackList] | None = None
    began = clock.now()
    if task.for_verdict and what_if:
        changed = []
        replayed = fly(changed.append)
    else:
        replayed = fly(None)
        if task.for_verdict and not replayed.exact:
            changed = []
            replayed = fly(changed.append)
    seconds, pictures = clock.now() - began, None
    if task.video is not None:
        from swarmtrack.replay.tiled_video import write_video

        pictures = write_video(task.video, task.recording, settings, replayed.scans, task.camera)
    scans, recorded = (
        seen_scans(reports, replayed.begin) for reports in (replayed.scans, replayed.recorded_scans)
    )
    replayed.scans, replayed.recorded_scans = [], []  # what goes back to the parent is what it needs
    return _Flown(
        task.recording,
        settings.config.tracker.name,
        replayed,
        seconds,
        notes,
        Published(replayed.asked, changed),
        scans,
        recorded,
        pictures,
    )


# --- what people see ------------------------------------------------------------------------------


def _print(one: _Flown, what_if: bool) -> None:
    from swarmtrack.outputs.wording import warning

    replayed, recording = one.replayed, one.recording
    speed = replayed.seconds / one.seconds if one.seconds > 0.0 else math.inf
    print(
        f"drone {recording.drone_id} ({recording.folder.name}, {one.tracker}): {replayed.seconds:.1f} s, "
        f"{replayed.inputs} inputs, {len(one.scans)} scans in {one.seconds:.2f} s ({speed:.0f} x real time)"
    )
    for line in (*one.notes, *recording.damage):
        print(f"  {line}")
    if recording.first_segment > 1:
        print(
            f"  begins with segment {recording.first_segment}: earlier inputs are missing, tracks may differ"
        )
    if replayed.inputs_lost:
        print(f"  {replayed.inputs_lost} inputs are missing in the recording, tracks may differ")
    if replayed.refused:
        print(f"  {replayed.refused} records could not be read")
    warnings = [(t, line) for t, event in replayed.news if (line := warning(event))]
    for t, line in warnings[:WARNINGS_SHOWN]:
        print(f"  at {t:.1f} s: {line}")
    if len(warnings) > WARNINGS_SHOWN:
        print(f"  and {len(warnings) - WARNINGS_SHOWN} warnings more")
    if not what_if:
        print(f"  {_sameness(replayed)}; digest {replayed.digest}")
    if one.diff is not None:
        print(f"  {_in_words(one.diff)}")


def _sameness(replayed: Replayed) -> str:
    scans, answers = replayed.scans_compared, replayed.answers_compared
    setpoints = replayed.setpoints_compared
    if replayed.exact:
        also = f", {setpoints.recorded} setpoints" if setpoints.recorded else ""
        return (
            f"bit for bit as recorded: {scans.recorded} scans, {answers.recorded} published lists of tracks{also} "
            "compared"
        )
    streams = (scans, answers, replayed.states_compared, replayed.strangers_compared, setpoints)
    parted = min((s.parted_s for s in streams if s.parted_s is not None), default=math.nan)
    return (
        f"not as recorded from {parted:.3f} s on: {scans.same} of {scans.recorded} scans, "
        f"{answers.same} of {answers.recorded} published lists of tracks are the same"
    )


def _in_words(diff: ReplayDiff) -> str:
    parted = "never part" if diff.parted_s is None else f"part at {diff.parted_s:.2f} s"
    return (
        f"against it: {diff.matched} tracks matched in {diff.scans} scans ({diff.one} here, {diff.other} there), "
        f"RMSE {diff.rmse_px:.3f} px, {diff.other_names} named otherwise "
        f"({diff.unknown_in_one} of them unknown to one); they {parted}"
    )


def _judge(flight: Recording, flown: list[_Flown], as_heard: Judged | None, what_if: bool) -> Judged:
    from rich.console import Console

    from swarmtrack.agents.sim import print_verdict
    from swarmtrack.replay.verdict import judge

    answers = {(one.recording.drone_id, one.recording.preface["boot"]): one.published for one in flown}
    same = all(published.changed is None for published in answers.values())
    if as_heard is not None and same and not as_heard.unreplayed(answers):
        judged = as_heard
    else:
        judged = judge(flight, answers, flown[0].tracker)
    print_verdict(judged.report, Console())
    unreplayed = judged.unreplayed(answers)
    if unreplayed:
        print(f"{unreplayed} messages with tracks have no recorded inputs")
    if not what_if and judged.recorded is not None:
        differences = judged.differences
        print(
            "the verdict is the recorded one" if not differences else "the verdict is not the recorded one:"
        )
        for line in differences:
            print(f"  {line}")
    return judged


def _record(one: _Flown) -> dict[str, Any]:
    from swarmtrack.replay.diff import scans_record

    replayed = one.replayed
    return {
        "drone_id": one.recording.drone_id,
        "boot": one.recording.preface["boot"],
        "tracker": one.tracker,
        "flight_s": round(replayed.seconds, 6),
        "took_s": round(one.seconds, 6),
        "inputs": replayed.inputs,
        "inputs_lost": replayed.inputs_lost,
        "records_refused": replayed.refused,
        "exact": replayed.exact,
        "digest": replayed.digest,
        "scans_compared": replayed.scans_compared._asdict(),
        "answers_compared": replayed.answers_compared._asdict(),
        "states_compared": replayed.states_compared._asdict(),
        "setpoints_compared": replayed.setpoints_compared._asdict(),
        "diff": one.diff and one.diff.as_record(),
        "scans": scans_record(one.scans),
    }


# --- beside another -------------------------------------------------------------------------------


def _read_other(path: Path) -> dict[tuple[int, str], list[SeenScan]]:
    """What another replay wrote with --json."""
    from swarmtrack.replay.diff import scans_of

    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        return {(part["drone_id"], part["boot"]): scans_of(part["scans"]) for part in record["drones"]}
    except OSError as error:
        raise RecordingError(
            f'--against {path}: {error.strerror}, expected "recorded" or a file that replay --json wrote'
        ) from None
    except (KeyError, TypeError, ValueError) as error:
        raise RecordingError(
            f"--against {path}: is not the JSON of a replay ({error!r}), expected what replay --json wrote"
        ) from None


def _compare(flown: list[_Flown], other: dict[tuple[int, str], list[SeenScan]] | None) -> None:
    from swarmtrack.replay.diff import compare

    for one in flown:
        key = (one.recording.drone_id, one.recording.preface["boot"])
        there = one.recorded_scans if other is None else other.get(key)
        if there is None:
            print(
                f"swarmtrack replay: drone {key[0]} (boot {key[1]}) is not in the other replay",
                file=sys.stderr,
            )
        else:
            one.diff = compare(one.scans, there)


def _plot(flown: list[_Flown], path: Path, against: str) -> None:
    from swarmtrack.replay.plot import plot

    diffs = {one.recording.drone_id: one.diff for one in flown if one.diff is not None}
    plot(diffs, path, f"{flown[0].tracker} and {against}")
