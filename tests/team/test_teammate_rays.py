"""What teammates see of each other and of this drone, as evidence of who is where."""

import numpy as np
import pytest

from support.observer import LEFT, RIGHT, Observer, at
from swarmtrack.geometry import rotation
from swarmtrack.messages import FOREIGN, Announcement, Sighting, SightingReport
from swarmtrack.team.evidence import AS_STATED, Marginal, TeammatePrior
from swarmtrack.team.own_errors import OwnErrors, PathTurn
from swarmtrack.team.priors import P_RAYS_MISNAMED
from swarmtrack.team.teammate_rays import TeammateRay, TeammateRays

OWN, MATE, OTHER = 1, 2, 3
PADS = {
    OWN: np.array([0.0, 0.0, -2.0]),
    MATE: np.array([6.0, 1.0, -2.0]),
    OTHER: np.array([5.0, -4.0, -2.0]),
}
ERRORS = OwnErrors(OWN, PADS)
WAYS = {OWN: np.array([1.0, 2.0, -0.5]), MATE: np.array([-1.0, 0.5, 0.2]), OTHER: np.array([0.5, 1.5, 0.0])}
STATED = {drone: PADS[drone] + WAYS[drone] for drone in PADS}
ASIDE = np.array([2.0, 5.0, 0.0])


def ray(observer, seen, true, t=5.0):
    """Between MATE and another; true: the places of all drones."""
    other = OTHER if observer == 4 else seen if observer == MATE else observer  # drone 4 is where OTHER is
    apart = true[seen] - true.get(observer, true[OTHER])
    sighting = Sighting(seen, 0.99, apart / np.linalg.norm(apart), 0.02)
    return TeammateRay.between((PADS[MATE], PADS[OWN]), (STATED[MATE], STATED[other]), sighting, t, 0.1)


def own_place(k):
    """Where component k has this drone."""
    turn = ERRORS.heading[k] if ERRORS.path[k] == PathTurn.OWN else 0.0
    way = rotation.from_euler(0.0, 0.0, turn) @ WAYS[OWN]
    return ERRORS.stands_at(OWN)[k] + ERRORS.shift[k] + way


def p_near(*rays):
    """The probability that MATE is shown where it says, by (observer, seen, true places) each."""
    told = TeammateRays()
    for observer, seen, true in rays:
        told.add(observer, seen, ray(observer, seen, true))
    cases = told.cases(5.0)
    marginal = Marginal(cases.matrices, 0.1**2 * np.eye(3), np.zeros(1))
    log = marginal.by_start(TeammatePrior.of(MATE, ERRORS), 0.05)
    return float(cases.p_near(log, np.log(AS_STATED.start[0])).sum())


AWAY = STATED | {MATE: STATED[MATE] + np.array([3.0, 3.0, 0.0])}


def test_rays_that_agree_show_a_teammate_where_it_says():
    assert p_near((MATE, OWN, STATED)) > 0.9
    assert p_near((MATE, OWN, STATED), (OTHER, MATE, STATED)) > 0.98


def test_rays_that_lead_elsewhere_show_nothing():
    assert p_near((MATE, OWN, AWAY)) < 0.6
    assert p_near((MATE, OWN, AWAY), (OTHER, MATE, AWAY)) < 0.1


def test_of_two_observers_that_contradict_each_other_either_is_right_and_a_third_decides():
    agreeing = (MATE, OWN, STATED), (MATE, OTHER, STATED)
    assert p_near((OTHER, MATE, AWAY)) < 0.15
    assert 0.3 < p_near(*agreeing, (OTHER, MATE, AWAY)) < 0.7
    assert p_near(*agreeing, (OTHER, MATE, AWAY), (4, MATE, STATED)) > 0.9


def test_the_component_that_is_true_explains_where_a_teammate_sees_this_drone():
    alone = (ERRORS.path != PathTurn.TEAM) & ~ERRORS.permuted(MATE) & ~ERRORS.permuted(OTHER)
    for k in np.flatnonzero(alone):
        found = ray(MATE, OWN, STATED | {OWN: own_place(k)}).by_own_errors(MATE, ERRORS)
        off, towards = own_place(k) - STATED[OWN], STATED[MATE] - STATED[OWN]
        aside = abs(off[0] * towards[1] - off[1] * towards[0]) / np.hypot(*towards[:2])
        assert found[k] > (0.2 if aside > 2.0 else -2.5)  # along the ray, a ring is only vaguer
        # Whatever one observer says decides nothing.
        assert np.ptp(found) < -np.log(P_RAYS_MISNAMED) + 0.1
        assert found[0] == 0.0
    assert ray(MATE, OWN, STATED).by_own_errors(MATE, ERRORS).max() == pytest.approx(0.0, abs=1e-9)


def test_rays_fade_and_are_forgotten_with_whom_they_are_of():
    rays = TeammateRays()
    rays.add(MATE, OWN, ray(MATE, OWN, STATED))
    rays.add(OTHER, MATE, ray(OTHER, MATE, STATED))
    assert rays.seen_by_it(5.0, MATE, ERRORS).min() < 2.0 * rays.seen_by_it(60.0, MATE, ERRORS).min() < 0.0
    assert rays.cases(60.0).matrices[0] == pytest.approx(np.exp(-55.0 / 40.0) * rays.cases(5.0).matrices[0])
    rays.forget(OWN)
    assert rays.seen_by_it(5.0, MATE, ERRORS) is None
    assert len(rays.cases(5.0).matrices) == 3
    rays.forget()
    assert not rays


def sees_a_stranger(seconds=6.0, told=(), is_confirmed=True):
    """How sure drone 1 is that what it sees to the right is drone 3, which says that it is aside; told: of the drones
    that report whom they see, and whether motion confirms that."""
    observer = Observer()
    observer.hears(2, LEFT)
    observer.hears_at(3, ASIDE)
    places = {1: np.zeros(3), 2: at(LEFT), 3: ASIDE}
    for _ in range(round(seconds / 0.3)):
        for drone in (2, 3):
            others = {other: place for other, place in places.items() if other != drone}
            sees = others if drone in told else None
            observer.is_told_at(drone, places[drone], sees=sees, is_confirmed=is_confirmed)
        observer.sees(0.3, a=LEFT, b=RIGHT)
    assert observer.names() in ({"a": 2, "b": None}, {"a": 2, "b": FOREIGN})
    assert not observer.identities.self_doubt
    return observer.identities._posterior.named[2].p[3]


def test_a_stranger_is_less_likely_a_teammate_that_is_seen_elsewhere():
    assert sees_a_stranger() > 0.6
    assert sees_a_stranger(told={3}) < 0.2
    assert sees_a_stranger(told={2, 3}) < 0.15


def test_names_that_rest_on_stated_starts_confirm_none():
    assert sees_a_stranger(told={2, 3}, is_confirmed=False) == sees_a_stranger()


def test_who_lies_of_whom_it_sees_takes_no_name(observer):
    for _ in range(20):
        # Drone 3 says that it sees drone 2 where it is not, and this drone far aside.
        observer.is_told_at(3, at(RIGHT), sees={1: np.array([0.0, 30.0, 0.0]), 2: at(RIGHT, 20.0)})
        observer.is_told_at(2, at(LEFT))
        observer.sees(0.3, a=LEFT, b=RIGHT)
    assert observer.names() == {"a": 2, "b": 3}
    assert not observer.identities.self_doubt


def report(observer, place, boot="0000000a", t=0.0, **more):
    towards = np.array([-1.0, 0.0, 0.0])
    return SightingReport(
        observer, boot, 1, t, 0.0, place, 0.1, (), (Sighting(1, 0.99, towards, 0.01, True),), **more
    )


def rays_of(observer, drone):
    return bool(observer.identities._posterior.teammates[drone].rays)


def test_of_who_is_carried_or_doubts_itself_or_has_begun_anew_there_are_no_rays(observer):
    observer.sees(1.0, a=LEFT, b=RIGHT)
    observer.identities.on_report(report(3, at(RIGHT), t=observer.t, leans_on=(1,)))
    assert not rays_of(observer, 3)
    observer.identities.on_report(report(3, at(RIGHT), t=observer.t - 30.0))
    assert not rays_of(observer, 3)
    observer.identities.on_report(report(3, at(RIGHT), t=observer.t))
    assert rays_of(observer, 3)
    cov = 1e6 * np.eye(3)
    observer.identities.announce(Announcement(3, "0000000a", 2, observer.t, 0.0, at(RIGHT), np.eye(3), cov))
    assert not rays_of(observer, 3)
    observer.identities.on_report(report(2, at(LEFT), t=observer.t))
    assert rays_of(observer, 2)
    observer.hears(2, LEFT, boot="0000000b")
    assert not rays_of(observer, 2)


@pytest.mark.parametrize("sees", [(2, 3), (3, 2)])
def test_between_a_drone_that_doubts_itself_and_another_there_are_no_rays(observer, sees):
    """Neither if it sees the other, nor if the other sees it."""
    which, whom = sees
    places = {2: at(LEFT), 3: at(RIGHT)}
    observer.sees(1.0, a=LEFT, b=RIGHT)
    observer.is_told_at(whom, places[whom])
    observer.is_told_at(which, places[which], sees={whom: places[whom]})
    assert [rays_of(observer, drone) for drone in sees] == [True, True]
    cov = 1e6 * np.eye(3)
    observer.identities.announce(Announcement(3, "0000000a", 2, observer.t, 0.0, at(RIGHT), np.eye(3), cov))
    observer.is_told_at(which, places[which], sees={whom: places[whom]})
    assert [rays_of(observer, drone) for drone in sees] == [False, False]
