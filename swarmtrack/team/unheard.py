"""Whether others explain the track of a teammate that says nothing, or only fit it by chance.

While a teammate is silent, its track is compared with all others and not with it. One of them fits: teammates that fly
in formation move alike, and there are hundreds of components by which to fit. So whatever is none of them, the silent
teammate or a stranger, moves with probability `P_MOVES_ALIKE` as the best of their fits says. Then the others can gain
no more by its silence than the logarithm of that, and what speaks against them counts as ever. A track that goes over
to another while its teammate is silent is another matter: what begins after the silence is no fit of the whole. Of that
the motion alone may be by chance; that it is where the other says it is, is none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array
from swarmtrack.team.evidence import fading
from swarmtrack.team.log_sums import log_sum
from swarmtrack.team.priors import P_MOVES_ALIKE


def by_chance(log_ratio: float) -> float:
    """How much of a log ratio for another is owed to chance: all but the logarithm of `P_MOVES_ALIKE`."""
    return max(float(np.logaddexp(math.log1p(-P_MOVES_ALIKE), math.log(P_MOVES_ALIKE) + log_ratio)), 0.0)


class UnheardTrack:
    """A track that was last a teammate which has said nothing `since` [s]. drone_id: that teammate; components, mates:
    how many there are."""

    def __init__(self, drone_id: int, since: float, *, components: int, mates: int) -> None:
        self.drone_id = drone_id
        self.since = since
        self._t = since
        self._before = np.zeros((components, mates))
        """Log ratios when the silence began. What spoke against a teammate, and what was not worked out, is 0: all that
        speaks for it later may be by chance."""
        self._is_new = True
        self._held_back = np.zeros(mates)
        """What was taken from log ratios since, as much of it as has not faded."""

    def held_back(
        self,
        t: float,
        since: Sequence[float],
        base: Array,
        each: Array,
        *,
        used: NDArray[np.intp],
        speak: NDArray[np.bool_],
    ) -> Array:
        """By how much more the log ratios are too large, (m,); of those who are silent themselves by nothing.

        since (s,): when each segment began; base (s, len(used)): log evidence of all before it, and each (s, len(used),
        m): of it, by teammate; used: the components; speak (m,): the teammates that the track is compared with.
        """
        left = fading(t - self._t)
        self._t = t
        self._held_back *= left
        self._before *= left
        whole = [s for s, begun in enumerate(since) if begun <= self.since]
        nobody = log_sum(base[whole], 0)
        ratio = log_sum(base[whole][:, :, None] + each[whole], 0) - nobody[:, None]
        ratio = ratio + self._held_back
        if self._is_new:
            self._before[used], self._is_new = np.maximum(ratio, 0.0), False
        most = float((ratio - self._before[used])[:, speak].max(initial=0.0))
        more = np.where(speak, np.maximum(by_chance(most) - self._held_back, 0.0), 0.0)
        self._held_back += more
        return np.asarray(more)
