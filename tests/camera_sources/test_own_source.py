"""docs/examples/pipe_camera.py: a source of one's own, as docs/add_a_camera.md adds it."""

import asyncio
import os
import runpy

import numpy as np
import pytest

from support.patience import PATIENCE
from support.places import DOCS
from swarmtrack.agents.main import main
from swarmtrack.camera_sources.opening import CAMERA_SOURCES, open_camera
from swarmtrack.clock import SystemClock
from swarmtrack.errors import SourceError

EXAMPLE = DOCS / "examples" / "pipe_camera.py"
PIPE_CAMERA = runpy.run_path(str(EXAMPLE))["PipeCamera"]
del CAMERA_SOURCES["pipe"]  # which the example has put there


@pytest.fixture
def pipe(tmp_path, monkeypatch):
    monkeypatch.setitem(CAMERA_SOURCES, "pipe", PIPE_CAMERA)
    os.mkfifo(tmp_path / "cam")
    return tmp_path / "cam"


async def test_frames_come_through_the_pipe_also_from_a_second_program(pipe):
    camera = open_camera(f"pipe://{pipe}?width=8&height=4", clock=SystemClock(), size=(8, 4))
    images = np.arange(96, dtype=np.uint8).reshape(3, 4, 8)
    async with asyncio.timeout(PATIENCE):
        frames = camera.frames()
        for image in images:
            await asyncio.to_thread(pipe.write_bytes, image.tobytes())
            frame = await anext(frames)
            np.testing.assert_array_equal(frame.image, image)
            assert SystemClock().now() - frame.t > 0.0
        await camera.close()
    assert camera.status().name.startswith("pipe://")


def test_its_mistakes_are_answered_as_those_of_all_sources(pipe, tmp_path, capsys):
    with pytest.raises(SourceError, match='unknown option "widht", did you mean "width"'):
        open_camera(f"pipe://{pipe}?widht=8", clock=SystemClock())
    config = tmp_path / "drone.toml"
    lens = "{ fx = 8.0, fy = 8.0, cx = 3.5, cy = 1.5, width = 8, height = 4 }"
    config.write_text(
        f'drone.id = 1\n[camera]\nsource = "pipe://{pipe}?width=8&height=4"\nintrinsics = {lens}\n'
    )
    assert main(["config", "check", str(config)]) == 0
    del CAMERA_SOURCES["pipe"]
    assert main(["config", "check", str(config)]) == 2
    assert 'unknown scheme "pipe"' in capsys.readouterr().err


def test_it_is_short():
    assert len(EXAMPLE.read_text().splitlines()) <= 60
