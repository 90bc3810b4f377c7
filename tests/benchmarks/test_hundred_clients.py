"""`swarmtrack bench clients`, in small: sessions of real processes, in a mesh and through two routers."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("zenoh", reason="Zenoh has no wheel here")

from swarmtrack.agents import main as swarmtrack
from swarmtrack.benchmarks import hundred_clients
from swarmtrack.benchmarks.hundred_clients import Team
from swarmtrack.transport.settings import Mode

SESSIONS = 6


def test_everybody_knows_everybody_in_a_mesh_and_through_two_routers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hundred_clients, "QUICK", (Team(SESSIONS, Mode.PEER), Team(SESSIONS, Mode.CLIENT)))
    assert swarmtrack.main(["bench", "clients", "--quick", "--out", str(tmp_path)]) == 0
    assert f"{SESSIONS} clients, 2 routers" in capsys.readouterr().out
    mesh, routed = json.loads((tmp_path / "clients.json").read_text())["teams"]
    for outcome in (mesh, routed):
        assert (outcome["sessions"], outcome["complete"]) == (SESSIONS, SESSIONS)
        assert 0 < outcome["announcement_bytes"] < 300
        # Its own, and a few puts for all that ask in the rush of a start.
        assert 1 <= outcome["announcements_sent_per_session"] <= 4
        # Keep-alives, and by chance the query that comes each ten seconds; an announcement a second would be thousands.
        assert outcome["idle_bytes_s_per_session"] <= 400
        assert outcome["bytes_until_known_per_session"] > (SESSIONS - 1) * outcome["announcement_bytes"]
    assert [len(outcome["router_rss_mb"]) for outcome in (mesh, routed)] == [0, 2]
