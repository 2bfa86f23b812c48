"""Evidence of an explanation: log-likelihood ratio of logged vessels against clutter.

An explanation competes with two others: that what it takes for a logged vessel is clutter, and that
it is a vessel without a log, which goes wherever it likes. Against the second it wins by what the
log foretells of the path in the image: where it begins, how fast it goes, how it bends. The path
and what the log leaves of it are written as Legendre polynomials in time; each coefficient that
the log makes smaller is worth the logarithm of by how much. A straight path has few coefficients,
and a camera with its clock has as many parameters to fit them with, so that the cost of these
(Occam's factor of Laplace's approximation) refuses a single straight pass, and lets pass two of
them, or one that manoeuvres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from sightline.association.observations import TrackObservations
from sightline.association.refine import CLOCKS_ALIKE_S, Explanation
from sightline.association.search import ROUGH_CAMERA, RecordingObservations, clutter_per_px2
from sightline.camera.parameters import HEADING
from sightline.clock_offset import USUAL_SIGMA_S
from sightline.types import FloatArray, IntArray

SURE = 0.5
"""An observation is a vessel's where that is likelier than not."""

LEAST_LOG_LIKELIHOOD_RATIO = 4.0
"""Least log-likelihood ratio of a match, in nats."""

_LEAST_SHARE = 0.5
_BEND_S = 6.0
_MOST_BENDS = 24
_APART_S = 8.0
_FLOOR_PX = np.array([4.0, 3.0])


@dataclass(frozen=True, eq=False)
class Match:
    """Observations matched to a logged vessel in a recording.

    Attributes:
        recording: Index of the recording.
        vessel: Index of the log in the recording.
        rows: (K,) its observations, in the order of time.
        log_likelihood_ratio: Of the path given the log, in nats, less the choice of the vessel.
    """

    recording: int
    vessel: int
    rows: IntArray
    log_likelihood_ratio: float


def matches(
    watches: Sequence[RecordingObservations], found: Explanation, size_px: tuple[int, int]
) -> list[Match]:
    """Matches of observations to vessels under an explanation, by recording, the surest first."""
    out: list[Match] = []
    for index, watch in enumerate(watches):
        if not len(watch.seen) or not watch.paths:
            continue
        share, predicted = found.share[index], found.predicted_px[index]
        density = _density(watch.seen, size_px)
        mine: list[Match] = []
        for vessel in np.flatnonzero((share > SURE).sum(axis=1) >= 3).tolist():
            rows = _rows(watch.seen, share[vessel], predicted[vessel])
            if rows.size < 3:
                continue
            ratio = _log_likelihood_ratio(watch.seen, rows, predicted[vessel], density, found)
            ratio -= float(np.log(len(watch.paths)))
            if ratio > LEAST_LOG_LIKELIHOOD_RATIO:
                mine.append(Match(index, vessel, rows, ratio))
        out.extend(_apart(mine))
    return out


def _rows(seen: TrackObservations, share: FloatArray, predicted: FloatArray) -> IntArray:
    """Observations of the vessel, in the order of time: of tracks that are mostly its own."""
    mine = share > SURE
    if seen.followed:
        foretold = np.isfinite(predicted[:, 0])
        count = np.bincount(seen.track[foretold], minlength=int(seen.track.max()) + 1)
        own = np.bincount(seen.track[mine], minlength=count.size)
        mine &= (own >= _LEAST_SHARE * count)[seen.track] & (own >= 2)[seen.track]
    rows = np.flatnonzero(mine)
    return np.asarray(rows[np.argsort(seen.time_utc_s[rows], kind="stable")])


def _log_likelihood_ratio(
    seen: TrackObservations,
    rows: IntArray,
    predicted: FloatArray,
    density: FloatArray,
    found: Explanation,
) -> float:
    """Log-likelihood ratio of a path given a log, against a vessel without one, in nats."""
    apart = max(_APART_S, 4.0 * seen.interval_s)
    cuts = np.flatnonzero(np.diff(seen.time_utc_s[rows]) > apart) + 1
    noise = np.maximum([found.noise.column_px, found.noise.row_px], _FLOOR_PX)
    total = 0.0
    last: FloatArray | None = None
    for part in np.split(rows, cuts):
        whole = _coefficients(seen.time_utc_s[part], seen.foot_px[part])
        rest = _coefficients(seen.time_utc_s[part], seen.foot_px[part] - predicted[part])
        total += float(np.log((np.abs(whole[1:]) + noise) / (np.abs(rest[1:]) + noise)).sum())
        if last is None:
            typical = float(np.median(density[part]))
            total -= float(np.log(2.0 * np.pi * typical * (np.abs(rest[0]) + noise).prod()))
        else:
            # What went out of sight comes back where it went: little to predict.
            total += float(
                np.log((np.abs(whole[0] - last) + noise) / (np.abs(rest[0]) + noise)).sum()
            )
        last = whole[0]
    return total


def goes_along(seen: TrackObservations, rows: IntArray, predicted: FloatArray) -> bool:
    """Whether a track follows the motion of a log, rather than being static where it passes."""
    rows = rows[np.argsort(seen.time_utc_s[rows], kind="stable")]
    whole = _coefficients(seen.time_utc_s[rows], seen.foot_px[rows])[1:]
    rest = _coefficients(seen.time_utc_s[rows], seen.foot_px[rows] - predicted[rows])[1:]
    worth = np.log((np.abs(whole) + _FLOOR_PX) / (np.abs(rest) + _FLOOR_PX))
    return bool(worth.sum() > 0.0)


def _coefficients(time_s: FloatArray, path_px: FloatArray) -> FloatArray:
    """(K, 2) Legendre coefficients of a path; each in pixels of root mean square."""
    span = float(np.ptp(time_s))
    degree = int(max(min(np.ceil(span / _BEND_S) + 1, len(time_s) // 3, _MOST_BENDS), 0))
    where = 2.0 * (time_s - time_s[0]) / max(span, 1e-6) - 1.0
    basis = legendre.legvander(where, degree)
    scale = 1.0 / np.sqrt(2.0 * np.arange(degree + 1) + 1.0)
    # A gap must not let high degrees swing.
    basis = basis * (1.0 / scale)
    rough = 1e-3 * len(time_s) * np.diag(np.arange(degree + 1.0) ** 2)
    return np.asarray(np.linalg.solve(basis.T @ basis + rough, basis.T @ path_px))


def _density(seen: TrackObservations, size_px: tuple[int, int]) -> FloatArray:
    """(N,) probability density of boxes at each box, per square pixel."""
    clutter = clutter_per_px2(seen, size_px)
    moments = max(1.0, np.ptp(seen.time_utc_s) / seen.interval_s)
    return np.asarray(clutter * moments / (1.2 * len(seen)))


def _apart(found: list[Match]) -> list[Match]:
    """Matches with at most a small overlap in observations; the surer one stays."""
    kept: list[Match] = []
    for match in sorted(found, key=lambda one: -one.log_likelihood_ratio):
        if all(np.isin(match.rows, other.rows).mean() < 0.2 for other in kept):
            kept.append(match)
    return kept


def cost(found: Explanation, largest_offset_s: float, image_size_px: tuple[int, int]) -> float:
    """Occam factor of the parameters of an explanation, in nats."""
    mean, sigma = ROUGH_CAMERA.moments(image_size_px, 0, 0, position_known=True)
    camera = found.vector.size
    offsets = found.offset_s.size
    anywhere = _anywhere_s(largest_offset_s)
    alike = anywhere if offsets == 1 else min(CLOCKS_ALIKE_S, anywhere)
    sigma = np.concatenate([sigma[:camera], np.full(offsets, alike)])
    sigma[HEADING] = 2.0 * np.pi / np.sqrt(12.0)
    off = (found.vector - mean[:camera]) / sigma[:camera]
    off[HEADING] = 0.0
    narrowed = found.covariance / np.outer(sigma, sigma)
    _, log_determinant = np.linalg.slogdet(narrowed)
    return float(0.5 * np.sum(off**2) - 0.5 * min(log_determinant, 0.0) + np.log(anywhere / alike))


def clock_belief(found: Explanation, largest_offset_s: float) -> float:
    """What is believed of clocks adds to the evidence of an explanation, in nats.

    `cost` takes a clock for off by anything up to the largest offset. Half of all clocks are taken
    for right here, as `ClockPrior` has them, and half for off by anything. Between explanations by
    several clocks the data decides alone: a log that repeats itself says nothing of the clock.
    """
    offset_s = float(np.mean(found.offset_s))
    scale_s = np.sqrt(2.0) * USUAL_SIGMA_S
    right = 1.0 / (np.pi * scale_s * (1.0 + (offset_s / scale_s) ** 2))
    density = 0.5 * right + 0.5 / (2.0 * max(largest_offset_s, 1e-3))
    return float(np.log(np.sqrt(2.0 * np.pi) * _anywhere_s(largest_offset_s) * density))


def _anywhere_s(largest_offset_s: float) -> float:
    """Standard deviation of a clock offset that may be anything up to the largest."""
    return float(2.0 * max(largest_offset_s, 1e-3) / np.sqrt(12.0))
