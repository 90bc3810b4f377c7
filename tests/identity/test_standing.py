"""The states of an assignment: every pair of a state and an event, in the table and in flight."""

from itertools import product

import pytest

from support.observer import LEFT, MIDDLE, RIGHT, SCAN_S, Observer, shifted
from support.places import ROOT
from swarmtrack.identity import names
from swarmtrack.identity.standing import Event, Standing, diagram, fire
from swarmtrack.messages import IdClash

PAIRS = list(product(Standing, Event))
# A track that nobody doubts is not judged, nor is one that is not detected; what was not hidden cannot come back.
IMPOSSIBLE = {
    (Standing.SETTLED, Event.CONFIRMED),
    (Standing.SETTLED, Event.REFUTED),
    (Standing.SETTLED, Event.OUT_OF_VIEW),
    (Standing.SETTLED, Event.DETECTED_AGAIN),
    (Standing.CHALLENGED, Event.DETECTED_AGAIN),
    (Standing.HIDDEN, Event.RIVALLED),
    (Standing.DOUBTED, Event.RIVALLED),
    (Standing.HIDDEN, Event.CONFIRMED),
    (Standing.HIDDEN, Event.REFUTED),
    (Standing.HIDDEN, Event.OUT_OF_VIEW),
    (Standing.DOUBTED, Event.DETECTED_AGAIN),
    (Standing.CHALLENGED, Event.SELF_DOUBTED),
    (Standing.HIDDEN, Event.SELF_DOUBTED),
    (Standing.DOUBTED, Event.SELF_DOUBTED),
}
# Exact probabilities never give a settled drone to a second track. Those of belief propagation may.
ONLY_BY_APPROXIMATION = {(Standing.SETTLED, Event.REASSIGNED)}

BEHIND = -8.0  # m: no camera that looks forward sees it


def bring(observer, standing):
    """Track a to where its ID, 2, stands so."""
    observer.hears(2, LEFT)
    observer.hears(3, RIGHT)
    observer.sees(1.0, a=LEFT, b=RIGHT)
    match standing:
        case Standing.CHALLENGED:
            observer.hears(2, LEFT, sequence=2)
        case Standing.HIDDEN | Standing.DOUBTED:
            observer.sees(0.5, coasting="a", a=LEFT, b=RIGHT)
    if standing is Standing.DOUBTED:
        observer.sees(SCAN_S, a=LEFT, b=RIGHT)


def let_happen(observer, standing, event):
    """What the world does to bring the event about; the track that it is about is a."""
    hidden = "a" if standing is Standing.HIDDEN else ""
    match event:
        case Event.ANNOUNCED:
            observer.hears(2, LEFT, sequence=3)
        case Event.SELF_DOUBTED:
            # All teammates are seen 15° beside where they say: the names are right, and the heading is wrong.
            observer.hears(2, shifted(LEFT, right=-120.0), sequence=3)
            observer.hears(3, shifted(RIGHT, right=-120.0), sequence=3)
            observer.sees(3.0, a=LEFT, b=RIGHT)
        case Event.UNDETECTED:
            observer.sees(0.5, coasting="a", a=LEFT, b=RIGHT)
        case Event.DETECTED_AGAIN:
            observer.sees(SCAN_S, a=LEFT, b=RIGHT)
        case Event.CONFIRMED:
            observer.sees(1.0, a=LEFT, b=RIGHT)
        case Event.RIVALLED:
            # A newcomer stands where the drone said it is while the named track has moved on a little; or the drone
            # says that it is between the two.
            if standing is Standing.CHALLENGED:
                observer.hears(2, shifted(LEFT, right=6.0), sequence=3)
            observer.sees(1.0, a=shifted(LEFT, right=12.0), b=RIGHT, c=LEFT)
        case Event.REFUTED:
            observer.hears(2, shifted(MIDDLE, down=-220.0), boot="0000000b")
            observer.sees(1.0, a=LEFT, b=RIGHT)
        case Event.OUT_OF_VIEW:
            observer.hears(2, LEFT, sequence=3, metres=BEHIND)
            observer.sees(1.0, a=LEFT, b=RIGHT)
        case Event.OVERRULED:
            observer.identities.overrule(2, observer.t)
        case Event.CLASHED:
            observer.identities.on_membership(IdClash(2, ("0000000a", "0000000b"), ours=False))
        case Event.REASSIGNED:
            observer.hears(2, MIDDLE, boot="0000000b")
            observer.sees(1.0, coasting=hidden, c=MIDDLE, a=LEFT, b=RIGHT)
        case Event.TRACK_ENDED:
            observer.sees(SCAN_S, b=RIGHT)


def expected(standing, event):
    """The rules by event, where the table goes by state."""
    match event:
        case Event.ANNOUNCED:
            return Standing.CHALLENGED if standing is Standing.SETTLED else standing
        case Event.SELF_DOUBTED:
            return Standing.CHALLENGED
        case Event.UNDETECTED:
            return Standing.HIDDEN
        case Event.DETECTED_AGAIN:
            return Standing.DOUBTED
        case Event.CONFIRMED:
            return Standing.SETTLED
        case Event.RIVALLED:
            return Standing.DOUBTED
        case Event.OUT_OF_VIEW:
            return Standing.SETTLED if standing is Standing.CHALLENGED else None
        case _:
            return None


@pytest.mark.parametrize(("standing", "event"), PAIRS)
def test_an_event_leads_where_its_rule_says_or_is_a_bug(standing, event):
    if (standing, event) in IMPOSSIBLE:
        with pytest.raises(RuntimeError, match=f"{event.value!r} cannot happen"):
            fire(standing, event)
    else:
        assert fire(standing, event) is expected(standing, event)


@pytest.mark.parametrize(
    ("standing", "event"), [pair for pair in PAIRS if pair not in IMPOSSIBLE | ONLY_BY_APPROXIMATION]
)
def test_each_transition_of_the_table_happens_in_flight(standing, event, monkeypatch):
    fired = []

    def witness(before, event):
        after = fire(before, event)
        fired.append((before, event, after))
        return after

    observer = Observer()
    bring(observer, standing)
    monkeypatch.setattr(names, "fire", witness)
    let_happen(observer, standing, event)
    assert (standing, event, expected(standing, event)) in fired


def test_only_an_id_that_is_doubted_is_not_stated():
    for standing in Standing:
        observer = Observer()
        bring(observer, standing)
        expected = None if standing is Standing.DOUBTED else 2
        assert observer.names()["a"] == expected, standing


def test_the_diagram_of_decision_8_is_the_table():
    """To mend the page: python -c "from swarmtrack.identity.standing import diagram; print(diagram())"."""
    page = (ROOT / "docs" / "decisions" / "0008-who-is-who.md").read_text()
    _, _, rest = page.partition("```mermaid\n")
    assert rest.partition("\n```")[0] == diagram()
