"""A place that rests on ours is no evidence of ours."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from swarmtrack.carried.own_place import OwnPlace
from swarmtrack.carried.priors import ANCHORS_MOST
from swarmtrack.messages import Announcement, Array, Sighting, SightingReport
from swarmtrack.motion.ego import TeamPose
from swarmtrack.relative.looks import TeamLook
from swarmtrack.relative.parameters import RelativeParameters
from swarmtrack.team.reported_places import SaidPlace

US, MATE = 1, 2
EYE = np.eye(3)
THERE = np.array([8.0, 0.0, 0.0])
WIDTH = RelativeParameters(airframe_span_m=0.5)


class Team:
    """A teammate that hovers at THERE."""

    def said_place(self, drone_id: int, t: float) -> SaidPlace | None:
        return SaidPlace(THERE, 0.0, 1.0, 1e-3)

    def p_as_configured(self) -> float:
        return 1.0

    def is_confirmed(self, drone_id: int) -> bool:
        return True


def look(t: float, place: Array) -> TeamLook:
    q = THERE - place
    r = float(np.linalg.norm(q))
    return TeamLook(
        t, place, np.zeros(3), ((MATE, 7),), (q / r)[None], 1e-5 * EYE[None], np.array([WIDTH.width_m / r]), np.ones(1)
    )  # fmt: skip


def report(
    t: float, leans_on: tuple[int, ...] = (), sigma: float = 0.1, sees_us: bool = True
) -> SightingReport:
    seen = (Sighting(US, 0.99, np.array([-1.0, 0.0, 0.0]), 0.03),) if sees_us else ()
    return SightingReport(MATE, "0" * 8, 1, t, 0.01, THERE, sigma, (US,), seen, leans_on)


def own(t: float) -> TeamPose:
    return TeamPose(t, np.zeros(3), EYE, 0.01 * EYE, 1e-4 * EYE)


def flown(end: float, *, lost_s: float, **said: object) -> OwnPlace:
    found = OwnPlace(US, WIDTH, cameras=[np.zeros(3)], start_sigma_m=0.05)
    found.announce(Announcement(MATE, "0" * 8, 1, 0.0, 0.0, THERE, EYE, 0.01 * EYE))
    for k in range(int(end * 10)):
        t = 0.1 * k
        if k % 10 == 0:
            found.hear(report(t, **said) if t >= lost_s else report(t))  # type: ignore[arg-type]
        found.observe(look(t, np.zeros(3)), 0, own(t), min(t, lost_s), Team())
    return found


def test_while_the_autopilot_knows_its_place_nobody_carries() -> None:
    assert flown(5.0, lost_s=9.0).carried(4.9) is None


def test_without_a_position_a_drone_is_carried_and_says_by_whom() -> None:
    found = flown(8.0, lost_s=3.0)
    carried = found.carried(7.9)
    assert carried is not None
    assert carried.by == (MATE,)
    assert carried.leans_on == (MATE,)
    assert float(np.linalg.norm(carried.position)) < 0.3
    news = found.news(7.9)
    assert news is not None
    assert news.by == (MATE,)
    assert news.off_m is None


def test_it_leans_on_whom_its_teammates_lean() -> None:
    carried = flown(8.0, lost_s=3.0, leans_on=(5, 9)).carried(7.9)
    assert carried is not None
    assert carried.leans_on == (MATE, 5, 9)


@pytest.mark.parametrize("said", [{"leans_on": (US, 5)}, {"sigma": 5.0}])
def test_whose_place_leans_on_ours_or_is_unknown_holds_nobody(said: dict[str, object]) -> None:
    found = flown(8.0, lost_s=3.0, **said)
    carried = found.carried(7.9)
    assert carried is not None
    assert carried.by == ()
    assert carried.sigma_m > 1.0


def test_a_teammate_that_is_carried_itself_holds_less_well() -> None:
    surely, vaguely = (flown(10.0, lost_s=3.0, leans_on=by, sigma=0.5).carried(9.9) for by in ((), (5,)))
    assert surely is not None
    assert vaguely is not None
    # East: across the ray.
    assert vaguely.cov[1, 1] > 1.5 * surely.cov[1, 1]


def test_nobody_says_so_within_a_second_of_the_last_ray() -> None:
    found = flown(8.0, lost_s=3.0)
    for k in range(11):
        t = 8.0 + 0.1 * k
        found.hear(report(t, sees_us=False))
        missed = look(t, np.zeros(3))
        nothing = TeamLook(
            t, missed.camera, missed.velocity, (), *(np.empty((0, *s)) for s in ((3,), (3, 3), (), ()))
        )
        found.observe(nothing, 0, own(t), 3.0, Team())
    carried = found.carried(9.0)
    assert carried is not None
    assert carried.by == ()


def test_of_many_teammates_the_first_hold_and_others_take_the_place_of_the_lost() -> None:
    ids, bearings = range(2, 6 + ANCHORS_MOST), 2.0 * np.pi * np.arange(4 + ANCHORS_MOST) / 20.0
    there = {id: 8.0 * np.array([np.cos(b), np.sin(b), 0.0]) for id, b in zip(ids, bearings, strict=True)}

    class Many(Team):
        def said_place(self, drone_id: int, t: float) -> SaidPlace | None:
            return SaidPlace(there[drone_id], 0.0, 1.0, 1e-3)

    found = OwnPlace(US, WIDTH, cameras=[np.zeros(3)], start_sigma_m=0.05)
    for id in ids:
        found.announce(Announcement(id, "0" * 8, 1, 0.0, 0.0, there[id], EYE, 0.01 * EYE))

    def see(begin: float, end: float, seen: Sequence[int]) -> tuple[int, ...]:
        for t in np.arange(begin, end, 0.1).tolist():
            found.observe(
                TeamLook(
                    t, np.zeros(3), np.zeros(3), tuple((id, id) for id in seen),
                    np.array([there[id] / 8.0 for id in seen]), np.tile(1e-5 * EYE, (len(seen), 1, 1)),
                    np.full(len(seen), WIDTH.width_m / 8.0), np.ones(len(seen)),
                ),
                0, own(t), None, Many(),
            )  # fmt: skip
        carried = found.carried(found._filter.t)  # type: ignore[union-attr]
        assert carried is not None
        assert np.linalg.norm(carried.position) < 0.5
        return carried.by

    assert see(0.0, 3.0, ids) == tuple(ids)[:ANCHORS_MOST]
    assert see(3.0, 6.0, ids[4:]) == tuple(ids)[4:]


@pytest.mark.parametrize(("begins", "confirmed"), [(3.0, True), (3.0, False), (0.0, True)])
def test_a_drift_is_told_from_a_wrong_start_by_when_it_begins(begins: float, confirmed: bool) -> None:
    """Names take either for a start that is off: a drift that begins when all has fitted is none. What names by stated
    places fit shows nothing."""
    places = {
        drone: np.array(place) for drone, place in ((2, [8.0, 0, 0]), (3, [0, 8.0, 0]), (4, [-6.0, 5.0, 0]))
    }

    class Doubting:
        def __init__(self, t: float) -> None:
            self._p = 0.95 if t < begins + 0.5 else 0.02

        def said_place(self, drone_id: int, t: float) -> SaidPlace | None:
            return SaidPlace(places[drone_id], 0.0, 1.0, 1e-3)

        def p_as_configured(self) -> float:
            return self._p

        def is_confirmed(self, drone_id: int) -> bool:
            return confirmed

    found = OwnPlace(US, WIDTH, cameras=[np.zeros(3)], start_sigma_m=0.05)
    for drone, place in places.items():
        found.announce(Announcement(drone, "0" * 8, 1, 0.0, 0.0, place, EYE, 0.01 * EYE))
    rays = np.array([place / np.linalg.norm(place) for place in places.values()])
    widths = np.array([WIDTH.width_m / float(np.linalg.norm(place)) for place in places.values()])
    keys = tuple((drone, 10 + drone) for drone in places)
    for k in range(90):
        t = 0.1 * k
        # Half a metre per second, or three metres from the beginning on.
        off = np.array([0.5 * (t - begins) * (t > begins), 0.0, 0.0]) if begins else np.array([3.0, 0.0, 0.0])
        seen = TeamLook(t, off, np.zeros(3), keys, rays, np.tile(1e-5 * EYE, (3, 1, 1)), widths, np.ones(3))
        found.observe(seen, 0, TeamPose(t, off, EYE, 0.01 * EYE, 1e-4 * EYE), t, Doubting(t))
    assert found.is_suspect == (begins > 0.0 and confirmed)
