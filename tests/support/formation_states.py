"""Tracks and relative states by hand, for formations."""

import numpy as np

from swarmtrack.formation.parameters import FlightLimits, FormationParameters
from swarmtrack.formation.setpoint import OwnFlight
from swarmtrack.messages import IdentifiedTrack, RelativeState, Track, TrackStatus

SLOTS = {1: (0.0, 0.0, 0.0), 2: (-4.0, 3.0, -1.0), 3: (-4.0, -3.0, 1.0)}
HEIGHT = 5.0


def parameters(drone_id=2, limits=None, **changes):
    said = {"drone_id": drone_id, "leader": 1, "slots": SLOTS, "references": (1,), "height": HEIGHT}
    return FormationParameters(**{**said, "limits": FlightLimits(**(limits or {})), **changes})


def in_slot(drone_id=2, off=(0.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.0), heading=0.0, **facts):
    """This drone, so far off its slot while the leader is over the origin."""
    north, east, down = np.add(SLOTS[drone_id], off).tolist()
    return OwnFlight((north, east, down - HEIGHT), velocity, heading, **facts)


def track(
    identity=1, track_id=10, probability=0.999, status=TrackStatus.CONFIRMED, coasting_since=None, camera=0
):
    seen = Track(
        track_id,
        0.0,
        np.array([320.0, 0.0, 240.0, 0.0]),
        np.eye(4),
        status,
        1.0,
        np.full(2, 30.0),
        coasting_since,
        camera,
    )
    return IdentifiedTrack(seen, identity, probability if identity is not None else 0.0)


def state(position, velocity=(0.0, 0.0, 0.0), drone_id=1, sigma=0.1, range_sigma_log=0.05, t=0.0):
    cov = np.diag([sigma**2] * 3 + [sigma**2] * 3)
    return RelativeState(
        drone_id, t, np.array(position, float), np.array(velocity, float), cov, range_sigma_log, ("size",)
    )


def leader_from(own, velocity=(0.0, 0.0, 0.0), at=(0.0, 0.0, -HEIGHT), **more):
    """The leader's state as `own` sees it."""
    return state(np.subtract(at, own.position), np.subtract(velocity, own.velocity), **more)


class Flying:
    """A formation that is commanded 10 times per second."""

    def __init__(self, formation):
        self.formation = formation
        self.t = 0.0

    def tell(self, own, states=None, tracks=(), seconds=0.1):
        """The same again for so long; the last setpoint."""
        for _ in range(max(round(seconds * 10.0), 1)):
            self.t += 0.1
            answer = self.formation.command(states or {}, own, tracks, self.t)
        return answer

    def settled(self, own, **leader):
        """In its slot, with the leader known for long enough."""
        return self.tell(own, {10: leader_from(own, **leader)}, [track()], seconds=3.0)
