"""What is known of a drone's network before anything is opened: for the check of a config and for doctor alike."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from swarmtrack.clock import Clock
from swarmtrack.config.drone import DroneConfig
from swarmtrack.diagnosis.surroundings import NetworkFacts
from swarmtrack.errors import KeysError, SwarmtrackError, TransportError
from swarmtrack.runtime.assembly import credentials_of
from swarmtrack.security.credentials import Credentials
from swarmtrack.transport.addresses import check_addresses

INTERFACES = Path("/sys/class/net")
IFF_UP, IFF_LOOPBACK, IFF_MULTICAST = 0x1, 0x8, 0x1000


def network_facts(config: DroneConfig, clock: Clock) -> tuple[NetworkFacts, Credentials | None]:
    """Keys, interfaces and addresses."""
    facts = NetworkFacts(config.drone.id, config.network.team)
    if config.is_alone:
        return replace(facts, in_process=True), None
    try:
        credentials = credentials_of(config, clock)
    except SwarmtrackError as error:
        text = str(error.__cause__ if isinstance(error.__cause__, KeysError) else error)
        return replace(facts, keys_refused=text), None
    if credentials is not None:
        left = credentials.expires.timestamp() - clock.utc()
        facts = replace(
            facts,
            expires_days=left / 86400.0,
            expires=datetime.fromtimestamp(credentials.expires.timestamp(), UTC).strftime("%Y-%m-%d %H:%M"),
        )
    if config.network.multicast:
        facts = replace(facts, multicast=_multicast(config.network.interface))
    try:
        check_addresses(config.network, secured=credentials is not None, drone_id=config.drone.id)
    except TransportError as error:
        facts = replace(facts, wrong_address=str(error))
    return facts, credentials


def _multicast(interface: str, folder: Path = INTERFACES) -> tuple[str, str]:
    """(interface, what is wrong with it or nothing)."""
    flags = {}
    for entry in folder.glob("*"):
        with contextlib.suppress(OSError, ValueError):
            flags[entry.name] = int((entry / "flags").read_text(encoding="ascii"), 16)
    if interface == "auto":
        usable = [n for n, f in flags.items() if f & IFF_UP and f & IFF_MULTICAST and not f & IFF_LOOPBACK]
        return ("auto", "" if usable else "no interface but loopback is up")
    if interface not in flags:
        return interface, f"no such interface, only {', '.join(sorted(flags)) or 'none'}"
    if not flags[interface] & IFF_UP:
        return interface, "it is down"
    return interface, "" if flags[interface] & IFF_MULTICAST else "it carries no multicast"
