"""Is this drone's own start or heading wrong? When it is said, and when no more.

One look may deceive: a teammate is hidden, a house stands where nobody should be. So the doubt must last before it is
said, and its end as well: each of both costs the team an announcement. That the drone may be elsewhere is thought of
only while there are tracks that nobody explains.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from swarmtrack.identity import own_pose
from swarmtrack.identity.assignment import Assignment
from swarmtrack.identity.onlookers import Onlookers
from swarmtrack.identity.own_pose import Elsewhere
from swarmtrack.identity.reprojection import STAY_IN_FLIGHT, ObserverCamera, is_vague, reproject
from swarmtrack.identity.weighing import RIVAL, Weighing
from swarmtrack.identity.whereabouts import Whereabouts
from swarmtrack.messages import Announcement, Array, SightingReport, Track, TrackStatus
from swarmtrack.motion.ego import TeamPose

# The probability that it is wrong, above which it is said, and s that this must last. One teammate in the wrong
# direction tells no more than the second: it may be that one's start.
SAID = ((0.75, 0.5), (0.4, 1.5))
# And below which it is said no more.
GONE = ((0.25, 3.0),)
# And from which on it is suspected at once, which is not said.
SUSPECTED = 0.4
# rad: by so many sigmas, and by so much at least, a heading must be off to be worth a word.
SIGMAS, LEAST = 2.0, math.radians(6.0)
# m: and a start.
LEAST_M = 0.5
# s: a longer pause between two looks breaks a doubt off.
LONGEST_S = 1.0
# s between two looks while the last one found nothing wrong, and while it did or there are new tracks without a name.
CALM_S, PUZZLED_S = 0.5, 0.1
# The probability that it is wrong, from which on a look found something.
PUZZLING = 0.1
# That the heading is off by far, from which on places tell nothing.
FAR = 0.05
# s that all headings are thought of once nothing is found wrong any more.
TURNS_S = 10.0
# s that a place is older than the sight of its drone: beyond, the drone may have moved since it said where it is.
SUPERSEDED_S = 0.9
# s: who said less long ago where it is will say it again. Reports come once a second.
SOON_S = 1.5


class SelfDoubt:
    """Told of every scan."""

    def __init__(self, drone_id: int, *, start_sigma_m: float, drift_speed: float, stay_s: float) -> None:
        """start_sigma_m: how well this drone knows where it starts, m per axis; the others as in `reproject`."""
        self._onlookers = Onlookers(drone_id)
        self._start_sigma = start_sigma_m
        self.said = False
        self.own = own_pose.unknown(0.0)
        """What is known of the own pose."""
        self._drift_speed = drift_speed
        self._stay_s = stay_s
        self._p = 0.0
        """That it is wrong, by the last look."""
        self._puzzled_t = -math.inf
        """When a look last found something."""
        self._nameless: set[int] = set()
        """The tracks that had no name then."""
        self._since: dict[float, float] = {}
        """s: since when the probability has been beyond each of those that count."""
        self._t = -math.inf
        self._own_pad: Array | None = None

    def hear(self, report: SightingReport) -> None:
        """A teammate reports whom it sees: this drone, perhaps."""
        self._onlookers.tell(report)

    def look(
        self,
        alive: Mapping[int, Track],
        names: Iterable[Assignment],
        lost: Iterable[Assignment],
        *,
        view: ObserverCamera,
        whereabouts: Whereabouts,
        weighing: Weighing,
    ) -> None:
        """At the tracks of a scan. names: that they have, lost: of tracks that ended. What counts are drones whose
        place is not older than the sight of them, and all tracks but those of the others."""
        if self._own_pad is None:
            self._own_pad = view.observer.position
        held = {name.track_id: name for name in names}
        named = {id for id, name in held.items() if name.stated}
        nameless = {
            track.id
            for track in alive.values()
            if track.status is TrackStatus.CONFIRMED and track.id not in named
        }
        t = view.observer.t
        self._onlookers.follow(t, view.observer.position, view.observer.position_sigma, in_doubt=self.said)
        if t - self._t < (PUZZLED_S if self._p > PUZZLING or nameless - self._nameless else CALM_S):
            return
        self._nameless = nameless
        sight = {name.drone_id: name.seen.t for name in (*lost, *held.values()) if name.seen is not None}
        known = (whereabouts.said(drone) for drone in whereabouts.announced)
        latest = [place for place in known if not is_vague(place)]
        places = [place for place in latest if place.t > sight.get(place.drone_id, -math.inf) - SUPERSEDED_S]
        moved = {place.drone_id for place in latest} - {place.drone_id for place in places}
        # Where they are now nobody said, but how they got there: that tells which way this drone looks.
        moving = {drone for drone in moved if _tells_motion(drone, weighing)}
        others = {id for id, name in held.items() if name.drone_id in moved - moving}
        tracks = [track for track in alive.values() if _counts(track) and track.id not in others]
        on_pad = whereabouts.on_pad
        ahead = reproject(places, view, on_pad=on_pad, drift_speed=self._drift_speed, stay_s=self._stay_s)
        vague = [*_known_by_motion(whereabouts, weighing), *sorted(moving)]
        if self.said and not places and any(t - place.t < SOON_S for place in latest):
            # They will say in a moment where they are now.
            self._break_off(t)
            return
        evidence = weighing.look(tracks, view, ahead, [place.drone_id for place in places], vague)
        unexplained = nameless & {track.id for track in tracks} or self._p > PUZZLING or self.said
        if places and (unexplained or self._onlookers.are_puzzled):
            elsewhere = self._elsewhere(places, view, whereabouts, weighing)
            self.own = own_pose.weigh(evidence, view, elsewhere)
        else:
            self.own = own_pose.weigh(evidence, view)
        self._p = self._wrong(view.observer)
        self._think_of_turns(t, weighing)
        # While nobody is left to compare with, a doubt neither grows nor goes.
        if (latest or vague) and alive:
            self._judge(t)
        else:
            self._break_off(t)

    def forbids(self, name: Assignment, weighing: Weighing) -> bool:
        """Whether a name that motion does not prove is given up: who is elsewhere knows nobody by place."""
        elsewhere = self.own.turned < 0.5
        return self.said and (elsewhere or not self.trusts_place(name.track_id, name.drone_id, weighing))

    def trusts_place(self, track_id: int, drone_id: int, weighing: Weighing) -> bool:
        """Whether its place may tell that a track is a drone. Who may be wrong itself waits for motion, of those that
        tell how they move: until it is clear to which side it looks, and where it moves as two of them. That nobody
        else is left is as good."""
        if not (self.said or self._p > SUSPECTED) or not weighing.tells_motion(drone_id):
            return True
        if self.said and self.own.beside > FAR and not weighing.leaves_only(track_id, drone_id):
            return False
        return not weighing.moves_as_another(track_id, drone_id)

    def _think_of_turns(self, t: float, weighing: Weighing) -> None:
        """By motion, as long as something may be wrong: with every heading that is too much work for each scan."""
        if self.said or self._p > PUZZLING:
            self._puzzled_t = t
        weighing.think_of_turns(self.own if t - self._puzzled_t < TURNS_S else None)

    def _elsewhere(
        self,
        places: Sequence[Announcement],
        view: ObserverCamera,
        whereabouts: Whereabouts,
        weighing: Weighing,
    ) -> Elsewhere:
        assert self._own_pad is not None
        age = np.array([abs(view.observer.t - place.t) + place.t_sigma for place in places])
        stands = [place.drone_id in whereabouts.on_pad for place in places]
        stay = np.where(stands, self._stay_s, STAY_IN_FLIGHT)
        start = np.array([np.trace(place.position_cov) for place in places]) / 3.0
        gone = age / (stay + age) * (self._drift_speed * age) ** 2
        drones = [place.drone_id for place in places]
        return own_pose.elsewhere(
            np.array([place.position for place in places]),
            np.sqrt(start + gone),
            weighing.seen(drones),
            pads=np.array(list(whereabouts.pads.values())).reshape(-1, 3),
            whose=[drones.index(drone) if drone in drones else -1 for drone in whereabouts.pads],
            own_pad=self._own_pad,
        )

    def _wrong(self, observer: TeamPose) -> float:
        """The probability that it is, by more than is expected of such a heading and start. No teammate's word alone
        begins a doubt, and any keeps it up."""
        start_sigma = math.hypot(self._start_sigma, observer.position_sigma)
        azimuth, metres = max(SIGMAS * self.own.heading_sigma, LEAST), max(SIGMAS * start_sigma, LEAST_M)
        wrong = [own.off_by(azimuth, metres) for own in self.own.seen_by(self._onlookers)]
        return wrong[0] if self.said else min(wrong)

    def _break_off(self, t: float) -> None:
        """Nobody is left to compare with: a doubt neither grows nor goes."""
        self._t = t
        self._since.clear()

    def _judge(self, t: float) -> None:
        if t - self._t > LONGEST_S:
            self._since.clear()
        self._t = t
        for p, lasting_s in GONE if self.said else SAID:
            if (self._p < p) != self.said:
                self._since.pop(p, None)
            elif t - self._since.setdefault(p, t) >= lasting_s:
                self.said = not self.said
                self._since.clear()
                return


def _known_by_motion(whereabouts: Whereabouts, weighing: Weighing) -> list[int]:
    """Who knows no more where it is, and tells how it moves. A code sways up and down, which no heading turns."""
    return [
        drone
        for drone, said in whereabouts.announced.items()
        if is_vague(said) and _tells_motion(drone, weighing)
    ]


def _tells_motion(drone: int, weighing: Weighing) -> bool:
    return weighing.tells_motion(drone) and not weighing.is_agreed(drone)


def _counts(track: Track) -> bool:
    """Whether a track may be a teammate or its rival now."""
    is_likely = track.status is TrackStatus.CONFIRMED or track.probability >= RIVAL
    return is_likely and track.status is not TrackStatus.LOST
