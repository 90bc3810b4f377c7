"""`swarmtrack video`: what is tracked in a video file, without a config, an autopilot or a network.

The agent's own parts do the work, at the pace of the machine. Beside what they write there is `agent.toml`, the config
that was flown: `swarmtrack-agent --config` takes it, and so may be changed.
"""

from __future__ import annotations

import argparse
import asyncio
import csv
import json
import math
import os
import re
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from swarmtrack.arguments import add_file, add_flag, add_folder, counted_folder, is_taken, positive
from swarmtrack.errors import SourceError, SwarmtrackError, ungrouped

if TYPE_CHECKING:
    from swarmtrack.messages import LinkStatus

HEADS = ("centernet", "yolo_v5", "yolo_v8", "end_to_end", "detr", "labelled_boxes")
FOV_DEG = 70.0  # from left to right: of most webcams and small cameras
COLUMNS = (
    "t_s", "frame", "id", "u_px", "v_px", "vu_px_s", "vv_px_s", "w_px", "h_px", "status", "probability"
)  # fmt: skip
LOOK_S = 0.1
CONFIG_NAME = "agent.toml"

CONFIG = """\
# Made by `swarmtrack video`. To fly it again: swarmtrack-agent --config {name}
[drone]
id = 1

[camera]
source = {source}
intrinsics = {{ fx = {f:.1f}, fy = {f:.1f}, cx = {cx:.1f}, cy = {cy:.1f}, width = {width}, height = {height} }}

[autopilot]
link = "none"

[motion]
turn_from = {turn_from}

[network]
transport = "memory"              # sends nothing

[output]
jsonl = {jsonl}
video = {video}
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, metavar="FILE", help="the video of one camera")
    parser.add_argument(
        "--fov",
        type=_angle,
        default=FOV_DEG,
        metavar="DEG",
        help="horizontal field of view (default: %(default)g)",
    )
    add_flag(parser, "--still", "the camera does not turn (default: its turns are measured in the images)")
    parser.add_argument(
        "--fps",
        type=positive,
        metavar="HZ",
        help="frames per second, for a file without times (default: the file's own times)",
    )
    add_folder(
        parser, "--out", "output folder (default: FILE-tracked, FILE-tracked-2 … in the current folder)"
    )
    add_flag(parser, "--force", "replace an --out that already exists")
    add_file(parser, "--model", "the detector, an ONNX file (default: the shipped one)")
    parser.add_argument(
        "--head",
        choices=HEADS,
        help="format of that file's outputs, where it can be read in more than one way",
    )
    parser.add_argument(
        "--names",
        type=_words,
        metavar="NAME,…",
        help="all classes of that file in their order, if it has no names",
    )
    parser.add_argument(
        "--classes",
        type=_words,
        metavar="NAME,…",
        help="the classes that are drones (default: those with a drone's name)",
    )


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


def _angle(text: str) -> float:
    degrees = positive(text)
    if degrees >= 175.0:
        raise argparse.ArgumentTypeError(f"found {text}, expected degrees below 175")
    return degrees


def run(args: argparse.Namespace) -> int:
    """Exit codes: 0 done, 1 a part of the file could not be read, 2 wrong usage."""
    from swarmtrack.camera_sources.video import VideoFile

    video = VideoFile(args.file, args.fps)
    if video.note:
        print(
            f"swarmtrack video: {video.note.replace('(fps= sets them)', '(--fps sets them)')}",
            file=sys.stderr,
        )
    out = _free_folder(args)
    existed = out.is_dir()
    try:
        out.mkdir(parents=True, exist_ok=True)
        config = _write_config(args, out, video.size)
    except OSError as error:
        raise SourceError(f"--out {out}: {error.strerror}, expected a folder that can be written") from None
    try:
        with ungrouped():  # a source that can never work says so only when it is opened
            return asyncio.run(_track(config, out, video.announced))
    except SwarmtrackError as error:
        # Nothing was tracked: the same command, mended, finds its place free.
        if existed:
            config.unlink()
        else:
            shutil.rmtree(out, ignore_errors=True)
        said = re.sub(rf"{re.escape(str(config))}:\d+: detector\.", "--", str(error))
        raise SourceError(said) from None


def _free_folder(args: argparse.Namespace) -> Path:
    """Where to write, made free if asked for."""
    if args.out is None:
        stem = os.fsencode(args.file.stem).decode(errors="replace")
        return counted_folder(f"{stem}-tracked")
    out: Path = args.out
    if is_taken(out):
        if not args.force:
            raise SourceError(
                f"--out {out}: already exists, expected an empty folder or a new one, or --force to replace it"
            )
        if not (out / CONFIG_NAME).is_file():
            raise SourceError(
                f"--out {out}: is no output of swarmtrack video, so --force does not replace it"
            )
        shutil.rmtree(out)
    return out


def _write_config(args: argparse.Namespace, out: Path, size: tuple[int, int]) -> Path:
    width, height = size
    path = out / CONFIG_NAME
    source = f"file://{quote(os.fsencode(args.file.absolute()))}?pace=fast"
    if args.fps is not None:
        source += f"&fps={args.fps:g}"
    text = CONFIG.format(
        name=path,
        jsonl=json.dumps(str(out.absolute() / "tracks.jsonl")),
        video=json.dumps(str(out.absolute() / "annotated.webm")),
        source=json.dumps(source),
        f=0.5 * width / math.tan(math.radians(0.5 * args.fov)),
        cx=0.5 * (width - 1),
        cy=0.5 * (height - 1),
        width=width,
        height=height,
        turn_from=json.dumps("nothing" if args.still else "images"),
    )
    if args.model is not None:
        text += f"\n[detector]\nmodel = {json.dumps(str(args.model.absolute()))}\n"
        said = {"head": args.head, "names": args.names, "classes": args.classes}
        text += "".join(
            f"{key} = {json.dumps(value, ensure_ascii=False)}\n" for key, value in said.items() if value
        )
    path.write_text(text, encoding="utf-8")
    return path


async def _track(config: Path, out: Path, frames: int) -> int:
    from rich.console import Console as Screen
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from swarmtrack.clock import SystemClock
    from swarmtrack.config.drone import load_config
    from swarmtrack.outputs.console import Console
    from swarmtrack.runtime.agent import Agent
    from swarmtrack.runtime.assembly import assemble

    parts = assemble(load_config(config), SystemClock())
    agent = Agent(parts, console=Console(*parts.lenses, quiet=True))
    columns = TextColumn("tracking"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    screen = Screen(stderr=True)
    with Progress(*columns, console=screen, transient=True, disable=not screen.is_terminal) as progress:
        task = progress.add_task("frames", total=frames or None)
        flying = asyncio.create_task(agent.run())
        try:
            while not flying.done():
                await asyncio.wait({flying}, timeout=LOOK_S)
                progress.update(task, completed=_frames(parts.camera.status()))
        except asyncio.CancelledError:
            agent.stop()
            await flying
            raise
        flying.result()
    tracks = _as_csv(out / "tracks.jsonl", out / "tracks.csv")
    return _tell(parts.camera.status(), out, tracks)


def _frames(camera: LinkStatus) -> int:
    return int(dict(camera.counters).get("frames", 0))


def _as_csv(lines: Path, table: Path) -> set[int]:
    """Confirmed and lost tracks, a row each; returns their numbers."""
    found: set[int] = set()
    with lines.open(encoding="utf-8") as source, table.open("w", encoding="utf-8", newline="") as target:
        writer = csv.DictWriter(target, COLUMNS, extrasaction="ignore")
        writer.writeheader()
        for line in source:
            scan: dict[str, Any] = json.loads(line)
            for track in scan["tracks"]:
                if track["status"] != "tentative":
                    found.add(track["id"])
                    writer.writerow({"t_s": scan["t_s"], "frame": scan["frame"], **track})
    return found


def _tell(camera: LinkStatus, out: Path, tracks: set[int]) -> int:
    print(f"{len(tracks)} track{'' if len(tracks) == 1 else 's'} in {_frames(camera)} frames")
    here = os.path.relpath(out)
    print(f"  {here}/annotated.webm  the video with its tracks; a browser plays it")
    print(f"  {here}/tracks.csv      a row for each track in each frame")
    print(f"  {here}/tracks.jsonl    the same with covariances, and unconfirmed tracks")
    if not camera.ok:
        print(f"swarmtrack video: {camera.text}", file=sys.stderr)
        return 1
    return 0
