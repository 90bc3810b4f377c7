"""A real agent flies a simulated drone behind its leader, by set points over UDP; the verdict says how."""

import json
import subprocess
import sys

import pytest

pytest.importorskip("zenoh", reason="Zenoh has no wheel here")

from swarmtrack.lab.score.swarm_verdict import BUSY

PAIR = """
about = "one drone follows another by sight"
seconds = 24.0
[camera]
fps = 7.0
[agents]
share_hz = 5.0
tracks_hz = 20.0
imu_rate_hz = 100.0
position_sigma_m = 0.3
[formation]
drones = 2
[formation.star]
height_m = 60.0
engages_s = 2.0
judged_from_s = 10.0
sticks = [
  { at_s = 2.0, velocity_m_s = [0.0, 0.0, 0.0] },
  { at_s = 2.5, velocity_m_s = [0.8, 0.0, 0.0] },
  { at_s = 4.0, velocity_m_s = [0.0, 0.8, 0.0] },
  { at_s = 5.5, velocity_m_s = [-0.8, 0.0, 0.0] },
  { at_s = 7.0, velocity_m_s = [0.0, -0.8, 0.0] },
  { at_s = 8.5, velocity_m_s = [0.0, 0.0, 0.0] },
  { at_s = 10.0, velocity_m_s = [0.0, 0.0, 0.0] },
  { at_s = 11.0, velocity_m_s = [1.2, 0.0, 0.0] },
  { at_s = 19.0, velocity_m_s = [1.2, 0.0, 0.0] },
  { at_s = 20.0, velocity_m_s = [0.0, 0.0, 0.0] },
]
"""


@pytest.mark.long("a leader is followed long enough to be judged")
def test_a_follower_flies_after_its_leader_and_the_verdict_says_how_far_off_it_was(tmp_path):
    path, told = tmp_path / "pair.toml", tmp_path / "verdict.json"
    path.write_text(PAIR, encoding="utf-8")
    said = subprocess.run(
        [sys.executable, "-m", "swarmtrack.agents.main", "sim", str(path), "--detector", "oracle", "--json", str(told)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert said.returncode in (0, 1, 3), said.stderr
    record = json.loads(told.read_text(encoding="utf-8"))
    formation = record["formation"]
    assert formation["followers"] == 1
    assert formation["min_separation_m"] > 1.5
    assert "smallest separation, m" in said.stdout
    if record["machine_busy"] <= BUSY:
        # The leader has flown 11 m off: who stays is lost.
        assert formation["lost"] == 0, said.stdout
        assert formation["error_m"]["end_p95"] < 2.0, said.stdout
