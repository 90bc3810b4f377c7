import math

import numpy as np
import pytest

from support.formation_states import HEIGHT, SLOTS, Flying, in_slot, leader_from, parameters, state, track
from swarmtrack.formation.formation import HOLD_TEXTS, Formation
from swarmtrack.formation.margins import (
    AT_HEIGHT_M,
    COMMAND_FADED_S,
    ESCAPE_MOST_M,
    LED_MOST_ASIDE_M,
    REFERENCE_ENTRY_S,
    REFERENCE_UNSEEN_S,
)
from swarmtrack.formation.setpoint import STANDSTILL, OwnSway, Why
from swarmtrack.messages import TrackStatus
from swarmtrack.relative.heights import HeightSight


@pytest.fixture
def flying():
    return Flying(Formation(parameters()))


def level(setpoint):
    return math.hypot(*setpoint.velocity[:2])


def test_in_its_slot_behind_a_leader_that_stands_a_drone_stands(flying):
    setpoint = flying.settled(in_slot(heading=math.atan2(-3.0, 4.0)))
    assert setpoint.why is Why.FOLLOW
    assert not setpoint.holds
    assert setpoint.velocity == pytest.approx(STANDSTILL, abs=1e-9)
    assert setpoint.yaw_rate == pytest.approx(0.0, abs=1e-9)
    assert setpoint.error == pytest.approx(0.0, abs=1e-9)


def test_off_its_slot_a_drone_flies_there(flying):
    setpoint = flying.settled(in_slot(off=(-1.0, 0.5, 0.0)))
    assert setpoint.velocity == pytest.approx((0.6, -0.3, 0.0))
    assert setpoint.error == pytest.approx(math.hypot(1.0, 0.5))


def test_a_slot_far_off_is_flown_to_no_faster_than_the_approach(flying):
    assert level(flying.settled(in_slot(off=(-20.0, 0.0, 0.0)))) == pytest.approx(1.5)


def test_a_leader_that_flies_is_flown_along_with(flying):
    setpoint = flying.settled(in_slot(velocity=(0.3, 0.0, 0.0)), velocity=(1.2, 0.4, 0.0))
    assert setpoint.velocity == pytest.approx((1.2, 0.4, 0.0))


def test_the_height_is_the_slots_by_the_own_autopilot(flying):
    flying.settled(in_slot())
    own = in_slot(off=(0.0, 0.0, 0.5))
    # By the camera the leader is where it should be, and the height is not: that counts nothing.
    seen = {10: state(np.subtract((0.0, 0.0, -HEIGHT), in_slot().position))}
    assert flying.tell(own, seen, [track()], seconds=1.0).velocity == pytest.approx((0.0, 0.0, -0.4))


def test_a_drone_first_climbs_to_its_height_and_then_flies_level(flying):
    own = in_slot(off=(-3.0, 0.0, 1.0))
    setpoint = flying.tell(own, {10: leader_from(own)}, [track()], seconds=3.0)
    assert setpoint.why is Why.HEIGHT
    assert setpoint.velocity == pytest.approx((0.0, 0.0, -0.8))
    own = in_slot(off=(-3.0, 0.0, 0.2))
    assert flying.tell(own, {10: leader_from(own)}, [track()], seconds=1.0).why is Why.FOLLOW
    # A moment off its height later does not stop it.
    own = in_slot(off=(-3.0, 0.0, 0.6))
    assert level(flying.tell(own, {10: leader_from(own)}, [track()])) > 1.0


def test_two_references_count_by_how_well_each_is_known():
    flying = Flying(Formation(parameters(references=(1, 3))))
    own = in_slot()
    one = state(np.subtract((1.0, 0.0, -HEIGHT), own.position), sigma=0.05)
    other = state(np.subtract((-4.0 - 1.0, -3.0, 1.0 - HEIGHT), own.position), drone_id=3, sigma=0.5)
    setpoint = flying.tell(own, {10: one, 11: other}, [track(), track(3, 11)], seconds=3.0)
    weights = 1.0 / (0.05**2 + 0.05**2), 1.0 / (0.5**2 + 0.05**2)
    assert setpoint.velocity[0] == pytest.approx(0.6 * (weights[0] - weights[1]) / sum(weights), abs=1e-6)


def test_a_command_begins_at_rest_and_changes_by_no_more_than_its_acceleration():
    flying = Flying(Formation(parameters(limits={"acceleration": 1.0})))
    own = in_slot()
    first = flying.tell(own)
    assert first.velocity == STANDSTILL
    assert first.yaw_rate == 0.0
    before = first.velocity
    for _ in range(40):
        # As its autopilot flies it.
        own = in_slot(velocity=before)
        velocity = flying.tell(own, {10: leader_from(own, velocity=(2.4, 0.0, 0.0))}, [track()]).velocity
        assert math.dist(velocity, before) <= 0.1 + 1e-9
        before = velocity
    assert before[0] == pytest.approx(2.4)


# ── references come and go ───────────────────────────────────────────────────────────────────────────────────────────


def test_a_reference_is_flown_by_once_it_was_sure_for_a_second(flying):
    own = in_slot(off=(-1.0, 0.0, 0.0))
    seen = {10: leader_from(own)}
    assert flying.tell(own, seen, [track()], seconds=REFERENCE_ENTRY_S).why is Why.ENTRY
    flying.tell(own, seen, [track(probability=0.95)])
    assert flying.tell(own, seen, [track()], seconds=REFERENCE_ENTRY_S).why is Why.ENTRY
    assert flying.tell(own, seen, [track()]).why is Why.FOLLOW


def test_a_missed_detection_costs_a_name_nothing_of_its_second_and_ends_it_for_nobody(flying):
    own = in_slot(off=(-1.0, 0.0, 0.0))
    seen = {10: leader_from(own)}
    flying.tell(own, seen, [track()], seconds=0.5)
    missed = [track(probability=0.9, coasting_since=flying.t)]
    assert flying.tell(own, seen, missed, seconds=REFERENCE_ENTRY_S).why is Why.ENTRY
    assert flying.tell(own, seen, [track()]).why is Why.FOLLOW


def test_a_name_that_is_not_sure_is_made_no_surer_by_a_missed_detection(flying):
    own = in_slot(off=(-1.0, 0.0, 0.0))
    seen, place_only = {10: leader_from(own)}, {"probability": 0.96}
    for _ in range(20):
        flying.tell(own, seen, [track(**place_only)])
        assert flying.tell(own, seen, [track(**place_only, coasting_since=flying.t)]).why is Why.ENTRY


@pytest.mark.parametrize(
    "tracks",
    [
        [],
        [track(identity=None)],
        [track(identity=3)],
        [track(identity="foreign")],
        [track(probability=0.8)],
        [track(status=TrackStatus.TENTATIVE)],
        [track(), track(track_id=11)],
    ],
    ids=["gone", "unknown", "another", "foreign", "doubted", "tentative", "two of them"],
)
def test_a_name_that_does_not_hold_ends_it_at_once_softly_and_it_comes_back_after_a_second(flying, tracks):
    own = in_slot(velocity=(1.0, 0.0, 0.0))
    seen = {n: leader_from(own, velocity=(1.0, 0.0, 0.0)) for n in (10, 11)}
    setpoint = flying.tell(own, seen, [track()], seconds=3.0)
    speeds = []
    for _ in range(round(10 * COMMAND_FADED_S) + 1):
        own = in_slot(velocity=setpoint.velocity)
        seen = {n: leader_from(own, velocity=(1.0, 0.0, 0.0)) for n in (10, 11)}
        setpoint = flying.tell(own, seen, tracks)
        speeds.append(level(setpoint))
    assert speeds == sorted(speeds, reverse=True)
    assert speeds[0] > 0.7
    assert speeds[-1] == 0.0
    assert setpoint.holds
    flying.tell(own, seen, [track()], seconds=REFERENCE_ENTRY_S)
    assert flying.tell(own, seen, [track()], seconds=0.2).why is Why.FOLLOW


def test_a_known_track_needs_no_second_proof_and_a_new_engagement_asks_for_one(flying):
    own = in_slot()
    flying.settled(own)
    seen, place_only = {10: leader_from(own)}, [track(probability=0.96)]
    flying.tell(own, seen, [track(identity=None)], seconds=2.0)
    assert flying.tell(own, seen, place_only, seconds=1.2).why is Why.FOLLOW
    flying.formation.engage()
    assert flying.tell(own, seen, place_only, seconds=3.0).why is Why.ENTRY


def test_a_name_that_goes_to_another_track_is_flown_by_after_a_second(flying):
    own = in_slot()
    flying.settled(own)
    seen = {11: leader_from(own)}
    said = [flying.tell(own, seen, [track(track_id=11)]).why for _ in range(12)]
    assert said == [*[Why.FADE] * 10, *[Why.FOLLOW] * 2]


def test_a_lost_reference_is_said_while_it_fades_and_while_it_holds(flying):
    own = in_slot()
    flying.settled(own, velocity=(1.0, 0.0, 0.0))
    assert flying.tell(own).why is Why.FADE
    last = flying.tell(own, seconds=3.0)
    assert last.why is Why.NO_REFERENCE
    assert last.text == "drone 1 is not in view"


def test_a_reference_that_is_missed_for_a_moment_is_flown_by_on(flying):
    own = in_slot()
    flying.settled(own)
    seen, since = {10: leader_from(own)}, flying.t
    while flying.t < since + REFERENCE_UNSEEN_S - 0.05:
        # Its probability falls with the track's own.
        assert flying.tell(own, seen, [track(probability=0.5, coasting_since=since)]).why is Why.FOLLOW
    assert flying.tell(own, seen, [track(probability=0.5, coasting_since=since)], seconds=0.2).why is Why.FADE


def test_a_reference_whose_range_is_not_known_is_none(flying):
    own = in_slot()
    assert flying.settled(own, range_sigma_log=0.6).why is Why.NO_REFERENCE


def test_a_name_that_leaps_to_another_place_is_not_flown_after(flying):
    """Names of two drones were swapped."""
    own = in_slot()
    flying.settled(own)
    leapt = {10: leader_from(own, at=(4.0, 4.0, -HEIGHT))}
    assert flying.tell(own, leapt, [track()]).why is not Why.FOLLOW


# ── holds ────────────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("facts", "why"),
    [
        ({"pose_age": 0.21}, Why.OWN_POSE),
        ({"position_sigma": 5.1}, Why.VAGUE),
        ({"height_sigma": 1.1}, Why.HEIGHT_VAGUE),
        ({"height_sigma": math.nan}, Why.HEIGHT_VAGUE),
        ({"pose_age": math.nan}, Why.OWN_POSE),
        ({"gyro_age": 0.4}, Why.GYRO),
        ({"scan_ages": (1.1,)}, Why.CAMERA),
        ({"clash": True}, Why.CLASH),
        ({"doubted": True}, Why.DOUBT),
        ({"heading_step_age": 0.5}, Why.HEADING),
        ({"clock_known": False}, Why.CLOCK),
    ],
)
def test_what_a_drone_cannot_fly_by_makes_it_stop_and_say_so(flying, facts, why):
    own, moving = in_slot(), {"velocity": (1.0, 0.0, 0.0)}
    flying.settled(own, **moving)
    held = in_slot(**facts)
    setpoint = flying.tell(held, {10: leader_from(held, **moving)}, [track()], seconds=1.0)
    assert setpoint.why is why
    assert setpoint.velocity == STANDSTILL
    assert setpoint.holds
    assert setpoint.text == HOLD_TEXTS[why]
    # And it goes on only after the reference was sure for a second again.
    assert (
        flying.tell(own, {10: leader_from(own, **moving)}, [track()], seconds=REFERENCE_ENTRY_S).why
        is Why.ENTRY
    )
    assert flying.tell(own, {10: leader_from(own, **moving)}, [track()], seconds=0.2).why is Why.FOLLOW


def test_who_braked_for_a_late_pose_does_not_speed_up_again_while_it_fades():
    flying = Flying(Formation(parameters(limits={"acceleration": 5.0})))
    flying.settled(in_slot())
    own = in_slot(velocity=(2.0, 0.0, 0.0))
    flying.tell(own, {10: leader_from(own, velocity=(2.0, 0.0, 0.0))}, [track()], seconds=0.6)
    slowed = flying.tell(in_slot(pose_age=0.3), seconds=0.3)
    assert 0.0 < level(slowed) < 0.6
    faded = flying.tell(in_slot())
    assert faded.why is Why.FADE
    assert level(faded) <= level(slowed)


@pytest.mark.parametrize("facts", [{"pose_age": 0.3}, {"gyro_age": 0.4}, {"scan_ages": (1.1,)}])
def test_what_comes_late_for_a_moment_stops_it_and_costs_its_reference_no_trust(flying, facts):
    own, moving = in_slot(), {"velocity": (1.0, 0.0, 0.0)}
    flying.settled(own, **moving)
    late = in_slot(**facts)
    slowed = flying.tell(late, {10: leader_from(late, **moving)}, [track()], seconds=0.4)
    assert slowed.holds
    assert level(slowed) < 0.6
    assert flying.tell(own, {10: leader_from(own, **moving)}, [track()]).why is Why.FOLLOW


def test_of_several_cameras_that_counts_which_saw_the_reference_last(flying):
    alive = in_slot(scan_ages=(0.0, 0.0))
    flying.tell(alive, {10: leader_from(alive)}, [track(camera=1)], seconds=3.0)
    other_died = in_slot(scan_ages=(1.1, 0.0))
    assert flying.tell(other_died, {10: leader_from(alive)}, [track(camera=1)]).why is Why.FOLLOW
    # That one is stuck, and then shows nobody any more: the first one lives, and tells nothing of the leader.
    its_died = in_slot(scan_ages=(0.0, 1.1))
    assert flying.tell(its_died, {10: leader_from(alive)}, [track(camera=1)]).why is Why.CAMERA
    assert flying.tell(its_died, seconds=5.0).why is Why.CAMERA
    # Until it comes into that one's picture.
    assert flying.tell(its_died, {10: leader_from(alive)}, [track()]).why is Why.ENTRY
    assert flying.tell(its_died, {10: leader_from(alive)}, [track()], seconds=1.2).why is Why.FOLLOW


def test_of_two_references_that_is_flown_by_whose_camera_lives():
    flying = Flying(Formation(parameters(drone_id=3, references=(1, 2))))
    own = in_slot(drone_id=3, scan_ages=(0.0, 0.0))
    north, east, down = SLOTS[2]
    states = {10: leader_from(own), 11: leader_from(own, at=(north, east, down - HEIGHT), drone_id=2)}
    tracks = [track(), track(2, 11, camera=1)]
    assert flying.tell(own, states, tracks, seconds=3.0).error == pytest.approx(0.0, abs=1e-6)
    stuck = in_slot(drone_id=3, scan_ages=(0.0, 1.1))
    leads_astray = states | {11: leader_from(own, at=(north + 1.5, east, down - HEIGHT), drone_id=2)}
    told = flying.tell(stuck, leads_astray, tracks)
    assert told.why is Why.FOLLOW
    assert told.error == pytest.approx(0.0, abs=1e-6)


def test_a_drone_that_holds_still_keeps_clear(flying):
    own = in_slot(clash=True)
    near = state((1.2, 0.0, 0.0), drone_id=0)
    setpoint = flying.tell(own, {12: near}, [track(None, 12)], seconds=1.0)
    assert setpoint.why is Why.CLASH
    assert setpoint.velocity[0] < -0.1
    assert setpoint.clear_of == (12,)


# ── the nose ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_the_nose_turns_to_the_reference_and_to_where_it_was_last(flying):
    own = in_slot(off=(0.0, -3.0, 0.0), heading=-0.5)
    # It is seen in the north-east of where its slot would have it.
    seen = {10: leader_from(own)}
    flying.tell(own, seen, [track()], seconds=1.0)
    assert flying.tell(own, seen, [track()]).yaw_rate == pytest.approx(1.5 * 0.5)
    assert flying.tell(own, seconds=1.0).yaw_rate == pytest.approx(1.5 * 0.5)
    toward_slot = 1.5 * (math.atan2(-3.0, 4.0) + 0.5)
    assert flying.tell(own, seconds=4.0).yaw_rate == pytest.approx(toward_slot)


def test_the_nose_turns_the_short_way_and_no_faster_than_allowed():
    flying = Flying(Formation(parameters(limits={"yaw_rate": 0.4})))
    own = in_slot(heading=3.0)
    assert flying.settled(own).yaw_rate == pytest.approx(0.4)


# ── fence ────────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_after_a_leader_that_flies_off_a_drone_stays_within_its_fence():
    flying = Flying(Formation(parameters(limits={"fence_radius": 10.0})))
    here, velocity = np.array(in_slot().position), np.zeros(3)
    begun = here.copy()
    for _ in range(400):
        own = in_slot(off=here - begun, velocity=tuple(velocity.tolist()))
        leader = leader_from(own, at=(2.0 * flying.t, 0.0, -HEIGHT), velocity=(2.0, 0.0, 0.0))
        velocity = np.array(flying.tell(own, {10: leader}, [track()]).velocity)
        here = here + 0.1 * velocity
    assert 9.5 < here[0] - begun[0] <= 10.0


class Chased:
    """A drone that does at once what it is told, and somebody without a name that stays 2 m in the south of it, and
    `below` m, and comes at `speed`, wherever it goes: nobody can get away from that. `off` and `up` are how far it is
    from where it began, level and in height."""

    def __init__(self, speed=2.0, leader=None, below=0.0, **limits):
        self.flying = Flying(Formation(parameters(limits=limits)))
        self.here, self.velocity, self.off, self.up = np.zeros(3), np.zeros(3), [], []
        self.leader = leader
        self.away = np.array([-2.0, 0.0, below])
        self.comes = -speed * self.away / np.linalg.norm(self.away)

    def fly(self, seconds, chased=True):
        for _ in range(round(10.0 * seconds)):
            own = in_slot(off=self.here, velocity=tuple(self.velocity.tolist()))
            seen, tracks = {}, []
            if chased:
                seen[11] = state(self.away, self.comes - self.velocity, drone_id=0)
                tracks.append(track(None, 11))
            if self.leader is not None:
                seen[10] = leader_from(
                    own, velocity=self.leader, at=(self.leader[0] * self.flying.t, 0.0, -HEIGHT)
                )
                tracks.append(track())
            self.velocity = np.array(self.flying.tell(own, seen, tracks).velocity)
            self.here = self.here + 0.1 * self.velocity
            self.off.append(float(np.linalg.norm(self.here[:2])))
            self.up.append(-float(self.here[2]))
        return self


@pytest.mark.parametrize("below", [1.5, -1.5])
def test_nobody_is_chased_through_the_heights_of_others(below):
    chased = Chased(below=below, fence_radius=100.0).fly(40.0)
    assert max(chased.off) > LED_MOST_ASIDE_M - 0.5
    # The leader's slot is a metre lower, and nobody's is higher.
    assert min(chased.up) >= -0.5 - 1e-6
    assert max(chased.up) <= ESCAPE_MOST_M + 1e-6


def test_who_is_kept_clear_of_from_below_is_so_by_flying_level(flying):
    near = state((1.0, 0.0, 0.6), drone_id=0)
    own = in_slot(off=(0.0, 0.0, -AT_HEIGHT_M))
    setpoint = flying.tell(own, {12: near}, [track(None, 12)], seconds=0.5)
    north, _, down = setpoint.velocity
    assert down == pytest.approx(0.0, abs=1e-3)
    assert setpoint.clear_of == (12,)
    # As fast along the ray as if it could climb.
    assert (1.0 * north + 0.6 * down) / math.hypot(1.0, 0.6) < -0.1


def test_nobody_is_chased_beyond_the_fence():
    chased = Chased(fence_radius=5.0).fly(60.0)
    assert 4.5 < max(chased.off) <= 5.0 + 1e-6


def test_who_holds_is_chased_no_farther_than_a_step_aside_may_take_it():
    chased = Chased(fence_radius=100.0).fly(90.0)
    assert LED_MOST_ASIDE_M - 0.5 < max(chased.off) <= LED_MOST_ASIDE_M + 1e-6


def test_who_is_chased_again_and_again_while_it_holds_is_led_no_farther():
    chased = Chased(fence_radius=100.0)
    for _ in range(8):
        chased.fly(10.0).fly(5.0, chased=False)
    # Round about it still steps aside, a little outwards with each step.
    assert LED_MOST_ASIDE_M - 0.5 < max(chased.off) <= LED_MOST_ASIDE_M + 0.1


def test_a_slot_that_is_fled_from_is_at_most_so_far_away_and_is_flown_back_to():
    chased = Chased(leader=(0.0, 0.0, 0.0), fence_radius=100.0)
    chased.fly(3.0, chased=False)
    assert max(chased.off) < 0.1
    chased.fly(60.0)
    # Round about it still steps aside, a little outwards with each step.
    assert LED_MOST_ASIDE_M - 0.5 < max(chased.off) < LED_MOST_ASIDE_M + 0.5
    chased.fly(30.0, chased=False)
    assert chased.off[-1] < 0.1


def test_a_retreat_along_with_a_leader_that_flies_that_way_is_not_held_back():
    chased = Chased(leader=(1.0, 0.0, 0.0), fence_radius=500.0)
    chased.fly(3.0, chased=False).fly(60.0)
    # The slot itself went 60 m that way.
    assert chased.off[-1] > 55.0


@pytest.mark.parametrize(("height", "least", "expected"), [(5.0, 7.0, 7.0), (30.0, 2.0, 17.0)])
def test_no_drone_is_led_below_its_least_height_or_above_its_fence(height, least, expected):
    limits = {"least_height": least, "fence_height": 10.0}
    flying = Flying(Formation(parameters(height=height, limits=limits)))
    down = -7.0
    for _ in range(600):
        own = in_slot(off=(0.0, 0.0, down + HEIGHT + 1.0))
        down += 0.1 * flying.tell(own).velocity[2]
    assert -down == pytest.approx(expected, abs=0.02)


def test_engaging_again_begins_from_rest_with_a_fence_around_that_place(flying):
    own = in_slot()
    assert level(flying.settled(own, velocity=(2.0, 0.0, 0.0))) > 1.9
    flying.formation.engage()
    assert flying.tell(own, {10: leader_from(own)}, [track()]).velocity == STANDSTILL


def test_the_same_story_gives_the_same_setpoints_to_the_last_bit():
    def story():
        flying, rng = Flying(Formation(parameters())), np.random.default_rng(4)
        for _ in range(50):
            own = in_slot(off=rng.normal(size=3), velocity=tuple(rng.normal(size=3).tolist()))
            seen = {10: leader_from(own), 11: state(rng.normal(size=3) * 3.0, rng.normal(size=3), 0)}
            yield flying.tell(own, seen, [track(), track(None, 11)])

    assert list(story()) == list(story())


# ── the code ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_drone_at_its_height_sways_about_it_by_its_code_and_one_that_climbs_does_not(flying):
    swaying = {"sways": OwnSway(-0.1, -0.4)}
    own = in_slot(**swaying)
    flying.settled(in_slot())
    setpoint = flying.tell(own, {10: leader_from(own)}, [track()], seconds=1.0)
    # 0.1 m below where it should be now, which rises by 0.4 m/s.
    assert setpoint.velocity[2] == pytest.approx(-0.4 - 0.8 * 0.1)
    flying.formation.engage()
    below = in_slot(off=(0.0, 0.0, 0.5), **swaying)
    climbing = flying.tell(below, {10: leader_from(below)}, [track()], seconds=1.0)
    assert climbing.velocity[2] == pytest.approx(-0.8 * 0.5)


# ── heights that drift, and commands that are not flown ──────────────────────────────────────────────────────────────


def drifting(flying, drift, *, drone_id=1, seconds=20.0, probability=0.999):
    """In its slot, while its camera finds it lower than it says, more so each time; the whys."""
    own = in_slot()
    whys = []
    for _ in range(round(10.0 * seconds)):
        t = flying.t + 0.1
        off = 8.0 + drift * t
        own = in_slot(height_sights=(HeightSight(drone_id, "a moved", t, off, 0.1, 5.0, 0.1),))
        setpoint = flying.tell(own, {10: leader_from(own)}, [track(probability=probability)])
        whys.append(setpoint.why)
    return whys, setpoint


def test_a_height_that_drifts_holds_the_drone_and_costs_its_leader_no_name(flying):
    whys, setpoint = drifting(flying, 0.0)
    assert whys[-1] is Why.FOLLOW
    whys, setpoint = drifting(flying, 0.2, seconds=10.0)
    assert setpoint.why is Why.HEIGHT_DOUBT
    assert setpoint.holds
    assert setpoint.text.startswith("own or drone 1's height seems wrong by ")
    assert setpoint.velocity == pytest.approx(STANDSTILL, abs=1e-9)
    assert Why.ENTRY not in whys
    # Whoever engages it again says that its height is right by now.
    flying.formation.engage()
    assert drifting(flying, 0.0)[0][-1] is Why.FOLLOW


@pytest.mark.parametrize("told", [{"drone_id": 3}, {"probability": 0.85}])
def test_who_is_not_surely_named_tells_nothing_of_heights(flying, told):
    assert Why.HEIGHT_DOUBT not in drifting(flying, 0.3, **told)[0]


def test_a_drone_that_does_not_fly_as_it_is_told_holds_and_is_told_so(flying):
    pushed = in_slot(velocity=(0.0, 1.2, 0.0))
    flying.settled(in_slot())
    setpoint = flying.tell(pushed, {10: leader_from(pushed)}, [track()], seconds=6.0)
    assert setpoint.why is Why.DIVERGES
    assert setpoint.holds
    assert "off its command" in setpoint.text
    # It has to obey for a while.
    own = in_slot()
    whys = [flying.tell(own, {10: leader_from(own)}, [track()]).why for _ in range(100)]
    assert whys[20] is Why.DIVERGES
    assert whys[-1] is Why.FOLLOW
    assert whys == sorted(whys, key=[Why.DIVERGES, Why.FOLLOW].index)


def test_nothing_leads_below_the_least_height_above_what_the_range_finder_measures():
    flying = Flying(Formation(parameters(limits={"least_height": 2.0})))
    own = in_slot(off=(0.0, 0.0, -1.0), ground=2.5)
    # Its slot is a metre lower.
    setpoint = flying.tell(own, {10: leader_from(own)}, [track()], seconds=3.0)
    assert setpoint.velocity[2] == pytest.approx(0.25)
    own = in_slot(off=(0.0, 0.0, -1.0), ground=2.0)
    assert flying.tell(own).velocity[2] == pytest.approx(0.0)
    own = in_slot(ground=1.0)
    assert flying.tell(own).velocity[2] == pytest.approx(-0.5)
    # Where the ground is farther than the own height says, that counts.
    own = in_slot(off=(0.0, 0.0, 2.0), ground=40.0)
    assert own.position[2] == -4.0
    flying = Flying(Formation(parameters(limits={"least_height": 4.5})))
    assert flying.tell(own, seconds=0.3).velocity[2] <= -0.25


@pytest.mark.parametrize("ground", [math.nan, math.inf, -1.0, 1e9])
def test_a_ground_that_is_none_is_no_floor(ground):
    flying = Flying(Formation(parameters()))
    own = in_slot(off=(0.0, 0.0, -1.0), ground=ground)
    assert flying.tell(own, {10: leader_from(own)}, [track()], seconds=3.0).velocity[2] == pytest.approx(0.8)


# ── an own height that is vague ──────────────────────────────────────────────────────────────────────────────────────


def measuring(flying, error, *, seconds=6.0, sigma=1.8):
    """It is 1 m above its leader, and its own height is wrong by `error` m; it flies as it is told."""
    height = HEIGHT + 1.0
    for _ in range(round(10.0 * seconds)):
        t = flying.t + 0.1
        # What is reported: its own height less the leader's, 0, less what the camera has.
        off = height + error - 0.0 - (height - HEIGHT)
        sight = HeightSight(1, "a moved", t, off, 0.1, 5.0, 0.1, 0.0)
        own = in_slot(
            off=(0.0, 0.0, HEIGHT + 1.0 - height - error), height_sigma=sigma, height_sights=(sight,)
        )
        setpoint = flying.tell(
            own, {10: leader_from(own, at=(0.0, 0.0, own.position[2] + height - HEIGHT))}, [track()]
        )
        height -= 0.1 * setpoint.velocity[2]
    return height, setpoint


@pytest.mark.parametrize("error", [-2.5, 1.8])
def test_a_vague_own_height_gives_way_to_that_above_the_leader(flying, error):
    height, setpoint = measuring(flying, error)
    assert setpoint.why is Why.FOLLOW
    assert height == pytest.approx(HEIGHT + 1.0, abs=0.05)


def test_an_own_height_that_is_known_does_not_follow_the_leaders(flying):
    height, _ = measuring(flying, 0.8, sigma=0.9)
    assert height == pytest.approx(HEIGHT + 1.0 - 0.8, abs=0.1)


def test_a_leader_at_another_height_than_planned_is_not_followed_beyond_the_own_error(flying):
    _, setpoint = measuring(flying, 4.0, sigma=1.2)
    assert setpoint.why is Why.HEIGHT_VAGUE


def test_a_vague_own_height_holds_until_the_leaders_is_measured(flying):
    own = in_slot(height_sigma=1.8)
    setpoint = flying.tell(own, {10: leader_from(own)}, [track()], seconds=3.0)
    assert setpoint.why is Why.HEIGHT_VAGUE
    assert setpoint.velocity == STANDSTILL
    assert measuring(flying, 0.0)[1].why is Why.FOLLOW
