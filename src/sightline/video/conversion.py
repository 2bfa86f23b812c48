"""Decoded pictures as they are shown: upright, with square pixels, in 8-bit BGR."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction

import av
import numpy as np
from numpy.typing import NDArray

from sightline.errors import BrokenOffError
from sightline.tally import Tally
from sightline.video.pictures import GreyScale

# Ratios closer to one than this are roundings.
_SQUARE = 0.01
# From so many bits on grey is of a thermal camera, which uses a part of them.
_DEEP_BITS = 12
_UNIT = 1 << 16


class Conversion:
    """Makes pictures of decoded frames, all of one size.

    Attributes:
        size_px: Width and height of the first picture, as shown; None before there was one.
    """

    def __init__(self, stream: av.VideoStream, name: str, tally: Tally) -> None:
        self.size_px: tuple[int, int] | None = None
        self._name, self._tally, self._grey = name, tally, GreyScale()
        aspect = stream.sample_aspect_ratio or Fraction(1)
        self._aspect = aspect if aspect > 0 and abs(float(aspect) - 1.0) > _SQUARE else Fraction(1)

    def check_size(self, picture: av.VideoFrame, index: int) -> None:
        """Refuse a picture of another size than the first.

        Raises:
            BrokenOffError: It has another size.
        """
        width, height = self.shown_px(picture)
        if self.size_px is None:
            self.size_px = width, height
            if self._aspect != 1:
                self._tally.note(
                    f"its pixels are not square ({self._aspect.numerator}:"
                    f"{self._aspect.denominator}): pictures of {picture.width} x "
                    f"{picture.height} px are shown, and read, with {width} x {height} px"
                )
        elif self.size_px != (width, height):
            raise BrokenOffError(
                f"{self._name}: from frame {index} on its pictures have {width} x {height} px, "
                f"those before {self.size_px[0]} x {self.size_px[1]} px; two cameras, or two "
                "settings of one, are two recordings: cut it there"
            )

    def shown_px(self, picture: av.VideoFrame) -> tuple[int, int]:
        """Width and height of a frame as it is shown."""
        width, height = self._stored_px(picture)
        return (height, width) if _turn(picture)[0] else (width, height)

    def to_bgr(self, picture: av.VideoFrame) -> NDArray[np.uint8]:
        """(H, W, 3) of a frame."""
        width, height = self._stored_px(picture)
        parts = picture.format.components
        if len(parts) == 1 and parts[0].bits >= _DEEP_BITS and not picture.format.is_bayer:
            deep = picture.to_ndarray(format="gray16le", width=width, height=height)
            first = self._grey.range is None
            image = np.repeat(self._grey.to_8_bits(deep)[..., None], 3, axis=2)
            if first:
                self._grey.note_in(self._tally)
        else:
            image = np.asarray(
                picture.to_ndarray(format="bgr24", width=width, height=height), dtype=np.uint8
            )
        transposed, mirrored_x, mirrored_y = _turn(picture)
        if transposed:
            image = image.transpose(1, 0, 2)
        return np.ascontiguousarray(image[:: -1 if mirrored_y else 1, :: -1 if mirrored_x else 1])

    def _stored_px(self, picture: av.VideoFrame) -> tuple[int, int]:
        return max(round(picture.width * self._aspect), 1), picture.height


def _turn(picture: av.VideoFrame) -> tuple[bool, bool, bool]:
    """Whether a picture is shown with its axes exchanged, then mirrored in x, and in y.

    Telephones store it lying and say how to turn it; some cameras that hang say that it is
    mirrored. The matrix takes a stored point to where it is shown, both with y down; other angles
    than quarters of a turn are taken for the next of these.
    """
    try:
        matrix = np.frombuffer(_display_matrix(picture), dtype="=i4")
    except ValueError:
        # It carries data of a kind that is newer than the library.
        quarters = round(picture.rotation / 90) % 4
        return bool(quarters % 2), quarters in (2, 3), quarters in (1, 2)
    if matrix.size < 9:
        return False, False, False
    across, down = matrix[[0, 3]] / _UNIT, matrix[[1, 4]] / _UNIT
    if abs(across[1]) > abs(across[0]):
        return True, bool(across[1] < 0), bool(down[0] < 0)
    return False, bool(across[0] < 0), bool(down[1] < 0)


def _display_matrix(picture: av.VideoFrame) -> bytes:
    side_data: Mapping[str, object] = picture.side_data
    return bytes(side_data["DISPLAYMATRIX"]) if "DISPLAYMATRIX" in side_data else b""  # type: ignore[call-overload]
