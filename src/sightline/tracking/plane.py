"""The seam inside a tracker: what is measured of a target, and how that moves."""

from __future__ import annotations

from typing import Protocol

from sightline.types import BoolArray, Boxes, FloatArray, IntArray

Columns = dict[str, FloatArray]
"""Columns by name, a row a target or a box: what they are is the affair of the plane."""


class Plane(Protocol):
    """A measurement model: the image, or the earth.

    States and measurements are tables whose columns only the plane knows. All are taken row by
    row, so that any number of targets is one call.
    """

    def measure(self, boxes: Boxes) -> Columns:
        """What N boxes tell."""
        ...

    def start(self, measured: Columns) -> Columns:
        """States of N new targets, each from one box."""
        ...

    def predict(self, state: Columns, lag_s: float) -> Columns:
        """States some time later."""
        ...

    def candidates(
        self, state: Columns, silent_s: FloatArray, measured: Columns
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """Which boxes may be of which targets.

        Args:
            state: T targets, predicted to the time of the boxes.
            silent_s: (T,) how long each has had no box.
            measured: N boxes.

        Returns:
            (P,) rows of targets, (P,) rows of boxes, and (P,) costs, the lower the likelier.
        """
        ...

    def update(self, state: Columns, silent_s: FloatArray, measured: Columns) -> Columns:
        """States of T targets that each have got the box in their row."""
        ...

    def continuations(
        self, ended: Columns, silent_s: FloatArray, begun: Columns
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """Which new targets may be the continuation of which lost ones.

        Args:
            ended: T lost targets, predicted to now.
            silent_s: (T,) how long each has been lost.
            begun: N new targets.

        Returns:
            As `candidates`.
        """
        ...


def rows(table: Columns, chosen: IntArray | BoolArray) -> Columns:
    """The rows of a table that an index array or a mask selects."""
    return {name: column[chosen] for name, column in table.items()}
