"""Overlap of boxes: area, intersection over union, and its generalisation.

All of it takes boxes ``x1, y1, x2, y2`` along the last axis, of shapes that broadcast against each
other: (N, 4) against (N, 4) row by row, (N, 1, 4) against (M, 4) each with each.
"""

from __future__ import annotations

import numpy as np

from sightline.types import FloatArray

_LEAST_PX2 = 1e-12
"""Boxes without an extent overlap nothing."""


def shared_area(first: FloatArray, second: FloatArray) -> FloatArray:
    """Area of intersection of boxes, square pixels."""
    low = np.maximum(first[..., :2], second[..., :2])
    high = np.minimum(first[..., 2:], second[..., 2:])
    return np.asarray(np.maximum(high - low, 0.0).prod(axis=-1))


def iou(first: FloatArray, second: FloatArray) -> FloatArray:
    """Intersection over union of boxes."""
    shared = shared_area(first, second)
    return np.asarray(shared / np.maximum(_union(first, second, shared), _LEAST_PX2))


def giou(first: FloatArray, second: FloatArray) -> FloatArray:
    """Generalised intersection over union of boxes; Rezatofighi et al. 2019."""
    shared = shared_area(first, second)
    union = _union(first, second, shared)
    hull = np.maximum(first[..., 2:], second[..., 2:]) - np.minimum(first[..., :2], second[..., :2])
    around = np.maximum(hull.prod(axis=-1), _LEAST_PX2)
    return np.asarray(shared / np.maximum(union, _LEAST_PX2) - (around - union) / around)


def _union(first: FloatArray, second: FloatArray, shared: FloatArray) -> FloatArray:
    areas = [(boxes[..., 2:] - boxes[..., :2]).prod(axis=-1) for boxes in (first, second)]
    return np.asarray(areas[0] + areas[1] - shared)
