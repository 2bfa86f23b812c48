"""A pond with red boats."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SIZE_PX = (256, 160)
BOAT_RGB = (250, 60, 40)


def picture(boxes: list[tuple[int, int, int, int]], seed: int) -> NDArray[np.uint8]:
    """A grey sea with red boats, red, green, blue."""
    rng = np.random.default_rng(seed)
    width, height = SIZE_PX
    image = rng.integers(90, 120, (height, width, 3)).astype(np.uint8)
    for x1, y1, x2, y2 in boxes:
        image[y1:y2, x1:x2] = BOAT_RGB
    return image
