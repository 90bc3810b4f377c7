"""A start that was announced wrongly is said to be, once, and is corrected; a right one is left alone."""

import math

import numpy as np
import pytest

from swarmtrack.geometry import rotation
from swarmtrack.messages import Announcement, MotionReport, Sighting, SightingReport
from swarmtrack.relative.frames import Frames
from swarmtrack.relative.looks import TeamLook
from swarmtrack.relative.parameters import RelativeParameters

START = np.array([6.0, 2.0, -1.0])


def place_at(t):
    return START + np.array([1.5 * math.sin(0.6 * t), 1.5 * (1.0 - math.cos(0.6 * t)), 0.0])


def announcement(shift, turn, boot="0000000a"):
    said = rotation.from_euler(0.0, 0.0, turn).T @ (START - shift)
    return Announcement(2, boot, 0, 0.0, 0.0, said, np.eye(3), 0.01 * np.eye(3))


def flown(shift, turn, seconds=20.0, *, still=False, boot="0000000a", seed=1, beside=False):
    """Frames of drone 1, told of a teammate whose own frame is ours, turned and shifted; and all news. beside: another
    camera, which does not show it, exposes whenever it says where it is."""
    rng = np.random.default_rng(seed)
    shift = np.asarray(shift, float)
    frames = Frames(1, RelativeParameters(airframe_span_m=0.5))
    frames.announce(announcement(shift, turn))
    back = rotation.from_euler(0.0, 0.0, turn).T
    news = []
    for k in range(int(seconds * 10)):
        t = 0.1 * k
        place = START if still else place_at(t)
        rho = np.linalg.norm(place)
        ray = place / rho + 3e-3 * rng.normal(size=3)
        width = 0.5 / rho * np.exp(0.1 * rng.normal())
        frames.add_look(
            TeamLook(
                t, np.zeros(3), np.zeros(3), ((2, 9),), ray[None] / np.linalg.norm(ray), 1e-5 * np.eye(3)[None],
                np.array([width]), np.ones(1),
            )
        )  # fmt: skip
        if beside:
            nobody = np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0), np.empty(0)
            frames.add_look(TeamLook(t + 0.03, np.zeros(3), np.zeros(3), (), *nobody))
        if k % 5 == 0:
            said = back @ (place - shift) + 0.03 * rng.normal(size=3)
            found = frames.add_report(SightingReport(2, boot, k, t + 0.03, 0.01, said, 0.1, (1,), ()))
            news += [found] if found else []
    return frames, news


def test_a_start_that_is_1_4_m_and_8_degrees_off_is_said_to_be_once():
    turn = math.radians(8.0)
    # The start itself is moved by so much, whatever the turn does about the origin.
    moved = np.array([1.0, -1.0, 0.0])
    shift = START - rotation.from_euler(0.0, 0.0, turn) @ (START - moved)
    frames, news = flown(shift, turn, 25.0)
    (one,) = news
    assert one.drone_id == 2
    assert one.off_m == pytest.approx(math.sqrt(2.0), abs=0.4)
    assert one.turn == pytest.approx(turn, abs=math.radians(2.5))
    found = frames.transform(2)
    said = rotation.from_euler(0.0, 0.0, turn).T @ (START - shift)
    where, cov = found.place(said)
    off = where - START
    assert np.linalg.norm(off) < 0.3
    assert off @ np.linalg.solve(cov, off) < 16.0


def test_it_is_looked_for_with_the_camera_that_shows_it_whichever_exposed_last():
    alone, news = flown((3.0, 0.0, 0.0), 0.3)
    beside, same = flown((3.0, 0.0, 0.0), 0.3, beside=True)
    assert same == news != []
    np.testing.assert_array_equal(beside.transform(2).rotation, alone.transform(2).rotation)


@pytest.mark.parametrize("seed", range(3))
def test_a_start_that_is_as_good_as_announced_is_left_alone(seed):
    frames, news = flown((0.1, -0.05, 0.02), math.radians(1.5), seed=seed)
    assert news == []
    assert frames.transform(2) is None


def test_of_a_teammate_that_stays_where_it_is_nothing_is_said():
    frames, news = flown((3.0, 0.0, 0.0), 0.3, still=True)
    assert news == []
    assert frames.transform(2) is None


def test_reports_of_another_life_of_its_process_are_not_compared_with_the_start_of_this():
    _, news = flown((3.0, 0.0, 0.0), 0.3, boot="0000000b")
    assert news == []


def test_a_new_life_begins_everything_anew():
    frames, news = flown((3.0, 0.0, 0.0), 0.3)
    assert len(news) == 1
    frames.announce(announcement(np.zeros(3), 0.0, boot="0000000c"))
    assert frames.transform(2) is None


def test_what_it_says_comes_into_our_frame_its_rays_and_velocity_too():
    turn, shift = 0.3, np.array([3.0, 0.0, 0.0])
    frames, _ = flown(shift, turn)
    turned = rotation.from_euler(0.0, 0.0, turn)
    said = turned.T @ (START - shift)
    report = SightingReport(
        2, "0000000a", 1, 0.0, 0.0, said, 0.1, (), (Sighting(3, 0.99, turned.T @ [1.0, 0.0, 0.0], 0.01),)
    )
    ours = frames.report_in_ours(report)
    assert ours.position == pytest.approx(START, abs=0.3)
    assert ours.sightings[0].direction == pytest.approx([1.0, 0.0, 0.0], abs=0.05)
    cov = np.diag([0.01, 0.04, 0.09])
    motion = MotionReport(2, "0000000a", 1, 0.0, 0.0, said, cov, turned.T @ [0.0, 2.0, 0.1], cov)
    assert frames.motion_in_ours(motion).velocity == pytest.approx([0.0, 2.0, 0.1], abs=0.1)
    other = SightingReport(5, "0000000a", 1, 0.0, 0.0, said, 0.1, (), ())
    assert frames.report_in_ours(other) is other
