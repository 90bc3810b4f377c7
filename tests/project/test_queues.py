"""The places that tests/conftest.py names are there: a file that moved would compute next to teams of agents."""

import pytest
from conftest import QUEUES

from support.places import ROOT


@pytest.mark.parametrize("place", [place for places in QUEUES.values() for place in places])
def test_what_the_queues_name_exists(place):
    path, _, test = place.partition("::")
    assert (ROOT / "tests" / path).exists()
    assert not test or f"def {test}" in (ROOT / "tests" / path).read_text()
