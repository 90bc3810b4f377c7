"""Video files and folders of images as cameras."""

from __future__ import annotations

import asyncio
from pathlib import Path

import cv2
import numpy as np
import pytest

from support.patience import PATIENCE, eventually
from swarmtrack.camera_sources.opening import open_camera
from swarmtrack.clock import ManualClock, SystemClock
from swarmtrack.errors import SourceError
from swarmtrack.messages import Frame, StampKind
from swarmtrack.sources import Camera

FPS = 10
START = 500.0  # s


def paint(number: int) -> np.ndarray:
    """A picture that says its number: grey levels far enough apart to survive compression."""
    return np.full((48, 64, 3), 5 + 8 * number, np.uint8)


def number(frame: Frame) -> int:
    return round((float(frame.image.mean()) - 5) / 8)


def write_video(path: Path, count: int, fourcc: str = "mp4v") -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*fourcc), FPS, (64, 48))
    for n in range(count):
        writer.write(paint(n))
    writer.release()
    return path


def write_images(folder: Path, count: int) -> Path:
    folder.mkdir()
    for n in range(count):
        cv2.imwrite(str(folder / f"frame_{n}.png"), paint(n))
    return folder


@pytest.fixture(params=["file", "images"])
def source(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """An address of 25 pictures at 10 Hz, ready for more options."""
    if request.param == "file":
        return f"file://{write_video(tmp_path / 'clip.mp4', 25)}?"
    return f"images://{write_images(tmp_path / 'clip', 25)}?fps={FPS}&"


async def all_frames(camera: Camera) -> list[Frame]:
    frames = [frame async for frame in camera.frames()]
    await camera.close()
    return frames


def counters(camera: Camera) -> dict[str, float]:
    return dict(camera.status().counters)


async def test_at_pace_fast_every_picture_comes_in_order_at_its_media_time(source: str) -> None:
    frames = await all_frames(open_camera(source + "pace=fast", clock=ManualClock(START)))
    assert [number(frame) for frame in frames] == list(range(25))
    assert [frame.sequence for frame in frames] == list(range(25))
    assert [frame.t for frame in frames] == pytest.approx([START + n / FPS for n in range(25)], abs=1e-3)
    assert {frame.stamp for frame in frames} == {StampKind.MEDIA}


async def test_at_pace_realtime_pictures_come_at_their_time_and_the_late_consumer_gets_the_newest(
    source: str,
) -> None:
    clock = ManualClock(START)
    camera = open_camera(source + "pace=realtime", clock=clock)
    frames = camera.frames()
    assert number(await anext(frames)) == 0
    pending = asyncio.ensure_future(anext(frames))
    clock.set(START + 0.101)
    assert number(await pending) == 1  # not before its time: the clock stood still until now
    clock.set(START + 1.001)
    await eventually(lambda: counters(camera)["dropped"] == 8)
    frame = await anext(frames)
    assert (frame.sequence, number(frame)) == (10, 10)
    assert frame.t == pytest.approx(START + 1.0, abs=1e-3)
    await camera.close()


async def test_a_loop_goes_on_in_time_and_sequence(source: str) -> None:
    camera = open_camera(source + "pace=fast&loop=1", clock=ManualClock(START))
    frames: list[Frame] = []
    async for frame in camera.frames():
        frames.append(frame)
        if len(frames) == 60:
            break
    await camera.close()
    assert [frame.sequence for frame in frames] == list(range(60))
    assert [number(frame) for frame in frames[24:27]] == [24, 0, 1]
    assert np.diff([frame.t for frame in frames]) == pytest.approx(1 / FPS, abs=1e-3)


@pytest.mark.parametrize("pace", ["fast", "realtime"])
async def test_a_cancelled_consumer_leaves_a_camera_that_closes_at_once(source: str, pace: str) -> None:
    clock = SystemClock()
    camera = open_camera(source + f"pace={pace}&loop=1", clock=clock)

    async def consume() -> None:
        async for _ in camera.frames():
            pass

    consumer = asyncio.create_task(consume())
    await eventually(lambda: counters(camera)["frames"] > 2)
    consumer.cancel()
    with pytest.raises(asyncio.CancelledError):
        await consumer
    async with asyncio.timeout(PATIENCE):
        await camera.close()
    assert [frame async for frame in camera.frames()] == []


async def test_pictures_of_another_size_are_refused_unless_they_may_be_scaled(source: str) -> None:
    with pytest.raises(SourceError, match="64x48, the calibration is for 640x480"):
        open_camera(source, clock=ManualClock(), size=(640, 480))
    camera = open_camera(source + "resize=1&pace=fast", clock=ManualClock(), size=(128, 96))
    assert {frame.image.shape for frame in await all_frames(camera)} == {(96, 128, 3)}


async def test_times_can_be_overruled_by_a_rate(tmp_path: Path) -> None:
    clip = write_video(tmp_path / "clip.mp4", 5)
    frames = await all_frames(
        open_camera(f"file://{clip.name}?pace=fast&fps=50", clock=ManualClock(), base=tmp_path)
    )
    assert [frame.t for frame in frames] == pytest.approx([0, 0.02, 0.04, 0.06, 0.08])


def test_a_file_that_holds_no_video_is_refused_with_the_reason(tmp_path: Path) -> None:
    whole = write_video(tmp_path / "whole.mp4", 25).read_bytes()
    (tmp_path / "half.mp4").write_bytes(whole[: len(whole) // 2])  # the index at its end is missing
    (tmp_path / "empty.mp4").write_bytes(b"")
    (tmp_path / "text.mp4").write_text("no video at all\n" * 100)
    (tmp_path / "folder.mp4").mkdir()
    for name, sentence in (
        ("none.mp4", "not found"),
        ("half.mp4", "cut off"),
        ("empty.mp4", "0 bytes"),
        ("text.mp4", "not a readable video"),
        ("folder.mp4", "images://"),
    ):
        with pytest.raises(SourceError, match=sentence):
            open_camera(f"file://{name}", clock=ManualClock(), base=tmp_path)


async def test_a_file_whose_end_is_missing_plays_what_there_is_and_says_so(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.avi", 25, "MJPG")
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    camera = open_camera(f"file://{path}?pace=fast", clock=ManualClock())
    frames = await all_frames(camera)
    assert [number(frame) for frame in frames] == list(range(len(frames)))
    assert 0 < len(frames) < 25
    status = camera.status()
    assert not status.ok
    assert "of 25 frames: the rest of the file cannot be read" in status.text


async def test_a_damaged_image_is_counted_and_the_next_one_shown(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "clip", 6)
    (folder / "frame_0.png").write_bytes(b"")
    (folder / "frame_3.png").write_bytes(b"\x89PNG but no more")
    camera = open_camera(f"images://{folder}?pace=fast", clock=ManualClock())
    assert [frame.sequence for frame in await all_frames(camera)] == [1, 2, 4, 5]
    assert counters(camera)["corrupt"] == 2


async def test_an_euroc_index_gives_the_times_to_the_microsecond(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "data", 12)
    stamps = [1403636579763555584, 1403636579813555456, 1403636579963555584]
    lines = [f"{stamp},frame_{n}.png" for stamp, n in zip(stamps, (10, 2, 11), strict=True)]
    (tmp_path / "data.csv").write_text("#timestamp [ns],filename\n" + "\r\n".join(lines) + "\n")
    camera = open_camera(f"images://{folder}?times=../data.csv&pace=fast", clock=ManualClock(START))
    frames = await all_frames(camera)
    assert [number(frame) for frame in frames] == [10, 2, 11]
    assert [frame.t - START for frame in frames] == pytest.approx([0, 0.049999872, 0.2], abs=1e-7)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("1000,frame_0.png\n1000,frame_1.png", ":2: time does not grow"),
        (
            "1000,frame_0.png\nlater,frame_1.png",
            ":2: found 'later,frame_1.png', expected timestamp_ns,filename",
        ),
        ("1000", "expected timestamp_ns,filename"),
        ("# nothing\n", "no line"),
        ("1000,frame_9.png", "none of its 1 images can be read"),
    ],
)
def test_a_wrong_index_is_refused_at_its_line(tmp_path: Path, text: str, sentence: str) -> None:
    folder = write_images(tmp_path / "data", 2)
    (tmp_path / "data.csv").write_text(text)
    with pytest.raises(SourceError) as error:
        open_camera(f"images://{folder}?times=../data.csv", clock=ManualClock())
    assert sentence in str(error.value)


def test_a_folder_without_images_is_refused(tmp_path: Path) -> None:
    for source, sentence in (
        ("images://none", "not found"),
        ("images://.", "no image matches"),
        ("images://.?times=data.csv", "No such file"),
    ):
        with pytest.raises(SourceError, match=sentence):
            open_camera(source, clock=ManualClock(), base=tmp_path)
