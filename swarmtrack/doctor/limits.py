"""The autopilot's own parameters, read over its link by `config check --autopilot` and doctor."""

from __future__ import annotations

import asyncio
from contextlib import suppress

from swarmtrack.autopilot.address import is_recording
from swarmtrack.autopilot.mavlink_autopilot import MavlinkAutopilot
from swarmtrack.autopilot.parameters import ParameterReader
from swarmtrack.clock import Clock
from swarmtrack.config.drone import DroneConfig
from swarmtrack.diagnosis.autopilot_feed import asked_of_feed, check_feed
from swarmtrack.diagnosis.autopilot_limits import Asked, asked_of, check_limits, unheard
from swarmtrack.diagnosis.findings import Finding, skipped
from swarmtrack.doctor.sample_collector import SampleCollector
from swarmtrack.runtime.assembly import make_autopilot
from swarmtrack.sources import Autopilot

# s: at most; a heartbeat comes each second, and what is not told is asked for four times.
DOCTOR_WITHIN_S = 6.0


def _wanted(config: DroneConfig) -> tuple[bool, bool]:
    """Whether its limits matter, and whether it is fed."""
    return config.formation.parameters(config.drone.id) is not None, config.autopilot.feed != "none"


def limits_reader(config: DroneConfig, autopilot: Autopilot | None) -> ParameterReader | None:
    """Reader of the parameters of an autopilot that is flown or fed, active once it runs; None where there is nothing
    to read."""
    follows, is_fed = _wanted(config)
    if not (follows or is_fed) or not isinstance(autopilot, MavlinkAutopilot):
        return None
    if is_recording(config.autopilot.link):
        return None

    def names(kind: int) -> tuple[str, ...]:
        return (asked_of(kind) if follows else ()) + (asked_of_feed(kind) if is_fed else ())

    reader = ParameterReader(names)
    autopilot.read_parameters(reader)
    return reader


def judged(config: DroneConfig, told: ParameterReader) -> list[Finding]:
    """Findings on the values that a reader got, given formation and feed."""
    place = config.formation.parameters(config.drone.id)
    limits = [] if place is None else check_limits(told.kind, told.values, Asked(place.limits, -place.down))
    return limits + (check_feed(told.kind, told.values) if _wanted(config)[1] else [])


async def read_limits(config: DroneConfig, clock: Clock, seconds: float = DOCTOR_WITHIN_S) -> list[Finding]:
    """Read the parameters for a drone with a slot in a formation, or that is fed; nothing is written to its
    autopilot."""
    if not any(_wanted(config)):
        return [skipped("limits", "this drone follows no other: only its pilot flies it")]
    autopilot = make_autopilot(config, clock, None)
    reader = limits_reader(config, autopilot)
    if autopilot is None or reader is None:
        return [skipped("limits", f"autopilot.link is {config.autopilot.link}: no autopilot to ask")]
    listening = asyncio.create_task(autopilot.run(SampleCollector()))
    try:
        with suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await reader.done()
    finally:
        listening.cancel()
        await asyncio.gather(listening, return_exceptions=True)
    if reader.kind is None:
        reason = f"{autopilot.status().text}; no heartbeat within {seconds:g} s"
        return unheard(reason)
    return judged(config, reader)
