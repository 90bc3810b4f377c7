"""Names that motion proves, with real processes: on the wire, on the page and in the verdict."""

from __future__ import annotations

from support.flown_pair import FlownPair


def test_a_proof_is_on_the_page_and_in_the_verdict(flown_pair: FlownPair) -> None:
    identity = flown_pair.verdict["identity"]
    assert identity["wrong"] == 0.0
    assert identity["proved"] > 0.0
    assert flown_pair.proved, "expected a proof on the page"
