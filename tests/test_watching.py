"""What a watch of the sensors kept may be asked for while more comes in."""

import sys
import threading
from collections.abc import Iterator

import numpy as np
import pytest

from swarmtrack.doctor.watching import SampleCollector
from swarmtrack.messages import ImuSample


@pytest.fixture
def busy_threads() -> Iterator[None]:
    """Threads that take turns as often as they can."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


@pytest.mark.usefixtures("busy_threads")
def test_turns_of_the_gyro_may_be_asked_for_while_samples_come_in() -> None:
    heard = SampleCollector()
    samples = [ImuSample(0.005 * k, np.zeros(3), np.zeros(3)) for k in range(5000)]
    enough = threading.Event()

    def tell() -> None:
        for sample in samples:
            if enough.is_set():
                return
            heard.on_imu(sample)
            enough.wait(1e-6)

    teller = threading.Thread(target=tell)
    teller.start()
    asked = 0
    while teller.is_alive() and asked < 200:
        if len(heard.samples) > 1:
            turns = heard.gyro()
            assert turns.first == 0.0
            asked += 1
    enough.set()
    teller.join()
    assert asked > 10
