"""Contact sheets: proposed boxes on their pictures, many to a page, for a person to check."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.atomic import atomic_path
from sightline.errors import InputError
from sightline.labelling.proposals import Proposals
from sightline.scene import Recording
from sightline.types import FloatArray

_CELL = (320, 200)
_COLUMNS, _ROWS = 4, 5
_CAPTION = 18
_SHARE = 0.45
"""Of a cell's width that a box takes, unless that would need more than the largest scale."""
_LARGEST_SCALE = 6
_SURE, _DOUBTFUL, _EXPECTED = (80, 220, 80), (40, 140, 255), (200, 200, 200)

Image = NDArray[np.uint8]


def contact_sheets(proposals: Proposals, recording: Recording, folder: Path) -> list[Path]:
    """Write a recording's proposals as pages of pictures.

    A page has twenty frames, cut out around the box and enlarged: the proposed box (green, orange
    where it is doubtful) and the place where the log says the target is (grey), with the frame's
    number, and the confidence or the reason why there is no box. Frames in gaps of the log and
    places outside the picture are left out: there is nothing to see.

    Args:
        proposals: Of the recording.
        recording: Has the pictures.
        folder: Where the pages go: ``RECORDING-1.png`` and so on.

    Returns:
        The pages.

    Raises:
        InputError: A page cannot be written, or the pictures cannot be read.
    """
    row_of = {int(frame): i for i, frame in enumerate(proposals.frame)}
    cells: list[Image] = []
    for frame in recording.frames():
        i = row_of.get(frame.index)
        if i is None:
            continue
        box, expected = proposals.xyxy_px[i], proposals.expected.xyxy_px[i]
        drawn = box if np.isfinite(box).all() else expected
        height, width = frame.image_bgr.shape[:2]
        if not np.isfinite(drawn).all() or not (
            drawn[2] > 0.0 and drawn[0] < width and drawn[3] > 0.0 and drawn[1] < height
        ):
            continue
        said = proposals.reason[i] or f"{proposals.confidence[i]:.2f}"
        caption = f"{proposals.recording}/{frame.index}  {said}"
        cells.append(
            _cell(frame.image_bgr, drawn, box, expected, float(proposals.confidence[i]), caption)
        )
    per_page = _COLUMNS * _ROWS
    pages = []
    for number, first in enumerate(range(0, len(cells), per_page), start=1):
        path = folder / f"{proposals.recording}-{number}.png"
        _write(_page(cells[first : first + per_page]), path)
        pages.append(path)
    return pages


@dataclass(frozen=True, eq=False)
class SheetBox:
    """A box on its picture, for a contact sheet.

    Attributes:
        image_bgr: (H, W, 3) the picture.
        xyxy_px: (4,) the box.
        caption: What stands above it.
        sure: Whether its frame is green; else it is orange.
    """

    image_bgr: Image
    xyxy_px: FloatArray
    caption: str
    sure: bool = True


def write_sheet(boxes: Sequence[SheetBox], path: Path) -> None:
    """Write boxes as one page of pictures, cut out and enlarged; at most twenty.

    Raises:
        InputError: It cannot be written, or there is no box.
    """
    if not boxes:
        raise InputError(f"{path}: there is no box to show")
    nowhere = np.full(4, np.nan)
    cells = [
        _cell(one.image_bgr, one.xyxy_px, one.xyxy_px, nowhere, float(one.sure), one.caption)
        for one in boxes[: _COLUMNS * _ROWS]
    ]
    _write(_page(cells), path)


def _cell(
    image: Image,
    drawn: FloatArray,
    box: FloatArray,
    expected: FloatArray,
    confidence: float,
    caption: str,
) -> Image:
    cell_width, cell_height = _CELL
    inner = cell_height - _CAPTION
    scale = min(_SHARE * cell_width / (drawn[2] - drawn[0]), 0.6 * inner / (drawn[3] - drawn[1]))
    scale = float(np.clip(scale, 0.25, _LARGEST_SCALE))
    # Beyond the border of the picture there is black.
    middle = 0.5 * (drawn[:2] + drawn[2:])
    move = np.array([0.5 * cell_width, _CAPTION + 0.5 * inner]) - scale * middle
    turn = np.array([[scale, 0.0, move[0]], [0.0, scale, move[1]]])
    cell = np.asarray(
        cv2.warpAffine(image, turn, (cell_width, cell_height), flags=cv2.INTER_LINEAR), np.uint8
    ).copy()
    colour = _SURE if confidence >= 0.5 else _DOUBTFUL
    for corners, paint in ((expected, _EXPECTED), (box, colour)):
        if np.isfinite(corners).all():
            at = np.round(np.concatenate([corners[:2], corners[2:]]) * scale + np.tile(move, 2))
            left, top, right, bottom = (int(v) for v in np.clip(at, -9999.0, 9999.0))
            cv2.rectangle(cell, (left, top), (right, bottom), paint, 1)
    cell[:_CAPTION] = 32
    cv2.putText(
        cell, caption, (4, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (240, 240, 240), 1, cv2.LINE_AA
    )
    cell[-1], cell[:, -1] = 0, 0
    return cell


def _page(cells: Sequence[Image]) -> Image:
    width, height = _CELL
    rows = -(-len(cells) // _COLUMNS)
    page = np.zeros((rows * height, _COLUMNS * width, 3), np.uint8)
    for i, cell in enumerate(cells):
        top, left = i // _COLUMNS * height, i % _COLUMNS * width
        page[top : top + height, left : left + width] = cell
    return page


def _write(page: Image, path: Path) -> None:
    good, content = cv2.imencode(".png", page)
    if not good:
        raise InputError(f"{path}: the page cannot be encoded as a PNG file")
    with atomic_path(path) as temporary:
        temporary.write_bytes(content.tobytes())
