"""Followers that meet on their ways to their slots: somebody yields, and all arrive."""

import pytest

from support.formation_states import Flying, in_slot, parameters, state, track
from swarmtrack.benchmarks.formation.meetings import ARRIVED_M, meet
from swarmtrack.formation.formation import Formation


# 67 and 152: two for whom the slot lies in front of one who stands, about whom they turned for good.
@pytest.mark.parametrize(
    "seed",
    [67, 152, *(pytest.param(seed, marks=pytest.mark.long("another seed of the same")) for seed in (0, 1))],
)
def test_followers_that_meet_wait_for_each_other_no_longer_than_ten_seconds_and_arrive(seed):
    met = meet(seed)
    assert met.waited < 10.0
    assert met.off < ARRIVED_M
    assert met.nearest > 1.5


def test_who_stands_behind_the_slot_is_not_stepped_aside_from():
    flying = Flying(Formation(parameters()))
    behind = state((5.0, 0.2, 0.0), drone_id=3)
    own = in_slot(off=(-1.5, 0.0, 0.0))
    leader = {10: state((5.5, -3.0, 1.0))}
    setpoint = flying.tell(own, leader | {12: behind}, [track(), track(3, 12)], seconds=3.0)
    assert setpoint.velocity == pytest.approx((0.9, 0.0, 0.0), abs=0.05)
