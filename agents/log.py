"""`swarmtrack log`: what a recording holds; repaired, merged, as tables, as a bag of ROS 2."""

from __future__ import annotations

import argparse
import json
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from swarmtrack.arguments import (
    add_action,
    add_file,
    add_flag,
    add_folder,
    counted_folder,
    is_taken,
    positive,
    require_extra,
)
from swarmtrack.errors import RecordingError

if TYPE_CHECKING:
    from swarmtrack.recording.info import Summary


def add_arguments(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(dest="action", required=True, metavar="info|repair|merge|csv|rosbag")
    info = add_action(actions, "info", "topics, counts, rates, gaps and damage")
    info.add_argument("path", type=Path, metavar="FILE|DIR")
    add_flag(info, "--json", "print JSON")
    repair = add_action(actions, "repair", "complete truncated files; the originals are kept as *.cut")
    repair.add_argument("path", type=Path, metavar="FILE|DIR")
    merge = add_action(actions, "merge", "merge several recordings into one file, on one timeline")
    merge.add_argument("paths", type=Path, nargs="+", metavar="FILE|DIR")
    add_file(merge, "--out", "the new file, .mcap", required=True)
    tables = add_action(actions, "csv", "write tracks, places, identities, health, ego and truth as tables")
    _add_conversion(tables, "csv")
    add_flag(tables, "--parquet", "also write each table as Parquet (extra parquet)")
    bag = add_action(actions, "rosbag", "write a ROS 2 bag with the topics of swarmtrack ros2 (extra rosbag)")
    _add_conversion(bag, "rosbag")
    bag.add_argument(
        "--hz", type=positive, default=20.0, help="tracks per drone and second, at most; default: 20"
    )


def _add_conversion(parser: argparse.ArgumentParser, suffix: str) -> None:
    parser.add_argument("paths", type=Path, nargs="+", metavar="FILE|DIR")
    add_folder(
        parser, "--out", f"output folder (default: NAME-{suffix}, NAME-{suffix}-2 … in the current folder)"
    )
    add_flag(parser, "--force", "replace an --out that already exists")


def run(args: argparse.Namespace) -> int:
    match args.action:
        case "info":
            return _info(args.path, as_json=args.json)
        case "repair":
            return _repair(args.path)
        case "csv":
            return _csv(args)
        case "rosbag":
            return _rosbag(args)
    return _merge(args.paths, args.out)


def _info(path: Path, *, as_json: bool) -> int:
    from swarmtrack.recording.info import summarise
    from swarmtrack.recording.reader import recordings_below

    summaries = [summarise(recording) for recording in recordings_below(path)]
    if as_json:
        print(json.dumps([summary.as_record() for summary in summaries], indent=1))
        return 0
    for summary in summaries:
        _print(summary)
    return 0


def _print(summary: Summary) -> None:
    preface = summary.preface
    who = f"drone {preface['drone_id']}" if preface["kind"] == "drone" else "messages of the swarm"
    begin = datetime.fromtimestamp(summary.begin_ns * 1e-9, UTC)
    size = sum(size for _, size, _ in summary.files)
    print(f"{summary.folder}: {who} of team {preface['team']}")
    print(
        f"  {begin:%Y-%m-%d %H:%M:%S} UTC, {summary.seconds:.1f} s, {len(summary.files)} files, {size / 1e6:.1f} MB"
    )
    for damage in summary.damage:
        print(f"  damaged: {damage}; `swarmtrack log repair` completes it")
    if int(preface["segment"]) > 1:
        print(f"  begins with segment {preface['segment']}: older ones were deleted")
    width = max((len(name) for name in summary.topics), default=0)
    for name, topic in sorted(summary.topics.items()):
        rate = (
            ""
            if topic.rate_hz is None
            else f"{topic.rate_hz:8.1f} Hz   longest gap {topic.gap_ns * 1e-9:.2f} s"
        )
        print(f"  {name:{width}}  {topic.count:8}  {rate}")


def _repair(path: Path) -> int:
    from swarmtrack.recording.reader import files_below
    from swarmtrack.recording.repair import repair

    failed = False
    for file in files_below(path):
        try:
            repaired = repair(file)
        except RecordingError as error:
            print(f"swarmtrack log: {error}", file=sys.stderr)
            failed = True
            continue
        if repaired is None:
            print(f"{file}: is complete")
        else:
            print(f"{repaired.target}: {repaired.messages} messages saved (the file {repaired.damage})")
    return 1 if failed else 0


def _merge(paths: list[Path], out: Path) -> int:
    from swarmtrack.recording.merge import merge
    from swarmtrack.recording.reader import recordings_below

    recordings = recordings_below(*paths)
    moved, count = merge(recordings, out)
    for recording, shift in zip(recordings, moved, strict=True):
        print(f"{recording.folder}: shifted by {1e3 * shift.seconds:+.3f} ms (by {shift.by})")
    print(f"{out}: {count} messages of {len(recordings)} recordings")
    return 0


def _csv(args: argparse.Namespace) -> int:
    if args.parquet:
        require_extra("parquet", "pyarrow", of="swarmtrack log csv --parquet")
    from swarmtrack.client.flight_tables import TABLES, write_parquet, write_tables

    out = _free_folder(args, "csv", {f"{name}{suffix}" for name in TABLES for suffix in (".csv", ".parquet")})
    rows = write_tables(tuple(args.paths), out, _say)
    if args.parquet:
        write_parquet(out, list(rows))
    for name, written in rows.items():
        print(f"{out / name}.csv: {written} rows")
    if missing := [name for name in TABLES if name not in rows]:
        print(f"not in this recording: {', '.join(missing)}")
    return 0


def _rosbag(args: argparse.Namespace) -> int:
    require_extra("rosbag", "rosbags", of="swarmtrack log rosbag")
    from swarmtrack.client.ros2_bag import write_bag

    out = _free_folder(args, "rosbag", {"metadata.yaml", "*.mcap"})
    written = write_bag(tuple(args.paths), out, hz=args.hz, progress=_say)
    print(f"{out}: {written} messages; `ros2 bag play {out}` plays it")
    return 0


def _say(text: str) -> None:
    print(f"swarmtrack log: {text}", file=sys.stderr)


def _free_folder(args: argparse.Namespace, suffix: str, own: set[str]) -> Path:
    """Where to write, made free if asked for. own: patterns of what such a folder holds."""
    from swarmtrack.recording.reader import files_below

    for path in args.paths:
        files_below(path)  # before anything is removed
    if args.out is None:
        return counted_folder(f"{args.paths[0].resolve().stem}-{suffix}")
    out: Path = args.out
    if is_taken(out):
        if not args.force:
            raise RecordingError(
                f"--out {out}: already exists, expected an empty folder or a new one, or --force to replace it"
            )
        found = list(out.iterdir()) if out.is_dir() else []
        written = [file for file in found if any(file.match(each) for each in own)]
        if not written:
            raise RecordingError(
                f"--out {out}: is no output of swarmtrack log {suffix}, so --force does not replace it"
            )
        for file in written:
            file.unlink()
    if out.is_dir() and not is_taken(out):
        out.rmdir()  # a bag's folder must be new
    return out
