"""No source is taken for an output, and an output that fails spoils no other."""

from __future__ import annotations

import json
import os
import re
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from sightline.atomic import atomic_path
from sightline.formats import read_tracks, write_tracks
from sightline.formats.kml import KmlTrackWriter

Command = Callable[..., Any]

SECOND = r"error: .*: is a second source; give one at a time, .*\n"
NO_TRACKS = r"error: .*: exists and holds no tracks, so it is not overwritten; .*\n"
READ = r"error: .*: is read by this command; give .*\n"
TWICE = r"error: .*: is given for two results; .*\n"


FLEET = """[[cameras]]
name = "harbour"
model = "camera.safetensors"
recordings = [{source = "boat.mp4", clock = "clock/01.csv", log = "target.gpx"}]
"""


def content(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def links(harbour: Path) -> None:
    """Other names of what is read."""
    os.link(harbour / "boxes" / "01.csv", harbour / "hard.csv")
    (harbour / "soft.csv").symlink_to(harbour / "boxes" / "01.csv")
    (harbour / "folder").symlink_to(harbour / "boxes")


@pytest.mark.parametrize(
    ("command", "message"),
    [
        # What a shell makes of *.csv.
        ("track boxes/01.csv boxes/02.csv {m} -o out.geojson", SECOND),
        ("track boxes/01.csv {m} boxes/02.csv -o out.geojson", SECOND),
        ("track boxes/01.csv new.csv {m} -o out.geojson", SECOND),
        ("track {m} -o out.geojson boxes/01.csv boxes/02.csv", SECOND),
        ("track {m} -o out.geojson -- boxes/01.csv boxes/02.csv", SECOND),
        ("track boxes/01.csv {m} -o out.geojson boxes/02.csv", NO_TRACKS),
        ("track boxes/01.csv {m} -o out.geojson target.gpx", NO_TRACKS),
        ("track boxes/01.csv {m} -o out.geojson out.gpx clock/02.csv", NO_TRACKS),
        ("track boxes/01.csv {m} -o out.geojson boat.mp4", NO_TRACKS),
        ("track boxes/01.csv {m} -o hard.csv", READ),
        ("track boxes/01.csv {m} -o soft.csv", READ),
        ("track boxes/01.csv {m} -o folder/01.csv", READ),
        ("track hard.csv {m} -o boxes/01.csv", READ),
        ("track file:boxes/01.csv {m} -o boxes/01.csv", READ),
        ("track boxes/01.csv {m} -o out.csv --json out.csv", TWICE),
        ("track boxes/01.csv {m} -o out.csv folder/../out.csv", TWICE),
        ("track boxes/01.csv {m} -o a.csv a-forecast.csv --forecast 5", TWICE),
        ("track boxes/01.csv {m} -o a.csv --json clock/01.csv", READ),
        ("track frames {m} -o a.csv --json frames/000.png", READ),
        ("detect boat.mp4 -o b.csv --json b.csv", TWICE),
        ("detect boat.mp4 -o b.csv --detector clock/01.csv --json clock/01.csv", READ),
        ("fit scene.toml -o boxes/01.csv", READ),
        ("fit scene.toml -o m.safetensors --json target.gpx", READ),
        ("fit scene.toml -o m.safetensors --json clock/02.csv", READ),
        ("compare scene.toml --report detections/02.csv", READ),
        ("evaluate scene.toml --model camera.safetensors --json boxes/02.csv", READ),
        ("run scene.toml -o out --json target.gpx", READ),
        ("run scene.toml -o out --json out/report.json", READ),
        ("count t.csv --lines area.geojson -o area.geojson", READ),
        ("count t.csv --zones area.geojson -o out.csv --json t.csv", READ),
        ("count t.csv --zones area.geojson -o t.csv", READ),
        ("export kept.db -o kept.db", READ),
        ("export kept.db -o out.csv --json kept.db", READ),
        ("show frames --model camera.safetensors -o frames/000.png --at 0", READ),
        ("show boat.mp4 --model camera.safetensors -o boat.mp4", READ),
        (
            "show frames --model camera.safetensors -o o.mp4 --fixes target.gpx --json target.gpx",
            READ,
        ),
        ("show frames --model camera.safetensors -o o.mp4 --tracks t.csv --json t.csv", READ),
        ("plan --model camera.safetensors -o o.html --json camera.safetensors", READ),
        ("plan --height 4 --drive target.gpx -o o.html --json target.gpx", READ),
        ("batch fleet.toml -o out --json fleet.toml", READ),
        ("batch fleet.toml -o out --json boat.mp4", READ),
        ("batch fleet.toml -o out --json camera.safetensors", READ),
        ("batch fleet.toml -o out --json clock/01.csv", READ),
        ("batch fleet.toml -o out --json target.gpx", READ),
        ("detector adapt scene.toml --model camera.safetensors -o camera.safetensors", READ),
        ("detector adapt scene.toml --model {c} -o d.onnx --json target.gpx --overwrite", READ),
    ],
)
def test_what_is_read_is_not_written(
    sightline: Command,
    harbour: Path,
    monkeypatch: pytest.MonkeyPatch,
    command: str,
    message: str,
) -> None:
    links(harbour)
    for name in ("t.csv", "area.geojson", "kept.db"):
        (harbour / name).touch()
    (harbour / "fleet.toml").write_text(FLEET)
    monkeypatch.chdir(harbour)
    before = content(harbour)
    model = "camera.safetensors"
    filled = command.format(m=f"--model {model} --clock clock/01.csv", c=model)
    done = sightline(*filled.split())
    assert (done.status, done.out) == (2, "")
    assert re.fullmatch(message, done.err), done.err
    assert content(harbour) == before


def test_a_run_does_not_replace_the_boxes_that_its_scene_names(
    sightline: Command, harbour: Path
) -> None:
    """They lie where it would put its tracks."""
    tracks = harbour / "results" / "tracks"
    tracks.mkdir(parents=True)
    (harbour / "boxes" / "02.csv").rename(tracks / "02.csv")
    scene = harbour / "scene.toml"
    scene.write_text(scene.read_text().replace("boxes/02.csv", "results/tracks/02.csv"))
    before = content(harbour)
    done = sightline("run", scene, "-o", harbour / "results", "--model", "qkr")
    assert done.status == 2
    assert re.fullmatch(r"error: .*tracks/02\.csv: is read by this command; .*\n", done.err)
    assert content(harbour) == before


def track(harbour: Path, *outputs: object) -> tuple[object, ...]:
    model = ("--model", harbour / "camera.safetensors", "--clock", harbour / "clock" / "01.csv")
    return ("track", harbour / "boxes" / "01.csv", *model, "-o", *outputs)


ENDINGS = ("csv", "geojson", "gpx", "kml", "parquet", "gpkg")


def test_the_same_command_replaces_its_tracks(
    sightline: Command, harbour: Path, tmp_path: Path
) -> None:
    files = [tmp_path / f"t.{ending}" for ending in ENDINGS]
    for _ in range(2):
        done = sightline(*track(harbour, *files))
        assert (done.status, done.err) == (0, "")
    empty = tmp_path / "empty.gpx"
    empty.touch()
    assert sightline(*track(harbour, files[0], empty)).status == 0
    assert len(read_tracks(empty)) == len(read_tracks(files[0])) == 1


@pytest.mark.parametrize("ending", ENDINGS)
def test_files_of_others_are_not_tracks_by_their_ending(
    sightline: Command, harbour: Path, tmp_path: Path, ending: str
) -> None:
    theirs = tmp_path / f"theirs.{ending}"
    if ending == "gpkg":
        with closing(sqlite3.connect(theirs)) as file:
            file.execute("CREATE TABLE shores (name TEXT)")
    else:
        theirs.write_text('{"type": "FeatureCollection", "features": [{"name": "shore"}]}')
    before = theirs.read_bytes()
    done = sightline(*track(harbour, tmp_path / "t.csv", theirs))
    assert (done.status, done.out) == (2, "")
    assert re.fullmatch(NO_TRACKS, done.err)
    assert theirs.read_bytes() == before


def test_a_writer_that_fails_spoils_no_other(
    sightline: Command, harbour: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(KmlTrackWriter, "add", fail)
    files = [tmp_path / f"t.{ending}" for ending in ("csv", "kml", "gpx")]
    write_tracks([], files[1])
    older = files[1].read_bytes()
    done = sightline(*track(harbour, files[0], "-o", files[1], files[2]), "--json", tmp_path / "j")
    assert done.status == 2
    assert done.err == f"error: {files[1]}: cannot be written: No space left on device\n"
    assert len(read_tracks(files[0])) == len(read_tracks(files[2])) == 1
    assert files[1].read_bytes() == older
    assert json.loads((tmp_path / "j").read_text())["files"] == [str(files[0]), str(files[2])]
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_a_bug_of_a_writer_spoils_no_other_and_is_a_bug(
    sightline: Command, harbour: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("a bug")

    monkeypatch.setattr(KmlTrackWriter, "add", fail)
    with pytest.raises(RuntimeError, match="a bug"):
        sightline(*track(harbour, tmp_path / "t.kml", tmp_path / "t.gpx"))
    assert len(read_tracks(tmp_path / "t.gpx")) == 1
    assert not (tmp_path / "t.kml").exists()


def test_where_nothing_can_be_written_the_work_ends(
    sightline: Command, harbour: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(KmlTrackWriter, "add", fail)
    done = sightline(*track(harbour, tmp_path / "t.kml"), "--json", tmp_path / "j")
    assert (done.status, done.out) == (2, "")
    assert [path.name for path in tmp_path.iterdir()] == ["harbour"]


def test_json_that_fails_does_not_cost_the_model(
    sightline: Command, harbour: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(path: Path, _: object) -> None:
        with atomic_path(path):
            raise OSError(28, "No space left on device")

    monkeypatch.setattr("sightline.evaluation.report.write_json", fail)
    model, result = tmp_path / "m.safetensors", tmp_path / "m.json"
    done = sightline("fit", harbour / "scene.toml", "-o", model, "--model", "qkr", "--json", result)
    assert done.status == 2
    assert done.err == f"error: {result}: cannot be written: No space left on device\n"
    assert f"model: {model}" in done.out
    assert model.exists()
    assert not result.exists()


def test_a_second_run_into_the_same_folder_is_refused_at_once(
    sightline: Command, harbour: Path, tmp_path: Path
) -> None:
    from sightline.atomic import atomic_folder

    out = tmp_path / "results" / "a"
    with atomic_folder(out) as folder:
        (folder / "first.txt").write_text("first")
        done = sightline("run", harbour / "scene.toml", "-o", out, "--model", "qkr")
        assert (done.status, done.out) == (2, "")
        assert done.err == (
            f"error: {out}: another run is writing it; wait for that, or give another name\n"
        )
    assert [path.name for path in out.iterdir()] == ["first.txt"]
