"""The layout of a camera fit's parameter vector.

A vector holds the camera, then the hull of its target, then two biases of each source of boxes,
then the clock offset of each recording. Everything else addresses a parameter by the names here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from sightline.types import FloatArray, IntArray

PARAMETERS = (
    "height_m",
    "pitch_deg",
    "roll_deg",
    "heading_deg",
    "focal_px",
    "k1",
    "k2",
    "east_m",
    "north_m",
    "principal_dx_px",
    "principal_dy_px",
    "curvature",
)
"""The unknowns of a camera, in the order of every parameter vector and covariance.

A parameter vector holds them as the fit sees them: the logarithms of height and focal length, and
angles in radians. The principal point counts from the middle of the image, and the curvature of the
sight line over the earth is a share of that of the earth itself.
"""

(
    LOG_HEIGHT,
    PITCH,
    ROLL,
    HEADING,
    LOG_FOCAL,
    K1,
    K2,
    EAST,
    NORTH,
    PRINCIPAL_DX,
    PRINCIPAL_DY,
    CURVATURE,
) = range(len(PARAMETERS))
"""Slots of the camera."""

POSITION = slice(EAST, NORTH + 1)
"""Slots of the camera's east and north."""

CAMERA = slice(0, len(PARAMETERS))
"""Slots of the whole camera, in the order of `PARAMETERS`."""

PRINCIPAL = slice(PRINCIPAL_DX, PRINCIPAL_DY + 1)
"""Slots of the principal point."""

TARGET_PARAMETERS = ("half_length_m", "half_beam_m")
"""What is unknown of the target: how far its hull reaches from where its log says that it is.

A box ends where the near side of the hull meets the water. From ahead or astern that is half a
length nearer than the receiver, from abeam half a beam.
"""

HALF_LENGTH, HALF_BEAM = range(CAMERA.stop, CAMERA.stop + len(TARGET_PARAMETERS))
"""Slots of the target."""

TARGET = slice(HALF_LENGTH, HALF_BEAM + 1)
"""Slots of the whole target, in the order of `TARGET_PARAMETERS`."""

CAMERA_AND_TARGET = slice(0, TARGET.stop)
"""Slots of what is the same for all sources of boxes."""

SOURCE_PARAMETERS = ("bias_px", "bias_m")
"""What is unknown of each source of boxes: see `SourceBias`."""

BIAS_PX, BIAS_M = range(len(SOURCE_PARAMETERS))
"""Where the slots of a source have each of `SOURCE_PARAMETERS`."""

Index = TypeVar("Index", int, IntArray)
"""One number of a source or a clock, or an array of them."""


@dataclass(frozen=True)
class ParameterLayout:
    """Slots of the parameter vector: `CAMERA`, `TARGET`, then the sources and the clocks.

    Attributes:
        n_sources: How many sources of boxes there are.
        n_clocks: How many recordings have a clock offset of their own.
    """

    n_sources: int
    n_clocks: int

    @classmethod
    def of(cls, size: int, n_clocks: int) -> ParameterLayout:
        """The layout of a parameter vector of some size, with so many clocks."""
        return cls((size - n_clocks - TARGET.stop) // len(SOURCE_PARAMETERS), n_clocks)

    def source(self, index: int) -> slice:
        """Slots of one source, in the order of `SOURCE_PARAMETERS`."""
        start = TARGET.stop + len(SOURCE_PARAMETERS) * index
        return slice(start, start + len(SOURCE_PARAMETERS))

    def bias_px(self, index: Index) -> Index:
        """Slot of a source's bias in pixels, or of each of several."""
        return TARGET.stop + len(SOURCE_PARAMETERS) * index + BIAS_PX

    def bias_m(self, index: Index) -> Index:
        """Slot of a source's bias in metres, or of each of several."""
        return TARGET.stop + len(SOURCE_PARAMETERS) * index + BIAS_M

    @property
    def sources(self) -> slice:
        """Slots of all sources, one after the other."""
        return slice(TARGET.stop, TARGET.stop + len(SOURCE_PARAMETERS) * self.n_sources)

    def clock(self, index: Index) -> Index:
        """Slot of a recording's clock offset, or of each of several."""
        first: int = self.clocks.start
        return first + index

    @property
    def clocks(self) -> slice:
        """Slots of all clock offsets."""
        return slice(self.sources.stop, self.sources.stop + self.n_clocks)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return int(self.clocks.stop)

    @property
    def middle(self) -> int:
        """Slot of the offset of a box's middle ahead of the log, internal to the fit."""
        return self.size


def camera_vector(by_slot: Mapping[int, float]) -> FloatArray:
    """(12,) float64 camera parameters by their slots; 0 where none is given."""
    out = np.zeros(len(PARAMETERS))
    for slot, value in by_slot.items():
        out[slot] = value
    return out
