"""Cameras by address."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from swarmtrack.camera_sources.address import DETECTS_BY_ITSELF, CameraAddress, nearest, parse_address
from swarmtrack.camera_sources.images import open_images
from swarmtrack.camera_sources.mjpeg import MjpegCamera
from swarmtrack.camera_sources.rtsp import RtspCamera
from swarmtrack.camera_sources.v4l2 import V4l2Camera
from swarmtrack.camera_sources.video import open_video_file
from swarmtrack.clock import Clock
from swarmtrack.errors import SourceError
from swarmtrack.sources import Camera

CAMERA_SOURCES: dict[str, Callable[..., Camera]] = {
    "v4l2": V4l2Camera,
    "file": open_video_file,
    "images": open_images,
    "http": MjpegCamera,
    "https": MjpegCamera,
    "rtsp": RtspCamera,
}


def open_camera(
    source: str, *, clock: Clock, size: tuple[int, int] | None = None, base: Path | None = None
) -> Camera:
    """The camera at an address; nothing is started before its `frames()`.

    size: (width, height) px of its calibration, frames of another are refused unless the address says `resize=1`;
    base: the folder that relative paths start from. Raises SourceError for what can never work.
    """
    address = known_address(source)
    if address.scheme == DETECTS_BY_ITSELF:
        raise SourceError(f"camera source {address}: sends no pictures, expected one of a camera")
    return CAMERA_SOURCES[address.scheme](address, clock=clock, size=size, base=base)


def known_address(source: str) -> CameraAddress:
    """The address, of a scheme that is known. Raises SourceError."""
    address = parse_address(source)
    known = {*CAMERA_SOURCES, DETECTS_BY_ITSELF}
    if address.scheme not in known:
        hint = nearest(address.scheme, known)
        # The rest may be a login: of a scheme that is not ours, nobody knows.
        raise SourceError(f'camera source {address.scheme}: unknown scheme "{address.scheme}"{hint}')
    return address
