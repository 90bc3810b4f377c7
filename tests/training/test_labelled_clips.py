"""Clips with labels: what they show, how their frames become training data, and what is held out with what."""

from __future__ import annotations

import argparse
import csv

import cv2
import numpy as np
import pytest

from support.labelled_pictures import data_directory
from swarmtrack.agents import train
from swarmtrack.agents.main import main
from swarmtrack.training.dataset import Recipe, SampleSource
from swarmtrack.training.labelled_clips import Origin, find_clips, labelled_frames, origins, window
from swarmtrack.training.labelled_images import LabelledFrame, held_out
from swarmtrack.training.split import what_to_learn
from swarmtrack.training.split_arguments import split_of


def write_clip(folder, name, boxes, side=(480, 400)):
    """boxes: by frame, (x, y, w, h) from the top left corner, drawn dark on grey."""
    writer = cv2.VideoWriter(str(folder / f"{name}.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, side)
    rows = []
    for frame in range(max(boxes) + 1):
        image = np.full((side[1], side[0], 3), 180, np.uint8)
        for x, y, w, h in boxes.get(frame, []):
            image[y : y + h, x : x + w] = 20
            rows.append([frame, 1, x, y, w, h])
        writer.write(image)
    writer.release()
    with (folder / f"{name}_gt.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["frame", "id", "x", "y", "w", "h"], *rows])


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("V_BIRD_001", "bird"),
        ("helicopter-7", "helicopter"),
        ("V_DRONE_106", "drone"),
        ("composite_3_A", "drone"),
    ],
)
def test_the_name_of_a_clip_tells_what_is_labelled_in_it(tmp_path, name, kind):
    write_clip(tmp_path, name, {0: [(40, 40, 20, 20)]})
    (clip,) = find_clips(tmp_path)
    assert clip.kind == kind


def test_each_nth_labelled_frame_is_read_and_lies_where_its_labels_say(tmp_path):
    boxes = {k: [(40 + 10 * k, 60, 20, 12)] for k in range(9) if k != 4}
    write_clip(tmp_path, "V_BIRD_001", boxes)
    (clip,) = find_clips(tmp_path)
    frames = list(labelled_frames(clip, Origin("src", "negative"), 2))
    assert [frame.name for frame in frames] == [f"V_BIRD_001_{k:04d}" for k in (0, 2, 6, 8)]
    for frame in frames:
        assert frame.drones.shape == (0, 4)
        assert frame.kinds == ("bird",)
        (u, v, _, _) = frame.distractors[0]
        rows, columns = np.nonzero(frame.image[..., 0] < 100)
        assert (columns.mean(), rows.mean()) == pytest.approx((u, v), abs=1.5)


def test_a_window_holds_its_object_with_the_label_on_it_and_is_the_same_each_time(tmp_path):
    write_clip(
        tmp_path, "V_DRONE_007", {0: [(400, 350, 30, 20)], 1: [(5, 5, 20, 20)], 2: [(200, 100, 16, 12)]}
    )
    (clip,) = find_clips(tmp_path)
    for frame in labelled_frames(clip, Origin("src", "scene"), 1):
        cut, again = window(frame, 160), window(frame, 160)
        assert cut.image.shape == (160, 160, 3)
        assert cut.is_window
        assert np.array_equal(cut.image, again.image)
        (u, v, _, _) = cut.drones[0]
        rows, columns = np.nonzero(cut.image[..., 0] < 100)
        assert (columns.mean(), rows.mean()) == pytest.approx((u, v), abs=1.5)


def test_a_window_leaves_out_the_labels_of_what_lies_outside():
    boxes = np.array([[50.0, 50.0, 20.0, 20.0], [560.0, 440.0, 20.0, 20.0]])
    frame = LabelledFrame(
        "a", "", "negative", np.zeros((480, 640, 3), np.uint8), np.empty((0, 4)), boxes, ("bird", "airplane")
    )
    cut = window(frame, 160)
    assert len(cut.distractors) == len(cut.kinds) == 1


def test_images_and_a_clip_of_the_same_source_belong_together(tmp_path):
    for name in ("V_BIRD_001", "V_DRONE_002", "V_DRONE_999"):
        write_clip(tmp_path, name, {0: [(40, 40, 20, 20)]})
    image, none = np.zeros((8, 8, 3), np.uint8), np.empty((0, 4))
    frames = [LabelledFrame("x.jpg", "Somebody V_DRONE_002", "A_field", image, none, none)]
    assert origins(find_clips(tmp_path), frames) == {
        "V_BIRD_001": Origin("V_BIRD_001", "negative"),
        "V_DRONE_002": Origin("Somebody V_DRONE_002", "A_field"),
        "V_DRONE_999": Origin("V_DRONE_999", "V_DRONE_999"),
    }


def options(parser_of, *arguments):
    parser = argparse.ArgumentParser()
    parser_of(parser)
    return parser.parse_args(list(map(str, arguments)))


def test_what_is_held_out_is_validated_on_in_whole_frames_and_never_trained_on(tmp_path):
    clips = tmp_path / "clips"
    clips.mkdir()
    names = [f"V_BIRD_00{k}" for k in range(1, 7)]
    for name in [*names, "V_DRONE_002", "V_DRONE_003"]:
        write_clip(clips, name, {k: [(40 + k, 40, 20, 20)] for k in range(10)})
    data = data_directory(tmp_path / "data")
    chosen = [
        "--data",
        data,
        "--clips",
        clips,
        "--every",
        1,
        "--hold-out",
        "V_DRONE_003",
        "--hold-out-negatives",
    ]
    told = options(train.add_arguments, "--out", tmp_path / "m.onnx", *chosen)
    training, validation = what_to_learn(split_of(told), told.every)
    kept = {frame.source for frame in validation}
    assert kept - {"rendered"} == {n for n in names if held_out("negative", n)} | {"V_DRONE_003"}
    assert not kept & {frame.source for frame in training if frame.is_window}
    assert {frame.image.shape for frame in validation if frame.source in names} == {(400, 480, 3)}
    assert {frame.name for frame in training if frame.source == "V_DRONE_002"} == {
        f"V_DRONE_002_{k:04d}" for k in range(10)
    }


def test_windows_of_clips_are_seen_as_often_as_the_recipe_says(tmp_path):
    """Bright frames without drones, dark windows: which was cropped shows in the sample."""
    none, bird = np.empty((0, 4)), np.array([[100.0, 100.0, 20.0, 20.0]])
    whole = LabelledFrame("w", "", "negative", np.full((400, 400, 3), 250, np.uint8), none, none)
    dark = np.full((320, 320, 3), 5, np.uint8)
    cut = LabelledFrame("c", "", "negative", dark, none, bird, ("bird",), is_window=True)
    recipe = Recipe(real_background=1.0, real_frame=0.0, of_clips=0.8, empty=1.0)
    source = SampleSource([whole, cut], recipe, np.random.default_rng(0))
    seen = [np.median(source.sample().image) < 120 for _ in range(30)]
    assert 0.6 < np.mean(seen) < 0.95


def test_a_folder_without_clips_is_said(tmp_path, capsys):
    pytest.importorskip("torch")
    assert (
        main(["train", "--out", str(tmp_path / "m.onnx"), "--iterations", "1", "--clips", str(tmp_path)]) == 2
    )
    assert "no pair of NAME.mp4 and NAME_gt.csv" in capsys.readouterr().err
