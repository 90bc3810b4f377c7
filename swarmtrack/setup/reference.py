"""All keys of a config, as the models know them: the JSON schema for editors, and a page for people."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import json
import re
import textwrap
from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel, TypeAdapter

from swarmtrack.config import DroneConfig
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.tracking import DEFAULT_TRACKER, TRACKERS
from swarmtrack.tracking.parameters import CommonParameters

Schema = dict[str, Any]

EXTENDS = {
    "anyOf": [{"type": "string"}, {"type": "array", "items": {"type": "string"}}],
    "description": "files this one is layered over, relative to it; later ones, and the file itself, win",
}
HEAD = """\
# Every key of a config

Made by `swarmtrack config reference` from the models that read configs (`swarmtrack/config.py`), and held to them by a
test. The same as a JSON schema: [config.schema.json](config.schema.json), from `swarmtrack config schema`. Editors with
[taplo](https://taplo.tamasfe.dev) (Even Better TOML) complete and check a config that begins with

```toml
#:schema config.schema.json
```

A config is TOML. It may begin with `extends = "team.toml"`, or a list of files: tables are merged key by key, and the
file itself wins over what it extends. Unknown keys are refused. Relative paths of what is read start at the folder of
the file that names them; those of `[output]` at the working directory. `swarmtrack config check drone-1.toml` says what
is wrong, with file and line; `swarmtrack config new` writes a first one; examples are in [configs/](../configs).
"""


def json_schema() -> Schema:
    """JSON schema of a file of a config. Nothing is required of its tables: what one file lacks, another may give."""
    schema = _whole_schema()
    schema.pop("required", None)
    for entry in schema["properties"].values():
        schema["$defs"][_referred(entry)].pop("required", None)
    schema["properties"] = {"extends": EXTENDS, **schema["properties"]}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "A drone's config for swarmtrack",
        **schema,
    }


def _whole_schema() -> Schema:
    """Of a config as it is once its files are merged."""
    schema = DroneConfig.model_json_schema(by_alias=True)
    definitions = schema["$defs"]
    kinds: dict[str, list[type[Any]]] = {
        "TrackerSection": [kind.Parameters for kind in TRACKERS.values()],
        "IdentitySection": [IdentityParameters],
    }
    for section, parameters in kinds.items():
        table = definitions[section]
        table["additionalProperties"] = False
        for kind in parameters:
            for key, entry in _parameters(kind).items():
                known = table["properties"].setdefault(key, entry)
                if known.get("default") != entry.get("default"):
                    known.pop("default", None)  # each tracker has its own
    definitions["TrackerSection"]["properties"]["name"]["enum"] = list(TRACKERS)
    for entry in schema["properties"].values():
        entry.pop("default", None)  # a whole table of defaults tells nothing that its keys do not
    _drop_titles(schema)
    return schema


def reference() -> str:
    """The page docs/config.md."""
    schema = _whole_schema()
    definitions = schema["$defs"]
    parts = [HEAD]
    for name, field in DroneConfig.model_fields.items():
        kind = field.annotation
        assert isinstance(kind, type)
        assert issubclass(kind, BaseModel)
        parts.append(f"## [{name}]\n\n{_about(kind)}\n")
        if name == "tracker":
            parts += _tracker_tables(definitions)
        else:
            parts.append(_table(_rows(definitions[_referred(schema["properties"][name])], definitions)))
    return "\n".join(parts)


def _tracker_tables(definitions: Schema) -> Iterator[str]:
    name = definitions["TrackerSection"]["properties"]["name"]
    yield _table([_row("name", name, definitions)])
    common = _parameters(CommonParameters)
    yield "Of every tracker:\n"
    yield _table(_row(key, entry, definitions) for key, entry in common.items())
    for tracker, kind in TRACKERS.items():
        own = {key: entry for key, entry in _parameters(kind.Parameters).items() if entry != common.get(key)}
        if own:
            note = ", the default" if tracker == DEFAULT_TRACKER else ""
            yield f"Of `{tracker}`{note}, and what it takes differently:\n"
            yield _table(_row(key, entry, definitions) for key, entry in own.items())


# ── tables ───────────────────────────────────────────────────────────────────────────────────────────────────────────

Row = tuple[str, str, str, str]


def _rows(table: Schema, definitions: Schema, prefix: str = "") -> Iterator[Row]:
    """A row for each key, those of tables within after their own."""
    required = table.get("required", ())
    for key, entry in table.get("properties", {}).items():
        name, what, default, meaning = _row(prefix + key, entry, definitions)
        yield name, what, "required" if key in required else default, meaning
        inner = _referred(entry)
        if inner:
            yield from _rows(definitions[inner], definitions, f"{prefix}{key}.")


def _row(key: str, entry: Schema, definitions: Schema) -> Row:
    default = entry.get("default")
    shown = (
        "" if default is None or isinstance(default, dict) else f"`{json.dumps(default, ensure_ascii=False)}`"
    )
    return f"`{key}`", _kind(entry, definitions), shown, entry.get("description", "")


def _table(rows: Iterator[Row] | list[Row]) -> str:
    lines = ["| key | type | default | meaning |", "|---|---|---|---|"]
    lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def _kind(entry: Schema, definitions: Schema) -> str:
    """What a value may be, in words."""
    match entry:
        case {"enum": words}:
            return " or ".join(f"`{json.dumps(word)}`" for word in words)
        case {"const": word}:
            return f"`{json.dumps(word)}`"
        case {"anyOf": kinds}:
            return " or ".join(_kind(kind, definitions) for kind in kinds if kind.get("type") != "null")
        case {"$ref": _}:
            return "table"
        case {"type": "array", "prefixItems": items}:
            return f"[{', '.join(_kind(item, definitions) for item in items)}]"
        case {"type": "array", "items": items}:
            return f"list of {_kind(items, definitions).replace(' or ', ', ')}"
        case {"type": "object"}:
            return "table"
        case {"type": "boolean"}:
            return "true or false"
        case {"type": "string", "format": "path"}:
            return "path"
        case {"type": "string"}:
            return "string"
        case {"type": "integer"}:
            return f"whole number{_bounds(entry)}"
        case _:
            return f"number{_bounds(entry)}"


def _bounds(entry: Schema) -> str:
    signs = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
    return "".join(
        f"{',' if i else ''} {signs[key]} {entry[key]:g}"
        for i, key in enumerate(k for k in signs if k in entry)
    )


# ── from the models ──────────────────────────────────────────────────────────────────────────────────────────────────


def _parameters(kind: type[Any]) -> Schema:
    """The schema of each field of a dataclass, described by the docstring below it."""
    entries: Schema = TypeAdapter(kind).json_schema()["properties"]
    said = _docstrings(kind)
    for key, entry in entries.items():
        entry.pop("title", None)
        if key in said:
            entry["description"] = said[key]
    return entries


def _docstrings(kind: type[Any]) -> dict[str, str]:
    """By field, also of the dataclasses that it extends: the string that stands below it, as one line."""
    said: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
        assert isinstance(body, ast.ClassDef)
        for field, below in zip(body.body, body.body[1:], strict=False):
            match field, below:
                case (
                    ast.AnnAssign(target=ast.Name(id=name)),
                    ast.Expr(value=ast.Constant(value=str(text))),
                ):
                    said[name] = " ".join(text.split())
    return said


def _about(kind: type[BaseModel]) -> str:
    """What the docstring says after `[name]: `."""
    text = " ".join((kind.__doc__ or "").split())
    said = re.sub(r"docs/([\w/.-]+\.md)", r"[\1](\1)", text.partition("]: ")[2] or text)
    return said[:1].upper() + said[1:]


def _referred(entry: Schema) -> str:
    """The name of the table that an entry refers to, or empty."""
    kinds = [entry, *entry.get("anyOf", [])]
    return next((kind["$ref"].rpartition("/")[2] for kind in kinds if "$ref" in kind), "")


def _drop_titles(schema: Any) -> None:
    """pydantic makes one for every key: `Imu Rate Hz`."""
    if isinstance(schema, dict):
        if isinstance(schema.get("title"), str):
            del schema["title"]
        for inner in schema.values():
            _drop_titles(inner)
    elif isinstance(schema, list):
        for inner in schema:
            _drop_titles(inner)
