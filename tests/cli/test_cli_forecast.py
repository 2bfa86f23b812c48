from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sightline import load
from sightline.formats import read_tracks
from sightline.pipeline.track import TrackSettings, iter_tracks
from sightline.scene import Scene
from sightline.types import PointKind, Track

Command = Callable[..., "object"]


def _options(harbour: Path) -> list[object]:
    clock = ["--clock", harbour / "clock" / "01.csv"]
    return ["--model", harbour / "camera.safetensors", *clock]


def test_forecasts_go_into_a_layer_of_their_own(
    sightline: Command, harbour: Path, tmp_path: Path
) -> None:
    boxes = harbour / "boxes" / "01.csv"
    outputs = [tmp_path / "tracks.geojson", tmp_path / "tracks.csv"]
    told = tmp_path / "result.json"
    got = sightline(
        *("track", boxes, *_options(harbour), "-o", outputs[0], "-o", outputs[1]),
        *("--forecast", 30, "--json", told),
    )
    assert got.status == 0, got.err
    (track,) = read_tracks(outputs[0])
    for suffix in (".geojson", ".csv"):
        path = tmp_path / f"tracks-forecast{suffix}"
        assert str(path) in json.loads(told.read_text())["forecasts"]
        (ahead,) = read_tracks(path)
        assert ahead.track_id == track.track_id
        assert (ahead.kind == PointKind.EXTRAPOLATED).all()
        lags = ahead.time_utc_s - track.time_utc_s[-1]
        np.testing.assert_allclose(lags, np.arange(5.0, 31.0, 5.0), atol=2e-3)
        assert (np.diff(np.trace(ahead.covariance_m2, axis1=1, axis2=2)) > 0.0).all()


def test_without_being_asked_nothing_is_forecast(
    sightline: Command, harbour: Path, tmp_path: Path
) -> None:
    boxes = harbour / "boxes" / "01.csv"
    assert sightline("track", boxes, *_options(harbour), "-o", tmp_path / "t.csv").status == 0
    assert [path.name for path in tmp_path.glob("t*")] == ["t.csv"]


@pytest.mark.parametrize("seconds", ["0", "-5", "nan", "inf"])
def test_a_forecast_over_no_time_is_refused(
    sightline: Command, harbour: Path, tmp_path: Path, seconds: str
) -> None:
    boxes = harbour / "boxes" / "01.csv"
    options = [*_options(harbour), "-o", tmp_path / "t.csv", "--forecast", seconds]
    got = sightline("track", boxes, *options)
    assert got.status == 2
    assert "forecast_s" in got.err
    assert not list(tmp_path.glob("t*.csv"))


def test_forecasts_do_not_overwrite_what_they_are_made_from(
    sightline: Command, harbour: Path
) -> None:
    boxes = harbour / "boxes" / "01.csv"
    source = boxes.rename(boxes.with_name("t-forecast.csv"))
    before = source.read_bytes()
    options = [*_options(harbour), "-o", source.with_name("t.csv"), "--forecast", "10"]
    got = sightline("track", source, *options)
    assert got.status == 2
    assert "is read by this command" in got.err
    assert source.read_bytes() == before


def test_evaluate_scores_forecasts(sightline: Command, harbour: Path, tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    model = ["--model", harbour / "camera.safetensors"]
    got = sightline("evaluate", harbour / "scene.toml", *model, "--forecast", "--json", report)
    assert got.status == 0, got.err
    assert "forecast over 10 s: " in got.out
    written = json.loads(report.read_text())
    assert list(written["forecast"]) == ["5", "10", "30", "60"]
    ten = written["forecast"]["10"]
    assert ten["n"] > 0
    assert 0.0 < ten["median"] <= ten["p90"]
    assert 0.0 <= ten["coverage_p95"] <= 1.0
    assert sum(r["forecast"]["10"]["n"] for r in written["recordings"].values()) == ten["n"]


def test_smoothed_tracks_are_no_forecasts(
    sightline: Command, harbour: Path, tmp_path: Path
) -> None:
    boxes = harbour / "boxes" / "01.csv"
    sightline("track", boxes, *_options(harbour), "-o", tmp_path / "t.csv")
    fixes = ["--fixes", harbour / "target.gpx"]
    got = sightline("evaluate", tmp_path / "t.csv", *fixes, "--forecast")
    assert got.status == 2
    assert "what came after" in got.err


def test_forecasts_come_with_each_track_from_python(harbour: Path) -> None:
    model = load(harbour / "camera.safetensors")
    boxes = Scene.load(harbour / "scene.toml").recordings[0].boxes()
    ahead: list[Track] = []
    made = list(
        iter_tracks(boxes, model, settings=TrackSettings(forecast_s=12.0), forecasts=ahead.append)
    )
    assert [track.track_id for track in made] == [track.track_id for track in ahead]
    assert all(len(track) == 2 for track in ahead)
