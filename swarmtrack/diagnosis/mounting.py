"""Calibration and mounting: plausibility of the numbers, and agreement of image and gyro. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from swarmtrack.config.drone import MountedCamera
from swarmtrack.diagnosis.findings import Finding, fault, ok, skipped
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import WIDEST_LENS_RAD, PinholeCamera
from swarmtrack.messages import Array
from swarmtrack.motion.hand_eye import Agreement, HandEye

ASPECT, CENTRE, FIELD_DEG = 0.05, 0.15, (15.0, 160.0)
UNREACHED = 0.02  # share of the border beyond the lens model's reach
FARTHEST_MOUNT = 1.5  # m
TELLING_TURN_RATE_RAD_S = 0.15  # rad/s about an axis, for the image to say anything of it
WRONG_SIGN, WEAK_GAIN = -0.3, 0.5
ROTATION_OFF_DEG, OFFSET_OFF_S = 5.0, 0.015
SURE_ROTATION_DEG, SURE_OFFSET_S = 2.0, 0.005
AXES = ("x (pitch of a camera that looks forward)", "y (its yaw)", "z (its roll)")


@dataclass(frozen=True, slots=True)
class MountFacts:
    """mounted: None where it cannot be read, and refused says why; rpy_deg: as the config writes it, if it does."""

    mounted: MountedCamera | None
    refused: str = ""
    rpy_deg: tuple[float, float, float] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class MotionFacts:
    """Image against gyro while the drone was turned. reason: why there is nothing to compare, or empty."""

    reason: str = ""
    agreement: Agreement | None = None
    found: HandEye | None = None


def check_calibration(facts: MountFacts) -> list[Finding]:
    if facts.mounted is None:
        return [fault("calibration.unreadable", reason=facts.refused)]
    camera = facts.mounted.camera
    findings = []
    aspect = abs(camera.fx / camera.fy - 1.0)
    if aspect > ASPECT:
        findings.append(fault("calibration.aspect", percent=100.0 * aspect))
    middle = np.array([camera.width - 1, camera.height - 1]) / 2.0
    off = np.abs(np.array([camera.cx, camera.cy]) - middle) / (camera.width, camera.height)
    if off.max() > CENTRE:
        findings.append(fault("calibration.centre", percent=100.0 * float(off.max())))
    field = _field_deg(camera)
    widest = math.degrees(2.0 * WIDEST_LENS_RAD) if camera.is_wide else FIELD_DEG[1]
    if not FIELD_DEG[0] <= field <= widest:
        findings.append(fault("calibration.field", degrees=field))
    share = _unreached(camera)
    if share > UNREACHED:
        findings.append(fault("calibration.distortion", share=share))
    lens = camera.distortion.name if camera.distortion else "no distortion"
    words = f"{camera.width}x{camera.height}, f = {camera.fx:.0f} px, {field:.0f}° wide, {lens}"
    return findings or [ok("calibration", words)]


def check_mount(facts: MountFacts, *, several: bool = False) -> list[Finding]:
    """Check a camera's mounting. several: it is one of many, which may well look back."""
    if facts.mounted is None:
        return []
    findings = []
    rpy = np.array(facts.rpy_deg or (0.0, 0.0, 0.0))
    nonzero = np.abs(rpy[rpy != 0.0])
    quarters = np.abs(nonzero / (math.pi / 2.0) - np.rint(nonzero / (math.pi / 2.0)))
    if len(nonzero) and nonzero.max() < 3.2 and quarters.max() < 0.01:
        findings.append(fault("mount.radians", rpy=[float(angle) for angle in rpy]))
    pose = facts.mounted.body_from_camera
    distance = float(np.linalg.norm(pose.position))
    if distance > FARTHEST_MOUNT:
        findings.append(fault("mount.position", metres=distance))
    where = looks(pose.rotation)
    backwards = pose.rotation[0, 2] < -0.5 and not several
    if backwards or pose.rotation[2, 2] < -0.7 or pose.rotation[2, 1] < -0.5:
        findings.append(fault("mount.backwards", where=where))
    return findings or [ok("mount", f"the camera looks {where}, {100.0 * distance:.0f} cm from the middle")]


def looks(body_from_camera: Array) -> str:
    """Direction of a camera, in words."""
    ahead, right, down = body_from_camera[:, 2]
    azimuth, elevation = math.degrees(math.atan2(right, ahead)), -math.degrees(math.asin(down))
    if abs(elevation) > 75.0:
        way = "straight up" if elevation > 0.0 else "straight down"
    else:
        ways = ("forward", "right", "backward", "left")
        way = ways[round(azimuth / 90.0) % 4]
        way += f", {abs(elevation):.0f}° {'up' if elevation > 0 else 'down'}" if abs(elevation) >= 1.0 else ""
    return way + (", upside down" if body_from_camera[2, 1] < -0.5 else "")


def check_motion(facts: MotionFacts, mounted: MountedCamera | None) -> list[Finding]:
    """Check signs first, for which one axis is enough; mounting and offset where the rotations suffice."""
    agreement = facts.agreement
    if mounted is None or agreement is None:
        return [
            skipped("motion", f"image against gyro was not checked: {facts.reason or 'no frames or no gyro'}")
        ]
    turned = agreement.rate > TELLING_TURN_RATE_RAD_S
    if not turned.any():
        return [
            skipped(
                "motion", "image against gyro was not checked: turn the drone by hand while doctor watches"
            )
        ]
    wrong = turned & (agreement.gain < WRONG_SIGN)
    if wrong.any():
        axes = " and ".join(axis for axis, is_wrong in zip(AXES, wrong, strict=True) if is_wrong)
        return [fault("motion.sign", axes=axes, gain=float(agreement.gain[wrong].min()))]
    findings = []
    if found := facts.found:
        off_deg = math.degrees(
            float(rotation.angle(found.camera_from_body @ mounted.body_from_camera.rotation))
        )
        sure_deg = math.degrees(float(found.rotation_sigma.max()))
        if sure_deg < SURE_ROTATION_DEG and off_deg > max(ROTATION_OFF_DEG, 3.0 * sure_deg):
            findings.append(fault("motion.rotation", angle_deg=off_deg))
        off_s = found.time_offset_s - mounted.time_offset_s
        if not found.at_edge and found.time_offset_sigma_s < SURE_OFFSET_S and abs(off_s) > OFFSET_OFF_S:
            findings.append(fault("motion.offset", off_ms=1e3 * off_s, offset_s=found.time_offset_s))
    if not findings and (turned & (agreement.gain < WEAK_GAIN)).any():
        return [
            skipped(
                "motion", "image and gyro agree too little to judge: turn in place, far from walls and people"
            )
        ]
    names = ", ".join(name for name, is_turned in zip("xyz", turned, strict=True) if is_turned)
    return findings or [
        ok(
            "motion",
            f"image and gyro turn the same way about the camera's {names}, clocks {_apart(agreement, mounted)}",
        )
    ]


def _apart(agreement: Agreement, mounted: MountedCamera) -> str:
    return f"{1e3 * (agreement.time_offset_s - mounted.time_offset_s):+.0f} ms apart"


def _field_deg(camera: PinholeCamera) -> float:
    edges = np.array([[-0.5, camera.cy], [camera.width - 0.5, camera.cy]])
    b = camera.bearing(edges)
    if camera.is_wide or not np.isfinite(b).all():
        return math.degrees(camera.field[0])
    return math.degrees(float(np.arctan2(np.abs(b[:, 0]), b[:, 2]).sum()))


def _unreached(camera: PinholeCamera) -> float:
    """Share of the image's border where the lens model has no answer."""
    if camera.is_wide and camera.reach >= WIDEST_LENS_RAD:
        # Beyond the circle of a fisheye its image is dark.
        return 0.0
    n = 33
    x, y = np.linspace(0, camera.width - 1, n), np.linspace(0, camera.height - 1, n)
    border = np.concatenate(
        [
            np.stack([x, np.zeros(n)], axis=1),
            np.stack([x, np.full(n, camera.height - 1)], axis=1),
            np.stack([np.zeros(n), y], axis=1),
            np.stack([np.full(n, camera.width - 1), y], axis=1),
        ]
    )
    return float(np.isnan(camera.undistort(border)).any(axis=1).mean())
