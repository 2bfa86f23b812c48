"""Boxes that somebody drew to teach or to measure a detector, and frames known to hold none."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from sightline.atomic import atomic_path
from sightline.errors import InputError
from sightline.formats import _files
from sightline.formats.boxes_csv import boxes_of_rows, columns_of, targets
from sightline.types import NO_FRAME, BoolArray, Boxes, FloatArray, IntArray

EMPTY_TABLE = "empty.csv"
"""In a folder of labels: ``recording,frame``, the frames that are known to hold none."""

TABLES_FOLDER = "boxes"
"""In a folder of labels: where its tables may lie, instead of in the folder itself."""

_CORNERS = ["x1", "y1", "x2", "y2"]
_OPTIONAL = ("annotator", "label", "target", "confidence", "time_utc", "track_id")


@dataclass(frozen=True)
class Margin:
    """What is added on every side of a box.

    Attributes:
        px: Pixels.
        share: And this share of the box's height.
    """

    px: float = 0.0
    share: float = 0.0

    def widened(self, xyxy_px: FloatArray) -> FloatArray:
        """(..., 4) boxes with the margin."""
        margin = self.px + self.share * (xyxy_px[..., 3:] - xyxy_px[..., 1:2])
        return np.asarray(xyxy_px + margin * np.array([-1.0, -1.0, 1.0, 1.0]))

    def __str__(self) -> str:
        return f"{self.px:g}+{100.0 * self.share:g}%"


@dataclass(frozen=True, eq=False)
class Labels:
    """What is known of the frames of a recording.

    Attributes:
        boxes: Drawn by hand, with their frames.
        target: (N,) bool, whether a box is of what is looked for, or of another boat.
        empty_frames: (K,) int64, in order; frames known to hold nothing that is looked for.
    """

    boxes: Boxes
    target: BoolArray
    empty_frames: IntArray

    @classmethod
    def of_target(cls, boxes: Boxes) -> Labels:
        """Boxes all of which are of what is looked for."""
        return cls(boxes, np.ones(len(boxes), dtype=bool), np.empty(0, dtype=np.int64))

    @property
    def frames(self) -> IntArray:
        """(M,) int64, in order: all frames of which something is known."""
        return np.unique(np.concatenate([self.boxes.frame, self.empty_frames]))

    def without_others(self) -> Labels:
        """As if other boats had not been drawn: to find one is then an error."""
        boxes = self.boxes[self.target]
        return Labels(
            boxes, np.ones(len(boxes), dtype=bool), np.setdiff1d(self.frames, boxes.frame)
        )

    def without_specks(self, least_height_px: float) -> Labels:
        """Boxes that are lower are taken for other boats: neither right nor wrong to find."""
        heights = self.boxes.xyxy_px[:, 3] - self.boxes.xyxy_px[:, 1]
        return replace(self, target=self.target & (heights >= least_height_px))

    def widened(self, margins: Mapping[str, Margin]) -> Labels:
        """With the margin of each annotator added to the boxes, other boats' too."""
        xyxy_px = self.boxes.xyxy_px.copy()
        for name, margin in margins.items():
            rows = self.boxes.source == name
            xyxy_px[rows] = margin.widened(xyxy_px[rows])
        return replace(self, boxes=replace(self.boxes, xyxy_px=xyxy_px))


def read_labels(path: str | os.PathLike[str], *, may_be_empty: bool = False) -> Labels:
    """A table of labels: ``frame,x1,y1,x2,y2`` and optionally ``annotator,label,target``.

    A row without corners says that its frame holds no box. ``target`` is 1 for what is looked for
    (everywhere, where the column is absent) and 0 for other boats.

    Args:
        path: A CSV file.
        may_be_empty: Whether it may have a header alone.

    Raises:
        InputError: A row cannot be understood, or there is none and must be.
    """
    (rows,) = _files.table(
        path, required=("frame", *_CORNERS), optional=_OPTIONAL, text=("label", "annotator")
    )
    if not len(rows) and not may_be_empty:
        raise InputError(f"{path}: holds no box, and no frame without one")
    empty = rows[_CORNERS].isna().all(axis=1)
    drawn = rows[~empty]
    frames = _files.whole_numbers(path, rows["frame"][empty])
    target = targets(path, drawn) if "target" in drawn else np.ones(len(drawn), dtype=bool)
    boxes = boxes_of_rows(path, drawn.drop(columns="target", errors="ignore"))
    return Labels(boxes, target, np.unique(frames))


def write_labels(labels: Labels, path: str | os.PathLike[str]) -> None:
    """Write a table that `read_labels` reads: boxes with their ``target``, and the empty frames.

    Raises:
        InputError: The file cannot be written, or a box has no frame.
    """
    boxes = labels.boxes
    if (boxes.frame == NO_FRAME).any():
        raise InputError(f"{path}: every box needs a frame to be written as a label")
    rows = pd.DataFrame({**columns_of(boxes, path), "target": labels.target.astype(int)})
    empty = pd.DataFrame({"frame": labels.empty_frames})
    if len(empty):
        rows = pd.concat([rows, empty]).sort_values("frame", kind="stable")
        rows["target"] = rows["target"].astype("Int64")
    with atomic_path(path) as temporary:
        rows.to_csv(temporary, index=False)


def read_label_folder(folder: str | os.PathLike[str], recording: str) -> Labels | None:
    """The labels of a recording in a folder: ``RECORDING.csv``, and its rows of ``empty.csv``.

    The tables may also lie in a folder ``boxes`` within it.

    Returns:
        None where the folder says nothing of the recording.

    Raises:
        InputError: There is no such folder, or a file cannot be used.
    """
    if not Path(folder).is_dir():
        raise InputError(f"{folder}: there is no such folder of labels")
    tables = tables_folder(folder)
    table = tables / f"{recording}.csv"
    several = [tables / EMPTY_TABLE, tables.resolve().parent / EMPTY_TABLE]
    empty = np.empty(0, dtype=np.int64)
    for path in several:
        if path.is_file():
            empty = empty_frames(path, recording)
            break
    if not table.is_file():
        if not empty.size:
            return None
        nothing = Boxes.of(np.empty((0, 4)))
        return Labels(nothing, np.empty(0, dtype=bool), empty)
    labels = read_labels(table, may_be_empty=bool(empty.size))
    return Labels(labels.boxes, labels.target, np.union1d(labels.empty_frames, empty))


def tables_folder(folder: str | os.PathLike[str]) -> Path:
    """Where a folder of labels has its tables: in one of their own, or beside the empty frames."""
    inner = Path(folder) / TABLES_FOLDER
    return inner if inner.is_dir() else Path(folder)


def empty_frames(path: str | os.PathLike[str], recording: str) -> IntArray:
    """(K,) int64, in order: the frames of a recording in a table as `EMPTY_TABLE`.

    Raises:
        InputError: The table cannot be used.
    """
    (rows,) = _files.table(path, required=("recording", "frame"), text=("recording",))
    own = rows[rows["recording"].str.strip() == recording]
    return np.unique(_files.whole_numbers(path, own["frame"]))


def parse_margins(texts: Sequence[str]) -> dict[str, Margin]:
    """Margins from ``SOURCE=PX`` or ``SOURCE=PX+SHARE%``.

    Raises:
        InputError: A text is of another form.
    """
    margins = {}
    for text in texts:
        name, _, value = text.partition("=")
        pixels, plus, share = value.partition("+")
        try:
            percent = float(share.removesuffix("%")) if plus else 0.0
            margin = Margin(float(pixels), percent / 100.0)
            if not (math.isfinite(margin.px) and math.isfinite(margin.share)):
                raise ValueError("no finite number")
            margins[name] = margin
        except ValueError as error:
            raise InputError(
                f"--margin {text!r}: expected SOURCE=PX or SOURCE=PX+PERCENT%, for example voc=-3 "
                "or eye=1+20%"
            ) from error
    return margins
