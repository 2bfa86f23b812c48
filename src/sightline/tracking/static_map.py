"""Map of detections that stay: houses, buoys, moored boats before a camera that stands still.

Boxes of one thing that does not move fall on one place of the image again and again. The map
clusters boxes by centre and size while they go by, and keeps of each place the moments of a
regression of the centre on time. It tells that a thing stays where it is by a test of
equivalence: not that no motion was found, but that a boat under way would have shown more.

Boxes are as the model's camera would have seen them, so that a camera that is shaken does not
matter as long as its rotation is known (`Georeferencer.compensated`).
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sightline.tracking.image import ImageTrackerSettings
from sightline.tracking.plane import Columns, Fields
from sightline.types import BoolArray, Boxes, FloatArray, IntArray

BLOCK_S = 1.0
"""Errors of boxes last about as long: all boxes of a place within it are one sample."""

SLOWEST_SIZES_PER_S = 0.125
"""Least speed of a boat under way, sizes of its box (roots of the area) a second.

A box of 4 m, of a boat of 6 m, at a knot: with less a rudder does not steer.
"""

FASTEST_SIZES_PER_S = 4.0
"""A box of 4 m at 30 knots: what is faster was another thing."""

COINCIDENCE = 0.01
"""Largest probability that a boat under way shows as little as what is told to stay.

It does where it heads along the line of sight; courses are equally likely.
"""

GATE = 4.0
"""Standard deviations within which a box is of a place: one box of 16,000 is not."""

SURE = 4.0
"""Standard errors from which on a drift is no chance."""

PASSED_BY = -1
"""The number of the place of a box that is at none."""

_IMAGE = ImageTrackerSettings()
# Before boxes tell their own scatter, that which trackers assume counts as so many of them.
_PRIOR_BOXES = 10.0
# Edges at whole pixels: the standard deviation of what rounding leaves.
_ROUNDED_PX = 1.0 / np.sqrt(12.0)
# The quantiles below are a normal distribution's, which hold from about so many samples on.
_LEAST_SAMPLES = 10.0
_WITHIN_95 = 2.0
# Light and tide change boxes within hours; what was minutes ago still holds.
_MEMORY_S = 600.0
# Who passes in front hides a thing for less; and what was never told to stay is forgotten then.
_HIDDEN_S = 60.0
_FORGOTTEN_S = 30.0
_GONE_PROBABILITY = 1e-4
_MOST_GAPS = 200
_FRAME_QUANTILE = 0.1

_SUMS: Fields = [
    ("weight", float, ()),
    ("time", float, ()),
    ("time_square", float, ()),
    ("measured", float, (4,)),
    ("measured_time", float, (4,)),
    ("measured_square", float, (4,)),
    ("box_square", float, (4,)),
    ("boxes", float, ()),
    ("confidence", float, ()),
    ("looks", float, ()),
    ("blocks", float, ()),
]
"""Sums over blocks, forgotten exponentially; measured are the centre and the logarithmic size."""

_PLACE: Fields = [
    ("number", int, ()),
    ("first_s", float, ()),
    ("last_s", float, ()),
    ("origin_s", float, ()),
    ("weight_square", float, ()),
    ("stays", bool, ()),
    *_SUMS,
]

_KEPT = ("centre_px", "size_px", "spread_px", "samples", "span_s", "seen_share", "confidence")
_WIDTHS = (2, 2, 2, 1, 1, 1, 1)


@dataclass(frozen=True, eq=False)
class StaticPlaces:
    """Places of the image that hold a detection that stays, one row a place.

    Attributes:
        centre_px: (K, 2) float64, mean centre of its boxes.
        size_px: (K, 2) float64, mean width and height.
        spread_px: (K, 2) float64, standard deviation of the centre of single boxes.
        samples: (K,) float64, how many independent samples it was learned from.
        span_s: (K,) float64, over how long a time.
        seen_share: (K,) float64, share of frames in which it has a box.
        confidence: (K,) float64, mean over all frames, those without a box count 0.
    """

    centre_px: FloatArray
    size_px: FloatArray
    spread_px: FloatArray
    samples: FloatArray
    span_s: FloatArray
    seen_share: FloatArray
    confidence: FloatArray

    def __len__(self) -> int:
        return int(self.samples.size)

    def to_array(self) -> FloatArray:
        """(K, 10) all columns side by side, as model files keep them."""
        return np.column_stack([getattr(self, name) for name in _KEPT]).reshape(len(self), -1)

    @classmethod
    def of_array(cls, rows: ArrayLike) -> StaticPlaces:
        """The places of an array from `to_array`.

        Raises:
            ValueError: It is of another shape, or a value is none that a place can have.
        """
        array = np.array(rows, dtype=np.float64)
        if array.ndim != 2 or array.shape[1] != sum(_WIDTHS):
            raise ValueError(f"places that stay have {sum(_WIDTHS)} columns, not {array.shape}")
        parts = np.split(array, np.cumsum(_WIDTHS)[:-1], axis=1)
        made = cls(*(p if w > 1 else p[:, 0] for p, w in zip(parts, _WIDTHS, strict=True)))
        positive = (made.size_px, made.spread_px, made.samples, made.span_s)
        if not np.isfinite(array).all() or not all((part > 0.0).all() for part in positive):
            raise ValueError("a place that stays has a size, a spread or a time that is none")
        shares = np.column_stack([made.seen_share, made.confidence])
        if not ((shares >= 0.0) & (shares <= 1.0)).all():
            raise ValueError("a place that stays has a share that is not between 0 and 1")
        return made


class StaticMap:
    """Learns online which places of the image hold a detection that stays.

    A place stays (`stays`) once its boxes have come for so long, and from so nearly the same
    place, that a boat under way would show as little with a probability of `COINCIDENCE` at most,
    whatever its course: with the drift across bounded by U (95 %), its time T and the size s of
    its boxes that is (2 / pi) asin(U / (`SLOWEST_SIZES_PER_S` s T)). That takes some 20 s for
    large boxes and a minute for those of ten pixels. A place whose drift or growth is certain,
    and larger than the scatter of single boxes, does not stay.
    """

    def __init__(self, known: StaticPlaces | None = None) -> None:
        """Begin with what is known already.

        Args:
            known: Places that stay, of the same camera.
        """
        self._known = known
        self._table: Columns = np.zeros(0, dtype=_PLACE)
        self._ended: Columns = np.zeros(0, dtype=_PLACE)
        self._numbers = 0
        self._waiting: list[FloatArray] = []
        self._pending = 0
        self._block: int | None = None
        self._now_s = -np.inf
        self._shift_s = 0.0
        self._resume_s: float | None = None
        self._last_moment_s = np.nan
        self._gaps_s: deque[float] = deque(maxlen=_MOST_GAPS)

    def update(self, boxes: Boxes) -> None:
        """Learn from boxes.

        Args:
            boxes: Later than those before, in the order of time, with their times; of any number
                of moments.
        """
        if not len(boxes):
            return
        if self._resume_s is not None:
            self._shift_s = self._resume_s - float(boxes.time_utc_s[0])
            self._resume_s = None
        times = boxes.time_utc_s + self._shift_s
        gaps = np.diff(times, prepend=self._last_moment_s)
        self._gaps_s.extend(gaps[gaps > 0.0].tolist())
        self._last_moment_s = float(times[-1])
        block = np.floor(times / BLOCK_S).astype(np.int64)
        rows = np.column_stack([times, *_measured(boxes), boxes.confidence])
        cuts = [0, *(np.flatnonzero(np.diff(block)) + 1).tolist(), len(boxes)]
        for start, stop in itertools.pairwise(cuts):
            if self._waiting and int(block[start]) != self._pending:
                self._settle()
            self._pending = int(block[start])
            self._waiting.append(rows[start:stop])

    @property
    def now_s(self) -> float:
        """Until when it has learned, by the clock of the boxes; minus infinity before that."""
        return self._now_s - self._shift_s

    def finish(self) -> None:
        """Learn from the boxes that wait for others of their block."""
        if self._waiting:
            self._settle()

    def rest(self) -> None:
        """Another recording of the same camera follows, at whatever time."""
        self.finish()
        if np.isfinite(self._now_s):
            self._resume_s = self._now_s + BLOCK_S
        self._last_moment_s = np.nan

    def lowered(self, boxes: Boxes) -> FloatArray:
        """(N,) confidence of boxes, lowered where they are of a place that stays.

        What stays has been there in every frame. So its confidence is the mean over all of them,
        where those without a box count 0: a roof that is taken for a boat now and then has little
        of it, a boat that is found in each frame keeps what it has.
        """
        table = self._table[self._table["stays"]]
        owner = _match(table, *_measured(boxes)) if len(table) else np.full(len(boxes), PASSED_BY)
        mean = np.append(table["confidence"] / np.maximum(table["looks"], 1e-9), 1.0)
        return np.asarray(np.minimum(boxes.confidence, np.clip(mean[owner], 0.0, 1.0)))

    def at(self, boxes: Boxes) -> IntArray:
        """(N,) number of the place that stays and that each box is of, or `PASSED_BY`.

        Of what has been learned by now, of boxes of any time that the map has seen: also from
        before it was known that the place stays, and of places from which something has left.
        """
        table = self._staying()
        if not len(table) or not len(boxes):
            return np.full(len(boxes), PASSED_BY, dtype=np.int64)
        times = boxes.time_utc_s + self._shift_s
        there = times[:, None] >= table["first_s"] - BLOCK_S
        there &= times[:, None] <= table["last_s"] + BLOCK_S
        owner = _match(table, *_measured(boxes), there)
        return np.append(table["number"], PASSED_BY)[owner]

    def staying(self, boxes: Boxes) -> BoolArray:
        """(N,) whether a target stays in its place, box by box.

        Boxes beside the place for less than errors last are no departure; and who is at a place
        for no longer than a slow boat takes to pass it, and under way before or after, passes by.

        Args:
            boxes: Of one target, in the order of time.
        """
        own = self.at(boxes)
        inside: BoolArray = np.asarray(own != PASSED_BY)
        if not inside.any():
            return inside
        times = boxes.time_utc_s
        for start, stop in _runs(inside):
            if not inside[start] and times[stop - 1] - times[start] < BLOCK_S:
                inside[start:stop] = True
        if inside.all():
            return inside
        lasts = self._lasts(own, times)
        out = np.zeros(len(boxes), dtype=bool)
        for start, stop in _runs(inside):
            rows = np.flatnonzero(lasts[start:stop])
            if rows.size:
                out[start + rows[0] : start + rows[-1] + 1] = True
        if not out.any():
            return out
        # Between, before and after there may be too little to tell of, or a neighbour.
        for start, stop in _runs(out):
            if not out[start] and not certainly_moves(boxes[start:stop]):
                out[start:stop] = True
        return out

    def _lasts(self, own: IntArray, times: FloatArray) -> BoolArray:
        """(N,) whether a target is for longer at the place of each box than it takes to pass it.

        It may be there several times: who is taken for a neighbour now and then is there again.
        """
        table = self._staying()
        table = table[np.isin(table["number"], own)]
        mean = table["measured"][:, :2] / table["weight"][:, None]
        apart = np.abs(mean[:, None] - mean[None]) / (GATE * _spread(table))[:, None]
        # One thing may have several places, of boxes of different size.
        same = (apart <= 1.0).all(axis=2)
        step_s = np.minimum(np.diff(times, append=times[-1]), BLOCK_S)
        there_s = np.array([step_s[own == number].sum() for number in table["number"]])
        reach = 2.0 * GATE * _spread(table)[:, 0] / (SLOWEST_SIZES_PER_S * _size(table))
        lasting = table["number"][same @ there_s > reach]
        return np.isin(own, lasting)

    def _staying(self) -> Columns:
        """All places that stay, or did until something left them."""
        return np.concatenate([self._table[self._table["stays"]], self._ended])

    def places(self) -> StaticPlaces:
        """The places that stay now."""
        table = self._table[self._table["stays"]]
        number, span_s = _samples(table)
        mean = table["measured"] / table["weight"][:, None]
        looks = np.maximum(table["looks"], 1e-9)
        return StaticPlaces(
            centre_px=mean[:, :2],
            size_px=np.exp(mean[:, 2:]),
            spread_px=_spread(table),
            samples=number,
            span_s=np.maximum(span_s, BLOCK_S),
            seen_share=np.clip(table["boxes"] / looks, 0.0, 1.0),
            confidence=np.clip(table["confidence"] / looks, 0.0, 1.0),
        )

    def _settle(self) -> None:
        """Learn from the boxes of a block, all of which are there."""
        times, centre, log_size, confidence = np.split(
            np.concatenate(self._waiting), [1, 3, 5], axis=1
        )
        self._waiting.clear()
        block = self._pending
        now_s = (block + 1) * BLOCK_S
        if self._known is not None:
            self._restore(self._known, block * BLOCK_S)
            self._known = None
        passed = 1 if self._block is None else max(block - self._block, 1)
        self._block, self._now_s = block, now_s
        self._forget(passed * BLOCK_S)
        looks = self._looks(times, passed)
        self._table["looks"] += looks
        self._table["blocks"] += passed
        owner = _match(self._table, centre, log_size)
        for i in range(len(times)):
            if owner[i] == PASSED_BY:
                self._begin(centre[i], log_size[i], block * BLOCK_S, looks)
                left = np.flatnonzero(owner == PASSED_BY)
                near = _match(self._table[-1:], centre[left], log_size[left])
                near[0] = 0
                owner[left[near == 0]] = len(self._table) - 1
        self._add(owner, np.column_stack([centre, log_size]), confidence[:, 0])
        self._judge(np.unique(owner))
        self._drop()

    def _looks(self, times: FloatArray, blocks: int) -> float:
        """How often something looked since the last block, with moments that had no box.

        Those are not seen here, and are told by the shortest times between others.
        """
        seen = np.unique(times).size
        if not self._gaps_s:
            return float(seen)
        apart_s = float(np.quantile(np.array(self._gaps_s), _FRAME_QUANTILE))
        return max(float(seen), blocks * BLOCK_S / apart_s)

    def _forget(self, elapsed_s: float) -> None:
        kept = float(np.exp(-elapsed_s / _MEMORY_S))
        for name, _, _ in _SUMS:
            self._table[name] *= kept
        self._table["weight_square"] *= kept**2

    def _begin(self, centre: FloatArray, log_size: FloatArray, time_s: float, looks: float) -> None:
        """Begin a place at a box that is at no other; its sums are still to be filled."""
        place = np.zeros(1, dtype=_PLACE)
        self._numbers += 1
        place["number"] = self._numbers
        place["first_s"] = place["origin_s"] = place["last_s"] = time_s
        place["looks"], place["blocks"] = looks, 1.0
        # So that it can be matched before it has its samples.
        place["weight"] = 1e-9
        place["measured"] = 1e-9 * np.concatenate([centre, log_size])
        self._table = np.concatenate([self._table, place])

    def _add(self, owner: IntArray, measured: FloatArray, confidence: FloatArray) -> None:
        """Add the mean of a block's boxes to each place that has some."""
        table = self._table
        count = np.bincount(owner, minlength=len(table)).astype(float)
        touched = np.flatnonzero(count)
        total = np.zeros((len(table), 4))
        np.add.at(total, owner, measured)
        mean = total[touched] / count[touched, None]
        before = table["measured"] / table["weight"][:, None]
        off = np.zeros((len(table), 4))
        np.add.at(off, owner, (measured - before[owner]) ** 2)
        table["box_square"] += off
        table["boxes"] += count
        table["confidence"] += np.bincount(owner, weights=confidence, minlength=len(table))
        time_s = self._now_s - table["origin_s"][touched]
        for name, value in (
            ("weight", np.ones(touched.size)),
            ("weight_square", np.ones(touched.size)),
            ("time", time_s),
            ("time_square", time_s**2),
            ("measured", mean),
            ("measured_time", mean * time_s[:, None]),
            ("measured_square", mean**2),
        ):
            table[name][touched] += value
        table["last_s"][touched] = self._now_s

    def _judge(self, rows: IntArray) -> None:
        """Tell of the places that had boxes whether they stay."""
        table = self._table[rows]
        number, span_s = _samples(table)
        drift, error = _drift(table, number, span_s)
        spread = _scatter(table)
        goes = (drift - SURE * error > spread).any(axis=1)
        most = drift[:, 0] + _WITHIN_95 * error[:, 0]
        across = SLOWEST_SIZES_PER_S * _size(table) * span_s
        coincidence = 2.0 / np.pi * np.arcsin(np.minimum(most / np.maximum(across, 1e-9), 1.0))
        found = (number >= _LEAST_SAMPLES) & (coincidence <= COINCIDENCE)
        # Along the line of sight a boat comes down in the picture.
        found &= drift[:, 1] <= np.maximum(_WITHIN_95 * error[:, 1], _ROUNDED_PX)
        self._table["stays"][rows] = (table["stays"] | found) & ~goes

    def _drop(self) -> None:
        """Drop places that are not seen any more; those that stayed are remembered as ended."""
        table = self._table
        unseen_s = self._now_s - table["last_s"]
        # The share of blocks in which it was seen, as it was when it was seen last.
        kept = np.exp(-unseen_s / _MEMORY_S)
        since = _MEMORY_S / BLOCK_S * (1.0 - kept)
        share = np.clip(table["weight"] / np.maximum(table["blocks"] - since, 1.0), 0.0, 0.99)
        missed = (1.0 - share) ** (unseen_s / BLOCK_S)
        stays = table["stays"]
        gone = np.where(
            stays,
            (unseen_s > _HIDDEN_S) & (missed < _GONE_PROBABILITY),
            unseen_s > _FORGOTTEN_S,
        )
        if gone.any():
            self._ended = np.concatenate([self._ended, table[gone & stays]])
            self._table = table[~gone]

    def _restore(self, known: StaticPlaces, now_s: float) -> None:
        """Places as they would be if they had been seen until now."""
        table = np.zeros(len(known), dtype=_PLACE)
        table["number"] = np.arange(len(known)) + 1
        self._numbers = len(known)
        table["first_s"], table["last_s"] = -np.inf, now_s
        table["origin_s"] = now_s - known.span_s
        number, span_s = known.samples, known.span_s
        measured = np.column_stack([known.centre_px, np.log(known.size_px)])
        scatter = np.column_stack([known.spread_px, np.full((len(known), 2), _IMAGE.size_noise)])
        table["weight"] = table["weight_square"] = table["boxes"] = number
        table["looks"] = table["blocks"] = number
        table["time"] = number * span_s / 2.0
        table["time_square"] = number * span_s**2 / 3.0
        table["measured"] = number[:, None] * measured
        table["measured_time"] = table["time"][:, None] * measured
        table["measured_square"] = number[:, None] * (measured**2 + scatter**2)
        table["box_square"] = number[:, None] * scatter**2
        table["boxes"] = number * known.seen_share
        table["confidence"] = number * known.confidence
        table["stays"] = True
        self._table = table


def certainly_moves(boxes: Boxes) -> bool:
    """Whether a target has certainly moved: further than boxes of one place differ.

    A leap that no boat makes is no motion: somebody else was taken for the target.

    Args:
        boxes: Of one target, in the order of time.
    """
    if not len(boxes):
        return False
    centre, log_size = _measured(boxes)
    times = boxes.time_utc_s
    size = float(np.exp(log_size.mean()))
    # Motion leaves the size as it is: the edges' own scatter shows there, twice the centre's.
    own = 0.5 * np.std(np.exp(log_size), axis=0) if len(boxes) > 2 else np.zeros(2)
    spread = np.hypot(np.maximum(_IMAGE.position_noise * size, own), _ROUNDED_PX)
    # Of a difference of two.
    least = GATE * np.sqrt(2.0) * spread
    step, lag_s = np.abs(np.diff(centre, axis=0)), np.diff(times)
    # Nobody saw how it went in a gap.
    lag_s = np.minimum(lag_s, max(BLOCK_S, 2.0 * float(np.median(lag_s)) if lag_s.size else 0.0))
    most = np.maximum(least, FASTEST_SIZES_PER_S * size * lag_s[:, None])
    leaps = np.flatnonzero((step > most).any(axis=1)) + 1
    for rows in np.split(np.arange(len(boxes)), leaps):
        block = np.floor((times[rows] - times[rows[0]]) / BLOCK_S).astype(np.int64)
        _, group, count = np.unique(block, return_inverse=True, return_counts=True)
        means = np.column_stack([np.bincount(group, column) / count for column in centre[rows].T])
        if (np.abs(means - means[0]) > least).any():
            return True
    return False


def _measured(boxes: Boxes) -> tuple[FloatArray, FloatArray]:
    """(N, 2) centres and (N, 2) logarithms of width and height."""
    xyxy = boxes.xyxy_px
    return 0.5 * (xyxy[:, :2] + xyxy[:, 2:]), np.log(xyxy[:, 2:] - xyxy[:, :2])


def _match(
    table: Columns, centre: FloatArray, log_size: FloatArray, possible: BoolArray | None = None
) -> IntArray:
    """(N,) row of the place that each box is of, `PASSED_BY` where there is none.

    Args:
        table: K places.
        centre: (N, 2) of the boxes.
        log_size: (N, 2) of the boxes.
        possible: (N, K) which pairs there may be; absent: all.
    """
    if not len(table) or not len(centre):
        return np.full(len(centre), PASSED_BY, dtype=np.int64)
    mean = table["measured"] / table["weight"][:, None]
    scatter = _scatter(table)
    measured = np.concatenate([centre, log_size], axis=1)
    apart = np.abs(measured[:, None] - mean) / scatter
    # Places are a mixture of normal distributions: that which has most boxes is likeliest.
    unlikely = 0.5 * (apart**2).sum(axis=2) + np.log(scatter).sum(axis=1)
    unlikely = unlikely - np.log1p(table["boxes"])
    near = (apart <= GATE).all(axis=2)
    if possible is not None:
        near &= possible
    unlikely = np.where(near, unlikely, np.inf)
    best = np.argmin(unlikely, axis=1)
    return np.where(near[np.arange(len(near)), best], best, PASSED_BY)


def _size(table: Columns) -> FloatArray:
    """(K,) roots of the areas, px."""
    mean = table["measured"][:, 2:] / table["weight"][:, None]
    return np.asarray(np.exp(mean.mean(axis=1)))


def _scatter(table: Columns) -> FloatArray:
    """(K, 4) standard deviation of single boxes: centre, px, and logarithms of width and height."""
    size_px = np.exp(table["measured"][:, 2:] / table["weight"][:, None])
    usual = np.column_stack(
        [
            np.repeat((_IMAGE.position_noise * _size(table))[:, None], 2, axis=1),
            np.full((len(table), 2), _IMAGE.size_noise),
        ]
    )
    rounded = np.column_stack(
        [np.full((len(table), 2), _ROUNDED_PX), np.sqrt(2.0) * _ROUNDED_PX / size_px]
    )
    squares = _PRIOR_BOXES * usual**2 + table["box_square"]
    return np.asarray(np.sqrt(squares / (_PRIOR_BOXES + table["boxes"])[:, None] + rounded**2))


def _spread(table: Columns) -> FloatArray:
    """(K, 2) standard deviation of the centre of single boxes, px."""
    return _scatter(table)[:, :2]


def _samples(table: Columns) -> tuple[FloatArray, FloatArray]:
    """(K,) how many samples a place has, and (K,) over how long they are spread, seconds."""
    weight = table["weight"]
    number = weight**2 / np.maximum(table["weight_square"], 1e-300)
    middle = table["time"] / weight
    variance = np.maximum(table["time_square"] / weight - middle**2, 0.0)
    return number, np.sqrt(12.0 * variance)


def _drift(table: Columns, number: FloatArray, span_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(K, 4) drift over the whole span by regression, and (K, 4) its standard error."""
    weight = table["weight"][:, None]
    middle, mean = table["time"][:, None] / weight, table["measured"] / weight
    variance = np.maximum(span_s[:, None] ** 2 / 12.0, 1e-9)
    slope = (table["measured_time"] / weight - middle * mean) / variance
    left = table["measured_square"] / weight - mean**2 - slope**2 * variance
    free = np.maximum(number[:, None] - 2.0, 1e-9)
    least = [_ROUNDED_PX, _ROUNDED_PX, 0.0, 0.0]
    sigma = np.sqrt(np.maximum(left * number[:, None] / free, np.square(least)))
    error = sigma * np.sqrt(12.0 / np.maximum(number[:, None], 1.0))
    return np.abs(slope) * span_s[:, None], error


def _runs(inside: BoolArray) -> Iterator[tuple[int, int]]:
    """Begin and end of each run of equal values."""
    cuts = [0, *(np.flatnonzero(np.diff(inside)) + 1).tolist(), len(inside)]
    return itertools.pairwise(cuts)
