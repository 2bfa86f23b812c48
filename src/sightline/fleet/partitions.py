"""Tracks of a recording in files by day, as query engines read them: ``day=2026-05-01/NAME``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from sightline.formats import TrackWriter, track_writer
from sightline.types import Track, rfc3339

DAY_S = 86_400.0


class TrackPartitions:
    """Writes each track to the files of the days (UTC) that it is of.

    A track that goes on after midnight goes on in the next day's file, under the same number.
    """

    def __init__(self, folder: Path, name: str) -> None:
        """Nothing is written before `add`.

        Args:
            folder: Of the camera; the files are ``day=YYYY-MM-DD/NAME.parquet`` in it.
            name: Of the recording.
        """
        self._folder = folder
        self._name = name
        self._stack = ExitStack()
        self._open: dict[int, TrackWriter] = {}
        self._paths: dict[int, Path] = {}

    def __enter__(self) -> TrackPartitions:
        self._stack.__enter__()
        return self

    def __exit__(self, *raised: object) -> None:
        self._stack.__exit__(*raised)  # type: ignore[arg-type]

    def add(self, track: Track) -> None:
        """Write a track."""
        for day, part in by_day(track):
            if day not in self._open:
                named = f"day={rfc3339(day * DAY_S)[:10]}"
                self._paths[day] = self._folder / named / f"{self._name}.parquet"
                self._open[day] = self._stack.enter_context(track_writer(self._paths[day]))
            self._open[day].add(part)

    def finish(self) -> list[Path]:
        """Let the files appear; returns them by day."""
        self._stack.close()
        return [self._paths[day] for day in sorted(self._paths)]


def by_day(track: Track) -> Iterator[tuple[int, Track]]:
    """The parts of a track by the day (UTC), which is counted from 1970."""
    days = np.floor(track.time_utc_s / DAY_S).astype(int)
    for day in np.unique(days):
        yield int(day), track[days == day]
