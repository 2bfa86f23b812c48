"""Camera calibration: maximum a posteriori fit to point correspondences.

Maximum a posteriori estimate of the camera of `sightline.camera.pinhole`, together with the size
of the target's hull, whose near side a box ends at, and a bias of the lower edge for each source
of boxes. Residuals are pixels, because that is where the noise
is: of the row and the column of a box's foot, each with a part that is constant in pixels and a
part that is constant in metres at the target (a drawn waterline is wrong by a share of the hull, a
log by metres), both estimated from the residuals. Large residuals are down-weighted (Huber).
Priors on height, focal length, roll and distortion hold what thin data leaves open, and the
posterior says which those were.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from sightline.camera.correlated_noise import Whitening, thinned
from sightline.camera.mixed_model import LocalMaximum, MixedModel
from sightline.camera.observations import PointCorrespondences, _check_enough
from sightline.camera.parameters import (
    CAMERA,
    EAST,
    HEADING,
    LOG_HEIGHT,
    NORTH,
    PARAMETERS,
    TARGET,
    ParameterLayout,
)
from sightline.camera.pinhole import Camera
from sightline.camera.priors import HEAVE_M, CameraPrior, PixelNoise, SourcePrior
from sightline.camera.target_sizes import TargetSizes
from sightline.clock_offset import USUAL_SIGMA_S
from sightline.errors import FitError
from sightline.types import BoolArray, FloatArray, IntArray

_OUTLIER = 4.0
# A start first sees the data through noise so many times wider, under which the posterior is
# smooth and no residual is large enough to be cut off.
_WIDE = 20.0
_KNOWN_AT = 0.7
# Of a logarithm: a height of which less is known than a factor of two is open.
_HEIGHT_SIGMA = 0.7
# Clocks that are further off than this are not what people call right.
_RIGHT_S = 1.5
# Ends as near as this to one another, as a share of a prior's width, are one.
_SAME_END = 0.05
# Standard deviations of a prior by which scatter of the log may pull at most.
_MOST_PULLED = 2.0

_BEHIND = (
    "no camera explains the boxes and fixes: from every start the targets lay behind the camera; "
    "check the camera's position, the clock and the log"
)


@dataclass(frozen=True, eq=False)
class CameraFit:
    """A fitted camera with its parameter covariance and clock offsets.

    Attributes:
        vector: (14 + 2 S + G,) float64, in the order of `layout`; a clock offset is how many
            seconds a recording's clock is to be moved on to agree with the log.
        covariance: Square, of ``vector``.
        prior_sigma: (14 + 2 S + G,) float64, infinite where there was no prior.
        clock_groups: (G,) int64, the recordings whose clocks were estimated.
        noise: Of a box's foot.
        image_size_px: Width and height.
        residual_px: (N, 2) float64, observed minus projected.
        standard_residual: (N,) float64, the residual over its standard deviation, root mean square
            of column and row.
        leverage: (N,) float64, how much of the fit hangs on this correspondence; they add up to the
            number of parameters that the data determined.
        outlier: (N,) bool, residuals beyond four standard deviations.
        starts_agreeing: How many starts ended at this camera.
        starts: How many there were.
        typical_range_m: Median distance of the correspondences from the camera.
        sizes: Of the targets; None where no boxes tell them.
        negative_log_evidence: Negative logarithm of the density of data and noise, by which fits of
            the same data under other priors are compared; NaN where it is not known.
        left_out_m: Root mean square error of the places of targets that were left out, metres; 0
            where there was but one.
    """

    vector: FloatArray
    covariance: FloatArray
    prior_sigma: FloatArray
    clock_groups: IntArray
    noise: PixelNoise
    image_size_px: tuple[int, int]
    residual_px: FloatArray
    standard_residual: FloatArray
    leverage: FloatArray
    outlier: BoolArray
    starts_agreeing: int
    starts: int
    typical_range_m: float
    sizes: TargetSizes | None = None
    negative_log_evidence: float = float("nan")
    left_out_m: float = 0.0

    @property
    def layout(self) -> ParameterLayout:
        """Parameter layout of ``vector``."""
        return ParameterLayout.of(self.vector.size, self.clock_groups.size)

    @property
    def camera(self) -> Camera:
        """The fitted camera."""
        return Camera.from_vector(self.vector[CAMERA], self.image_size_px)

    @property
    def clock_offset_s(self) -> FloatArray:
        """(G,) clock offset of each recording, seconds to add to its clock."""
        return self.vector[self.layout.clocks]

    @property
    def clock_sigma_s(self) -> float:
        """Standard deviation of an unseen clock's offset, seconds; 0 where none was fitted."""
        count = self.clock_groups.size
        if count == 0:
            return 0.0
        own = np.diag(self.covariance)[self.layout.clocks]
        sigma = self.prior_sigma[self.layout.clocks]
        prior = min(USUAL_SIGMA_S, float(sigma.min())) ** 2
        # What was taken off before the fit shows in the width of the prior. As far as clocks go
        # that people call right, it says how such scatter; one that is off by more says nothing.
        before = 2.0 * np.maximum(sigma**2 - USUAL_SIGMA_S**2, 0.0)
        scatter = self.clock_offset_s**2 + own + np.where(before < _RIGHT_S**2, before, 0.0)
        # The prior weighs as much as half a recording.
        return float(np.sqrt((0.5 * prior + np.sum(scatter)) / (0.5 + count)))

    def determined(self) -> BoolArray:
        """(12,) bool: whether the data, not the prior, determines each of `PARAMETERS`.

        A parameter counts as determined where its standard deviation is less than 0.7 of what it
        was before any data: an angle without a prior where it is known to 10 degrees, a position
        where it is known to within a quarter of the camera's distance to what it saw, a height
        where it is known to a factor of 1.6, however vague the prior.
        """
        sigma = np.sqrt(np.diag(self.covariance)[CAMERA])
        prior = self.prior_sigma[CAMERA].copy()
        prior[HEADING] = min(prior[HEADING], np.radians(10.0) / _KNOWN_AT)
        prior[LOG_HEIGHT] = min(prior[LOG_HEIGHT], _HEIGHT_SIGMA)
        prior[np.isinf(prior)] = 0.25 * self.typical_range_m / _KNOWN_AT
        return np.asarray(sigma < _KNOWN_AT * prior)

    def target_determined(self) -> BoolArray:
        """(2,) bool: as `determined`, of `TARGET_PARAMETERS`."""
        sigma = np.sqrt(np.diag(self.covariance)[TARGET])
        return np.asarray(sigma < _KNOWN_AT * self.prior_sigma[TARGET])


@dataclass(frozen=True)
class CameraFitSettings:
    """How a camera is fitted.

    Attributes:
        position_known: Whether the origin of the plane is where the camera is said to stand.
        heaving: Whether the camera is on a vessel, whose heave is to be told from the log's errors.
        starts: How many random starting cameras, the first at the prior's mean.
        seed: Of the random starts.
        clocks: By recording, mean and standard deviation of its clock offset, seconds to be added
            to its clock; where they are others than the prior's.
    """

    position_known: bool = True
    heaving: bool = False
    starts: int = 8
    seed: int = 0
    clocks: Mapping[int, tuple[float, float]] = field(default_factory=dict)


def fit_camera(
    sightings: PointCorrespondences,
    image_size_px: tuple[int, int],
    *,
    n_sources: int,
    prior: CameraPrior | None = None,
    beliefs: Mapping[int, SourcePrior] | None = None,
    noise: PixelNoise | None = None,
    settings: CameraFitSettings | None = None,
) -> CameraFit:
    """Fit the camera and the lower-edge bias of each source to point correspondences.

    Args:
        sightings: At least three, not all in one place.
        image_size_px: Width and height.
        n_sources: How many sources of boxes there are.
        prior: Beliefs about the camera; absent: those of an ordinary camera.
        beliefs: Priors of single sources, of which more is known than the prior says.
        noise: Noise of a foot, taken as known; absent: estimated from the residuals.
        settings: How the camera is fitted.

    Raises:
        FitError: Too few points, all in one place, or no start that puts them before the camera.
    """
    _check_enough(sightings)
    prior, settings = prior or CameraPrior(), settings or CameraFitSettings()
    starts, known, heaving = max(settings.starts, 1), settings.position_known, settings.heaving
    chosen = thinned(sightings.time_s, sightings.log)
    everything = MixedModel(sightings, image_size_px, n_sources, prior, known, beliefs, heaving)
    problem = everything
    if chosen.size < len(sightings):
        problem = MixedModel(
            sightings[chosen], image_size_px, n_sources, prior, known, beliefs, heaving
        )
    for one in (everything, problem):
        one.expect_clocks(settings.clocks)
    # Costs, cameras, and what these were under the wider noise.
    found: list[tuple[float, FloatArray, FloatArray]] = []
    assumed = noise or PixelNoise()
    for start in problem.starts(starts, np.random.default_rng(settings.seed)):
        wide = problem.solve(start, assumed.scaled(_WIDE), evaluations=50)
        solution = problem.solve(wide[1], assumed, evaluations=50) if wide is not None else None
        if wide is not None and solution is not None:
            found.append((*solution, wide[1]))
    if not found:
        raise FitError(_BEHIND)
    found.sort(key=lambda one: one[0])
    if everything.heaving and noise is None:
        assumed = replace(assumed, heave_m=HEAVE_M)
    start, wide_start = (np.append(vector, 0.0) for vector in found[0][1:])
    if noise is None:
        best, estimated, doubt = problem.with_estimated_noise(start, wide_start, assumed)
    else:
        problem.expect_hull(start)
        best, estimated, doubt = problem.refine(start, noise), noise, np.zeros(start.size)
    if best is None:
        raise FitError(_BEHIND)
    best.vector[HEADING] = np.mod(best.vector[HEADING], 2.0 * np.pi)
    # The noise came from the best start; under it the others go on from where they are.
    ends = [best.vector]
    for _, vector, _ in found[1:]:
        if np.all(np.abs(vector - found[0][1]) < _SAME_END * problem.scale):
            ends.append(best.vector)
            continue
        nearer = problem.solve(vector, estimated, evaluations=100)
        end = problem.refine(np.append(nearer[1], 0.0), estimated) if nearer else None
        if end is not None:
            ends.append(end.vector)
    fit = _Summary(problem, doubt).at(best, estimated, ends, starts)
    return fit if problem is everything else _Summary(everything, doubt).with_all(fit, chosen)


def expected_fit(
    sightings: PointCorrespondences,
    camera: Camera,
    *,
    n_sources: int,
    prior: CameraPrior | None = None,
    noise: PixelNoise | None = None,
    settings: CameraFitSettings | None = None,
) -> CameraFit:
    """The fit that correspondences of a known camera would lead to.

    It is `fit_camera` with the true camera in place of a search: which correspondences count, the
    model, its priors, the noise that residuals tell and the covariance are the same. It ends where
    the priors and the noise draw the estimate, as far as the data let them.

    Args:
        sightings: At least three, not all in one place, as the camera sees them, noise and all.
        camera: It.
        n_sources: How many sources of boxes there are.
        prior: Beliefs about the camera; absent: those of an ordinary camera.
        noise: Noise of a foot, taken as known; absent: estimated from the residuals.
        settings: Its starts and its seed are of no use here.

    Raises:
        FitError: Too few points, or all in one place, or they are not seen.
    """
    _check_enough(sightings)
    prior, settings = prior or CameraPrior(), settings or CameraFitSettings()
    model = MixedModel(
        sightings[thinned(sightings.time_s, sightings.log)],
        camera.image_size_px,
        n_sources,
        prior,
        settings.position_known,
        None,
        settings.heaving,
    )
    model.expect_clocks(settings.clocks)
    start = model.mean.copy()
    start[CAMERA] = camera.to_vector()
    assumed = noise or PixelNoise()
    # As a search goes on from wherever it has begun: where boxes leave it open how large targets
    # are, the priors decide, and not the truth.
    wide = model.solve(start, assumed.scaled(_WIDE), evaluations=50)
    solution = model.solve(wide[1], assumed, evaluations=50) if wide is not None else None
    if wide is None or solution is None:
        raise FitError(_BEHIND)
    vector, doubt = np.append(solution[1], 0.0), np.zeros(start.size + 1)
    if noise is None:
        best, noise, doubt = model.with_estimated_noise(vector, np.append(wide[1], 0.0), assumed)
    else:
        model.expect_hull(vector)
        best = model.refine(vector, noise)
    if best is None:
        raise FitError(_BEHIND)
    best.vector[HEADING] = np.mod(best.vector[HEADING], 2.0 * np.pi)
    return _Summary(model, doubt).at(best, noise, [best.vector], 1)


class _Summary:
    """The fit of a model at a maximum of its posterior."""

    def __init__(self, model: MixedModel, doubt: FloatArray) -> None:
        self.model = model
        self.doubt = doubt

    def at(
        self, found: LocalMaximum, noise: PixelNoise, ends: list[FloatArray], starts: int
    ) -> CameraFit:
        """The fit with its covariance, from the best optimum and those of all starts."""
        residual, jacobian, by_point = self.model.linearise(found)
        by_place = by_point[:, :, :2]
        variance = self.model.pixel_variance(found.vector, noise)
        variance += (self.model.place_sigma(noise) ** 2)[:, None] * np.sum(by_place**2, axis=2)
        # Errors of one recording are alike, so that it tells less than its number of boxes.
        shares = [self._shared_error(found.standard[:, axis]) for axis in (0, 1)]
        crowding = np.stack([self._crowding(share) for share in shares], axis=1)
        whitening = Whitening(
            found.blocks,
            variance * crowding / found.weight,
            by_place,
            noise,
            by_point[:, :, 2],
            self.model.hull.half_lengths_m,
        )
        scaled = whitening.forward(jacobian).reshape(-1, found.vector.size)
        _, beliefs = self.model.beliefs(found.vector.size)
        whole: FloatArray = np.linalg.pinv(
            scaled.T @ scaled + beliefs.T @ beliefs, hermitian=True
        ).astype(np.float64)
        leverage = np.einsum("nj,jk,nk->n", scaled, whole, scaled).reshape(-1, 2).sum(axis=1)
        pulled = whole @ self._attenuation(found.vector, noise, variance * crowding / found.weight)
        # Beliefs bound how far either goes.
        limit = np.append(_MOST_PULLED * self.model.sigma, np.inf)
        for by in (pulled, self.doubt):
            by = by * min(1.0, float(np.min(limit / np.maximum(np.abs(by), 1e-12))))
            whole = whole + np.outer(by, by)
        middle = self.model.layout.middle
        middle_m = float(np.sqrt(found.vector[middle] ** 2 + whole[middle, middle]))
        vector, covariance = (
            found.vector[: self.model.size],
            whole[: self.model.size, : self.model.size],
        )
        return CameraFit(
            vector=vector,
            covariance=covariance,
            prior_sigma=self.model.sigma,
            clock_groups=self.model.clock_groups,
            noise=replace(noise, middle_m=middle_m),
            image_size_px=self.model.image_size_px,
            residual_px=residual,
            standard_residual=np.sqrt(np.mean(found.standard**2, axis=1)),
            leverage=leverage,
            outlier=np.asarray(np.abs(found.standard).max(axis=1) > _OUTLIER),
            starts_agreeing=sum(self._same(end, vector, covariance) for end in ends),
            starts=starts,
            typical_range_m=float(
                np.median(
                    np.hypot(
                        self.model.sightings.east_m - vector[EAST],
                        self.model.sightings.north_m - vector[NORTH],
                    )
                )
            ),
            sizes=self.model.hull.sizes,
            negative_log_evidence=self.model.evidence,
            left_out_m=self.model.left_out_m,
        )

    def with_all(self, fit: CameraFit, chosen: IntArray) -> CameraFit:
        """A fit to a subset, extended by the residuals of all correspondences."""
        pixel, _, by_point = self.model.project(fit.vector, self.model.aspect(fit.vector))
        per_metre = np.sum(by_point[:, :, :2] ** 2, axis=2)
        sigma = np.hypot(
            self.model.sigmas(fit.vector, fit.noise), fit.noise.correlated_m * np.sqrt(per_metre)
        )
        residual = self.model.sightings.pixel_px - pixel
        standard = residual / sigma
        residual[chosen] = fit.residual_px
        leverage = np.zeros(len(self.model.sightings))
        leverage[chosen] = fit.leverage
        outlier = np.abs(standard).max(axis=1) > _OUTLIER
        outlier[chosen] = fit.outlier
        size = np.sqrt(np.mean(standard**2, axis=1))
        size[chosen] = fit.standard_residual
        return replace(
            fit, residual_px=residual, standard_residual=size, leverage=leverage, outlier=outlier
        )

    def _attenuation(
        self, vector: FloatArray, noise: PixelNoise, variance_px2: FloatArray
    ) -> FloatArray:
        """(P,) cost gradient of the attenuation by place noise charged to the pixels.

        It makes metres look small: the slope of its expected part of the cost. Where the data hold
        the camera it hardly moves it; where they do not, the estimate may be off by this much.
        """
        rows = self.model.boxes & ~self.model.timed
        out = np.zeros(vector.size)
        if not rows.any():
            return out
        aspect = self.model.aspect(vector)
        weight = (0.5 * noise.place_m**2 / variance_px2)[rows]
        for i in range(len(PARAMETERS)):
            apart = 1e-4 * self.model.scale[i]
            squares = []
            for side in (-1.0, 1.0):
                moved = vector.copy()
                moved[i] += side * apart
                by_point = self.model.project(moved, aspect)[2][rows]
                squares.append(np.sum(by_point[:, :, :2] ** 2, axis=2))
            out[i] = np.sum(weight * (squares[1] - squares[0])) / (2.0 * apart)
        return out

    @staticmethod
    def _same(one: FloatArray, other: FloatArray, covariance: FloatArray) -> bool:
        """Whether two cameras agree within one standard deviation in every parameter."""
        difference = one[CAMERA] - other[CAMERA]
        turn = difference[HEADING]
        difference[HEADING] = np.arctan2(np.sin(turn), np.cos(turn))
        return bool(np.all(np.abs(difference) < np.sqrt(np.diag(covariance)[CAMERA])))

    def _shared_error(self, standard: FloatArray) -> float:
        """Intraclass correlation of errors within a recording, 0 to 1 (one-way ANOVA)."""
        group = self.model.sightings.group
        names, inverse, count = np.unique(group, return_inverse=True, return_counts=True)
        if names.size < 2 or names.size == group.size:
            return 0.0
        clipped = np.clip(standard, -_OUTLIER, _OUTLIER)
        means = np.bincount(inverse, clipped) / count
        between = np.sum(count * (means - clipped.mean()) ** 2) / (names.size - 1)
        within = np.sum((clipped - means[inverse]) ** 2) / (group.size - names.size)
        typical = (group.size - np.sum(count**2) / group.size) / (names.size - 1)
        shared = (between - within) / typical
        return float(np.clip(shared / max(shared + within, 1e-12), 0.0, 1.0))

    def _crowding(self, share: float) -> FloatArray:
        """(N,) design effect by which correspondences are down-weighted: 1 + (n - 1) share.

        Boxes of one moment, drawn by one and found by another, are of one place, and count as one.
        """
        s = self.model.sightings
        _, inverse, count = np.unique(s.group, return_inverse=True, return_counts=True)
        timed = np.flatnonzero(self.model.timed)
        moment = np.stack([s.log[timed].astype(float), s.time_s[timed]], axis=1)
        _, at, alike = np.unique(moment, axis=0, return_inverse=True, return_counts=True)
        of_moment = np.ones(len(s))
        of_moment[timed] = alike[at.ravel()]
        return np.asarray((1.0 + (count[inverse] - 1.0) * share) * of_moment)
