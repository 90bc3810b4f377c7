"""A drone's ID, assigned to a track."""

from __future__ import annotations

import math
from collections.abc import Set
from dataclasses import dataclass, field

from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.identity.reprojection import LastSeen
from swarmtrack.identity.standing import Standing

# Of an assigned ID: how rarely a track jumps from one drone to another.
HELD_LOG_ODDS = math.log(1e3)
# Of one whose track met another, or came back from where it was not seen.
HIDDEN_LOG_ODDS = math.log(3.0)
# The probability from which on a track is rather a stranger, and s for which it then stays one by place.
STRANGE, STRANGE_S = 0.5, 10.0


@dataclass(slots=True)
class Assignment:
    """That a track is a drone, and what speaks for it."""

    track_id: int
    drone_id: int
    probability: float
    """That the track is the drone, by the last posterior that judged it."""
    standing: Standing = Standing.SETTLED
    scans: int = 0
    """How many there were since it is challenged or doubted."""
    log_odds: float = HELD_LOG_ODDS
    """In its favour, before the posterior looks where the drones are."""
    evidence: float = -math.inf
    """The log ratio of the last posterior that was sure of it: that the track is the drone, and a stranger."""
    motion: float = 0.0
    """The part of it that motion gave."""
    since: float = -math.inf
    """s: when that was."""
    seen: LastSeen | None = None
    """Where the drone was when it was last detected under a stated ID."""
    met: set[int] = field(default_factory=set)
    """The teammates that came near while the track was not detected: they may have been taken for one another."""
    missed_alone: bool = True
    """Whether no other track came near while it was not detected."""
    verified_t: float = -math.inf
    """s: when these were last asked where they are."""

    @property
    def stated(self) -> bool:
        """Whether the ID is published."""
        return self.standing is not Standing.DOUBTED

    @property
    def undecided(self) -> bool:
        """Whether the posterior is to judge it."""
        return self.standing in (Standing.CHALLENGED, Standing.DOUBTED)

    def enter(self, standing: Standing) -> None:
        """Take the state that the table gave. A judgement starts with no scans; one that is over leaves no doubt."""
        self.standing = standing
        if self.undecided:
            self.scans = 0
        elif standing is Standing.SETTLED:
            self.log_odds = HELD_LOG_ODDS

    def weaken(self, log_odds: float) -> None:
        """There is reason to believe in it no more than this."""
        self.log_odds = min(log_odds, self.log_odds)


@dataclass(slots=True)
class Unassigned:
    """A track without an ID."""

    first_t: float
    unexplained_since: float | None = None
    """s: since when it is probably no announced drone."""
    p_none: float = 0.0
    """The probability that it is none."""
    foreign: bool = False
    """Unexplained for long enough."""
    _strange_since: float | None = None
    """s: since when it is rather no announced drone."""
    _elsewhere: set[int] = field(default_factory=set)
    """The drones that have said where they are all the time since then."""
    _not_of: dict[int, float] = field(default_factory=dict)
    """By drone that it was none of for long, with the drone's place known: when that was so last, s."""

    def weigh(self, p_none: float, t: float, parameters: IdentityParameters, located: Set[int]) -> bool:
        """p_none: that it is no announced drone, by the scan of t; located: the drones that say then where they are.
        Whether one of them may explain it."""
        self.p_none = p_none
        self._remember_strange(t, parameters.foreign_s, located)
        if p_none < parameters.probability:
            self.unexplained_since, self.foreign = None, False
            return True
        if self.unexplained_since is None:
            self.unexplained_since = t
        self.foreign = t - self.unexplained_since >= parameters.foreign_s
        return False

    def was_strange_to(self, drone_id: int, t: float) -> bool:
        """Whether it was rather a stranger for seconds, not long ago, while that drone said where it was: a track stays
        what it is."""
        return t - self._not_of.get(drone_id, -math.inf) < STRANGE_S

    def reconsider(self) -> None:
        """What it was taken for came of a place or a heading that was wrong."""
        self._strange_since = None
        self._not_of.clear()

    def _remember_strange(self, t: float, long: float, located: Set[int]) -> None:
        if self.p_none < STRANGE:
            self._strange_since = None
        elif self._strange_since is None:
            self._strange_since, self._elsewhere = t, set(located)
        else:
            self._elsewhere &= located
            if t - self._strange_since >= long:
                self._not_of |= dict.fromkeys(self._elsewhere, t)
