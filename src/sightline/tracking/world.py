r"""Multi-target tracking in the local plane, with boxes located by a model.

A target has a place and a velocity in metres, and a box in the image. From one frame to the next
the image tells more: a pixel is worth metres far away, and nothing near the horizon has a
position at all. Over seconds the earth does: vessels go straight in it, at speeds that vessels
have. So targets are predicted in both planes, and a box must agree with both as long as either
tells something.

The camera stands at the origin, or on a platform whose log tells where it was. It knows bearings
well and ranges badly; what it measures is taken as the bearing and the *inverse* range, in which a
pixel counts the same everywhere (an extended Kalman filter, Bar-Shalom, Li and Kirubarajan,
*Estimation with Applications to Tracking and Navigation*, 2001, section 10.3): the noise is then
that of the range predicted, and a range that was measured too short does not look precise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sightline.platform import Platform
from sightline.tracking.image import IMAGE_MEASURED, IMAGE_STATE, ImagePlane, ImageTrackerSettings
from sightline.tracking.plane import Columns, Fields, white_acceleration
from sightline.tracking.targets import TargetTracker
from sightline.types import NO_TRACK, Boxes, FloatArray, IntArray, Positions

Locate = Callable[[Boxes], Positions]
"""Where boxes lie on the earth, as `Georeferencer.locate` says it."""

_NEAREST_M = 1.0
_OWN_SHARE = 0.05

_STATE: Fields = [
    *IMAGE_STATE,
    ("place", float, (4,)),
    ("doubt", float, (4, 4)),
    ("placed", float, ()),
]
_MEASURED: Fields = [
    *IMAGE_MEASURED,
    ("placed", float, ()),
    ("en", float, (2,)),
    ("camera_position", float, (2,)),
    ("own", float, (2, 2)),
    ("line_of_sight", float, (2,)),
    ("noise", float, (2, 2)),
]


@dataclass(frozen=True)
class WorldTrackerSettings(ImageTrackerSettings):
    """Settings of a `WorldTracker`.

    Attributes:
        acceleration_m2ps3: Spectral density of the white acceleration, m²/s³.
        speed_mps: Standard deviation of each component of the velocity of a new target.
        correlation_time_s: The errors of boxes last for so long; boxes that follow each other
            faster tell accordingly less.
        earth_gate: Largest distance between a predicted and a measured place, in standard
            deviations.
        loose_gate: The same as long as the image tells more, within ``image_s``: the lower edge
            of a boat that something begins to hide is anywhere.
        image_s: For this long without a box the image's own prediction is good.
        stitch_gate: Largest distance, in place and velocity, between a lost target and a new one
            that continues it.
    """

    coast_s: float = 20.0
    direct_s: float = 2.0
    acceleration_m2ps3: float = 0.7
    speed_mps: float = 4.0
    correlation_time_s: float = 1.0
    earth_gate: float = 4.0
    loose_gate: float = 5.0
    image_s: float = 0.6
    stitch_gate: float = 5.0


class WorldPlane:
    """Image and local plane together as a measurement model; see `Plane`.

    Beside the columns of `ImagePlane` a state has ``place`` (N, 4), metres east and north and
    their velocities, ``doubt`` (N, 4, 4) their covariance, and ``placed`` (N,), 1 where they mean
    something and 0 where the target has had no position yet.
    """

    def __init__(
        self, locate: Locate, settings: WorldTrackerSettings, platform: Platform | None = None
    ) -> None:
        """Take the function that locates boxes.

        Args:
            locate: Where boxes lie.
            settings: How targets move.
            platform: What the camera stands on, where that moves.
        """
        self._locate = locate
        self._platform = platform
        self._settings = settings
        self._image = ImagePlane(settings)

    def measure(self, boxes: Boxes) -> Columns:
        """Measurements of the image, and ``line_of_sight`` (bearing, inverse range) with ``noise``.

        Both are from the camera, which is at ``camera_position``.
        """
        positions = self._locate(boxes)
        camera_position = np.zeros((len(boxes), 2))
        if self._platform is not None:
            pose = self._platform.pose(boxes.time_utc_s, positions.plane, until_then=True)
            camera_position = np.nan_to_num(pose.en_m)
        known = positions.known & np.isfinite(positions.covariance_m2).all(axis=(1, 2))
        en = np.stack([positions.east_m, positions.north_m], axis=1)
        en = np.where(known[:, None], en, [0.0, 1.0])
        assert positions.shared_covariance_m2 is not None, "positions fill it in"
        # What a target's positions have in common does not move it from one to the next.
        own = positions.covariance_m2 - (1.0 - _OWN_SHARE) * positions.shared_covariance_m2
        own = np.where(known[:, None, None], own, np.eye(2))
        sight, jacobian = _line_of_sight(en - camera_position)
        measured = np.zeros(len(boxes), dtype=_MEASURED)
        self._image.fill_measured(measured, boxes)
        measured["placed"] = known
        measured["en"], measured["camera_position"], measured["own"] = en, camera_position, own
        measured["line_of_sight"] = sight
        measured["noise"] = jacobian @ own @ np.swapaxes(jacobian, 1, 2)
        return measured

    def start(self, measured: Columns) -> Columns:
        """See `Plane`."""
        state = np.zeros(len(measured), dtype=_STATE)
        self._image.fill_start(state, measured)
        self._fill_start(state, measured)
        return state

    def _fill_start(self, state: Columns, measured: Columns) -> None:
        """Fill in the columns of `start` beside those of the image."""
        state["place"][:, :2] = measured["en"]
        state["place"][:, 2:] = 0.0
        state["doubt"] = 0.0
        doubt = state["doubt"]
        doubt[:, :2, :2] = measured["own"]
        doubt[:, 2, 2] = doubt[:, 3, 3] = self._settings.speed_mps**2
        state["placed"] = measured["placed"]

    def predict(self, state: Columns, lag_s: float) -> None:
        """See `Plane`."""
        self._image.predict(state, lag_s)
        step, noise = (_on_both_axes(part) for part in white_acceleration(lag_s))
        noise *= self._settings.acceleration_m2ps3
        state["place"] = state["place"] @ step.T
        state["doubt"] = step @ state["doubt"] @ step.T + noise

    def candidates(
        self, state: Columns, silent_s: FloatArray, measured: Columns
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """See `Plane`."""
        settings = self._settings
        near = self._image.nearness(state, measured)
        i, j = near.target, near.box
        both = (state["placed"][i] > 0.0) & (measured["placed"][j] > 0.0)
        distance = self._distance(state, measured, i, j)
        fresh = silent_s[i] <= settings.image_s
        limit = np.where(fresh, settings.loose_gate, settings.earth_gate)
        possible = self._image.possible(near) & (~both | (distance <= limit))
        cost = self._image.cost(near)
        cost = cost + np.where(both, np.minimum(distance / settings.earth_gate, 3.0), 1.0)
        return i[possible], j[possible], cost[possible]

    def _distance(self, state: Columns, measured: Columns, i: IntArray, j: IntArray) -> FloatArray:
        """(P,) Mahalanobis distance of pairs in bearing and inverse range."""
        # All boxes are of one moment.
        expected, jacobian = _line_of_sight(state["place"][:, :2] - measured["camera_position"][:1])
        spread = jacobian @ state["doubt"][:, :2, :2] @ np.swapaxes(jacobian, 1, 2)
        off = _residual(measured["line_of_sight"][j], expected[i])
        return np.sqrt(_squared(off, spread[i] + measured["noise"][j]))

    def update(self, state: Columns, silent_s: FloatArray, measured: Columns) -> None:
        """See `Plane`."""
        self._image.update(state, silent_s, measured)
        had, has = state["placed"] > 0.0, measured["placed"] > 0.0
        both = had & has
        if both.all():
            self._update_places(state, silent_s, measured)
            return
        old, new = np.flatnonzero(both), np.flatnonzero(~had & has)
        if old.size:
            part = state[old]
            self._update_places(part, silent_s[old], measured[old])
            state[old] = part
        if new.size:
            # One that had no position yet begins with this one.
            part = state[new]
            self._fill_start(part, measured[new])
            state[new] = part

    def _update_places(self, state: Columns, silent_s: FloatArray, measured: Columns) -> None:
        """Kalman update of the positions of targets by those of their boxes."""
        place, doubt = state["place"], state["doubt"]
        expected, jacobian = _line_of_sight(place[:, :2] - measured["camera_position"])
        cross = doubt[:, :, :2] @ jacobian.transpose(0, 2, 1)
        # Errors that last make boxes that follow each other closely one box.
        repeated = np.maximum(
            1.0, 2.0 * self._settings.correlation_time_s / np.maximum(silent_s, 1e-3)
        )
        noise = measured["noise"] * repeated[:, None, None]
        gain = cross @ _inverse(jacobian @ cross[:, :2] + noise)
        off = _residual(measured["line_of_sight"], expected)
        state["place"] = place + (gain @ off[:, :, None])[:, :, 0]
        left = doubt - gain @ cross.transpose(0, 2, 1)
        state["doubt"] = 0.5 * (left + left.transpose(0, 2, 1))

    def continuations(
        self,
        ended: Columns,
        silent_s: FloatArray,  # noqa: ARG002 - the state knows how unsure it has become
        begun: Columns,
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """See `Plane`: gated by position and velocity together."""
        i, j = np.nonzero((ended["placed"][:, None] > 0.0) & (begun["placed"][None, :] > 0.0))
        if not i.size:
            return i, j, np.empty(0)
        unlike = np.abs(ended["log_size"][i] - begun["log_size"][j]).sum(axis=1)
        off = begun["place"][j] - ended["place"][i]
        spread = ended["doubt"][i] + begun["doubt"][j]
        squared = np.einsum("pi,pi->p", off, np.linalg.solve(spread, off[:, :, None])[:, :, 0])
        distance = np.sqrt(squared)
        near = (distance <= self._settings.stitch_gate) & (unlike <= 1.0)
        return i[near], j[near], (distance + unlike)[near]


@dataclass(frozen=True, eq=False)
class Estimates:
    """Position and velocity estimates of confirmed targets.

    Attributes:
        time_utc_s: Now, POSIX seconds.
        track_id: (T,) int64.
        seen_utc_s: (T,) float64, when each had its last box.
        mean: (T, 4) float64, metres east and north, and their velocities.
        covariance: (T, 4, 4) float64, without what all places of a target have in common.
    """

    time_utc_s: float
    track_id: IntArray
    seen_utc_s: FloatArray
    mean: FloatArray
    covariance: FloatArray


class WorldTracker(TargetTracker):
    """Multi-target tracker in the local plane; see `Tracker`.

    Boxes without a position (above the horizon, or too far) are followed in the image alone. Ids
    start at 1, and belong to the instance.
    """

    def __init__(
        self,
        locate: Locate,
        settings: WorldTrackerSettings | None = None,
        *,
        platform: Platform | None = None,
    ) -> None:
        """Begin without targets.

        Args:
            locate: Where boxes lie, as `Georeferencer.locate` says it.
            settings: Absent: those for vessels.
            platform: What the camera stands on, where that moves.
        """
        settings = settings if settings is not None else WorldTrackerSettings()
        super().__init__(WorldPlane(locate, settings, platform), settings)

    def estimates(self) -> Estimates:
        """Estimates of the confirmed targets that have a position, lost ones among them.

        `sightline.trajectory.forecast.MotionState.of_moments` moves them all on at once.
        """
        state = self._state
        if state is None:
            state = self._plane.start(self._plane.measure(Boxes.of([])))
        chosen = (self._track_id != NO_TRACK) & (state["placed"] > 0.0)
        return Estimates(
            time_utc_s=self._time_s,
            track_id=self._track_id[chosen],
            seen_utc_s=self._last_s[chosen],
            mean=state["place"][chosen],
            covariance=state["doubt"][chosen],
        )


def _line_of_sight(en_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Bearing (radians) and inverse range (1/m) of places, and their Jacobian.

    Args:
        en_m: (N, 2) metres.

    Returns:
        (N, 2), and (N, 2, 2): rows bearing and inverse range, columns east and north.
    """
    east, north = en_m.T
    range_m = np.maximum(np.hypot(east, north), _NEAREST_M)
    squared = range_m * range_m
    sight, derivative = np.empty((len(en_m), 2)), np.empty((len(en_m), 2, 2))
    sight[:, 0], sight[:, 1] = np.arctan2(east, north), 1.0 / range_m
    along_east, along_north = east / squared, north / squared
    derivative[:, 0, 0], derivative[:, 0, 1] = along_north, -along_east
    derivative[:, 1, 0], derivative[:, 1, 1] = -along_east / range_m, -along_north / range_m
    return sight, derivative


def _on_both_axes(matrix: FloatArray) -> FloatArray:
    """Extend (2, 2) for position and velocity along one axis to both axes: (4, 4)."""
    out = np.zeros((4, 4))
    out[::2, ::2] = out[1::2, 1::2] = matrix
    return out


def _residual(measured: FloatArray, expected: FloatArray) -> FloatArray:
    """(N, 2) residuals, that of the bearing wrapped to (-pi, pi]."""
    off = measured - expected
    off[:, 0] = np.remainder(off[:, 0] + np.pi, 2.0 * np.pi) - np.pi
    return np.asarray(off)


def _inverse(matrices: FloatArray) -> FloatArray:
    """(N, 2, 2) inverses of (N, 2, 2) symmetric and positive definite matrices."""
    a, b, c = matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 1]
    determinant = a * c - b * b
    out = np.empty_like(matrices)
    out[:, 0, 0], out[:, 1, 1] = c / determinant, a / determinant
    out[:, 0, 1] = out[:, 1, 0] = -b / determinant
    return out


def _squared(off: FloatArray, spread: FloatArray) -> FloatArray:
    """(N,) squared Mahalanobis distances of (N, 2) under covariances (N, 2, 2)."""
    x, y = off.T
    a, b, c = spread[:, 0, 0], spread[:, 0, 1], spread[:, 1, 1]
    return np.asarray((c * x * x - 2.0 * b * x * y + a * y * y) / (a * c - b * b))
