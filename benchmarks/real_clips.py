"""How well the agent follows real drones: labelled clips through `swarmtrack-agent`, scored from its JSON lines.

Each clip runs through the agent's own program, from file to JSON lines, every frame in order. The first second is left
out, while tracks are being confirmed. Metrics: see `swarmtrack.lab.score.clip_score`.

    swarmtrack bench clips DATA [--tracker kalman] [--set tracker.p_detection=0.8] --out DIR
    swarmtrack bench clips DATA --drone-free [--set …] --out DIR   # how many tracks where no drone is
    swarmtrack bench clips --jsonl FILE --gt FILE --out DIR        # score what was written elsewhere

DATA is a folder that holds pairs NAME.mp4 and NAME_gt.csv (see `swarmtrack.training.labelled_clips`). With --drone-free
it is one of labelled images, too: they tell which of the clips without drones `train --hold-out-negatives` keeps back.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import swarmtrack
from swarmtrack.arguments import add_file, add_flag, add_list, positive
from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.command_line import add_clips, add_common, add_tracker
from swarmtrack.benchmarks.report import BenchmarkError, number
from swarmtrack.lab.score.clip_score import ClipScore, TrackPoints, score_clip
from swarmtrack.messages import TrackStatus
from swarmtrack.tracking import DEFAULT_TRACKER
from swarmtrack.training.labelled_clips import Clip, drone_clips, find_clips, origins, read_truth
from swarmtrack.training.labelled_images import held_out, load_frames

NAME = "clips"
QUICK_CLIPS = 2
START_S = 1.0
AIMS = {"recall": 0.85, "precision": 0.9, "identity_switches": 2}  # of one clip
AGENT_TIMEOUT_S = 900.0  # for one clip of ten seconds: a stuck agent, no slow machine


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


class FalseTracks(NamedTuple):
    """What was confirmed in a clip without drones: how many tracks, in how many of its frames."""

    clip: Clip
    frames: int
    tracks: int
    frames_with: int


def count_false_tracks(clip: Clip, jsonl: Path) -> FalseTracks:
    """From START_S on. A track of the second before counts if it is still confirmed."""
    claimed = read_tracks(jsonl)
    frames = range(round(START_S * clip.fps), clip.frames)
    shown = [claimed[frame].id for frame in frames if frame in claimed and claimed[frame].id.size]
    return FalseTracks(clip, len(frames), len({int(track) for ids in shown for track in ids}), len(shown))


def held_out_clips(data: Path) -> list[Clip]:
    """The clips without drones that `train --hold-out-negatives` keeps unseen."""
    clips = find_clips(data)
    places = origins(clips, load_frames(data))
    kept = [clip for clip in clips if held_out(places[clip.name].scene, places[clip.name].source)]
    if not kept:
        raise BenchmarkError(f"{data}: no clip without drones that a training would hold out, expected one")
    return kept


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
    add_flag(
        parser,
        "--drone-free",
        "instead of clips with drones: those without that `train --hold-out-negatives` keeps unseen",
    )
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
    if args.drone_free:
        publish_false_tracks(
            args.out,
            held_out_clips(args.data)[: QUICK_CLIPS if args.quick else None],
            tracker=args.tracker,
            settings=parse_settings(args.set),
        )
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
    clips = drone_clips(data)[:limit]
    settings = settings or {}
    scores: dict[str, ClipScore] = {}
    with tempfile.TemporaryDirectory() as scratch, report.progress("real clips", len(clips)) as advance:
        folder = out / "tracks" if video else Path(scratch)
        for clip in clips:
            jsonl = track_clip(clip, folder, tracker=tracker, settings=settings, video=video)
            scores[clip.name] = score_file(jsonl, clip.truth, fps=clip.fps, frames=clip.frames)
            advance(f"{clip.name}: recall {scores[clip.name].recall:.2f}")
    return publish_scores(out, scores, tracker=tracker, settings=settings)


def publish_false_tracks(
    out: Path,
    clips: Sequence[Clip],
    *,
    tracker: str = DEFAULT_TRACKER,
    settings: dict[str, str] | None = None,
) -> dict[str, Any]:
    """Track every one of the clips, which show no drone; clips.json and clips.md into `out`."""
    rows = []
    with tempfile.TemporaryDirectory() as scratch, report.progress("drone-free clips", len(clips)) as advance:
        for clip in clips:
            jsonl = track_clip(clip, Path(scratch), tracker=tracker, settings=settings or {})
            rows.append(count_false_tracks(clip, jsonl))
            advance(f"{clip.name}: {rows[-1].tracks} tracks")
    kinds = sorted({row.clip.kind for row in rows})
    by_kind = {kind: _false_tracks([row for row in rows if row.clip.kind == kind]) for kind in kinds}
    total = _false_tracks(rows)
    result = {
        "tracker": tracker,
        "settings": settings or {},
        "start_s": START_S,
        "clips": [{"clip": row.clip.name} | _false_tracks([row]) for row in rows],
        "by_kind": by_kind,
        "total": total,
    }
    table = report.table(
        ["", "clips", "minutes", "confirmed tracks", "per minute", "frames with one", "clips with none"],
        [_false_row(kind, entry) for kind, entry in (by_kind | {"all": total}).items()],
    )
    title = f"# Confirmed tracks where no drone is\n\nEvery frame after the first {START_S:g} s of a clip."
    report.write(out, NAME, result, f"{title}\n\n{table}\n")
    return result


def _false_row(kind: str, entry: dict[str, Any]) -> list[str]:
    return [
        kind,
        str(entry["clips"]),
        number(entry["minutes"]),
        str(entry["tracks"]),
        number(entry["tracks_per_minute"], 1),
        f"{100 * entry['share_of_frames']:.0f} %",
        str(entry["clean_clips"]),
    ]


def _false_tracks(rows: Sequence[FalseTracks]) -> dict[str, Any]:
    minutes = sum(row.frames / row.clip.fps for row in rows) / 60.0
    tracks = sum(row.tracks for row in rows)
    return {
        "clips": len(rows),
        "minutes": minutes,
        "tracks": tracks,
        "tracks_per_minute": tracks / minutes,
        "share_of_frames": sum(row.frames_with for row in rows) / sum(row.frames for row in rows),
        "clean_clips": sum(row.tracks == 0 for row in rows),
    }


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
