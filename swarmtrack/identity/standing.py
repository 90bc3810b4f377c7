"""How an assigned ID stands: the states of an assignment, and all that may happen to it.

Theory of operation. An assignment says that a track is a drone. It begins settled, when the posterior gives the ID to
the track, and the track carries the ID until something speaks against it.

* News: the drone announces itself again. The ID is challenged. It is still stated, because it is right more often than
  not, until the posterior confirms or refutes it.
* Self-doubt: where the observer is, or looks, may be otherwise than it thinks. Whatever motion does not prove is
  challenged, again and again, and its past counts for nothing.
* A rival: a nameless track comes where the drone should be, and the ID is less sure than it must be. It was given when
  there was nobody else, so it is doubted until the posterior prefers one of the two.
* Silence: the track is not detected for a while and the assignment is hidden. It may come back as another drone, so it
  is doubted once it is detected again. A doubted ID is not stated until the posterior confirms it.

The posterior judges only what is challenged or doubted. A drone out of view cannot be judged: a challenged ID is
given the benefit of the doubt, a doubted one is not.

Every assignment can be ended from outside: other observers overrule it, two processes clash over the ID, another track
is more likely to be the drone, or the track ends.

`TRANSITIONS` is the whole machine, and `fire` is the only way through it. An event that a state does not list cannot
happen there: it is a bug and raises. Four entries lead back to their own state. News of a challenged or doubted drone
starts the judgement again, because the posterior now has another pose to compare with. A hidden track stays hidden
however long it is missed and whatever its drone says, because it will be doubted in any case.

Entering challenged or doubted starts a new count of scans. Entering settled restores the prior in favour of the ID
(`Assignment.enter`).
"""

from __future__ import annotations

import enum


class Standing(enum.Enum):
    """The state of an assignment. An ID that is doubted is not stated; in all other states it is."""

    SETTLED = "settled"
    CHALLENGED = "challenged"
    HIDDEN = "hidden"
    DOUBTED = "doubted"


class Event(enum.Enum):
    """What happens to an assignment."""

    ANNOUNCED = "announced again"
    """There is a newer announcement of the drone."""
    SELF_DOUBTED = "self-doubted"
    """The observer's own pose is in doubt, and so is what it went by."""
    UNDETECTED = "undetected"
    """The track has not been detected for longer than a miss."""
    DETECTED_AGAIN = "detected again"
    """A hidden track is detected."""
    CONFIRMED = "confirmed"
    """The posterior is sure enough that the track is the drone."""
    REFUTED = "refuted"
    """The posterior says that it rather is not."""
    RIVALLED = "rivalled"
    """A nameless track may be the drone as well."""
    OUT_OF_VIEW = "out of view"
    """The drone should not be visible to this camera, so the posterior says nothing about it."""
    OVERRULED = "overruled"
    """Other observers see the drone elsewhere."""
    CLASHED = "clashed"
    """Two processes speak as this drone."""
    REASSIGNED = "reassigned"
    """Another track is more likely to be the drone, or this track to be another drone."""
    TRACK_ENDED = "track ended"


TRANSITIONS: dict[Standing, dict[Event, Standing | None]] = {
    Standing.SETTLED: {
        Event.ANNOUNCED: Standing.CHALLENGED,
        Event.SELF_DOUBTED: Standing.CHALLENGED,
        Event.UNDETECTED: Standing.HIDDEN,
        Event.RIVALLED: Standing.DOUBTED,
        Event.OVERRULED: None,
        Event.CLASHED: None,
        Event.REASSIGNED: None,
        Event.TRACK_ENDED: None,
    },
    Standing.CHALLENGED: {
        Event.ANNOUNCED: Standing.CHALLENGED,
        Event.UNDETECTED: Standing.HIDDEN,
        Event.RIVALLED: Standing.DOUBTED,
        Event.CONFIRMED: Standing.SETTLED,
        Event.REFUTED: None,
        Event.OUT_OF_VIEW: Standing.SETTLED,
        Event.OVERRULED: None,
        Event.CLASHED: None,
        Event.REASSIGNED: None,
        Event.TRACK_ENDED: None,
    },
    Standing.HIDDEN: {
        Event.ANNOUNCED: Standing.HIDDEN,
        Event.UNDETECTED: Standing.HIDDEN,
        Event.DETECTED_AGAIN: Standing.DOUBTED,
        Event.OVERRULED: None,
        Event.CLASHED: None,
        Event.REASSIGNED: None,
        Event.TRACK_ENDED: None,
    },
    Standing.DOUBTED: {
        Event.ANNOUNCED: Standing.DOUBTED,
        Event.UNDETECTED: Standing.HIDDEN,
        Event.CONFIRMED: Standing.SETTLED,
        Event.REFUTED: None,
        Event.OUT_OF_VIEW: None,
        Event.OVERRULED: None,
        Event.CLASHED: None,
        Event.REASSIGNED: None,
        Event.TRACK_ENDED: None,
    },
}
"""By state and event: the state that follows; None: the assignment has ended."""


def fire(standing: Standing, event: Event) -> Standing | None:
    """The state after the event, None where the assignment ends.

    Raises RuntimeError for an event that cannot happen in this state.
    """
    follows = TRANSITIONS[standing]
    if event not in follows:
        raise RuntimeError(
            f"identity: {event.value!r} cannot happen to an assignment that is {standing.value}"
        )
    return follows[event]


def diagram() -> str:
    """The table as a Mermaid state diagram; what ends an assignment in every state is a note."""
    always = [
        event for event in Event if all(follows.get(event, event) is None for follows in TRANSITIONS.values())
    ]
    lines = ["stateDiagram-v2", "    [*] --> settled: assigned"]
    for standing, follows in TRANSITIONS.items():
        labels: dict[Standing | None, list[str]] = {}
        for event, after in follows.items():
            if event not in always:
                labels.setdefault(after, []).append(event.value)
        for after, events in labels.items():
            lines.append(f"    {standing.value} --> {after.value if after else '[*]'}: {', '.join(events)}")
    ends = ", ".join(event.value for event in always)
    lines += ["    note right of settled", f"        Ends in every state: {ends}", "    end note"]
    return "\n".join(lines)
