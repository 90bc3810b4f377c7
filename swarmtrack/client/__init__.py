"""Python client: reads a team of drones, and sends the ranges of a ranging radio to an agent (docs/client.md)."""

from swarmtrack.client.axes import Axes
from swarmtrack.client.freshness import Mark
from swarmtrack.client.ranging import Ranging
from swarmtrack.client.recorded import RecordedSwarm, recorded
from swarmtrack.client.sight import DroneCamera, DroneHealth, Relative, Sight, Stranger, Target
from swarmtrack.client.swarm import Swarm

__all__ = [
    "Axes", "DroneCamera", "DroneHealth", "Mark", "Ranging", "RecordedSwarm", "Relative", "Sight", "Stranger", "Swarm",
    "Target", "recorded",
]  # fmt: skip
