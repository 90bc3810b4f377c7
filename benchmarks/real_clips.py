"""How well the agent follows real drones: labelled clips through `swarmtrack-agent`, scored from its JSON lines.

Each clip runs through the agent's own program, from file to JSON lines, every frame in order. The first second is left
out, while tracks are being confirmed. Metrics: see `swarmtrack.evaluation.clip_score`.

    swarmtrack bench clips DATA [--tracker kalman] [--set tracker.p_detection=0.8] --out DIR
    swarmtrack bench clips --jsonl FILE --gt FILE --out DIR        # score what was written elsewhere

DATA is a folder that holds pairs NAME.mp4 and NAME_gt.csv (`frame,id,x,y,w,h`: frames from 0, the box's top left corner
and size in pixels).
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

import swarmtrack
from swarmtrack.arguments import add_file, add_flag, add_list, positive
from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.command_line import add_clips, add_common, add_tracker
from swarmtrack.benchmarks.report import BenchmarkError, number
from swarmtrack.evaluation.clip_score import ClipScore, TrackPoints, TruthBoxes, score_clip
from swarmtrack.messages import TrackStatus
from swarmtrack.tracking import DEFAULT_TRACKER

NAME = "clips"
QUICK_CLIPS = 2
START_S = 1.0
AIMS = {"recall": 0.85, "precision": 0.9, "identity_switches": 2}  # of one clip
AGENT_TIMEOUT_S = 900.0  # for one clip of ten seconds: a stuck agent, no slow machine
VIDEOS = (".mp4", ".avi", ".mkv")


class Clip(NamedTuple):
    """A video, its labels, and what a look at the file tells."""

    name: str
    video: Path
    truth: Path
    frames: int
    fps: float
    width: int
    height: int


def find_clips(folder: Path) -> list[Clip]:
    """All labelled clips below a folder, by name."""
    clips = []
    for truth in sorted(folder.rglob("*_gt.csv")):
        name = truth.name.removesuffix("_gt.csv")
        videos = [path for suffix in VIDEOS if (path := truth.with_name(name + suffix)).exists()]
        if videos:
            clips.append(_look_at(name, videos[0], truth))
    if not clips:
        raise BenchmarkError(f"{folder}: no pair of NAME.mp4 and NAME_gt.csv found in it or below")
    return clips


def _look_at(name: str, video: Path, truth: Path) -> Clip:
    capture = cv2.VideoCapture(str(video))
    try:
        frames, fps, width, height = (
            capture.get(field)
            for field in (
                cv2.CAP_PROP_FRAME_COUNT,
                cv2.CAP_PROP_FPS,
                cv2.CAP_PROP_FRAME_WIDTH,
                cv2.CAP_PROP_FRAME_HEIGHT,
            )
        )
    finally:
        capture.release()
    if frames < 1 or fps <= 0.0:
        raise BenchmarkError(
            f"{video}: {frames:g} frames at {fps:g} Hz, expected a video that can be decoded"
        )
    return Clip(name, video, truth, int(frames), fps, int(width), int(height))


def read_truth(path: Path) -> dict[int, TruthBoxes]:
    """The labelled boxes by frame."""
    rows: dict[int, list[tuple[float, ...]]] = {}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                box = tuple(float(row[key]) for key in ("id", "x", "y", "w", "h"))
                rows.setdefault(int(row["frame"]), []).append(box)
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise BenchmarkError(f"{path}: {error!r}, expected a table frame,id,x,y,w,h of numbers") from error
    truth = {}
    for frame, boxes in rows.items():
        table = np.array(boxes)
        corner, size = table[:, 1:3], table[:, 3:5]
        truth[frame] = TruthBoxes(table[:, 0].astype(np.int64), corner + 0.5 * size, size)
    return truth


def read_tracks(path: Path) -> dict[int, TrackPoints]:
    """The confirmed tracks by frame, from an agent's JSON lines."""
    tracks = {}
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise BenchmarkError(f"{path}: {error.strerror}, expected the JSON lines of an agent") from error
    for number_of_line, line in enumerate(lines, start=1):
        try:
            record = json.loads(line)
            confirmed = [track for track in record["tracks"] if track["status"] == TrackStatus.CONFIRMED]
            ids = np.array([track["id"] for track in confirmed], np.int64)
            centre = np.array([(track["u_px"], track["v_px"]) for track in confirmed], float)
            tracks[int(record["frame"])] = TrackPoints(ids, centre.reshape(-1, 2))
        except (ValueError, KeyError, TypeError) as error:
            expected = 'expected {"frame", "tracks": [{"id", "u_px", "v_px", "status"}]}'
            raise BenchmarkError(f"{path}:{number_of_line}: {error!r}, {expected}") from error
    return tracks


def score_file(jsonl: Path, truth: Path, *, fps: float, frames: int | None = None) -> ClipScore:
    """Score an agent's JSON lines from START_S on; frames: of the clip, else until the last one labelled or claimed."""
    labelled, claimed = read_truth(truth), read_tracks(jsonl)
    last = frames or 1 + max([*labelled, *claimed], default=-1)
    return score_clip(labelled, claimed, range(round(START_S * fps), last))


def config_text(clip: Clip, tracker: str, settings: dict[str, str], jsonl: Path, video: Path | None) -> str:
    """The agent's config for a clip, as TOML. settings: dotted keys and TOML values, over everything else."""
    # Nobody calibrated these cameras. They do not turn, so the focal length is of no consequence for the tracks.
    lens = {"fx": clip.width, "fy": clip.width, "cx": (clip.width - 1) / 2, "cy": (clip.height - 1) / 2}
    lens |= {"width": clip.width, "height": clip.height}
    entries = {
        "drone.id": "1",
        "camera.source": json.dumps(f"{clip.video.resolve().as_uri()}?pace=fast"),
        **{f"camera.intrinsics.{key}": str(value) for key, value in lens.items()},
        "tracker.name": json.dumps(tracker),
        "network.transport": '"memory"',
        "output.jsonl": json.dumps(str(jsonl.resolve())),
        **settings,
    }
    if video is not None:
        entries["output.video"] = json.dumps(str(video.resolve()))
    return "".join(f"{key} = {value}\n" for key, value in entries.items())


def track_clip(
    clip: Clip, folder: Path, *, tracker: str, settings: dict[str, str], video: bool = False
) -> Path:
    """Run the agent's program on a clip; returns the JSON lines it wrote into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    jsonl, config = folder / f"{clip.name}.jsonl", folder / f"{clip.name}.toml"
    annotated = folder / f"{clip.name}.mp4" if video else None
    config.write_text(config_text(clip, tracker, settings, jsonl, annotated), encoding="utf-8")
    command = [sys.executable, "-m", "swarmtrack.agents.vehicle", "--config", str(config), "--quiet"]
    try:
        done = subprocess.run(
            command,
            env=agent_environment(),
            capture_output=True,
            text=True,
            timeout=AGENT_TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise BenchmarkError(f"{clip.video}: the agent was not done after {AGENT_TIMEOUT_S:g} s") from error
    if done.returncode != 0:
        raise BenchmarkError(
            f"{clip.video}: the agent ended with {done.returncode}: {done.stderr.strip()[-800:]}"
        )
    return jsonl


def agent_environment() -> dict[str, str]:
    """In which an agent's process finds this very package, installed or not."""
    here = str(Path(swarmtrack.__file__).resolve().parents[1])
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [here, os.environ.get("PYTHONPATH")]))}


def parse_settings(assignments: Iterable[str]) -> dict[str, str]:
    """`key=value` as dotted keys and TOML values; a key without a section is the tracker's, text needs no quotes."""
    settings = {}
    for assignment in assignments:
        key, equals, value = assignment.partition("=")
        if not equals or not key or not value:
            raise BenchmarkError(f"--set {assignment}: expected KEY=VALUE, such as tracker.p_detection=0.8")
        plain = value in ("true", "false") or _is_number(value) or value[0] in "\"'[{"
        settings[key if "." in key else f"tracker.{key}"] = value if plain else json.dumps(value)
    return settings


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def as_record(name: str, score: ClipScore) -> dict[str, Any]:
    return {
        "clip": name,
        "frames": score.frames,
        "recall": score.recall,
        "precision": score.precision,
        "identity_switches": score.switches,
        "centre_rmse_px": score.centre_rmse_px,
        "boxes": score.boxes,
        "confirmed": score.tracks,
        "hits": score.hits,
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_common(parser)
    add_tracker(parser)
    add_clips(parser, nargs="?")
    add_list(parser, "--set", "of the agent's config; tracker.KEY if bare", "KEY=VALUE")
    add_flag(parser, "--video", "keep annotated videos and JSON lines, too")
    add_file(parser, "--jsonl", "instead of DATA: score what an agent wrote …")
    add_file(parser, "--gt", "… against these labels")
    parser.add_argument(
        "--fps", type=positive, default=30.0, metavar="F", help="of that clip (default: %(default)g)"
    )


def run(args: argparse.Namespace) -> None:
    if (args.data is None) == (args.jsonl is None) or (args.jsonl is None) != (args.gt is None):
        raise BenchmarkError("clips: expected either DATA, or --jsonl FILE and --gt FILE")
    if args.jsonl is not None:
        publish_scores(args.out, {args.jsonl.stem: score_file(args.jsonl, args.gt, fps=args.fps)})
        return
    publish(
        args.out,
        args.data,
        tracker=args.tracker,
        settings=parse_settings(args.set),
        limit=QUICK_CLIPS if args.quick else None,
        video=args.video,
    )


def publish(
    out: Path,
    data: Path,
    *,
    tracker: str = DEFAULT_TRACKER,
    settings: dict[str, str] | None = None,
    limit: int | None = None,
    video: bool = False,
) -> dict[str, Any]:
    """Track and score every clip below `data` (at most `limit`), and publish the scores.

    video: keep the annotated videos and the JSON lines in `out`, too.
    """
    report.pyplot()  # before the work, not after it, should it be missing
    clips = find_clips(data)[:limit]
    settings = settings or {}
    scores: dict[str, ClipScore] = {}
    with tempfile.TemporaryDirectory() as scratch, report.progress("real clips", len(clips)) as advance:
        folder = out / "tracks" if video else Path(scratch)
        for clip in clips:
            jsonl = track_clip(clip, folder, tracker=tracker, settings=settings, video=video)
            scores[clip.name] = score_file(jsonl, clip.truth, fps=clip.fps, frames=clip.frames)
            advance(f"{clip.name}: recall {scores[clip.name].recall:.2f}")
    return publish_scores(out, scores, tracker=tracker, settings=settings)


def publish_scores(
    out: Path,
    scores: dict[str, ClipScore],
    *,
    tracker: str | None = None,
    settings: dict[str, str] | None = None,
) -> dict[str, Any]:
    """clips.json, clips.md and clips.png into `out`; tracker: None where nobody knows what wrote the tracks."""
    result = {
        "tracker": tracker,
        "settings": settings or {},
        "start_s": START_S,
        "clips": [as_record(name, score) for name, score in scores.items()],
        "total": as_record("total", sum(scores.values(), ClipScore())),
        "aims": AIMS,
    }
    report.write(out, NAME, result, _markdown(result))
    _plot(out / f"{NAME}.png", scores)
    return result


def _markdown(result: dict[str, Any]) -> str:
    rows = [_row(record) for record in [*result["clips"], result["total"]]]
    changed = [f"`{key} = {value}`" for key, value in result["settings"].items()]
    told = (
        [f"tracker `{result['tracker']}`", *changed] if result["tracker"] else ["JSON lines from elsewhere"]
    )
    return "\n\n".join(
        [
            "# Real clips",
            f"Confirmed tracks of `swarmtrack-agent` ({', '.join(told)})"
            f" against the labelled boxes, every frame after the first {START_S:g} s. A hit lies within max(6 px, half"
            " the longer box side) of the box's centre. Aim of a clip: recall"
            f" {AIMS['recall']}, precision {AIMS['precision']}, at most {AIMS['identity_switches']} switches.",
            report.table(
                ["clip", "frames", "recall", "precision", "switches", "centre RMSE, px", "aim"], rows
            ),
        ]
    )


def _row(record: dict[str, Any]) -> list[str]:
    reached = (
        record["recall"] >= AIMS["recall"]
        and record["precision"] >= AIMS["precision"]
        and record["identity_switches"] <= AIMS["identity_switches"]
    )
    return [
        record["clip"],
        str(record["frames"]),
        number(record["recall"], 3),
        number(record["precision"], 3),
        str(record["identity_switches"]),
        number(record["centre_rmse_px"]),
        "" if record["clip"] == "total" else "reached" if reached else "missed",
    ]


def _plot(path: Path, scores: dict[str, ClipScore]) -> None:
    pyplot = report.pyplot()
    figure, axes = pyplot.subplots(figsize=(8.0, 3.6), layout="constrained")
    place = np.arange(len(scores))
    axes.bar(place - 0.2, [score.recall for score in scores.values()], 0.38, label="recall")
    axes.bar(place + 0.2, [score.precision for score in scores.values()], 0.38, label="precision")
    axes.axhline(AIMS["recall"], color="C0", linewidth=0.8, linestyle="--")
    axes.axhline(AIMS["precision"], color="C1", linewidth=0.8, linestyle="--")
    axes.set_xticks(place, list(scores), rotation=30, ha="right")
    axes.set(ylim=(0.0, 1.05))
    axes.legend(loc="lower right")
    figure.savefig(path, dpi=130)
    pyplot.close(figure)
