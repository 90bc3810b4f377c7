"""Arrays with a row per teammate, which may be added and removed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import accumulate
from typing import Self

import numpy as np
from numpy.typing import NDArray


class TeammateRows:
    """All attributes are arrays (n, …); a subclass makes them in `__init__(n)`."""

    def __init__(self, n: int) -> None:
        raise NotImplementedError

    def grow(self, n: int) -> None:
        """Room for n teammates."""
        more = type(self)(n)
        for name, value in vars(self).items():
            vars(more)[name][: len(value)] = value
        vars(self).update(vars(more))

    def remove(self, row: int) -> None:
        """One teammate less."""
        for name, value in vars(self).items():
            vars(self)[name] = np.delete(value, row, 0)

    @classmethod
    def joined(cls, parts: Sequence[tuple[Self, NDArray[np.intp]]]) -> Self:
        """The chosen rows of several, one after the other."""
        made = cls(0)
        for name in vars(made):
            vars(made)[name] = np.concatenate([vars(rows)[name][chosen] for rows, chosen in parts])
        return made

    def return_to(self, parts: Sequence[tuple[Self, NDArray[np.intp]]]) -> None:
        """Put rows back where they were `joined` from."""
        ranges = runs([len(chosen) for _, chosen in parts])
        for (rows, chosen), part in zip(parts, ranges, strict=True):
            for name, value in vars(rows).items():
                value[chosen] = vars(self)[name][part]


def runs(counts: Iterable[int]) -> list[slice]:
    """Where each of several runs is that stand one after the other."""
    ends = list(accumulate(counts))
    return [slice(begin, end) for begin, end in zip([0, *ends], ends, strict=False)]
