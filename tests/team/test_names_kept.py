"""Names that tracks have got: how they are kept, asked for, withheld and reported; tracks are put by hand."""

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from support.observer import FORWARD, LEFT, MIDDLE, RIGHT, RIGHTWARD, SCAN_S, Observer, shifted
from swarmtrack.messages import FOREIGN, IdClash, PeerArrived, PeerDeparted, PeerExpelled

# --- given ---


def test_its_own_announcement_and_one_heard_before_change_nothing(observer):
    assert not observer.hears(1, MIDDLE)
    assert not observer.hears(2, RIGHT, sequence=1)
    assert observer.hears(2, LEFT, sequence=2)
    assert sorted(observer.identities.teammates.announced) == [2, 3]


# --- kept ---


def test_an_id_stays_with_its_track_wherever_it_flies(observer):
    for step in range(30):
        names = observer.sees(SCAN_S, a=shifted(LEFT, right=10.0 * step), b=RIGHT)
    assert names == {"a": 2, "b": 3}


def test_a_name_is_as_sure_as_its_track_and_withheld_once_that_has_likelier_lost_the_drone(observer):
    observer.sees(1.0, a=LEFT, b=RIGHT)
    track, *_ = observer.tracks
    stated = [
        (entry.identity, entry.identity_probability)
        for existence in (1.0, 0.8, 0.4)
        for entry in observer.identities.label([track._replace(probability=existence)])
    ]
    sure = stated[0][1]
    assert sure > 0.95
    assert stated == [(2, sure), (2, pytest.approx(0.8 * sure)), (None, 0.0)]


def test_an_id_is_kept_through_occlusion_and_while_a_track_is_carried_on(observer):
    observer.sees(1.0, a=LEFT, b=RIGHT)
    for step in range(10):
        hidden = observer.sees(SCAN_S, coasting="a", a=shifted(LEFT, right=10.0 * step), b=RIGHT)
        assert hidden == {"a": 2, "b": 3}
    assert observer.sees(1.0, a=shifted(LEFT, right=105.0), b=RIGHT) == {"a": 2, "b": 3}


def test_a_drone_that_was_lost_is_found_where_it_was_last_seen_not_where_it_announced_itself(observer):
    observer.sees(1.0, a=LEFT, b=RIGHT)
    for step in range(15):
        observer.sees(SCAN_S, a=shifted(LEFT, right=4.0 * step, down=-8.0 * step), b=RIGHT)
    last = shifted(LEFT, right=56.0, down=-112.0)
    observer.sees(0.5, b=RIGHT)  # its track ended
    assert observer.sees(1.0, c=shifted(last, right=3.0), b=RIGHT) == {"c": 2, "b": 3}


def test_two_that_are_lost_together_are_found_each_where_it_was(observer):
    observer.sees(1.0, a=LEFT, b=RIGHT)
    left, right = shifted(LEFT, right=60.0, down=40.0), shifted(RIGHT, right=-60.0, down=-40.0)
    for step in range(1, 11):
        observer.sees(
            SCAN_S, a=shifted(LEFT, 6.0 * step, 4.0 * step), b=shifted(RIGHT, -6.0 * step, -4.0 * step)
        )
    observer.sees(0.3)
    assert observer.sees(1.0, c=right, d=left) == {"c": 3, "d": 2}


def test_who_departs_keeps_its_id_for_the_drone_still_flies(observer):
    observer.sees(1.0, a=LEFT, b=RIGHT)
    observer.identities.on_membership(PeerDeparted(2, "0000000a"))
    assert observer.sees(1.0, a=LEFT, b=RIGHT) == {"a": 2, "b": 3}


# --- tried again ---


def test_an_announcement_from_where_it_is_seen_confirms_an_id(observer):
    observer.sees(1.0, a=LEFT, b=RIGHT)
    for step in range(15):
        observer.sees(SCAN_S, a=shifted(LEFT, right=5.0 * step), b=RIGHT)
    here = shifted(LEFT, right=70.0)
    observer.hears(2, here, sequence=2)
    for _ in range(10):
        assert observer.sees(SCAN_S, a=here, b=RIGHT) == {"a": 2, "b": 3}


def test_an_announcement_from_elsewhere_withdraws_it_and_names_who_is_there(observer):
    observer.sees(1.0, a=LEFT, b=RIGHT)
    observer.hears(2, MIDDLE, sequence=2)
    names = observer.sees(1.5, a=LEFT, b=RIGHT, c=MIDDLE)
    assert (names["a"], names["c"]) == (None, 2)


def test_a_new_boot_elsewhere_withdraws_an_id(observer):
    observer.sees(1.0, a=LEFT, b=RIGHT)
    observer.hears(2, (320.0, 20.0), boot="0000000b")
    assert observer.sees(1.0, a=LEFT, b=RIGHT) == {"a": None, "b": 3}


# --- withheld while two speak as one ---


def test_while_two_processes_speak_as_one_drone_nobody_is_it(observer):
    observer.sees(1.0, a=LEFT, b=RIGHT)
    observer.identities.on_membership(IdClash(2, ("0000000a", "0000000b"), ours=False))
    assert not observer.hears(2, LEFT, sequence=5)
    assert observer.sees(5.0, a=LEFT, b=RIGHT) == {"a": None, "b": 3}  # and no stranger: it may be drone 2
    observer.identities.on_membership(PeerDeparted(2, "0000000a"))
    assert observer.sees(1.0, a=LEFT, b=RIGHT) == {"a": None, "b": 3}  # its pose is not known yet
    assert observer.hears(2, LEFT, sequence=1, boot="0000000b")
    assert observer.sees(1.0, a=LEFT, b=RIGHT) == {"a": 2, "b": 3}


def test_a_clash_lasts_until_one_process_alone_speaks_as_the_drone(observer):
    observer.sees(1.0, a=LEFT, b=RIGHT)
    observer.identities.on_membership(IdClash(2, ("0000000a", "0000000b", "0000000c"), ours=False))
    for boot in ("0000000c", "0000000d"):
        observer.identities.on_membership(PeerDeparted(2, boot))
        assert not observer.hears(2, LEFT, sequence=5)
        assert observer.sees(1.0, a=LEFT, b=RIGHT) == {"a": None, "b": 3}
    observer.identities.on_membership(PeerDeparted(2, "0000000a"))
    assert observer.hears(2, LEFT, sequence=5, boot="0000000b")
    assert observer.sees(1.0, a=LEFT, b=RIGHT) == {"a": 2, "b": 3}


def test_a_clash_over_this_drone_s_own_id_takes_no_teammate_s_name(observer):
    observer.sees(1.0, a=LEFT, b=RIGHT)
    observer.identities.on_membership(IdClash(1, ("0000000a", "0000000b"), ours=True))
    assert observer.sees(1.0, a=LEFT, b=RIGHT) == {"a": 2, "b": 3}


# --- strangers ---


def test_a_track_that_no_drone_explains_is_foreign_after_the_stated_time_and_no_sooner(observer):
    away = (320.0, 40.0)
    assert observer.sees(2.9, a=LEFT, b=RIGHT, c=away) == {"a": 2, "b": 3, "c": None}
    assert observer.sees(0.5, a=LEFT, b=RIGHT, c=away) == {"a": 2, "b": 3, "c": FOREIGN}


def test_nobody_is_foreign_while_a_teammate_is_alive_whose_pose_is_not_known(observer):
    away = (320.0, 40.0)
    observer.identities.on_membership(PeerArrived(4, "0000000a"))
    assert observer.sees(6.0, a=LEFT, b=RIGHT, c=away)["c"] is None
    observer.hears(4, MIDDLE)
    assert observer.sees(4.0, a=LEFT, b=RIGHT, c=away, d=MIDDLE)["c"] == FOREIGN


def test_nobody_is_foreign_who_may_be_a_teammate_that_is_not_where_it_said(observer):
    observer.sees(1.0, a=LEFT, b=RIGHT)
    observer.hears(4, MIDDLE)
    assert observer.sees(6.0, a=LEFT, b=RIGHT, c=shifted(MIDDLE, down=-120.0))["c"] is None


def test_a_foreign_track_that_a_teammate_turns_out_to_be_is_named(observer):
    assert observer.sees(4.0, a=LEFT, b=RIGHT, c=MIDDLE)["c"] == FOREIGN
    observer.hears(4, MIDDLE)
    assert observer.sees(1.0, a=LEFT, b=RIGHT, c=MIDDLE)["c"] == 4


@pytest.fixture
def beside_a_stranger(observer):
    """Drone 4 has said for four seconds that it is outside the image, and then where track c was all the time."""
    observer.hears(4, OUTSIDE)
    _is_told_and_sees(observer, 4.0, OUTSIDE)
    return observer


OUTSIDE, THERE = (900.0, 240.0), (320.0, 40.0)


def _is_told_and_sees(observer, seconds, place, **tracks):
    tracks = tracks or {"c": THERE}
    for _ in range(round(seconds / 0.5)):
        observer.is_told(4, place)
        names = observer.sees(0.5, a=LEFT, b=RIGHT, **tracks)
    return names


def test_of_a_drone_that_was_wrong_itself_a_stranger_may_be_a_teammate(beside_a_stranger):
    beside_a_stranger.identities.lose_place()
    assert _is_told_and_sees(beside_a_stranger, 2.0, THERE)["c"] == 4


def test_nobody_is_foreign_before_somebody_has_announced_itself():
    alone = Observer()
    assert alone.sees(4.0, a=MIDDLE) == {"a": None}
    alone.hears(2, RIGHT)
    assert alone.sees(4.0, a=MIDDLE, b=RIGHT) == {"a": FOREIGN, "b": 2}


# --- asked ---


def test_drones_that_cannot_be_told_apart_are_asked_to_announce_themselves_more_and_more_rarely():
    observer = Observer()
    observer.hears(2, LEFT)
    observer.hears(3, shifted(LEFT, right=2.0))
    assert set(observer.sees(30.0, a=LEFT, b=shifted(LEFT, right=3.0)).values()) == {None}
    for drone in (2, 3):
        asked = [t for t, wanted in observer.wanted if wanted == drone]
        assert asked[0] < 3.0
        pauses = np.diff(asked)
        assert len(pauses) >= 2
        assert pauses == pytest.approx([3.0 * 2.0**k for k in range(len(pauses))], abs=2.0 * SCAN_S)


def test_where_all_is_clear_nobody_is_asked(observer):
    observer.sees(20.0, a=LEFT, b=RIGHT)
    assert observer.wanted == []


# --- whatever happens ---

PLACES = st.tuples(st.floats(20.0, 620.0), st.floats(20.0, 460.0))
BOOTS = ("0000000a", "0000000b", "0000000c")
STEPS = st.one_of(
    st.tuples(st.just("hears"), st.integers(1, 5), PLACES, st.booleans()),
    st.tuples(st.sampled_from(["arrives", "departs"]), st.integers(2, 5), st.sampled_from(BOOTS)),
    st.tuples(st.just("clashes"), st.integers(2, 5)),
    st.tuples(st.just("goes"), st.sampled_from("abcdef"), PLACES),
    st.tuples(st.just("ends"), st.sampled_from("abcdef")),
    st.tuples(st.just("hides"), st.sampled_from("abcdef")),
    st.tuples(st.just("sees"), st.floats(0.1, 1.5)),
)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(STEPS, max_size=40))
def test_whatever_happens_nobody_holds_an_id_twice_nor_one_that_several_speak_as(steps):
    observer, places, hidden, clashing = Observer(), {}, set(), {}
    sequence = 0
    for step in [("hears", 2, LEFT, False), ("hears", 3, RIGHT, False), *steps, ("sees", 1.0)]:
        match step:
            case ("hears", drone, place, reboots):
                sequence += 1
                observer.hears(drone, place, sequence, boot=f"{sequence if reboots else 0:08x}")
            case ("goes", name, place):
                places[name] = place
                hidden.discard(name)
            case ("ends", name):
                places.pop(name, None)
                hidden.discard(name)
            case ("hides", name):
                hidden.add(name)
            case ("sees", seconds):
                names = observer.sees(seconds, coasting=hidden & set(places), **places)
                given_ids = [name for name in names.values() if isinstance(name, int)]
                assert len(set(given_ids)) == len(given_ids)
                assert set(given_ids) <= set(observer.identities.teammates.announced) - clashing.keys() - {1}
            case ("arrives", drone, boot):
                observer.identities.on_membership(PeerArrived(drone, boot))
            case ("departs", drone, boot):
                observer.identities.on_membership(PeerDeparted(drone, boot))
                clashing.get(drone, set()).discard(boot)
                if len(clashing.get(drone, ())) == 1:
                    del clashing[drone]
            case ("clashes", drone):
                observer.identities.on_membership(IdClash(drone, BOOTS, ours=False))
                clashing[drone] = set(BOOTS)


def test_who_is_no_member_any_more_has_no_name_and_is_forgotten(observer):
    assert observer.sees(1.0, a=LEFT, b=RIGHT) == {"a": 2, "b": 3}
    observer.identities.on_membership(PeerExpelled(3))
    assert observer.sees(0.5, a=LEFT, b=RIGHT) == {"a": 2, "b": None}
    assert observer.identities.teammates.announced.keys() == {2}


# --- several cameras ---


def two_cameras():
    """Drone 2 ahead and drone 3 to the right, each named in the picture of its camera."""
    observer = Observer(cameras=(FORWARD, RIGHTWARD))
    observer.hears(2, LEFT)
    observer.hears(3, MIDDLE, camera=RIGHTWARD)
    for _ in range(20):
        observer.sees(SCAN_S, camera=0, elsewhere="b", a=LEFT, b=MIDDLE)
        observer.sees(SCAN_S, camera=1, elsewhere="a", a=LEFT, b=MIDDLE)
    assert observer.names() == {"a": 2, "b": 3}
    return observer


def test_a_drone_that_this_camera_has_just_missed_is_not_reported_as_seen():
    observer = two_cameras()
    assert sighted(observer) == [2, 3]
    # The other camera's turn will come; this one's is now.
    observer.sees(SCAN_S, camera=0, elsewhere="b", coasting="a", a=LEFT, b=MIDDLE)
    assert sighted(observer) == [3]


def test_whose_track_is_with_a_camera_that_has_not_looked_yet_is_reported():
    observer = Observer(cameras=(FORWARD, RIGHTWARD))
    observer.hears(2, LEFT)
    assert observer.sees(1.0, a=LEFT) == {"a": 2}
    observer.sees(SCAN_S, elsewhere="a", a=LEFT)
    assert sighted(observer) == [2]


def test_what_another_camera_saw_is_reported_until_that_looks_again_for_a_second_at_most():
    observer = two_cameras()
    observer.sees(0.8, camera=0, elsewhere="b", a=LEFT, b=MIDDLE)
    assert sighted(observer) == [2, 3]
    observer.sees(0.3, camera=0, elsewhere="b", a=LEFT, b=MIDDLE)
    assert sighted(observer) == [2]
    observer = two_cameras()
    observer.sees(SCAN_S, camera=1, elsewhere="a", coasting="b", a=LEFT, b=MIDDLE)
    observer.sees(SCAN_S, camera=0, elsewhere="b", coasting="b", a=LEFT, b=MIDDLE)
    assert sighted(observer) == [2]


def test_where_a_drone_is_that_another_camera_saw_is_known_the_less_the_faster_it_crosses_the_picture():
    observer = two_cameras()
    sigmas = []
    for px_s in (0.0, 60.0):
        observer.moving = px_s
        observer.sees(SCAN_S, camera=1, elsewhere="a", a=LEFT, b=MIDDLE)
        observer.sees(SCAN_S, camera=0, elsewhere="b", a=LEFT, b=MIDDLE)
        sigmas += [ray.sigma for ray, *_ in observer.identities.sightings(observer.t) if ray.drone_id == 3]
    assert math.sqrt(sigmas[1] ** 2 - sigmas[0] ** 2) == pytest.approx(60.0 / 430.0 * SCAN_S, rel=0.05)


def sighted(observer):
    return sorted(ray.drone_id for ray, *_ in observer.identities.sightings(observer.t))


def test_a_track_that_may_have_been_a_teammate_is_no_surer_when_it_comes_back():
    """Drone 2 says that it is behind the observer: either its start is wrong, or what is seen is a stranger."""
    observer = Observer()
    observer.hears_at(2, np.array([-6.0, 5.0, 0.0]))
    spot = (400.0, 250.0)
    assert observer.sees(3.0, a=spot) == {"a": None}
    observer.sees(0.5)
    assert observer.sees(1.0, b=shifted(spot, right=4.0)) == {"b": None}


def test_an_undetected_track_is_compared_with_whoever_has_just_come():
    """Drone 3 speaks twice, and its track has just left the picture when that ends: it is not drone 2 on 3's pad."""
    observer = Observer()
    observer.hears(2, LEFT)
    observer.hears(3, RIGHT)
    observer.identities.on_membership(IdClash(3, ("0000000a", "0000000c"), ours=False))
    assert observer.sees(4.0, b=RIGHT) == {"b": None}
    observer.sees(0.5, coasting=("b",), b=RIGHT)
    observer.identities.on_membership(PeerDeparted(3, "0000000c"))
    observer.hears(3, RIGHT)
    assert observer.sees(SCAN_S, coasting=("b",), b=RIGHT) == {"b": 3}


def test_a_track_may_be_a_teammate_that_has_not_said_where_it_is():
    observer = Observer()
    observer.hears(2, LEFT, sigma=4.0)
    observer.identities.on_membership(PeerArrived(3, "0000000b"))
    assert observer.sees(1.0, a=LEFT) == {"a": None}
    observer.identities.on_membership(PeerDeparted(3, "0000000b"))
    assert observer.sees(1.0, a=LEFT) == {"a": 2}
