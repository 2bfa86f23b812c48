"""Refinement of a rough camera: camera, clocks and association by expectation-maximisation.

Expectation and maximisation (Dempster et al. 1977): which observations lie where a log says that
its vessel must be seen, given the camera; then the camera and the clocks that put the logs onto
them. The noise begins wide, so that a rough camera finds its observations, and narrows to what the
residuals are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sightline.association.search import (
    ROUGH_CAMERA,
    Candidate,
    RecordingObservations,
    clutter_per_px2,
    offset_step_s,
)
from sightline.camera.parameters import (
    CAMERA,
    CURVATURE,
    EAST,
    HEADING,
    K1,
    K2,
    LOG_FOCAL,
    LOG_HEIGHT,
    NORTH,
    PARAMETERS,
    PITCH,
    POSITION,
    PRINCIPAL_DX,
    PRINCIPAL_DY,
    ROLL,
    camera_vector,
)
from sightline.camera.pinhole import Camera, project_with_jacobian
from sightline.camera.priors import CameraPrior
from sightline.types import FloatArray, IntArray

# A state is a camera, then the clock offset of each recording.
_CLOCKS = slice(len(PARAMETERS), None)
_SEEN_SHARE = 0.7
"""How often a vessel in view has a box."""
CLOCKS_ALIKE_S = 2.0
"""By how much the offsets of recordings of one camera differ, as a standard deviation."""

_WIDEST = 6.0
_AGAIN = 2.5
_ROUNDS = 10
_MARGIN = 0.25
_LARGEST_PX = 60.0
# Boxes of one track are alike in error for about this long.
CORRELATION_TIME_S = 2.0

_LONGEST_STEP = camera_vector(
    {
        LOG_HEIGHT: 0.4,
        PITCH: 0.08,
        ROLL: 0.03,
        HEADING: 0.08,
        LOG_FOCAL: 0.2,
        K1: 0.08,
        K2: 0.05,
        EAST: 2.0,
        NORTH: 2.0,
        PRINCIPAL_DX: 1.0,
        PRINCIPAL_DY: 1.0,
        CURVATURE: 0.1,
    }
)


@dataclass(frozen=True)
class FootNoise:
    """Standard deviations of a foot point about the place that its log states.

    Attributes:
        column_px: Of the column, pixels.
        row_px: Of the row, pixels.
        place_m: Of the place, metres: the log, and the middle of the box off the receiver.
        row_m: Of the row, metres of height at the target.
    """

    column_px: float = 4.0
    row_px: float = 3.0
    place_m: float = 2.5
    row_m: float = 0.3


@dataclass(frozen=True, eq=False)
class Explanation:
    """A camera with its clock offsets, and the association that follows from them.

    Attributes:
        vector: (12,) camera.
        offset_s: (R,) of each recording: added to its times they agree with the logs.
        noise: Of a foot.
        score: Log-likelihood ratio of the observations against clutter alone.
        share: Per recording (V, N) float64, probability that each observation is of each vessel.
        standard: Per recording (V, N) float64, distance from the predicted foot in standard
            deviations; infinite where the log or the camera says nothing.
        predicted_px: Per recording (V, N, 2) float64.
        covariance: (9 + R, 9 + R) of camera and clocks.
    """

    vector: FloatArray
    offset_s: FloatArray
    noise: FootNoise
    score: float
    share: tuple[FloatArray, ...]
    standard: tuple[FloatArray, ...]
    predicted_px: tuple[FloatArray, ...]
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class _Predicted:
    """Predicted foot points of one recording by its logs; rows are (vessel, observation)."""

    vessel: IntArray
    row: IntArray
    pixel_px: FloatArray
    by_camera: FloatArray
    by_offset: FloatArray
    sigma_px: FloatArray


class Refiner:
    """Refines candidates on the same recordings by expectation-maximisation."""

    def __init__(
        self,
        watches: Sequence[RecordingObservations],
        image_size_px: tuple[int, int],
        *,
        largest_offset_s: float,
        prior: CameraPrior | None = None,
    ) -> None:
        self.watches = tuple(watches)
        self.image_size_px = image_size_px
        self.largest_offset_s = largest_offset_s
        mean, sigma = (prior or ROUGH_CAMERA).moments(image_size_px, 0, 0, position_known=True)
        self._mean = np.concatenate([mean[CAMERA], np.zeros(len(watches))])
        alone = len(watches) == 1
        held_s = max(largest_offset_s, 1e-3) if alone else min(CLOCKS_ALIKE_S, largest_offset_s)
        self._precision = np.concatenate(
            [sigma[CAMERA] ** -2.0, np.full(len(watches), max(held_s, 1e-3) ** -2.0)]
        )
        self._vessels = [list(range(len(watch.paths))) for watch in watches]
        self._clutter = [clutter_per_px2(watch.seen, image_size_px) for watch in watches]

    def refine(self, start: Candidate, noise: FootNoise | None = None) -> Explanation:
        """Refine a candidate to an explanation."""
        state = np.concatenate([start.vector, start.offset_s])
        if len(self.watches) > 1:
            self._mean[_CLOCKS] = start.offset_s
        self._choose(state)
        noise = noise or FootNoise()
        for widen in np.geomspace(_WIDEST, 1.0, _ROUNDS):
            for _ in range(2):
                state = self._step(state, noise, float(widen))
            if widen < 2.5:
                noise = self._noise(state, noise, float(widen))
        return self._alike(self.explain(state, noise))

    def at_another_clock(self, known: Explanation, apart_s: float) -> Candidate | None:
        """The camera of an explanation at the next best clock offset; None where there is none.

        Candidates differ in where they look, and each has but the clock with the most votes. A
        vessel that goes to and fro, or round and round, goes as its log says at more than one.

        Args:
            known: The explanation.
            apart_s: So far from its clock another one begins.
        """
        step_s = offset_step_s(self.watches)
        steps = int(2.0 * self.largest_offset_s / step_s) + 1
        moved_s = step_s * np.arange(-steps, steps + 1)
        score = np.zeros(moved_s.size)
        for i, moved in enumerate(moved_s):
            offset_s = known.offset_s + moved
            if (np.abs(offset_s) > self.largest_offset_s).any():
                continue
            state = np.concatenate([known.vector, offset_s])
            self._choose(state)
            for index in range(len(self.watches)):
                found = self._predict(state, index, known.noise)
                score[i] += self._shares(found, index, 1.0)[2]
        # The flanks of a clock that slow vessels leave wide are no clocks of their own.
        peak = (score[1:-1] >= score[:-2]) & (score[1:-1] >= score[2:]) & (score[1:-1] > 0.0)
        peak &= np.abs(moved_s[1:-1]) > apart_s
        if not peak.any():
            return None
        best = 1 + int(np.argmax(np.where(peak, score[1:-1], 0.0)))
        return Candidate(known.vector, known.offset_s + moved_s[best], float(score[best]))

    def _alike(self, found: Explanation) -> Explanation:
        """Retry outlying clock offsets at the median of the others; the likelier one stays.

        A recording that tells little of its clock may be drawn to something else that is seen,
        while the camera is still rough.
        """
        told = [i for i, share in enumerate(found.share) if (share > 0.5).sum() >= 3]
        if len(told) < 3:
            return found
        common_s = float(np.median(found.offset_s[told]))
        for index in told:
            if abs(found.offset_s[index] - common_s) < CLOCKS_ALIKE_S:
                continue
            state = np.concatenate([found.vector, found.offset_s])
            state[_clock(index)] = common_s
            for widen in np.geomspace(_AGAIN, 1.0, _ROUNDS):
                state = self._step(state, found.noise, float(widen))
            other = self.explain(state, found.noise)
            if self._likelihood(other) > self._likelihood(found):
                found = other
        return found

    def _likelihood(self, found: Explanation) -> float:
        """Log posterior of an explanation, up to a constant."""
        off = np.concatenate([found.vector, found.offset_s]) - self._mean
        off[HEADING] = 0.0
        return found.score - 0.5 * float(np.sum(self._precision * off**2))

    def explain(self, state: FloatArray, noise: FootNoise) -> Explanation:
        """The explanation for a camera and its clock offsets, (9 + R,)."""
        shares, standards, pixels = [], [], []
        score = 0.0
        information = np.diag(self._precision)
        for index, watch in enumerate(self.watches):
            found = self._predict(state, index, noise)
            share, standard, ratio = self._shares(found, index, 1.0)
            score += ratio
            size = (len(watch.paths), len(watch.seen))
            full, apart = np.zeros(size), np.full(size, np.inf)
            pixel = np.full((*size, 2), np.nan)
            full[found.vessel, found.row] = share
            apart[found.vessel, found.row] = standard
            pixel[found.vessel, found.row] = found.pixel_px
            shares.append(full)
            standards.append(apart)
            pixels.append(pixel)
            information += self._normal(found, index, share)[0]
        return Explanation(
            vector=state[CAMERA].copy(),
            offset_s=state[_CLOCKS].copy(),
            noise=noise,
            score=float(score),
            share=tuple(shares),
            standard=tuple(standards),
            predicted_px=tuple(pixels),
            covariance=np.asarray(np.linalg.pinv(information, hermitian=True), dtype=np.float64),
        )

    def _choose(self, state: FloatArray) -> None:
        """Restrict to vessels in the field of view of the camera, with a margin in heading."""
        half = np.arctan(0.5 * self.image_size_px[0] / np.exp(state[LOG_FOCAL])) + _MARGIN
        self._vessels = []
        for index, watch in enumerate(self.watches):
            times = watch.seen.time_utc_s
            at = np.linspace(times.min(), times.max(), 120) if times.size else times
            chosen = []
            for v, path in enumerate(watch.paths):
                place = path.at(at + state[_clock(index)]).east_north_m
                turn = np.arctan2(place[:, 0], place[:, 1]) - state[HEADING]
                turn = np.abs(np.arctan2(np.sin(turn), np.cos(turn)))
                # A log with gaps may tell of a moment that was not asked for.
                if (turn < half).any() or (len(watch.paths) == 1):
                    chosen.append(v)
            self._vessels.append(chosen)

    def _predict(self, state: FloatArray, index: int, noise: FootNoise) -> _Predicted:
        watch, vector = self.watches[index], state[CAMERA]
        times = watch.seen.time_utc_s + state[_clock(index)]
        sin_h, cos_h = np.sin(vector[HEADING]), np.cos(vector[HEADING])
        places, speeds, sigmas, vessels, rows = [], [], [], [], []
        for v in self._vessels[index]:
            at = watch.paths[v].at(times)
            offset = at.east_north_m - vector[POSITION]
            ahead = sin_h * offset[:, 0] + cos_h * offset[:, 1]
            side = cos_h * offset[:, 0] - sin_h * offset[:, 1]
            known = np.flatnonzero((ahead > 3.0) & (np.abs(side) < 2.5 * ahead))
            places.append(at.east_north_m[known])
            speeds.append(at.velocity_mps[known])
            sigmas.append(at.sigma_m[known])
            vessels.append(np.full(known.size, v))
            rows.append(known)
        place = np.concatenate([np.empty((0, 2)), *places])
        above = np.concatenate([np.empty(0), *(watch.above_m[known] for known in rows)])
        pixel, by_parameter, by_point = project_with_jacobian(
            vector, self.image_size_px, place[:, 0], place[:, 1], above
        )
        speed, untold = np.concatenate([np.empty((0, 2)), *speeds]), np.concatenate([[], *sigmas])
        height2 = np.exp(2.0 * vector[LOG_HEIGHT])
        slant2 = np.sum((place - vector[POSITION]) ** 2, axis=1) + height2
        per_metre = np.hypot(by_point[:, :, 0], by_point[:, :, 1])
        own = np.stack(
            [
                np.full(len(place), noise.column_px**2),
                noise.row_px**2 + noise.row_m**2 * np.exp(2.0 * vector[LOG_FOCAL]) / slant2,
            ],
            axis=1,
        )
        variance = own + (noise.place_m**2 + untold**2)[:, None] * per_metre**2
        # The lens model folds far outside the picture; nothing there is in view.
        width, _height = self.image_size_px
        camera = Camera.from_vector(vector, self.image_size_px)
        offset = place - vector[POSITION]
        bearing = np.arctan2(offset[:, 0], offset[:, 1]) - vector[HEADING]
        valid = (np.tan(bearing) ** 2 < min(camera.largest_radius, 3.0) ** 2) & (
            (pixel[:, 0] > -0.1 * width) & (pixel[:, 0] < 1.1 * width)
        )
        return _Predicted(
            vessel=np.concatenate([np.empty(0, dtype=np.int64), *vessels])[valid].astype(np.int64),
            row=np.concatenate([np.empty(0, dtype=np.int64), *rows])[valid].astype(np.int64),
            pixel_px=pixel[valid],
            by_camera=by_parameter[valid],
            by_offset=np.einsum("nij,nj->ni", by_point[valid, :, :2], speed[valid]),
            sigma_px=np.sqrt(variance[valid]),
        )

    def _shares(
        self, found: _Predicted, index: int, widen: float
    ) -> tuple[FloatArray, FloatArray, float]:
        """Association probabilities and Mahalanobis distances of pairs, and the log-likelihood."""
        seen = self.watches[index].seen
        sigma = found.sigma_px * widen
        standard = (seen.foot_px[found.row] - found.pixel_px) / sigma
        square = np.sum(standard**2, axis=1)
        density = np.exp(-0.5 * np.minimum(square, 200.0)) / (2.0 * np.pi * sigma.prod(axis=1))
        ratio = _SEEN_SHARE * density / self._clutter[index][found.row]
        total = np.bincount(found.row, ratio, minlength=len(seen))
        share = ratio / (1.0 + total[found.row])
        # Whatever is seen at a moment, a vessel is one of it.
        weight = min(seen.interval_s / CORRELATION_TIME_S, 1.0)
        ratio = weight * float(np.sum(np.log1p(total)))
        return share, np.sqrt(square), ratio

    def _normal(
        self, found: _Predicted, index: int, share: FloatArray, widen: float = 1.0
    ) -> tuple[FloatArray, FloatArray]:
        """The normal equations of one recording, over camera and all clocks."""
        seen = self.watches[index].seen
        size = len(PARAMETERS) + len(self.watches)
        sigma = found.sigma_px * widen
        rows = np.flatnonzero(share > 1e-3)
        jacobian = np.zeros((rows.size, 2, size))
        jacobian[:, :, CAMERA] = found.by_camera[rows]
        jacobian[:, :, _clock(index)] = found.by_offset[rows]
        jacobian /= sigma[rows][:, :, None]
        residual = (seen.foot_px[found.row[rows]] - found.pixel_px[rows]) / sigma[rows]
        weight = share[rows] * min(seen.interval_s / CORRELATION_TIME_S, 1.0)
        flat = (jacobian * weight[:, None, None]).reshape(-1, size)
        return flat.T @ jacobian.reshape(-1, size), flat.T @ residual.reshape(-1)

    def _step(self, state: FloatArray, noise: FootNoise, widen: float) -> FloatArray:
        matrix, right = np.diag(self._precision), self._precision * (self._mean - state)
        for index in range(len(self.watches)):
            found = self._predict(state, index, noise)
            share, _, _ = self._shares(found, index, widen)
            one, other = self._normal(found, index, share, widen)
            matrix, right = matrix + one, right + other
        move = np.linalg.lstsq(matrix, right, rcond=None)[0]
        limit = np.concatenate([_LONGEST_STEP, np.full(len(self.watches), 2.0)])
        out = state + np.clip(move, -limit, limit)
        out[K1] = max(out[K1], -0.5)
        out[_CLOCKS] = np.clip(out[_CLOCKS], -self.largest_offset_s, self.largest_offset_s)
        return np.asarray(out)

    def _noise(self, state: FloatArray, noise: FootNoise, widen: float) -> FootNoise:
        """Noise re-estimated from the residuals of the associated observations."""
        squares, weights, spreads = [], [], []
        for index, watch in enumerate(self.watches):
            found = self._predict(state, index, noise)
            share, _, _ = self._shares(found, index, widen)
            residual = watch.seen.foot_px[found.row] - found.pixel_px
            squares.append(residual / found.sigma_px)
            weights.append(share)
            spreads.append(found.sigma_px)
        weight = np.concatenate(weights)
        if weight.sum() < 5.0:
            return noise
        ratio = np.concatenate(squares)
        # Medians: a wake or a second boat beside must not widen the noise.
        scale = [_weighted_median(np.abs(ratio[:, axis]), weight) / 0.6745 for axis in (0, 1)]
        change = np.clip(scale, 0.7, 1.4)
        return FootNoise(
            column_px=float(np.clip(noise.column_px * change[0], 1.5, 12.0)),
            row_px=float(np.clip(noise.row_px * change[1], 1.0, 10.0)),
            place_m=float(np.clip(noise.place_m * change[0], 0.7, 6.0)),
            row_m=float(np.clip(noise.row_m * change[1], 0.1, 1.0)),
        )


def _clock(index: int) -> int:
    """Slot of a recording's clock offset in a state."""
    return len(PARAMETERS) + index


def _weighted_median(values: FloatArray, weight: FloatArray) -> float:
    order = np.argsort(values)
    mass = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(mass, 0.5 * mass[-1])])
