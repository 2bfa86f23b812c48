"""Lines, texts and colours of what is drawn into pictures."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.text import figure_text
from sightline.types import FloatArray

Image = NDArray[np.uint8]
Colour = tuple[int, int, int]
"""Blue, green, red."""

WHITE: Colour = (255, 255, 255)
BLACK: Colour = (0, 0, 0)
GREY: Colour = (190, 190, 190)

# Of Okabe and Ito's palette those that stand out from water: orange, sky blue, yellow, vermilion,
# reddish purple, bluish green. Colour-blind people can tell them apart.
_PALETTE: tuple[Colour, ...] = (
    (0, 159, 230),
    (233, 180, 86),
    (66, 228, 240),
    (0, 94, 213),
    (167, 121, 204),
    (115, 158, 0),
)

LONGEST_NAME = 28
"""Characters of a name that are shown."""

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_SHIFT = 4
_PLATE = 0.33
# Letters that do not fall into a letter and an accent.
_LETTERS = str.maketrans(
    {"ß": "ss", "ø": "o", "Ø": "O", "æ": "ae", "Æ": "AE", "œ": "oe", "ł": "l", "Ł": "L", "đ": "d"}
)


def colour_of(number: int) -> Colour:
    """The colour of a track, by its number."""
    return _PALETTE[number % len(_PALETTE)]


def drawable(text: str) -> str:
    """A text in the letters that can be drawn: accents are dropped, others become ``?``."""
    shown = unicodedata.normalize("NFKD", figure_text(text, LONGEST_NAME).translate(_LETTERS))
    letters = (c for c in shown if not unicodedata.combining(c))
    return "".join(c if " " <= c <= "~" else "?" for c in letters)


def scale_of(height_px: int) -> float:
    """How large texts and marks are in a picture, 1 where it has 720 rows."""
    return max(height_px / 720.0, 0.6)


def pieces(points_px: FloatArray, size_px: tuple[int, int]) -> Iterator[FloatArray]:
    """Pieces of a line that can be drawn: without points that are none, or far outside.

    Args:
        points_px: (N, 2), NaN where there is no point.
        size_px: Width and height of the picture.

    Yields:
        (M, 2) points, at least two.
    """
    far = 4.0 * max(size_px)
    # What is no number is not less than anything.
    seen = (np.abs(points_px) < far).all(axis=1)
    edges = np.flatnonzero(np.diff(seen, prepend=False, append=False))
    for start, stop in edges.reshape(-1, 2):
        if stop - start > 1:
            yield points_px[start:stop]


def line(
    image: Image,
    points_px: FloatArray,
    colour: Colour,
    *,
    thickness: int = 1,
    halo: bool = True,
    dashed: bool = False,
) -> None:
    """Draw a line through points, where they are to a sixteenth of a pixel.

    Args:
        image: Is drawn into.
        points_px: (N, 2); the first pixel reaches from 0 to 1. NaN breaks the line.
        colour: Of the line.
        thickness: Of the line, px.
        halo: Whether it has a dark edge, so that it shows on what is bright.
        dashed: Whether only every other piece is drawn.
    """
    height, width = image.shape[:2]
    drawn = []
    for piece in pieces(points_px, (width, height)):
        # OpenCV's pixel 0 has its middle at 0.
        fixed = np.rint((piece - 0.5) * (1 << _SHIFT)).astype(np.int32)
        drawn += [fixed[i : i + 3] for i in range(0, len(fixed) - 1, 4)] if dashed else [fixed]
    if not drawn:
        return
    if halo:
        cv2.polylines(image, drawn, False, BLACK, thickness + 2, cv2.LINE_AA, _SHIFT)
    cv2.polylines(image, drawn, False, colour, thickness, cv2.LINE_AA, _SHIFT)


def box_outline(xyxy_px: FloatArray) -> FloatArray:
    """(5, 2) corners of a box, closed."""
    x1, y1, x2, y2 = xyxy_px
    return np.array([[x1, y1], [x2, y1], [x2, y2], [x1, y2], [x1, y1]])


def dot(image: Image, point_px: FloatArray, colour: Colour, radius_px: float) -> None:
    """Draw a filled circle with a dark edge; nothing where the point is none, or far outside."""
    height, width = image.shape[:2]
    if not (np.isfinite(point_px).all() and (np.abs(point_px) < 4 * max(width, height)).all()):
        return
    x, y = (round(float(value - 0.5) * (1 << _SHIFT)) for value in point_px)
    for radius, paint in ((radius_px + 1.2, BLACK), (radius_px, colour)):
        fixed = round(radius * (1 << _SHIFT))
        cv2.circle(image, (x, y), fixed, paint, cv2.FILLED, cv2.LINE_AA, _SHIFT)


def text_size_px(text: str, scale: float) -> tuple[int, int]:
    """Width and height of a text as `write` draws it."""
    (width, height), below = cv2.getTextSize(text, _FONT, 0.45 * scale, 1)
    return width, height + below


def plate(image: Image, left: float, top: float, right: float, bottom: float) -> None:
    """Darken a rectangle of a picture, for a text to be read on it."""
    rows, columns = slice(max(int(top), 0), int(bottom)), slice(max(int(left), 0), int(right))
    where = image[rows, columns]
    if where.size:
        np.multiply(where, _PLATE, out=where, casting="unsafe")


def write(
    image: Image, text: str, left_px: float, bottom_px: float, colour: Colour, scale: float
) -> None:
    """Draw a text; ``bottom_px`` is the line that the letters stand on."""
    left, bottom = round(left_px), round(bottom_px)
    stroke, size = max(round(scale), 1), 0.45 * scale
    cv2.putText(image, text, (left, bottom), _FONT, size, colour, stroke, cv2.LINE_AA)


def nice_length(length: float) -> float:
    """The largest of 1, 2, 5, 10, 20 and so on that is at most a length; that must be positive."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(step * power for step in (1.0, 2.0, 5.0) if step * power <= length * 1.000001))


def length_text(length_m: float) -> str:
    """A length in metres or kilometres."""
    return f"{length_m / 1000.0:g} km" if length_m >= 1000.0 else f"{length_m:g} m"
