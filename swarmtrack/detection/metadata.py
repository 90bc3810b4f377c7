"""Metadata in a model's file: text by key, of any origin."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from swarmtrack.errors import ModelError
from swarmtrack.plain_text import plain
from swarmtrack.relative.box_width import BOX_WIDTH_BOUNDS, BoxWidth

PREFIX = "swarmtrack."
LONGEST_ENTRY = 64 << 10  # characters: a thousand classes take half of it
LONGEST_CLASS_NAME, METADATA_SHOWN = 64, 120  # characters
COARSEST_STRIDE_PX = 1024  # px of a stride
LARGEST_METADATA_NUMBER = 1e6
UNREADABLE = (ValueError, TypeError, KeyError, SyntaxError, RecursionError, OverflowError, MemoryError)

T = TypeVar("T")


class Metadata:
    """Our entries of a file, by their keys without `PREFIX`."""

    def __init__(self, path: str, written: Mapping[str, str]) -> None:
        self._path = path
        self._present = ", ".join(sorted(written))
        self.entries = {
            key.removeprefix(PREFIX): text for key, text in written.items() if key.startswith(PREFIX)
        }

    def entry(self, key: str, parse: Callable[[str], T], expected: str, default: T | None = None) -> T:
        """Value of an entry; where it is missing, the default. Raises `ModelError` where it cannot be read, or is
        missing and has none.
        """
        if key not in self.entries:
            if default is not None:
                return default
            raise ModelError(
                f"{self._path}: metadata {PREFIX}{key} is missing (found {self._present}), expected {expected}"
            )
        try:
            return parse(bounded(self.entries[key]))
        except UNREADABLE:
            raise ModelError(
                f"{self._path}: metadata {PREFIX}{key} is {quoted(self.entries[key])}, expected {expected}"
            ) from None


def one_of(allowed: Sequence[str]) -> Callable[[str], str]:
    def parse(text: str) -> str:
        if text not in allowed:
            raise ValueError(text)
        return text

    return parse


def bounded(text: str) -> str:
    if len(text) > LONGEST_ENTRY:
        raise ValueError("too long")
    return text


def quoted(text: str) -> str:
    return plain(repr(text[:METADATA_SHOWN]), METADATA_SHOWN)


def pixels(text: str) -> int:
    if not 1 <= (value := int(text)) <= COARSEST_STRIDE_PX:
        raise ValueError(text)
    return value


def byte(text: str) -> int:
    if not 0 <= (value := int(text)) <= 255:
        raise ValueError(text)
    return value


def fraction(text: str) -> float:
    if not 0 <= (value := float(text)) <= 1:
        raise ValueError(text)
    return value


def number(value: Any) -> float:
    # NaN is within no bounds.
    if not abs(result := float(value)) <= LARGEST_METADATA_NUMBER:
        raise ValueError(value)
    return result


def sigmoid(text: str) -> tuple[float, float]:
    a, b = two(text)
    if a <= 0.0:  # the surest would be the least
        raise ValueError(text)
    return a, b


def two(text: str) -> tuple[float, float]:
    x, y = (number(value) for value in json.loads(text))
    return x, y


def three(text: str) -> tuple[float, float, float]:
    x, y, z = (number(value) for value in json.loads(text))
    return x, y, z


def scale(text: str) -> tuple[float, float, float]:
    value = json.loads(text)
    factors = three(text) if isinstance(value, list) else (number(value),) * 3
    if 0.0 in factors:  # it would see nothing, or the same in all pictures
        raise ValueError(text)
    return factors


def names(text: str) -> tuple[str, ...]:
    listed: Any = json.loads(text)
    if not isinstance(listed, list) or not listed or not all(isinstance(name, str) for name in listed):
        raise ValueError(text)
    return tuple(plain(name, LONGEST_CLASS_NAME) for name in listed)


def box_width_of(path: str, written: Mapping[str, str]) -> BoxWidth | None:
    """Model of the widths of boxes in our metadata; None without one. Raises `ModelError`."""
    text = written.get(f"{PREFIX}box_width")
    if text is None:
        return None
    try:
        return BoxWidth(**json.loads(bounded(text)))
    except UNREADABLE as error:
        found, why = quoted(text), plain(str(error), METADATA_SHOWN)
        raise ModelError(
            f"{path}: metadata {PREFIX}box_width is {found} ({why}), expected a JSON object of "
            f"{', '.join(BOX_WIDTH_BOUNDS)}"
        ) from None
