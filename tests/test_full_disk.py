from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from full_disk import room_for
from sightline.errors import InputError, OutputError
from sightline.formats import write_boxes, write_fixes, write_tracks
from sightline.geodesy import LocalPlane
from sightline.types import Boxes, Fixes, Frame, Track
from sightline.video import write_video

N = 3000


def a_track() -> Track:
    times = 1.6e9 + np.arange(N, dtype=float)
    covariance = np.tile(np.eye(2), (N, 1, 1))
    column = np.zeros(N)
    kind = np.zeros(N, dtype=np.int8)
    plane = LocalPlane(0.0, 0.0)
    return Track(1, times, column, column, column, column, covariance, covariance, kind, plane)


def noise() -> Iterator[Frame]:
    rng = np.random.default_rng(0)
    for index in range(60):
        yield Frame(index, index / 10.0, rng.integers(0, 255, (120, 160, 3), dtype=np.uint8))


@pytest.mark.parametrize("name", ["a.csv", "a.geojson", "a.gpx", "a.kml", "a.parquet", "a.gpkg"])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 0.6, 0.7, 0.8, 0.9, 0.99])
def test_tracks(tmp_path: Path, name: str, share: float) -> None:
    """Wherever the disk is full: GDAL leaves out the index of points without a word."""
    path = tmp_path / name
    write_tracks([a_track()], path)
    whole_bytes = path.stat().st_size
    path.write_text("older")
    with (
        pytest.raises(OutputError, match=rf"/{name}: cannot be written: "),
        room_for(int(share * whole_bytes)),
    ):
        write_tracks([a_track()], path)
    assert path.read_text() == "older"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", ["a.csv", "a.gpx"])
def test_fixes(tmp_path: Path, name: str) -> None:
    fixes = Fixes(np.arange(N), np.zeros(N), np.zeros(N))
    with pytest.raises(InputError, match=f"{name}: cannot be written"), room_for(20_000):
        write_fixes(fixes, tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["a.csv", "a.txt"])
def test_boxes(tmp_path: Path, name: str) -> None:
    boxes = Boxes.of(np.tile([0.0, 0.0, 1.0, 1.0], (N, 1)), frame=np.arange(N))
    with pytest.raises(InputError, match=f"{name}: cannot be written"), room_for(20_000):
        write_boxes(boxes, tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_video(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a\.mp4: cannot be written"), room_for(20_000):
        write_video(tmp_path / "a.mp4", noise())
    assert list(tmp_path.iterdir()) == []
