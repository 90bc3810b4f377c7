"""Command lines: what is said of a command, and what is not guessed."""

import argparse
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from support.places import ROOT
from swarmtrack import arguments
from swarmtrack.agents import main as swarmtrack
from swarmtrack.arguments import add_action, one_of, page


@pytest.fixture
def parser():
    parser = argparse.ArgumentParser(prog="tool", allow_abbrev=False)
    actions = parser.add_subparsers(required=True)
    add_action(actions, "list", "who has keys").add_argument("--team")
    add_action(actions, "board", "write a board", description="On paper.")
    return parser


@pytest.mark.parametrize(
    ("words", "about"), [(["list", "--help"], "Who has keys."), (["board", "--help"], "On paper.")]
)
def test_the_help_of_an_action_says_what_it_does(parser, capsys, words, about):
    with pytest.raises(SystemExit):
        parser.parse_args(words)
    assert about in capsys.readouterr().out.splitlines()


def test_an_option_that_is_cut_short_is_not_guessed(parser, capsys):
    assert parser.parse_args(["list", "--team", "red"]).team == "red"
    with pytest.raises(SystemExit):
        parser.parse_args(["list", "--te", "red"])
    assert "--te" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("word", "said"),
    [("jpdf", "found jpdf, did you mean jpdaf?"), ("x", "found x, expected a tracker: kalman, jpdaf")],
)
def test_a_name_that_is_none_is_answered_with_the_nearest(word, said):
    tracker = one_of(["kalman", "jpdaf"], "tracker")
    assert tracker("jpdaf") == "jpdaf"
    with pytest.raises(argparse.ArgumentTypeError, match=re.escape(said)):
        tracker(word)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["config", "chek"], "found chek, did you mean check?"),
        (["bench", "identiy"], "found identiy, did you mean identity?"),
        (["keys", "isue"], "found isue, did you mean issue?"),
        (["sim", "--detector", "oracel"], "found oracel, did you mean oracle?"),
        (["log", "\x1b[2J"], "expected a word: info, "),
    ],
)
def test_a_misspelt_action_or_value_is_answered_with_the_nearest(words, said, capsys):
    with pytest.raises(SystemExit) as ended:
        swarmtrack.parse(words)
    assert ended.value.code == 2
    err = capsys.readouterr().err
    assert said in err
    assert "\x1b" not in err


@pytest.mark.parametrize(
    ("word", "said"), [("sin", "did you mean sim?"), ("\x1b[2J", "expected a command: sim, ")]
)
def test_a_command_that_is_none_is_answered_with_the_nearest(capsys, word, said):
    with pytest.raises(SystemExit) as end:
        swarmtrack.parse([word])
    complained = capsys.readouterr().err
    assert end.value.code == 2
    assert said in complained
    assert "\x1b" not in complained


def test_the_help_has_every_command_once_and_in_a_group(capsys):
    with pytest.raises(SystemExit):
        swarmtrack.parse(["--help"])
    said = capsys.readouterr().out
    listed = re.findall(r"^  ([\w-]+) +[a-z]", said.partition("options:")[0], re.MULTILINE)
    assert listed == list(swarmtrack.COMMANDS)
    assert [
        line[:-1] for line in said.splitlines() if line in {f"{group}:" for group in swarmtrack.GROUPS}
    ] == list(swarmtrack.GROUPS)


def test_the_help_of_a_command_begins_with_its_name(capsys):
    with pytest.raises(SystemExit):
        swarmtrack.parse(["log", "--help"])
    assert capsys.readouterr().out.startswith("usage: swarmtrack log ")


def test_a_page_is_named_by_a_path_that_is_there_or_by_where_it_is(monkeypatch, tmp_path):
    # As in a checkout.
    monkeypatch.setattr(arguments, "__file__", str(ROOT / "swarmtrack" / "arguments.py"))
    assert Path(page("security.md")).is_file()
    monkeypatch.chdir(tmp_path)
    assert Path(page("security.md")).is_file()
    # As installed from a wheel, which has no pages.
    monkeypatch.setattr(arguments, "__file__", str(tmp_path / "swarmtrack" / "arguments.py"))
    assert page("security.md") == "docs/security.md in swarmtrack's source"


@pytest.mark.parametrize(
    "words",
    [
        ("main", "sim", "--list"),
        ("main", "--help"),
        ("main", "--version"),
        ("main", "config", "schema"),
        ("vehicle", "--help"),
        ("vehicle", "--config", str(ROOT / "configs" / "sim.toml"), "--check"),
    ],
    ids=" ".join,
)
def test_a_reader_who_has_enough_before_anything_is_read_sees_no_complaint(words):
    """As `swarmtrack sim --list | true`. Where output waits in a buffer, it is first written at the end."""
    program, *rest = words
    surroundings = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    read, write = os.pipe()
    os.close(read)
    try:
        printing = subprocess.run(
            [sys.executable, "-m", f"swarmtrack.agents.{program}", *rest],
            stdout=write,
            stderr=subprocess.PIPE,
            env=surroundings,
            check=False,
        )
    finally:
        os.close(write)
    assert (printing.returncode, printing.stderr) == (0, b"")


def test_what_a_command_ends_with_stays_when_nobody_reads_it(monkeypatch):
    monkeypatch.setattr(swarmtrack, "_run", lambda arguments: print("a verdict") or 1)
    read, write = os.pipe()
    os.close(read)
    with open(write, "w") as stdout:
        monkeypatch.setattr(sys, "stdout", stdout)
        assert swarmtrack.main(["sim", "--seconds", "1"]) == 1
