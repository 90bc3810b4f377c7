"""`swarmtrack healthy`: whether an agent does its work, by the file it writes its health to. For health checks.

Imports nothing heavy: it runs every few seconds, next to the agent, on a small computer.
"""

from __future__ import annotations

import argparse
import json
from typing import Any

from swarmtrack.arguments import add_file, add_seconds
from swarmtrack.clock import SystemClock
from swarmtrack.errors import SourceError
from swarmtrack.runtime.health_file import ENVIRONMENT, health_path

HEALTHY, UNHEALTHY = 0, 1
NETWORKS = ("zenoh", "memory")  # links to the team: a drone out of its reach is alone, and does its work


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Check that an agent is healthy: its health file is recent, so is its newest tracked frame, and camera, "
        "autopilot and detector work. Exit code 0: healthy. 1: not healthy, with the reason. 2: wrong usage."
    )
    add_file(parser, "file", f"output.health of the agent's config (default: ${ENVIRONMENT})", nargs="?")
    add_seconds(
        parser,
        "--max-age",
        "age from which the health file means a hung or ended agent (default: %(default)g)",
        default=5.0,
    )
    add_seconds(
        parser,
        "--max-frame-age",
        "time without a tracked frame from which the agent is unhealthy (default: %(default)g)",
        default=10.0,
    )


def run(args: argparse.Namespace) -> int:
    """Raises SourceError where no file is named."""
    path = health_path(args.file)
    if path is None:
        raise SourceError(f"no FILE, and no ${ENVIRONMENT}, expected output.health of the agent's config")
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        troubles = find_troubles(
            record, SystemClock().now(), max_age_s=args.max_age, max_frame_age_s=args.max_frame_age
        )
        links = [f"{link['name']}: {link['text']}" for link in record["health"]["links"] if link["ok"]]
        drone_id = int(record["drone_id"])
    except OSError as error:
        print(f"unhealthy: {path}: {error.strerror}; is the agent running, and does it write there?")
        return UNHEALTHY
    except (ValueError, KeyError, TypeError):
        print(f"unhealthy: {path}: is not an agent's health, expected its output.health")
        return UNHEALTHY
    if troubles:
        print(f"unhealthy: drone {drone_id}: {'; '.join(troubles)}")
        return UNHEALTHY
    print(f"healthy: drone {drone_id}: {'; '.join(links)}")
    return HEALTHY


def find_troubles(
    record: dict[str, Any], now: float, *, max_age_s: float, max_frame_age_s: float
) -> list[str]:
    """What is wrong with the agent that wrote this; now [s]: monotonic. Raises KeyError, TypeError: no agent did."""
    age, frame_age = now - record["written_monotonic_s"], record["frame_age_s"]
    if not 0.0 <= age <= max_age_s:
        said = f"{age:.0f} s ago" if age >= 0.0 else "before this machine was started"
        return [f"last written {said}, expected within {max_age_s:g} s"]
    health = record["health"]
    troubles = [
        f"{link['name']}: {link['text']}"
        for link in health["links"]
        if not link["ok"] and link["name"] not in NETWORKS
    ]
    blind_s = health["uptime_s"] if frame_age is None else frame_age
    if blind_s > max_frame_age_s:
        troubles.append(
            f"no frame was tracked for {blind_s:.0f} s, expected one within {max_frame_age_s:g} s"
        )
    return troubles
