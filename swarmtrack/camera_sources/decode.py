"""Decoders of camera bytes: uncompressed formats and JPEG."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from swarmtrack.camera_sources.frame_slot import BadImage
from swarmtrack.camera_sources.limits import MAX_DECODED_PIXELS
from swarmtrack.camera_sources.stretch import Stretch
from swarmtrack.messages import Image

# "As the sensor saw it": grey stays grey, and the EXIF orientation is ignored, which would turn the image under its
# calibration.
READ_FLAGS = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION


JPEG_PADDING = b"\0\r\n "
"""In front of an image, where a server separates it from its header by more than one line."""


class RawImage(NamedTuple):
    """Form of an uncompressed image. fourcc: one of `RAW_FORMATS`; stride: bytes per line, 0 for no padding."""

    fourcc: str
    width: int
    height: int
    stride: int = 0


def decode_raw(data: memoryview, form: RawImage, *, grey: bool, stretch: Stretch) -> Image:
    """Returns a copy, (height, width, 3) BGR, or (height, width) if it is grey or `grey` is asked. stretch: 16 bits."""
    fourcc, width, height, stride = form
    layout = RAW_FORMATS[fourcc]
    if layout.paired and (width % 2 or (layout.planes > 1 and height % 2)):
        raise BadImage(f"{width}x{height}, expected even numbers: {fourcc} comes in pairs")
    used = layout.bytes_per_pixel * width
    rows = height * layout.planes // 2 if layout.planes > 1 else height
    lines = _lines(data, used, rows, stride or used)
    if fourcc == "Y16":
        return stretch(np.ascontiguousarray(lines).view("<u2"))
    if fourcc == "GREY":
        return np.array(lines)
    if layout.planes > 1:
        if grey:
            return np.array(lines[:height])
        if layout.apart and stride > used:
            lines = np.concatenate((lines[:height], _chroma_lines(data, form)))
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(lines), layout.to_bgr), np.uint8)
    pixels = lines.reshape(height, width, layout.bytes_per_pixel)
    if layout.luma is None:
        image = np.array(pixels) if layout.to_bgr < 0 else cv2.cvtColor(pixels, layout.to_bgr)
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if grey else image, np.uint8)
    if grey:
        return np.array(pixels[:, :, layout.luma])
    return np.asarray(cv2.cvtColor(pixels, layout.to_bgr), np.uint8)


class RawLayout(NamedTuple):
    """Layout of an uncompressed format. bytes_per_pixel: of the first plane; to_bgr: OpenCV's conversion, -1 for none;
    luma: which byte of a pixel is its luma, None where none is; paired: two pixels share a colour; planes: 3 halves
    where the colour stands in planes below; apart: U and V in planes of their own, with lines of half the stride.
    """

    bytes_per_pixel: int
    to_bgr: int = -1
    luma: int | None = None
    paired: bool = False
    planes: int = 1
    apart: bool = False


RAW_FORMATS = {
    "GREY": RawLayout(1),
    "YUYV": RawLayout(2, cv2.COLOR_YUV2BGR_YUYV, 0, paired=True),
    "UYVY": RawLayout(2, cv2.COLOR_YUV2BGR_UYVY, 1, paired=True),
    "YVYU": RawLayout(2, cv2.COLOR_YUV2BGR_YVYU, 0, paired=True),
    "NV12": RawLayout(1, cv2.COLOR_YUV2BGR_NV12, paired=True, planes=3),
    "NV21": RawLayout(1, cv2.COLOR_YUV2BGR_NV21, paired=True, planes=3),
    "YU12": RawLayout(1, cv2.COLOR_YUV2BGR_I420, paired=True, planes=3, apart=True),
    "YV12": RawLayout(1, cv2.COLOR_YUV2BGR_YV12, paired=True, planes=3, apart=True),
    "BGR3": RawLayout(3),
    "RGB3": RawLayout(3, cv2.COLOR_RGB2BGR),
    "BGR4": RawLayout(4, cv2.COLOR_BGRA2BGR),
    "Y16": RawLayout(2),
}
"""By V4L2's names."""
JPEG_FORMATS = ("MJPG", "JPEG")


def _chroma_lines(data: memoryview, form: RawImage) -> Image:
    """Planes of U and V without padding, (height / 2, width) bytes."""
    _, width, height, stride = form
    if stride % 2:
        raise BadImage(f"{stride} bytes a line, expected an even number")
    planes = np.frombuffer(data, np.uint8, height * stride // 2, offset=height * stride)
    return np.ascontiguousarray(planes.reshape(height, stride // 2)[:, : width // 2]).reshape(-1, width)


def _lines(data: memoryview, used: int, height: int, stride: int) -> Image:
    """(height, used) bytes: of `stride` bytes a line the first `used`, the rest is padding."""
    if stride < used:
        raise BadImage(f"{stride} bytes a line, expected {used} or more")
    if len(data) < height * stride:
        raise BadImage(f"{len(data)} bytes, expected {height * stride}")
    return np.frombuffer(data, np.uint8, height * stride).reshape(height, stride)[:, :used]


def decode_jpeg(data: bytes | memoryview, grey: bool = False) -> Image:
    """A whole baseline or progressive JPEG. Returns (h, w, 3) BGR, or (h, w) if it is grey or `grey` is asked."""
    data = bytes(data).lstrip(JPEG_PADDING)
    check_pixels(data)
    # libjpeg fills what is missing with grey and OpenCV does not tell, so the end is looked for: behind the last scan's
    # start, since a thumbnail has an end of its own. What comes after it is padding, of any kind and length.
    if data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda"):
        raise BadImage("JPEG is cut short")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE if grey else READ_FLAGS)
    except cv2.error as error:
        raise BadImage(f"JPEG: {error.err}") from None
    if image is None:
        raise BadImage("JPEG cannot be decoded")
    return np.asarray(image, np.uint8)


def check_pixels(data: bytes) -> tuple[int, int]:
    """(width, height) of a JPEG; raises BadImage above the size of any camera."""
    width, height = jpeg_size(data)
    if width * height > MAX_DECODED_PIXELS:
        raise BadImage(f"JPEG claims {width}x{height}")
    return width, height


def jpeg_size(data: bytes) -> tuple[int, int]:
    """(width, height) from the frame header, without decoding. ITU-T T.81, annex B."""
    data = data.lstrip(JPEG_PADDING)
    if data[:2] != b"\xff\xd8":
        raise BadImage(f"not a JPEG: starts with {data[:4].hex(' ') or 'nothing'}")
    at = 2
    while at + 9 <= len(data):
        if data[at] != 0xFF:
            break
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
        elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # SOFn; the three are DHT, JPG, DAC
            height, width = int.from_bytes(data[at + 5 : at + 7]), int.from_bytes(data[at + 7 : at + 9])
            if width and height:
                return width, height
            break
        else:
            at += 2 + int.from_bytes(data[at + 2 : at + 4])
    raise BadImage("JPEG without a frame header")
