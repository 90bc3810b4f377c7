"""`swarmtrack label DIR --out DATA`: pictures of a flight, labelled by where teammates knew themselves to be."""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from swarmtrack.arguments import add_file, add_folder, count, is_taken
from swarmtrack.errors import RecordingError, SourceError

if TYPE_CHECKING:
    from swarmtrack.replay.flight_labels import LabelledPicture

SHEET_COLUMNS, SHEET_ROWS, SHEET_WIDTH = 4, 4, 320  # pictures, px


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(
        parser,
        "path",
        'recordings of one flight, of all its drones if possible; with [recording] frames = "jpeg"',
        metavar="FILE|DIR",
    )
    add_folder(parser, "--out", "a new folder, for swarmtrack train --data", metavar="DATA", required=True)
    parser.add_argument(
        "--span",
        type=_metres,
        required=True,
        metavar="M",
        help="width of your drones, from rotor tip to rotor tip",
    )
    parser.add_argument(
        "--height", type=_metres, metavar="M", help="height of your drones (default: span / 3)"
    )
    parser.add_argument(
        "--every", type=count, default=1, metavar="N", help="use every Nth image (default: %(default)s)"
    )


def _metres(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.01 <= value <= 20.0:
        raise argparse.ArgumentTypeError(f"found {text}, expected metres, 0.01 to 20")
    return value


def run(args: argparse.Namespace) -> int:
    from swarmtrack.recording.reader import recordings_below
    from swarmtrack.replay.flight_labels import Body, FlightLabels

    if is_taken(args.out):
        raise SourceError(f"--out {args.out}: already exists, expected a new folder")
    recordings = recordings_below(args.path)
    found = FlightLabels(recordings, Body(args.span, args.height or args.span / 3))
    if not found.observers:
        raise RecordingError(f"{args.path}: holds no drone's recording, expected one with pictures")
    (args.out / "images").mkdir(parents=True, exist_ok=True)
    pictures, labels = _write(args.out, found.pictures(args.every))
    for why, many in found.skipped.most_common():
        print(f"{many} pictures left out: {why}", file=sys.stderr)
    if not pictures:
        raise RecordingError(
            f"{args.path}: no picture could be labelled"
            + ("" if found.skipped else ', expected recordings with [recording] frames = "jpeg"')
        )
    print(f"{args.out}: {pictures} pictures, {labels} labels; look at {args.out / 'labels.jpg'}")
    return 0


def _write(out: Path, pictures: Iterable[LabelledPicture]) -> tuple[int, int]:
    """images/, images.csv, labels.csv and labels.jpg; how many pictures and labels."""
    images, labels, shown = 0, 0, []
    with (
        (out / "images.csv").open("w", newline="", encoding="utf-8") as image_file,
        (out / "labels.csv").open("w", newline="", encoding="utf-8") as label_file,
    ):
        image_rows, label_rows = csv.writer(image_file), csv.writer(label_file)
        image_rows.writerow(["image", "source", "scene"])
        label_rows.writerow(["image", "x", "y", "w", "h", "label"])
        for picture in pictures:
            camera = f"_camera-{picture.camera + 1}" if picture.camera else ""
            name = f"drone-{picture.observer}{camera}_{picture.sequence:07d}.jpg"
            (out / "images" / name).write_bytes(picture.jpeg)
            image_rows.writerow([name, f"drone-{picture.observer}", out.name])
            for label in picture.labels:
                label_rows.writerow([name, *(f"{value:.2f}" for value in label.box), "drone"])
            images += 1
            labels += len(picture.labels)
            if picture.labels:
                shown.append(picture)
    if shown:
        count = SHEET_COLUMNS * SHEET_ROWS
        step = max(1, len(shown) // count)
        _sheet(out / "labels.jpg", shown[::step][:count])
    return images, labels


def _sheet(path: Path, pictures: list[LabelledPicture]) -> None:
    """Some of the pictures with their boxes: what one looks at before one trains on it."""
    import cv2
    import numpy as np

    cells = []
    for picture in pictures:
        image: Any = cv2.imdecode(np.frombuffer(picture.jpeg, np.uint8), cv2.IMREAD_COLOR)
        for label in picture.labels:
            x, y, w, h = label.box
            cv2.rectangle(image, (round(x), round(y)), (round(x + w), round(y + h)), (80, 220, 80), 2)
            where = (round(x), max(12, round(y) - 4))
            cv2.putText(image, str(label.drone_id), where, cv2.FONT_HERSHEY_SIMPLEX, 0.6, (80, 220, 80), 2)
        height = round(SHEET_WIDTH * image.shape[0] / image.shape[1])
        cells.append(cv2.resize(image, (SHEET_WIDTH, height), interpolation=cv2.INTER_AREA))
    height = max(cell.shape[0] for cell in cells)
    sheet = np.full((-(-len(cells) // SHEET_COLUMNS) * height, SHEET_COLUMNS * SHEET_WIDTH, 3), 40, np.uint8)
    for k, cell in enumerate(cells):
        top, left = k // SHEET_COLUMNS * height, k % SHEET_COLUMNS * SHEET_WIDTH
        sheet[top : top + cell.shape[0], left : left + SHEET_WIDTH] = cell
    cv2.imwrite(str(path), sheet)
