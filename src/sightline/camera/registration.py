"""Patch displacements between two views of the static scene, by phase correlation."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from sightline.errors import InputError
from sightline.types import FloatArray, IntArray

HALF_HEIGHT_PX = 32


HALF_STORED_PX = 64


"""Views keep more rows than are compared at once, so that they are still there after a turn."""


_SHRINK = 4


FEWEST_STRIPS = 5


# By what strips may differ, as a share of what they moved.
_MOST_APART = 0.3


# And by what they may differ where they moved little, px.
_NOISE_PX = 0.3


# Where strips disagree more than this about the way across, they show no static scene.
_LANDMARKS_APART_PX = 1.5


_ROWS_SMOOTH_PX = 1.5


NOWHERE = np.zeros(2, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class ReferenceView:
    """Patches of the static scene along the horizon, for registration.

    Attributes:
        strips: (S, H, W) uint8, grey, from left to right.
        top_px: (S,) int64, rows of their upper edges in the picture.
        left_px: (S,) int64, columns of their left edges.
        landmarks: Whether they show anything static but the horizon.

    Raises:
        InputError: The columns do not fit together.
    """

    strips: NDArray[np.uint8]
    top_px: IntArray
    left_px: IntArray
    landmarks: bool = True

    def __post_init__(self) -> None:
        n = len(self.strips)
        if self.strips.ndim != 3 or n < 2 or {self.top_px.shape, self.left_px.shape} != {(n,)}:
            raise InputError("a view needs two strips or more, each with its row and column")

    @property
    def middle_px(self) -> FloatArray:
        """(S, 2) centre of each patch, x and y."""
        height, width = self.strips.shape[1:]
        return np.stack([self.left_px + 0.5 * width, self.top_px + 0.5 * height], axis=1)


@dataclass(frozen=True, eq=False)
class Displacement:
    """Patch displacements between two views of the static scene.

    Attributes:
        at_px: (S, 2) places in the first, x and y.
        moved_px: (S, 2) by how much each lies further right and down in the second.
        landmarks: Whether the way across means anything: not where only a horizon is seen.
    """

    at_px: FloatArray
    moved_px: FloatArray
    landmarks: bool


def displacement(reference: ReferenceView, other: ReferenceView) -> Displacement | None:
    """Register one view against another; None where they cannot be registered.

    Args:
        reference: Of one time.
        other: Of another, of the same camera with the same lens.
    """
    if reference.strips.shape != other.strips.shape:
        return None
    base = np.stack([other.left_px - reference.left_px, other.top_px - reference.top_px], axis=1)
    if not (reference.landmarks and other.landmarks):
        measured = measure_strips(reference.strips, other.strips, -base)
        moved = np.stack([np.zeros(len(base)), measured[:, 2] + base[:, 1]], axis=1)
        told = agree(moved[None], *consensus(moved))
        return Displacement(reference.middle_px, moved, False) if told else None
    for coarse in ((0, 0), coarse_shift(reference.strips, other.strips)):
        rough = (
            measure_strips(reference.strips, other.strips, np.array(coarse) - base)[:, :2] + base
        )
        # Once more where each strip ought to be: what lies in both is then as much as can be.
        there = np.round(rigid_shifts(*consensus(rough), len(rough))).astype(np.int64)
        moved = measure_strips(reference.strips, other.strips, there - base)[:, :2] + base
        if agree(moved[None], *consensus(moved)):
            return Displacement(reference.middle_px, moved, True)
    return None


def measure_strips(
    reference: NDArray[np.uint8], strips: NDArray[np.uint8], coarse_px: IntArray
) -> FloatArray:
    """Displacements of patches, pixels, by phase correlation.

    Args:
        reference: (S, H, W).
        strips: (S, H, W).
        coarse_px: (S, 2) or (2,), by how much further right and down they are to be looked for.

    Returns:
        (S, 3): to the right and down, and down by the rows alone.
    """
    height, width = reference.shape[1:]
    rows = min(2 * HALF_HEIGHT_PX, height)
    top = (height - rows) // 2
    limit = np.array([width // 2, top])
    coarse = np.broadcast_to(np.clip(coarse_px, -limit, limit), (len(reference), 2))
    out = np.empty((len(reference), 3))
    for i, (x, y) in enumerate(coarse.tolist()):
        left, right = max(0, -x), min(width, width - x)
        here = reference[i, top : top + rows, left:right].astype(np.float32)
        there = strips[i, top + y : top + y + rows, left + x : right + x].astype(np.float32)
        out[i, :2] = _phase_shift(here, there)
        out[i, 2] = _rows_moved(here, there)
    return out + np.stack([coarse[:, 0], coarse[:, 1], coarse[:, 1]], axis=1)


def _phase_shift(one: NDArray[np.float32], other: NDArray[np.float32]) -> tuple[float, float]:
    """By how much further right and down a picture shows what another of its size shows."""
    # Where OpenCV pads to an odd number of pixels it is off by half a pixel.
    rows, columns = map(_padded_evenly, one.shape)
    window = cv2.createHanningWindow((columns, rows), cv2.CV_32F)
    x, y = cv2.phaseCorrelate(
        np.ascontiguousarray(one[:rows, :columns]),
        np.ascontiguousarray(other[:rows, :columns]),
        window,
    )[0]
    return x, y


def _padded_evenly(size: int) -> int:
    """The largest size, at most this, that a Fourier transform pads to an even one."""
    while size > 1 and cv2.getOptimalDFTSize(size) % 2:
        size -= 1
    return size


def _rows_moved(one: NDArray[np.float32], other: NDArray[np.float32]) -> float:
    """Vertical displacement of horizontal edges, rows downwards."""
    edges = [
        np.diff(gaussian_filter1d(strip.mean(axis=1, dtype=np.float64), _ROWS_SMOOTH_PX))
        for strip in (one, other)
    ]
    taper = np.hanning(edges[0].size)
    alike = np.correlate(edges[1] * taper, edges[0] * taper, mode="full")
    at = int(np.argmax(alike))
    shift = float(at - (edges[0].size - 1))
    if 0 < at < alike.size - 1:
        before, here, after = alike[at - 1 : at + 2]
        bend = before - 2.0 * here + after
        if bend < 0.0:
            shift += 0.5 * (before - after) / bend
    return shift


def coarse_shift(reference: NDArray[np.uint8], strips: NDArray[np.uint8]) -> tuple[int, int]:
    """Coarse shift in whole pixels, right and down, of all patches side by side."""
    small = []
    for part in (reference, strips):
        wide = np.concatenate(list(part), axis=1)
        size = (wide.shape[1] // _SHRINK, wide.shape[0] // _SHRINK)
        small.append(cv2.resize(wide, size, interpolation=cv2.INTER_AREA).astype(np.float32))
    x, y = _phase_shift(*small)
    return round(_SHRINK * x), round(_SHRINK * y)


def consensus(moved: FloatArray) -> tuple[float, float, float]:
    """Median shift across and down, and slope of the shift down, of patches (S, 2)."""
    across, down = np.median(moved, axis=0)
    at = (np.arange(len(moved)) + 0.5) / len(moved)
    i, j = np.triu_indices(len(moved), 1)
    slope = float(np.median((moved[j, 1] - moved[i, 1]) / (at[j] - at[i])))
    return float(across), float(down), slope


def rigid_shifts(across: float, down: float, slope: float, count: int) -> FloatArray:
    """(S, 2) the shifts of patches under one rigid rotation."""
    at = (np.arange(count) + 0.5) / count - 0.5
    return np.stack([np.full(count, across), down + slope * at], axis=1)


def largest_shift(across: float, down: float, slope: float) -> float:
    """The largest displacement, pixels, of any patch under a rigid shift."""
    return float(max(np.hypot(across, down), 0.5 * abs(slope)))


def agree(
    moved: FloatArray, across: float, down: float, slope: float, noise_px: float = _NOISE_PX
) -> bool:
    """Whether shifts (T, S, 2) of patches agree with one rotation."""
    apart = moved - rigid_shifts(across, down, slope, moved.shape[1])
    most = max(noise_px, _MOST_APART * largest_shift(across, down, slope))
    return bool(np.median(np.hypot(apart[..., 0], apart[..., 1])) <= most)


def scattered(moved: FloatArray) -> bool:
    """Whether displacements of patches (T, S, 2 or more) across are scattered: no landmarks."""
    across = moved[..., 0]
    return bool(np.median(np.abs(across - np.median(across))) > _LANDMARKS_APART_PX)
