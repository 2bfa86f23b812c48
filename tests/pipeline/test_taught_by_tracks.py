"""A camera without a log of its own, calibrated by the tracks of calibrated neighbours."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from _support.fleet import DETECTOR, place_errors, write_scene

from sightline.errors import InputError
from sightline.formats import holds_tracks, read_track_logs, write_boxes, write_tracks
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.pipeline.check import check
from sightline.pipeline.fit_unlabelled import fit_scene
from sightline.scene import Scene
from sightline.simulation import Harbour, SeveralSettings, harbours
from sightline.types import NO_TRACK, FusedTrack


def neighbours_tracks(harbour: Harbour, sigma_m: float, seed: int = 0) -> list[FusedTrack]:
    """What calibrated neighbours would say of each boat: errors that last for half a minute."""
    rng = np.random.default_rng(seed)
    times = harbour.times(1.0)
    out = []
    for boat in harbour.boats:
        truth = harbour.truth(times, [boat])
        knots = rng.normal(size=(2, 1 + int(harbour.duration_s / 30.0) + 1))
        at = (times - times[0]) / 30.0
        off = [sigma_m * np.interp(at, np.arange(own.size), own) for own in knots]
        n = times.size
        out.append(
            FusedTrack(
                track_id=boat.identity,
                time_utc_s=times,
                east_m=truth.east_m + off[0],
                north_m=truth.north_m + off[1],
                velocity_east_mps=truth.velocity_east_mps,
                velocity_north_mps=truth.velocity_north_mps,
                covariance_m2=np.tile(sigma_m**2 * np.eye(2), (n, 1, 1)),
                velocity_covariance_m2ps2=np.tile(0.1 * np.eye(2), (n, 1, 1)),
                kind=np.zeros(n, dtype=np.int8),
                plane=harbour.plane,
                moored=np.full(n, not boat.path.moves),
            )
        )
    return out


@pytest.fixture(scope="module")
def harbour() -> Harbour:
    return harbours(4, SeveralSettings(cameras=1, vessels=6, duration_s=120.0))[0]


def scene(folder: Path, harbour: Harbour, tracks: list[FusedTrack], suffix: str = ".csv") -> Path:
    boxes = harbour.boxes(harbour.times(5.0), noise=DETECTOR, of="all")
    boxes = boxes.with_columns(track_id=np.full(len(boxes), NO_TRACK))
    write_boxes(boxes, folder / "detections.csv")
    write_tracks(tracks, folder / f"fused{suffix}", fused=True)
    path = folder / "scene.toml"
    write_scene(harbour, path, f'detections = "detections.csv"\nfixes = "fused{suffix}"\n')
    return path


def fitted(folder: Path, harbour: Harbour, sigma_m: float, suffix: str = ".csv") -> Georeferencer:
    path = scene(folder, harbour, neighbours_tracks(harbour, sigma_m), suffix)
    return fit_scene(Scene.load(path), "camera", detector=None)


@pytest.mark.slow
def test_neighbours_tracks_teach_a_camera(tmp_path: Path, harbour: Harbour) -> None:
    exact, unsure = (tmp_path / name for name in ("exact", "unsure"))
    exact.mkdir()
    unsure.mkdir()
    good = fitted(exact, harbour, 0.5, ".parquet")
    worse = fitted(unsure, harbour, 5.0)
    assert np.sqrt(np.mean(place_errors(harbour, good, 1) ** 2)) < 6.0
    said = " ".join(worse.report.statements)
    assert "Taught by the tracks of other cameras" in said
    assert "± 5.0 m" in said
    assert "gaps of the log" not in said
    # What the neighbours do not know, the camera does not know either.
    box = np.array([[600.0, 380.0, 640.0, 400.0]])
    spread = [model.locate(box, source="detector").covariance_m2[0] for model in (good, worse)]
    assert np.linalg.det(spread[1]) > 1.5 * np.linalg.det(spread[0])


def test_a_file_of_tracks_is_a_log_of_what_moves(tmp_path: Path, harbour: Harbour) -> None:
    tracks = neighbours_tracks(harbour, 3.0)
    loaded = Scene.load(scene(tmp_path, harbour, tracks))
    logs = loaded.recordings[0].logs()
    assert len(logs) == sum(boat.path.moves for boat in harbour.boats)
    assert logs[0].sigma_m == pytest.approx(3.0)
    with pytest.raises(InputError, match="nobody says which is of the target"):
        loaded.recordings[0].fixes()
    looked = check(tmp_path / "scene.toml")
    assert f"{len(logs)} vessels" in str(looked.to_dict())
    # A run scores what it has found against a log.
    assert "no run is scored against them" in str(looked.to_dict())


def test_tracks_that_teach_nothing_are_refused(tmp_path: Path, harbour: Harbour) -> None:
    tracks = neighbours_tracks(harbour, 3.0)
    path = tmp_path / "tracks.csv"
    still = [replace(one, moored=np.ones(len(one), dtype=bool)) for one in tracks]
    write_tracks(still, path)
    with pytest.raises(InputError, match="no target in these tracks moves"):
        read_track_logs(path)
    unsure = [replace(one, covariance_m2=np.full((len(one), 2, 2), np.nan)) for one in tracks]
    write_tracks(unsure, path)
    with pytest.raises(InputError, match="does not say how unsure it is"):
        read_track_logs(path)


def test_logs_are_no_tracks(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("time_utc,latitude_deg,longitude_deg\n2024-06-01T10:00:00Z,54.0,10.0\n")
    assert not holds_tracks(log)
    sentences = tmp_path / "log.nmea"
    sentences.write_text("$GPRMC,\n")
    assert not holds_tracks(sentences)
