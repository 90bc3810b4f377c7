"""A small folder of labelled images, rendered."""

import csv
from pathlib import Path

import cv2
import numpy as np

from swarmtrack.training import render


def data_directory(root: Path, frames: int = 4) -> Path:
    """A small one, rendered: a drone in each image but the last."""
    rng = np.random.default_rng(1)
    (root / "images").mkdir(parents=True)
    images, labels = [], []
    for i in range(frames):
        picture = render.background(rng, 200, 240)
        if i < frames - 1:
            u, v, w, h = render.paste_into(rng, picture, render.multirotor(rng), np.array([120.0, 90.0]), 40)
            labels.append([f"{i}.png", u - w / 2, v - h / 2, w, h, "drone"])
        cv2.imwrite(str(root / "images" / f"{i}.png"), picture.astype(np.uint8))
        images.append([f"{i}.png", 240, 200, "rendered", "scene" if i < frames - 1 else "negative", i])
    for name, header, rows in (
        ("images.csv", "image,width,height,source,scene,frame", images),
        ("labels.csv", "image,x,y,w,h,label", labels),
    ):
        with (root / name).open("w", newline="") as file:
            csv.writer(file).writerows([header.split(","), *rows])
    return root
