"""The components: what may be wrong with this drone, and with the pads of its team."""

import math

import numpy as np
import pytest

from swarmtrack.team.own_errors import OwnErrors
from swarmtrack.team.priors import (
    SHARED_HEADING_CELL_RAD,
    SHARED_HEADING_SIGMA_RAD,
    SHARED_HEADING_WITHIN_RAD,
)

PADS = {drone: np.array([3.0 * drone, drone % 2, -1.0]) for drone in (1, 2, 3, 4)}


@pytest.mark.parametrize("heading_deg", [2.0, 5.0, 15.0])
def test_priors_add_up_to_one(heading_deg):
    log_prior, off = OwnErrors(1, PADS).log_prior(math.radians(heading_deg))
    # The cells of a wide heading are cut off where another fault has all of the prior.
    assert np.exp(log_prior).sum() == pytest.approx(1.0, abs=1e-3)
    assert off.min() >= 0.0
    assert off.max() <= 1.0


def test_as_configured_is_first_and_no_fault():
    errors = OwnErrors(1, PADS)
    log_prior, off = errors.log_prior(math.radians(2.0))
    assert int(log_prior.argmax()) == 0
    assert off[0] == 0.0
    assert not errors.mine[0]


def test_a_heading_that_is_off_is_a_fault_unless_the_autopilot_knows_no_better():
    errors = OwnErrors(1, PADS)
    k = next(k for k, c in enumerate(errors.components) if c.heading == pytest.approx(math.radians(12.0)))
    _, sure = errors.log_prior(math.radians(2.0))
    _, vague = errors.log_prior(math.radians(12.0))
    assert sure[k] > 0.99
    assert vague[k] < 0.1


def test_two_on_each_others_pads_stand_where_the_other_says():
    errors = OwnErrors(1, PADS)
    k = next(k for k, c in enumerate(errors.components) if c.pads == ((1, 2), (2, 1)) and not c.heading)
    assert errors.stands_at(1)[k].tolist() == PADS[2].tolist()
    assert errors.stands_at(2)[k].tolist() == PADS[1].tolist()
    assert errors.stands_at(3)[k].tolist() == PADS[3].tolist()
    assert errors.mine[k]
    assert errors.permuted(2)[k]
    assert not errors.permuted(3)[k]


def test_in_a_large_team_only_neighbours_swap():
    many = {drone: np.array([2.0 * drone, 0.0, 0.0]) for drone in range(1, 31)}
    swaps = {c.pads for c in OwnErrors(1, many).components if len(c.pads) == 2}
    assert ((5, 6), (6, 5)) in swaps
    assert ((1, 30), (30, 1)) not in swaps
    assert len(swaps) < 120


def test_what_was_learned_goes_over_to_a_larger_team():
    small = OwnErrors(1, {drone: PADS[drone] for drone in (1, 2)})
    large = OwnErrors(1, PADS)
    value = np.arange(len(small), dtype=float)
    mapped = large.mapped_from(small, value)
    for k, c in enumerate(large.components):
        if not c.pads and not c.loose:
            same = small.components.index(c)
            assert mapped[k] == value[same]


@pytest.mark.parametrize("step_deg", [-170.0, -90.0, -12.0, 12.0, 90.0, 170.0])
def test_a_step_of_the_heading_moves_what_was_learned_to_other_cells(step_deg):
    errors = OwnErrors(1, PADS)
    rows = errors.turned(np.arange(len(errors)), math.radians(step_deg))
    for c, row in zip(errors.components, rows.tolist(), strict=True):
        was = errors.components[row]
        error = math.remainder(was.heading - c.heading - math.radians(step_deg), 2.0 * math.pi)
        if row:
            assert abs(error) < math.radians(6.1)
            assert (was.shift, was.pads, was.loose) == (c.shift, c.pads, c.loose)
        else:
            # It had no fault at all, or a fault of the start or pads that only goes with a heading in a coarse cell.
            assert abs(error) < math.radians(6.1) or c.ring or c.pads


def test_a_step_within_a_cell_moves_nothing():
    errors = OwnErrors(1, PADS)
    value = np.arange(len(errors))
    assert errors.turned(value, math.radians(2.0)).tolist() == value.tolist()


def test_a_large_team_shares_one_heading_in_fine_cells():
    """What a heading as stated has in a small team its cells share, and none of them is a fault."""
    pads = {drone: np.array([3.0 * drone, 0.0, 0.0]) for drone in range(1, 60)}
    large, small = OwnErrors(1, pads), OwnErrors(1, PADS)
    sigma = math.radians(2.0)
    log_prior, off = large.log_prior(sigma)
    within = np.abs(large.heading) <= SHARED_HEADING_WITHIN_RAD
    as_stated = within & (large.ring == 0.0)
    assert np.exp(log_prior).sum() == pytest.approx(1.0, abs=1e-3)
    assert as_stated.sum() == 31
    assert np.exp(log_prior[as_stated]).sum() > 0.85
    assert off[as_stated & (np.abs(large.heading) < 2.0 * sigma)].max() < 0.02
    used = np.arange(len(large))
    assert large.heading_sigma(used, sigma)[as_stated] == pytest.approx(SHARED_HEADING_SIGMA_RAD)
    assert small.heading_sigma(np.arange(2), sigma).tolist() == [sigma, small.sigma[1]]


def test_a_turned_heading_takes_fine_cells_along():
    pads = {drone: np.array([3.0 * drone, 0.0, 0.0]) for drone in range(1, 60)}
    errors = OwnErrors(1, pads)
    value = np.where(np.isclose(errors.heading, SHARED_HEADING_CELL_RAD), 7.0, 0.0)
    turned = errors.turned(value, -SHARED_HEADING_CELL_RAD)
    assert turned[errors.heading == 2.0 * SHARED_HEADING_CELL_RAD] == pytest.approx(7.0)
