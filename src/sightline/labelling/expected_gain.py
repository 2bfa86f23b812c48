"""What further boxes would teach a fitted camera, by its covariance, before they are drawn.

The fit is linear about its maximum: boxes add ``Jᵀ V⁻¹ J`` to the inverse of its covariance, with
their Jacobian ``J`` and the covariance ``V`` of their feet, in which the log's correlated error
makes boxes of one minute alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sightline.camera.correlated_noise import Whitening, blocks_of
from sightline.camera.observations import UNDER_WAY_MPS
from sightline.camera.parameters import BIAS_M, BIAS_PX, CAMERA, POSITION, TARGET
from sightline.camera.pinhole import project_with_jacobian
from sightline.camera.priors import ANY_ASPECT, CameraPrior
from sightline.georeferencing.camera_regressor import CameraRegressor
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.labelling.expected import camera_of
from sightline.labelling.logged_frames import LoggedFrames
from sightline.types import FloatArray, IntArray

AXIS_95 = float(np.sqrt(5.991464547))
"""The larger semi-axis of a 95 % ellipse, over its standard deviation."""


@dataclass(frozen=True, eq=False)
class Derivatives:
    """Derivatives of the feet of N boxes.

    Attributes:
        jacobian: (N, 2, Q) float64, of column and row by the parameters.
        by_place: (N, 2, 2) float64, by the place, pixels a metre east and north.
        by_up: (N, 2) float64, by the height of the water, pixels a metre.
    """

    jacobian: FloatArray
    by_place: FloatArray
    by_up: FloatArray


class Design:
    """Information of boxes, drawn or to be drawn, on a fitted camera.

    The biases of an annotator and the clock of a recording that the fit does not know yet are
    unknowns beyond its own, as uncertain as the prior says.

    Attributes:
        covariance: (Q, Q) float64, of the fit's parameters and these.
    """

    def __init__(self, georeferencer: Georeferencer, recording: str, annotator: str) -> None:
        """Prepare the information of boxes in a recording.

        Args:
            georeferencer: Has a camera that stands still.
            recording: Whose boxes.
            annotator: Who is to draw.

        Raises:
            InputError: The model has no camera.
        """
        self._model: CameraRegressor = camera_of(georeferencer)
        self._georeferencer = georeferencer
        self._height_m = self._model.camera_.height_m
        fit, prior = self._model.fit_, self._model.prior or CameraPrior()
        self._recording, self._annotator, own = recording, annotator, fit.vector.size
        sigma: list[float] = []
        self._slots: dict[str, int] = {
            name: int(fit.layout.source(i).start) for i, name in enumerate(self._model.sources_)
        }
        if annotator not in self._slots:
            self._slots[annotator] = own + len(sigma)
            sigma += [prior.bias_px_sigma, prior.bias_m_sigma]
        learned = georeferencer.report.recordings
        self._clocks: dict[str, int] = {
            learned[group]: int(fit.layout.clock(i))
            for i, group in enumerate(fit.clock_groups.tolist())
            if group < len(learned)
        }
        if recording not in self._clocks:
            self._clocks[recording] = own + len(sigma)
            sigma.append(prior.clock_sigma_s)
        size = own + len(sigma)
        self.vector = np.zeros(size)
        self.vector[:own] = fit.vector
        self.covariance = np.zeros((size, size))
        self.covariance[:own, :own] = fit.covariance
        self.covariance[range(own, size), range(own, size)] = np.square(sigma)
        self._own = own

    @property
    def place_m(self) -> FloatArray:
        """(2,) where the camera stands, metres east and north."""
        return self.vector[POSITION]

    def derivatives(
        self,
        at: LoggedFrames,
        above_m: FloatArray,
        sources: Sequence[str] | None = None,
        recordings: Sequence[str] | None = None,
    ) -> Derivatives:
        """Derivatives of the feet of boxes.

        Args:
            at: (N,) places of the target.
            above_m: (N,) or one number, how high the water stands above the plane of the camera.
            sources: (N,) who draws each. Absent: the annotator.
            recordings: (N,) in which each is. Absent: in that of the design.
        """
        v, n = self.vector, len(at)
        slots = np.array([self._slots[name] for name in sources or [self._annotator] * n])
        slots = slots.astype(np.int64)
        off = at.east_north_m - v[POSITION]
        distance = np.hypot(*off.T)
        unit = off / np.maximum(distance, 1e-9)[:, None]
        speed = np.hypot(*at.velocity_mps.T)
        cosine = np.sum(unit * at.velocity_mps, axis=1) / np.maximum(speed, 1e-9)
        aspect = np.stack([np.abs(cosine), np.sqrt(np.maximum(1.0 - cosine**2, 0.0))], axis=1)
        aspect[speed < UNDER_WAY_MPS] = ANY_ASPECT
        foot = at.east_north_m - unit * (aspect @ v[TARGET])[:, None]
        above = above_m + v[slots + BIAS_M]
        _, by_camera, by_foot = project_with_jacobian(
            v[CAMERA], self._georeferencer.image_size_px, foot[:, 0], foot[:, 1], above
        )
        # A camera that moves sees another side of the hull.
        aside = np.stack([unit[:, 1], -unit[:, 0]], axis=1)
        across = np.einsum("nij,nj->ni", by_foot[:, :, :2], aside)
        reach = (aspect @ v[TARGET] / np.maximum(distance, 1e-9))[:, None]
        by_place = by_foot[:, :, :2] - (across * reach)[:, :, None] * aside[:, None, :]
        out = np.zeros((n, 2, v.size))
        out[:, :, CAMERA] = by_camera
        out[:, :, POSITION] = -by_place
        inwards = np.einsum("nij,nj->ni", by_foot[:, :, :2], unit)
        out[:, :, TARGET] = -inwards[:, :, None] * aspect[:, None, :]
        rows = np.arange(n)
        out[rows, 1, slots + BIAS_PX] = 1.0
        out[rows, :, slots + BIAS_M] = by_foot[:, :, 2]
        late = np.einsum("nij,nj->ni", by_place, at.velocity_mps)
        for name in dict.fromkeys(recordings or [self._recording]):
            own = np.ones(n, dtype=bool) if recordings is None else np.array(recordings) == name
            if name in self._clocks:
                out[own, :, self._clocks[name]] = late[own]
        return Derivatives(out, by_place, by_foot[:, :, 2])

    def noise_px2(self, at: LoggedFrames, derivatives: Derivatives) -> FloatArray:
        """(N, 2, 2) covariances of single feet: of all but what is the same for all of them."""
        noise, by_place = self._model.fit_.noise, derivatives.by_place
        out = np.einsum("nij,nkj->nik", by_place, by_place)
        place = noise.place_m**2 + noise.correlated_m**2 + noise.lasting_m**2
        out *= (place + np.square(at.sigma_m))[:, None, None]
        own = self._own_px2(at) + np.array(noise.lasting_px2())
        out[:, [0, 1], [0, 1]] += own
        return np.asarray(out)

    def whitening(
        self,
        at: LoggedFrames,
        derivatives: Derivatives,
        recordings: Sequence[str] | None = None,
        weight: FloatArray | float = 1.0,
    ) -> Whitening:
        """The whitening of the feet of N boxes, as a fit of them would have it.

        Args:
            at: (N,) places of the target.
            derivatives: Of these.
            recordings: As for `derivatives`.
            weight: (N,) or one number: how much each counts, 0 to 1.
        """
        noise, by_place = self._model.fit_.noise, derivatives.by_place
        names = [self._recording] * len(at) if recordings is None else list(recordings)
        log = np.unique(names, return_inverse=True)[1].astype(np.int64)
        variance = self._own_px2(at) + noise.place_m**2 * np.sum(by_place**2, axis=2)
        speed = np.hypot(*at.velocity_mps.T)
        steered = speed >= UNDER_WAY_MPS
        bow = at.velocity_mps / np.maximum(speed, 1e-9)[:, None] * steered[:, None]
        return Whitening(
            blocks_of(at.time_utc_s, log, at.sigma_m, np.stack([at.time_utc_s] * 2, axis=1)),
            variance / np.broadcast_to(weight, (len(at),))[:, None],
            by_place,
            noise,
            derivatives.by_up,
            self.vector[TARGET.start] * bow,
        )

    def information(
        self, at: LoggedFrames, above_m: FloatArray, sources: Sequence[str] | None = None
    ) -> FloatArray:
        """(Q, Q) what boxes add to the inverse of the covariance."""
        if not len(at):
            return np.zeros_like(self.covariance)
        found = self.derivatives(at, above_m, sources)
        white = self.whitening(at, found).forward(found.jacobian)
        flat = white.reshape(-1, self.vector.size)
        return np.asarray(flat.T @ flat)

    def _own_px2(self, at: LoggedFrames) -> FloatArray:
        slant = np.hypot(np.hypot(*(at.east_north_m - self.place_m).T), self._height_m)
        scale = (self._model.camera_.focal_px / slant) ** 2
        return np.stack(self._model.fit_.noise.variances_px2(scale), axis=1)

    def after(self, added: FloatArray) -> FloatArray:
        """(Q, Q) covariance after boxes that add information (Q, Q)."""
        values, vectors = np.linalg.eigh(added)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        spread = self.covariance @ root
        middle = np.eye(values.size) + root.T @ spread
        out = self.covariance - spread @ np.linalg.solve(middle, spread.T)
        return np.asarray(0.5 * (out + out.T))

    def model_with(self, covariance: FloatArray) -> Georeferencer:
        """The georeferencer with another covariance (Q, Q) of its parameters."""
        fit = replace(self._model.fit_, covariance=covariance[: self._own, : self._own])
        return replace(self._georeferencer, regressor=self._model.with_fit(fit))


def axes_95_m(
    georeferencer: Georeferencer,
    boxes_xyxy_px: FloatArray,
    annotator: str,
    water_level_m: FloatArray | None,
) -> FloatArray:
    """(N,) larger semi-axes of the 95 % ellipses of boxes, metres; infinite where there is none."""
    known = georeferencer.calibrated is not None and annotator in georeferencer.calibrated.sources_
    where = georeferencer.locate(boxes_xyxy_px, annotator if known else None, water_level_m)
    covariance = where.covariance_m2
    finite = np.isfinite(covariance).all(axis=(1, 2))
    out = np.full(len(covariance), np.inf)
    out[finite] = AXIS_95 * np.sqrt(np.linalg.eigvalsh(covariance[finite])[:, -1])
    return out


def spread_rows(count: int, most: int) -> IntArray:
    """At most so many of a number of rows, evenly."""
    if count <= most:
        return np.arange(count, dtype=np.int64)
    return np.linspace(0, count - 1, most).round().astype(np.int64)
