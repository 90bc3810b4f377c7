"""Training draws hundreds of sprites before its first sample, which no test of samples needs."""

import pytest

from swarmtrack.training.dataset import SampleSource


@pytest.fixture(autouse=True)
def few_sprites(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SampleSource, "BANK", 24)
