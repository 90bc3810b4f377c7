"""One camera in the dialects of many tools; lenses unlike ours; fields that change the meaning of others."""

from __future__ import annotations

import json
import re

import cv2
import numpy as np
import pytest

from support.calibrations import (
    CALIBRATIONS,
    CX,
    CY,
    FISHEYE,
    FX,
    MATRIX,
    MEI,
    OAK_PRISM,
    ORB_SLAM2,
    RADTAN,
    REALSENSE,
    REALSENSE_BACK,
    VINS,
    XML,
    K,
    kalibr,
    opencv_matrix,
)
from support.places import ROOT, writer
from swarmtrack.agents.main import main
from swarmtrack.config.camera_files import CALIBRATION_DIALECTS, load_calibration
from swarmtrack.errors import CalibrationError
from swarmtrack.geometry.camera import Equidistant, RadTan


@pytest.fixture
def write(tmp_path):
    return writer(tmp_path, "cam.yaml")


SAME = [name for name, written in CALIBRATIONS.items() if written.lens is not None]


@pytest.mark.parametrize("name", SAME)
def test_one_camera_in_each_dialect_is_the_same_camera(write, name):
    written = CALIBRATIONS[name]
    found = load_calibration(write(written.text), written.camera)
    lens = found.camera
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == K
    assert (lens.width, lens.height) == (640, 480)
    assert isinstance(lens.distortion, Equidistant if written.lens == FISHEYE else RadTan)
    assert lens.distortion.coefficients == written.lens
    assert found.notes == ()


# --- lenses unlike ours: the textbook's pixel for a direction, and ours -----------------------------------------------

RAYS = np.array([[0.0, 0.0, 1.0], [0.3, -0.2, 1.0], [-0.5, 0.3, 0.9], [0.9, 0.6, 1.0], [-0.8, 0.1, 0.3]])


def sphere(xi, z, ray):
    return z + xi * np.linalg.norm(ray)


def textbook(name, ray):
    """Pixel of a direction by the equations of the paper of each model, one at a time."""
    x, y, z = ray
    d = np.linalg.norm(ray)
    if name in ("Kalibr omni", "VINS MEI"):
        u, v = x / (z + 1.9 * d), y / (z + 1.9 * d)
        p1, p2 = (0.0002, -0.0001) if name == "VINS MEI" else (0.0, 0.0)
        r2 = u * u + v * v
        radial = 1 - 0.1 * r2 + 0.05 * r2 * r2
        u, v = (
            u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u),
            v * radial + 2 * p2 * u * v + p1 * (r2 + 2 * v * v),
        )
        return 552.0 * u + CX, 551.0 * v + CY
    if name == "Kalibr eucm":
        rho = np.sqrt(1.05 * (x * x + y * y) + z * z)
        below = 0.58 * rho + 0.42 * z
        return 190.2 * x / below + CX, 190.4 * y / below + CY
    if name in ("Kalibr ds", "Basalt"):
        shifted = -0.17 * d + z
        below = 0.59 * np.sqrt(x * x + y * y + shifted**2) + 0.41 * shifted
        return 158.3 * x / below + CX, 158.4 * y / below + CY
    r = np.hypot(x / z, y / z)  # fov
    scale = np.arctan(2 * r * np.tan(0.95 / 2)) / (0.95 * r) if r else 1.0
    return 300.0 * scale * x / z + CX, 300.0 * scale * y / z + CY


@pytest.mark.parametrize(
    "name", ["Kalibr omni", "VINS MEI", "Kalibr eucm", "Kalibr ds", "Basalt", "Kalibr fov"]
)
def test_another_lens_model_gives_the_pixels_of_its_paper(write, name):
    found = load_calibration(write(CALIBRATIONS[name].text))
    lens = found.camera
    expected = np.array([textbook(name, ray) for ray in RAYS])
    pixels, _, valid = lens.project(RAYS)
    inside = lens.contains(expected)
    assert inside[:3].all()
    assert valid[inside].all()
    assert np.abs(pixels - expected)[inside].max() < 0.25
    assert re.search(r"is read as equidistant, within 0\.\d+ px", found.notes[0])


def test_a_thin_prism_is_read_to_a_third_of_a_pixel_of_opencvs(write):
    found = load_calibration(write(OAK_PRISM))
    coefficients = np.array([9.49, -102.07, 0.0008, 0.002, 401.2, 9.26, -101.1, 398.6])
    prism = np.array([0.0012, -0.0003, -0.0008, 0.0001, 0.0, 0.0])
    points = RAYS[:4] / RAYS[:4, 2:]
    matrix = np.array([[K[0], 0, CX], [0, K[1], CY], [0, 0, 1]])
    expected, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), matrix, np.concatenate([coefficients, prism])
    )
    inside = found.camera.contains(expected[:, 0])
    assert np.abs(found.camera.project(points)[0] - expected[:, 0])[inside].max() < 0.35
    assert "within 0." in found.notes[0]


def test_a_lens_of_realsense_that_is_written_backwards_is_turned_around(write):
    lens = load_calibration(write(REALSENSE_BACK)).camera
    pixel = np.array([[520.0, 400.0]])
    x, y = ((pixel - [CX, CY]) / K[:2])[0]
    k1, k2, p1, p2 = RADTAN
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2 * r2
    ray = np.array(
        [
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y),
                1.0,
            ]
        ]
    )
    assert lens.project(ray)[0] == pytest.approx(pixel, abs=0.1)


def test_a_lens_too_far_from_ours_is_refused_with_the_next_step(write):
    text = OAK_PRISM.replace("0.0012, -0.0003", "0.12, -0.03")
    with pytest.raises(
        CalibrationError, match=r"px off the nearest radtan one, expected at most 1 px: calibrate again"
    ):
        load_calibration(write(text))


# --- fields that change the meaning of others -------------------------------------------------------------------------

INFO = f"""height: 480
width: 640
distortion_model: plumb_bob
d: [{", ".join(map(str, RADTAN))}, 0.0]
k: [{MATRIX}]
"""


def test_binning_is_applied(write):
    found = load_calibration(write(INFO + "binning_x: 2\nbinning_y: 2\n"))
    whole = load_calibration(write(INFO)).camera
    assert (found.camera.width, found.camera.height) == (320, 240)
    assert found.camera.project(RAYS[1:2])[0] == pytest.approx((whole.project(RAYS[1:2])[0] + 0.5) / 2 - 0.5)
    assert found.notes == ("binning 2 x 2 is applied: images are 320 x 240",)


def test_binning_is_applied_in_a_flat_file_too(write):
    found = load_calibration(write(FLAT + "binning_x: 2\nbinning_y: 2\n"))
    assert (found.camera.width, found.camera.height, found.camera.fx) == (320, 240, 230.25)
    assert found.notes == ("binning 2 x 2 is applied: images are 320 x 240",)


def test_a_region_of_interest_is_applied_before_binning(write):
    text = INFO + "binning_x: 2\nbinning_y: 2\nroi: {x_offset: 100, y_offset: 60, width: 400, height: 300}\n"
    found = load_calibration(write(text))
    assert (found.camera.width, found.camera.height) == (200, 150)
    assert found.camera.cx == pytest.approx((CX - 100 + 0.5) / 2 - 0.5)
    assert found.camera.fx == FX / 2
    assert len(found.notes) == 2


@pytest.mark.parametrize(
    "more", ["binning_x: 0\nbinning_y: 0\n", "binning_x: 1\n", "roi: {x_offset: 0, width: 0}\n"]
)
def test_none_is_none(write, more):
    found = load_calibration(write(INFO + more))
    assert (found.camera.width, found.camera.fx, found.notes) == (640, FX, ())


OTHER_SIZE = (
    r"principal point \(322.2, 241.7\) in an image of 2064 x 1544, the middle of one of 644 x 483; expected"
)
REFUSED = [
    (INFO, "width: 640", "width: 2064", "height: 480", "height: 1544", OTHER_SIZE),
    (VINS, "width: 640", "width: 320", "height: 480", "height: 240", r"principal point .* outside of the image"),
    (VINS, "PINHOLE", "SCARAMUZZA", "", "", r"'scaramuzza' is not supported, expected PINHOLE"),
    (VINS, "   fx: 460.5\n", "", "", "", r"projection_parameters.fx: missing"),
    (MEI, "xi: 1.9", "xi: cheese", "", "", r"mirror_parameters.xi: cheese, expected numbers"),
    (ORB_SLAM2, "Camera.width: 640\n", "", "", "", r"Camera.width: missing, expected the size of the images"),
    (ORB_SLAM2, "Camera.fps", "Camera.type: Fisheye\nx", "", "", r"Camera.type: 'fisheye' is not supported"),
    (INFO, "d: [", "roi: {x_offset: 600, width: 400, height: 480}\nd: [", "", "", r"roi: 400 x 480 at \(600, 0\)"),
    (INFO, "d: [", "binning_x: 9999\nd: [", "", "", r"binning_x, binning_y: 9999, 0, expected"),
    (XML, "camera_matrix", "matrix", "camera_matrix", "matrix", r"only the keys image_width, .* expected a calib"),
    (XML, "</rows>", "", "", "", r":\d+: mismatched tag, expected valid XML"),
    (INFO, "k: [", "cam0_calib: a.yaml\nother: [", "", "", r"cam0_calib: names another file"),
    (kalibr("ds", f"-0.17, 7.0, 158.3, 158.4, {CX}, {CY}"), "", "", "", "", r"cam0\.intrinsics: alpha = 7, exp"),
    (REALSENSE, "", "", "", "", r"2 cameras \(Color 1280x720, Color 640x480\), expected calibration_camera"),
    (INFO, INFO, "intrinsics: {a: 1}", "", "", r"intrinsics: .*a.*: 1.*, expected numbers"),
    (kalibr("omni", f"1.2, 460.5, 459.1, {CX}, {CY}"), "none", "equi", "[]", "[0.1, 0, 0, 0]", r"on top of 'omni'"),
    (INFO, INFO, "# Camera list\n1 OPENCV 640 480 460 460 320 240\n", "", "", "no keys in it"),
    (INFO, INFO, "cam0 (/a):\n    type: <class 'a'>\n    b: [1 2] +- [0 0]\n", "", "", "expected valid YAML"),
    (json.dumps({"cameraData": []}), "", "", "", "", r"holds no camera"),
    (json.dumps({"value0": {"intrinsics": 3}}), "", "", "", "", r"value0\.intrinsics, resolution: expected a list"),
]  # fmt: skip


NEXT_STEP = re.compile(
    r": (calibrate again with|correct |add a line|give that file)|expected calibration_camera"
)


@pytest.mark.parametrize(("text", "old", "new", "older", "newer", "words"), REFUSED)
def test_what_no_dialect_means_is_refused_with_a_sentence(write, text, old, new, older, newer, words):
    assert old in text
    path = write(text.replace(old, new, 1).replace(older, newer))
    with pytest.raises(CalibrationError, match=words) as caught:
        load_calibration(path)
    assert str(caught.value).startswith(str(path))
    assert "expected" in str(caught.value)
    assert NEXT_STEP.search(str(caught.value))


@pytest.mark.parametrize(
    ("made_for", "size"),
    [
        ((640, 480), (640, 360)),
        ((1280, 960), (1280, 720)),
        ((1280, 800), (1280, 720)),
        ((1280, 720), (1280, 960)),
        ((800, 600), (960, 720)),
        ((1280, 720), (640, 480)),
        ((640, 480), (480, 640)),
    ],
)
def test_numbers_of_another_size_are_refused_whichever_side_was_cut(write, made_for, size):
    """The principal point is some per cent off its image's middle, as those of real cameras."""
    cx, cy = 0.505 * made_for[0], 0.497 * made_for[1]
    text = f"fx: 700\nfy: 700\ncx: {cx}\ncy: {cy}\nwidth: {{}}\nheight: {{}}\n"
    assert load_calibration(write(text.format(*made_for))).camera.cx == cx
    with pytest.raises(CalibrationError, match=r"the middle of one of|outside of the image"):
        load_calibration(write(text.format(*size)))


@pytest.mark.parametrize("off", [(0.04, -0.03), (-0.04, 0.0), (0.0, 0.045), (0.1, 0.03)])
@pytest.mark.parametrize("size", [(640, 480), (752, 480), (1280, 720), (1280, 800), (1920, 1080)])
def test_a_principal_point_somewhat_off_the_middle_is_taken(write, size, off):
    cx, cy = ((0.5 + off[i]) * size[i] for i in range(2))
    text = f"fx: 700\nfy: 700\ncx: {cx}\ncy: {cy}\nwidth: {size[0]}\nheight: {size[1]}\n"
    assert load_calibration(write(text)).camera.cx == cx


def test_vins_says_where_the_camera_is_on_the_imu(write):
    turned = "0, 0, 1, 1, 0, 0, 0, 1, 0"
    text = (
        VINS
        + opencv_matrix("extrinsicRotation", 3, 3, turned)
        + opencv_matrix("extrinsicTranslation", 3, 1, "1, 2, 3")
    )
    pose = load_calibration(write(text)).imu_from_camera
    assert pose.position.tolist() == [1.0, 2.0, 3.0]
    assert pose.rotation[:, 2].tolist() == [1.0, 0.0, 0.0]
    with pytest.raises(CalibrationError, match=r"extrinsicRotation: det R = -1\.000, a reflection"):
        load_calibration(write(text.replace(turned, turned.replace("0, 0, 1,", "0, 0, -1,", 1))))


def test_an_empty_list_is_a_lens_without_distortion(write):
    assert load_calibration(write(re.sub(r"d: \[.*\]", "d: []", INFO))).camera.distortion is None
    with pytest.raises(CalibrationError, match="missing, expected the coefficients of equidistant"):
        load_calibration(write(re.sub(r"d: \[.*\]", "d: []", INFO).replace("plumb_bob", "equidistant")))


FLAT = "fx: 460.5\nfy: 459.1\ncx: 322.2\ncy: 241.7\nwidth: 640\nheight: 480\n"


@pytest.mark.parametrize(
    ("more", "lens"),
    [
        ("", None),
        ("model: pinhole\n", None),
        ("k1: -0.29\nk2: 0.08\np1: 0.0001\np2: 0.0002\n", RadTan(RADTAN)),
        (f"distortion: {list(RADTAN)}\n", RadTan(RADTAN)),
        (f"distortion_model: equidistant\ndist_coeffs: {list(FISHEYE)}\n", Equidistant(FISHEYE)),
    ],
)
def test_a_file_by_hand_is_read(write, more, lens):
    assert load_calibration(write(FLAT + more)).camera.distortion == lens


def test_a_file_by_hand_may_hold_its_intrinsics_in_one_mapping(write):
    text = f"intrinsics: {{fx: 460.5, fy: 459.1, cx: {CX}, cy: {CY}}}\nwidth: 640\nheight: 480\n"
    assert load_calibration(write(text)).camera == load_calibration(write(FLAT)).camera


def test_a_projection_that_is_named_is_not_passed_over(write):
    with pytest.raises(CalibrationError, match="camera_model: 'ocam' is not supported"):
        load_calibration(write(FLAT + "camera_model: ocam\n"))
    fisheye = re.sub(r"distortion_model.*\nd: .*", f"camera_model: fisheye\nd: {list(FISHEYE)}", INFO)
    assert load_calibration(write(fisheye)).camera.distortion == Equidistant(FISHEYE)


def test_config_check_prints_what_was_made_of_a_file_and_what_is_unlikely_in_a_lens(write, tmp_path, capsys):
    lens = tmp_path / "lens.yaml"
    lens.write_text(CALIBRATIONS["Kalibr eucm"].text, encoding="utf-8")
    text = 'drone.id = 1\nnetwork.transport = "memory"\n[camera]\nsource = "detections://127.0.0.1:9/"\n'
    assert main(["config", "check", str(write(f'{text}calibration = "{lens}"\n'))]) == 0
    assert "the extended unified lens is read as equidistant, within 0.0" in capsys.readouterr().out
    inline = "intrinsics = { fx = 299.5, fy = 300.1, cx = 254.1, cy = 183.9, width = 2064, height = 1544 }\n"
    assert main(["config", "check", str(write(text + inline))]) == 0
    assert "warning: the principal point is off the image centre by 38 %" in capsys.readouterr().out


def test_a_tilted_camera_of_orb_slam_is_where_it_says(write):
    pose = load_calibration(write(CALIBRATIONS["ORB-SLAM3"].text)).imu_from_camera
    assert pose.position.tolist() == [0.1, 0.2, 0.3]
    assert pose.rotation[:, 2].tolist() == [1.0, 0.0, 0.0]
    basalt = load_calibration(write(CALIBRATIONS["Basalt"].text)).imu_from_camera
    assert np.allclose(basalt.rotation, pose.rotation)


def test_the_page_names_every_tool(tmp_path):
    page = (ROOT / "docs" / "calibration.md").read_text(encoding="utf-8")
    for dialect in CALIBRATION_DIALECTS:
        assert re.search(rf"^\| .*{dialect.tool}", page, re.MULTILINE), dialect.tool
