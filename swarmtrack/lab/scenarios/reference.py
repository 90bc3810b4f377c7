"""All keys of a scenario, as the models know them: the page docs/scenarios.md."""

from __future__ import annotations

from collections.abc import Iterator
from typing import get_args

from pydantic import BaseModel

from swarmtrack.lab.scenarios.files import ScenarioFile
from swarmtrack.lab.score.swarm_verdict import Limits
from swarmtrack.lab.world.sensors import DetectorParameters
from swarmtrack.setup.reference import Schema, about, drop_titles, key_rows, key_table, parameters_schema

HEAD = """\
# Write a scenario

A scenario is a TOML file that says which drones fly, how, with which cameras, autopilots and radios, what fails, and
what is expected. `swarmtrack sim FILE` flies it: real agents, simulated hardware, a verdict. `swarmtrack sim --list`
lists the shipped ones; their files are in [configs/scenarios/](../configs/scenarios).

Save this as `mine.toml`. Two drones hover face to face. Then one flies a figure of eight, and a stranger passes above:

```toml
about = "one flies a figure of eight, and a stranger passes"
seconds = 15.0

[[drone]]
id = 1
position_m = [0.0, 0.0, -5.0]               # north, east, down: 5 m high
looks_at_m = [8.0, 0.0, -5.0]

[[drone]]
id = 2
position_m = [8.0, 0.0, -5.0]
heading_deg = 180.0
[drone.flight]
centre_m = [8.0, 0.0, -5.0]
amplitude_m = [1.0, 2.0, 0.0]
frequency_hz = [0.2, 0.1, 0.0]

[[drone]]
id = 9
stranger = true
position_m = [14.0, -6.0, -10.0]
waypoints = [{ at_s = 2.0, position_m = [14.0, -6.0, -10.0] }, { at_s = 12.0, position_m = [14.0, 6.0, -10.0] }]

[agents]
share_hz = 7.0                              # the team shares velocities, which no stranger's motion matches

[expected]
correct = 0.9
```

```sh
swarmtrack sim mine.toml --detector oracle
```

A mistake is reported with file, line and the nearest known key. `--seed` changes everything random, `--drones` the
number of drones of a `[formation]`. `sim` takes a name for a file if it ends in `.toml` or contains a `/`.

A scenario for everyone belongs in `configs/scenarios/`, with a comment on what it shows; tests then fly it with the
oracle detector. For autopilots simulated elsewhere, such as your own SITL, write [a world](rehearse.md) instead.

World time counts from the beginning of the flight. `swarmtrack config reference --scenario` generates the tables below
from the models that read scenarios; a test keeps them up to date.
"""
PARAMETERS: dict[str, tuple[type, str]] = {
    "detector": (DetectorParameters, "A statistical detector, for `--detector oracle`."),
    "expected": (Limits, "Limits of the verdict."),
}


def scenario_reference() -> str:
    """The page docs/scenarios.md."""
    schema = ScenarioFile.model_json_schema(by_alias=True)
    drop_titles(schema)
    definitions: Schema = schema["$defs"]
    parts, of_file = [HEAD], []
    for name, field in ScenarioFile.model_fields.items():
        kind = next(_tables(field.annotation), None)
        if name in PARAMETERS:
            dataclass, text = PARAMETERS[name]
            rows = key_rows({"properties": parameters_schema(dataclass, {})}, definitions)
        elif kind is None or name == "origin":
            of_file.append(name)
            continue
        else:
            text = about(kind)
            rows = key_rows(definitions[kind.__name__], definitions)
        several = name in ("drone", "fault")
        parts.append(f"## {'[[' if several else '['}{name}{']]' if several else ']'}\n\n{text}\n")
        parts.append(key_table(rows))
    top = {key: schema["properties"][key] for key in of_file}
    rows = key_rows({"properties": top, "required": schema["required"]}, definitions)
    parts[1:1] = ["## The file\n\nThese keys come before the first table.\n", key_table(rows)]
    return "\n".join(parts)


def _tables(annotation: object) -> Iterator[type[BaseModel]]:
    """A type that is a table, and those within `tuple[…]`, `… | None` and `Annotated[…]`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _tables(inner)
