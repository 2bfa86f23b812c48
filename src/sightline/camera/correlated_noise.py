"""Correlated noise of a log, and of boxes of one moment: whitening and its likelihood.

A receiver that is two metres off is two metres off for half a minute. Boxes within seconds of each
other share this error: as independent ones they would seem to tell more than they do, and turn the
camera towards the log. It is a Gauss-Markov (Ornstein-Uhlenbeck) process in east and another in
north, anew in each recording and for each vessel. Its covariance is
``correlated_m² exp(-|Δt| / correlation_time_s)``, but smooth below a second, since fixes come a
second apart and are interpolated between. Residuals are whitened by what it and the boxes' own
noise make together (generalised least squares).

The heave of a camera that moves is correlated as well, over a second or so, and moves the rows of
all boxes. It is another such process, in metres of height, anew in each recording. Were it not told
apart it would be taken for an error of the log, and that is none of the boxes'.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import lapack

from sightline.camera.priors import PixelNoise
from sightline.types import BoolArray, FloatArray, IntArray

LONGEST_BLOCK_S = 60.0
"""Errors of moments that are further apart may count as independent."""

MOST_IN_BLOCK = 256
"""Boxes in a block; more in as short a time tell hardly more."""

# exp(-(sqrt(Δt² + s²) - s) / correlation_time_s) is positive definite: the exponent is a Bernstein
# function of Δt² (Schoenberg).
_SMOOTH_S = 1.0

# Of a gap: so long a vessel strays to one side. What pinned places and speeds at the ends leave of
# white acceleration is half alike at half a gap.
_STRAYS_SHARE = 0.42

# Degrees of freedom of the variance of a gap: the few that are usual for tails of which little is
# known. Set by hand, with one bay in sight, and not estimated.
_BOUT_FREEDOM = 4.0
# A gap in which a vessel went so much further astray tells nothing any more.
_MOST_STRAYING = 100.0

HEAVE_CORRELATION_TIME_S = 0.7
"""Correlation time of heave: by this a wave of five seconds is half gone after a fourth of it."""


@dataclass(frozen=True, eq=False)
class Block:
    """Point correspondences whose errors are correlated, n of each of several logs.

    Logs with as many correspondences are taken together: most matrices are so small that it is
    their number that costs.

    Attributes:
        rows: (B, n) int64, which correspondences, by their logs.
        apart_s: (B, n, n) float64, seconds between any two boxes of a log.
        fixes_s: (B, n, 2) float64, times of the fixes that each place is interpolated between.
        shares: (B, n, 2) float64, how much each of the two counts.
        gap_m2: (B, n, n) float64, square metres, covariance of the places along either axis that
            gaps of the log make, which is known; None where there are none.
    """

    rows: IntArray
    apart_s: FloatArray
    fixes_s: FloatArray
    shares: FloatArray
    gap_m2: FloatArray | None = None

    def with_gaps(self, share: FloatArray) -> Block:
        """The same with the variances of its places in gaps of the log (B, n) times as large."""
        if self.gap_m2 is None:
            return self
        root = np.sqrt(share)
        return replace(self, gap_m2=self.gap_m2 * root[:, :, None] * root[:, None, :])

    @cached_property
    def gap_rows(self) -> list[tuple[int, IntArray]]:
        """Gaps of the logs: which log, and the rows of the block that are in the gap."""
        out = []
        for log, begin_s in enumerate(self.fixes_s[:, :, 0]):
            _, of = np.unique(begin_s, return_inverse=True)
            out += [(log, np.flatnonzero(of == gap)) for gap in range(int(of.max()) + 1)]
        return out

    @cached_property
    def _fix_pairs(self) -> tuple[FloatArray, FloatArray]:
        """(B, n, m) weights of the fixes in each place, and (B, m, m) seconds between them."""
        each = [np.unique(fixes_s, return_inverse=True) for fixes_s in self.fixes_s]
        most = max(times.size for times, _ in each)
        weights, times = np.zeros((*self.rows.shape, most)), np.zeros((len(each), most))
        row = np.arange(self.rows.shape[1])
        for log, (own, at) in enumerate(each):
            times[log, : own.size] = own
            for side in (0, 1):
                where = (row, at.reshape(-1, 2)[:, side])
                np.add.at(weights[log], where, self.shares[log, :, side])
        return weights, np.abs(times[:, :, None] - times[:, None, :])

    def log_kernel(self, correlation_time_s: float) -> FloatArray:
        """(B, n, n) correlation of the log's error at the boxes: of what lies between fixes."""
        weights, apart = self._fix_pairs
        return np.asarray(weights @ np.exp(-apart / correlation_time_s) @ weights.mT)

    def log_kernel_slope(self, correlation_time_s: float) -> FloatArray:
        """(B, n, n) derivative of `log_kernel` by the logarithm of the correlation time."""
        weights, apart = self._fix_pairs
        scaled = apart / correlation_time_s
        return np.asarray(weights @ (np.exp(-scaled) * scaled) @ weights.mT)


def thinned(time_s: FloatArray, log: IntArray) -> IntArray:
    """Rows to learn from: logs that report faster than needed are thinned."""
    kept = [np.flatnonzero(~np.isfinite(time_s))]
    for one in np.unique(log[np.isfinite(time_s)]):
        rows = np.flatnonzero((log == one) & np.isfinite(time_s))
        rows = rows[np.argsort(time_s[rows], kind="stable")]
        blocks = max(1.0, np.ptp(time_s[rows]) / LONGEST_BLOCK_S)
        most = int(blocks * MOST_IN_BLOCK)
        if rows.size > most:
            rows = rows[np.linspace(0, rows.size - 1, most).round().astype(np.int64)]
        kept.append(rows)
    return np.sort(np.concatenate(kept))


def blocks_of(
    time_s: FloatArray,
    log: IntArray,
    sigma_m: FloatArray | None = None,
    gap_s: FloatArray | None = None,
) -> list[Block]:
    """Blocks of correlated errors: logs of a recording, long ones in parts; none without times.

    Args:
        time_s: (N,) seconds, NaN where not known.
        log: (N,) which log tells the place.
        sigma_m: (N,) standard deviations of the places by the gaps of the log. Absent: none.
        gap_s: (N, 2) the times at which each gap begins and ends.
    """
    alike: dict[tuple[int, bool], list[IntArray]] = {}
    for one in np.unique(log[np.isfinite(time_s)]):
        rows = np.flatnonzero((log == one) & np.isfinite(time_s))
        rows = rows[np.argsort(time_s[rows], kind="stable")]
        count = -(-rows.size // MOST_IN_BLOCK)
        for part in np.array_split(rows, count):
            gaps = sigma_m is not None and gap_s is not None and bool(sigma_m[part].any())
            alike.setdefault((part.size, gaps), []).append(part)
    out = []
    for (_, gaps), parts in alike.items():
        known = None
        if gaps and sigma_m is not None and gap_s is not None:
            known = np.stack([gap_covariance(time_s[p], sigma_m[p], gap_s[p]) for p in parts])
        between = zip(*(_between(time_s[part], gap_s, part) for part in parts), strict=True)
        lag = np.stack([_lag(time_s[part]) for part in parts])
        fixes_s, shares = (np.stack(column) for column in between)
        out.append(Block(np.stack(parts), lag, fixes_s, shares, known))
    return out


def _between(
    time_s: FloatArray, gap_s: FloatArray | None, part: IntArray
) -> tuple[FloatArray, FloatArray]:
    """(n, 2) times of the fixes around boxes, and (n, 2) the share of each in a place."""
    own = np.stack([time_s, time_s], axis=1)
    if gap_s is None:
        return own, np.full(own.shape, 0.5)
    fixes = gap_s[part]
    known = np.isfinite(fixes).all(axis=1) & (fixes[:, 1] > fixes[:, 0])
    fixes = np.where(known[:, None], fixes, own)
    span = np.where(known, fixes[:, 1] - fixes[:, 0], 1.0)
    late = np.where(known, np.clip((time_s - fixes[:, 0]) / span, 0.0, 1.0), 0.5)
    return fixes, np.stack([1.0 - late, late], axis=1)


def _lag(time_s: FloatArray) -> FloatArray:
    return np.asarray(np.abs(time_s[:, None] - time_s[None, :]))


def gap_covariance(time_s: FloatArray, sigma_m: FloatArray, gap_s: FloatArray) -> FloatArray:
    """(N, N) square metres, covariance of places along either axis that gaps of a log make.

    Within a gap a vessel strays from the expected path for a share of it: as alike as a Gaussian
    of that length says. Different gaps count as independent.

    Args:
        time_s: (N,) seconds.
        sigma_m: (N,) standard deviations.
        gap_s: (N, 2) the times at which each gap begins and ends; NaN where not known.
    """
    begin, end = gap_s.T
    length_s = _STRAYS_SHARE * np.maximum(end - begin, 1e-3)
    alike = begin[:, None] == begin[None, :]
    with np.errstate(invalid="ignore"):
        apart = (time_s[:, None] - time_s[None, :]) / length_s
        kernel = np.where(alike, np.exp(-0.5 * apart**2), 0.0)
    np.fill_diagonal(kernel, 1.0)
    return np.asarray(kernel * np.outer(sigma_m, sigma_m))


@dataclass(frozen=True, eq=False)
class CorrelatedError:
    """Correlated errors of log and box, projected on one coordinate at each of several places.

    Attributes:
        time_s: (N,) float64, seconds; NaN where it is not known, and errors are independent.
        log: (N,) int64, which log tells each place; errors of different ones are independent.
        noise: How large the errors are.
        direction: (N, 2) float64, by how much the coordinate changes with a metre east and north.
        by_pixel: (N, 2) float64, the same with a pixel of column and row.
        aboard: (N,) float64, the same with half a length of the target along its course.
        hull: (N,) float64, standard deviation of what the reach of hulls makes of it.
        by_heave: By how much it changes with a metre of the camera's height.
    """

    time_s: FloatArray
    log: IntArray
    noise: PixelNoise
    direction: FloatArray
    by_pixel: FloatArray
    aboard: FloatArray
    hull: FloatArray
    by_heave: float = 0.0

    def __getitem__(self, rows: IntArray | BoolArray) -> CorrelatedError:
        return replace(
            self,
            **{
                name: getattr(self, name)[rows]
                for name in ("time_s", "log", "direction", "by_pixel", "aboard", "hull")
            },
        )

    def covariance(self) -> FloatArray:
        """(N, N) covariance of the coordinate."""
        noise, apart = self.noise, _apart(self.time_s)
        alike = (self.log[:, None] == self.log[None, :]) & np.isfinite(apart)
        apart = np.where(alike, apart, 0.0)
        lasting = np.exp(-apart / noise.lasting_time_s)
        metres = noise.correlated_m**2 * np.exp(-apart / noise.correlation_time_s)
        metres += noise.offset_m**2 + noise.lasting_m**2 * lasting
        out = metres * (self.direction @ self.direction.T)
        pixels = self.by_pixel * (noise.lasting_column_px, noise.lasting_row_px)
        out += lasting * (pixels @ pixels.T)
        out += noise.antenna_share**2 * np.outer(self.aboard, self.aboard)
        out += np.outer(self.hull, self.hull)
        heave = noise.heave_m * self.by_heave
        out += heave**2 * np.exp(-apart / HEAVE_CORRELATION_TIME_S)
        return np.where(alike, out, 0.0)


def _apart(time_s: FloatArray) -> FloatArray:
    """(N, N) absolute time differences, seconds, smoothed about zero."""
    return np.asarray(np.hypot(time_s[:, None] - time_s[None, :], _SMOOTH_S) - _SMOOTH_S)


def _whole(block: Block, kernel: FloatArray) -> FloatArray:
    """(B, n, n) covariance of the places: the log's estimated error, and what its gaps make."""
    return kernel if block.gap_m2 is None else kernel + block.gap_m2


class Whitening:
    """Whitens the residuals of point correspondences: independent, of unit variance.

    Args:
        blocks: Of `blocks_of`.
        variance_px2: (N, 2) square pixels, of columns and rows, without what is correlated.
        by_place: (N, 2, 2) pixels a metre, derivatives of columns and rows by east and north.
        noise: What is correlated.
        by_height: (N, 2) pixels a metre, derivatives of columns and rows by the camera's height.
        half_lengths_m: (N, 2) half of each target's length in the direction of its course; zero
            where that is not known.
    """

    def __init__(
        self,
        blocks: list[Block],
        variance_px2: FloatArray,
        by_place: FloatArray,
        noise: PixelNoise,
        by_height: FloatArray | None = None,
        half_lengths_m: FloatArray | None = None,
    ) -> None:
        self._blocks = blocks
        self._sigma = np.sqrt(variance_px2)
        self._by_place = by_place
        self._by_height = by_height if noise.heave_m > 0.0 else None
        self._noise = noise
        self._half_lengths_m = half_lengths_m
        self._by_antenna = (
            np.zeros(by_place.shape[:2])
            if half_lengths_m is None
            else np.einsum("nij,nj->ni", by_place, half_lengths_m)
        )
        self.variance_px2 = variance_px2
        # Of a correspondence without a time no error is correlated.
        self._alone = np.ones(len(variance_px2), dtype=bool)
        for block in blocks:
            self._alone[block.rows] = False
        self.factors: list[FloatArray] = []
        self.kernels = []
        for block in blocks:
            kernel = noise.correlated_m**2 * block.log_kernel(noise.correlation_time_s)
            self.kernels.append(kernel)
            lasting = self._lasting_kernel(block)
            whole = _whole(block, kernel + noise.offset_m**2 + noise.lasting_m**2 * lasting)
            logs, n = block.rows.shape
            covariance = self.turned(block)
            apart = covariance.reshape(logs, n, 2, n, 2)
            apart *= whole[:, :, None, :, None]
            apart[:, :, 0, :, 0] += noise.lasting_column_px**2 * lasting
            apart[:, :, 1, :, 1] += noise.lasting_row_px**2 * lasting
            covariance += noise.antenna_share**2 * self._aboard(block)
            if self._by_height is not None:
                lifted = self._lifted(block).reshape(apart.shape)
                apart += self._heave_kernel(block)[:, :, None, :, None] * lifted
            diagonal = np.arange(2 * n)
            covariance[:, diagonal, diagonal] += variance_px2[block.rows].reshape(logs, -1)
            self.factors.append(np.asarray(np.linalg.cholesky(covariance), dtype=np.float64))

    def _lasting_kernel(self, block: Block) -> FloatArray:
        return np.asarray(np.exp(-block.apart_s / self._noise.lasting_time_s))

    def _aboard(self, block: Block) -> FloatArray:
        """(B, 2 n, 2 n) covariance of the pixels for receivers half a length off the middle."""
        return _squared(self._by_antenna[block.rows])

    def turned(self, block: Block) -> FloatArray:
        """(B, 2 n, 2 n) covariance of the pixels for a shared place error of unit variance."""
        logs, n = block.rows.shape
        flat = self._by_place[block.rows].reshape(logs, 2 * n, 2)
        return np.asarray(flat @ flat.mT)

    def _lifted(self, block: Block) -> FloatArray:
        """(B, 2 n, 2 n) as `turned`, for a shared heave of unit variance."""
        assert self._by_height is not None, "the caller has looked"
        return _squared(self._by_height[block.rows])

    def _heave_kernel(self, block: Block) -> FloatArray:
        return np.asarray(
            self._noise.heave_m**2 * np.exp(-block.apart_s / HEAVE_CORRELATION_TIME_S)
        )

    def forward(self, values: FloatArray) -> FloatArray:
        """Whiten (N, 2, K) pixels."""
        return self._solved(values, transposed=False)

    def backward(self, whitened: FloatArray) -> FloatArray:
        """Inverse covariance times pixels, from whitened values (N, 2, K)."""
        return self._solved(whitened, transposed=True)

    def _solved(self, values: FloatArray, *, transposed: bool) -> FloatArray:
        """(N, 2, K) inverse Cholesky factors times values, or the transposes of these."""
        out = np.asarray(values / self._sigma[:, :, None])
        for block, factors in zip(self._blocks, self.factors, strict=True):
            logs, n = block.rows.shape
            own = values[block.rows].reshape(logs, 2 * n, -1)
            columns = _used(own)
            part = np.take_along_axis(own, columns, axis=2)
            for factor, column in zip(factors, part, strict=True):
                # LAPACK takes matrices by columns: the transpose of the factor as it lies there.
                column[:], _ = lapack.dtrtrs(
                    factor.T, column, lower=0, trans=0 if transposed else 1
                )
            np.put_along_axis(own, columns, part, axis=2)
            out[block.rows] = own.reshape(logs, n, 2, -1)
        return out

    def correlated_error(self, weights: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Most probable errors of the log, metres, of `backward`'s (N, 2) residuals.

        Returns:
            (N, 2) what drifts, (N, 2) what is constant in a log, and (N, 2) what lasts in a box.
        """
        pulled = np.einsum("nij,ni->nj", self._by_place, weights)
        drift, offset, body = (np.zeros_like(pulled) for _ in range(3))
        for block, kernel in zip(self._blocks, self.kernels, strict=True):
            own = pulled[block.rows]
            drift[block.rows] = _whole(block, kernel) @ own
            body[block.rows] = self._noise.lasting_m**2 * (self._lasting_kernel(block) @ own)
            offset[block.rows] = self._noise.offset_m**2 * own.sum(axis=1, keepdims=True)
            if self._half_lengths_m is not None:
                ahead = np.sum(self._by_antenna[block.rows] * weights[block.rows], axis=(1, 2))
                ahead *= self._noise.antenna_share**2
                offset[block.rows] += ahead[:, None, None] * self._half_lengths_m[block.rows]
        return drift, offset, body

    def strays(self, weights: FloatArray, share: FloatArray) -> FloatArray:
        """(N,) likelier variances in gaps of the log, as shares of what motion models say.

        Vessels turn in bouts, so that what a motion model leaves in a gap has the tails of
        Student's t: its variance is a random effect, of `_BOUT_FREEDOM` degrees of freedom, and all
        places in a gap share it (expectation and maximisation; Lange, Little and Taylor 1989,
        "Robust statistical modeling using the t distribution").

        Args:
            weights: (N, 2) of `backward`, inverse covariance times residuals.
            share: (N,) variances as shares, under which they were made.
        """
        pulled = np.einsum("nij,ni->nj", self._by_place, weights)
        out = share.copy()
        for block, factors in zip(self._blocks, self.factors, strict=True):
            if block.gap_m2 is None:
                continue
            inverse = _inverses(factors)
            for log, part in block.gap_rows:
                rows, kernel = block.rows[log, part], block.gap_m2[log][np.ix_(part, part)]
                by_place, flat = self._by_place[rows], (2 * part[:, None] + [0, 1]).ravel()
                own = inverse[log][np.ix_(flat, flat)].reshape(part.size, 2, part.size, 2)
                told = np.einsum(
                    "nij,nimk,mkj,nm->", by_place, own, by_place, kernel, optimize=True
                )
                found = np.einsum("ni,nm,mi->", pulled[rows], kernel, pulled[rows])
                more = _BOUT_FREEDOM + share[rows] * max(float(found), 0.0)
                more /= _BOUT_FREEDOM + max(float(told), 0.0)
                out[rows] = np.minimum(more, _MOST_STRAYING)
        return out

    def log_determinant(self) -> float:
        """Half the logarithm of the determinant of the covariance."""
        value = float(np.log(self._sigma[self._alone]).sum())
        diagonals = (np.diagonal(factors, axis1=1, axis2=2) for factors in self.factors)
        return value + sum(float(np.log(diagonal).sum()) for diagonal in diagonals)

    def gradient(
        self, weights: FloatArray, solved: FloatArray, covariance: FloatArray
    ) -> tuple[FloatArray, dict[str, float]]:
        """Gradient of the negative log-likelihood by the white and the correlated noise.

        Args:
            weights: (N, 2) inverse covariance times the residuals that the parameters leave.
            solved: (N, 2, P) inverse covariance times the derivatives by the parameters.
            covariance: (P, P) of the parameters.

        Returns:
            (N, 2) by each variance; by the logarithms of the parts of the noise that are correlated
            and of their times, by their names.
        """
        noise = self._noise
        by_variance = 1.0 / self.variance_px2 - weights**2
        alone = solved[self._alone]
        by_variance[self._alone] -= np.sum((alone @ covariance) * alone, axis=2)
        out = dict.fromkeys(
            (
                "correlated_m",
                "correlation_time_s",
                "heave_m",
                "offset_m",
                "antenna_share",
                "lasting_row_px",
                "lasting_column_px",
                "lasting_m",
                "lasting_time_s",
            ),
            0.0,
        )
        for block, kernel, factors in zip(self._blocks, self.kernels, self.factors, strict=True):
            logs, n = block.rows.shape
            part = solved[block.rows].reshape(logs, 2 * n, -1)
            own = weights[block.rows].reshape(logs, 2 * n, 1)
            inner = _inverses(factors)
            inner -= _explained(part, covariance)
            inner -= own @ own.mT
            four = inner.reshape(logs, n, 2, n, 2)
            diagonal = np.diagonal(inner, axis1=1, axis2=2)
            by_variance[block.rows] = diagonal.reshape(logs, n, 2)
            if self._by_height is not None:
                lifted = self._lifted(block).reshape(four.shape)
                heave = np.einsum("bimjk,bimjk->bij", four, lifted)
                out["heave_m"] += float(np.vdot(heave, self._heave_kernel(block)))
            lasting = self._lasting_kernel(block)
            slope = lasting * (block.apart_s / noise.lasting_time_s)
            column, row = four[:, :, 0, :, 0], four[:, :, 1, :, 1]
            columns, rows = noise.lasting_column_px**2, noise.lasting_row_px**2
            out["lasting_column_px"] += columns * float(np.vdot(column, lasting))
            out["lasting_row_px"] += rows * float(np.vdot(row, lasting))
            out["lasting_time_s"] += 0.5 * float(np.vdot(columns * column + rows * row, slope))
            turned = self.turned(block).reshape(four.shape)
            together = np.einsum("bimjk,bimjk->bij", four, turned)
            out["correlated_m"] += float(np.vdot(together, kernel))
            out["correlation_time_s"] += (
                0.5
                * noise.correlated_m**2
                * float(np.vdot(together, block.log_kernel_slope(noise.correlation_time_s)))
            )
            aboard = float(np.vdot(inner, self._aboard(block)))
            out["antenna_share"] += noise.antenna_share**2 * aboard
            body = noise.lasting_m**2
            out["lasting_m"] += body * float(np.vdot(together, lasting))
            out["lasting_time_s"] += 0.5 * body * float(np.vdot(together, slope))
            out["offset_m"] += noise.offset_m**2 * float(together.sum())
        return 0.5 * by_variance, out


def _squared(by_coordinate: FloatArray) -> FloatArray:
    """(B, 2 n, 2 n) outer products of derivatives (B, n, 2) with themselves."""
    flat = by_coordinate.reshape(len(by_coordinate), -1)
    return np.asarray(flat[:, :, None] * flat[:, None, :])


def _used(values: FloatArray) -> IntArray:
    """(B, 1, U) columns of values (B, m, K) that are not all zero, and some more.

    Clocks are parameters of one recording each, so that a log has few of all.
    """
    used = values.any(axis=1)
    columns = np.argsort(~used, axis=1, kind="stable")[:, : int(used.sum(axis=1).max(initial=0))]
    return np.asarray(columns[:, None, :])


def _explained(by_parameter: FloatArray, covariance: FloatArray) -> FloatArray:
    """(B, m, m) covariances that parameters make, by derivatives (B, m, P) by them."""
    columns = _used(by_parameter)
    part = np.take_along_axis(by_parameter, columns, axis=2)
    return np.asarray(part @ covariance[columns.mT, columns] @ part.mT)


def _inverses(factors: FloatArray) -> FloatArray:
    """(B, m, m) inverses of the matrices whose Cholesky factors are given."""
    out = np.empty_like(factors)
    for factor, inverse in zip(factors, out, strict=True):
        inverse[:], _ = lapack.dpotri(factor.T, lower=False)
    # Only the upper triangles are there.
    out += np.triu(out, 1).mT
    return out
