"""docs/wire.md is enough: a decoder that is made of its tables, and knows nothing else of us, reads every message."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import Any, NamedTuple

import msgpack
import msgspec
import pytest

from support.golden_bytes import EVERY_MESSAGE
from support.places import ROOT
from swarmtrack.transport.keys import MESSAGES
from swarmtrack.wire import codec
from swarmtrack.wire.checks import DecodeError

PAGE = (ROOT / "docs" / "wire.md").read_text(encoding="utf-8")
NAMED = {kind.__name__.removesuffix("Message"): kind for kind in MESSAGES.values()}
CAN_BE_ABSENT = re.compile(r"\belse absent\b")
PLAIN = {"int": int, "float": (float, int), "str": str, "bin": bytes, "bool": bool}


class Field(NamedTuple):
    """A row of a table; a row of several fields is as many of these."""

    name: str
    type: str
    says: str


Table = list[Field]


def tables_of(section: str) -> Iterator[tuple[str, Table]]:
    """Each table with the line that introduces it."""
    caption, table = "", []
    for line in [*section.splitlines(), ""]:
        if line.startswith("| # |") or line.startswith("|---"):
            continue
        if line.startswith("|"):
            _, _, names, kind, says, *_ = re.split(r"(?<!\\)\|", line)
            fields = re.findall(r"`(\w+)`", names)
            if len(fields) > 1:
                kind = kind.replace("floats", "float").replace("ints", "int")
            table += [Field(name, kind.strip(), says) for name in fields]
        elif table:
            yield caption, table
            table = []
        if line and not line.startswith("|"):
            caption = line


def read_page() -> tuple[dict[str, Table], dict[str, Table]]:
    """The table of each message, by its heading; and of each record, by the field that holds it."""
    messages, records = {}, {}
    for part in re.split(r"^### ", PAGE, flags=re.MULTILINE)[1:]:
        section = re.split(r"^## ", part, flags=re.MULTILINE)[0]
        heading = section.split(" ", 1)[0]
        if "| # |" not in section:
            continue
        (_, messages[heading]), *parts = tables_of(section)
        for caption, table in parts:
            found = re.search(r"and (each|the) (\w+)", caption)
            assert found, f"{heading}: a table after {caption!r}, expected 'and each …' or 'and the …'"
            records[found[2] + ("s" if found[1] == "each" else "")] = table
    return messages, records


MESSAGE_TABLES, RECORD_TABLES = read_page()


def understood(where: str, value: Any, name: str, kind: str) -> Any:
    """A value as the page describes it. Fails where it is something else."""
    if value is None:
        assert kind.endswith("nil"), f"{where}: nil, expected {kind}"
        return None
    kind = re.sub(r"(,| or) nil$", "", kind)
    alternatives = re.findall(r'"(\w+)"', kind)
    if alternatives:
        assert value in alternatives or (kind.startswith("int") and type(value) is int), f"{where}: {value!r}"
        return value
    if kind in PLAIN:
        # To Python, True is a number.
        assert isinstance(value, PLAIN[kind]), f"{where}: {value!r}, expected {kind}"
        assert isinstance(value, bool) == (kind == "bool"), f"{where}: {value!r}, expected {kind}"
        return value
    if kind == "record":
        return by_position(where, value, RECORD_TABLES[name])
    if kind == "[records]":
        return [by_position(f"{where}[{i}]", part, RECORD_TABLES[name]) for i, part in enumerate(value)]
    assert isinstance(value, list | dict), f"{where}: {value!r}, expected {kind}"
    if found := re.fullmatch(r"\[(\d+ )?(float|int|str)s?\]", kind):
        assert not found[1] or len(value) == int(found[1]), f"{where}: {len(value)}, expected {kind}"
        return [understood(where, part, name, found[2]) for part in value]
    if found := re.fullmatch(r"\{name: (.*)\}", kind):
        return {key: understood(f"{where}.{key}", part, name, found[1]) for key, part in value.items()}
    if kind.startswith("[["):
        return [understood(where, part, name, kind[1:-1]) for part in value]
    assert kind.startswith("[`"), f"{where}: the page says {kind!r}, which this test does not understand"
    names = re.findall(r"`(\w+)`", kind)
    assert len(names) == len(value), where
    return dict(zip(names, value, strict=True))


def by_position(where: str, values: list[Any], table: Table) -> dict[str, Any]:
    """Fields at the end may be absent, where the page says so: a decoder has them as nil or empty."""
    absent = table[len(values) :]
    assert len(values) <= len(table), f"{where}: {len(values)} fields, the page has {len(table)}"
    assert all(CAN_BE_ABSENT.search(field.says) for field in absent), f"{where}: {absent} not there"
    return {
        field.name: understood(f"{where}.{field.name}", value, field.name, field.type)
        for field, value in zip(table, values, strict=False)
    } | {field.name: [] if field.type.startswith("[ints") else None for field in absent}


def as_dict(value: Any) -> Any:
    """Our own decoder's answer in the same shape."""
    if isinstance(value, msgspec.Struct):
        return {name: as_dict(part) for name, part in msgspec.structs.asdict(value).items()}
    if isinstance(value, dict):
        return {name: as_dict(part) for name, part in value.items()}
    if isinstance(value, tuple):
        return [as_dict(part) for part in value]
    return value


def test_the_page_has_a_table_of_every_message_and_bytes_are_pinned_of_each():
    assert set(MESSAGE_TABLES) == set(NAMED) == set(EVERY_MESSAGE)
    assert set(RECORD_TABLES) == {"sightings", "rays", "located", "tracks", "relatives", "lens", "others"}


@pytest.mark.parametrize("heading", sorted(NAMED))
def test_whoever_has_only_the_page_reads_what_we_mean(heading):
    data = bytes.fromhex(EVERY_MESSAGE[heading])
    read = by_position(heading, msgpack.unpackb(data), MESSAGE_TABLES[heading])
    assert read == as_dict(codec.decode(NAMED[heading], data))


@pytest.mark.parametrize("heading", sorted(NAMED))
def test_a_field_of_another_type_is_noticed(heading):
    """That the test above does look at types."""
    fields = msgpack.unpackb(bytes.fromhex(EVERY_MESSAGE[heading]))
    for i, field in enumerate(MESSAGE_TABLES[heading]):
        wrong = "wrong" if field.type.startswith("bin") else b"wrong"
        with pytest.raises((AssertionError, TypeError, AttributeError)):
            by_position(heading, [*fields[:i], wrong, *fields[i + 1 :]], MESSAGE_TABLES[heading])


NUMBER = r"([0-9]+[⁰¹²³⁴⁵⁶⁷⁸⁹]*(?:−1)?|π)"
SUPERSCRIPT = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹", "0123456789")


def number(text: str) -> float:
    """65535, 10⁷, 2³²−1, π."""
    if text == "π":
        return math.pi
    base, power, less = re.fullmatch(r"([0-9]+)([⁰¹²³⁴⁵⁶⁷⁸⁹]*)(−1)?", text).groups()
    return int(base) ** int(power.translate(SUPERSCRIPT) or 1) - (1 if less else 0)


def bounds(field: Field) -> tuple[float, float] | None:
    """As the page says them first; above a bound means that it is excluded, which is not looked at here."""
    if found := re.search(rf"within ±{NUMBER}", field.says):
        return -number(found[1]), number(found[1])
    if found := re.search(rf"above 0, to {NUMBER}", field.says):
        return 0.0, number(found[1])
    if found := re.search(rf"{NUMBER} … {NUMBER}", field.says):
        return number(found[1]), number(found[2])
    return None


def bounded_fields() -> Iterator[Any]:
    """Each with the way to it from the message's array, and the value that is allowed at most."""
    for heading, table in MESSAGE_TABLES.items():
        for i, field in enumerate(table):
            if bounds(field):
                yield pytest.param(heading, (i,), field, id=f"{heading}.{field.name}")
            inner = RECORD_TABLES.get(field.name, ()) if "record" in field.type else ()
            for k, part in enumerate(inner):
                way = (i, k) if field.type == "record" else (i, 0, k)
                if bounds(part):
                    yield pytest.param(heading, way, part, id=f"{heading}.{field.name}.{part.name}")


@pytest.mark.parametrize(("heading", "way", "field"), list(bounded_fields()))
def test_beyond_the_bounds_of_the_page_nothing_is_believed(heading, way, field):
    low, high = bounds(field)
    step = 1 if field.type == "int" or field.type.startswith("int,") else 1e-3 * (high - low)
    for value in (low - step, high + step):
        fields = msgpack.unpackb(bytes.fromhex(EVERY_MESSAGE[heading]))
        place = fields
        for k in way[:-1]:
            place = place[k]
        if field.type.startswith("["):
            place[way[-1]] = [value, *place[way[-1]][1:]]
        else:
            place[way[-1]] = value
        with pytest.raises(DecodeError):
            codec.decode(NAMED[heading], msgpack.packb(fields))


def test_enough_bounds_are_looked_at():
    assert len(list(bounded_fields())) > 30


def test_the_keys_of_the_page_are_all_there_are():
    told = set(re.findall(r"^\| `(\w+)/<id>", PAGE, flags=re.MULTILINE))
    assert told == {str(kind) for kind in MESSAGES} | {"alive"}
