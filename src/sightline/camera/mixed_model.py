"""The mixed model of a camera fit: residuals, their Jacobian and the maxima of its posterior.

What is estimated of the camera, the hull and the sources of boxes is the same for all boxes (fixed
effects); what a target, its log and its boxes have of their own is Gaussian with a covariance that
is estimated (random effects; Lindstrom and Bates 1990, "Nonlinear mixed effects models for repeated
measures data"). The expansion is made at the most probable place of each target as far as its log
is wrong, and at the logged one as far as its boxes are: a fit that charged errors of the log to the
pixels would find a camera in which metres look too small, and one that charged errors of the boxes
to the log, one in which they look too large (errors in variables; Carroll et al. 2006, "Measurement
Error in Nonlinear Models").
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.optimize import least_squares
from scipy.stats import norm

from sightline.camera.correlated_noise import Block, Whitening, blocks_of
from sightline.camera.observations import NO_SOURCE, UNDER_WAY_MPS, PointCorrespondences
from sightline.camera.parameters import (
    BIAS_M,
    BIAS_PX,
    CAMERA,
    EAST,
    HEADING,
    LOG_FOCAL,
    LOG_HEIGHT,
    NORTH,
    PITCH,
    POSITION,
    PRINCIPAL_DX,
    SOURCE_PARAMETERS,
    TARGET,
    ParameterLayout,
)
from sightline.camera.pinhole import Camera, project_with_jacobian
from sightline.camera.priors import ANY_ASPECT, CameraPrior, PixelNoise, SourcePrior
from sightline.camera.restricted_likelihood import (
    RestrictedLikelihood,
    most_probable_noise,
    negative_log_evidence,
)
from sightline.camera.target_sizes import BEAM_SHARE, TargetSizes
from sightline.types import BoolArray, FloatArray, IntArray

_HUBER = 2.0
# Of a standard deviation: a step so small ends the search.
_ENOUGH = 0.01
_MOST_STEPS = 30
# Parameters and noise are estimated in turn so many times.
_ROUNDS = 6
# Targets are left out in so many parts.
_FOLDS = 6
_NO_WEIGHT = 1e-9
# A receiver stands somewhere on its boat: metres, or a share of half its length.
_MIDDLE_SIGMA_M, _MIDDLE_SHARE = 1.0, 0.4
# By what share of itself a length that is read off boxes may be wrong: off tight boxes of rendered
# hulls it comes out 4 to 11 % too short, and people leave margins.
_SIZE_SHARE = 0.25
# A length that is stated is that of the deck, and a box ends at the water.
_STATED_SIZE_SHARE = 0.05


@dataclass(frozen=True, eq=False)
class LocalMaximum:
    """A local maximum of the posterior density.

    Attributes:
        vector: Parameters, with how far the middle of a box lies ahead of the receiver.
        shift_m: (N, 2) how far the places at which derivatives are taken lie from the log's.
        weight: (N, 2) how much each column and row counts, 0 to 1.
        standard: (N, 2) residuals without correlated error, over their standard deviations.
        blocks: Of correlated errors, those of gaps as large as they were found to be.
    """

    vector: FloatArray
    shift_m: FloatArray
    weight: FloatArray
    standard: FloatArray
    blocks: list[Block]


@dataclass(frozen=True, eq=False)
class Hulls:
    """Sizes of the targets of N boxes, as the widths of their boxes tell them.

    Attributes:
        relative_size: (N,) float64, of each box's target over that of a typical one.
        half_lengths_m: (N, 2) float64, half of its length along its course; zero where that is not
            known.
        sizes: Distribution of the sizes; None where no widths tell them.
    """

    relative_size: FloatArray
    half_lengths_m: FloatArray
    sizes: TargetSizes | None = None

    @property
    def middle_sigma_m(self) -> float:
        """Standard deviation of how far a typical target's receiver is ahead of its middle."""
        return _MIDDLE_SIGMA_M if self.sizes is None else _MIDDLE_SHARE * self.sizes.half_length_m


class MixedModel:
    """Residuals and Jacobian of one maximum a posteriori fit.

    Vectors are those of `CameraFit`, or these followed by what is known of the places: how far
    the middle of a box lies ahead of the receiver, and the values of the logs' correlated error.
    """

    def __init__(
        self,
        sightings: PointCorrespondences,
        image_size_px: tuple[int, int],
        n_sources: int,
        prior: CameraPrior,
        position_known: bool,
        beliefs: Mapping[int, SourcePrior] | None,
        heaving: bool = False,
    ) -> None:
        self.sightings = sightings
        self.image_size_px = image_size_px
        self.n_sources = n_sources
        # Whether what lasts a second or two in metres is the log's error, not the box's.
        self.of_log = False
        # Of the targets that were left out to choose between the two.
        self.left_out_m = 0.0
        # Its negative logarithm, once noise was estimated.
        self.evidence = float("nan")
        self.hull = Hulls(np.ones(len(sightings)), np.zeros((len(sightings), 2)))
        self.prior = prior
        self.position_known = position_known
        moving = np.abs(sightings.velocity_mps).sum(axis=1) > 0.0
        self.clock_groups = np.unique(sightings.group[moving])
        self.layout = ParameterLayout(n_sources, self.clock_groups.size)
        self.clock = np.searchsorted(self.clock_groups, sightings.group)
        self.moving = np.flatnonzero(moving)
        self.mean, self.sigma = prior.moments(
            image_size_px, n_sources, self.clock_groups.size, position_known=position_known
        )
        for source, belief in (beliefs or {}).items():
            at = self.layout.source(source)
            own = np.array([belief.bias_px, belief.bias_m])
            self.mean[at], self.sigma[at] = own.T
        self.held = np.isfinite(self.sigma)
        self.size = self.layout.size
        self.timed = np.isfinite(sightings.time_s)
        self.boxes = sightings.source != NO_SOURCE
        # What gaps of the logs make of the places of boxes is known, and none of the noise.
        self.gap_sigma_m = np.where(self.boxes, sightings.sigma_m, 0.0)
        self.blocks = blocks_of(sightings.time_s, sightings.log, self.gap_sigma_m, sightings.gap_s)
        # Without times heave is as any other noise of the rows.
        self.heaving = heaving and bool(self.blocks)
        speed = np.hypot(*sightings.velocity_mps.T)
        steered = (sightings.source != NO_SOURCE) & (speed > UNDER_WAY_MPS)
        self.bow = np.where(
            steered[:, None], sightings.velocity_mps / np.maximum(speed, 1e-9)[:, None], 0.0
        )
        # Where the place is that of the middle, no receiver lies ahead of it or astern.
        self.aboard = np.where(sightings.at_middle[:, None], 0.0, self.bow)
        self.sized = np.isfinite(sightings.hull_m) & self.boxes[:, None]
        self.stated_half_m = np.where(self.sized, 0.5 * sightings.hull_m, 0.0)
        self.centre = np.array([np.mean(sightings.east_m), np.mean(sightings.north_m)])
        self.spread = float(
            np.hypot(
                np.std(sightings.east_m - self.centre[0]),
                np.std(sightings.north_m - self.centre[1]),
            )
        )
        self.scale = np.where(self.held, self.sigma, 1.0)
        self.scale[HEADING] = 0.3
        if not position_known:
            self.scale[POSITION] = self.spread

    def expect_clocks(self, clocks: Mapping[int, tuple[float, float]]) -> None:
        """Set the prior of the clock offsets of some recordings."""
        for slot, group in enumerate(self.clock_groups.tolist(), self.layout.clocks.start):
            if group in clocks:
                self.mean[slot], self.sigma[slot] = clocks[group]
                self.scale[slot] = self.sigma[slot]

    def starts(self, count: int, rng: np.random.Generator) -> list[FloatArray]:
        """Initial cameras: the prior mean, then draws from the prior, all facing the targets."""
        out = []
        for i in range(count):
            vector = self.mean.copy()
            # The places are those at the clocks that the fit begins with.
            vector[self.layout.clocks] = 0.0
            if i or not self.position_known:
                # What is known well is no matter of chance.
                vector[LOG_HEIGHT] += rng.normal(0.0, min(0.8, self.sigma[LOG_HEIGHT]))
                vector[PITCH] += rng.normal(0.0, min(np.radians(8.0), self.sigma[PITCH]))
                vector[LOG_FOCAL] += rng.normal(0.0, min(0.6, 2.0 * self.sigma[LOG_FOCAL]))
            if not self.position_known:
                angle = 2.0 * np.pi * (i + rng.uniform()) / count
                distance = self.spread * np.exp(rng.uniform(0.0, 1.6))
                vector[EAST] = self.centre[0] + distance * np.sin(angle)
                vector[NORTH] = self.centre[1] + distance * np.cos(angle)
            bearing = np.arctan2(
                self.sightings.east_m - vector[EAST], self.sightings.north_m - vector[NORTH]
            )
            middle_px = 0.5 * self.image_size_px[0] + vector[PRINCIPAL_DX]
            from_middle = self.sightings.pixel_px[:, 0] - middle_px
            across = np.arctan(from_middle / np.exp(vector[LOG_FOCAL]))
            turn = bearing - across
            seen = np.arctan2(np.sin(turn).mean(), np.cos(turn).mean())
            # Of the full turns that are one heading, that by the prior's.
            off = seen - self.mean[HEADING]
            vector[HEADING] = self.mean[HEADING] + np.arctan2(np.sin(off), np.cos(off))
            out.append(vector)
        return out

    def aspect(self, vector: FloatArray) -> FloatArray:
        """(N, 2) shares of a typical half length and half beam along the line of sight.

        None of those that are stated.
        """
        out = self.directions(vector) * self.hull.relative_size[:, None]
        return np.where(self.sized, 0.0, out)

    def reach_m(self, vector: FloatArray, aspect: FloatArray) -> FloatArray:
        """(N,) how far the hulls reach towards the camera, metres."""
        out: FloatArray = aspect @ vector[TARGET]
        if self.sized.any():
            out = out + np.sum(self.directions(vector) * self.stated_half_m, axis=1)
        return out

    def directions(self, vector: FloatArray) -> FloatArray:
        """(N, 2) shares of its own half length and half beam along the line of sight."""
        s = self.sightings
        east, north = s.east_m - vector[EAST], s.north_m - vector[NORTH]
        speed = np.hypot(*s.velocity_mps.T)
        size = np.maximum(speed * np.hypot(east, north), 1e-9)
        cosine = (s.velocity_mps[:, 0] * east + s.velocity_mps[:, 1] * north) / size
        out: FloatArray = np.stack([np.abs(cosine), np.sqrt(np.maximum(1.0 - cosine**2, 0.0))], 1)
        out[speed < UNDER_WAY_MPS] = ANY_ASPECT
        out[~self.boxes] = 0.0
        return out

    def expect_hull(self, vector: FloatArray) -> None:
        """Set the prior of the hull's dimensions from what is stated, else the boxes' widths."""
        s = self.sightings
        rows = np.flatnonzero(np.isfinite(s.width_px) | self.sized[:, 0])
        if rows.size < 3:
            return
        aspect = self.directions(vector)[rows]
        seen = 2.0 * (aspect[:, 1] + BEAM_SHARE * aspect[:, 0])
        each = s.width_px[rows] / self.pixels_per_metre(vector)[rows] / seen
        stated = self.sized[rows, 0]
        logs, of = np.unique(s.log[rows], return_inverse=True)
        wider = self._wider(each, rows, of)
        each = each / wider
        each[stated] = self.stated_half_m[rows[stated], 0]
        half = np.array([np.median(each[of == one]) for one in range(logs.size)])
        sizes = TargetSizes.of(half, wider)
        typical = sizes.half_length_m
        relative = np.ones(len(s))
        relative[rows] = (half / typical)[of]
        self.hull = Hulls(relative, typical * relative[:, None] * self.aboard, sizes)
        beams = self.stated_half_m[self.sized[:, 1], 1]
        beam = float(np.median(beams)) if beams.size else BEAM_SHARE * typical
        self.mean[TARGET] = typical, beam
        share = np.maximum(_SIZE_SHARE * (1.0 - self.sized[rows].mean(axis=0)), _STATED_SIZE_SHARE)
        self.sigma[TARGET] = share * self.mean[TARGET]

    def _wider(self, half_m: FloatArray, rows: IntArray, of: IntArray) -> float:
        """How many times wider boxes are than hulls: 1, but for what stated sizes tell.

        Half lengths (K,) are those that the widths of boxes make, of some rows and their logs.
        """
        known = self.sized[rows, 0] & np.isfinite(half_m)
        if not known.any():
            return 1.0
        ratio = np.log(half_m[known] / self.stated_half_m[rows[known], 0])
        logs = np.unique(of[known])
        each = [np.median(ratio[of[known] == one]) for one in logs]
        # That boxes are as wide as hulls counts as much as one target.
        return float(np.exp(np.median(each) * logs.size / (1.0 + logs.size)))

    def project(
        self, vector: FloatArray, aspect: FloatArray, shift_m: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Expected pixels (N, 2), with Jacobians by the parameters and by the place.

        The place may be moved by a shift, (N, 2) metres.
        """
        s = self.sightings
        bias = vector[self.layout.sources].reshape(-1, len(SOURCE_PARAMETERS))
        source = np.where(self.boxes, s.source, 0)
        above = s.above_m
        if self.n_sources:
            above = above + np.where(self.boxes, bias[source, BIAS_M], 0.0)
        east, north = self.place(vector)
        if shift_m is not None:
            east, north = east + shift_m[:, 0], north + shift_m[:, 1]
        # The foot of a box lies on the near side of the target.
        east_off, north_off = east - vector[EAST], north - vector[NORTH]
        distance = np.hypot(east_off, north_off)
        sine, cosine = east_off / distance, north_off / distance
        hull = self.reach_m(vector, aspect)
        pixel, by_parameter, by_foot = project_with_jacobian(
            vector[CAMERA], self.image_size_px, east - hull * sine, north - hull * cosine, above
        )
        by_point = by_foot.copy()
        across = by_foot[:, :, 0] * cosine[:, None] - by_foot[:, :, 1] * sine[:, None]
        across *= (hull / distance)[:, None]
        by_point[:, :, 0] -= across * cosine[:, None]
        by_point[:, :, 1] += across * sine[:, None]
        jacobian = np.zeros((len(s), 2, vector.size))
        if vector.size > self.size:
            jacobian[:, :, self.layout.middle] = np.einsum(
                "nij,nj->ni", by_point[:, :, :2], self.aboard * self.hull.relative_size[:, None]
            )
        jacobian[:, :, CAMERA] = by_parameter
        jacobian[:, :, POSITION] = -by_point[:, :, :2]
        inwards = by_foot[:, :, 0] * sine[:, None] + by_foot[:, :, 1] * cosine[:, None]
        jacobian[:, :, TARGET] = -inwards[:, :, None] * aspect[:, None, :]
        rows = np.flatnonzero(self.boxes)
        if self.n_sources:
            pixel[rows, 1] += bias[source[rows], BIAS_PX]
            jacobian[rows, 1, self.layout.bias_px(source[rows])] = 1.0
            at = self.layout.bias_m(source[rows])
            jacobian[rows[:, None], [[0, 1]], at[:, None]] = by_point[rows, :, 2]
        rows = self.moving
        jacobian[rows, :, self.layout.clock(self.clock[rows])] = np.einsum(
            "nij,nj->ni", by_point[rows, :, :2], s.velocity_mps[rows]
        )
        return pixel, jacobian, by_point

    def place(self, vector: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Target positions, east and north (N,), corrected for the offsets of clock and box."""
        s = self.sightings
        place = np.stack([s.east_m, s.north_m])
        if self.moving.size:
            offset = np.zeros(len(s))
            offset[self.moving] = vector[self.layout.clock(self.clock[self.moving])]
            place += offset * s.velocity_mps.T
        if vector.size > self.size:
            place += vector[self.layout.middle] * self.hull.relative_size * self.aboard.T
        return place[0], place[1]

    def pixels_per_metre(self, vector: FloatArray) -> FloatArray:
        """(N,) image scale at the box, pixels per metre; zero for control points."""
        s = self.sightings
        slant = np.hypot(
            np.hypot(s.east_m - vector[EAST], s.north_m - vector[NORTH]),
            np.exp(vector[LOG_HEIGHT]) - s.above_m,
        )
        return np.where(self.boxes, np.exp(vector[LOG_FOCAL]) / slant, 0.0)

    def pixel_variance(self, vector: FloatArray, noise: PixelNoise) -> FloatArray:
        """(N, 2) pixel variances of column and row without the place's, square pixels.

        A control point has the pixel part of a box's noise.
        """
        own = replace(noise, heave_m=0.0) if self.heaving else noise
        return np.stack(own.variances_px2(self.pixels_per_metre(vector) ** 2), axis=1)

    def place_sigma(self, noise: PixelNoise) -> FloatArray:
        """(N,) standard deviations of the places, metres; a control point has its own."""
        return np.where(self.boxes, noise.place_m, self.sightings.sigma_m)

    def sigmas(self, vector: FloatArray, noise: PixelNoise, *, gaps: bool = True) -> FloatArray:
        """(N, 2) standard deviations of column and row, pixels, without correlated noise.

        What gaps of the logs make counts, as of each box alone, but for where it is not asked.
        """
        by_place = self.project(vector, self.aspect(vector))[2][:, :, :2]
        place_m2 = self.place_sigma(noise) ** 2 + (self.gap_sigma_m**2 if gaps else 0.0)
        place = place_m2[:, None] * np.sum(by_place**2, axis=2)
        return np.asarray(np.sqrt(self.pixel_variance(vector, noise) + place))

    def beliefs(self, size: int) -> tuple[FloatArray, FloatArray]:
        """Prior mean of a vector of a size, and the matrix that whitens its deviations."""
        held = np.flatnonzero(self.held)
        out = np.zeros((held.size + size - self.size, size))
        out[np.arange(held.size), held] = 1.0 / self.sigma[held]
        if size > self.size:
            out[held.size, self.layout.middle] = 1.0 / self.hull.middle_sigma_m
        return np.concatenate([self.mean, np.zeros(size - self.size)]), out

    def refine(
        self, start: FloatArray, noise: PixelNoise, left_out: BoolArray | None = None
    ) -> LocalMaximum | None:
        """The nearest maximum of the posterior under all noise, that of the logs included.

        Gauss-Newton steps on whitened residuals. The correlated error, like that of single places,
        is not left in the residual: derivatives are those at the likeliest places, since a fit that
        charged all of it to the pixels would find a camera in which metres look too small (errors
        in variables). Outlying boxes are down-weighted (Huber).

        Returns:
            None where it ends behind the targets, or nowhere.
        """
        vector, aspect = start.copy(), self.aspect(start)
        mean, beliefs = self.beliefs(vector.size)
        precision = beliefs.T @ beliefs
        place_variance = (self.place_sigma(noise) ** 2)[:, None]
        shift = np.zeros((len(self.sightings), 2))
        absent = np.zeros(len(self.sightings), dtype=bool) if left_out is None else left_out
        weight = np.where(absent[:, None], _NO_WEIGHT, np.ones((len(self.sightings), 2)))
        blocks, gaps = self.blocks, np.ones(len(self.sightings))
        for _ in range(_MOST_STEPS):
            pixel, jacobian, by_point = self.project(vector, aspect, shift)
            if not (np.isfinite(pixel).all() and np.isfinite(jacobian).all()):
                return None
            by_place = by_point[:, :, :2]
            residual = self.sightings.pixel_px - pixel + np.einsum("nij,nj->ni", by_place, shift)
            variance = self.pixel_variance(vector, noise)
            variance += place_variance * np.sum(by_place**2, axis=2)
            whitening = Whitening(
                blocks,
                variance / weight,
                by_place,
                noise,
                by_point[:, :, 2],
                self.hull.half_lengths_m,
            )
            both = whitening.forward(np.concatenate([jacobian, residual[:, :, None]], axis=2))
            flat = both.reshape(-1, vector.size + 1)
            normal = flat[:, :-1].T @ flat[:, :-1] + precision
            slope = flat[:, :-1].T @ flat[:, -1] - precision @ (vector - mean)
            try:
                factor = cho_factor(normal, lower=True, check_finite=False)
            except LinAlgError:
                return None
            step = cho_solve(factor, slope, check_finite=False)
            covariance = cho_solve(factor, np.eye(vector.size), check_finite=False)
            step /= max(1.0, np.abs(step / self.reach(vector.size)).max())
            left = both[:, :, -1:] - both[:, :, :-1] @ step[:, None]
            pull = whitening.backward(left)[:, :, 0]
            drift, offset, body = whitening.correlated_error(pull)
            shift = offset + drift
            if self.of_log:
                shift += body + place_variance * np.einsum("nij,ni->nj", by_place, pull)
            standard = pull * np.sqrt(variance) / weight
            weight = np.minimum(1.0, _HUBER / np.maximum(np.abs(standard), 1e-9))
            weight[absent] = _NO_WEIGHT
            if self.gap_sigma_m.any():
                gaps = whitening.strays(pull, gaps)
                blocks = [block.with_gaps(gaps[block.rows]) for block in self.blocks]
            vector = vector + step
            if (np.abs(step) < _ENOUGH * np.sqrt(np.diag(covariance))).all():
                break
        if not self.ahead(vector):
            return None
        return LocalMaximum(vector, shift, weight, standard, blocks)

    def with_estimated_noise(
        self, start: FloatArray, wide_start: FloatArray, noise: PixelNoise
    ) -> tuple[LocalMaximum | None, PixelNoise, FloatArray]:
        """The maximum of the posterior under noise that is estimated, that noise, and the doubt.

        Errors in metres that last a second or two are a target's gait, or its log's. Likelihood
        does not tell which, and where derivatives are to be taken depends on it: where the log
        says, or where the target was. Both are tried, and the one is kept by which targets that
        were left out are placed better.

        Args:
            start: Parameters by white noise at the logged places.
            wide_start: The same by much wider noise. With a single target the other view starts
                there, since from ``start``, which takes all errors for the box's, it need not
                find back.
            noise: To begin with.

        Returns:
            The parameters are the mean over both views, each as probable as it is that its
            left-out places are the nearer ones by more than chance; the doubt is what is to be
            added to them as one more error, (P,), the standard deviation over both.
        """
        best, estimated = self.alternate(start, noise)
        if best is None:
            return best, estimated, np.zeros(start.size)
        errors = self.left_out_errors(best, estimated)
        self.of_log = True
        # Several targets spread over the picture: the first view has a camera to go on from.
        if np.unique(self.sightings.log[self.boxes]).size > 1:
            other, of_other = self.alternate(best.vector, estimated)
        else:
            other, of_other = self.alternate(wide_start, noise)
        errors_other = None if other is None else self.left_out_errors(other, of_other)
        self.of_log = False
        if other is None or errors is None or errors_other is None:
            self.expect_hull(best.vector)
            self.evidence = self.negative_log_evidence(best, estimated)
            return best, estimated, np.zeros(start.size)
        self.left_out_m = self.root_mean_square(errors)
        more = errors_other - errors
        # Of the sum; parts are independent of one another, boxes of one part are not.
        sigma = np.sqrt(more.size * np.var(more, ddof=1))
        chance = float(norm.sf(np.abs(more.sum()) / max(sigma, 1e-12)))
        if more.sum() < 0.0:
            self.of_log = True
            self.left_out_m = self.root_mean_square(errors_other)
            best, estimated, other = other, of_other, best
        self.expect_hull(best.vector)
        # Of a maximum: the mean of two is none.
        self.evidence = self.negative_log_evidence(best, estimated)
        apart = other.vector - best.vector
        apart[HEADING] = np.arctan2(np.sin(apart[HEADING]), np.cos(apart[HEADING]))
        mean = replace(best, vector=best.vector + chance * apart)
        return mean, estimated, np.sqrt(chance * (1.0 - chance)) * apart

    def alternate(
        self, start: FloatArray, noise: PixelNoise
    ) -> tuple[LocalMaximum | None, PixelNoise]:
        """Parameters under the noise and noise under the parameters, in turn."""
        best = None
        for _ in range(_ROUNDS):
            self.expect_hull(start)
            best = self.refine(start, noise)
            if best is None:
                break
            start = best.vector
            try:
                noise = self.estimate_noise(best, noise)
            except LinAlgError:
                # The noise of the round before stands.
                break
        return self.refine(start, noise), noise

    def left_out_errors(self, found: LocalMaximum, noise: PixelNoise) -> FloatArray | None:
        """(K,) summed squared errors of places that were left out, square metres, of each part.

        Targets are left out, or stretches of a single one.

        Returns:
            None where what is left tells no camera.
        """
        s = self.sightings
        rows = np.flatnonzero(self.boxes)
        logs, part = np.unique(s.log[rows], return_inverse=True)
        if logs.size == 1:
            rows = rows[np.argsort(s.time_s[rows], kind="stable")]
            part = np.arange(rows.size) * _FOLDS // rows.size
        count = int(part.max()) + 1
        out = np.zeros(count)
        for fold in range(min(_FOLDS, count)):
            left = np.zeros(len(s), dtype=bool)
            left[rows[part % _FOLDS == fold]] = True
            without = self.refine(found.vector, noise, left_out=left)
            if without is None:
                return None
            of = np.flatnonzero(part % _FOLDS == fold)
            np.add.at(out, part[of], self.squared_errors(without.vector, rows[of]))
        return out

    def root_mean_square(self, errors_m2: FloatArray) -> float:
        """Root mean square of `left_out_errors`, metres; 0 where there is but one target."""
        one = np.unique(self.sightings.log[self.boxes]).size == 1
        return 0.0 if one else float(np.sqrt(errors_m2.sum() / self.boxes.sum()))

    def squared_errors(self, vector: FloatArray, rows: IntArray) -> FloatArray:
        """(K,) squared errors of places, square metres, of at most half of the distance."""
        s = self.sightings
        camera = Camera.from_vector(vector[CAMERA], self.image_size_px)
        bias = vector[self.layout.sources].reshape(-1, len(SOURCE_PARAMETERS))[s.source[rows]]
        foot = s.pixel_px[rows] - np.stack([np.zeros(rows.size), bias[:, BIAS_PX]], axis=1)
        east, north = camera.locate(foot, s.above_m[rows] + bias[:, BIAS_M])
        at_east, at_north = self.place(vector)
        off = np.stack([at_east[rows] - camera.east_m, at_north[rows] - camera.north_m])
        distance = np.hypot(*off)
        hull = self.reach_m(vector, self.aspect(vector))[rows] / distance
        error = np.hypot(
            east - at_east[rows] + hull * off[0], north - at_north[rows] + hull * off[1]
        )
        most = 0.5 * distance
        return np.asarray(np.minimum(np.where(np.isfinite(error), error, most), most) ** 2)

    def reach(self, size: int) -> FloatArray:
        """(size,) the largest step of each parameter."""
        return np.concatenate([self.scale, np.full(size - self.size, self.hull.middle_sigma_m)])

    def solve(
        self, start: FloatArray, noise: PixelNoise, evaluations: int
    ) -> tuple[float, FloatArray] | None:
        """Cost and parameters of the nearest posterior maximum; None if it does not converge."""
        sigma, aspect = self.sigmas(start, noise), self.aspect(start)
        mean, beliefs = self.beliefs(start.size)
        scale = np.concatenate([self.scale, np.ones(start.size - self.size)])
        last: list[tuple[FloatArray, FloatArray, FloatArray]] = []

        def evaluate(vector: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
            # The optimiser asks for residuals and for derivatives one after the other.
            if not last or not np.array_equal(last[0][0], vector):
                pixel, jacobian, _ = self.project(vector, aspect)
                raw = ((self.sightings.pixel_px - pixel) / sigma).ravel()
                size_of = np.abs(raw)
                tail = size_of > _HUBER
                root = np.sqrt(np.where(tail, 2.0 * _HUBER * size_of - _HUBER**2, 1.0))
                residual = np.where(tail, np.sign(raw) * root, raw)
                slope = np.where(tail, _HUBER / root, 1.0)
                by_parameter = -(jacobian / sigma[:, :, None]).reshape(raw.size, -1)
                by_all = np.concatenate([by_parameter * slope[:, None], beliefs])
                all_residuals = np.concatenate([residual, beliefs @ (vector - mean)])
                rows = np.column_stack([by_all, all_residuals])
                if np.isfinite(rows).all():
                    rows = fewer_rows(rows, self.layout.clocks)
                last[:] = [(vector.copy(), rows[:, -1], rows[:, :-1])]
            return last[0]

        if not np.isfinite(evaluate(start)[1]).all():
            return None

        def residuals(vector: FloatArray) -> FloatArray:
            return evaluate(vector)[1]

        def derivatives(vector: FloatArray) -> FloatArray:
            return evaluate(vector)[2]

        solution = least_squares(
            residuals,
            start,
            jac=derivatives,
            x_scale=scale,
            max_nfev=evaluations,
            xtol=1e-9,
            ftol=1e-9,
            gtol=1e-9,
        )
        return (float(solution.cost), solution.x) if self.ahead(solution.x) else None

    def ahead(self, vector: FloatArray) -> bool:
        """Whether most correspondences lie in front of the camera."""
        s = self.sightings
        heading = vector[HEADING]
        forward = np.sin(heading) * (s.east_m - vector[EAST]) + np.cos(heading) * (
            s.north_m - vector[NORTH]
        )
        return bool(np.mean(forward > 0.0) > 0.5)

    def linearise(self, found: LocalMaximum) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Residuals (N, 2) and Jacobians by parameters and by points, logs corrected.

        What that took from the residuals is put back to first order. Only the correlated error is
        corrected: boxes that two people drew at one moment show one place. With derivatives at two
        places, a log that is off by very much would seem to explain how the boxes differ.
        """
        aspect = self.aspect(found.vector)
        pixel, jacobian, by_point = self.project(found.vector, aspect, found.shift_m)
        put_back = np.einsum("nij,nj->ni", by_point[:, :, :2], found.shift_m)
        return self.sightings.pixel_px - pixel + put_back, jacobian, by_point

    def estimate_noise(self, found: LocalMaximum, before: PixelNoise) -> PixelNoise:
        """Maximum a posteriori noise of the residuals: see `RestrictedLikelihood`."""
        return most_probable_noise(self.likelihood(found), before, heaving=self.heaving)

    def negative_log_evidence(self, found: LocalMaximum, noise: PixelNoise) -> float:
        """Negative logarithm of the density of data and noise; infinite where there is none."""
        try:
            return negative_log_evidence(self.likelihood(found), noise, heaving=self.heaving)
        except LinAlgError:
            return np.inf

    def likelihood(self, found: LocalMaximum) -> RestrictedLikelihood:
        """Restricted likelihood of the noise of the residuals."""
        residual, jacobian, by_point = self.linearise(found)
        mean, beliefs = self.beliefs(found.vector.size)
        own_m = np.where(self.boxes, 0.0, self.sightings.sigma_m)
        return RestrictedLikelihood(
            residual_px=residual,
            jacobian=jacobian,
            by_point=by_point,
            pixels_per_metre=self.pixels_per_metre(found.vector),
            is_box=self.boxes,
            known_m2=own_m**2,
            weight=found.weight,
            blocks=found.blocks,
            half_lengths_m=self.hull.half_lengths_m,
            precision=beliefs.T @ beliefs,
            off_mean=found.vector - mean,
        )


def fewer_rows(rows: FloatArray, clocks: slice) -> FloatArray:
    """(K, K) rows whose products of columns are those of many rows (M, K): a QR decomposition.

    Costs and steps of a least-squares problem depend on these products alone, and an optimiser that
    decomposes what it is given is faster with few rows. A row depends on one clock at most, so that
    clocks, which are many where targets are, are orthogonal as they stand.
    """
    clock, others = rows[:, clocks], np.delete(rows, clocks, axis=1)
    length = np.linalg.norm(clock, axis=0)
    unit = clock / np.maximum(length, 1e-300)
    along = unit.T @ others
    rest = np.linalg.qr(others - unit @ along, mode="r")
    count = length.size
    out = np.zeros((count + len(rest), rows.shape[1]))
    kept = np.delete(np.arange(rows.shape[1]), clocks)
    out[:count, clocks] = np.diag(length)
    out[:count, kept] = along
    out[count:, kept] = rest
    return out
