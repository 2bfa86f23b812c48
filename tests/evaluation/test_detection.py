"""Measures of detectors, against closed forms and COCO's own counting."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest

from sightline.errors import InputError
from sightline.evaluation.detection import JudgedFrame, pooled, score_detections
from sightline.formats.labels import parse_margins, read_label_folder, read_labels
from sightline.scene import Scene
from sightline.scene.labelled_frames import detect_labelled, scene_labels
from sightline.types import Boxes, Frame

A = [100.0, 100.0, 140.0, 120.0]
B = [300.0, 200.0, 340.0, 220.0]


def frame(
    truth: list[list[float]],
    found: list[tuple[list[float], float]],
    ignored: list[bool] | None = None,
) -> JudgedFrame:
    return JudgedFrame(
        name="f",
        truth_xyxy_px=np.array(truth, float).reshape(-1, 4),
        ignored=np.array(ignored if ignored else [False] * len(truth), dtype=bool),
        found_xyxy_px=np.array([box for box, _ in found], float).reshape(-1, 4),
        confidence=np.array([score for _, score in found], float),
    )


def shifted(box: list[float], x: float) -> list[float]:
    return [box[0] + x, box[1], box[2] + x, box[3]]


def test_all_found_and_nothing_else() -> None:
    report = score_detections([frame([A], [(A, 0.9)]), frame([B], [(B, 0.4)]), frame([], [])])
    assert (report.frames, report.drawn, report.found) == (3, 2, 2)
    assert report.map_50 == pytest.approx(1.0)
    assert report.map_50_95 == pytest.approx(1.0)
    assert (report.recall, report.precision, report.false_per_frame) == (1.0, 1.0, 0.0)
    assert (report.recall_at_allowed, report.threshold_at_allowed) == (1.0, 0.4)
    assert (report.mean_iou, report.mean_giou, report.foot_px) == (1.0, 1.0, 0.0)


def test_half_found_is_precision_one_to_half_of_recall() -> None:
    """COCO reads the precision at 101 recalls, 0, 0.01, ... 1: 51 of them are at most a half."""
    report = score_detections([frame([A], [(A, 0.9)]), frame([B], [])])
    assert report.map_50 == pytest.approx(51 / 101)
    assert report.recall == 0.5


def test_a_false_box_before_the_right_one_halves_the_precision() -> None:
    report = score_detections([frame([A], [(B, 0.9), (A, 0.5)])], allowed_per_frame=0.0)
    assert report.map_50 == pytest.approx(0.5)
    assert (report.recall, report.precision, report.false_per_frame) == (1.0, 0.5, 1.0)
    assert report.recall_at_allowed == 0.0
    assert math.isnan(report.threshold_at_allowed)
    one = score_detections([frame([A], [(B, 0.9), (A, 0.5)])], allowed_per_frame=1.0)
    assert (one.recall_at_allowed, one.threshold_at_allowed) == (1.0, 0.5)


@pytest.mark.parametrize(("least_iou", "counts"), [(0.5, True), (0.501, False)])
def test_a_box_of_just_that_overlap_is_found_or_is_of_another_boat(
    least_iou: float, counts: bool
) -> None:
    half = [A[0], A[1], 0.5 * (A[0] + A[2]), A[3]]
    found = score_detections([frame([A], [(half, 0.9)])], least_iou=least_iou)
    assert (found.recall, found.false_per_frame) == ((1.0, 0.0) if counts else (0.0, 1.0))
    beside = score_detections([frame([A], [(half, 0.9)], [True])], least_iou=least_iou)
    assert beside.false_per_frame == (0.0 if counts else 1.0)


def test_average_precision_asks_for_more_overlap_step_by_step() -> None:
    """A box of 40 px moved by 8 px overlaps by 32 / 48 = 0.667: four of ten steps reach that."""
    report = score_detections([frame([A], [(shifted(A, 8.0), 0.9)])])
    assert report.map_50 == pytest.approx(1.0)
    assert report.map_50_95 == pytest.approx(0.4)
    assert report.mean_iou == pytest.approx(2 / 3)
    assert report.mean_giou == pytest.approx(2 / 3)
    # By 13 px, 27 / 53 = 0.509: the first step alone.
    just = score_detections([frame([A], [(shifted(A, 13.0), 0.9)])])
    assert just.map_50 == pytest.approx(1.0)
    assert just.map_50_95 == pytest.approx(0.1)
    far = score_detections([frame([A], [(shifted(A, 20.0), 0.9)])], least_iou=0.3)
    assert (far.map_50, far.recall) == (0.0, 1.0)


def test_the_threshold_counts_in_recall_and_not_in_average_precision() -> None:
    report = score_detections([frame([A], [(A, 0.2)])], threshold=0.3)
    assert report.map_50 == pytest.approx(1.0)
    assert report.recall == 0.0
    assert math.isnan(report.precision)
    assert report.recall_at_allowed == 1.0


def test_a_second_box_of_the_same_thing_is_false() -> None:
    report = score_detections([frame([A], [(A, 0.9), (shifted(A, 4.0), 0.8)])])
    assert (report.recall, report.precision) == (1.0, 0.5)


def test_other_boats_are_neither_right_nor_wrong() -> None:
    report = score_detections([frame([A, B], [(A, 0.9), (B, 0.95)], [False, True])])
    assert report.drawn == 1
    assert (report.recall, report.precision, report.map_50) == (1.0, 1.0, pytest.approx(1.0))
    missed = score_detections([frame([A, B], [(A, 0.9)], [False, True])])
    assert (missed.recall, missed.map_50) == (1.0, pytest.approx(1.0))


def test_boxes_in_frames_without_a_boat_are_false() -> None:
    report = score_detections([frame([A], [(A, 0.5)]), frame([], [(B, 0.9)])])
    assert report.precision == 0.5
    assert report.map_50 == pytest.approx(0.5)


@pytest.mark.parametrize("allowed", [0.0, 0.5, 1.0, 1.7, 3.0])
@pytest.mark.parametrize("seed", range(3))
def test_recall_at_so_many_false_boxes_a_frame_is_that_of_trying_each_threshold(
    allowed: float, seed: int
) -> None:
    """Frames with none to three drawn boxes, and up to five false ones, some equally sure."""
    rng = np.random.default_rng(seed)
    frames, sure, right = [], [], []
    for _ in range(12):
        # A grid of places so far apart that no box of one overlaps that of another.
        places = rng.permutation(20)
        cells = [[60.0 * i, 100.0, 60.0 * i + 40.0, 120.0] for i in places]
        drawn = cells[: rng.integers(0, 4)]
        hits = [box for box in drawn if rng.random() < 0.8]
        false = cells[10 : 10 + rng.integers(0, 6)]
        scores = np.round(rng.random(len(hits) + len(false)), 1).tolist()
        frames.append(frame(drawn, list(zip(hits + false, scores, strict=True))))
        sure += scores
        right += [True] * len(hits) + [False] * len(false)
    confidence, hit = np.array(sure), np.array(right)
    n_drawn = sum(len(one.truth_xyxy_px) for one in frames)
    assert n_drawn != len(frames)
    best, least = 0.0, math.nan
    for threshold in sorted(set(sure), reverse=True):
        kept = confidence >= threshold
        if (kept & ~hit).sum() <= allowed * len(frames):
            best, least = float((kept & hit).sum() / n_drawn), threshold
    report = score_detections(frames, allowed_per_frame=allowed, threshold=0.5)
    assert report.recall_at_allowed == pytest.approx(best)
    assert report.threshold_at_allowed == pytest.approx(least, nan_ok=True)
    kept = confidence >= 0.5
    assert report.recall == pytest.approx((kept & hit).sum() / n_drawn)
    assert report.precision == pytest.approx((kept & hit).sum() / kept.sum())
    assert report.false_per_frame == pytest.approx((kept & ~hit).sum() / len(frames))


def test_found_boxes_that_end_too_high_have_a_negative_foot() -> None:
    high = [A[0], A[1], A[2], A[3] - 3.0]
    assert score_detections([frame([A], [(high, 0.9)])]).foot_px == -3.0


def test_nothing_found_and_nothing_to_find() -> None:
    assert score_detections([frame([A], [])]).map_50 == 0.0
    nothing = score_detections([frame([], [(A, 0.9)])])
    assert math.isnan(nothing.map_50)
    assert math.isnan(nothing.recall)
    assert nothing.false_per_frame == 1.0
    with pytest.raises(InputError, match="no frame has both a picture and labels"):
        score_detections([])
    with pytest.raises(InputError, match="iou is 0"):
        score_detections([frame([A], [])], least_iou=0.0)


def test_labels_tell_targets_others_and_empty_frames(tmp_path: Path) -> None:
    (tmp_path / "07.csv").write_text(
        "frame,x1,y1,x2,y2,annotator,label,target\n"
        "0,1,2,30,40,me,boat,1\n0,5,6,70,80,me,sailboat,0\n200,,,,,,,\n100,1,2,3,4,me,boat,\n"
    )
    (tmp_path / "empty.csv").write_text("recording,frame\n07,300\n08,500\n")
    labels = read_labels(tmp_path / "07.csv")
    assert labels.boxes.frame.tolist() == [0, 0, 100]
    assert labels.target.tolist() == [True, False, True]
    assert labels.empty_frames.tolist() == [200]
    seven = read_label_folder(tmp_path, "07")
    assert seven is not None
    assert seven.frames.tolist() == [0, 100, 200, 300]
    eight = read_label_folder(tmp_path, "08")
    assert eight is not None
    assert (len(eight.boxes), eight.frames.tolist()) == (0, [500])
    assert read_label_folder(tmp_path, "09") is None


def test_tables_of_labels_may_lie_beside_the_list_of_empty_frames(tmp_path: Path) -> None:
    inner = tmp_path / "boxes"
    inner.mkdir()
    (inner / "07.csv").write_text("frame,x1,y1,x2,y2\n0,1,2,30,40\n")
    (inner / "08.csv").write_text("frame,x1,y1,x2,y2\n")
    (tmp_path / "empty.csv").write_text("recording,frame\n07,300\n08,500\n")
    for folder in (tmp_path, inner):
        seven = read_label_folder(folder, "07")
        assert seven is not None
        assert seven.frames.tolist() == [0, 300]
        # A table without boxes is of use where its frames are known to be empty.
        eight = read_label_folder(folder, "08")
        assert eight is not None
        assert (len(eight.boxes), eight.frames.tolist()) == (0, [500])


def test_other_boats_are_errors_to_find_where_that_is_asked(tmp_path: Path) -> None:
    path = tmp_path / "07.csv"
    path.write_text(
        "frame,x1,y1,x2,y2,target\n0,100,50,140,70,1\n0,10,20,50,40,0\n1,10,20,50,40,0\n2,,,,,\n"
    )
    labels = read_labels(path)
    alone = labels.without_others()
    assert alone.boxes.frame.tolist() == [0]
    assert alone.target.all()
    # Frames with other boats alone are still looked at.
    assert alone.frames.tolist() == labels.frames.tolist() == [0, 1, 2]
    assert alone.empty_frames.tolist() == [1, 2]


def test_margins_of_annotators_and_specks(tmp_path: Path) -> None:
    (tmp_path / "07.csv").write_text(
        "frame,x1,y1,x2,y2,annotator,target\n"
        "0,100,50,140,70,me,1\n0,10,20,20,25,me,1\n0,100,50,140,70,you,1\n"
    )
    labels = read_labels(tmp_path / "07.csv")
    changed = labels.without_specks(6.0).widened(parse_margins(["me=2.5+10%"]))
    # By 2.5 px and a tenth of the height, 4.5 px and 3 px; the other annotator's stays.
    np.testing.assert_allclose(
        changed.boxes.xyxy_px,
        [[95.5, 45.5, 144.5, 74.5], [7.0, 17.0, 23.0, 28.0], [100.0, 50.0, 140.0, 70.0]],
    )
    # It was 5 px high before the margin.
    assert changed.target.tolist() == [True, False, True]
    assert labels.target.all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frame,x1,y1,x2,y2\n", "holds no box, and no frame without one"),
        ("", "is empty"),
        ("frame,x1,y1,x2\n1,2,3,4\n", "lacks the column y2"),
        ("frame,x1,y1,x2,y2\n1,2,3,4,\n", "line 2: .* is no number"),
        ("frame,x1,y1,x2,y2,target\n1,2,3,4,5,2\n", "line 2: 2 is no target; give 1 or 0"),
        ("frame,x1,y1,x2,y2\n,,,,\n", "holds no box"),
    ],
)
def test_labels_that_cannot_be_used(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "07.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        read_labels(tmp_path / "07.csv")


class Recalling:
    """A detector that says what was drawn, three pixels to the right."""

    def __init__(self, known: dict[int, np.ndarray]) -> None:
        self.known = known
        self.shown: list[int] = []

    def reset(self) -> None:
        self.shown.clear()

    def detect(self, frame: Frame) -> Boxes:
        self.shown.append(frame.index)
        boxes = self.known.get(frame.index, np.empty((0, 4))) + np.array([3.0, 0.0, 3.0, 0.0])
        return Boxes.of(boxes, frame=frame.index, confidence=0.9)


def test_a_scene_is_measured_where_it_has_boxes_and_pictures(data_dir: Path) -> None:
    scene = Scene.load(data_dir / "tracks-at-sea" / "scene.toml").select(["08", "17"])
    known = scene_labels(scene)
    assert set(known) == {"08", "17"}
    drawn = scene["17"].boxes()
    detector = Recalling({int(f): drawn.xyxy_px[drawn.frame == f] for f in drawn.frame})
    judged = detect_labelled(scene.select(["17"]), {"17": known["17"]}, detector)
    # What learns from the frames before is shown all of them.
    assert len(detector.shown) == 36
    report = score_detections(pooled(judged))
    assert report.frames == len(judged["17"]) == 4
    assert report.recall == 1.0


def test_a_scene_without_boxes_or_pictures_cannot_measure(tmp_path: Path, data_dir: Path) -> None:
    scene = Scene.load(data_dir / "tracks-at-sea" / "scene.toml")
    with pytest.raises(InputError, match="no recording has both pictures and boxes"):
        scene_labels(scene.select(["20"]))
    with pytest.raises(InputError, match="no such folder of labels"):
        scene_labels(scene, tmp_path / "none")
    with pytest.raises(InputError, match="no recording has both pictures and labels in"):
        scene_labels(scene, tmp_path)


def test_without_the_extra_it_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycocotools", None)
    with pytest.raises(InputError) as caught:
        score_detections([frame([A], [(A, 0.9)])])
    expected = 'pycocotools is not installed; run: pip install "sightline[score]"'
    assert str(caught.value) == expected
    # What needs no average precision needs no extra.
    assert math.isnan(score_detections([frame([], [(A, 0.9)])]).map_50)
