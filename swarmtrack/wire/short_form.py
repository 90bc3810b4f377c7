"""The short form of a tracks message, for narrow radios: half of the bytes, and the same records.

Floats have 32 bits, but for `t_utc_s`. A covariance is a string of 16-bit integers, big-endian, in the order of its
upper triangle: on the diagonal the logarithm of a standard deviation in units of 1/1024, elsewhere a correlation in
units of 1/32767. Both are rounded such that no covariance shrinks in any direction.
"""

from __future__ import annotations

import struct
from typing import Any, Final

import msgspec
import numpy as np

from swarmtrack.messages import Array
from swarmtrack.wire.checks import symmetric, upper_triangle
from swarmtrack.wire.tracks import RelativeMessage, TrackMessage, TracksMessage

LOG_SIGMA_UNITS: Final = 1024.0
CORRELATION_UNITS: Final = 32767.0
# The logarithm of a standard deviation of zero.
ZERO_SIGMA: Final = -32768
# Rows of a covariance by the length of its upper triangle, of which each entry takes two bytes.
_ROWS = {10: 4, 21: 6}
# Numbers of the fields, by which MessagePack has them.
_TRACKS = TracksMessage.__struct_fields__.index("tracks")
_RELATIVES = TracksMessage.__struct_fields__.index("relatives")
_TRACK_COV = TrackMessage.__struct_fields__.index("cov_upper")
_RELATIVE_COV = RelativeMessage.__struct_fields__.index("cov")
_ARRAY, _LONG_ARRAY, _SINGLE, _T_UTC_S = 0x90, 0xDC, 0xCA, 1


def short_form(message: TracksMessage) -> bytes:
    """Bytes of a message in its short form, without empty fields at its end."""
    fields: list[Any] = list(msgspec.to_builtins(message))
    while not fields[-1] and len(fields) > _TRACKS + 1:
        fields.pop()
    fields[_TRACKS] = [_with_packed(record, _TRACK_COV) for record in fields[_TRACKS]]
    if len(fields) > _RELATIVES:
        fields[_RELATIVES] = [_with_packed(record, _RELATIVE_COV) for record in fields[_RELATIVES]]
    t_utc_s = msgspec.msgpack.encode(fields[_T_UTC_S])
    parts = [t_utc_s if number == _T_UTC_S else _in_single(field) for number, field in enumerate(fields)]
    return bytes([_ARRAY | len(fields)]) + b"".join(parts)


def long_form(data: bytes) -> list[Any] | None:
    """Fields of a message in its short form, its covariances as upper triangles; None where nothing is packed.

    Raises msgspec.MsgspecError for bytes that are no MessagePack. Types and bounds are not checked.
    """
    fields = msgspec.msgpack.decode(data)
    if not isinstance(fields, list):
        return None
    found = [
        _unpacked(record, cov)
        for field, cov in ((_TRACKS, _TRACK_COV), (_RELATIVES, _RELATIVE_COV))
        if len(fields) > field and isinstance(fields[field], list)
        for record in fields[field]
    ]
    return fields if any(found) else None


def pack_covariance(upper: tuple[float, ...]) -> bytes:
    """upper: entries of the upper triangle of a covariance, row by row. The one that is read is larger, or equal.

    Raises ValueError for a variance below zero, or not finite.
    """
    n = _ROWS[len(upper)]
    cov = symmetric(np.array([upper]), n)[0]
    variances = np.diagonal(cov)
    if not np.all((variances >= 0.0) & np.isfinite(variances)):
        raise ValueError(f"covariance: found the variances {variances}, expected finite ones, none negative")

    # Rounding takes half a unit at most from each correlation, and never from a standard deviation.
    logs = np.full(n, float(ZERO_SIGMA))
    some = variances > 0.0
    logs[some] = np.ceil(0.5 * LOG_SIGMA_UNITS * np.log(variances[some] * (1.0 + n / CORRELATION_UNITS)))
    logs = np.clip(logs, ZERO_SIGMA, -ZERO_SIGMA - 1)
    scale = np.outer(_sigma(logs), _sigma(logs))
    numbers = np.zeros((n, n))
    np.divide(cov * CORRELATION_UNITS, scale, out=numbers, where=scale > 0.0)
    np.fill_diagonal(numbers, logs)
    return struct.pack(f">{len(upper)}h", *map(round, upper_triangle(numbers)))


def unpack_covariance(packed: bytes) -> tuple[float, ...]:
    """The upper triangle that `pack_covariance` packed."""
    count = len(packed) // 2
    numbers = symmetric(np.array([struct.unpack(f">{count}h", packed)], float), _ROWS[count])[0]
    sigma = _sigma(np.diagonal(numbers))
    correlation = numbers / CORRELATION_UNITS
    np.fill_diagonal(correlation, 1.0)
    return upper_triangle(correlation * np.outer(sigma, sigma))


def _sigma(logs: Array) -> Array:
    return np.where(logs == ZERO_SIGMA, 0.0, np.exp(logs / LOG_SIGMA_UNITS))


def _with_packed(record: list[Any], cov: int) -> list[Any]:
    return [*record[:cov], pack_covariance(record[cov]), *record[cov + 1 :]]


def _unpacked(record: object, cov: int) -> bool:
    """Whether a record's covariance was packed; then it is unpacked, in place."""
    if not isinstance(record, list) or len(record) <= cov:
        return False
    packed = record[cov]
    if not isinstance(packed, bytes) or len(packed) % 2 or len(packed) // 2 not in _ROWS:
        return False
    record[cov] = list(unpack_covariance(packed))
    return True


def _in_single(value: object) -> bytes:
    """MessagePack of a value or of nested lists, with floats in 32 bits."""
    if isinstance(value, list | tuple):
        n = len(value)
        head = bytes([_ARRAY | n]) if n < 16 else bytes([_LONG_ARRAY]) + struct.pack(">H", n)
        return head + b"".join(map(_in_single, value))
    if isinstance(value, float):
        return bytes([_SINGLE]) + struct.pack(">f", value)
    return msgspec.msgpack.encode(value)
