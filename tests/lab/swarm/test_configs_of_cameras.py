"""What a drone's config says of its cameras: as a user would write it, a table each."""

import tomllib

import numpy as np
import pytest

from swarmtrack.geometry import rotation
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.swarm.configs import Sources, write_configs

ONE = """
[camera]
source = "http://127.0.0.1:9/1"
intrinsics = { fx = 430, fy = 430, cx = 319.5, cy = 239.5, width = 640, height = 480 }
body_from_camera = { rpy_deg = [0.0, 0.0, 0.0], position_m = [0.1, 0.0, 0.0] }
max_age_s = 0.15

[autopilot]
link = "udpout:127.0.0.1:5001"
"""


def written(folder, name, cameras):
    scenario = load_scenario(name)
    sources = {
        d: Sources(
            f"http://127.0.0.1:9/{d}",
            f"udpout:127.0.0.1:{5000 + d}",
            more_cameras=tuple(f"http://127.0.0.1:9/{d}/{k}" for k in range(1, cameras)),
        )
        for d in scenario.members
    }
    files = write_configs(folder, scenario, team="blue", tracker="mbm", sources=sources, simulator="…")
    return scenario, {d: path.read_text(encoding="utf-8") for d, path in files.items()}


def test_one_camera_is_one_table_as_ever(tmp_path):
    _, texts = written(tmp_path, "crossing", 1)
    assert texts[1].endswith(ONE)


def test_several_cameras_are_a_table_each_in_their_order(tmp_path):
    scenario, texts = written(tmp_path, "all-round", 4)
    assert len(set(texts.values())) == len(scenario.members)
    for drone, text in texts.items():
        tables = tomllib.loads(text)["camera"]
        assert [table["source"] for table in tables] == [
            f"http://127.0.0.1:9/{drone}", *(f"http://127.0.0.1:9/{drone}/{k}" for k in (1, 2, 3))
        ]  # fmt: skip
        for k, (table, camera) in enumerate(zip(tables, scenario.cameras, strict=True)):
            assert table["mounting_sigma_deg"] == 0.5
            assert table["max_age_s"] == 0.15
            assert table["intrinsics"]["fx"] == camera.lens.fx
            assert table["body_from_camera"]["position_m"] == pytest.approx(camera.body_from_camera.position)
            rpy = np.radians(table["body_from_camera"]["rpy_deg"])
            told = rotation.from_euler(*rpy) @ rotation.BODY_FROM_FORWARD_CAMERA
            apart = camera.body_from_camera.rotation.T @ told
            assert told == pytest.approx(scenario.told_mounting(drone, k).rotation, abs=1e-5)
            assert 0.0 < np.degrees(np.linalg.norm(rotation.log(apart))) < 3.0
