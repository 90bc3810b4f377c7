"""Whether others explain the track of a teammate that says nothing, or only fit it by chance.

While a teammate is silent, its track is compared with all others and not with it. One of them fits: teammates that fly
in formation move alike, and there are hundreds of components by which to fit. So whatever is none of them, the silent
teammate or a stranger, moves with probability `P_MOVES_ALIKE` as the best of their fits says. Then the others can gain
no more by its silence than the logarithm of that, and what speaks against them counts as ever. A track that goes over
to another while its teammate is silent is another matter: what begins after the silence is no fit of the whole.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array
from swarmtrack.team.evidence import fading
from swarmtrack.team.priors import P_MOVES_ALIKE


class UnheardTrack:
    """A track that was last a teammate which has said nothing `since` [s]. drone_id: that teammate; components: how
    many there are."""

    def __init__(self, drone_id: int, since: float, components: int) -> None:
        self.drone_id = drone_id
        self.since = since
        self._components = components
        self._t = since
        self._before: Array | None = None
        """(k, m): log ratio of each component and teammate when the silence began. What spoke against it, and what was
        not worked out, is 0: all that speaks for it later may be by chance."""
        self._held_back = 0.0
        """What was taken from the others' log ratios, as much of it as has not faded."""

    def held_back(
        self, t: float, since: Sequence[float], base: Array, each: Array, used: NDArray[np.intp]
    ) -> float:
        """By how much more the log ratios of all others are too large. since (s,): when each segment began; base (s,
        len(used)): log evidence of all before it, and each (s, len(used), m): of it, by other teammate; used: the
        components."""
        left = fading(t - self._t)
        self._t = t
        self._held_back *= left
        whole = [s for s, begun in enumerate(since) if begun <= self.since]
        nobody = np.logaddexp.reduce(base[whole], axis=0)
        ratio = np.logaddexp.reduce(base[whole][:, :, None] + each[whole], axis=0) - nobody[:, None]
        ratio = ratio + self._held_back
        if self._before is None:
            self._before = np.zeros((self._components, ratio.shape[1]))
            self._before[used] = np.maximum(ratio, 0.0)
        self._before *= left
        most = float((ratio - self._before[used]).max(initial=0.0))
        due = max(np.logaddexp(math.log1p(-P_MOVES_ALIKE), math.log(P_MOVES_ALIKE) + most), 0.0)
        more = max(float(due) - self._held_back, 0.0)
        self._held_back += more
        return more
