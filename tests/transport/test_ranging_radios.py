"""What counts of what ranging radios say."""

from __future__ import annotations

from swarmtrack.messages import RangeReport
from swarmtrack.transport.limits import MAX_MEASURED_PER_RADIO, MAX_RADIOS
from swarmtrack.transport.ranging_radios import RangingRadios
from swarmtrack.wire.ranging import RangeMessage, range_message

UTC = 1.7e9


def said(
    sequence: int, other: int = 2, boot: str = "0123abcd", t: float = 10.0, utc: float = UTC
) -> RangeMessage:
    return range_message(RangeReport(1, other, t, 0.01, 8.0, 0.1), boot, sequence, utc, t + 0.02)


def time_of(radios: RangingRadios, message: RangeMessage, arrived: float = 10.03):
    return radios.time_of(message, arrived=arrived, utc_offset=UTC)


def test_a_distance_holds_at_its_own_time():
    found = time_of(RangingRadios(), said(1))
    assert found is not None
    assert abs(found.t - 10.0) < 1e-6
    assert found.sigma == 0.01


def test_a_radio_whose_clock_is_hours_off_is_stamped_by_arrival():
    found = time_of(RangingRadios(), said(1, utc=UTC - 7200.0))
    assert found is not None
    assert abs(found.t - 10.0) < 0.05
    assert found.sigma >= 0.2


def test_what_is_repeated_or_overtaken_counts_once_for_each_teammate():
    radios = RangingRadios()
    told = [time_of(radios, said(*one)) for one in ((1, 2), (2, 2), (2, 2), (1, 2), (1, 3))]
    assert [one is not None for one in told] == [True, True, False, False, True]
    assert radios.counters["ranges_repeated"] == 2


def test_a_radio_that_starts_again_counts_from_the_beginning():
    radios = RangingRadios()
    assert time_of(radios, said(100))
    assert time_of(radios, said(1, boot="0123abce"))


def test_a_flood_of_radios_and_of_teammates_is_not_remembered():
    radios = RangingRadios()
    for k in range(100):
        assert time_of(radios, said(1, boot=f"{k:08x}"))
    assert len(radios._radios) == MAX_RADIOS
    for other in range(2, 3000):
        time_of(radios, said(1, other, boot="ffffffff"))
    assert radios.counters["ranges_beyond_limit"] == 2998 - MAX_MEASURED_PER_RADIO
