"""Examination of one drone: facts gathered concurrently, findings in the order of repair."""

from __future__ import annotations

import asyncio
from contextlib import suppress

import numpy as np

from swarmtrack.clock import Clock
from swarmtrack.config.drone import DroneConfig, MountedCamera
from swarmtrack.diagnosis import mounting, sources, surroundings
from swarmtrack.diagnosis.findings import Finding, of_camera, skipped
from swarmtrack.diagnosis.surroundings import DetectorFacts
from swarmtrack.doctor import machine, team
from swarmtrack.doctor.limits import judged
from swarmtrack.doctor.watching import SensorWatch
from swarmtrack.errors import ModelError, SwarmtrackError
from swarmtrack.messages import Frame, StampKind
from swarmtrack.runtime.assembly import make_simulation
from swarmtrack.runtime.disk_facts import disk_facts
from swarmtrack.runtime.mount_facts import mount_facts
from swarmtrack.runtime.perception import make_detector

TIMED_FRAMES = 8
NETWORK_SECONDS = 5.0  # at most: whoever is there has answered by then


async def examine(config: DroneConfig, clock: Clock, seconds: float) -> list[Finding]:
    """Examine for so many seconds. Raises SwarmtrackError only for a simulation that does not exist."""
    simulation = make_simulation(config, clock)
    mounts = [mount_facts(section, simulation) for section in config.cameras]
    network = asyncio.create_task(team.ask(config, clock, min(seconds, NETWORK_SECONDS)))
    watch = SensorWatch(config, [facts.mounted for facts in mounts], clock, simulation)
    watched = await watch.run(seconds)
    several = len(mounts) > 1

    def named(number: int, found: list[Finding]) -> list[Finding]:
        return [of_camera(number, finding) for finding in found] if several else found

    findings = []
    for number, (facts, seen) in enumerate(zip(mounts, watched.cameras, strict=True)):
        found = [] if facts.mounted is None else sources.check_camera(seen.facts)
        found += mounting.check_calibration(facts)
        if facts.mounted is not None:
            found += mounting.check_mount(facts, several=several)
        findings += named(number, found)
    findings += sources.check_autopilot(watched.autopilot)
    findings += sources.check_door(config.autopilot.link, signed=config.autopilot.signing_key is not None)
    if watch.limits is not None:
        findings += judged(config, watch.limits)
    if watched.autopilot.wanted and not watched.autopilot.refused:
        findings += sources.check_imu(watched.imu)
        findings += sources.check_pose(watched.pose)
    for number, (facts, seen) in enumerate(zip(mounts, watched.cameras, strict=True)):
        findings += named(number, mounting.check_motion(seen.motion, facts.mounted))
    rates = [dict(seen.facts.status.counters).get("fps") for seen in watched.cameras if seen.facts.status]
    fps = sum(rate for rate in rates if rate is not None) if any(rates) else next(iter(rates), None)
    newest = next((seen.newest for seen in watched.cameras if seen.newest is not None), None)
    detector = await asyncio.to_thread(detector_facts, config, clock, mounts[0].mounted, newest, fps)
    findings += surroundings.check_detector(detector)
    heard = await network
    findings += surroundings.check_network(heard)
    findings += surroundings.check_tracks(heard)
    findings += surroundings.check_disk(disk_facts(config))
    findings += surroundings.check_heat(await asyncio.to_thread(machine.heat))
    missing = [
        of_camera(number, skipped("camera", text)) if several else skipped("camera", text)
        for number, facts in enumerate(mounts)
        if facts.mounted is None
        for text in ["not opened without a calibration"]
    ]
    return [*missing, *findings]


def detector_facts(
    config: DroneConfig,
    clock: Clock,
    mounted: MountedCamera | None,
    newest: Frame | None,
    fps: float | None,
) -> DetectorFacts:
    """Load it, and have it look at the newest frame, or at a grey one."""
    wanted = not config.camera.detects_by_itself
    providers = config.detector.providers
    try:
        detector = make_detector(config, clock)
    except ModelError as error:
        return DetectorFacts(wanted, str(error), providers=providers)
    if detector is None:
        return DetectorFacts(wanted=False)
    if newest is None:
        size = (480, 640) if mounted is None else (mounted.camera.height, mounted.camera.width)
        newest = Frame(0.0, 0.0, 0, np.full((*size, 3), 128, np.uint8), StampKind.MEDIA)
    with suppress(SwarmtrackError):
        detector.warm_up(newest.image.shape[1], newest.image.shape[0])
    for _ in range(TIMED_FRAMES):
        detector.detect(detector.plan(newest))
    latency = detector.latency
    ms = 1e3 * (latency.pre.p50 + latency.infer.p50 + latency.post.p50)
    return DetectorFacts(True, "", detector.path.name, providers, detector.providers, ms, fps)
