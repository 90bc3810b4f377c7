"""Who flies a drone: itself, by a path that is known beforehand, or whoever commands its autopilot.

A guided flight is a table of phases and events. Commands, set points and time make events; one that a phase does not
know is refused.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import Enum, auto
from typing import Any, Protocol

from pymavlink.dialects.v20 import common

from swarmtrack.geometry.geodesy import Geodetic
from swarmtrack.lab.autopilots.firmware import Firmware, FlightMode, ModeNumbers
from swarmtrack.lab.autopilots.senses import LastingErrors
from swarmtrack.lab.autopilots.set_points import (
    ABOVE_HOME,
    ABOVE_SEA,
    global_set_point,
    local_set_point,
    place_in_world,
)
from swarmtrack.lab.world.guided import GuidedDrone
from swarmtrack.lab.world.response import NO_MOTION, Flown, SetPoint, Triple

LAND_SPEED = 0.5  # m/s
REACHED_M = 0.3  # below the height of a take-off
LIFTS_M, LIFTS_M_S = 0.3, 0.1  # above the ground, or upwards: a set point that wants into the air
ARMED_BEFORE_S = 2.0  # s on the ground with the motors on
LOOKS_EVERY = 0.1  # s: how soon a pilot notices what happened by itself
LASTING_SETPOINT_T = math.inf  # as the time of a set point: it needs no other after it
CHANGE_MODE = common.MAV_DO_REPOSITION_FLAGS_CHANGE_MODE
# s without a position until its filter fails, and lands.
BLIND_S = 1.0
RETURNED_M = 0.5  # so near to a height, and to a place above its start, it is there
# s: set points that come for so long, none later than that after the other, end a failsafe of PX4.
RETURNS_S = 0.5


class Pilot(Protocol):
    """What an autopilot says of its flight, and what of it can be commanded. `now`: on the caller's clock [s]."""

    @property
    def armed(self) -> bool: ...

    @property
    def status(self) -> int:
        """MAV_STATE"""
        ...

    @property
    def mode(self) -> ModeNumbers: ...
    @property
    def intended(self) -> ModeNumbers:
        """The mode that was asked for last, which a failsafe does not change."""
        ...

    @property
    def landed(self) -> int:
        """MAV_LANDED_STATE"""
        ...

    @property
    def due(self) -> float:
        """When `poll` has something to see, at the latest."""
        ...

    def poll(self, now: float) -> None:
        """At what happened by itself."""
        ...

    def command(self, command: Any, now: float) -> int | None:
        """The MAV_RESULT of a COMMAND_LONG or COMMAND_INT; None: not one of flight."""
        ...

    def steer(self, message: Any, now: float) -> None:
        """A set point."""
        ...

    def set_mode(self, custom: int, now: float) -> int:
        """By its number in a heartbeat; the MAV_RESULT."""
        ...

    def return_home(self, now: float) -> None:
        """By a failsafe of its battery."""
        ...

    def take_texts(self) -> list[tuple[int, str]]:
        """MAV_SEVERITY and words of what there was to say since."""
        ...


class OnItsPath:
    """Flies a path that nobody changes, deaf to commands.

    takes_off_at: when it leaves the ground, on the caller's clock; it is armed a little before.
    """

    mode = intended = ModeNumbers("", 0, 0)

    def __init__(self, takes_off_at: float = -math.inf) -> None:
        self._takes_off_at = takes_off_at
        self.armed, self.status = False, int(common.MAV_STATE_STANDBY)
        self.landed = int(common.MAV_LANDED_STATE_ON_GROUND)
        self.due = math.inf
        self.poll(-math.inf)

    def poll(self, now: float) -> None:
        if now >= self._takes_off_at - ARMED_BEFORE_S:
            self.armed, self.due = True, self._takes_off_at
        else:
            self.due = self._takes_off_at - ARMED_BEFORE_S
        if now >= self._takes_off_at:
            self.status, self.landed = common.MAV_STATE_ACTIVE, common.MAV_LANDED_STATE_IN_AIR
            self.due = math.inf

    def command(self, command: Any, now: float) -> int | None:
        return None

    def steer(self, message: Any, now: float) -> None:
        """It has its path."""

    def set_mode(self, custom: int, now: float) -> int:
        return int(common.MAV_RESULT_UNSUPPORTED)

    def return_home(self, now: float) -> None:
        """It has its path."""

    def take_texts(self) -> list[tuple[int, str]]:
        return []


class Phase(Enum):
    """Of a guided flight."""

    ON_GROUND = auto()
    IDLING = auto()
    CLIMBING = auto()
    FLYING = auto()
    LANDING = auto()


class PilotEvent(Enum):
    """What moves a guided flight on."""

    ARM = auto()
    DISARM = auto()
    TAKE_OFF = auto()
    REACHED = auto()
    STEER = auto()
    LAND = auto()
    TOUCHED = auto()


PHASE_TRANSITIONS: dict[tuple[Phase, PilotEvent], Phase] = {
    (Phase.ON_GROUND, PilotEvent.ARM): Phase.IDLING,
    (Phase.IDLING, PilotEvent.ARM): Phase.IDLING,
    (Phase.IDLING, PilotEvent.DISARM): Phase.ON_GROUND,
    (Phase.ON_GROUND, PilotEvent.DISARM): Phase.ON_GROUND,
    (Phase.IDLING, PilotEvent.TAKE_OFF): Phase.CLIMBING,
    (Phase.CLIMBING, PilotEvent.REACHED): Phase.FLYING,
    (Phase.CLIMBING, PilotEvent.STEER): Phase.FLYING,
    (Phase.FLYING, PilotEvent.STEER): Phase.FLYING,
    (Phase.LANDING, PilotEvent.STEER): Phase.FLYING,
    (Phase.CLIMBING, PilotEvent.LAND): Phase.LANDING,
    (Phase.FLYING, PilotEvent.LAND): Phase.LANDING,
    (Phase.LANDING, PilotEvent.LAND): Phase.LANDING,
    (Phase.CLIMBING, PilotEvent.TOUCHED): Phase.IDLING,
    (Phase.FLYING, PilotEvent.TOUCHED): Phase.IDLING,
    (Phase.LANDING, PilotEvent.TOUCHED): Phase.IDLING,
}
LANDED = {
    Phase.ON_GROUND: common.MAV_LANDED_STATE_ON_GROUND,
    Phase.IDLING: common.MAV_LANDED_STATE_ON_GROUND,
    Phase.CLIMBING: common.MAV_LANDED_STATE_TAKEOFF,
    Phase.FLYING: common.MAV_LANDED_STATE_IN_AIR,
    Phase.LANDING: common.MAV_LANDED_STATE_LANDING,
}
AIRBORNE_PHASES = (Phase.CLIMBING, Phase.FLYING, Phase.LANDING)


class GuidedPilot:
    """Flies a `GuidedDrone` as it is commanded, by what the autopilot believes of itself. One that hovers already is
    held where it is.

    epoch: world time 0 on the caller's clock; origin: of the world on the Earth; located: whether the autopilot knows
    where it is at a time of the caller's clock, without which it is not guided, and lands after blind_s; ready: whether
    it arms; errors: by how much it is off. Its velocity is GPS's, so that an error of the heading turns its nose, and
    not its way.
    """

    def __init__(
        self,
        drone: GuidedDrone,
        firmware: Firmware,
        *,
        epoch: float,
        origin: Geodetic,
        located: Callable[[float], bool],
        errors: LastingErrors,
        ready: Callable[[float], bool] = lambda t: True,
        blind_s: float = BLIND_S,
    ) -> None:
        self.phase = Phase.FLYING if drone.airborne else Phase.ON_GROUND
        self._drone = drone
        self._errors = errors
        drone.heading_error = errors.heading
        self._firmware = firmware
        self._epoch = epoch
        self._origin = origin
        self._located = located
        self._ready, self._blind_s = ready, blind_s
        self._mode = self._intended = FlightMode.HOLD if drone.airborne else FlightMode.BY_HAND
        self._streams_since = math.inf  # world time
        self._texts: list[tuple[int, str]] = []
        self._quiet_since = 0.0  # world time since which the motors idle
        self._last_set_point = -math.inf  # world time
        self._climbs_to = 0.0  # m, NED, as it believes
        self._looked = -math.inf
        self._located_at = -math.inf
        self._is_high = False

    @property
    def armed(self) -> bool:
        return self.phase is not Phase.ON_GROUND

    @property
    def status(self) -> int:
        if self.phase in AIRBORNE_PHASES:
            return int(common.MAV_STATE_ACTIVE)
        return self._firmware.armed_state if self.armed else int(common.MAV_STATE_STANDBY)

    @property
    def mode(self) -> ModeNumbers:
        return self._firmware.modes[self._mode]

    @property
    def intended(self) -> ModeNumbers:
        return self._firmware.modes[self._intended]

    @property
    def landed(self) -> int:
        return int(LANDED[self.phase])

    @property
    def due(self) -> float:
        return self._looked + LOOKS_EVERY if self.armed else math.inf

    def take_texts(self) -> list[tuple[int, str]]:
        texts, self._texts = self._texts, []
        return texts

    def poll(self, now: float) -> None:
        self._looked = now
        t = now - self._epoch
        down = self._believed(t).position[2]
        if self.phase in AIRBORNE_PHASES and not self._drone.airborne:
            self._fire(PilotEvent.TOUCHED)
            self._quiet_since = self._drone.touched_s
        if self.phase is Phase.CLIMBING and down <= self._climbs_to + REACHED_M:
            self._fire(PilotEvent.REACHED)
            if self._firmware.takes_off_in is FlightMode.TAKE_OFF:
                self._mode = self._intended = FlightMode.HOLD
        self._fail_safe(now, t)
        patience = self._firmware.landed_s if self._drone.touched_s > -math.inf else self._firmware.idle_s
        if self.phase is Phase.IDLING and t - self._quiet_since > patience:
            self._fire(PilotEvent.DISARM)
            self._say(common.MAV_SEVERITY_INFO, "Disarming motors")

    def _fail_safe(self, now: float, t: float) -> None:
        """What it does by itself, whatever its pilot intends."""
        if self._located(now):
            self._located_at = now
        if self._mode is FlightMode.GUIDED and t - self._last_set_point > self._firmware.stream_s:
            self._say(common.MAV_SEVERITY_WARNING, "Failsafe activated: no set points")
            self._brake(FlightMode.POSITION, t)
        if now - self._located_at > self._blind_s and self._mode not in (FlightMode.LAND, FlightMode.BY_HAND):
            self._descend(t, "EKF failsafe: no position")
        if self._mode is FlightMode.RETURN and self.phase in (Phase.CLIMBING, Phase.FLYING):
            self._go_home(t)

    def return_home(self, now: float) -> None:
        """By a failsafe of its battery: up, to above its start, and down."""
        if self.phase not in (Phase.CLIMBING, Phase.FLYING):
            return
        self._say(common.MAV_SEVERITY_CRITICAL, "Battery failsafe: returns")
        self._mode, self._is_high = FlightMode.RETURN, False
        self._go_home(now - self._epoch)

    def _descend(self, t: float, why: str) -> None:
        if self._fire(PilotEvent.LAND):
            self._say(common.MAV_SEVERITY_CRITICAL, why)
            self._mode = FlightMode.LAND
            self._drone.command(t, SetPoint(LASTING_SETPOINT_T, velocity=(0.0, 0.0, LAND_SPEED)))

    def _go_home(self, t: float) -> None:
        here, home = self._believed(t).position, self._drone.start
        top = self._drone.ground - self._firmware.return_m
        self._is_high = self._is_high or here[2] < top + RETURNED_M
        if self._is_high and math.hypot(here[0] - home[0], here[1] - home[1]) < RETURNED_M:
            self._fire(PilotEvent.LAND)
            self._drone.command(t, SetPoint(LASTING_SETPOINT_T, velocity=(0.0, 0.0, LAND_SPEED)))
            return
        north, east = home[:2] if self._is_high else here[:2]
        self._fire(PilotEvent.STEER)
        above = SetPoint(LASTING_SETPOINT_T, position=(north, east, min(top, here[2])), yaw_rate=0.0)
        self._drone.command(t, _moved(above, self._errors.local))

    # ── commands ─────────────────────────────────────────────────────────────────────────────────────────────────────

    def command(self, command: Any, now: float) -> int | None:
        self.poll(now)
        t = now - self._epoch
        match command.command:
            case common.MAV_CMD_COMPONENT_ARM_DISARM:
                done = self._arm(t) if command.param1 == 1.0 else self._disarm()
            case common.MAV_CMD_DO_SET_MODE:
                return self.set_mode(self._custom_mode(command), now)
            case common.MAV_CMD_NAV_TAKEOFF:
                done = self._take_off(_last_parameter(command), t)
            case common.MAV_CMD_NAV_LAND:
                done = self._land(t)
            case common.MAV_CMD_CONDITION_YAW if self._firmware.autopilot != common.MAV_AUTOPILOT_PX4:
                done = self._turn(math.radians(command.param1), relative=command.param4 == 1.0, t=t)
            case common.MAV_CMD_DO_REPOSITION if command.get_type() == "COMMAND_INT":
                done = self._reposition(command, t)
            case _:
                return None
        return int(common.MAV_RESULT_ACCEPTED) if done else self._firmware.refused

    def move_sticks(self, now: float) -> None:
        """The pilot takes over: of PX4 that is the intention to fly by position."""
        if FlightMode.POSITION in self._firmware.modes:
            self._enter(FlightMode.POSITION, now - self._epoch)

    def switch_to(self, mode: FlightMode, now: float) -> bool:
        """By a switch on the transmitter; False: refused."""
        return self._enter(mode, now - self._epoch)

    def set_mode(self, custom: int, now: float) -> int:
        wanted = [mode for mode, numbers in self._firmware.modes.items() if numbers.custom == custom]
        done = bool(wanted) and self._enter(wanted[0], now - self._epoch)
        return int(common.MAV_RESULT_ACCEPTED) if done else self._firmware.refused

    def steer(self, message: Any, now: float) -> None:
        """Set points are listened to in guided flight only, but PX4 wants to hear them before it begins."""
        self.poll(now)
        t = now - self._epoch
        state, drone = self._believed(t), self._drone
        if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
            point, off = local_set_point(message, t, state, drone.start), self._errors.local
        else:
            point = global_set_point(message, t, state, self._origin, drone.start)
            off = self._off_on_earth(message.coordinate_frame)
        if point is None:
            return
        point = _moved(point, off)
        if t - self._last_set_point > RETURNS_S:
            self._streams_since = t
        self._last_set_point = t
        self._return(t)
        if self._mode is not FlightMode.GUIDED:
            return
        if point.yaw is None and point.yaw_rate is None and not self._firmware.nose:
            point = point._replace(yaw=state.yaw)
        if self.phase is Phase.IDLING and self._firmware.stream_s < math.inf and self._lifts(point):
            self._fire(PilotEvent.TAKE_OFF)
            drone.take_off(t, point)
        if self._fire(PilotEvent.STEER):
            drone.command(t, point)

    def _return(self, t: float) -> None:
        """Out of a failsafe, back into what is intended, as PX4 does once set points stream again."""
        failed = self._intended is FlightMode.GUIDED and self._mode is FlightMode.POSITION
        if failed and t - self._streams_since >= RETURNS_S:
            self._mode = FlightMode.GUIDED

    def _believed(self, t: float) -> Flown:
        """Its state, as its local frame has it."""
        state, (north, east, down) = self._drone.state(t), self._errors.local
        x, y, z = state.position
        return state._replace(
            position=(x + north, y + east, z + down), yaw=state.yaw + self._errors.heading(t)
        )

    def _off_on_earth(self, frame: int) -> Triple:
        """By how much it is off in a frame with latitude and longitude: heights above home are those of its local
        frame."""
        north, east, down = self._errors.earth
        return north, east, self._errors.local[2] if frame in ABOVE_HOME else down

    def _lifts(self, point: SetPoint) -> bool:
        if point.position is not None:
            return point.position[2] < self._drone.start[2] - LIFTS_M
        return point.velocity is not None and point.velocity[2] < -LIFTS_M_S

    def _custom_mode(self, command: Any) -> int:
        """PX4's come in two parameters, the main mode and the sub-mode."""
        if self._firmware.autopilot == common.MAV_AUTOPILOT_PX4:
            return int(command.param2) << 16 | int(command.param3) << 24
        return int(command.param2)

    def _arm(self, t: float) -> bool:
        if not self._located(t + self._epoch):
            return self._refuse("Arm: Need Position Estimate")
        if not self._ready(t + self._epoch):
            return self._refuse("Arm: waiting for the estimator")
        if self._mode in (FlightMode.LAND, FlightMode.RETURN):
            return self._refuse("Arm: mode not armable")
        if not self._fire(PilotEvent.ARM):
            return self.phase in AIRBORNE_PHASES  # it is armed already
        self._quiet_since = t
        self._say(common.MAV_SEVERITY_INFO, "Arming motors")
        if self._mode is FlightMode.TAKE_OFF:
            self._climb(t)
        return True

    def _disarm(self) -> bool:
        """Never in the air, not even by force: what falls teaches nobody to see."""
        if not self._fire(PilotEvent.DISARM):
            return self._refuse("Disarm: not landed")
        self._say(common.MAV_SEVERITY_INFO, "Disarming motors")
        return True

    def _enter(self, mode: FlightMode, t: float) -> bool:
        if mode is FlightMode.LAND:
            return self._land(t)
        if mode is FlightMode.TAKE_OFF:
            return self._take_off(math.nan, t)
        if mode is FlightMode.BY_HAND and self.phase in AIRBORNE_PHASES:
            return self._refuse("Mode change failed: no manual control")
        if mode is not FlightMode.BY_HAND and not self._located(t + self._epoch):
            return self._refuse(f"Mode change to {self._firmware.modes[mode].name} failed: requires position")
        if mode is FlightMode.GUIDED and t - self._last_set_point > self._firmware.stream_s:
            return self._refuse("Switching to Offboard is currently not available: no set points")
        self._intended = mode
        self._brake(mode, t)
        self._is_high = False
        return True

    def _brake(self, mode: FlightMode, t: float) -> None:
        """Enter a mode with what it begins with: in the air, to stop."""
        self._mode = mode
        if self._fire(PilotEvent.STEER):
            self._drone.command(t, SetPoint(LASTING_SETPOINT_T, velocity=NO_MOTION))

    def _take_off(self, height: float, t: float) -> bool:
        firmware, ground = self._firmware, self._drone.start[2]
        if self.phase in AIRBORNE_PHASES or not self._located(t + self._epoch):
            return False
        if firmware.takes_off_in is FlightMode.GUIDED and (
            self._mode is not FlightMode.GUIDED or self.phase is not Phase.IDLING
        ):
            return self._refuse("Take-off: arm in GUIDED first")
        if not math.isfinite(height):
            climb = firmware.take_off_m
        else:
            sea = self._origin.height - ground - self._errors.earth[2]
            climb = height - sea if firmware.above_sea else height
        if not climb > 0.0:
            return False
        self._climbs_to = ground - climb
        self._mode = self._intended = firmware.takes_off_in
        if self.phase is Phase.IDLING:
            self._climb(t)
        return True

    def _climb(self, t: float) -> None:
        """Straight up to the height that was asked for."""
        self._fire(PilotEvent.TAKE_OFF)
        north, east, _ = self._believed(t).position
        above = SetPoint(t, position=(north, east, self._climbs_to), yaw_rate=0.0)
        self._drone.take_off(t, _moved(above, self._errors.local))

    def _land(self, t: float) -> bool:
        self._mode = self._intended = FlightMode.LAND
        if self._fire(PilotEvent.LAND):
            self._drone.command(t, SetPoint(LASTING_SETPOINT_T, velocity=(0.0, 0.0, LAND_SPEED)))
        return True

    def _turn(self, angle: float, *, relative: bool, t: float) -> bool:
        if self._mode is not FlightMode.GUIDED or self.phase not in AIRBORNE_PHASES:
            return False
        self._drone.turn(t, self._believed(t).yaw + angle if relative else angle)
        return True

    def _reposition(self, command: Any, t: float) -> bool:
        """Go to a place on the Earth: ArduPilot in GUIDED, if the flags allow to change the mode; PX4 holds there."""
        guided = self._firmware.takes_off_in is FlightMode.GUIDED
        may = not guided or self._mode is FlightMode.GUIDED or int(command.param2) & CHANGE_MODE
        if command.frame not in (*ABOVE_SEA, *ABOVE_HOME) or self.phase not in AIRBORNE_PHASES or not may:
            return False
        home = self._drone.start if command.frame in ABOVE_HOME else None
        place = place_in_world(command.x, command.y, command.z, self._origin, home)
        self._mode = self._intended = FlightMode.GUIDED if guided else FlightMode.HOLD
        self._fire(PilotEvent.STEER)
        point = SetPoint(t, position=place, yaw=None if math.isnan(command.param4) else command.param4)
        self._drone.command(t, _moved(point, self._off_on_earth(command.frame)))
        return True

    # ── the table ────────────────────────────────────────────────────────────────────────────────────────────────────

    def _fire(self, event: PilotEvent) -> bool:
        """Go on by the table; False: nothing of that kind can happen now."""
        after = PHASE_TRANSITIONS.get((self.phase, event))
        if after is None:
            return False
        self.phase = after
        return True

    def _refuse(self, why: str) -> bool:
        self._say(common.MAV_SEVERITY_CRITICAL, why)
        return False

    def _say(self, severity: int, text: str) -> None:
        self._texts.append((severity, text))


def _moved(point: SetPoint, off: Triple) -> SetPoint:
    """Where a set point truly is, of who is off by so much in what it believes of its own position [m]."""
    if point.position is None:
        return point
    (x, y, z), (north, east, down) = point.position, off
    return point._replace(position=(x - north, y - east, z - down))


def _last_parameter(command: Any) -> float:
    """The seventh: a height."""
    return float(command.z if command.get_type() == "COMMAND_INT" else command.param7)
