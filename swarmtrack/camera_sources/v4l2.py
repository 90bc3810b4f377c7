"""`v4l2:` a USB or CSI camera, read from the kernel's own buffers on the event loop.

Why not OpenCV: it tells neither the sequence number (lost frames), nor whether a stamp means the start of the
exposure or the end of the frame, and it hands out what waited in its buffers as if it were new.

Theory of operation. `Capture` is one opened device: negotiated format, mapped buffers, streaming. The kernel owns a
buffer from QBUF until it has filled it; DQBUF gives it to us. On every wake-up all filled buffers are taken and all
but the newest given back at once. The newest waits in the `FrameSlot`, undecoded and uncopied, until the consumer
takes it or a newer one comes; it is decoded in a worker thread and then given back. Of four buffers one may wait,
one may be decoded, and two are the kernel's.

A camera's life: away (not plugged in, busy, forbidden; said once, tried again after 0.5 … 5 s) → open, no frame yet
→ streaming → silent (no frame for some periods; said once) → streaming again, or closed and opened again → away …
Nothing here ends the camera but `close`.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import fcntl
import glob
import grp
import math
import mmap
import os
from collections.abc import AsyncIterator
from ctypes import c_int32
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

from swarmtrack.camera_sources import v4l2_abi as abi
from swarmtrack.camera_sources.address import CameraAddress, in_range, read_options
from swarmtrack.camera_sources.decode import JPEG_FORMATS, RAW_FORMATS, RawImage, decode_jpeg, decode_raw
from swarmtrack.camera_sources.frame_slot import BadImage, FrameSlot, Freshness, RawFrame
from swarmtrack.camera_sources.limits import (
    CAMERA_FIRST_BACKOFF_S,
    CAMERA_LONGEST_BACKOFF_S,
    CAMERA_REOPEN_AFTER_S,
    CAMERA_SILENT_AT_LEAST_S,
    CAMERA_SILENT_PERIODS,
    DEFAULT_FRAME_PERIOD_S,
    KERNEL_STAMP_SIGMA_S,
    STAMP_LATE_S,
    STAMPS_COMPARED,
    V4L2_LEAST_AGE_S,
    V4L2_STAMP_WINDOW_S,
)
from swarmtrack.camera_sources.newest_slot import start, stop
from swarmtrack.camera_sources.stamp_clock import StampBounds, StampClock
from swarmtrack.camera_sources.stretch import Stretch
from swarmtrack.clock import Clock
from swarmtrack.errors import SourceError
from swarmtrack.messages import Frame, Image, LinkStatus, StampKind
from swarmtrack.plain_text import plain

# What we decode, best first: JPEG must be decompressed, and of 16 bits the camera's own 8 are better stretched.
FORMATS = (
    "GREY",
    "YUYV",
    "UYVY",
    "YVYU",
    "NV12",
    "NV21",
    "YU12",
    "YV12",
    "MJPG",
    "JPEG",
    "BGR3",
    "RGB3",
    "BGR4",
    "Y16",
)
assert set(FORMATS) == {*RAW_FORMATS, *JPEG_FORMATS}
CONVERT = "have another program convert it and serve it as rtsp:// or http:// (GStreamer, MediaMTX)"
LIBCAMERA_DRIVERS = ("unicam", "rp1-cfe")


class CameraUnavailable(Exception):
    """The camera cannot be used now; the text names the reason and the remedy."""


@dataclass(frozen=True, slots=True)
class V4l2Options:
    """`width`, `height` [px]: both or none (then the calibrated size, else what the driver has set)."""

    width: int | None = None
    height: int | None = None
    fps: float | None = None
    fourcc: tuple[str, ...] = FORMATS
    buffers: int = 4
    exposure_us: float | None = None  # sets manual exposure, and moves the stamp to its middle
    gain: int | None = None
    grey: bool = False  # deliver grey even where the camera has colour
    resize: bool = False

    def __post_init__(self) -> None:
        if (self.width is None) != (self.height is None):
            raise ValueError("width and height are given together or not at all")
        in_range("width", self.width, 16, 16384, " px")
        in_range("height", self.height, 16, 16384, " px")
        in_range("fps", self.fps, 0.1, 1000)
        in_range("buffers", self.buffers, 3, 32)  # one waits, one is decoded, one is filled
        in_range("exposure_us", self.exposure_us, 1, 1e6)
        for name in self.fourcc:
            if name not in FORMATS:
                raise ValueError(f'fourcc: found "{name}", expected some of {", ".join(FORMATS)}')
        if not self.fourcc:
            raise ValueError(f"fourcc: empty, expected some of {', '.join(FORMATS)}")


class V4l2Camera:
    """A camera behind /dev/video*. The clock must be CLOCK_MONOTONIC, the kernel's for these stamps."""

    def __init__(
        self, address: CameraAddress, *, clock: Clock, size: tuple[int, int] | None, base: Path | None
    ) -> None:
        del base  # a device is never relative to the config
        self._options = options = read_options(address, V4l2Options)
        self._path = address.target
        if not self._path.startswith("/"):
            raise SourceError(f"camera source {address}: expected a device such as v4l2:///dev/video0")
        asked = (options.width, options.height) if options.width and options.height else None
        if asked and size and asked != size and not options.resize:
            raise SourceError(
                f"camera source {address}: {asked[0]}x{asked[1]} is asked, the calibration is for {size[0]}x{size[1]}: "
                "ask for that size, calibrate again, or add resize=1 if it shows the same field of view"
            )
        self._ask_size = asked or size
        self._clock = clock
        self._slot = FrameSlot(str(address), clock, size, options.resize)
        self._task: asyncio.Task[None] | None = None

    def frames(self) -> AsyncIterator[Frame]:
        self._task = self._task or start(self._run, self._slot)
        return self._slot.frames()

    async def arrived(self) -> None:
        await self._slot.arrived()

    def status(self) -> LinkStatus:
        return self._slot.source.status()

    async def close(self) -> None:
        await stop(self._task, self._slot)

    async def _run(self) -> None:
        backoff = CAMERA_FIRST_BACKOFF_S
        sequence = -1
        opened_before = False
        while True:
            try:
                capture = await self._open()
            except CameraUnavailable as away:
                self._slot.source.report(False, str(away))
            else:
                self._slot.source.counts.reconnects += opened_before
                opened_before = True
                stream = CaptureSession(capture, self._slot, self._clock, self._options, sequence)
                self._slot.source.report(False, await stream.run())
                sequence = stream.sequence
                if stream.received:
                    backoff = CAMERA_FIRST_BACKOFF_S
            await asyncio.sleep(backoff)
            backoff = min(2 * backoff, CAMERA_LONGEST_BACKOFF_S)

    async def _open(self) -> Capture:
        # In a thread: waking a USB camera takes from 10 ms to seconds.
        opening = asyncio.get_running_loop().run_in_executor(
            None, open_capture, self._path, self._options, self._ask_size
        )
        try:
            return await asyncio.shield(opening)
        except asyncio.CancelledError:
            opening.add_done_callback(_close_unused)
            raise


class CaptureSession:
    """One capture on the event loop, from its first frame to its loss."""

    # Wake-ups in a row without a frame: a broken driver wakes us for ever and has nothing to say.
    EMPTY_LIMIT = 100

    def __init__(
        self, capture: Capture, slot: FrameSlot, clock: Clock, options: V4l2Options, sequence: int
    ) -> None:
        """sequence: of the last frame before; the camera's own count starts anew each time it is opened."""
        self.received = 0  # buffers of any worth
        self.sequence = sequence
        self._capture = capture
        self._slot = slot
        self._clock = clock
        self._options = options
        self._camera_sequence: int | None = None
        self._freshness = Freshness(capture.period, depth=len(capture.maps))
        self._flowing = False
        self._empty = 0
        low, high = V4L2_LEAST_AGE_S
        # The first may have waited while the detector was loaded.
        bounds = StampBounds(
            low,
            STAMP_LATE_S + capture.period,
            high + capture.period,
            V4L2_STAMP_WINDOW_S,
            credit=STAMPS_COMPARED - 1,
        )
        slot.source.stamps = StampClock(clock, same_machine=True, utc=False, bounds=bounds)
        self._lost: asyncio.Future[str] = asyncio.get_running_loop().create_future()

    async def run(self) -> str:
        """Feed the slot until the device fails; closes it and returns the reason."""
        loop = asyncio.get_running_loop()
        self._slot.source.report(False, f"{self._capture.description}; waiting for the first frame")
        loop.add_reader(self._capture.fd, self._on_readable)
        try:
            return await self._watch()
        finally:
            loop.remove_reader(self._capture.fd)
            self._slot.clear()
            self._capture.retire()
            await asyncio.to_thread(self._capture.close)

    async def _watch(self) -> str:
        """Wait for the loss of the device, and say when it falls silent."""
        silent_for = 0.0
        patience = max(CAMERA_SILENT_PERIODS * self._capture.period, CAMERA_SILENT_AT_LEAST_S)
        while True:
            received = self.received
            await asyncio.wait([self._lost], timeout=patience)
            if self._lost.done():
                return self._lost.result()
            silent_for = 0.0 if self.received > received else silent_for + patience
            if silent_for > max(CAMERA_REOPEN_AFTER_S, patience):
                return f"no frame for {silent_for:.1f} s; opening it again"
            if silent_for and self._flowing:
                self._flowing = False
                self._slot.source.report(
                    False, f"no frame for {silent_for:.1f} s (cable, power, USB bandwidth?)"
                )

    def _on_readable(self) -> None:
        newest: RawFrame | None = None
        try:
            # Bounded: a camera that fills as fast as we give back must not keep the loop.
            for _ in self._capture.maps:
                buffer = self._capture.dequeue()
                if buffer is None:
                    self._empty += 1
                    break
                self._empty = 0
                raw = self._judge(buffer)
                if raw is None:
                    self._capture.requeue(buffer.index)
                else:
                    if newest is not None:
                        self._slot.put(newest)
                    newest = raw
        except OSError as error:
            self._lose(_why_lost(error))
        if newest is not None:
            self._slot.put(newest)
        elif self._empty > self.EMPTY_LIMIT:
            self._lose("the driver reports an error and no frame; opening it again")

    def _lose(self, reason: str) -> None:
        if not self._lost.done():
            self._lost.set_result(reason)
        # The device stays readable; without this the loop would spin until `run` wakes up.
        asyncio.get_running_loop().remove_reader(self._capture.fd)

    def _judge(self, buffer: abi.Buffer) -> RawFrame | None:
        """Account for one filled buffer; the frame in it, or None if it is not worth looking at."""
        now = self._clock.now()
        self._count(buffer.sequence)
        if not self._flowing:
            self._flowing = True
            self._slot.source.report(True, self._capture.description)
        if buffer.flags & abi.BUF_FLAG_ERROR or buffer.bytesused == 0:
            self._slot.source.damaged(
                "marked as damaged by the driver" if buffer.bytesused else "an empty buffer"
            )
            return None
        stamp, t, t_sigma = self._exposure(buffer, now)
        if stamp is not StampKind.ARRIVAL and self._freshness.is_stale(t, self.sequence, now):
            self._slot.source.counts.stale += 1
            return None
        index, used, grey = buffer.index, buffer.bytesused, self._options.grey
        return RawFrame(
            t,
            t_sigma,
            self.sequence,
            stamp,
            decode=lambda: self._capture.decode(index, used, grey),
            release=lambda: self._capture.requeue(index),
        )

    def _exposure(self, buffer: abi.Buffer, now: float) -> tuple[StampKind, float, float]:
        """As `exposure_time`; the time of arrival where the stamp is on another clock."""
        period = self._capture.period
        t = kernel_stamp(buffer)
        believed = None if t is None else self._slot.source.exposure(t, now)
        if t is None or believed is None:
            return StampKind.ARRIVAL, now, period
        kind, middle, sigma = exposure_time(t, buffer.flags, period, self._options.exposure_us)
        return kind, middle, max(sigma, believed[1])

    def _count(self, camera_sequence: int) -> None:
        step = 1
        if self._camera_sequence is not None:
            step = (camera_sequence - self._camera_sequence) & 0xFFFFFFFF
            if not 1 <= step < 1 << 31:  # a driver that does not count, or starts again
                step = 1
        self._camera_sequence = camera_sequence
        self._slot.source.counts.lost += step - 1
        self.sequence += step
        self.received += 1


def kernel_stamp(buffer: abi.Buffer) -> float | None:
    """Stamp of a dequeued buffer [s], None where it is not on CLOCK_MONOTONIC by the driver's own word."""
    monotonic = buffer.flags & abi.BUF_FLAG_TIMESTAMP_MASK == abi.BUF_FLAG_TIMESTAMP_MONOTONIC
    return buffer.timestamp.tv_sec + 1e-6 * buffer.timestamp.tv_usec if monotonic else None


def exposure_time(
    t: float, flags: int, period: float, exposure_us: float | None
) -> tuple[StampKind, float, float]:
    """(kind of stamp, middle of the exposure [s], its sigma [s]) of a buffer with stamp t [s]."""
    half_exposure = 0.5e-6 * exposure_us if exposure_us is not None else 0.0
    sigma = KERNEL_STAMP_SIGMA_S
    if exposure_us is None:
        # It lies anywhere between none and a period, its middle between none and half of one.
        sigma = math.hypot(sigma, period / 2 / 12**0.5)
    if flags & abi.BUF_FLAG_TSTAMP_SRC_MASK == abi.BUF_FLAG_TSTAMP_SRC_SOE:
        return StampKind.EXPOSURE, t + half_exposure, sigma
    # The end of the frame comes after exposure *and* readout, and the readout, up to a period, is nobody's to know.
    # Its mean is a constant: `camera.time_offset_s` of the calibration takes it.
    return StampKind.READOUT, t - half_exposure, math.hypot(sigma, period / 12**0.5)


class Capture:
    """One opened, streaming device. `fd` is readable when a buffer is filled."""

    def __init__(self, fd: int, pix: abi.PixFormat, period: float, description: str) -> None:
        self.fd = fd
        self.size = (int(pix.width), int(pix.height))
        self.stride = int(pix.bytesperline)  # bytes
        self.fourcc = abi.fourcc_name(pix.pixelformat)
        self.period = period  # s
        self.description = description
        self.maps: list[mmap.mmap] = []
        self._stretch = Stretch()
        self._retired = False

    def dequeue(self) -> abi.Buffer | None:
        """The oldest filled buffer, None if there is none. Raises OSError when the device is gone."""
        buffer = abi.Buffer(type=abi.BUF_TYPE_VIDEO_CAPTURE, memory=abi.MEMORY_MMAP)
        try:
            fcntl.ioctl(self.fd, abi.VIDIOC_DQBUF, buffer)
        except BlockingIOError:
            return None
        return buffer

    def requeue(self, index: int) -> None:
        if self._retired:
            return
        buffer = abi.Buffer(type=abi.BUF_TYPE_VIDEO_CAPTURE, memory=abi.MEMORY_MMAP, index=index)
        # A device that is gone refuses; the next DQBUF tells.
        with contextlib.suppress(OSError):
            fcntl.ioctl(self.fd, abi.VIDIOC_QBUF, buffer)

    def decode(self, index: int, bytes_used: int, grey: bool) -> Image:
        """A copy of the image in a buffer; in any thread."""
        try:
            data = memoryview(self.maps[index])[:bytes_used]
        except (IndexError, ValueError):
            raise BadImage("the camera was closed before it was decoded") from None
        if self.fourcc in JPEG_FORMATS:
            return decode_jpeg(data, grey)
        return decode_raw(
            data, RawImage(self.fourcc, *self.size, self.stride), grey=grey, stretch=self._stretch
        )

    def retire(self) -> None:
        """Disable `requeue`. Called on the loop, as `requeue` is, so the two cannot meet."""
        self._retired = True

    def close(self) -> None:
        """Stop and release the device; blocking, once."""
        self.retire()
        with contextlib.suppress(OSError):
            fcntl.ioctl(self.fd, abi.VIDIOC_STREAMOFF, c_int32(abi.BUF_TYPE_VIDEO_CAPTURE))
        for mapped in self.maps:
            # The mappings keep the device's name taken: left open, a camera that comes back is another /dev/video*.
            # One that is being decoded cannot be closed; it goes with the decoder's last reference.
            with contextlib.suppress(BufferError):
                mapped.close()
        self.maps = []
        os.close(self.fd)


def open_capture(path: str, options: V4l2Options, size: tuple[int, int] | None) -> Capture:
    """Open a device and start it; blocking. size: (width, height) to ask for. Raises Away."""
    try:
        fd = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise CameraUnavailable(_why_not_opened(path, error)) from None
    driver = ""
    try:
        capability = abi.Capability()
        try:
            fcntl.ioctl(fd, abi.VIDIOC_QUERYCAP, capability)
        except OSError as error:
            raise CameraUnavailable(
                f"{path} is not a V4L2 device ({os.strerror(error.errno or 0)})"
            ) from None
        driver = capability.driver.decode("utf-8", "replace")
        _expect_capture_node(path, capability)
        pix = _set_format(path, fd, options.fourcc, size)
        remarks = _set_controls(fd, options)
        period = _set_rate(fd, options.fps)
        remarks += _remark_on_rate(period, options.fps)
        depth = " (16 bits, stretched to 8)" if abi.fourcc_name(pix.pixelformat) == "Y16" else ""
        name = f"{_card(capability)}: {abi.fourcc_name(pix.pixelformat)}{depth} "
        description = f"{name}{pix.width}x{pix.height} at {1 / period:.4g} fps{remarks}"
        capture = Capture(fd, pix, period, description)
    except CameraUnavailable as away:
        os.close(fd)
        if driver in LIBCAMERA_DRIVERS:
            raise CameraUnavailable(_needs_libcamera(driver, str(away))) from None
        raise
    except BaseException:
        os.close(fd)
        raise
    try:
        _start_streaming(path, capture, options.buffers)
    except CameraUnavailable as away:
        capture.close()
        if driver in LIBCAMERA_DRIVERS:
            raise CameraUnavailable(_needs_libcamera(driver, str(away))) from None
        raise
    return capture


def _expect_capture_node(path: str, capability: abi.Capability) -> None:
    flags = capability.capabilities
    if flags & abi.CAP_DEVICE_CAPS:
        flags = capability.device_caps
    card = _card(capability)
    if not flags & abi.CAP_VIDEO_CAPTURE:
        if flags & abi.CAP_VIDEO_CAPTURE_MPLANE:
            raise CameraUnavailable(
                f"{path} ({card}) captures multi-planar only, which is not supported: {CONVERT}"
            )
        raise CameraUnavailable(
            f"{path} ({card}) captures no video; cameras often have a second node for metadata, {_nodes(path)}"
        )
    if not flags & abi.CAP_STREAMING:
        raise CameraUnavailable(f"{path} ({card}) cannot stream into mapped buffers")


def _card(capability: abi.Capability) -> str:
    """The device's own name."""
    return plain(capability.card.decode("utf-8", "replace"))


def _set_format(path: str, fd: int, wanted: tuple[str, ...], size: tuple[int, int] | None) -> abi.PixFormat:
    """The first wanted format in the wanted size; else the first that the driver accepts in another."""
    offered = _offered_formats(fd)
    second_best: abi.PixFormat | None = None
    for name in wanted:
        if name not in offered:
            continue
        pix = _try_format(path, fd, name, size)
        if abi.fourcc_name(pix.pixelformat) != name:
            continue
        if size is None or (pix.width, pix.height) == size:
            return pix
        second_best = second_best or pix
    if second_best is None:
        readable = [name for name in offered if name in FORMATS]
        advice = (
            f"add {readable[0]} to fourcc= in the address"
            if readable
            else f"select another mode of the camera, or {CONVERT}"
        )
        raise CameraUnavailable(
            f"{path} offers {', '.join(offered) or 'no format'}, expected one of {', '.join(wanted)}: {advice}"
        )
    return _try_format(path, fd, abi.fourcc_name(second_best.pixelformat), size)


def _offered_formats(fd: int) -> list[str]:
    offered: list[str] = []
    for index in range(64):
        description = abi.FmtDesc(index=index, type=abi.BUF_TYPE_VIDEO_CAPTURE)
        try:
            fcntl.ioctl(fd, abi.VIDIOC_ENUM_FMT, description)
        except OSError:
            break
        offered.append(abi.fourcc_name(description.pixelformat))
    return offered


def _try_format(path: str, fd: int, name: str, size: tuple[int, int] | None) -> abi.PixFormat:
    """Ask for a format; the driver answers with the nearest it can."""
    request = abi.Format(type=abi.BUF_TYPE_VIDEO_CAPTURE)
    try:
        fcntl.ioctl(fd, abi.VIDIOC_G_FMT, request)
        request.fmt.pix.pixelformat = abi.fourcc(name)
        request.fmt.pix.field = abi.FIELD_NONE
        request.fmt.pix.bytesperline = 0
        if size is not None:
            request.fmt.pix.width, request.fmt.pix.height = size
        fcntl.ioctl(fd, abi.VIDIOC_S_FMT, request)
    except OSError as error:
        raise CameraUnavailable(_why_refused(path, f"refused {name}", error)) from None
    pix: abi.PixFormat = request.fmt.pix
    return abi.PixFormat.from_buffer_copy(pix)


def _set_controls(fd: int, options: V4l2Options) -> str:
    """Exposure and gain; returns a remark on what the camera refused. It works without, so that is no error."""
    refused = []
    if options.exposure_us is not None:
        steps = max(1, round(options.exposure_us / 100))
        manual = _set_control(fd, abi.CID_EXPOSURE_AUTO, abi.EXPOSURE_MANUAL)
        if not _set_control(fd, abi.CID_EXPOSURE_ABSOLUTE, steps) or not manual:
            refused.append("exposure_us")
    if options.gain is not None and not _set_control(fd, abi.CID_GAIN, options.gain):
        refused.append("gain")
    return f" (camera refused {' and '.join(refused)})" if refused else ""


def _set_control(fd: int, control: int, value: int) -> bool:
    try:
        fcntl.ioctl(fd, abi.VIDIOC_S_CTRL, abi.Control(id=control, value=value))
    except OSError:
        return False
    return True


def _set_rate(fd: int, fps: float | None) -> float:
    """Ask for a frame rate if one is wanted; returns the period [s] that the driver has set."""
    request = abi.StreamParm(type=abi.BUF_TYPE_VIDEO_CAPTURE)
    try:
        fcntl.ioctl(fd, abi.VIDIOC_G_PARM, request)
        if fps is not None and request.parm.capture.capability & abi.CAP_TIMEPERFRAME:
            period = Fraction(1 / fps).limit_denominator(100_000)
            request.parm.capture.timeperframe.numerator = period.numerator
            request.parm.capture.timeperframe.denominator = period.denominator
            fcntl.ioctl(fd, abi.VIDIOC_S_PARM, request)
    except OSError:
        return DEFAULT_FRAME_PERIOD_S  # the call is optional; frames will tell
    fraction = request.parm.capture.timeperframe
    if not fraction.numerator or not fraction.denominator:
        return DEFAULT_FRAME_PERIOD_S
    return float(min(max(fraction.numerator / fraction.denominator, 1e-3), 10.0))


def _remark_on_rate(period: float, fps: float | None) -> str:
    if fps is None or 1 / period > 0.8 * fps:
        return ""
    return f" ({fps:g} asked; a smaller size or fourcc=MJPG may be faster)"


def _start_streaming(path: str, capture: Capture, count: int) -> None:
    request = abi.RequestBuffers(count=count, type=abi.BUF_TYPE_VIDEO_CAPTURE, memory=abi.MEMORY_MMAP)
    try:
        fcntl.ioctl(capture.fd, abi.VIDIOC_REQBUFS, request)
        if request.count < 2:
            raise CameraUnavailable(f"{path} has {request.count} buffers, expected {count}")
        for index in range(request.count):
            buffer = abi.Buffer(index=index, type=abi.BUF_TYPE_VIDEO_CAPTURE, memory=abi.MEMORY_MMAP)
            fcntl.ioctl(capture.fd, abi.VIDIOC_QUERYBUF, buffer)
            capture.maps.append(
                mmap.mmap(capture.fd, buffer.length, mmap.MAP_SHARED, mmap.PROT_READ, offset=buffer.m.offset)
            )
            fcntl.ioctl(capture.fd, abi.VIDIOC_QBUF, buffer)
        fcntl.ioctl(capture.fd, abi.VIDIOC_STREAMON, c_int32(abi.BUF_TYPE_VIDEO_CAPTURE))
    except OSError as error:
        raise CameraUnavailable(_why_refused(path, "does not start", error)) from None


# Why not: sentences for people ------------------------------------------------------------------------------------


def _why_not_opened(path: str, error: OSError) -> str:
    if error.errno == errno.ENOENT:
        return f"{path} is not there, {_nodes(path)}; waiting for it"
    if error.errno in (errno.ENODEV, errno.ENXIO):
        return f"{path} is unplugged; waiting for it"
    if error.errno in (errno.EACCES, errno.EPERM):
        group = _group_of(path)
        return f"{path}: permission denied; run `sudo usermod -aG {group} $USER` and log in again"
    return _why_refused(path, "cannot be opened", error)


def _why_refused(path: str, what: str, error: OSError) -> str:
    if error.errno == errno.EBUSY:
        who = ", ".join(holders(path))
        return f"{path}: busy, held by {who or f'another process (`sudo fuser -v {path}` names it)'}"
    if error.errno == errno.ENOSPC:
        return f"{path} {what}: not enough USB bandwidth; use another port, a smaller size or fourcc=MJPG"
    if error.errno in (errno.ENODEV, errno.ENXIO):
        return f"{path} is unplugged; waiting for it"
    return f"{path} {what}: {error.strerror}"


def _why_lost(error: OSError) -> str:
    if error.errno in (errno.ENODEV, errno.ENXIO):
        return "unplugged; waiting for it"
    return f"lost: {error.strerror} (cable, power?); opening it again"


def _needs_libcamera(driver: str, why: str) -> str:
    return (
        f"{why}. The driver {driver} is one for libcamera and gives raw sensor data only: "
        "serve it as MJPEG over HTTP with a libcamera program and give that address"
    )


def _nodes(path: str) -> str:
    """What else there is, so that nobody has to look."""
    nodes = [node for node in sorted(glob.glob("/dev/video*")) if node != path]
    return f"there is {', '.join(nodes)}" if nodes else "and no other /dev/video*"


def _group_of(path: str) -> str:
    try:
        return grp.getgrgid(os.stat(path).st_gid).gr_name
    except (OSError, KeyError):
        return "video"


def holders(path: str) -> list[str]:
    """Other processes that have the file open, as `name (pid N)`; only those with readable descriptors."""
    target = os.path.realpath(path)
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        if int(process.name) == os.getpid():
            continue
        # Processes end while we look, and those of others are closed to us.
        with contextlib.suppress(OSError):
            if any(_points_to(link, target) for link in (process / "fd").iterdir()):
                found.append(f"{(process / 'comm').read_text().strip()} (pid {process.name})")
    return found


def _points_to(link: Path, target: str) -> bool:
    try:
        return os.readlink(link) == target
    except OSError:
        return False


def _close_unused(opening: asyncio.Future[Capture]) -> None:
    if not opening.cancelled() and opening.exception() is None:
        opening.result().close()
