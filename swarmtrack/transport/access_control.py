"""Zenoh's access control, the same in every process of the team: which keys each name may use.

Every receiver filters by the name in the certificate at the other end of the link. A drone publishes below its own ID
only, monitors subscribe and query, routers forward everything. A name that is not in the roster may neither send nor
receive.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Final

from swarmtrack.security import names
from swarmtrack.security.roster import Roster
from swarmtrack.transport import keys

ASKING: Final = ("declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber")
SPEAKING: Final = ("put", "delete", "reply", "declare_queryable", "liveliness_token")


def access_control(roster: Roster) -> dict[str, Any]:
    """Zenoh's `access_control` section. Incoming messages are permitted by the sender's name, outgoing ones by the
    team only.
    """
    everything = keys.key(roster.team, "**")
    rules = [
        _rule("send", "egress", (*ASKING, *SPEAKING), everything),
        _rule("ask", "ingress", ASKING, everything),
        _rule("relay", "ingress", SPEAKING, everything),
        *(
            _rule(names.drone(i), "ingress", SPEAKING, keys.key(roster.team, "*", i, "**"))
            for i in sorted(roster.drones)
        ),
    ]
    allowed: Mapping[str, Iterable[str]] = {
        **{name: ("send", "ask", name) for name in map(names.drone, sorted(roster.drones))},
        **dict.fromkeys(roster.monitors, ("send", "ask")),
        **dict.fromkeys(roster.routers, ("send", "ask", "relay")),
    }
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": name, "cert_common_names": [name]} for name in allowed],
        "policies": [{"rules": list(rules), "subjects": [name]} for name, rules in allowed.items()],
    }


def _rule(name: str, flow: str, messages: Iterable[str], key_expression: str) -> dict[str, Any]:
    return {
        "id": name,
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": [key_expression],
        "permission": "allow",
    }
