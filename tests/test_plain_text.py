"""Texts from outside: whatever they hold, they can be shown, logged and sent, and stop nothing."""

from __future__ import annotations

import io
import logging
import os
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from support.simulated_agent import SimulatedFlight
from swarmtrack.agents import main as swarmtrack
from swarmtrack.agents import vehicle as agent
from swarmtrack.autopilot.notices import LONGEST_STATUSTEXT_BYTES, Severity, status_text
from swarmtrack.errors import ConfigError, SourceError
from swarmtrack.log_lines import PlainFormatter
from swarmtrack.messages import LinkStatus
from swarmtrack.plain_text import LONGEST_OF_SEVERAL, LONGEST_PLAIN_TEXT, MOST_LINES, plain, plain_lines
from swarmtrack.transport.base import Kind
from swarmtrack.wire.fields import LONGEST_LINE
from swarmtrack.wire.health import HealthMessage, link_health

ANY = st.text(st.characters(exclude_categories=()), max_size=2 * LONGEST_PLAIN_TEXT)
# A window's title, a cleared screen, a forged line, text that runs backwards, half a character.
HOSTILE = (
    "\x1b]0;pwned\x07\x1b[2J\nWARNING all is well\r\u202e\udcff\ud800 \N{LATIN SMALL LETTER A WITH ACUTE}"
)
CLEAN = "�]0;pwned��[2J WARNING all is well ��� á"


@given(ANY, st.integers(1, LONGEST_PLAIN_TEXT))
def test_any_text_becomes_a_line_that_can_be_shown_and_encoded(text, longest):
    line = plain(text, longest)
    assert len(line) == min(len(text), longest)
    assert line.isprintable()
    assert plain(line, longest) == line
    line.encode()


@given(st.text(st.characters(codec="ascii", categories=["L", "N", "P", "S"]), max_size=LONGEST_PLAIN_TEXT))
def test_plain_text_stays_as_it_is(text):
    assert plain(text) == text


def test_what_is_hostile_is_shown_as_such():
    assert plain(HOSTILE) == CLEAN
    assert plain(10 * "x", 4) == "xxx…"


def test_lines_stay_lines_and_are_cut_in_length_and_number():
    assert plain_lines("first\nsecond\x1b[2J") == "first\nsecond�[2J"
    many = plain_lines("\n".join(1000 * ["x" * 3000])).split("\n")
    assert len(many) == MOST_LINES + 1 or len(many) <= MOST_LINES
    assert max(map(len, many)) <= LONGEST_OF_SEVERAL
    assert plain_lines("\n".join(1000 * ["x"])).split("\n")[-2:] == ["x", "…"]


@pytest.mark.parametrize("error", [SourceError(HOSTILE), ConfigError([HOSTILE])])
def test_an_error_for_people_is_plain_but_keeps_its_lines(error):
    assert str(error) == CLEAN.replace(" WARNING", "\nWARNING")


def test_a_line_of_the_log_is_one_line_and_a_traceback_keeps_its_own():
    formatter = PlainFormatter("%(levelname)s: %(message)s")
    record = logging.LogRecord("camera", logging.WARNING, __file__, 1, "camera: %s", (HOSTILE,), None)
    assert formatter.format(record) == f"WARNING: camera: {CLEAN}"
    try:
        raise ValueError("\x1b[2J")
    except ValueError as error:
        record.exc_info = (ValueError, error, error.__traceback__)
    lines = formatter.format(record).split("\n")
    assert lines[0] == f"WARNING: camera: {CLEAN}"
    assert lines[1].startswith("Traceback")
    assert lines[-1] == "ValueError: �[2J"


def test_the_state_of_a_link_is_plain_from_birth_and_fits_the_wire():
    status = LinkStatus(HOSTILE, False, HOSTILE + 100_000 * "x", ((HOSTILE + 99 * "y", 1.0),))
    assert status.name == CLEAN
    assert len(status.text) == LONGEST_PLAIN_TEXT
    said = link_health(status)
    msgspec.msgpack.Decoder(type(said)).decode(msgspec.msgpack.encode(said))


def test_a_ground_station_is_sent_no_control_characters():
    sent = "".join(message.text for message in status_text(Severity.WARNING, HOSTILE + 999 * "x", 1))
    assert len(sent) == LONGEST_STATUSTEXT_BYTES
    assert sent.startswith("?]0;pwned??[2J WARNING all is well ??? ?")


@pytest.mark.parametrize(
    "words",
    [
        pytest.param(HOSTILE, id="hostile"),
        pytest.param(100_000 * "\N{SQUID}", id="wide"),
        pytest.param(
            100_000 * "x", id="long", marks=pytest.mark.long("as long as the wide one, and narrower")
        ),
    ],
)
def test_health_is_sent_each_second_whatever_the_camera_says(tmp_path, words):
    flight = SimulatedFlight(tmp_path)
    lost = LinkStatus("camera", False, words, (("frames", 20.0),))
    flight.at(2.05, setattr, flight.camera, "status", lambda: lost)
    flight.at(2.06, lambda: flight.agent.health.events.append(words))
    flight.fly(6.5)
    said = [message for _, message in flight.messages(HealthMessage, Kind.HEALTH)]
    assert len(said) == 6
    assert "unsendable_health" not in said[-1].drops
    camera = next(link for link in said[-1].links if link.name == "camera")
    assert camera.text.startswith(plain(words, 30).rstrip("…"))
    assert said[-1].events == (plain(words, LONGEST_LINE),)


# --- what is printed ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "encoding",
    [
        "ascii",
        "utf-16",
        "cp037",
        *(
            pytest.param(name, marks=pytest.mark.long("a process for each encoding"))
            for name in ("latin-1", "cp1252", "koi8-r", "utf-8")
        ),
    ],
)
def test_no_encoding_of_stdout_ends_a_program_with_a_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, encoding: str
) -> None:
    """`±` and `…` are not in all of them, and half of a character, as file names may hold it, is in none."""
    config = tmp_path / "drone-\udcff-ж.toml"
    config.write_text(
        '[drone]\nid = 1\nstart = { position_m = [0.0, 0.0, 0.0], yaw_deg = 0.0 }\n[camera]\nsource = "v4l2:///dev/video7"\n'
        "intrinsics = { fx = 400.0, fy = 400.0, cx = 320.0, cy = 240.0, width = 640, height = 480 }\n"
    )
    for program, words in (
        (swarmtrack.main, ["config", "check", str(config)]),
        (swarmtrack.main, ["config", "reference"]),
        (agent.main, ["--config", str(config), "--check"]),
    ):
        stdout = io.TextIOWrapper(io.BytesIO(), encoding=encoding, errors="strict")
        monkeypatch.setattr(sys, "stdout", stdout)
        assert program(words) == 0
        stdout.flush()
        assert len(stdout.buffer.getvalue()) > 100


@pytest.mark.parametrize("module", ["swarmtrack.agents.main", "swarmtrack.diagnosis.findings"])
def test_a_module_prints_in_ascii(module: str) -> None:
    words = [sys.executable, "-m", module, *(["config", "reference"] if module.endswith("main") else [])]
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    assert b"|" in subprocess.run(words, env=environment, capture_output=True, check=True).stdout


def test_a_full_disk_behind_stdout_ends_in_a_sentence() -> None:
    with open("/dev/full", "wb") as full:
        words = [sys.executable, "-m", "swarmtrack.agents.main", "config", "schema"]
        ended = subprocess.run(words, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert ended.returncode == 1
    assert "No space left on device, expected" in ended.stderr
    assert ended.stderr.count("\n") == 1


def test_a_program_whose_stdout_is_closed_says_nothing_and_does_its_work(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "stdout", None)
    assert swarmtrack.main(["config", "schema"]) == 0
