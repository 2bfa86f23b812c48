from __future__ import annotations

import re
import runpy
from pathlib import Path

import pandas as pd
import pytest

import sightline

EXAMPLES = Path(__file__).parents[1] / "examples"


def run(
    name: str, folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> str:
    monkeypatch.setattr("sys.argv", [name, str(folder)])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    return capsys.readouterr().out


def test_every_example_is_run_here() -> None:
    here = Path(__file__).read_text(encoding="utf-8")
    for example in EXAMPLES.glob("*.py"):
        assert f'"{example.name}"' in here


def test_fit_and_locate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = run("fit_and_locate.py", tmp_path, capsys, monkeypatch)
    ranges = [float(r) for r in re.findall(r"(\d+) m away", out)]
    assert len(ranges) == 2
    assert ranges[0] < ranges[1]
    assert out.count("no position") == 1
    assert sightline.load(tmp_path / "model.safetensors").model == "camera+gpr"


def test_write_tracks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = run("write_tracks.py", tmp_path, capsys, monkeypatch)
    tracks = sightline.Tracks.read(tmp_path / "tracks.geojson")
    assert len(tracks) == out.count("track ") > 1
    table = pd.read_csv(tmp_path / "tracks.csv", parse_dates=["time_utc"])
    assert len(table) == sum(len(track) for track in tracks)
    for name in ("tracks.gpx", "tracks.kml"):
        assert (tmp_path / name).stat().st_size > 1000


def test_smooth_a_track(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = run("smooth_a_track.py", tmp_path, capsys, monkeypatch)
    rmse = {name: float(v) for name, v in re.findall(r"^([\w ]+): ([\d.]+) m RMSE", out, re.M)}
    assert rmse["rts"] < rmse["paper"] < rmse["single boxes"]
    kinds = re.findall(r"(measured|interpolated|extrapolated)$", out, re.M)
    assert kinds == ["measured", "interpolated", "extrapolated"]


def test_evaluate_a_track(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = run("evaluate_a_track.py", tmp_path, capsys, monkeypatch)
    compared = re.search(r"(\d+) points compared, ([\d.]+) m RMSE", out)
    assert compared is not None
    assert int(compared[1]) > 100
    assert float(compared[2]) < 20.0
    assert (tmp_path / "report.json").exists()
