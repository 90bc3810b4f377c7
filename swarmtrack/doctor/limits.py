"""The autopilot's own limits, read over its link by `config check --autopilot` and doctor."""

from __future__ import annotations

import asyncio
from contextlib import suppress

from swarmtrack.autopilot.address import is_recording
from swarmtrack.autopilot.mavlink_autopilot import MavlinkAutopilot
from swarmtrack.autopilot.parameters import ParameterReader
from swarmtrack.clock import Clock
from swarmtrack.config.drone import DroneConfig
from swarmtrack.diagnosis.autopilot_limits import Asked, asked_of, check_limits, unheard
from swarmtrack.diagnosis.findings import Finding, skipped
from swarmtrack.doctor.sample_collector import SampleCollector
from swarmtrack.runtime.assembly import make_autopilot
from swarmtrack.sources import Autopilot

# s: at most; a heartbeat comes each second, and what is not told is asked for four times.
DOCTOR_WITHIN_S = 6.0


def limits_reader(config: DroneConfig, autopilot: Autopilot | None) -> ParameterReader | None:
    """Reader of the limits of a follower's autopilot, active once it runs; None where there is nothing to read."""
    follows = config.formation.parameters(config.drone.id) is not None
    if not follows or not isinstance(autopilot, MavlinkAutopilot) or is_recording(config.autopilot.link):
        return None
    reader = ParameterReader(asked_of)
    autopilot.read_parameters(reader)
    return reader


def judged(config: DroneConfig, told: ParameterReader) -> list[Finding]:
    """Findings on the values that a reader got, given the formation."""
    place = config.formation.parameters(config.drone.id)
    return [] if place is None else check_limits(told.kind, told.values, Asked(place.limits, -place.down))


async def read_limits(config: DroneConfig, clock: Clock, seconds: float = DOCTOR_WITHIN_S) -> list[Finding]:
    """Read the limits for a drone with a slot in a formation; nothing is written to its autopilot."""
    if config.formation.parameters(config.drone.id) is None:
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
