"""Detections and tracks of OTVision (``.otdet``, ``.ottrk``): bzip2-compressed JSON."""

from __future__ import annotations

import bz2
import json
import logging
import os
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

import numpy as np

from sightline.errors import InputError
from sightline.formats import _files
from sightline.tally import Tally
from sightline.types import Boxes

_logger = logging.getLogger(__name__)

_MOST_BYTES = 2**30
_CENTRED_UP_TO = (1, 0)
_DATE = "%Y-%m-%d %H:%M:%S.%f"


def iter_otvision(
    path: str | os.PathLike[str],
    chunk_rows: int,
    *,
    source: str = "",
    skip_empty: bool = False,
    image_size_px: tuple[int, int] | None = None,
    tally: Tally | None = None,
) -> Iterator[Boxes]:
    """Boxes of OTVision's detections or tracks in chunks.

    As OTAnalytics reads them (OpenTrafficCam/OTAnalytics, ``plugin_parser/otvision_parser.py``):
    ``x, y, w, h`` in pixels, where up to version 1.0 of ``otdet`` x and y are the box's centre, and
    its upper left corner since; a version that is no number is an old one. Frames count from 1
    there and from 0 here. Times are of ``occurrence``, UTC, or of the recording's start and its
    frame rate. The model's name becomes the boxes' source.

    Args:
        path: The file.
        chunk_rows: Most boxes in a chunk.
        source: The source of all boxes, where the file names no model.
        skip_empty: Leave out boxes without width or height, and count them, rather than refuse the
            file.
        image_size_px: Not needed; boxes are in pixels.
        tally: Counts boxes, and what is left out.

    Raises:
        InputError: The file is neither, is damaged, or a box cannot be understood.
    """
    del image_size_px
    own = Tally(path) if tally is None else tally
    own.format = "OTVision"
    content = _content(path)
    try:
        metadata, found = content["metadata"], content["data"]
        video = metadata["video"]
        centred = _version(metadata.get("otdet_version")) <= _CENTRED_UP_TO
        start_s = _seconds(video["recorded_start_date"])
        fps = float(video["recorded_fps"])
        model = metadata.get("detection", {}).get("model", {}).get("name")
        rows = list(_rows(found))
        if not fps > 0.0 or not np.isfinite(fps):
            raise ValueError("a frame rate that is none")
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(
            f"{path}: is no file of OTVision; expected metadata with video, and data with "
            f"detections ({_files.shortened(str(error))})"
        ) from error
    name = model if isinstance(model, str) and model else source
    own.count("boxes", len(rows))
    for begin in range(0, len(rows), chunk_rows):
        yield _boxes(path, rows[begin : begin + chunk_rows], centred, start_s, fps, name, own)
    if own.left_out and not skip_empty:
        raise InputError(f"{path}: boxes that are none: {own.reasons()}")
    if tally is None:
        own.warn(_logger)


def _content(path: str | os.PathLike[str]) -> dict[str, Any]:
    with _files.existing(path).open("rb") as file:
        head = file.read(3)
        file.seek(0)
        try:
            if head == b"BZh":
                # What a few bytes may unpack to has no bound of its own.
                data = bz2.BZ2File(file).read(_MOST_BYTES + 1)
            else:
                data = file.read(_MOST_BYTES + 1)
            if len(data) > _MOST_BYTES:
                raise InputError(
                    f"{path}: holds more than {_MOST_BYTES >> 20} MiB; cut it in parts"
                )
            content = json.loads(data)
        except (OSError, EOFError, ValueError, RecursionError) as error:
            raise InputError(
                f"{path}: is damaged or cut short; expected JSON of OTVision, packed by bzip2"
            ) from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: is no file of OTVision")
    return content


def _version(text: object) -> tuple[int, int]:
    try:
        major, minor = (int(part) for part in str(text).split(".")[:2])
    except ValueError:
        return _CENTRED_UP_TO
    return major, minor


def _seconds(value: object) -> float:
    try:
        seconds = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        seconds = datetime.strptime(str(value), _DATE).replace(tzinfo=UTC).timestamp()
    if not np.isfinite(seconds) or abs(seconds) > 1e11:
        raise ValueError("a time that is none")
    return seconds


def _rows(data: Any) -> Iterator[tuple[int, dict[str, Any]]]:
    """Frame, from 1, and box: tracks are one list, detections have one a frame."""
    if "detections" in data:
        for one in data["detections"]:
            yield int(one["frame"]), one
    else:
        for frame, content in data.items():
            for one in content["detections"]:
                yield int(frame), one


def _boxes(
    path: str | os.PathLike[str],
    rows: list[tuple[int, dict[str, Any]]],
    centred: bool,
    start_s: float,
    fps: float,
    source: str,
    tally: Tally,
) -> Boxes:
    try:
        x, y, w, h = np.array(
            [[float(one[key]) for key in ("x", "y", "w", "h")] for _, one in rows]
        ).T
        frame = np.array([number - 1 for number, _ in rows], dtype=np.int64)
        time = np.array(
            [
                _seconds(one["occurrence"]) if "occurrence" in one else start_s + (number - 1) / fps
                for number, one in rows
            ]
        )
        confidence = np.clip([float(one.get("confidence", 1.0)) for _, one in rows], 0.0, 1.0)
        track = np.array([int(one.get("track-id", -1)) for _, one in rows], dtype=np.int64)
        label = [str(one.get("class", "")) for _, one in rows]
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(
            f"{path}: a box is incomplete; expected frame, x, y, w, h as numbers "
            f"({_files.shortened(str(error))})"
        ) from error
    left, top = (x - w / 2.0, y - h / 2.0) if centred else (x, y)
    xyxy = np.column_stack([left, top, left + w, top + h])
    good = np.isfinite(xyxy).all(axis=1) & (w > 0.0) & (h > 0.0) & (frame >= 0)
    good &= np.isfinite(confidence)
    tally.leave_out("without width, height or frame", int((~good).sum()))
    chosen = np.flatnonzero(good)
    return Boxes.of(
        xyxy[chosen],
        frame=frame[chosen],
        time_utc_s=time[chosen],
        confidence=confidence[chosen],
        source=source,
        track_id=track[chosen],
        label=[label[i] for i in chosen.tolist()],
    )
