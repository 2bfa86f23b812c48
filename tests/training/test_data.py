from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sightline.errors import InputError
from sightline.formats.labels import Labels as KnownLabels
from sightline.formats.labels import write_labels
from sightline.scene import Scene
from sightline.training.data import (
    Labels,
    Margin,
    Picture,
    backgrounds,
    check_split,
    digest,
    parse_margins,
    scene_pictures,
    sprites,
    synthetic_pictures,
    vanishing_row_px,
)
from sightline.types import Boxes

ONE_CLASS = Labels(class_names=("boat",))


def _table(folder: Path, name: str, text: str) -> None:
    folder.mkdir(exist_ok=True)
    (folder / name).write_text(text)


def test_pictures_come_by_recording(scene: Scene) -> None:
    pictures = scene_pictures(scene, ["b"], ONE_CLASS)
    assert {picture.recording for picture in pictures} == {"b"}
    assert [picture.frame for picture in pictures] == [0, 1, 2, 3, 4, 5]


def test_what_lies_around_the_targets_box_is_left_open(scene: Scene) -> None:
    picture = scene_pictures(scene, ["a"], ONE_CLASS)[0]
    box = picture.boxes_xyxy_px[~picture.ignore]
    assert len(box) == 1
    regions = picture.boxes_xyxy_px[picture.ignore]
    covered = np.zeros(picture.image.shape[:2], dtype=bool)
    for x1, y1, x2, y2 in regions.round().astype(int):
        covered[y1:y2, x1:x2] = True
    x1, y1, x2, y2 = box[0].astype(int)
    assert not covered[y1:y2, x1:x2].any()
    # A ring of three quarters of its size on every side is known to be empty.
    expected = 160 * 256 - np.prod(
        [
            min(160, y2 + 0.75 * 18) - max(0, y1 - 0.75 * 18),
            min(256, x2 + 30) - max(0, x1 - 30),
        ]
    )
    assert covered.sum() == pytest.approx(expected, abs=300)


def test_tables_replace_the_scenes_boxes_and_may_be_complete(scene: Scene, tmp_path: Path) -> None:
    folder = tmp_path / "eye"
    _table(
        folder,
        "a.csv",
        "frame,x1,y1,x2,y2,annotator,label,target\n"
        "0,10,20,30,30,eye,boat,1\n0,100,40,120,70,eye,sailboat,0\n"
        "0,60,5,90,15,eye,ignore,0\n0,1,1,5,5,eye,gull,0\n",
    )
    _table(folder, "empty.csv", "recording,frame\na,1\nb,2\n")
    pictures = scene_pictures(scene, ["a"], Labels(folders=(folder,)))
    first, second = pictures[0], pictures[1]
    np.testing.assert_allclose(
        first.boxes_xyxy_px, [[10, 20, 30, 30], [100, 40, 120, 70], [60, 5, 90, 15]]
    )
    assert first.labels[:2].tolist() == [0, 1]
    assert first.ignore.tolist() == [False, False, True]
    assert len(second.boxes_xyxy_px) == 0
    np.testing.assert_allclose(first.worth, 1.0)
    half = scene_pictures(scene, ["a"], Labels(("boat", "sailboat"), (folder,), others=0.5))
    # Only of the target's own class; and this table has no other boat of it.
    np.testing.assert_allclose(half[0].worth, 1.0)


def test_a_table_of_the_target_alone_leaves_the_rest_open(scene: Scene, tmp_path: Path) -> None:
    folder = tmp_path / "eye"
    _table(folder, "a.csv", "frame,x1,y1,x2,y2,target\n0,10,20,30,30,1\n")
    _table(folder, "empty.csv", "recording,frame\na,1\n")
    pictures = scene_pictures(scene, ["a"], Labels(("boat",), (folder,)))
    # Of a frame without the target, and nothing else known, there is nothing to learn.
    assert [picture.frame for picture in pictures] == [0, 2, 3, 4, 5]
    assert pictures[0].ignore.tolist() == [False, True, True, True]


def test_proposed_boxes_join_the_scenes_own_and_leave_the_rest_open(
    scene: Scene, tmp_path: Path
) -> None:
    proposals = Boxes.of([[10.0, 20.0, 30.0, 30.0]], frame=[0], source="log", label="boat")
    folder = tmp_path / "proposed"
    folder.mkdir()
    write_labels(KnownLabels.of_target(proposals), folder / "a.csv")
    alone = scene_pictures(scene, ["a"], ONE_CLASS)
    both = scene_pictures(scene, ["a"], Labels(("boat",), (folder,), margins={"log": Margin(1.0)}))
    assert [one.frame for one in both] == [one.frame for one in alone]
    np.testing.assert_allclose(both[0].boxes_xyxy_px[~both[0].ignore], [[9, 19, 31, 31]])
    # Other boats of the frame are not known, so what is around is neither boat nor water.
    assert both[0].ignore.tolist() == [False, True, True, True]
    assert [one.digest for one in both[1:]] == [one.digest for one in alone[1:]]


def test_other_boats_are_worth_less_if_asked(scene: Scene, tmp_path: Path) -> None:
    folder = tmp_path / "eye"
    text = "frame,x1,y1,x2,y2,label,target\n0,10,20,30,30,boat,1\n0,60,20,80,30,boat,0\n"
    _table(folder, "a.csv", text)
    labels = Labels(("boat", "sailboat"), (folder,), others=0.4)
    np.testing.assert_allclose(scene_pictures(scene, ["a"], labels)[0].worth, [1.0, 0.4])
    with pytest.raises(InputError, match="share above 0"):
        Labels(others=0.0)


def test_boxes_of_two_annotators_become_one(scene: Scene, tmp_path: Path) -> None:
    _table(
        tmp_path / "boxes",
        "a.csv",
        "frame,x1,y1,x2,y2,annotator\n0,10,20,50,40,loose\n0,14,24,46,36,close\n0,15,25,20,30,part\n",
    )
    picture = scene_pictures(scene, ["a"], ONE_CLASS)[0]
    np.testing.assert_allclose(picture.boxes_xyxy_px[~picture.ignore], [[12, 22, 48, 38]])


def test_margins_even_out_annotators() -> None:
    margins = parse_margins(["voc=-3", "eye=1+20%"])
    box = np.array([[10.0, 10.0, 50.0, 30.0]])
    np.testing.assert_allclose(margins["voc"].widened(box), [[13, 13, 47, 27]])
    np.testing.assert_allclose(margins["eye"].widened(box), [[5, 5, 55, 35]])
    assert margins["eye"] == Margin(1.0, 0.2)


@pytest.mark.parametrize("text", ["voc", "voc=", "voc=a", "voc=1+b%"])
def test_a_margin_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="expected SOURCE=PX"):
        parse_margins([text])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frame,x1,y1,x2,y2\n", "has a header and no boxes"),
        ("", "is empty"),
        ("frame,x1,y1,x2\n0,1,2,3\n", "lacks the column y2"),
        ("frame,x1,y1,x2,y2\n0,9,2,3,4\n", "line 2"),
    ],
)
def test_a_table_that_holds_no_boxes_is_refused(
    scene: Scene, tmp_path: Path, text: str, message: str
) -> None:
    _table(tmp_path / "eye", "a.csv", text)
    with pytest.raises(InputError, match=message):
        scene_pictures(scene, ["a"], Labels(folders=(tmp_path / "eye",)))


def test_a_part_of_a_split_without_boxes_is_refused(scene: Scene) -> None:
    with pytest.raises(InputError, match=r"for validation \(c\) have no boxes"):
        check_split(scene_pictures(scene, ["c"], ONE_CLASS), ["c"], "validation")


def test_a_picture_of_nothing_but_open_regions_is_no_box(scene: Scene) -> None:
    image = np.zeros((32, 32, 3), np.uint8)
    box = np.array([[0, 0, 32, 32]], np.float32)
    alone = Picture(
        "a", 0, image, box, np.zeros(1, np.int64), np.ones(1, bool), np.ones(1, np.float32)
    )
    with pytest.raises(InputError, match="have no boxes"):
        check_split([alone], ["a"], "train")


def test_the_median_of_a_recording_has_no_boats_and_sprites_are_the_boats(scene: Scene) -> None:
    pictures = scene_pictures(scene, ["a"], ONE_CLASS)
    (background,) = backgrounds(pictures)
    assert background.image[..., 0].max() < 130
    cut = sprites(pictures)
    assert cut
    for sprite in cut:
        x1, y1, x2, y2 = sprite.box_xyxy_px.round().astype(int)
        assert sprite.opacity[y1 + 3 : y2 - 3, x1 + 3 : x2 - 3].min() > 0.9
        outside = sprite.opacity.copy()
        outside[max(y1 - 4, 0) : y2 + 4, max(x1 - 4, 0) : x2 + 4] = 0.0
        assert outside.max() < 0.2
        assert sprite.image[(y1 + y2) // 2, (x1 + x2) // 2, 0] == 250


def test_boats_grow_from_the_vanishing_row() -> None:
    rng = np.random.default_rng(0)
    row = rng.uniform(110.0, 300.0, 60)
    height = 0.4 * (row - 100.0) * np.exp(rng.normal(0.0, 0.02, 60))
    boxes = np.stack([row * 0, row - height, row * 0 + 30, row], axis=1).astype(np.float32)
    blank = np.zeros((2, 2, 3), np.uint8)
    picture = Picture(
        "a", 0, blank, boxes, np.zeros(60, np.int64), np.zeros(60, bool), np.ones(60, np.float32)
    )
    assert vanishing_row_px([picture]) == pytest.approx(100.0, abs=4.0)
    assert vanishing_row_px([]) is None


def test_digest_follows_the_data(scene: Scene) -> None:
    pictures = scene_pictures(scene, ["a", "b"], ONE_CLASS)
    first = digest(pictures)
    assert first == digest(scene_pictures(scene, ["a", "b"], ONE_CLASS))
    assert first["a"]["pictures"] == 6
    assert first["a"]["boxes"] == 6
    moved = scene_pictures(scene, ["a", "b"], Labels(("boat",), margins={"eye": Margin(1.0)}))
    assert digest(moved)["a"]["sha256"] != first["a"]["sha256"]


def test_rendered_pictures_hold_every_boat() -> None:
    pictures = synthetic_pictures(2, 5, Labels(), image_size_px=(320, 192))
    assert [picture.real for picture in pictures] == [False, False]
    again = synthetic_pictures(2, 5, Labels(), image_size_px=(320, 192))
    assert digest(pictures) == digest(again)
    assert any(len(picture.boxes_xyxy_px) for picture in pictures)
    for picture in pictures:
        assert (picture.boxes_xyxy_px[:, 2:] <= [320, 192]).all()
