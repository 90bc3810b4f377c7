"""Who a track is by how it moves: filters against closed forms, drones told apart wherever they started."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from support.observer import CAMERA, FORWARD
from swarmtrack.geometry import rotation
from swarmtrack.identity import ray_filters
from swarmtrack.identity.motion_evidence import (
    CODED,
    MOST,
    PUBLISHED,
    REPORTED,
    TRIED,
    TURNS,
    MotionEvidence,
    Saying,
)
from swarmtrack.identity.ray_filters import Looks, Model, RayFilters
from swarmtrack.identity.reprojection import ObserverCamera
from swarmtrack.messages import Track, TrackStatus
from swarmtrack.motion.ego import TeamPose

NORTH = np.array([1.0, 0.0, 0.0])
STILL = np.zeros(3)
SCAN_S = 1 / 7


def hovering(seed, size=0.15):
    """A place around its own (3,) m at t, and its derivative: slow sines by chance."""
    rng = np.random.default_rng(seed)
    rate, angle = rng.uniform(0.4, 2.5, (4, 3)), rng.uniform(0.0, 2.0 * math.pi, (4, 3))

    def flown(t):
        place = (np.sin(rate * t + angle) - np.sin(angle)).sum(axis=0)
        return size / math.sqrt(2.0) * place, size / math.sqrt(2.0) * (rate * np.cos(rate * t + angle)).sum(
            axis=0
        )

    return flown


def level(flown):
    """The same without its heave."""
    return lambda t: tuple(value * (1.0, 1.0, 0.0) for value in flown(t))


def at_rest(t):
    return STILL, STILL


class Flight:
    """Tracks 1, 2, … of things at `starts` that move as they do; drones 1, 2, … say how they move.

    late_s: by how much the scans stamp later than the sayings that they are of; misses: no detection in a scan (track);
    steps: at t [s] the observer's heading steps by so much [rad], and the evidence is told, or not, found_s later.
    """

    def __init__(
        self,
        starts,
        moves,
        *,
        observer=at_rest,
        late_s=0.0,
        misses=lambda scan: (),
        steps=(math.inf, 0.0, None),
    ):
        self.steps_t, self.step, self.found_s = steps
        self.starts = np.array(starts, dtype=float)
        self.moves, self.observer, self.late_s, self.misses = moves, observer, late_s, misses

    def watched(self, seconds, sayings, *, every=1, arrive_s=0.0, rng=None, thinks_of=None):
        """The evidence after so long. sayings: by drone how it says that it moves, at every `every`th scan; thinks_of:
        how likely the observer's north is turned by each of `TURNS`."""
        found, heard = MotionEvidence(), []
        found.think_of_turns(thinks_of)
        for scan in range(round(seconds / SCAN_S)):
            t = scan * SCAN_S
            if scan % every == 0:
                heard += [(t + arrive_s, saying(t)) for saying in sayings]
            for due in [one for one in heard if one[0] <= t]:
                heard.remove(due)
                found.hear(due[1])
            if self.found_s is not None and t - SCAN_S < self.steps_t + self.found_s <= t:
                found.begin_again(self.steps_t + self.found_s)
            self._look(found, scan, t, rng)
        return found

    def _look(self, found, scan, t, rng):
        true_t = t + self.late_s
        places = np.array([move(true_t)[0] for move in self.moves]) + self.starts
        view = ObserverCamera.of(
            TeamPose(t, self.observer(true_t)[0], np.eye(3), 0.01 * np.eye(3), 1e-4 * np.eye(3)),
            CAMERA,
            FORWARD,
        )
        away = (places - view.team_from_camera.position) @ view.team_from_camera.rotation
        pixel = 430.0 * away[:, :2] / away[:, 2:] + (320.0, 240.0)
        if t >= self.steps_t:
            believed = rotation.from_euler(0.0, 0.0, self.step)
            view = ObserverCamera.of(replace(view.observer, world_from_body=believed), CAMERA, FORWARD)
        if rng is not None:
            pixel += rng.standard_normal(pixel.shape)
        side = 430.0 * 0.45 / away[:, 2]
        tracks = [
            Track(
                k + 1,
                t,
                np.array([u, 0.0, v, 0.0]),
                np.eye(4),
                TrackStatus.CONFIRMED,
                1.0,
                np.full(2, side[k]),
            )
            for k, (u, v) in enumerate(pixel)
            if k + 1 not in self.misses(scan)
        ]
        found.observe(tracks, view)


def published(drone, flown, trust=PUBLISHED):
    return lambda t: Saying(drone, ("boot",), t, *flown(t), trust)


# --- the filters ---


def test_the_likelihood_of_rays_is_that_of_their_joint_gaussian():
    """Of one that climbs all is linear, and so all rays are one Gaussian: written down without a filter."""
    t = np.array([0.0, 0.2, 0.5, 0.6, 1.4])
    moved = np.outer([0.0, 0.2, -0.1, 0.3, 0.6], [0.0, 0.0, 1.0])
    speed = np.outer([0.5, 1.0, -0.4, 0.2, 0.9], [0.0, 0.0, 1.0])
    seen = np.array([[0.0, 0.0], [0.004, 0.021], [-0.006, -0.012], [0.003, 0.03], [0.01, 0.055]])
    kappa, kappa_sigma, clock, wander, w, noise = 0.1, 0.04, 0.1, 0.01, 1.2, 2e-5
    rays = np.array([[1.0, *a] for a in seen])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    filters, row = RayFilters([0.0], used=1), np.array([3])
    looks = [
        Looks(np.array([s]), ray[None], np.zeros((1, 3)), np.array([noise]), q[None, None], v[None, None])
        for s, ray, q, v in zip(t, rays, moved, speed, strict=True)
    ]
    filters.begin(row, looks[0], Model(*(np.full((1, 1), x) for x in (kappa, kappa_sigma, clock, wander, w))))
    for look in looks[1:]:
        filters.look(row, look)

    dt = np.abs(t[:, None] - t)
    attitude = ray_filters.ATTITUDE_SIGMA**2 * np.exp(-dt / ray_filters.ATTITUDE_S)
    strays = wander**2 * (1.0 + w * dt) * np.exp(-w * dt)
    # The axes across north: east and down.
    g, v = moved[:, 1:].T.ravel(), speed[:, 1:].T.ravel()
    cov = np.kron(np.eye(2), attitude + strays + noise * np.eye(len(t)))
    cov += kappa_sigma**2 * np.outer(g, g) + (clock * kappa) ** 2 * np.outer(v, v)
    # Where it was at first, anybody may guess: what is seen is how it moved from there.
    away = np.kron(np.eye(2), np.hstack([-np.ones((len(t) - 1, 1)), np.eye(len(t) - 1)]))
    measured = away @ (seen.T.ravel() - kappa * g)
    assert filters.log[3, 0] == pytest.approx(
        multivariate_normal.logpdf(measured, cov=away @ cov @ away.T) + 4 * math.log(0.99), abs=2e-3
    )


def test_a_ray_of_something_else_costs_little_and_teaches_nothing():
    kappa, still, none = 0.1, np.zeros((1, 3)), np.zeros((1, 1, 3))
    model = Model(*(np.full((1, 1), x) for x in (kappa, 0.04, 0.1, 0.003, 0.5)))

    def watched(*east):
        filters, row = RayFilters([0.0], used=1), np.array([0])
        for k, a in enumerate(east):
            ray = np.array([[1.0, a, 0.0]]) / math.hypot(1.0, a)
            look = Looks(np.array([0.2 * k]), ray, still, np.array([2e-5]), none, none)
            if k == 0:
                filters.begin(row, look, model)
            else:
                filters.look(row, look)
        return float(filters.log[0, 0])

    one_astray, all_well = watched(0.0, 0.15, 0.0, 0.0), watched(0.0, 0.0, 0.0, 0.0)
    assert all_well - 15.0 < one_astray < all_well - 5.0
    astray, beside = watched(0.0, 0.15, 0.0), watched(0.0, 0.15)
    assert astray - beside > 5.0


# --- who is who ---


def starts(n):
    return [[12.0, 2.5 * (k - (n - 1) / 2), 0.4 * (k % 2)] for k in range(n)]


@pytest.mark.parametrize("n", [2, 4])
def test_drones_that_sway_are_told_apart_by_what_they_say_wherever_it_is_counted_from(n):
    moves = [hovering(k) for k in range(1, n + 1)]
    said = [published(k + 1, lambda t, m=m, k=k: (m(t)[0] + 50.0 * k, m(t)[1])) for k, m in enumerate(moves)]
    found = Flight(starts(n), moves).watched(6.0, said, rng=np.random.default_rng(0))
    for track in range(1, n + 1):
        ratios = [found.log_ratio(track, drone) for drone in range(1, n + 1)]
        assert np.argmax(ratios) == track - 1
        assert ratios[track - 1] > math.log(1e3)
        assert sorted(ratios)[-2] < ratios[track - 1] - math.log(1e3)


def turned(flown, degrees):
    """The same as a drone tells it whose north is so much further to the left than the observer's."""
    about = rotation.from_euler(0.0, 0.0, math.radians(degrees))
    return lambda t: tuple(about @ value for value in flown(t))


@pytest.mark.parametrize("degrees", [0.0, 36.0, -108.0, 180.0, 90.0])
def test_an_observer_whose_north_is_turned_by_anything_finds_out_by_how_much(degrees):
    """It sees with a heading that is off; what its teammates say, and where itself is, are true."""
    moves = [level(hovering(1, size=0.5)), level(hovering(2, size=0.5))]
    said = [published(k + 1, turned(move, -degrees)) for k, move in enumerate(moves)]
    flight = Flight(starts(2), moves)
    anything = np.full(len(TURNS), 1.0 / len(TURNS))
    found = flight.watched(12.0, said, thinks_of=anything)
    by_turn = np.trace(found.log_ratios([1, 2], [1, 2]), axis1=1, axis2=2)
    away = np.abs((np.degrees(TURNS) - degrees + 180.0) % 360.0 - 180.0)
    assert away[by_turn.argmax()] <= 36.0
    assert by_turn[away > 60.0].max() < by_turn.max() - math.log(100.0)
    assert found.log_ratio(1, 1) > 0.0 > found.log_ratio(1, 2)


@pytest.mark.parametrize("trust", [PUBLISHED, REPORTED, CODED, TRIED])
def test_one_number_says_of_a_pair_what_the_table_of_that_pair_says(trust):
    moves, unheard = [hovering(1, size=1.0), hovering(2, size=1.0)], 7
    found = Flight(starts(2), moves).watched(12.0, [published(1, moves[0], trust)])
    for track, drone in ((1, 1), (2, 1), (1, unheard)):
        assert found.log_ratio(track, drone) == pytest.approx(found.log_ratios([track], [drone]).item())
    assert found.log_ratio(1, 1) > 0.0 > found.log_ratio(2, 1)


def test_no_turn_is_thought_of_unasked_and_none_once_it_is_settled():
    moves = [hovering(1), hovering(2)]
    flight, said = Flight(starts(2), moves), [published(1, moves[0])]
    found = flight.watched(6.0, said)
    assert found.turns == 1
    asked = flight.watched(6.0, said, thinks_of=np.full(len(TURNS), 1.0 / len(TURNS)))
    assert asked.turns == len(TURNS)
    asked.think_of_turns(None)
    assert asked.turns == 1
    assert asked.log_ratio(1, 1) == pytest.approx(found.log_ratio(1, 1), abs=1e-9)


def test_a_house_and_a_drone_that_hovers_still_are_as_likely_however_long_it_lasts():
    found = Flight(starts(2), [at_rest, at_rest]).watched(60.0, [published(1, at_rest)])
    assert found.log_ratio(1, 1) == pytest.approx(found.log_ratio(2, 1), abs=0.3)
    # Only that it is a stranger in flight is ruled out: it was one of two.
    assert -0.5 < found.log_ratio(1, 1) < math.log(2.0) + 0.3


@pytest.mark.parametrize("metres", [9.0, 15.0, 40.0, 1e4])
def test_a_thing_that_stands_is_known_by_the_observer_s_own_way_at_any_distance(metres):
    """The observer climbs with its teammate: the drone stays where it is in the image."""

    def climbing(t):
        return np.array([0.0, 0.0, -0.5 * t]), np.array([0.0, 0.0, -0.5])

    flight = Flight([8.0 * NORTH, [metres, 0.1 * metres, 0.0]], [climbing, at_rest], observer=climbing)
    found = flight.watched(6.0, [published(1, climbing)])
    assert found.log_ratio(1, 1) > 0.0
    # What is very far off stays where it is in the image, as the drone does.
    assert found.log_ratio(1, 1) - found.log_ratio(2, 1) > (3.0 if metres < 50.0 else -0.5)


@pytest.mark.parametrize("late_s", [-0.2, 0.0, 0.2])
def test_two_clocks_that_are_apart_change_nothing(late_s):
    moves = [hovering(1), hovering(2)]
    flight = Flight(starts(2), moves, late_s=late_s)
    found = flight.watched(8.0, [published(k + 1, m) for k, m in enumerate(moves)])
    for track, other in ((1, 2), (2, 1)):
        assert found.log_ratio(track, track) > math.log(1e3)
        assert found.log_ratio(track, other) < 0.0


def test_what_comes_a_second_late_counts_at_its_own_time():
    moves = [hovering(1), hovering(2)]
    said = [published(k + 1, m) for k, m in enumerate(moves)]
    late = Flight(starts(2), moves).watched(6.0 + 7 * SCAN_S, said, arrive_s=7 * SCAN_S)
    at_once = Flight(starts(2), moves).watched(6.0, said)
    # Which saying is the last is the one difference.
    assert late.log_ratio(1, 1) == pytest.approx(at_once.log_ratio(1, 1), abs=2.0)
    assert late.log_ratio(1, 2) == pytest.approx(at_once.log_ratio(1, 2), abs=2.0)


def test_a_spoofed_motion_is_of_no_track():
    found = Flight(starts(2), [hovering(1), hovering(2)]).watched(8.0, [published(1, hovering(5))])
    assert max(found.log_ratio(1, 1), found.log_ratio(2, 1)) < -math.log(1e3)


def test_places_that_are_told_once_a_second_never_decide_alone():
    flight = Flight(starts(2), [hovering(1, size=1.5), hovering(2, size=1.5)])
    found = flight.watched(40.0, [published(1, hovering(1, size=1.5), REPORTED)], every=7)
    assert found.log_ratio(1, 1) == pytest.approx(REPORTED.most)
    assert found.log_ratio(2, 1) == pytest.approx(-REPORTED.most)


def test_a_track_that_was_hidden_keeps_little_of_what_motion_said_and_may_be_another():
    moves = [hovering(1, size=0.5), hovering(2, size=0.5)]
    said = [published(k + 1, m) for k, m in enumerate(moves)]
    flight = Flight(starts(2), moves)
    found = flight.watched(10.0, said)
    assert found.log_ratio(1, 1) > 0.5 * MOST
    for track in (1, 2):
        found.weaken(track, 1.0)
        for drone in (1, 2):
            assert abs(found.log_ratio(track, drone)) <= 1.0 + math.log(4.0)


@pytest.mark.parametrize("found_s", [0.1, 0.6])
def test_a_step_of_the_own_heading_speaks_against_nobody_once_it_is_found(found_s):
    """An autopilot that aligns itself in flight turns all rays at once by some degrees."""

    def proof(found_s):
        flight = Flight(starts(1), [hovering(1)], steps=(8.0, math.radians(3.0), found_s))
        return flight.watched(9.5, [published(1, hovering(1))]).log_ratio(1, 1)

    assert proof(None) < 0.0
    assert proof(found_s) > math.log(1e3)


def test_a_place_that_was_set_anew_is_not_flown():
    """An estimator that jumps by metres speaks against nobody."""

    def jumps(t):
        place, speed = hovering(1)(t)
        return place + (4.0 if t > 5.0 else 0.0), speed

    found = Flight(starts(1), [hovering(1)]).watched(10.0, [published(1, jumps)])
    assert found.log_ratio(1, 1) > math.log(1e3)


def test_what_is_counted_from_elsewhere_begins_again_also_for_a_track_that_is_missed_just_then():
    """First the drone tells places, 50 m from where it counts its motion; that track is not detected as it changes."""

    def saying(t):
        if t < 3.0:
            return Saying(1, ("place",), t, hovering(1)(t)[0] + 50.0, hovering(1)(t)[1], REPORTED)
        return published(1, hovering(1))(t)

    flight = Flight(starts(2), [hovering(1), hovering(2)], misses=lambda scan: (1,) if scan == 21 else ())
    assert flight.watched(9.0, [saying]).log_ratio(1, 1) > math.log(1e3)


def test_nothing_is_weighed_while_nobody_says_anything():
    found = Flight(starts(3), [hovering(k) for k in range(3)]).watched(5.0, [])
    assert not found.pairs


def test_tracks_that_have_ended_are_forgotten_and_their_place_is_used_again():
    found = Flight(starts(3), [hovering(k) for k in range(3)]).watched(2.0, [published(1, hovering(1))])
    assert found.pairs == {(1, 1), (2, 1), (3, 1)}
    found.keep({2})
    assert found.pairs == {(2, 1)}
    assert found.log_ratio(1, 1) == 0.0


# --- what may not be flown, and who tells more ---


def of_source(name, flown, trust, *, after=0.0, until=math.inf):
    """A source that speaks for drone 1 at after ≤ t < until [s]; else it says what was said long ago."""

    def said(t):
        return Saying(1, (name,), t if after <= t < until else -9.0, *flown(t), trust)

    return said


def test_what_a_drone_may_not_fly_at_all_speaks_for_it_and_hardly_against_it():
    sways, other = hovering(3), hovering(4)
    flight = Flight([[8.0, -1.0, 0.0], [8.0, 1.0, 0.0]], [sways, other])
    rng = np.random.default_rng
    surely = flight.watched(8.0, [published(1, sways, CODED)], rng=rng(5))
    tried = flight.watched(8.0, [published(1, sways, TRIED)], rng=rng(5))
    assert surely.log_ratio(2, 1) < -math.log(100.0)
    assert tried.log_ratio(2, 1) == pytest.approx(-math.log(2.0), abs=0.01)
    assert tried.log_ratio(1, 1) == pytest.approx(surely.log_ratio(1, 1) - math.log(2.0), abs=0.01)


def test_a_code_that_was_not_flown_the_first_time_names_at_the_second():
    """At the first time the drone stays where it is; then it sways as it was to do before."""
    sways = hovering(3)
    flight = Flight([[8.0, 0.0, 0.0]], [lambda t: at_rest(t) if t < 7.0 else sways(t)])
    times = [
        of_source("first", sways, TRIED, until=7.0),
        of_source("second", sways, TRIED, after=7.0),
    ]
    first = flight.watched(6.9, times[:1], rng=np.random.default_rng(5))
    both = flight.watched(14.9, times, rng=np.random.default_rng(5))
    assert first.log_ratio(1, 1) < -0.5
    assert both.log_ratio(1, 1) > math.log(1e3)


def test_who_tells_less_is_not_heard_while_somebody_tells_more():
    sways = hovering(3)
    flight = Flight([[8.0, 0.0, 0.0]], [sways])
    alone = flight.watched(8.0, [published(1, sways)], rng=np.random.default_rng(5))
    beside = [published(1, sways), of_source("report", sways, REPORTED)]
    assert flight.watched(8.0, beside, rng=np.random.default_rng(5)).log_ratio(1, 1) == alone.log_ratio(1, 1)
    falls_silent = [of_source("boot", sways, PUBLISHED, until=0.2), of_source("report", sways, REPORTED)]
    later = flight.watched(9.0, falls_silent, rng=np.random.default_rng(5))
    assert later.exact == ()


def test_of_two_that_are_both_as_sure_as_any_may_be_the_likelier_one_stays_so():
    """They fly nearly alike: each alone is beyond what may be remembered."""
    flown, else_ = hovering(3, size=0.5), hovering(4, size=0.05)

    def nearly(t):
        return tuple(one + other for one, other in zip(flown(t), else_(t), strict=True))

    flight = Flight([(8.0, 0.0, 0.0)], [flown])
    found = flight.watched(2.0, [published(1, flown), published(2, nearly)])
    assert found.log_ratio(1, 1) == found.log_ratio(1, 2) == MOST
    of_it, of_other = found.log_ratios([1], [1, 2])[0, 0]
    assert of_it == MOST
    assert of_other < MOST - 0.5
