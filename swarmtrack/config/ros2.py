"""[output] ros2: the drone as ROS 2 topics."""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal

from pydantic import Field

from swarmtrack.config.toml.sections import Positive, Section, Switch, Text

Distro = Literal["jazzy", "kilted", "humble"]
ROS2_ROUTER: Final = "127.0.0.1:7447"
"""Where the nodes of rmw_zenoh look for their router."""


class Ros2Section(Section):
    """Topics of a drone, or of a whole team, under rmw_zenoh."""

    router: Text = Field(
        default=ROS2_ROUTER, description="address of the router of ROS 2 (rmw_zenohd), HOST or HOST:PORT"
    )
    domain: Annotated[int, Field(ge=0, le=232, strict=True)] = Field(default=0, description="ROS domain ID")
    namespace: Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*$")] = Field(
        default="swarm", description="first part of topics and frames: letters, digits, `_`"
    )
    distro: Distro = Field(default="jazzy", description="of the nodes that listen")
    hz: Annotated[Positive, Field(le=100.0)] = Field(
        default=20.0, description="highest rate of odometry, transforms and teammates"
    )
    insecure: Switch = Field(
        default=False, description="allow a router on another machine: ROS 2 is read without keys"
    )


def or_switch(entry: dict[str, Any]) -> None:
    """Schema of an entry that is a table, or `true` for its defaults."""
    for kind in entry["anyOf"]:
        if kind.get("type") == "null":
            kind["type"] = "boolean"
