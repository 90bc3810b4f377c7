"""Arrays with a row per teammate, which may be added and removed."""

from __future__ import annotations

import numpy as np


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
