"""Multi-target tracking in the image, before anything is known of the camera.

Each target's box moves with a constant velocity; a Kalman filter a target predicts it, and boxes
are given to targets by the least total cost (Bewley et al. 2016, "Simple online and realtime
tracking"), with all times in seconds, since frames come irregularly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sightline.tracking.plane import Columns, Fields, white_acceleration
from sightline.tracking.targets import TargetTracker, TrackerSettings
from sightline.types import BoolArray, Boxes, FloatArray, IntArray

LARGEST_UNLIKE = 2.0 * float(np.log(3.0))
"""A box of three times the width and height is of something else."""

IMAGE_STATE: Fields = [
    ("centre", float, (2,)),
    ("velocity", float, (2,)),
    ("motion", float, (2, 2)),
    ("log_size", float, (2,)),
    ("shape_variance", float, ()),
]
IMAGE_MEASURED: Fields = [
    ("centre", float, (2,)),
    ("log_size", float, (2,)),
    ("half_size", float, (2,)),
    ("xyxy", float, (4,)),
]


@dataclass(frozen=True)
class ImageTrackerSettings(TrackerSettings):
    """Settings of an `ImageTracker`.

    Lengths are shares of the size of a target's box, the root of its area, so they hold near and
    far.

    Attributes:
        gate: Largest distance between a predicted and a found centre, in standard deviations.
        least_overlap: A box that overlaps the predicted one by less (intersection over union) is
            taken only inside the gate.
        position_noise: Standard deviation of a box's centre, of the size.
        size_noise: Standard deviation of the logarithms of width and height.
        acceleration: Standard deviation of a change of velocity in a second, sizes a second.
        growth: Standard deviation of the change of those logarithms in a second.
    """

    gate: float = 4.0
    least_overlap: float = 0.2
    position_noise: float = 0.10
    size_noise: float = 0.20
    acceleration: float = 0.35
    growth: float = 0.25


@dataclass(frozen=True, eq=False)
class Nearness:
    """Distance, overlap and size difference of boxes and predicted targets, one row a pair.

    Attributes:
        target: (P,) int64, row of the target.
        box: (P,) int64, row of the box.
        distance: (P,) float64, between the centres, in standard deviations.
        overlap: (P,) float64, intersection over union.
        unlike: (P,) float64, sum of the differences of the logarithms of width and height.
    """

    target: IntArray
    box: IntArray
    distance: FloatArray
    overlap: FloatArray
    unlike: FloatArray


class ImagePlane:
    """The image as a measurement model; see `Plane`.

    A state has the columns ``centre`` (N, 2) px, ``velocity`` (N, 2) px/s, ``motion`` (N, 2, 2)
    the covariance of position and velocity along one axis (across and down are alike: one
    serves both), ``log_size`` (N, 2) logarithms of width and height, and ``shape_variance`` (N,).
    """

    def __init__(self, settings: ImageTrackerSettings) -> None:
        """Take the settings."""
        self._settings = settings

    def measure(self, boxes: Boxes) -> Columns:
        """Centres, sizes and corners; see `Plane`."""
        measured = np.zeros(len(boxes), dtype=IMAGE_MEASURED)
        self.fill_measured(measured, boxes)
        return measured

    def fill_measured(self, measured: Columns, boxes: Boxes) -> None:
        """Fill in the columns of `measure`, in a table that may have others."""
        xyxy = boxes.xyxy_px
        measured["xyxy"] = xyxy
        measured["centre"] = 0.5 * (xyxy[:, :2] + xyxy[:, 2:])
        measured["half_size"] = 0.5 * (xyxy[:, 2:] - xyxy[:, :2])
        measured["log_size"] = np.log(xyxy[:, 2:] - xyxy[:, :2])

    def start(self, measured: Columns) -> Columns:
        """See `Plane`."""
        state = np.zeros(len(measured), dtype=IMAGE_STATE)
        self.fill_start(state, measured)
        return state

    def fill_start(self, state: Columns, measured: Columns) -> None:
        """Fill in the columns of `start`, in a table of zeros that may have others."""
        area = _area(measured["log_size"])
        state["centre"] = measured["centre"]
        state["motion"][:, 0, 0] = self._settings.position_noise**2 * area
        state["motion"][:, 1, 1] = area
        state["log_size"] = measured["log_size"]
        state["shape_variance"] = self._settings.size_noise**2

    def predict(self, state: Columns, lag_s: float) -> None:
        """Predict with constant velocity under white acceleration. See `Plane`."""
        power = self._settings.acceleration**2 * _area(state["log_size"])
        step, noise = white_acceleration(lag_s)
        state["centre"] += lag_s * state["velocity"]
        state["motion"] = step @ state["motion"] @ step.T + power[:, None, None] * noise
        state["shape_variance"] += self._settings.growth**2 * lag_s

    def candidates(
        self,
        state: Columns,
        silent_s: FloatArray,  # noqa: ARG002 - the state knows how unsure it has become
        measured: Columns,
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """See `Plane`."""
        near = self.nearness(state, measured)
        possible = self.possible(near)
        cost = self.cost(near)[possible]
        return near.target[possible], near.box[possible], cost

    def possible(self, near: Nearness) -> BoolArray:
        """(P,) bool, whether a pair is inside the gate or overlaps, and is of similar size."""
        settings = self._settings
        close = (near.distance <= settings.gate) | (near.overlap >= settings.least_overlap)
        return np.asarray(close & (near.unlike < LARGEST_UNLIKE))

    def cost(self, near: Nearness) -> FloatArray:
        """(P,) association cost of pairs."""
        return near.distance / self._settings.gate + (1.0 - near.overlap) + 0.5 * near.unlike

    def nearness(self, state: Columns, measured: Columns) -> Nearness:
        """Pairs of T targets and N boxes inside the gate of each other, or that may overlap."""
        spread = self._spread_px(state)
        centre, log_size = state["centre"], state["log_size"]
        box_centre, half_box = measured["centre"], measured["half_size"]
        half = 0.5 * np.exp(log_size)
        reach = self._settings.gate * spread
        # Of hundreds of boxes few are near in x: look at those alone.
        widest = np.maximum(reach, half[:, 0] + half_box[:, 0].max(initial=0.0))
        apart_x = np.abs(centre[:, :1] - box_centre[:, 0])
        i, j = np.nonzero(apart_x <= widest[:, None])
        apart = np.abs(centre[i] - box_centre[j])
        inside = apart <= np.maximum(reach[i, None], half[i] + half_box[j])
        near = inside[:, 0] & inside[:, 1]
        if not near.all():
            i, j, apart = i[near], j[near], apart[near]
        own, other = half[i], half_box[j]
        middle, corners = centre[i], measured["xyxy"][j]
        low = np.maximum(middle - own, corners[:, :2])
        high = np.minimum(middle + own, corners[:, 2:])
        side = np.maximum(high - low, 0.0)
        shared = side[:, 0] * side[:, 1]
        area = 4.0 * (own[:, 0] * own[:, 1] + other[:, 0] * other[:, 1])
        unlike = np.abs(log_size[i] - measured["log_size"][j])
        return Nearness(
            target=i,
            box=j,
            distance=np.hypot(apart[:, 0], apart[:, 1]) / spread[i],
            overlap=shared / (area - shared),
            unlike=unlike[:, 0] + unlike[:, 1],
        )

    def update(
        self,
        state: Columns,
        silent_s: FloatArray,  # noqa: ARG002 - the state knows how unsure it has become
        measured: Columns,
    ) -> None:
        """See `Plane`."""
        motion, shape = state["motion"], state["shape_variance"]
        gain = motion[:, :, 0] / self._spread_px(state)[:, None] ** 2
        innovation = measured["centre"] - state["centre"]
        shape_gain = shape / (shape + self._settings.size_noise**2)
        size_step = shape_gain[:, None] * (measured["log_size"] - state["log_size"])
        state["centre"] += gain[:, :1] * innovation
        state["velocity"] += gain[:, 1:] * innovation
        state["motion"] = motion - gain[:, :, None] * motion[:, None, 0, :]
        state["log_size"] += size_step
        state["shape_variance"] = shape * (1.0 - shape_gain)

    def continuations(
        self,
        ended: Columns,  # noqa: ARG002 - none is taken up again
        silent_s: FloatArray,  # noqa: ARG002
        begun: Columns,  # noqa: ARG002
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """See `Plane`: none, since image velocity is too uncertain to stitch tracklets."""
        nothing = np.empty(0, dtype=np.int64)
        return nothing, nothing, np.empty(0)

    def _spread_px(self, state: Columns) -> FloatArray:
        """(N,) standard deviation of the innovation of the centre."""
        noise = self._settings.position_noise**2 * _area(state["log_size"])
        return np.asarray(np.sqrt(state["motion"][:, 0, 0] + noise))


def _area(log_size: FloatArray) -> FloatArray:
    """(N,) areas, square pixels, from logarithms of width and height (N, 2)."""
    return np.asarray(np.exp(log_size[:, 0] + log_size[:, 1]))


class ImageTracker(TargetTracker):
    """Follows many targets in the image; see `Tracker`.

    Ids start at 1, and belong to the instance.
    """

    def __init__(self, settings: ImageTrackerSettings | None = None) -> None:
        """Begin without targets.

        Args:
            settings: Absent: those for boats before a small camera.
        """
        settings = settings if settings is not None else ImageTrackerSettings()
        super().__init__(ImagePlane(settings), settings)
