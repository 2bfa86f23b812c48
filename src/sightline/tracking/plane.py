"""The seam inside a tracker: measurement and motion model of a target."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sightline.types import Boxes, FloatArray, IntArray

Columns = NDArray[np.void]
"""Columns by name, a row a target or a box: what they are is the affair of the plane.

A structured array, since rows are selected again and again: of all columns in one step.
"""

Fields = list[tuple[str, type, tuple[int, ...]]]
"""Names, types and shapes of columns."""


class Plane(Protocol):
    """A measurement model: the image, or the earth.

    States and measurements are tables whose columns only the plane knows. All are taken row by
    row, so that any number of targets, or of boxes of whatever moments, is one call.
    """

    def measure(self, boxes: Boxes) -> Columns:
        """Measurements of N boxes."""
        ...

    def start(self, measured: Columns) -> Columns:
        """States of N new targets, each from one box."""
        ...

    def predict(self, state: Columns, lag_s: float) -> None:
        """Predict states to a later time."""
        ...

    def candidates(
        self, state: Columns, silent_s: FloatArray, measured: Columns
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """Gated pairs of targets and boxes, with their costs.

        Args:
            state: T targets, predicted to the time of the boxes.
            silent_s: (T,) how long each has had no box.
            measured: N boxes.

        Returns:
            (P,) rows of targets, (P,) rows of boxes, and (P,) costs, the lower the likelier.
        """
        ...

    def update(self, state: Columns, silent_s: FloatArray, measured: Columns) -> None:
        """Update the states of T targets, each with the box in its row."""
        ...

    def continuations(
        self, ended: Columns, silent_s: FloatArray, begun: Columns
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """Gated pairs of lost and new targets to stitch, with their costs.

        Args:
            ended: T lost targets, predicted to now.
            silent_s: (T,) how long each has been lost.
            begun: N new targets.

        Returns:
            As `candidates`.
        """
        ...


def white_acceleration(lag_s: float) -> tuple[FloatArray, FloatArray]:
    """Transition and process noise of constant velocity along one axis.

    Returns:
        (2, 2), and (2, 2) for a spectral density of 1.
    """
    square, cube = lag_s * lag_s / 2.0, lag_s**3 / 3.0
    return np.array([[1.0, lag_s], [0.0, 1.0]]), np.array([[cube, square], [square, lag_s]])
