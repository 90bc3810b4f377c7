"""`swarmtrack calibrate board` and `… intrinsics`: a printed board, and a camera file from looking at it."""

from __future__ import annotations

import argparse
import asyncio
import json
import signal
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from swarmtrack.arguments import add_action, add_file, add_flag, add_seconds, require_extra

if TYPE_CHECKING:
    from swarmtrack.calibration.board import Board
    from swarmtrack.calibration.intrinsics import Fit
    from swarmtrack.calibration.views import BoardViews
    from swarmtrack.messages import Frame

DONE, FAILED = 0, 1
SECONDS = 180.0
SQUARE_MM = 28.0  # nine of them fit on A4
RECORDED = ("file", "images")
ARROW = 0.02  # of the image's width: a usual residual is drawn so long


def add_board_command(steps: Any) -> None:
    board = add_action(
        steps,
        "board",
        "write a board to print",
        description="Write a board to print, as a PDF to scale or as a PNG. Glue it onto something flat.",
    )
    add_file(board, "--out", "board.pdf or board.png", required=True)
    board.add_argument(
        "--paper", default="A4", choices=["A4", "A3", "A2", "letter"], help="(default: %(default)s)"
    )
    _add_board_arguments(board)


def add_intrinsics_command(steps: Any) -> None:
    intrinsics = add_action(
        steps,
        "intrinsics",
        "focal lengths, centre and distortion of a camera, from views of a board",
        description="Focal lengths, centre and distortion of a camera. Hold the board still in all parts of the "
        "image, near and far, tilted to all sides. The terminal shows what is still missing. Ctrl-C ends it early. "
        "Exit code 0: good. 1: not good.",
    )
    intrinsics.add_argument(
        "source",
        metavar="SOURCE",
        help="a camera as in the config: v4l2:///dev/video0?width=640&height=480, http://…, file://video.mp4, "
        "images://folder",
    )
    add_file(intrinsics, "--out", "(default: %(default)s)", default=Path("camera.yaml"))
    intrinsics.add_argument(
        "--model",
        default="radtan",
        choices=["radtan", "equidistant"],
        help="lens model: equidistant for fisheyes, above about 100 degrees (default: %(default)s)",
    )
    add_seconds(intrinsics, "--seconds", "end after S seconds (default: %(default)g)", default=SECONDS)
    add_file(intrinsics, "--plot", "a PNG of residuals (needs matplotlib)")
    add_flag(intrinsics, "--json", "print JSON")
    _add_board_arguments(intrinsics)


def _add_board_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--board",
        default="charuco",
        choices=["charuco", "aprilgrid", "checkerboard"],
        help="(default: %(default)s)",
    )
    parser.add_argument(
        "--columns", type=int, default=9, metavar="N", help="squares across (default: %(default)s)"
    )
    parser.add_argument(
        "--rows", type=int, default=6, metavar="N", help="squares down (default: %(default)s)"
    )
    parser.add_argument(
        "--square-mm",
        type=float,
        default=SQUARE_MM,
        metavar="MM",
        help="measured side of a square (default: %(default)g)",
    )


def run(args: argparse.Namespace) -> int:
    from swarmtrack.calibration.board import Board
    from swarmtrack.errors import SourceError

    try:
        board = Board(args.board, args.columns, args.rows, 1e-3 * args.square_mm)
        if args.step == "board":
            return _write_board(board, args.out, args.paper)
    except ValueError as error:
        raise SourceError(str(error)) from None
    return asyncio.run(_intrinsics(args, board))


def _write_board(board: Board, out: Path, paper: str) -> int:
    import cv2
    import numpy as np

    from swarmtrack.calibration.board import as_pdf
    from swarmtrack.errors import SourceError

    if out.suffix.lower() == ".pdf":
        data = as_pdf(board, paper)
    elif out.suffix.lower() == ".png":
        image = np.pad(board.draw(120), 60, constant_values=255)
        data = cv2.imencode(".png", image)[1].tobytes()
    else:
        raise SourceError(f"--out {out}: expected a name that ends in .pdf or .png")
    try:
        out.write_bytes(data)
    except OSError as error:
        raise SourceError(f"--out {out}: {error.strerror}") from None
    print(
        f"{out}: print it at 100 %, measure a square, and give its side: --square-mm {1e3 * board.square_m:g}"
    )
    return DONE


async def _intrinsics(args: argparse.Namespace, board: Board) -> int:
    from swarmtrack.calibration.intrinsics import as_yaml, doubts, fit
    from swarmtrack.errors import CalibrationError, SourceError

    if args.plot is not None:
        require_extra("bench", "matplotlib", of="--plot")
    views = await _collect(args, board)
    if views is None:
        return FAILED
    seen = [view.seen for view in views.kept]
    try:
        found = fit(seen, views.size, args.model)
    except CalibrationError as error:
        print(f"calibrate intrinsics: {error}", file=sys.stderr)
        return FAILED
    problems = doubts(found)
    try:
        args.out.write_text(as_yaml(found, args.out.stem), encoding="utf-8")
    except OSError as error:
        raise SourceError(f"--out {args.out}: {error.strerror}") from None
    if args.plot is not None:
        _plot(found, args.plot)
    if args.json:
        print(json.dumps(_record(found, problems), indent=1))
    else:
        _say(found, problems, args.out)
    return FAILED if problems else DONE


async def _collect(args: argparse.Namespace, board: Board) -> BoardViews | None:
    """Look until nothing is missing, the source ends, time is up, or Ctrl-C. None, and why on stderr: saw no board."""
    from rich.console import Console
    from rich.live import Live

    from swarmtrack.camera_sources.address import parse_address
    from swarmtrack.camera_sources.opening import open_camera
    from swarmtrack.clock import SystemClock

    address = parse_address(args.source)
    recorded = address.scheme in RECORDED
    source = args.source
    if recorded and "pace" not in dict(address.query):
        source += ("&" if address.query else "?") + "pace=fast"
    camera = open_camera(source, clock=SystemClock(), base=Path.cwd())
    views: BoardViews | None = None
    stop = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGINT, stop.set)

    async def look() -> None:
        nonlocal views
        async for views in _found(board, camera.frames(), still=address.scheme != "images"):
            live.update(_progress(views))
            if not recorded and not views.missing():
                return

    with Live(console=Console(stderr=True), transient=True) as live:
        tasks = [asyncio.create_task(look()), asyncio.create_task(stop.wait())]
        patience = None if recorded else args.seconds
        await asyncio.wait(tasks, timeout=patience, return_when=asyncio.FIRST_COMPLETED)
        for task in tasks:
            task.cancel()
        looked, _ = await asyncio.gather(*tasks, return_exceptions=True)
    status = camera.status()
    await camera.close()
    if isinstance(looked, Exception):
        raise looked
    if views is not None and views.kept:
        return views
    _say_nothing(args, views, f"{address}: {status.text}")
    return None


async def _found(board: Board, frames: AsyncIterator[Frame], *, still: bool) -> AsyncIterator[BoardViews]:
    """The views so far, after each frame that has the size of the first."""
    from swarmtrack.calibration.views import BoardViews

    views: BoardViews | None = None
    async for frame in frames:
        size = (frame.image.shape[1], frame.image.shape[0])
        if views is None:
            views = BoardViews(size, still=still)
        if size == views.size:
            views.offer(await asyncio.to_thread(board.find, frame.image))
            yield views


def _say_nothing(args: argparse.Namespace, views: BoardViews | None, source: str) -> None:
    what = "no frame"
    if views is not None:
        what = f"the board in {views.boards} frames, none of them kept still enough"
    print(f"calibrate intrinsics: {what} from {source}", file=sys.stderr)
    if views is not None and not views.boards:
        print(f"expected {args.board} of {args.columns} x {args.rows} squares", file=sys.stderr)


def _progress(views: BoardViews) -> str:
    lines = [*views.picture(), f"{len(views.kept)} views of {views.boards} boards seen"]
    missing = views.missing()
    return "\n".join(
        [*lines, *(f"still: {what}" for what in missing)] if missing else [*lines, "everything was shown"]
    )


def _record(found: Fit, problems: list[str]) -> dict[str, Any]:
    camera = found.camera
    return {
        "model": found.model,
        "fx_px": camera.fx,
        "fy_px": camera.fy,
        "cx_px": camera.cx,
        "cy_px": camera.cy,
        "sigma_px": found.sigma.round(4).tolist(),
        "distortion": list(camera.distortion.coefficients) if camera.distortion else [],
        "width_px": camera.width,
        "height_px": camera.height,
        "rms_px": round(found.rms, 4),
        "views": len(found.views),
        "rejected": len(found.rejected),
        "coverage": round(found.coverage, 3),
        "doubts": problems,
    }


def _say(found: Fit, problems: list[str], out: Path) -> None:
    c, s = found.camera, found.sigma
    print(f"camera     fx {c.fx:.2f} ± {s[0]:.2f}, fy {c.fy:.2f} ± {s[1]:.2f}, cx {c.cx:.2f} ± {s[2]:.2f}, "
          f"cy {c.cy:.2f} ± {s[3]:.2f} px, {c.width} x {c.height}")  # fmt: skip
    coefficients = ", ".join(f"{k:.5f}" for k in (c.distortion.coefficients if c.distortion else ()))
    print(f"lens       {found.model} [{coefficients}]")
    print(
        f"evidence   {len(found.views)} views, {len(found.rejected)} left out, corners in {found.coverage:.0%} of the "
        f"picture, they miss by {found.rms:.3f} px RMS (worst view {found.errors.max():.3f})"
    )
    print()
    for problem in problems:
        print(f"Not good yet: {problem}")
    print("" if problems else "Good. ", end="")
    print(f'Written to {out}. For the config:\n\n[camera]\ncalibration = "{out}"')


def _plot(found: Fit, path: Path) -> None:
    """Where corners missed, and which views missed most."""
    from swarmtrack.benchmarks.report import pyplot

    plt = pyplot()
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.5), width_ratios=(3, 2))
    u, v = found.pixels.T
    du, dv = found.residuals.T
    longer = ARROW * found.camera.width / max(found.rms, 1e-6)
    arrows = left.quiver(
        u,
        v,
        du,
        dv,
        (du**2 + dv**2) ** 0.5,
        angles="xy",
        scale_units="xy",
        scale=1.0 / longer,
        width=0.003,
        cmap="viridis",
    )
    figure.colorbar(arrows, ax=left, label="miss, px")
    left.set(
        xlim=(0, found.camera.width), ylim=(found.camera.height, 0), aspect="equal", xlabel="u, px", ylabel="v, px",
        title=f"corners miss by {found.rms:.3f} px RMS (drawn {longer:.0f} times as long)",
    )  # fmt: skip
    right.bar(range(len(found.errors)), found.errors, color="#4477aa")
    right.axhline(found.rms, color="#cc6677", linewidth=1.0)
    right.set(
        xlabel="view",
        ylabel="miss, px RMS",
        title=f"{len(found.views)} views, {len(found.rejected)} left out",
    )
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    plt.close(figure)
