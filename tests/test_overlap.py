"""How far boxes overlap, against counting pixels and values by hand."""

from __future__ import annotations

import numpy as np

from sightline.overlap import giou, iou, shared_area


def test_overlap_is_what_counting_pixels_gives() -> None:
    rng = np.random.default_rng(4)
    low = rng.integers(0, 12, (60, 2))
    boxes = np.hstack([low, low + rng.integers(1, 9, (60, 2))])
    y, x = np.mgrid[:24, :24]
    inside = [(x >= a) & (x < c) & (y >= b) & (y < d) for a, b, c, d in boxes]
    shared = np.array([[(one & other).sum() for other in inside] for one in inside])
    either = np.array([[(one | other).sum() for other in inside] for one in inside])
    corners = boxes.astype(float)
    np.testing.assert_array_equal(shared_area(corners[:, None], corners), shared)
    np.testing.assert_allclose(iou(corners[:, None], corners), shared / either)
    np.testing.assert_allclose(
        iou(corners[:30], corners[30:]), np.diag((shared / either)[:30, 30:])
    )


def test_generalised_overlap_by_hand() -> None:
    """Apart: two squares of 1 in a hull of 3: 0 - (3 - 2) / 3."""
    first = np.array([[0.0, 0, 1, 1], [0, 0, 2, 2], [0, 0, 1, 1]])
    second = np.array([[2.0, 0, 3, 1], [1, 1, 3, 3], [0, 0, 1, 1]])
    wanted = [-1 / 3, 1 / 7 - 2 / 9, 1.0]
    np.testing.assert_allclose(giou(first, second), wanted)


def test_boxes_without_an_extent_overlap_nothing() -> None:
    line, box = np.array([1.0, 1.0, 3.0, 1.0]), np.array([0.0, 0.0, 4.0, 2.0])
    assert iou(line, line) == 0.0
    assert iou(line, box) == 0.0
    assert iou(np.empty((0, 1, 4)), box).shape == (0, 1)
