"""Relative states as a whole: against least squares over a whole flight, in Monte Carlo, and against liars."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from swarmtrack.benchmarks import relative as bench
from swarmtrack.geometry import rotation
from swarmtrack.messages import Announcement, MotionReport, RangeReport, Sighting, SightingReport
from swarmtrack.relative.box_width import BoxWidth
from swarmtrack.relative.gates import GATE
from swarmtrack.relative.log_range import cartesian, decay
from swarmtrack.relative.looks import TeamLook
from swarmtrack.relative.parameters import RelativeParameters
from swarmtrack.relative.priors import STRANGER_LEAST_SPEED_M_S
from swarmtrack.relative.reading import OwnMotion
from swarmtrack.relative.states import RelativeStates

DT = 1.0 / 7.0
STILL = OwnMotion(np.zeros(3), np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3)))
BOXES = BoxWidth(factor=1.0, drone_sigma=0.18, wander_sigma=0.12, wander_s=1.0, white_sigma=0.06)
TOLD = RelativeParameters(airframe_span_m=0.5, box_width=BOXES)
PLACE = np.array([8.0, 2.0, -1.0])


def look(t, *places, track=7, width=0.5, camera=(0.0, 0.0, 0.0), rng=None, sigma=2.5e-3, gain=1.0):
    """What is seen of teammates 2, 3, … at places (3,) m from the camera."""
    away = np.array(places, float).reshape(-1, 3)
    rho = np.linalg.norm(away, axis=1)
    ray = away / rho[:, None]
    if rng is not None:
        ray = ray + sigma * rng.normal(size=ray.shape)
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    keys = tuple((2 + i, track + i) for i in range(len(away)))
    cov = np.tile(sigma**2 * np.eye(3), (len(away), 1, 1))
    return TeamLook(
        t, np.array(camera, float), np.zeros(3), keys, ray, cov, width / rho, gain * np.ones_like(rho)
    )


def announced(place, sigma=0.1, t=0.0, drone=2):
    return Announcement(drone, "0000000a", 0, t, 0.0, np.array(place, float), np.eye(3), sigma**2 * np.eye(3))


def moves(velocity, t, drone=2, t_sigma=0.0):
    cov = 0.05**2 * np.eye(3)
    return MotionReport(drone, "0000000a", 0, t, t_sigma, np.zeros(3), cov, np.array(velocity, float), cov)


def watched(states, places, begin=0.0):
    for k, place in enumerate(places):
        states.observe(look(begin + k * DT, place))
    return begin + (len(places) - 1) * DT


def only(states, t, own=STILL):
    (state,) = states.at(t, own).values()
    return state


def test_a_drone_of_known_span_has_a_range_from_its_first_box():
    states = RelativeStates(TOLD)
    t = watched(states, [PLACE])
    state = only(states, t)
    assert state.drone_id == 2
    assert state.position == pytest.approx(PLACE, rel=1e-6)
    assert state.sources == ("size",)
    assert state.range_sigma_log == pytest.approx(math.sqrt(0.18**2 + 0.12**2 + 0.06**2))


@pytest.mark.parametrize("pause", [0.5, 1.5, 6.0])
def test_a_camera_may_pause_for_longer_than_the_past_is_kept(pause):
    states = RelativeStates(TOLD)
    t = watched(states, [PLACE] * 8)
    states.observe(look(t + pause, PLACE))
    states.hear_motion(moves([0.0, 0.0, 0.0], t + 0.5 * pause))
    states.observe(look(t + pause + DT, PLACE))
    assert only(states, t + pause + DT).position == pytest.approx(PLACE, rel=0.05)


def test_a_box_that_is_padding_for_the_most_part_tells_as_much_less():
    """What is off by 10 % of a box three times as wide as its drone is off by 30 % of the drone."""
    states = RelativeStates(TOLD)
    states.observe(look(0.0, PLACE, gain=2.0))
    assert only(states, 0.0).range_sigma_log == pytest.approx(2.0 * math.sqrt(0.18**2 + 0.12**2 + 0.06**2))
    states = RelativeStates(TOLD)
    for k in range(40):
        states.observe(look(k * DT, PLACE, gain=2.0))
    # What wanders and what is white is averaged out in part, and what lasts never.
    assert 2.0 * 0.18 < only(states, 39 * DT).range_sigma_log < 2.0 * math.sqrt(0.18**2 + 0.12**2 + 0.06**2)


def test_a_span_that_nobody_told_is_off_by_the_same_however_much_of_a_box_is_padding():
    unknown = RelativeParameters(box_width=BOXES)
    gain = np.array([1.0, 2.0, 4.0])
    assert (TOLD.lasting_by(gain) == gain).all()
    assert unknown.lasting * unknown.lasting_by(gain) == pytest.approx(np.hypot(0.6, 0.18 * gain))


def test_of_an_airframe_nobody_told_of_the_size_tells_no_range_until_a_place_is_known():
    states = RelativeStates()
    t = watched(states, [PLACE] * 8)
    assert states.at(t, STILL) == {}
    states = RelativeStates()
    states.hear_announcement(announced(PLACE))
    t = watched(states, [PLACE] * 8)
    state = only(states, t)
    assert state.sources == ("size", "announcement")
    assert state.position == pytest.approx(PLACE, abs=0.1)


def test_a_range_that_was_announced_teaches_what_the_box_is_worth():
    """Once the drone has flown off, the size alone keeps the range: its lasting error was learned."""
    told = replace(TOLD, box_width=replace(BOXES, wander_sigma=0.0, white_sigma=0.02))
    states = RelativeStates(told)
    states.hear_announcement(announced(PLACE, sigma=0.05))
    for k in range(20):
        # The box is a fifth too wide.
        states.observe(look(k * DT, PLACE, width=0.6))
    for k in range(20, 120):
        far = PLACE * min(1.0 + 0.02 * (k - 20), 2.0)
        states.observe(look(k * DT, far, width=0.6))
    state = only(states, 119 * DT)
    assert np.linalg.norm(state.position) == pytest.approx(2.0 * np.linalg.norm(PLACE), rel=0.05)
    assert state.range_sigma_log < 0.06


@pytest.mark.parametrize(("radius", "apart"), [(0.0, 0.1), (2.0, 4.0)])
@pytest.mark.parametrize("seed", range(3))
def test_a_steady_flight_is_estimated_as_by_least_squares_over_all_of_it(seed, radius, apart):
    """A teammate on a straight line, an observer that hovers or circles: the same data to SciPy, all at once. While it
    hovers all is linear; on the circle the first steps knew the range less well than the last.
    """
    rng = np.random.default_rng(seed)
    boxes = replace(BOXES, wander_sigma=0.0, white_sigma=0.1)
    told = replace(TOLD, speed_sigma=1.5, fellows=0.0, forget_s=1e9, box_width=boxes,
                   odometry=0.0, jitter_m=0.0, attitude_walk=0.0)  # fmt: skip
    states = RelativeStates(told)
    t = np.arange(60) * DT
    eye = radius * np.column_stack([np.cos(t), np.sin(t), 0.0 * t])
    velocity, bias = np.array([0.2, 0.9, -0.1]), 0.12
    away = PLACE + t[:, None] * velocity - eye
    rho = np.linalg.norm(away, axis=1)
    rays = away / rho[:, None] + 2.5e-3 * rng.normal(size=away.shape)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    width = 0.5 / rho * np.exp(-bias - 0.1 * rng.normal(size=60))
    for k in range(60):
        seen = TeamLook(
            t[k], eye[k], np.zeros(3), ((2, 7),), rays[k][None], 2.5e-3**2 * np.eye(3)[None], width[k, None],
            np.ones(1),
        )  # fmt: skip
        states.observe(seen)

    def misses(x):
        d = x[:3] + t[:, None] * x[3:6] - eye
        length = np.linalg.norm(d, axis=1)
        across = (d / length[:, None] - rays) / 2.5e-3
        size = (np.log(length) + x[6] - np.log(0.5 / width)) / 0.1
        return np.concatenate([across.ravel(), size, x[3:6] / 1.5, x[6:] / 0.18])

    whole = least_squares(misses, np.concatenate([PLACE, np.zeros(3), [0.0]]))
    cov = np.linalg.inv(whole.jac.T @ whole.jac)
    to_end = np.block([[np.eye(3), t[-1] * np.eye(3)], [np.zeros((3, 3)), np.eye(3)]])
    at_end, cov = to_end @ whole.x[:6], to_end @ cov[:6, :6] @ to_end.T
    at_end[:3] -= eye[-1]
    state = only(states, t[-1], STILL._replace(camera=eye[-1]))
    off = np.concatenate([state.position, state.velocity]) - at_end
    assert off @ np.linalg.solve(cov, off) < apart
    assert np.sqrt(np.diag(state.cov)) == pytest.approx(np.sqrt(np.diag(cov)), rel=0.05)


@pytest.mark.parametrize(
    ("row", "range_m"), [(0, 3.0), (0, 40.0), (1, 3.0), (2, 10.0), (4, 10.0), (8, 10.0), (9, 10.0)]
)
def test_what_is_stated_is_as_far_off_as_it_says(row, range_m):
    """Of 15 teammates: the mean NEES lies in the interval of as many flights with four independent instants each."""
    flights = [bench.fly(range_m, bench.MODES[row], seed) for seed in (1, 2)]
    mean = np.concatenate([flight.nees[7:].mean(axis=0) for flight in flights])
    assert np.isfinite(mean).all()
    n = 4 * len(mean)
    low, high = chi2.ppf([1e-3, 1.0 - 1e-3], 6 * n) / n
    assert low < mean.mean() < high


@pytest.mark.parametrize("row", [4, 8], ids=["velocity", "UWB"])
def test_velocity_that_is_said_is_worth_a_radio_ranger(row):
    found = bench.summary([bench.fly(10.0, bench.MODES[row], seed) for seed in (1, 2)])
    assert found["range_error"] < 0.03
    assert found["to_10_percent_s"] < 3.0


def test_a_late_word_counts_at_its_own_time():
    """A teammate brakes hard: what it said of the time before is no lie, and is not believed of now."""
    states = RelativeStates(TOLD)
    states.hear_announcement(announced(PLACE, 0.05))
    aside = np.array([0.0, 1.5, 0.0])
    places = [PLACE + k * DT * aside for k in range(15)]
    places += [places[-1]] * 3
    t = watched(states, places)
    states.hear_motion(moves(aside, t - 4 * DT))
    assert states.counters["relative_refused"] == 0
    assert only(states, t).velocity[1] < 1.2


@pytest.mark.parametrize("late", [0.08, 0.2])
@pytest.mark.parametrize("words", [False, True])
def test_looks_of_a_camera_that_is_late_tell_nearly_as_much_as_in_their_order(late, words):
    """Of two cameras that look in turn, one sits beside the other; the own drone and the teammate fly."""

    def seen(t, camera, rng):
        own = np.array([1.0 * t, 0.3 * math.sin(t) + 0.14 * camera, 0.0])
        there = PLACE + np.array([1.5 * math.sin(0.8 * t), 2.0 * math.sin(0.5 * t), 0.0])
        return look(t, there - own, camera=own, rng=rng)

    arrives = sorted((k * DT / 2.0 + late * (k % 2), k * DT / 2.0, k % 2) for k in range(120))
    told = []
    for scans in (sorted(arrives, key=lambda scan: scan[1]), arrives):
        states, rngs = RelativeStates(TOLD), [np.random.default_rng(1), np.random.default_rng(2)]
        told.append([])
        for _, t, camera in scans:
            states.observe(seen(t, camera, rngs[camera]))
            if words and not camera:
                said = t - 0.05
                states.hear_motion(moves((1.2 * math.cos(0.8 * said), math.cos(0.5 * said), 0.0), said))
            if t > 4.0 and not camera:
                told[-1].append(only(states, t))
        assert (states.surprised, states.refused) == (0, 0)
    for ordered, state in zip(*told, strict=True):
        sigma = np.sqrt(np.diagonal(ordered.cov))
        assert (np.abs(state.position - ordered.position) < sigma[:3]).all()
        assert (np.abs(state.velocity - ordered.velocity) < sigma[3:]).all()
    less = [state.range_sigma_log / ordered.range_sigma_log for ordered, state in zip(*told, strict=True)]
    # What may have happened between such a look and the scan that it comes after counts as its noise.
    assert 0.97 < np.mean(less) < 1.3


def test_what_is_older_than_the_history_or_yet_to_come_is_let_go():
    states = RelativeStates(TOLD)
    t = watched(states, [PLACE] * 20)
    before = only(states, t)
    for when in (t - 2.0, t + 7200.0, t - 7200.0, math.nan):
        states.hear_motion(moves((0.5, 0.0, 0.0), when))
    assert states.counters["relative_late"] == 4
    assert (only(states, t).cov == before.cov).all()


def test_words_that_overtake_each_other_count_once():
    """After what is late was folded in, the scans before tell no more how errors moved: what is older still goes."""
    states = RelativeStates(TOLD)
    t = watched(states, [PLACE] * 10)
    states.hear_motion(moves((0.0, 0.0, 0.0), t - 2 * DT))
    after = only(states, t).cov
    states.hear_motion(moves((0.0, 0.0, 0.0), t - 3 * DT))
    assert states.counters["relative_late"] == 1
    assert (only(states, t).cov == after).all()
    states.hear_motion(moves((0.0, 0.0, 0.0), t + 0.01))
    assert np.trace(only(states, t).cov) < np.trace(after)


@pytest.mark.parametrize("gap", [1, 2])
def test_a_name_that_came_back_knows_nothing_of_what_was_said_before(gap):
    states, other = RelativeStates(TOLD), np.array([9.0, -2.0, 0.0])
    for k in range(5 + gap):
        lost = 3 <= k < 3 + gap
        states.observe(look(k * DT, *([PLACE] if lost else [PLACE, other])))
    t = (4 + gap) * DT
    before = states.at(t, STILL)[7]
    states.hear_motion(moves([1.0, 0.0, 0.0], t=1.5 * DT, drone=3))
    assert states.late == 1
    assert (states.at(t, STILL)[7].cov == before.cov).all()
    states.hear_motion(moves([0.0, 0.0, 0.0], t=t, drone=3))
    assert states.late == 1


def test_the_attitude_counts_in_what_is_said_and_nowhere_else():
    states = RelativeStates(TOLD)
    t = watched(states, [PLACE] * 5)
    plain = only(states, t)
    tilted = only(states, t, STILL._replace(attitude_cov=0.02**2 * np.eye(3)))
    assert (only(states, t).cov == plain.cov).all()
    assert tilted.range_sigma_log == plain.range_sigma_log
    more = tilted.cov[:3, :3] - plain.cov[:3, :3]
    # Of a turn about each axis: across the ray, by 20 mrad times the distance.
    assert PLACE @ more @ PLACE == pytest.approx(0.0, abs=1e-6)
    assert np.trace(more) == pytest.approx(2.0 * (0.02 * np.linalg.norm(PLACE)) ** 2, rel=1e-3)


def test_between_scans_a_state_goes_on_as_the_filter_would_without_a_look():
    states, unseen = RelativeStates(TOLD), RelativeStates(TOLD)
    places = [PLACE + k * DT * np.array([0.0, 1.0, 0.0]) for k in range(20)]
    for one in (states, unseen):
        t = watched(one, places)
    eye = np.array([0.3, -0.2, 0.1])
    later = states.at(t + 0.1, STILL._replace(camera=eye))[7]
    blind = look(t + 0.1, places[-1], camera=eye)
    unseen.observe(replace(blind, ray=np.full((1, 3), np.nan), width=np.full(1, np.nan)))
    want = unseen.at(t + 0.1, STILL._replace(camera=eye))[7]
    assert later.position == pytest.approx(want.position, abs=1e-9)
    assert later.velocity == pytest.approx(want.velocity, abs=1e-9)
    # But for the own way's and the attitude's walk, and the lever of what it is not sure of.
    assert np.diag(later.cov) == pytest.approx(np.diag(want.cov), rel=0.02)


def test_a_state_ends_with_its_name_and_is_handed_on_to_nobody():
    states = RelativeStates(TOLD)
    t = watched(states, [PLACE] * 5)
    states.hear_range(RangeReport(1, 2, t, 0.0, float(np.linalg.norm(PLACE)), 0.1))
    assert only(states, t).range_sigma_log < 0.02
    # The same ID on another track.
    states.observe(look(t + DT, PLACE, track=8))
    assert list(states.at(t + DT, STILL)) == [8]
    assert only(states, t + DT).range_sigma_log > 0.15
    states.observe(look(t + 2 * DT))
    assert states.at(t + 2 * DT, STILL) == {}


def test_a_teammate_that_is_not_detected_for_a_while_is_carried_on_and_blurs():
    states = RelativeStates(TOLD)
    places = [PLACE + k * DT * np.array([0.0, 1.0, 0.0]) for k in range(30)]
    t = watched(states, places[:20])
    before = only(states, t)
    for k in range(20, 30):
        unseen = look(k * DT, places[k])
        states.observe(replace(unseen, ray=np.full((1, 3), np.nan), width=np.full(1, np.nan)))
    after = only(states, 29 * DT)
    assert np.trace(after.cov) > 1.5 * np.trace(before.cov)
    off = after.position - places[29]
    assert off @ np.linalg.solve(after.cov[:3, :3], off) < chi2.ppf(0.999, 3)


def test_a_liar_costs_nothing_but_a_count():
    states, honest = RelativeStates(TOLD), RelativeStates(TOLD)
    for one in (states, honest):
        t = watched(one, [PLACE] * 10)
    states.hear_motion(moves((200.0, 0.0, 0.0), t))
    states.hear_range(RangeReport(1, 2, t, 0.0, 250.0, 0.01))
    states.hear_sightings(SightingReport(2, "0000000a", 0, t, 0.0, 30.0 * PLACE, 0.1, (), ()))
    states.hear_announcement(announced(-PLACE, t=t))
    assert states.counters["relative_refused"] == 4
    assert (only(states, t).cov == only(honest, t).cov).all()
    assert (only(states, t).position == only(honest, t).position).all()


@pytest.mark.parametrize(("distance", "sigma"), [(math.nan, 0.1), (-1.0, 0.1), (5.0, 0.0), (5.0, math.inf)])
def test_a_range_that_is_none_is_refused_at_birth(distance, sigma):
    with pytest.raises(ValueError, match="expected finite numbers above 0"):
        RangeReport(1, 2, 0.0, 0.0, distance, sigma)


@pytest.mark.parametrize("times", [-1.0, 4.0], ids=["behind the camera", "four times as far as its size"])
def test_a_start_that_cannot_be_is_not_believed(times):
    states = RelativeStates(TOLD)
    states.hear_announcement(announced(times * PLACE))
    t = watched(states, [PLACE] * 3)
    assert only(states, t).sources == ("size",)


def test_an_own_frame_that_is_set_anew_begins_everything_anew():
    states = RelativeStates(TOLD)
    watched(states, [PLACE] * 5)
    states.observe(look(5 * DT, PLACE, camera=(500.0, 0.0, 0.0)))
    state = only(states, 5 * DT, STILL._replace(camera=np.array([500.0, 0.0, 0.0])))
    assert state.position == pytest.approx(PLACE, rel=1e-6)
    assert state.range_sigma_log > 0.2


def test_rays_of_others_narrow_the_range_and_many_are_no_more_than_a_few():
    """Two observers at right angles: what is left is what their frames differ by, however long they look."""
    states, alone, eye = RelativeStates(TOLD), RelativeStates(TOLD), np.array([8.0, -6.0, -1.0])
    towards = (PLACE - eye) / np.linalg.norm(PLACE - eye)
    ray = Sighting(2, 0.99, rotation.exp([0.0, 0.0, 0.03]) @ towards, 2e-3)
    for k in range(300):
        for one in (states, alone):
            one.observe(look(k * DT, PLACE))
        if k % 7 == 0:
            states.hear_sightings(SightingReport(5, "0000000b", k, k * DT, 0.0, eye, 0.05, (), (ray,)))
    state = only(states, 299 * DT)
    assert state.sources == ("size", "sighting")
    assert 0.03 < state.range_sigma_log < 0.75 * only(alone, 299 * DT).range_sigma_log
    assert math.log(np.linalg.norm(state.position / np.linalg.norm(PLACE))) < 3.0 * state.range_sigma_log


def test_scans_of_nobody_are_ordinary():
    states = RelativeStates(TOLD)
    for k in range(3):
        states.observe(look(k * DT))
    assert states.at(3 * DT, STILL) == {}
    states.hear_motion(moves((0.0, 0.0, 0.0), 2 * DT))


def test_the_same_flight_gives_the_same_bits():
    one, two = (bench.fly(10.0, bench.MODES[5], 3) for _ in range(2))
    assert (one.nees == two.nees).all()
    assert (one.place2 == two.place2).all()


def test_the_gates_are_the_quantiles_that_scipy_gives():
    assert {n: pytest.approx(chi2.ppf(0.9999, n), abs=1e-3) for n in GATE} == GATE


def test_reading_again_is_reading_the_same_and_never_what_was_before_a_change():
    """A reading is kept between changes: after a scan, a word, or a name that is forgotten there is another."""
    states = RelativeStates(TOLD)
    t = watched(states, [PLACE] * 5)
    first, again = only(states, t + 0.05), only(states, t + 0.05)
    assert (first.cov == again.cov).all()
    assert (first.position == again.position).all()
    states.hear_range(RangeReport(1, 2, t, 0.0, float(np.linalg.norm(PLACE)), 0.1))
    told = only(states, t + 0.05)
    assert told.range_sigma_log < 0.5 * first.range_sigma_log
    assert "range" in told.sources
    states.observe(look(t + DT, PLACE))
    assert np.trace(only(states, t + DT).cov) < np.trace(told.cov) + 1.0
    assert only(states, t + DT + 0.05).t == t + DT + 0.05
    states.reset(2)
    assert states.at(t + DT, STILL) == {}


@pytest.mark.parametrize("ahead", [0.0, 1e-3, 0.1, 1.0])
def test_many_are_read_as_each_of_them_is_alone(ahead):
    """By the table of eight numbers, as by the closed form for one teammate after the other."""
    rng = np.random.default_rng(4)
    places = [PLACE + 3.0 * rng.normal(size=3) for _ in range(6)]
    states = RelativeStates(TOLD)
    for k in range(12):
        states.observe(look(k * DT, *(place + 0.1 * k for place in places), rng=rng))
    t = 11 * DT
    own = OwnMotion(rng.normal(size=3), rng.normal(size=3), 0.1 * np.eye(3), np.diag([1e-4, 2e-4, 9e-4]))
    now = states._now
    step = decay(ahead, states._prior(now.keys))
    found = cartesian(now.beliefs, step)
    for i, state in enumerate(states.at(t + ahead, own).values()):
        r, v = found.r[i] - own.camera, found.v[i] - own.velocity
        by_turn = np.concatenate([np.cross(np.eye(3), r).T, np.cross(np.eye(3), v).T])
        cov = found.cov[i] + by_turn @ own.attitude_cov @ by_turn.T
        cov[:3, :3] += TOLD.jitter_m**2 * np.eye(3)
        cov[3:, 3:] += own.velocity_cov
        assert state.position == pytest.approx(r)
        assert state.velocity == pytest.approx(v)
        assert state.cov == pytest.approx(cov, rel=1e-9, abs=1e-12)


def closing_of_one_who_comes(least_speed, seed):
    """m/s that somebody comes, and the standard deviation of that, of who hovered 14 m off for 16 s and then has flown
    straight on at 2 m/s for 2.5 s."""
    boxes = BoxWidth(factor=1.0, drone_sigma=0.19, wander_sigma=0.02, white_sigma=0.11)
    states = RelativeStates(RelativeParameters(airframe_span_m=0.5, box_width=boxes, least_speed=least_speed))
    chance = np.random.default_rng(seed)
    for t in np.arange(0.0, 18.5, DT):
        place = (14.0 - 2.0 * max(t - 16.0, 0.0), 0.0, 0.0)
        width = 0.5 * math.exp(0.11 * chance.normal())
        states.observe(look(t, place, rng=chance, width=width, sigma=5e-3))
    state = only(states, t)
    return -state.velocity[0], math.sqrt(state.cov[3, 3])


def test_who_hovered_for_long_and_then_comes_straight_on_is_known_to_come_where_nobody_takes_it_to_be_calm():
    comes, sigma = np.array(
        [closing_of_one_who_comes(STRANGER_LEAST_SPEED_M_S, seed) for seed in range(12)]
    ).T
    assert (comes + sigma > 1.2).all()
    assert np.median(comes + sigma) > 1.7
    calm = [sum(closing_of_one_who_comes(0.2, seed)) for seed in range(12)]
    assert np.median(calm) < 1.2


@pytest.mark.parametrize("seed", range(3))
def test_errors_of_a_carried_place_say_nothing_of_ranges(seed):
    """The own place goes to and fro by 0.1 m, and no ray turns: as if the teammate were far away."""
    rng, off, errors = np.random.default_rng(seed), np.zeros(3), {}
    for walk in (0.0, 0.03):
        states = RelativeStates(TOLD)
        states.hear_announcement(announced(PLACE))
        for k in range(200):
            off = 0.8 * off + rng.normal(0.0, 0.06, 3)
            states.observe(replace(look(k * DT, PLACE, rng=rng), camera=off, walk=walk))
            states.hear_motion(moves((0.0, 0.0, 0.0), k * DT))
        state = only(states, 199 * DT)
        away = float(np.linalg.norm(PLACE))
        errors[walk] = math.log(float(np.linalg.norm(state.position)) / away) / state.range_sigma_log
    assert abs(errors[0.03]) < 2.0 < abs(errors[0.0])
