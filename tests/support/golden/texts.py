"""Texts that are kept line by line: benchmark tables at fixed seeds, bytes on the wire, help texts."""

from __future__ import annotations

import contextlib
import difflib
import io
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import msgspec
import numpy as np

from support.golden import FOLDER, Moved, Part
from support.golden.flights import RECORDINGS
from support.places import PYTHONPATH, ROOT
from swarmtrack import arguments
from swarmtrack.agents import bench, main, vehicle
from swarmtrack.messages import TrackList
from swarmtrack.recording.reader import recordings_below
from swarmtrack.recording.settings import read_settings
from swarmtrack.replay.replayer import Replayer
from swarmtrack.wire import codec
from swarmtrack.wire.tracks import tracks_message

TABLES = {
    "misconfigured": "--seeds 1 --scenarios hover-triangle --rows nothing swapped 30° 3",
    "motion": "--seeds 1 --teams 3",
    "identity": "--quick",
    "silent": "--seeds 1 --drones 3",
    "formation": "--seeds 1 --flights star-3 leader-lost",
}
"""Benchmark and the options that it is run with."""
ROUNDING = 1e-3  # of the numbers in a table, which are printed with three digits or so

ACTIONS = {
    "config": ("new", "check", "schema", "reference"),
    "log": ("info", "repair", "merge"),
    "keys": ("init", "issue", "revoke", "list"),
    "calibrate": ("board", "intrinsics", "extrinsics", "size"),
    "bench": tuple(bench.BENCHMARKS),
    "mission": ("sway",),
}
HELP_COLUMNS = "100"

SENDERS = ("hover-triangle", "two-cameras", "formation-3")
MACHINE = re.compile(r"Python 3\.\d+\.\d+, swarmtrack ")
PUBLISHED_EVERY = 50
UTC_SIGMA = 1e-3  # s


def tables() -> dict[str, str]:
    """Each benchmark's page in Markdown, without what names the machine and times it."""
    with tempfile.TemporaryDirectory() as folder:
        return {name: _table(name, options.split(), Path(folder)) for name, options in TABLES.items()}


def _table(name: str, options: list[str], folder: Path) -> str:
    command = [sys.executable, "-m", "swarmtrack.agents.main", "bench", name, *options, "--out", str(folder)]
    subprocess.run(command, check=True, capture_output=True, env=os.environ | {"PYTHONPATH": PYTHONPATH})
    (page,) = folder.glob(f"{name}*.md")
    lines = page.read_text(encoding="utf-8").splitlines()
    page.unlink()
    return "\n".join(_without_times(line for line in lines if not MACHINE.search(line))) + "\n"


def _without_times(lines: Iterable[str]) -> Iterator[str]:
    """Tables without the columns that time this machine."""
    timed: list[bool] = []
    for line in lines:
        cells = line.split(" | ")
        if not line.startswith("|"):
            timed = []
        elif not timed:
            timed = [re.search(r"\bCPU\b|\b[mµ]s\b", cell) is not None for cell in cells]
        yield " | ".join(cell for k, cell in enumerate(cells) if not (timed and timed[k]))


def wire() -> dict[str, str]:
    """Hexadecimal: what three recorded agents would have sent of their tracks, every 50th message."""
    found = {}
    for recording in recordings_below(*(RECORDINGS / name for name in SENDERS)):
        published: list[TrackList] = []
        Replayer(recording, read_settings(recording)[0], watcher=published.append).run()
        found[Path(recording.folder).parts[-3]] = "".join(
            codec.encode(_rounded(tracks_message(tracks, number, 0.0, UTC_SIGMA))).hex() + "\n"
            for number, tracks in enumerate(published)
            if number % PUBLISHED_EVERY == 0
        )
    return found


def _rounded(part: Any) -> Any:
    """A message, or a part of one, with single precision: the last bits are the processor's, by its matrix products."""
    match part:
        case float():
            return float(np.float32(part))
        case msgspec.Struct():
            values = {name: _rounded(getattr(part, name)) for name in part.__struct_fields__}
            return msgspec.structs.replace(part, **values)
        case list() | tuple():
            return type(part)(map(_rounded, part))
        case _:
            return part


def help_texts() -> dict[str, str]:
    """Of every command, 100 columns wide."""
    commands = [("swarmtrack",), *(("swarmtrack", name) for name in main.COMMANDS)]
    commands += [("swarmtrack", name, action) for name, actions in ACTIONS.items() for action in actions]
    texts = {
        " ".join(words): _printed(lambda words=words: main.parse([*words[1:], "--help"]))
        for words in commands
    }
    return texts | {"swarmtrack-agent": _printed(lambda: vehicle.main(["--help"]))}


def _printed(program: Callable[[], object]) -> str:
    with (
        mock.patch.dict(os.environ, {"COLUMNS": HELP_COLUMNS}),
        # As in a checkout, also where swarmtrack is installed: help names files as they are reached from here.
        mock.patch.object(arguments, "__file__", str(ROOT / "swarmtrack" / "arguments.py")),
        mock.patch.object(vehicle, "__file__", str(ROOT / "swarmtrack" / "agents" / "vehicle.py")),
        contextlib.chdir(ROOT),
        contextlib.redirect_stdout(io.StringIO()) as out,
        contextlib.suppress(SystemExit),
    ):
        program()
    return out.getvalue()


def _part(kind: str, compute: Callable[[], dict[str, str]]) -> Part:
    """Kept in one file: each text below a line `=== name`."""
    path = FOLDER / f"{kind}.txt"

    def load() -> dict[str, str]:
        parts = re.split(r"^=== (.*)\n", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
        return dict(zip(parts[1::2], parts[2::2], strict=True))

    def save(found: dict[str, str]) -> None:
        path.write_text("".join(f"=== {name}\n{text}" for name, text in found.items()), encoding="utf-8")

    return Part(compute, load, save, compare)


def compare(name: str, kept: str, found: str) -> list[Moved]:
    if kept == found:
        return []
    was, now = kept.splitlines(), found.splitlines()
    changed = [
        line for line in difflib.unified_diff(was, now, lineterm="", n=0) if line[:3] not in ("---", "+++")
    ]
    text = "\n    ".join(line[:200] for line in changed[:12])
    return [Moved(name, f"{len(changed)} lines\n    {text}", not _rounds(kept, found))]


def _rounds(kept: str, found: str) -> bool:
    """Whether only numbers differ, each by less than its rounding."""
    number = r"-?\d+\.\d+|-?\d+"
    if re.sub(number, "#", kept) != re.sub(number, "#", found):
        return False
    pairs = zip(re.findall(number, kept), re.findall(number, found), strict=True)
    return all(abs(float(a) - float(b)) <= ROUNDING * max(1.0, abs(float(a))) for a, b in pairs)


TABLES_PART = _part("tables", tables)
WIRE_PART = _part("wire", wire)
HELP_PART = _part("help", help_texts)
