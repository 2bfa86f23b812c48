"""What live keeps: one SQLite file, which survives a program that is killed.

The schema, version 2 (``PRAGMA user_version``; ``application_id`` 0x53474C54). Times are whole
microseconds since the epoch, UTC, by the clock that `Moment` says; places WGS 84; variances and
covariance m², east and north.

======== ==========================================================================================
meta     key, value: ``camera``, ``latitude_deg`` and ``longitude_deg`` of the plane's origin,
         ``highest_id``, ``state`` (JSON, what identities are carried on with after a restart)
target   id, first_us, last_us, label, mmsi, name, match: one row a target
point    time_us, target_id, latitude_deg, longitude_deg, east_m2, east_north_m2, north_m2,
         speed_mps, course_deg, state (0 measured, 1 predicted, 2 moored), capture (0 sender,
         1 arrival): what was published
smoothed target_id, time_us, latitude_deg, longitude_deg, east_m2, east_north_m2, north_m2,
         velocity_east_mps, velocity_north_mps, kind (a `PointKind`), final (0 or 1): the track a
         few seconds behind, and what replaces it once the target has gone
event    time_us, target_id, kind, boundary, direction, probability, speed_mps: what targets did at
         lines and in zones (since version 2)
passage  time_us, target_id, mmsi, model, east_m, north_m, velocity_east_mps, velocity_north_mps,
         off_east_m, off_north_m, east_m2, east_north_m2, north_m2, x1_px, y1_px, x2_px, y2_px,
         source: a target beside what its vessel reported, an `AisCheck` (since version 2)
======== ==========================================================================================

The file is in WAL mode with ``synchronous=NORMAL``: what was committed outlives the program, though
not a power cut. Readers are short, since one that stays in a transaction lets the log grow.
"""

from __future__ import annotations

import json
import os
import sqlite3
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import IO
from urllib.parse import quote

import numpy as np

from sightline.atomic import locked
from sightline.errors import InputError, OutputError
from sightline.geodesy import LocalPlane
from sightline.live.ais_check import AisCheck
from sightline.live.state import SmoothedPart
from sightline.moment import Alert, CaptureClock, Moment, State, TargetState
from sightline.types import LARGEST_MMSI, FusedTrack, PointKind

SCHEMA_VERSION = 2
_APPLICATION_ID = 0x53474C54
_STATES: tuple[State, ...] = ("measured", "predicted", "moored")
_CAPTURES: tuple[CaptureClock, ...] = ("sender", "arrival")
_MOST_TARGETS = 2000
_DAY_US = 86_400_000_000
_CHECKS_US = 30 * _DAY_US
_DELETED_AT_ONCE = 5000
# Metres, metres a second and square metres: more is no vessel's, and its square no number.
_LARGEST = 1e15

_Measure = float | None
_PointRow = tuple[
    int,
    int,
    float,
    float,
    float,
    float,
    float,
    _Measure,
    _Measure,
    int,
    int,
    int | None,
    str | None,
    _Measure,
    str | None,
]

Row = Alert | AisCheck
"""What is kept besides moments."""

_SCHEMA = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT) WITHOUT ROWID;
CREATE TABLE target (
    id INTEGER PRIMARY KEY, first_us INTEGER NOT NULL, last_us INTEGER NOT NULL,
    label TEXT NOT NULL DEFAULT '', mmsi INTEGER, name TEXT, match REAL
);
CREATE TABLE point (
    time_us INTEGER NOT NULL, target_id INTEGER NOT NULL,
    latitude_deg REAL NOT NULL, longitude_deg REAL NOT NULL,
    east_m2 REAL NOT NULL, east_north_m2 REAL NOT NULL, north_m2 REAL NOT NULL,
    speed_mps REAL, course_deg REAL, state INTEGER NOT NULL, capture INTEGER NOT NULL,
    PRIMARY KEY (time_us, target_id)
) WITHOUT ROWID;
CREATE TABLE smoothed (
    target_id INTEGER NOT NULL, time_us INTEGER NOT NULL,
    latitude_deg REAL NOT NULL, longitude_deg REAL NOT NULL,
    east_m2 REAL NOT NULL, east_north_m2 REAL NOT NULL, north_m2 REAL NOT NULL,
    velocity_east_mps REAL NOT NULL, velocity_north_mps REAL NOT NULL,
    kind INTEGER NOT NULL, final INTEGER NOT NULL,
    PRIMARY KEY (target_id, time_us)
) WITHOUT ROWID;
"""
_SCHEMA_2 = """
CREATE TABLE event (
    time_us INTEGER NOT NULL, target_id INTEGER NOT NULL, kind TEXT NOT NULL,
    boundary TEXT NOT NULL, direction TEXT, probability REAL NOT NULL, speed_mps REAL
);
CREATE INDEX event_time ON event (time_us);
CREATE TABLE passage (
    time_us INTEGER NOT NULL, target_id INTEGER NOT NULL, mmsi INTEGER NOT NULL,
    model TEXT NOT NULL, east_m REAL NOT NULL, north_m REAL NOT NULL,
    velocity_east_mps REAL NOT NULL, velocity_north_mps REAL NOT NULL,
    off_east_m REAL NOT NULL, off_north_m REAL NOT NULL,
    east_m2 REAL NOT NULL, east_north_m2 REAL NOT NULL, north_m2 REAL NOT NULL,
    x1_px REAL NOT NULL, y1_px REAL NOT NULL, x2_px REAL NOT NULL, y2_px REAL NOT NULL,
    source TEXT NOT NULL, PRIMARY KEY (time_us, target_id, mmsi)
) WITHOUT ROWID;
"""


class Store:
    """The store of a camera, open for writing by one thread; see the module for the schema."""

    def __init__(
        self, path: str | os.PathLike[str], *, camera: str, plane: LocalPlane, model: str = ""
    ) -> None:
        """Open a store, or make it.

        Args:
            path: The file.
            camera: Name of the camera.
            plane: The plane of its tracks.
            model: Tells the model from others, since what AIS says holds for one alone.

        Raises:
            InputError: The file is something else, of a newer version, or cannot be written.
        """
        self.path, self.model = Path(path), model
        self._lock = _only_writer(self.path)
        try:
            made = not self.path.exists() or self.path.stat().st_size == 0
            if not made:
                check_store(self.path)
            # One thread writes at a time; which one is the caller's affair.
            self._file = sqlite3.connect(self.path, timeout=5.0, check_same_thread=False)
            if made:
                self._file.execute("PRAGMA auto_vacuum = INCREMENTAL")
            self._file.execute("PRAGMA journal_mode = WAL")
            self._file.execute("PRAGMA synchronous = NORMAL")
            if made:
                self._file.executescript(
                    f"BEGIN; {_SCHEMA} {_SCHEMA_2} "
                    f"PRAGMA application_id = {_APPLICATION_ID};"
                    f"PRAGMA user_version = {SCHEMA_VERSION}; COMMIT;"
                )
            elif self._file.execute("PRAGMA user_version").fetchone() == (1,):
                self._file.executescript(
                    f"BEGIN; {_SCHEMA_2} PRAGMA user_version = {SCHEMA_VERSION}; COMMIT;"
                )
            with self._file:
                self._put("camera", camera)
                self._put("latitude_deg", repr(plane.latitude_deg))
                self._put("longitude_deg", repr(plane.longitude_deg))
        except (sqlite3.Error, OSError) as error:
            raise OutputError(f"{path}: cannot be written as a store: {error}") from error

    def highest_id(self) -> int:
        """The highest number that a target ever had; 0 where there was none."""
        (told,) = self._file.execute("SELECT max(id) FROM target").fetchone()
        return max(int(told or 0), int(self._get("highest_id") or 0))

    def kept_state(self) -> dict[str, object]:
        """What identities are carried on with; empty where there is nothing."""
        with suppress(ValueError):
            told = json.loads(self._get("state") or "{}")
            if isinstance(told, dict):
                return told
        return {}

    def keep(
        self,
        moments: Sequence[Moment],
        parts: Sequence[SmoothedPart] = (),
        state: dict[str, object] | None = None,
        rows: Sequence[Row] = (),
    ) -> None:
        """Keep moments, smoothed parts and rows; they are kept once this returns, all or none.

        Raises:
            sqlite3.Error: They cannot be written.
        """
        with self._file:
            for moment in moments:
                self._keep_moment(moment)
            for part in parts:
                self._keep_part(part)
            for row in rows:
                self._keep_row(row)
            if state is not None:
                self._put("state", json.dumps(state))

    def forget(self, before_utc_s: float) -> int:
        """Remove whole days that ended before a time; returns how many points they had.

        Raises:
            sqlite3.Error: They cannot be removed.
        """
        until_us = int(before_utc_s * 1e6) // _DAY_US * _DAY_US
        removed = 0
        with self._file:
            self._put("highest_id", str(self.highest_id()))
        for table, key in (("point", "time_us, target_id"), ("smoothed", "target_id, time_us")):
            while True:
                # In parts, so that nobody waits for long.
                with self._file:
                    done = self._file.execute(
                        f"DELETE FROM {table} WHERE ({key}) IN "  # noqa: S608 - names of ours
                        f"(SELECT {key} FROM {table} WHERE time_us < ? LIMIT {_DELETED_AT_ONCE})",
                        (until_us,),
                    ).rowcount
                removed += done if table == "point" else 0
                if done < _DELETED_AT_ONCE:
                    break
        with self._file:
            for table, column in (("target", "last_us"), ("event", "time_us")):
                self._file.execute(
                    f"DELETE FROM {table} WHERE {column} < ?",  # noqa: S608 - names of ours
                    (until_us,),
                )
            # A model is judged over days that are longer than a short retention.
            self._file.execute("DELETE FROM passage WHERE time_us < ?", (until_us - _CHECKS_US,))
        self._file.execute("PRAGMA incremental_vacuum").fetchall()
        return removed

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        self._lock.close()

    def _keep_moment(self, moment: Moment) -> None:
        time_us = _microseconds(moment.time_utc_s)
        capture = _CAPTURES.index(moment.capture)
        points, targets = [], []
        for one in moment.targets:
            covariance = np.asarray(one.covariance_m2)
            points.append(
                (
                    *(time_us, one.id, one.latitude_deg, one.longitude_deg),
                    *(float(covariance[i, j]) for i, j in ((0, 0), (0, 1), (1, 1))),
                    *(one.speed_mps, one.course_deg, _STATES.index(one.state), capture),
                )
            )
            targets.append((one.id, time_us, time_us, one.mmsi, one.name, one.match))
        self._file.executemany(
            "INSERT OR REPLACE INTO point VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", points
        )
        self._file.executemany(
            "INSERT INTO target (id, first_us, last_us, mmsi, name, match) "
            "VALUES (?, ?, ?, ?, ?, ?) ON CONFLICT (id) DO UPDATE SET "
            "last_us = max(last_us, excluded.last_us), mmsi = coalesce(excluded.mmsi, mmsi), "
            "name = coalesce(excluded.name, name), match = coalesce(excluded.match, match)",
            targets,
        )

    def _keep_part(self, part: SmoothedPart) -> None:
        track = part.track
        if not len(track):
            return
        times = [_microseconds(time) for time in track.time_utc_s.tolist()]
        if part.final:
            self._file.execute(
                "DELETE FROM smoothed WHERE target_id = ? AND time_us BETWEEN ? AND ?",
                (track.track_id, times[0], times[-1]),
            )
        covariance = track.covariance_m2
        columns = zip(
            times,
            *(track.latitude_deg.tolist(), track.longitude_deg.tolist()),
            *(covariance[:, i, j].tolist() for i, j in ((0, 0), (0, 1), (1, 1))),
            *(track.velocity_east_mps.tolist(), track.velocity_north_mps.tolist()),
            track.kind.tolist(),
            strict=True,
        )
        rows = [(track.track_id, *row, int(part.final)) for row in columns]
        self._file.executemany(
            "INSERT OR REPLACE INTO smoothed VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", rows
        )
        self._file.execute(
            "INSERT INTO target (id, first_us, last_us, label) VALUES (?, ?, ?, ?) "
            "ON CONFLICT (id) DO UPDATE SET label = excluded.label",
            (track.track_id, times[0], times[-1], track.label),
        )

    def _keep_row(self, row: Row) -> None:
        time_us = _microseconds(row.time_utc_s)
        if isinstance(row, Alert):
            told = (time_us, row.target_id, row.kind, row.boundary, row.direction)
            self._file.execute(
                "INSERT INTO event VALUES (?, ?, ?, ?, ?, ?, ?)",
                (*told, row.probability, row.speed_mps),
            )
            return
        numbers = (*row.place_m, *row.velocity_mps, *row.off_m, *row.covariance_m2)
        key = (time_us, row.target_id, row.mmsi, self.model)
        self._file.execute(
            "INSERT OR REPLACE INTO passage VALUES "
            "(?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (*key, *numbers, *row.box_xyxy_px, row.source),
        )

    def checks(self) -> list[AisCheck]:
        """What AIS said of the model that is watched with, in the order of time."""
        rows = self._file.execute(
            "SELECT * FROM passage WHERE model = ? ORDER BY time_us", (self.model,)
        ).fetchall()
        return [
            AisCheck(
                time_utc_s=row[0] * 1e-6,
                target_id=row[1],
                mmsi=row[2],
                place_m=row[4:6],
                velocity_mps=row[6:8],
                off_m=row[8:10],
                covariance_m2=row[10:13],
                box_xyxy_px=row[13:17],
                source=row[17],
            )
            for row in rows
        ]

    def _put(self, key: str, value: str) -> None:
        self._file.execute("INSERT OR REPLACE INTO meta VALUES (?, ?)", (key, value))

    def _get(self, key: str) -> str | None:
        row = self._file.execute("SELECT value FROM meta WHERE key = ?", (key,)).fetchone()
        return None if row is None else str(row[0])


def _only_writer(path: Path) -> IO[bytes]:
    """A lock that ends with the program: two that write would give the same numbers twice.

    It is on a file beside the store, since closing a file of SQLite's own ends SQLite's locks.

    Raises:
        InputError: Another program has it.
    """
    try:
        file = path.with_name(f"{path.name}-lock").open("ab")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written as a store: {error.strerror}") from error
    try:
        free = locked(file.fileno())
    except OSError:
        # A disk without locks tells nobody apart.
        free = True
    if not free:
        file.close()
        raise InputError(
            f"{path}: is being written to by another sightline live; give each camera its own"
        )
    return file


def check_store(path: Path) -> None:
    """Raise InputError where a file is no store that is known.

    Raises:
        InputError: It is missing, something else, or of a newer version.
    """
    if not path.is_file():
        raise InputError(f"{path}: there is no such store; sightline live writes one (--store)")
    try:
        with closing(_reader(path)) as file:
            (own,) = file.execute("PRAGMA application_id").fetchone()
            (version,) = file.execute("PRAGMA user_version").fetchone()
    except sqlite3.OperationalError as error:
        raise InputError(f"{path}: cannot be read ({error})") from error
    except sqlite3.Error as error:
        raise InputError(f"{path}: is no store of sightline live ({error})") from error
    if own != _APPLICATION_ID:
        raise InputError(f"{path}: is no store of sightline live, but another SQLite file")
    if version > SCHEMA_VERSION:
        raise InputError(
            f"{path}: is a store of version {version}, and this sightline knows version "
            f"{SCHEMA_VERSION}; use a newer one"
        )


def _reader(path: Path) -> sqlite3.Connection:
    """A connection that reads, for a moment.

    SQLite reads a store with a log of writes by a map of it, which it leaves beside the store where
    none was. Without a log nobody writes: then the file alone is all there is, and nothing is made.
    """
    alone = not os.path.exists(f"{os.fspath(path)}-wal")
    mode = "mode=ro&immutable=1" if alone else "mode=ro"
    address = f"file:{quote(os.path.abspath(path))}?{mode}"
    return sqlite3.connect(address, uri=True, timeout=5.0)


def stored_tracks(
    path: Path, from_utc_s: float | None = None, to_utc_s: float | None = None
) -> Iterator[FusedTrack]:
    """Tracks of a store, target by target: smoothed as far as they are, then as published.

    They say which vessel AIS took each for, and that the camera saw it where it was measured.

    Args:
        path: The store; it may be written to at the same time.
        from_utc_s: POSIX seconds; None: from the beginning.
        to_utc_s: POSIX seconds, not included; None: to the end.

    Raises:
        InputError: It is no store, or is damaged.
    """
    check_store(path)
    low = -(2**62) if from_utc_s is None else _microseconds(from_utc_s)
    high = 2**62 if to_utc_s is None else _microseconds(to_utc_s)
    try:
        with closing(_reader(path)) as file:
            meta = dict(file.execute("SELECT key, value FROM meta").fetchall())
            plane = LocalPlane(float(meta["latitude_deg"]), float(meta["longitude_deg"]))
            targets = file.execute(
                "SELECT id, label, name, mmsi FROM target WHERE last_us >= ? AND first_us < ? "
                "ORDER BY id",
                (low, high),
            ).fetchall()
        camera = meta.get("camera") or ""
        for number, label, name, mmsi in targets:
            # A transaction a target: a reader that stays lets the log grow.
            with closing(_reader(path)) as file:
                track = _track(file, int(number), plane, (low, high))
            if track is not None:
                seen = np.where(track.kind == PointKind.MEASURED, camera, "")
                yield replace(
                    track,
                    cameras=seen,
                    label=str(name or label),
                    name=str(name or ""),
                    mmsi=_mmsi(mmsi),
                )
    except (sqlite3.Error, LookupError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path}: is damaged, or no store of sightline live ({error})") from error


class KeptMoments:
    """What was published, read from a store that may be written to at the same time.

    Each answer is read in transactions of one moment, since a reader that stays lets the log grow.
    """

    def __init__(self, path: Path) -> None:
        """Take a store.

        Args:
            path: The file; it is only read.
        """
        self._path = path

    def extent_utc_s(self) -> tuple[float, float] | None:
        """Times of the first and the last moment with a target; None where there is none.

        Raises:
            InputError: The store cannot be read.
        """
        with _readable(self._path) as file:
            first, last = file.execute("SELECT min(time_us), max(time_us) FROM point").fetchone()
        return None if first is None else (first * 1e-6, last * 1e-6)

    def moments(self, from_utc_s: float, seconds: float, step_s: float = 1.0) -> list[Moment]:
        """Moments of a part of the time, one a step: the last that was published in it.

        Args:
            from_utc_s: POSIX seconds.
            seconds: How long the part is.
            step_s: How far apart moments are; steps in which nothing was published have none.

        Raises:
            InputError: The store cannot be read.
        """
        found = []
        with _readable(self._path) as file:
            told = file.execute("SELECT value FROM meta WHERE key = 'camera'").fetchone()
            camera = str(told[0]) if told else ""
            for k in range(int(np.ceil(seconds / step_s))):
                low, high = (_microseconds(from_utc_s + n * step_s) for n in (k, k + 1))
                rows = file.execute(
                    "SELECT time_us, target_id, latitude_deg, longitude_deg, east_m2, "
                    "east_north_m2, north_m2, speed_mps, course_deg, state, capture, mmsi, name, "
                    "match, label FROM point LEFT JOIN target ON target.id = target_id "
                    "WHERE time_us = (SELECT max(time_us) FROM point WHERE time_us >= ? "
                    "AND time_us < ?) LIMIT ?",
                    (low, high, _MOST_TARGETS),
                ).fetchall()
                if rows:
                    found.append(_moment(camera, rows))
        return found


def _moment(camera: str, rows: Sequence[_PointRow]) -> Moment:
    targets = tuple(
        TargetState(
            id=row[1],
            latitude_deg=row[2],
            longitude_deg=row[3],
            covariance_m2=np.array([[row[4], row[5]], [row[5], row[6]]]),
            speed_mps=row[7],
            course_deg=row[8],
            state=_STATES[row[9]],
            mmsi=row[11],
            name=row[12],
            match=row[13],
            label=str(row[14] or ""),
        )
        for row in rows
    )
    return Moment(rows[0][0] * 1e-6, _CAPTURES[rows[0][10]], camera, targets)


@contextmanager
def _readable(path: Path) -> Iterator[sqlite3.Connection]:
    """A connection that can only read, without a transaction that stays.

    Raises:
        InputError: It is no store, or is damaged.
    """
    try:
        with closing(_reader(path)) as file:
            yield file
    except (sqlite3.Error, LookupError, TypeError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error})") from error


def _track(
    file: sqlite3.Connection, number: int, plane: LocalPlane, between: tuple[int, int]
) -> FusedTrack | None:
    smoothed = file.execute(
        "SELECT time_us, latitude_deg, longitude_deg, east_m2, east_north_m2, north_m2, "
        "velocity_east_mps, velocity_north_mps, kind FROM smoothed "
        "WHERE target_id = ? AND time_us >= ? AND time_us < ? ORDER BY time_us",
        (number, *between),
    ).fetchall()
    after = smoothed[-1][0] + 1 if smoothed else between[0]
    first, last = file.execute(
        "SELECT first_us, last_us FROM target WHERE id = ?", (number,)
    ).fetchone()
    published = file.execute(
        "SELECT time_us, latitude_deg, longitude_deg, east_m2, east_north_m2, north_m2, "
        "speed_mps, course_deg, state "
        "FROM point WHERE time_us >= ? AND time_us < ? AND target_id = ? ORDER BY time_us",
        (max(after, first), min(between[1], last + 1), number),
    ).fetchall()
    while published and published[-1][-1] == _STATES.index("predicted"):
        # Where nothing was seen any more, is no end of a track.
        published.pop()
    kinds = {1: PointKind.EXTRAPOLATED}
    rows = list(smoothed)
    for *before, speed_mps, course_deg, state in published:
        course_rad = np.radians(course_deg or 0.0)
        speed_mps = 0.0 if course_deg is None else speed_mps or 0.0
        if not abs(speed_mps) < _LARGEST:
            raise ValueError(f"target {number} has a speed that cannot be")
        velocity = (speed_mps * np.sin(course_rad), speed_mps * np.cos(course_rad))
        rows.append((*before, *velocity, kinds.get(state, PointKind.MEASURED)))
    if not rows:
        return None
    table = np.array(rows, dtype=np.float64)
    east, north = plane.to_plane(table[:, 1], table[:, 2])
    covariance = table[:, [3, 4, 4, 5]].reshape(-1, 2, 2)
    known = np.stack([east, north, table[:, 6], table[:, 7]])
    if not (np.abs(known) < _LARGEST).all() or (np.abs(covariance) >= _LARGEST).any():
        raise ValueError(f"target {number} has a place, a speed or an ellipse that cannot be")
    return FusedTrack(
        track_id=number,
        time_utc_s=table[:, 0] * 1e-6,
        east_m=east,
        north_m=north,
        velocity_east_mps=table[:, 6],
        velocity_north_mps=table[:, 7],
        covariance_m2=covariance,
        velocity_covariance_m2ps2=np.full((len(rows), 2, 2), np.nan),
        kind=table[:, 8].astype(np.int8),
        plane=plane,
    )


def _mmsi(value: object) -> int | None:
    """Of a target; None where AIS told none.

    Raises:
        ValueError: No vessel has such a number.
    """
    if value is not None and not (isinstance(value, int) and 0 < value <= LARGEST_MMSI):
        raise ValueError(f"{value!r} is no MMSI")
    return value


def _microseconds(time_utc_s: float) -> int:
    return round(time_utc_s * 1e6)


class Keeper:
    """Writes to a store in a thread of its own, so that a slow disk holds up nobody.

    Attributes:
        kept_utc_s: Time of the newest moment that is kept; NaN before there is one.
        lost: Moments that were given up, since they could not be written for too long.
        problem: Why nothing can be written; empty where all is well.
    """

    def __init__(
        self,
        store: Store,
        *,
        retention_days: float | None = None,
        most: int = 3000,
        told: Callable[[str], None] | None = None,
    ) -> None:
        """Take the store; `start` begins.

        Args:
            store: Nobody else writes to it from then on.
            retention_days: Whole days that are older are removed; None: all is kept.
            most: How many moments may wait.
            told: Is told when it cannot be written, and when it can again.
        """
        self.kept_utc_s, self.lost, self.problem = float("nan"), 0, ""
        self.change(retention_days)
        self._store, self._told, self._most = store, told, most
        self._changed = threading.Condition()
        self._moments: deque[Moment] = deque()
        self._parts: deque[SmoothedPart] = deque()
        self._rows: deque[Row] = deque()
        self._state: dict[str, object] | None = None
        self._closing = False
        self._thread = threading.Thread(target=self._run, daemon=True, name="sightline-store")

    def change(self, retention_days: float | None) -> None:
        """Remove what is older than so many days, or nothing, from now on."""
        self._retention_s = None if retention_days is None else retention_days * 86_400.0
        self._forget_at_s = 0.0

    def start(self) -> None:
        """Begin to write."""
        self._thread.start()

    def keep(
        self,
        moment: Moment | None,
        parts: Sequence[SmoothedPart] = (),
        state: dict[str, object] | None = None,
        rows: Sequence[Row] = (),
    ) -> None:
        """Hand over what is to be kept; returns at once."""
        with self._changed:
            if moment is not None:
                self._moments.append(moment)
            self._parts.extend(parts)
            self._rows.extend(rows)
            self._state = state or self._state
            while len(self._moments) > self._most:
                self._moments.popleft()
                self.lost += 1
            for waiting in (self._parts, self._rows):
                while len(waiting) > self._most:
                    waiting.popleft()
            self._changed.notify_all()

    def close(self, timeout_s: float = 1.0) -> None:
        """Write what waits, for so long at the most, and close the store."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        try:
            while True:
                with self._changed:
                    if not (self._moments or self._parts or self._rows or self._closing):
                        self._changed.wait(0.5)
                    moments, parts = list(self._moments), list(self._parts)
                    rows, state, closing = list(self._rows), self._state, self._closing
                done = self._write(moments, parts, rows, state)
                if closing and (not done or not (self._moments or self._parts or self._rows)):
                    return
                if done:
                    self._forget()
                if not done:
                    time.sleep(0.5)
        finally:
            self._store.close()

    def _write(
        self,
        moments: list[Moment],
        parts: list[SmoothedPart],
        rows: list[Row],
        state: dict[str, object] | None,
    ) -> bool:
        if not (moments or parts or rows or state):
            return True
        try:
            self._store.keep(moments, parts, state, rows)
        except sqlite3.Error as error:
            if not self.problem:
                self.problem = str(error)
                self._tell(f"{self._store.path}: cannot be written: {error}; tried again")
            return False
        if self.problem:
            self.problem = ""
            self._tell(f"{self._store.path}: is written again; {self.lost} moments were lost")
        with self._changed:
            # Others may have been given up meanwhile, from the same end.
            kept = {id(moment) for moment in moments}
            while self._moments and id(self._moments[0]) in kept:
                self._moments.popleft()
            if self._state is state:
                self._state = None
            written = {id(one) for one in (*parts, *rows)}
            waiting: deque[SmoothedPart] | deque[Row]
            for waiting in (self._parts, self._rows):
                while waiting and id(waiting[0]) in written:
                    waiting.popleft()
        if moments:
            self.kept_utc_s = moments[-1].time_utc_s
        return True

    def _forget(self) -> None:
        now_s = time.time()
        if self._retention_s is None or now_s < self._forget_at_s:
            return
        self._forget_at_s = now_s + 3600.0
        with suppress(sqlite3.Error):
            self._store.forget(now_s - self._retention_s)

    def _tell(self, text: str) -> None:
        if self._told is not None:
            self._told(text)
