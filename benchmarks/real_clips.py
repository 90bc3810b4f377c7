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
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from swarmtrack.arguments import positive
from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.harness import CLIPS, TRACKER, Benchmark, flag, listed, option, path
from swarmtrack.benchmarks.processes import agent_environment
from swarmtrack.benchmarks.report import BenchmarkError
from swarmtrack.lab.score.clip_score import ClipScore, TrackPoints, score_clip
from swarmtrack.messages import TrackStatus
from swarmtrack.training.labelled_clips import Clip, drone_clips, find_clips, origins, read_truth
from swarmtrack.training.labelled_images import held_out, load_frames

QUICK_CLIPS = 2
DRONE_FREE = "those without that `train --hold-out-negatives` keeps unseen"
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
    how: dict[str, Any] = {"env": agent_environment(), "capture_output": True, "text": True}
    try:
        done = subprocess.run(command, timeout=AGENT_TIMEOUT_S, check=False, **how)
    except subprocess.TimeoutExpired as error:
        raise BenchmarkError(f"{clip.video}: the agent was not done after {AGENT_TIMEOUT_S:g} s") from error
    if done.returncode != 0:
        said = done.stderr.strip()[-800:]
        raise BenchmarkError(f"{clip.video}: the agent ended with {done.returncode}: {said}")
    return jsonl


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
    """Of clips without drones."""
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


def _measured(args: argparse.Namespace) -> dict[str, Any]:
    if (args.data is None) == (args.jsonl is None) or (args.jsonl is None) != (args.gt is None):
        raise BenchmarkError("clips: expected either DATA, or --jsonl FILE and --gt FILE")
    if args.jsonl is not None:
        scores = {args.jsonl.stem: score_file(args.jsonl, args.gt, fps=args.fps)}
        return _scored(scores, tracker=None, settings={})
    told: dict[str, Any] = {"tracker": args.tracker, "settings": parse_settings(args.set)}
    some = slice(QUICK_CLIPS if args.quick else None)
    with tempfile.TemporaryDirectory() as scratch:
        folder = args.out / "tracks" if args.video else Path(scratch)
        if args.drone_free:
            return _drone_free(held_out_clips(args.data)[some], folder, **told)
        clips, scores = drone_clips(args.data)[some], {}
        with report.progress("real clips", len(clips)) as advance:
            for clip in clips:
                jsonl = track_clip(clip, folder, video=args.video, **told)
                scores[clip.name] = score_file(jsonl, clip.truth, fps=clip.fps, frames=clip.frames)
                advance(f"{clip.name}: recall {scores[clip.name].recall:.2f}")
    return _scored(scores, **told)


def _scored(scores: dict[str, ClipScore], *, tracker: str | None, settings: dict[str, str]) -> dict[str, Any]:
    """tracker: None where nobody knows what wrote the tracks."""
    return {
        "tracker": tracker,
        "settings": settings,
        "start_s": START_S,
        "clips": [as_record(name, score) for name, score in scores.items()],
        "total": as_record("total", sum(scores.values(), ClipScore())),
        "aims": AIMS,
    }


def _drone_free(clips: Sequence[Clip], folder: Path, **told: Any) -> dict[str, Any]:
    """Track every one of the clips, which show no drone."""
    rows = []
    with report.progress("drone-free clips", len(clips)) as advance:
        for clip in clips:
            rows.append(count_false_tracks(clip, track_clip(clip, folder, **told)))
            advance(f"{clip.name}: {rows[-1].tracks} tracks")
    kinds = sorted({row.clip.kind for row in rows})
    return {
        **told,
        "start_s": START_S,
        "clips": [{"clip": row.clip.name} | _false_tracks([row]) for row in rows],
        "by_kind": {kind: _false_tracks([row for row in rows if row.clip.kind == kind]) for kind in kinds},
        "total": _false_tracks(rows),
    }


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


COLUMNS: report.Columns = (
    ("clip", "{clip}"),
    ("frames", "{frames}"),
    ("recall", "{recall:.3f}"),
    ("precision", "{precision:.3f}"),
    ("switches", "{identity_switches}"),
    ("centre RMSE, px", "{centre_rmse_px:.2f}"),
    ("aim", lambda record: "" if record["clip"] == "total" else "reached" if _reached(record) else "missed"),
)
FALSE_COLUMNS: report.Columns = (
    ("", "{name}"),
    ("clips", "{clips}"),
    ("minutes", "{minutes:.2f}"),
    ("confirmed tracks", "{tracks}"),
    ("per minute", "{tracks_per_minute:.1f}"),
    ("frames with one", "{share_of_frames:.0p} %"),
    ("clips with none", "{clean_clips}"),
)


def _reached(record: dict[str, Any]) -> bool:
    good = record["recall"] >= AIMS["recall"] and record["precision"] >= AIMS["precision"]
    return bool(good and record["identity_switches"] <= AIMS["identity_switches"])


def _page(result: dict[str, Any]) -> str:
    if "by_kind" in result:
        return report.page(
            "# Confirmed tracks where no drone is",
            f"Every frame after the first {START_S:g} s of a clip.",
            report.table_by_name(FALSE_COLUMNS, result["by_kind"] | {"all": result["total"]}),
        )
    told = ["JSON lines from elsewhere"]
    if result["tracker"]:
        changed = [f"`{key} = {value}`" for key, value in result["settings"].items()]
        told = [f"tracker `{result['tracker']}`", *changed]
    return report.page(
        "# Real clips",
        f"Confirmed tracks of `swarmtrack-agent` ({', '.join(told)})"
        f" against the labelled boxes, every frame after the first {START_S:g} s. A hit lies within max(6 px, half"
        " the longer box side) of the box's centre. Aim of a clip: recall"
        f" {AIMS['recall']}, precision {AIMS['precision']}, at most {AIMS['identity_switches']} switches.",
        report.table_of(COLUMNS, [*result["clips"], result["total"]]),
    )


BENCH = Benchmark(
    "clips",
    _measured,
    _page,
    options=(
        TRACKER,
        CLIPS._replace(keywords={**CLIPS.keywords, "nargs": "?"}),
        listed("--set", "of the agent's config; tracker.KEY if bare", "KEY=VALUE"),
        flag("--video", "keep annotated videos and JSON lines, too"),
        flag("--drone-free", f"instead of clips with drones: {DRONE_FREE}"),
        path("--jsonl", "instead of DATA: score what an agent wrote …", "FILE"),
        path("--gt", "… against these labels", "FILE"),
        option("--fps", "of that clip (default: %(default)g)", type=positive, default=30.0, metavar="F"),
    ),
)
