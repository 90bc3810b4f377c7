"""Whether the drones agree, judged by a bystander from what they say."""

from __future__ import annotations

import numpy as np

from swarmtrack.messages import Array, Sighting, SightingReport
from swarmtrack.monitor.verdict import Reports

PLACES = {1: np.array([0.0, 0.0, -2.0]), 2: np.array([8.0, 0.0, -2.0]), 3: np.array([0.0, 8.0, -2.0])}


def report(
    observer: int, t: float, calls: dict[int, int], places: dict[int, Array] | None = None
) -> SightingReport:
    """calls: whom it sees, by the name it gives."""
    where = {**PLACES, **(places or {})}
    sightings = []
    for whom, name in calls.items():
        ray = where[whom] - where[observer]
        sightings.append(Sighting(name, 0.99, ray / np.linalg.norm(ray), 0.01))
    return SightingReport(
        observer, "0123abcd", round(10 * t), t, 0.0, where[observer], 0.1, (), tuple(sightings)
    )


def judged(*reports: SightingReport) -> Reports:
    heard = Reports()
    for one in reports:
        heard.add(one)
    return heard


def test_rays_that_pass_by_where_the_named_drones_say_they_stand_agree():
    heard = judged(report(1, 0.0, {2: 2, 3: 3}), report(2, 0.2, {1: 1}), report(3, 0.4, {}))
    verdict = heard.evaluate((1, 2, 3), 0.5)
    assert verdict.disagreements == ()
    assert {(look.observer, look.called, look.whom) for look in verdict.looks} == {
        (1, 2, 2),
        (1, 3, 3),
        (2, 1, 1),
    }


def test_a_swap_is_told_by_names():
    heard = judged(report(1, 0.0, {2: 3, 3: 2}), report(2, 0.2, {}), report(3, 0.4, {}))
    assert set(heard.evaluate((1, 2, 3), 0.5).disagreements) == {
        "drone 1 calls drone 2 drone 3",
        "drone 1 calls drone 3 drone 2",
    }


def test_a_name_on_a_bird_is_where_that_drone_is_not():
    bird = {4: np.array([-5.0, -5.0, -9.0])}
    heard = judged(report(1, 0.0, {4: 2}, bird), report(2, 0.2, {}), report(3, 0.4, {}))
    assert heard.evaluate((1, 2, 3), 0.5).disagreements == ("drone 1 sees drone 2 where it is not",)


def test_who_has_not_spoken_yet_is_no_reason_to_doubt():
    heard = judged(report(1, 0.0, {3: 3, 2: 2}), report(2, 0.2, {}))
    verdict = heard.evaluate((1, 2, 3), 0.5)
    assert verdict.disagreements == ()
    assert {look.called: look.right for look in verdict.looks} == {2: True, 3: None}


def test_who_says_nothing_is_seen_in_one_place_by_all_or_somebody_errs():
    agree = judged(report(1, 0.0, {3: 3}), report(2, 0.2, {3: 3}))
    assert agree.evaluate((1, 2), 0.5).disagreements == ()
    elsewhere = {3: np.array([4.0, -20.0, -2.0])}
    differ = judged(report(1, 0.0, {3: 3}), report(2, 0.2, {3: 3}, elsewhere))
    assert len(differ.evaluate((1, 2), 0.5).disagreements) == 2


def test_drones_that_fly_are_compared_at_one_instant():
    """Five metres a second: half a second apart, places as they were last told would be far off."""
    heard = Reports()
    for k in range(4):
        t = 1.0 * k
        fast = {2: np.array([8.0, 5.0 * t, -2.0])}
        heard.add(report(1, t, {2: 2}, fast))
        late = {2: np.array([8.0, 5.0 * (t + 0.5), -2.0])}
        heard.add(report(2, t + 0.5, {}, late))
    assert heard.evaluate((1, 2), 3.6).disagreements == ()


def test_of_a_new_life_the_old_words_do_not_count():
    heard = judged(report(1, 9.0, {2: 3}), report(2, 0.2, {}), report(3, 0.4, {}))
    reborn = report(1, 0.5, {2: 2})
    heard.add(SightingReport(1, "ffff0000", 1, reborn.t, 0.0, reborn.position, 0.1, (), reborn.sightings))
    assert heard.evaluate((1, 2, 3), 0.6).disagreements == ()
