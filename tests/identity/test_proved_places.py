"""Names of teammates that move alike, by places that motion has proved; by the whole of `Identities`."""

import numpy as np
import pytest

from support.observer import CAMERA, FORWARD, LEFT, RIGHT, SCAN_S, at, shifted
from support.swaying import SIZE, Sway
from swarmtrack.identity.motion_evidence import MOST, PUBLISHED, Saying
from swarmtrack.identity.proof import LASTS_S, PROVED
from swarmtrack.identity.proved_places import FITS_S, MOST_AGAINST, ProvedPlaces
from swarmtrack.identity.reprojection import ObserverCamera
from swarmtrack.identity.weighing import PLACE_ALONE, SILENT_S
from swarmtrack.messages import Announcement, Track, TrackStatus
from swarmtrack.motion.ego import TeamPose


class Alike(Sway):
    """Drones 2 and 3 sway each in its own way for `apart_s`, long enough to be proved by default; then alike. Then both
    are out of sight for 2 s, and come back as other tracks."""

    def __init__(self, thinks=None, apart_s=14.0):
        super().__init__({"a": LEFT, "b": RIGHT}, {2: 12, 3: 13}, thinks or {2: LEFT, 3: RIGHT})
        self.observer.sizes |= dict.fromkeys("de", SIZE)
        if apart_s:
            self.flies(apart_s)
        self.sways = self.said = {2: 12, 3: 12}
        self.places = {}
        self.flies(2.0)
        self.places = {"d": LEFT, "e": RIGHT}

    def sureness(self):
        """By drone, of its name; and nothing of it is proved by motion alone."""
        labels = self.observer.identities.label(self.observer.tracks)
        assert all(entry.proof is None for entry in labels)
        return {entry.identity: entry.identity_probability for entry in labels}


def test_of_two_that_move_alike_each_is_known_by_its_place_once_that_was_proved():
    flight = Alike()
    assert flight.flies(1.0) == {"d": 2, "e": 3}
    assert max(flight.sureness().values()) <= PLACE_ALONE
    assert flight.flies(9.0) == {"d": 2, "e": 3}
    assert flight.sureness().keys() == {2, 3}
    for surely in flight.sureness().values():
        assert PROVED < surely < 1.0 - 0.5 * np.exp(-MOST_AGAINST)


@pytest.mark.parametrize("thinks", [{2: LEFT, 3: RIGHT}, {2: RIGHT, 3: LEFT}], ids=["right", "swapped"])
def test_places_that_motion_has_not_proved_make_no_name_surer(thinks):
    flight = Alike(thinks, apart_s=0.0)
    for _ in range(20):
        flight.flies(1.0)
        assert max(flight.sureness().values()) <= PLACE_ALONE


def _lose_the_own_place(flight):
    flight.observer.identities.lose_place()


def _begin_another_life(flight):
    for drone, pixel in flight.thinks.items():
        flight.observer.hears(drone, pixel, boot="0000000b")


def _fall_silent(flight):
    flight.said = {}
    flight.thinks = {}
    flight.observer.sees(SILENT_S + 0.5)
    flight.said = flight.sways
    flight.thinks = {2: LEFT, 3: RIGHT}


def _come_back_elsewhere(flight):
    flight.places = {"d": shifted(LEFT, 90.0), "e": shifted(RIGHT, 90.0)}


@pytest.mark.parametrize(
    "lose", [_lose_the_own_place, _begin_another_life, _fall_silent, _come_back_elsewhere]
)
def test_places_that_may_be_right_no_more_make_no_name_surer(lose):
    flight = Alike()
    lose(flight)
    for _ in range(12):
        flight.flies(1.0)
        assert max(flight.sureness().values()) <= PLACE_ALONE


class Scans:
    """Drones 2 and 3 hover where they say, to the left and to the right; motion says that both tracks are either."""

    exact, turn_weight = (2, 3), np.ones(1)

    def __init__(self):
        self.places, self.t = ProvedPlaces(), 0.0
        self.counted_from = np.zeros(3)
        self.proved = ()
        self.sigma_m = 0.2

    def log_ratios(self, tracks, drones):
        return np.full((1, len(tracks), len(drones)), MOST)

    def lasting(self, t):
        return self.proved

    def look(self, seconds, proved=(), left=LEFT, seen=(1, 2)):
        """The probabilities of tracks and drones. proved: by motion; left: where track 1 is seen; seen: the tracks."""
        self.proved = proved
        for _ in range(round(seconds / SCAN_S)):
            self.t += SCAN_S
            told = {}
            for drone, pixel in ((2, LEFT), (3, RIGHT)):
                cov = self.sigma_m**2 * np.eye(3)
                told[drone] = Announcement(drone, "0000000a", 1, self.t, 0.0, at(pixel), np.eye(3), cov)
                self.places.hear(
                    Saying(drone, ("motion",), self.t, self.counted_from, np.zeros(3), PUBLISHED)
                )
            observer = TeamPose(self.t, np.zeros(3), np.eye(3), 0.01 * np.eye(3), 1e-4 * np.eye(3))
            view = ObserverCamera.of(observer, CAMERA, FORWARD, 0)
            tracks = [self._track(id, {1: left, 2: RIGHT}[id]) for id in seen]
            self.places.follow((1, 2), told)
            self.places.judge(tracks, view, self, self)
        pairs = [(track, drone) for track in (1, 2) for drone in (2, 3)]
        return {pair: p for pair in pairs if (p := self.places.probability(*pair, self.t))}

    def _track(self, track_id, pixel):
        mean = np.array([pixel[0], 0.0, pixel[1], 0.0])
        return Track(track_id, self.t, mean, np.eye(4), TrackStatus.CONFIRMED, 1.0, np.full(2, 20.0), None)


BOTH = ((1, 2), (2, 3))


@pytest.mark.parametrize("proved_s", [FITS_S - 0.5, FITS_S + 0.5])
def test_a_place_is_right_once_motion_has_proved_it_for_a_while(proved_s):
    scans = Scans()
    assert scans.look(proved_s, BOTH) == {}
    assert scans.look(LASTS_S - 0.1) == {}
    found = scans.look(1.0)
    assert set(found) == (set(BOTH) if proved_s > FITS_S else set())
    assert all(p > PROVED for p in found.values())


def test_one_right_place_tells_who_of_two_is_there_and_who_the_other_one_is():
    scans = Scans()
    scans.look(4.0, BOTH[:1])
    assert set(scans.look(2.0)) == set(BOTH)


def test_who_is_seen_beside_its_place_is_no_more_where_it_says():
    scans = Scans()
    scans.look(4.0, BOTH[:1])
    scans.look(0.5, BOTH[:1], left=shifted(LEFT, 60.0))
    assert scans.look(2.0) == {}


def test_a_track_beside_the_place_is_not_known_by_it():
    scans = Scans()
    scans.look(4.0, BOTH)
    assert set(scans.look(2.0, left=shifted(LEFT, 40.0))) == {(2, 3)}


@pytest.mark.parametrize(("proved", "known"), [(BOTH, {(1, 2)}), (BOTH[:1], set())])
def test_a_track_alone_may_be_whoever_flies_alike_and_whose_place_is_not_known_to_be_right(proved, known):
    scans = Scans()
    scans.look(4.0, proved)
    assert set(scans.look(2.0, seen=(1,))) == known


def test_a_place_that_is_hardly_known_tells_nothing():
    scans = Scans()
    scans.look(4.0, BOTH)
    scans.sigma_m = 1.6
    assert scans.look(2.0) == {}


def test_who_counts_its_way_from_elsewhere_is_not_known_by_its_place_any_more():
    scans = Scans()
    scans.look(4.0, BOTH)
    scans.counted_from = np.array([5.0, 0.0, 0.0])
    assert scans.look(2.0) == {}
