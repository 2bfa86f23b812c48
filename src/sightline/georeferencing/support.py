"""The support of a model in the image: beyond it, it extrapolates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull

from sightline.types import BoolArray, FloatArray

_MARGIN = (0.02, 0.015)


@dataclass(frozen=True, eq=False)
class Support:
    """Convex hull of the pixels that a model learned from, slightly widened.

    Attributes:
        planes: (M, 3) float64; a pixel is inside where ``planes[:, :2] @ pixel + planes[:, 2]``
            is nowhere positive.
    """

    planes: FloatArray

    @classmethod
    def of(cls, pixel_px: ArrayLike, image_size_px: tuple[int, int]) -> Self:
        """The support of (N, 2) pixels, N at least 1.

        It is widened by 2 % of the width and 1.5 % of the height of the image.
        """
        pixel = np.asarray(pixel_px, dtype=np.float64).reshape(-1, 2)
        margin = np.multiply(_MARGIN, image_size_px)
        corners = np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]]) * margin
        # With its corners around it even a single pixel has a hull.
        widened = (pixel[:, None, :] + corners).reshape(-1, 2)
        return cls(np.asarray(ConvexHull(widened).equations, dtype=np.float64))

    def holds(self, pixel_px: FloatArray) -> BoolArray:
        """(N,) bool, whether (N, 2) pixels lie inside."""
        return np.asarray((pixel_px @ self.planes[:, :2].T + self.planes[:, 2] <= 1e-9).all(axis=1))
