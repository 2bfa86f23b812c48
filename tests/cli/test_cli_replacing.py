"""A command replaces its own earlier results, and what others wrote only where it is told to."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import matplotlib.figure
import numpy as np
import pytest
from safetensors.numpy import save_file

Command = Callable[..., Any]

GPX = """<?xml version="1.0"?>
<gpx version="1.1" creator="{creator}" xmlns="http://www.topografix.com/GPX/1/1"><trk>
<name>sightline</name><trkseg>
<trkpt lat="54.3" lon="10.1"><time>2024-06-01T10:00:00Z</time></trkpt></trkseg></trk></gpx>
"""
LOG_CSV = "track_id,time_utc,latitude_deg,longitude_deg\n1,2024-06-01T10:00:00Z,54.3,10.1\n"
DRAWN_CSV = "frame,x1,y1,x2,y2,confidence,annotator,time_utc\n1,10,10,20,20,1,me,\n"
MOT = "1,1,10,10,20,20,1,-1,-1,-1\n2,1,11,10,20,20,1,-1,-1,-1\n"
SHORE = '{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {}}]}'
IDENTIFIED = SHORE.replace('"properties": {}', '"properties": {"track_id": 3}')
KML = '<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2"><name>route</name></kml>'
NMEA = "$GPRMC,100000,A,5418.00,N,01006.00,E,5.0,90.0,010624,,*2A\n"
PAGE = "<!DOCTYPE html><html><body>my notes on sightline</body></html>"


def theirs(name: str, content: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).write_text(content)
        return folder / name

    return make


def their_weights(folder: Path) -> Path:
    save_file({"conv": np.zeros(3, np.float32)}, folder / "net.safetensors")
    return folder / "net.safetensors"


def their_picture(folder: Path) -> Path:
    cv2.imwrite(str(folder / "photo.png"), np.zeros((20, 30, 3), np.uint8))
    return folder / "photo.png"


def their_plot(folder: Path) -> Path:
    matplotlib.figure.Figure().savefig(folder / "plot.pdf")
    return folder / "plot.pdf"


TRACK = "track boxes/01.csv --model camera.safetensors --clock clock/01.csv -o"
DETECT = "detect boat.mp4 --detector motion -o"
CASES = [
    (TRACK, theirs("log.gpx", GPX.format(creator="Garmin"))),
    (TRACK, theirs("log.csv", LOG_CSV)),
    (TRACK, theirs("drawn.csv", DRAWN_CSV)),
    (TRACK, theirs("shore.geojson", SHORE)),
    (TRACK, theirs("others.geojson", IDENTIFIED)),
    (TRACK, theirs("route.kml", KML)),
    (TRACK, theirs("cargo.parquet", "PAR1 cargo PAR1")),
    (TRACK, theirs("shores.gpkg", "SQLite format 3")),
    (TRACK + " t.csv --json", theirs("package.json", '{"name": "mine", "tracks": 3}')),
    (TRACK + " t.csv --json", theirs("log.nmea", NMEA)),
    (TRACK + " t.csv --json", theirs("log.gpx", GPX.format(creator="Garmin"))),
    (DETECT, theirs("drawn.csv", DRAWN_CSV)),
    (DETECT, theirs("log.csv", LOG_CSV)),
    (DETECT, theirs("gt.txt", MOT)),
    (DETECT, theirs("notes.txt", "remember the milk")),
    ("fit scene.toml --model qkr -o", their_weights),
    ("fit scene.toml --model qkr -o", theirs("log.nmea", NMEA)),
    ("fit scene.toml --model qkr -o m.safetensors --json", theirs("other.json", '{"a": 1}')),
    ("compare scene.toml --models qkr --map", their_picture),
    ("compare scene.toml --models qkr --map", their_plot),
    ("compare scene.toml --models qkr --report", theirs("notes.html", PAGE)),
    ("compare scene.toml --models qkr --json", theirs("list.json", "[1, 2, 3]")),
    ("evaluate scene.toml --model camera.safetensors --json", theirs("list.json", "[1]")),
    ("check scene.toml --json", theirs("damaged.json", '{"what": ')),
]


@pytest.mark.parametrize(
    ("command", "make"), CASES, ids=[f"{i}-{case[0].split()[0]}" for i, case in enumerate(CASES)]
)
def test_what_others_wrote_is_not_replaced(
    sightline: Command,
    harbour: Path,
    monkeypatch: pytest.MonkeyPatch,
    command: str,
    make: Callable[[Path], Path],
) -> None:
    monkeypatch.chdir(harbour)
    path = make(harbour)
    before = {one: one.read_bytes() for one in harbour.rglob("*") if one.is_file()}
    done = sightline(*command.split(), path.name)
    assert (done.status, done.out) == (2, "")
    assert re.fullmatch(
        rf"error: {re.escape(path.name)}: exists and is not .* that sightline wrote, so it is not "
        r"replaced; give another name, or --overwrite\n",
        done.err,
    )
    assert {one: one.read_bytes() for one in harbour.rglob("*") if one.is_file()} == before


@pytest.mark.parametrize(
    "command",
    [
        TRACK + " t.csv t.geojson t.gpx t.kml t.parquet t.gpkg --forecast 5 --json t.json",
        DETECT + " b.csv --json b.json",
        DETECT + " b.txt",
        "fit scene.toml --model qkr -o m.safetensors --json m.json",
        pytest.param(
            "compare scene.toml --models qkr --map m.png --report r.html --json c.json",
            marks=pytest.mark.slow,
        ),
        pytest.param("compare scene.toml --models qkr --map m.svg", marks=pytest.mark.slow),
        pytest.param("compare scene.toml --models qkr --map m.pdf", marks=pytest.mark.slow),
        "evaluate scene.toml --model camera.safetensors --json e.json",
        "check scene.toml --json k.json",
        "check boat.mp4 --json k.json",
        pytest.param("run scene.toml --model qkr -o out --json out.json", marks=pytest.mark.slow),
        "simulate -o sea --no-video --recordings 1 --duration 15 --json s.json",
    ],
)
def test_the_same_command_again(
    sightline: Command, harbour: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    monkeypatch.chdir(harbour)
    first = sightline(*command.split())
    assert first.status == 0, first.err
    again = sightline(*command.split())
    assert (again.status, again.err, again.out) == (0, first.err, first.out)


def test_what_the_user_allows_is_replaced(
    sightline: Command, harbour: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(harbour)
    for make in (theirs("log.gpx", GPX.format(creator="Garmin")), theirs("log.csv", LOG_CSV)):
        path = make(harbour)
        before = path.read_bytes()
        done = sightline(*TRACK.split(), path.name, "--overwrite")
        assert (done.status, done.err) == (0, "")
        assert path.read_bytes() != before
        # Now it is ours.
        assert sightline(*TRACK.split(), path.name).status == 0
    # Not so what stands behind an output: a pattern of a shell's may have put it there.
    theirs("other.gpx", GPX.format(creator="Garmin"))(harbour)
    done = sightline(*TRACK.split(), "t.csv", "other.gpx", "--overwrite")
    assert done.status == 2
    assert "other.gpx: exists and holds no tracks" in done.err
    # An input is none of what may be replaced.
    done = sightline(*TRACK.split(), "boxes/01.csv", "--overwrite")
    assert done.status == 2
    assert "is read by this command" in done.err


def test_simulate_keeps_a_folder_that_is_somebody_s(sightline: Command, tmp_path: Path) -> None:
    harbour, empty, mine = (tmp_path / name for name in ("harbour", "empty", "mine"))
    small = ("--no-video", "--recordings", 1, "--duration", 15)
    empty.mkdir()
    (empty / ".DS_Store").touch()
    mine.mkdir()
    (mine / "scene.toml").write_text("[camera]\nname = 'mine'\n")
    for folder in (harbour, harbour, empty):
        assert sightline("simulate", "-o", folder, *small).status == 0
    done = sightline("simulate", "-o", mine, *small)
    assert (done.status, done.out) == (2, "")
    assert done.err == (
        f"error: {mine}: is a folder that simulate has not made, and is not empty; give another "
        "name, or --overwrite\n"
    )
    assert [path.name for path in mine.iterdir()] == ["scene.toml"]
    assert "mine" in (mine / "scene.toml").read_text()
    # A truth beside it makes it no harbour of ours, nor does a scene without a truth.
    (mine / "truth.json").write_text("{}")
    (harbour / "truth.json").unlink()
    for folder in (mine, harbour):
        assert sightline("simulate", "-o", folder, *small).status == 2
    assert sightline("simulate", "-o", mine, *small, "--overwrite").status == 0
    assert "mine" not in (mine / "scene.toml").read_text()
