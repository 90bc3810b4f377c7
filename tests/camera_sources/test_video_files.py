"""Video files as people have them: without times, trimmed, damaged, with odd names, and with 16 bits per pixel."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from support.mutants import MUTANTS, mutants
from support.streams import jpeg
from support.tiny_videos import H264, LONGER_SOUND, VARYING_RATE, WITH_A_RATE
from swarmtrack.camera_sources.container_end import is_complete
from swarmtrack.camera_sources.edit_list import edited_duration_s
from swarmtrack.camera_sources.opening import open_camera
from swarmtrack.camera_sources.playback import Picture
from swarmtrack.camera_sources.stretch import Stretch
from swarmtrack.camera_sources.video import VideoFile
from swarmtrack.clock import ManualClock


def write(path: Path, count: int, fourcc: str = "mp4v") -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*fourcc), 30.0, (64, 48))
    for n in range(count):
        writer.write(np.full((48, 64, 3), 4 * n, np.uint8))
    writer.release()
    return path


def played(path: Path, fps: float | None = None) -> tuple[VideoFile, list[Picture], tuple[bool, str]]:
    video = VideoFile(path, fps)
    pictures = list(video.play())
    return video, pictures, video.ending(len(pictures))


# --- times ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "data", "count"), [("a.h264", H264, 10), ("a.mjpeg", jpeg(9) * 7, 7)])
async def test_a_stream_without_times_is_said_to_have_none_and_a_rate_can_be_given(
    tmp_path: Path, name: str, data: bytes, count: int
) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    video, pictures, ending = played(path)
    assert "the file holds no times: 25 frames per second are assumed" in video.note
    assert ending == (True, f"ended after {count} frames")
    video, pictures, _ = played(path, 50.0)
    assert video.note == ""
    assert [picture.t for picture in pictures] == pytest.approx([0.02 * n for n in range(count)])
    camera = open_camera(f"file://{path}", clock=ManualClock())
    camera.frames()
    assert "holds no times" in camera.status().text
    await camera.close()


@pytest.mark.parametrize("name", WITH_A_RATE)
def test_a_bare_stream_that_holds_its_rate_has_no_note(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(WITH_A_RATE[name])
    video, pictures, _ = played(path)
    assert video.note == ""
    assert pictures[-1].t == pytest.approx(9 / 50, abs=0.025)


def test_a_file_with_times_has_no_note(tmp_path: Path) -> None:
    assert VideoFile(write(tmp_path / "a.mp4", 3), None).note == ""
    assert VideoFile(write(tmp_path / "a.avi", 3, "MJPG"), None).note == ""


# --- the end ----------------------------------------------------------------------------------------------------------


def trimmed(path: Path, begin_s: float) -> Path:
    """The same file with an edit list that begins later, as phones write it."""
    data = bytearray(path.read_bytes())
    at = data.index(b"elst") + 4
    scale = struct.unpack_from(">I", data, data.index(b"mdhd") + 4 + 12)[0]
    duration = struct.unpack_from(">I", data, at + 8)[0]
    count = struct.unpack_from(">I", data, at + 4)[0]
    assert (data[at], count) == (0, 1)
    movie = struct.unpack_from(">I", data, data.index(b"mvhd") + 4 + 12)[0]
    struct.pack_into(">Ii", data, at + 8, duration - round(begin_s * movie), round(begin_s * scale))
    path.write_bytes(data)
    return path


def test_a_trimmed_file_ends_well(tmp_path: Path) -> None:
    video, pictures, ending = played(trimmed(write(tmp_path / "a.mp4", 40), 0.8))
    assert video.announced == 40
    assert len(pictures) == 16
    assert ending == (True, "ended after 16 frames")


@pytest.mark.parametrize("cut", [0.5, 0.9])
def test_a_trimmed_file_that_is_cut_off_too_is_said_to_be(tmp_path: Path, cut: float) -> None:
    """Its index is moved to the front, as for the web: else nothing of it can be read."""
    data = trimmed(write(tmp_path / "a.mp4", 40), 0.8).read_bytes()
    boxes, at = {}, 0
    while at < len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        boxes[kind] = bytearray(data[at : at + size])
        at += size
    index = boxes[b"moov"]
    for name in (b"stco",):
        where = index.index(name) + 8
        for k in range(struct.unpack_from(">I", index, where)[0]):
            offset = struct.unpack_from(">I", index, where + 4 + 4 * k)[0]
            struct.pack_into(">I", index, where + 4 + 4 * k, offset + len(index))
    whole = b"".join(
        bytes(boxes[kind]) for kind in (b"ftyp", b"moov", *sorted(boxes.keys() - {b"ftyp", b"moov"}))
    )
    path = tmp_path / "b.mp4"
    path.write_bytes(whole)
    assert played(path)[2] == (True, "ended after 16 frames")
    path.write_bytes(whole[: len(whole) - int((1 - cut) * len(boxes[b"mdat"]) / 2)])
    good, text = played(path)[2]
    assert not good, text


@pytest.mark.parametrize(
    "count", [60, pytest.param(MUTANTS // 10, marks=pytest.mark.long("a thousand, not 60"))]
)
def test_any_mutation_of_an_edit_list_is_a_duration_or_none(tmp_path: Path, count: int) -> None:
    path = trimmed(write(tmp_path / "a.mp4", 3), 0.02)
    for mutant in mutants(path.read_bytes(), count, seed=5):
        path.write_bytes(mutant)
        found = edited_duration_s(path)
        assert found is None or found > 0.0


def test_a_file_of_a_varying_rate_ends_well(tmp_path: Path) -> None:
    path = tmp_path / "a.mkv"
    path.write_bytes(VARYING_RATE)
    video, pictures, ending = played(path)
    assert video.announced == 30
    assert [picture.t for picture in pictures] == pytest.approx([0.0, 0.033, 0.067, 0.933, 0.967])
    assert ending == (True, "ended after 5 frames")


@pytest.mark.parametrize("name", LONGER_SOUND)
def test_a_file_whose_sound_is_longer_ends_well(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(LONGER_SOUND[name])
    video, pictures, ending = played(path)
    assert video.announced > len(pictures) + 5
    assert ending == (True, f"ended after {len(pictures)} frames")


@pytest.mark.parametrize("name", ["a.mkv", "a.flv", "a.ts"])
def test_a_file_with_sound_that_is_cut_off_is_said_to_be(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(LONGER_SOUND[name][: len(LONGER_SOUND[name]) * 6 // 10])
    _, pictures, (good, text) = played(path)
    assert not good
    assert text.startswith(f"ended after {len(pictures)} ")


@pytest.mark.parametrize(
    "count", [60, pytest.param(MUTANTS // 10, marks=pytest.mark.long("a thousand, not 60"))]
)
@pytest.mark.parametrize("name", LONGER_SOUND)
def test_any_mutation_of_a_container_is_complete_or_not(tmp_path: Path, name: str, count: int) -> None:
    path = tmp_path / name
    for mutant in mutants(LONGER_SOUND[name], count, seed=5):
        path.write_bytes(mutant)
        assert is_complete(path) in (True, False, None)


@pytest.mark.parametrize("name", ["a.avi", "a.mkv"])
def test_a_file_without_its_end_is_said_to_be_cut(tmp_path: Path, name: str) -> None:
    path = write(tmp_path / name, 40, "MJPG")
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    _, pictures, (good, text) = played(path)
    assert not good
    assert f"ended after {len(pictures)} of 40 frames: the rest of the file cannot be read" in text


def test_what_is_behind_a_damaged_part_is_shown_and_the_loss_counted(tmp_path: Path, monkeypatch) -> None:
    """OpenCV's answer to damage, as H.264 in MP4 gives it, is that of the end: no frame."""
    video = VideoFile(write(tmp_path / "a.mp4", 20), None)
    real = cv2.VideoCapture.read
    count = [0]

    class Damaged:
        def __init__(self, capture):
            self._capture = capture

        def __getattr__(self, name):
            return getattr(self._capture, name)

        def read(self):
            count[0] += 1
            found, image = real(self._capture)
            return (False, None) if 5 <= count[0] < 9 else (found, image)

    from swarmtrack.camera_sources import video as module  # noqa: PLC0415

    opened = module.open_path
    monkeypatch.setattr(module, "open_path", lambda *arguments: Damaged(opened(*arguments)))
    pictures = list(video.play())
    assert [picture.image is None for picture in pictures].count(True) == 4
    assert pictures[-1].image is not None
    assert pictures[-1].t == pytest.approx(19 / 30, abs=1e-3)
    assert [picture.sequence for picture in pictures] == list(range(20))
    assert video.ending(len(pictures)) == (False, "ended after 16 frames: 4 more could not be read")


# --- names ------------------------------------------------------------------------------------------------------------

ODD = [
    b"2026-05-01T10:00:00.mp4",
    b"http:a.mp4",
    b"-a.mp4",
    b"a %03d #1?&x=1.mp4",
    b"caf\xe9.mp4",
    "Flug über den See…\n.mp4".encode(),
    b"concat:a|b.mp4",
    b"~nobody.mp4",
]


@pytest.mark.parametrize("name", ODD)
def test_a_file_opens_whatever_its_name_is(tmp_path: Path, monkeypatch, name: bytes) -> None:
    path = tmp_path / os.fsdecode(name)
    write(tmp_path / "plain.mp4", 3).rename(path)
    monkeypatch.chdir(tmp_path)
    assert len(played(Path(os.fsdecode(name)))[1]) == 3
    from urllib.parse import quote  # noqa: PLC0415

    camera = open_camera(f"file://{quote(os.fsencode(path))}", clock=ManualClock())
    assert not camera.status().ok


# --- depth ------------------------------------------------------------------------------------------------------------


def thermal(n: int) -> np.ndarray:
    """14 bits in 16: a warm square on noise."""
    image = 7600 + np.random.default_rng(n).integers(0, 30, (96, 128)).astype(np.uint16)
    image[40:52, 60:72] = 8000
    return image


def test_sixteen_bits_of_a_video_are_stretched_and_it_is_said(tmp_path: Path) -> None:
    path = tmp_path / "a.mkv"
    options = [cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U, cv2.VIDEOWRITER_PROP_IS_COLOR, 0]
    writer = cv2.VideoWriter(
        str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*"FFV1"), 9.0, (128, 96), options
    )
    for n in range(3):
        writer.write(thermal(n))
    writer.release()
    video, pictures, _ = played(path)
    assert video.note == "16 bits per pixel are stretched to 8"
    image = pictures[-1].image
    assert image is not None
    assert int(image[45, 65]) - float(np.median(image)) > 200


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
async def test_sixteen_bits_of_images_are_stretched_and_it_is_said(tmp_path: Path, suffix: str) -> None:
    for n in range(2):
        cv2.imwrite(str(tmp_path / f"{n}{suffix}"), thermal(n))
    camera = open_camera(f"images://{tmp_path}?pace=fast", clock=ManualClock())
    frames = camera.frames()
    assert "16 bits per pixel are stretched to 8" in camera.status().text
    image = (await anext(frames)).image
    assert int(image[45, 65]) - float(np.median(image)) > 200
    await camera.close()


def test_a_defect_pixel_does_not_take_the_contrast() -> None:
    image = np.tile(thermal(0), (2, 2))
    image[3, 3], image[5, 5] = 0, 65535
    seen = Stretch()(image)
    assert int(seen[45, 65]) - float(np.median(seen)) > 200


def test_noise_alone_stays_faint_and_a_change_of_the_scene_is_followed_smoothly() -> None:
    flat = 7600 + np.random.default_rng(0).integers(0, 10, (64, 64)).astype(np.uint16)
    assert np.ptp(Stretch()(flat)) <= 10
    stretch = Stretch()
    stretch(np.linspace(0, 60000, 4096).astype(np.uint16).reshape(64, 64))
    scene = thermal(0)
    spans = [np.ptp(stretch(scene).astype(int)) for _ in range(150)]
    assert spans[0] < 5
    assert spans[-1] > 200
    assert max(np.diff(spans)) < 20


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((4, 4), np.uint16),
        np.full((4, 4), np.nan, np.float32),
        np.array([[1e308, -1e308], [np.inf, 0.0]]),
        np.array([[-5, 7]], np.int32),
    ],
)
def test_any_depth_becomes_eight_bits(image: np.ndarray) -> None:
    assert Stretch()(image).dtype == np.uint8
