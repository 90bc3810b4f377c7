"""Kinds of command-line arguments that several programs take."""

from __future__ import annotations

import argparse


def positive_seconds(text: str) -> float:
    """For `type=`: a number of seconds above 0."""
    return positive(text, "number of seconds")


def positive(text: str, what: str = "number") -> float:
    """For `type=`: a number above 0."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"found {text}, expected a {what} above 0")
    return value


def count(text: str) -> int:
    """For `type=`: a whole number from 1 on."""
    if not (text.isascii() and text.isdigit() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"found {text}, expected a whole number above 0")
    return int(text)


def seed(text: str) -> int:
    """For `type=`: what generators of random numbers take."""
    if not (text.isascii() and text.isdigit()):
        raise argparse.ArgumentTypeError(f"found {text}, expected a whole number, 0 or more")
    return int(text)


def port(text: str) -> int:
    """For `type=`: of TCP or UDP, 0 for any that is free."""
    if not (text.isascii() and text.isdigit() and int(text) < 65536):
        raise argparse.ArgumentTypeError(f"found {text}, expected a port, 0 … 65535")
    return int(text)
