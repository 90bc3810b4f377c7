"""Exposures of the fake libraries: the middle of number k is at START + k / 30 s, on CLOCK_MONOTONIC.

Frames arrive 50 ms later. CLOCK_BOOTTIME is ahead by an hour, as on a board that has slept for so long.
"""

import itertools
import math
import os
import time

START = float(os.environ["FAKE_START"])
LAST = int(os.environ["FAKE_LAST"])
ASLEEP = 3600.0
EXPOSURE = 8e-3

_clock_gettime = time.clock_gettime
time.clock_gettime = lambda clock: _clock_gettime(clock) + ASLEEP * (clock == time.CLOCK_BOOTTIME)


def exposures():
    """Numbers and middles of exposures, each when it has arrived; then the camera is unplugged."""
    # A camera keeps no pictures of the time before its program was up.
    first = max(0, math.ceil(30.0 * (time.monotonic() - START)))
    for k in itertools.count(first):
        if k > first + LAST:
            raise RuntimeError("the fake camera is unplugged")
        middle = START + k / 30.0
        time.sleep(max(0.0, middle + 0.05 - time.monotonic()))
        yield k, middle
