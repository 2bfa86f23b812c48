"""What the commands write and print where all is well."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest

from sightline import Georeferencer, Scene, Tracks, load
from sightline.formats import read_boxes, read_fixes, write_boxes
from sightline.simulation.simulate import Simulation, SimulationSettings, simulate
from sightline.types import Boxes

Command = Callable[..., Any]

APE = {"n", "rmse", "mse", "mean", "median", "p90", "max", "per_range"}
RPE = {"delta_s", "rmse", "mse"}
COVERAGE = {"p50", "p95"}
PARTS = {"ape", "rpe", "coverage"}


def numbers(value: object) -> list[float]:
    """All numbers in nested dicts and lists."""
    if isinstance(value, dict):
        return [number for item in value.values() for number in numbers(item)]
    if isinstance(value, list):
        return [number for item in value for number in numbers(item)]
    return [value] if isinstance(value, float) else []


def content(path: Path) -> Any:
    """JSON as the standard has it: without NaN and Infinity."""

    def refuse(word: str) -> float:
        raise AssertionError(f"{word} is no JSON")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


def check_report(report: dict[str, Any], recordings: set[str]) -> None:
    """The layout of a report, and that its numbers agree with each other."""
    assert set(report) >= {*PARTS, "recordings"}
    assert set(report["recordings"]) == recordings
    for part in (report, *report["recordings"].values()):
        assert set(part) >= PARTS
        assert set(part["ape"]) >= APE
        assert set(part["rpe"]) >= RPE
        assert set(part["coverage"]) >= COVERAGE
        ape = part["ape"]
        assert ape["n"] > 0
        assert ape["mse"] == pytest.approx(ape["rmse"] ** 2)
        assert 0.0 <= ape["median"] <= ape["p90"] <= ape["max"]
        assert ape["mean"] <= ape["rmse"] <= ape["max"]
        assert 0.0 <= part["coverage"]["p50"] <= part["coverage"]["p95"] <= 1.0
    assert all(map(math.isfinite, numbers(report)))
    if recordings:
        assert report["ape"]["n"] == sum(r["ape"]["n"] for r in report["recordings"].values())


def test_fit_writes_a_model_that_python_loads(
    sightline: Command, harbour: Path, tmp_path: Path
) -> None:
    out = tmp_path / "new" / "m.safetensors"
    done = sightline(
        "fit", harbour / "scene.toml", "--model", "camera", "-o", out, "--json", tmp_path / "f.json"
    )
    assert (done.status, done.err) == (0, "")
    model = load(out)
    assert isinstance(model, Georeferencer)
    assert model.model == "camera"
    result = content(tmp_path / "f.json")
    assert result["model"] == str(out)
    truth = json.loads((tmp_path / "f.json").read_text())["fit"]
    assert truth["n"] == len(truth["boxes"]) == model.report.n > 50
    assert f"learned from {model.report.n} of {model.report.asked} boxes" in done.out


@pytest.mark.slow
def test_compare_leaves_recordings_out_and_prints_the_table(
    sightline: Command, harbour: Path, tmp_path: Path
) -> None:
    names = {name: tmp_path / f"c.{name}" for name in ("json", "html", "png")}
    done = sightline(
        *("compare", harbour / "scene.toml", "--models", "camera,qkr", "--json", names["json"]),
        *("--report", names["html"], "--map", names["png"]),
    )
    assert (done.status, done.err) == (0, "")
    result = content(names["json"])
    assert list(result["models"]) == ["camera", "qkr"]
    for kind in ("models", "smoothed"):
        for report in result[kind].values():
            check_report(report, {"01", "02", "03"})
    # What a model learned from would be nearer: a quadratic is far off where it saw nothing.
    camera, quadratic = (result["models"][name]["ape"]["rmse"] for name in ("camera", "qkr"))
    assert camera < quadratic
    assert f"{quadratic:.1f}" in done.out
    assert names["html"].read_text().startswith("<!DOCTYPE html>")
    assert cv2.imread(str(names["png"])) is not None


def test_evaluate_a_scene(sightline: Command, harbour: Path, tmp_path: Path) -> None:
    reports = {}
    for flags in ((), ("--smooth",)):
        out = tmp_path / f"{len(flags)}.json"
        done = sightline(
            *("evaluate", harbour / "scene.toml", "--model", harbour / "camera.safetensors"),
            *("--json", out, *flags),
        )
        assert (done.status, done.err) == (0, "")
        reports[flags] = content(out)
        check_report(reports[flags], {"01", "02", "03"})
    assert reports[()]["ape"]["n"] == load(harbour / "camera.safetensors").report.n
    single, smooth = (reports[flags]["rpe"]["rmse"] for flags in ((), ("--smooth",)))
    assert smooth < single


def test_tracks_of_a_table_in_every_format(
    sightline: Command, harbour: Path, tmp_path: Path
) -> None:
    endings = ("geojson", "csv", "gpx", "kml", "parquet", "gpkg")
    files = [tmp_path / "tracks" / f"t.{ending}" for ending in endings]
    done = sightline(
        *("track", harbour / "boxes" / "01.csv", "--model", harbour / "camera.safetensors"),
        *("--clock", harbour / "clock" / "01.csv", "--json", tmp_path / "t.json"),
        *(part for path in files for part in ("-o", path)),
    )
    assert (done.status, done.err) == (0, "")
    result = content(tmp_path / "t.json")
    assert result["tracks"] == 1
    assert result["files"] == list(map(str, files))
    assert sorted(path.name for path in (tmp_path / "tracks").iterdir()) == sorted(
        path.name for path in files
    )
    drawn = Scene.load(harbour / "scene.toml")["01"].boxes()
    for path in files:
        if path.suffix == ".kml":
            assert path.read_text().count("<when>") == result["points"]
            continue
        (track,) = Tracks.read(path)
        assert len(track) == result["points"]
        assert np.isin(np.round(track.time_utc_s, 3), np.round(drawn.time_utc_s, 3)).all()


def test_tracks_against_a_log(sightline: Command, harbour: Path, tmp_path: Path) -> None:
    tracks, out = tmp_path / "t.csv", tmp_path / "e.json"
    boxes, model = harbour / "boxes" / "02.csv", harbour / "camera.safetensors"
    clock = harbour / "clock" / "02.csv"
    sightline("track", boxes, "--model", model, "--clock", clock, "-o", tracks)
    log = harbour / "target.gpx"
    done = sightline("evaluate", tracks, "--fixes", log, "--model", model, "--json", out)
    assert (done.status, done.err) == (0, "")
    with_camera = content(out)
    check_report(with_camera, set())
    assert with_camera["tracks"]["used"] == [1]
    assert "track 1, chosen by smallest median error" in done.out
    sightline("evaluate", tracks, "--fixes", log, "--json", out)
    without = content(out)
    # Tracks do not tell where the camera stands.
    assert without["ape"]["per_range"] is None
    assert without["ape"]["rmse"] == pytest.approx(with_camera["ape"]["rmse"], abs=1e-3)
    ais = sightline(
        *("evaluate", tracks, "--fixes", harbour / "ais.nmea", "--mmsi", 211_000_001),
        *("--track-id", 1),
    )
    assert (ais.status, ais.err) == (0, "")
    assert "chosen by track_id" in ais.out


def test_tracks_of_a_table_keep_its_ids(sightline: Command, harbour: Path, tmp_path: Path) -> None:
    boxes = Scene.load(harbour / "scene.toml")["01"].boxes()
    twin = boxes.with_columns(xyxy_px=boxes.xyxy_px + np.array([30.0, 0.0, 30.0, 0.0]))
    both = Boxes.concatenate(
        [
            boxes.with_columns(track_id=np.full(len(boxes), 7)),
            twin.with_columns(track_id=np.full(len(boxes), 42)),
        ]
    )
    write_boxes(both[np.argsort(both.time_utc_s, kind="stable")], tmp_path / "ids.csv")
    out, model = tmp_path / "t.csv", harbour / "camera.safetensors"
    done = sightline("track", tmp_path / "ids.csv", "--model", model, "-o", out)
    assert (done.status, done.err) == (0, "")
    assert sorted(track.track_id for track in Tracks.read(out)) == [7, 42]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "times"),
    [("boat.mp4", ()), ("boat.mp4", ("--start-utc", "2020-09-30T19:36:24Z")), ("frames", None)],
)
def test_tracks_of_pictures(
    sightline: Command,
    harbour: Path,
    tmp_path: Path,
    source: str,
    times: tuple[str, ...] | None,
) -> None:
    out, model = tmp_path / "t.geojson", harbour / "camera.safetensors"
    clock = ("--clock", harbour / "frames.csv")
    flags = clock if times is None else times
    # A boat of two rectangles is none to a network, but it moves.
    flags = (*flags, "--detector", "motion")
    done = sightline("track", harbour / source, "--model", model, "-o", out, *flags)
    assert (done.status, done.err) == (0, "")
    (track,) = Tracks.read(out)
    start_s = 1_601_494_584.0 if times else 1_700_000_000.0
    assert start_s < track.time_utc_s[0] < track.time_utc_s[-1] < start_s + 4.0
    features = content(out)["features"]
    assert len(features) == len(track)
    assert features[0]["properties"]["time"].endswith("Z")


def test_points_at_an_interval(sightline: Command, harbour: Path, tmp_path: Path) -> None:
    out = tmp_path / "t.csv"
    done = sightline(
        *("track", harbour / "boxes" / "01.csv", "--model", harbour / "camera.safetensors"),
        *("--clock", harbour / "clock" / "01.csv", "-o", out, "--interval", 0.25),
    )
    assert (done.status, done.err) == (0, "")
    (track,) = Tracks.read(out)
    np.testing.assert_allclose(np.diff(track.time_utc_s), 0.25, atol=1.1e-3)


@pytest.mark.slow
def test_run_writes_tracks_model_report_and_map(
    sightline: Command, harbour: Path, tmp_path: Path
) -> None:
    scene = harbour / "scene.toml"
    scene.write_text(
        scene.read_text() + '\n[[recordings]]\nname = "video alone"\nvideo = "boat.mp4"\n'
    )
    out = tmp_path / "results"
    done = sightline("run", scene, "-o", out, "--model", "qkr", "--json", tmp_path / "run.json")
    assert done.status == 0
    # After what was seen there is nothing to complain of.
    assert re.fullmatch(r"seen: recording [^\n]*\n", done.err)
    result = content(tmp_path / "run.json")
    check_report(result, {"01", "02", "03"})
    check_report(result["single"], {"01", "02", "03"})
    check_report(content(out / "report.json"), {"01", "02", "03"})
    assert result["left_out"] == ["01", "02", "03"]
    assert set(result["tracks_per_recording"]) == {"01", "02", "03", "video alone"}
    assert sorted(path.name for path in out.iterdir()) == [
        "map.png",
        "model.safetensors",
        "report.html",
        "report.json",
        "tracks",
    ]
    assert {path.suffix for path in (out / "tracks").iterdir()} == {
        ".csv",
        ".geojson",
        ".gpx",
        ".kml",
    }
    assert load(out / "model.safetensors").model == "qkr"
    assert cv2.imread(str(out / "map.png")) is not None
    page = (out / "report.html").read_text()
    assert "a detector found the boxes" in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert all(Path(path).exists() for path in result["files"].values())


@pytest.mark.slow
def test_run_says_where_pictures_come_too_seldom(
    sightline: Command, harbour: Path, tmp_path: Path
) -> None:
    scene = harbour / "scene.toml"
    (harbour / "slow.csv").write_text("frame,utc\n0,1700000000\n39,1700000156\n")
    scene.write_text(
        scene.read_text()
        + '\n[[recordings]]\nname = "slow"\nframes = "frames"\nclock = "slow.csv"\n'
    )
    result = tmp_path / "r.json"
    done = sightline("run", scene, "-o", tmp_path / "out", "--model", "qkr", "--json", result)
    assert done.status == 0
    # After what was seen there is nothing to complain of.
    assert re.fullmatch(r"seen: recording [^\n]*\n", done.err)
    told = "Nothing is tracked in recording slow: the pictures are 4.0 s apart"
    assert told in done.out
    assert any(told in note for note in content(result)["notes"])
    assert told in (tmp_path / "out" / "report.html").read_text()
    assert content(result)["tracks_per_recording"]["slow"] == 0
    assert "a detector found the boxes" not in (tmp_path / "out" / "report.html").read_text()


def test_run_with_one_recording_says_that_nothing_was_left_out(
    sightline: Command, harbour: Path, tmp_path: Path
) -> None:
    scene = harbour / "scene.toml"
    head, first, *_ = scene.read_text().split("[[recordings]]")
    scene.write_text(f"{head}[[recordings]]{first}")
    result = tmp_path / "r.json"
    done = sightline("run", scene, "-o", tmp_path / "out", "--model", "qkr", "--json", result)
    assert (done.status, done.err) == (0, "")
    assert content(result)["left_out"] == []
    assert "The figures are of the recordings that the model learned from" in done.out


def test_run_replaces_what_an_earlier_one_wrote_and_nothing_else(
    sightline: Command, harbour: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    (out / "tracks").mkdir(parents=True)
    for name in ("report.html", "tracks/01.csv", "tracks/mine.csv"):
        (out / name).write_text("older")
    command = ("run", harbour / "scene.toml", "-o", out, "--model", "qkr")
    done = sightline(*command)
    assert done.status == 2
    assert "report.html: exists and is not a report that sightline wrote" in done.err
    assert {path.read_bytes() for path in out.rglob("*") if path.is_file()} == {b"older"}
    assert sightline(*command, "--overwrite").status == 0
    old = [path.name for path in out.rglob("*") if path.is_file() and path.read_bytes() == b"older"]
    assert old == ["mine.csv"]
    (out / "report.html").touch()
    assert sightline(*command).status == 0
    assert not [path for path in out.rglob("*") if path.name.startswith(".")]


def test_simulate_writes_a_scene(sightline: Command, tmp_path: Path) -> None:
    out = tmp_path / "harbour"
    done = sightline(
        *("simulate", "-o", out, "--no-video", "--recordings", 2, "--duration", 15, "--seed", 4),
        *("--clock", "stepped", "--json", tmp_path / "s.json"),
    )
    assert (done.status, done.err) == (0, "")
    assert content(tmp_path / "s.json") == {
        "scene": str(out / "scene.toml"),
        "recordings": ["01", "02"],
    }
    scene = tomllib.loads((out / "scene.toml").read_text())
    assert [recording["name"] for recording in scene["recordings"]] == ["01", "02"]
    assert len(read_boxes(out / "boxes" / "01.csv")) > 10
    assert len(read_fixes(out / "target.gpx")) > 30


@pytest.mark.slow
def test_demo_runs_the_whole_way(
    sightline: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:

    def small(
        folder: Path, settings: SimulationSettings, *, progress: Callable[[float], None]
    ) -> Simulation:
        less = replace(settings, image_size_px=(320, 180), rate_hz=6.0)
        return simulate(folder, less, progress=progress)

    monkeypatch.setattr(sys.modules["sightline.simulation.simulate"], "simulate", small)
    out = tmp_path / "demo"
    done = sightline("demo", "-o", out, "--duration", 4, "--json", tmp_path / "d.json")
    assert (done.status, done.err) == (0, "")
    report = out / "results" / "report.html"
    assert f"Open {report} in a browser." in done.out
    assert report.exists()
    assert (out / "harbour" / "01.mp4").exists()
    result = content(tmp_path / "d.json")
    assert set(result["single"]["recordings"]) <= {"01", "02"}
    assert set(result["tracks_per_recording"]) == {"01", "02", "03"}


def test_evaluate_tracks_of_others(sightline: Command, harbour: Path, tmp_path: Path) -> None:
    log = read_fixes(harbour / "target.gpx")
    pd.DataFrame(
        {
            "track_id": 5,
            "time_utc": log.time_utc_s,
            "latitude_deg": log.latitude_deg + 10.0 / 111_000.0,
            "longitude_deg": log.longitude_deg,
        }
    ).drop_duplicates("time_utc").to_csv(tmp_path / "mine.csv", index=False)
    out = tmp_path / "e.json"
    fixes = harbour / "target.gpx"
    assert sightline("evaluate", tmp_path / "mine.csv", "--fixes", fixes, "--json", out).status == 0
    result = content(out)
    # A degree of latitude is 110.6 to 111.7 km.
    assert result["ape"]["rmse"] == pytest.approx(10.0, rel=0.01)
    assert result["coverage"]["p95"] is None


def test_boxes_without_height_are_left_out_and_said_once(
    sightline: Command, harbour: Path, tmp_path: Path
) -> None:
    path = harbour / "boxes" / "01.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines, "100,10,20,30,20,annotator"]) + "\n")
    done = sightline(
        *("track", path, "--model", harbour / "camera.safetensors"),
        *("--clock", harbour / "clock" / "01.csv", "-o", tmp_path / "t.csv"),
    )
    assert done.status == 0
    assert done.err == (
        f"warning: {path}: left out: 1 without width or height (line 42: 10,20,30,20)\n"
    )
    (track,) = Tracks.read(tmp_path / "t.csv")
    assert len(track) <= len(lines) - 1


def test_no_command_shows_what_there_is(sightline: Command) -> None:
    done = sightline()
    assert (done.status, done.err) == (2, "")
    assert "compare" in done.out


@pytest.mark.parametrize(("flag", "said"), [("--help", "compare"), ("--version", "sightline 0")])
def test_what_the_command_says_of_itself(sightline: Command, flag: str, said: str) -> None:
    done = sightline(flag)
    assert (done.status, done.err) == (0, "")
    assert said in done.out


@pytest.mark.slow
def test_the_installed_command_refuses_in_one_line(tmp_path: Path) -> None:
    command = Path(sys.executable).with_name("sightline")
    done = subprocess.run(
        [command, "run", "nowhere.toml", "-o", "out"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr == "error: nowhere.toml: there is no such scene file\n"
    assert done.stdout == ""
    assert os.listdir(tmp_path) == []
