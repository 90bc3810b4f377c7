"""TOML files layered over one another, with the file and line of every entry, so that errors can point at it.

    extends = "team.toml"            # or a list; relative to this file; later ones, and the file itself, win

Tables are merged key by key, everything else is replaced. Paths of inputs are made absolute in the file that names
them, so that a team file may live in another folder.
"""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

from swarmtrack.errors import ConfigError

Key = tuple[str | int, ...]  # an int: which one of an array
Table = dict[str, Any]

MAX_CONFIG_BYTES = (
    256 * 1024
)  # a config is a page; a recording given by mistake is refused before it is parsed
MOST_FILES = 32  # that one config extends, one that is reached by several ways counted each time
MOST_PARTS = 64  # of a dotted key: a parser takes time by their square
MOST_BITS = 10_000  # of a whole number: Python shows none of 4300 digits
# Beyond these a value's end is not looked for: only the line in an error message is lost.
MAX_STATEMENT_LINES = 200
MAX_SEARCHED = 1 << 20  # characters parsed, some of them again and again
_LONG_KEY = re.compile(
    rf"""(?<![\w"'-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){{{MOST_PARTS}}}"""
)


class Problem(NamedTuple):
    """One wrong entry; sorts by place."""

    file: str
    line: int
    text: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {self.text}"


@dataclass
class Layer:
    """One file. `lines` is filled when an error asks for it."""

    path: Path
    text: str
    table: Table
    _lines: dict[Key, int] = field(default_factory=dict)

    def line(self, key: Key) -> int:
        """The line of an entry, or of the nearest table around it; 1 if there is none."""
        if not self._lines:
            self._lines = {(): 1, **key_lines(self.text)}
        while key not in self._lines:
            key = key[:-1]
        return self._lines[key]


@dataclass
class Layers:
    """Files from the most general to the one that was asked for, and their union."""

    files: list[Layer]
    table: Table

    def problem(self, key: Key, text: str) -> Problem:
        """What is wrong with an entry, at the file and line that count; with one that is missing, at its table."""
        for depth in range(len(key), 0, -1):
            for layer in reversed(self.files):
                if _holds(layer.table, key[:depth]):
                    return Problem(str(layer.path), layer.line(key[:depth]), text)
        return Problem(str(self.files[-1].path), 1, text)


def read_layers(path: Path, prepare: Callable[[Table, Path], None]) -> Layers:
    """Read a file and all it extends. `prepare(table, folder)` may rewrite each file's entries in place.

    Raises ConfigError with all that is wrong with any of the files.
    """
    problems: list[Problem] = []
    files = list(_read(path, (), problems, prepare, count(1)))
    if problems:
        raise ConfigError([str(problem) for problem in problems])
    merged: Table = {}
    for layer in files:
        merged = merge(merged, layer.table)
    return Layers(files, merged)


def _read(
    path: Path,
    extended_by: tuple[Path, ...],
    problems: list[Problem],
    prepare: Callable[[Table, Path], None],
    files: Iterator[int],
) -> Iterator[Layer]:
    """files: counts them."""

    def wrong(line: int, text: str) -> None:
        problems.append(Problem(str(path), line, text))

    text = ""
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_CONFIG_BYTES + 1)
        if len(raw) > MAX_CONFIG_BYTES:
            return wrong(1, f"larger than {MAX_CONFIG_BYTES // 1024} KiB, expected a config in TOML")
        text = raw.decode().removeprefix("\ufeff")
        if long := _LONG_KEY.search(text):
            line = text[: long.start()].count("\n") + 1
            return wrong(line, f"a key of more than {MOST_PARTS} parts, expected a config in TOML")
        layer = Layer(path, text, tomllib.loads(text))
        _check_numbers(layer.table)
    except OSError as error:
        return wrong(1, f"cannot be read ({error.strerror}), expected a config file")
    except UnicodeDecodeError as error:
        line = raw[: error.start].count(b"\n") + 1
        return wrong(line, f"byte 0x{raw[error.start]:02x} is not UTF-8, expected a config in TOML")
    except tomllib.TOMLDecodeError as error:
        return wrong(*_syntax_error(text, str(error)))
    except ValueError as error:  # a number too large
        return wrong(1, f"{error}, expected valid TOML")
    except RecursionError:
        return wrong(1, "nested too deeply, expected a config in TOML")

    line = layer.line(("extends",))
    extends = layer.table.pop("extends", [])
    names = [extends] if isinstance(extends, str) else extends
    if not (isinstance(names, list) and all(isinstance(name, str) for name in names)):
        return wrong(line, f"extends: {names!r}, expected a file name or a list of them")
    chain = (*extended_by, path.resolve())
    for name in names:
        if next(files) >= MOST_FILES:
            return wrong(line, f"extends: more than {MOST_FILES} files in all, expected fewer")
        base = path.parent / os.path.expanduser(name)
        if not os.path.isfile(base):
            wrong(line, f"extends: no file {str(base)!r}, expected one relative to this file")
        elif base.resolve() in chain:
            circle = " -> ".join(file.name for file in (*chain, base))
            wrong(line, f"extends: goes in a circle ({circle}), expected a file that does not lead back here")
        else:
            yield from _read(base, chain, problems, prepare, files)
    prepare(layer.table, path.parent.absolute())
    yield layer


def _check_numbers(value: Any) -> None:
    """Raise ValueError for a whole number that is too large."""
    if isinstance(value, int) and value.bit_length() > MOST_BITS:
        raise ValueError(f"a whole number of more than {MOST_BITS} bits")
    for each in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        _check_numbers(each)


def _syntax_error(text: str, message: str) -> tuple[int, str]:
    """Line and sentence: tomllib says `… (at line 3, column 7)` or `… (at end of document)`."""
    at = re.search(r" \(at line (\d+), column \d+\)$", message)
    line = int(at[1]) if at else text.count("\n") + 1
    what = message[: at.start()] if at else message.removesuffix(" (at end of document)")
    return line, f"{what}, expected valid TOML"


def merge(base: Table, over: Table) -> Table:
    """Their union: tables key by key, of everything else what `over` says."""
    merged = dict(base)
    for key, value in over.items():
        both_tables = isinstance(value, dict) and isinstance(base.get(key), dict)
        merged[key] = merge(base[key], value) if both_tables else value
    return merged


def _holds(table: Any, key: Key) -> bool:
    for part in key:
        if isinstance(part, int):
            held = isinstance(table, list) and part < len(table)
        else:
            held = isinstance(table, dict) and part in table
        if not held:
            return False
        table = table[part]
    return True


def key_lines(text: str) -> dict[Key, int]:
    """The line of every table and entry of a valid TOML text; of each table of an array, by its index.

    tomllib does not tell, so the text is cut into statements: lines are added until they parse by themselves.
    """
    found: dict[Key, int] = {}
    table: Key = ()
    tables: dict[Key, int] = {}  # of each array of tables, how many there are so far
    pending: list[str] = []
    searched = 0
    for number, line in enumerate(text.replace("\r\n", "\n").split("\n"), start=1):
        pending.append(line)
        searched += sum(map(len, pending)) + 1
        if searched > MAX_SEARCHED:
            break
        try:
            parsed = tomllib.loads("\n".join(pending))
        except tomllib.TOMLDecodeError:
            if len(pending) > MAX_STATEMENT_LINES:
                break
            continue
        keys = list(_keys(parsed))
        if pending[0].lstrip().startswith("["):
            table = _within(keys[-1], tables)
            if pending[0].lstrip().startswith("[["):
                tables[table] = tables.get(table, 0) + 1
                table = (*table, tables[table] - 1)
            keys = [table[: depth + 1] for depth in range(len(table))]
            start: Key = ()
        else:
            start = table
        for key in keys:
            found.setdefault(start + key, number - len(pending) + 1)
        pending = []
    return found


def _within(key: Key, tables: dict[Key, int]) -> Key:
    """The key of a table's header with the index of the newest table for each array of tables that it leads through."""
    full: Key = ()
    for part in key[:-1]:
        full = (*full, part)
        if full in tables:
            full = (*full, tables[full] - 1)
    full = (*full, key[-1])
    return full


def _keys(table: Table) -> Iterator[Key]:
    for name, value in table.items():
        yield (name,)
        if isinstance(value, dict):
            yield from ((name, *below) for below in _keys(value))
