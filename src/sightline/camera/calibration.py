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
from dataclasses import dataclass, field, fields, replace

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.optimize import least_squares, minimize

from sightline.camera.correlated_noise import Whitening, blocks_of, thinned
from sightline.camera.observations import NO_SOURCE, PointCorrespondences, _check_enough
from sightline.camera.parameters import (
    BIAS_M,
    BIAS_PX,
    CAMERA,
    EAST,
    HEADING,
    LOG_FOCAL,
    LOG_HEIGHT,
    NORTH,
    PARAMETERS,
    PITCH,
    POSITION,
    SOURCE_PARAMETERS,
    TARGET,
    ParameterLayout,
)
from sightline.camera.pinhole import Camera, project_with_jacobian
from sightline.camera.priors import (
    _NOISE_CENTRE,
    ANY_ASPECT,
    CameraPrior,
    PixelNoise,
    SourcePrior,
)
from sightline.camera.target_sizes import BEAM_SHARE, TargetSizes
from sightline.clock_offset import USUAL_SIGMA_S
from sightline.errors import FitError
from sightline.types import BoolArray, FloatArray, IntArray

_HUBER = 2.0
_OUTLIER = 4.0
# A start first sees the data through noise so many times wider, under which the posterior is
# smooth and no residual is large enough to be cut off.
_WIDE = 20.0
_KNOWN_AT = 0.7
# Below this a target's course says little about where its bow points.
_UNDER_WAY_MPS = 0.5
_ROUNDS = int(__import__('os').environ.get('ROUNDS', '6'))
# Clocks that are further off than this are not what people call right.
_RIGHT_S = 1.5
# Of a standard deviation: a step so small ends the search.
_ENOUGH = 0.01
_MOST_STEPS = 30
# Ends as near as this to one another, as a share of a prior's width, are one.
_SAME_END = 0.05
# Standard deviations of a prior by which scatter of the log may pull at most.
_MOST_PULLED = 2.0
# A receiver stands somewhere on its boat.
_MIDDLE_SIGMA_M = 1.0
_MIDDLE_SHARE = float(__import__("os").environ.get("MID","0.4"))
_SHARE = float(__import__("os").environ.get("SHARE", "0.5"))
_MORE_ROUNDS = 3
_FOLDS = 6
_NO_WEIGHT = 1e-9
_NAMES = (
    "row_px row_m column_px place_m correlated_m correlation_time_s heave_m offset_m "
    "lasting_row_px lasting_column_px lasting_time_s"
).split()
_AVOID = __import__("os").environ.get("AVOID", "").split(",")
# By part: logarithmic (median, width) or exponential (mean,).
_NOISE_PRIOR = {
    "row_px": (1.0, 0.7),
    "column_px": (2.0, 0.7),
    "row_m": (1.0,),
    "place_m": (1.0,),
    "correlated_m": (3.0,),
    "correlation_time_s": (float(__import__("os").environ.get("TL","20")), float(__import__("os").environ.get("TLW","0.5"))),
    "heave_m": (0.15, 1.0),
    "offset_m": (3.0,),
    "antenna_share": (0.3, 0.7),
    "lasting_m": (1.0,),
    "lasting_row_px": (1.0,),
    "lasting_column_px": (1.0,),
    "lasting_time_s": (2.0, float(__import__("os").environ.get("TBW","1.0"))),
}
# By what share of itself a length that is read off boxes may be wrong:
# off tight boxes of rendered hulls it comes out 4 to 11 % too short, and people leave margins.
_SIZE_SHARE = 0.25


_BEHIND = (
    "no camera explains the boxes and fixes: from every start the targets lay behind the camera; "
    "check the camera's position, the clock and the log"
)


@dataclass(frozen=True, eq=False)
class CameraFit:
    """A fitted camera with its parameter covariance and clock offsets.

    Attributes:
        vector: (11 + 2 S + G,) float64, in the order of `layout`; a clock offset is how many
            seconds a recording's clock is to be moved on to agree with the log.
        covariance: Square, of ``vector``.
        prior_sigma: (11 + 2 S + G,) float64, infinite where there was no prior.
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
        """(9,) bool: whether the data, not the prior, determines each of `PARAMETERS`.

        A parameter counts as determined where its standard deviation is less than 0.7 of what it
        was before any data: an angle without a prior where it is known to 10 degrees, a position
        where it is known to within a quarter of the camera's distance to what it saw.
        """
        sigma = np.sqrt(np.diag(self.covariance)[CAMERA])
        prior = self.prior_sigma[CAMERA].copy()
        prior[HEADING] = np.radians(10.0) / _KNOWN_AT
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
    everything = _Problem(sightings, image_size_px, n_sources, prior, known, beliefs, heaving)
    problem = everything
    if chosen.size < len(sightings):
        problem = _Problem(
            sightings[chosen], image_size_px, n_sources, prior, known, beliefs, heaving
        )
    for one in (everything, problem):
        one.expect_clocks(settings.clocks)
    found: list[tuple[float, FloatArray]] = []
    assumed = noise or PixelNoise()
    for start in problem.starts(starts, np.random.default_rng(settings.seed)):
        solution = problem.solve(start, assumed.scaled(_WIDE), evaluations=50)
        if solution is not None:
            solution = problem.solve(solution[1], assumed, evaluations=50)
        if solution is not None:
            found.append(solution)
    if not found:
        raise FitError(_BEHIND)
    found.sort(key=lambda pair: pair[0])
    if everything.heaving and noise is None:
        assumed = replace(assumed, heave_m=_NOISE_CENTRE[-1])
    start = np.append(found[0][1], 0.0)
    if noise is None:
        best, estimated = problem.with_estimated_noise(start, assumed)
    else:
        problem.expect_hull(start)
        best, estimated = problem.refine(start, noise), noise
    if best is None:
        raise FitError(_BEHIND)
    best.vector[HEADING] = np.mod(best.vector[HEADING], 2.0 * np.pi)
    # The noise came from the best start; under it the others go on from where they are.
    ends = [best.vector]
    for _, vector in found[1:]:
        if np.all(np.abs(vector - found[0][1]) < _SAME_END * problem.scale):
            ends.append(best.vector)
            continue
        nearer = problem.solve(vector, estimated, evaluations=100)
        end = problem.refine(np.append(nearer[1], 0.0), estimated) if nearer else None
        if end is not None:
            ends.append(end.vector)
    fit = problem.summarise(best, estimated, ends, starts)
    return fit if problem is everything else everything.with_all(fit, chosen)


@dataclass(frozen=True, eq=False)
class _Refined:
    """A local maximum of the posterior density.

    Attributes:
        vector: Parameters, with how far the middle of a box lies ahead of the receiver.
        correlated_m: (N, 2) most probable correlated error of the log.
        weight: (N, 2) how much each column and row counts, 0 to 1.
        standard: (N, 2) residuals without correlated error, over their standard deviations.
    """

    vector: FloatArray
    correlated_m: FloatArray
    weight: FloatArray
    standard: FloatArray


class _Problem:
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
        self.of_log = 0.0
        # Of each box's target, over that of a typical one.
        self.relative_size = np.ones(len(sightings))
        self.sizes: TargetSizes | None = None
        self.middle_sigma_m = _MIDDLE_SIGMA_M
        self.half_lengths_m: FloatArray | None = None
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
        steered = (sightings.source != NO_SOURCE) & (speed > _UNDER_WAY_MPS)
        self.bow = np.where(
            steered[:, None], sightings.velocity_mps / np.maximum(speed, 1e-9)[:, None], 0.0
        )
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
                vector[LOG_HEIGHT] += rng.normal(0.0, 0.5)
                vector[PITCH] += rng.normal(0.0, np.radians(8.0))
                vector[LOG_FOCAL] += rng.normal(0.0, 0.3)
            if not self.position_known:
                angle = 2.0 * np.pi * (i + rng.uniform()) / count
                distance = self.spread * np.exp(rng.uniform(0.0, 1.6))
                vector[EAST] = self.centre[0] + distance * np.sin(angle)
                vector[NORTH] = self.centre[1] + distance * np.cos(angle)
            bearing = np.arctan2(
                self.sightings.east_m - vector[EAST], self.sightings.north_m - vector[NORTH]
            )
            from_middle = self.sightings.pixel_px[:, 0] - 0.5 * self.image_size_px[0]
            across = np.arctan(from_middle / np.exp(vector[LOG_FOCAL]))
            turn = bearing - across
            vector[HEADING] = np.arctan2(np.sin(turn).mean(), np.cos(turn).mean())
            out.append(vector)
        return out

    def aspect(self, vector: FloatArray) -> FloatArray:
        """(N, 2) shares of a typical half length and half beam along the line of sight."""
        return self.directions(vector) * self.relative_size[:, None]

    def directions(self, vector: FloatArray) -> FloatArray:
        """(N, 2) shares of its own half length and half beam along the line of sight."""
        s = self.sightings
        east, north = s.east_m - vector[EAST], s.north_m - vector[NORTH]
        speed = np.hypot(*s.velocity_mps.T)
        size = np.maximum(speed * np.hypot(east, north), 1e-9)
        cosine = (s.velocity_mps[:, 0] * east + s.velocity_mps[:, 1] * north) / size
        out: FloatArray = np.stack([np.abs(cosine), np.sqrt(np.maximum(1.0 - cosine**2, 0.0))], 1)
        out[speed < _UNDER_WAY_MPS] = ANY_ASPECT
        out[~self.boxes] = 0.0
        return out

    def expect_hull(self, vector: FloatArray) -> None:
        """Set the prior of the hull's dimensions from the widths of the boxes."""
        s = self.sightings
        rows = np.flatnonzero(np.isfinite(s.width_px))
        if rows.size < 3:
            return
        aspect = self.directions(vector)[rows]
        seen = 2.0 * (aspect[:, 1] + BEAM_SHARE * aspect[:, 0])
        each = s.width_px[rows] / self.pixels_per_metre(vector)[rows] / seen
        logs, of = np.unique(s.log[rows], return_inverse=True)
        half = np.array([np.median(each[of == one]) for one in range(logs.size)])
        self.sizes = TargetSizes.of(half)
        typical = self.sizes.half_length_m
        self.relative_size[rows] = (half / typical)[of]
        self.mean[TARGET] = typical, BEAM_SHARE * typical
        self.sigma[TARGET] = _SIZE_SHARE * typical, _SIZE_SHARE * BEAM_SHARE * typical
        self.middle_sigma_m = _MIDDLE_SHARE * typical
        self.half_lengths_m = typical * self.relative_size[:, None] * self.bow

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
        hull = aspect @ vector[TARGET]
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
                "nij,nj->ni", by_point[:, :, :2], self.bow * self.relative_size[:, None]
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
            place += vector[self.layout.middle] * self.relative_size * self.bow.T
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

    def sigmas(self, vector: FloatArray, noise: PixelNoise) -> FloatArray:
        """(N, 2) standard deviations of column and row, pixels, without correlated noise.

        What gaps of the logs make counts, as of each box alone.
        """
        by_place = self.project(vector, self.aspect(vector))[2][:, :, :2]
        place_m2 = self.place_sigma(noise) ** 2 + self.gap_sigma_m**2
        place = place_m2[:, None] * np.sum(by_place**2, axis=2)
        return np.asarray(np.sqrt(self.pixel_variance(vector, noise) + place))

    def beliefs(self, size: int) -> tuple[FloatArray, FloatArray]:
        """Prior mean of a vector of a size, and the matrix that whitens its deviations."""
        held = np.flatnonzero(self.held)
        out = np.zeros((held.size + size - self.size, size))
        out[np.arange(held.size), held] = 1.0 / self.sigma[held]
        if size > self.size:
            out[held.size, self.layout.middle] = 1.0 / self.middle_sigma_m
        return np.concatenate([self.mean, np.zeros(size - self.size)]), out

    def refine(
        self, start: FloatArray, noise: PixelNoise, left_out: BoolArray | None = None
    ) -> _Refined | None:
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
        # Without times the scatter of single places cannot be told from the target's path: see
        # `summarise`.
        latent = np.where(self.timed[:, None], place_variance, 0.0)
        shift = np.zeros((len(self.sightings), 2))
        absent = np.zeros(len(self.sightings), dtype=bool) if left_out is None else left_out
        weight = np.where(absent[:, None], _NO_WEIGHT, np.ones((len(self.sightings), 2)))
        for _ in range(_MOST_STEPS):
            pixel, jacobian, by_point = self.project(vector, aspect, shift)
            if not (np.isfinite(pixel).all() and np.isfinite(jacobian).all()):
                return None
            by_place = by_point[:, :, :2]
            residual = self.sightings.pixel_px - pixel + np.einsum("nij,nj->ni", by_place, shift)
            variance = self.pixel_variance(vector, noise)
            variance += place_variance * np.sum(by_place**2, axis=2)
            whitening = Whitening(
                self.blocks,
                variance / weight,
                by_place,
                noise,
                by_point[:, :, 2],
                self.half_lengths_m,
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
                shift += body + latent * np.einsum("nij,ni->nj", by_place, pull)
            standard = pull * np.sqrt(variance) / weight
            weight = np.minimum(1.0, _HUBER / np.maximum(np.abs(standard), 1e-9))
            weight[absent] = _NO_WEIGHT
            vector = vector + step
            if (np.abs(step) < _ENOUGH * np.sqrt(np.diag(covariance))).all():
                break
        if not self._ahead(vector):
            return None
        return _Refined(vector, shift, weight, standard)

    def with_estimated_noise(
        self, start: FloatArray, noise: PixelNoise
    ) -> tuple[_Refined | None, PixelNoise]:
        """The maximum of the posterior under noise that is estimated, and that noise.

        Errors in metres that last a second or two are a target's gait, or its log's. Likelihood
        does not tell which, and where derivatives are to be taken depends on it: where the log
        says, or where the target was. Both are tried, and the one is kept by which targets that
        were left out are placed better.
        """
        best, estimated = self.alternate(start, noise, _ROUNDS)
        if best is None or not self.blocks:
            return best, estimated
        self.of_log = 1.0
        other, of_other = self.alternate(best.vector, estimated, _MORE_ROUNDS)
        if other is not None:
            error_other = self.left_out_error(other, of_other)
            self.of_log = 0.0
            self.expect_hull(best.vector)
            error = self.left_out_error(best, estimated)
            if __import__("os").environ.get("VL"):
                print("LEFT", round(error, 4), round(error_other, 4), end=" ")
            if error_other < error:
                self.of_log = 1.0
                self.expect_hull(other.vector)
                return other, of_other
        self.of_log = 0.0
        self.expect_hull(best.vector)
        return best, estimated

    def alternate(
        self, start: FloatArray, noise: PixelNoise, rounds: int
    ) -> tuple[_Refined | None, PixelNoise]:
        """Parameters under the noise and noise under the parameters, in turn."""
        best = None
        for _ in range(rounds):
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

    def left_out_error(self, found: _Refined, noise: PixelNoise) -> float:
        """Root mean square error of the places of targets that were left out, metres."""
        s = self.sightings
        logs = np.unique(s.log[self.boxes])
        if logs.size < 2:
            return 0.0
        squares = []
        for fold in range(min(_FOLDS, logs.size)):
            left = self.boxes & np.isin(s.log, logs[fold::_FOLDS])
            without = self.refine(found.vector, noise, left_out=left)
            if without is None:
                return np.inf
            squares.append(self.squared_errors(without.vector, np.flatnonzero(left)))
        return float(np.sqrt(np.mean(np.concatenate(squares))))

    def squared_errors(self, vector: FloatArray, rows: IntArray) -> FloatArray:
        """(K,) squared errors of places, square metres; no more than half of the distance counts."""
        s = self.sightings
        camera = Camera.from_vector(vector[CAMERA], self.image_size_px)
        bias = vector[self.layout.sources].reshape(-1, len(SOURCE_PARAMETERS))[s.source[rows]]
        foot = s.pixel_px[rows] - np.stack([np.zeros(rows.size), bias[:, BIAS_PX]], axis=1)
        east, north = camera.locate(foot, s.above_m[rows] + bias[:, BIAS_M])
        at_east, at_north = self.place(vector)
        off = np.stack([at_east[rows] - camera.east_m, at_north[rows] - camera.north_m])
        distance = np.hypot(*off)
        hull = (self.aspect(vector)[rows] @ vector[TARGET]) / distance
        error = np.hypot(
            east - at_east[rows] + hull * off[0], north - at_north[rows] + hull * off[1]
        )
        most = 0.5 * distance
        return np.asarray(np.minimum(np.where(np.isfinite(error), error, most), most) ** 2)

    def reach(self, size: int) -> FloatArray:
        """(size,) the largest step of each parameter."""
        return np.concatenate([self.scale, np.full(size - self.size, self.middle_sigma_m)])

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
                last[:] = [
                    (
                        vector.copy(),
                        np.concatenate([residual, beliefs @ (vector - mean)]),
                        np.concatenate([by_parameter * slope[:, None], beliefs]),
                    )
                ]
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
        return (float(solution.cost), solution.x) if self._ahead(solution.x) else None

    def _ahead(self, vector: FloatArray) -> bool:
        """Whether most correspondences lie in front of the camera."""
        s = self.sightings
        heading = vector[HEADING]
        forward = np.sin(heading) * (s.east_m - vector[EAST]) + np.cos(heading) * (
            s.north_m - vector[NORTH]
        )
        return bool(np.mean(forward > 0.0) > 0.5)

    def linearise(self, found: _Refined) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Residuals (N, 2) and Jacobians by parameters and by points, logs corrected.

        What that took from the residuals is put back to first order. Only the correlated error is
        corrected: boxes that two people drew at one moment show one place. With derivatives at two
        places, a log that is off by very much would seem to explain how the boxes differ.
        """
        aspect = self.aspect(found.vector)
        pixel, jacobian, by_point = self.project(found.vector, aspect, found.correlated_m)
        put_back = np.einsum("nij,nj->ni", by_point[:, :, :2], found.correlated_m)
        return self.sightings.pixel_px - pixel + put_back, jacobian, by_point

    def estimate_noise(self, found: _Refined, before: PixelNoise) -> PixelNoise:
        """Maximum a posteriori noise of the residuals, with a weak prior on each part.

        The likelihood is that of the residuals with the parameters integrated out, linearised
        where they are (restricted maximum likelihood).
        """
        residual, jacobian, by_point = self.linearise(found)
        by_place = by_point[:, :, :2]
        n, size = len(self.sightings), found.vector.size
        mean, beliefs = self.beliefs(size)
        precision, off = beliefs.T @ beliefs, found.vector - mean
        per_metre = np.sum(by_place**2, axis=2)
        own_m = np.where(self.boxes, 0.0, self.sightings.sigma_m)
        known = (own_m**2)[:, None] * per_metre
        # Variances are these times the squares of the first four of `PixelNoise`.
        parts = np.zeros((4, n, 2))
        parts[0, :, 1] = 1.0
        parts[1, :, 1] = self.pixels_per_metre(found.vector) ** 2
        parts[2, :, 0] = 1.0
        parts[3] = np.where(self.boxes[:, None], per_metre, 0.0)
        names = ["row_px", "row_m", "column_px", "place_m"]
        if self.blocks:
            names += [
                "correlated_m",
                "correlation_time_s",
                "offset_m",
                "antenna_share",
                "lasting_m",
                "lasting_row_px",
                "lasting_column_px",
                "lasting_time_s",
            ]
        if self.heaving:
            names.append("heave_m")
        columns = np.concatenate([jacobian, residual[:, :, None]], axis=2)

        def negative_log(t: FloatArray) -> tuple[float, FloatArray]:
            now = replace(before, **dict(zip(names, np.exp(t).tolist(), strict=True)))
            if not self.blocks:
                now = replace(now, correlated_m=0.0)
            variance = (np.tensordot(np.exp(2.0 * t[:4]), parts, 1) + known) / found.weight
            whitening = Whitening(
                self.blocks, variance, by_place, now, by_point[:, :, 2], self.half_lengths_m
            )
            both = whitening.forward(columns)
            flat = both.reshape(-1, size + 1)
            factor = cho_factor(
                flat[:, :-1].T @ flat[:, :-1] + precision, lower=True, check_finite=False
            )
            slope = flat[:, :-1].T @ flat[:, -1] - precision @ off
            step = cho_solve(factor, slope, check_finite=False)
            value = 0.5 * float(flat[:, -1] @ flat[:, -1] + off @ precision @ off - slope @ step)
            value += whitening.log_determinant() + float(np.log(np.diag(factor[0])).sum())
            solved = whitening.backward(both)
            covariance = cho_solve(factor, np.eye(size), check_finite=False)
            by_variance, by_name = whitening.gradient(
                solved[:, :, -1] - solved[:, :, :-1] @ step, solved[:, :, :-1], covariance
            )
            by_part = np.tensordot(parts, by_variance / found.weight, 2)
            by_name |= dict(
                zip(names[:4], (2.0 * np.exp(2.0 * t[:4]) * by_part).tolist(), strict=True)
            )
            gradient = np.array([by_name[name] for name in names])
            for i, name in enumerate(names):
                prior = _NOISE_PRIOR[name]
                if len(prior) == 2:
                    belief = (t[i] - np.log(prior[0])) / prior[1]
                    value += 0.5 * belief**2
                    gradient[i] += belief / prior[1]
                else:
                    value += float(np.exp(t[i])) / prior[0]
                    gradient[i] += np.exp(t[i]) / prior[0]
                    if name in _AVOID:
                        value -= t[i]
                        gradient[i] -= 1.0
            return value, gradient

        bounds, at = [], []
        for name in names:
            prior = _NOISE_PRIOR[name]
            low, high = (
                (np.log(prior[0]) - 4.0 * prior[1], np.log(prior[0]) + 4.0 * prior[1])
                if len(prior) == 2
                else (np.log(prior[0]) - 6.0, np.log(prior[0]) + 6.0)
            )
            bounds.append((low, high))
            value = getattr(before, name)
            at.append(np.clip(np.log(value) if value > 0.0 else np.log(0.3 * prior[0]), low + 0.7, high - 0.7))
        best = minimize(
            negative_log,
            np.array(at),
            jac=True,
            method="L-BFGS-B",
            bounds=bounds,
            options={"maxiter": 25, "ftol": 1e-6},
        )
        return replace(before, **dict(zip(names, np.exp(best.x).tolist(), strict=True)), **({} if self.blocks else {"correlated_m": 0.0}))

    def summarise(
        self, found: _Refined, noise: PixelNoise, ends: list[FloatArray], starts: int
    ) -> CameraFit:
        """The fit with its covariance, from the best optimum and those of all starts."""
        residual, jacobian, by_point = self.linearise(found)
        by_place = by_point[:, :, :2]
        variance = self.pixel_variance(found.vector, noise)
        variance += (self.place_sigma(noise) ** 2)[:, None] * np.sum(by_place**2, axis=2)
        # Errors of one recording are alike, so that it tells less than its number of boxes.
        shares = [self._shared_error(found.standard[:, axis]) for axis in (0, 1)]
        crowding = np.stack([self._crowding(share) for share in shares], axis=1)
        whitening = Whitening(
            self.blocks,
            variance * crowding / found.weight,
            by_place,
            noise,
            by_point[:, :, 2],
            self.half_lengths_m,
        )
        scaled = whitening.forward(jacobian).reshape(-1, found.vector.size)
        _, beliefs = self.beliefs(found.vector.size)
        whole: FloatArray = np.linalg.pinv(
            scaled.T @ scaled + beliefs.T @ beliefs, hermitian=True
        ).astype(np.float64)
        leverage = np.einsum("nj,jk,nk->n", scaled, whole, scaled).reshape(-1, 2).sum(axis=1)
        # Beliefs bound how far it goes.
        pulled = whole @ self._attenuation(found.vector, noise, variance * crowding / found.weight)
        limit = np.append(_MOST_PULLED * self.sigma, np.inf)
        pulled *= min(1.0, float(np.min(limit / np.maximum(np.abs(pulled), 1e-12))))
        whole = whole + np.outer(pulled, pulled)
        vector, covariance = found.vector[: self.size], whole[: self.size, : self.size]
        return CameraFit(
            vector=vector,
            covariance=covariance,
            prior_sigma=self.sigma,
            clock_groups=self.clock_groups,
            noise=replace(noise, middle_m=float(abs(found.vector[self.layout.middle]))),
            image_size_px=self.image_size_px,
            residual_px=residual,
            standard_residual=np.sqrt(np.mean(found.standard**2, axis=1)),
            leverage=leverage,
            outlier=np.asarray(np.abs(found.standard).max(axis=1) > _OUTLIER),
            starts_agreeing=sum(self._same(end, vector, covariance) for end in ends),
            starts=starts,
            typical_range_m=float(
                np.median(
                    np.hypot(
                        self.sightings.east_m - vector[EAST], self.sightings.north_m - vector[NORTH]
                    )
                )
            ),
            sizes=self.sizes,
        )

    def with_all(self, fit: CameraFit, chosen: IntArray) -> CameraFit:
        """A fit to a subset, extended by the residuals of all correspondences."""
        pixel, _, by_point = self.project(fit.vector, self.aspect(fit.vector))
        per_metre = np.sum(by_point[:, :, :2] ** 2, axis=2)
        sigma = np.hypot(
            self.sigmas(fit.vector, fit.noise), fit.noise.correlated_m * np.sqrt(per_metre)
        )
        residual = self.sightings.pixel_px - pixel
        standard = residual / sigma
        residual[chosen] = fit.residual_px
        leverage = np.zeros(len(self.sightings))
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
        rows = self.boxes & ~self.timed
        out = np.zeros(vector.size)
        if not rows.any():
            return out
        aspect = self.aspect(vector)
        weight = (0.5 * noise.place_m**2 / variance_px2)[rows]
        for i in range(len(PARAMETERS)):
            apart = 1e-4 * self.scale[i]
            squares = []
            for side in (-1.0, 1.0):
                moved = vector.copy()
                moved[i] += side * apart
                by_point = self.project(moved, aspect)[2][rows]
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
        group = self.sightings.group
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
        s = self.sightings
        _, inverse, count = np.unique(s.group, return_inverse=True, return_counts=True)
        timed = np.flatnonzero(self.timed)
        moment = np.stack([s.log[timed].astype(float), s.time_s[timed]], axis=1)
        _, at, alike = np.unique(moment, axis=0, return_inverse=True, return_counts=True)
        of_moment = np.ones(len(s))
        of_moment[timed] = alike[at.ravel()]
        return np.asarray((1.0 + (count[inverse] - 1.0) * share) * of_moment)
