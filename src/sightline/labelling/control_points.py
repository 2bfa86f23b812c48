"""A scene's control points while they are set: pixels whose place on the earth is known."""

from __future__ import annotations

import csv
import io
import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sightline.atomic import atomic_path
from sightline.errors import InputError, OutputError, SightlineError
from sightline.formats import read_control_points
from sightline.formats.pasted_position import parse_position as parse_position
from sightline.geodesy import LocalPlane
from sightline.georeferencing.fit import FitInputs, FitSettings, fit
from sightline.georeferencing.fit_report import Parameter
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.labelling.box_table import WAIT_S
from sightline.labelling.refit import without_empty_tables
from sightline.plausibility import check_together
from sightline.scene import Scene
from sightline.scene.correspondences import collect
from sightline.scene.naming import name_control_points
from sightline.scene.schema import parse_scene_table
from sightline.tally import Tally
from sightline.text import cell_text, text_of_cell
from sightline.types import BoolArray, ControlPoints

FILE = "control_points.csv"
"""The table that is begun beside the scene file."""

_COLUMNS = ("x_px", "y_px", "latitude_deg", "longitude_deg")
_HEADER = (*_COLUMNS, "name")
_LONGEST_NAME = 80
_MOST_STEPS = 1000
_MODEL = "camera"

Cells = tuple[str, ...]


@dataclass(frozen=True)
class SheetPoint:
    """A control point.

    Attributes:
        number: In the order of the table, the first is 1.
        x_px: Its column.
        y_px: Its row.
        latitude_deg: Degrees north.
        longitude_deg: Degrees east.
        name: What it is, or ``""``.
    """

    number: int
    x_px: float
    y_px: float
    latitude_deg: float
    longitude_deg: float
    name: str


@dataclass(frozen=True)
class PointResidual:
    """What a fit makes of a control point.

    Attributes:
        number: As in `SheetPoint`.
        error_m: From its place to where the camera puts its pixel; NaN at or above the horizon.
        residual_px: From its pixel to where the camera expects it.
        left_out_m: As ``error_m``, by a fit without this point; NaN where there is none.
        sigmas: The residual in standard deviations.
        outlier: Whether the fit took it for one.
    """

    number: int
    error_m: float
    residual_px: float
    left_out_m: float
    sigmas: float
    outlier: bool


@dataclass(frozen=True, eq=False)
class ControlPointReport:
    """A fit to the control points of a scene, and to its boxes.

    Attributes:
        points: One a control point.
        rmse_m: Root mean square error of the control points, metres; NaN without a fit.
        left_out_m: The same by fits without each; NaN where one of them fails.
        parameters: Of the camera.
        statements: Sentences for people.
        error: Why there is no fit, in one line, or ``""``.
        georeferencer: The fit, or None.
    """

    points: tuple[PointResidual, ...] = ()
    rmse_m: float = float("nan")
    left_out_m: float = float("nan")
    parameters: tuple[Parameter, ...] = ()
    statements: tuple[str, ...] = ()
    error: str = ""
    georeferencer: Georeferencer | None = None


def fit_points(scene: Path) -> tuple[FitInputs, Georeferencer]:
    """Fit a camera to the control points of a scene, and to boxes where there are any.

    Args:
        scene: The scene file.

    Raises:
        InputError: A file of the scene cannot be used.
        FitError: There are too few, or no camera explains them.
    """
    inputs = collect(without_empty_tables(Scene.load(scene)), pictures=False)
    return inputs, fit(inputs, FitSettings(model=_MODEL))


@dataclass(frozen=True)
class _Change:
    """A change that can be undone: a row that was there, and one that is there instead."""

    before: Cells | None
    after: Cells | None
    at: int


class ControlPointSheet:
    """The control points of a scene while they are set.

    Every change is written at once, whole, to the table that the scene names; one is begun beside
    the scene file, and named in it, where there is none. Changes of others to other points stay.
    """

    def __init__(self, scene: Path) -> None:
        """Open the control points of a scene.

        Args:
            scene: The scene file.

        Raises:
            InputError: A file of the scene cannot be used, or its control points stand where they
                cannot be changed: in the scene file itself, or in a file of OTVision.
        """
        self._path = Path(scene)
        self._size_px = Scene.load(self._path).image_size_px
        self._lock = threading.RLock()
        self._done: list[_Change] = []
        self._undone: list[_Change] = []
        self._read()

    def points(self) -> list[SheetPoint]:
        """All control points, as the table has them now.

        Raises:
            InputError: The table cannot be read any more.
        """
        with self._lock:
            header, rows = self._read()
        return [_point(header, row, i) for i, row in enumerate(rows, start=1)]

    def add(
        self,
        pixel_px: tuple[float, float],
        latitude_deg: float,
        longitude_deg: float,
        name: str = "",
    ) -> SheetPoint:
        """Add a control point.

        Args:
            pixel_px: Its column and row.
            latitude_deg: Degrees north.
            longitude_deg: Degrees east.
            name: What it is.

        Raises:
            InputError: The pixel is not in the picture, the place not on the earth or far from all
                others, or the table cannot be written.
        """
        with self._lock:
            header, rows = self._read()
            header = header if "name" in header or not name else (*header, "name")
            new = self._cells(header, ("",) * len(header), pixel_px, (latitude_deg, longitude_deg))
            new = _named(header, new, name)
            self._change(_Change(None, new, len(rows)), header)
            self._remember(_Change(None, new, len(rows)))
            return self.points()[-1]

    def move(
        self,
        number: int,
        *,
        pixel_px: tuple[float, float] | None = None,
        place_deg: tuple[float, float] | None = None,
    ) -> SheetPoint:
        """Move a control point, in the picture or on the earth.

        Args:
            number: Of the point.
            pixel_px: Its new column and row. Absent: as before.
            place_deg: Its new latitude and longitude. Absent: as before.

        Raises:
            InputError: As `add`, or there is no such point.
        """
        with self._lock:
            header, rows = self._read()
            old = self._row(rows, number)
            was = _point(header, old, number)
            new = self._cells(
                header,
                old,
                (was.x_px, was.y_px) if pixel_px is None else pixel_px,
                (was.latitude_deg, was.longitude_deg) if place_deg is None else place_deg,
            )
            change = _Change(old, new, number - 1)
            self._change(change, header)
            self._remember(change)
            return _point(header, new, number)

    def remove(self, number: int) -> None:
        """Take a control point away.

        Raises:
            InputError: There is no such point, or the table cannot be written.
        """
        with self._lock:
            header, rows = self._read()
            change = _Change(self._row(rows, number), None, number - 1)
            self._change(change, header)
            self._remember(change)

    def undo(self) -> bool:
        """Take the last change back; whether there was one.

        Raises:
            InputError: Somebody else has changed that point since, or it cannot be written.
        """
        return self._again(self._done, self._undone, back=True)

    def redo(self) -> bool:
        """Do again what was taken back last; whether there was something.

        Raises:
            InputError: As `undo`.
        """
        return self._again(self._undone, self._done, back=False)

    def residuals(self, *, left_out: bool = True) -> ControlPointReport:
        """Fit a camera to the control points, and to boxes where there are any.

        Args:
            left_out: Whether each point is also held against a fit without it, which takes as many
                fits as there are points.
        """
        try:
            inputs, fitted = fit_points(self._path)
        except SightlineError as error:
            return ControlPointReport(error=str(error))
        report = fitted.report
        points = tuple(
            PointResidual(
                number=one.number,
                error_m=one.error_m,
                residual_px=one.residual_px,
                left_out_m=_left_out_m(inputs, i) if left_out else float("nan"),
                sigmas=one.sigmas,
                outlier=one.outlier,
            )
            for i, one in enumerate(report.points)
        )
        return ControlPointReport(
            points=points,
            rmse_m=_root_mean_square([one.error_m for one in points]),
            left_out_m=_root_mean_square([one.left_out_m for one in points]),
            parameters=report.parameters,
            statements=report.statements,
            georeferencer=fitted,
        )

    def _again(self, steps: list[_Change], others: list[_Change], *, back: bool) -> bool:
        with self._lock:
            if not steps:
                return False
            step = steps[-1]
            change = _Change(step.after, step.before, step.at) if back else step
            header, _ = self._read()
            try:
                self._change(change, header)
            except OutputError:
                raise
            except InputError:
                # What somebody else has changed is no longer ours to take back.
                steps.pop()
                raise
            others.append(steps.pop())
            return True

    def _remember(self, change: _Change) -> None:
        self._done.append(change)
        del self._done[:-_MOST_STEPS]
        self._undone.clear()

    def _table(self) -> Path | None:
        """The table that the scene file names."""
        named = parse_scene_table(self._path).control_points
        if isinstance(named, str):
            return self._path.parent / named
        if named:
            raise InputError(
                f"{self._path}: its control points stand in the scene file; write them into a "
                f'table ({",".join(_HEADER)}) and name it (control_points = "{FILE}") to change '
                "them here"
            )
        return None

    def _read(self) -> tuple[Cells, list[Cells]]:
        """Header and rows of the table."""
        path = self._table()
        if path is None:
            return _HEADER, []
        read_control_points(path, tally=Tally(path))
        try:
            lines = path.read_text(encoding="utf-8-sig").splitlines()
            rows = [row for row in csv.reader(lines, strict=True) if any(map(str.strip, row))]
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            raise InputError(f"{path}: cannot be read: {error}") from error
        header = tuple(name.strip() for name in rows[0]) if rows else ()
        if not set(_COLUMNS) <= set(header):
            raise InputError(
                f"{path}: control points are changed in tables of the columns "
                f"{','.join(_HEADER)} alone (UTF-8, parted by commas); write it so, or name "
                "another file in the scene"
            )
        width = len(header)
        wide = [(*row, *("",) * (width - len(row))) for row in map(tuple, rows[1:])]
        for number, row in enumerate(wide, start=1):
            try:
                _point(header, row, number)
            except ValueError as error:
                # Readers pass over a row that says NA in every cell; here it has a number.
                raise InputError(
                    f"{path}: its row {number} is no control point ({error}); correct it, or take "
                    "it out"
                ) from error
        return header, wide

    def _change(self, change: _Change, header: Cells) -> None:
        """Write a change into the table as it is now."""
        path = self._table()
        begun = path is None
        path = self._path.parent / FILE if path is None else path
        with atomic_path(path, wait_s=WAIT_S) as temporary:
            if begun and path.exists():
                raise InputError(
                    f"{path}: is there already, and {self._path} does not name it; name it "
                    f'(control_points = "{FILE}"), or move it away'
                )
            _, rows = (header, list[Cells]()) if begun else self._read()
            rows = [(*row, *("",) * (len(header) - len(row))) for row in rows]
            rows = _changed(path, rows, change, len(header))
            if rows:
                _check(path, header, rows)
                temporary.write_text(_text(header, rows), encoding="utf-8", newline="")
            elif not begun:
                # A scene with an empty table is none.
                name_control_points(self._path, None, wait_s=WAIT_S)
        if not rows:
            path.unlink(missing_ok=True)
        elif begun:
            try:
                name_control_points(self._path, FILE, wait_s=WAIT_S)
            except InputError:
                path.unlink(missing_ok=True)
                raise

    @staticmethod
    def _row(rows: Sequence[Cells], number: int) -> Cells:
        if not 1 <= number <= len(rows):
            raise InputError(f"there is no control point {number}; there are {len(rows)}")
        return rows[number - 1]

    def _cells(
        self,
        header: Cells,
        old: Cells,
        pixel_px: tuple[float, float],
        place_deg: tuple[float, float],
    ) -> Cells:
        """A row with another pixel and place.

        Raises:
            InputError: One of them cannot be.
        """
        (x, y), (latitude, longitude) = pixel_px, place_deg
        width, height = self._size_px
        if not (math.isfinite(x) and math.isfinite(y)) or not (
            0.0 <= x <= width and 0.0 <= y <= height
        ):
            raise InputError(f"pixel ({x:g}, {y:g}) is not in the picture of {width} x {height} px")
        on_earth = math.isfinite(latitude) and math.isfinite(longitude)
        if not (on_earth and abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
            raise InputError(
                f"{latitude:g}, {longitude:g} is no place on the earth; give degrees north (-90 to "
                "90) and east (-180 to 180)"
            )
        known = {
            "x_px": f"{x:.2f}",
            "y_px": f"{y:.2f}",
            "latitude_deg": f"{latitude:.8f}",
            "longitude_deg": f"{longitude:.8f}",
        }
        return tuple(known.get(name, cell) for name, cell in zip(header, old, strict=True))


def _named(header: Cells, row: Cells, name: str) -> Cells:
    name = name.strip()
    if len(name) > _LONGEST_NAME or not name.isprintable():
        raise InputError(
            f"a control point's name has up to {_LONGEST_NAME} printable letters; it is "
            f"{name[:_LONGEST_NAME]!r}"
        )
    return tuple(
        cell_text(name) if column == "name" else cell
        for column, cell in zip(header, row, strict=True)
    )


def _point(header: Cells, row: Cells, number: int) -> SheetPoint:
    cells = dict(zip(header, row, strict=False))
    x, y, latitude, longitude = (float(cells[name]) for name in _COLUMNS)
    name = text_of_cell(cells.get("name", "").strip())
    return SheetPoint(number, x, y, latitude, longitude, name)


def _changed(path: Path, rows: list[Cells], change: _Change, width: int) -> list[Cells]:
    """Rows with a change, wherever the row that it is of stands by now."""

    def wide(row: Cells) -> Cells:
        return (*row, *("",) * (width - len(row)))

    if change.before is None:
        at = min(change.at, len(rows))
    else:
        places = [i for i, row in enumerate(rows) if row == wide(change.before)]
        if not places:
            raise InputError(
                f"{path}: this control point was changed by somebody else meanwhile; look at it, "
                "and do it again"
            )
        at = min(places, key=lambda i: abs(i - change.at))
        rows = [*rows[:at], *rows[at + 1 :]]
    if change.after is None:
        return rows
    return [*rows[:at], wide(change.after), *rows[at:]]


def _text(header: Cells, rows: Sequence[Cells]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return out.getvalue()


def _check(path: Path, header: Cells, rows: Sequence[Cells]) -> None:
    """Raise InputError for control points that no reader of the scene would take."""
    points = [_point(header, row, i) for i, row in enumerate(rows, start=1)]
    check_together(
        np.array([one.latitude_deg for one in points]),
        np.array([one.longitude_deg for one in points]),
        [f"control point {one.number}" for one in points],
        str(path),
    )


def _left_out_m(inputs: FitInputs, left_out: int) -> float:
    """Error of a control point by a fit without it, metres; NaN where there is no such fit."""
    control = inputs.control_points
    kept: BoolArray = np.arange(len(control)) != left_out
    others = ControlPoints(
        control.pixel_px[kept], control.latitude_deg[kept], control.longitude_deg[kept]
    )
    try:
        fitted = fit(replace(inputs, control_points=others), FitSettings(model=_MODEL))
    except SightlineError:
        return float("nan")
    camera, plane = fitted.camera, fitted.plane
    assert camera is not None, "a model of a camera has one"
    return _apart_m(camera.locate(control.pixel_px[[left_out]]), plane, control, left_out)


def _apart_m(
    found: tuple[np.ndarray, np.ndarray], plane: LocalPlane, control: ControlPoints, row: int
) -> float:
    east, north = plane.to_plane(control.latitude_deg[[row]], control.longitude_deg[[row]])
    return float(np.hypot(found[0][0] - east[0], found[1][0] - north[0]))


def _root_mean_square(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values else float("nan")
