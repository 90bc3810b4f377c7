"""How well calibrations find a truth that is known: extrinsics by hand, intrinsics of rendered boards.

Rendered frames and boards go through the same functions as those of `swarmtrack calibrate` (docs/calibration.md).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.harness import Benchmark, flown, seeds
from swarmtrack.calibration.board import BOARD_KINDS, Board, Kind
from swarmtrack.calibration.extrinsics import doubts
from swarmtrack.calibration.image_motion import ImageMotion
from swarmtrack.calibration.intrinsics import Fit, Model, fit
from swarmtrack.calibration.views import BoardViews
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import Equidistant, PinholeCamera, RadTan
from swarmtrack.lab.world.boards import BoardScene, board_poses
from swarmtrack.lab.world.hand_turned import HandTurned, Room
from swarmtrack.messages import Array
from swarmtrack.motion.hand_eye import GyroTurns, HandEye, compare, solve

NAME = "calibration"
SECONDS, FPS, IMU_HZ = 16.0, 15.0, 200.0  # a quarter of the minute that the command takes
EYE = PinholeCamera(215.0, 216.0, 161.0, 118.0, 320, 240, RadTan((-0.25, 0.06, 0.001, -0.0005)))
GYRO_NOISE, GYRO_BIAS = 0.005, 0.01  # rad/s, a sample's; an axis'
OFFSET = 0.1  # s
PIXEL_NOISE = 3.0
WITHIN_DEG, WITHIN_S = 0.5, 3e-3  # the claims

LENSES: dict[Model, PinholeCamera] = {
    "radtan": PinholeCamera(431.0, 429.5, 322.3, 236.8, 640, 480, RadTan((-0.28, 0.09, 0.0012, -0.0008))),
    "equidistant": PinholeCamera(
        232.0, 231.0, 317.0, 242.0, 640, 480, Equidistant((0.03, -0.012, 0.004, -0.001))
    ),
}
VIEWS = 40


class Minute(NamedTuple):
    """One hand-turned minute and what was made of it: errors against the truth, sigmas as claimed."""

    found: HandEye
    rotation_error: float  # rad
    offset_error: float  # s
    believed: bool


def hand_turned(
    seed: int,
    *,
    seconds: float = SECONDS,
    fps: float = FPS,
    camera: PinholeCamera = EYE,
    amplitude: tuple[float, float, float] = (0.45, 0.45, 0.6),
    sway_m: float = 0.03,
) -> Minute:
    rng = np.random.default_rng(seed)
    hand = HandTurned(rng, amplitude=amplitude, sway_m=sway_m)
    room = Room(rng, camera)
    body_from_camera = rotation.from_euler(*rng.uniform(-0.7, 0.7, 3)) @ rotation.BODY_FROM_FORWARD_CAMERA
    offset = float(rng.uniform(-OFFSET, OFFSET))
    bias = rng.normal(0.0, GYRO_BIAS, 3)
    t = np.arange(-0.6, seconds + 0.6, 1.0 / IMU_HZ)
    gyro = GyroTurns(t, hand.rates(t) + bias + rng.normal(0.0, GYRO_NOISE, (len(t), 3)))
    motion = ImageMotion(camera)
    exposures = np.arange(0.0, seconds, 1.0 / fps)
    eyes, places = hand.world_from_body(exposures) @ body_from_camera, hand.position(exposures)
    for exposed, eye, place in zip(exposures, eyes, places, strict=True):
        noise = np.clip(128.0 + rng.normal(0.0, PIXEL_NOISE, (camera.height, camera.width)), 0, 255)
        motion.add_frame(float(exposed) - offset, room.image(eye, place, noise.astype(np.uint8)))
    turns = motion.turns()
    found = solve(turns, gyro)
    assert found is not None, "the image was understood nowhere"
    wrong = doubts(found, compare(turns, gyro, found.camera_from_body), seconds=seconds, reach=0.3)
    rotation_error = float(rotation.angle(found.camera_from_body @ body_from_camera))
    return Minute(found, rotation_error, found.time_offset_s - offset, not wrong)


class Shown(NamedTuple):
    """A board shown to a camera: what was fitted, and the largest error of a ray in the image [px]."""

    found: Fit
    focal_error: float  # share
    ray_error_px: float


def board_shown(seed: int, kind: Kind, model: Model, *, views: int = VIEWS, noise: float = 2.0) -> Shown:
    rng = np.random.default_rng(seed)
    truth = LENSES[model]
    board = Board(kind)
    scene = BoardScene(board.draw(60), 60, board.square_m, truth)
    chosen = BoardViews((truth.width, truth.height), still=False)
    for pose in board_poses(rng, truth, board.size_m, views):
        chosen.offer(board.find(scene.image(pose, rng, noise)))
    found = fit([view.seen for view in chosen.kept], (truth.width, truth.height), model)
    return Shown(found, abs(found.camera.fx / truth.fx - 1.0), ray_error_px(found.camera, truth))


def ray_error_px(found: PinholeCamera, truth: PinholeCamera) -> float:
    """Root mean square over the image of how far a pixel's bearing is off, in pixels at the middle."""
    u, v = np.meshgrid(np.linspace(10, truth.width - 10, 25), np.linspace(10, truth.height - 10, 19))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    a, b = found.bearing(pixels), truth.bearing(pixels)
    # A common rotation is no error: nobody knows how the sensor stands in its housing.
    sound = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    U, _, Vt = np.linalg.svd(b[sound].T @ a[sound])
    R: Array = U @ np.diag([1.0, 1.0, float(np.sign(np.linalg.det(U @ Vt)))]) @ Vt
    return truth.fx * float(np.sqrt((np.linalg.norm(a[sound] @ R.T - b[sound], axis=1) ** 2).mean()))


def _alone(fly: Callable[[int], Any], seed: int) -> Any:
    """On one core, as another does on the next."""
    cv2.setNumThreads(1)
    return fly(seed)


def _measured(args: argparse.Namespace) -> dict[str, Any]:
    """calibration.png into `args.out`, too."""
    boards: list[tuple[Kind, Model]] = [
        *((kind, "radtan") for kind in BOARD_KINDS),
        ("charuco", "equidistant"),
    ]
    (minutes,) = flown("turned by hand", [("", partial(_alone, hand_turned))], range(args.seeds))
    shows = [partial(board_shown, kind=kind, model=model) for kind, model in boards]
    parts = [(", ".join(board), partial(_alone, show)) for board, show in zip(boards, shows, strict=True)]
    by_board = list(flown("boards", parts, range(max(args.seeds // 6, 2))))
    _plot(args.out / f"{NAME}.png", minutes)
    return {
        "seconds": SECONDS,
        "extrinsics": _extrinsics(minutes),
        "intrinsics": [_intrinsics(*board, shown) for board, shown in zip(boards, by_board, strict=True)],
    }


def _extrinsics(minutes: list[Minute]) -> dict[str, Any]:
    angles = np.degrees([minute.rotation_error for minute in minutes])
    offsets = np.array([minute.offset_error for minute in minutes])
    sigma_deg = np.degrees([float(np.linalg.norm(minute.found.rotation_sigma)) for minute in minutes])
    sigma_s = np.array([minute.found.time_offset_sigma_s for minute in minutes])
    return {
        "seeds": len(minutes),
        "believed": sum(minute.believed for minute in minutes),
        "rotation_rms_deg": float(np.sqrt((angles**2).mean())),
        "rotation_worst_deg": float(angles.max()),
        "rotation_sigma_deg": float(np.sqrt((sigma_deg**2).mean())),
        "offset_rms_s": float(np.sqrt((offsets**2).mean())),
        "offset_worst_s": float(np.abs(offsets).max()),
        "offset_sigma_s": float(np.sqrt((sigma_s**2).mean())),
        "within": int(sum((angles < WITHIN_DEG) & (np.abs(offsets) < WITHIN_S))),
        "angles_deg": angles.tolist(),
        "offsets_s": offsets.tolist(),
    }


def _intrinsics(kind: Kind, model: Model, shown: list[Shown]) -> dict[str, Any]:
    return {
        "board": kind,
        "model": model,
        "seeds": len(shown),
        "focal_worst_percent": 100.0 * max(each.focal_error for each in shown),
        "ray_rms_px": float(np.mean([each.ray_error_px for each in shown])),
        "rms_px": float(np.mean([each.found.rms for each in shown])),
        "views": float(np.mean([len(each.found.views) for each in shown])),
    }


def _page(result: dict[str, Any]) -> str:
    e = result["extrinsics"]
    by_hand = [
        [report.filled(f"{{{what}_{of}{unit}:{form}}}", e) for of in ("rms", "worst", "sigma")]
        for what, unit, form in (("rotation", "_deg", ".3f"), ("offset", "_s", ".2m"))
    ]
    rows = [["rotation, °", *by_hand[0]], ["offset, ms", *by_hand[1]]]
    return report.page(
        "# Calibration",
        report.table(["by hand", "RMS", "worst", "σ claimed"], rows),
        f"{e['within']} of {e['seeds']} turns within {WITHIN_DEG:g}° and {1e3 * WITHIN_S:g} ms, "
        f"{e['believed']} of them believed.",
        report.table_of(
            (
                ("board, lens", "{board}, {model}"),
                ("views", "{views:.0f}"),
                ("corners miss, px RMS", "{rms_px:.3f}"),
                ("fx off, worst, %", "{focal_worst_percent:.3f}"),
                ("rays off, px RMS", "{ray_rms_px:.3f}"),
            ),
            result["intrinsics"],
        ),
    )


def _plot(path: Path, minutes: list[Minute]) -> None:
    figure, axes = report.pyplot().subplots(1, 2, figsize=(9, 3.6))
    share = np.arange(1, len(minutes) + 1)
    angles = [[m.rotation_error, float(np.linalg.norm(m.found.rotation_sigma))] for m in minutes]
    offsets = [[abs(m.offset_error), m.found.time_offset_sigma_s] for m in minutes]
    for axis, name, values in (
        (axes[0], "rotation, °", np.degrees(angles)),
        (axes[1], "offset, ms", 1e3 * np.array(offsets)),
    ):
        errors, sigmas = np.sort(values, axis=0).T
        axis.plot(errors, share, "o-", color="#4477aa", label="error")
        axis.plot(sigmas, share, "x--", color="#cc6677", label="σ claimed")
        axis.set(xlabel=name, ylabel="turns with less", xlim=(0, None))
        axis.legend()
    figure.tight_layout()
    report.save(figure, path, dpi=110)


BENCH = Benchmark(NAME, _measured, _page, options=(seeds(20, quick=4),), draws=True)
