"""Names among houses, poles and birds: rivals, sizes, and what is asked of whom."""

import math

import numpy as np
import pytest

from support.observer import CAMERA, LEFT, MIDDLE, RIGHT, SCAN_S, Observer, at, shifted
from swarmtrack.identity import spans
from swarmtrack.identity.posterior import PRIOR
from swarmtrack.identity.reprojection import anywhere
from swarmtrack.identity.scene import PRIOR_S, Scene
from swarmtrack.identity.spans import SPAN, Spans
from swarmtrack.identity.weighing import PLACE_ALONE, Weighing
from swarmtrack.identity.whereabouts import Whereabouts
from swarmtrack.messages import Announcement, SightingReport

BESIDE = shifted(LEFT, right=14.0)


# --- rivals ---


def test_a_house_is_no_drone_while_a_track_that_is_not_confirmed_yet_may_be_it(observer):
    assert observer.sees(2.0, tentative="a", a=LEFT, b=RIGHT, c=BESIDE)["c"] is None


def test_the_same_house_alone_is_as_good_as_the_drone(observer):
    assert observer.sees(2.0, b=RIGHT, c=BESIDE)["c"] == 2


def test_a_name_that_was_given_without_a_rival_is_doubted_when_one_comes_and_its_drone_is_asked(observer):
    observer.sees(2.0, b=RIGHT, c=BESIDE)
    observer.wanted.clear()
    names = observer.sees(3 * SCAN_S, a=shifted(LEFT, right=-4.0), b=RIGHT, c=BESIDE)
    assert (names["b"], names["c"]) == (3, None)
    assert 2 in {drone for _, drone in observer.wanted}


def test_a_doubted_name_goes_to_no_rival_while_its_own_track_misses_a_detection(observer):
    observer.sees(2.0, b=RIGHT, c=BESIDE)
    both = {"a": shifted(LEFT, right=-4.0), "b": RIGHT, "c": BESIDE}
    observer.sees(1.0, **both)
    assert observer.sees(2 * SCAN_S, coasting="a", **both)["c"] is None
    assert observer.sees(2 * SCAN_S, coasting="c", **both)["a"] is None


def test_a_second_track_of_the_same_thing_puts_no_name_in_doubt(observer):
    observer.sees(2.0, a=LEFT, b=RIGHT)
    assert observer.sees(1.0, a=LEFT, b=RIGHT, c=shifted(LEFT, right=3.0))["a"] == 2


def test_a_house_loses_its_name_to_the_drone_once_that_has_said_that_it_moved(observer):
    """Nothing is tracked but the house, at 14 px; then the drone, 1.5 m away from it."""
    observer.sees(2.0, b=RIGHT, c=BESIDE)
    up = shifted(LEFT, down=-80.0)
    for _ in range(3):
        observer.is_told(2, up)
        names = observer.sees(1.0, a=up, b=RIGHT, c=BESIDE)
    assert (names["a"], names["c"]) == (2, None)


def test_a_house_loses_its_name_when_its_drone_says_that_it_has_moved_although_nothing_else_is_seen(observer):
    assert observer.sees(2.0, b=RIGHT, c=BESIDE)["c"] == 2
    observer.is_told(2, shifted(LEFT, down=-80.0))
    assert observer.sees(1.0, b=RIGHT, c=BESIDE)["c"] is None


def test_of_the_names_stated_among_strangers_as_many_are_right_as_their_probabilities_promise():
    """Skies as the prior has them: one stranger in the mean, anywhere and of any size, and one drone in ten overlooked
    at first. All are named without a rival if they are; then the drone that was overlooked comes."""
    rng = np.random.default_rng(3)
    # px at 2 m: of the announced pose (0.1 m), of the own one (0.05 m and 0.01 rad), and of a body in its box of 80 px.
    sigma = math.hypot(0.1 * 215.0, 0.05 * 215.0, 0.01 * 430.0, 0.15 * 80.0)
    promised, right = [], []
    for _ in range(250):
        observer = Observer()
        observer.hears(2, MIDDLE, metres=2.0)
        tracks = {"a": tuple(rng.normal(MIDDLE, sigma))}
        span = 0.45 * math.exp(0.6 * rng.standard_normal())
        observer.sizes["a"] = (215.0 * span, 215.0 * span)
        for name in "bcdef"[: rng.poisson(1.0)]:
            tracks[name] = tuple(rng.uniform((0.0, 0.0), (640.0, 480.0)))
            observer.sizes[name] = (math.exp(rng.uniform(math.log(4.0), math.log(320.0))),) * 2
        overlooked = rng.random() > PRIOR.p_seen
        seen = {name: pixel for name, pixel in tracks.items() if name != "a" or not overlooked}
        for visible in (seen, tracks):
            observer.sees(0.4, **visible)
            for entry in observer.identities.label(observer.tracks):
                if entry.identity == 2:
                    promised.append(entry.identity_probability)
                    right.append(entry.track.id == 1)
    assert len(right) > 300
    assert 0.95 < np.mean(promised) <= PLACE_ALONE
    assert np.mean(right) > np.mean(promised) - 2.0 * math.sqrt(0.02 / len(right))


# --- sizes ---


def test_a_box_says_by_bayes_rule_how_likely_it_is_the_drone_s_at_its_distance():
    known = Spans()
    box, metres = np.array([40.0, 25.0]), 8.0
    variance = spans.SPAN_SIGMA**2 + spans.BOX_SIGMA**2 + (0.4 / metres) ** 2
    x = math.log(40.0 * metres / 430.0 / SPAN)
    by_hand = math.exp(-0.5 * x * x / variance) / math.sqrt(2.0 * math.pi * variance) * math.log(80.0)
    assert known.log_ratio(2, box, metres, 0.4, focal_px=430.0) == pytest.approx(math.log(by_hand))


def test_once_a_drone_was_recognised_a_box_of_twice_its_size_is_rather_not_it():
    known = Spans()
    for _ in range(5):
        known.learn(2, np.array([44.0, 25.0]), 8.0, 0.99, focal_px=430.0)
    right = known.log_ratio(2, np.array([44.0, 25.0]), 8.0, 0.4, focal_px=430.0)
    assert right - known.log_ratio(2, np.array([90.0, 37.0]), 8.0, 0.4, focal_px=430.0) > 2.0
    # Nearer it looks as large as it must.
    assert known.log_ratio(2, np.array([88.0, 50.0]), 4.0, 0.4, focal_px=430.0) == pytest.approx(
        right, abs=0.2
    )


def test_a_size_that_was_learned_from_the_wrong_thing_never_rules_the_drone_out():
    known = Spans()
    for _ in range(100):
        known.learn(2, np.array([180.0, 60.0]), 8.0, 1.0, focal_px=430.0)
    before = Spans().log_ratio(2, np.array([24.0, 15.0]), 8.0, 0.4, focal_px=430.0)
    assert (
        known.log_ratio(2, np.array([24.0, 15.0]), 8.0, 0.4, focal_px=430.0)
        > before + math.log(1.0 - spans.MOST_SURE) - 1e-6
    )


@pytest.mark.parametrize(("size", "metres"), [((np.nan, np.nan), 8.0), ((20.0, 20.0), np.nan)])
def test_a_size_or_a_distance_that_nobody_knows_says_nothing(size, metres):
    assert Spans().log_ratio(2, np.array(size), metres, 1.0, focal_px=430.0) == 0.0


# --- the scene ---


def test_the_prior_of_a_scene_begins_as_that_of_one_look_and_follows_what_is_seen():
    scene = Scene(1.0)
    begin = scene.log_ratio(2, 0.0, weak=False)
    assert begin == pytest.approx(PRIOR.log_ratio, abs=0.3)
    # Four, evenly over an image of one radian.
    everywhere = [(math.radians(5.0 * step), 4.0 * math.radians(5.0)) for step in range(-18, 19)]
    for k in range(31):
        scene.learn(0.1 * k, everywhere, [], {2: 0.9})
    strangers = (PRIOR_S * PRIOR.strangers + 4.0 * 3.0) / (PRIOR_S + 3.0)
    assert scene.log_ratio(2, 0.0, weak=False) == pytest.approx(begin - math.log(strangers), abs=0.05)


def test_where_a_drone_is_overlooked_what_is_near_its_place_is_less_likely_the_drone():
    scene = Scene(1.0)
    for k in range(100):
        scene.learn(0.1 * k, [], [], {2: 0.0, 3: 1.0})
    assert scene.log_ratio(2, 0.0, weak=False) < scene.log_ratio(3, 0.0, weak=False) - 2.0


def test_strangers_on_the_horizon_make_names_doubtful_there_and_not_in_the_sky():
    scene, begin = Scene(1.0), Scene(1.0).log_ratio(2, 0.0, weak=False)
    for k in range(100):
        scene.learn(0.1 * k, [(0.0, 1.0)], [], {2: 0.9})
    assert scene.log_ratio(2, 0.0, weak=False) < begin - 0.7
    assert scene.log_ratio(2, 0.4, weak=False) > begin


def test_a_drone_that_is_likely_out_of_view_is_missed_for_that_reason():
    """Bayes: it is seen with p, times that it is in the image; not seen with one minus that."""
    scene, p = Scene(1.0), PRIOR.p_seen
    assert scene.log_ratio(2, 0.0, weak=False) - scene.log_ratio(
        2, 0.0, weak=False, in_view=0.1
    ) == pytest.approx(math.log((1.0 - 0.1 * p) / (1.0 - p)))


def test_a_ghost_at_the_border_is_less_likely_a_drone_that_should_be_beyond_it_than_one_inside():
    given = []
    for place, ghost in (((690.0, 240.0), (632.0, 240.0)), ((370.0, 240.0), (312.0, 240.0))):
        observer = Observer()
        observer.sizes["a"] = (80.0, 80.0)
        observer.hears(2, place, metres=2.0)
        observer.sees(1.0, a=ghost)
        (entry,) = observer.identities.label(observer.tracks)
        given.append(1.0 - entry.identity_probability)
    assert given[0] > given[1] + 0.01


# --- places ---


def announced(t=0.0, boot="0000000a", sequence=1, position=None, sigma=0.3):
    position = at(LEFT) if position is None else position
    return Announcement(2, boot, sequence, t, 0.0, position, np.eye(3), sigma**2 * np.eye(3))


def report(t, position, sigma=0.1, t_sigma=0.0, boot="0000000a"):
    return SightingReport(2, boot, 1, t, t_sigma, position, sigma, (), ())


def test_a_drone_is_where_it_reported_itself_last_and_no_surer_of_it_than_its_announcement():
    places = Whereabouts()
    places.announce(announced())
    places.report(report(1.0, at(MIDDLE)))
    assert places.latest(2).t == 1.0
    assert places.latest(2).position == pytest.approx(at(MIDDLE))
    assert np.diag(places.latest(2).position_cov).min() >= 0.09


def test_who_was_found_elsewhere_than_it_says_is_believed_no_more_than_that_until_it_starts_again():
    places = Whereabouts()
    places.announce(announced())
    places.doubt(2, 3.0)
    places.report(report(1.0, at(MIDDLE)))
    assert np.diag(places.latest(2).position_cov).min() >= 9.0
    places.announce(announced(t=5.0, boot="0000000b"))
    assert places.latest(2).position_cov == pytest.approx(announced().position_cov)


def test_a_report_from_the_pad_says_that_the_drone_still_waits_and_one_from_elsewhere_that_it_flies():
    places = Whereabouts()
    places.announce(announced())
    places.report(report(1.0, at(LEFT) + 0.1))
    assert places.on_pad == {2}
    places.report(report(2.0, at(LEFT) + 2.0))
    assert not places.on_pad


def test_a_step_of_the_heading_on_the_ground_is_no_take_off():
    places = Whereabouts()
    places.announce(announced())
    places.announce(announced(1.0, sequence=2, position=at(LEFT) + 0.1))
    assert places.on_pad == {2}
    places.report(report(2.0, at(LEFT) + 0.1))
    assert places.on_pad == {2}
    places.announce(announced(3.0, sequence=3, position=at(LEFT) - (0.0, 0.0, 2.0)))
    assert not places.on_pad


def test_a_drone_that_hovers_above_its_pad_flies_however_vague_its_place():
    places = Whereabouts()
    places.announce(announced(sigma=2.0))
    places.announce(announced(1.0, sequence=2, position=at(LEFT) - (0.0, 0.0, 1.5), sigma=2.0))
    assert not places.on_pad


@pytest.mark.parametrize(
    "said",
    [
        [announced(), announced(1.0, sequence=2, position=at(RIGHT)), announced(2.0, sequence=3)],
        [announced(), announced(1.0, "0000000b", sequence=2)],
        [announced(sequence=2)],
    ],
    ids=["it was elsewhere", "another life", "never heard on its pad"],
)
def test_whoever_may_have_flown_flies_although_it_is_near_its_pad(said):
    places = Whereabouts()
    for announcement in said:
        places.announce(announcement)
    assert not places.on_pad
    places.announce(announced(9.0, "0000000c"))
    assert places.on_pad == {2}


@pytest.mark.parametrize(
    "unusable",
    [
        report(1.0, at(MIDDLE), sigma=5.0),
        report(1.0, at(MIDDLE), t_sigma=2.0),
        report(1.0, at(MIDDLE), boot="0000000b"),
        report(-1.0, at(MIDDLE)),
    ],
    ids=["vague place", "vague time", "another life", "older"],
)
def test_a_report_that_is_no_place_changes_nothing(unusable):
    places = Whereabouts()
    places.report(report(0.5, at(MIDDLE)))
    places.announce(announced())
    places.report(unusable)
    assert places.latest(2).position == pytest.approx(at(LEFT))


def test_who_came_back_elsewhere_is_named_where_it_reports_itself_without_being_asked(observer):
    observer.sees(1.0, a=LEFT, b=RIGHT)
    observer.sees(5.0, b=RIGHT)
    observer.is_told(2, MIDDLE)
    observer.wanted.clear()
    assert observer.sees(3 * SCAN_S, b=RIGHT, c=MIDDLE) == {"b": 3, "c": 2}
    assert observer.wanted == []


# --- asked ---


def test_who_is_about_to_come_into_view_is_asked_before_anything_is_seen_of_it():
    """Drone 2 said that it is 30 degrees outside the image to the right; then the observer turns there."""
    observer = Observer()
    observer.hears(2, (1400.0, 240.0))
    observer.sees(5.0)
    assert observer.wanted == []
    observer.turn(40.0)
    observer.sees(SCAN_S)
    assert [drone for _, drone in observer.wanted] == [2]
    observer.sees(2.0)
    assert len(observer.wanted) == 1


def test_who_reports_itself_need_not_be_asked_when_it_comes_into_view():
    observer = Observer()
    observer.hears(2, (1400.0, 240.0))
    observer.sees(5.0)
    observer.is_told(2, (1400.0, 240.0))
    observer.turn(40.0)
    observer.sees(SCAN_S)
    assert observer.wanted == []


def test_a_nameless_ghost_asks_nobody_while_all_who_are_in_view_are_settled(observer):
    observer.sees(10.0, a=LEFT, b=RIGHT)
    observer.sees(10.0, a=LEFT, b=RIGHT, c=(320.0, 40.0))
    assert observer.wanted == []


@pytest.mark.parametrize(
    ("u", "p", "missed"), [(600.0, 0.1, True), (800.0, 0.1, True), (1200.0, 0.1, False), (600.0, 0.9, False)]
)
def test_a_teammate_is_missed_that_should_be_in_the_image_or_beside_it_and_is_no_track(u, p, missed):
    weighing = Weighing([CAMERA], 0.5)
    predicted = anywhere([2])._replace(pixel=np.array([[u, 240.0]]))
    assert weighing.misses_somebody(predicted, np.array([[p]])) == missed
