"""Positions of boxes in the plane of a model."""

from __future__ import annotations

from dataclasses import dataclass

from sightline.types import FloatArray


@dataclass(frozen=True, eq=False)
class Placement:
    """Positions with covariances in the plane of a model, one row a box; NaN where there is none.

    Attributes:
        east_north_m: (N, 2) float64, metres; starboard and ahead where the camera moves.
        covariance_m2: (N, 2, 2) float64.
        shared_covariance_m2: (N, 2, 2) float64, the part that a target has in common with itself a
            moment later; None where the model does not tell.
    """

    east_north_m: FloatArray
    covariance_m2: FloatArray
    shared_covariance_m2: FloatArray | None = None
