"""Many targets in the image, before anything is known of the camera.

Each target's box moves with a constant velocity; a Kalman filter a target predicts it, and boxes
are given to targets by the least total cost (Bewley et al. 2016, "Simple online and realtime
tracking"), with all times in seconds, since frames come irregularly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from sightline.errors import InputError
from sightline.types import NO_TRACK, Boxes, FloatArray, IntArray

_IMPOSSIBLE = 1e6


@dataclass(frozen=True)
class ImageTrackerSettings:
    """How an `ImageTracker` follows targets.

    Lengths are shares of the size of a target's box, the root of its area, so they hold near and
    far.

    Attributes:
        confirm_s: A target counts once it has been followed for this long.
        coast_s: A confirmed target is kept for this long without a box: behind a post, say.
        coast_unconfirmed_s: The same for one that is not confirmed, once it was missed.
        gate: Largest distance between a predicted and a found centre, in standard deviations.
        least_overlap: A box that overlaps the predicted one by less (intersection over union) is
            taken only inside the gate.
        position_noise: Standard deviation of a box's centre, of the size.
        size_noise: Standard deviation of the logarithms of width and height.
        acceleration: Standard deviation of a change of velocity in a second, sizes a second.
        growth: Standard deviation of the change of those logarithms in a second.
    """

    confirm_s: float = 0.4
    coast_s: float = 3.0
    coast_unconfirmed_s: float = 0.3
    gate: float = 4.0
    least_overlap: float = 0.2
    position_noise: float = 0.10
    size_noise: float = 0.20
    acceleration: float = 0.35
    growth: float = 0.25

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value >= 0.0:
                raise InputError(f"image tracker: {name} is {value:g}; it must not be negative")


class _Target:
    """State of one target: centre and velocity, px and px/s, and log width and log height."""

    def __init__(self, box: FloatArray, time_s: float, settings: ImageTrackerSettings) -> None:
        self._settings = settings
        self.first_s = self.last_s = self._time_s = time_s
        self.track_id = NO_TRACK
        centre, log_size = _measure(box)
        self.centre, self.velocity, self.log_size = centre, np.zeros(2), log_size
        size = self._size
        # East and west are alike: one 2 x 2 covariance of position and velocity serves both axes.
        self._motion = np.diag([(settings.position_noise * size) ** 2, size**2])
        self._shape_variance = settings.size_noise**2

    @property
    def _size(self) -> float:
        return float(np.exp(0.5 * self.log_size.sum()))

    @property
    def box(self) -> FloatArray:
        """(4,) the box as predicted or last updated, px."""
        half = 0.5 * np.exp(self.log_size)
        return np.concatenate([self.centre - half, self.centre + half])

    @property
    def spread_px(self) -> float:
        """Standard deviation of the next centre about the predicted one."""
        noise = (self._settings.position_noise * self._size) ** 2
        return float(np.sqrt(self._motion[0, 0] + noise))

    def predict(self, time_s: float) -> None:
        """Move on to a time."""
        dt = time_s - self._time_s
        self._time_s = time_s
        self.centre = self.centre + dt * self.velocity
        transition = np.array([[1.0, dt], [0.0, 1.0]])
        # White acceleration in continuous time.
        power = (self._settings.acceleration * self._size) ** 2
        noise = power * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
        self._motion = transition @ self._motion @ transition.T + noise
        self._shape_variance += self._settings.growth**2 * dt

    def update(self, box: FloatArray) -> None:
        """Take a box at the time predicted to."""
        centre, log_size = _measure(box)
        gain = self._motion[:, 0] / self.spread_px**2
        innovation = centre - self.centre
        self.centre = self.centre + gain[0] * innovation
        self.velocity = self.velocity + gain[1] * innovation
        self._motion = self._motion - np.outer(gain, self._motion[0])
        shape_gain = self._shape_variance / (self._shape_variance + self._settings.size_noise**2)
        self.log_size = self.log_size + shape_gain * (log_size - self.log_size)
        self._shape_variance *= 1.0 - shape_gain
        self.last_s = self._time_s


class ImageTracker:
    """Follows many targets in the image; see `Tracker`.

    Ids start at 1, and belong to the instance.
    """

    def __init__(self, settings: ImageTrackerSettings | None = None) -> None:
        """Begin without targets.

        Args:
            settings: Absent: those for boats before a small camera.
        """
        self._settings = settings if settings is not None else ImageTrackerSettings()
        self._next_id = 1
        self.reset()

    def reset(self) -> None:
        """Forget all targets; see `Tracker`."""
        self._targets: list[_Target] = []
        self._time_s = -np.inf

    def update(self, boxes: Boxes) -> Boxes:
        """Give the boxes of one moment their track ids; see `Tracker`."""
        if not len(boxes):
            return boxes
        time_s = float(boxes.time_utc_s[0])
        if not (boxes.time_utc_s == time_s).all():
            raise InputError("a tracker takes the boxes of one known time; these have several")
        if time_s <= self._time_s:
            raise InputError(
                f"boxes come {self._time_s - time_s:g} s before those seen last; a tracker takes "
                "them in the order of time, and is reset between recordings"
            )
        self._targets = [target for target in self._targets if not self._gone(target, time_s)]
        self._time_s = time_s
        for target in self._targets:
            target.predict(time_s)
        owner = self._assign(boxes.xyxy_px)
        for row, index in enumerate(owner.tolist()):
            if index == -1:
                self._targets.append(_Target(boxes.xyxy_px[row], time_s, self._settings))
                owner[row] = len(self._targets) - 1
            else:
                self._targets[index].update(boxes.xyxy_px[row])
        ids = np.array([self._confirmed_id(self._targets[i], time_s) for i in owner.tolist()])
        return boxes.with_columns(track_id=ids)[ids != NO_TRACK]

    def _gone(self, target: _Target, time_s: float) -> bool:
        if target.track_id != NO_TRACK:
            return time_s - target.last_s > self._settings.coast_s
        # With few frames a second, the next one is not late.
        missed = target.last_s < self._time_s
        return missed and time_s - target.last_s > self._settings.coast_unconfirmed_s

    def _confirmed_id(self, target: _Target, time_s: float) -> int:
        if target.track_id == NO_TRACK and time_s - target.first_s >= self._settings.confirm_s:
            target.track_id = self._next_id
            self._next_id += 1
        return target.track_id

    def _assign(self, xyxy_px: FloatArray) -> IntArray:
        """(N,) index of the target of each box, -1 where there is none."""
        owner = np.full(len(xyxy_px), -1, dtype=np.int64)
        free = np.ones(len(xyxy_px), dtype=bool)
        # Confirmed targets choose first: clutter beside a boat must not take its box.
        for confirmed in (True, False):
            chosen = [
                i for i, t in enumerate(self._targets) if (t.track_id != NO_TRACK) == confirmed
            ]
            rows = np.flatnonzero(free)
            if not chosen or not rows.size:
                continue
            cost = self._cost([self._targets[i] for i in chosen], xyxy_px[rows])
            for i, j in zip(*linear_sum_assignment(cost), strict=True):
                if cost[i, j] < _IMPOSSIBLE:
                    owner[rows[j]] = chosen[i]
                    free[rows[j]] = False
        return owner

    def _cost(self, targets: list[_Target], xyxy_px: FloatArray) -> FloatArray:
        """(targets, boxes), the lower the likelier; `_IMPOSSIBLE` outside gate and overlap."""
        predicted = np.stack([target.box for target in targets])
        overlap = iou(predicted, xyxy_px)
        centres = 0.5 * (xyxy_px[:, :2] + xyxy_px[:, 2:])
        apart = np.linalg.norm(
            np.stack([target.centre for target in targets])[:, None] - centres[None], axis=2
        )
        distance = apart / np.array([target.spread_px for target in targets])[:, None]
        size = np.log(xyxy_px[:, 2:] - xyxy_px[:, :2])
        sizes = np.stack([target.log_size for target in targets])
        unlike = np.abs(sizes[:, None] - size[None]).sum(axis=2)
        cost = distance / self._settings.gate + (1.0 - overlap) + 0.5 * unlike
        # A box of three times the width and height is of something else.
        possible = (distance <= self._settings.gate) | (overlap >= self._settings.least_overlap)
        possible &= unlike < 2.0 * np.log(3.0)
        return np.where(possible, cost, _IMPOSSIBLE)


def _measure(box: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Centre, px, and logarithms of width and height."""
    return 0.5 * (box[:2] + box[2:]), np.log(box[2:] - box[:2])


def iou(first: FloatArray, second: FloatArray) -> FloatArray:
    """(N, M) intersection over union of boxes (N, 4) and (M, 4), pixels."""
    low = np.maximum(first[:, None, :2], second[None, :, :2])
    high = np.minimum(first[:, None, 2:], second[None, :, 2:])
    shared = np.maximum(high - low, 0.0).prod(axis=2)
    area_1 = (first[:, 2:] - first[:, :2]).prod(axis=1)
    area_2 = (second[:, 2:] - second[:, :2]).prod(axis=1)
    return np.asarray(shared / (area_1[:, None] + area_2[None, :] - shared))
