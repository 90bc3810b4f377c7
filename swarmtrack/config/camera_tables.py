"""Numbers of a calibration file, checked, and the camera that they are.

A reader of one dialect (`camera_files.py`) finds the numbers under that tool's names; what they must be like, and which
lens they make, is the same for all and stands here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np

from swarmtrack.errors import CalibrationError
from swarmtrack.geometry import foreign_lenses
from swarmtrack.geometry.camera import Equidistant, PinholeCamera, RadTan
from swarmtrack.geometry.foreign_lenses import FittedLens, ImagePlane, Model
from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import is_rotation
from swarmtrack.messages import Array

ROTATION_TOLERANCE = 2e-3  # entries of RRᵀ: files written by hand carry three or four digits
MOST_FIT_ERROR_PX = (
    1.0  # px in the worst corner, as far as a detection scatters: beyond, ours is another lens
)
OTHER_SIZE = (
    0.8  # times the image's middle, in both axes alike: a principal point there is another image's middle
)
ALIKE = 0.15  # share by which the two axes may differ then
# Sizes (width, height) px in which cameras deliver images: of one sensor, many are a part of it, or another's scaled.
COMMON_SIZES_PX = (
    (320, 240), (424, 240), (640, 360), (640, 400), (640, 480), (752, 480), (800, 600), (848, 480), (960, 540),
    (960, 720), (1024, 768), (1280, 720), (1280, 800), (1280, 960), (1280, 1024), (1456, 1088), (1600, 1200),
    (1640, 1232), (1920, 1080), (1920, 1200), (2028, 1520), (2048, 1536), (2560, 1440), (2592, 1944), (3840, 2160),
)  # fmt: skip
OFF_MIDDLE = 0.1  # logarithm of a ratio of sides: real principal points are rarely further off
FAR_NEARER = 0.25  # times the distance to the own size: so near, another size is meant
AGAIN = (
    "calibrate again with swarmtrack calibrate intrinsics, or with Kalibr's pinhole-radtan or pinhole-equi"
)
MOUNTING = "correct it, or remove it and write the mounting as camera.body_from_camera"

RADTAN = (
    "radtan",
    "plumb_bob",
    "rational_polynomial",
    "radial_tangential",
    "brown_conrady",
    "opencv",
)  # fmt: skip
EQUIDISTANT = ("equidistant", "equi", "kannala_brandt", "kannala_brandt4", "kannalabrandt8", "fisheye", "kb4")
NO_DISTORTION = ("none", "")
FIELD_OF_VIEW = ("fov", "ftheta")
# RealSense: `inverse` takes pixels to directions, `modified` differs in the order of its two parts.
BACKWARDS, MODIFIED = "inverse_brown_conrady", "modified_brown_conrady"
KNOWN_DISTORTIONS = (*RADTAN, *EQUIDISTANT, *NO_DISTORTION, *FIELD_OF_VIEW, BACKWARDS, MODIFIED)

PROJECTIONS = {
    "pinhole": "pinhole",
    "omni": "unified",
    "eucm": "extended unified",
    "ds": "double sphere",
}
"""Projections by Kalibr's names, with those for people."""
PROJECTION_NUMBERS: dict[str, tuple[tuple[str, float, float], ...]] = {
    "omni": (("xi", 0.0, 100.0),),
    "eucm": (("alpha", 0.0, 1.0), ("beta", 1e-3, 100.0)),
    "ds": (("xi", -1.0, 1.0), ("alpha", 0.0, 1.0)),
}
"""Numbers that a projection has of its own: name, least and largest."""


class LensNumbers(NamedTuple):
    """What a file says of a lens. shape: the projection's own numbers; model: of its distortion, as the file calls it;
    keys: names in the file of the intrinsics, the projection, the model and the coefficients, for errors.
    """

    focal: tuple[float, float]
    centre: tuple[float, float]
    size: tuple[int, int]
    projection: str = "pinhole"
    shape: tuple[float, ...] = ()
    model: str = ""
    coefficients: Array | None = None
    keys: tuple[str, str, str, str] = (
        "intrinsics",
        "camera_model",
        "distortion_model",
        "distortion_coefficients",
    )


@dataclass(frozen=True)
class CameraTable:
    """One mapping of a file, and how to complain about it."""

    path: Path
    table: dict[str, Any]
    prefix: str = ""

    def refuse(self, key: str, text: str, step: str = AGAIN) -> NoReturn:
        """Raise CalibrationError. text: what was found and expected; step: what to do next, or empty."""
        place = f"{self.prefix}{key}" if key else self.prefix.removesuffix(".")
        where = f"{self.path}: {place}" if place else str(self.path)
        raise CalibrationError(f"{where}: {text}: {step}" if step else f"{where}: {text}")

    def has(self, key: str) -> bool:
        return self.table.get(key) is not None

    def find(self, keys: Sequence[str]) -> str | None:
        """The first of the keys that is there."""
        return next((key for key in keys if self.has(key)), None)

    def inner(self, key: str) -> CameraTable:
        if not isinstance(self.table.get(key), dict):
            self.refuse(key, f"{str(self.table.get(key))[:60]!r}, expected a mapping")
        return CameraTable(self.path, self.table[key], f"{self.prefix}{key}.")

    def text(self, key: str, default: str = "") -> str:
        value = self.table.get(key)
        return default if value is None else str(value)[:80].strip().lower()

    def number(self, key: str) -> float:
        return float(self.numbers(key, (1,))[0])

    def numbers(self, key: str, *shapes: tuple[int, ...]) -> Array:
        """A matrix written as a list, a list of rows, or rows/cols/data, in the first shape that fits its size.

        No shape: flat, of any length.
        """
        value = self.table.get(key)
        if value is None:
            self.refuse(key, "missing, expected numbers")
        entries = value.get("data", value) if isinstance(value, dict) else value
        try:
            # PyYAML reads 1e-05 (no dot) as a string: float() takes it all the same.
            rows: list[Any] = entries if isinstance(entries, list) else [entries]
            flat = np.array([float(x) for row in rows for x in (row if isinstance(row, list) else [row])])
        except (TypeError, ValueError, OverflowError):
            self.refuse(key, f"{str(entries)[:60]}, expected numbers")
        if not np.isfinite(flat).all():
            self.refuse(key, "holds NaN or infinity, expected finite numbers")
        if not shapes:
            return flat
        for shape in shapes:
            if flat.size == np.prod(shape):
                return flat.reshape(shape)
        self.refuse(key, f"{flat.size} numbers, expected {' or '.join(str(np.prod(s)) for s in shapes)}")

    def size(self, width: str, height: str) -> tuple[int, int]:
        """(width, height) of the image in pixels."""
        return self.whole(f"{width}, {height}", self.number(width), self.number(height))

    def whole(self, key: str, width: float, height: float) -> tuple[int, int]:
        """The size, checked. key: where it stands."""
        if not (width >= 1 and height >= 1 and width == int(width) and height == int(height)):
            self.refuse(key, f"{width:g} x {height:g}, expected the size of the images in whole pixels")
        return int(width), int(height)

    def pose(self, key: str) -> Pose:
        """A 4x4 transform, checked, and its rotation made exactly orthonormal."""
        T = self.numbers(key, (4, 4), (3, 4))
        R, position = T[:3, :3], T[:3, 3]
        if len(T) == 4 and not np.allclose(T[3], [0, 0, 0, 1], atol=1e-9):
            self.refuse(key, f"last row {T[3].tolist()}, expected [0, 0, 0, 1]", MOUNTING)
        with np.errstate(all="ignore"):
            if not is_rotation(R, ROTATION_TOLERANCE):
                if np.linalg.det(R) < 0.0:
                    text = f"det R = {np.linalg.det(R):.3f}, a reflection, expected a rotation (+1): an axis is flipped"
                    self.refuse(key, text, MOUNTING)
                error = np.abs(R @ R.T - np.eye(3)).max()
                self.refuse(
                    key,
                    f"rows of R are off orthonormal by {error:.2g}, expected at most {ROTATION_TOLERANCE}",
                    MOUNTING,
                )
        u, _, vt = np.linalg.svd(R)
        return Pose(u @ vt, position)

    def camera(self, said: LensNumbers) -> tuple[PinholeCamera, tuple[str, ...]]:
        """The camera, and what a user should know of it. The numbers are checked against each other: those of another
        resolution, or in the wrong order, show in the principal point.
        """
        (fx, fy), (cx, cy), (width, height) = said.focal, said.centre, said.size
        intrinsics = said.keys[0]
        if not (fx > 0.0 and fy > 0.0):
            self.refuse(intrinsics, f"focal lengths {fx:g}, {fy:g}, expected both above 0 px")
        if not (0.0 < cx < width and 0.0 < cy < height):
            where = f"principal point ({cx:g}, {cy:g}) outside of the image of {width} x {height}"
            self.refuse(intrinsics, f"{where}, expected numbers of one resolution")
        self._check_middle(said)
        lens = ImagePlane(fx, fy, cx, cy, width, height)
        try:
            return self._lens(said, lens)
        except ValueError as error:
            self.refuse(intrinsics, f"make no camera ({error}), expected those of a real one")

    def _check_middle(self, said: LensNumbers) -> None:
        """Whether the principal point is the middle of an image of another size: one scaled, cut at two sides, or with
        width and height exchanged.
        """
        cx, cy = said.centre
        width, height = said.size
        meant = 2.0 * (cx + 0.5), 2.0 * (cy + 0.5)
        x, y = meant[0] / width, meant[1] / height
        is_scaled = abs(x / y - 1.0) < ALIKE and (max(x, y) < OTHER_SIZE or min(x, y) > 1.0 / OTHER_SIZE)
        off = _size_distance(meant, said.size)
        other = min(_size_distance(meant, size) for size in ((height, width), *COMMON_SIZES_PX))
        if is_scaled or (off > OFF_MIDDLE and other < FAR_NEARER * off):
            self.refuse(
                said.keys[0],
                f"principal point ({cx:g}, {cy:g}) in an image of {width} x {height}, the middle of one of "
                f"{2 * cx:.0f} x {2 * cy:.0f}; expected numbers and size of the same image",
                "correct the size, or calibrate again with the images that the drone will use (a lens that is really "
                "so far off its image's middle can be written inline, as camera.intrinsics)",
            )

    def _lens(self, said: LensNumbers, lens: ImagePlane) -> tuple[PinholeCamera, tuple[str, ...]]:
        """Our lens where it is one of ours, else the nearest."""
        _, projection, model_key, key = said.keys
        model = said.model.removeprefix("distortion.").replace("-", "_").replace(" ", "_")
        if said.projection not in PROJECTIONS:
            self.refuse(
                projection,
                f"{said.projection!r} is not supported, expected {', '.join(PROJECTIONS)}",
            )
        if model not in KNOWN_DISTORTIONS:
            self.refuse(
                model_key,
                f"{model!r} is not supported, expected radtan (plumb_bob), equidistant or fov",
            )
        for number, (name, least, most) in zip(
            said.shape, PROJECTION_NUMBERS.get(said.projection, ()), strict=True
        ):
            if not least <= number <= most:
                self.refuse(said.keys[0], f"{name} = {number:g}, expected {least:g} … {most:g}")
        numbers = self._coefficients(said, model, key)
        direct = said.projection == "pinhole"
        if direct and model in EQUIDISTANT:
            return PinholeCamera(*lens, Equidistant(tuple(numbers))), ()
        if direct and len(numbers) == 0:
            return PinholeCamera(*lens), ()
        if direct and model in (*RADTAN, *NO_DISTORTION) and len(numbers) <= 8:
            return PinholeCamera(*lens, RadTan(tuple(numbers))), ()
        with np.errstate(all="ignore"):
            fitted = self._fitted(said, model, numbers, lens)
        words = "a lens of Brown and Conrady" if model in (BACKWARDS, MODIFIED) else "its lens"
        words = f"the {PROJECTIONS[said.projection]} lens" if not direct else words
        words = "the field-of-view lens" if model in FIELD_OF_VIEW else words
        assert fitted.camera.distortion is not None
        ours = fitted.camera.distortion.name
        if not fitted.worst_px <= MOST_FIT_ERROR_PX:
            self.refuse(
                projection if not direct else model_key,
                f"{words} is {fitted.worst_px:.2g} px off the nearest {ours} one, expected at most "
                f"{MOST_FIT_ERROR_PX:g} px",
            )
        return fitted.camera, (f"{words} is read as {ours}, within {fitted.worst_px:.2g} px",)

    def _coefficients(self, said: LensNumbers, model: str, key: str) -> tuple[float, ...]:
        """Coefficients of the distortion, as many as the model has; () where it distorts nothing."""
        if said.coefficients is not None and said.coefficients.size == 0 and model in RADTAN:
            # As simulators write a lens without distortion.
            return ()
        if said.coefficients is None or said.coefficients.size == 0:
            if model in NO_DISTORTION:
                return ()
            self.refuse(key, f"missing, expected the coefficients of {model}")
        numbers = said.coefficients
        if model in EQUIDISTANT:
            if numbers.size > 4 and not numbers[4:].any():
                numbers = numbers[:4]
            if numbers.size != 4:
                self.refuse(key, f"{numbers.size} numbers, expected the 4 of {model}")
            return tuple(numbers)
        if not numbers.any():
            return ()
        if model == "none":
            self.refuse(key, "not zero with distortion_model none, expected the name of the model")
        if model in FIELD_OF_VIEW:
            if numbers[1:].any() or not 0.0 < abs(numbers[0]) < math.pi:
                self.refuse(key, f"{numbers.tolist()}, expected one angle in rad, below pi")
            return (abs(float(numbers[0])),)
        if numbers.size in (12, 14) and not numbers[8:].any():
            numbers = numbers[:8]
        if numbers.size not in (4, 5, 8, 12, 14):
            self.refuse(key, f"{numbers.size} numbers, expected 4, 5, 8, 12 or 14 of {model or 'OpenCV'}")
        return tuple(numbers)

    def _fitted(
        self, said: LensNumbers, model: str, numbers: tuple[float, ...], lens: ImagePlane
    ) -> FittedLens:
        """The lens of ours that is nearest."""
        if model == BACKWARDS and said.projection == "pinhole":
            rays, pixels = foreign_lenses.looked_back(foreign_lenses.brown(numbers), lens)
            return foreign_lenses.radtan_through(rays, pixels, lens)
        project = self._projection(said)
        bend = None
        if model in FIELD_OF_VIEW:
            bend = foreign_lenses.field_of_view(numbers[0])
        elif model == MODIFIED:
            bend = foreign_lenses.modified_brown(numbers)
        elif model in (*RADTAN, *NO_DISTORTION):
            bend = foreign_lenses.brown(numbers) if numbers else None
        else:
            self.refuse(
                said.keys[2], f"{model!r} on top of {said.projection!r} is not supported, expected radtan"
            )

        def places(rays: Array) -> Array:
            return project(rays) if bend is None else bend(project(rays))

        rays, pixels = foreign_lenses.projected(places, lens)
        if said.projection == "pinhole" and model not in FIELD_OF_VIEW:
            return foreign_lenses.radtan_through(rays, pixels, lens, numbers)
        # px per rad on the axis: where the search starts.
        slope = float(places(np.array([[1e-6, 0.0, 1.0]]))[0, 0]) / 1e-6
        if not 0.0 < slope < 1e3:
            raise ValueError("is undefined on its axis")
        return foreign_lenses.equidistant_through(
            rays, pixels, lens._replace(fx=lens.fx * slope, fy=lens.fy * slope)
        )

    def _projection(self, said: LensNumbers) -> Model:
        match said.projection, said.shape:
            case "omni", (xi,):
                return foreign_lenses.unified(xi)
            case "eucm", (alpha, beta):
                return foreign_lenses.extended_unified(alpha, beta)
            case "ds", (xi, alpha):
                return foreign_lenses.double_sphere(xi, alpha)
            case _:
                return foreign_lenses.pinhole


def _size_distance(a: tuple[float, float], b: tuple[float, float]) -> float:
    """How far the sides of two images are apart, by the logarithms of their ratios."""
    return math.hypot(math.log(a[0] / b[0]), math.log(a[1] / b[1]))
