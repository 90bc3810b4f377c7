"""What an agent does not load: thirty of them share two cores in the simulation, and a Pi is no server."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from support.patience import PATIENCE
from support.places import ROOT

INTRINSICS = "{ fx = 430.0, fy = 430.0, cx = 319.5, cy = 239.5, width = 640, height = 480 }"
LOADED = """
import json, sys
from swarmtrack.clock import SystemClock
from swarmtrack.config.drone import load_config
from swarmtrack.runtime.agent import Agent
from swarmtrack.runtime.assembly import assemble
from swarmtrack.outputs.console import Console
assemble(load_config(sys.argv[1]), SystemClock())
print(json.dumps(sorted(sys.modules)))
"""


@pytest.fixture(scope="module")
def without_images(tmp_path_factory) -> set[str]:
    return loaded(tmp_path_factory.mktemp("agent"), "detections://127.0.0.1:8091/1")


def loaded(folder: Path, source: str) -> set[str]:
    """The modules of an agent with this camera, made but not started."""
    config = folder / "drone.toml"
    config.write_text(
        f'drone.id = 1\nautopilot.link = "udpin:127.0.0.1:14540"\ncamera.source = "{source}"\n'
        f"camera.intrinsics = {INTRINSICS}\n"
    )
    run = subprocess.run(
        [sys.executable, "-c", LOADED, str(config)],
        capture_output=True,
        text=True,
        check=True,
        timeout=PATIENCE,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    return set(json.loads(run.stdout))


@pytest.mark.parametrize(
    "module",
    ["scipy", "cv2", "onnxruntime", "rich", "matplotlib", "yaml", "cryptography", "pymavlink.mavutil"],
)
def test_an_agent_whose_camera_detects_by_itself_does_without(without_images, module):
    assert {"numpy", "zenoh", "swarmtrack.runtime.agent"} <= without_images
    assert module not in without_images


def test_an_agent_with_a_detector_does_without_scipy(tmp_path):
    modules = loaded(tmp_path, "http://127.0.0.1:8091/1")
    assert {"onnxruntime", "cv2"} <= modules
    assert "scipy" not in modules
