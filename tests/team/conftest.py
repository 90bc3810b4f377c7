"""What the tests of names begin with."""

import pytest

from support.observer import LEFT, RIGHT, Observer


@pytest.fixture
def observer():
    """Who has heard that drone 2 is to the left and drone 3 to the right."""
    alone = Observer()
    alone.hears(2, LEFT)
    alone.hears(3, RIGHT)
    return alone
