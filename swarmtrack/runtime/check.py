"""`--check`: what an agent would do with a config, without doing it."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from swarmtrack.autopilot.address import parse_address as link_address
from swarmtrack.camera_sources.address import parse_address as camera_address
from swarmtrack.clock import SystemClock
from swarmtrack.config.camera_files import load_calibration
from swarmtrack.config.drone import CameraSection, DroneConfig, load_config, read_inputs
from swarmtrack.config.formation import fields_of_view
from swarmtrack.config.toml.layers import Problem, Table
from swarmtrack.config.toml.sections import key_text
from swarmtrack.diagnosis.findings import Finding, Level, fault
from swarmtrack.diagnosis.mounting import check_calibration, check_mount
from swarmtrack.diagnosis.sources import check_door
from swarmtrack.diagnosis.surroundings import (
    DetectorFacts,
    NetworkFacts,
    check_detector,
    check_disk,
    check_network,
)
from swarmtrack.errors import ConfigError, SwarmtrackError
from swarmtrack.formation.plan import FormationPlan, HalfView
from swarmtrack.outputs.destinations import check_outputs
from swarmtrack.outputs.formation_drawing import as_svg, as_text
from swarmtrack.runtime.assembly import Parts, assemble
from swarmtrack.runtime.disk_facts import disk_facts
from swarmtrack.runtime.mount_facts import mount_facts
from swarmtrack.runtime.network_facts import network_facts
from swarmtrack.security.credentials import Credentials
from swarmtrack.transport import topology
from swarmtrack.transport.settings import parse_endpoint

# What --check says of `autopilot.tell` beyond the harmless (docs/telling.md).
DANGERS = {
    "camera_tracking": "one box for all teammates; QGroundControl draws it only with a MAVLink camera that tracks, "
    "which the agent is not",
    "adsb": "an ArduPilot with ADSB_TYPE = 1 and AVD_ENABLE = 1 evades what it receives, and so does a PX4 with "
    "NAV_TRAFF_AVOID of 2 or more; positions that are not known in metres are the teammates' own reports, checked by "
    "the camera's direction only",
}

TURNS_BY = {
    "gyro": "by the gyro",
    "images": "by the first camera's images",
    "both": "by the gyro, and by the first camera's images where it is silent",
    "nothing": "never: the camera is assumed not to turn",
}
FLOWN = "enabled: its agent flies it while its pilot has it in GUIDED or OFFBOARD"
NOT_FLOWN = "not enabled: its agent only watches"


def check(path: Path) -> None:
    """`--check`: print what an agent would do with this config. Raises SwarmtrackError where it could not."""
    try:
        config = load_config(path)
        parts = assemble(config, SystemClock())
    except ConfigError as error:
        # These stop at the first table that cannot be read, or at the first part that cannot be made.
        more = sorted(problem for problem in _unusable(path) if str(problem) not in error.problems)
        raise ConfigError([*error.problems, *map(str, more)]) from error
    with config.blamed("output"):
        check_outputs(config.output.jsonl, config.output.video, len(config.cameras))
    link = config.autopilot.link
    print(f"drone      {config.drone.id} of team {config.network.team}")
    for number, section in enumerate(config.cameras):
        _print_camera(parts, number, section)
    if link in ("none", "sim"):
        print(f"autopilot  {'simulated' if parts.autopilot else 'none'}")
    else:
        autopilot = link_address(link)
        print(f"autopilot  {autopilot}{_absence(autopilot.path) if autopilot.scheme == 'serial' else ''}")
        heading = config.autopilot.heading_sigma_deg
        print(f"heading    ±{heading.ground:g}° on the ground, ±{heading.flight:g}° in flight")
        print(f"sending    {', '.join(config.autopilot.tell) or 'only a heartbeat'}")
    print(f"turns      {TURNS_BY[config.turn_from]}")
    detector = (
        "none: the camera detects by itself" if parts.detector is None else parts.detector.status().text
    )
    print(f"detector   {detector}")
    facts, credentials = network_facts(config, SystemClock())
    print(f"network    {_network(config, credentials)}")
    print(f"tracker    {config.tracker.name}")
    if config.team.drones:
        print(f"teammates  {_filed(config)}")
    if parts.agreed:
        print(f"agreed     {_agreed(config)}")
    if not config.team.announce:
        print("silent     nothing is sent to the team, nothing requested")
    plan = config.formation.plan()
    if plan is not None:
        print(f"formation  {_role(plan, config.drone.id)}")
        if config.drone.id != plan.leader:
            print(f"           {FLOWN if config.flies_in_formation else NOT_FLOWN}")
        print(textwrap.indent(as_text(plan, config.drone.id, _views(parts)), "           "))
    for finding in _findings(config, parts, facts):
        if finding.level in (Level.OK, Level.SKIPPED):
            continue
        print(f"warning: {finding.found}: {finding.remedy}")
    for word in config.autopilot.tell:
        if word in DANGERS:
            print(f"warning: autopilot.tell: {word}: {DANGERS[word]}")
    print(f"{path}: ok")


def _unusable(path: Path) -> Iterator[Problem]:
    """Addresses and files named in a config that can never work, each by itself, whatever else is wrong."""
    try:
        layers = read_inputs(path)
    except ConfigError:
        return
    for (table, entry), probe in PROBES.items():
        said = layers.table.get(table)
        tables = said if isinstance(said, list) else [said]
        for number, section in enumerate(tables):
            if not isinstance(section, dict) or not isinstance(section.get(entry), str):
                continue
            key = (table, number, entry) if len(tables) > 1 else (table, entry)
            try:
                probe(section)
            except SwarmtrackError as error:
                yield layers.problem(key, f"{key_text(key)}: {error}")


def _try_source(camera: Table) -> None:
    # Not above: a camera that detects by itself needs no OpenCV.
    from swarmtrack.camera_sources.opening import known_address  # noqa: PLC0415

    if not camera["source"].startswith("sim:"):
        known_address(camera["source"])


def _try_calibration(camera: Table) -> None:
    load_calibration(camera["calibration"], camera.get("calibration_camera"))


def _try_link(autopilot: Table) -> None:
    if autopilot["link"] != "sim":
        link_address(autopilot["link"])


PROBES: dict[tuple[str, str], Callable[[Table], None]] = {
    ("camera", "source"): _try_source,
    ("camera", "calibration"): _try_calibration,
    ("autopilot", "link"): _try_link,
}


def _print_camera(parts: Parts, number: int, section: CameraSection) -> None:
    """One of the cameras; of several also which, and where it looks."""
    camera, lens = camera_address(section.source), parts.lenses[number]
    name = "camera" if len(parts.lenses) == 1 else f"camera {number + 1}"
    print(f"{name:10} {camera}{_absence(camera.target) if camera.scheme == 'v4l2' else ''}")
    print(f"lens       {lens.width} x {lens.height} px, f = {lens.fx:.1f}, {lens.fy:.1f} px")
    if section.calibration is not None:
        for note in load_calibration(section.calibration, section.calibration_camera).notes:
            print(f"           {note}")
    if len(parts.lenses) > 1:
        ahead, right, down = parts.door.perceived.cameras[number].body_from_camera.rotation[:, 2]
        azimuth, up = math.degrees(math.atan2(right, ahead)), -math.degrees(math.asin(down))
        # Nothing is a negative nothing.
        azimuth, up = round(azimuth) + 0, round(up) + 0
        way = f"{azimuth:+d}° from the nose, clockwise, {up:+d}° up"
        print(f"looks      {way}, known to {section.mounting_sigma_deg:g}°")


def _findings(config: DroneConfig, parts: Parts, facts: NetworkFacts) -> list[Finding]:
    """What doctor would find in the config alone, and in this machine."""
    start = config.drone.start
    several = len(config.cameras) > 1
    findings = [
        replace(each, found=f"camera {number}: {each.found}") if several else each
        for number, section in enumerate(config.cameras, start=1)
        for each in _doubts(section, several=several)
    ]
    findings += check_door(config.autopilot.link, signed=config.autopilot.signing_key is not None)
    if start.has_unknown_sigma:
        findings.append(fault("pose.unmeasured", sigma_m=start.position_sigma_m))
    findings += check_network(facts) + check_disk(disk_facts(config))
    if parts.detector is not None:
        findings += check_detector(
            DetectorFacts(providers=config.detector.providers, runs_on=parts.detector.providers)
        )
    return findings


def _doubts(section: CameraSection, *, several: bool) -> list[Finding]:
    """What is unlikely in the numbers of a lens and of its mounting. several: it is one of many cameras."""
    if section.simulated:
        return []
    facts = mount_facts(section, None)
    return [*check_calibration(facts), *check_mount(facts, several=several)]


def draw_formation(path: Path) -> str:
    """The formation of a config as SVG. Raises SwarmtrackError, also where there is none."""
    config = load_config(path)
    plan = config.formation.plan()
    if plan is None:
        raise ConfigError(
            [config.problem(("formation", "leader"), "found none, expected a formation to draw")]
        )
    parts = assemble(config, SystemClock())
    return as_svg(plan, config.drone.id, _views(parts))


def _views(parts: Parts) -> list[HalfView]:
    return fields_of_view((each.lens, each.body_from_camera) for each in parts.door.perceived.cameras)


def _role(plan: FormationPlan, drone_id: int) -> str:
    if drone_id == plan.leader:
        return f"leads drones {', '.join(map(str, plan.followers))}: flown by its pilot, never by its agent"
    references = " and ".join(map(str, plan.references[drone_id]))
    return f"follows drone {plan.leader}, finds its slot by drone {references}"


def _network(config: DroneConfig, credentials: Credentials | None) -> str:
    """Where the agent listens and what it dials."""
    if config.network.transport == "memory":
        return "none: what is sent stays in this process"
    settings = topology.of_drone(config.network, config.drone.id, credentials)
    if settings.rendezvous:
        return "this machine only"
    said = [f"{settings.mode}, {'without' if credentials is None else 'with'} keys"]
    if settings.listen:
        said.append(f"listens on {', '.join(map(_own, dict.fromkeys(map(_shown, settings.listen))))}")
    if settings.connect:
        said.append(f"dials {', '.join(dict.fromkeys(map(_shown, settings.connect)))}")
    return "; ".join(said)


def _shown(endpoint: str) -> str:
    """Host of an endpoint; the rest is as in the config."""
    return parse_endpoint(endpoint, "network").host


def _own(host: str) -> str:
    return host if topology.is_here(host) else f"{host} (not an address of this machine now)"


def _filed(config: DroneConfig) -> str:
    """What the team's file says of the others."""
    said = []
    for drone_id, filed in config.team.drones.items():
        if int(drone_id) == config.drone.id:
            continue
        place = (
            "somewhere"
            if filed.position_m is None
            else f"{list(filed.position_m)} ±{filed.position_sigma_m:g} m"
        )
        said.append(f"{drone_id} at {place}")
    return ", ".join(said).replace("at somewhere", "somewhere") or "none"


def _agreed(config: DroneConfig) -> str:
    """How the others move without saying it."""
    code, plan = config.team.code, config.team.plan
    said = [f"codes at {begin.isoformat()}" for begin in (code.begins if code else ())]
    return ", ".join([*said, *([f"{plan.file} at {plan.begins.isoformat()}"] if plan else [])])


def _absence(device: str) -> str:
    """A device that may be plugged in later is no mistake, but worth a word."""
    return "" if Path(device).exists() else "   (not there now: it is waited for)"
