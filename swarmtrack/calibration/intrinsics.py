"""Intrinsics from views of a board: fit, outlier rejection, quality check, output."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from swarmtrack.calibration.board import Seen
from swarmtrack.calibration.views import ENOUGH_CELLS, covered
from swarmtrack.errors import CalibrationError
from swarmtrack.geometry.camera import Equidistant, PinholeCamera, RadTan
from swarmtrack.messages import Array

Model = Literal["radtan", "equidistant"]
ROS_NAMES = {"radtan": "plumb_bob", "equidistant": "equidistant"}
LEAST_VIEWS = 6
OUTLIER, ROUNDS = 2.5, 4  # times the median of the views' errors
GOOD_RMS_PX, GOOD_SIGMA, GOOD_VIEWS = 0.6, 0.004, 12


class Fit(NamedTuple):
    """A camera with the uncertainty of its parameters.

    sigma (4,) px of fx fy cx cy; rms px over all corners; views: indices of those used, errors (n,) px their own;
    rejected: indices of those left out; pixels, residuals (m, 2) px of all corners used.
    """

    camera: PinholeCamera
    model: Model
    sigma: Array
    rms: float
    views: tuple[int, ...]
    errors: Array
    rejected: tuple[int, ...]
    pixels: Array
    residuals: Array
    coverage: float


class _Solution(NamedTuple):
    camera: PinholeCamera
    sigma: Array
    residuals: list[Array]


def fit(seen: Sequence[Seen], size: tuple[int, int], model: Model = "radtan") -> Fit:
    """Fit a camera. seen: views of one board in images of size (width, height). Raises CalibrationError."""
    views = list(range(len(seen)))
    if len(views) < LEAST_VIEWS:
        raise CalibrationError(
            f"{len(views)} different views of the board, expected {LEAST_VIEWS} at least, {GOOD_VIEWS} to be good"
        )
    solve = _radtan if model == "radtan" else _equidistant
    for _ in range(ROUNDS):
        try:
            solution = solve([seen[i] for i in views], size)
        except cv2.error as error:
            reason = (
                str(error.err).strip().splitlines()[0]
                if getattr(error, "err", "")
                else "it does not converge"
            )
            raise CalibrationError(
                f"no {model} camera fits the board's views ({reason}): show it tilted, in all parts of the picture"
            ) from None
        except ValueError as error:
            raise CalibrationError(f"the fit is not a camera: {error}") from None
        errors = np.array([np.sqrt((r**2).sum(axis=1).mean()) for r in solution.residuals])
        good = errors <= max(OUTLIER * float(np.median(errors)), 0.05)
        if good.all() or good.sum() < LEAST_VIEWS:
            break
        views = [i for i, is_good in zip(views, good, strict=True) if is_good]
    residuals = np.concatenate(solution.residuals)
    pixels = np.concatenate([seen[i].pixels for i in views])
    return Fit(
        camera=solution.camera,
        model=model,
        sigma=solution.sigma,
        rms=float(np.sqrt((residuals**2).sum(axis=1).mean())),
        views=tuple(views),
        errors=errors,
        rejected=tuple(i for i in range(len(seen)) if i not in views),
        pixels=pixels,
        residuals=residuals,
        coverage=float(covered([seen[i].pixels for i in views], size).mean()),
    )


def doubts(found: Fit) -> list[str]:
    """Reasons against the fit, with remedies; empty for a good one."""
    lines = []
    if found.rms > GOOD_RMS_PX:
        lines.append(
            f"corners miss by {found.rms:.2f} px, expected at most {GOOD_RMS_PX}: use a flatter board and more "
            "light, and hold it still; "
            + ("a wide lens needs --model equidistant" if found.model == "radtan" else "or --model radtan")
        )
    relative = float((found.sigma[:2] / (found.camera.fx, found.camera.fy)).max())
    if relative > GOOD_SIGMA:
        lines.append(
            f"the focal length is known only to {100 * relative:.1f} %, expected {100 * GOOD_SIGMA:g} %: "
            "tilt the board more"
        )
    if found.coverage < ENOUGH_CELLS:
        lines.append(
            f"corners in {found.coverage:.0%} of the image, expected {ENOUGH_CELLS:.0%}: also "
            "show the board in its corners"
        )
    if len(found.views) < GOOD_VIEWS:
        lines.append(f"{len(found.views)} views that fit, expected {GOOD_VIEWS}: show more")
    return lines


def as_yaml(found: Fit, name: str) -> str:
    """The camera as ROS' camera_info, which many programs read, ours among them."""
    camera = found.camera
    coefficients = camera.distortion.coefficients if camera.distortion else ()
    document: dict[str, Any] = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "camera_matrix": {"rows": 3, "cols": 3, "data": [float(x) for x in camera.K.ravel()]},
        "distortion_model": ROS_NAMES[found.model],
        "distortion_coefficients": {"rows": 1, "cols": len(coefficients), "data": list(coefficients)},
    }
    head = (
        f"# By swarmtrack calibrate intrinsics: {len(found.views)} views, corners miss by {found.rms:.3f} px RMS,\n"
        f"# fx ± {found.sigma[0]:.2f}, fy ± {found.sigma[1]:.2f}, "
        f"cx ± {found.sigma[2]:.2f}, cy ± {found.sigma[3]:.2f} px.\n"
    )
    return head + str(yaml.safe_dump(document, sort_keys=False, default_flow_style=None))


def _radtan(seen: list[Seen], size: tuple[int, int]) -> _Solution:
    points = [each.points.astype(np.float32) for each in seen]
    pixels = [each.pixels.astype(np.float32) for each in seen]
    # A third coefficient fits noise, except for the widest lenses, which are equidistant.
    flags = cv2.CALIB_FIX_K3
    guess = np.eye(3), np.zeros(5)
    _, K, d, rvecs, tvecs, sigma, _, _ = cv2.calibrateCameraExtended(
        points, pixels, size, *guess, flags=flags
    )
    residuals = [
        each.pixels - cv2.projectPoints(each.points, rvec, tvec, K, d)[0].reshape(-1, 2)
        for each, rvec, tvec in zip(seen, rvecs, tvecs, strict=True)
    ]
    lens = RadTan(tuple(float(x) for x in d.ravel()[:4]))
    return _Solution(_camera(K, size, lens), np.asarray(sigma, dtype=float).ravel()[:4], residuals)


def _equidistant(seen: list[Seen], size: tuple[int, int]) -> _Solution:
    points = [each.points.reshape(-1, 1, 3) for each in seen]
    pixels = [each.pixels.reshape(-1, 1, 2) for each in seen]
    flags = cv2.fisheye.CALIB_RECOMPUTE_EXTRINSIC | cv2.fisheye.CALIB_FIX_SKEW
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-9)
    guess = np.eye(3), np.zeros((4, 1))
    _, K, d, rvecs, tvecs = cv2.fisheye.calibrate(
        points, pixels, size, *guess, flags=flags, criteria=criteria
    )
    residuals, jacobians = [], []
    for each, rvec, tvec in zip(seen, rvecs, tvecs, strict=True):
        told, J = cv2.fisheye.projectPoints(each.points.reshape(-1, 1, 3), rvec, tvec, K, d)
        residuals.append(each.pixels - told.reshape(-1, 2))
        jacobians.append(np.asarray(J, dtype=float)[:, :14])  # f f c c k k k k, rotation, translation
    lens = Equidistant(tuple(float(x) for x in d.ravel()))
    return _Solution(_camera(K, size, lens), _sigma(jacobians, residuals), residuals)


def _sigma(jacobians: list[NDArray[np.float64]], residuals: list[Array]) -> Array:
    """(4,) of the first four common parameters, the six of each view's pose eliminated (Schur's complement)."""
    H = np.zeros((8, 8))
    for J in jacobians:
        A, B = J[:, :8], J[:, 8:]
        H += A.T @ A - A.T @ B @ np.linalg.pinv(B.T @ B) @ B.T @ A
    count = sum(residual.size for residual in residuals) - 8 - 6 * len(jacobians)
    variance = sum(float((residual**2).sum()) for residual in residuals) / max(count, 1)
    sigma: Array = np.sqrt(variance * np.diag(np.linalg.pinv(H)))[:4]
    return sigma


def _camera(K: Any, size: tuple[int, int], lens: RadTan | Equidistant) -> PinholeCamera:
    return PinholeCamera(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), *size, lens)
