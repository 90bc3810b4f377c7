"""Consistency of the configs of one team: each may be valid by itself, and the drones still not receive each other."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

from swarmtrack.config.drone import DroneConfig

SAME_START_M = 0.1  # m: nearer than this two drones do not stand beside each other


class Common(NamedTuple):
    """An entry that must be the same for the whole team."""

    key: tuple[str, str]
    of: Callable[[DroneConfig], object]


def _filed(config: DroneConfig) -> tuple[str, ...]:
    """Who starts where, by the team's file."""
    return tuple(
        f"{drone_id} at {filed.position_m}, {filed.yaw_deg:g} degrees, ±{filed.position_sigma_m} m"
        for drone_id, filed in sorted(config.team.drones.items())
    )


def _formation(config: DroneConfig) -> tuple[str, ...]:
    """Who leads, who follows by whom, and every slot."""
    plan = config.formation.plan()
    if plan is None:
        return ()
    slots = [f"{drone} at {list(plan.slots[drone])} by {plan.references[drone]}" for drone in plan.followers]
    return (f"behind {plan.leader}, {plan.height:g} m high", *slots)


COMMON = (
    Common(("network", "team"), lambda config: config.network.team),
    Common(("network", "topology"), lambda config: config.network.topology),
    Common(("network", "peers"), lambda config: config.network.peers),
    Common(("network", "routers"), lambda config: config.network.routers),
    Common(("team", "origin"), lambda config: config.team.origin),
    Common(("team", "announce"), lambda config: config.team.announce),
    Common(("team", "drones"), _filed),
    Common(("formation", "slots"), _formation),
)


def contradictions(configs: Sequence[DroneConfig]) -> list[str]:
    """Sentences `FILE:LINE: key: found, expected`, each of the later of two files that do not fit together."""
    problems = []
    for first, other in combinations(configs, 2):
        problems += _of_two(first, other)
    if len(configs) > 1:
        problems += [
            config.problem(
                ("network", "transport"), '"memory" stays within one process, expected "zenoh" for a team'
            )
            for config in configs
            if config.is_alone and config.team.announce
        ]
    return list(dict.fromkeys(problems))


def doubts(configs: Sequence[DroneConfig]) -> list[str]:
    """Sentences on what is unlikely, but possible: drones of a team are mostly built alike."""
    angles: dict[str, list[int]] = {}
    for config in configs:
        for camera in config.cameras[:1]:
            if camera.guessed_angle_deg is not None:
                angles.setdefault(f"{camera.guessed_angle_deg:.0f}°", []).append(config.drone.id)
    if len(angles) < 2:
        return []
    each = "; ".join(f"{angle} of drone {', '.join(map(str, ids))}" for angle, ids in angles.items())
    return [
        f"the guessed lenses differ: {each}; with equal cameras, write one guess into all of them, or measure them "
        "with `swarmtrack calibrate intrinsics`"
    ]


def _of_two(first: DroneConfig, other: DroneConfig) -> list[str]:
    problems = []
    who = f"drone {first.drone.id}"
    if first.drone.id == other.drone.id:
        text = (
            f"{other.drone.id}, which another of these files is too, expected one that is unique in the team"
        )
        return [other.problem(("drone", "id"), text)]
    for common in COMMON:
        mine, theirs = common.of(other), common.of(first)
        if mine != theirs:
            text = f"{_shown(mine)}, expected {_shown(theirs)} as in {who}"
            problems.append(other.problem(common.key, text))
    problems += _of_keys(first, other)
    here, there = _start(other), _start(first)
    if here is not None and there is not None and math.dist(here, there) < SAME_START_M:
        text = f"{_shown(here)}, where {who} starts too, expected a place of its own"
        problems.append(other.problem(("drone", "start", "position_m"), text))
    return problems


def _of_keys(first: DroneConfig, other: DroneConfig) -> list[str]:
    ours, theirs = other.network.keys_of(other.drone.id), first.network.keys_of(first.drone.id)
    key, who = ("network", "keys"), f"drone {first.drone.id}"
    if (ours is None) != (theirs is None):
        found, expected = ("none", "keys") if ours is None else (_shown(str(ours)), "none")
        return [
            other.problem(
                key, f"{found}, expected {expected} as {who} has: with and without, they do not link"
            )
        ]
    if ours is None or theirs is None or _authority(ours) == _authority(theirs):
        return []
    return [
        other.problem(key, f"{_shown(str(ours))} is of another CA than the keys of {who}, expected the same")
    ]


def _authority(folder: Path) -> bytes | None:
    try:
        return (folder / "ca.pem").read_bytes()
    except OSError:
        return None


def _start(config: DroneConfig) -> tuple[float, float, float] | None:
    """Where it says it stands, if it says so itself."""
    simulated = config.camera.simulated and "start" not in config.drone.model_fields_set
    return None if simulated or config.drone.start.source is not None else config.drone.start.position_m


def _shown(value: object) -> str:
    if value is None or value in ((), {}):
        return "nothing"
    if isinstance(value, tuple):
        return f"[{', '.join(map(str, value))}]"
    return f'"{value}"' if isinstance(value, str) else str(value)
