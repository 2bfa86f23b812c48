"""Search for initial cameras: a Hough vote of observations and logs over a coarse grid.

With the height of the camera, its focal length and the offset of its clock assumed, every foot of a
box that is taken for a logged vessel says which heading and which pitch the camera has (its column
against the bearing, its row against the range). Right assumptions and right pairs agree, clutter
and other vessels spread. No track is needed, so single pictures far apart vote as well; and all
vessels and recordings vote for the one camera. (Ballard 1981, "Generalizing the Hough transform".)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from sightline.association.observations import TrackObservations
from sightline.camera.parameters import (
    CURVATURE,
    HEADING,
    K1,
    LOG_FOCAL,
    LOG_HEIGHT,
    PITCH,
    camera_vector,
)
from sightline.camera.priors import CameraPrior
from sightline.reference_trajectory import ReferenceTrajectory
from sightline.types import FloatArray, IntArray

HEADING_STEP_DEG = 2.0
ROUGH_CAMERA = CameraPrior(k1_sigma=0.2, principal_sigma_widths=1e-4, curvature=(6.0 / 7.0, 1e-3))
"""Prior of the camera by which vessels are recognised: its principal point and the curvature are
as good as known, since they would only bend it to wrong explanations. Any lens is tried."""
PITCH_STEP_DEG = 1.0
_PITCHES_DEG = (-20.0, 31.0)
_HEIGHTS_M = (2.0, 3.2, 5.0, 8.0, 13.0, 22.0, 40.0)
_FOCAL_WIDTHS = (0.45, 0.58, 0.74, 0.95, 1.25, 1.7)
_K1 = (0.0, -0.25)
OFFSET_STEP_S = 1.0
_FURTHEST_M = 8000.0
_PIECE_S = 30.0
_SHORTEST_S = 3.0
# How much heading and pitch may vary over a piece that a log explains, at least and at most.
_TOLERANCE_DEG = np.array([0.4, 0.3])
_LOOSEST_DEG = np.array([2.5, 1.2])
# What is static is explained by anything that is static.
_TOLD_BY_ANY = 1.5
_CELL_PX = (16.0, 8.0)
# Two cameras are told apart from here.
_APART_DEG = (8.0, 4.0)


@dataclass(frozen=True, eq=False)
class RecordingObservations:
    """Observations of one recording, and the logs of whatever may be in view.

    Attributes:
        name: Of the recording.
        seen: The observations.
        paths: The logs.
        above_m: (N,) float64, how high the water stood at each observation above its middle over
            all recordings. The votes leave it out: what they find is refined. Absent: at it.
        zone_s: What was added to the logs' times, so that they are in the camera's time zone.
    """

    name: str
    seen: TrackObservations
    paths: tuple[ReferenceTrajectory, ...]
    above_m: FloatArray = field(default_factory=lambda: np.empty(0))
    zone_s: float = 0.0

    def __post_init__(self) -> None:
        if self.above_m.size == 0:
            object.__setattr__(self, "above_m", np.zeros(len(self.seen)))


@dataclass(frozen=True, eq=False)
class Candidate:
    """An initial camera with clock offsets.

    Attributes:
        vector: (12,) as in `sightline.camera.parameters.PARAMETERS`.
        offset_s: (R,) of each recording's clock: what is to be added to it. The recordings of a
            camera have a clock, so that they begin alike.
        votes: How many votes it has.
    """

    vector: FloatArray
    offset_s: FloatArray
    votes: float


def clutter_per_px2(seen: TrackObservations, image_size_px: tuple[int, int]) -> FloatArray:
    """(N,) clutter density at each observation, boxes a square pixel and moment.

    Over the whole recording, so that the static scene counts as clutter that was to be expected.
    """
    width, height = image_size_px
    shape = (int(np.ceil(width / _CELL_PX[0])), int(np.ceil(height / _CELL_PX[1])))
    at = (seen.foot_px / _CELL_PX).astype(np.int64)
    at = np.clip(at, 0, np.array(shape) - 1)
    count = np.zeros(shape)
    np.add.at(count, (at[:, 0], at[:, 1]), 1.0)
    moments = max(1.0, np.ptp(seen.time_utc_s) / seen.interval_s) if len(seen) else 1.0
    smooth = gaussian_filter(count, 1.5, mode="nearest") / (_CELL_PX[0] * _CELL_PX[1])
    # A box might be anywhere, too.
    uniform = (len(seen) + 1.0) / (width * height)
    return np.asarray((smooth[at[:, 0], at[:, 1]] + 0.2 * uniform) / moments)


def offset_step_s(watches: Sequence[RecordingObservations]) -> float:
    """Step of the clock offsets tried: coarser with a whole feed, whose many vessels vote."""
    few = max(len(watch.paths) for watch in watches) < 8
    return OFFSET_STEP_S if few else 2.0 * OFFSET_STEP_S


def candidates(
    watches: Sequence[RecordingObservations],
    image_size_px: tuple[int, int],
    *,
    largest_offset_s: float,
    count: int = 24,
) -> list[Candidate]:
    """Cameras with the most votes, the best first, each unlike those before it.

    Args:
        watches: At least one.
        image_size_px: Width and height.
        largest_offset_s: How far clocks may be off.
        count: How many.
    """
    step_s = offset_step_s(watches)
    steps = int(np.ceil(largest_offset_s / step_s))
    offsets = step_s * np.arange(-steps, steps + 1)
    lenses = [(f * image_size_px[0], k) for f in _FOCAL_WIDTHS for k in _K1]
    headings = round(360.0 / HEADING_STEP_DEG)
    pitches = round((_PITCHES_DEG[1] - _PITCHES_DEG[0]) / PITCH_STEP_DEG)
    shape = (len(lenses), len(_HEIGHTS_M), headings, pitches)
    total = np.zeros(shape, dtype=np.float32)
    which = np.zeros(shape, dtype=np.int16)
    middle = 0.5 * np.asarray(image_size_px, dtype=float)
    pieces = [_pieces(watch.seen, image_size_px) for watch in watches]
    rays = [[_rays((part.foot_px - middle) / focal, k1) for focal, k1 in lenses] for part in pieces]
    for number, offset in enumerate(offsets):
        votes = np.zeros(shape, dtype=np.float32)
        for watch, part, angles in zip(watches, pieces, rays, strict=True):
            _vote(votes, _alike(part, watch.paths, float(offset), image_size_px[0]), angles)
        for lens, height in np.argwhere(votes.any(axis=(2, 3))):
            smooth = gaussian_filter(
                votes[lens, height], 1.0, mode=("wrap", "constant"), truncate=2.0
            )
            more = smooth > total[lens, height]
            total[lens, height][more] = smooth[more]
            which[lens, height][more] = number
    prior = ROUGH_CAMERA
    heights = -0.5 * (np.log(np.array(_HEIGHTS_M) / prior.height_m) / prior.log_height_sigma) ** 2
    focal = np.array([focal for focal, _ in lenses]) / (prior.focal_widths * image_size_px[0])
    longs = -0.5 * (np.log(focal) / prior.log_focal_sigma) ** 2
    total += (longs[:, None, None, None] + heights[None, :, None, None]).astype(np.float32)
    out: list[Candidate] = []
    # Each lens and height has its own peaks; the best are looked at in turn.
    flat = np.argsort(total, axis=None)[::-1]
    taken: list[tuple[float, float]] = []
    for index in flat[:20000]:
        lens, height, i, j = (int(v) for v in np.unravel_index(index, shape))
        heading = (i + 0.5) * HEADING_STEP_DEG
        pitch = _PITCHES_DEG[0] + (j + 0.5) * PITCH_STEP_DEG
        near = next(
            (
                k
                for k, (h, p) in enumerate(taken)
                if abs((heading - h + 180.0) % 360.0 - 180.0) < _APART_DEG[0]
                and abs(pitch - p) < _APART_DEG[1]
            ),
            None,
        )
        if near is not None:
            continue
        taken.append((heading, pitch))
        focal_px, k1 = lenses[lens]
        out.append(
            Candidate(
                vector=camera_vector(
                    {
                        LOG_HEIGHT: np.log(_HEIGHTS_M[height]),
                        PITCH: np.radians(pitch),
                        HEADING: np.radians(heading),
                        LOG_FOCAL: np.log(focal_px),
                        K1: k1,
                        CURVATURE: prior.curvature[0],
                    }
                ),
                offset_s=np.full(len(watches), offsets[which[lens, height, i, j]]),
                votes=float(total[lens, height, i, j]),
            )
        )
        if len(out) == count:
            break
    return out


def _vote(
    votes: NDArray[np.float32], pairs: _Pairs, rays: Sequence[tuple[FloatArray, FloatArray]]
) -> None:
    """Add the votes of pairs, (lens, height, heading, pitch), in place."""
    if not pairs.row.size:
        return
    headings, pitches = votes.shape[2:]
    for lens, (across, level) in enumerate(rays):
        turned = pairs.bearing_deg - np.degrees(across[pairs.row])
        heading, spread = pairs.mean_and_spread(turned)
        steady = spread < pairs.spread_deg[:, 0]
        if not steady.any():
            continue
        ahead = pairs.distance_m * np.cos(across[pairs.row])
        column = np.floor(heading / HEADING_STEP_DEG).astype(np.int64) % headings
        for k, height in enumerate(_HEIGHTS_M):
            tilt, spread = pairs.mean_and_spread(
                np.degrees(np.arctan(height / ahead) - level[pairs.row])
            )
            line = np.floor((tilt - _PITCHES_DEG[0]) / PITCH_STEP_DEG).astype(np.int64)
            chosen = steady & (spread < pairs.spread_deg[:, 1]) & (line >= 0) & (line < pitches)
            np.add.at(votes[lens, k], (column[chosen], line[chosen]), pairs.weight[chosen])


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Short segments of tracks, rows in the order of the segment.

    Attributes:
        time_utc_s: (N,) float64.
        foot_px: (N, 2) float64.
        start: (P,) the first row of each piece.
        weight: (P,) how much it tells if it is explained.
        spread_deg: (P, 2) by how much heading and pitch may vary over it, if it is.
    """

    time_utc_s: FloatArray
    foot_px: FloatArray
    start: IntArray
    weight: FloatArray
    spread_deg: FloatArray


def _pieces(seen: TrackObservations, image_size_px: tuple[int, int]) -> _Pieces:
    if not seen.followed:
        # What lies where something always lies tells nothing.
        weight = np.log1p(0.5 / (2.0 * np.pi * 150.0) / clutter_per_px2(seen, image_size_px))
        rows = np.arange(len(seen))
        any_spread = np.full((rows.size, 2), 1.0)
        return _Pieces(seen.time_utc_s, seen.foot_px, rows, weight, any_spread)
    chosen: list[IntArray] = []
    weight_of: list[float] = []
    loose: list[FloatArray] = []
    order = np.lexsort((seen.time_utc_s, seen.track))
    for rows in np.split(order, np.flatnonzero(np.diff(seen.track[order])) + 1):
        if not rows.size:
            continue
        time = seen.time_utc_s[rows]
        parts = max(1, int(np.ceil(np.ptp(time) / _PIECE_S)))
        cuts = np.searchsorted(time, time[0] + np.ptp(time) * np.arange(1, parts) / parts)
        for part in np.split(rows, cuts):
            if part.size < 5 or np.ptp(seen.time_utc_s[part]) < _SHORTEST_S:
                continue
            few = part[np.round(np.linspace(0, part.size - 1, min(part.size, 10))).astype(int)]
            extent = np.abs(np.diff(seen.foot_px[few[[0, -1]]], axis=0))[0]
            chosen.append(few)
            told = float(np.log1p(extent[0] / 8.0) + np.log1p(extent[1] / 4.0)) - _TOLD_BY_ANY
            if told <= 0.0:
                chosen.pop()
                continue
            weight_of.append(told)
            degrees = np.degrees(1.0 / image_size_px[0])
            loose.append(_TOLERANCE_DEG + 0.2 * degrees * np.std(seen.foot_px[few], axis=0))
    sizes = np.array([part.size for part in chosen], dtype=np.int64)
    rows = np.concatenate([np.empty(0, dtype=np.int64), *chosen])
    return _Pieces(
        seen.time_utc_s[rows],
        seen.foot_px[rows],
        np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64)[: sizes.size],
        np.array(weight_of),
        np.minimum(np.array(loose).reshape(-1, 2), _LOOSEST_DEG),
    )


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Track segments paired with logs that may match, rows in the order of the pair.

    Attributes:
        row: (K,) row of `_Pieces`.
        bearing_deg: (K,) of the log's place, unwrapped within a pair.
        distance_m: (K,) of the log's place.
        start: (Q,) the first row of each pair.
        weight: (Q,) of its piece.
        spread_deg: (Q, 2) of its piece.
    """

    row: IntArray
    bearing_deg: FloatArray
    distance_m: FloatArray
    start: IntArray
    weight: FloatArray
    spread_deg: FloatArray

    def mean_and_spread(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(Q,) mean and standard deviation of values (K,) over each pair."""
        count = np.diff(np.append(self.start, values.size))
        mean = np.add.reduceat(values, self.start) / count
        square = np.add.reduceat((values - np.repeat(mean, count)) ** 2, self.start) / count
        return mean, np.sqrt(square)


def _alike(
    pieces: _Pieces, paths: Sequence[ReferenceTrajectory], offset_s: float, width_px: int
) -> _Pairs:
    """Segment-log pairs whose columns are consistent with the bearings of some camera."""
    count = np.diff(np.append(pieces.start, pieces.time_utc_s.size))
    rows, bearings, distances, sizes, weights, spreads = [], [], [], [], [], []
    number = np.repeat(np.arange(count.size), count)
    x = pieces.foot_px[:, 0]
    for path in paths:
        if not count.size:
            break
        place = path.at(pieces.time_utc_s + offset_s).east_north_m
        distance = np.hypot(place[:, 0], place[:, 1])
        bearing = np.degrees(np.arctan2(place[:, 0], place[:, 1]))
        first = bearing[pieces.start]
        bearing = first[number] + (bearing - first[number] + 180.0) % 360.0 - 180.0
        usable = (distance < _FURTHEST_M) & (distance > 1.0)
        known = np.minimum.reduceat(usable.astype(np.int64), pieces.start) > 0
        safe = np.where(np.isfinite(bearing), bearing, 0.0)
        mean_x = np.add.reduceat(x, pieces.start) / count
        mean_b = np.add.reduceat(safe, pieces.start) / count
        dx, db = x - mean_x[number], safe - mean_b[number]
        var_x = np.add.reduceat(dx * dx, pieces.start) / count + 4.0
        cov = np.add.reduceat(dx * db, pieces.start) / count
        var_b = np.add.reduceat(db * db, pieces.start) / count
        # Degrees a pixel, between those of a long and of a short lens.
        slope = np.clip(cov / var_x, np.degrees(0.4) / width_px, np.degrees(2.6) / width_px)
        left = var_b - 2.0 * slope * cov + slope**2 * var_x
        fits = known & (left < pieces.spread_deg[:, 0] ** 2)
        chosen = fits[number]
        rows.append(np.flatnonzero(chosen))
        bearings.append(bearing[chosen])
        distances.append(distance[chosen])
        sizes.append(count[fits])
        weights.append(pieces.weight[fits])
        spreads.append(pieces.spread_deg[fits])
    size = np.concatenate([np.empty(0, dtype=np.int64), *sizes])
    return _Pairs(
        row=np.concatenate([np.empty(0, dtype=np.int64), *rows]),
        bearing_deg=np.concatenate([np.empty(0), *bearings]),
        distance_m=np.concatenate([np.empty(0), *distances]),
        start=np.concatenate([[0], np.cumsum(size)[:-1]]).astype(np.int64)[: size.size],
        weight=np.concatenate([np.empty(0), *weights]),
        spread_deg=np.concatenate([np.empty((0, 2)), *spreads]),
    )


def _rays(distorted: FloatArray, k1: float) -> tuple[FloatArray, FloatArray]:
    """Angles of pixels: horizontal, radians clockwise, and vertical, radians downwards."""
    radius = np.hypot(distorted[:, 0], distorted[:, 1])
    scale = np.ones_like(radius)
    if k1:
        # Beyond the fold the lens model says nothing; the edge of what it says will do here.
        straight = radius.copy()
        fold = np.sqrt(-1.0 / (3.0 * k1)) if k1 < 0.0 else np.inf
        for _ in range(10):
            slope = np.maximum(1.0 + 3.0 * k1 * straight**2, 0.1)
            straight -= (straight * (1.0 + k1 * straight**2) - radius) / slope
            straight = np.clip(straight, 0.0, 0.95 * fold)
        scale = np.where(radius > 0.0, straight / np.maximum(radius, 1e-12), 1.0)
    x, y = distorted[:, 0] * scale, distorted[:, 1] * scale
    return np.arctan(x), np.arctan(y)
