"""TOML tables as pydantic models, and what is wrong with one as `FILE:LINE: key: found, expected`."""

from __future__ import annotations

import dataclasses
import difflib
import json
import re
import sys
import types
import typing
from collections.abc import Callable, Iterable
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, Strict, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from swarmtrack.config.toml.layers import Key, Layers, Problem
from swarmtrack.errors import ConfigError

# Strict: "1" is not 1, and true is not 1.0. A whole number is welcome where a number is asked for.
Number = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0.0)]
NotNegative = Annotated[Number, Field(ge=0.0)]
Probability = Annotated[Number, Field(gt=0.0, lt=1.0)]
Count = Annotated[int, Strict(), Field(gt=0)]
Switch = Annotated[bool, Strict()]
Vector = tuple[Number, Number, Number]
FARTHEST_CONFIGURED_M = 1e7  # what a message can say
Coordinate = Annotated[Number, Field(ge=-FARTHEST_CONFIGURED_M, le=FARTHEST_CONFIGURED_M)]
Place = tuple[Coordinate, Coordinate, Coordinate]
"""m."""
Text = Annotated[str, Field(min_length=1)]


class Section(BaseModel):
    """A table whose keys are all known."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class ParameterSection(BaseModel):
    """A table whose keys are the fields of a dataclass in the core, which says what is right."""

    model_config = ConfigDict(extra="allow", frozen=True)

    @property
    def parameters(self) -> dict[str, Any]:
        """What was given, checked; for `create_tracker`, `IdentityParameters`."""
        return dict(self.model_extra or {})


def parameter_problems(layers: Layers, section: str, kind: type[Any], ignore: str = "") -> list[Problem]:
    """What the dataclass `kind`, whose fields the keys of a section are, has against them."""
    table = layers.table.get(section, {})
    if not isinstance(table, dict):
        return []  # pydantic says so
    hints = typing.get_type_hints(kind)
    known = [field.name for field in dataclasses.fields(kind)]
    values = {key: value for key, value in table.items() if key != ignore}
    problems = []
    for key, value in values.items():
        if key not in known:
            text = f"unknown key, {one_of(key, known)}"
        elif not _is_a(value, hints[key]):
            text = f"{found(value)}, expected {EXPECTED.get(hints[key], str(hints[key]))}"
        else:
            continue
        problems.append(layers.problem((section, key), f"{section}.{key}: {text}"))
    if not problems:
        try:
            kind(**values)
        except ValueError as error:  # `tracker.KEY: found …, expected …`
            key, _, sentence = str(error).partition(": ")
            problems.append(
                layers.problem(tuple(key.split(".")), f"{key}: {sentence.removeprefix('found ')}")
            )
    return problems


EXPECTED: dict[Any, str] = {float: "a number", int: "a whole number", bool: "true or false", str: "a string"}


def _is_a(value: object, kind: Any) -> bool:
    """Whether a TOML value fits a field's type; types that TOML does not have are left to the dataclass."""
    if isinstance(kind, types.UnionType):
        return any(_is_a(value, one) for one in typing.get_args(kind) if one is not type(None))
    if kind is float:
        return (
            isinstance(value, int | float)
            and not isinstance(value, bool)
            and abs(value) <= sys.float_info.max
        )
    if kind is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(value, kind) if kind in EXPECTED else True


S = TypeVar("S", bound=Section)


def validated(
    root: type[S],
    layers: Layers,
    problems: list[Problem],
    among_entries: Callable[[S], Iterable[Problem]] = lambda file: (),
) -> S:
    """The whole of a file as a `root`. Raises ConfigError with every problem that was found.

    problems: those found already; among_entries: what entries, each right by itself, have against each other.
    """
    try:
        file = root.model_validate(layers.table)
    except ValidationError as error:
        wrong = error.errors(include_url=False)
        problems = problems + [section_problem(layers, details, root) for details in wrong]
    problems = problems or list(among_entries(file))
    if problems:
        raise ConfigError([str(problem) for problem in sorted(problems)])
    return file


def section_problem(layers: Layers, error: ErrorDetails, root: type[Section]) -> Problem:
    """One of pydantic's errors with a file whose whole is a `root`, as `FILE:LINE: key: found, expected`."""
    key = _as_written(tuple(error["loc"]), layers.table)
    field = _field(root, key)
    description = field.description if field else None
    match error["type"]:
        case "extra_forbidden":
            text = _unknown(root, key)
        case "missing":
            text = f"missing, expected {description or 'a number'}"
        case "value_error":
            text = error["msg"].removeprefix("Value error, ")
        case "model_type":
            text = f"{found(error['input'])}, expected a table"
        case "string_pattern_mismatch":
            text = f"{found(error['input'])}, expected {description}"
        case _:
            # "Input should be greater than 0", "Tuple should have at most 3 items after validation, not 4"
            expected = re.sub(r"^\w+ should (be|have) ", "", error["msg"])
            expected = re.sub(r"^a valid (tuple|list)$", "a list", expected)  # TOML has no tuples
            text = f"{found(error['input'])}, expected {expected}"
            text += f" ({description})" if description else ""
    return layers.problem(key, f"{key_text(key)}: {text}")


def key_text(key: Key) -> str:
    """A key as people name it: `camera[1].source` is the second camera's."""
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in key).removeprefix(".")


def _as_written(key: Key, table: Any) -> Key:
    """The key without the number of an array's entry where the file has a single table instead."""
    written: list[str | int] = []
    for part in key:
        if isinstance(part, int) and isinstance(table, dict):
            continue
        written.append(part)
        if isinstance(part, int):
            table = table[part] if isinstance(table, list) and part < len(table) else None
        else:
            table = table.get(part) if isinstance(table, dict) else None
    return tuple(written)


def _unknown(root: type[Section], key: Key) -> str:
    """What to say of a key that its table does not have."""
    word, known = str(key[-1]), list(_keys_of(_section(root, key[:-1])))
    elsewhere = [f"[{name}]" for name in _keys_of(root) if word in _keys_of(_section(root, (name,)))]
    if elsewhere:
        return f"unknown key here, expected in {' or '.join(elsewhere)}"
    return f"unknown key, {one_of(word, known)}"


def one_of(word: str, known: list[str]) -> str:
    close = difflib.get_close_matches(word, known, n=1)
    return f'did you mean "{close[0]}"?' if close else f"expected one of {', '.join(known)}"


def _keys_of(section: type[BaseModel]) -> dict[str, FieldInfo]:
    return {field.alias or name: field for name, field in section.model_fields.items()}


def _field(root: type[Section], key: Key) -> FieldInfo | None:
    return _keys_of(_section(root, key[:-1])).get(str(key[-1])) if key else None


def _section(root: type[Section], key: Key) -> type[BaseModel]:
    """The model of a table; of the nearest one around it where it has none."""
    section: type[BaseModel] = root
    for part in key:
        field = _keys_of(section).get(str(part))
        kinds = [field.annotation, *typing.get_args(field.annotation)] if field else []
        inner = [kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseModel)]
        section = inner[0] if inner else section
    return section


def check_drone_ids(keys: Iterable[str], example: str) -> None:
    """Check the keys of a table by drone, with an entry of it as an example. Raises ValueError."""
    for key in keys:
        if not re.fullmatch("[1-9][0-9]{0,4}", key, re.ASCII) or int(key) > 65535:
            raise ValueError(f"found the key {found(key)}, expected drone IDs: {example}")


def found(value: object) -> str:
    """A value as TOML would write it, shortened."""
    text = json.dumps(value, default=str, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}…"
