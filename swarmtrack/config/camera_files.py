"""Camera calibration files as other tools write them: one table of dialects, `CALIBRATION_DIALECTS`.

What is read, whatever it is called: the size of the image, fx fy cx cy, the lens' distortion, the camera's place on
the IMU and the offset between the two clocks. What contradicts itself, or is a lens unlike any of ours, is refused with
a sentence `FILE: key: found, expected`. A field that changes the meaning of others (binning, a region of interest) is
applied.

Conventions that are easily taken the wrong way round:

* Kalibr's `T_cam_imu` takes IMU coordinates to the camera's, so it is `camera_from_imu`. OpenVINS writes its inverse
  as `T_imu_cam`, EuRoC as `T_BS` (body from sensor), ORB-SLAM3 as `IMU.T_b_c1`.
* Kalibr's `timeshift_cam_imu` is defined by t_imu = t_cam + shift. Our `time_offset_s` is defined by
  exposure time on the IMU's clock = frame stamp + time_offset_s, so the two are the same number with the same sign.
* The IMU's axes are those of whichever IMU was calibrated: FRD if it was the autopilot's own data, often FLU if it
  came through ROS. The file does not say; the config does (`camera.imu_frame`).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from swarmtrack.config.camera_tables import EQUIDISTANT, MOUNTING, CameraTable, LensNumbers
from swarmtrack.config.camera_text import OpencvMatrix, read_table, shown
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Array

MATRIX = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "CameraMatrix", "intrinsic_matrix", "K", "k", "M")
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
BROWN_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
CHOOSE = "correct camera.calibration_camera"
OAK_SOCKETS = "ABCDEFGH"
OAK_KINDS = {"0": "radtan", "1": "equidistant"}


@dataclass(frozen=True)
class Calibration:
    """A camera, and where and when it is relative to the IMU it was calibrated with, as far as the file says.

    imu_from_camera: in the axes of that IMU. time_offset_s: exposure on the IMU's clock = frame stamp + time_offset_s.
    notes: what was made of the file beyond reading it.
    """

    camera: PinholeCamera
    imu_from_camera: Pose | None = None
    time_offset_s: float | None = None
    name: str = ""
    source_format: str = ""
    notes: tuple[str, ...] = ()


class Dialect(NamedTuple):
    """Format of one tool. tool: its name, for people; signs: pattern of a key that only its files have; read: of the
    camera with this name, or of the only one.
    """

    tool: str
    signs: str
    read: Callable[[CameraTable, str | None], Calibration]


def load_calibration(path: str | Path, camera: str | None = None) -> Calibration:
    """Read a calibration file, and of several cameras in it the one named `camera`. Raises CalibrationError."""
    path = Path(path)
    file = CameraTable(path, read_table(path))
    keys = [str(key) for key in file.table]
    for dialect in CALIBRATION_DIALECTS:
        if any(re.fullmatch(dialect.signs, key) for key in keys):
            return dialect.read(file, camera)
    if file.has("cam0_calib"):
        file.refuse(
            "cam0_calib",
            "names another file, expected the calibration itself",
            "give that file as camera.calibration",
        )
    tools = ", ".join(dict.fromkeys(dialect.tool for dialect in CALIBRATION_DIALECTS))
    file.refuse(
        "",
        f"only the keys {shown(file.table)}, expected a calibration of {tools}",
    )


def _choose(file: CameraTable, names: Sequence[str], camera: str | None) -> str:
    """Which of several cameras."""
    listed = ", ".join(names)
    if not names:
        file.refuse("", "holds no camera, expected one at least")
    if camera is None and len(names) > 1:
        file.refuse("", f"{len(names)} cameras ({listed}), expected calibration_camera to name one", "")
    if camera is not None and camera not in names:
        file.refuse("", f"cameras {listed}, expected one named {camera!r}", CHOOSE)
    return camera or names[0]


def _only(file: CameraTable, calibration: Calibration, camera: str | None) -> Calibration:
    """The only camera of a file, which may be asked for by its name."""
    if camera is not None and camera != calibration.name:
        file.refuse("", f"one camera, named {calibration.name!r}, expected one named {camera!r}", CHOOSE)
    return calibration


# --- Kalibr, OpenVINS, EuRoC ------------------------------------------------------------------------------------------


def _camchain(file: CameraTable, camera: str | None) -> Calibration:
    names = [str(key) for key in file.table if re.fullmatch(r"cam\d+", str(key))]
    return _kalibr(file.inner(_choose(file, names, camera)))


def _kalibr(file: CameraTable) -> Calibration:
    """One camera of a camchain or camchain-imucam (github.com/ethz-asl/kalibr/wiki/yaml-formats), also OpenVINS'."""
    lens, notes = file.camera(_listed(file, "distortion_coeffs"))
    given = {}
    if file.has("T_cam_imu"):
        given["kalibr"] = file.pose("T_cam_imu").inverse()
    if file.has("T_imu_cam"):
        given["openvins"] = file.pose("T_imu_cam")
    poses = list(given.values())
    if len(poses) == 2 and not np.allclose((poses[0].inverse() @ poses[1]).rotation, np.eye(3), atol=1e-2):
        file.refuse(
            "T_imu_cam",
            "not the inverse of T_cam_imu, expected only one of the two, or both consistent",
            MOUNTING,
        )
    shift = file.number("timeshift_cam_imu") if file.has("timeshift_cam_imu") else None
    name = file.prefix.removesuffix(".") or file.path.stem
    form = "openvins" if list(given) == ["openvins"] else "kalibr"
    return Calibration(lens, poses[0] if poses else None, shift, name, form, notes)


def _euroc_or_kalibr(file: CameraTable, camera: str | None) -> Calibration:
    """sensor.yaml of a camera of the EuRoC MAV data set, ASL format; or a camera of Kalibr's by itself, or by hand."""
    if isinstance(by_hand := file.table["intrinsics"], dict) and "fx" in by_hand:
        return _flat_file(CameraTable(file.path, {**file.table, **by_hand}), camera)
    if file.has("camera_model") and not file.has("T_BS"):
        return _only(file, _kalibr(file), camera)
    lens, notes = file.camera(_listed(file, "distortion_coefficients"))
    pose = file.pose("T_BS") if file.has("T_BS") else None
    return _only(file, Calibration(lens, pose, None, file.path.parent.name, "euroc", notes), camera)


def _listed(file: CameraTable, coefficients: str) -> LensNumbers:
    """camera_model, intrinsics [of the projection …, fu, fv, cu, cv], resolution, distortion_model."""
    projection = file.text("camera_model", "pinhole")
    lengths = {"omni": 5, "eucm": 6, "ds": 6}
    numbers = [float(each) for each in file.numbers("intrinsics", (lengths.get(projection, 4),))]
    model = file.text("distortion_model")
    return LensNumbers(
        focal=(numbers[-4], numbers[-3]),
        centre=(numbers[-2], numbers[-1]),
        size=_size(file),
        projection=projection,
        shape=tuple(numbers[:-4]),
        model=model,
        coefficients=_coefficients(file, coefficients),
        keys=("intrinsics", "camera_model", "distortion_model", coefficients),
    )


# --- ROS, OpenCV, VOXL ------------------------------------------------------------------------------------------------


def _ros_or_opencv(file: CameraTable, camera: str | None) -> Calibration:
    return _only(file, _matrix_and_coefficients(file), camera)


def _opencv_pair(file: CameraTable, camera: str | None) -> Calibration:
    names = [key for key in ("M1", "M2") if file.has(key)]
    chosen = _choose(file, names, camera)
    return _matrix_and_coefficients(file, chosen, matrix=(chosen,), coefficients=(f"D{chosen[1:]}",))


def _matrix_and_coefficients(
    file: CameraTable,
    name: str | None = None,
    matrix: Sequence[str] = MATRIX,
    coefficients: Sequence[str] = COEFFICIENTS,
) -> Calibration:
    """A 3x3 matrix and a vector of coefficients, under one of many names."""
    key = file.find(matrix) or matrix[0]
    focal, centre = _of_matrix(file, key)
    model = file.text("distortion_model")
    if not model and file.text("fisheye_model") in ("1", "true"):
        model = "fisheye"
    if not model and file.text("camera_model") in EQUIDISTANT:
        model = file.text("camera_model")
    found = file.find(coefficients) or coefficients[0]
    said = LensNumbers(
        focal,
        centre,
        _size(file),
        model=model,
        coefficients=_coefficients(file, found),
        keys=("intrinsics", "camera_model", "distortion_model", found),
    )
    lens, notes = file.camera(said)
    lens, applied = _delivered(file, lens)
    return Calibration(
        lens,
        name=name or str(file.table.get("camera_name") or file.path.stem),
        source_format="opencv" if isinstance(file.table[key], OpencvMatrix) else "camera_info",
        notes=(*notes, *applied),
    )


def _of_matrix(file: CameraTable, key: str) -> tuple[tuple[float, float], tuple[float, float]]:
    """Focal lengths and principal point of a 3x3 matrix."""
    K = file.numbers(key, (3, 3))
    fx, fy = float(K[0, 0]), float(K[1, 1])
    if fx == 0.0:
        file.refuse(key, "fx is 0: the camera is uncalibrated, expected a file written after its calibration")
    if abs(K[0, 1]) > 1e-6 * abs(fx) or not np.array_equal(K[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]):
        file.refuse(key, f"{K.ravel().tolist()}, expected [fx, 0, cx, 0, fy, cy, 0, 0, 1]")
    return (fx, fy), (float(K[0, 2]), float(K[1, 2]))


def _coefficients(file: CameraTable, key: str) -> Array | None:
    return file.numbers(key) if file.has(key) else None


def _size(file: CameraTable) -> tuple[int, int]:
    """(width, height) of the image in pixels."""
    key = file.find(SIZE)
    if key is not None:
        return file.whole(key, *(float(each) for each in file.numbers(key, (2,))))
    width, height = file.find(WIDTH_KEYS), file.find(HEIGHT)
    if width is None or height is None:
        file.refuse(
            WIDTH_KEYS[0],
            "missing, expected the width and height of the images it was calibrated with",
            "add a line with each",
        )
    return file.size(width, height)


def _delivered(file: CameraTable, lens: PinholeCamera) -> tuple[PinholeCamera, tuple[str, ...]]:
    """The camera of the images that a ROS driver delivers: K is of the whole sensor, of which the images are a region
    of interest, binned (sensor_msgs/CameraInfo).
    """
    notes = []
    if file.has("roi"):
        lens, region = _cut(file.inner("roi"), lens)
        notes += region
    across, down = (int(file.number(key)) if file.has(key) else 0 for key in ("binning_x", "binning_y"))
    if not (0 <= across <= lens.width and 0 <= down <= lens.height):
        file.refuse("binning_x, binning_y", f"{across}, {down}, expected 0, 1, or pixels that become one")
    if across > 1 or down > 1:
        across, down = max(across, 1), max(down, 1)
        lens = lens.scaled(lens.width // across, lens.height // down)
        notes.append(f"binning {across} x {down} is applied: images are {lens.width} x {lens.height}")
    return lens, tuple(notes)


def _cut(file: CameraTable, lens: PinholeCamera) -> tuple[PinholeCamera, list[str]]:
    x, y, width, height = (
        file.number(key) if file.has(key) else 0.0 for key in ("x_offset", "y_offset", "width", "height")
    )
    if x == y == width == height == 0.0:
        return lens, []
    width, height = width or lens.width - x, height or lens.height - y
    if not (x >= 0.0 and y >= 0.0 and x + width <= lens.width and y + height <= lens.height):
        file.refuse(
            "", f"{width:g} x {height:g} at ({x:g}, {y:g}), expected a part of {lens.width} x {lens.height}"
        )
    size = file.whole("width, height", width, height)
    try:
        cut = replace(lens, cx=lens.cx - x, cy=lens.cy - y, width=size[0], height=size[1])
    except ValueError as error:
        file.refuse("", f"{error}, expected a region that the lens reaches")
    if size == (lens.width, lens.height):
        return lens, []
    return cut, [f"roi is applied: images are {size[0]} x {size[1]} at ({x:g}, {y:g})"]


def _ost(file: CameraTable, camera: str | None) -> Calibration:
    """ROS' camera calibrator, as text."""
    inner = file.inner("ost")
    inner = CameraTable(file.path, inner.table)
    names = [str(key) for key, value in inner.table.items() if key != "image" and value.get("camera_matrix")]
    name = _choose(file, names, camera)
    image, section = inner.inner("image"), inner.inner(name)
    focal, centre = _of_matrix(section, "camera_matrix")
    keys = ("camera_matrix", "", "distortion", "distortion")
    numbers = _coefficients(section, "distortion")
    lens, notes = section.camera(
        LensNumbers(focal, centre, image.size("width", "height"), coefficients=numbers, keys=keys)
    )
    return Calibration(lens, name=name, source_format="ost.txt", notes=notes)


# --- VINS, ORB-SLAM, Basalt -------------------------------------------------------------------------------------------


def _named(file: CameraTable, names: Sequence[str], prefix: str = "") -> Array | None:
    """Coefficients with a key each; None without any. Those behind the last that is there are left out."""
    there = [name for name in names if file.has(prefix + name)]
    if not there:
        return None
    last = 1 + max(names.index(name) for name in there)
    full = next(count for count in (1, 2, 3, 4, 5, 8) if count >= last)
    full = max(full, min(4, len(names)))
    return np.array([file.number(prefix + name) if file.has(prefix + name) else 0.0 for name in names[:full]])


def _vins(file: CameraTable, camera: str | None) -> Calibration:
    """VINS-Mono and VINS-Fusion, and camodocal, from which they have it."""
    kind = file.text("model_type", "pinhole")
    places = file.inner("projection_parameters")
    distortion = (
        file.inner("distortion_parameters")
        if file.has("distortion_parameters")
        else CameraTable(file.path, {})
    )
    size = _size(file)
    keys = ("projection_parameters", "model_type", "model_type", "distortion_parameters")
    model, projection = "radtan", "pinhole"
    shape: tuple[float, ...] = ()
    numbers = _named(distortion, BROWN_NAMES)
    focal, centre = ("fx", "fy"), ("cx", "cy")
    if kind == "kannala_brandt":
        model, focal, centre = "equidistant", ("mu", "mv"), ("u0", "v0")
        numbers = np.array([places.number(key) for key in ("k2", "k3", "k4", "k5")])
    elif kind == "mei":
        projection, focal, centre = "omni", ("gamma1", "gamma2"), ("u0", "v0")
        shape = (file.inner("mirror_parameters").number("xi"),)
    elif kind not in ("pinhole", "pinhole_full"):
        file.refuse("model_type", f"{kind!r} is not supported, expected PINHOLE, KANNALA_BRANDT or MEI")
    lens, notes = file.camera(
        LensNumbers(
            _pair(places, focal),
            _pair(places, centre),
            size,
            projection,
            shape,
            "" if numbers is None else model,
            numbers,
            keys,
        )
    )
    name = str(file.table.get("camera_name") or file.path.stem)
    return _only(file, Calibration(lens, _on_imu(file), None, name, "vins", notes), camera)


def _on_imu(file: CameraTable) -> Pose | None:
    """Where VINS' file says that the camera is on the IMU: from the camera's coordinates to the IMU's."""
    if file.has("body_T_cam0"):
        return file.pose("body_T_cam0")
    if not (file.has("extrinsicRotation") and file.has("extrinsicTranslation")):
        return None
    R = file.numbers("extrinsicRotation", (3, 3))
    T = np.column_stack([R, file.numbers("extrinsicTranslation", (3,))])
    return CameraTable(file.path, {"extrinsicRotation": T.tolist()}).pose("extrinsicRotation")


def _pair(file: CameraTable, keys: Sequence[str]) -> tuple[float, float]:
    return file.number(keys[0]), file.number(keys[1])


def _orb_slam(file: CameraTable, camera: str | None) -> Calibration:
    """ORB-SLAM2 and ORB-SLAM3: flat keys with dots."""
    names = [name for name in ("Camera", "Camera1", "Camera2") if file.has(f"{name}.fx")]
    name = _choose(file, names, camera)
    kind = file.text("Camera.type", "pinhole")
    models = {"pinhole": "radtan", "kannalabrandt8": "equidistant", "rectified": "none"}
    if kind not in models:
        file.refuse(
            "Camera.type",
            f"{kind!r} is not supported, expected PinHole, KannalaBrandt8 or Rectified",
        )
    for key in ("Camera.width", "Camera.height"):
        if not file.has(key):
            file.refuse(
                key, "missing, expected the size of the images it was calibrated with", "add a line with it"
            )
    order = ("k1", "k2", "k3", "k4") if models[kind] == "equidistant" else BROWN_NAMES
    numbers = None if kind == "rectified" else _named(file, order, f"{name}.")
    lens, notes = file.camera(
        LensNumbers(
            _pair(file, (f"{name}.fx", f"{name}.fy")),
            _pair(file, (f"{name}.cx", f"{name}.cy")),
            file.size("Camera.width", "Camera.height"),
            model="" if numbers is None else models[kind],
            coefficients=numbers,
            keys=(f"{name}.fx", "Camera.type", "Camera.type", f"{name}.k1"),
        )
    )
    on_imu = file.find(("IMU.T_b_c1", "Tbc"))
    pose = None if on_imu is None else file.pose(on_imu)
    if name == "Camera2" and pose is not None:
        pose = pose @ file.pose("Stereo.T_c1_c2") if file.has("Stereo.T_c1_c2") else None
    return Calibration(lens, pose, None, name, "orb_slam", notes)


BASALT_LENSES: dict[str, tuple[str, tuple[str, ...], str, tuple[str, ...]]] = {
    "ds": ("ds", ("xi", "alpha"), "", ()),
    "eucm": ("eucm", ("alpha", "beta"), "", ()),
    "ucm": ("eucm", ("alpha",), "", ()),
    "kb4": ("pinhole", (), "equidistant", ("k1", "k2", "k3", "k4")),
    "pinhole": ("pinhole", (), "", ()),
    "pinhole-radtan8": ("pinhole", (), "radtan", BROWN_NAMES),
    "fov": ("pinhole", (), "fov", ("w",)),
}
"""Our names of its projection and distortion, each with the keys of its numbers."""


def _basalt(file: CameraTable, camera: str | None) -> Calibration:
    """Basalt's calibration.json."""
    whole = file.inner("value0")
    lenses, sizes, poses = (whole.table.get(key) for key in ("intrinsics", "resolution", "T_imu_cam"))
    if not isinstance(lenses, list) or not isinstance(sizes, list) or len(sizes) < len(lenses):
        whole.refuse("intrinsics, resolution", "expected a list of each, with an entry per camera")
    name = _choose(file, [f"cam{i}" for i in range(min(len(lenses), 16))], camera)
    i = int(name.removeprefix("cam"))
    entry = CameraTable(file.path, {f"intrinsics[{i}]": lenses[i]}, whole.prefix).inner(f"intrinsics[{i}]")
    kind = entry.text("camera_type")
    if kind not in BASALT_LENSES:
        entry.refuse("camera_type", f"{kind!r} is not supported, expected {', '.join(BASALT_LENSES)}")
    projection, shape_keys, model, keys = BASALT_LENSES[kind]
    numbers = entry.inner("intrinsics")
    size = CameraTable(file.path, {"resolution": sizes[i]}, whole.prefix)
    lens, notes = numbers.camera(
        LensNumbers(
            _pair(numbers, ("fx", "fy")),
            _pair(numbers, ("cx", "cy")),
            size.whole("resolution", *(float(each) for each in size.numbers("resolution", (2,)))),
            projection,
            (*(numbers.number(key) for key in shape_keys), *((1.0,) if kind == "ucm" else ())),
            model,
            np.array([numbers.number(key) for key in keys]) if keys else None,
        )
    )
    pose = None
    if isinstance(poses, list) and len(poses) > i:
        place = CameraTable(file.path, {f"T_imu_cam[{i}]": poses[i]}, whole.prefix).inner(f"T_imu_cam[{i}]")
        q = np.array([place.number(key) for key in ("qw", "qx", "qy", "qz")])
        if not abs(float(np.linalg.norm(q)) - 1.0) < 1e-3:
            place.refuse("qw", f"norm of the quaternion is {np.linalg.norm(q):.3g}, expected 1", MOUNTING)
        pose = Pose(
            rotation.from_quaternion(q / np.linalg.norm(q)),
            np.array([place.number(key) for key in ("px", "py", "pz")]),
        )
    return Calibration(lens, pose, None, name, "basalt", notes)


# --- OAK, RealSense ---------------------------------------------------------------------------------------------------


def _oak(file: CameraTable, camera: str | None) -> Calibration:
    """The calibration in an OAK's EEPROM, as DepthAI dumps it."""
    said = file.table["cameraData"]
    pairs: list[Any] = list(said.items()) if isinstance(said, dict) else said
    found: dict[str, Any] = {}
    for pair in pairs if isinstance(pairs, list) else []:
        if isinstance(pair, list | tuple) and len(pair) == 2 and isinstance(pair[1], dict):
            number = int(pair[0]) if str(pair[0]).isascii() and str(pair[0]).isdigit() else -1
            known = 0 <= number < len(OAK_SOCKETS)
            found[f"CAM_{OAK_SOCKETS[number]}" if known else str(pair[0])[:40]] = pair[1]
    name = _choose(file, list(found), camera)
    entry = CameraTable(file.path, {name: found[name]}, "cameraData.").inner(name)
    kind = entry.text("cameraType", "0")
    if kind not in OAK_KINDS:
        entry.refuse("cameraType", f"{kind}, expected 0 (perspective) or 1 (fisheye)")
    focal, centre = _of_matrix(entry, "intrinsicMatrix")
    numbers = entry.numbers("distortionCoeff")
    numbers = numbers[:4] if kind == "1" else numbers
    lens, notes = entry.camera(
        LensNumbers(
            focal,
            centre,
            entry.size("width", "height"),
            model=OAK_KINDS[kind],
            coefficients=numbers,
            keys=("intrinsicMatrix", "cameraType", "cameraType", "distortionCoeff"),
        )
    )
    return Calibration(lens, name=name, source_format="oak", notes=notes)


def _realsense_report(file: CameraTable, camera: str | None) -> Calibration:
    """What `rs-enumerate-devices -c` prints."""
    table = file.inner("realsense").table
    name = _choose(file, [str(key) for key in table], camera)
    return _flat(CameraTable(file.path, table).inner(name), name)


def _flat_file(file: CameraTable, camera: str | None) -> Calibration:
    return _only(file, _flat(file, file.path.stem), camera)


def _flat(file: CameraTable, name: str) -> Calibration:
    """A number per key, as librealsense's own structure has them, and people who write by hand."""
    cx, cy = file.find(("ppx", "cx", "px")) or "cx", file.find(("ppy", "cy", "py")) or "cy"
    in_one = isinstance(file.table.get("distortion"), list)
    key = file.find(("coeffs", *COEFFICIENTS)) or ("distortion" if in_one else "coeffs")
    numbers = _coefficients(file, key) if file.has(key) else _named(file, BROWN_NAMES)
    model_keys = ("model", "distortion_model") if in_one else ("model", "distortion", "distortion_model")
    model_key = file.find(model_keys) or "distortion_model"
    model = file.text(model_key)
    lens, notes = file.camera(
        LensNumbers(
            _pair(file, ("fx", "fy")),
            _pair(file, (cx, cy)),
            _size(file),
            projection=file.text("camera_model", "pinhole"),
            model="" if model == "pinhole" else model,
            coefficients=numbers,
            keys=("fx", "camera_model", model_key, key),
        )
    )
    lens, applied = _delivered(file, lens)
    return Calibration(lens, name=name, source_format="realsense", notes=(*notes, *applied))


CALIBRATION_DIALECTS = (
    Dialect("Kalibr", r"cam\d+", _camchain),
    Dialect("OpenCV", r"M[12]", _opencv_pair),
    Dialect("Basalt", r"value0", _basalt),
    Dialect("OAK", r"cameraData", _oak),
    Dialect("RealSense", r"realsense", _realsense_report),
    Dialect("ROS", r"ost", _ost),
    Dialect("VINS", r"projection_parameters", _vins),
    Dialect("ORB-SLAM", r"Camera[12]?\.fx", _orb_slam),
    Dialect("EuRoC", r"intrinsics", _euroc_or_kalibr),
    Dialect("ROS", "|".join(MATRIX), _ros_or_opencv),
    Dialect("RealSense", r"fx", _flat_file),
)
"""In the order in which they are tried. VOXL's files are OpenCV's, OpenVINS' are Kalibr's."""
