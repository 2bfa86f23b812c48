"""Tables of boxes of any origin: what their values mean, and their boxes in chunks.

A table is read twice. What a column means shows in all of its values, not in the first of them:
whether confidences are percents, whether frames count from one, whether a seventh column says which
rows count.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import cast

import numpy as np
import pandas as pd

from sightline.errors import InputError
from sightline.formats import _files
from sightline.formats._box_columns import TableForm, form_of
from sightline.tally import Tally
from sightline.text import text_of_cell
from sightline.types import NO_TRACK, BoolArray, Boxes, FloatArray, IntArray

_logger = logging.getLogger(__name__)

_SURVEY_ROWS = 20_000
_FEWEST_TO_JUDGE = 10
_LEAST_PERCENT = 5.0
_SHARES_REACH = 1.5
_LEAST_SIDE_PX = 300
_SLACK_PX = 2.0
_EIGHTH = 7
_ROUNDING = 1e-3
_TEXT_ROLES = ("label", "annotator")

IGNORED = "marked as not to be counted"
OTHER_TARGET = "of another target (target is 0)"
NO_BOX = "without a box (no coordinates)"
NOT_A_NUMBER = "with a coordinate that is no number"
NO_SIZE = "without width or height"
REVERSED = "with a negative width or height"

_CHOSEN = (OTHER_TARGET,)
"""Reasons that are the user's own wish."""


@dataclass
class _Span:
    """Least and greatest of a column's values, and what kind of values they are."""

    least: float = np.inf
    greatest: float = -np.inf
    whole: bool = True
    count: int = 0
    large: int = 0
    missing: int = 0

    def add(self, values: FloatArray) -> None:
        known = values[np.isfinite(values)]
        self.missing += len(values) - len(known)
        if not known.size:
            return
        self.least = min(self.least, float(known.min()))
        self.greatest = max(self.greatest, float(known.max()))
        self.whole &= bool((known % 1.0 == 0.0).all())
        self.count += known.size
        self.large += int((known >= _LEAST_PERCENT).sum())

    def flags(self) -> bool:
        """Whether all values are 0 or 1."""
        return self.count > 0 and self.whole and self.least >= 0.0 and self.greatest <= 1.0


@dataclass
class _Survey:
    """What all rows of a table have in common."""

    rows: int = 0
    frame: _Span = field(default_factory=_Span)
    extent: _Span = field(default_factory=_Span)
    confidence: _Span = field(default_factory=_Span)
    class_id: _Span = field(default_factory=_Span)
    visibility: _Span = field(default_factory=_Span)
    track_id: _Span = field(default_factory=_Span)
    begins_outside: int = 0
    boxes: int = 0
    backwards: int = 0
    grows: int = 0
    consecutive: bool = True
    without_track: int = 0
    corner_reach: FloatArray = field(default_factory=lambda: np.full(2, -np.inf))
    centre_reach: FloatArray = field(default_factory=lambda: np.full(2, -np.inf))
    centre_from: FloatArray = field(default_factory=lambda: np.full(2, np.inf))
    crowded: int = 0
    same_second: int = 0
    second: _Span = field(default_factory=_Span)
    eighth: _Span = field(default_factory=_Span)
    _last_id: float = np.nan

    def add(self, form: TableForm, rows: pd.DataFrame) -> None:
        self.rows += len(rows)
        four = np.column_stack([_values(form, rows, role) for role in form.geometry])
        known = np.isfinite(four).all(axis=1)
        self.extent.add(four[known].ravel())
        self.boxes += int(known.sum())
        first, second = four[known, :2], four[known, 2:]
        self.begins_outside += int((first < 0.0).any(axis=1).sum())
        self.grows += int((second > first).all(axis=1).sum())
        if form.extent == "size" and known.any():
            with np.errstate(over="ignore"):
                reach, half = (first + second).max(axis=0), 0.5 * second
                self.corner_reach = np.maximum(self.corner_reach, reach)
                self.centre_reach = np.maximum(self.centre_reach, (first + half).max(axis=0))
                self.centre_from = np.minimum(self.centre_from, (first - half).min(axis=0))
        if not form.names:
            self._add_second(rows)
        size = second - first if form.extent == "corners" else second
        self.backwards += int((size < 0.0).any(axis=1).sum())
        for role in ("frame", "class_id", "visibility"):
            if role in form.places:
                getattr(self, role).add(_values(form, rows, role))
        if "confidence" in form.places:
            given = _values(form, rows, "confidence")
            self.confidence.add(given[given != -1.0])
        if "track_id" in form.places:
            ids = _values(form, rows, "track_id")
            self.track_id.add(ids)
            self.without_track += int((~(ids >= 0.0))[known].sum())
            self.consecutive &= bool((np.diff(ids, prepend=self._last_id) == 1.0)[1:].all())
            self.consecutive &= not np.isfinite(self._last_id) or ids[0] == self._last_id + 1.0
            self._last_id = float(ids[-1])

    def _add_second(self, rows: pd.DataFrame) -> None:
        """Whether the second column of rows without a header is an id or a class."""
        second = _files.floats(rows[1])
        self.second.add(second)
        crowded = rows[0].duplicated(keep=False)
        self.crowded += int(crowded.sum())
        self.same_second += int((rows.duplicated([0, 1], keep=False) & (second >= 0.0)).sum())
        if rows.shape[1] > _EIGHTH:
            self.eighth.add(_files.floats(rows[_EIGHTH]))

    @property
    def in_shares(self) -> bool:
        """Whether coordinates are shares of the picture."""
        span = self.extent
        least = max(abs(span.least), abs(span.greatest))
        return self.boxes > 0 and not span.whole and least <= _SHARES_REACH


@dataclass(frozen=True)
class _Meaning:
    """What a table's columns mean.

    Attributes:
        first_frame: The number of its first frame.
        flagged: Whether the confidence says which rows count, as in ground truth.
        confidence_scale: What a confidence is multiplied with; 0: they say nothing.
        scale_px: What coordinates in x and y are multiplied with.
        corners: Whether width and height are the lower right corner instead.
        numbered: Whether the track ids are the numbers of the rows.
        tolerant: Whether rows without a box are left out, and not refused.
    """

    first_frame: int
    flagged: bool
    confidence_scale: float
    scale_px: tuple[float, float]
    corners: bool
    numbered: bool
    tolerant: bool


def iter_box_table(
    path: str | os.PathLike[str],
    chunk_rows: int,
    *,
    source: str = "",
    skip_empty: bool = False,
    image_size_px: tuple[int, int] | None = None,
    tally: Tally | None = None,
) -> Iterator[Boxes]:
    """Boxes of a table in chunks, at constant memory; see `sightline.formats.read_boxes`.

    Without a tally of the caller's, what is left out is logged when the table has been read.

    Raises:
        InputError: The table cannot be understood, a row holds no box, or no row is left.
    """
    own = Tally(path) if tally is None else tally
    form = form_of(path)
    own.format = "table of boxes" if form.names else "MOTChallenge"
    for name in form.unused:
        own.note(f"the column {_files.shortened(name)} is not used")
    survey = _Survey()
    for rows in _chunks(path, form, _SURVEY_ROWS):
        survey.add(form, rows)
    found = _with_extent(path, form, survey, own, image_size_px)
    if found is not form:
        form, survey = found, _Survey()
        for rows in _chunks(path, form, _SURVEY_ROWS):
            survey.add(form, rows)
    meaning = _meaning(path, form, survey, own, skip_empty, image_size_px)
    left = 0
    for rows in _chunks(path, form, chunk_rows):
        own.count("rows", len(rows))
        boxes = _boxes(path, form, meaning, rows, source, own)
        left += len(boxes)
        yield boxes
    own.count("boxes", left)
    dropped = {reason for reason in own.left_out if reason not in _CHOSEN}
    if survey.rows and not left and dropped:
        raise InputError(f"{path}: none of its {survey.rows} rows is of use: {own.reasons()}")
    if tally is None:
        own.warn(_logger)


def _chunks(
    path: str | os.PathLike[str], form: TableForm, chunk_rows: int
) -> Iterator[pd.DataFrame]:
    """Rows by the number of their columns; the index is the line."""
    texts = {form.places[role] for role in _TEXT_ROLES if role in form.places}
    # Somebody may be called "nan" or "NA".
    missing = {i: [""] if i in texts else list(_files.MISSING) for i in range(form.columns)}
    try:
        reader = pd.read_csv(
            path,
            sep=form.separator,
            decimal=form.decimal,
            encoding=form.encoding,
            compression=None,
            header=None,
            names=range(form.columns),
            index_col=False,
            skiprows=form.skipped_lines,
            skip_blank_lines=False,
            skipinitialspace=True,
            chunksize=chunk_rows,
            dtype=dict.fromkeys(texts, str),
            keep_default_na=False,
            # Its annotations know only columns whose names are texts.
            na_values=cast("dict[str, list[str]]", missing),
            low_memory=False,
        )
        with reader:
            for chunk in reader:
                chunk.index += form.skipped_lines + 1
                # Blank lines keep their number and then go.
                rows = chunk.dropna(how="all")
                if len(rows):
                    yield rows
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text in UTF-8 ({error.reason})") from error
    except pd.errors.EmptyDataError:
        return
    except pd.errors.ParserError as error:
        reason = str(error).strip().removeprefix("Error tokenizing data. C error: ")
        raise InputError(f"{path}: is no table of boxes ({reason})") from error


def _values(form: TableForm, rows: pd.DataFrame, role: str) -> FloatArray:
    """(N,) a column's numbers, NaN where a cell is empty or no number."""
    column = rows[form.places[role]]
    if role == "confidence" and not pd.api.types.is_numeric_dtype(column):
        column = column.astype(str).str.strip().str.removesuffix("%")
    return _files.floats(column)


def _with_extent(
    path: str | os.PathLike[str],
    form: TableForm,
    survey: _Survey,
    tally: Tally,
    image_size_px: tuple[int, int] | None,
) -> TableForm:
    """The form of a table, its x and y taken for the corner or for the centre as the values say.

    Raises:
        InputError: They may be either.
    """
    if form.extent != "size" or not survey.boxes:
        return form
    size = np.array((1.0, 1.0) if survey.in_shares else image_size_px or (np.inf, np.inf))
    slack = _ROUNDING if survey.in_shares else _SLACK_PX
    corner_out = bool((survey.corner_reach > size + slack).any())
    centre_out = bool(
        (survey.centre_reach > size + slack).any() or (survey.centre_from < -slack).any()
    )
    only_centre, only_corner = corner_out and not centre_out, centre_out and not corner_out
    if not form.names:
        return _of_yolo(path, form, survey, tally, only_centre, only_corner)
    if not form.bare or only_corner:
        return form
    if only_centre:
        tally.note(
            "its x,y are taken for the centre, since boxes would reach out of the picture if they "
            "were the upper left corner"
        )
        return form.with_centres()
    if survey.in_shares or form.of_ultralytics:
        raise InputError(
            f"{path}: its x,y,w,h may be the centre (as in YOLO's xywh) or the upper left corner; "
            "call the columns xc,yc,w,h or left,top,width,height"
        )
    tally.note(
        "its x,y are taken for the upper left corner; if they are the centre, call them xc,yc"
    )
    return form


def _of_yolo(
    path: str | os.PathLike[str],
    form: TableForm,
    survey: _Survey,
    tally: Tally,
    only_centre: bool,
    only_corner: bool,
) -> TableForm:
    """The form of rows without a header: of MOTChallenge, or YOLO's labels behind their frame.

    Two boxes of a frame have two ids, and may have one class.
    """
    told = survey.second.least >= 0.0 and survey.second.whole
    classes = survey.same_second > 0.5 * survey.crowded > 0.0
    # MOTChallenge ends its rows with a place in the world that nobody knows.
    mot = form.columns > _EIGHTH + 2 and survey.eighth.least == survey.eighth.greatest == -1.0
    if not told or only_corner or mot or "label" in form.places:
        return form
    ids = survey.eighth
    numbered = ids.whole and ids.least >= 0.0 and form.columns == _EIGHTH + 1
    if not survey.in_shares:
        one_class = survey.second.greatest == 0.0 and ids.greatest > 0.0
        if not (numbered and (classes or one_class)):
            return form
    elif classes or only_centre or (numbered and not survey.crowded):
        tally.note(
            "it has no header; its columns are taken for frame, class, centre and size in shares "
            "of the picture, as YOLO writes them"
        )
        # Without a confidence the id follows the size.
        return form.with_classes_first(form.columns == _EIGHTH and survey.confidence.whole)
    raise InputError(
        f"{path}: has no header, and nothing tells whether its rows are frame,id,left,top,width,"
        "height or, as YOLO writes them, frame,class,centre and size; write a header, as "
        "frame,class_id,xc,yc,w,h,conf,track_id"
    )


def _meaning(
    path: str | os.PathLike[str],
    form: TableForm,
    survey: _Survey,
    tally: Tally,
    skip_empty: bool,
    image_size_px: tuple[int, int] | None,
) -> _Meaning:
    """What the columns mean, with a note on all that is not as usual."""
    scale = _scale_px(path, survey, tally, image_size_px)
    flagged = (
        form.mot
        and {"visibility", "class_id", "confidence"} <= form.places.keys()
        and survey.confidence.flags()
        and survey.class_id.whole
        and survey.visibility.least >= 0.0
        and survey.visibility.greatest <= 1.0
    )
    # A width is less than what is left of it, but for boxes that reach over half of the picture.
    corners = (
        form.extent == "size"
        and not form.names
        and survey.boxes >= _FEWEST_TO_JUDGE
        and survey.grows == survey.boxes
    )
    if corners:
        tally.note(
            "columns 5 and 6 are greater than 3 and 4 in every row, so they are taken for the "
            "lower right corner and not for width and height"
        )
    if survey.begins_outside > 0.5 * survey.boxes:
        tally.note(
            f"{survey.begins_outside} of {survey.boxes} boxes begin left of the picture or above "
            "it (negative coordinates) and are kept as they stand; are they of this picture?"
        )
    if survey.boxes >= _FEWEST_TO_JUDGE and survey.backwards > 0.5 * survey.boxes:
        hint = "; are these widths and heights? name them left,top,width,height"
        raise InputError(
            f"{path}: {survey.backwards} of {survey.boxes} boxes are empty or reversed; expected "
            f"x1 < x2 and y1 < y2{hint if form.extent == 'corners' else ''}"
        )
    return _Meaning(
        first_frame=_first_frame(form, survey, tally),
        flagged=flagged,
        confidence_scale=1.0 if flagged else _confidence_scale(path, survey.confidence, tally),
        scale_px=scale,
        corners=corners,
        numbered=_numbered(form, survey, tally),
        tolerant=skip_empty,
    )


def _scale_px(
    path: str | os.PathLike[str],
    survey: _Survey,
    tally: Tally,
    image_size_px: tuple[int, int] | None,
) -> tuple[float, float]:
    span = survey.extent
    if not survey.boxes or span.whole:
        return 1.0, 1.0
    if not survey.in_shares:
        return _percent_px(survey, tally, image_size_px)
    if image_size_px is None:
        raise InputError(
            f"{path}: its coordinates lie between {span.least:g} and {span.greatest:g}, as shares "
            "of the picture, whose size is not known here; multiply x by the picture's width and "
            "y by its height, both in pixels"
        )
    width, height = image_size_px
    tally.note(
        f"its coordinates are shares of the picture and were multiplied by {width}, {height}"
    )
    return float(width), float(height)


def _percent_px(
    survey: _Survey, tally: Tally, image_size_px: tuple[int, int] | None
) -> tuple[float, float]:
    """As `_scale_px`, where the coordinates may be percents: many, and none beyond 100."""
    least, greatest = survey.extent.least, survey.extent.greatest
    if not (least >= 0.0 and 50.0 < greatest <= 100.0) or survey.boxes < _FEWEST_TO_JUDGE:
        return 1.0, 1.0
    if image_size_px is None:
        tally.note(
            "all boxes lie within 100 px of the picture's upper left corner; are these percents?"
        )
        return 1.0, 1.0
    width, height = image_size_px
    if min(width, height) < _LEAST_SIDE_PX:
        return 1.0, 1.0
    tally.note(
        f"no coordinate is beyond 100 in a picture of {width} x {height} px: taken for percents"
    )
    return 0.01 * width, 0.01 * height


def _first_frame(form: TableForm, survey: _Survey, tally: Tally) -> int:
    if not form.mot:
        return 0
    if survey.frame.least == 0.0:
        tally.note("its frames count from 0, and those of MOTChallenge from 1: taken as from 0")
        return 0
    return 1


def _confidence_scale(path: str | os.PathLike[str], span: _Span, tally: Tally) -> float:
    if not span.count:
        return 1.0
    if span.greatest == span.least == 0.0 and span.count >= _FEWEST_TO_JUDGE:
        tally.note(
            "all confidences are 0, as where a number below 1 is cut to a whole one: taken as "
            "not given"
        )
        return 0.0
    if span.least >= 0.0 and span.greatest <= 1.0 + _ROUNDING:
        return 1.0
    if span.least >= 0.0 and span.greatest <= 100.0 and span.large >= 0.5 * span.count:
        tally.note("its confidences are percents and were divided by 100")
        return 0.01
    if span.count >= _FEWEST_TO_JUDGE:
        raise InputError(
            f"{path}: its confidences lie between {span.least:g} and {span.greatest:g}; expected "
            "0 to 1, or percents, or -1 where they are not known"
        )
    return 1.0


def _numbered(form: TableForm, survey: _Survey, tally: Tally) -> bool:
    numbered = (
        "track_id" in form.places
        and survey.consecutive
        and survey.rows >= _FEWEST_TO_JUDGE
        and survey.frame.least < survey.frame.greatest
        and survey.track_id.least >= 0.0
    )
    if numbered:
        tally.note(
            f"the column {form.name('track_id')} numbers the rows, so it is taken for no track id"
        )
    elif "track_id" in form.places and 0 < survey.without_track < survey.boxes:
        tally.note(
            f"{survey.without_track} of {survey.boxes} boxes have no track id and belong to no "
            "track, since others have one"
        )
    return numbered


def _boxes(
    path: str | os.PathLike[str],
    form: TableForm,
    meaning: _Meaning,
    rows: pd.DataFrame,
    source: str,
    tally: Tally,
) -> Boxes:
    rows = _of_use(path, form, meaning, rows, tally)
    xyxy = _corners(path, form, meaning, rows)
    kept = _with_a_box(path, rows.index, xyxy, meaning, tally)
    rows, xyxy = rows[kept], xyxy[kept]
    frame = time = None
    if "frame" in form.places:
        frame = _whole(path, form, rows, "frame")
        counts = "MOTChallenge counts" if meaning.first_frame else "frames count"
        reason = f"is no frame; {counts} from {meaning.first_frame}"
        _files.refuse(path, rows.index, frame < meaning.first_frame, frame, reason)
        frame = frame - meaning.first_frame
    if "time_utc" in form.places:
        column = rows[form.places["time_utc"]].rename(form.name("time_utc"))
        # A frame tells the time as well, so then a cell may be empty.
        time = _files.times(path, column, missing_allowed=frame is not None)
    return Boxes.of(
        xyxy,
        frame=frame,
        time_utc_s=time,
        confidence=_confidences(path, form, meaning, rows),
        source=_text(form, rows, "annotator", source),
        track_id=_track_ids(path, form, meaning, rows),
        label=_text(form, rows, "label", ""),
    )


def _of_use(
    path: str | os.PathLike[str],
    form: TableForm,
    meaning: _Meaning,
    rows: pd.DataFrame,
    tally: Tally,
) -> pd.DataFrame:
    """The rows that are meant to count."""
    if "target" in form.places:
        flag = _whole(path, form, rows, "target", default=1.0)
        _files.refuse(path, rows.index, ~np.isin(flag, (0, 1)), flag, "is no target; give 1 or 0")
        rows = _without(rows, flag == 0, OTHER_TARGET, tally)
    if meaning.flagged:
        rows = _without(rows, _values(form, rows, "confidence") == 0.0, IGNORED, tally)
    places = [form.places[role] for role in form.geometry]
    return _without(rows, rows[places].isna().all(axis=1).to_numpy(), NO_BOX, tally)


def _without(rows: pd.DataFrame, bad: BoolArray, reason: str, tally: Tally) -> pd.DataFrame:
    if not bad.any():
        return rows
    first = rows.iloc[int(np.argmax(bad))]
    text = ",".join("" if pd.isna(cell) else f"{cell}" for cell in first)
    tally.leave_out(reason, int(bad.sum()), row=f"line {first.name}", text=text)
    return rows[~bad]


def _corners(
    path: str | os.PathLike[str], form: TableForm, meaning: _Meaning, rows: pd.DataFrame
) -> FloatArray:
    """(N, 4) pixels; not finite only where such rows are left out."""
    columns = []
    for role in form.geometry:
        values = _values(form, rows, role)
        column = rows[form.places[role]]
        bad = ~np.isfinite(values)
        if meaning.tolerant:
            bad &= column.notna().to_numpy() & ~np.isinf(values)
        _files.refuse(path, rows.index, bad, column, f"is no number ({form.name(role)})")
        columns.append(values)
    first, second, third, fourth = columns
    with np.errstate(over="ignore", invalid="ignore"):
        if form.extent == "centre":
            first, second = first - 0.5 * third, second - 0.5 * fourth
        if form.extent != "corners" and not meaning.corners:
            third, fourth = first + third, second + fourth
        four = np.column_stack([first, second, third, fourth])
        return np.asarray(four * np.tile(meaning.scale_px, 2))


def _with_a_box(
    path: str | os.PathLike[str],
    lines: pd.Index,
    xyxy_px: FloatArray,
    meaning: _Meaning,
    tally: Tally,
) -> BoolArray:
    """(N,) bool, which rows hold a box; unless they may be left out, others are refused."""
    known: BoolArray = np.asarray(np.isfinite(xyxy_px).all(axis=1))
    with np.errstate(over="ignore", invalid="ignore"):
        size = xyxy_px[:, 2:] - xyxy_px[:, :2]
    backwards = known & (size < 0.0).any(axis=1)
    empty = known & ~backwards & (size == 0.0).any(axis=1)
    if not meaning.tolerant:
        _files.refuse(path, lines, ~known, xyxy_px[:, 2], "is too large a number")
        refuse_empty(path, lines, xyxy_px)
    for bad, reason in ((~known, NOT_A_NUMBER), (backwards, REVERSED), (empty, NO_SIZE)):
        if bad.any():
            i = int(np.argmax(bad))
            text = ",".join(f"{v:g}" for v in xyxy_px[i])
            tally.leave_out(reason, int(bad.sum()), row=f"line {lines[i]}", text=text)
    kept: BoolArray = known & ~backwards & ~empty
    return kept


def refuse_empty(path: str | os.PathLike[str], lines: pd.Index, xyxy_px: FloatArray) -> None:
    """Raise InputError for a box without width or height, or with reversed corners.

    Args:
        path: The file.
        lines: (N,) numbers of the lines.
        xyxy_px: (N, 4) pixels.

    Raises:
        InputError: As said; names the first line.
    """
    refused = (xyxy_px[:, 2:] <= xyxy_px[:, :2]).any(axis=1)
    if refused.any():
        i = int(np.argmax(refused))
        raise InputError(
            f"{path}, line {lines[i]}: the box {','.join(f'{v:g}' for v in xyxy_px[i])} is empty "
            "or reversed; expected x1 < x2 and y1 < y2 (upper left corner, lower right corner)"
        )


def _whole(
    path: str | os.PathLike[str],
    form: TableForm,
    rows: pd.DataFrame,
    role: str,
    default: float | None = None,
) -> IntArray:
    column = rows[form.places[role]].rename(form.name(role))
    if pd.api.types.is_signed_integer_dtype(column):
        return column.to_numpy(dtype=np.int64)
    filled = column if default is None else column.where(column.notna(), default)
    return _files.whole_numbers(path, filled)


def _confidences(
    path: str | os.PathLike[str], form: TableForm, meaning: _Meaning, rows: pd.DataFrame
) -> FloatArray | None:
    if "confidence" not in form.places or meaning.flagged or not meaning.confidence_scale:
        return None
    given = _values(form, rows, "confidence")
    column = rows[form.places["confidence"]]
    text = np.isnan(given) & column.notna().to_numpy()
    _files.refuse(path, rows.index, text, column, f"is no number ({form.name('confidence')})")
    unknown = np.isnan(given) | (given == -1.0)
    confidence = np.where(unknown, 1.0, given * meaning.confidence_scale)
    outside = ~((confidence >= 0.0) & (confidence <= 1.0 + _ROUNDING))
    _files.refuse(path, rows.index, outside, given, "is no confidence between 0 and 1")
    return np.minimum(confidence, 1.0)


def _track_ids(
    path: str | os.PathLike[str], form: TableForm, meaning: _Meaning, rows: pd.DataFrame
) -> IntArray | None:
    if "track_id" not in form.places or meaning.numbered:
        return None
    track = _whole(path, form, rows, "track_id", default=NO_TRACK)
    return np.where(track < 0, NO_TRACK, track)


def _text(form: TableForm, rows: pd.DataFrame, role: str, default: str) -> list[str] | str:
    if role not in form.places:
        return default
    cells = rows[form.places[role]].fillna(default).astype(str).str.strip()
    return [text_of_cell(cell) for cell in cells]
