"""Decoders of camera bytes: YUYV, GREY and JPEG."""

from __future__ import annotations

import cv2
import numpy as np

from swarmtrack.camera_sources.frame_slot import BadImage
from swarmtrack.camera_sources.limits import MAX_DECODED_PIXELS
from swarmtrack.messages import Image

# "As the sensor saw it": grey stays grey, and the EXIF orientation is ignored, which would turn the image under its
# calibration.
READ_FLAGS = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION


JPEG_PADDING = b"\0\r\n "
"""In front of an image, where a server separates it from its header by more than one line."""


def decode_grey(data: memoryview, width: int, height: int, stride: int) -> Image:
    """8-bit grey, `stride` bytes per line. Returns a copy (height, width)."""
    return np.array(_lines(data, width, height, stride))


def decode_yuyv(data: memoryview, width: int, height: int, stride: int, grey: bool) -> Image:
    """YUYV 4:2:2, two pixels in four bytes. Returns (height, width, 3) BGR, or only the luma (height, width)."""
    if width % 2:
        raise BadImage(f"{width} pixels a line, expected an even number: YUYV comes in pairs")
    pixels = _lines(data, 2 * width, height, stride).reshape(height, width, 2)
    if grey:
        return np.array(pixels[:, :, 0])
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_YUV2BGR_YUYV), np.uint8)


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
