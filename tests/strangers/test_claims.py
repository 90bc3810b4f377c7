"""Claims by Remote ID: attached to the stranger that they fit, and called false where nothing fits."""

import numpy as np
import pytest

from swarmtrack.messages import LocatedStranger, RemoteIdClaim
from swarmtrack.strangers.claims import RemoteIds
from swarmtrack.strangers.mates import MatePlace
from swarmtrack.strangers.priors import MOST_CLAIMS

PLACE = np.array([10.0, 2.0, -6.0])
STILL = np.zeros(3)
EAST = np.array([0.0, 1.0, 0.0])


def stranger(number=101, place=PLACE, t=0.0):
    return LocatedStranger(number, t, place, STILL, 0.09 * np.eye(6), (1, 2))


def claim(t, place=PLACE, uas_id="A", velocity=STILL):
    return RemoteIdClaim(t, uas_id, place, velocity, 1.5, 2.0)


def judged(claims, located, seconds, *, mates=(), empty=lambda place: False, ids=None):
    """All news, with a claim a second and a scan each tenth of one."""
    ids, news = ids or RemoteIds(), []
    for k in range(round(10 * seconds)):
        t = 0.1 * k
        if k % 10 == 0:
            for one in claims(t):
                ids.hear(one)
        news += ids.judge(t, located(t), mates, empty)
    return ids, news


def test_a_claim_that_fits_is_of_that_stranger():
    far = stranger(102, PLACE + 12.0 * EAST)
    ids, news = judged(lambda t: [claim(t)], lambda t: [stranger(), far], 3.0)
    assert [(one.uas_id, one.number) for one in news] == [("A", 101)]
    assert ids.of_number == {101: "A"}


def test_a_claim_of_a_place_that_is_seen_to_be_empty_is_false_within_five_seconds():
    _, news = judged(
        lambda t: [claim(t, PLACE + 9.0 * EAST)], lambda t: [stranger()], 6.0, empty=lambda place: True
    )
    assert [one.number for one in news] == [None]
    assert news[0].t < 5.0
    assert np.isnan(news[0].off_m)


def test_a_claim_that_leaves_its_stranger_is_false_and_by_how_much():
    def path(t):
        return PLACE + 4.0 * max(t - 4.0, 0.0) * EAST

    _, news = judged(lambda t: [claim(t, path(t))], lambda t: [stranger(t=t)], 12.0)
    assert [one.number for one in news] == [101, None]
    assert news[1].off_m > 5.0
    assert news[1].t < 4.0 + 2.5 + 5.0


def test_a_claim_of_a_place_that_no_camera_sees_is_neither():
    ids, news = judged(lambda t: [claim(t, PLACE + 90.0 * EAST)], lambda t: [stranger()], 8.0)
    assert news == []
    assert ids.of_number == {}


def test_a_teammates_own_claim_is_none_of_a_stranger():
    mate = MatePlace(0.0, PLACE, 0.5)
    _, news = judged(
        lambda t: [claim(t)], lambda t: [stranger()], 4.0, mates=[mate], empty=lambda place: True
    )
    assert news == []


def test_a_claim_that_is_heard_no_more_is_forgotten():
    ids, _ = judged(lambda t: [claim(t)] if t < 2.5 else [], lambda t: [stranger()], 9.0)
    assert ids.of_number == {}


def test_claims_are_bounded_and_counted():
    ids, _ = judged(lambda t: [claim(t, uas_id=f"{k}") for k in range(MOST_CLAIMS + 5)], lambda t: [], 1.0)
    assert ids.counters["remote_ids_crowded"] == 5


@pytest.mark.parametrize("velocity", [np.array([0.0, 3.0, 0.0])])
def test_a_claim_is_carried_on_by_its_velocity(velocity):
    def place(t):
        return PLACE + t * velocity

    _, news = judged(
        lambda t: [claim(t, place(t), velocity=velocity)], lambda t: [stranger(place=place(t), t=t)], 4.0
    )
    assert [one.number for one in news] == [101]
