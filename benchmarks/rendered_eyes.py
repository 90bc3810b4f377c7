"""What drones of a virtual swarm see in drawn pictures, with the detector of an agent."""

from __future__ import annotations

from swarmtrack.benchmarks.clip_frames import detected
from swarmtrack.benchmarks.virtual_swarm import Exposure, Eyes
from swarmtrack.clock import SystemClock
from swarmtrack.config.drone import DetectorSection
from swarmtrack.detection.expectation import PerceivedExpectation
from swarmtrack.lab.scenarios.scenario import Scenario
from swarmtrack.lab.world.rendering import Renderer
from swarmtrack.messages import Detections, Frame, StampKind
from swarmtrack.runtime.perception import detector_of

USUAL_SECTION = DetectorSection()


def rendered_eyes(scenario: Scenario, section: DetectorSection = USUAL_SECTION) -> Eyes:
    """The detector of each drone's agent, which looks where that drone expects something."""
    renderers = [
        Renderer(scenario.world, camera.lens, camera.body_from_camera, number=number)
        for number, camera in enumerate(scenario.cameras)
    ]
    detectors = {d: detector_of(section, SystemClock()) for d in scenario.members}

    def eyes(seen: Exposure) -> Detections:
        image = renderers[seen.camera].image(seen.drone_id, seen.t, seen.sequence)
        frame = Frame(seen.stamp, 0.0, seen.sequence, image, StampKind.EXPOSURE, camera=seen.camera)
        return detected(detectors[seen.drone_id], frame, PerceivedExpectation(seen.perceived, seen.camera))

    return eyes
