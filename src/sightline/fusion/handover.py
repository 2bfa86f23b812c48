"""Handover across gaps: whose track begins where another's has ended, and what lies between.

A target that no camera sees goes on as it went, less and less surely: its velocity changes by white
acceleration (nearly constant velocity; Bar-Shalom, Li and Kirubarajan, *Estimation with
Applications to Tracking and Navigation*, 2001, section 6.2).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from sightline.fusion.intersection import intersect
from sightline.fusion.track_association import SAME_VESSEL, of_velocities
from sightline.types import FloatArray

_GATE = 16.0
_UNKNOWN_MPS = 1.5
_OVERLAP_S = 2.0


@dataclass(frozen=True)
class HandoverSettings:
    """Settings of the handover.

    Attributes:
        longest_s: Longest time in which no camera sees a target that is then taken up again.
        acceleration_m2ps3: Spectral density of the white acceleration, m²/s³.
        least_nats: A track goes on in another where that is likelier than not by more than this.
    """

    longest_s: float = 60.0
    acceleration_m2ps3: float = 0.1
    least_nats: float = 2.0


@dataclass(frozen=True, eq=False)
class End:
    """A state at the beginning or the end of what was seen of a target.

    Attributes:
        time_s: When.
        place_m: (2,) float64, east and north.
        velocity_mps: (2,) float64.
        covariance_m2: (2, 2) float64, of the place.
        velocity_covariance: (2, 2) float64, m²/s²; NaN where nobody says.
    """

    time_s: float
    place_m: FloatArray
    velocity_mps: FloatArray
    covariance_m2: FloatArray
    velocity_covariance: FloatArray

    def at(self, time_s: FloatArray, acceleration_m2ps3: float) -> tuple[FloatArray, FloatArray]:
        """(N, 4) places and velocities at other times, and (N, 4, 4) covariances.

        Args:
            time_s: (N,) later or earlier.
            acceleration_m2ps3: Spectral density of the white acceleration.
        """
        lag = np.atleast_1d(time_s) - self.time_s
        n = lag.size
        step = np.tile(np.eye(4), (n, 1, 1))
        step[:, 0, 2] = step[:, 1, 3] = lag
        covariance = np.zeros((4, 4))
        covariance[:2, :2] = self.covariance_m2
        covariance[2:, 2:] = known_velocity(self.velocity_covariance)
        state = np.concatenate([self.place_m, self.velocity_mps])
        far = np.abs(lag)
        noise = np.zeros((n, 4, 4))
        for axis in (0, 1):
            noise[:, axis, axis] = far**3 / 3.0
            noise[:, axis + 2, axis + 2] = far
            noise[:, axis, axis + 2] = noise[:, axis + 2, axis] = np.sign(lag) * far**2 / 2.0
        spread = step @ covariance @ step.transpose(0, 2, 1) + acceleration_m2ps3 * noise
        return np.asarray(step @ state), np.asarray(spread)


def known_velocity(covariance: FloatArray) -> FloatArray:
    """The covariance of a velocity; a wide one where nobody says."""
    if np.isfinite(covariance).all():
        return covariance
    return np.asarray(_UNKNOWN_MPS**2 * np.eye(2))


@dataclass(frozen=True, eq=False)
class Seen:
    """What was seen of a target without a long gap.

    Attributes:
        begin: Where it begins.
        end: Where it ends.
        begin_camera: Index of a camera that sees the beginning.
        end_camera: Index of a camera that sees the end.
        mmsi: Of the vessel, where that is known.
    """

    begin: End
    end: End
    begin_camera: int
    end_camera: int
    mmsi: int | None = None


def handover_nats(
    before: Seen, after: Seen, bias_m2: FloatArray, density: float, settings: HandoverSettings
) -> float:
    """Log-likelihood ratio of one target that goes on, against two; minus infinity beyond a gate.

    Args:
        before: What ends.
        after: What begins.
        bias_m2: (2, 2) covariance of the difference of their cameras' biases.
        density: Targets on a square metre.
        settings: How far to look.
    """
    lag_s = after.begin.time_s - before.end.time_s
    if not -_OVERLAP_S <= lag_s <= settings.longest_s:
        return -np.inf
    same = before.mmsi is not None and before.mmsi == after.mmsi
    if before.mmsi is not None and after.mmsi is not None and not same:
        return -np.inf
    states, spread = before.end.at(np.array([after.begin.time_s]), settings.acceleration_m2ps3)
    apart = after.begin.place_m - states[0, :2]
    covariance = spread[0, :2, :2] + after.begin.covariance_m2 + bias_m2
    distance = float(apart @ np.linalg.solve(covariance, apart))
    if same:
        return SAME_VESSEL - 0.5 * min(distance, _GATE)
    velocity = known_velocity(after.begin.velocity_covariance) + spread[0, 2:, 2:]
    turned = after.begin.velocity_mps - states[0, 2:]
    if distance > _GATE or float(turned @ np.linalg.solve(velocity, turned)) > _GATE:
        return -np.inf
    size = float(np.log(np.linalg.det(covariance)))
    place = -0.5 * (distance + size) - np.log(2.0 * np.pi * density)
    return float(place + of_velocities(turned[None], velocity[None])[0])


def successors(nats: Mapping[tuple[int, int], float], least_nats: float) -> dict[int, int]:
    """What goes on in what, one to one, with the largest sum of evidence (Kuhn-Munkres).

    Args:
        nats: Evidence that the first of two goes on in the second, where there is any.
        least_nats: Less counts for nothing.
    """
    told = [pair for pair, own in nats.items() if own > least_nats]
    if not told:
        return {}
    rows, columns = np.array(told).T
    n = int(max(rows.max(), columns.max())) + 1
    links = coo_matrix((np.ones(rows.size), (rows, columns + n)), shape=(2 * n, 2 * n))
    part = connected_components(links, directed=False)[1]
    out = {}
    for number in np.unique(part[rows]):
        own = np.unique(rows[part[rows] == number])
        theirs = np.unique(columns[part[rows] == number])
        gain = np.array(
            [
                [max(nats.get((i, j), -np.inf) - least_nats, 0.0) for j in theirs.tolist()]
                for i in own.tolist()
            ]
        )
        for i, j in zip(*linear_sum_assignment(gain, maximize=True), strict=True):
            if gain[i, j] > 0.0:
                out[int(own[i])] = int(theirs[j])
    return out


def bridge(
    before: End,
    after: End,
    time_s: FloatArray,
    settings: HandoverSettings,
    correlated_share: float = 1.0,
) -> tuple[FloatArray, FloatArray]:
    """States between the end of what was seen and the beginning of what is seen again.

    Args:
        before: The end.
        after: The beginning.
        time_s: (N,) times between the two.
        settings: The process noise.
        correlated_share: Of the errors of what is foretold from before and concluded from after:
            where one camera sees both, they have its bias in common.

    Returns:
        (N, 4) places and velocities, and (N, 4, 4) their covariances.
    """
    both = [one.at(time_s, settings.acceleration_m2ps3) for one in (before, after)]
    states = np.stack([state for state, _ in both], axis=1)
    covariances = np.stack([covariance for _, covariance in both], axis=1)
    return intersect(states, covariances, correlated_share)
