"""Tiling of a frame for detection, at a resolution that keeps small targets.

A boat at a kilometre is a few pixels large: a frame scaled to the size of a network loses it. So
the strip around the horizon, where things are far and small, is taken at full resolution; what is
near is large, and may be scaled down. Of a frame that is wider than others the same holds: harbour
cameras of more pixels show more, not larger things.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sightline.detection.letterbox import Letterbox
from sightline.errors import InputError, unknown_name
from sightline.overlap import shared_area
from sightline.types import BoolArray, FloatArray, IntArray

Horizon = tuple[float, float]
"""Rows of the horizon at the left and the right edge of the image, px."""

VIEWS = ("strip", "tiles", "whole", "everywhere")

_REFERENCE_WIDTH_PX = 1280
_ENLARGED_EVERYWHERE = 1.5
"""Boats of 8 px are seen by networks that were taught larger ones; at twice the size they find no
more, and more that is none."""
_OVERLAP_OF_TILES, _OVERLAP_EVERYWHERE = 0.1, 0.2
_COARSER = 3.0
"""Between the scales of tiles everywhere: what no finer tile has whole, these have."""
_LEAST_STEP = 1.4
_LARGEST_TILE_PX = 2048
_MOST_PX = 2**24
"""What a network is shown at once fits into memory up to here."""
_MOST_ENLARGED = 8.0

_TOUCHES_PX = 2.0
_SAME = 0.5
"""Share of a cut box inside a whole one from which both are of the same thing."""
_OVERLAP = 0.3
"""Intersection over union of boxes of two views from which they are of the same thing."""


@dataclass(frozen=True)
class Tile:
    """A part of a frame, with the scale at which a network is run on it.

    Attributes:
        x: Left edge, px of the frame.
        y: Upper edge.
        width: Pixels of the frame.
        height: Pixels of the frame.
        scale: Pixels of the network's input for a pixel of the frame.
    """

    x: int
    y: int
    width: int
    height: int
    scale: float

    @property
    def searched_px(self) -> float:
        """Number of pixels of network input, without padding."""
        return self.width * self.height * self.scale**2


@dataclass(frozen=True)
class TilingSettings:
    """How the tiles of a frame are chosen.

    Attributes:
        kind: ``"strip"``: around and below the horizon as it is, and all below the horizon scaled
            down; ``"tiles"``: all of the frame as it is; ``"whole"``: the frame scaled down;
            ``"everywhere"``: all of the frame enlarged, and again ever coarser down to the whole,
            so that things of any size are seen: for pictures and batch jobs.
        frame_width_px: Frames that are wider are scaled down to it before anything looks. None:
            they are not.
        above_px: How far above the horizon the strip begins; masts and cabins stand there. Of a
            frame of ``frame_width_px`` or 1280 px; in wider ones in proportion.
        below_px: How far below the horizon it ends, likewise.
        near_scale: Scale of all that lies below the horizon, in the strip's. 0: left out.
        overlap: Of neighbouring tiles, as a share of their side. What is larger than it may lie
            whole in neither; the scaled view is for that. None: 0.1, and 0.2 everywhere.
        whole_px: Longest side of a frame scaled for a network that takes any size.
        enlarge: Pixels that the network is shown for a pixel of the frame. None: 1, and 1.5
            everywhere.
    """

    kind: str = "strip"
    frame_width_px: int | None = None
    above_px: float = 40.0
    below_px: float = 180.0
    near_scale: float = 0.25
    overlap: float | None = None
    whole_px: int = 640
    enlarge: float | None = None

    def __post_init__(self) -> None:
        if self.kind not in VIEWS:
            raise unknown_name("kind of views", self.kind, VIEWS)
        width = 1 if self.frame_width_px is None else self.frame_width_px
        positive = min(width, self.whole_px, self.above_px + self.below_px)
        if not (positive > 0 and 0.0 <= self.near_scale <= 1.0 and 0.0 <= self.overlap_share < 0.9):
            raise InputError(
                "views: sizes must be positive, near_scale between 0 and 1, and overlap between 0 "
                f"and 0.9; got {self}"
            )
        if self.enlarge is not None and not 0.0 < self.enlarge <= _MOST_ENLARGED:
            raise InputError(
                f"views: enlarge is {self.enlarge:g}; it must be more than 0 and at most "
                f"{_MOST_ENLARGED:g} (2: twice the size)"
            )

    @property
    def overlap_share(self) -> float:
        """Overlap of neighbouring tiles, as a share of their side."""
        if self.overlap is not None:
            return self.overlap
        return _OVERLAP_EVERYWHERE if self.kind == "everywhere" else _OVERLAP_OF_TILES

    def scale(self, width_px: int) -> float:
        """Pixels that the network is shown for a pixel of a frame of this width."""
        enlarge = self.enlarge
        if enlarge is None:
            enlarge = _ENLARGED_EVERYWHERE if self.kind == "everywhere" else 1.0
        if self.frame_width_px is None:
            return enlarge
        return min(1.0, self.frame_width_px / width_px) * enlarge

    def stretch(self, width_px: int) -> float:
        """Pixels of a frame of this width for a pixel of ``above_px`` and ``below_px``."""
        return max(1.0, width_px / (self.frame_width_px or _REFERENCE_WIDTH_PX))

    def band(self, width_px: int, horizon_px: Horizon) -> tuple[float, float]:
        """First and last row of the strip around the horizon, as far as it would reach."""
        stretch = self.stretch(width_px)
        top, bottom = min(horizon_px), max(horizon_px)
        return top - self.above_px * stretch, bottom + self.below_px * stretch


def plan_tiles(
    frame_px: tuple[int, int],
    settings: TilingSettings,
    *,
    horizon_px: Horizon | None = None,
    input_px: tuple[int, int] | None = None,
    stride_px: int = 32,
) -> tuple[Tile, ...]:
    """Plan the tiles of a frame.

    Args:
        frame_px: Width and height.
        settings: How they are chosen.
        horizon_px: Where the horizon lies; without it a strip is all of the frame.
        input_px: Width and height that the network takes; None: any.
        stride_px: Of which a network that takes any size takes multiples.
    """
    width, height = frame_px
    if settings.kind == "whole":
        return (_whole(frame_px, settings, input_px),)
    scale = settings.scale(width)
    if settings.kind == "everywhere":
        return _everywhere(frame_px, settings, input_px, scale)
    top, bottom = 0, height
    if settings.kind == "strip" and horizon_px is not None:
        top, bottom = _strip(frame_px, settings, horizon_px, scale, stride_px)
    if input_px is not None:
        area = (0, top, width, bottom)
        tiles = tuple(_tiles(area, frame_px, input_px, scale, settings.overlap_share))
        whole = _whole(frame_px, settings, input_px)
        return tiles if whole in tiles else (*tiles, whole)
    strip = Tile(0, top, width, bottom - top, scale)
    parts: tuple[Tile, ...] = (strip,)
    if strip.searched_px > _MOST_PX:
        side_px = (_LARGEST_TILE_PX, _LARGEST_TILE_PX)
        area = (0, top, width, bottom)
        parts = tuple(_tiles(area, frame_px, side_px, scale, settings.overlap_share))
    if bottom == height or settings.near_scale == 0.0:
        return parts
    return *parts, Tile(0, top, width, height - top, scale * settings.near_scale)


def _whole(
    frame_px: tuple[int, int], settings: TilingSettings, input_px: tuple[int, int] | None
) -> Tile:
    if input_px is not None:
        scale = min(input_px[0] / frame_px[0], input_px[1] / frame_px[1])
    else:
        scale = min(1.0, settings.whole_px / max(frame_px))
    return Tile(0, 0, *frame_px, scale)


def _everywhere(
    frame_px: tuple[int, int],
    settings: TilingSettings,
    input_px: tuple[int, int] | None,
    scale: float,
) -> tuple[Tile, ...]:
    """Tiles of all of the frame at several scales, and the whole, the finest first."""
    side_px = input_px if input_px is not None else (_LARGEST_TILE_PX, _LARGEST_TILE_PX)
    whole = _whole(frame_px, settings, input_px)
    area = (0, 0, *frame_px)
    tiles: list[Tile] = []
    while scale > whole.scale * (_LEAST_STEP if tiles else 1.0):
        tiles += _tiles(area, frame_px, side_px, scale, settings.overlap_share)
        scale /= _COARSER
    return (*tiles, whole)


def _strip(
    frame_px: tuple[int, int],
    settings: TilingSettings,
    horizon_px: Horizon,
    scale: float,
    stride_px: int,
) -> tuple[int, int]:
    """First and last row of the strip, a multiple of the network's stride."""
    width, height = frame_px
    first, bottom = settings.band(width, horizon_px)
    # A horizon outside the frame leaves the row next to it.
    top = min(max(math.floor(first), 0), height - 1)
    rows = math.ceil(max(bottom - top, 1.0) * scale / stride_px) * stride_px
    return top, min(top + math.ceil(rows / scale), height)


def _tiles(
    area: tuple[int, int, int, int],
    frame_px: tuple[int, int],
    input_px: tuple[int, int],
    scale: float,
    overlap: float,
) -> Iterator[Tile]:
    """Tiles of the network's size that cover an area, x1, y1, x2, y2, and may reach beyond it."""
    columns = _places(area[0], area[2], frame_px[0], input_px[0] / scale, overlap)
    rows = list(_places(area[1], area[3], frame_px[1], input_px[1] / scale, overlap))
    for x, width in columns:
        for y, height in rows:
            yield Tile(x, y, width, height, scale)


def _places(
    first: int, last: int, end: int, side: float, overlap: float
) -> Iterator[tuple[int, int]]:
    """Starts and lengths of tiles along one axis."""
    length = min(math.floor(side), end)
    count = max(math.ceil((last - first - overlap * length) / ((1.0 - overlap) * length)), 1)
    if count == 1:
        # In the middle of the area, as far as the frame reaches.
        middle = 0.5 * (first + last - length)
        yield min(max(round(middle), 0), end - length), length
        return
    for begin in np.linspace(first, last - length, count):
        yield round(float(begin)), length


def place(view: Tile, input_px: tuple[int, int] | None, stride_px: int, centred: bool) -> Letterbox:
    """Letterbox of a tile on the canvas of a network."""
    return Letterbox.fit(
        (view.width, view.height),
        scale=view.scale,
        canvas_px=input_px,
        stride_px=stride_px,
        centred=centred,
    )


def merge(
    views: Sequence[Tile],
    frame_px: tuple[int, int],
    xyxy_px: FloatArray,
    score: FloatArray,
    view: IntArray,
    label: IntArray,
) -> BoolArray:
    """Merge the boxes of overlapping tiles by non-maximum suppression between tiles.

    A box that ends at an edge of its view inside the frame is cut off there; it goes where another
    view has the whole of it. Of the others that overlap and are of two views, the best stays
    (non-maximum suppression between views; boxes of one view have been through their own).

    Args:
        views: All views.
        frame_px: Width and height.
        xyxy_px: (N, 4) boxes in the frame.
        score: (N,) its confidence.
        view: (N,) index of the view of each.
        label: (N,) its class; only boxes of the same class are of the same thing.

    Returns:
        (N,) bool, what stays.
    """
    stays: BoolArray = np.ones(len(xyxy_px), dtype=bool)
    if len(views) < 2 or not len(xyxy_px):
        return stays
    cut = _cut(views, frame_px, xyxy_px, view)
    area = (xyxy_px[:, 2:] - xyxy_px[:, :2]).prod(axis=1)
    whole = np.flatnonzero(~cut)
    for i in np.flatnonzero(cut):
        others = whole[(view[whole] != view[i]) & (label[whole] == label[i])]
        stays[i] = not (shared_area(xyxy_px[i], xyxy_px[others]) >= _SAME * area[i]).any()
    order = np.argsort(-score, kind="stable")
    for rank, i in enumerate(order):
        if stays[i]:
            later = order[rank + 1 :]
            later = later[(view[later] != view[i]) & (label[later] == label[i])]
            shared = shared_area(xyxy_px[i], xyxy_px[later])
            stays[later[shared >= _OVERLAP * (area[i] + area[later] - shared)]] = False
    return stays


def _cut(
    views: Sequence[Tile], frame_px: tuple[int, int], xyxy_px: FloatArray, view: IntArray
) -> BoolArray:
    """(N,) whether a box is cut off by an inner edge of its tile."""
    edges = np.array([(v.x, v.y, v.x + v.width, v.y + v.height) for v in views], dtype=np.float64)
    slack = np.array([_TOUCHES_PX / v.scale for v in views])
    inner = edges != np.array([0, 0, *frame_px])
    own, near = edges[view], slack[view][:, None]
    touches = np.empty((len(xyxy_px), 4), dtype=bool)
    touches[:, :2] = xyxy_px[:, :2] <= own[:, :2] + near
    touches[:, 2:] = xyxy_px[:, 2:] >= own[:, 2:] - near
    return np.asarray((touches & inner[view]).any(axis=1), dtype=bool)
