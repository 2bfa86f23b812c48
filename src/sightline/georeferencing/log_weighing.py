"""Weighing of a log's fixes by the boxes: which of them cannot be where they say.

Boxes between two fixes are placed between these, so that one fix that is wrong spoils all boxes on
either side of it, each by its share. By a first model the error of each fix is estimated from its
boxes alone (weighted least squares), and compared with what such a model leaves anywhere. What is
far beyond that, and leaps there from the fixes beside it, is no error of the model, which is as
smooth as the path is, but one of the fix. A stretch of fixes is found one by one: its ends leap.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sightline.georeferencing.correspondences import Correspondences
from sightline.georeferencing.placement import Placement
from sightline.types import BoolArray, FloatArray, IntArray, utc_text

# In standard deviations of what a model leaves at fixes: beyond the first a fix is wrong, where a
# single box tells beyond the second, since that may be wrong as well; beyond the third it belongs
# to a stretch that is.
_WRONG = 4.5
_WRONG_BY_ONE = 6.0
_SUSPECT = 3.0
# The median of the length of two independent standard normal variables.
_MEDIAN_LENGTH = 1.1774
# Fixes further away than this say nothing of an error that leaps.
_BESIDE_S = 100.0
# By so much of an error it changes within two fixes where it is one of the log.
_LEAST_LEAP = 0.5
# A box tells of a fix that makes up so much of its place.
_LEAST_SHARE = 0.05
# More than this share of the boxes is no exception: then the model is wrong.
_LARGEST_SHARE = 0.25
_MOST_NAMED = 5


@dataclass(frozen=True, eq=False)
class WrongFix:
    """A fix that is not where it says.

    Attributes:
        recording: The recording that its boxes are of.
        time_utc_s: By the log's clock.
        off_m: How far it is from where the boxes say.
        boxes: How many boxes it spoils.
    """

    recording: str
    time_utc_s: float
    off_m: float
    boxes: int


@dataclass(frozen=True, eq=False)
class _FixErrors:
    """Errors of the fixes that boxes tell of, in the order of logs and times.

    Attributes:
        log: (K,) int64, which log.
        time_s: (K,) float64.
        error_m: (K, 2) float64, east and north.
        covariance_m2: (K, 2, 2) float64, as of the surest of its boxes: errors of boxes within
            seconds are alike.
        boxes: (K,) int64, how many boxes tell.
    """

    log: IntArray
    time_s: FloatArray
    error_m: FloatArray
    covariance_m2: FloatArray
    boxes: IntArray

    def __len__(self) -> int:
        return self.time_s.size


def wrong_fixes(
    pairs: Correspondences, placed: Placement
) -> tuple[BoolArray, tuple[WrongFix, ...]]:
    """Which boxes wrong fixes spoil, and these fixes, the worst first.

    Args:
        pairs: With the times of the fixes around each box.
        placed: Of the pairs' boxes, by a model that few wrong fixes do not move.

    Returns:
        (N,) bool, and the fixes. Where too many boxes would be spoilt, none is.
    """
    spoilt = np.zeros(len(pairs), dtype=bool)
    off_m = placed.east_north_m - pairs.east_north_m
    known = np.isfinite(off_m).all(axis=1) & np.isfinite(pairs.fix_time_utc_s).all(axis=1)
    logs = np.unique(np.stack([pairs.recording, pairs.vessel], axis=1), axis=0)
    log = np.full(len(pairs), -1)
    for index, (recording, vessel) in enumerate(logs):
        log[(pairs.recording == recording) & (pairs.vessel == vessel)] = index
    covariance = placed.covariance_m2 + pairs.fix_sigma_m[:, None, None] ** 2 * np.eye(2)
    found: list[WrongFix] = []
    scale = None
    while True:
        rows = np.flatnonzero(known & ~spoilt)
        errors = _errors(pairs[rows], log[rows], off_m[rows], covariance[rows])
        if len(errors) < 3:
            break
        standard = _length(errors.error_m, errors.covariance_m2)
        # Of all fixes, before any is left out: what is left would look ever worse.
        scale = scale or max(1.0, float(np.median(standard)) / _MEDIAN_LENGTH)
        worst = _worst(errors, standard / scale, scale)
        if worst is None:
            break
        box, fix, _, _, _ = _told(pairs[rows], log[rows])
        own = np.zeros(len(pairs), dtype=bool)
        own[rows[box[fix == worst]]] = True
        spoilt |= own
        size_m = float(np.hypot(*errors.error_m[worst]))
        name = str(logs[errors.log[worst]][0])
        found.append(WrongFix(name, float(errors.time_s[worst]), size_m, int(own.sum())))
        if spoilt.sum() > _LARGEST_SHARE * len(pairs):
            return np.zeros(len(pairs), dtype=bool), ()
    return spoilt, tuple(found)


def _told(
    pairs: Correspondences, log: IntArray
) -> tuple[IntArray, IntArray, FloatArray, FloatArray, IntArray]:
    """What boxes tell of fixes, one row a box and fix.

    Returns:
        (M,) which box, (M,) which fix and (M,) the share of that in the box's place; then, of the
        fixes, (K,) their times and (K,) their logs.
    """
    before, after = pairs.fix_time_utc_s.T
    span = np.maximum(after - before, 1e-9)
    late = np.clip((pairs.boxes.time_utc_s - before) / span, 0.0, 1.0)
    # A box at the time of a fix has the same fix on both sides.
    late = np.where(after == before, 0.0, late)
    n = len(pairs)
    box = np.concatenate([np.arange(n), np.arange(n)])
    share = np.concatenate([1.0 - late, late])
    key = np.stack([np.concatenate([log, log]), np.concatenate([before, after])], axis=1)
    tells = share > _LEAST_SHARE
    fixes, fix = np.unique(key[tells], axis=0, return_inverse=True)
    return (
        box[tells],
        fix.reshape(-1).astype(np.int64),
        share[tells],
        fixes[:, 1],
        fixes[:, 0].astype(np.int64),
    )


def _errors(
    pairs: Correspondences, log: IntArray, off_m: FloatArray, covariance_m2: FloatArray
) -> _FixErrors:
    box, fix, share, times, logs = _told(pairs, log)
    precision = np.linalg.inv(covariance_m2)[box]
    information, pull = np.zeros((times.size, 2, 2)), np.zeros((times.size, 2))
    np.add.at(information, fix, (share**2)[:, None, None] * precision)
    # A box is off its log's place by the error of the fix, the other way.
    np.add.at(pull, fix, -share[:, None] * np.einsum("nij,nj->ni", precision, off_m[box]))
    largest = np.zeros(times.size)
    np.maximum.at(largest, fix, share)
    inverse = np.linalg.inv(information)
    alike = np.bincount(fix, share**2, times.size) / largest**2
    return _FixErrors(
        logs,
        times,
        np.einsum("kij,kj->ki", inverse, pull),
        inverse * alike[:, None, None],
        np.bincount(fix, minlength=times.size).astype(np.int64),
    )


def _worst(errors: _FixErrors, standard: FloatArray, scale: float) -> int | None:
    """The fix that is furthest off, among those that leap there from the fixes beside them."""
    limit = np.where(errors.boxes > 1, _WRONG, _WRONG_BY_ONE)
    for index in np.argsort(-standard):
        if standard[index] < _WRONG:
            return None
        if standard[index] > limit[index] and _leaps(errors, standard, int(index), scale):
            return int(index)
    return None


def _leaps(errors: _FixErrors, standard: FloatArray, index: int, scale: float) -> bool:
    """Whether the error of a fix, or of the stretch that it is in, begins and ends with a leap."""
    own = np.flatnonzero(errors.log == errors.log[index])
    size_m = float(np.hypot(*errors.error_m[index]))
    known = False
    for side in (own[own <= index][::-1], own[own >= index]):
        # The next fix on either side shares boxes with this one, and looks wrong with it.
        right = np.flatnonzero(standard[side[2:]] < _SUSPECT)[:1] + 2
        if not right.size:
            continue
        beside = side[int(right[0])]
        if abs(errors.time_s[beside] - errors.time_s[index]) > _BESIDE_S:
            continue
        known = True
        off = errors.error_m[index] - errors.error_m[[beside]]
        if _length(off, errors.covariance_m2[[index]])[0] < _WRONG * scale:
            return False
        path = errors.error_m[side[: int(right[0]) + 1]]
        if np.hypot(*(path[2:] - path[:-2]).T).max() < _LEAST_LEAP * size_m:
            return False
    # In a log that is off as a whole nothing says where it is right.
    return known


def _length(error_m: FloatArray, covariance_m2: FloatArray) -> FloatArray:
    """(K,) lengths of errors in standard deviations."""
    solved = np.linalg.solve(covariance_m2, error_m[:, :, None])[:, :, 0]
    return np.asarray(np.sqrt(np.sum(error_m * solved, axis=1)))


def sentences(found: tuple[WrongFix, ...]) -> tuple[str, ...]:
    """Sentences for people on the fixes that were left out, stretches in one."""
    stretches: list[list[WrongFix]] = []
    for fix in sorted(found, key=lambda one: (one.recording, one.time_utc_s)):
        last = stretches[-1][-1] if stretches else None
        if last and last.recording == fix.recording and fix.time_utc_s - last.time_utc_s < 10.0:
            stretches[-1].append(fix)
        else:
            stretches.append([fix])
    stretches.sort(key=lambda stretch: -max(fix.off_m for fix in stretch))
    out = []
    for stretch in stretches[:_MOST_NAMED]:
        off_m = max(fix.off_m for fix in stretch)
        boxes = sum(fix.boxes for fix in stretch)
        told = f"{boxes} box{'es' if boxes != 1 else ''} beside"
        first, last_utc = utc_text(stretch[0].time_utc_s), utc_text(stretch[-1].time_utc_s)
        if len(stretch) == 1:
            out.append(
                f"The fix at {first} (recording {stretch[0].recording}) is {off_m:.0f} m from "
                f"where the boxes say; it is left out, with the {told} it."
            )
        else:
            out.append(
                f"The fixes from {first} to {last_utc} (recording {stretch[0].recording}) are "
                f"up to {off_m:.0f} m from where the boxes say; they "
                f"are left out, with the {told} them."
            )
    if len(stretches) > _MOST_NAMED:
        out.append(f"So are fixes at {len(stretches) - _MOST_NAMED} more places of the logs.")
    return tuple(out)
