"""Readiness of an agent to fly, from its counters: the checks of doctor that cost nothing. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from swarmtrack.diagnosis.findings import Finding, Level, fault, of_camera
from swarmtrack.diagnosis.sources import AutopilotFacts, CameraFacts, check_autopilot, check_camera
from swarmtrack.messages import LinkStatus

MOST_REASONS = 8
LONGEST_REASON = 256  # characters, as the wire takes them
CERTIFICATE_S = 3600.0  # no flight is longer

SELF_DOUBT = "sightings of teammates contradict our own start or heading"


class Readiness(NamedTuple):
    """reasons: why not, one sentence each; where ready, further remarks."""

    ready: bool
    reasons: tuple[str, ...]


def judge(
    *,
    cameras: Sequence[CameraFacts],
    autopilot: AutopilotFacts,
    detector: LinkStatus | None,
    network: LinkStatus,
    clones: tuple[str, ...] = (),
    doubts_itself: bool = False,
    unmeasured_m: float | None = None,
) -> Readiness:
    """Failures count, warnings do not; the one about an unmeasured start is reported.

    clones: boots of other agents that speak as this drone. doubts_itself: what it sees does not fit its own pose.
    unmeasured_m: the sigma [m] that the start is taken to have; None where it was written.
    """
    findings: list[Finding] = []
    for number, camera in enumerate(cameras):
        found = check_camera(camera)
        if len(cameras) > 1:
            # Which one does not stand in its sentence.
            named = [of_camera(number, finding) for finding in found]
            found = [replace(finding, found=f"{finding.check}: {finding.found}") for finding in named]
        findings += found
    if autopilot.wanted:
        findings += check_autopilot(autopilot)
    reasons = [finding.found for finding in findings if finding.level is Level.FAILURE]
    reasons += [
        f"{name}: {status.text}"
        for name, status in (("detector", detector), ("network", network))
        if status is not None and not status.ok
    ]
    left_s = dict(network.counters).get("certificate_s", math.inf)
    if left_s < CERTIFICATE_S:
        reasons.append(
            f"network: our certificate ends in {max(left_s, 0.0) / 60.0:.0f} min, and all links with it: renew it"
        )
    if clones:
        reasons.append(f"another agent uses this drone's ID (boots {', '.join(clones)})")
    if doubts_itself:
        reasons.append(f"{SELF_DOUBT}: check drone.start, the compass and camera.body_from_camera")
    ready = not reasons
    if unmeasured_m is not None:
        reasons.append(fault("pose.unmeasured", sigma_m=unmeasured_m).found)
    return Readiness(ready, tuple(reason[:LONGEST_REASON] for reason in reasons[:MOST_REASONS]))
