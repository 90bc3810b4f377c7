"""Calibration boards: drawn, printed, and found in images."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array, Image

Kind = Literal["charuco", "aprilgrid", "checkerboard"]
BOARD_KINDS: tuple[Kind, ...] = ("charuco", "aprilgrid", "checkerboard")
DICTIONARIES = {"charuco": cv2.aruco.DICT_5X5_250, "aprilgrid": cv2.aruco.DICT_APRILTAG_36h11}
MARKER_SHARE = 0.7  # of a square that its marker fills
LEAST_BOARD_CORNERS = 8
LEAST_SPREAD = 0.05  # second singular value of the corners over the first: less is a line
PAPERS_MM = {"A4": (297.0, 210.0), "A3": (420.0, 297.0), "A2": (594.0, 420.0), "letter": (279.4, 215.9)}


class Seen(NamedTuple):
    """A board in one image. ids (n,): of corners; points (n, 3) m on the board; pixels (n, 2)."""

    ids: NDArray[np.int64]
    points: Array
    pixels: Array


@dataclass(frozen=True)
class Board:
    """columns x rows squares (or tags) of `square_m`; a checkerboard shows all its inner corners or none."""

    kind: Kind = "charuco"
    columns: int = 9
    rows: int = 6
    square_m: float = 0.028

    def __post_init__(self) -> None:
        if self.kind not in BOARD_KINDS:
            raise ValueError(f"board: found {self.kind}, expected one of {', '.join(BOARD_KINDS)}")
        if not (3 <= self.columns <= 30 and 3 <= self.rows <= 30):
            raise ValueError(f"board: found {self.columns} x {self.rows}, expected 3 … 30 squares each way")
        if not 1e-3 <= self.square_m <= 2.0:
            raise ValueError(f"board: squares of {1e3 * self.square_m:g} mm, expected 1 … 2000 mm")

    @property
    def size_m(self) -> tuple[float, float]:
        """(width, height) without a margin."""
        return self.columns * self.square_m, self.rows * self.square_m

    def draw(self, square_px: int) -> Image:
        """(rows * square_px, columns * square_px) grey, without a margin. square_px: a multiple of 20, for tags."""
        size = (self.columns * square_px, self.rows * square_px)
        if self.kind == "charuco":
            return np.asarray(self._charuco().generateImage(size, marginSize=0, borderBits=1), np.uint8)
        image = np.full(size[::-1], 255, np.uint8)
        if self.kind == "checkerboard":
            dark = (np.add.outer(np.arange(self.rows), np.arange(self.columns)) % 2) == 0
            image[np.kron(dark, np.ones((square_px, square_px), bool))] = 0
            return image
        side = round(MARKER_SHARE * square_px)
        margin = (square_px - side) // 2
        dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES["aprilgrid"])
        for tag in range(self.columns * self.rows):
            row, column = divmod(tag, self.columns)
            y, x = row * square_px + margin, column * square_px + margin
            image[y : y + side, x : x + side] = cv2.aruco.generateImageMarker(dictionary, tag, side)
        return image

    def find(self, image: Image) -> Seen | None:
        """The board in (h, w) or (h, w, 3); None where too little of it is visible."""
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image, np.uint8)
        finder = {
            "charuco": self._find_charuco,
            "aprilgrid": self._find_tags,
            "checkerboard": self._find_checks,
        }
        seen = finder[self.kind](grey)
        if seen is None or len(seen.ids) < LEAST_BOARD_CORNERS:
            return None
        spread = np.linalg.svd(seen.points[:, :2] - seen.points[:, :2].mean(axis=0), compute_uv=False)
        return seen if spread[1] > LEAST_SPREAD * spread[0] else None

    def _charuco(self) -> cv2.aruco.CharucoBoard:
        dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES["charuco"])
        return cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square_m, MARKER_SHARE * self.square_m, dictionary
        )

    def _find_charuco(self, grey: Image) -> Seen | None:
        board = self._charuco()
        corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(grey)
        if ids is None or len(ids) == 0:
            return None
        flat = np.asarray(ids, dtype=np.int64).ravel()
        points = np.asarray(board.getChessboardCorners(), dtype=float)[flat]
        return Seen(flat, points, np.asarray(corners, dtype=float).reshape(-1, 2))

    def _find_tags(self, grey: Image) -> Seen | None:
        dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES["aprilgrid"])
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
        corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(grey)
        if ids is None:
            return None
        known = [
            (int(tag), quad.reshape(4, 2))
            for tag, quad in zip(ids.ravel(), corners, strict=True)
            if tag < self.columns * self.rows
        ]
        if not known:
            return None
        lead = 0.5 * (1.0 - MARKER_SHARE) * self.square_m
        side = MARKER_SHARE * self.square_m
        quad_m = np.array([[0.0, 0.0], [side, 0.0], [side, side], [0.0, side]])
        tags = np.array([tag for tag, _ in known])
        places = np.stack([tags % self.columns, tags // self.columns], axis=1) * self.square_m + lead
        flat = (places[:, None] + quad_m).reshape(-1, 2)
        all_ids = (4 * tags[:, None] + np.arange(4)).ravel().astype(np.int64)
        pixels = np.concatenate([quad for _, quad in known]).astype(float)
        return Seen(all_ids, np.column_stack([flat, np.zeros(len(flat))]), pixels)

    def _find_checks(self, grey: Image) -> Seen | None:
        inner = (self.columns - 1, self.rows - 1)
        found, corners = cv2.findChessboardCornersSB(
            grey, inner, flags=cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
        )
        if not found:
            return None
        grid = np.stack(np.meshgrid(np.arange(inner[0]), np.arange(inner[1])), axis=-1).reshape(-1, 2) + 1.0
        points = np.column_stack([self.square_m * grid, np.zeros(len(grid))])
        return Seen(np.arange(len(points)), points, np.asarray(corners, dtype=float).reshape(-1, 2))


def as_pdf(board: Board, paper: str, square_px: int = 200) -> bytes:
    """A page with the board in its middle, to scale: print it at 100 %. Raises ValueError where it does not fit."""
    page, size = PAPERS_MM[paper], tuple(1e3 * side for side in board.size_m)
    if size[0] > page[0] - 10.0 or size[1] > page[1] - 10.0:
        raise ValueError(
            f"board of {size[0]:.0f} x {size[1]:.0f} mm, expected at most {page[0] - 10:.0f} x {page[1] - 10:.0f} mm "
            f"for {paper}: fewer or smaller squares, or another --paper"
        )
    points = 72.0 / 25.4
    image = board.draw(square_px)
    height, width = image.shape
    x, y = ((page[i] - size[i]) / 2.0 * points for i in (0, 1))
    place = f"{size[0] * points:.4f} 0 0 {size[1] * points:.4f} {x:.4f} {y:.4f} cm"
    squares = f"{board.columns} x {board.rows}, squares of {1e3 * board.square_m:g} mm"
    note = f"{board.kind} {squares}: print at 100 %, measure one"
    drawing = f"q {place} /B Do Q BT /F 8 Tf {x:.1f} {max(y - 10, 3):.1f} Td ({note}) Tj ET".encode()
    pixels = zlib.compress(image.tobytes(), 9)
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {page[0] * points:.2f} {page[1] * points:.2f}] "
        f"/Contents 4 0 R /Resources << /XObject << /B 5 0 R >> /Font << /F 6 0 R >> >> >>".encode(),
        b"<< /Length %d >>\nstream\n%b\nendstream" % (len(drawing), drawing),
        b"<< /Type /XObject /Subtype /Image /Width %d /Height %d /ColorSpace /DeviceGray /BitsPerComponent 8 "
        b"/Filter /FlateDecode /Length %d >>\nstream\n%b\nendstream" % (width, height, len(pixels), pixels),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    out, offsets = bytearray(b"%PDF-1.4\n"), []
    for number, body in enumerate(objects, start=1):
        offsets.append(len(out))
        out += b"%d 0 obj\n%b\nendobj\n" % (number, body)
    start = len(out)
    out += b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    out += b"".join(b"%010d 00000 n \n" % offset for offset in offsets)
    out += b"trailer << /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, start)
    return bytes(out)
