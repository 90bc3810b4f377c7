"""What was agreed before the flight is said at the time of a scan, and only while it lasts."""

from __future__ import annotations

import numpy as np
import pytest

from support.observer import LEFT, RIGHT, SCAN_S, Observer, at
from swarmtrack.identity.agreed import AgreedMotions
from swarmtrack.identity.motion_evidence import CODED, PLANNED, TRIED
from swarmtrack.identity.spans import SPAN
from swarmtrack.messages import AgreedMotion
from swarmtrack.motion.priors import SWAY_LASTS_S
from swarmtrack.motion.sway import sway
from swarmtrack.runtime.filed import SOMEWHERE_M, coded_motion, filed_announcement


def motion(drone_id=2, begin=10.0, *, planned=False):
    t = np.linspace(0.0, 4.0, 81)
    way = np.stack([0.0 * t, 2.0 * t, 0.5 * np.sin(t)], axis=1)
    return AgreedMotion(drone_id, begin + t, way, planned)


def test_it_says_where_a_drone_is_and_how_fast_while_it_lasts():
    agreed = AgreedMotions()
    agreed.agree(motion())
    assert list(agreed.at(9.9)) == []
    assert not agreed.begun
    (said,) = agreed.at(11.0)
    assert agreed.begun == {2}
    assert (said.drone_id, said.t, said.trust) == (2, 11.0, CODED)
    assert said.displacement == pytest.approx([0.0, 2.0, 0.5 * np.sin(1.0)], abs=1e-3)
    assert said.velocity == pytest.approx([0.0, 2.0, 0.5 * np.cos(1.0)], abs=1e-3)
    assert list(agreed.at(14.1)) == []
    assert list(agreed.at(11.0)) == []  # it is over


def test_a_code_and_a_plan_are_counted_from_different_places_and_trusted_differently():
    agreed = AgreedMotions()
    for planned in (False, True):
        agreed.agree(motion(planned=planned))
    code, plan = agreed.at(12.0)
    assert code.source != plan.source
    assert plan.trust == PLANNED


def test_a_code_that_may_not_be_flown_is_trusted_as_that():
    agreed = AgreedMotions()
    agreed.agree(coded_motion(2, (1, 2, 3), 10.0, tried=True))
    (code,) = agreed.at(12.0)
    assert code.trust == TRIED


def test_what_is_told_again_counts_once():
    agreed = AgreedMotions()
    for _ in range(2):
        agreed.agree(motion())
    assert len(list(agreed.at(12.0))) == 1


def test_times_that_do_not_increase_are_refused():
    with pytest.raises(ValueError, match=r"AgreedMotion\.t: expected two or more times that increase"):
        AgreedMotion(2, np.zeros(2), np.zeros((2, 3)), planned=False)


@pytest.mark.parametrize("tried", [False, True], ids=["as agreed", "by the pilot's switch"])
@pytest.mark.parametrize("team", [(2, 3), tuple(range(1, 11))], ids=["two", "neighbours among ten"])
def test_drones_that_start_somewhere_are_known_by_how_they_sway_and_by_nothing_else(team, tried):
    """The left one is drone 2 and the right one drone 3; all that is known of them is how each of the team sways."""
    watching = Observer(probability=0.99)
    begin, metres = 1.0, 4.0
    for drone_id in team:
        watching.identities.announce(
            filed_announcement(drone_id, 0.0, position=np.zeros(3), yaw=0.0, sigma=SOMEWHERE_M)
        )
        watching.identities.agree(coded_motion(drone_id, team, begin, tried=tried))
    size = (430.0 * SPAN / metres,) * 2
    watching.sizes = {"a": size, "b": size}

    def seen(pixel, drone_id):
        place = at(pixel, metres) + sway(drone_id, team, watching.t + SCAN_S - begin)[0]
        return (320.0 + 430.0 * place[1] / place[0], 240.0 + 430.0 * place[2] / place[0])

    while watching.t < begin:
        assert watching.sees(SCAN_S, a=LEFT, b=RIGHT) == {"a": None, "b": None}
    while watching.t < begin + 7.5:
        names = watching.sees(SCAN_S, a=seen(LEFT, 2), b=seen(RIGHT, 3))
        assert names["a"] in (None, 2)
        assert names["b"] in (None, 3)
    assert names == {"a": 2, "b": 3}


def test_a_switch_thrown_by_mistake_takes_no_name():
    """Both hold their places while their codes would be flown, three times."""
    watching = Observer()
    for drone_id, pixel in ((2, LEFT), (3, RIGHT)):
        watching.hears(drone_id, pixel)
        for begin in (1.0, 11.0, 21.0):
            watching.identities.agree(coded_motion(drone_id, (2, 3), begin, tried=True))
    rng, told = np.random.default_rng(4), []
    while watching.t < 29.5:
        a, b = np.array([LEFT, RIGHT]) + 0.5 * rng.standard_normal((2, 2))
        names = watching.sees(SCAN_S, a=tuple(a), b=tuple(b))
        told += watching.news.astray
        if watching.t > 1.0:
            assert names == {"a": 2, "b": 3}
    assert told == []


class Swaying:
    """A team of six that starts somewhere and sways by its codes from 1 s on: who is seen, and how far away each is."""

    TEAM, BEGIN = (1, 2, 3, 4, 5, 6), 1.0

    def __init__(self, seed, **metres):
        self.rng, self.metres = np.random.default_rng(seed), metres
        self.watching = Observer()
        self.watching.sizes = {name: (430.0 * SPAN / far,) * 2 for name, far in metres.items()}
        for drone_id in self.TEAM[1:]:
            start = filed_announcement(drone_id, 0.0, position=np.zeros(3), yaw=0.0, sigma=SOMEWHERE_M)
            self.watching.identities.announce(start)
            self.watching.identities.agree(coded_motion(drone_id, self.TEAM, self.BEGIN))

    def named_at(self, name, sways):
        """When the track was named, s since the beginning, or inf. sways: t -> by track, its displacement (3,) m."""
        while self.watching.t < self.BEGIN + SWAY_LASTS_S:
            moved = sways(self.watching.t + SCAN_S - self.BEGIN)
            pixels = {one: self._pixel(one, moved[one]) for one in self.metres}
            if self.watching.sees(SCAN_S, **pixels)[name] is not None:
                return self.watching.t - self.BEGIN
        return np.inf

    def _pixel(self, name, moved):
        column = 100.0 + 100.0 * "abcde".index(name)
        place = at((column, 240.0), self.metres[name]) + moved
        u, v = 320.0 + 430.0 * place[1] / place[0], 240.0 + 430.0 * place[2] / place[0]
        return tuple(np.array([u, v]) + self.rng.standard_normal(2))


def by_code(t):
    return {
        name: sway(drone_id, Swaying.TEAM, t)[0]
        for name, drone_id in zip("abcde", (2, 3, 4, 5, 6), strict=True)
    }


def test_the_more_of_a_team_is_found_the_sooner_is_the_next():
    """A far drone, alone in view and among four near ones."""
    seeds = range(6)
    alone = [Swaying(seed, a=20.0).named_at("a", by_code) for seed in seeds]
    among = [Swaying(seed, a=20.0, b=4.0, c=4.0, d=4.0, e=4.0).named_at("a", by_code) for seed in seeds]
    assert np.mean(np.minimum(among, SWAY_LASTS_S)) < np.mean(np.minimum(alone, SWAY_LASTS_S)) - 0.5


@pytest.mark.parametrize("seed", range(4))
def test_a_stranger_that_hovers_among_a_team_that_was_found_gets_no_name(seed):
    rate, angle = np.random.default_rng(seed).uniform((0.5, 0.0), (3.0, 6.3), (4, 2)).T

    def sways(t):
        heave = 0.06 * np.sin(rate * t + angle).sum()
        return by_code(t) | {"a": np.array([0.0, 0.0, heave])}

    assert Swaying(seed, a=8.0, b=4.0, c=4.0, d=4.0, e=4.0).named_at("a", sways) == np.inf
