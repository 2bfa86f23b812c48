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
        share, _ = _shares(pairs, errors.time_s[worst])
        own = known & ~spoilt & (log == errors.log[worst]) & (share > _LEAST_SHARE)
        spoilt |= own
        size_m = float(np.hypot(*errors.error_m[worst]))
        name = str(logs[errors.log[worst]][0])
        found.append(WrongFix(name, float(errors.time_s[worst]), size_m, int(own.sum())))
        if spoilt.sum() > _LARGEST_SHARE * len(pairs):
            return np.zeros(len(pairs), dtype=bool), ()
    return spoilt, tuple(found)


def _shares(pairs: Correspondences, time_s: float) -> tuple[FloatArray, FloatArray]:
    """(N,) share of a fix in each place, 0 to 1, and (N,) seconds between the fixes around."""
    before, after = pairs.fix_time_utc_s.T
    span = np.maximum(after - before, 1e-9)
    late = np.clip((pairs.boxes.time_utc_s - before) / span, 0.0, 1.0)
    return np.where(before == time_s, 1.0 - late, np.where(after == time_s, late, 0.0)), span


def _errors(
    pairs: Correspondences, log: IntArray, off_m: FloatArray, covariance_m2: FloatArray
) -> _FixErrors:
    precision = np.linalg.inv(covariance_m2)
    logs, times, errors, covariances, counts = [], [], [], [], []
    for one in np.unique(log):
        own = np.flatnonzero(log == one)
        part = pairs[own]
        for time in np.unique(part.fix_time_utc_s):
            share, _ = _shares(part, float(time))
            tells = np.flatnonzero(share > _LEAST_SHARE)
            if not tells.size:
                continue
            h, weight = share[tells], precision[own[tells]]
            information = np.einsum("n,nij->ij", h * h, weight)
            # A box is off its log's place by the error of the fix, the other way.
            pull = -np.einsum("n,nij,nj->i", h, weight, off_m[own[tells]])
            logs.append(int(one))
            times.append(float(time))
            errors.append(np.linalg.solve(information, pull))
            covariances.append(np.linalg.inv(information) * np.sum(h * h) / h.max() ** 2)
            counts.append(tells.size)
    return _FixErrors(
        np.array(logs, dtype=np.int64),
        np.array(times),
        np.array(errors).reshape(-1, 2),
        np.array(covariances).reshape(-1, 2, 2),
        np.array(counts, dtype=np.int64),
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
    """Whether the error of a fix is no continuation of that of those beside it."""
    own = np.flatnonzero(errors.log == errors.log[index])
    beside = []
    # The next fix on either side shares boxes with this one, and looks wrong with it.
    for side in (own[own < index - 1][::-1], own[own > index + 1]):
        beside += side[standard[side] < _SUSPECT][:1].tolist()
    near = [at for at in beside if abs(errors.time_s[at] - errors.time_s[index]) < _BESIDE_S]
    # In a log that is off as a whole nothing says where it is right.
    if not near:
        return False
    leap = errors.error_m[index] - errors.error_m[near]
    return bool((_length(leap, errors.covariance_m2[[index]]) > _WRONG * scale).all())


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
