"""How the heading of a drone at rest wanders: every change of it is an error.

Theory of operation. After it is switched on an autopilot learns its gyro's bias and its compass for some forty seconds,
and its heading swings by up to 4° to either side meanwhile. A drone that stands does not turn, so each ray's direction
is taken along with the heading (`TeamPosterior.turn_rays`): what was seen does not swing. That the drone stands is said
by its autopilot, and by a gyro that reads no more than its bias ("zero angular rate update"). A deck that turns more
slowly than a gyro's bias is not told from one that stands.
"""

from __future__ import annotations

import math
from statistics import fmean

import numpy as np

from swarmtrack.messages import Array, EgoPose, ImuSample
from swarmtrack.motion.priors import (
    HEADING_GYRO_BIAS_RAD_S,
    REST_GYRO_SIGMA_RAD_S,
    REST_HEADING_ATTITUDES,
    REST_HEADING_STEP_RAD,
    REST_WINDOW_S,
)


class HeadingAtRest:
    """Takes the gyro's samples on the ground, and all poses. A heading counts once the samples around it are known to
    be of a drone at rest."""

    def __init__(self) -> None:
        self.found = 0
        self._is_still = False
        self._window_t = -math.inf
        """When the window of gyro samples began, s."""
        self._samples: list[Array] = []
        self._waiting: list[float] = []
        """Headings within the window, rad."""
        self._anchor: float | None = None
        """The heading that the rays have now, rad."""
        self._headings: list[float] = []
        """Since it was compared last, rad."""

    @property
    def counters(self) -> dict[str, int]:
        """Steps, each of `REST_HEADING_STEP_RAD` or more."""
        return {"heading_steps_at_rest": self.found}

    def add_gyro(self, sample: ImuSample) -> None:
        """Add a sample of the gyro."""
        if not 0.0 <= sample.t - self._window_t < REST_WINDOW_S:
            self._judge()
            self._window_t = sample.t
        self._samples.append(sample.gyro)

    def _judge(self) -> None:
        """Did the drone turn within the window?"""
        rates, self._samples = np.array(self._samples), []
        headings, self._waiting = self._waiting, []
        self._is_still = len(rates) > 1 and bool(
            rates.std(axis=0).max() < REST_GYRO_SIGMA_RAD_S
            and np.abs(rates.mean(axis=0)).max() < HEADING_GYRO_BIAS_RAD_S
        )
        if not self._is_still:
            self._anchor, self._headings = None, []
        else:
            self._headings += headings

    def add_pose(self, pose: EgoPose, *, is_on_ground: bool) -> list[float] | None:
        """Add an attitude. Returns by how much the heading has changed and the drone has not [rad], clockwise from
        above, if at all; None for a drone that may have turned."""
        if not is_on_ground or pose.t - self._window_t > 2.0 * REST_WINDOW_S:
            # It flies, or the gyro is silent.
            self._samples = []
            self._judge()
            return None
        self._waiting.append(math.atan2(float(pose.world_from_body[1, 0]), float(pose.world_from_body[0, 0])))
        if not self._is_still:
            return None
        if len(self._headings) < REST_HEADING_ATTITUDES:
            return []
        anchor = self._headings[0] if self._anchor is None else self._anchor
        off = [math.remainder(heading - anchor, 2.0 * math.pi) for heading in self._headings]
        step, self._headings = fmean(off), []
        if self._anchor is None:
            self._anchor = anchor + step
            return []
        if abs(step) < REST_HEADING_STEP_RAD:
            return []
        self.found += 1
        self._anchor += step
        return [step]
