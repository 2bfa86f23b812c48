"""Which tiles of a video's frames are looked at, where there is time for some of them only.

What has not changed since a network looked at it would give the same boxes again. So the first
frame is looked at everywhere; after it, in each frame, tiles with what changed where something had
been found, and with what else moves, and with what time is left all others in turn, the band around
the horizon more often. Boxes of a tile that is not looked at stay as long as the picture under them
does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.detection.tiling import Tile
from sightline.types import BoolArray, FloatArray, IntArray

Grey = NDArray[np.float32]

_WIDTH_PX = 640
_LEAST_CHANGE = 12.0
_TIMES_NOISE = 4.0
_NEIGHBOURS = 9
_MOST_NOISE = 20.0
_MEMORY_S = 5.0
_MOVED_MEMORY_S = 50.0
_UNKNOWN_INTERVAL_S = 1.0 / 15.0
_LONGEST_INTERVAL_S = 2.0
_LEAST_AREA_PX = 4
_MOST_REGIONS = 64
_AROUND = 0.25
_CHANGED_SHARE = 0.1
_WEIGHT_OF_BAND = 3.0
_RESERVED_SHARE = 4


@dataclass(frozen=True, eq=False)
class Found:
    """Boxes that a network found in a tile.

    Attributes:
        xyxy_px: (N, 4) px of the frame.
        score: (N,).
        label: (N,) number of the class.
    """

    xyxy_px: FloatArray
    score: FloatArray
    label: IntArray

    def only(self, kept: BoolArray) -> Found:
        """Those of a mask."""
        return Found(self.xyxy_px[kept], self.score[kept], self.label[kept])


class TileRotation:
    """Chooses the tiles of each frame that are looked at, and remembers what the others held.

    For each frame in the order of time, `choose` and then `merge`. What is chosen depends on the
    frames and on how many tiles there may be, and on nothing else.
    """

    def __init__(self, tiles: Sequence[Tile], frame_px: tuple[int, int]) -> None:
        """Begin without having looked at anything.

        Args:
            tiles: All of them, which cover the frame.
            frame_px: Its width and height.
        """
        self.tiles = tuple(tiles)
        self.frame_px = frame_px
        self._scale = min(1.0, _WIDTH_PX / frame_px[0])
        self._small_px = (
            max(round(frame_px[0] * self._scale), 1),
            max(round(frame_px[1] * self._scale), 1),
        )
        self._edges = np.array(
            [(t.x, t.y, t.x + t.width, t.y + t.height) for t in self.tiles], dtype=np.float64
        )
        self._tile_scale = np.array([tile.scale for tile in self.tiles])
        self._windows = [self._window(edges) for edges in self._edges]
        self._weight = np.ones(len(self.tiles))
        self._age = np.full(len(self.tiles), np.inf)
        self._found: dict[int, Found] = {}
        self._seen: dict[int, Grey] = {}
        self._now: Grey | None = None
        self._background: Grey | None = None
        self._noise: Grey | None = None
        self._last_s = float("nan")
        self._frames = 0

    def set_band(self, rows: tuple[float, float] | None) -> None:
        """Take tiles that reach into these rows more often, and those that show most at once.

        Args:
            rows: The first and the last, px of the frame; None: no row is better than others.
        """
        coarse = self._tile_scale < 0.5 * self._tile_scale.max()
        inside = np.zeros(len(self.tiles), dtype=bool)
        if rows is not None:
            inside = (self._edges[:, 1] < rows[1]) & (self._edges[:, 3] > rows[0])
        self._weight = np.where(coarse | inside, _WEIGHT_OF_BAND, 1.0)

    def choose(self, image_bgr: NDArray[np.uint8], time_utc_s: float, most: int) -> list[int]:
        """Numbers of the tiles of the next frame that are to be looked at, in order.

        Args:
            image_bgr: (H, W, 3) the frame.
            time_utc_s: When it was taken; NaN where that is not known.
            most: How many there may be.
        """
        regions, moving = self._observe(image_bgr, time_utc_s)
        self._age += 1.0
        if most >= len(self.tiles) or self._frames == 1:
            return list(range(len(self.tiles)))
        # Of one tile a frame every other is for what does not move, or it would never be seen.
        reserved = max(most // _RESERVED_SHARE, 1) if most > 1 else self._frames % 2
        chosen = self._holding(regions, most - reserved)
        chosen += self._holding(moving, most - reserved - len(chosen), chosen)
        turn = np.argsort(-self._age * self._weight, kind="stable").tolist()
        chosen += [i for i in turn if i not in chosen][: most - len(chosen)]
        return sorted(chosen)

    def merge(self, found: Mapping[int, Found]) -> dict[int, Found]:
        """What is known of all tiles: what was found now, and earlier where nothing has changed.

        Args:
            found: By the number of the tile, what the network found in those that were chosen.
        """
        assert self._now is not None, "tiles are chosen before something is found in them"
        for i, boxes in found.items():
            self._found[i] = boxes
            self._seen[i] = self._now[self._windows[i]].copy()
            self._age[i] = 0.0
        return dict(sorted(self._found.items()))

    def _window(self, edges: FloatArray) -> tuple[slice, slice]:
        """Rows and columns of the small picture that show a part of the frame, one at least."""
        low = np.floor(edges[:2] * self._scale).astype(int)
        high = np.ceil(edges[2:] * self._scale).astype(int)
        low = np.clip(low, 0, np.array(self._small_px) - 1)
        high = np.clip(high, low + 1, self._small_px)
        return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))

    def _observe(
        self, image_bgr: NDArray[np.uint8], time_utc_s: float
    ) -> tuple[_Regions, _Regions]:
        """Parts of the frame where something had been found and has changed, and that move."""
        elapsed_s = time_utc_s - self._last_s
        elapsed_s = elapsed_s if elapsed_s > 0.0 else _UNKNOWN_INTERVAL_S
        elapsed_s = min(elapsed_s, _LONGEST_INTERVAL_S)
        self._last_s = time_utc_s
        self._frames += 1
        small = cv2.resize(image_bgr, self._small_px, interpolation=cv2.INTER_AREA)
        now: Grey = np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), dtype=np.float32)
        before, self._now = self._now, now
        if before is None or self._background is None or self._noise is None:
            self._background = now.copy()
            self._noise = np.zeros_like(now)
            return _Regions.none(), _Regions.none()
        rate = 1.0 - float(np.exp(-elapsed_s / _MEMORY_S))
        slowly = 1.0 - float(np.exp(-elapsed_s / _MOVED_MEMORY_S))
        # At first the mean of what was seen; and of neighbours, since waves do not stand still.
        step = np.minimum(cv2.absdiff(now, before), _MOST_NOISE)
        step = cv2.boxFilter(step, cv2.CV_32F, (_NEIGHBOURS, _NEIGHBOURS))
        cv2.accumulateWeighted(step, self._noise, max(rate, 1.0 / (self._frames - 1)))
        limit = np.maximum(_LEAST_CHANGE, _TIMES_NOISE * self._noise)
        excess = _changes(now, self._background) - limit
        moving = excess > 0.0
        # What moves is learned slowly, or a slow boat would fade.
        for mask, pace in ((~moving, rate), (moving, slowly)):
            cv2.accumulateWeighted(now, self._background, pace, mask=mask.astype(np.uint8))
        return self._forget_changed(now, limit), _moving(excess, moving, self._scale)

    def _forget_changed(self, now: Grey, limit: Grey) -> _Regions:
        """Forget boxes under which the picture has changed, and say where they were."""
        gone: list[FloatArray] = []
        scores: list[FloatArray] = []
        for i, boxes in self._found.items():
            if not len(boxes.score):
                continue
            window = self._windows[i]
            mask = _changes(now[window], self._seen[i]) > limit[window]
            if not mask.any():
                continue
            share = self._share(mask, window, boxes.xyxy_px)
            changed = share > _CHANGED_SHARE
            gone.append(boxes.xyxy_px[changed])
            scores.append(boxes.score[changed])
            self._found[i] = boxes.only(~changed)
        if not gone:
            return _Regions.none()
        return _Regions(np.concatenate(gone), np.concatenate(scores)).first()

    def _share(
        self, mask: BoolArray, window: tuple[slice, slice], xyxy_px: FloatArray
    ) -> FloatArray:
        """(N,) shares of what lies in and around boxes that a mask of a window has."""
        sums = np.asarray(cv2.integral(mask.astype(np.uint8)), dtype=np.float64)
        corner = np.array([window[1].start, window[0].start])
        around = _AROUND * (xyxy_px[:, 2:] - xyxy_px[:, :2])
        size = np.array(mask.shape[::-1])
        low = np.floor((xyxy_px[:, :2] - around) * self._scale - corner).astype(int)
        high = np.ceil((xyxy_px[:, 2:] + around) * self._scale - corner).astype(int)
        (x1, y1), (x2, y2) = np.clip(low, 0, size - 1).T, np.clip(high, 1, size).T
        x2, y2 = np.maximum(x2, x1 + 1), np.maximum(y2, y1 + 1)
        total = sums[y2, x2] - sums[y1, x2] - sums[y2, x1] + sums[y1, x1]
        return np.asarray(total / ((x2 - x1) * (y2 - y1)), dtype=np.float64)

    def _holding(self, regions: _Regions, most: int, chosen: Sequence[int] = ()) -> list[int]:
        """Tiles that hold regions, each as a whole and as large as can be.

        The most urgent first, by how strong a region is and how long its tile has waited.
        """
        wanted: dict[int, float] = {}
        for region, strength in zip(regions.xyxy_px, regions.strength.tolist(), strict=True):
            inside = (self._edges[:, :2] <= region[:2]) & (self._edges[:, 2:] >= region[2:])
            holding = np.flatnonzero(inside.all(axis=1))
            if not holding.size:
                holding = np.array([int(np.argmin(self._tile_scale))])
            scale = self._tile_scale[holding]
            holding = holding[scale == scale.max()]
            if any(i in chosen for i in holding.tolist()):
                continue
            margin = np.minimum(
                region[:2] - self._edges[holding, :2], self._edges[holding, 2:] - region[2:]
            ).min(axis=1)
            there = [i for i in holding.tolist() if i in wanted]
            best = there[0] if there else int(holding[np.argmax(margin)])
            wanted[best] = wanted.get(best, 0.0) + strength
        order = sorted(wanted, key=lambda i: -wanted[i] * self._age[i])
        return order[: max(most, 0)]


@dataclass(frozen=True, eq=False)
class _Regions:
    """Parts of a frame that are to be looked at.

    Attributes:
        xyxy_px: (N, 4) px of the frame.
        strength: (N,) how sure it is that there is something, in any unit.
    """

    xyxy_px: FloatArray
    strength: FloatArray

    @classmethod
    def none(cls) -> _Regions:
        """Nowhere."""
        return cls(np.empty((0, 4)), np.empty(0))

    def first(self) -> _Regions:
        """The strongest."""
        order = np.argsort(-self.strength, kind="stable")[:_MOST_REGIONS]
        return _Regions(self.xyxy_px[order], self.strength[order])


def _moving(excess: Grey, moving: BoolArray, scale: float) -> _Regions:
    """Parts that move, by how far all of their pixels are beyond noise.

    Args:
        excess: (H, W) how far each pixel is beyond it.
        moving: (H, W) where that is more than nothing.
        scale: Pixels of these for a pixel of the frame.
    """
    joined = cv2.dilate(moving.astype(np.uint8), np.ones((3, 5), np.uint8))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(joined, connectivity=8)
    stats, labels = np.asarray(stats), np.asarray(labels, dtype=np.int64)
    sums = np.bincount(labels[moving], weights=excess[moving], minlength=len(stats))
    kept = np.flatnonzero(np.bincount(labels[moving], minlength=len(stats)) >= _LEAST_AREA_PX)
    kept = kept[kept > 0]
    left, top, width, height = stats[kept, :4].T.astype(np.float64)
    found = np.column_stack([left, top, left + width, top + height])
    strength = np.asarray(sums[kept], dtype=np.float64)
    return _Regions(np.asarray(found / scale, dtype=np.float64), strength).first()


def _changes(now: Grey, before: Grey) -> Grey:
    """How far each pixel is from what it was, whatever has become of all the light."""
    difference = now - before
    difference -= np.median(difference[::4, ::4])
    return np.asarray(np.abs(difference), dtype=np.float32)
