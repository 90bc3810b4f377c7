"""Messages as records for people: named fields with units, ready for JSON; and back."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import msgspec

from swarmtrack.wire import codec
from swarmtrack.wire.codec import AnyMessage, Message
from swarmtrack.wire.tracks import TracksMessage


def as_record(message: Message) -> dict[str, Any]:
    """The message with named fields, ready for JSON; the names carry the units.

    A track contains its `relative`, or null, and its `camera` unless all tracks are of the first: as in the agent's
    own JSON lines.
    """
    record: dict[str, Any] = _named(message)
    if isinstance(message, TracksMessage):
        relatives = {relative.pop("track_id"): relative for relative in record.pop("relatives")}
        for track, camera in zip(record["tracks"], record.pop("cameras"), strict=False):
            track["camera"] = camera
        for track in record["tracks"]:
            track["relative"] = relatives.get(track["id"])
    return record


def from_record(kind: type[AnyMessage], record: Mapping[str, Any]) -> AnyMessage:
    """Inverse of `as_record`, with the same checks as a received message. Raises DecodeError."""
    fields = _unnamed(_type_info(kind), record)  # type: ignore[arg-type]  # classes are hashable
    return codec.decode(kind, msgspec.msgpack.encode(fields))


@cache
def _type_info(kind: type) -> msgspec.inspect.Type:
    return msgspec.inspect.type_info(kind)


def _unnamed(kind: msgspec.inspect.Type, value: Any) -> Any:
    """A record as the array that stands on the wire; what is no record of this kind is left for msgspec to refuse."""
    match kind:
        case msgspec.inspect.StructType() if isinstance(value, Mapping):
            return [_unnamed(field.type, value.get(field.name)) for field in kind.fields]
        case msgspec.inspect.DictType() if isinstance(value, Mapping):
            return {name: _unnamed(kind.value_type, v) for name, v in value.items()}
        case msgspec.inspect.VarTupleType() if isinstance(value, list | tuple):
            return [_unnamed(kind.item_type, v) for v in value]
        case msgspec.inspect.UnionType() if isinstance(value, Mapping):
            # The unions of ours are a struct or null.
            return next(
                _unnamed(one, value) for one in kind.types if isinstance(one, msgspec.inspect.StructType)
            )
    return value


def _named(value: Any) -> Any:
    if isinstance(value, msgspec.Struct):
        return {name: _named(getattr(value, name)) for name in value.__struct_fields__}
    if isinstance(value, Mapping):
        return {name: _named(v) for name, v in value.items()}
    if isinstance(value, tuple):
        return [_named(v) for v in value]
    return value.hex() if isinstance(value, bytes) else value
