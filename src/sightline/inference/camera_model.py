"""The models `camera` and `camera+gpr`: boxes in, places with their covariance out."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils.validation import check_is_fitted

from sightline.errors import FitError, InputError
from sightline.inference.camera import Camera, project_with_jacobian
from sightline.inference.camera_fit import (
    NO_SOURCE,
    SOURCE_PARAMETERS,
    CameraFit,
    CameraPrior,
    PixelNoise,
    Sightings,
    fit_camera,
)
from sightline.inference.estimator import Arrays, Settings
from sightline.inference.residual import Hyperparameters, ResidualProcess
from sightline.types import BoolArray, FloatArray, IntArray, check_boxes

FEWEST_FOR_RESIDUAL = 10
"""With fewer boxes a camera is all that can be learned."""

CONTROL_POINT_SIGMA_M = 0.1
"""How far off a control point may lie: read off an aerial picture, or surveyed."""

LARGEST_RELATIVE_SIGMA = 0.5
"""A box whose range is less certain than this share of itself has no position."""

_LENGTH_SCALES = (2.0, 1.0, 0.4, 0.7)
_N = 9
_CHUNK = 8192


class CameraRegressor(RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """An unknown camera, and a Gaussian process on what it leaves.

    Args:
        image_size_px: Width and height.
        residual: Whether to learn the residual process (`camera+gpr`) or only the camera.
        prior: Beliefs about the camera; None: those of an ordinary one.
        position_known: Whether the camera stands at the origin of the plane, as far as one knows.
        starts: Random starting cameras of the fit.
        random_state: Seed of the starts.

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
        position_known: bool = True,
        starts: int = 8,
        random_state: int = 0,
    ) -> None:
        self.image_size_px = image_size_px
        self.residual = residual
        self.prior = prior
        self.position_known = position_known
        self.starts = starts
        self.random_state = random_state

    def fit(
        self,
        X: ArrayLike,
        y: ArrayLike,
        *,
        source: ArrayLike | None = None,
        group: ArrayLike | None = None,
        velocity_mps: ArrayLike | None = None,
        control_px: ArrayLike | None = None,
        control_east_north_m: ArrayLike | None = None,
    ) -> Self:
        """Learn from boxes and control points.

        Args:
            X: (N, 4) boxes, pixels.
            y: (N, 2) metres east and north.
            source: (N,) str, who made each box; absent: one unnamed source.
            group: (N,) the recording of each box; absent: one.
            velocity_mps: (N, 2) of the target, east and north; tells how far a clock is off.
            control_px: (M, 2) pixels of control points.
            control_east_north_m: (M, 2) metres.

        Raises:
            FitError: The pairs are too few, or all in one place.
            InputError: A box is none, or columns differ in length.
        """
        boxes, places = _rows(X, 4), _rows(y, 2)
        pixels = _rows([] if control_px is None else control_px, 2)
        known = _rows([] if control_east_north_m is None else control_east_north_m, 2)
        check_boxes(boxes)
        n, m = len(boxes), len(pixels)
        velocity = np.zeros((n, 2)) if velocity_mps is None else _rows(velocity_mps, 2)
        if len(places) != n or len(known) != m:
            raise InputError(f"{n} boxes and {len(places)} places; each box needs its place")
        names = np.asarray(source if source is not None else [""] * n, dtype=np.str_)
        groups = np.asarray(group if group is not None else [0] * n)
        self.sources_ = tuple(str(name) for name in np.unique(names))
        index = np.searchsorted(self.sources_, names) if n else np.empty(0, dtype=np.int64)
        self._group: IntArray = np.unique(groups, return_inverse=True)[1].astype(np.int64)
        foot = _foot(boxes)
        # Points of a map are independent of one another: each is a group of its own.
        own = int(self._group.max(initial=-1)) + 1 + np.arange(m)
        sightings = Sightings(
            pixel_px=np.concatenate([foot, pixels]),
            east_m=np.concatenate([places[:, 0], known[:, 0]]),
            north_m=np.concatenate([places[:, 1], known[:, 1]]),
            source=np.concatenate([index, np.full(m, NO_SOURCE)]).astype(np.int64),
            group=np.concatenate([self._group, own]).astype(np.int64),
            velocity_mps=np.concatenate([velocity, np.zeros((m, 2))]),
            sigma_m=np.concatenate([np.zeros(n), np.full(m, CONTROL_POINT_SIGMA_M)]),
        )
        self.fit_ = fit_camera(
            sightings,
            self.image_size_px,
            n_sources=len(self.sources_),
            prior=self.prior,
            noise=PixelNoise() if n == 0 else None,
            position_known=self.position_known,
            starts=self.starts,
            seed=self.random_state,
        )
        self.n_features_in_ = 4
        self.typical_speed_mps_ = float(np.sqrt(np.mean(velocity**2) * 2.0)) if n else 0.0
        self._prepare()
        self.range_process_: ResidualProcess | None = None
        self.bearing_process_: ResidualProcess | None = None
        if self.residual and n >= FEWEST_FOR_RESIDUAL:
            offset = self.fit_.clock_offset_s
            clocks = dict(zip(self.fit_.clock_groups.tolist(), offset.tolist(), strict=True))
            late = np.array([clocks.get(int(g), 0.0) for g in self._group])
            self._learn_residual(boxes, places + late[:, None] * velocity, names)
        return self

    def predict(
        self, X: ArrayLike, *, source: ArrayLike | None = None, return_cov: bool = False
    ) -> Any:
        """Where boxes lie.

        Args:
            X: (N, 4) boxes, pixels.
            source: (N,) str or one for all, who made the boxes. A source that was not learned
                from counts as unbiased, with the uncertainty of a bias that nobody knows.
            return_cov: Whether to return covariances too.

        Returns:
            (N, 2) metres east and north, NaN where there is no position: at or above the horizon,
            and where the range would be less certain than half of itself. With ``return_cov``
            also (N, 2, 2) square metres: parameters of the camera, noise of the box, residual.
        """
        check_is_fitted(self, "fit_")
        boxes = np.asarray(X, dtype=np.float64)
        places = np.full((len(boxes), 2), np.nan)
        covariance = np.full((len(boxes), 2, 2), np.nan)
        if source is None or np.ndim(source) == 0:
            parts: list[tuple[str, IntArray | None]] = [(str(source or ""), None)]
        else:
            names = np.asarray(source, dtype=np.str_)
            parts = [(str(name), np.flatnonzero(names == name)) for name in np.unique(names)]
        for name, rows in parts:
            count = len(boxes) if rows is None else len(rows)
            for start in range(0, count, _CHUNK):
                part = slice(start, start + _CHUNK)
                chosen = part if rows is None else rows[part]
                places[chosen], covariance[chosen] = self._place(boxes[chosen], name)
        return (places, covariance) if return_cov else places

    def bias(self, source: str) -> tuple[FloatArray, FloatArray]:
        """A source's bias, (2,) pixels and metres, and the whole covariance with the camera's.

        The covariance is (11, 11): the camera's nine parameters, then the two of the bias.
        """
        fit, prior = self.fit_, self.prior or CameraPrior()
        name = self.sources_[0] if not source and len(self.sources_) == 1 else source
        covariance = np.zeros((_N + 2, _N + 2))
        covariance[:_N, :_N] = fit.covariance[:_N, :_N]
        if name in self.sources_:
            first = _N + 2 * self.sources_.index(name)
            chosen = [*range(_N), first, first + 1]
            return fit.vector[first : first + 2], fit.covariance[np.ix_(chosen, chosen)]
        covariance[_N, _N] = prior.bias_px_sigma**2
        covariance[_N + 1, _N + 1] = prior.bias_m_sigma**2
        return np.zeros(2), covariance

    def _prepare(self) -> None:
        """What every prediction needs, once: the camera, and each source's bias."""
        # By how much a target moves while the clock is unsure, along either axis.
        self._clock_variance = 0.5 * (self.fit_.clock_sigma_s * self.typical_speed_mps_) ** 2
        self.camera_: Camera = self.fit_.camera
        self._biases: dict[str, tuple[FloatArray, FloatArray]] = {}

    def _root(self, source: str) -> tuple[FloatArray, FloatArray]:
        """A source's bias, and a square root (11, 11) of the covariance of all parameters."""
        if source not in self._biases:
            bias, covariance = self.bias(source)
            values, vectors = np.linalg.eigh(covariance)
            root = vectors * np.sqrt(np.maximum(values, 0.0))
            self._biases[source] = (bias, root)
        return self._biases[source]

    def _see(self, boxes: FloatArray, source: str) -> _Seen:
        bias, root = self._root(source)
        foot = _foot(boxes)
        foot[:, 1] -= bias[0]
        camera, fit = self.camera_, self.fit_
        east, north = camera.locate(foot, bias[1])
        offset_east, offset_north = east - camera.east_m, north - camera.north_m
        distance = np.sqrt(offset_east * offset_east + offset_north * offset_north)
        _, by_parameter, by_point = project_with_jacobian(
            fit.vector[:_N], self.image_size_px, east, north, bias[1]
        )
        # Seen along and across the line of sight: (along, across) from (column, row).
        sine, cosine = offset_east / distance, offset_north / distance
        by_east, by_north = by_point[:, :, 0], by_point[:, :, 1]
        along = by_east * sine[:, None] + by_north * cosine[:, None]
        across = by_east * cosine[:, None] - by_north * sine[:, None]
        determinant = along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]
        inverse = np.empty((len(boxes), 2, 2))
        inverse[:, 0, 0], inverse[:, 0, 1] = across[:, 1], -across[:, 0]
        inverse[:, 1, 0], inverse[:, 1, 1] = -along[:, 1], along[:, 0]
        inverse /= determinant[:, None, None]
        shift = by_parameter @ root[:_N]
        shift += by_point[:, :, 2:3] * root[_N + 1]
        shift[:, 1] += root[_N]
        moved = inverse @ shift
        column, row = fit.noise.sigmas_px(
            np.exp(fit.vector[4]) / np.sqrt(distance**2 + np.exp(2.0 * fit.vector[0]))
        )
        noise = inverse * np.stack([column, row], axis=1)[:, None, :]
        return _Seen(distance, sine, cosine, moved, noise)

    def _inputs(self, boxes: FloatArray, seen: _Seen, source: str) -> FloatArray:
        """(N, 4) what the residual depends on: bearing, log-range, log of apparent height, width.

        The bearing is off the optical axis, radians; heights and widths are metres.
        """
        heading = np.radians(self.camera_.heading_deg)
        bearing = np.arctan2(seen.sine, seen.cosine) - heading
        metres_per_pixel = seen.distance / self.camera_.focal_px
        bias_px = self._root(source)[0][0]
        height = np.maximum(boxes[:, 3] - boxes[:, 1] - bias_px, 0.5) * metres_per_pixel
        width = (boxes[:, 2] - boxes[:, 0]) * metres_per_pixel
        return np.stack(
            [
                np.arctan2(np.sin(bearing), np.cos(bearing)),
                np.log(seen.distance),
                np.log(height),
                np.log(width),
            ],
            axis=1,
        )

    def _place(self, boxes: FloatArray, source: str) -> tuple[FloatArray, FloatArray]:
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            seen = self._see(boxes, source)
            noise = seen.noise_variance()
            relative = np.sqrt(seen.moved_variance()[0] + noise[0]) / seen.distance
            known = relative < LARGEST_RELATIVE_SIGMA
        distance, sine, cosine = seen.distance, seen.sine, seen.cosine
        shape = seen.parameter_covariance()
        shape[:, 0, 0] += self._clock_variance
        shape[:, 1, 1] += self._clock_variance
        if self.range_process_ is None or self.bearing_process_ is None:
            shape += seen.noise_covariance()
        elif known.any():
            inputs = self._inputs(boxes[known], seen[known], source)
            own = np.sqrt(np.stack(noise)[:, known]) / distance[known]
            stretch, stretch_variance = self.range_process_.predict(inputs, own[0])
            turn, turn_variance = self.bearing_process_.predict(inputs, own[1])
            distance = distance.copy()
            distance[known] *= np.exp(stretch)
            scale = np.square(distance[known])
            shape[known, 0, 0] += stretch_variance * scale
            shape[known, 1, 1] += turn_variance * scale
            sine, cosine = sine.copy(), cosine.copy()
            angle = np.arctan2(sine[known], cosine[known]) + turn
            sine[known], cosine[known] = np.sin(angle), np.cos(angle)
        camera = self.camera_
        places = np.stack(
            [camera.east_m + distance * sine, camera.north_m + distance * cosine], axis=1
        )
        covariance = _to_east_north(shape, sine, cosine)
        places[~known] = np.nan
        covariance[~known] = np.nan
        return places, covariance

    def _learn_residual(self, boxes: FloatArray, places: FloatArray, names: Any) -> None:
        n = len(boxes)
        inputs, targets = np.full((n, 4), np.nan), np.full((n, 2), np.nan)
        noise = np.full((n, 2), np.nan)
        camera = self.camera_
        east, north = places[:, 0] - camera.east_m, places[:, 1] - camera.north_m
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            for name in np.unique(names):
                rows = np.flatnonzero(names == name)
                seen = self._see(boxes[rows], str(name))
                inputs[rows] = self._inputs(boxes[rows], seen, str(name))
                noise[rows] = np.sqrt(np.stack(seen.noise_variance(), 1)) / seen.distance[:, None]
                turn = np.arctan2(east[rows], north[rows]) - np.arctan2(seen.sine, seen.cosine)
                targets[rows, 0] = np.log(np.hypot(east[rows], north[rows]) / seen.distance)
                targets[rows, 1] = np.arctan2(np.sin(turn), np.cos(turn))
            usable = (
                np.isfinite(inputs).all(axis=1)
                & np.isfinite(targets).all(axis=1)
                & (noise[:, 0] < LARGEST_RELATIVE_SIGMA)
                & ~self.fit_.outlier[:n]
            )
        if usable.sum() < FEWEST_FOR_RESIDUAL:
            return
        limit = 3.0 * noise[usable]
        clipped = np.clip(targets[usable], -limit, limit)

        def learn(axis: int) -> ResidualProcess:
            return ResidualProcess(
                inputs[usable],
                clipped[:, axis],
                noise[usable, axis],
                self._group[usable],
                length_scales=_LENGTH_SCALES,
            )

        self.range_process_, self.bearing_process_ = learn(0), learn(1)

    def state(self) -> tuple[Arrays, Settings]:
        """What `from_state` needs to predict the same: arrays, and the rest as JSON can hold it."""
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
            "starts_agreeing": fit.starts_agreeing,
            "starts": fit.starts,
            "typical_range_m": fit.typical_range_m,
            "typical_speed_mps": self.typical_speed_mps_,
        }
        for key, process in (("range", self.range_process_), ("bearing", self.bearing_process_)):
            if process is not None:
                arrays[f"{key}.inputs"] = process.inputs
                arrays[f"{key}.targets"] = process.targets
                arrays[f"{key}.noise"] = process.noise
                arrays[f"{key}.group"] = process.group
                settings[key] = {
                    "hyperparameters": list(process.hyperparameters.to_log()),
                    "length_scales": list(process.length_scales),
                }
        return arrays, settings

    @classmethod
    def from_state(cls, arrays: Arrays, settings: Settings) -> Self:
        """The model that `state` described.

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
        )
        model.sources_ = tuple(settings["sources"])
        clock_groups = np.array(arrays["clock_groups"], dtype=np.int64)
        size = _N + len(SOURCE_PARAMETERS) * len(model.sources_) + clock_groups.size
        vector = np.array(arrays["vector"], dtype=np.float64).reshape(size)
        nothing = np.empty(0)
        model.fit_ = CameraFit(
            vector=vector,
            covariance=np.array(arrays["covariance"], dtype=np.float64).reshape(size, size),
            prior_sigma=np.array(arrays["prior_sigma"], dtype=np.float64).reshape(size),
            clock_groups=clock_groups,
            noise=PixelNoise(**settings["noise"]),
            image_size_px=model.image_size_px,
            residual_px=np.empty((0, 2)),
            standard_residual=nothing,
            leverage=nothing,
            outlier=np.empty(0, dtype=np.bool_),
            starts_agreeing=int(settings["starts_agreeing"]),
            starts=int(settings["starts"]),
            typical_range_m=float(settings["typical_range_m"]),
        )
        if not (np.isfinite(vector).all() and np.isfinite(model.fit_.covariance).all()):
            raise ValueError("a parameter of the camera is not a number")
        model.n_features_in_ = 4
        model.typical_speed_mps_ = float(settings["typical_speed_mps"])
        model._prepare()
        processes = [
            ResidualProcess(
                np.array(arrays[f"{key}.inputs"], dtype=np.float64),
                np.array(arrays[f"{key}.targets"], dtype=np.float64),
                np.array(arrays[f"{key}.noise"], dtype=np.float64),
                np.array(arrays[f"{key}.group"], dtype=np.int64),
                length_scales=tuple(settings[key]["length_scales"]),
                hyperparameters=Hyperparameters.from_log(
                    np.array(settings[key]["hyperparameters"], dtype=np.float64)
                ),
            )
            if key in settings
            else None
            for key in ("range", "bearing")
        ]
        model.range_process_, model.bearing_process_ = processes
        return model


class _Seen:
    """Boxes as the camera sees them: how far, in which direction, and how that may be off."""

    def __init__(
        self,
        distance: FloatArray,
        sine: FloatArray,
        cosine: FloatArray,
        moved: FloatArray,
        noise: FloatArray,
    ) -> None:
        self.distance = distance
        self.sine, self.cosine = sine, cosine
        self.moved, self.noise = moved, noise

    def __getitem__(self, rows: BoolArray) -> _Seen:
        return _Seen(
            self.distance[rows],
            self.sine[rows],
            self.cosine[rows],
            self.moved[rows],
            self.noise[rows],
        )

    def noise_variance(self) -> tuple[FloatArray, FloatArray]:
        """Variance along and across the line of sight that the box's noise makes."""
        return _squares(self.noise)

    def moved_variance(self) -> tuple[FloatArray, FloatArray]:
        """Variance along and across that the parameters make."""
        return _squares(self.moved)

    def parameter_covariance(self) -> FloatArray:
        """(N, 2, 2) along and across, of the parameters."""
        return _outer(self.moved)

    def noise_covariance(self) -> FloatArray:
        """(N, 2, 2) along and across, of the box's noise."""
        return _outer(self.noise)


def _squares(shift: FloatArray) -> tuple[FloatArray, FloatArray]:
    return (
        np.einsum("nk,nk->n", shift[:, 0], shift[:, 0]),
        np.einsum("nk,nk->n", shift[:, 1], shift[:, 1]),
    )


def _outer(shift: FloatArray) -> FloatArray:
    out = np.empty((len(shift), 2, 2))
    out[:, 0, 0], out[:, 1, 1] = _squares(shift)
    out[:, 0, 1] = out[:, 1, 0] = np.einsum("nk,nk->n", shift[:, 0], shift[:, 1])
    return out


def _to_east_north(shape: FloatArray, sine: FloatArray, cosine: FloatArray) -> FloatArray:
    """Covariances from along and across the line of sight to east and north."""
    along, across, mixed = shape[:, 0, 0], shape[:, 1, 1], shape[:, 0, 1]
    out = np.empty_like(shape)
    out[:, 0, 0] = along * sine**2 + across * cosine**2 + 2.0 * mixed * sine * cosine
    out[:, 1, 1] = along * cosine**2 + across * sine**2 - 2.0 * mixed * sine * cosine
    out[:, 0, 1] = (along - across) * sine * cosine + mixed * (cosine**2 - sine**2)
    out[:, 1, 0] = out[:, 0, 1]
    return out


def _foot(boxes_xyxy_px: FloatArray) -> FloatArray:
    """(N, 2) the middle of each lower edge, pixels."""
    return np.stack(
        [0.5 * (boxes_xyxy_px[:, 0] + boxes_xyxy_px[:, 2]), boxes_xyxy_px[:, 3]], axis=1
    )


def _rows(values: ArrayLike, width: int) -> FloatArray:
    table = np.asarray(values, dtype=np.float64)
    if table.size == 0:
        return np.empty((0, width))
    if table.ndim != 2 or table.shape[1] != width:
        raise InputError(f"expected a table of the shape (N, {width}), got {table.shape}")
    if not np.isfinite(table).all():
        raise FitError("a box, a place or a pixel among the pairs is not a number")
    return table
