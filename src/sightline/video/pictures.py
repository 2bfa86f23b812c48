"""Pictures from files and folders: decoders that are meant, a largest size, one grey scale."""

from __future__ import annotations

import math
import os
import re
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps

from sightline.errors import BrokenOffError, InputError
from sightline.tally import Tally
from sightline.video.kinds import UNREAD_SUFFIXES, why_no_picture, why_no_pictures

PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp")
"""Endings of the pictures that a folder's frames are looked for among."""

MOST_PIXELS = 100_000_000
"""The largest picture that is decoded."""

# Pillow knows formats that start other programs (EPS: Ghostscript) or are read by little used code.
_FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "BMP")
# Grey pictures of more than 8 bits, which Pillow would cut off at 255.
_DEEP_MODES = ("I", "F", "I;16", "I;16L", "I;16B", "I;16N")
_MOST_DIGITS = 18
_FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
# Zero means that the camera did not know; from a fisheye's to a telescope's.
_SHORTEST_MM, _LONGEST_MM = 4.0, 20_000.0


class GreyScale:
    """Maps deep grey values to 8 bits by the range of the first picture, the same for all.

    Thermal cameras use a small part of their 16 bits, another part on each day; a scale of each
    picture's own would make the scene flicker.

    Attributes:
        range: Lowest and highest value of the first picture; None before there is one.
    """

    def __init__(self) -> None:
        self.range: tuple[float, float] | None = None

    def to_8_bits(self, values: NDArray[np.generic]) -> NDArray[np.uint8]:
        """(H, W) uint8 of (H, W) grey values of any type."""
        finite = np.nan_to_num(values.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)
        if self.range is None:
            self.range = float(finite.min()), float(finite.max())
        lowest, highest = self.range
        scaled = (finite - lowest) * (255.0 / max(highest - lowest, 1e-9))
        shown: NDArray[np.uint8] = np.rint(np.clip(scaled, 0.0, 255.0)).astype(np.uint8)
        return shown

    def note_in(self, tally: Tally) -> None:
        """Say by which range grey values were scaled, where they were."""
        if self.range is not None:
            tally.note(
                f"grey values of more than 8 bits are scaled from {self.range[0]:g} to "
                f"{self.range[1]:g}, the range of the first picture"
            )


def read_picture(
    path: str | os.PathLike[str],
    *,
    grey: GreyScale | None = None,
    transparent: int | None = None,
) -> NDArray[np.uint8]:
    """Read a picture as it is shown: upright and not mirrored, in 8 bits.

    JPEG, PNG, TIFF, WebP and BMP are read, by what is in the file and not by its name.

    Args:
        path: The file.
        grey: How grey values of more than 8 bits are scaled; where it is not given, by the range
            of this picture.
        transparent: Grey value that is behind transparent pixels. Absent: what the file has there.

    Returns:
        (H, W, 3) BGR.

    Raises:
        InputError: The file is of none of these kinds, is damaged or cut short (OpenCV would show
            what there is), or has more than 100 megapixels, which is seen before it is decoded.
    """
    try:
        with warnings.catch_warnings():
            # It warns of sizes that are read here, beside the error for those that are not.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            stored = Image.open(path, formats=_FORMATS)
    except Image.DecompressionBombError as error:
        raise _too_large(path, str(error)) from error
    except Exception as error:
        raise _no_picture(path) from error
    with stored:
        if stored.width * stored.height > MOST_PIXELS:
            raise _too_large(path, f"{stored.width} x {stored.height} px")
        try:
            opaque = stored if transparent is None else _opaque(stored, transparent)
            return _shown(opaque, grey or GreyScale())
        # What decoders raise on damaged files is no closed set.
        except Exception as error:
            raise _no_picture(path) from error


def focal_length_px(path: str | os.PathLike[str], *, tally: Tally | None = None) -> float | None:
    """The focal length that a picture's EXIF data states, pixels; None where it states none.

    The data has it as that of a lens with the same field of view over 35-mm film, whose diagonal is
    taken for that of the picture.

    Args:
        path: The picture.
        tally: Told of it.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path, formats=_FORMATS) as stored:
                stated = stored.getexif().get_ifd(ExifTags.IFD.Exif)
                on_film_mm = float(stated.get(ExifTags.Base.FocalLengthIn35mmFilm, 0.0))
                diagonal_px = math.hypot(*stored.size)
    # What is damaged raises anything, and is refused where it is read for its pixels.
    except Exception:
        return None
    if not _SHORTEST_MM <= on_film_mm <= _LONGEST_MM:
        return None
    focal_px = on_film_mm / _FILM_DIAGONAL_MM * diagonal_px
    if tally is not None:
        tally.note(
            f"its EXIF data states a focal length of {on_film_mm:g} mm on 35-mm film, "
            f"{focal_px:.0f} px"
        )
    return focal_px


def _opaque(stored: Image.Image, behind: int) -> Image.Image:
    """The picture before a grey wall, turned as it is shown."""
    if "A" not in stored.getbands() and "transparency" not in stored.info:
        return stored
    coloured = ImageOps.exif_transpose(stored.convert("RGBA"))
    wall = Image.new("RGBA", coloured.size, (behind, behind, behind, 255))
    return Image.alpha_composite(wall, coloured)


def _shown(stored: Image.Image, grey: GreyScale) -> NDArray[np.uint8]:
    if stored.mode in _DEEP_MODES:
        upright = np.asarray(ImageOps.exif_transpose(stored))
        return np.repeat(grey.to_8_bits(upright)[..., None], 3, axis=2)
    coloured = ImageOps.exif_transpose(stored.convert("RGB"))
    return np.ascontiguousarray(np.asarray(coloured)[..., ::-1])


def _no_picture(path: str | os.PathLike[str]) -> InputError:
    why = why_no_picture(path)
    if why is None:
        why = f"is no picture that can be read, or is damaged; known are {', '.join(_FORMATS)}"
    return InputError(f"{path}: {why}")


def _too_large(path: str | os.PathLike[str], size: str) -> InputError:
    return InputError(
        f"{path}: is too large ({size}); pictures of at most {MOST_PIXELS // 1_000_000} megapixels "
        "are read"
    )


def numbered_pictures(folder: Path) -> dict[int, Path]:
    """The pictures of a folder by the number in which their names end, in order.

    Raises:
        InputError: There is none, a name has no number, or two have the same.
    """
    numbered: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        # Hidden files are what systems keep of pictures: ._000100.jpg.
        if path.suffix.lower() not in PICTURE_SUFFIXES or path.name.startswith("."):
            continue
        number = re.search(r"([0-9]+)$", path.stem)
        if number is None:
            raise InputError(
                f"{path}: the name does not end in the number of the frame, as in 000100.jpg"
            )
        if len(number[1]) > _MOST_DIGITS:
            raise InputError(f"{path}: its number is too large for that of a frame")
        other = numbered.setdefault(int(number[1]), path)
        if other != path:
            raise InputError(f"{folder}: {other.name} and {path.name} are both frame {number[1]}")
    if not numbered:
        why = why_no_pictures(folder) or "holds no picture; expected FRAME.jpg or FRAME.png"
        raise InputError(f"{folder}: {why}")
    return dict(sorted(numbered.items()))


class FolderReader:
    """Reads the pictures of a folder, which are all of one camera.

    Attributes:
        pictures: Files by the number of the frame, in order.
    """

    def __init__(self, folder: Path, tally: Tally) -> None:
        self.pictures = numbered_pictures(folder)
        self._folder, self._tally, self._grey = folder, tally, GreyScale()
        self._first: tuple[Path, tuple[int, int]] | None = None
        tally.format = "folder of pictures"
        unread = [p.name for p in sorted(folder.iterdir()) if p.suffix.lower() in UNREAD_SUFFIXES]
        tally.leave_out(
            "pictures of a kind that is not read", len(unread), row=" ".join(unread[:1])
        )

    def __iter__(self) -> Iterator[int]:
        return iter(self.pictures)

    def read(self, index: int) -> NDArray[np.uint8]:
        """A frame's picture.

        Raises:
            InputError: It cannot be read.
            BrokenOffError: It has another size than the first.
        """
        path = self.pictures[index]
        image = read_picture(path, grey=self._grey)
        size = image.shape[1], image.shape[0]
        if self._first is None:
            self._first = path, size
            self._grey.note_in(self._tally)
        if size != self._first[1]:
            raise BrokenOffError(
                f"{self._folder}: {path.name} has {size[0]} x {size[1]} px, "
                f"{self._first[0].name} {self._first[1][0]} x {self._first[1][1]} px; the frames "
                "of a folder are of one camera: put these into two"
            )
        self._tally.count("frames")
        return image
