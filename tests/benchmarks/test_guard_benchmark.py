"""`bench guard`: what its rows say, and that it would notice."""

import math

from swarmtrack.benchmarks import guard as benchmark
from swarmtrack.benchmarks.guard import Cost, Flight, Found, Told, cost, page, told_anything
from swarmtrack.guard import Command, Guard


def test_a_flight_is_in_order_only_if_zero_is_heard_in_time_and_then_nothing():
    assert Flight(zero_s=0.3, last_s=1.0, worst=0.0, flown_m=2.0).ok
    assert Flight(zero_s=math.nan, last_s=0.0, worst=0.0, flown_m=9.0).ok
    assert not Flight(zero_s=0.5, last_s=1.0, worst=2.5, flown_m=2.0).ok
    assert not Flight(zero_s=0.1, last_s=2.0, worst=0.0, flown_m=2.0).ok
    assert not Flight(zero_s=math.nan, last_s=0.6, worst=2.5, flown_m=9.0).ok


def test_whatever_it_is_told_the_guard_breaks_no_limit():
    told = told_anything(5000)
    assert told.sent > 4000
    assert told.beyond == 0


def test_a_guard_that_passes_on_what_it_is_told_would_be_noticed(monkeypatch):
    class Careless(Guard):
        def _checked(self, decision, dt, now):
            return Command(decision.velocity, decision.yaw_rate)

    monkeypatch.setattr(benchmark, "Guard", Careless)
    assert told_anything(500).beyond > 100


def test_a_guard_is_a_process_whose_set_points_arrive():
    measured = cost(0.5, signed=True)
    assert 0.0 < measured.p95_ms <= measured.worst_ms
    assert 1.0 < measured.mb < 40.0


def test_the_page_says_what_happened():
    flights = {"stopped": [Flight(0.01, 0.2, 0.0, 2.4), Flight(0.4, 1.0, 1.0, 7.5)]}
    text = page(Found(flights, Told(10, 9, 0), {"unsigned": Cost(0.002, 12.0, 0.5, 0.6)}))
    assert "| SIGTERM | 2 | 1 | 0.40 | 1.00 | 7.50 |" in text
    assert "| unsigned | 0.20 | 12.00 | 0.50 | 0.60 |" in text
