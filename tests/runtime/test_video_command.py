"""`swarmtrack video`: a clip in, a video that a browser plays and tables out."""

import csv
import functools
import http.server
import json
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from support.browser import browser_page, needs_chromium
from support.clips import shorten
from support.places import SHARED
from swarmtrack.agents import main as swarmtrack
from swarmtrack.outputs.annotated_video import CLOSING_S

CLIP = SHARED / "drones_real" / "clips_more" / "V_DRONE_002.mp4"
needs_clip = pytest.mark.skipif(not CLIP.is_file(), reason="../shared/data is absent")


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What it writes of the first two seconds of a real clip."""
    folder = tmp_path_factory.mktemp("video")
    clip = folder / "a clip.mp4"
    shorten(CLIP, clip, 60)
    assert swarmtrack.main(["video", str(clip), "--out", str(folder / "out")]) == 0
    return folder / "out"


@needs_clip
def test_the_tables_tell_of_the_one_drone_that_flies(tracked: Path) -> None:
    with (tracked / "tracks.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    lines = [json.loads(line) for line in (tracked / "tracks.jsonl").read_text().splitlines()]
    assert [line["frame"] for line in lines] == list(range(60))
    assert len({row["id"] for row in rows}) == 1
    assert len(rows) > 50
    shown = {(line["frame"], track["id"]): track for line in lines for track in line["tracks"]}
    for row in rows:
        track = shown[int(row["frame"]), int(row["id"])]
        assert float(row["u_px"]) == track["u_px"]
        assert row["status"] == track["status"] != "tentative"
        assert track["identity"] is None


@needs_clip
def test_the_video_is_as_long_as_the_clip_and_its_summary(tracked: Path) -> None:
    capture = cv2.VideoCapture(str(tracked / "annotated.webm"))
    frames = 0
    while capture.read()[0]:
        frames += 1
    assert frames == 60 + round(CLOSING_S * capture.get(cv2.CAP_PROP_FPS)) + 1


@needs_clip
@needs_chromium
async def test_a_browser_plays_the_video(tracked: Path) -> None:
    serve = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(tracked))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), serve) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        async with browser_page() as (page, _):
            await page.goto(f"http://127.0.0.1:{server.server_address[1]}/")
            seconds = await page.evaluate(
                """() => new Promise((done, fail) => {
                    const video = document.createElement("video");
                    video.muted = true;
                    video.onerror = () => fail(video.error.message);
                    video.ontimeupdate = () => video.currentTime > 0.5 && done(video.currentTime);
                    video.src = "/annotated.webm";
                    video.play();
                })"""
            )
        server.shutdown()
    assert seconds > 0.5


@needs_clip
def test_nothing_is_overwritten(tracked: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert swarmtrack.main(["video", str(CLIP), "--out", str(tracked)]) == 2
    assert "already exists, expected an empty folder or a new one" in capsys.readouterr().err


def test_a_refused_run_leaves_nothing_and_names_the_option(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clip, checkpoint = tmp_path / "clip.avi", tmp_path / "yolo.pt"
    write_clip(clip)
    checkpoint.write_bytes(b"PK\x03\x04" + bytes(range(200)))
    words = ["video", str(clip), "--out", str(tmp_path / "out"), "--model"]
    assert swarmtrack.main([*words, str(checkpoint)]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"swarmtrack video: --model: {checkpoint}: is a PyTorch checkpoint")
    assert "yolo export model=yolo.pt format=onnx" in said
    assert sorted(path.name for path in tmp_path.iterdir()) == ["clip.avi", "yolo.pt"]


def test_a_second_run_counts_up_or_replaces_what_it_wrote_itself(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_clip(tmp_path / "clip.avi")
    for _ in range(2):
        assert swarmtrack.main(["video", "clip.avi"]) == 0
    (tmp_path / "clip-tracked" / "old").touch()
    assert swarmtrack.main(["video", "clip.avi", "--out", "clip-tracked", "--force"]) == 0
    assert not (tmp_path / "clip-tracked" / "old").exists()
    assert (tmp_path / "clip-tracked-2" / "tracks.csv").is_file()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").touch()
    assert swarmtrack.main(["video", "clip.avi", "--out", "mine", "--force"]) == 2
    assert "is no output of swarmtrack video" in capsys.readouterr().err
    assert (tmp_path / "mine" / "thesis.tex").exists()


def write_clip(path: Path) -> None:
    """Three grey frames."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (160, 120))
    for _ in range(3):
        writer.write(np.full((120, 160, 3), 128, np.uint8))
    writer.release()


def test_what_is_no_video_is_refused_with_a_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "x.mp4").write_bytes(np.zeros(1000, np.uint8).tobytes())
    for name, words in (("x.mp4", "1000 bytes that are not a readable video"), ("y.mp4", "not found")):
        assert swarmtrack.main(["video", str(tmp_path / name), "--out", str(tmp_path / "out")]) == 2
        assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("degrees", ["0", "175", "wide"])
def test_a_lens_that_cannot_be_is_refused(degrees: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        swarmtrack.parse(["video", "x.mp4", "--fov", degrees])
    assert f"found {degrees}, expected" in capsys.readouterr().err
