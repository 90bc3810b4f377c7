"""Which drones a track may be, and where these should be in the image now.

What is undecided is matched: tracks without an ID, drones without a track, and IDs in doubt. A drone whose track ended
is expected where it was seen last, moving on, or where it said that it is since. Beside these come settled drones where
a nameless track is as well, and drones that should be elsewhere but move as a track does.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from swarmtrack.identity.boxes import coincide
from swarmtrack.identity.names import Names
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.identity.pose_requests import PoseRequests
from swarmtrack.identity.reprojection import (
    NOBODY,
    LastSeen,
    ObserverCamera,
    Predictions,
    joined,
    reproject,
    retrace,
)
from swarmtrack.identity.standing import Standing
from swarmtrack.identity.teammates import Teammates
from swarmtrack.identity.weighing import RIVAL, Weighing
from swarmtrack.messages import Announcement, Track, TrackStatus

# Of these, the track does not show where the drone is.
UNSEEN = (Standing.HIDDEN, Standing.DOUBTED)
# Of the image's size, on each side: as far as a camera that turns fast sees in half a second.
SOON = 0.5


class CandidateDrones:
    """Looks at names and teammates; remembers only who was expected in view, to ask those who are about to enter."""

    def __init__(
        self, parameters: IdentityParameters, teammates: Teammates, names: Names, weighing: Weighing
    ) -> None:
        self._parameters = parameters
        self._teammates = teammates
        self._names = names
        self._weighing = weighing
        self._expected: dict[int, dict[int, bool]] = {}
        """By camera, and drone without a settled track: whether it should be in view, or nearly."""

    def undecided(self) -> list[Track]:
        """The tracks that take part in the matching. One whose ID is not settled does even while it is not detected:
        else whoever is near would have no rival for as long."""
        return [track for track in self._names.shown.values() if self._is_undecided(track)]

    def _is_undecided(self, track: Track) -> bool:
        held = self._names.of(track.id)
        if held is not None:
            return held.standing is not Standing.SETTLED
        # One that is not confirmed yet, or lost, may be a rival of one that is named or could be.
        return track.status is not TrackStatus.TENTATIVE or track.probability >= RIVAL

    def expected(self, view: ObserverCamera) -> Predictions:
        """Where the drones should be that no track has for certain: by where they were seen last, or where they said
        that they are since. Of what is newer than the sight, an announcement was asked for and counts; a report
        counts where it tells more."""
        announced, whereabouts = self._teammates.announced, self._teammates.whereabouts
        settled = {held.drone_id for held in self._names.settled}
        free = [drone for drone in announced if drone not in settled | self._teammates.clashing]
        unseen = [*self._names.lost.values(), *(held for held in self._names if held.standing in UNSEEN)]
        seen = {held.drone_id: held.seen for held in unseen if held.seen is not None}
        by_sight = [seen[d] for d in free if d in seen and announced[d].t <= seen[d].t]
        sight = retrace(by_sight, view, turn_rate=self._parameters.turn_rate)
        places = [whereabouts.latest(drone) for drone in free]
        said = self._reproject(places, view)
        older = {place.drone_id for place in places if _is_before(place, seen.get(place.drone_id))}
        width = {d: spread for d, spread in zip(said.drone_id, said.spread, strict=True) if d not in older}
        vaguer = [
            j for j, drone in enumerate(sight.drone_id) if drone in width and width[drone] < sight.spread[j]
        ]
        sight = sight.only([j for j in range(len(sight.key)) if j not in vaguer])
        found = set(sight.drone_id) | (older & {ray.drone_id for ray in by_sight})
        return joined(said.only([j for j, drone in enumerate(said.drone_id) if drone not in found]), sight)

    def contested(self, undecided: Sequence[Track], view: ObserverCamera) -> tuple[Predictions, list[Track]]:
        """Where the settled drones should be in whose gate a nameless track is, or whose track does not move as they
        do; and those tracks."""
        newcomers = [track for track in undecided if self._names.of(track.id) is None]
        shown = self._names.shown
        known = [
            held
            for held in self._names.settled
            if held.drone_id in self._teammates.announced and held.track_id in shown
        ]
        settled = {held.drone_id: shown[held.track_id] for held in known}
        contradicted = {held.drone_id for held in known if self._weighing.is_contradicted(held)}
        if not settled or not (newcomers or contradicted):
            return NOBODY, []
        predicted = self._reproject([self._teammates.whereabouts.latest(drone) for drone in settled], view)
        near = self._weighing.near(newcomers, predicted)
        columns = [
            j
            for j, drone in enumerate(predicted.drone_id)
            if drone in contradicted
            or any(not coincide(newcomers[i], settled[drone]) for i in np.flatnonzero(near[:, j]).tolist())
        ]
        return predicted.only(columns), [settled[predicted.drone_id[j]] for j in columns]

    def unexpected(self, tracks: Sequence[Track], predicted: Predictions) -> Predictions:
        """Drones that no track has for certain and that should not be in the image, of which a track has the motion."""
        unmoved = {held.drone_id for held in self._names.settled if not self._weighing.is_contradicted(held)}
        known = self._teammates.announced.keys() - self._teammates.clashing - unmoved
        return self._weighing.astray(tracks, sorted(known - set(predicted.drone_id)))

    def ask_who_enters(
        self, predicted: Predictions, view: ObserverCamera, pose_requests: PoseRequests
    ) -> None:
        """Whoever should come into view soon is asked where it is, so that the answer is there when its track is."""
        camera, before = view.camera, self._expected.get(view.number, {})
        u, v = predicted.pixel.T / np.array([[camera.width], [camera.height]])
        near = (np.abs(u - 0.5) < 0.5 + SOON) & (np.abs(v - 0.5) < 0.5 + SOON)
        expected = dict(zip(predicted.drone_id, near.tolist(), strict=True))
        for drone, enters in expected.items():
            if enters and before.get(drone) is False:
                pose_requests.ask_again(self._teammates.whereabouts.latest(drone), view.observer.t)
        named = dict.fromkeys(self._names.stated, True)
        self._expected[view.number] = dict.fromkeys(self._teammates.announced, False) | named | expected

    def _reproject(self, places: Sequence[Announcement], view: ObserverCamera) -> Predictions:
        whereabouts = self._teammates.whereabouts
        found = reproject(
            places,
            view,
            on_pad=whereabouts.on_pad,
            drift_speed=self._parameters.drift_speed,
            stay_s=self._parameters.stay_s,
        )
        # Those places are where we would see them: our own heading is in them already.
        aligned = np.array([drone in whereabouts.aligned for drone in found.drone_id], dtype=bool)
        return found._replace(turn=np.where(aligned[:, None], 0.0, found.turn))


def _is_before(place: Announcement, sight: LastSeen | None) -> bool:
    return sight is not None and place.t <= sight.t
