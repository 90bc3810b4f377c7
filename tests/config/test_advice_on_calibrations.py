"""Advice on calibrations is followed: somebody does what a refusal says, and the file is read.

A new calibration (`calibrate again`) is made in tests/calibration; the other steps change the file or the config.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from support.calibrations import CX, CY, FX, FY, MATRIX, ORB_SLAM2, RADTAN, REALSENSE, VOXL, listed
from swarmtrack.config.camera_files import Calibration, load_calibration
from swarmtrack.config.drone import load_config
from swarmtrack.errors import CalibrationError, ConfigError
from swarmtrack.geometry.camera import PinholeCamera

INFO = f"height: 480\nwidth: 640\ndistortion_model: plumb_bob\nd: [{listed(RADTAN)}, 0.0]\nk: [{MATRIX}]\n"
KALIBR = (
    "cam0:\n  camera_model: pinhole\n  distortion_model: radtan\n"
    f"  distortion_coeffs: [{listed(RADTAN)}]\n  intrinsics: [{FX}, {FY}, {CX}, {CY}]\n  resolution: [640, 480]\n"
)
TURNED = "  T_imu_cam: [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
FLIPPED = "  T_cam_imu: [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
TWO = KALIBR + KALIBR.replace("cam0", "cam1")

Edit = Callable[[str], str]


def without(line: str) -> Edit:
    return lambda text: text.replace(line, "")


def again(old: str, new: str) -> Edit:
    return lambda text: text.replace(old, new)


# (text, camera asked for), advice; and for each way out of it the text or the name that it leads to.
STEPS: dict[str, tuple[str, str | None, str, list[tuple[Edit, str | None]]]] = {
    "a flipped mounting": (
        KALIBR + FLIPPED, None, "correct it, or remove it and write the mounting as camera.body_from_camera",
        [(again("[-1, 0, 0, 0]", "[1, 0, 0, 0]"), None), (without(FLIPPED), None)],
    ),
    "two mountings that contradict each other": (
        KALIBR + FLIPPED.replace("[-1,", "[1,") + TURNED, None,
        "expected only one of the two, or both consistent: correct it, or remove it",
        [(without(TURNED), None),
         (again("[[0, -1, 0, 0], [1, 0, 0, 0]", "[[1, 0, 0, 0], [0, 1, 0, 0]"), None)],
    ),
    "no size": (
        VOXL.replace("width: 640\nheight: 480\n", ""), None, "add a line with each",
        [(lambda text: f"{text}image_width: 640\nimage_height: 480\n", None)],
    ),
    "no width": (
        ORB_SLAM2.replace("Camera.width: 640\n", ""), None, "Camera.width: missing, .*: add a line with it",
        [(lambda text: f"{text}\nCamera.width: 640\n", None)],
    ),
    "several cameras": (
        TWO, None, r"\(cam0, cam1\), expected calibration_camera to name one", [(str, "cam0"), (str, "cam1")]
    ),
    "several modes": (REALSENSE, None, "expected calibration_camera to name one", [(str, "Color 640x480")]),
    "another name": (TWO, "left", "expected one named 'left': correct camera.calibration_camera", [(str, "cam1")]),
    "another name than the only one": (
        "%YAML:1.0\n" + INFO + "camera_name: front\n", "left", "named 'front', .* correct camera.calibration_camera",
        [(str, "front")],
    ),
    "numbers of another size": (
        INFO.replace("width: 640", "width: 2064").replace("height: 480", "height: 1544"), None, "correct the size, or ",
        [(lambda text: text.replace("2064", "640").replace("1544", "480"), None)],
    ),
    "an uncalibrated camera": (
        INFO.replace(MATRIX, listed((0.0,) * 9)), None, "expected a file written after its calibration",
        [(lambda _: INFO, None)],
    ),
}  # fmt: skip


def loaded(folder: Path, text: str, camera: str | None) -> Calibration:
    path = folder / "cam.yaml"
    path.write_text(text)
    return load_calibration(path, camera)


@pytest.mark.parametrize("name", STEPS)
def test_each_way_out_of_a_refused_calibration_is_one(tmp_path: Path, name: str) -> None:
    text, camera, advice, ways = STEPS[name]
    with pytest.raises(CalibrationError, match=advice):
        loaded(tmp_path, text, camera)
    for edit, named in ways:
        found = loaded(tmp_path, edit(text), named)
        assert (found.camera.width, found.camera.height) == (640, 480)


def test_the_file_that_another_one_names_is_taken_in_its_place(tmp_path: Path) -> None:
    with pytest.raises(
        CalibrationError, match=r"names another file, .* give that file as camera\.calibration"
    ):
        loaded(tmp_path, "cam0_calib: camera.yaml\nbody_T_cam0: 1\n", None)
    assert loaded(tmp_path, INFO, None).camera.width == 640


def test_a_lens_far_off_the_middle_is_taken_inline_as_the_refusal_says(tmp_path: Path) -> None:
    numbers = INFO.replace("width: 640", "width: 2064").replace("height: 480", "height: 1544")

    def configured(lens: str) -> PinholeCamera:
        path = tmp_path / "drone.toml"
        path.write_text(f'drone.id = 1\n[camera]\nsource = "http://127.0.0.1:9/stream"\n{lens}\n')
        section = load_config(path).camera
        return (
            load_calibration(section.calibration).camera
            if section.calibration is not None
            else section.lens_of(section.intrinsics)
        )

    (tmp_path / "cam.yaml").write_text(numbers)
    with pytest.raises(
        (CalibrationError, ConfigError), match=r"can be written inline, as camera\.intrinsics"
    ):
        configured('calibration = "cam.yaml"')
    inline = f"intrinsics = {{ fx = {FX}, fy = {FY}, cx = {CX}, cy = {CY}, width = 2064, height = 1544 }}"
    assert configured(inline).width == 2064
