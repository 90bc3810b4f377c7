"""When motion alone gives a name as well."""

from __future__ import annotations

from swarmtrack.messages import MotionProof

# Of a probability: from where on it is a proof, and below which it is one no more.
P_PROVED, P_PROOF_KEPT = 0.99, 0.95
# s: by then it has outlasted most lucky moments, and counts for more than a place.
PROOF_LASTS_S = 1.0


def proof_after(before: MotionProof | None, probability: float, t: float) -> MotionProof | None:
    """What is proved once the pair has that probability; before: what was until then."""
    if probability > P_PROVED or (before is not None and probability >= P_PROOF_KEPT):
        return MotionProof(probability, t if before is None else before.since)
    return None
