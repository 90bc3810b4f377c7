"""Calibration files as the tools write them, and the ways they go wrong."""

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from support.places import writer
from swarmtrack.config.camera_files import load_calibration
from swarmtrack.errors import CalibrationError
from swarmtrack.geometry.camera import Equidistant, RadTan

# cam0 of the EuRoC MAV data set: body (IMU) from camera.
T_BS = np.array(
    [
        [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
        [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
        [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
K = [458.654, 457.296, 367.215, 248.375]
D = [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]

EUROC = f"""# General sensor definitions.
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)
T_BS:
  cols: 4
  rows: 4
  data: {T_BS.ravel().tolist()}
rate_hz: 20
resolution: [752, 480]
camera_model: pinhole
intrinsics: {K} #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: {D}
"""


def rows(T):
    return "\n".join(f"  - {row}" for row in T.tolist())


KALIBR = f"""cam0:
  T_cam_imu:
{rows(np.linalg.inv(T_BS))}
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: {D}
  distortion_model: radtan
  intrinsics: {K}
  resolution: [752, 480]
  rostopic: /cam0/image_raw
  timeshift_cam_imu: 0.0058
cam1:
  camera_model: pinhole
  distortion_coeffs: [-0.013, 0.0021, -1e-05, 3.4e-4]
  distortion_model: equidistant
  intrinsics: [190.97, 190.97, 254.9, 256.8]
  resolution: [512, 512]
"""

OPENVINS = f"""%YAML:1.0

cam0:
  T_imu_cam: #rotation from camera to IMU R_CtoI, position of camera in IMU p_CinI
{rows(T_BS)}
  camera_model: pinhole
  distortion_coeffs: {D}
  distortion_model: radtan
  intrinsics: {K}
  resolution: [752, 480]
  timeshift_cam_imu: 0.0058
"""

CAMERA_INFO = f"""image_width: 752
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [{K[0]}, 0, {K[2]}, 0, {K[1]}, {K[3]}, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: {[*D, 0.0]}
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
"""

TOPIC_ROS1 = f"""header:
  seq: 3
  frame_id: "cam"
height: 480
width: 752
distortion_model: "plumb_bob"
D: {[*D, 0.0]}
K: [{K[0]}, 0.0, {K[2]}, 0.0, {K[1]}, {K[3]}, 0.0, 0.0, 1.0]
R: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
---
header:
  seq: 4
"""

TOPIC_ROS2 = TOPIC_ROS1.replace("D:", "d:").replace("K:", "k:").replace("R:", "r:")

IMU_FROM_CAMERA = {"euroc", "kalibr", "openvins"}
FILES = {
    "euroc": (EUROC, "euroc"),
    "kalibr": (KALIBR.split("cam1:", maxsplit=1)[0], "kalibr"),
    "openvins": (OPENVINS, "openvins"),
    "camera_info": (CAMERA_INFO, "camera_info"),
    "topic of ROS 1": (TOPIC_ROS1, "camera_info"),
    "topic of ROS 2": (TOPIC_ROS2, "camera_info"),
}


@pytest.fixture
def write(tmp_path):
    return writer(tmp_path, "cam.yaml")


@pytest.mark.parametrize("name", FILES)
def test_one_camera_written_by_every_tool_is_the_same_camera(write, name):
    text, source_format = FILES[name]
    found = load_calibration(write(text))
    camera = found.camera
    assert [camera.fx, camera.fy, camera.cx, camera.cy] == K
    assert (camera.width, camera.height) == (752, 480)
    assert isinstance(camera.distortion, RadTan)
    assert camera.distortion.coefficients[:4] == tuple(D)
    assert found.source_format == source_format
    if name in IMU_FROM_CAMERA:
        assert np.allclose(found.imu_from_camera.rotation, T_BS[:3, :3], atol=1e-9)
        assert np.allclose(found.imu_from_camera.position, T_BS[:3, 3], atol=1e-9)
    else:
        assert found.imu_from_camera is None
    assert found.time_offset_s == (0.0058 if name in ("kalibr", "openvins") else None)


@pytest.mark.parametrize(
    "names", [("camera_matrix", "distortion_coefficients"), ("K", "D"), ("Camera_Matrix", "D")]
)
def test_what_opencv_writes_is_read(tmp_path, names):
    path = tmp_path / "opencv.yml"
    matrix = np.array([[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1.0]])
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Sat 01 Jan 2022 00:00:00")
    storage.write("image_width", 752)
    storage.write("image_height", 480)
    storage.write(names[0], matrix)
    storage.write(names[1], np.array([[*D, 0.0]]))
    storage.release()
    assert "!!opencv-matrix" in path.read_text()
    found = load_calibration(path)
    assert np.array_equal(found.camera.K, matrix)
    assert found.camera.distortion.coefficients == (*D, 0.0)
    assert found.source_format == "opencv"


def test_the_pixels_of_a_camera_that_was_read_are_opencvs(write):
    camera = load_calibration(write(CAMERA_INFO)).camera
    points = np.array([[0.3, -0.2, 1.0], [-0.5, 0.1, 2.0]])
    witness, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.K, np.array(D))
    assert np.allclose(camera.project(points)[0], witness[:, 0], atol=1e-9)


def test_of_several_cameras_one_must_be_named(write):
    path = write(KALIBR)
    with pytest.raises(
        CalibrationError, match=r"2 cameras \(cam0, cam1\), expected calibration_camera to name one"
    ):
        load_calibration(path)
    fisheye = load_calibration(path, "cam1")
    assert fisheye.name == "cam1"
    assert fisheye.camera.distortion == Equidistant((-0.013, 0.0021, -1e-05, 3.4e-4))
    assert fisheye.imu_from_camera is None
    with pytest.raises(CalibrationError, match="cameras cam0, cam1, expected one named 'cam2'"):
        load_calibration(path, "cam2")


def test_lens_models_go_by_many_names(write):
    def lens(model, coefficients):
        model_line = f"distortion_model: {model}" if model is not None else ""
        text = CAMERA_INFO.replace("distortion_model: plumb_bob", model_line)
        return load_calibration(write(text.replace(str([*D, 0.0]), str(coefficients)))).camera.distortion

    eight = (0.1, -0.2, 0.001, 0.002, 0.03, 0.4, -0.5, 0.6)
    assert lens("rational_polynomial", list(eight)) == RadTan(eight)
    assert lens("rational_polynomial", [*eight, 0, 0, 0, 0, 0, 0]) == RadTan(eight)
    assert lens(None, D) == RadTan(tuple(D))
    assert lens("plumb_bob", [0.0] * 5) is None
    assert lens("none", []) is None
    for name in ("equidistant", "kannala_brandt", "fisheye"):
        assert lens(name, [0.0] * 4) == Equidistant((0.0,) * 4)


REFUSED = [
    (KALIBR, "camera_model: pinhole", "camera_model: omni", r"cam0.intrinsics: 4 numbers, expected 5"),
    (KALIBR, "camera_model: pinhole", "camera_model: ocam", r"cam0.camera_model: 'ocam' is not supported"),
    (KALIBR, "model: radtan", "model: fov", r"cam0.distortion_coeffs: .* expected one angle in rad"),
    (KALIBR, "resolution", "was", r"cam0.image_width: missing"),
    (KALIBR, "[752, 480]", "[360, 480]", r"cam0.intrinsics: principal point \(367.215, 248.375\) outside"),
    (KALIBR, f"{K}", "[458.6, 457.2, 367.2]", r"cam0.intrinsics: 3 numbers, expected 4"),
    (
        KALIBR,
        f"{K}",
        "[0.0, 457.2, 367.2, 240]",
        r"cam0.intrinsics: focal lengths 0, 457.2, expected both above 0",
    ),
    (KALIBR, f"{D}", "[0.1, .nan, 0, 0]", r"cam0.distortion_coeffs: holds NaN"),
    (KALIBR, f"{D}", "[0.1, 0, 0]", r"cam0.distortion_coeffs: 3 numbers, expected 4, 5, 8, 12 or 14"),
    (KALIBR, f"{D}", "cheese", r"cam0.distortion_coeffs: cheese, expected numbers"),
    (
        OPENVINS,
        "0.0148655429818, -0.99",
        "-0.0148655429818, 0.99",
        r"cam0.T_imu_cam: det R = -1.000, a reflection",
    ),
    (OPENVINS, "0.999557249008", "0.97", r"cam0.T_imu_cam: rows of R are off orthonormal"),
    (OPENVINS, "[0.0, 0.0, 0.0, 1.0]", "[0.0, 0.0, 1.0, 1.0]", r"cam0.T_imu_cam: last row"),
    (CAMERA_INFO, f"[{K[0]}, 0,", "[0.0, 0,", r"camera_matrix: fx is 0: the camera is uncalibrated"),
    (CAMERA_INFO, f"[{K[0]}, 0,", f"[{K[0]}, 3.0,", r"camera_matrix: .* expected \[fx, 0, cx"),
    (CAMERA_INFO, "image_width: 752", "image_width: 75.2", r"image_width, image_height: 75.2 x 480"),
    (CAMERA_INFO, "image_width: 752", "", r"image_width: missing"),
    (
        CAMERA_INFO,
        "plumb_bob",
        "thin_prism_fisheye",
        r"distortion_model: 'thin_prism_fisheye' is not supported",
    ),
    (CAMERA_INFO, "camera_matrix:", "camera_matrix: [", r":\d+: .* expected valid YAML"),
    (
        CAMERA_INFO,
        "camera_matrix:",
        "matrix:",
        r"only the keys image_width, .* expected a calibration of Kalibr",
    ),
    (EUROC, "camera_model: pinhole", "camera_model: scaramuzza", r"camera_model: 'scaramuzza' is not supp"),
    (EUROC, EUROC, "just text", r"no keys in it"),
    (EUROC, EUROC, "", r"no keys in it"),
]


@pytest.mark.parametrize(("text", "old", "new", "words"), REFUSED)
def test_what_is_not_understood_or_contradicts_itself_is_refused_with_a_sentence(
    write, text, old, new, words
):
    assert old in text
    path = write(text.replace(old, new, 1))
    with pytest.raises(CalibrationError, match=words) as caught:
        load_calibration(path, "cam0" if "cam1:" in text else None)
    assert str(caught.value).startswith(str(path))
    assert ", expected" in str(caught.value)


def test_a_rotation_written_with_four_digits_is_taken_and_made_a_rotation(write):
    text = OPENVINS.replace(rows(T_BS), rows(T_BS.round(4)))
    found = load_calibration(write(text)).imu_from_camera
    assert np.allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-12)
    assert np.allclose(found.rotation, T_BS[:3, :3], atol=2e-4)


def test_both_transforms_that_contradict_each_other_are_refused(write):
    kalibr_too = f"  T_cam_imu:\n{rows(T_BS)}\n  camera_model"  # the inverse was forgotten
    with pytest.raises(CalibrationError, match="T_imu_cam: not the inverse of T_cam_imu"):
        load_calibration(write(OPENVINS.replace("  camera_model", kalibr_too)))


def test_files_that_are_not_there_or_no_text_are_refused(tmp_path):
    (tmp_path / "image.yaml").write_bytes(b"\x89PNG\xff\xfe")
    for path in (tmp_path / "none.yaml", tmp_path, tmp_path / "image.yaml"):
        with pytest.raises(CalibrationError, match="cannot be read"):
            load_calibration(path)


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.sampled_from([KALIBR, EUROC, CAMERA_INFO, OPENVINS]),
    st.integers(0, 900),
    st.integers(0, 40),
    st.binary(max_size=20),
)
def test_a_damaged_file_is_read_or_refused_but_never_worse(tmp_path, text, at, cut, garbage):
    raw = text.encode()
    path = tmp_path / "cam.yaml"
    path.write_bytes(raw[:at] + garbage + raw[at + cut :])
    message = ""
    try:
        load_calibration(path, "cam0" if text is KALIBR else None)
    except CalibrationError as error:
        message = str(error)
    assert message == "" or message.startswith(str(path))
