"""One drone's place in a formation: its command from what it sees. Pure: no clock, no input, no output.

Theory of operation. A command has five parts, in this order:

1. Holds. The own autopilot, camera or team may report a state in which it must not fly: then the drone stops.
2. The law (`law.py`) gives a level velocity from the trusted references (`references.py`). When the last of them is
   lost, the last command fades; then the drone holds, and never searches.
3. The height is that of the slot, held by the own autopilot's. Where that is vague, the height above the references as
   measured counts instead. Right after engaging it comes first: a drone that flies
   level through other drones' heights meets them where no camera looks.
4. The command changes by no more than the acceleration allows. The barrier (`barrier.py`) then bends it away from every
   track, named or not, and the fence bends it inwards; a step of theirs is not slowed down. No evasion leads beyond the
   fence, nor farther than `LED_MOST_ASIDE_M` from the slot (`Berth`), nor out of the own height: a drone to the side is
   out of sight, and kept apart by heights alone.
5. The first camera turns to the references, and to where they were last expected.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from swarmtrack.formation.barrier import (
    HalfSpace,
    binding,
    excess,
    fence,
    layer,
    leash,
    nearest_velocity,
    sidestep,
    stepped,
)
from swarmtrack.formation.divergence import DivergenceWatch
from swarmtrack.formation.escape import FreeHeights, room, way_out, who_collides
from swarmtrack.formation.heights import HeightWatch
from swarmtrack.formation.law import SeenReference, added, displacement, saturated, towards, turn_rate
from swarmtrack.formation.margins import (
    AT_HEIGHT_M,
    BARRIERS_CONTRADICT_M_S,
    COMING_SPEED_M_S,
    COMING_WITHIN_S,
    COMMAND_FADED_S,
    COMMAND_FADES_S,
    ESCAPE_GAIN_PER_S,
    FARTHEST_SEEN_M,
    FASTEST_OWN_SPEED_M_S,
    HEADING_SETTLES_S,
    HEIGHT_CORRECTED_SIGMAS,
    HEIGHT_GAIN_PER_S,
    LATE_INPUT_LASTS_S,
    LED_BACK_WITHIN_S,
    LED_MOST_ASIDE_M,
    LONGEST_TIME_STEP_S,
    OLDEST_GYRO_S,
    OLDEST_POSE_S,
    OLDEST_SCAN_S,
    REFERENCE_DOUBTED_PROBABILITY,
    SIDESTEP_SPEED_M_S,
    VAGUEST_OWN_HEIGHT_M,
    VAGUEST_OWN_PLACE_M,
    YAW_GAIN_PER_S,
)
from swarmtrack.formation.obstacles import Obstacle, obstacles
from swarmtrack.formation.out_of_sight import OutOfSight
from swarmtrack.formation.parameters import FlightLimits, FormationParameters
from swarmtrack.formation.references import ReferenceWatch
from swarmtrack.formation.setpoint import NO_SWAY, STANDSTILL, OwnFlight, Setpoint, Velocity, Why
from swarmtrack.formation.squeezed import best_of, least_closing, no_faster_than_asked
from swarmtrack.messages import IdentifiedTrack, RelativeState, TrackStatus

# What a busy computer or link delays for a moment: only where it lasts `LATE_INPUT_LASTS_S` it costs the references
# their trust.
LATE_INPUTS = (Why.OWN_POSE, Why.VAGUE, Why.GYRO, Why.CAMERA)

# Where one of these holds it, what the autopilot says of its velocity is not how it flies.
MOVES_UNKNOWN = (Why.OWN_POSE, Why.VAGUE, Why.CLOCK, Why.HEADING)

HOLD_TEXTS = {
    Why.OWN_POSE: "own position is old",
    Why.VAGUE: f"own position error exceeds {VAGUEST_OWN_PLACE_M:g} m",
    Why.HEIGHT_VAGUE: f"own height error exceeds {VAGUEST_OWN_HEIGHT_M:g} m, and no reference's is measured",
    Why.GYRO: "gyro is silent",
    Why.CAMERA: "camera is silent or stuck",
    Why.CLASH: "another process uses this drone's ID",
    Why.DOUBT: "own start or heading seems wrong",
    Why.HEADING: "heading has stepped",
    Why.CLOCK: "autopilot's clock is unknown",
    Why.HEIGHT_DOUBT: "own height seems wrong",
    Why.DIVERGES: "does not fly as commanded",
    Why.BROKEN: "its command is not a number",
}


class Berth(NamedTuple):
    """Where a drone belongs for now: position in the team frame [m] and velocity [m/s] of its slot, or where it
    began to hold. slack [m]: its distance from the slot while no drone was in its way.
    """

    place: Velocity
    velocity: Velocity = STANDSTILL
    slack: float = 0.0
    holds: bool = False


class SlotFlight(NamedTuple):
    """Level velocity to fly [m/s]; distance and vector to the slot, level [m]; and the slot's velocity [m/s]."""

    wanted: Velocity
    error: Velocity
    velocity: Velocity

    @property
    def arrives(self) -> float:
        """Approximate time until it is in its slot, s."""
        north, east, _ = (wanted - along for wanted, along in zip(self.wanted, self.velocity, strict=True))
        return math.hypot(*self.error) / max(math.hypot(north, east), 1e-3)


class Formation:
    """Takes what is seen and how the drone flies; `command` returns what to fly. `engage` begins each flight."""

    def __init__(self, parameters: FormationParameters) -> None:
        self.parameters = parameters
        self._watches = [ReferenceWatch(drone_id, parameters.sure) for drone_id in parameters.references]
        self.engage()

    def engage(self) -> None:
        """Begin a flight, from rest: the fence is centred on the drone's position at the next command."""
        for watch in self._watches:
            watch.engage()
        self._t: float | None = None
        self._engaged_at: Velocity | None = None
        self._at_height = False
        self._heights = HeightWatch(self.parameters.references)
        self._correction = 0.0
        """m: by how much the own height is taken to exceed the true one."""
        self._divergence = DivergenceWatch()
        self._escapes = False
        """Whether it may be out of its height, since somebody was about to collide with it."""
        self._berth: Berth | None = None
        self._bent_at = -math.inf
        self._flown = STANDSTILL
        self._followed = STANDSTILL
        self._followed_at = -math.inf
        self._yaw_rate = 0.0
        self._out_of_sight = OutOfSight()
        self._late_since: float | None = None
        """Since when it stands for nothing but what came late."""

    def command(
        self,
        relative_states: Mapping[int, RelativeState],
        own: OwnFlight,
        tracks: Sequence[IdentifiedTrack],
        t: float,
    ) -> Setpoint:
        """What to fly from t [s] on. relative_states: by track, of all whose range is known, named or not, at t."""
        dt = self._step_to(t)
        if not own.is_possible:
            self._forget()
            return self._brake(t, dt, Why.OWN_POSE)
        states = _usable(relative_states)
        trusted = self._trusted(states, own, tracks, t)
        self._watch_heights(own, tracks, t)
        why = _forbidden(own, self._cameras(own), height_known=self._corrects_height(own))
        if self._lasts(why, t):
            self._forget()
        doubt = self._watched(own, why, t)
        if why in (Why.OWN_POSE, Why.VAGUE, Why.GYRO):
            return self._brake(t, dt, why)
        if self._engaged_at is None:
            self._engaged_at = own.position
        error = slot = None
        if why is not None:
            wanted, text = STANDSTILL, HOLD_TEXTS[why]
        elif doubt is not None:
            wanted, (why, text) = STANDSTILL, doubt
        elif trusted:
            slot = self._law(trusted, states, own)
            wanted, error = slot.wanted, math.hypot(*slot.error)
            self._divergence.follow(t, slot.error, slot.velocity)
            why, text = Why.FOLLOW, f"{error:.1f} m off its slot"
        else:
            wanted, why, text = self._alone(t)
        wanted, why, text = self._with_height(wanted, own, why, text)
        limits = self.parameters.limits
        slewed = towards(self._flown, saturated(wanted, limits.speed), limits.acceleration * dt)
        if not _are_numbers(slewed):
            return self._brake(t, dt, Why.BROKEN)
        if why is Why.FOLLOW:
            self._followed, self._followed_at = slewed, t
        self._berth = self._berthed(slot, own, t)
        near = self._in_the_way(states, own, tracks, t)
        escape = self._escape(near, slewed, own)
        velocity, clear_of = self._bent(
            slewed, near, own, dt, aside=_aside(near, wanted, slot), up_or_down=escape
        )
        yaw_rate = self._turned(own, t, dt) if why is not Why.HEADING else 0.0
        if not _are_numbers((*velocity, yaw_rate)):
            return self._brake(t, dt, Why.BROKEN)
        self._flown, self._yaw_rate = velocity, yaw_rate
        if velocity != slewed:
            self._bent_at = t
        if clear_of:
            text += ", keeps clear"
        nearest = min((other.nearest for other in near), default=None)
        return Setpoint(t, velocity, yaw_rate, why, text, error, clear_of, nearest)

    def _step_to(self, t: float) -> float:
        """s since the last command; 0 where time does not go on."""
        before, self._t = self._t, t
        passed = 0.0 if before is None else t - before
        return min(passed, LONGEST_TIME_STEP_S) if passed > 0.0 else 0.0

    # ── whom to fly by ───────────────────────────────────────────────────────────────────────────────────────────────

    def _trusted(
        self,
        states: Mapping[int, RelativeState],
        own: OwnFlight,
        tracks: Sequence[IdentifiedTrack],
        t: float,
    ) -> list[tuple[int, int]]:
        """Drone and track of the references that may be flown by."""
        bearers: dict[int, list[IdentifiedTrack]] = {watch.drone_id: [] for watch in self._watches}
        for entry in tracks:
            if isinstance(entry.identity, int) and entry.identity in bearers:
                bearers[entry.identity].append(entry)
        trusted = []
        for watch in self._watches:
            named = bearers[watch.drone_id]
            state = states.get(named[0].track.id) if len(named) == 1 else None
            if state is None or state.drone_id != watch.drone_id:
                watch.restart()
                continue
            watch.observe(named[0], state, own, t)
            if watch.trusted and _is_new(own.scan_ages[named[0].track.camera]):
                trusted.append((watch.drone_id, named[0].track.id))
        return trusted

    def _cameras(self, own: OwnFlight) -> Sequence[int]:
        """Those that saw the references last; any, of those that nobody has seen."""
        seen_by = [watch.camera for watch in self._watches if watch.camera is not None]
        return seen_by or range(len(own.scan_ages))

    def _lasts(self, why: Why | None, t: float) -> bool:
        """Whether what holds it is more than a moment's delay."""
        if why not in LATE_INPUTS:
            self._late_since = None
            return why is not None
        if self._late_since is None:
            self._late_since = t
        return t - self._late_since >= LATE_INPUT_LASTS_S

    def _forget(self) -> None:
        """What holds a drone costs its references their trust: it goes on once they have been sure for a while. What
        came late for a moment does not."""
        for watch in self._watches:
            watch.restart()
        self._followed_at = -math.inf

    def _watch_heights(self, own: OwnFlight, tracks: Sequence[IdentifiedTrack], t: float) -> None:
        if own.is_carried:
            return
        # What drifts contradicts the name's place, and costs it some of what made it sure.
        sure = {
            entry.identity
            for entry in tracks
            if isinstance(entry.identity, int)
            and entry.identity_probability
            > (REFERENCE_DOUBTED_PROBABILITY if self._heights.knows(entry.identity) else self.parameters.sure)
        }
        self._heights.add_sights((sight for sight in own.height_sights if sight.drone_id in sure), t)

    def _corrects_height(self, own: OwnFlight) -> bool:
        """Whether the own height is known, by itself or above the references; `_correction` is its error."""
        p = self.parameters
        if own.height_sigma <= VAGUEST_OWN_HEIGHT_M:
            self._correction = 0.0
            return True
        correction = self._heights.correction({drone: p.height - p.slots[drone][2] for drone in p.references})
        if correction is None or not abs(correction) <= HEIGHT_CORRECTED_SIGMAS * own.height_sigma:
            return False
        self._correction = correction
        return True

    def _watched(self, own: OwnFlight, why: Why | None, t: float) -> tuple[Why, str] | None:
        """What the last seconds tell against flying on, whatever holds the drone now. It costs nobody's name."""
        # A carried velocity is not known well enough to contradict a command.
        usable = why not in MOVES_UNKNOWN and not own.is_carried
        self._divergence.add_sample(t, self._flown, own.velocity, usable=usable)
        # Nor is its height a barometer's, that could drift.
        height = None if own.is_carried else self._heights.doubt
        watches = (Why.HEIGHT_DOUBT, height), (Why.DIVERGES, self._divergence.doubt(t))
        return next(((doubt, text) for doubt, text in watches if text is not None), None)

    # ── the law ──────────────────────────────────────────────────────────────────────────────────────────────────────

    def _law(
        self, trusted: list[tuple[int, int]], states: Mapping[int, RelativeState], own: OwnFlight
    ) -> SlotFlight:
        """To the slot, and along with the references."""
        p = self.parameters
        seen = []
        for drone_id, track_id in trusted:
            state = states[track_id]
            error = state.position - p.wanted(drone_id)
            seen.append(SeenReference(error, state.velocity + own.velocity, state.cov))
        (north, east, _), along = displacement(seen)
        x, y, _ = saturated((p.gain * north, p.gain * east, 0.0), p.approach)
        level = along[0], along[1], 0.0
        return SlotFlight(
            saturated((x + along[0], y + along[1], 0.0), p.limits.speed), (north, east, 0.0), level
        )

    def _berthed(self, slot: SlotFlight | None, own: OwnFlight, t: float) -> Berth:
        """Of one that holds, it stays where it was when that began: else it would be led away step by step."""
        if slot is None:
            before = self._berth
            return before if before is not None and before.holds else Berth(own.position, holds=True)
        slack = math.hypot(*slot.error)
        before = self._berth
        if before is not None and not before.holds and 0.0 <= t - self._bent_at < LED_BACK_WITHIN_S:
            slack = min(slack, before.slack)
        return Berth(added(own.position, slot.error), slot.velocity, slack)

    def _alone(self, t: float) -> tuple[Velocity, Why, str]:
        """Without a reference: the last command fades, then the drone holds."""
        lost_for = t - self._followed_at
        names = " and ".join(str(watch.drone_id) for watch in self._watches)
        if 0.0 <= lost_for < COMMAND_FADED_S:
            north, east, _ = self._followed
            flown, followed = math.hypot(*self._flown[:2]), math.hypot(north, east)
            # Who had to brake meanwhile does not speed up again.
            share = min(math.exp(-lost_for / COMMAND_FADES_S), flown / followed if followed > flown else 1.0)
            return (share * north, share * east, 0.0), Why.FADE, f"drone {names} is lost: slows down"
        entering = [watch.drone_id for watch in self._watches if watch.entering]
        if entering:
            return STANDSTILL, Why.ENTRY, f"drone {entering[0]} is in view, not for long enough"
        return STANDSTILL, Why.NO_REFERENCE, f"drone {names} is not in view"

    def _with_height(
        self, wanted: Velocity, own: OwnFlight, why: Why, text: str
    ) -> tuple[Velocity, Why, str]:
        """The slot's height beside the level velocity, and the sway of its code about it; the height alone until the
        drone has come to it."""
        sways = own.sways if self._at_height else NO_SWAY
        off = self._slot_down() + sways.down - own.position[2]
        climb = self.parameters.limits.climb
        down = min(max(HEIGHT_GAIN_PER_S * off + sways.speed, -climb), climb)
        if not self._at_height:
            self._at_height = abs(off) < AT_HEIGHT_M
        if why in HOLD_TEXTS:
            return wanted, why, text
        if not self._at_height:
            return (
                (0.0, 0.0, down),
                Why.HEIGHT,
                f"{'descends' if off > 0.0 else 'climbs'} {abs(off):.1f} m first",
            )
        return (wanted[0], wanted[1], down), why, text

    # ── limits ───────────────────────────────────────────────────────────────────────────────────────────────────────

    def _bent(
        self,
        velocity: Velocity,
        near: Sequence[Obstacle],
        own: OwnFlight,
        dt: float,
        *,
        aside: Velocity,
        up_or_down: Velocity,
    ) -> tuple[Velocity, tuple[int, ...]]:
        """Away from everybody who is near, and within the fence; and of whom it had to keep clear. aside: a step out
        of their way, up_or_down: and out of their height."""
        limits, here = self.parameters.limits, self._engaged_at
        assert here is not None
        spaces = fence(
            own.position,
            here,
            radius=limits.fence_radius,
            lowest=min(lowest(limits, own), here[2] + limits.fence_height),
            highest=here[2] - limits.fence_height,
            pull=limits.climb,
        )
        clear = [other.to_keep_clear(self.parameters) for other in near]
        held = list(spaces)
        goal = velocity
        if near:
            height = self._layer(own, here)
            goal = nearest_velocity(added(added(velocity, aside), up_or_down), spaces + clear + height)
            held += height
            if self._berth is not None:
                berth = self._berth
                held += leash(own.position, berth.place, berth.velocity, LED_MOST_ASIDE_M + berth.slack)
        # What nobody is led beyond: where the barrier wants it otherwise, these have the last word.
        goal = nearest_velocity(goal, held)
        bent = self._limited(goal, held)
        if excess(bent, clear) > BARRIERS_CONTRADICT_M_S:
            closing = [other.not_to_close_in(self.parameters) for other in near]
            if excess(goal, clear) > BARRIERS_CONTRADICT_M_S or excess(bent, closing) > max(
                excess(STANDSTILL, closing), 0.0
            ):
                bent = self._squeezed(bent, near, closing, clear, held, up_or_down=up_or_down)
        step = stepped(self._flown, bent, limits.evasion * dt, held)
        return self._at_most(step), binding(velocity, spaces + clear)

    def _escape(self, near: Sequence[Obstacle], flies: Velocity, own: OwnFlight) -> Velocity:
        """m/s, up or down, where somebody is about to collide."""
        collides = who_collides(near, flies)
        # Until nobody is near any more: a height that is left is not fetched back in front of somebody.
        self._escapes = collides is not None or (self._escapes and bool(near))
        if collides is None:
            return STANDSTILL
        return way_out(collides, own.position[2], self._room(own), self.parameters.limits.climb)

    def _limited(self, velocity: Velocity, held: Sequence[HalfSpace]) -> Velocity:
        """held: floor and ceiling first."""
        north, east, down = velocity
        most_down, most_up = (space.bound for space in held[:2])
        return self._at_most((north, east, min(max(down, -most_up), most_down)))

    def _at_most(self, velocity: Velocity) -> Velocity:
        """The nearest that climbs and flies no faster than allowed."""
        limits = self.parameters.limits
        north, east, down = velocity
        return saturated((north, east, min(max(down, -limits.climb), limits.climb)), limits.speed)

    def _squeezed(
        self,
        compromise: Velocity,
        near: Sequence[Obstacle],
        closing: Sequence[HalfSpace],
        clear: Sequence[HalfSpace],
        held: Sequence[HalfSpace],
        *,
        up_or_down: Velocity,
    ) -> Velocity:
        """Where not everybody can be kept clear of: as if this drone stood, with a step aside from those who come."""
        limits = self.parameters.limits
        # Nobody is drawn back within the fence, or to its slot, into another.
        may = [space._replace(bound=max(space.bound, 0.0)) for space in held]
        climb = [HalfSpace((0.0, 0.0, sense), limits.climb) for sense in (1.0, -1.0)]
        aside = added(_aside(near, STANDSTILL), up_or_down)
        least = least_closing(aside, closing, may + climb, limits.speed)
        least = self._limited(nearest_velocity(least, may), may)
        return best_of((no_faster_than_asked(least, clear), least, compromise, STANDSTILL), closing)

    def _room(self, own: OwnFlight) -> FreeHeights:
        """Of heights, to escape to."""
        p = self.parameters
        others = [self._slot_down(drone) for drone in p.slots if drone != p.drone_id]
        return room(self._slot_down() + own.sways.down, others)

    def _slot_down(self, drone_id: int | None = None) -> float:
        """Height of a drone's slot, by default the own, as the own autopilot has it: m, down in the team frame."""
        p = self.parameters
        return p.slots[p.drone_id if drone_id is None else drone_id][2] - p.height - self._correction

    def _layer(self, own: OwnFlight, engaged: Velocity) -> list[HalfSpace]:
        """Out of its slot's height nobody is led by whom it keeps clear of; nor, until the drone is there, off the way
        to it from where it was engaged. Whoever was about to collide may have left it, a little."""
        sways = own.sways if self._at_height else NO_SWAY
        slot = self._slot_down() + sways.down
        if self._escapes and self._at_height:
            free = self._room(own)
            least, most = min(free.highest, slot - AT_HEIGHT_M), max(free.lowest, slot + AT_HEIGHT_M)
            return layer(own.position[2], least, most, speed=sways.speed, gain=ESCAPE_GAIN_PER_S)
        begun = slot if self._at_height else engaged[2]
        least, most = min(slot, begun) - AT_HEIGHT_M, max(slot, begun) + AT_HEIGHT_M
        return layer(own.position[2], least, most, speed=sways.speed, gain=HEIGHT_GAIN_PER_S)

    def _in_the_way(
        self,
        states: Mapping[int, RelativeState],
        own: OwnFlight,
        tracks: Sequence[IdentifiedTrack],
        t: float,
    ) -> list[Obstacle]:
        """Confirmed tracks whose distance is known, named or not; and who has just left the picture."""
        seen = {
            entry.track.id: states[entry.track.id]
            for entry in tracks
            if entry.track.status is not TrackStatus.TENTATIVE and entry.track.id in states
        }
        everybody = self._out_of_sight.states(seen, own, t) | seen
        return obstacles(everybody, own, self.parameters.clearance)

    # ── the view ─────────────────────────────────────────────────────────────────────────────────────────────────────

    def _turned(self, own: OwnFlight, t: float, dt: float) -> float:
        """rad/s: towards the references, where they are, were last expected, or should be."""
        north = east = 0.0
        for watch in self._watches:
            direction = watch.direction(own, t)
            if direction is None:
                x, y, _ = self.parameters.wanted(watch.drone_id)
                away = math.hypot(x, y)
                direction = (x / away, y / away) if away > 1e-3 else (0.0, 0.0)
            north, east = north + direction[0], east + direction[1]
        limits = self.parameters.limits
        wanted = 0.0
        if math.hypot(north, east) > 1e-3:
            wanted = turn_rate(math.atan2(east, north) - own.heading, YAW_GAIN_PER_S, limits.yaw_rate)
        return self._slewed_rate(wanted, dt)

    def _slewed_rate(self, wanted: float, dt: float) -> float:
        most = self.parameters.limits.yaw_acceleration * dt
        return self._yaw_rate + min(max(wanted - self._yaw_rate, -most), most)

    def _brake(self, t: float, dt: float, why: Why) -> Setpoint:
        """To a stop, by nothing but the last command."""
        self._flown = towards(self._flown, STANDSTILL, self.parameters.limits.acceleration * dt)
        self._yaw_rate = self._slewed_rate(0.0, dt)
        return Setpoint(t, self._flown, self._yaw_rate, why, HOLD_TEXTS[why])


def _aside(near: Sequence[Obstacle], wanted: Velocity, slot: SlotFlight | None = None) -> Velocity:
    """m/s: out of the way of those who come. To whom is retreating from them nobody comes: what counts is what would be
    flown if nobody were in the way. To those who stand, as the slot does, this drone comes no nearer than its slot is:
    on its way there it does not turn about one who stands behind it."""
    aside = STANDSTILL
    for other in near:
        north, east, down = (flies - wants for flies, wants in zip(other.velocity, wanted, strict=True))
        lasts = COMING_WITHIN_S
        if slot is not None and max(map(_level_speed, (other.velocity, slot.velocity))) < COMING_SPEED_M_S:
            lasts = slot.arrives
        aside = added(aside, sidestep(other.place, (north, east, down), lasts))
    return saturated(aside, SIDESTEP_SPEED_M_S)


def _level_speed(velocity: Velocity) -> float:
    return math.hypot(velocity[0], velocity[1])


def _forbidden(own: OwnFlight, cameras: Sequence[int], *, height_known: bool) -> Why | None:
    """Why this drone may not fly by what it sees; None where it may. Of several reasons the gravest. cameras: one of
    these has to be alive."""
    # Who doubts its start says that it knows its place to a kilometre: its autopilot still knows how it moves.
    vague = not own.doubted and not own.position_sigma <= VAGUEST_OWN_PLACE_M
    reasons = (
        (not own.pose_age <= OLDEST_POSE_S, Why.OWN_POSE),
        (vague, Why.VAGUE),
        (not own.gyro_age <= OLDEST_GYRO_S, Why.GYRO),
        (not own.clock_known, Why.CLOCK),
        (own.clash, Why.CLASH),
        (not own.heading_step_age >= HEADING_SETTLES_S, Why.HEADING),
        (own.doubted, Why.DOUBT),
        (not any(_is_new(own.scan_ages[camera]) for camera in cameras), Why.CAMERA),
        (not height_known, Why.HEIGHT_VAGUE),
    )
    return next((why for holds, why in reasons if holds), None)


def lowest(limits: FlightLimits, own: OwnFlight) -> float:
    """Floor, m, down: the least height, by the own autopilot or above the ground that the range finder measures,
    whichever is higher.
    """
    if own.ground is None or not 0.0 <= own.ground < FARTHEST_SEEN_M:
        return -limits.least_height
    return min(0.0, own.position[2] + own.ground) - limits.least_height


def _is_new(scan_age: float) -> bool:
    """Whether what a camera shows tells of now."""
    return scan_age <= OLDEST_SCAN_S


def _usable(states: Mapping[int, RelativeState]) -> dict[int, RelativeState]:
    """Those that a drone could have."""
    if not states:
        return {}
    told = states.values()
    place, speed = np.array([state.position for state in told]), np.array([state.velocity for state in told])
    cov = np.array([state.cov for state in told])
    with np.errstate(over="ignore", invalid="ignore"):
        far, fast, wide = (
            (place * place).sum(axis=1),
            (speed * speed).sum(axis=1),
            (cov * cov).sum(axis=(1, 2)),
        )
    # NaN fails every comparison.
    usable = (far > 1e-4) & (far < FARTHEST_SEEN_M**2) & (fast < FASTEST_OWN_SPEED_M_S**2) & (wide < math.inf)
    usable &= (cov.diagonal(axis1=1, axis2=2) >= 0.0).all(axis=1)
    return {
        track: state for (track, state), is_one in zip(states.items(), usable.tolist(), strict=True) if is_one
    }


def _are_numbers(values: Sequence[float]) -> bool:
    return all(map(math.isfinite, values))
