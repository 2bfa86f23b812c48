"""The models `camera` and `camera+gpr`: positions with covariance from boxes."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils.validation import check_is_fitted

from sightline.camera.calibration import CameraFit, CameraFitSettings, expected_fit, fit_camera
from sightline.camera.correlated_noise import CorrelatedError
from sightline.camera.parameters import (
    CAMERA_AND_TARGET,
    CURVATURE,
    HALF_LENGTH,
    PRINCIPAL_DX,
    SOURCE_PARAMETERS,
    TARGET,
    ParameterLayout,
)
from sightline.camera.pinhole import (
    BY_ABOVE,
    BY_BEYOND,
    BY_COLUMN,
    BY_ROW,
    Camera,
    locate_with_jacobian,
)
from sightline.camera.priors import (
    ANY_ASPECT,
    ANY_ASPECT_SPREAD,
    CameraPrior,
    PixelNoise,
    SourcePrior,
)
from sightline.camera.target_sizes import USUAL_SPREAD, TargetSizes
from sightline.georeferencing.model_file import numbers_of_shape
from sightline.georeferencing.observations import CameraObservations
from sightline.georeferencing.one_box import MOST_SQUARED, place_one
from sightline.georeferencing.paper.estimator import Arrays, Settings
from sightline.georeferencing.placement import Placement
from sightline.georeferencing.residual_gp import Hyperparameters, ResidualProcess
from sightline.types import BoolArray, FloatArray, IntArray, StrArray

FEWEST_FOR_RESIDUAL = 10
"""With fewer boxes a camera is all that can be learned."""

LARGEST_RELATIVE_SIGMA = 0.5
"""A box whose range is less certain than this share of itself has no position; one nearer than what
the camera was learned from, if it is less certain than this share of that."""

LARGEST_GAP_SIGMA_M = 1.0
"""The residual process learns from boxes in gaps of a log where these say the place to this."""

UNSEEN_BIAS_PX = 5.0
"""Standard deviation of the lower-edge bias of an unseen source: detectors that were trained on
other boats end their boxes 6 to 8 px too high, people who draw boxes differ by as much."""

# Prior of what earlier models took as known.
_EXACT = 1e-9
# The prior weighs as much as so many known sources.
_UNSEEN_WEIGHT = 2.0
_LENGTH_SCALES = (2.0, 1.0, 0.4, 0.7)
_INPUTS = len(_LENGTH_SCALES)
# So that what is known of a chunk stays in a core's own cache.
_CHUNK = 1024


class CameraRegressor(RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """A fitted camera, with a Gaussian process on its residual.

    Args:
        image_size_px: Width and height.
        residual: Whether to learn the residual process (`camera+gpr`) or only the camera.
        prior: Prior of the camera; None: that of an ordinary one.
        source_priors: Priors of the biases of sources, by their names; others have ``prior``'s.
        noise: Noise of a foot, taken as known; None: estimated from the residuals.
        position_known: Whether the camera stands at the origin of the plane, as far as one knows.
        heaving: Whether the camera is on a vessel, whose heave is no error of the log.
        starts: Random starting cameras of the fit.
        random_state: Seed of the starts.
        above_sigma_m: Standard deviation of the water level (``above_m``); 0 where that is not
            asked.

    Attributes:
        fit_: The fitted camera and its uncertainty, a `CameraFit`.
        sources_: Names of the sources of boxes, in the order of their biases.
        range_process_: Residual of the log-range, or None.
        bearing_process_: Residual of the bearing, radians, or None.
    """

    def __init__(
        self,
        image_size_px: tuple[int, int] = (1280, 720),
        *,
        residual: bool = True,
        prior: CameraPrior | None = None,
        source_priors: Mapping[str, SourcePrior] | None = None,
        noise: PixelNoise | None = None,
        position_known: bool = True,
        heaving: bool = False,
        starts: int = 8,
        random_state: int = 0,
        above_sigma_m: float = 0.0,
    ) -> None:
        self.image_size_px = image_size_px
        self.residual = residual
        self.prior = prior
        self.source_priors = source_priors
        self.noise = noise
        self.position_known = position_known
        self.heaving = heaving
        self.starts = starts
        self.random_state = random_state
        self.above_sigma_m = above_sigma_m

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Fit to boxes of one target, of which nothing is known but its places.

        Args:
            X: (N, 4) boxes, pixels.
            y: (N, 2) metres east and north.

        Raises:
            FitError: The pairs are too few, or all in one place.
            InputError: A box is none, or there are more boxes than places, or fewer.
        """
        return self.fit_observations(CameraObservations(np.asarray(X), np.asarray(y)))

    def fit_observations(self, observations: CameraObservations) -> Self:
        """Fit to boxes and landmarks, with all that is known of them.

        Raises:
            FitError: The boxes are too few, or all in one place.
        """
        o, n = observations, len(observations)
        self.sources_ = o.sources
        self._group, self._log = o.group, o.log
        self.fit_ = fit_camera(
            o.sightings(),
            self.image_size_px,
            n_sources=len(self.sources_),
            prior=self.prior,
            beliefs={
                self.sources_.index(name): belief
                for name, belief in (self.source_priors or {}).items()
                if name in self.sources_
            },
            noise=PixelNoise(correlated_m=0.0) if n == 0 else self.noise,
            settings=CameraFitSettings(
                position_known=self.position_known,
                heaving=self.heaving,
                starts=self.starts,
                seed=self.random_state,
                clocks=o.clocks_by_group,
            ),
        )
        self.n_features_in_ = 4
        self.typical_speed_mps_ = float(np.sqrt(np.mean(o.velocity_mps**2) * 2.0)) if n else 0.0
        self._prepare()
        self.range_process_: ResidualProcess | None = None
        self.bearing_process_: ResidualProcess | None = None
        if self.residual and n >= FEWEST_FOR_RESIDUAL:
            offset = self.fit_.clock_offset_s
            clocks = dict(zip(self.fit_.clock_groups.tolist(), offset.tolist(), strict=True))
            late = np.array([clocks.get(int(g), 0.0) for g in self._group])
            self._learn_residual(o, o.east_north_m + late[:, None] * o.velocity_mps)
        return self

    def expect_observations(self, observations: CameraObservations, camera: Camera) -> Self:
        """Become the model that `fit_observations` would lead to if it found the true camera.

        Without the residual process, which learns what no plan knows.

        Args:
            observations: As the camera sees them, with noise where ``noise`` is to be estimated.
            camera: The true one.

        Raises:
            FitError: The boxes are too few, or all in one place.
        """
        self.sources_ = observations.sources
        self.fit_ = expected_fit(
            observations.sightings(),
            camera,
            n_sources=len(self.sources_),
            prior=self.prior,
            noise=self.noise,
            settings=CameraFitSettings(position_known=self.position_known, heaving=self.heaving),
        )
        self.n_features_in_ = 4
        speeds = observations.velocity_mps
        self.typical_speed_mps_ = float(np.sqrt(np.mean(speeds**2) * 2.0)) if len(speeds) else 0.0
        self._prepare()
        self.range_process_ = self.bearing_process_ = None
        return self

    def predict(
        self,
        X: ArrayLike,
        *,
        source: ArrayLike | None = None,
        above_m: ArrayLike = 0.0,
        return_cov: bool = False,
        return_shared: bool = False,
    ) -> Any:
        """Positions of boxes.

        Args:
            X: (N, 4) boxes, pixels.
            source: (N,) str or one for all, who made the boxes. A source that was not learned
                from counts as `bias` says.
            above_m: (N,) or one value: how high the water stands above the plane that the camera's
                height is over; below the camera.
            return_cov: Whether to return covariances too.
            return_shared: Whether to return, besides, the part of them that a target has in
                common with itself a moment later: all but the noise of the box.

        Returns:
            (N, 2) metres east and north, NaN where there is no position: at or above the horizon,
            and where the range would be less certain than half of itself. With ``return_cov``
            also (N, 2, 2) square metres: parameters of the camera, noise of the box, residual;
            with ``return_shared`` another (N, 2, 2).
        """
        if not hasattr(self, "fit_"):
            check_is_fitted(self, "fit_")
        boxes = np.asarray(X, dtype=np.float64)
        n = len(boxes)
        above = np.asarray(above_m, dtype=np.float64)
        # One level for all is not spread over the boxes, which would cost every batch.
        each = above.ndim > 0
        if n == 1:
            name = "" if source is None else str(np.ravel(source)[0])
            one = place_one(self, boxes[0], name, self._largest_sigma_m, float(above.ravel()[0]))
            if one is not None:
                return one if return_shared else one[:2] if return_cov else one[0]
        places, covariance = np.empty((n, 2)), np.empty((n, 2, 2))
        shared = np.empty((n if return_shared else 0, 2, 2))
        if source is None or np.ndim(source) == 0:
            parts: list[tuple[str, IntArray | None]] = [(str(source or ""), None)]
        else:
            names = np.asarray(source, dtype=np.str_)
            parts = [(str(name), np.flatnonzero(names == name)) for name in np.unique(names)]
        for name, rows in parts:
            count = len(boxes) if rows is None else len(rows)
            for start in range(0, count, _CHUNK):
                part = slice(start, start + _CHUNK)
                if rows is None:
                    level = above[part] if each else above
                    self._place(
                        boxes[part], name, level, places[part], covariance[part], shared[part]
                    )
                    continue
                chosen = rows[part]
                level = above[chosen] if each else above
                where, spread = np.empty((chosen.size, 2)), np.empty((chosen.size, 2, 2))
                common = np.empty((chosen.size if return_shared else 0, 2, 2))
                self._place(boxes[chosen], name, level, where, spread, common)
                places[chosen], covariance[chosen] = where, spread
                if return_shared:
                    shared[chosen] = common
        if return_shared:
            return places, covariance, shared
        return (places, covariance) if return_cov else places

    @property
    def camera(self) -> Camera:
        """The fitted camera."""
        return self.camera_

    @property
    def camera_fit(self) -> CameraFit:
        """The fitted camera with its covariance."""
        return self.fit_

    @property
    def reference_sigma_m(self) -> float:
        """Correlated error of the logs that it learned from, metres east and north."""
        return self.fit_.noise.correlated_m

    def locate(
        self, boxes_xyxy_px: FloatArray, source: StrArray | None, above_m: FloatArray
    ) -> Placement:
        """As `predict`, with covariances and their shared part."""
        return Placement(
            *self.predict(boxes_xyxy_px, source=source, above_m=above_m, return_shared=True)
        )

    def bias(self, source: str) -> tuple[FloatArray, FloatArray]:
        """Lower-edge bias of a source, (2,) pixels and metres, and its covariance with the camera.

        The covariance is (13, 13): the camera's nine parameters, the target's two, and the two of
        the bias. A source that was not learned from is what the prior says of such, and how far the
        known ones are from that says how far it may be.
        """
        fit, prior = self.fit_, self.prior or CameraPrior()
        name = self.sources_[0] if not source and len(self.sources_) == 1 else source
        if name in self.sources_:
            own = fit.layout.source(self.sources_.index(name))
            chosen = np.r_[CAMERA_AND_TARGET, own]
            return fit.vector[own], fit.covariance[np.ix_(chosen, chosen)]
        count = len(self.sources_)
        mean = np.array([prior.unseen_px, prior.unseen_m])
        expected = np.array([max(UNSEEN_BIAS_PX, prior.bias_px_sigma), prior.bias_m_sigma])
        known, each = fit.layout.sources, len(SOURCE_PARAMETERS)
        squares = (fit.vector[known].reshape(-1, each) - mean) ** 2
        squares += np.diag(fit.covariance)[known].reshape(-1, each)
        spread = _UNSEEN_WEIGHT * expected**2 + squares.sum(axis=0)
        alone, both = ParameterLayout(n_sources=1, n_clocks=0), CAMERA_AND_TARGET
        covariance = np.zeros((alone.size, alone.size))
        covariance[both, both] = fit.covariance[both, both]
        covariance[alone.sources, alone.sources] = np.diag(spread / (_UNSEEN_WEIGHT + count))
        return mean, covariance

    def _prepare(self) -> None:
        """Precompute what every prediction needs: the camera, and the bias of each source."""
        # By how much a target moves while the clock is unsure, along either axis.
        self.clock_variance = 0.5 * (self.fit_.clock_sigma_s * self.typical_speed_mps_) ** 2
        self.camera_: Camera = self.fit_.camera
        self.half_m = self.fit_.vector[TARGET]
        # Of a box nobody knows the course, and so not to which side of its middle the receiver is.
        noise, half_length = self.fit_.noise, self.half_m[0]
        # Targets of one size are likely one target, whose receiver stands where it always does.
        sizes = self.fit_.sizes
        alike = 0.0 if sizes is None else min(sizes.log_sigma / USUAL_SPREAD, 1.0)
        self.aboard_m2 = float(noise.middle_m**2 + (alike * noise.antenna_share * half_length) ** 2)
        # A log that drifts is off by as much from the start. What is constant beyond that, a box
        # may have as well, as far as anyone can tell.
        constant = max(noise.offset_m**2 - noise.correlated_m**2, 0.0)
        self.lasting_m2 = noise.lasting_m**2 + constant
        self._biases: dict[str, tuple[float, float, FloatArray, FloatArray]] = {}

    def bias_root(self, source: str) -> tuple[float, float, FloatArray, FloatArray]:
        """Bias of a source, pixels and metres, and a root of the covariance of all parameters.

        The root is (16, 15): its product with `Located.derivatives`, but for the last, has the
        square that the covariance gives, but for the target's part. That is (16, 2), to be
        multiplied by the shares of half length and half beam along the line of sight.
        """
        if source not in self._biases:
            bias, covariance = self.bias(source)
            values, vectors = np.linalg.eigh(covariance)
            root = (vectors * np.sqrt(np.maximum(values, 0.0))).T
            of_target = np.ascontiguousarray(root[:, TARGET])
            root = np.delete(root, HALF_LENGTH, axis=1)
            # The reach of a hull is the box's own: see `hull`.
            root[:, BY_BEYOND] = 0.0
            # What the bias adds to the row is taken off before the place is looked up.
            root[:, BY_ROW] *= -1.0
            self._biases[source] = (
                float(bias[0]),
                float(bias[1]),
                np.ascontiguousarray(root),
                of_target,
            )
        return self._biases[source]

    def reach(self, width_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """How far hulls of some apparent widths reach towards the camera: see `TargetSizes`.

        Of models that were fitted without it, every target is a typical one of any course.
        """
        if self.fit_.sizes is not None:
            return self.fit_.sizes.reach(width_m)
        any_aspect = np.full(width_m.shape, ANY_ASPECT)
        spread = np.array(ANY_ASPECT_SPREAD)[:, None] * np.ones(width_m.shape)
        return any_aspect, any_aspect, spread

    def _largest_sigma_m(self, distance_m: float) -> float:
        return LARGEST_RELATIVE_SIGMA * max(distance_m, self.fit_.typical_range_m)

    def _see(
        self, boxes: FloatArray, source: str, above_m: FloatArray, *, heave: bool = True
    ) -> _Seen:
        bias_px, bias_m, root, of_target = self.bias_root(source)
        camera = self.camera_
        column, row = 0.5 * (boxes[:, 0] + boxes[:, 2]), boxes[:, 3] - bias_px
        hull = _Hulls(self, boxes[:, 2] - boxes[:, 0], above_m)
        at = locate_with_jacobian(camera, column, row, bias_m + above_m, hull)
        by = at.derivatives
        shift = (root @ by[:BY_COLUMN].reshape(BY_COLUMN, -1)).reshape(len(root), 2, -1)
        shift[:, 0] += of_target @ hull.shares
        moved = np.einsum("kin,kin->in", shift, shift)
        skewed = _ranges_variance(moved[0], at.distance_m) - moved[0]
        if self.above_sigma_m > 0.0:
            moved[0] += np.square(self.above_sigma_m * by[BY_ABOVE, 0])
        slant = at.distance_m * at.distance_m + (camera.height_m - above_m) ** 2
        by_column, by_row = by[BY_COLUMN], by[BY_ROW]
        box = self.fit_.noise if heave else replace(self.fit_.noise, heave_m=0.0)
        of_column, of_row = box.variances_px2(camera.focal_px**2 / slant)
        noise = of_column * by_column * by_column
        noise += of_row * by_row * by_row
        noise += self.fit_.noise.place_m**2
        last_column, last_row = box.lasting_px2()
        lasting = last_column * by_column * by_column + last_row * by_row * by_row
        lasting += self.lasting_m2
        lasting += self.aboard_m2 * hull.squares
        lasting[0] += hull.variance_m2
        lasting_mixed = last_column * by_column[0] * by_column[1] + last_row * by_row[0] * by_row[1]
        return _Seen(
            at.distance_m,
            at.sine,
            at.cosine,
            moved=moved,
            skewed=skewed,
            moved_mixed=np.einsum("kn,kn->n", shift[:, 0], shift[:, 1]),
            noise=noise + lasting,
            noise_mixed=of_column * by_column[0] * by_column[1]
            + of_row * by_row[0] * by_row[1]
            + lasting_mixed,
            lasting=lasting,
            lasting_mixed=lasting_mixed,
            by_pixel=np.stack([by_column, by_row], axis=1),
            hull=np.sqrt(np.maximum(hull.variance_m2, 0.0)),
        )

    def _inputs(self, boxes: FloatArray, seen: _Seen, source: str) -> FloatArray:
        """(N, 4) inputs of the residual: bearing, log-range, log of apparent height, width.

        The bearing is off the optical axis, radians; heights and widths are metres.
        """
        heading = math.radians(self.camera_.heading_deg)
        sine, cosine = math.sin(heading), math.cos(heading)
        out = np.empty((4, len(boxes)))
        np.arctan2(
            seen.sine * cosine - seen.cosine * sine,
            seen.cosine * cosine + seen.sine * sine,
            out=out[0],
        )
        out[1] = seen.distance
        metres_per_pixel = seen.distance / self.camera_.focal_px
        bias_px = self.bias_root(source)[0]
        out[2] = np.maximum(boxes[:, 3] - boxes[:, 1] - bias_px, 0.5) * metres_per_pixel
        out[3] = (boxes[:, 2] - boxes[:, 0]) * metres_per_pixel
        np.log(out[1:], out=out[1:])
        return out.T

    def _place(
        self,
        boxes: FloatArray,
        source: str,
        above_m: FloatArray,
        places: FloatArray,
        covariance: FloatArray,
        shared: FloatArray,
    ) -> None:
        """Fill in the places (N, 2) and covariances (N, 2, 2) of boxes of one source.

        The shared part of the covariances is filled in where ``shared`` has room for it.
        """
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            seen = self._see(boxes, source, above_m)
            reach = np.maximum(seen.distance, self.fit_.typical_range_m)
            limit = (LARGEST_RELATIVE_SIGMA * reach) ** 2
            known = seen.moved[0] + seen.noise[0] < limit
        distance, sine, cosine = seen.distance, seen.sine, seen.cosine
        along, across = seen.moved + self.clock_variance
        along += seen.skewed
        mixed = seen.moved_mixed
        if self.range_process_ is None or self.bearing_process_ is None:
            own_along, own_across = seen.noise
            along += own_along
            across += own_across
            mixed = mixed + seen.noise_mixed
            alike_mixed = seen.lasting_mixed
        else:
            alike_mixed = np.zeros_like(mixed)
            rows = slice(None) if known.all() else known
            near = seen[rows]
            inputs = self._inputs(boxes[rows], near, source)
            own = np.sqrt(near.noise) / near.distance
            stretch, stretch_variance = self.range_process_.predict(inputs, own[0])
            turn, turn_variance = self.bearing_process_.predict(inputs, own[1])
            further = near.distance * np.exp(stretch)
            scale = further * further
            along[rows] += stretch_variance * scale
            across[rows] += turn_variance * scale
            own_along, own_across = np.zeros_like(along), np.zeros_like(across)
            own_along[rows] = (self.range_process_.hyperparameters.noise * own[0]) ** 2 * scale
            own_across[rows] = (self.bearing_process_.hyperparameters.noise * own[1]) ** 2 * scale
            sin_t, cos_t = np.sin(turn), np.cos(turn)
            distance[rows] = further
            sine[rows], cosine[rows] = (
                near.sine * cos_t + near.cosine * sin_t,
                near.cosine * cos_t - near.sine * sin_t,
            )
        places[:, 0] = self.camera_.east_m + distance * sine
        places[:, 1] = self.camera_.north_m + distance * cosine
        _turn(along, across, mixed, sine, cosine, covariance)
        if shared.size:
            # Of the box's noise, the part that a moment later is the same.
            alike = seen.lasting / seen.noise
            _turn(
                along - own_along * (1.0 - alike[0]),
                across - own_across * (1.0 - alike[1]),
                seen.moved_mixed + alike_mixed,
                sine,
                cosine,
                shared,
            )
        if not known.all():
            places[~known] = np.nan
            covariance[~known] = np.nan
            shared[~known[: len(shared)]] = np.nan

    def _learn_residual(self, observations: CameraObservations, places: FloatArray) -> None:
        """Fit the Gaussian processes to the residual; places (N, 2) are corrected for clocks."""
        boxes, names, n = observations.boxes_xyxy_px, observations.source, len(observations)
        inputs, targets = np.full((n, 4), np.nan), np.full((n, 2), np.nan)
        noise = np.full((n, 2), np.nan)
        hull = np.full(n, np.nan)
        sight, by_pixel = np.full((n, 2), np.nan), np.full((n, 2, 2), np.nan)
        camera = self.camera_
        east, north = places[:, 0] - camera.east_m, places[:, 1] - camera.north_m
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            for name in np.unique(names):
                rows = np.flatnonzero(names == name)
                # Heave is in the correlated error, below.
                seen = self._see(boxes[rows], str(name), observations.above_m[rows], heave=False)
                inputs[rows] = self._inputs(boxes[rows], seen, str(name))
                own = seen.noise - seen.lasting
                noise[rows] = np.sqrt(own / np.square(seen.distance)).T
                hull[rows] = seen.hull / seen.distance
                by_pixel[rows] = np.moveaxis(seen.by_pixel / seen.distance, -1, 0)
                sight[rows] = np.stack([seen.sine, seen.cosine], axis=1) / seen.distance[:, None]
                turn = np.arctan2(east[rows], north[rows]) - np.arctan2(seen.sine, seen.cosine)
                targets[rows, 0] = np.log(np.hypot(east[rows], north[rows]) / seen.distance)
                targets[rows, 1] = np.arctan2(np.sin(turn), np.cos(turn))
            usable = (
                ~observations.bias_only
                & np.isfinite(inputs).all(axis=1)
                & np.isfinite(targets).all(axis=1)
                & (noise[:, 0] < LARGEST_RELATIVE_SIGMA)
                & ~self.fit_.outlier[:n]
                # What a vessel did in a gap of its log is not what the camera leaves.
                & (observations.fix_sigma_m <= max(self.fit_.noise.place_m, LARGEST_GAP_SIGMA_M))
            )
        if usable.sum() < FEWEST_FOR_RESIDUAL:
            return
        speed = np.hypot(*observations.velocity_mps.T)[:, None]
        ahead_m = self.half_m[0] * observations.velocity_mps / np.maximum(speed, 1e-9)
        ahead_m[observations.at_middle] = 0.0

        def learn(axis: int) -> ResidualProcess:
            along_or_across = sight if axis == 0 else sight[:, ::-1] * (1.0, -1.0)
            log_error = CorrelatedError(
                observations.time_s,
                self._log,
                self.fit_.noise,
                along_or_across,
                by_pixel[:, axis],
                np.einsum("ni,ni->n", along_or_across, ahead_m),
                hull if axis == 0 else np.zeros(n),
                # Heave changes all ranges by the same share, and no bearing.
                1.0 / camera.height_m if axis == 0 else 0.0,
            )
            known = log_error[usable]
            limit = 3.0 * np.sqrt(noise[usable, axis] ** 2 + np.diag(known.covariance()))
            return ResidualProcess(
                inputs[usable],
                np.clip(targets[usable, axis], -limit, limit),
                noise[usable, axis],
                self._group[usable],
                length_scales=_LENGTH_SCALES,
                log_error=known,
            )

        self.range_process_, self.bearing_process_ = learn(0), learn(1)
        # A process that places what was left out worse, by more than chance, is none; nor is one
        # that describes single passages: what a camera leaves varies slowly from place to place.
        gain, error = self.range_process_.gain()
        if gain < -error or self.range_process_.too_rough:
            self.range_process_ = self.bearing_process_ = None

    def with_fit(self, fit: CameraFit) -> Self:
        """The model with another fit of its camera, of the same sources."""
        other = copy.copy(self)
        other.fit_ = fit
        other._prepare()
        return other

    def without_residual(self) -> Self:
        """The camera of this model alone."""
        plain = copy.copy(self)
        plain.residual = False
        plain.range_process_ = plain.bearing_process_ = None
        return plain

    def state(self) -> tuple[Arrays, Settings]:
        """State that `from_state` restores: arrays, and the rest as JSON can hold it."""
        check_is_fitted(self, "fit_")
        fit = self.fit_
        arrays: Arrays = {
            "vector": fit.vector,
            "covariance": fit.covariance,
            "prior_sigma": fit.prior_sigma,
            "clock_groups": fit.clock_groups,
        }
        settings: Settings = {
            "image_size_px": list(self.image_size_px),
            "residual": self.residual,
            "position_known": self.position_known,
            "sources": list(self.sources_),
            "noise": {name: getattr(fit.noise, name) for name in fit.noise.__dataclass_fields__},
            "prior": {name: getattr(self.prior, name) for name in CameraPrior.__dataclass_fields__}
            if self.prior
            else None,
            # Only where there is something to say: other models stay as they were.
            **({"above_sigma_m": self.above_sigma_m} if self.above_sigma_m else {}),
            "starts_agreeing": fit.starts_agreeing,
            "starts": fit.starts,
            "typical_range_m": fit.typical_range_m,
            "typical_speed_mps": self.typical_speed_mps_,
            "sizes": None
            if fit.sizes is None
            else {
                "half_length_m": fit.sizes.half_length_m,
                "log_sigma": fit.sizes.log_sigma,
                "wider": fit.sizes.wider,
            },
        }
        for key, process in (("range", self.range_process_), ("bearing", self.bearing_process_)):
            if process is not None:
                arrays[f"{key}.inputs"] = process.inputs
                arrays[f"{key}.targets"] = process.targets
                arrays[f"{key}.noise"] = process.noise
                arrays[f"{key}.group"] = process.group
                if process.log_error is not None:
                    arrays[f"{key}.time"] = process.log_error.time_s
                    arrays[f"{key}.direction"] = process.log_error.direction
                    arrays[f"{key}.log"] = process.log_error.log
                    arrays[f"{key}.by_pixel"] = process.log_error.by_pixel
                    arrays[f"{key}.aboard"] = process.log_error.aboard
                    arrays[f"{key}.hull"] = process.log_error.hull
                settings[key] = {
                    "hyperparameters": process.hyperparameters.to_list(),
                    "length_scales": list(process.length_scales),
                }
        return arrays, settings

    @classmethod
    def from_state(cls, arrays: Arrays, settings: Settings) -> Self:
        """Restore the model from its `state`.

        Args:
            arrays: Of `state`.
            settings: Of `state`.

        Raises:
            LookupError: A part is missing.
            ValueError: A part does not fit the others.
        """
        prior = settings["prior"]
        if prior is not None:
            pairs = {k: tuple(v) for k, v in prior.items() if isinstance(v, list)}
            prior = CameraPrior(**{**prior, **pairs})
        width, height = (int(v) for v in settings["image_size_px"])
        model = cls(
            (width, height),
            residual=bool(settings["residual"]),
            prior=prior,
            position_known=bool(settings["position_known"]),
            above_sigma_m=float(settings.get("above_sigma_m", 0.0)),
        )
        model.sources_ = tuple(settings["sources"])
        if not all(isinstance(source, str) for source in model.sources_):
            raise TypeError("a source of boxes is no text")
        clock_groups = np.array(arrays["clock_groups"], dtype=np.int64)
        size = ParameterLayout(len(model.sources_), clock_groups.size).size
        arrays = _with_all_parameters(arrays, size)
        vector = np.array(arrays["vector"], dtype=np.float64).reshape(size)
        nothing = np.empty(0)
        sizes = settings.get("sizes")
        if sizes is not None:
            sizes = TargetSizes(
                float(sizes["half_length_m"]),
                float(sizes["log_sigma"]),
                float(sizes.get("wider", 1.0)),
            )
        model.fit_ = CameraFit(
            vector=vector,
            covariance=np.array(arrays["covariance"], dtype=np.float64).reshape(size, size),
            prior_sigma=np.array(arrays["prior_sigma"], dtype=np.float64).reshape(size),
            clock_groups=clock_groups,
            noise=PixelNoise(**{name: float(v) for name, v in settings["noise"].items()}),
            image_size_px=model.image_size_px,
            residual_px=np.empty((0, 2)),
            standard_residual=nothing,
            leverage=nothing,
            outlier=np.empty(0, dtype=np.bool_),
            starts_agreeing=int(settings["starts_agreeing"]),
            starts=int(settings["starts"]),
            typical_range_m=float(settings["typical_range_m"]),
            sizes=sizes,
        )
        if not (np.isfinite(vector).all() and np.isfinite(model.fit_.covariance).all()):
            raise ValueError("a parameter of the camera is not a number")
        if clock_groups.ndim != 1 or not (model.fit_.prior_sigma > 0.0).all():
            raise ValueError("what was assumed of the camera is not a number")
        model.n_features_in_ = 4
        model.typical_speed_mps_ = float(settings["typical_speed_mps"])
        model._prepare()
        processes = [
            _restored_process(key, arrays, settings[key], model.fit_, model.camera_.height_m)
            if key in settings
            else None
            for key in ("range", "bearing")
        ]
        model.range_process_, model.bearing_process_ = processes
        return model


def _ranges_variance(along_m2: FloatArray, distance_m: FloatArray) -> FloatArray:
    """As `ranges_variance`, of many."""
    squared = np.minimum(along_m2 / (distance_m * distance_m), MOST_SQUARED)
    spread = np.expm1(2.0 * squared) - 2.0 * np.expm1(0.5 * squared)
    return np.asarray(distance_m * distance_m * spread)


def _with_all_parameters(arrays: Arrays, size: int) -> Arrays:
    """Arrays of a model file; earlier ones had no principal point and no curvature.

    Theirs are those of the middle of the image and of a plane, exactly known.
    """
    vector = np.asarray(arrays["vector"], dtype=np.float64)
    later = np.arange(PRINCIPAL_DX, CURVATURE + 1)
    if vector.size != size - later.size:
        return arrays
    known = np.delete(np.arange(size), later)
    prior_sigma, whole = np.full(size, _EXACT), np.zeros(size)
    whole[known] = vector
    prior_sigma[known] = np.asarray(arrays["prior_sigma"], dtype=np.float64)
    covariance = np.zeros((size, size))
    covariance[np.ix_(known, known)] = np.asarray(arrays["covariance"], dtype=np.float64)
    return {**arrays, "vector": whole, "prior_sigma": prior_sigma, "covariance": covariance}


def _restored_process(
    key: str, arrays: Arrays, settings: Settings, fit: CameraFit, height_m: float
) -> ResidualProcess:
    """The residual in range or bearing from a model's state.

    Raises:
        LookupError: A part is missing.
        ValueError: A part does not fit the others, or is not a number.
    """
    length_scales = tuple(float(scale) for scale in settings["length_scales"])
    hyperparameters = Hyperparameters.from_list(settings["hyperparameters"])
    n, dimensions = len(arrays[f"{key}.targets"]), len(hyperparameters.length_scales)

    def part(name: str, *shape: int) -> FloatArray:
        return numbers_of_shape(arrays[f"{key}.{name}"], f"{key}.{name}", (n, *shape))

    if dimensions != _INPUTS or len(length_scales) != _INPUTS:
        raise ValueError(f"the residual in {key} is of {dimensions} inputs, not of {_INPUTS}")
    group = part("group").astype(np.int64)
    log_error = None
    if f"{key}.time" in arrays:
        log_error = CorrelatedError(
            part("time"),
            part("log").astype(np.int64) if f"{key}.log" in arrays else group,
            fit.noise,
            part("direction", 2),
            part("by_pixel", 2) if f"{key}.by_pixel" in arrays else np.zeros((n, 2)),
            part("aboard") if f"{key}.aboard" in arrays else np.zeros(n),
            part("hull") if f"{key}.hull" in arrays else np.zeros(n),
            1.0 / height_m if key == "range" else 0.0,
        )
    return ResidualProcess(
        part("inputs", _INPUTS),
        part("targets"),
        part("noise"),
        group,
        length_scales=length_scales,
        hyperparameters=hyperparameters,
        log_error=log_error,
    )


@dataclass(frozen=True, eq=False)
class _Seen:
    """Range, bearing and their covariance of boxes as the camera sees them.

    Attributes:
        distance: (N,) metres.
        sine: (N,) of the bearing.
        cosine: (N,) of the bearing.
        moved: (2, N) variance along and across the line of sight that the parameters make.
        skewed: (N,) by how much a range that is multiplied by its error varies more than that.
        moved_mixed: (N,) the covariance of the two.
        noise: (2, N) variance along and across that the box's noise makes.
        noise_mixed: (N,) the covariance of the two.
        lasting: (2, N) the part of ``noise`` that is alike a moment later.
        lasting_mixed: (N,) the covariance of the two.
        by_pixel: (2, 2, N) metres along and across by a pixel of column and row.
        hull: (N,) standard deviation of how far the hull reaches towards the camera.
    """

    distance: FloatArray
    sine: FloatArray
    cosine: FloatArray
    moved: FloatArray
    skewed: FloatArray
    moved_mixed: FloatArray
    noise: FloatArray
    noise_mixed: FloatArray
    lasting: FloatArray
    lasting_mixed: FloatArray
    by_pixel: FloatArray
    hull: FloatArray

    def __getitem__(self, rows: BoolArray | slice) -> _Seen:
        return _Seen(*(getattr(self, column.name)[..., rows] for column in fields(self)))


class _Hulls:
    """How far the hulls of boxes reach towards the camera, once their distances are known.

    Attributes:
        shares: (2, N) of the typical half length and half beam.
        squares: (2, N) means of the squares of a target's lengths along and across the line of
            sight, shares of the typical half length.
        variance_m2: (N,) of the reach, for a target of any course.
    """

    shares: FloatArray
    squares: FloatArray
    variance_m2: FloatArray

    def __init__(self, model: CameraRegressor, width_px: FloatArray, above_m: FloatArray) -> None:
        self._model, self._width_px, self._above_m = model, width_px, above_m

    def __call__(self, distance_m: FloatArray) -> FloatArray:
        """(N,) metres, by (N,) distances."""
        camera, (half_length, half_beam) = self._model.camera_, self._model.half_m
        slant = np.sqrt(distance_m * distance_m + (camera.height_m - self._above_m) ** 2)
        length, beam, spread = self._model.reach(self._width_px * slant / camera.focal_px)
        self.shares = np.stack([length, beam])
        self.squares = self.shares**2 + spread[:2]
        self.variance_m2 = (
            half_length**2 * spread[0]
            + half_beam**2 * spread[1]
            + 2.0 * half_length * half_beam * spread[2]
        )
        return np.asarray(half_length * length + half_beam * beam)


def _turn(
    along: FloatArray,
    across: FloatArray,
    mixed: FloatArray,
    sine: FloatArray,
    cosine: FloatArray,
    out: FloatArray,
) -> None:
    """Rotate covariances from along and across the line of sight to east and north."""
    ss, cc, sc = sine * sine, cosine * cosine, sine * cosine
    out[:, 0, 0] = along * ss + across * cc + 2.0 * mixed * sc
    out[:, 1, 1] = along * cc + across * ss - 2.0 * mixed * sc
    out[:, 0, 1] = (along - across) * sc + mixed * (cc - ss)
    out[:, 1, 0] = out[:, 0, 1]
