"""Data types passed between the stages: frozen tables of columns, validated where they are made.

Conventions, said once:

* **Boxes** are ``x1, y1, x2, y2`` in pixels of the full image, origin at the upper left corner,
  x to the right and y down. The *foot* of a box is the middle of its lower edge.
* **Times** are POSIX seconds, UTC, as float64 (``time_utc_s``): good to a quarter of a
  microsecond. NaN is a time that is not known.
* **Positions** are metres east and north of the origin of a `LocalPlane`; relative to a platform
  that moves they are of other types, without a latitude. NaN is no position.
* **Covariances** are 2 x 2, square metres, in the order east, north.
* **Courses and bearings** are degrees clockwise from north, in [0, 360).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Sized
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from sightline.errors import InputError
from sightline.geodesy import LocalPlane, check_geographic

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
StrArray = NDArray[np.str_]

Rows = IntArray | BoolArray | slice
"""What selects rows of a table: their numbers, a mask, or a slice."""

NO_TRACK = -1
"""The track id of a box that belongs to no track."""

NO_FRAME = -1
"""The frame number of a box that came without one."""


def to_datetime64(time_utc_s: ArrayLike) -> NDArray[np.datetime64]:
    """Convert POSIX seconds to ``datetime64[ns]``; NaN becomes NaT."""
    seconds = np.asarray(time_utc_s, dtype=float)
    known = np.isfinite(seconds)
    whole = np.floor(np.where(known, seconds, 0.0))
    nanoseconds = np.round((np.where(known, seconds, 0.0) - whole) * 1e9)
    out = (whole.astype(np.int64) * 1_000_000_000 + nanoseconds.astype(np.int64)).astype(
        "datetime64[ns]"
    )
    return np.where(known, out, np.datetime64("NaT", "ns"))


def from_datetime64(time_utc: ArrayLike) -> FloatArray:
    """Convert ``datetime64`` of any unit, taken as UTC, to POSIX seconds; NaT becomes NaN."""
    stamps = np.asarray(time_utc).astype("datetime64[ns]")
    nanoseconds = stamps.astype(np.int64)
    seconds = nanoseconds // 1_000_000_000 + (nanoseconds % 1_000_000_000) * 1e-9
    return np.where(np.isnat(stamps), np.nan, seconds)


def utc_text(time_utc_s: float) -> str:
    """Format a finite time to the second, as people read it: ``2024-06-01 10:00:00``."""
    return str(np.datetime_as_string(to_datetime64(time_utc_s), "s")).replace("T", " ")


def rfc3339(time_utc_s: float) -> str:
    """Format a finite time to the second: ``2024-06-01T10:00:00Z``."""
    return f"{np.datetime_as_string(to_datetime64(time_utc_s), 's')}Z"


def _column(
    table: object, name: str, values: ArrayLike, dtype: DTypeLike, shape: tuple[int, ...]
) -> NDArray[Any]:
    """Convert values to a column; raise an error that names it where they do not fit."""
    array = np.array(values, dtype=dtype)
    if array.shape != shape:
        raise InputError(f"{type(table).__name__}.{name} has shape {array.shape}, expected {shape}")
    return array


def _freeze(
    table: object, name: str, values: ArrayLike, dtype: DTypeLike, shape: tuple[int, ...]
) -> None:
    array = _column(table, name, values, dtype, shape)
    array.flags.writeable = False
    object.__setattr__(table, name, array)


LARGEST_MMSI = 999_999_999
"""Identities of vessels in AIS have at most nine digits."""


class Columns:
    """Base class of the tables: selection of rows."""

    _row_fields: tuple[str, ...] = ()

    _any_rows = False
    """Whether rows of such a table, whichever and in whatever order, are one again."""

    def __getitem__(self, rows: Rows) -> Self:
        """The rows selected by an index array, a mask or a slice, as a new table.

        What a slice selects stays where it is, as in an array; the rest is copied.
        """
        chosen = {name: getattr(self, name)[rows] for name in self._row_fields}
        first = self._row_fields[0]
        if self._any_rows and chosen[first].ndim == getattr(self, first).ndim:
            return self._unchecked(chosen)
        return replace(self, **chosen)  # type: ignore[type-var]

    def _unchecked(self, columns: Mapping[str, NDArray[Any]]) -> Self:
        """Copy the table with other columns, without validation.

        What came in over a border was checked there; checking it again with each selection took
        longer than the work on it.
        """
        table = object.__new__(type(self))
        for column in columns.values():
            column.flags.writeable = False
        table.__dict__.update(self.__dict__, **columns)
        return table


@dataclass(frozen=True, eq=False)
class Frame:
    """One picture of a video.

    Attributes:
        index: Number of the frame in its recording, from 0.
        time_utc_s: POSIX seconds; NaN if the recording does not tell.
        image_bgr: (H, W, 3) uint8, blue, green, red.
        horizon_px: Rows of the horizon at the left and the right edge; None where it was not looked
            for, or not found.
    """

    index: int
    time_utc_s: float
    image_bgr: NDArray[np.uint8]
    horizon_px: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class Boxes(Columns):
    """Bounding boxes in the image, one a row, in any order.

    Attributes:
        xyxy_px: (N, 4) float64, ``x1, y1, x2, y2``; finite, x1 < x2, y1 < y2.
        frame: (N,) int64, `NO_FRAME` where there is none.
        time_utc_s: (N,) float64, NaN where not known.
        confidence: (N,) float64 in [0, 1].
        source: (N,) str, who made the box: an annotator's or a detector's name, or ``""``. Every
            source has its own bias at the lower edge, so models learn a bias for each.
        track_id: (N,) int64, `NO_TRACK` where there is none.
        label: (N,) str, the class, or ``""``.

    Raises:
        InputError: A column is of another length, or a value breaks the invariants.
    """

    xyxy_px: FloatArray
    frame: IntArray
    time_utc_s: FloatArray
    confidence: FloatArray
    source: StrArray
    track_id: IntArray
    label: StrArray

    _row_fields = (
        "xyxy_px",
        "frame",
        "time_utc_s",
        "confidence",
        "source",
        "track_id",
        "label",
    )
    _any_rows = True

    def __post_init__(self) -> None:
        n = np.shape(self.xyxy_px)[0] if np.ndim(self.xyxy_px) == 2 else -1
        if n < 0 or np.shape(self.xyxy_px)[1] != 4:
            raise InputError(
                f"boxes must have the shape (N, 4), x1, y1, x2, y2; "
                f"these have {np.shape(self.xyxy_px)}"
            )
        _freeze(self, "xyxy_px", self.xyxy_px, np.float64, (n, 4))
        _freeze(self, "frame", self.frame, np.int64, (n,))
        _freeze(self, "time_utc_s", self.time_utc_s, np.float64, (n,))
        _freeze(self, "confidence", self.confidence, np.float64, (n,))
        _freeze(self, "source", self.source, np.str_, (n,))
        _freeze(self, "track_id", self.track_id, np.int64, (n,))
        _freeze(self, "label", self.label, np.str_, (n,))
        check_boxes(self.xyxy_px)
        bad = ~((self.confidence >= 0.0) & (self.confidence <= 1.0))
        if bad.any():
            i = int(np.argmax(bad))
            raise InputError(
                f"box {i + 1}: confidence {self.confidence[i]:g} is not between 0 and 1"
            )

    @classmethod
    def of(
        cls,
        xyxy_px: ArrayLike,
        *,
        frame: ArrayLike | None = None,
        time_utc_s: ArrayLike | None = None,
        confidence: ArrayLike | None = None,
        source: ArrayLike | None = None,
        track_id: ArrayLike | None = None,
        label: ArrayLike | None = None,
    ) -> Boxes:
        """Boxes from what is known of them; a single value holds for all rows.

        Args:
            xyxy_px: (N, 4) pixels.
            frame: Frame numbers; absent: `NO_FRAME`.
            time_utc_s: POSIX seconds; absent: NaN.
            confidence: Absent: 1.
            source: Absent: ``""``.
            track_id: Absent: `NO_TRACK`.
            label: Absent: ``""``.

        Examples:
            >>> boxes = sightline.Boxes.of(
            ...     [[640.0, 400.0, 652.0, 409.0], [100.0, 395.0, 130.0, 412.0]],
            ...     time_utc_s=1717236000.0,
            ...     source="annotator",
            ... )
            >>> len(boxes), boxes.xyxy_px.shape, boxes.confidence.tolist()
            (2, (2, 4), [1.0, 1.0])
            >>> boxes[boxes.xyxy_px[:, 0] > 200.0].xyxy_px.tolist()
            [[640.0, 400.0, 652.0, 409.0]]
        """
        xyxy = np.asarray(xyxy_px, dtype=np.float64)
        if xyxy.size == 0:
            xyxy = xyxy.reshape(0, 4)
        n = xyxy.shape[0] if xyxy.ndim else 0

        def column(values: ArrayLike | None, default: ArrayLike) -> NDArray[Any]:
            array = np.asarray(default if values is None else values)
            return np.broadcast_to(array, (n,)) if array.ndim == 0 else array

        return cls(
            xyxy_px=xyxy,
            frame=column(frame, NO_FRAME),
            time_utc_s=column(time_utc_s, np.nan),
            confidence=column(confidence, 1.0),
            source=column(source, ""),
            track_id=column(track_id, NO_TRACK),
            label=column(label, ""),
        )

    @classmethod
    def concatenate(cls, tables: Sequence[Boxes]) -> Boxes:
        """Concatenate tables in their order, located if all of them are."""
        if not tables:
            return cls.of(np.empty((0, 4)))
        return (type(tables[0]) if len({*map(type, tables)}) == 1 else Boxes)._joined(tables)

    @classmethod
    def _joined(cls, tables: Sequence[Boxes]) -> Boxes:
        empty = object.__new__(Boxes)
        return empty._unchecked(_joined_columns(tables, Boxes._row_fields))

    def with_columns(self, **columns: ArrayLike) -> Boxes:
        """A copy with some columns replaced, each (N,) or (N, 4) for ``xyxy_px``."""
        if not columns.keys() <= _UNBOUND.keys():
            return replace(self, **columns)  # type: ignore[arg-type]
        shape = (len(self),)
        return self._unchecked(
            {
                name: _column(self, name, values, _UNBOUND[name], shape)
                for name, values in columns.items()
            }
        )

    def __len__(self) -> int:
        return int(self.xyxy_px.shape[0])


_UNBOUND: dict[str, type[np.generic]] = {
    "frame": np.int64,
    "time_utc_s": np.float64,
    "source": np.str_,
    "track_id": np.int64,
    "label": np.str_,
}
"""Columns of boxes in which any value may stand, and their types."""


def _joined_columns(tables: Sequence[object], names: Sequence[str]) -> dict[str, NDArray[Any]]:
    return {name: np.concatenate([getattr(table, name) for table in tables]) for name in names}


def check_boxes(xyxy_px: FloatArray) -> None:
    """Raise InputError for non-finite or empty boxes.

    Args:
        xyxy_px: (N, 4) pixels.

    Raises:
        InputError: A coordinate is not finite, or a box has no width or height (its corners are
            reversed). The message names the first.
    """
    if np.isfinite(xyxy_px).all() and (xyxy_px[:, :2] < xyxy_px[:, 2:]).all():
        return
    finite = np.isfinite(xyxy_px).all(axis=1)
    if not finite.all():
        i = int(np.argmin(finite))
        raise InputError(f"box {i + 1}: {_row(xyxy_px[i])} has a coordinate that is not a number")
    ordered = (xyxy_px[:, 0] < xyxy_px[:, 2]) & (xyxy_px[:, 1] < xyxy_px[:, 3])
    if not ordered.all():
        i = int(np.argmin(ordered))
        raise InputError(
            f"box {i + 1}: {_row(xyxy_px[i])} is empty or reversed; "
            "expected x1 < x2 and y1 < y2 (upper left corner, lower right corner)"
        )


def _row(values: FloatArray) -> str:
    return "(" + ", ".join(f"{v:g}" for v in values) + ")"


@dataclass(frozen=True, eq=False)
class Fixes(Columns):
    """Position log of one vessel or vehicle, in the order of time.

    Attributes:
        time_utc_s: (N,) float64, finite, never decreasing. Logs that keep whole seconds repeat
            times; readers keep every fix and leave what to make of repeats to the interpolation.
        latitude_deg: (N,) float64.
        longitude_deg: (N,) float64.
        name: Whose log it is (a vessel's name, an MMSI), or ``""``.

    Raises:
        InputError: A column is of another length, times decrease, or a place is not on the earth.

    Examples:
        >>> log = sightline.Fixes(
        ...     time_utc_s=[1717236000.0, 1717236001.0],
        ...     latitude_deg=[54.3251, 54.3252],
        ...     longitude_deg=[10.1402, 10.1402],
        ...     name="Anna",
        ... )
        >>> len(log), log.latitude_deg[1:].tolist()
        (2, [54.3252])
    """

    time_utc_s: FloatArray
    latitude_deg: FloatArray
    longitude_deg: FloatArray
    name: str = ""

    _row_fields = ("time_utc_s", "latitude_deg", "longitude_deg")

    def __post_init__(self) -> None:
        n = np.size(self.time_utc_s)
        for name in self._row_fields:
            _freeze(self, name, getattr(self, name), np.float64, (n,))
        if not np.isfinite(self.time_utc_s).all():
            i = int(np.argmin(np.isfinite(self.time_utc_s)))
            raise InputError(f"fix {i + 1} has no time")
        check_geographic(self.latitude_deg, self.longitude_deg, "fixes")
        backwards = np.diff(self.time_utc_s) < 0.0
        if backwards.any():
            i = int(np.argmax(backwards))
            raise InputError(
                f"fix {i + 2} is {self.time_utc_s[i] - self.time_utc_s[i + 1]:g} s before the fix "
                "that it follows; the times of a log must not decrease"
            )

    def __len__(self) -> int:
        return int(self.time_utc_s.size)


@dataclass(frozen=True, eq=False)
class Headings(Columns):
    """Headings of a platform, in the order of time.

    Attributes:
        time_utc_s: (N,) float64, finite, strictly increasing, at least two.
        heading_deg: (N,) float64, degrees clockwise from true north.

    Raises:
        InputError: A column is of another length, times do not increase, or a value is not finite.
    """

    time_utc_s: FloatArray
    heading_deg: FloatArray

    _row_fields = ("time_utc_s", "heading_deg")

    def __post_init__(self) -> None:
        n = np.size(self.time_utc_s)
        for name in self._row_fields:
            _freeze(self, name, getattr(self, name), np.float64, (n,))
            if not np.isfinite(getattr(self, name)).all():
                raise InputError(f"headings: a value of {name} is not a number")
        if n < 2 or (np.diff(self.time_utc_s) <= 0.0).any():
            raise InputError("headings: at least two are needed, and their times must increase")

    def __len__(self) -> int:
        return int(self.time_utc_s.size)


@dataclass(frozen=True, eq=False)
class Horizons(Columns):
    """The horizon in the frames of a recording, in the order of time.

    It is the straight line that fits it best over the width of the image, since lenses bend it.

    Attributes:
        time_utc_s: (N,) float64, strictly increasing.
        left_y_px: (N,) float64, its row at the left edge of the image.
        right_y_px: (N,) float64, its row at the right edge.

    Raises:
        InputError: A column is of another length, times do not increase, or a value is not finite.
    """

    time_utc_s: FloatArray
    left_y_px: FloatArray
    right_y_px: FloatArray

    _row_fields = ("time_utc_s", "left_y_px", "right_y_px")

    def __post_init__(self) -> None:
        n = np.size(self.time_utc_s)
        for name in self._row_fields:
            _freeze(self, name, getattr(self, name), np.float64, (n,))
            if not np.isfinite(getattr(self, name)).all():
                raise InputError(f"horizons: a value of {name} is not a number")
        if (np.diff(self.time_utc_s) <= 0.0).any():
            raise InputError("horizons: their times must increase")

    def __len__(self) -> int:
        return int(self.time_utc_s.size)


@dataclass(frozen=True, eq=False)
class ControlPoints(Columns):
    """Pixels whose place on the earth is known: a buoy, the corner of a pier, a road marking.

    Attributes:
        pixel_px: (N, 2) float64, x and y.
        latitude_deg: (N,) float64.
        longitude_deg: (N,) float64.
    """

    pixel_px: FloatArray
    latitude_deg: FloatArray
    longitude_deg: FloatArray

    _row_fields = ("pixel_px", "latitude_deg", "longitude_deg")
    _any_rows = True

    def __post_init__(self) -> None:
        n = np.size(self.latitude_deg)
        _freeze(self, "pixel_px", np.reshape(self.pixel_px, (-1, 2)), np.float64, (n, 2))
        _freeze(self, "latitude_deg", self.latitude_deg, np.float64, (n,))
        _freeze(self, "longitude_deg", self.longitude_deg, np.float64, (n,))
        check_geographic(self.latitude_deg, self.longitude_deg, "control points")
        if not np.isfinite(self.pixel_px).all():
            raise InputError("control points: a pixel is not a number")

    def __len__(self) -> int:
        return int(self.latitude_deg.size)


@dataclass(frozen=True, eq=False)
class EastNorthPositions(Columns):
    """Positions east and north of an origin, metres, with covariance, one row a box.

    What the origin is, the two types that are made of it say: `Positions` and `PlatformPositions`.

    Attributes:
        east_m: (N,) float64, metres; NaN where there is no position (at or above the horizon).
        north_m: (N,) float64, metres.
        covariance_m2: (N, 2, 2) float64, NaN where there is no position.
        extrapolated: (N,) bool, True where the box lies beyond those that the model learned from,
            and where there is no position at all.
        plane: The plane of the earth that they are in, or will be moved to.
        shared_covariance_m2: (N, 2, 2) float64, the part of ``covariance_m2`` that a target has
            in common with itself a moment later, and that time does not average out: of the
            camera's parameters, the clock, the biases of a source. Absent: zero.
    """

    east_m: FloatArray
    north_m: FloatArray
    covariance_m2: FloatArray
    extrapolated: BoolArray
    plane: LocalPlane
    shared_covariance_m2: FloatArray | None = None

    _row_fields = ("east_m", "north_m", "covariance_m2", "extrapolated", "shared_covariance_m2")
    _any_rows = True

    def __post_init__(self) -> None:
        _freeze_places(self, "east_m", "north_m")

    def __len__(self) -> int:
        return int(self.east_m.size)

    @property
    def known(self) -> BoolArray:
        """(N,) bool, whether there is a position."""
        return np.isfinite(self.east_m)

    @property
    def range_m(self) -> FloatArray:
        """(N,) ranges from the origin, metres."""
        return np.hypot(self.east_m, self.north_m)


@dataclass(frozen=True, eq=False)
class Positions(EastNorthPositions):
    """Positions of boxes on the earth: east and north of the origin of a `LocalPlane`.

    Examples:
        Of two boxes, the second lies in the sky:

        >>> model = sightline.load("model.safetensors")
        >>> where = model.locate([[600, 400, 640, 430], [600, 100, 640, 130]], source="annotator")
        >>> where.known.tolist(), where.covariance_m2.shape
        ([True, False], (2, 2, 2))
        >>> where.range_m.round(-1).tolist()
        [100.0, nan]
    """

    @property
    def latitude_deg(self) -> FloatArray:
        """(N,) degrees north, NaN where there is no position."""
        return self.plane.to_geographic(self.east_m, self.north_m)[0]

    @property
    def longitude_deg(self) -> FloatArray:
        """(N,) degrees east, NaN where there is no position."""
        return self.plane.to_geographic(self.east_m, self.north_m)[1]


@dataclass(frozen=True, eq=False)
class PlatformPositions(EastNorthPositions):
    """Positions of boxes relative to a moving platform: east and north of it.

    They have no latitude before they are moved to where the platform was.
    """


@dataclass(frozen=True, eq=False)
class BodyPositions(Columns):
    """Positions of boxes in the body frame of a platform: to starboard and ahead of it.

    They have no latitude before it is known where the platform was and how it pointed.

    Attributes:
        starboard_m: (N,) float64, metres; NaN where there is no position.
        ahead_m: (N,) float64, metres.
        covariance_m2: (N, 2, 2) float64, in the order starboard, ahead.
        extrapolated: (N,) bool; see `EastNorthPositions`.
        plane: The plane of the earth that they will be moved to.
        shared_covariance_m2: (N, 2, 2) float64; see `EastNorthPositions`.
    """

    starboard_m: FloatArray
    ahead_m: FloatArray
    covariance_m2: FloatArray
    extrapolated: BoolArray
    plane: LocalPlane
    shared_covariance_m2: FloatArray | None = None

    _row_fields = (
        "starboard_m",
        "ahead_m",
        "covariance_m2",
        "extrapolated",
        "shared_covariance_m2",
    )

    def __post_init__(self) -> None:
        _freeze_places(self, "starboard_m", "ahead_m")

    def __len__(self) -> int:
        return int(self.starboard_m.size)

    @property
    def known(self) -> BoolArray:
        """(N,) bool, whether there is a position."""
        return np.isfinite(self.starboard_m)


def _freeze_places(table: EastNorthPositions | BodyPositions, first: str, second: str) -> None:
    n = np.size(getattr(table, first))
    _freeze(table, first, getattr(table, first), np.float64, (n,))
    _freeze(table, second, getattr(table, second), np.float64, (n,))
    _freeze(table, "covariance_m2", table.covariance_m2, np.float64, (n, 2, 2))
    _freeze(table, "extrapolated", table.extrapolated, np.bool_, (n,))
    shared = table.shared_covariance_m2
    shared = np.zeros((n, 2, 2)) if shared is None else shared
    _freeze(table, "shared_covariance_m2", shared, np.float64, (n, 2, 2))


@dataclass(frozen=True, eq=False)
class BoxesWith(Boxes):
    """Boxes with a companion table of as many rows.

    Selection and concatenation take it along. A subclass has the table as its one field more.
    """

    _companion = ""
    _stale_with: ClassVar[frozenset[str]] = frozenset()
    """With other values in these columns of the boxes the table holds no longer."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_rows(self, getattr(self, self._companion), self._companion)

    @classmethod
    def at(cls, boxes: Boxes, table: Sized) -> Self:
        """Boxes with their companion table.

        Args:
            boxes: N rows.
            table: N rows.

        Raises:
            InputError: There is not one row a box.
        """
        _check_rows(boxes, table, cls._companion)
        made = object.__new__(cls)
        made.__dict__.update({name: getattr(boxes, name) for name in Boxes._row_fields})
        made.__dict__[cls._companion] = table
        return made

    def __getitem__(self, rows: Rows) -> Self:
        """See `Boxes`."""
        chosen = super().__getitem__(rows)
        chosen.__dict__[self._companion] = getattr(self, self._companion)[rows]
        return chosen

    @classmethod
    def _joined(cls, tables: Sequence[Boxes]) -> Boxes:
        parts = [getattr(table, cls._companion) for table in tables]
        columns = _joined_columns(parts, parts[0]._row_fields)
        joined = tables[0]._unchecked(_joined_columns(tables, Boxes._row_fields))
        joined.__dict__[cls._companion] = parts[0]._unchecked(columns)
        return joined

    def with_columns(self, **columns: ArrayLike) -> Boxes:
        """See `Boxes`; the companion table is dropped where it holds no longer."""
        if columns.keys() & self._stale_with:
            return self.boxes.with_columns(**columns)
        return super().with_columns(**columns)

    @property
    def boxes(self) -> Boxes:
        """The boxes alone."""
        plain = object.__new__(Boxes)
        plain.__dict__.update({name: getattr(self, name) for name in Boxes._row_fields})
        return plain


def _check_rows(boxes: Boxes, table: Sized, name: str) -> None:
    if len(table) != len(boxes):
        raise InputError(f"{len(boxes)} boxes and {len(table)} rows of {name}; each needs one")


@dataclass(frozen=True, eq=False)
class LocatedBoxes(BoxesWith):
    """Boxes with their positions.

    Attributes:
        positions: N rows, as `Georeferencer.locate` or `Georeferencer.locate_body` has them.
    """

    positions: Positions | BodyPositions

    _companion = "positions"
    _stale_with = frozenset({"xyxy_px", "time_utc_s", "source"})


class PointKind(IntEnum):
    """Kind of a point of a track: measured, interpolated or extrapolated."""

    MEASURED = 0
    INTERPOLATED = 1
    EXTRAPOLATED = 2


@dataclass(frozen=True, eq=False)
class Track(Columns):
    """Smooth trajectory of one target, one row a point in time.

    Attributes:
        track_id: Its number.
        time_utc_s: (N,) float64, finite, strictly increasing.
        east_m: (N,) float64, finite.
        north_m: (N,) float64, finite.
        velocity_east_mps: (N,) float64, metres a second.
        velocity_north_mps: (N,) float64, metres a second.
        covariance_m2: (N, 2, 2) float64, of the position.
        velocity_covariance_m2ps2: (N, 2, 2) float64, of the velocity.
        kind: (N,) int8, a `PointKind` a row.
        plane: Where the origin lies on the earth.
        label: The class of the target, or ``""``.
        moored: (N,) bool, whether the target stayed in its place, as what is moored does, and
            houses and buoys that are taken for boats. Absent: nowhere.
        untold: Whether too little was seen of the target to tell if it moves elsewhere.
        mmsi: Of the vessel that the target is, where that is known.
        name: Of that vessel, or ``""``.

    Examples:
        >>> track = sightline.Tracks.read("tracks.geojson")[0]
        >>> track.east_m.shape == track.time_utc_s.shape
        True
        >>> track.covariance_m2.shape == (len(track), 2, 2)
        True
        >>> bool((track.speed_mps >= 0.0).all() and (track.course_deg < 360.0).all())
        True
    """

    track_id: int
    time_utc_s: FloatArray
    east_m: FloatArray
    north_m: FloatArray
    velocity_east_mps: FloatArray
    velocity_north_mps: FloatArray
    covariance_m2: FloatArray
    velocity_covariance_m2ps2: FloatArray
    kind: NDArray[np.int8]
    plane: LocalPlane
    label: str = ""
    moored: BoolArray | None = None
    untold: bool = False
    mmsi: int | None = None
    name: str = ""

    _row_fields: tuple[str, ...] = (
        "time_utc_s",
        "east_m",
        "north_m",
        "velocity_east_mps",
        "velocity_north_mps",
        "covariance_m2",
        "velocity_covariance_m2ps2",
        "kind",
        "moored",
    )

    def __post_init__(self) -> None:
        n = np.size(self.time_utc_s)
        for name in Track._row_fields:
            if name == "kind":
                _freeze(self, name, self.kind, np.int8, (n,))
            elif name == "moored":
                moored = np.zeros(n, dtype=bool) if self.moored is None else self.moored
                _freeze(self, name, moored, np.bool_, (n,))
            elif "covariance" in name:
                _freeze(self, name, getattr(self, name), np.float64, (n, 2, 2))
            else:
                _freeze(self, name, getattr(self, name), np.float64, (n,))
                if not np.isfinite(getattr(self, name)).all():
                    raise InputError(f"track {self.track_id}: {name} has a value that is no number")
        if (np.diff(self.time_utc_s) <= 0.0).any():
            i = int(np.argmax(np.diff(self.time_utc_s) <= 0.0))
            raise InputError(
                f"track {self.track_id}: point {i + 2} is not later than the point before it; "
                "the times of a track must increase"
            )

    def __len__(self) -> int:
        return int(self.time_utc_s.size)

    @property
    def latitude_deg(self) -> FloatArray:
        """(N,) degrees north."""
        return self.plane.to_geographic(self.east_m, self.north_m)[0]

    @property
    def longitude_deg(self) -> FloatArray:
        """(N,) degrees east."""
        return self.plane.to_geographic(self.east_m, self.north_m)[1]

    def in_plane(self, plane: LocalPlane) -> Self:
        """The same places in the plane of another origin; velocities stay as they are.

        Args:
            plane: Not so far away that its north points elsewhere.
        """
        east, north = plane.to_plane(self.latitude_deg, self.longitude_deg)
        return replace(self, east_m=east, north_m=north, plane=plane)

    @property
    def never_moves(self) -> bool:
        """Whether the target stayed in its place for the whole track."""
        assert self.moored is not None, "filled in"
        return bool(len(self) and self.moored.all())

    @property
    def speed_mps(self) -> FloatArray:
        """(N,) metres a second over ground."""
        return np.hypot(self.velocity_east_mps, self.velocity_north_mps)

    @property
    def course_deg(self) -> FloatArray:
        """(N,) degrees clockwise from north, course over ground."""
        return np.degrees(np.arctan2(self.velocity_east_mps, self.velocity_north_mps)) % 360.0


@dataclass(frozen=True, eq=False)
class FusedTrack(Track):
    """Trajectory of one target that several cameras may have seen.

    Attributes:
        cameras: (N,) str, names of the cameras that saw it at each point, parted by spaces;
            ``""`` where none did. Absent: nowhere.
    """

    cameras: StrArray | None = None

    _row_fields: tuple[str, ...] = (*Track._row_fields, "cameras")

    def __post_init__(self) -> None:
        n = np.size(self.time_utc_s)
        cameras = np.full(n, "") if self.cameras is None else self.cameras
        _freeze(self, "cameras", cameras, np.str_, (n,))
        super().__post_init__()


@dataclass(frozen=True, eq=False)
class Ellipses:
    """Error ellipses of covariances.

    Attributes:
        semi_major_m: (N,) metres.
        semi_minor_m: (N,) metres.
        bearing_deg: (N,) of the major axis, degrees clockwise from north, in [0, 180).
    """

    semi_major_m: FloatArray
    semi_minor_m: FloatArray
    bearing_deg: FloatArray = field(repr=False)


def ellipses(covariance_m2: FloatArray, probability: float = 0.95) -> Ellipses:
    """Error ellipses that hold the true position with a probability, under a normal distribution.

    Args:
        covariance_m2: (N, 2, 2) square metres, east and north.
        probability: In (0, 1).
    """
    scale = np.sqrt(-2.0 * np.log1p(-probability))
    known = np.asarray(np.isfinite(covariance_m2).all(axis=(1, 2)))
    values, vectors = np.linalg.eigh(np.where(known[:, None, None], covariance_m2, np.eye(2)))
    axes = scale * np.sqrt(np.maximum(values, 0.0))
    bearing = np.degrees(np.arctan2(vectors[:, 0, 1], vectors[:, 1, 1])) % 180.0
    return Ellipses(
        semi_major_m=np.where(known, axes[:, 1], np.nan),
        semi_minor_m=np.where(known, axes[:, 0], np.nan),
        bearing_deg=np.where(known, bearing, np.nan),
    )


def check_inside(boxes: Boxes, size_px: tuple[int, int], where: str = "") -> None:
    """Raise InputError for boxes wholly outside the image.

    Args:
        boxes: The boxes.
        size_px: Width and height of the picture.
        where: Begins the message: the file.

    Raises:
        InputError: A box lies wholly outside the picture; names the first.
    """
    x1, y1, x2, y2 = boxes.xyxy_px.T
    outside = (x2 <= 0.0) | (y2 <= 0.0) | (x1 >= size_px[0]) | (y1 >= size_px[1])
    if outside.any():
        i = int(np.argmax(outside))
        box = ",".join(f"{value:g}" for value in boxes.xyxy_px[i])
        known = boxes.frame[i] != NO_FRAME
        name = f"the box of frame {boxes.frame[i]}" if known else f"box {i + 1}"
        raise InputError(
            f"{where}{name} ({box}) lies wholly outside the picture of {size_px[0]} x "
            f"{size_px[1]} px; was it drawn in a picture of another size?"
        )
