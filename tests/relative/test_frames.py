"""A start that was announced wrongly is reported, once, and is corrected; a right one is left alone."""

import math

import numpy as np
import pytest

from swarmtrack.geometry import rotation
from swarmtrack.geometry.frame_transform import FrameTransform
from swarmtrack.messages import Announcement, MotionReport, Sighting, SightingReport
from swarmtrack.relative.frames import Frames

START = np.array([6.0, 2.0, -1.0])
EIGHT_DEGREES = math.radians(8.0)


def transform(moved, turn, sigma=0.1):
    """The true frame of a teammate whose start is `moved` m from where it was announced, and its heading by `turn`."""
    shift = START + moved - rotation.from_euler(0.0, 0.0, turn) @ START
    return FrameTransform(turn, shift, np.diag([sigma**2] * 3 + [(sigma / 5.0) ** 2]))


def judged(found, times=5, *, boot="0000000a", every_s=1.5):
    """Frames of a team in which drone 2 announced START, and what it reports when it is found so."""
    frames = Frames(turn_sigma=math.radians(3.0))
    frames.announce(announcement("0000000a"))
    news = [frames.judge(report(every_s * k, boot), lambda _: found) for k in range(times)]
    return frames, [one for one in news if one is not None]


def announcement(boot):
    return Announcement(2, boot, 0, 0.0, 0.0, START, np.eye(3), 0.01 * np.eye(3))


def report(t, boot="0000000a", drone_id=2, seen=()):
    return SightingReport(drone_id, boot, 1, t, 0.0, START, 0.1, (), seen)


def test_a_start_that_is_1_4_m_and_8_degrees_off_is_reported_once():
    frames, (one,) = judged(transform((1.0, -1.0, 0.0), EIGHT_DEGREES))
    assert (one.drone_id, one.t) == (2, 3.0)
    assert one.off_m == pytest.approx(math.sqrt(2.0))
    assert one.turn == EIGHT_DEGREES
    assert frames.transform(2) is not None


def test_it_is_reported_again_once_it_fits():
    frames, _ = judged(transform((1.0, -1.0, 0.0), EIGHT_DEGREES))
    fits = transform((0.1, 0.0, 0.0), 0.0)
    news = [frames.judge(report(10.0 + 1.5 * k), lambda _: fits) for k in range(5)]
    (one,) = [one for one in news if one is not None]
    assert one.off_m is None
    assert frames.transform(2) is None


@pytest.mark.parametrize(
    "found",
    [
        transform((0.3, -0.2, 0.0), math.radians(1.5)),
        pytest.param(transform((3.0, 0.0, 0.0), EIGHT_DEGREES, sigma=2.0), id="and little is known"),
        pytest.param(None, id="and it is not in view"),
    ],
)
def test_a_start_that_is_as_good_as_announced_is_left_alone(found):
    frames, news = judged(found)
    assert news == []
    assert frames.transform(2) is None


def test_reports_that_follow_each_other_at_once_are_judged_once():
    assert judged(transform((3.0, 0.0, 0.0), 0.0), times=20, every_s=0.1)[1] == []


def test_reports_of_another_life_of_its_process_are_not_compared_with_the_start_of_this():
    assert judged(transform((3.0, 0.0, 0.0), 0.3), boot="0000000b")[1] == []


def test_a_new_life_begins_everything_afresh():
    frames, news = judged(transform((3.0, 0.0, 0.0), 0.3))
    assert len(news) == 1
    frames.announce(announcement("0000000c"))
    assert frames.transform(2) is None


def test_what_it_says_comes_into_our_frame_its_rays_and_velocity_too():
    turn = 0.3
    frames, _ = judged(transform((3.0, 0.0, 0.0), turn))
    turned = rotation.from_euler(0.0, 0.0, turn)
    ours, variance = frames.report_in_ours(
        report(9.0, seen=(Sighting(3, 0.99, turned.T @ [1.0, 0.0, 0.0], 0.01),))
    )
    assert variance == pytest.approx(0.1**2 + (0.02 * math.hypot(*START[:2])) ** 2)
    assert ours.position == pytest.approx((9.0, 2.0, -1.0))
    assert ours.sightings[0].direction == pytest.approx([1.0, 0.0, 0.0])
    cov = np.diag([0.01, 0.04, 0.09])
    motion = MotionReport(2, "0000000a", 1, 0.0, 0.0, START, cov, turned.T @ [0.0, 2.0, 0.1], cov)
    assert frames.motion_in_ours(motion).velocity == pytest.approx([0.0, 2.0, 0.1])
    other = report(9.0, drone_id=5)
    assert frames.report_in_ours(other) == (other, None)
