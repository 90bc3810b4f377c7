"""Calibration files as each tool writes them, most of one camera: 640 x 480, f = 460.5, 459.1, c = 322.2, 241.7."""

from __future__ import annotations

import json
from typing import NamedTuple

K = (460.5, 459.1, 322.2, 241.7)
RADTAN = (-0.29, 0.08, 0.0001, 0.0002)
FISHEYE = (0.0029, 0.0016, -0.0007, 0.0001)


class Written(NamedTuple):
    """text; camera: which one, where there are several; lens: coefficients expected, None where it is fitted."""

    text: str
    lens: tuple[float, ...] | None
    camera: str | None = None


FX, FY, CX, CY = K
MATRIX = f"{FX}, 0.0, {CX}, 0.0, {FY}, {CY}, 0.0, 0.0, 1.0"


def opencv_matrix(name: str, rows: int, columns: int, data: str) -> str:
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {data} ]\n"


def listed(numbers: tuple[float, ...]) -> str:
    return ", ".join(str(number) for number in numbers)


VOXL = (
    "%YAML:1.0\n---\n"
    + opencv_matrix("M", 3, 3, MATRIX)
    + opencv_matrix("D", 4, 1, listed(FISHEYE))
    + "reprojection_error: 4.1e-01\nwidth: 640\nheight: 480\ndistortion_model: fisheye\n"
)
XML = f"""<?xml version="1.0"?>
<opencv_storage>
<image_width>640</image_width>
<image_height>480</image_height>
<camera_matrix type_id="opencv-matrix">
  <rows>3</rows><cols>3</cols><dt>d</dt>
  <data>
    {MATRIX.replace(",", "")}</data></camera_matrix>
<distortion_coefficients type_id="opencv-matrix">
  <rows>1</rows><cols>4</cols><dt>d</dt>
  <data>
    {listed(RADTAN).replace(",", "")}</data></distortion_coefficients>
</opencv_storage>
"""
XML_NODES = XML.replace("image_width>640<", "image_size>640 480<").replace("</image_width>", "</image_size>")
OPENCV_JSON = json.dumps(
    {
        "image_width": 640,
        "image_height": 480,
        "cameraMatrix": {
            "type_id": "opencv-matrix",
            "rows": 3,
            "cols": 3,
            "dt": "d",
            "data": [FX, 0, CX, 0, FY, CY, 0, 0, 1],
        },
        "distCoeffs": {"type_id": "opencv-matrix", "rows": 4, "cols": 1, "dt": "d", "data": RADTAN},
    },
    indent="\t",
)
VINS = f"""%YAML:1.0
---
model_type: PINHOLE
camera_name: camera
image_width: 640
image_height: 480
distortion_parameters:
   k1: {RADTAN[0]}
   k2: {RADTAN[1]}
   p1: {RADTAN[2]}
   p2: {RADTAN[3]}
projection_parameters:
   fx: {FX}
   fy: {FY}
   cx: {CX}
   cy: {CY}
"""
VINS_FISHEYE = f"""%YAML:1.0
---
model_type: KANNALA_BRANDT
camera_name: camera
image_width: 640
image_height: 480
projection_parameters:
   k2: {FISHEYE[0]}
   k3: {FISHEYE[1]}
   k4: {FISHEYE[2]}
   k5: {FISHEYE[3]}
   mu: {FX}
   mv: {FY}
   u0: {CX}
   v0: {CY}
"""
MEI = """%YAML:1.0
---
model_type: MEI
camera_name: camera
image_width: 640
image_height: 480
mirror_parameters:
   xi: 1.9
distortion_parameters:
   k1: -0.10
   k2: 0.05
   p1: 0.0002
   p2: -0.0001
projection_parameters:
   gamma1: 552.0
   gamma2: 551.0
   u0: 322.2
   v0: 241.7
"""
ORB_SLAM2 = f"""%YAML:1.0
Camera.fx: {FX}
Camera.fy: {FY}
Camera.cx: {CX}
Camera.cy: {CY}
Camera.k1: {RADTAN[0]}
Camera.k2: {RADTAN[1]}
Camera.p1: {RADTAN[2]}
Camera.p2: {RADTAN[3]}
Camera.width: 640
Camera.height: 480
Camera.fps: 30.0
"""
ORB_SLAM3 = ORB_SLAM2.replace("Camera.", "Camera1.").replace("Camera1.width", "Camera.width").replace(
    "Camera1.height", "Camera.height"
) + 'File.version: "1.0"\nCamera.type: "PinHole"\nCamera.newWidth: 320\n' + opencv_matrix(
    "IMU.T_b_c1", 4, 4, "0, 0, 1, 0.1, 1, 0, 0, 0.2, 0, 1, 0, 0.3, 0, 0, 0, 1"
)  # fmt: skip
ORB_SLAM3_FISHEYE = (
    '%YAML:1.0\nCamera.type: "KannalaBrandt8"\n'
    + "".join(
        f"Camera{n}.fx: {FX}\nCamera{n}.fy: {FY}\nCamera{n}.cx: {CX}\nCamera{n}.cy: {CY}\n"
        + "".join(f"Camera{n}.k{i + 1}: {k}\n" for i, k in enumerate(FISHEYE))
        for n in (1, 2)
    )
    + "Camera.width: 640\nCamera.height: 480\n"
)
OST = f"""# oST version 5.0 parameters


[image]

width
640

height
480

[narrow_stereo]

camera matrix
{FX} 0.000000 {CX}
0.000000 {FY} {CY}
0.000000 0.000000 1.000000

distortion
{listed(RADTAN).replace(",", "")} 0.000000

rectification
1.000000 0.000000 0.000000
0.000000 1.000000 0.000000
0.000000 0.000000 1.000000
"""
REALSENSE = f"""Device info:
    Name                          : \tIntel RealSense D435I
 Intrinsic of "Color" / 1280x720 / {{YUYV/RGB8/BGR8}}
  Width:      \t1280
  Height:     \t720
  PPX:        \t640.1
  PPY:        \t361.2
  Fx:         \t920.1
  Fy:         \t920.3
  Distortion: \tInverse Brown Conrady
  Coeffs:     \t0  \t0  \t0  \t0  \t0
  FOV (deg):  \t69.6 x 42.7

 Intrinsic of "Color" / 640x480 / {{YUYV/RGB8/BGR8}}
  Width:      \t640
  Height:     \t480
  PPX:        \t{CX}
  PPY:        \t{CY}
  Fx:         \t{FX}
  Fy:         \t{FY}
  Distortion: \tBrown Conrady
  Coeffs:     \t{RADTAN[0]} \t{RADTAN[1]} \t{RADTAN[2]} \t{RADTAN[3]} \t0
  FOV (deg):  \t54.9 x 42.5

 Motion Intrinsic Accel:
  Bias Variances: \t0 0 0
"""
REALSENSE_JSON = json.dumps(
    {"width": 640, "height": 480, "ppx": CX, "ppy": CY, "fx": FX, "fy": FY,
     "model": "distortion.brown_conrady", "coeffs": [*RADTAN, 0.0]}
)  # fmt: skip
REALSENSE_BACK = REALSENSE_JSON.replace("distortion.", "distortion.inverse_")
OAK = json.dumps(
    {
        "boardName": "BW1098OBC",
        "cameraData": [
            [0, {"cameraType": 0, "distortionCoeff": [*RADTAN, *[0.0] * 10], "height": 480, "width": 640,
                 "intrinsicMatrix": [[FX, 0.0, CX], [0.0, FY, CY], [0.0, 0.0, 1.0]], "lensPosition": 120}],
            [1, {"cameraType": 1, "distortionCoeff": [*FISHEYE, *[0.0] * 10], "height": 480, "width": 640,
                 "intrinsicMatrix": [[FX, 0.0, CX], [0.0, FY, CY], [0.0, 0.0, 1.0]]}],
        ],
    }
)  # fmt: skip
OAK_PRISM = f"""height: 480
width: 640
distortion_model: rational_polynomial
d: [9.49, -102.07, 0.0008, 0.002, 401.2, 9.26, -101.1, 398.6, 0.0012, -0.0003, -0.0008, 0.0001, 0.0, 0.0]
k: [{MATRIX}]
"""
BASALT = json.dumps(
    {
        "value0": {
            "T_imu_cam": [{"px": 0.1, "py": 0.2, "pz": 0.3, "qx": 0.5, "qy": 0.5, "qz": 0.5, "qw": 0.5}],
            "intrinsics": [
                {"camera_type": "ds",
                 "intrinsics": {"fx": 158.3, "fy": 158.4, "cx": CX, "cy": CY, "xi": -0.17, "alpha": 0.59}}
            ],
            "resolution": [[640, 480]],
        }
    }
)  # fmt: skip


def kalibr(model: str, numbers: str, distortion: str = "none", coefficients: str = "") -> str:
    return (
        f"cam0:\n  camera_model: {model}\n  intrinsics: [{numbers}]\n  distortion_model: {distortion}\n"
        f"  distortion_coeffs: [{coefficients}]\n  resolution: [640, 480]\n  rostopic: /cam0/image_raw\n"
    )


CALIBRATIONS = {
    "VOXL": Written(VOXL, FISHEYE),
    "OpenCV XML": Written(XML, RADTAN),
    "OpenCV XML, size in one": Written(XML_NODES, RADTAN),
    "OpenCV JSON": Written(OPENCV_JSON, RADTAN),
    "VINS": Written(VINS, RADTAN),
    "VINS fisheye": Written(VINS_FISHEYE, FISHEYE),
    "VINS MEI": Written(MEI, None),
    "ORB-SLAM2": Written(ORB_SLAM2, RADTAN),
    "ORB-SLAM3": Written(ORB_SLAM3, RADTAN),
    "ORB-SLAM3 fisheye": Written(ORB_SLAM3_FISHEYE, FISHEYE, "Camera2"),
    "ost.txt": Written(OST, (*RADTAN, 0.0)),
    "RealSense report": Written(REALSENSE, (*RADTAN, 0.0), "Color 640x480"),
    "RealSense JSON": Written(REALSENSE_JSON, (*RADTAN, 0.0)),
    "RealSense backwards": Written(REALSENSE_BACK, None),
    "OAK": Written(OAK, (*RADTAN, *[0.0] * 4), "CAM_A"),
    "OAK fisheye": Written(OAK, FISHEYE, "CAM_B"),
    "OAK thin prism": Written(OAK_PRISM, None),
    "Basalt": Written(BASALT, None),
    "Kalibr omni": Written(kalibr("omni", f"1.9, 552.0, 551.0, {CX}, {CY}", "radtan", "-0.1, 0.05, 0.0, 0.0"), None),
    "Kalibr eucm": Written(kalibr("eucm", f"0.58, 1.05, 190.2, 190.4, {CX}, {CY}"), None),
    "Kalibr ds": Written(kalibr("ds", f"-0.17, 0.59, 158.3, 158.4, {CX}, {CY}"), None),
    "Kalibr fov": Written(kalibr("pinhole", f"300.0, 300.0, {CX}, {CY}", "fov", "0.95"), None),
}  # fmt: skip
