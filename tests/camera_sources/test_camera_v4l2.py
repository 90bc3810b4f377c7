"""The real V4L2 camera, in a process of its own, on a stand-in for the kernel's side of the ioctls."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from queue import Empty, Queue
from typing import Any

import cv2
import numpy as np
import pytest

from support.patience import PATIENCE
from support.places import ROOT, V4L2_STAND_IN
from swarmtrack.camera_sources import v4l2_abi as abi
from swarmtrack.camera_sources.decode import RawImage, decode_raw
from swarmtrack.camera_sources.frame_slot import BadImage, Freshness
from swarmtrack.camera_sources.limits import STAMPS_COMPARED
from swarmtrack.camera_sources.opening import open_camera
from swarmtrack.camera_sources.stretch import Stretch
from swarmtrack.camera_sources.v4l2 import exposure_time, holders, kernel_stamp
from swarmtrack.clock import ManualClock
from swarmtrack.diagnosis.findings import Level
from swarmtrack.diagnosis.sources import CameraFacts, check_camera
from swarmtrack.errors import SourceError
from swarmtrack.messages import LinkStatus, StampKind

DEVICE = "/dev/video99"
CC = shutil.which("cc") or shutil.which("gcc")
PERIOD = 1 / 30

needs_cc = pytest.mark.skipif(CC is None, reason="no C compiler to build the stand-in with")


@pytest.fixture(scope="session")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("stand_in") / "stand_in.so"
    command = [
        str(CC),
        "-O1",
        "-shared",
        "-fPIC",
        str(V4L2_STAND_IN / "stand_in.c"),
        "-o",
        str(path),
        "-ldl",
        "-lpthread",
    ]
    subprocess.run(command, check=True)
    return path


class Watch:
    """A process that watches the camera; its lines, and the script of its camera."""

    def __init__(self, library: Path, folder: Path) -> None:
        self._library = library
        self._script = folder / "script"
        self._lines: Queue[dict[str, Any] | None] = Queue()
        self._process: subprocess.Popen[str] | None = None

    def script(self, **keys: object) -> None:
        fresh = self._script.with_suffix(".new")
        fresh.write_text("".join(f"{key} {value}\n" for key, value in keys.items()))
        fresh.replace(self._script)  # never seen half-written

    def start(self, query: str = "", size: tuple[int, int] = (0, 0), consumer_seconds: float = 0.0) -> None:
        source = f"v4l2://{DEVICE}" + (f"?{query}" if query else "")
        arguments = [source, *map(str, size), str(consumer_seconds)]
        environment = {
            "V4L2_STAND_IN_DEVICE": DEVICE,
            "V4L2_STAND_IN_SCRIPT": str(self._script),
            "LD_PRELOAD": str(self._library),
            "PYTHONPATH": str(ROOT),
        }
        self._process = subprocess.Popen(
            [sys.executable, str(V4L2_STAND_IN / "watch.py"), *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=os.environ | environment,
        )
        self._lines = Queue()
        threading.Thread(target=self._read, args=(self._process, self._lines), daemon=True).start()

    def _read(self, process: subprocess.Popen[str], lines: Queue[dict[str, Any] | None]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            lines.put(json.loads(line))
        lines.put(None)

    def send(self, command: str) -> None:
        assert self._process is not None
        assert self._process.stdin is not None
        self._process.stdin.write(command + "\n")
        self._process.stdin.flush()

    def line(self, key: str) -> dict[str, Any]:
        """The next line that has the key."""
        while True:
            try:
                line = self._lines.get(timeout=PATIENCE)
            except Empty:
                pytest.fail(f"nothing with {key} from the camera's process")
            assert line is not None, "the camera's process ended"
            if key in line:
                return line

    def frame(self) -> dict[str, Any]:
        return self.line("sequence")

    def frames(self, count: int) -> list[dict[str, Any]]:
        return [self.frame() for _ in range(count)]

    def status(self) -> dict[str, Any]:
        self.send("status")
        return self.line("text")

    def status_that(self, holds: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Ask until the status is such."""
        waited = threading.Event()
        for _ in range(int(PATIENCE / 0.05)):
            status = self.status()
            if holds(status):
                return status
            waited.wait(0.05)
        pytest.fail(f"last status: {status}")

    def close(self) -> dict[str, Any]:
        self.send("close")
        return self.line("closed_in")

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()


@pytest.fixture
def watch(library: Path, tmp_path: Path) -> Iterator[Watch]:
    watch = Watch(library, tmp_path)
    yield watch
    watch.kill()


@needs_cc
@pytest.mark.parametrize(
    ("fourcc", "shape"),
    [("GREY", [480, 600]), ("YUYV", [480, 600, 3]), ("UYVY,NV16", [480, 600, 3]), ("NV12", [480, 600, 3])],
)
def test_every_frame_carries_the_kernels_start_of_exposure_and_its_own_picture(
    watch: Watch, fourcc: str, shape: list[int]
) -> None:
    watch.script(formats=fourcc, lead_us=12000)
    watch.start("width=600&height=480&fps=30")  # 600 px: lines padded to 64 bytes
    frames = watch.frames(20)
    ages = [frame["now"] - frame["t"] for frame in frames]
    assert min(ages) == pytest.approx(0.012, abs=0.008)
    assert {frame["stamp"] for frame in frames} == {StampKind.EXPOSURE.value}
    assert {tuple(frame["shape"]) for frame in frames} == {tuple(shape)}
    for one, two in pairwise(frames):
        assert two["t"] - one["t"] == pytest.approx((two["sequence"] - one["sequence"]) * PERIOD, abs=1e-4)
    for frame in frames:
        # The stand-in paints 4 x sequence. YUYV to BGR stretches luma 16 … 235 to 0 … 255.
        luma = 4 * frame["sequence"] % 256
        expected = luma if fourcc == "GREY" else [min(max((luma - 16) * 255 / 219, 0), 255)] * 3
        assert frame["corner"] == pytest.approx(expected, abs=2)
    assert watch.close()["closed_in"] < 1


@needs_cc
@pytest.mark.parametrize("fourcc", ["MJPG", "JPEG"])
def test_motion_jpeg_is_decoded_and_grey_is_preferred_to_it(
    watch: Watch, tmp_path: Path, fourcc: str
) -> None:
    image = np.full((480, 640, 3), (10, 120, 230), np.uint8)
    (tmp_path / "image.jpg").write_bytes(cv2.imencode(".jpg", image)[1].tobytes())
    watch.script(formats=f"{fourcc},GREY", jpeg=tmp_path / "image.jpg")
    watch.start(f"fourcc={fourcc}")
    assert watch.frame()["corner"] == pytest.approx([10, 120, 230], abs=4)
    (tmp_path / "image.jpg").write_bytes(b"\xff\xd8\xff nonsense")
    watch.status_that(lambda status: status["corrupt"] > 2)
    watch.kill()
    watch.start()
    assert watch.frame()["shape"] == [480, 640]


@needs_cc
def test_with_a_known_exposure_the_stamp_is_its_middle(watch: Watch) -> None:
    watch.script(formats="GREY", lead_us=12000)
    watch.start("exposure_us=8000")
    frames = watch.frames(10)
    assert min(frame["now"] - frame["t"] for frame in frames) == pytest.approx(0.012 - 0.004, abs=0.003)
    assert frames[0]["sigma"] == pytest.approx(1e-3)


@needs_cc
def test_a_slow_consumer_gets_the_newest_frame_and_the_others_are_counted(watch: Watch) -> None:
    watch.script(formats="GREY")
    watch.start(consumer_seconds=0.1)
    frames = watch.frames(8)
    # Taken in order, the fifth would be 0.27 s old already, and each one older than the last.
    assert min(frame["now"] - frame["t"] for frame in frames[4:]) < 0.1
    status = watch.status()
    skipped = frames[-1]["sequence"] - frames[0]["sequence"] + 1 - len(frames)
    assert skipped >= len(frames)
    # Those that the driver lost for want of a buffer, on a busy machine, are none of ours.
    assert status["dropped"] + status["lost"] >= skipped - 1


@needs_cc
def test_what_waited_while_the_loop_stood_still_is_thrown_away_and_counted(watch: Watch) -> None:
    watch.script(formats="GREY")
    watch.start("buffers=4")
    last = watch.frames(5)[-1]
    watch.send("block 0.5")
    while (frame := watch.frame())["sequence"] < last["sequence"] + 6:
        last = frame
    # 15 exposures: the first ones filled the buffers and are 0.37 s old or more, the others found none.
    assert frame["now"] - frame["t"] < 0.3
    status = watch.status()
    assert status["stale"] >= 2
    assert status["lost"] >= 5
    assert status["stale"] + status["lost"] >= frame["sequence"] - last["sequence"] - 2


@needs_cc
def test_a_camera_that_falls_silent_is_said_and_goes_on(watch: Watch) -> None:
    watch.script(formats="GREY")
    watch.start()
    watch.frames(3)
    watch.script(formats="GREY", silent=1)
    assert "no frame for" in watch.status_that(lambda status: not status["ok"])["text"]
    watch.script(formats="GREY", silent=0)
    # It counts as well as soon as it is open again, before its first frame.
    assert watch.status_that(lambda status: status["ok"] and status["frames"] > 3)


@needs_cc
def test_an_unplugged_camera_comes_back_and_its_frames_count_on(watch: Watch) -> None:
    watch.script(formats="GREY")
    watch.start()
    before = watch.frames(5)[-1]
    watch.script(plugged=0)
    status = watch.status_that(lambda status: "not there" in status["text"])
    assert DEVICE in status["text"]
    watch.script(formats="GREY")
    while (frame := watch.frame())["sequence"] <= before["sequence"]:
        pass
    status = watch.status_that(lambda status: status["ok"])
    assert status["reconnects"] == 1
    assert frame["t"] > before["t"]
    assert watch.close()["closed_in"] < 1


@needs_cc
@pytest.mark.parametrize(
    ("script", "query", "sentence"),
    [
        ({"formats": "H264"}, "", "offers H264, expected one of GREY, YUYV, UYVY"),
        ({"formats": "YUYV"}, "fourcc=MJPG", "offers YUYV, expected one of MJPG: add YUYV to fourcc="),
        (
            {"planes": 2},
            "",
            "captures multi-planar only, which is not supported: have another program convert it",
        ),
        ({"formats": "NV16"}, "", "have another program convert it and serve it as rtsp://"),
        ({"formats": "GREY", "busy": 1}, "", "busy, held by"),
        ({"open_errno": 13}, "", "usermod -aG video"),
        ({"plugged": 0}, "", "is not there"),
        ({"formats": "H264", "driver": "unicam"}, "", "libcamera"),
    ],
)
def test_why_a_camera_does_not_open_is_a_sentence(
    watch: Watch, script: dict[str, object], query: str, sentence: str
) -> None:
    watch.script(**script)
    watch.start(query)
    status = watch.status_that(lambda status: "not opened yet" not in status["text"])
    assert sentence in status["text"]
    assert not status["ok"]
    watch.script(formats="YUYV,GREY,MJPG", jpeg="/dev/null")  # mended: no restart is needed
    watch.status_that(lambda status: status["fps"] > 0 or status["corrupt"] > 0)


@needs_cc
def test_frames_of_another_size_are_refused_and_said_unless_they_may_be_scaled(watch: Watch) -> None:
    watch.script(formats="GREY", width=320, height=240)
    watch.start(size=(640, 480))
    status = watch.status_that(lambda status: status["wrong_size"] > 2)
    assert "320x240" in status["text"]
    assert "640x480" in status["text"]
    assert (status["ok"], status["frames"]) == (False, 0)
    watch.kill()
    watch.start("resize=1", size=(640, 480))
    assert watch.frame()["shape"] == [480, 640]


SMALL = {"width": 320, "height": 240, "formats": "GREY"}
NARROW = {"formats": "YUYV,MJPG", "bandwidth": 320 * 240, "jpeg": "JPEG"}
NO_SIZE = (0, 0)

# Script, query and calibrated size; the advice, where {} stands for what it names; and for each way out the same three.
Try = tuple[dict[str, object], str, tuple[int, int]]
ADVICE: dict[str, tuple[Try, str, list[Try]]] = {
    "another fourcc": (
        ({"formats": "YUYV"}, "fourcc=MJPG", NO_SIZE), r"expected one of MJPG: add (\w+) to fourcc= in the address",
        [({"formats": "YUYV"}, "fourcc=MJPG,{}", NO_SIZE)],
    ),
    "one size only": (
        (SMALL, "", (640, 480)), "set the camera to that size, calibrate again, or add resize=1",
        [({"formats": "GREY"}, "", (640, 480)), (SMALL, "", (320, 240)), (SMALL, "resize=1", (640, 480))],
    ),
    "a narrow bus": (
        (NARROW, "width=640&height=480", NO_SIZE),
        "not enough USB bandwidth; use another port, a smaller size or fourcc=MJPG",
        [
            (NARROW | {"bandwidth": 0}, "width=640&height=480", NO_SIZE),
            (NARROW, "width=320&height=240", NO_SIZE),
            (NARROW, "width=640&height=480&fourcc=MJPG", NO_SIZE),
        ],
    ),
    "another program": (
        ({"formats": "GREY", "busy": 1}, "", NO_SIZE), "busy, held by", [({"formats": "GREY"}, "", NO_SIZE)],
    ),
    "no pictures": (
        ({"formats": "GREY,MJPG", "jpeg": "/dev/null"}, "fourcc=MJPG", NO_SIZE), "no picture",
        [({"formats": "GREY,MJPG"}, "fourcc=GREY", NO_SIZE)],
    ),
}  # fmt: skip


@needs_cc
@pytest.mark.parametrize("name", ADVICE)
def test_each_way_out_that_a_camera_names_gives_frames(watch: Watch, tmp_path: Path, name: str) -> None:
    def tried(script: dict[str, object], query: str, size: tuple[int, int]) -> None:
        jpeg = {"jpeg": tmp_path / "image.jpg"} if script.get("jpeg") == "JPEG" else {}
        watch.script(**script | jpeg)
        watch.start(query, size)

    cv2.imwrite(str(tmp_path / "image.jpg"), np.full((480, 640, 3), 90, np.uint8))
    before, advice, ways = ADVICE[name]
    tried(*before)
    status = watch.status_that(lambda status: re.search(advice, status["text"]))
    said, faults = re.search(advice, status["text"]), failures_of(status)
    assert said is not None
    assert faults
    for script, query, size in ways:
        watch.kill()
        tried(script, query.format(*said.groups()), size)
        shape = watch.frame()["shape"]
        assert size == NO_SIZE or tuple(shape[1::-1]) == size
        assert not faults & failures_of(watch.status())


def failures_of(status: dict[str, Any]) -> set[str]:
    """What doctor calls them."""
    counters = tuple((key, value) for key, value in status.items() if isinstance(value, float | int))
    said = LinkStatus("camera", status["ok"], status["text"], counters)
    facts = CameraFacts(3.0, 0.5, said, frames=round(status["frames"]), kind="v4l2")
    return {finding.fault for finding in check_camera(facts) if finding.level is Level.FAILURE}


@needs_cc
def test_each_way_out_of_a_size_that_contradicts_the_calibration_gives_frames(watch: Watch) -> None:
    asked = "width=320&height=240"
    with pytest.raises(SourceError, match="ask for that size, calibrate again, or add resize=1"):
        open_camera(f"v4l2://{DEVICE}?{asked}", clock=ManualClock(), size=(640, 480))
    watch.script(formats="GREY")
    for query, size in (
        ("width=640&height=480", (640, 480)),
        (asked, (320, 240)),
        (f"{asked}&resize=1", (640, 480)),
    ):
        watch.start(query, size)
        assert watch.frame()["shape"][1::-1] == list(size)
        watch.kill()


@needs_cc
def test_buffers_the_driver_marks_as_damaged_are_counted_not_shown(watch: Watch) -> None:
    watch.script(formats="GREY", damaged=1)
    watch.start()
    status = watch.status_that(lambda status: status["corrupt"] > 3)
    assert (status["ok"], status["frames"]) == (False, 0)
    assert "no picture can be read from them; the last: marked as damaged by the driver" in status["text"]
    watch.script(formats="GREY")
    watch.frame()
    assert watch.status_that(lambda status: status["ok"])


@needs_cc
def test_a_driver_that_wakes_us_without_a_frame_is_opened_again(watch: Watch) -> None:
    watch.script(formats="GREY", stuck=1)
    watch.start()
    watch.status_that(lambda status: "reports an error and no frame" in status["text"])
    watch.script(formats="GREY")
    watch.frame()


@needs_cc
def test_a_camera_without_the_wanted_controls_works_and_says_so(watch: Watch) -> None:
    watch.script(formats="GREY", controls=0)
    watch.start("exposure_us=2000&gain=3")
    watch.frame()
    assert "camera refused exposure_us and gain" in watch.status()["text"]


@needs_cc
def test_structures_and_requests_are_those_of_the_kernels_header(tmp_path: Path) -> None:
    names = [name for name in vars(abi) if name.startswith("VIDIOC_")]
    lines = "".join(f'printf("%u\\n", (unsigned){name});' for name in names)
    fields = "".join(
        f'printf("%zu\\n", offsetof(struct v4l2_buffer, {field}));' for field, *_ in abi.Buffer._fields_
    )
    source = tmp_path / "abi.c"
    source.write_text(
        "#include <stdio.h>\n#include <stddef.h>\n#include <linux/videodev2.h>\n"
        f"int main(void) {{ {lines}{fields} return 0; }}"
    )
    subprocess.run([str(CC), str(source), "-o", str(tmp_path / "abi")], check=True)
    found = subprocess.run([tmp_path / "abi"], check=True, capture_output=True, text=True).stdout.split()
    ours = [getattr(abi, name) for name in names]
    ours += [getattr(abi.Buffer, field).offset for field, *_ in abi.Buffer._fields_]
    assert [int(value) for value in found] == ours  # a request number holds the size of its structure


def buffer(t: float, flags: int) -> abi.Buffer:
    return abi.Buffer(flags=flags, timestamp=abi.Timeval(int(t), int(1e6 * (t - int(t)))))


def test_a_stamp_of_the_end_of_the_frame_is_known_for_what_it_is() -> None:
    stamp, at, sigma = exposure_time(1000.0, abi.BUF_FLAG_TIMESTAMP_MONOTONIC, PERIOD, 10_000)
    assert stamp is StampKind.READOUT
    assert at == pytest.approx(1000.0 - 0.005)
    assert PERIOD > sigma > 1e-3
    assert kernel_stamp(buffer(1000.0, abi.BUF_FLAG_TIMESTAMP_MONOTONIC)) == pytest.approx(1000.0)
    assert kernel_stamp(buffer(1000.0, 0)) is None


@needs_cc
@pytest.mark.parametrize(
    ("lead_us", "problem"),
    [
        (1_200_000, " s behind this machine's monotonic clock by the youngest of 20 frames, or"),
        (-80_000, " s ahead of this machine's monotonic clock by the youngest of 20 frames, expected -5 to"),
        (100_000_000, "100 s behind this machine's monotonic clock, expected -5 to +533 ms"),
    ],
)
def test_stamps_of_another_clock_are_not_used_and_the_offset_is_said(
    watch: Watch, lead_us: int, problem: str
) -> None:
    watch.script(formats="GREY", lead_us=lead_us)
    watch.start()
    watch.frames(STAMPS_COMPARED)  # from then on their youngest counts
    for frame in watch.frames(10):
        assert frame["stamp"] == StampKind.ARRIVAL.value
        assert 0.0 <= frame["now"] - frame["t"] < 0.2
    status = watch.status()
    assert "stamps are not used: their clock is" in status["text"]
    assert problem in status["text"]
    assert status["ok"]
    assert status["bad_stamps"] >= 10


@needs_cc
@pytest.mark.parametrize("before", [1, 5])
def test_a_frame_that_waited_longer_than_any_latency_keeps_its_stamp(watch: Watch, before: int) -> None:
    watch.script(formats="GREY")
    watch.start("buffers=4")
    last = watch.frames(before)[-1]
    watch.send("block 1.0")
    while (frame := watch.frame())["sequence"] < last["sequence"] + 30:
        assert frame["stamp"] == StampKind.EXPOSURE.value
    assert watch.status()["bad_stamps"] == 0


def test_an_honest_latency_is_not_staleness_and_a_lasting_change_of_it_is_learnt() -> None:
    freshness = Freshness(PERIOD, depth=20)

    def stale(sequences: range, age: float) -> list[bool]:
        return [freshness.is_stale(n * PERIOD, n, n * PERIOD + age) for n in sequences]

    assert not any(stale(range(100), age=0.2))
    assert all(stale(range(100, 110), age=0.4))
    assert not any(stale(range(140, 150), age=0.2))
    assert not any(stale(range(150, 250), age=0.4)[Freshness.MEMORY :])


def test_no_more_frames_in_a_row_are_stale_than_can_have_waited() -> None:
    freshness = Freshness(PERIOD, depth=4)
    assert not freshness.is_stale(0.0, 0, 0.01)
    late = [freshness.is_stale(n * PERIOD, n, n * PERIOD + 0.2) for n in range(1, 11)]
    assert late == [True] * 4 + [False] + [True] * 4 + [False]


def test_who_holds_a_device_is_named(tmp_path: Path) -> None:
    path = tmp_path / "device"
    path.touch()
    code = "import sys; f = open(sys.argv[1]); print('open', flush=True); sys.stdin.read()"
    command = [sys.executable, "-c", code, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        assert any(f"(pid {other.pid})" in who for who in holders(str(path)))
        assert other.stdin is not None
        other.stdin.close()


def test_a_size_that_contradicts_the_calibration_can_never_work() -> None:
    with pytest.raises(SourceError, match="1280x720 is asked, the calibration is for 640x480"):
        open_camera("v4l2:///dev/video0?width=1280&height=720", clock=ManualClock(), size=(640, 480))


@pytest.mark.parametrize(("width", "stride"), [(64, 127), (65, 130)])
def test_a_format_that_no_yuyv_camera_has_spoils_a_frame_and_not_the_flight(width: int, stride: int) -> None:
    with pytest.raises(BadImage, match="expected"):
        seen_as(memoryview(bytes(48 * stride)), RawImage("YUYV", width, 48, stride))


BGR = (30, 90, 200)


def seen_as(data: memoryview, form: RawImage, *, grey: bool = False) -> np.ndarray:
    return decode_raw(data, form, grey=grey, stretch=Stretch())


def packed(fourcc: str, width: int, height: int, stride: int) -> bytes:
    """A uniform image in a V4L2 format, by OpenCV's own conversion the other way."""
    image = np.full((height, width, 3), BGR, np.uint8)
    if fourcc in ("YU12", "YV12"):
        code = cv2.COLOR_BGR2YUV_I420 if fourcc == "YU12" else cv2.COLOR_BGR2YUV_YV12
        y, chroma = np.split(cv2.cvtColor(image, code).ravel(), [height * width])
        lines = (y.reshape(height, width), chroma.reshape(height, width // 2))
        return b"".join(
            np.pad(plane, ((0, 0), (0, stride * plane.shape[1] // width - plane.shape[1]))).tobytes()
            for plane in lines
        )
    if fourcc == "BGR4":
        lines = cv2.cvtColor(image, cv2.COLOR_BGR2BGRA).reshape(height, -1)
    elif fourcc in ("BGR3", "RGB3"):
        lines = (image if fourcc == "BGR3" else image[:, :, ::-1]).reshape(height, -1)
    elif fourcc in ("NV12", "NV21"):
        y, u, v = np.split(
            cv2.cvtColor(image, cv2.COLOR_BGR2YUV_I420).ravel(), [height * width, height * width * 5 // 4]
        )
        pair = (u, v) if fourcc == "NV12" else (v, u)
        lines = np.concatenate([y, np.stack(pair, axis=1).ravel()]).reshape(-1, width)
    else:
        code = {
            "YUYV": cv2.COLOR_BGR2YUV_YUYV,
            "UYVY": cv2.COLOR_BGR2YUV_UYVY,
            "YVYU": cv2.COLOR_BGR2YUV_YVYU,
        }[fourcc]
        lines = cv2.cvtColor(image, code).reshape(height, -1)
    return np.pad(lines, ((0, 0), (0, stride - lines.shape[1]))).tobytes()


@pytest.mark.parametrize(
    "fourcc", ["YUYV", "UYVY", "YVYU", "NV12", "NV21", "YU12", "YV12", "BGR3", "RGB3", "BGR4"]
)
@pytest.mark.parametrize("padding", [0, 16])
def test_each_format_gives_the_colours_that_went_in(fourcc: str, padding: int) -> None:
    used = 8 * {"NV12": 1, "NV21": 1, "YU12": 1, "YV12": 1, "BGR3": 3, "RGB3": 3, "BGR4": 4}.get(fourcc, 2)
    data = memoryview(packed(fourcc, 8, 6, used + padding))
    seen = seen_as(data, RawImage(fourcc, 8, 6, (used + padding) if padding else 0))
    assert seen.shape == (6, 8, 3)
    assert np.abs(seen.astype(int) - BGR).max() <= 6
    assert seen_as(data, RawImage(fourcc, 8, 6, used + padding), grey=True).shape == (6, 8)
    for cut in (0, 1, len(data) - 1):
        with pytest.raises(BadImage, match="expected"):
            seen_as(data[:cut], RawImage(fourcc, 8, 6, used + padding))


def test_sixteen_bits_of_a_thermal_camera_are_stretched() -> None:
    image = np.full((48, 64), 7600, "<u2")
    image[10:20, 10:20] = 8100
    seen = seen_as(memoryview(image.tobytes()), RawImage("Y16", 64, 48, 128))
    assert int(seen[15, 15]) - int(seen[40, 40]) > 200


@needs_cc
def test_a_stamp_that_is_old_but_believed_is_known_less_well(watch: Watch) -> None:
    watch.script(formats="GREY", lead_us=300_000)
    watch.start()
    watch.frames(STAMPS_COMPARED)
    frame = watch.frames(5)[-1]
    assert frame["stamp"] != StampKind.ARRIVAL.value
    assert frame["sigma"] > 0.02
