"""What a drone's config shares with those of its team: drones of one team are mostly built alike."""

from __future__ import annotations

import os
import re
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

from swarmtrack.config.drone import CameraSection, load_config
from swarmtrack.errors import ConfigError
from swarmtrack.setup.answers import Wiring
from swarmtrack.setup.texts import NO_MOUNT, as_toml, calibrated_lens, guessed_lens, known_lens


class LensPlan(NamedTuple):
    """Lines of [camera] about the lens. size: of the image, px; angle_deg: horizontal field of view of a guess; None:
    it was measured, or is simulated."""

    lines: list[str]
    size: tuple[int, int]
    angle_deg: float | None


class Sibling(NamedTuple):
    """What a drone takes from another one's config. mount: the value of body_from_camera; wiring: None without an
    autopilot."""

    file: Path
    source: str
    lens: LensPlan
    mount: str
    wiring: Wiring | None


def newest_sibling(folder: Path, but: Collection[Path]) -> Sibling | None:
    """From the newest drone's config in a folder that can be read and whose camera is a real one; but: not these."""
    files = [file for file in folder.glob("drone-*.toml") if file not in but and file.is_file()]
    for file in sorted(files, key=lambda file: file.stat().st_mtime_ns, reverse=True):
        try:
            config = load_config(file)
        except ConfigError:
            continue
        camera, link = config.camera, config.autopilot.link
        if len(config.cameras) > 1 or camera.simulated:
            continue
        mount = NO_MOUNT if camera.body_from_camera is None else as_toml(camera.body_from_camera.model_dump())
        wiring = None if link == "none" else Wiring(link, _notes(file))
        return Sibling(file, camera.source, _lens(camera, folder), mount, wiring)
    return None


def _lens(camera: CameraSection, folder: Path) -> LensPlan:
    if camera.calibration is not None:
        name = os.path.relpath(camera.calibration, folder.absolute())
        return LensPlan(calibrated_lens(name, camera.calibration_camera), (0, 0), None)
    assert camera.intrinsics is not None
    size = camera.intrinsics.width, camera.intrinsics.height
    angle = camera.guessed_angle_deg
    if angle is not None:
        return LensPlan(guessed_lens(size, round(angle, 1)), size, angle)
    distortion = camera.distortion.model_dump() if camera.distortion else None
    return LensPlan(known_lens(camera.intrinsics.model_dump(), distortion), size, None)


def _notes(file: Path) -> tuple[str, ...]:
    """The comment above its link."""
    above = re.search(r"((?:^# .*\n)+)link = ", file.read_text(encoding="utf-8"), re.MULTILINE)
    return tuple(line.removeprefix("# ") for line in above[1].splitlines()) if above else ()
