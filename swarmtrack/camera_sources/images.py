"""`images:` a folder of images, with the times of an EuRoC `data.csv` or at a fixed rate."""

from __future__ import annotations

import csv
import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from swarmtrack.camera_sources.address import CameraAddress, in_range, nearest, read_options
from swarmtrack.camera_sources.decode import READ_FLAGS
from swarmtrack.camera_sources.playback import PACES, Picture, PlaybackCamera, play
from swarmtrack.camera_sources.stretch import Stretch
from swarmtrack.clock import Clock
from swarmtrack.errors import SourceError

IMAGE_SUFFIXES = (".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp")


@dataclass(frozen=True, slots=True)
class ImagesOptions:
    pattern: str = "*"  # of file names, in the folder
    times: str = ""  # CSV `timestamp_ns,filename`, relative to the folder
    fps: float = 30.0  # where there are no times
    pace: str = "realtime"
    loop: bool = False
    resize: bool = False

    def __post_init__(self) -> None:
        if self.pace not in PACES:
            raise ValueError(f'pace: found "{self.pace}"{nearest(self.pace, PACES)}')
        in_range("fps", self.fps, 0.01, 1000)


class ImageFolder:
    """Images and their times. `size`: (width, height) px of the first readable one; note: what is done to them."""

    def __init__(self, folder: Path, options: ImagesOptions) -> None:
        """Raises SourceError if there is nothing to play."""
        if not os.path.isdir(folder):
            what = "is a file, expected a folder" if os.path.exists(folder) else "not found"
            raise SourceError(f"image folder {folder}: {what}")
        if options.times:
            self._index = read_times(folder / options.times, folder)
        else:
            paths = matching(folder, options.pattern)
            self._index = [(n / options.fps, path) for n, path in enumerate(paths)]
        if not self._index:
            raise SourceError(f'image folder {folder}: no image matches pattern "{options.pattern}"')
        self.period = (
            (self._index[-1][0] - self._index[0][0]) / (len(self._index) - 1)
            if len(self._index) > 1
            else 1 / options.fps
        )
        first = next((image for _, path in self._index if (image := read_image(path)) is not None), None)
        if first is None:
            raise SourceError(f"image folder {folder}: none of its {len(self._index)} images can be read")
        self.size = (first.shape[1], first.shape[0])
        bits = 8 * first.dtype.itemsize
        self.note = f"{bits} bits per pixel are stretched to 8" if bits > 8 else ""

    def play(self) -> Iterator[Picture]:
        stretch = Stretch()
        for sequence, (t, path) in enumerate(self._index):
            image = read_image(path)
            yield Picture(t, sequence, None if image is None else stretch(image))

    def ending(self, pictures: int) -> tuple[bool, str]:
        return True, f"ended after {pictures} images"


def read_image(path: Path) -> NDArray[Any] | None:
    """The image with its stored channels and depth; None if it is missing, damaged or not an image."""
    try:
        data = np.fromfile(path, np.uint8)
        return cv2.imdecode(data, READ_FLAGS | cv2.IMREAD_ANYDEPTH) if data.size else None
    except (OSError, cv2.error):
        return None


def matching(folder: Path, pattern: str) -> list[Path]:
    """Images in the folder by name, numbers in names by value: frame_9 before frame_10."""
    try:
        found = [path for path in folder.glob(pattern) if path.suffix.lower() in IMAGE_SUFFIXES]
    except (ValueError, NotImplementedError) as error:
        raise SourceError(f'image folder {folder}: pattern "{pattern}": {error}') from None

    def by_number(path: Path) -> list[tuple[int, str]]:
        return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]

    return sorted(found, key=by_number)


def read_times(path: Path, folder: Path) -> list[tuple[float, Path]]:
    """An EuRoC index: lines of `timestamp_ns,filename`. Returns (seconds since the first, image) in order."""
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise SourceError(f"image times {path}: {error.strerror}") from None
    index: list[tuple[float, Path]] = []
    first_ns = 0
    last = -math.inf
    for number, row in enumerate(csv.reader(lines), start=1):
        if not row or row[0].strip().startswith("#"):
            continue
        if len(row) < 2 or not row[0].strip().isdigit():
            raise SourceError(
                f"image times {path}:{number}: found {','.join(row)!r}, expected timestamp_ns,filename"
            )
        stamp_ns = int(row[0])
        if not index:
            first_ns = stamp_ns
        t = (stamp_ns - first_ns) / 1e9  # the difference first: a float holds an epoch in ns only to 0.2 µs
        if t <= last:
            raise SourceError(f"image times {path}:{number}: time does not grow ({stamp_ns} ns)")
        last = t
        index.append((t, folder / row[1].strip()))
    if not index:
        raise SourceError(f"image times {path}: no line with timestamp_ns,filename")
    return index


def open_images(
    address: CameraAddress, *, clock: Clock, size: tuple[int, int] | None, base: Path | None
) -> PlaybackCamera:
    """A folder of images as a camera."""
    options = read_options(address, ImagesOptions)
    return play(ImageFolder(address.path(base), options), address, options, clock=clock, size=size)
