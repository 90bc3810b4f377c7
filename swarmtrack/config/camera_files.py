"""Camera calibration files as other tools write them: Kalibr, OpenVINS, ROS, OpenCV, EuRoC.

What is read, whatever it is called: the size of the image, fx fy cx cy, the lens' distortion, the camera's place on
the IMU and the offset between the two clocks. What contradicts itself, or is a model that we do not have, is refused
with a sentence `FILE: key: found, expected`.

Conventions that are easily taken the wrong way round:

* Kalibr's `T_cam_imu` takes IMU coordinates to the camera's, so it is `camera_from_imu`. OpenVINS writes its inverse
  as `T_imu_cam`, EuRoC as `T_BS` (body from sensor).
* Kalibr's `timeshift_cam_imu` is defined by t_imu = t_cam + shift. Our `time_offset_s` is defined by
  exposure time on the IMU's clock = frame stamp + time_offset_s, so the two are the same number with the same sign.
* The IMU's axes are those of whichever IMU was calibrated: FRD if it was the autopilot's own data, often FLU if it
  came through ROS. The file does not say; the config does (`camera.imu_frame`).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import yaml

from swarmtrack.errors import CalibrationError
from swarmtrack.geometry.camera import Distortion, Equidistant, PinholeCamera, RadTan
from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import is_rotation
from swarmtrack.messages import Array

MAX_CAMERA_FILE_BYTES = 1024 * 1024  # a calibration is a page
MOST_ENTRIES = 200_000
DEEPEST = 32  # levels
ROTATION_TOLERANCE = 2e-3  # entries of RRᵀ: files written by hand carry three or four digits

RADTAN = (
    "radtan",
    "plumb_bob",
    "rational_polynomial",
    "radial-tangential",
    "radial_tangential",
    "brown_conrady",
)
EQUIDISTANT = ("equidistant", "kannala_brandt", "kannala_brandt4", "fisheye")
NO_DISTORTION = ("none", "")

MATRIX = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "CameraMatrix", "intrinsic_matrix", "K", "k")
COEFFICIENTS = (
    "distortion_coefficients",
    "Distortion_Coefficients",
    "distortion_coeffs",
    "dist_coeffs",
    "dist_coeff",
    "distCoeffs",
    "DistCoeffs",
    "D",
    "d",
)
WIDTH_KEYS = ("image_width", "image_Width", "imageWidth", "width")
HEIGHT = ("image_height", "image_Height", "imageHeight", "height")
SIZE = ("image_size", "imageSize", "resolution", "img_size")


@dataclass(frozen=True)
class Calibration:
    """A camera, and where and when it is relative to the IMU it was calibrated with, as far as the file says.

    imu_from_camera: in the axes of that IMU. time_offset_s: exposure on the IMU's clock = frame stamp + time_offset_s.
    """

    camera: PinholeCamera
    imu_from_camera: Pose | None = None
    time_offset_s: float | None = None
    name: str = ""
    source_format: str = ""


def load_calibration(path: str | Path, camera: str | None = None) -> Calibration:
    """Read a calibration file, and of several cameras in it the one named `camera`. Raises CalibrationError."""
    path = Path(path)
    file = _CameraFile(path, _read(path))
    chain = [key for key in file.table if re.fullmatch(r"cam\d+", str(key))]
    if chain:
        return _kalibr(file.inner(_choose(file, chain, camera)))
    stereo: list[str] = [key for key in ("M1", "M2") if key in file.table]
    if stereo:
        chosen = _choose(file, stereo, camera)
        return _matrix_and_coefficients(file, chosen, matrix=(chosen,), coefficients=(f"D{chosen[1:]}",))
    if file.has("intrinsics"):
        calibration = _kalibr(file) if file.has("camera_model") and not file.has("T_BS") else _euroc(file)
    elif file.find(MATRIX):
        calibration = _matrix_and_coefficients(file)
    else:
        keys = ", ".join(str(key) for key in list(file.table)[:6])
        file.refuse(
            "", f"only the keys {keys}, expected a Kalibr, ROS camera_info, OpenCV or EuRoC calibration"
        )
    if camera is not None and camera != calibration.name:
        file.refuse("", f"one camera, named {calibration.name!r}, expected one named {camera!r}")
    return calibration


# libyaml's reads a page in a millisecond; that in Python, where libyaml is missing, takes a second for each 30 KB.
_BASE: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_BASE):  # type: ignore[misc]
    """YAML with OpenCV's matrices, which come out as `_Matrix`."""


class _Matrix(dict[str, Any]):
    """A mapping with rows, cols and data that was tagged !!opencv-matrix."""


def _opencv_matrix(loader: _Loader, node: yaml.Node) -> _Matrix:
    if not isinstance(node, yaml.MappingNode):
        raise yaml.constructor.ConstructorError(None, None, "an opencv-matrix without rows, cols and data")
    return _Matrix((str(key), value) for key, value in loader.construct_mapping(node, deep=True).items())


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _opencv_matrix)


def _read(path: Path) -> dict[str, Any]:
    """The first YAML document of a file, as a mapping."""
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_CAMERA_FILE_BYTES + 1)
        text = raw.decode()
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path, or bytes that are no UTF-8
        reason = getattr(error, "strerror", None) or "not text"
        raise CalibrationError(f"{path}: cannot be read ({reason}), expected a YAML file") from None
    if len(raw) > MAX_CAMERA_FILE_BYTES:
        raise CalibrationError(
            f"{path}: larger than {MAX_CAMERA_FILE_BYTES // 1024} KiB, expected a calibration in YAML"
        )
    # OpenCV, and OpenVINS after it, begin with `%YAML:1.0`, which is not YAML.
    text = re.sub(r"\A\ufeff?%YAML:1\.0\s*\n", "", text)
    try:
        _check_size(text)
        document = next(yaml.load_all(text, _Loader), None)
    except (yaml.YAMLError, ValueError, RecursionError, OverflowError, TypeError, AttributeError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "cannot be understood"
        raise CalibrationError(f"{path}{line}: {problem}, expected valid YAML") from None
    if not isinstance(document, dict):
        raise CalibrationError(f"{path}: no keys in it, expected a calibration in YAML")
    return document


def _check_size(text: str) -> None:
    """Raise YAMLError for a document that is far larger than its text once its aliases are followed, or too deep.

    Ten lines of aliases to aliases are a document of 10^10 entries, harmless until somebody merges or prints it.
    """
    sizes: dict[str, int] = {}  # entries behind each anchor
    open_nodes: list[tuple[str | None, int]] = [(None, 0)]
    for event in yaml.parse(text, _Loader):
        anchor, size = getattr(event, "anchor", None), 1
        match event:
            case yaml.DocumentEndEvent():
                return  # what follows is not read
            case yaml.AliasEvent():
                size = sizes.get(anchor or "", MOST_ENTRIES + 1)  # not there yet: it holds itself
                anchor = None
            case yaml.CollectionStartEvent():
                open_nodes.append((anchor, 1))
                if len(open_nodes) > DEEPEST:
                    raise _refused(f"nested more than {DEEPEST} deep", event.start_mark)
                continue
            case yaml.CollectionEndEvent():
                anchor, size = open_nodes.pop()
            case yaml.ScalarEvent():
                pass
            case _:
                continue
        if anchor is not None:
            sizes[anchor] = size
        around, so_far = open_nodes[-1]
        open_nodes[-1] = (around, so_far + size)
        if so_far + size > MOST_ENTRIES:
            raise _refused(f"more than {MOST_ENTRIES} entries, aliases followed", event.start_mark)


def _refused(problem: str, mark: Any) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=mark)


@dataclass(frozen=True)
class _CameraFile:
    """One mapping of a file, and how to complain about it."""

    path: Path
    table: dict[str, Any]
    prefix: str = ""

    def refuse(self, key: str, text: str) -> NoReturn:
        place = f"{self.prefix}{key}" if key else self.prefix.removesuffix(".")
        raise CalibrationError(f"{self.path}: {place}: {text}" if place else f"{self.path}: {text}")

    def has(self, key: str) -> bool:
        return self.table.get(key) is not None

    def find(self, keys: tuple[str, ...]) -> str | None:
        """The first of the keys that is there."""
        return next((key for key in keys if self.has(key)), None)

    def inner(self, key: str) -> _CameraFile:
        if not isinstance(self.table[key], dict):
            self.refuse(key, f"{self.table[key]!r}, expected a mapping")
        return _CameraFile(self.path, self.table[key], f"{self.prefix}{key}.")

    def text(self, key: str, default: str = "") -> str:
        value = self.table.get(key)
        return default if value is None else str(value).strip().lower()

    def numbers(self, key: str, *shapes: tuple[int, ...]) -> Array:
        """A matrix written as a list, a list of rows, or rows/cols/data, in the first shape that fits its size.

        No shape: flat, of any length.
        """
        value = self.table.get(key)
        if value is None:
            self.refuse(key, "missing")
        entries = value.get("data") if isinstance(value, dict) else value
        try:
            # PyYAML reads 1e-05 (no dot) as a string: float() takes it all the same.
            rows: list[Any] = entries if isinstance(entries, list) else [entries]
            flat = np.array([float(x) for row in rows for x in (row if isinstance(row, list) else [row])])
        except (TypeError, ValueError):
            self.refuse(key, f"{str(entries)[:60]}, expected numbers")
        if not np.isfinite(flat).all():
            self.refuse(key, "holds NaN or infinity, expected finite numbers")
        if not shapes:
            return flat
        for shape in shapes:
            if flat.size == np.prod(shape):
                return flat.reshape(shape)
        self.refuse(key, f"{flat.size} numbers, expected {' or '.join(str(np.prod(s)) for s in shapes)}")


def _choose(file: _CameraFile, names: list[str], camera: str | None) -> str:
    """Which of several cameras."""
    listed = ", ".join(names)
    if camera is None and len(names) > 1:
        file.refuse("", f"{len(names)} cameras ({listed}), expected calibration_camera to name one")
    if camera is not None and camera not in names:
        file.refuse("", f"cameras {listed}, expected one named {camera!r}")
    return camera or names[0]


def _kalibr(file: _CameraFile) -> Calibration:
    """One camera of a camchain or camchain-imucam (github.com/ethz-asl/kalibr/wiki/yaml-formats), also OpenVINS'."""
    camera = _listed_intrinsics(file, "distortion_coeffs")
    given = {}
    if file.has("T_cam_imu"):
        given["kalibr"] = _pose(file, "T_cam_imu").inverse()
    if file.has("T_imu_cam"):
        given["openvins"] = _pose(file, "T_imu_cam")
    poses = list(given.values())
    if len(poses) == 2 and not np.allclose((poses[0].inverse() @ poses[1]).rotation, np.eye(3), atol=1e-2):
        file.refuse(
            "T_imu_cam", "not the inverse of T_cam_imu, expected only one of the two, or both consistent"
        )
    shift = float(file.numbers("timeshift_cam_imu", (1,))[0]) if file.has("timeshift_cam_imu") else None
    name = file.prefix.removesuffix(".") or file.path.stem
    form = "openvins" if list(given) == ["openvins"] else "kalibr"
    return Calibration(camera, poses[0] if poses else None, shift, name, form)


def _euroc(file: _CameraFile) -> Calibration:
    """sensor.yaml of a camera of the EuRoC MAV data set, ASL format."""
    camera = _listed_intrinsics(file, "distortion_coefficients")
    pose = _pose(file, "T_BS") if file.has("T_BS") else None
    return Calibration(camera, pose, None, file.path.parent.name, "euroc")


def _listed_intrinsics(file: _CameraFile, coefficients: str) -> PinholeCamera:
    """Kalibr's and EuRoC's way: camera_model, intrinsics [fu, fv, cu, cv], resolution, distortion_model."""
    model = file.text("camera_model", "pinhole")
    if model != "pinhole":
        file.refuse(
            "camera_model", f"{model!r} is not supported, expected 'pinhole' (calibrate again with it)"
        )
    fx, fy, cx, cy = file.numbers("intrinsics", (4,))
    return _camera(file, (fx, fy, cx, cy), _size(file), coefficients if file.has(coefficients) else None)


def _matrix_and_coefficients(
    file: _CameraFile,
    name: str | None = None,
    matrix: tuple[str, ...] = MATRIX,
    coefficients: tuple[str, ...] = COEFFICIENTS,
) -> Calibration:
    """OpenCV's and ROS' way: a 3x3 matrix and a vector of coefficients, under one of many names."""
    key = file.find(matrix) or matrix[0]
    K = file.numbers(key, (3, 3))
    fx, fy = K[0, 0], K[1, 1]
    if fx == 0.0:
        file.refuse(key, "fx is 0: the camera is uncalibrated, expected a file written after its calibration")
    if abs(K[0, 1]) > 1e-6 * abs(fx) or not np.array_equal(K[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]):
        file.refuse(key, f"{K.ravel().tolist()}, expected [fx, 0, cx, 0, fy, cy, 0, 0, 1]")
    camera = _camera(file, (fx, fy, K[0, 2], K[1, 2]), _size(file), file.find(coefficients))
    opencv = isinstance(file.table[key], _Matrix)
    return Calibration(
        camera,
        name=name or str(file.table.get("camera_name") or file.path.stem),
        source_format="opencv" if opencv else "camera_info",
    )


def _size(file: _CameraFile) -> tuple[int, int]:
    """(width, height) of the image in pixels."""
    key = file.find(SIZE)
    if key is not None:
        width, height = file.numbers(key, (2,))
    else:
        width_key, height_key = file.find(WIDTH_KEYS), file.find(HEIGHT)
        if width_key is None or height_key is None:
            file.refuse(
                WIDTH_KEYS[0], "missing, expected the width and height of the images it was calibrated with"
            )
        key = f"{width_key}, {height_key}"
        width, height = file.numbers(width_key, (1,))[0], file.numbers(height_key, (1,))[0]
    if not (width >= 1 and height >= 1 and width == int(width) and height == int(height)):
        file.refuse(key, f"{width:g} x {height:g}, expected the size of the images in whole pixels")
    return int(width), int(height)


def _camera(
    file: _CameraFile,
    intrinsics: tuple[float, float, float, float],
    size: tuple[int, int],
    coefficients: str | None,
) -> PinholeCamera:
    """Checked against each other: numbers of another resolution, or in the wrong order, show in the principal point."""
    fx, fy, cx, cy = (float(number) for number in intrinsics)
    width, height = size
    if not (fx > 0.0 and fy > 0.0):
        file.refuse("intrinsics", f"focal lengths {fx:g}, {fy:g}, expected both above 0 px")
    if not (0.0 < cx < width and 0.0 < cy < height):
        found = f"principal point ({cx:g}, {cy:g}) outside of the image of {width} x {height}"
        file.refuse("intrinsics", f"{found}, expected numbers of one resolution")
    return PinholeCamera(fx, fy, cx, cy, width, height, _distortion(file, coefficients))


def _distortion(file: _CameraFile, key: str | None) -> Distortion | None:
    """The lens model by its name; without a name (OpenCV's files) by the number of coefficients."""
    model = file.text("distortion_model")
    if not model and file.text("fisheye_model") in ("1", "true"):
        model = "fisheye"
    if model not in RADTAN + EQUIDISTANT + NO_DISTORTION:
        file.refuse(
            "distortion_model", f"{model!r} is not supported, expected radtan (plumb_bob) or equidistant"
        )
    if key is None:
        if model in NO_DISTORTION:
            return None
        file.refuse(COEFFICIENTS[0], f"missing, expected the coefficients of {model}")
    coefficients = file.numbers(key)
    if model in EQUIDISTANT:
        if coefficients.size != 4:
            file.refuse(key, f"{coefficients.size} numbers, expected the 4 of {model}")
        return Equidistant(tuple(coefficients))
    if not coefficients.any():
        return None
    if model == "none":
        file.refuse(key, "not zero with distortion_model none, expected the name of the model")
    if coefficients.size in (12, 14) and not coefficients[8:].any():
        coefficients = coefficients[:8]
    if coefficients.size not in (4, 5, 8):
        more = " (thin prism and tilt are not supported)" if coefficients.size > 8 else ""
        file.refuse(key, f"{coefficients.size} numbers, expected 4, 5 or 8 of {model or 'OpenCV'}{more}")
    return RadTan(tuple(coefficients))


def _pose(file: _CameraFile, key: str) -> Pose:
    """A 4x4 transform, checked, and its rotation made exactly orthonormal."""
    T = file.numbers(key, (4, 4), (3, 4))
    R, position = T[:3, :3], T[:3, 3]
    if len(T) == 4 and not np.allclose(T[3], [0, 0, 0, 1], atol=1e-9):
        file.refuse(key, f"last row {T[3].tolist()}, expected [0, 0, 0, 1]")
    if np.linalg.det(R) < 0.0:
        file.refuse(
            key, f"det R = {np.linalg.det(R):.3f}, a reflection, expected a rotation (+1): an axis is flipped"
        )
    if not is_rotation(R, ROTATION_TOLERANCE):
        error = np.abs(R @ R.T - np.eye(3)).max()
        file.refuse(
            key, f"rows of R are off orthonormal by {error:.2g}, expected at most {ROTATION_TOLERANCE}"
        )
    u, _, vt = np.linalg.svd(R)
    return Pose(u @ vt, position)
