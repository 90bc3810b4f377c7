"""The example in C++ reads the pinned bytes, and what is no message ends it with a sentence."""

from __future__ import annotations

import math
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from support.golden_bytes import ANNOUNCEMENT_BYTES, HEALTH_BYTES, PLACED_TRACKS_BYTES, TRACKS_BYTES
from support.places import ROOT
from swarmtrack.wire import codec
from swarmtrack.wire.tracks import TracksMessage

SOURCE = ROOT / "docs" / "examples" / "read_tracks.cpp"
COMPILER = next(filter(None, map(shutil.which, ("c++", "g++", "clang++"))), None)


@pytest.fixture(scope="module")
def program(tmp_path_factory) -> Path:
    if COMPILER is None:
        pytest.skip("no C++ compiler is installed here")
    path = tmp_path_factory.mktemp("cpp") / "read_tracks"
    subprocess.run(
        [COMPILER, "-std=c++17", "-Wall", "-Wextra", "-Werror", "-o", str(path), str(SOURCE)], check=True
    )
    return path


def read(program: Path, data: bytes) -> tuple[int, str, str]:
    done = subprocess.run([program], input=data, capture_output=True, check=False, timeout=60)
    return done.returncode, done.stdout.decode(), done.stderr.decode()


def test_it_says_who_is_where(program):
    data = bytes.fromhex(PLACED_TRACKS_BYTES)
    (place,) = codec.decode(TracksMessage, data).relatives
    north, east, down = place.position_m
    code, said, errors = read(program, data)
    assert (code, errors) == (0, "")
    assert "track 1: drone 2 (0.75) at (320.0, 256.0) px" in said
    assert (
        f"north {north:.2f} east {east:.2f} down {down:.2f} m, {math.hypot(north, east, down):.2f} m ± 0.50"
        in said
    )


def test_it_reads_the_short_form_as_well(program):
    long = codec.decode(TracksMessage, bytes.fromhex(PLACED_TRACKS_BYTES))
    short = codec.encode(long, short=True)
    assert b"\xc4" in short
    assert read(program, short) == read(program, bytes.fromhex(PLACED_TRACKS_BYTES))


def test_a_message_without_places_and_a_longer_one_of_tomorrow_are_read(program):
    data = bytes.fromhex(TRACKS_BYTES)
    assert "track 1: foreign (0.75)" in read(program, data)[1]
    placed = bytes.fromhex(PLACED_TRACKS_BYTES)
    assert placed[0] == 0x98
    # One field more, a nil.
    longer = read(program, b"\x99" + placed[1:] + b"\xc0")
    assert longer == read(program, placed)


@pytest.mark.parametrize("message", [ANNOUNCEMENT_BYTES, HEALTH_BYTES], ids=["announcement", "health"])
def test_another_message_is_none_of_tracks(program, message):
    code, _, errors = read(program, bytes.fromhex(message))
    assert (code, "no message of tracks" in errors) == (1, True)


def test_what_is_cut_off_or_claims_too_much_is_refused(program):
    whole = bytes.fromhex(PLACED_TRACKS_BYTES)
    torn = [whole[:k] for k in range(0, len(whole), 37)]
    claims = [
        b"\xdd\xff\xff\xff\xff",
        b"\xdf\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
        b"\x91" * 60_000,
        b"\xc1",
    ]
    for data in [*torn, *claims]:
        code, _, errors = read(program, data)
        assert (code, "no message of tracks" in errors) == (1, True), data[:20]


def test_the_lines_on_the_page_are_those_of_the_example():
    page = (ROOT / "docs" / "wire.md").read_text(encoding="utf-8")
    section = page.split("### Tracks", 1)[1].split("### Health", 1)[0]
    source = " ".join(SOURCE.read_text(encoding="utf-8").split())
    blocks = re.findall(r"```cpp\n(.*?)```", section, re.DOTALL)
    assert blocks
    for block in blocks:
        assert " ".join(block.split()) in source
