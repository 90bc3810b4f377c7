"""The detector: exact geometry, decoding, honest failures, and drones found by the shipped model."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from support.places import SHARED
from swarmtrack.benchmarks import detector as bench
from swarmtrack.detection import letterbox
from swarmtrack.detection.description import Description
from swarmtrack.detection.detector import SMALLEST_INPUT_PX, Detector
from swarmtrack.detection.heads import Candidates, centernet, read, suppress
from swarmtrack.detection.metadata import box_width_of
from swarmtrack.detection.model import metadata_of, model_path
from swarmtrack.errors import ModelError
from swarmtrack.lab.score import detector_score
from swarmtrack.messages import Frame, StampKind
from swarmtrack.training import render
from swarmtrack.training.labelled_clips import find_clips

TRACKS = SHARED / "drones_real" / "tracks"

DESCRIPTION = Description(head="centernet", stride=4, source="this test", entries={})
INPUT = (80, 64)
ONE_CLASS = np.zeros(50, np.intp)


def frame_of(image: np.ndarray, t: float = 1.5, sequence: int = 7) -> Frame:
    return Frame(t, 0.0, sequence, image, StampKind.MEDIA)


@pytest.fixture(scope="module")
def detector() -> Detector:
    return Detector("default")


SIZES = [(640, 512), (641, 359), (1280, 720), (320, 240)]


# --- letterbox


@given(
    width=st.integers(40, 2000),
    height=st.integers(40, 2000),
    scale=st.floats(0.2, 4),
    where=st.tuples(st.floats(0, 1), st.floats(0, 1)),
)
def test_a_point_put_into_the_input_comes_back_where_it_was(width, height, scale, where):
    box = letterbox.fit(width, height, scale=scale, multiple=32)
    point = np.array([where]) * [width, height]
    assert (box.input_width % 32, box.input_height % 32) == (0, 0)
    assert np.abs(box.points_to_image(box.points_to_input(point)) - point).max() < 1e-9


@pytest.mark.parametrize(
    ("size", "scale"),
    [
        *((size, scale) for size in SIZES for scale in (0.5, 1.0, 1.5, 3.0) if scale * size[0] < 2000),
        pytest.param((1280, 720), 3.0, marks=pytest.mark.long("pictures of 8 megapixels")),
    ],
)
def test_pixels_land_where_the_mapping_says_to_a_hundredth_of_a_pixel(size, scale):
    """Smooth spots are resized for real; their centres of mass, mapped back, are where they were drawn.

    The mean over eight, because rounding to 8 bits moves each by a hundredth.
    """
    width, height = size
    rng = np.random.default_rng(0)
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    box = letterbox.fit(width, height, scale=scale, multiple=32)
    rows, columns = np.mgrid[0 : box.input_height, 0 : box.input_width]
    errors = []
    for centre in rng.uniform(0.3, 0.7, (8, 2)) * [width, height]:
        spot = 255 * np.exp(-((u - centre[0]) ** 2 + (v - centre[1]) ** 2) / (2 * 12.0**2))
        seen = box.to_input(spot.round().astype(np.uint8), pad_value=0)[..., 0].astype(float)
        mass_centre = np.array([[(seen * columns).sum(), (seen * rows).sum()]]) / seen.sum()
        errors.append(box.points_to_image(mass_centre)[0] - centre)
    assert np.abs(np.mean(errors, axis=0)).max() < 0.01


def test_a_net_of_one_input_size_gets_the_whole_image_unstretched():
    box = letterbox.fit_fixed(1280, 720, input_width=320, input_height=320)
    assert (box.width, box.height) == (320, 180)
    assert box.to_input(np.zeros((720, 1280, 3), np.uint8), 114).shape == (320, 320, 3)


# --- heads


def heads_with(peaks: list[tuple[int, int, float]], h: int = 16, w: int = 20) -> list[np.ndarray]:
    heat, offset, size = (np.zeros((1, n, h, w), np.float32) for n in (1, 2, 2))
    for row, column, score in peaks:
        heat[0, 0, row, column] = score
        offset[0, :, row, column] = 0.25, -0.5
        size[0, :, row, column] = np.log([5.0, 3.0])
    return [heat, offset, size]


def test_peaks_of_a_heat_map_become_centres_and_sizes_best_first():
    outputs = heads_with([(3, 5, 0.6), (10, 12, 0.9), (8, 2, 0.1)])
    outputs[0][0, 0, 10, 13] = 0.8  # the flank of a peak is no peak
    found = centernet(outputs, DESCRIPTION, 0.3, INPUT)
    assert found.score == pytest.approx([0.9, 0.6])
    assert found.centre == pytest.approx(np.array([[49.0, 38.0], [21.0, 10.0]]))
    assert found.size == pytest.approx(np.array([[20.0, 12.0], [20.0, 12.0]]))


def test_an_empty_heat_map_holds_nothing():
    found = suppress(centernet(heads_with([]), DESCRIPTION, 0.3, INPUT), limit=10)
    assert found.centre.shape == (0, 2)
    assert found.size.shape == (0, 2)
    assert found.score.shape == (0,)


def test_outputs_of_another_head_are_refused_with_their_shapes():
    with pytest.raises(ModelError, match=r"\(1, 84, 8400\)"):
        read([np.zeros((1, 84, 8400), np.float32)], DESCRIPTION, 0.3, INPUT)


def test_a_split_peak_is_one_drone_and_two_neighbours_stay_two():
    centre = np.array([[100.0, 100.0], [104.0, 101.0], [130.0, 100.0]])
    found = suppress(
        Candidates(centre, np.full((3, 2), 30.0), np.array([0.9, 0.8, 0.7]), ONE_CLASS[:3]), limit=10
    )
    assert found.centre[:, 0].tolist() == [100.0, 130.0]


def test_no_more_than_the_limit_are_kept():
    centre = np.stack([np.arange(50) * 100.0, np.zeros(50)], axis=1)
    assert (
        len(
            suppress(
                Candidates(centre, np.full((50, 2), 10.0), np.linspace(1, 0, 50), ONE_CLASS), limit=8
            ).score
        )
        == 8
    )


# --- the shipped model


@pytest.mark.parametrize("grey", [False, True])
def test_the_shipped_model_finds_rendered_drones_against_the_sky(detector, grey):
    rng = np.random.default_rng(5)
    found = false = 0
    for _ in range(10):
        image = np.full((256, 320, 3), rng.uniform([200, 150, 100], [250, 200, 160]), np.float32)
        centres = np.array([[70.0, 60.0], [200.0, 90.0], [120.0, 190.0]]) + rng.uniform(-15, 15, (3, 2))
        for centre in centres:
            render.paste_into(rng, image, render.multirotor(rng), centre, rng.uniform(20, 50))
        picture = image.astype(np.uint8)
        seen = detector.detect(
            detector.plan(frame_of(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) if grey else picture))
        )
        distance = np.linalg.norm(seen.centre[:, None] - centres[None], axis=2).reshape(-1, 3)
        found += int((distance.min(axis=0, initial=99) < 6).sum())
        false += int((distance.min(axis=1, initial=99) > 20).sum())
    assert found >= 24  # of 30
    assert false <= 3


@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "recall", "false_per_frame"),
    [
        ("V_DRONE_106", 0.95, 1.2),
        pytest.param("composite_5_F", 0.9, 0.2, marks=pytest.mark.long("another clip, of larger pictures")),
    ],
)
def test_the_shipped_model_finds_the_drones_of_a_real_clip(detector, name, recall, false_per_frame):
    clip = TRACKS / f"{name}.mp4"
    if not clip.is_file():
        pytest.skip(f"{clip} is not there")
    (found,) = (entry for entry in find_clips(TRACKS) if entry.name == name)
    looks = list(bench.look_at_clip(detector, found, every=8))
    seen = detector_score.summary(looks, detector.score_threshold)
    assert seen["recall"] > recall
    assert seen["false_per_image"] < false_per_frame


@pytest.mark.long("detects twice in a real clip; test_motion_cue.py has the cue itself in the default run")
@pytest.mark.shared
def test_on_a_real_clip_what_moved_is_found_more_surely_and_not_at_the_price_of_ghosts():
    clip = TRACKS / "V_DRONE_106.mp4"
    if not clip.is_file():
        pytest.skip(f"{clip} is not there")
    (found,) = (entry for entry in find_clips(TRACKS) if entry.name == clip.stem)
    without, beside = (
        detector_score.summary(list(bench.look_at_clip(detector, found, every=6)), detector.own_threshold)
        for detector in (
            Detector(look="whole", second_stage="none", motion=motion) for motion in (False, True)
        )
    )
    assert beside["recall"] > max(0.95, without["recall"] + 0.05)
    assert beside["false_per_image"] < without["false_per_image"] + 0.3


def test_an_image_without_anything_gives_no_detections(detector):
    seen = detector.detect(detector.plan(frame_of(np.full((480, 640, 3), 128, np.uint8))))
    assert len(seen) == 0
    assert seen.centre.shape == (0, 2)


def test_detections_carry_the_frame_s_time_and_sequence(detector):
    seen = detector.detect(detector.plan(frame_of(np.zeros((100, 130), np.uint8), t=12.25, sequence=41)))
    assert (seen.t, seen.sequence) == (12.25, 41)


def test_shifting_the_image_shifts_the_detection_as_much(detector):
    """By 4 px, one cell of the net: a half-pixel error in the mapping would not show, a wrong offset would."""
    rng = np.random.default_rng(2)
    sky = np.full((256, 320, 3), (230, 180, 130), np.float32)
    render.paste_into(rng, sky, render.multirotor(rng), np.array([160.0, 120.0]), 40)
    here = detector.detect(detector.plan(frame_of(sky.astype(np.uint8))))
    there = detector.detect(detector.plan(frame_of(np.roll(sky, (32, 64), axis=(0, 1)).astype(np.uint8))))
    assert len(here) == len(there) == 1
    assert there.centre[0] - here.centre[0] == pytest.approx([64, 32], abs=0.05)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((0, 0, 3), np.uint8),
        np.zeros((480, 0), np.uint8),
        np.zeros((100, 100, 3), np.uint16),
        np.zeros((100, 100, 4), np.uint8),
        np.zeros((100, 100), np.float32),
        np.zeros((SMALLEST_INPUT_PX - 1, 100), np.uint8),
        np.zeros(100, np.uint8),
    ],
    ids=lambda image: f"{image.dtype}{image.shape}",
)
def test_a_frame_that_is_no_image_is_counted_and_said_and_is_not_an_empty_sky(image):
    detector = Detector("default")
    assert detector.detect(detector.plan(frame_of(image))) is None
    status = detector.status()
    assert not status.ok
    assert str(image.dtype) in status.text
    assert "expected uint8" in status.text
    assert dict(status.counters)["refused_frames"] == 1
    detector.detect(detector.plan(frame_of(np.zeros((64, 64), np.uint8))))
    assert detector.status().ok


def test_latency_is_reported_for_the_last_frames():
    detector = Detector("default")
    assert detector.latency.infer.max == 0
    detector.warm_up(96, 64)
    for _ in range(300):
        detector.detect(detector.plan(frame_of(np.zeros((64, 96, 3), np.uint8))))
    latency = detector.latency
    assert 0 < latency.infer.p50 <= latency.infer.p95 <= latency.infer.max
    assert dict(detector.status().counters)["frames"] == 300


# --- files that are no models


def test_a_missing_model_is_named():
    with pytest.raises(ModelError, match=r"nowhere\.onnx: no such model file"):
        Detector("nowhere.onnx")


@pytest.mark.parametrize("damage", ["truncated", "random", "empty"])
def test_a_damaged_file_is_refused_with_its_name(tmp_path, damage):
    whole = model_path("default").read_bytes()
    content = {
        "truncated": whole[: len(whole) // 2],
        "random": np.random.default_rng(1).bytes(9999),
        "empty": b"",
    }
    path = tmp_path / "broken.onnx"
    path.write_bytes(content[damage])
    with pytest.raises(ModelError, match=r"broken\.onnx"):
        Detector(path)


def altered(tmp_path: Path, alter) -> Path:
    """A copy of the shipped model, changed."""
    onnx = pytest.importorskip("onnx")
    model = onnx.load(str(model_path("default")))
    alter(model)
    path = tmp_path / "altered.onnx"
    path.write_bytes(model.SerializeToString())
    return path


def set_metadata(key: str, value: str):
    def alter(model) -> None:
        for entry in model.metadata_props:
            if entry.key == f"swarmtrack.{key}":
                entry.value = value

    return alter


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("head", "yolo_v99", "one of centernet"),
        ("stride", "0", "positive whole number"),
        ("score_threshold", "nan", r"in 0…1"),
        ("mean", "[1, 2]", "three numbers"),
        ("channel_order", "RBG", "BGR or RGB"),
        ("names", json.dumps("drone"), "list of class names"),
        ("box_width", json.dumps({"factor": 0.0}), "JSON object of factor, padding_px"),
        ("box_width", json.dumps({"width": 1.0}), "JSON object of factor, padding_px"),
        ("box_width", "[1.14]", "JSON object of factor, padding_px"),
    ],
)
def test_wrong_metadata_is_named_with_what_was_expected(tmp_path, key, value, expected):
    with pytest.raises(ModelError, match=rf"swarmtrack\.{key} is .*{expected}"):
        Detector(altered(tmp_path, set_metadata(key, value)))


def test_the_shipped_model_says_how_wide_its_boxes_are_and_a_model_need_not(tmp_path):
    shipped = Detector().description.box_width
    assert shipped == box_width_of("default", metadata_of(model_path("default")))
    assert shipped is not None
    assert shipped.padding_px > 5.0

    def silent(model) -> None:
        entries = [entry for entry in model.metadata_props if entry.key != "swarmtrack.box_width"]
        model.ClearField("metadata_props")
        model.metadata_props.extend(entries)

    assert Detector(altered(tmp_path, silent)).description.box_width is None


def test_metadata_that_miss_an_entry_are_refused(tmp_path):
    def alter(model) -> None:
        entries = [entry for entry in model.metadata_props if entry.key != "swarmtrack.head"]
        model.ClearField("metadata_props")
        model.metadata_props.extend(entries)

    with pytest.raises(ModelError, match=r"swarmtrack\.head is missing .*expected one of centernet"):
        Detector(altered(tmp_path, alter))


def test_a_centernet_without_metadata_is_recognised_by_its_three_maps(tmp_path):
    bare = Detector(altered(tmp_path, lambda model: model.ClearField("metadata_props")))
    assert (bare.description.head, bare.description.stride) == ("centernet", 4)
    assert bare.description.source == "the shapes of its outputs"


def test_a_model_of_a_future_opset_is_refused(tmp_path):
    def alter(model) -> None:
        model.opset_import[0].version = 999

    with pytest.raises(ModelError, match=r"altered\.onnx: .*(?i:opset)"):
        Detector(altered(tmp_path, alter))


def test_a_model_that_answers_nan_is_refused_before_it_flies(tmp_path):
    onnx = pytest.importorskip("onnx")

    def alter(model) -> None:
        weight = model.graph.initializer[0]
        values = np.full(onnx.numpy_helper.to_array(weight).shape, np.nan, np.float32)
        weight.CopyFrom(onnx.numpy_helper.from_array(values, weight.name))

    with pytest.raises(ModelError, match="NaN"):
        Detector(altered(tmp_path, alter))


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"providers": ("gpu",)}, "expected some of cpu"),
        ({"providers": ()}, "expected some of cpu"),
        ({"score_threshold": 1.5}, "between 0 and 1"),
        ({"input_scale": 0.0}, "0.1…8"),
        ({"threads": 0}, "at least 1"),
    ],
)
def test_wrong_arguments_are_refused_with_what_was_expected(arguments, sentence):
    with pytest.raises(ModelError, match=sentence):
        Detector("default", **arguments)
