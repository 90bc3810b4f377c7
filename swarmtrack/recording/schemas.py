"""JSON schemas of our topics, for viewers that plot them."""

from __future__ import annotations

from typing import Any

from swarmtrack.recording.inputs import Entry, Form

Schema = dict[str, Any]

NUMBER: Schema = {"type": "number"}
INTEGER: Schema = {"type": "integer"}
TEXT: Schema = {"type": "string"}
_PLAIN: dict[str, Schema] = {
    "number": NUMBER,
    "integer": INTEGER,
    "string": TEXT,
    "boolean": {"type": "boolean"},
    "integers": {"type": "array", "items": INTEGER},
    "strings": {"type": "array", "items": TEXT},
}


def array(items: Schema) -> Schema:
    return {"type": "array", "items": items}


def table(title: str, **properties: Schema) -> Schema:
    return {"title": title, "type": "object", "properties": properties}


def of_form(form: Form) -> Schema:
    """Schema of an input, with its running number."""
    return table(form.schema, n=INTEGER, **{entry.key: _of_entry(entry) for entry in form.entries})


def _of_entry(entry: Entry) -> Schema:
    if entry.form is not None:
        inner = {part.key: _of_entry(part) for part in entry.form.entries}
        return array(table(entry.form.schema, **inner))
    schema = _PLAIN[entry.type]
    for _ in entry.shape or ():
        schema = array(schema)
    return schema


TRACKS_SCHEMA = table(
    "swarmtrack.Tracks",
    t_s=NUMBER,
    sequence=INTEGER,
    camera=INTEGER,
    digest=TEXT,
    tracks=array(
        table(
            "swarmtrack.Track",
            id=INTEGER,
            camera=INTEGER,
            t_s=NUMBER,
            identity={},  # a drone's ID, "foreign" or null
            identity_probability=NUMBER,
            status=TEXT,
            probability=NUMBER,
            mean_px=array(NUMBER),
            cov=array(array(NUMBER)),
            size_px=array(NUMBER),
            coasting_since_s=NUMBER,
        )
    ),
    strangers_digest=TEXT,
    strangers=array(
        table(
            "swarmtrack.Stranger",
            number=INTEGER,
            position_m=array(NUMBER),
            velocity_m_s=array(NUMBER),
            cov=array(array(NUMBER)),
            observers=array(INTEGER),
            remote_id=TEXT,
        )
    ),
)
ASKED_SCHEMA = table("swarmtrack.Asked", n=INTEGER, t_s=NUMBER, digest=TEXT, tracks=INTEGER)
SETPOINTS_SCHEMA = table(
    "swarmtrack.Setpoint",
    n=INTEGER,
    t_s=NUMBER,
    engagement=INTEGER,
    clock_known={"type": "boolean"},
    why=TEXT,
    text=TEXT,
    velocity_m_s=array(NUMBER),
    sent_velocity_m_s=array(NUMBER),
    yaw_rate_rad_s=NUMBER,
    error_m=NUMBER,
    clear_of=array(INTEGER),
    digest=TEXT,
)
SAID_SCHEMA = table("swarmtrack.Said", drone_id=INTEGER, boot=TEXT, sequence=INTEGER, t_s=NUMBER)
FRAME_SCHEMA = table("swarmtrack.Frame", sequence=INTEGER, camera=INTEGER, t_s=NUMBER, t_sigma_s=NUMBER)
HEALTH_SCHEMA: Schema = {"title": "swarmtrack.Health", "type": "object"}
