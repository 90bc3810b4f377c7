"""A follower whose autopilot is a simulated one on its link, in virtual time: it loses its position, and is fed ours.

Between `Onboard` and the autopilot is all that flies: MAVLink both ways, clock map, `PlaceFeed`, and an estimator that
goes by ODOMETRY as the parameters let it. In place of the pilot: a switch that selects the sources.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.address import LinkAddress
from swarmtrack.autopilot.fed_position import FedPosition
from swarmtrack.autopilot.links import Wire
from swarmtrack.autopilot.mavlink_autopilot import MavlinkAutopilot
from swarmtrack.autopilot.notices import Severity
from swarmtrack.benchmarks.virtual_swarm import LEAD_S
from swarmtrack.clock import ManualClock
from swarmtrack.lab.autopilots.autopilot import SimulatedArduPilot, SimulatedVehicle
from swarmtrack.lab.autopilots.firmware import FlightMode
from swarmtrack.lab.autopilots.pilot import GuidedPilot
from swarmtrack.lab.autopilots.px4 import SimulatedPx4
from swarmtrack.lab.autopilots.senses import DroneSenses
from swarmtrack.lab.scenarios.scenario import Scenario
from swarmtrack.lab.world.guided import GuidedDrone
from swarmtrack.lab.world.response import Triple
from swarmtrack.messages import AutopilotRebooted, EgoPose, FlightState, ImuSample, RemoteIdClaim
from swarmtrack.motion.ego import AutopilotPlace
from swarmtrack.onboard import Onboard
from swarmtrack.runtime.place_feed import FeedParameters, PlaceFeed

# s of the link's clock at world time 0; and of it between two looks at the link.
EPOCH_S, LINK_STEP_S = 1000.0, 0.005
# s that an estimator carries on by inertia alone: EKF2_NOAID_TOUT of PX4; EKF3 does for 7 s and more.
COASTS_S = 5.0
# s from the loss until the pilot has thrown the switch.
SWITCHES_AFTER_S = 0.5
EXTERNAL_PARAMETERS = {"VISO_TYPE": 1, "EK3_SRC2_POSXY": 6, "EK3_SRC2_YAW": 1, "EKF2_EV_CTRL": 1}
_VELOCITY_AND_RATE = 0b111 | 0b111 << 6 | common.POSITION_TARGET_TYPEMASK_YAW_IGNORE


class _Link:
    """A perfect datagram link: what is sent waits."""

    datagrams, recording, remark, foreign, numbered = True, False, "", 0, True
    left_out: tuple[str, ...] = ()
    bytes_per_second: float | None = None

    def __init__(self) -> None:
        self.address = LinkAddress("udpin", host="localhost", port=1)
        self.sent: list[bytes] = []

    async def run(self, receiver: Any) -> None:
        raise NotImplementedError("it is moved by hand")

    def send(self, data: bytes) -> None:
        self.sent.append(data)

    def wire(self) -> Wire:
        return Wire(-1)

    def drop(self, reason: str) -> None:
        raise AssertionError(reason)


class FedAutopilot:
    """The autopilot of one guided drone of a scenario, and our end of its link.

    onboard: told what comes; is_fed: whether it is fed, or loses its position for good; lost: whether its receiver
    finds nothing at a world time [s].
    """

    def __init__(
        self,
        scenario: Scenario,
        drone_id: int,
        onboard: Onboard,
        *,
        is_fed: bool,
        lost: Callable[[float], bool],
        px4: bool = False,
    ) -> None:
        self.texts: list[tuple[float, str]] = []
        """World times and sentences for the pilot."""
        self._onboard, self._lost = onboard, lost
        self._lost_since = math.inf
        drone = scenario.world.flown(drone_id)
        assert isinstance(drone, GuidedDrone)
        self._senses = senses = DroneSenses(
            scenario.world, drone_id, EPOCH_S, ego=scenario.ego(drone_id), earth=scenario.origin
        )
        kind: type[SimulatedVehicle] = SimulatedPx4 if px4 else SimulatedArduPilot
        self.pilot = GuidedPilot(
            drone,
            kind.firmware,
            epoch=EPOCH_S,
            origin=scenario.origin,
            located=senses.is_located,
            errors=senses.lasting_errors,
            blind_s=COASTS_S,
        )
        self.vehicle = kind(senses, pilot=self.pilot, system=drone_id, boot_at=EPOCH_S - 60.0)
        if is_fed:
            self.vehicle.parameters.values.update(EXTERNAL_PARAMETERS)
        self._clock, self._link = ManualClock(EPOCH_S - LEAD_S - 2.0), _Link()
        fed = FedPosition() if is_fed else None
        self.unit = MavlinkAutopilot(self._link, clock=self._clock, imu_rate_hz=scenario.imu_rate_hz, fed=fed)
        self.unit.deliver_to(self)
        self.unit.opened()
        self.feed = (
            None
            if fed is None
            else PlaceFeed(self, self.unit, fed, self, clock=self._clock, parameters=FeedParameters())
        )
        self._steps = 0

    @property
    def place_for_autopilot(self) -> AutopilotPlace | None:
        """On the link's clock."""
        place = self._onboard.place_for_autopilot
        return None if place is None else place._replace(t=place.t + EPOCH_S, held_t=place.held_t + EPOCH_S)

    def add(self, severity: Severity, text: str) -> None:
        """A sentence for the pilot."""
        self.texts.append((self._clock.now() - EPOCH_S, text))

    def fly(self, now: float) -> None:
        """On to the world time `now` [s]."""
        while self._clock.now() + LINK_STEP_S <= EPOCH_S + now:
            t = self._clock.now() + LINK_STEP_S
            self._clock.set(t)
            self._steps += 1
            self._switch_sources(t - EPOCH_S)
            sent, self._link.sent = self._link.sent, []
            for data in sent:
                self.vehicle.receive(data, t)
            for data in self.vehicle.step(t):
                self.unit.received(t, data)
            if self._steps % 10 == 0:
                self.unit.tick(t)
                if self.feed is not None:
                    self.feed.feed(t)

    def _switch_sources(self, now: float) -> None:
        """What the receiver finds, and what its pilot does about that."""
        is_lost = self._lost(now)
        self._senses.position_lost = is_lost
        self._lost_since = min(self._lost_since, now) if is_lost else math.inf
        vehicle = self.vehicle
        if not isinstance(vehicle, SimulatedArduPilot) or self.feed is None:
            return
        wanted = 2 if now - self._lost_since >= SWITCHES_AFTER_S else 1
        if vehicle.source_set != wanted and (is_lost or self._lost_since == math.inf):
            vehicle.select_source_set(wanted)

    def engage(self, now: float) -> None:
        """By the pilot's switch."""
        self.pilot.switch_to(FlightMode.GUIDED, EPOCH_S + now)

    def command(self, velocity: Triple, yaw_rate: float) -> None:
        """A velocity [m/s], NED, and a rate [rad/s] for the autopilot."""
        set_point = common.MAVLink_set_position_target_local_ned_message(
            0, 0, 0, common.MAV_FRAME_LOCAL_NED, _VELOCITY_AND_RATE, 0, 0, 0, *velocity, 0, 0, 0, 0, yaw_rate
        )
        self.unit.send_message(set_point)

    # ── AutopilotListener ────────────────────────────────────────────────────────────────────────────────────────

    def on_imu(self, sample: ImuSample) -> None:
        self._onboard.tell(ImuSample(sample.t - EPOCH_S, sample.gyro, sample.accel, sample.gyro_delay))

    def on_pose(self, pose: EgoPose) -> None:
        self._onboard.tell(
            EgoPose(
                pose.t - EPOCH_S,
                pose.position,
                pose.world_from_body,
                position_sigma=pose.position_sigma,
                t_sigma=pose.t_sigma,
            )
        )

    def on_flight_state(self, state: FlightState) -> None:
        since = state.airborne_since
        self._onboard.tell(FlightState(state.t - EPOCH_S, None if since is None else since - EPOCH_S))

    def on_autopilot_reboot(self) -> None:
        self._onboard.tell(AutopilotRebooted())

    def on_switch(self, t: float) -> None:
        """None is watched."""

    def on_remote_id(self, claim: RemoteIdClaim) -> None:
        """None is read."""

    def on_found_flying(self) -> None:
        """It hovers from the beginning."""
