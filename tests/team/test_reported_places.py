"""Where a teammate was between its reports."""

import numpy as np
import pytest

from swarmtrack.team.priors import MOTION_DEVIATION, REPORTED_WHITE_M
from swarmtrack.team.reported_places import Report, ReportedPlaces


def path(*reports):
    made = ReportedPlaces()
    for t, x, velocity in reports:
        made.append(
            Report(t, np.array([x, 0.0, 0.0]), None if velocity is None else np.array([velocity, 0.0, 0.0]))
        )
    return made


def test_nothing_was_said():
    assert not ReportedPlaces()
    with pytest.raises(IndexError):
        _ = ReportedPlaces().last


def test_between_two_reports_it_is_on_the_line():
    said = path((0.0, 1.0, None), (1.0, 3.0, None)).at(0.25)
    assert said.place.tolist() == [1.5, 0.0, 0.0]
    assert said.white == REPORTED_WHITE_M**2


def test_a_path_that_bends_is_a_parabola_and_vaguer():
    bending = path(*((float(t), 0.5 * t**2, None) for t in range(4)))
    said = bending.at(2.5)
    assert said.place[0] == pytest.approx(0.5 * 2.5**2)
    assert said.white > 1.4 * REPORTED_WHITE_M**2


def test_it_is_carried_on_for_a_while_and_grows_vague():
    moving = path((0.0, 0.0, 2.0))
    assert moving.at(1.0)[0][0] == pytest.approx(2.0)
    assert moving.at(9.0)[0][0] == pytest.approx(3.0)
    assert moving.at(9.0).white > 100.0 * REPORTED_WHITE_M**2
    assert path((0.0, 0.0, None)).at(9.0).white < moving.at(9.0).white


def test_who_says_how_it_moves_is_nearer_to_that_and_off_smoothly():
    one = np.array([1.0, 0.0, 0.0])
    made = ReportedPlaces()
    made.append(Report(0.0, 0.0 * one, one, measured=True, t_sigma=0.05))
    made.append(Report(0.2, 0.2 * one, one, measured=True, t_sigma=0.05))
    said = made.at(0.1)
    assert said.white < 0.2 * REPORTED_WHITE_M**2
    # Half a decimetre of it is its clock.
    assert said.sigma == pytest.approx(np.hypot(MOTION_DEVIATION[0], 0.05))


def test_a_report_that_is_not_newer_is_dropped():
    made = path((1.0, 1.0, None), (1.0, 9.0, None), (0.5, 9.0, None))
    assert made.last.place[0] == 1.0


def test_a_place_that_may_be_late_is_vague_along_with_its_speed():
    def variance(speed, t_sigma):
        made = ReportedPlaces()
        made.append(Report(0.0, np.zeros(3), np.array([speed, 0.0, 0.0]), t_sigma=t_sigma))
        return made.at(0.0).white

    assert variance(3.0, 0.1) == pytest.approx(REPORTED_WHITE_M**2 + 0.3**2)
    assert variance(0.0, 0.1) == variance(3.0, 0.0)
