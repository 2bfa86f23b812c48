"""Bias of each camera from targets that two of them see: an offset, and a turn about its place.

What is seen are differences of two cameras. What all of them have in common shows in none, so each
bias has a prior, and the answer is the most probable one (sensor registration; Bar-Shalom, Willett
and Tian, *Tracking and Data Fusion*, 2011, chapter 10).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sightline.types import FloatArray

# A scale of ranges is not among them: every camera sees the near side of a hull, and what that
# makes of places looks the same.
PARAMETERS = 3
"""Of a camera: metres east, metres north, and radians clockwise."""

_ROUNDS = 8
_HUBER = 2.5


@dataclass(frozen=True)
class BiasPrior:
    """What is believed of a camera's bias before targets are compared.

    Attributes:
        offset_m: Standard deviation of the offset, east and north, metres.
        heading_deg: Standard deviation of its heading.
    """

    offset_m: float = 3.0
    heading_deg: float = 0.5

    @property
    def sigma(self) -> FloatArray:
        """(3,) float64, standard deviations; metres and radians."""
        return np.array([self.offset_m, self.offset_m, np.radians(self.heading_deg)])


@dataclass(frozen=True, eq=False)
class Differences:
    """How far apart two cameras have the same target, one row a stretch of time.

    Attributes:
        first: (N,) int64, index of one camera.
        second: (N,) int64, index of the other.
        place_m: (N, 2) float64, where the target is, in the middle of the two.
        apart_m: (N, 2) float64, the place by the first camera less that by the second.
        covariance_m2: (N, 2, 2) float64, of that.
    """

    first: np.ndarray
    second: np.ndarray
    place_m: FloatArray
    apart_m: FloatArray
    covariance_m2: FloatArray

    def __len__(self) -> int:
        return len(self.apart_m)

    @classmethod
    def none(cls) -> Differences:
        """Of no target."""
        index = np.empty(0, dtype=np.int64)
        return cls(index, index, np.empty((0, 2)), np.empty((0, 2)), np.empty((0, 2, 2)))


@dataclass(frozen=True, eq=False)
class Biases:
    """Bias of each camera: what it adds to the true place of a target.

    Attributes:
        value: (K, 3) float64, metres east and north, and radians clockwise about its place.
        covariance: (3 K, 3 K) float64, of all of them, camera after camera.
        camera_m: (K, 2) float64, where each camera stands; NaN where nobody says, and then its
            bias has no turn.
        compared: (K,) int64, how many stretches of time it shared with another.
    """

    value: FloatArray
    covariance: FloatArray
    camera_m: FloatArray
    compared: np.ndarray

    @classmethod
    def unknown(cls, camera_m: FloatArray, prior: BiasPrior) -> Biases:
        """The biases before anything is compared."""
        n = len(camera_m)
        sigma = _sigma(camera_m, prior)
        value, compared = np.zeros((n, PARAMETERS)), np.zeros(n, dtype=np.int64)
        return cls(value, np.diag(sigma**2), camera_m, compared)

    def at(self, camera: int, place_m: FloatArray) -> FloatArray:
        """(N, 2) metres that a camera adds to places."""
        return np.asarray(self._jacobian(camera, place_m) @ self.value[camera])

    def apart(self, seen: Differences) -> FloatArray:
        """(N, 2) metres that the biases make two cameras differ by."""
        rows = zip(seen.first.tolist(), seen.second.tolist(), seen.place_m, strict=True)
        parts = [self.at(a, place[None]) - self.at(b, place[None]) for a, b, place in rows]
        return np.concatenate([np.empty((0, 2)), *parts])

    def of_difference(self, first: int, second: int, place_m: FloatArray) -> FloatArray:
        """(N, 2, 2) covariance of what the biases of two cameras make of their difference."""
        own = self._jacobian(first, place_m)
        other = self._jacobian(second, place_m)
        both = np.concatenate([own, -other], axis=2)
        rows = np.r_[_rows(first), _rows(second)]
        return np.asarray(both @ self.covariance[np.ix_(rows, rows)] @ both.transpose(0, 2, 1))

    def _jacobian(self, camera: int, place_m: FloatArray) -> FloatArray:
        return jacobian(self.camera_m[camera], place_m)


def jacobian(camera_m: FloatArray, place_m: FloatArray) -> FloatArray:
    """(N, 2, 3) how the bias of a camera moves places.

    Args:
        camera_m: (2,) where it stands; NaN where nobody says.
        place_m: (N, 2) metres.
    """
    out = np.zeros((len(place_m), 2, PARAMETERS))
    out[:, 0, 0] = out[:, 1, 1] = 1.0
    if np.isfinite(camera_m).all():
        away = place_m - camera_m
        # Clockwise: what lies north moves east.
        out[:, 0, 2], out[:, 1, 2] = away[:, 1], -away[:, 0]
    return out


def estimate(seen: Differences, camera_m: FloatArray, prior: BiasPrior) -> Biases:
    """The most probable biases (maximum a posteriori, with Huber's weights).

    Where the differences scatter more than their covariances say, those of the biases are widened
    by as much.

    Args:
        seen: Differences of targets that two cameras see.
        camera_m: (K, 2) where each camera stands.
        prior: Of each.
    """
    n = len(camera_m)
    unknown = Biases.unknown(camera_m, prior)
    if not len(seen):
        return unknown
    rows = np.zeros((len(seen), 2, n * PARAMETERS))
    for camera in range(n):
        own = jacobian(camera_m[camera], seen.place_m)
        sign = (seen.first == camera).astype(float) - (seen.second == camera).astype(float)
        rows[:, :, _rows(camera)] = sign[:, None, None] * own
    information = np.linalg.inv(seen.covariance_m2)
    prior_information = np.diag(1.0 / _sigma(camera_m, prior) ** 2)
    weight = np.ones(len(seen))
    vector = np.zeros(n * PARAMETERS)
    normal = prior_information
    for _ in range(_ROUNDS):
        weighted = weight[:, None, None] * information
        normal = np.einsum("mip,mij,mjq->pq", rows, weighted, rows) + prior_information
        right = np.einsum("mip,mij,mj->p", rows, weighted, seen.apart_m)
        vector = np.linalg.solve(normal, right)
        left = seen.apart_m - rows @ vector
        distance = np.sqrt(np.einsum("mi,mij,mj->m", left, information, left))
        weight = np.minimum(1.0, _HUBER / np.maximum(distance, 1e-12))
    excess = max(1.0, float(np.mean(np.minimum(distance, 2.0 * _HUBER) ** 2)) / 2.0)
    data = normal - prior_information
    covariance = np.asarray(np.linalg.inv(data / excess + prior_information), dtype=np.float64)
    compared = np.array([int(((seen.first == k) | (seen.second == k)).sum()) for k in range(n)])
    return Biases(vector.reshape(n, PARAMETERS), covariance, camera_m, compared)


def _sigma(camera_m: FloatArray, prior: BiasPrior) -> FloatArray:
    return np.tile(prior.sigma, len(camera_m))


def _rows(camera: int) -> slice:
    return slice(camera * PARAMETERS, (camera + 1) * PARAMETERS)
