"""The examples in configs/: each is a config, commented, that passes its own check with no hardware there."""

import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from support.fake_autopilot import FakeAutopilot
from support.places import ROOT
from swarmtrack.agents.main import main
from swarmtrack.config.drone import load_config, load_team_config
from swarmtrack.setup.team_check import contradictions

CONFIGS = ROOT / "configs"
EXAMPLES = sorted(path.stem for path in CONFIGS.glob("*.toml") if path.stem != "team")
RECORDED = "replay"  # names two files that are its reader's own


def test_there_is_one_for_each_way_to_fly():
    assert {"px4-uart", "ardupilot-udp", "raspberry-pi-5", "jetson", "replay", "sim", "smart-camera"} <= set(
        EXAMPLES
    )


@pytest.mark.parametrize("name", [name for name in EXAMPLES if name != RECORDED])
def test_it_passes_its_check_and_says_what_is_not_there_now(name, capsys):
    assert main(["config", "check", str(CONFIGS / f"{name}.toml")]) == 0
    out = capsys.readouterr().out
    assert f"{name}.toml: ok" in out
    devices = re.findall(r"(?:serial|v4l2):(?://)?(/dev/[\w/.-]+)", out)
    missing = [device for device in devices if not Path(device).exists()]
    assert out.count("not there now: it is waited for") == len(missing)


def test_the_replay_plays_a_video_and_a_log_that_lie_beside_it(tmp_path):
    for name in ("replay.toml", "team.toml"):
        shutil.copy(CONFIGS / name, tmp_path)
    video = cv2.VideoWriter(str(tmp_path / "flight.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (640, 480))
    for shade in range(15):
        video.write(np.full((480, 640, 3), 100 + shade, np.uint8))
    video.release()
    autopilot, log = FakeAutopilot(boot_at=-40.0), b""
    for tick in range(500):
        for frame in autopilot.step(1e-3 * tick):
            log += int((time.time() + 1e-3 * tick) * 1e6).to_bytes(8, "big") + frame
    (tmp_path / "flight.tlog").write_bytes(log)
    result = subprocess.run(
        [sys.executable, "-m", "swarmtrack.agents.vehicle", "--config", "replay.toml"],
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        timeout=180.0,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert len((tmp_path / "tracks.jsonl").read_text().splitlines()) == 15
    assert (tmp_path / "annotated.mp4").stat().st_size > 0


def test_those_of_one_team_fly_together():
    team = [load_config(CONFIGS / f"{name}.toml") for name in EXAMPLES]
    team = [config for config in team if config.network.transport == "zenoh"]
    assert len(team) >= 6
    # The one that starts by GPS brings the origin itself, to be complete; its comment says where it belongs.
    assert [p for p in contradictions(team) if "team.origin" not in p] == []


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.toml")), ids=lambda path: path.stem)
def test_it_is_commented_and_known_to_editors(path):
    text = path.read_text(encoding="utf-8")
    first, *rest = text.splitlines()
    schema = re.fullmatch(r"#:schema (\S+)", first)[1]
    assert (path.parent / schema).resolve() == ROOT / "docs" / "config.schema.json"
    assert (path.parent / schema).exists()
    comments = sum("#" in line for line in rest)
    assert comments >= 0.25 * sum(bool(line.strip()) for line in rest)
    assert max(map(len, rest)) <= 130
    load_team_config(path)


def test_without_a_registered_simulator_a_simulated_camera_is_an_error_with_its_remedy(monkeypatch, capsys):
    monkeypatch.setattr("swarmtrack.runtime.assembly.entry_points", lambda **_: ())
    assert main(["config", "check", str(CONFIGS / "sim.toml")]) == 2
    assert "no simulator is registered for sim://" in capsys.readouterr().err
