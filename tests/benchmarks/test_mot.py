"""`bench mot`: identities by stated rules, the same detections for all, and figures that can be wrong."""

import numpy as np
import pytest

from swarmtrack.benchmarks import mot, mot_page
from swarmtrack.benchmarks.mot_sequences import (
    LINK_GAP,
    Faults,
    LabelledSequence,
    detected,
    linked,
    read_annotation,
)
from swarmtrack.benchmarks.report import BenchmarkError
from swarmtrack.lab.score.clip_score import TruthBoxes


def boxes(*centres, side=20.0):
    """(n, 4) as the annotations have them: y1, x1, y2, x2."""
    return np.array([(v - side / 2, u - side / 2, v + side / 2, u + side / 2) for u, v in centres]).reshape(
        -1, 4
    )


def ids(frames):
    return [frame.id.tolist() for frame in frames]


def test_an_annotation_is_read_with_frames_that_have_no_line(tmp_path):
    file = tmp_path / "Video_1_gt.txt"
    file.write_text(
        "time_layer: 1 detections: \ntime_layer: 3 detections: (1, 2, 5, 8), (10, 20, 30, 40), \n"
    )
    assert [len(frame) for frame in read_annotation(file)] == [0, 0, 2]
    assert read_annotation(file)[2][0].tolist() == [1.0, 2.0, 5.0, 8.0]


@pytest.mark.parametrize(
    "second", ["time_layer: 1 detections: ", "nonsense", "time_layer: 2 detections: (1, 2, x, 4)"]
)
def test_a_line_that_is_none_is_named(tmp_path, second):
    file = tmp_path / "Video_1_gt.txt"
    file.write_text(f"time_layer: 1 detections: \n{second}\n")
    with pytest.raises(BenchmarkError, match=r"Video_1_gt\.txt:2: "):
        read_annotation(file)


def test_two_drones_that_cross_keep_their_identities_by_their_velocities():
    frames = [boxes((100 + 8 * k, 100), (260 - 8 * k, 104)) for k in range(20)]
    assert ids(linked(frames)) == [[0, 1]] * 20


def test_an_identity_survives_a_gap_and_not_a_long_one():
    def seen(missing):
        frames = [boxes((100.0, 100.0))] * 5 + [boxes()] * missing + [boxes((101.0, 100.0))]
        return ids(linked(frames))[-1]

    assert seen(LINK_GAP - 1) == [0]
    assert seen(LINK_GAP + 1) == [1]


def test_a_box_of_another_size_is_another():
    assert ids(linked([boxes((100.0, 100.0)), boxes((101.0, 100.0), side=60.0)])) == [[0], [1]]


def sequence(frames=200):
    truth = [
        TruthBoxes(
            np.array([4, 7]), np.array([[100.0 + k, 200.0], [400.0, 100.0 + k]]), np.full((2, 2), 24.0)
        )
        for k in range(frames)
    ]
    return LabelledSequence("made", truth, 30.0, (640, 480))


def test_detections_have_the_stated_faults_and_are_the_same_for_all():
    one, again = (detected(sequence(2000), Faults(), np.random.default_rng(1)) for _ in range(2))
    assert all(a.centre.tobytes() == b.centre.tobytes() for a, b in zip(one, again, strict=True))
    found = np.mean([len(frame.score) for frame in one])
    assert found == pytest.approx(2 * 0.9 + 0.3, abs=0.06)
    assert all((np.diff(frame.score) <= 0.0).all() for frame in one)


@pytest.mark.parametrize("name", mot.TRACKERS)
def test_our_trackers_follow_both_with_one_number_each(name):
    flown = sequence()
    shown = mot.follow_all(mot.followers()[name], flown, detected(flown, Faults(), np.random.default_rng(2)))
    given = mot.as_given(flown.frames, shown)
    hits = [(similar > 0.5).any(axis=1).sum() for similar in given["similarity_scores"]]
    assert sum(hits) > 0.9 * given["num_gt_dets"]
    late = {track for one in shown[30:] for track in one.id.tolist()}
    assert len(late) == 2


def test_half_a_side_away_is_where_a_hit_ends():
    truth = TruthBoxes(np.array([1]), np.array([[100.0, 100.0]]), np.array([[24.0, 10.0]]))
    shown = mot.Followed(np.array([1, 2]), np.array([[112.0, 100.0], [100.0, 100.0]]))
    assert mot.similarity(truth, shown) == pytest.approx(np.array([[0.5, 1.0]]))


def test_a_swap_costs_identity_and_nothing_else():
    pytest.importorskip("trackeval")
    flown = sequence(100)
    right = [mot.Followed(frame.id, frame.centre) for frame in flown.frames]
    swapped = [one if k < 50 else mot.Followed(one.id[::-1], one.centre) for k, one in enumerate(right)]
    perfect, worse = (
        mot.scored({"a": mot.as_given(flown.frames, one)}, mot._metrics()) for one in (right, swapped)
    )
    assert perfect == pytest.approx({"HOTA": 1.0, "AssA": 1.0, "IDF1": 1.0, "MOTA": 1.0, "switches": 0.0})
    assert worse["IDF1"] == pytest.approx(0.5)
    assert worse["switches"] == 2.0


def figures(idf1, hota=0.5):
    return dict.fromkeys(("AssA", "MOTA", "switches", "ms"), 0.0) | {"IDF1": idf1, "HOTA": hota}


TABLES = {"clips": {f"{hz} Hz": {"mbm": figures(0.9), "SORT": figures(0.2, 0.9), "SORT, boxes × 4": figures(0.8)}
                    for hz in (30, 3)}}  # fmt: skip


def test_a_peer_counts_once_with_the_boxes_that_suit_it():
    assert mot_page.better_boxes(TABLES["clips"]["3 Hz"]) == {"mbm": figures(0.9), "SORT": figures(0.8)}
    about = {"clips": {"sequences": 1, "frames": 2, "boxes": 3}}
    page = mot_page.page({"tables": TABLES, "about": about})
    assert "| clips, 3 Hz | **50.0** / **90.0** | **50.0** / 80.0 |" in page


def test_the_plot_shows_every_source(tmp_path):
    pytest.importorskip("matplotlib")
    mot_page.draw(tmp_path / "mot.png", TABLES)
    assert (tmp_path / "mot.png").read_bytes()[:4] == b"\x89PNG"
