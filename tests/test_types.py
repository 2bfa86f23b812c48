from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sightline.errors import InputError
from sightline.geodesy import LocalPlane
from sightline.types import NO_TRACK, Boxes, FloatArray, LocatedBoxes, Positions

PLANE = LocalPlane(54.0, 10.0)
COLUMNS = ("xyxy_px", "frame", "time_utc_s", "confidence", "source", "track_id", "label")


def some_boxes(n: int = 6) -> Boxes:
    rng = np.random.default_rng(0)
    low = rng.uniform(0.0, 100.0, (n, 2))
    return Boxes.of(
        np.hstack([low, low + rng.uniform(1.0, 20.0, (n, 2))]),
        frame=np.arange(n),
        time_utc_s=rng.uniform(0.0, 10.0, n),
        confidence=rng.random(n),
        source=["a", "somebody"] * (n // 2),
        track_id=rng.integers(0, 5, n),
        label="boat",
    )


def places(boxes: Boxes) -> Positions:
    """Each box at a place of its own, by which it is known again."""
    n = len(boxes)
    east: FloatArray = boxes.xyxy_px[:, 0] * 10.0
    covariance = np.tile(np.eye(2), (n, 1, 1)) * boxes.xyxy_px[:, 1, None, None]
    return Positions(east, -east, covariance, np.zeros(n, dtype=bool), PLANE, covariance / 4.0)


@pytest.mark.parametrize(
    "rows",
    [slice(1, 4), slice(None, None, -2), np.array([4, 0, 0]), np.arange(6) % 2 == 0, slice(0, 0)],
    ids=["slice", "backwards", "repeated", "mask", "none"],
)
def test_rows_are_those_of_each_column_and_cannot_be_changed(rows: Any) -> None:
    boxes = some_boxes()
    chosen = boxes[rows]
    checked = Boxes(**{name: getattr(boxes, name)[rows] for name in COLUMNS})
    assert len(chosen) == len(checked)
    for name in COLUMNS:
        column = getattr(chosen, name)
        np.testing.assert_array_equal(column, getattr(checked, name))
        with pytest.raises(ValueError, match="read-only"):
            column[...] = column


@pytest.mark.parametrize("row", [0, None, (0, 0)])
def test_what_selects_no_rows_is_refused(row: Any) -> None:
    with pytest.raises((InputError, IndexError)):
        some_boxes()[row]


def test_columns_that_break_a_promise_are_refused_when_they_are_put_in() -> None:
    boxes = some_boxes()
    with pytest.raises(InputError, match="box 3: confidence 2 is not between 0 and 1"):
        boxes.with_columns(confidence=[0.0, 1.0, 2.0, 0.5, 0.5, 0.5])
    with pytest.raises(InputError, match="empty or reversed"):
        boxes.with_columns(xyxy_px=boxes.xyxy_px[:, [2, 3, 0, 1]])
    with pytest.raises(InputError, match=r"Boxes.track_id has shape \(2,\), expected \(6,\)"):
        boxes.with_columns(track_id=[1, 2])
    with pytest.raises(TypeError, match="colour"):
        boxes.with_columns(colour=["red"] * 6)


def test_a_column_that_is_put_in_is_a_copy_of_its_type() -> None:
    numbers = np.arange(6.0)
    boxes = some_boxes().with_columns(track_id=numbers)
    numbers[:] = NO_TRACK
    np.testing.assert_array_equal(boxes.track_id, np.arange(6))
    assert boxes.track_id.dtype == np.int64


def test_positions_go_with_their_boxes() -> None:
    boxes = some_boxes()
    located = LocatedBoxes.at(boxes, places(boxes))
    order = np.array([5, 2, 2, 0])
    parts = [located[order][1:], located[:2].with_columns(track_id=[7, 8])]
    together = Boxes.concatenate(parts)
    assert isinstance(together, LocatedBoxes)
    expected = places(together)
    for name in ("east_m", "north_m", "covariance_m2", "shared_covariance_m2", "extrapolated"):
        np.testing.assert_array_equal(getattr(together.positions, name), getattr(expected, name))
    assert together.track_id[-2:].tolist() == [7, 8]


def test_boxes_that_were_moved_have_no_positions_any_more() -> None:
    boxes = some_boxes()
    located = LocatedBoxes.at(boxes, places(boxes))
    moved = located.with_columns(xyxy_px=boxes.xyxy_px + 1.0)
    assert not isinstance(moved, LocatedBoxes)
    np.testing.assert_array_equal(moved.xyxy_px, boxes.xyxy_px + 1.0)
    assert not isinstance(Boxes.concatenate([located, boxes]), LocatedBoxes)


def test_boxes_need_a_position_each() -> None:
    boxes = some_boxes()
    with pytest.raises(InputError, match="6 boxes and 5 positions"):
        LocatedBoxes.at(boxes, places(boxes)[:5])
