"""Foam rendered on the water: the wake of a boat, and what is left of one that has gone by.

A network that has seen little wash takes it for a part of the boat. So wash is rendered behind and
beside boats whose boxes are known, and on water where there is no boat. The picture of the water is
taken back to a plane in metres, as a level pinhole camera sees it; there foam lies where a planing
boat leaves it: churned by the engine behind the stern, thrown up along two arms from the bow.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.types import FloatArray

_Map = NDArray[np.float32]

_HEIGHT_M = 2.3
"""Of an open boat with somebody standing in it."""

_LENGTH_M, _BEAM_M = 6.7, 2.4
_MARGIN_SHARE, _MARGIN_PX = 0.14, 1.0
"""About what a box has around the hull on every side, of its height and besides."""

_LEAST_HEIGHT_PX = 7.0
"""Of a box; of a smaller boat the wash is a pixel high."""

_PATTERN = ((0.5, 1.2), (0.3, 0.4), (0.2, 0.18))
"""Shares of the foam's unevenness, and how large its patches are, in metres."""

_FOCAL_PX = (900.0, 2200.0)
_TEXELS = 256
_TEXELS_A_CELL = 4.0


@dataclass(frozen=True)
class Hull:
    """A boat on the water, as its wash needs it.

    Attributes:
        x_px: Column of its middle.
        row_px: Row of its nearest point of the waterline.
        px_per_m: At its distance.
        rise_px: How far above ``row_px`` the horizon lies.
        heading_rad: 0 goes away from the camera, half a turn comes; positive to the right.
    """

    x_px: float
    row_px: float
    px_per_m: float
    rise_px: float
    heading_rad: float


def hull_of(
    rng: np.random.Generator, box_xyxy_px: FloatArray, horizon_row_px: float | None
) -> Hull | None:
    """A boat that would fill a box.

    Its course follows from the box's shape but for the signs, which are drawn.

    Args:
        rng: Of what is not known.
        box_xyxy_px: (4,) with a margin.
        horizon_row_px: Where boats would be without size; None: as from some metres above the
            water.

    Returns:
        None where the boat is too small for its wash to show.
    """
    x1, y1, x2, y2 = (float(value) for value in inner(box_xyxy_px))
    height = y2 - y1
    if box_xyxy_px[3] - box_xyxy_px[1] < _LEAST_HEIGHT_PX or x2 <= x1:
        return None
    px_per_m = height / _HEIGHT_M * float(np.exp(rng.normal(0.0, 0.1)))
    # From ahead a boat shows its beam, from the side its length.
    seen_m = (x2 - x1) / px_per_m
    largest = np.hypot(_LENGTH_M, _BEAM_M)
    turned = np.arcsin(min(seen_m / largest, 1.0)) - np.arctan2(_BEAM_M, _LENGTH_M)
    turned = float(np.clip(turned + rng.normal(0.0, 0.12), 0.0, 0.5 * np.pi))
    heading = turned if rng.random() < 0.5 else np.pi - turned
    heading *= 1.0 if rng.random() < 0.5 else -1.0
    above_m = float(rng.uniform(2.5, 7.0))
    rise = y2 - horizon_row_px if horizon_row_px is not None else above_m * px_per_m
    return Hull(0.5 * (x1 + x2), y2, px_per_m, max(rise, 1.2 * px_per_m), float(heading))


def inner(boxes_xyxy_px: FloatArray) -> FloatArray:
    """(..., 4) boxes without the margin that annotators leave."""
    margin = _MARGIN_PX + _MARGIN_SHARE * (boxes_xyxy_px[..., 3:] - boxes_xyxy_px[..., 1:2])
    return np.asarray(boxes_xyxy_px + margin * np.array([1.0, 1.0, -1.0, -1.0]))


def draw_wash(
    rng: np.random.Generator,
    image: NDArray[np.uint8],
    hull: Hull,
    *,
    kept_xyxy_px: FloatArray,
    scale: float = 1.0,
    gap_m: float = 0.0,
) -> None:
    """Draw the wash of a boat on a picture, in place.

    Args:
        rng: Of its strength, width, age and pattern.
        image: (H, W, 3) uint8.
        hull: The boat.
        kept_xyxy_px: (M, 4) boxes whose hulls, `inner`, keep their pixels.
        scale: Of the picture, against that of the camera.
        gap_m: Behind the stern, where the foam is gone or the boat has never been.
    """
    height, width = image.shape[:2]
    horizon = hull.row_px - hull.rise_px
    top = max(int(np.ceil(horizon + 0.12 * hull.rise_px)), 0)
    if top >= height - 1:
        return
    opacity = np.zeros((height, width), np.float32)
    opacity[top:] = _foam(rng, hull, (width, height - top), top, scale, gap_m)
    opacity = _raised(rng, opacity, hull.px_per_m)
    opacity = np.asarray(cv2.GaussianBlur(opacity, (0, 0), float(rng.uniform(0.5, 1.0))))
    opacity *= _free(height, width, kept_xyxy_px)
    rows = np.flatnonzero(opacity.max(axis=1) > 0.004)
    if not len(rows):
        return
    used = slice(int(rows[0]), int(rows[-1]) + 1)
    light = float(rng.uniform(215.0, 300.0))
    colour = light * (np.array([1.0, 1.0, 0.96]) + rng.normal(0.0, 0.01, 3))
    share = opacity[used, :, None]
    # Foam is grey in its hollows.
    hollows = 0.5 * _noise(rng, width, used, max(3.0, 0.6 * hull.px_per_m))
    hollows += 0.5 * _noise(rng, width, used, max(1.5, 0.15 * hull.px_per_m))
    light_left = (1.0 - float(rng.uniform(0.1, 0.4)) * hollows)[..., None]
    foam = colour.astype(np.float32) * light_left
    mixed = image[used] * (1.0 - share) + foam * share
    image[used] = np.clip(mixed, 0.0, 255.0).astype(np.uint8)


def _foam(
    rng: np.random.Generator,
    hull: Hull,
    size_px: tuple[int, int],
    top: int,
    scale: float,
    gap_m: float,
) -> _Map:
    """Opacity of the foam that lies on the water."""
    width, height = size_px
    row = np.arange(height, dtype=np.float32)[:, None] + (top + 0.5)
    column = np.arange(width, dtype=np.float32)[None, :] + 0.5
    distance_m = float(rng.uniform(*_FOCAL_PX)) * scale / hull.px_per_m
    length = _LENGTH_M * float(rng.uniform(0.8, 1.2))
    beam = 0.36 * length
    sin, cos = np.sin(hull.heading_rad), np.cos(hull.heading_rad)
    # A level pinhole camera: depth goes with one over the rows below the horizon.
    depth = hull.rise_px / (row - (hull.row_px - hull.rise_px))
    right_m = (column - hull.x_px) / hull.px_per_m * depth
    away_m = distance_m * (depth - 1.0) - 0.5 * length * abs(cos)
    behind = 0.5 * length - (right_m * sin + away_m * cos)
    past = np.maximum(behind - length, 0.0)
    bend = float(rng.normal(0.0, 0.012))
    side = np.abs(right_m * cos - away_m * sin - 0.5 * bend * past**2)

    vigour = float(np.exp(rng.normal(0.9, 0.5)))
    churn, lasts_m = vigour * float(rng.uniform(0.6, 1.3)), float(rng.uniform(4.0, 40.0))
    half = 0.42 * beam + np.tan(np.radians(rng.uniform(1.5, 11.0))) * past
    dense = churn * np.exp(-past / lasts_m) * _step((half - side) / (0.35 + 0.25 * half))
    dense = np.where(behind > 0.93 * length + gap_m, dense, 0.0)
    if rng.random() < 0.8:
        arms, reach_m = vigour * float(rng.uniform(0.6, 2.2)), float(rng.uniform(3.0, 14.0))
        along = np.maximum(behind - 0.15 * length, 0.0)
        middle = 0.5 * beam * np.clip(along / (0.3 * length), 0.0, 1.0)
        middle = middle + np.tan(np.radians(rng.uniform(6.0, 28.0))) * along
        crest = 0.35 + float(rng.uniform(0.04, 0.18)) * along
        # Steep outside, trailing off inside.
        off = side - middle
        off = np.where(off > 0.0, off / crest, -off / (float(rng.uniform(1.0, 3.0)) * crest))
        arm = arms * np.exp(-along / reach_m) * np.exp(-(off**2))
        dense = np.maximum(dense, np.where(behind > 0.15 * length + gap_m, arm, 0.0))
    pattern = np.zeros_like(behind)
    for share, cell_m in _PATTERN:
        pattern = pattern + share * _sampled(rng, behind, side, cell_m)
    opacity = _step((1.3 * dense - pattern) / float(rng.uniform(0.25, 0.7)))
    opacity = float(rng.uniform(0.8, 1.0)) * opacity
    # At the far end all of it is a line, and lines fade.
    return np.asarray(opacity * np.clip(3.0 - 0.5 * depth, 0.0, 1.0), dtype=np.float32)


def _raised(rng: np.random.Generator, opacity: _Map, px_per_m: float) -> _Map:
    """Foam has a height, ragged along its crest."""
    most = float(rng.uniform(0.05, 0.9)) * px_per_m
    ragged = _noise(rng, opacity.shape[1], slice(1), max(2.0, 0.35 * px_per_m))
    reach = most * (0.3 + 0.7 * ragged)
    raised = opacity.copy()
    for up in range(1, int(np.ceil(most)) + 1):
        share = np.clip(reach - up + 1.0, 0.0, 1.0)
        np.maximum(raised[:-up], opacity[up:] * share, out=raised[:-up])
    return raised


def _free(height: int, width: int, kept_xyxy_px: FloatArray) -> _Map:
    """(height, width) 0 on hulls, 1 off their boxes, between the two in the margin."""
    free = np.ones((height, width), np.float32)
    x, y = np.arange(width) + 0.5, np.arange(height) + 0.5
    for outer, hull in zip(kept_xyxy_px, inner(kept_xyxy_px), strict=True):
        margin = max(float(hull[0] - outer[0]), 1.0)
        off_x = np.maximum(np.maximum(np.floor(hull[0]) - x, x - np.ceil(hull[2])), 0.0)
        off_y = np.maximum(np.maximum(np.floor(hull[1]) - y, y - np.ceil(hull[3])), 0.0)
        off = np.maximum(off_x[None, :], off_y[:, None]) / (0.3 * margin)
        free = np.minimum(free, np.clip(off, 0.0, 1.0).astype(np.float32))
    return free


def _step(value: FloatArray | _Map) -> _Map:
    """0 below 0, 1 above 1, smooth between."""
    value = np.clip(value, 0.0, 1.0).astype(np.float32)
    return np.asarray(value * value * (3.0 - 2.0 * value))


@lru_cache(maxsize=1)
def _texture() -> _Map:
    """(256, 256) smooth noise that can be tiled; each value from 0 to 1 is as common."""
    rng = np.random.default_rng(7)
    white = np.pad(rng.normal(size=(_TEXELS, _TEXELS)).astype(np.float32), 16, mode="wrap")
    smooth = np.asarray(cv2.GaussianBlur(white, (0, 0), 0.45 * _TEXELS_A_CELL))[16:-16, 16:-16]
    order = np.argsort(np.argsort(smooth, axis=None)).reshape(smooth.shape)
    return (order / (order.size - 1.0)).astype(np.float32)


def _sampled(rng: np.random.Generator, behind_m: _Map, side_m: _Map, cell_m: float) -> _Map:
    """Noise on the water, drawn out along the wake."""
    grain = _TEXELS_A_CELL / cell_m
    start = rng.uniform(0.0, _TEXELS, 2)
    x = (0.5 * behind_m * grain + start[0]) % _TEXELS
    y = (side_m * grain + start[1]) % _TEXELS
    return _looked_up(x, y)


def _noise(rng: np.random.Generator, width: int, rows: slice, cell_px: float) -> _Map:
    """(rows, width) noise in some rows of the picture."""
    start = rng.uniform(0.0, _TEXELS, 2)
    x = (np.arange(width) * _TEXELS_A_CELL / cell_px + start[0]) % _TEXELS
    y = (np.arange(rows.start or 0, rows.stop) * _TEXELS_A_CELL / cell_px + start[1]) % _TEXELS
    return _looked_up(*np.meshgrid(x, y))


def _looked_up(x: FloatArray | _Map, y: FloatArray | _Map) -> _Map:
    found = cv2.remap(
        _texture(),
        x.astype(np.float32),
        y.astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_WRAP,
    )
    return np.asarray(found)
