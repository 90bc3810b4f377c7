"""Drone 1 and its tracks by one posterior: names, strangers, and what is wrong with whom."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support.observer import LEFT, MIDDLE, RIGHT, SCAN_S, Observer, at, shifted
from swarmtrack.geometry import rotation
from swarmtrack.messages import FOREIGN, IdClash, PeerDeparted, PeerExpelled

NAMED = {"a": 2, "b": 3}
PIXELS = st.tuples(st.floats(0.0, 640.0), st.floats(0.0, 480.0))
DRONES, TRACKS = st.integers(1, 5), st.sampled_from("abcd")
STEPS = st.one_of(
    st.tuples(st.just("hears"), DRONES, PIXELS, st.sampled_from(["0000000a", "0000000b"])),
    st.tuples(st.just("is told"), DRONES, PIXELS),
    st.tuples(st.just("goes"), TRACKS, PIXELS),
    st.tuples(st.just("ends"), TRACKS),
    st.tuples(st.just("sees"), st.sampled_from([0.1, 0.5, 2.0])),
    st.tuples(st.just("steps"), st.floats(-3.0, 3.0)),
    st.tuples(st.just("turns")),
    st.tuples(st.just("clashes"), st.integers(2, 5)),
    st.tuples(st.just("is alone"), st.integers(2, 5)),
    st.tuples(st.just("is expelled"), st.integers(2, 5)),
)


def test_drones_are_named_where_they_said_they_are(observer):
    assert observer.sees(SCAN_S, a=LEFT, b=RIGHT) == {"a": 2, "b": 3}


def test_what_place_alone_says_is_no_certainty(observer):
    observer.sees(3.0, a=LEFT, b=RIGHT)
    stated = observer.identities.label(observer.tracks)
    # Two may stand on each other's pads, and nobody has moved.
    assert all(0.95 < entry.identity_probability < 0.995 for entry in stated)


def test_a_track_where_nobody_should_be_is_a_stranger_after_a_while():
    observer = Observer()
    observer.hears(2, LEFT)
    assert observer.sees(0.5, a=LEFT, b=shifted(RIGHT, down=-150)) == {"a": 2, "b": None}
    assert observer.sees(3.5, a=LEFT, b=shifted(RIGHT, down=-150)) == {"a": 2, "b": FOREIGN}


def test_before_anybody_has_announced_itself_nobody_is_anything():
    assert Observer().sees(5.0, a=LEFT, b=RIGHT) == {"a": None, "b": None}


def test_a_teammate_that_is_not_confirmed_yet_is_vouched_for(observer):
    observer.sees(3.0, a=LEFT, b=RIGHT, tentative="b")
    assert observer.news.vouched == (2,)
    assert observer.names() == {"a": 2, "b": None}
    assert observer.sees(SCAN_S, a=LEFT, b=RIGHT) == {"a": 2, "b": 3}


def test_while_two_processes_speak_as_one_drone_no_track_is_it(observer):
    observer.sees(1.0, a=LEFT, b=RIGHT)
    observer.identities.on_membership(IdClash(2, ("0000000a", "0000000b"), ours=False))
    assert observer.names() == {"a": None, "b": 3}
    assert observer.sees(5.0, a=LEFT, b=RIGHT) == {"a": None, "b": 3}
    observer.identities.on_membership(PeerDeparted(2, "0000000a"))
    assert observer.sees(1.0, a=LEFT, b=RIGHT) == {"a": None, "b": 3}  # its pose is not known yet
    assert observer.hears(2, LEFT, boot="0000000b")
    assert observer.sees(1.0, a=LEFT, b=RIGHT) == {"a": 2, "b": 3}


def test_an_expelled_drone_has_no_track(observer):
    observer.sees(1.0, a=LEFT, b=RIGHT)
    observer.identities.on_membership(PeerExpelled(3))
    assert observer.sees(1.0, a=LEFT, b=RIGHT)["b"] is None


def test_a_drone_that_starts_again_elsewhere_is_named_there(observer):
    observer.sees(1.0, a=LEFT, b=RIGHT)
    assert observer.hears(2, MIDDLE, boot="0000000b")
    assert observer.sees(1.0, a=MIDDLE, b=RIGHT)["a"] == 2


def test_of_a_nameless_track_the_likeliest_are_asked_for_their_pose():
    observer = Observer()
    observer.hears(2, LEFT)
    observer.hears(3, LEFT)
    observer.sees(4.0, a=LEFT)
    assert {drone for _, drone in observer.wanted} == {2, 3}


def test_what_another_process_of_a_drone_reports_is_not_of_its_frame(observer):
    for _ in range(6):
        observer.is_told(2, RIGHT, boot="0000000c")
        observer.is_told(3, RIGHT)
        names = observer.sees(1.0, a=LEFT, b=RIGHT)
    assert names == {"a": 2, "b": 3}


def test_names_are_found_again_after_the_place_was_lost(observer):
    observer.sees(3.0, a=LEFT, b=RIGHT)
    observer.identities.lose_place()
    assert observer.sees(2.0, a=LEFT, b=RIGHT) == {"a": 2, "b": 3}


def test_a_stranger_that_is_asked_for_while_the_place_is_lost_is_unknown():
    observer = Observer()
    observer.hears(2, LEFT)
    assert observer.sees(4.0, a=LEFT, b=shifted(RIGHT, down=-150))["b"] == FOREIGN
    observer.identities.lose_place()
    assert observer.names()["b"] is None


def test_nobody_s_start_is_no_reason_to_doubt_the_own():
    observer = Observer()
    for drone in (2, 3, 4):
        observer.hears_at(drone, np.zeros(3), sigma=1e4)
    observer.sees(3.0, a=LEFT, b=RIGHT)
    assert not observer.identities.self_doubt


def flown_aside(observer, *, off=0.0, seconds=12.0):
    """Drones 2 and 3 say how they move, and fly to and fro; 2 is `off` m east of where it says that it started."""
    places = {2: at(LEFT), 3: at(RIGHT)}
    news = []
    for k in range(round(seconds / SCAN_S)):
        t = SCAN_S * k
        moved = {2: [0.0, math.sin(0.9 * t), 0.3 * math.sin(t)], 3: [0.0, math.sin(0.5 * t), 0.0]}
        for drone, way in moved.items():
            observer.says_it_moved(drone, np.array(way))
        seen = {drone: places[drone] + way for drone, way in moved.items()}
        seen[2] = seen[2] + [0.0, off, 0.0]
        observer.sees(SCAN_S, a=observer.pixel_of(seen[2], 0.0), b=observer.pixel_of(seen[3], 0.0))
        news += observer.news.astray
    return news


def test_what_motion_alone_says_confirms_a_name(observer):
    observer.sees(2.0, a=LEFT, b=RIGHT)
    assert [entry.proof for entry in observer.identities.label(observer.tracks)] == [None, None]
    assert flown_aside(observer) == []
    proofs = [entry.proof for entry in observer.identities.label(observer.tracks)]
    assert all(proof is not None and 2.0 < proof.since < 10.0 for proof in proofs)


def test_a_drone_that_is_elsewhere_than_it_says_keeps_its_name_and_that_is_said_once(observer):
    found = flown_aside(observer, off=1.5)
    assert observer.names() == {"a": 2, "b": 3}
    assert [(one.drone_id, one.track_id) for one in found] == [(2, 1)]
    assert found[0].miss_m == pytest.approx(1.5, abs=0.5)


@pytest.mark.parametrize("far", [1.9e3, 1e5, 1e9, 1e150])
def test_a_teammate_that_says_it_is_far_away_takes_no_name_from_the_others(observer, far):
    for _ in range(6):
        observer.is_told_at(2, np.array([far, -far, far]))
        observer.is_told(3, RIGHT)
        names = observer.sees(1.0, a=LEFT, b=RIGHT)
    assert names["b"] == 3
    assert 0.9 < observer.identities.label(observer.tracks)[1].identity_probability <= 1.0


@given(st.lists(STEPS, max_size=30))
@settings(max_examples=40, deadline=None)
def test_whatever_happens_no_id_is_held_twice(steps):
    observer = Observer()
    tracks = {}
    for what, *values in steps:
        match what, values:
            case "hears", [drone, pixel, boot]:
                observer.hears(drone, pixel, sequence=len(observer.tracks) + 1, boot=boot)
            case "is told", [drone, pixel]:
                observer.is_told(drone, pixel)
            case "goes", [name, pixel]:
                tracks[name] = pixel
            case "ends", [name]:
                tracks.pop(name, None)
            case "sees", [seconds]:
                observer.sees(seconds, **tracks)
            case "steps", [angle]:
                observer.identities.step_heading(observer.t, angle)
            case "turns", []:
                observer.identities.turn_unmeasured()
            case "clashes", [drone]:
                observer.identities.on_membership(IdClash(drone, ("0000000a", "0000000b"), ours=False))
            case "is alone", [drone]:
                observer.identities.on_membership(PeerDeparted(drone, "0000000b"))
            case "is expelled", [drone]:
                observer.identities.on_membership(PeerExpelled(drone))
        held = [name for name in observer.names().values() if isinstance(name, int)]
        assert len(held) == len(set(held))
        assert set(held) <= observer.identities.teammates.announced.keys()
        for entry in observer.identities.label(observer.tracks):
            assert 0.0 <= entry.identity_probability <= 1.0


def test_names_outlast_a_heading_that_steps(observer):
    observer.sees(4.0, a=LEFT, b=RIGHT)
    step = math.radians(25.0)
    observer.attitude = rotation.from_euler(0.0, 0.0, step) @ observer.attitude
    observer.identities.step_heading(observer.t, step)
    assert observer.sees(2.0, a=LEFT, b=RIGHT) == {"a": 2, "b": 3}
    # The autopilot's heading is off since then, and that is said.
    observer.sees(4.0, a=LEFT, b=RIGHT)
    assert observer.identities.self_doubt


def test_a_teammate_is_where_it_was_in_the_very_scan_after_a_heading_stepped(observer):
    observer.sees(4.0, a=LEFT, b=RIGHT)
    step = math.radians(25.0)
    observer.attitude = rotation.from_euler(0.0, 0.0, step) @ observer.attitude
    observer.identities.step_heading(observer.t, step)
    observer.sees(SCAN_S, a=LEFT, b=RIGHT)
    assert observer.identities.frame(2).turn == pytest.approx(step, abs=math.radians(6.0))


def test_a_drone_that_has_said_nothing_for_long_keeps_its_track(observer):
    for _ in range(8):
        observer.is_told(3, RIGHT)
        observer.sees(1.0, a=LEFT, b=RIGHT)
    assert observer.names() == {"a": 2, "b": 3}


def test_tracks_are_other_things_after_a_turn_that_nobody_measured(observer):
    observer.sees(1.0, a=LEFT, b=RIGHT)
    observer.identities.turn_unmeasured()
    assert observer.sees(SCAN_S, a=RIGHT, b=LEFT) == {"a": 3, "b": 2}


def test_a_compass_that_is_off_is_found_by_how_the_others_move():
    observer = Observer()
    off = math.radians(40.0)
    places = {2: np.array([8.0, -3.0, 0.0]), 3: np.array([9.0, 3.0, -1.0])}
    observer.attitude = rotation.from_euler(0.0, 0.0, off)
    for drone, place in places.items():
        observer.hears_at(drone, place)
    for k in range(120):
        t = SCAN_S * k
        moved = {
            2: places[2] + [0.0, 1.5 * math.sin(0.9 * t), 0.8 * math.sin(0.5 * t)],
            3: places[3] + [1.5 * math.sin(0.7 * t), 0.0, 0.8 * math.cos(0.5 * t) - 0.8],
        }
        for drone, place in moved.items() if k % 5 == 0 else ():
            observer.is_told_at(drone, place)
        pixels = {name: observer.pixel_of(moved[drone], heading=0.0) for name, drone in NAMED.items()}
        observer.sees(SCAN_S, **pixels)
    assert observer.names() == {"a": 2, "b": 3}
    assert observer.identities.self_doubt
    assert observer.identities.fault.heading == pytest.approx(-off, abs=0.1)
