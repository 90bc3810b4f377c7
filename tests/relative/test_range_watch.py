"""When a ranging radio is said not to fit, and when to fit again."""

from __future__ import annotations

from swarmtrack.messages import RangeReport
from swarmtrack.relative.range_watch import RangeNews, RangeWatch


def news(watch: RangeWatch, verdicts: list[bool], t0: float = 0.0, other: int = 2) -> list[RangeNews]:
    """Ten distances in each second."""
    found = []
    for k, believed in enumerate(verdicts):
        one = watch.add_range(RangeReport(1, other, t0 + 0.1 * k, 0.0, 208.0, 0.1), believed=believed)
        if one is not None:
            found.append(one)
    return found


def test_distances_that_never_fit_are_said_once_and_once_more_when_they_do():
    watch = RangeWatch()
    (one,) = news(watch, [False] * 100)
    assert (one.drone_id, one.distance) == (2, 208.0)
    assert 1.0 <= one.t < 1.2
    (again,) = news(watch, [True] * 100, t0=10.0)
    assert again.distance is None
    assert again.t >= 11.0


def test_a_single_echo_is_no_news_and_neither_is_a_radio_that_fits():
    watch = RangeWatch()
    assert news(watch, ([True] * 9 + [False]) * 20) == []


def test_each_teammate_has_its_own_verdict():
    watch = RangeWatch()
    assert news(watch, [True] * 30, other=3) == []
    assert [one.drone_id for one in news(watch, [False] * 30, other=2)] == [2]
    assert news(watch, [True] * 30, t0=3.0, other=3) == []
