"""Reading a team of drones from Python: `from swarmtrack.client import Swarm` (docs/client.md)."""

from swarmtrack.client.axes import Axes
from swarmtrack.client.sight import DroneCamera, DroneHealth, Relative, Sight, Target
from swarmtrack.client.swarm import Swarm

__all__ = ["Axes", "DroneCamera", "DroneHealth", "Relative", "Sight", "Swarm", "Target"]
