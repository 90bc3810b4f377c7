"""Command lines: tables of commands, kinds of arguments that several programs take, and extras that commands need."""

from __future__ import annotations

import argparse
import difflib
import itertools
import os
import re
from collections.abc import Callable, Iterable, Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from swarmtrack.errors import MissingExtraError
from swarmtrack.plain_text import plain


def add_commands(
    parser: argparse.ArgumentParser,
    table: Mapping[str, tuple[str, str]],
    *,
    dest: str,
    metavar: str,
    of: str = "",
    **more: Any,
) -> None:
    """A command for each name in the table of (module, summary), one of which a command line must name. more: as
    `add_subparsers` takes it.

    Its module is imported when a command line names it, not before, so `--help` answers at once; it, or what is named
    `of` in it, then adds its own arguments by `add_arguments(parser)`.
    """
    commands = parser.add_subparsers(dest=dest, required=True, metavar=metavar, parser_class=_Command, **more)
    for name, (module, summary) in table.items():
        command = add_action(commands, name, summary)
        command.module, command.of = module, of


def add_action(actions: Any, name: str, summary: str, **more: Any) -> Any:
    """The parser of one of the `add_subparsers` actions; more: as `add_parser` takes it.

    summary: for the list of actions; without a description of its own, its help begins with it.
    """
    about = f"{summary[0].upper()}{summary[1:]}."
    return actions.add_parser(name, help=summary, allow_abbrev=False, **({"description": about} | more))


class _Command(argparse.ArgumentParser):
    """The parser of one command of a table."""

    module: str | None = None
    """That has still to add its arguments."""
    of: str = ""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        if self.module is not None:
            module = import_module(self.module)
            (getattr(module, self.of) if self.of else module).add_arguments(self)
            self.module = None
        return super().parse_known_args(args, namespace)

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        # Argparse lists all choices, also where one letter is missing.
        if action.choices is not None and value not in action.choices:
            what = "value" if action.option_strings else "word"
            said = unknown(what, str(value), map(str, action.choices))
            raise argparse.ArgumentError(action, f"found {plain(str(value), 40)}, {said}")


def add_file(
    parser: argparse.ArgumentParser, name: str, help: str, metavar: str = "FILE", **more: Any
) -> None:
    """An argument that is a file; more: as `add_argument` takes it."""
    parser.add_argument(name, type=Path, metavar=metavar, help=help, **more)


def add_folder(
    parser: argparse.ArgumentParser, name: str, help: str, metavar: str = "DIR", **more: Any
) -> None:
    """An argument that is a folder; more: as `add_argument` takes it."""
    parser.add_argument(name, type=Path, metavar=metavar, help=help, **more)


def add_flag(parser: argparse.ArgumentParser, name: str, help: str) -> None:
    """An option without a value: False unless it is given."""
    parser.add_argument(name, action="store_true", help=help)


def add_list(parser: argparse.ArgumentParser, name: str, help: str, metavar: str, **more: Any) -> None:
    """An option that may be given again for more: a list, empty where it is not given."""
    parser.add_argument(name, action="append", default=[], metavar=metavar, help=help, **more)


def add_seconds(parser: argparse.ArgumentParser, name: str, help: str, default: float | None = None) -> None:
    """An option that is a length of time, above 0 s."""
    parser.add_argument(name, type=positive_seconds, default=default, metavar="S", help=help)


def add_seed(parser: argparse.ArgumentParser, help: str, default: int | None) -> None:
    """--seed K: of what is left to chance."""
    parser.add_argument("--seed", type=seed, default=default, metavar="K", help=help)


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


def one_of(names: Iterable[str], what: str) -> Callable[[str], str]:
    """For `type=`: one of the names; a word that is none is answered with the nearest. what: what they are names of."""
    known = list(names)

    def name(text: str) -> str:
        if text not in known:
            raise argparse.ArgumentTypeError(f"found {text}, {unknown(what, text, known)}")
        return text

    return name


def unknown(what: str, word: str, known: Iterable[str]) -> str:
    """What to say of a word that names nothing."""
    names = list(known)
    close = difflib.get_close_matches(word, names, n=1)
    return f"did you mean {close[0]}?" if close else f"expected a {what}: {', '.join(names)}"


def require_extra(extra: str, *packages: str, of: str) -> None:
    """Refuse to begin work that needs packages which are not installed.

    extra: the extra in pyproject.toml that brings them; of: the command or option that needs them.
    """
    missing = [package for package in packages if find_spec(package) is None]
    if missing:
        by_name = f"pip install {' '.join(missing)}"
        raise MissingExtraError(
            f"{of} needs {' and '.join(missing)}: {by_name}, or in swarmtrack's source pip install '.[{extra}]'"
        )


def page(name: str) -> str:
    """How a page of the documentation is named to a user who may have installed the program without it."""
    file = Path(__file__).parents[1] / "docs" / name
    if not file.is_file():
        return f"docs/{name} in swarmtrack's source"
    return os.path.relpath(file) if file.is_relative_to(Path.cwd()) else str(file)


def with_pages(text: str) -> str:
    """A text that names pages as docs/NAME.md, with each named as `page` does."""
    return re.sub(r"\bdocs/(\w+\.md)", lambda found: page(found[1]), text)


def port(text: str) -> int:
    """For `type=`: of TCP or UDP, 0 for any that is free."""
    if not (text.isascii() and text.isdigit() and int(text) < 65536):
        raise argparse.ArgumentTypeError(f"found {text}, expected a port, 0 … 65535")
    return int(text)


def is_taken(out: Path) -> bool:
    """Whether there is something else than an empty folder."""
    return out.exists() and (not out.is_dir() or any(out.iterdir()))


def counted_folder(name: str) -> Path:
    """NAME in the current folder, else NAME-2 and so on: the first that is free."""
    names = (Path(name if k == 1 else f"{name}-{k}") for k in itertools.count(1))
    return next(folder for folder in names if not is_taken(folder))
