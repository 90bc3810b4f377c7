"""No two tracks are the same teammate at one time, in the past as little as now."""

import numpy as np
import pytest

from swarmtrack.team.matchings import log_total
from swarmtrack.team.pasts import COLUMN_OF_NOBODY, Past, each_past_once, log_ratios, pasts_from_now

BOTH = (0, 1)
ALL = np.ones(1, bool)


def begun(whole):
    """Two tracks with one component, log ratios `whole` (2, m) of all their bearings, and a segment that begins now."""
    whole = np.asarray(whole, float)
    pasts = [Past.unknown(np.zeros((2, 1))) for _ in whole]
    each = [np.stack([row[None], np.full((1, whole.shape[1]), -np.inf)]) for row in whole]
    return pasts, each


def told_again(found, more, handover=-6.0):
    """The tracks some time later, when `more` (2, m) was said since: the first segments say it as well."""
    pasts, each = begun(more[0])
    for i, past in found.items():
        begins = Past(handover + past.log, past.column, handover + past.log_other)
        pasts[i] = Past(*(np.stack(rows) for rows in zip(pasts[i].of(0), begins, strict=True)))
        each[i][1] = np.asarray(more[1][i])[None]
    nobody, ratio = log_ratios([past.log for past in pasts], each)
    once = each_past_once(ratio, nobody, pasts, each, [10.0 * np.arange(len(row)) for row in each])
    return float(sum(nobody)[0] + log_total(once)[0])


@pytest.mark.parametrize("whole", [[[50.0, -90.0], [-90.0, 40.0]], [[50.0, 20.0], [45.0, -90.0]]])
def test_all_pasts_together_are_one_matching(whole):
    pasts, each = begun(whole)
    found = pasts_from_now(BOTH, pasts, each, ALL)
    assert sum(past.log[0] for past in found.values()) == pytest.approx(
        log_total(np.asarray(whole)[:, None])[0]
    )


def test_a_track_that_was_a_teammate_leaves_another_the_time_since_then_only():
    """Both fitted teammate 0, the second a little worse. The first is nobody any more, and the second fits well."""
    whole = [[50.0, -90.0], [48.0, -90.0]]
    found = pasts_from_now(BOTH[::-1], *begun(whole), ALL)
    assert found[0].column[0] == 0
    later = ([[-90.0, -90.0], [53.0, -90.0]], [[-90.0, -90.0], [5.0, -90.0]])
    # At most one of the two pasts, and what came since.
    assert told_again(found, later) < 50.0 + 5.0 + 1.0


def test_of_a_past_the_likeliest_is_known_and_what_it_was_otherwise():
    found = pasts_from_now([0], *begun([[50.0, 20.0], [-90.0, -90.0]]), ALL)
    past = found[0]
    assert (past.log[0], past.column[0]) == (pytest.approx(50.0), 0)
    assert past.without(0)[0] == pytest.approx(20.0)
    assert past.without(1)[0] == past.without(COLUMN_OF_NOBODY)[0] == past.log[0]


def two_pasts(begins_s):
    """Log odds of swapped names, of two tracks with one component: the first was teammate 1 until `begins_s[0]` and has
    looked more like 0 since; the second was teammate 0 until `begins_s[1]`, and has said nothing since."""
    was = [Past(np.array([[0.0], [44.0]]), np.array([[COLUMN_OF_NOBODY], [1]]), np.array([[0.0], [10.0]]))]
    was.append(
        Past(np.array([[0.0], [122.0]]), np.array([[COLUMN_OF_NOBODY], [0]]), np.array([[0.0], [10.0]]))
    )
    each = [np.array([[[-90.0, 60.0]], [[22.0, 6.0]]]), np.array([[[128.0, -90.0]], [[0.0, 0.0]]])]
    nobody, ratio = log_ratios([past.log for past in was], each)
    since = [np.array([1.0, begins]) for begins in begins_s]
    once = each_past_once(ratio, nobody, was, each, since)
    return float(once[0, 0, 0] + once[1, 0, 1] - once[0, 0, 1] - once[1, 0, 0])


def test_a_claim_is_of_no_time_in_which_another_track_was_that_teammate():
    """From a carried follower's flight: without this, a track became the leader of ten seconds ago as soon as a segment
    began on the leader's track."""
    assert two_pasts((16.0, 26.0)) < -30.0
    assert two_pasts((26.0, 16.0)) < -30.0


def test_two_tracks_swap_at_a_time_that_is_known_no_better_than_segments_begin():
    assert two_pasts((25.0, 26.0)) > -1.0
    assert two_pasts((26.0, 25.0)) > -1.0


def test_a_track_that_came_later_costs_nothing():
    """A past may be of a teammate that is another track's by now, if that has begun since."""
    was = [Past(np.array([[0.0]]), np.array([[COLUMN_OF_NOBODY]]), np.array([[0.0]]))]
    was.append(
        Past(np.array([[0.0], [20.0]]), np.array([[COLUMN_OF_NOBODY], [0]]), np.array([[0.0], [-10.0]]))
    )
    each = [np.array([[[30.0]]]), np.array([[[-90.0]], [[-5.0]]])]
    nobody, ratio = log_ratios([past.log for past in was], each)
    for begun, gone in ((20.0, False), (5.0, True)):
        once = each_past_once(ratio, nobody, was, each, [np.array([begun]), np.array([1.0, 10.0])])
        assert (once[0, 0, 0] < ratio[0, 0, 0] - 10.0) == gone
