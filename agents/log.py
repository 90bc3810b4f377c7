"""`swarmtrack log info|repair|merge`: what a recording holds, one that was cut off made whole, several made one."""

from __future__ import annotations

import argparse
import json
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from swarmtrack.arguments import add_action, add_file, add_flag
from swarmtrack.errors import RecordingError

if TYPE_CHECKING:
    from swarmtrack.recording.info import Summary


def add_arguments(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(dest="action", required=True, metavar="info|repair|merge")
    info = add_action(actions, "info", "topics, counts, rates, gaps and damage")
    info.add_argument("path", type=Path, metavar="FILE|DIR")
    add_flag(info, "--json", "print JSON")
    repair = add_action(actions, "repair", "complete truncated files; the originals are kept as *.cut")
    repair.add_argument("path", type=Path, metavar="FILE|DIR")
    merge = add_action(actions, "merge", "merge several recordings into one file, on one timeline")
    merge.add_argument("paths", type=Path, nargs="+", metavar="FILE|DIR")
    add_file(merge, "--out", "the new file, .mcap", required=True)


def run(args: argparse.Namespace) -> int:
    match args.action:
        case "info":
            return _info(args.path, as_json=args.json)
        case "repair":
            return _repair(args.path)
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
