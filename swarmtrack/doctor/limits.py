"""The autopilot's own limits, asked for over its link: what `config check --autopilot` says."""

from __future__ import annotations

import asyncio
from contextlib import suppress

from swarmtrack.clock import Clock
from swarmtrack.config import DroneConfig
from swarmtrack.diagnosis.autopilot_limits import Asked, asked_of, check_limits, unheard
from swarmtrack.diagnosis.findings import Finding, skipped
from swarmtrack.doctor.watching import SampleCollector
from swarmtrack.runtime.assembly import make_autopilot
from swarmtrack.sensors.mavlink.address import is_recording
from swarmtrack.sensors.mavlink.autopilot import MavlinkAutopilot
from swarmtrack.sensors.mavlink.parameters import ParameterReader

# s: at most; a heartbeat comes each second, and what is not told is asked for four times.
WITHIN_S = 6.0


async def read_limits(config: DroneConfig, clock: Clock, seconds: float = WITHIN_S) -> list[Finding]:
    """Of a drone that has a place in a formation; nothing is written to its autopilot."""
    place = config.formation.parameters(config.drone.id)
    if place is None:
        return [skipped("limits", "this drone follows nobody: nobody but its pilot flies it")]
    if is_recording(config.autopilot.link):
        return [skipped("limits", f"{config.autopilot.link} is a recording: nobody to be asked")]
    autopilot = make_autopilot(config, clock, None)
    if not isinstance(autopilot, MavlinkAutopilot):
        return [skipped("limits", f"autopilot.link is {config.autopilot.link}: nobody to be asked")]
    reader = ParameterReader(asked_of)
    autopilot.read_parameters(reader)
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
    return check_limits(reader.kind, reader.values, Asked(place.limits, -place.down))
