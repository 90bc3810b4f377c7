"""Random stories of a PX4, its pilot and its agent, in told time: nobody is flown again but by the pilot's intention.

What PX4 does without its agent, and with it again, is modelled here apart from `swarmtrack.lab.world`, as it was seen
on a live one: it leaves OFFBOARD when it hears nothing, keeps the intention, and goes back when it is streamed to.
"""

from collections import deque
from dataclasses import dataclass, field

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.engagement import PilotEngagement
from swarmtrack.autopilot.limits import AGENT_STOOD_STILL_S
from swarmtrack.autopilot.pilot_switch import PilotSwitch
from swarmtrack.mavlink_dialect import CurrentMode

PX4 = common.MAV_AUTOPILOT_PX4
OFFBOARD, HOLD, POSITION = 6 << 16, 4 << 16 | 3 << 24, 3 << 16
STEP_S, LOSS_S, RETURNS_S = 0.1, 1.0, 0.5


@dataclass
class Story:
    """owed: something has failed, and the pilot's intention has not left OFFBOARD since; asked: mode or switch was off
    since the last engagement. Both are the truth of the PX4 and its pilot, not what the agent believes."""

    with_switch: bool
    reads_first: bool
    t: float = 100.0
    intention: int = HOLD
    mode: int = HOLD
    armed: bool = True
    airborne: bool = True
    switch_on: bool = False
    heard_at: float = 0.0
    streams_s: float = 0.0
    owed: bool = True
    asked: bool = True
    engagements: int = 0
    waiting: deque = field(default_factory=deque)
    engagement: PilotEngagement | None = None

    def start(self):
        switch = PilotSwitch(7, 1700.0) if self.with_switch else None
        self.engagement, self.owed = PilotEngagement(switch), True

    def act(self, what):
        match what:
            case "asks for OFFBOARD" if self.streams_s >= RETURNS_S:
                self.intention = self.mode = OFFBOARD
            case "asks for HOLD":
                self.intention = self.mode = HOLD
            case "moves the sticks" if self.airborne:
                self.intention = self.mode = POSITION
            case "throws the switch":
                self.switch_on = not self.switch_on
            case "lands":
                self.airborne = self.armed = False
            case "arms":
                self.armed = True
            case "takes off" if self.armed:
                self.airborne = True
            case "fails" if self.engagement:
                self.engagement.fail("no decision")
                self.owed = True
            case "kills the agent":
                self.engagement = None
            case "starts the agent" if self.engagement is None:
                self.start()
        self.speak()

    def speak(self):
        base = common.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | common.MAV_MODE_FLAG_SAFETY_ARMED * self.armed
        beat = common.MAVLink_heartbeat_message(
            common.MAV_TYPE_QUADROTOR, PX4, base, self.mode, common.MAV_STATE_ACTIVE, 3
        )
        us = 1900 if self.switch_on else 1100
        channels = common.MAVLink_rc_channels_message(0, 8, *[1500] * 6, us, *[1500] * 11, 255)
        self.waiting += [
            (self.t, beat, self.airborne),
            (self.t, CurrentMode(0, self.mode, self.intention), self.airborne),
            (self.t, channels, self.airborne),
        ]

    def read(self):
        while self.waiting:
            t, message, airborne = self.waiting.popleft()
            match message.get_type():
                case "HEARTBEAT":
                    self.engagement.on_heartbeat(t, message, PX4, airborne=airborne)
                case "CURRENT_MODE":
                    self.engagement.on_current_mode(t, message)
                case "RC_CHANNELS":
                    self.engagement.on_channels(t, message)

    def pass_time(self, seconds, *, frozen=False):
        begun = self.t
        for k in range(round(seconds / STEP_S)):
            self.t += STEP_S
            self._fly()
            if k % 2 == 0:
                self.speak()
            if self.engagement is None:
                self.waiting.clear()
            elif not frozen:
                self._live()
        if frozen and self.t - begun > AGENT_STOOD_STILL_S:
            self.owed = True

    def _fly(self):
        if self.t - self.heard_at > LOSS_S and self.mode == OFFBOARD and self.armed:
            self.mode, self.owed = POSITION, True
            self.speak()
        if self.t - self.heard_at > RETURNS_S:
            self.streams_s = 0.0
        if self.intention == OFFBOARD and self.mode == POSITION and self.streams_s >= RETURNS_S:
            self.mode = OFFBOARD
            self.speak()

    def _live(self):
        engagement = self.engagement
        before = engagement.number
        parts = [self.read, lambda: engagement.tick(self.t)]
        for part in parts if self.reads_first else parts[::-1]:
            part()
        # The agent has heard it: what was owed is paid.
        self.owed = self.owed and self.intention == OFFBOARD
        self.asked |= self.intention != OFFBOARD or (self.with_switch and not self.switch_on)
        if engagement.number > before:
            self.engagements += 1
            assert engagement.number == before + 1
            assert self.asked, "engaged, and neither mode nor switch had been off"
            self.asked = self.intention != OFFBOARD
        if self.owed:
            assert not engagement.engaged, "flown after a failure without a change of the intention"
            assert not engagement.wants_stream, (
                "streamed to after a failure without a change of the intention"
            )
        if engagement.engaged or engagement.wants_stream:
            self.heard_at = self.t
            self.streams_s += STEP_S


SECONDS = st.floats(0.1, 6.0)
PILOT = (
    "asks for OFFBOARD", "asks for OFFBOARD", "asks for HOLD", "moves the sticks", "throws the switch", "lands", "arms",
    "takes off", "fails", "kills the agent", "starts the agent", "starts the agent",
)  # fmt: skip
CHAPTERS = st.lists(
    st.one_of(
        st.tuples(st.sampled_from(PILOT), SECONDS),
        st.tuples(st.just("freezes the agent"), SECONDS),
    ),
    max_size=30,
)


FAILURES = ("fails", "freezes the agent", "kills the agent")
ENGAGED = [("throws the switch", 1.0), ("asks for OFFBOARD", 2.0)]


def tell(chapters, **options):
    story = Story(**options)
    story.start()
    story.pass_time(2.0)
    for what, seconds in ENGAGED:
        story.act(what)
        story.pass_time(seconds)
    assert story.engagement.engaged
    for what, seconds in chapters:
        frozen = what == "freezes the agent"
        story.act(what)
        story.pass_time(seconds, frozen=frozen)
        if frozen:
            story.pass_time(1.0)
    return story


@settings(max_examples=300, deadline=None)
@given(
    failure=st.tuples(st.sampled_from(FAILURES), SECONDS),
    then=CHAPTERS,
    with_switch=st.booleans(),
    reads_first=st.booleans(),
)
def test_whatever_fails_nobody_is_flown_or_streamed_to_until_the_intention_has_left_the_mode(
    failure, then, with_switch, reads_first
):
    tell([failure, *then], with_switch=with_switch, reads_first=reads_first)


@pytest.mark.parametrize("with_switch", [False, True])
@pytest.mark.parametrize("failure", FAILURES)
def test_in_these_stories_a_pilot_who_leaves_the_mode_and_comes_again_is_flown_again(failure, with_switch):
    waits = [(failure, 3.0), ("starts the agent", 4.0)]
    again = [("asks for HOLD", 2.0), ("asks for OFFBOARD", 2.0)]
    assert tell(waits, with_switch=with_switch, reads_first=True).engagements == 1
    assert tell(waits + again, with_switch=with_switch, reads_first=True).engagements == 2
