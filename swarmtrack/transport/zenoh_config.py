"""Zenoh's own config of one session. Unknown entries are errors at `open`, so a typing mistake here cannot hide."""

from __future__ import annotations

import json
from typing import Any

import zenoh

from swarmtrack.security.credentials import Credentials
from swarmtrack.transport.access_control import access_control
from swarmtrack.transport.limits import (
    CLIENT_CONNECT_MS,
    CLIENT_HANDSHAKE_MS,
    DATAGRAM_KEEP_ALIVES_PER_LEASE,
    HANDSHAKE_MS,
    KEEP_ALIVES_PER_LEASE,
    MAX_LINKS_PER_PAIR,
    MAX_ZENOH_BYTES,
)
from swarmtrack.transport.settings import ENCRYPTED, Mode, NetworkSettings


def zenoh_config(network: NetworkSettings, listen: tuple[str, ...], connect: tuple[str, ...]) -> zenoh.Config:
    """Config for `zenoh.open`; only at loopback's well-known ports is a taken port an error at once."""
    # Of two that learn of each other by gossip one dials, else they dial twice. Who cannot be dialled must dial.
    autoconnect = {"to_router": "always", "to_peer": "greater-zid" if listen else "always"}
    is_client = network.mode == Mode.CLIENT
    config: dict[str, Any] = {
        "mode": network.mode,
        "listen": {
            "endpoints": listen,
            "exit_on_failure": network.rendezvous,
            "timeout_ms": 0 if network.rendezvous else -1,  # for ever: an interface may come up yet
            "retry": {"period_init_ms": 500, "period_max_ms": 2000, "period_increase_factor": 2},
        },
        "connect": {
            "endpoints": connect,
            # For ever, in the background: a peer that is away may come back. A client does so once it was connected.
            "timeout_ms": CLIENT_CONNECT_MS if is_client else -1,
            "exit_on_failure": is_client,
            # Who takes over a meeting point is met after one period. Loopback refuses at once and for free.
            "retry": {
                "period_init_ms": 100,
                "period_max_ms": 250 if network.rendezvous else 500,
                "period_increase_factor": 2,
            },
        },
        # Do not wait for links: whoever comes later is no special case.
        "open": {"return_conditions": {"connect_scouted": False, "declares": False}},
        "scouting": {
            "delay": 100,
            "multicast": {
                "enabled": network.multicast,
                "interface": network.interface,
                "autoconnect_strategy": {"peer": autoconnect},
            },
            # Where everybody's address is known, hearsay could only lead to dialling twice.
            "gossip": {"enabled": not network.expected, "autoconnect_strategy": {"peer": autoconnect}},
        },
        "timestamping": {"enabled": True},
        "queries_default_timeout": 2000,
        "transport": {
            "unicast": {
                "open_timeout": CLIENT_HANDSHAKE_MS if is_client else HANDSHAKE_MS,
                "accept_timeout": HANDSHAKE_MS,
            },
            "shared_memory": {"enabled": False},  # nothing to gain at our sizes, and it hides lost links
            "link": _link(network),
        },
    }
    if network.credentials is not None:
        config["transport"]["unicast"]["max_links"] = MAX_LINKS_PER_PAIR
        config["transport"]["link"] |= {"protocols": list(ENCRYPTED), "tls": _tls(network.credentials)}
        config["access_control"] = access_control(network.credentials.roster)
    return zenoh.Config.from_json5(json.dumps(config))


def _link(network: NetworkSettings) -> dict[str, Any]:
    """Leases, keep-alives and the size limit of one link."""
    keep_alives = DATAGRAM_KEEP_ALIVES_PER_LEASE if network.credentials else KEEP_ALIVES_PER_LEASE
    return {
        "tx": {"lease": round(network.lease_s * 1000), "keep_alive": keep_alives},
        "rx": {"max_message_size": MAX_ZENOH_BYTES},
    }


def _tls(credentials: Credentials) -> dict[str, Any]:
    """Both ends show a certificate of the team's CA, or there is no link."""
    key, certificate = str(credentials.key), str(credentials.certificate)
    return {
        "root_ca_certificate": str(credentials.ca),
        "enable_mtls": True,
        "listen_private_key": key,
        "listen_certificate": certificate,
        "connect_private_key": key,
        "connect_certificate": certificate,
        # Who it is matters, not where: certificates hold no addresses, which change from field to field.
        "verify_name_on_connect": False,
        "close_link_on_expiration": True,
    }
