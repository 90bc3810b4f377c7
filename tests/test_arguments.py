"""Command lines: what is said of a command, and what is not guessed."""

import argparse

import pytest

from swarmtrack.arguments import add_action


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
