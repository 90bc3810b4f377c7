"""Names of teammates that move alike, by places that motion has proved; by the whole of `Identities`."""

import numpy as np
import pytest

from support.observer import LEFT, RIGHT, shifted
from support.swaying import SIZE, Sway
from swarmtrack.identity.proof import PROVED
from swarmtrack.identity.proved_places import FITS_S, MOST_AGAINST
from swarmtrack.identity.weighing import PLACE_ALONE, SILENT_S


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


def test_a_place_is_right_only_once_motion_has_proved_it_for_a_while():
    flight = Sway({"a": LEFT, "b": RIGHT}, {2: 12, 3: 13}, {2: LEFT, 3: RIGHT})
    while None in (proofs := [flight.proofs().get(drone) for drone in (2, 3)]):
        flight.flies(0.1)
    since = max(proof.since for proof in proofs)
    alike = Alike(apart_s=round(since + FITS_S - 0.3, 1))
    for _ in range(10):
        alike.flies(1.0)
        assert max(alike.sureness().values()) <= PLACE_ALONE
