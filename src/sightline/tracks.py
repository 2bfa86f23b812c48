"""A set of tracks, with its files."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass

import pandas as pd

from sightline.formats import read_tracks, track_table, write_tracks
from sightline.geodesy import LocalPlane
from sightline.types import Track


@dataclass(frozen=True)
class Tracks:
    """Tracks in a fixed order.

    Attributes:
        tracks: Of any targets, at any times.

    Examples:
        >>> tracks = sightline.Tracks.read("tracks.geojson")
        >>> tracks[0].label
        'sailboat'
        >>> table = tracks.to_dataframe()
        >>> len(table) == sum(len(track) for track in tracks)
        True
    """

    tracks: tuple[Track, ...]

    def __iter__(self) -> Iterator[Track]:
        return iter(self.tracks)

    def __len__(self) -> int:
        return len(self.tracks)

    def __getitem__(self, index: int) -> Track:
        return self.tracks[index]

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the tracks in the format that the file's suffix names; see `sightline.formats`.

        Raises:
            InputError: The ending is unknown, an extra is missing, or the file cannot be written.

        Examples:
            >>> tracks = sightline.Tracks.read("tracks.geojson")
            >>> tracks.write("tracks.gpx")
            >>> tracks.write("tracks.kml")
        """
        write_tracks(self.tracks, path)

    @classmethod
    def read(cls, path: str | os.PathLike[str], *, plane: LocalPlane | None = None) -> Tracks:
        """Read the tracks of a file; see `sightline.formats.read_tracks`.

        Args:
            path: A GeoJSON, GPX, CSV, Parquet or GeoPackage file.
            plane: The plane of the tracks; None: one at the first point.

        Raises:
            InputError: The file cannot be used.

        Examples:
            >>> tracks = sightline.Tracks.read("tracks.geojson")
            >>> len(tracks)
            10
        """
        return cls(read_tracks(path, plane=plane))

    def to_dataframe(self) -> pd.DataFrame:
        """All points of all tracks as a table; ``time_utc`` is aware of UTC."""
        return track_table(self.tracks)
