"""Checks that types and bounds cannot express: finite numbers, unit vectors, valid covariances."""

from __future__ import annotations

import math

import msgspec
import numpy as np
from numpy.typing import NDArray

from swarmtrack.errors import SwarmtrackError
from swarmtrack.messages import Array

# Of a quaternion or direction: far above rounding, far below a mistake.
_NORM_TOLERANCE = 1e-6
# Of the trace: the most negative eigenvalue that rounding may leave.
_COVARIANCE_TOLERANCE = 1e-9
# Rows and columns of an upper triangle, row by row.
_UPPER = {n: np.triu_indices(n) for n in (3, 4, 6)}


class DecodeError(SwarmtrackError):
    """Bytes from the network that are not a valid message; the text names the field and the reason."""


def is_finite(value: object) -> bool:
    """Whether every number in it is finite. The bounds refuse NaN too, but only because of how msgspec compares."""
    if isinstance(value, float):
        return math.isfinite(value)
    if isinstance(value, msgspec.Struct):
        value = msgspec.structs.astuple(value)
    elif isinstance(value, dict):
        value = tuple(value.values())
    if not isinstance(value, tuple):
        return True
    # Floats are looked at here and not in a call each: a message holds hundreds, fifty times a second.
    return all(math.isfinite(item) if type(item) is float else is_finite(item) for item in value)


def check_unit(where: str, components: tuple[float, ...], expected: str) -> None:
    norm = math.sqrt(sum(c * c for c in components))
    if abs(norm - 1.0) > _NORM_TOLERANCE:
        raise DecodeError(f"{where}: norm is {norm:.6g}, expected {expected}")


def check_covariances(where: str, uppers: list[tuple[float, ...]], n: int) -> None:
    """uppers: upper triangles of (n, n) matrices, each to be positive semi-definite."""
    cov = symmetric(np.array(uppers), n)
    try:
        np.linalg.cholesky(cov)
        return
    except np.linalg.LinAlgError:
        # Singular ones are allowed, and need a closer look.
        pass
    smallest = np.linalg.eigvalsh(cov)[:, 0]
    if not np.all(smallest >= -_COVARIANCE_TOLERANCE * np.trace(cov, axis1=1, axis2=2)):
        raise DecodeError(
            f"{where}: has the eigenvalue {smallest.min():.3g}, expected a covariance (none negative)"
        )


def upper_triangle(matrix: Array) -> tuple[float, ...]:
    return tuple(matrix[_UPPER[len(matrix)]].tolist())


def _entries(n: int) -> NDArray[np.intp]:
    """(n, n): which entry of the upper triangle stands there."""
    entry = np.zeros((n, n), dtype=np.intp)
    entry[_UPPER[n]] = np.arange(n * (n + 1) // 2)
    return np.maximum(entry, entry.T)


_ENTRIES = {n: _entries(n) for n in _UPPER}


def symmetric(upper: Array, n: int) -> Array:
    """upper (k, n(n+1)/2), row by row -> (k, n, n)."""
    matrix: Array = upper[:, _ENTRIES[n]]
    return matrix
