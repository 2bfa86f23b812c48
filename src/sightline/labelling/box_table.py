"""A recording's table of boxes while several people draw in it.

Each change reads the table anew, changes the rows of one frame and one annotator, and replaces the
file in one step, while nobody else can. All other rows and columns stay as they were written.
"""

from __future__ import annotations

import csv
import io
import math
import shutil
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from sightline.atomic import atomic_path
from sightline.errors import InputError
from sightline.formats import read_boxes
from sightline.scene.naming import name_file
from sightline.scene.schema import parse_scene_table
from sightline.tally import Tally
from sightline.text import cell_text, text_of_cell

Box = tuple[float, float, float, float]
"""Left, top, right and bottom, pixels."""

WAIT_S = 5.0
"""So long a change waits for those of others."""

_CORNERS = ("x1", "y1", "x2", "y2")
_HEADER = ("frame", *_CORNERS, "annotator")
_FOLDER = "boxes"
_BOM = "\ufeff"
_PAUSE_S = 0.02


@dataclass(frozen=True)
class TableRow:
    """A row of the table that is of the logged target.

    Attributes:
        frame: Its frame.
        box: Its corners.
        annotator: Who drew it, or ``""``.
        confidence: 0 to 1.
        cells: All of it, as it is written.
    """

    frame: int
    box: Box
    annotator: str
    confidence: float
    cells: tuple[str, ...]


RowKey = tuple[int, str]
"""A frame and an annotator."""

Change = tuple[Sequence[TableRow], Sequence["TableRow | Box"]]
"""Rows that stand in a table, and what is to stand there: rows as they were, or new boxes."""


@dataclass(frozen=True)
class _Content:
    """A table: lines before its header, the header, and its rows with what they hold, if it counts.

    Attributes:
        preamble: Comments.
        header: Names of the columns.
        rows: Cells of each row, and what is in them where it is of the target.
    """

    preamble: tuple[str, ...] = ()
    header: tuple[str, ...] = _HEADER
    rows: tuple[tuple[tuple[str, ...], TableRow | None], ...] = ()

    @property
    def boxes(self) -> list[TableRow]:
        return [row for _, row in self.rows if row is not None]

    def of(self, frame: int, annotator: str) -> tuple[TableRow, ...]:
        return tuple(row for row in self.boxes if row.frame == frame and row.annotator == annotator)

    def text(self) -> str:
        out = io.StringIO()
        for line in self.preamble:
            out.write(f"{line}\n")
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(self.header)
        writer.writerows(cells for cells, _ in self.rows)
        return out.getvalue()


class BoxTable:
    """The table of boxes of one recording of a scene; see the module.

    Attributes:
        path: The table; None where the scene names none yet.
    """

    def __init__(
        self, scene: Path, recording: str, path: Path | None, image_size_px: tuple[int, int]
    ) -> None:
        """Read the table.

        Args:
            scene: The scene file.
            recording: Name of the recording.
            path: The table that it names, or None.
            image_size_px: Width and height of the picture.

        Raises:
            InputError: It cannot be read, or is of a kind that no row can be added to.
        """
        self.path = path
        self._scene, self._recording, self._size_px = scene, recording, image_size_px
        self._seen: tuple[int, int, int] | None = None
        self._content = _Content()
        self._lock = threading.RLock()
        self.rows()

    def rows(self) -> list[TableRow]:
        """The rows of the target as the table has them now.

        Raises:
            InputError: It cannot be read any more.
        """
        with self._lock:
            if self.path is None:
                named = self._named()
                if named is None:
                    return []
                self.path = named
            stamp = self._stamp(self.path)
            if stamp is None or stamp != self._seen:
                self._content = _read(self.path, self._size_px)
                self._seen = stamp
            return self._content.boxes

    def of(self, frame: int, annotator: str) -> tuple[TableRow, ...]:
        """The rows of a frame by an annotator, as they were last read."""
        return self._content.of(frame, annotator)

    def put(
        self,
        frame: int,
        annotator: str,
        new: Sequence[TableRow | Box],
        *,
        expected: tuple[TableRow, ...] | None = None,
    ) -> tuple[TableRow, ...]:
        """Replace the rows of a frame by an annotator, at once and whole.

        Args:
            frame: The frame.
            annotator: Whose rows.
            new: What stands there then: rows as they were, or new boxes.
            expected: What has to stand there until then. Absent: what was last read.

        Returns:
            The rows that stand there now.

        Raises:
            InputError: Somebody else has changed these rows, or the table cannot be read or
                written; then nothing has changed.
        """
        with self._lock:
            expected = self.of(frame, annotator) if expected is None else expected
            key = frame, annotator
            return self.put_all({key: (expected, new)})[key]

    def put_all(self, changes: Mapping[RowKey, Change]) -> dict[RowKey, tuple[TableRow, ...]]:
        """Replace the rows of several frames and annotators, all at once or none.

        Args:
            changes: By frame and annotator, what has to stand there until then, and what stands
                there then.

        Returns:
            What stands there now.

        Raises:
            InputError: As `put`.
        """
        with self._lock:
            if self.path is None:
                self._begin()
            path = self.path
            assert path is not None, "it has just been made"
            with atomic_path(path, wait_s=WAIT_S) as temporary:
                content = _read(path, self._size_px)
                for (frame, annotator), (expected, _) in changes.items():
                    if content.of(frame, annotator) == tuple(expected):
                        continue
                    self._content, self._seen = content, self._stamp(path)
                    raise InputError(
                        f"{path}: the box of {annotator or 'nobody'} in frame {frame} was changed "
                        "by somebody else meanwhile; look at it, and do it again"
                    )
                for (frame, annotator), (_, new) in changes.items():
                    content = _with(content, frame, annotator, new)
                temporary.write_text(content.text(), encoding="utf-8", newline="")
            self._content, self._seen = content, self._stamp(path)
            return {key: content.of(*key) for key in changes}

    def _begin(self) -> None:
        """Make an empty table that the scene names, or take the one that somebody else has made."""
        path = self._scene.parent / _FOLDER / f"{self._recording}.csv"
        # Whoever made it names it next.
        until_s = time.monotonic() + WAIT_S
        while (named := self._named()) is None and path.exists() and time.monotonic() < until_s:
            time.sleep(_PAUSE_S)
        if named is None:
            with atomic_path(path, wait_s=WAIT_S) as temporary:
                named = self._named()
                if named is None and path.exists():
                    raise InputError(
                        f"{path}: is there already, and {self._scene} does not name it; name it "
                        f'(boxes = "{self._relative(path)}"), or move it away'
                    )
                if named is None:
                    temporary.write_text(_Content().text(), encoding="utf-8", newline="")
                else:
                    shutil.copyfile(path, temporary)
            try:
                name_file(
                    self._scene, self._recording, "boxes", self._relative(path), wait_s=WAIT_S
                )
            except InputError:
                path.unlink()
                raise
            named = path
        self.path = named

    def _named(self) -> Path | None:
        """The table that the scene file names by now; somebody else may have begun one."""
        for one in parse_scene_table(self._scene).recordings:
            if one.name == self._recording and one.boxes is not None:
                return self._scene.parent / one.boxes
        return None

    def _relative(self, path: Path) -> str:
        return path.relative_to(self._scene.parent).as_posix()

    @staticmethod
    def _stamp(path: Path) -> tuple[int, int, int] | None:
        try:
            found = path.stat()
        except OSError:
            return None
        return found.st_mtime_ns, found.st_size, found.st_ino


def _with(content: _Content, frame: int, annotator: str, new: Sequence[TableRow | Box]) -> _Content:
    """The content with other rows of a frame by an annotator."""
    header = content.header
    if "annotator" not in header and any(not isinstance(one, TableRow) for one in new):
        header = (*header, "annotator")
    kept: list[tuple[tuple[str, ...], TableRow | None]] = []
    at: int | None = None
    for cells, row in content.rows:
        if row is not None and row.frame == frame and row.annotator == annotator:
            at = len(kept) if at is None else at
            continue
        wide = (*cells, *("",) * (len(header) - len(cells)))
        kept.append((wide, None if row is None else replace(row, cells=wide)))
    if at is None:
        # In the order of frames, as far as there is one.
        later = (i for i, (_, row) in enumerate(kept) if row is not None and row.frame > frame)
        at = next(later, len(kept))
    added = [_row(header, frame, annotator, one) for one in new]
    rows = (*kept[:at], *((row.cells, row) for row in added), *kept[at:])
    return _Content(content.preamble, header, rows)


def _row(header: tuple[str, ...], frame: int, annotator: str, one: TableRow | Box) -> TableRow:
    if isinstance(one, TableRow):
        cells = (*one.cells, *("",) * (len(header) - len(one.cells)))
        return replace(one, cells=cells)
    rounded = [round(float(value), 2) for value in one]
    known = {"frame": str(frame), "annotator": cell_text(annotator), "confidence": "1"}
    known |= {
        name: f"{value:.2f}".rstrip("0").rstrip(".")
        for name, value in zip(_CORNERS, rounded, strict=True)
    }
    if "target" in header:
        known["target"] = "1"
    cells = tuple(known.get(name, "") for name in header)
    x1, y1, x2, y2 = (float(known[name]) for name in _CORNERS)
    return TableRow(frame, (x1, y1, x2, y2), annotator, 1.0, cells)


def _read(path: Path, image_size_px: tuple[int, int]) -> _Content:
    """Read and check a table.

    Raises:
        InputError: It cannot be read, or a row cannot be added to it as it is written.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    other = InputError(
        f"{path}: boxes are drawn into tables of the columns {','.join(_HEADER)} alone (UTF-8, "
        "parted by commas); write it so, or name another file in the scene"
    )
    try:
        text = data.decode("utf-8").removeprefix(_BOM)
    except UnicodeDecodeError as error:
        raise other from error
    lines = text.splitlines()
    skipped = next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))
    try:
        table = list(csv.reader(lines[skipped:], strict=True))
    except csv.Error as error:
        raise InputError(f"{path}: is damaged: {error}") from error
    if not table:
        raise other
    header = tuple(name.strip() for name in table[0])
    if not {"frame", *_CORNERS} <= set(header) or len(set(header)) < len(header):
        raise other
    cells = [tuple(row) for row in table[1:] if any(cell.strip() for cell in row)]
    if cells:
        # It refuses what no reader of the scene would take, with the line.
        read_boxes(path, image_size_px=image_size_px, tally=Tally(path))
    return _Content(
        tuple(lines[:skipped]),
        header,
        tuple((row, _parsed(path, dict(zip(header, row, strict=False)), row)) for row in cells),
    )


def _parsed(path: Path, named: dict[str, str], cells: tuple[str, ...]) -> TableRow | None:
    """What a row holds; None for one of another boat, or of a time instead of a frame."""
    try:
        if named.get("target", "").strip() and float(named["target"]) == 0.0:
            return None
        frame = named["frame"].strip()
        if not frame:
            return None
        x1, y1, x2, y2 = (float(named[name]) for name in _CORNERS)
        sure = named.get("confidence", "").strip()
        confidence = float(sure) if sure else 1.0
        number = int(float(frame))
    except (ValueError, OverflowError, KeyError) as error:
        raise InputError(f"{path}: {','.join(cells)[:80]} is no row of a box") from error
    if not all(map(math.isfinite, (x1, y1, x2, y2))):
        raise InputError(f"{path}: {','.join(cells)[:80]} is no row of a box")
    annotator = text_of_cell(named.get("annotator", "").strip())
    return TableRow(number, (x1, y1, x2, y2), annotator, confidence, cells)
