"""How teammates move by what was agreed before the flight, a code or a plan: nothing of it is on the air."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from swarmtrack.identity.motion_evidence import CODED, PLANNED, TRIED, Saying, Trust
from swarmtrack.messages import AgreedMotion


class AgreedMotions:
    """Told of all of them at any time; says at the time of a scan what each drone does then."""

    def __init__(self) -> None:
        self._motions: list[AgreedMotion] = []
        self.begun: set[int] = set()
        """The drones of which anything has been said."""

    def agree(self, motion: AgreedMotion) -> None:
        """One more. The same again, as after a restart of whoever tells, counts once."""
        same = (motion.drone_id, motion.planned, float(motion.t[0]))
        self._motions = [one for one in self._motions if (one.drone_id, one.planned, float(one.t[0])) != same]
        self._motions.append(motion)

    def at(self, t: float) -> Iterator[Saying]:
        """What was agreed for this time; what is over is forgotten."""
        self._motions = [motion for motion in self._motions if t <= motion.t[-1]]
        for motion in self._motions:
            if t < motion.t[0]:
                continue
            self.begun.add(motion.drone_id)
            velocity = np.gradient(motion.displacement, motion.t, axis=0)
            now = [np.interp(t, motion.t, axis) for axis in (*motion.displacement.T, *velocity.T)]
            yield Saying(
                motion.drone_id,
                ("plan" if motion.planned else "code", float(motion.t[0])),
                t,
                np.array(now[:3]),
                np.array(now[3:]),
                _trust(motion),
            )


def _trust(motion: AgreedMotion) -> Trust:
    if motion.planned:
        return PLANNED
    return TRIED if motion.tried else CODED
