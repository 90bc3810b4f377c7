"""What is known of how a camera sits: for the check of a config and for doctor alike."""

from __future__ import annotations

from swarmtrack.config.drone import CameraSection
from swarmtrack.diagnosis.mounting import MountFacts
from swarmtrack.errors import CalibrationError
from swarmtrack.runtime.assembly import mount
from swarmtrack.sources import SimulatedSources


def mount_facts(section: CameraSection, simulation: SimulatedSources | None) -> MountFacts:
    """Lens and mounting as the config has them, or why they cannot be had."""
    sits = section.body_from_camera
    try:
        mounted = mount(section, simulation)
    except CalibrationError as error:
        return MountFacts(None, str(error))
    return MountFacts(mounted, rpy_deg=None if sits is None or simulation is not None else sits.rpy_deg)
