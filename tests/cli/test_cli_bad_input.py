"""What is the user's to mend ends in one line and status 2, and leaves nothing behind."""

from __future__ import annotations

import errno
import json
import os
import pickle
import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save_file

from full_disk import room_for
from sightline import Scene
from sightline.formats import write_boxes

Command = Callable[..., Any]
Spoil = Callable[[Path], None]

FIT = "fit {h}/scene.toml -o {t}/out/m.safetensors"
FIT_QKR = FIT + " --model qkr"
RUN = "run {h}/scene.toml -o {t}/out"
MODEL = " --model {h}/camera.safetensors"
CLOCK = " --clock {h}/clock/01.csv"
TRACK = "track {h}/boxes/01.csv -o {t}/out/t.csv" + MODEL
VIDEO = "track {h}/boat.mp4 -o {t}/out/t.csv" + MODEL
FRAMES = "track {h}/frames -o {t}/out/t.csv" + MODEL
SCENE = "evaluate {h}/scene.toml --json {t}/out/e.json"
TRACKS = "evaluate {h}/t.csv --fixes {h}/target.gpx --json {t}/out/e.json"
MODELS = r"known are nn, gpr, qkr, qkr\+nn, qkr\+gpr, camera, camera\+gpr"


def write(name: str, text: str | bytes) -> Spoil:
    """Put something else into a file."""
    content = text.encode() if isinstance(text, str) else text

    def spoil(folder: Path) -> None:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content)

    return spoil


def remove(name: str) -> Spoil:
    return lambda folder: (folder / name).unlink()


def replace(name: str, old: str, new: str) -> Spoil:
    """Change the first match of a pattern in a text file."""

    def spoil(folder: Path) -> None:
        text, count = re.subn(old, new, (folder / name).read_text(), count=1, flags=re.DOTALL)
        assert count == 1
        (folder / name).write_text(text)

    return spoil


def cut(name: str, share: float) -> Spoil:
    """Keep the beginning of a file."""

    def spoil(folder: Path) -> None:
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: int(share * len(data))])

    return spoil


def lines(name: str, first: int, last: int) -> Spoil:
    """Keep the header and some rows of a table."""

    def spoil(folder: Path) -> None:
        header, *rows = (folder / name).read_text().splitlines(keepends=True)
        (folder / name).write_text(header + "".join(rows[first:last]))

    return spoil


def nothing(folder: Path) -> None:
    """All is well with the files."""


def both(*spoils: Spoil) -> Spoil:
    def spoil(folder: Path) -> None:
        for one in spoils:
            one(folder)

    return spoil


def few_pairs(folder: Path) -> None:
    """Three boxes in all."""
    for name in ("01", "02", "03"):
        lines(f"boxes/{name}.csv", 5, 6)(folder)


def one_place(folder: Path) -> None:
    """A boat at anchor: boxes and fixes that are all the same."""
    for name in ("01", "02", "03"):
        path = folder / "boxes" / f"{name}.csv"
        header, *rows = path.read_text().splitlines()
        same = rows[0].split(",")[1:]
        path.write_text("\n".join([header, *(",".join([r.split(",")[0], *same]) for r in rows)]))
    text = (folder / "target.gpx").read_text()
    place = re.search(r'lat="[^"]*" lon="[^"]*"', text)
    assert place is not None
    (folder / "target.gpx").write_text(re.sub(r'lat="[^"]*" lon="[^"]*"', place[0], text))


def another_version(folder: Path) -> None:
    metadata = {"format": "sightline-model", "format_version": "99", "content": "{}"}
    save_file({"support": np.zeros(3)}, folder / "camera.safetensors", metadata)


def another_model(folder: Path) -> None:
    save_file({"weights": np.zeros(3)}, folder / "camera.safetensors")


def empty_model_content(folder: Path) -> None:
    metadata = {"format": "sightline-model", "format_version": "1", "content": "{}"}
    save_file({"support": np.zeros(3)}, folder / "camera.safetensors", metadata)


def tracks_file(*rows: str) -> Spoil:
    return write("t.csv", "track_id,time_utc,latitude_deg,longitude_deg\n" + "\n".join(rows))


def to_itself(folder: Path) -> None:
    (folder / "scene.toml").unlink()
    (folder / "scene.toml").symlink_to("scene.toml")


def log_table(*rows: str) -> Spoil:
    """Another log: a table."""
    header = "time_utc,latitude_deg,longitude_deg\n"
    return both(
        write("log.csv", header + "\n".join(rows)),
        replace("scene.toml", r"target\.gpx", "log.csv"),
    )


def boxes_table(more: str, row: str) -> Spoil:
    return write("boxes/01.csv", f"frame,x1,y1,x2,y2{more}\n{row}\n")


ROW = "2023-11-14T22:13:2{}Z,32.7,-117.2"
GPX = '<gpx version="1.1" creator="x"><trk><trkseg>{}</trkseg></trk></gpx>'
POINT = '<trkpt lat="{}" lon="-117"><time>2023-11-14T22:13:2{}Z</time></trkpt>'
RECORDING = '[[recordings]]\nname = "a"\nboxes = "boxes/01.csv"\n'

SCENES = [
    ("missing", remove("scene.toml"), FIT, r"scene\.toml: there is no such scene file"),
    ("a folder", nothing, "fit {h} -o {t}/out/m", r"is a folder; expected a scene file"),
    ("empty", write("scene.toml", ""), FIT, r"scene\.toml: give \[\[recordings\]\]"),
    ("no TOML", write("scene.toml", "[[recordings"), FIT, r"scene\.toml: is no TOML"),
    ("binary", write("scene.toml", b"\xff\x00\xfe"), FIT, r"scene\.toml: is not text in UTF-8"),
    (
        "unknown key",
        replace("scene.toml", "fixes =", "fixs ="),
        RUN,
        r"unknown key recordings\[1\]\.fixs; known are name, video, .*fixes",
    ),
    (
        "unknown table",
        replace("scene.toml", r"\[camera\]", "[kamera]"),
        RUN,
        r"unknown key kamera; known are camera, recordings, control_points",
    ),
    (
        "two of a name",
        replace("scene.toml", '"02"', '"01"'),
        FIT,
        r"two recordings are named '01'",
    ),
    (
        "latitude",
        replace("scene.toml", r"latitude_deg = [\d.]+", "latitude_deg = 132.7"),
        FIT,
        r"camera\.latitude_deg: .*less than or equal to 90; it is 132\.7",
    ),
    (
        "latitude of a control point",
        write(
            "scene.toml",
            "[[control_points]]\npixel_px = [1, 2]\nlatitude_deg = -91.0\nlongitude_deg = 0.0\n",
        ),
        FIT,
        r"control_points\[1\]\.latitude_deg",
    ),
    (
        "a file that is not there",
        remove("boxes/02.csv"),
        RUN,
        r"recordings\[2\]\.boxes names .*02\.csv, which does not exist",
    ),
    (
        "a name that leads elsewhere",
        replace("scene.toml", '"01"', '"../../elsewhere"'),
        FIT,
        r"recordings\[1\]\.name: '\.\./\.\./elsewhere' holds / or \\ or what cannot be printed",
    ),
    ("nested too deep", write("scene.toml", "a = " + 5000 * "["), FIT, r"scene\.toml: is no TOML"),
    (
        "a number without end",
        write("scene.toml", "[camera]\nlatitude_deg = 1" + 5000 * "0"),
        FIT,
        r"scene\.toml: is no TOML",
    ),
    (
        "no table",
        write("scene.toml", "camera = [1]\n"),
        FIT,
        r"scene\.toml: camera: expected a table of keys and values; it is \[1\]",
    ),
    (
        "a name that is too long",
        replace("scene.toml", r'boxes = "[^"]*"', f'boxes = "{300 * "a"}"'),
        FIT,
        r"recordings\[1\]\.boxes names .*aaa, which does not exist",
    ),
    ("a link to itself", to_itself, FIT, r"scene\.toml: cannot be read: Too many levels"),
    (
        "a control point outside the picture",
        write(
            "scene.toml",
            "[camera]\nimage_size_px = [640, 360]\n"
            "[[control_points]]\npixel_px = [3, 361]\nlatitude_deg = 1.0\nlongitude_deg = 0.0\n",
        ),
        FIT,
        r"scene\.toml: control point 1 \(3, 361 px\) lies outside the picture of 640 x 360 px",
    ),
    ("no model", nothing, SCENE, r"give --model MODEL"),
    (
        "a log beside a scene",
        nothing,
        SCENE + MODEL + " --fixes {h}/target.gpx",
        r"a scene names its own logs",
    ),
    (
        "nothing to compare",
        write("scene.toml", "[camera]\nimage_size_px = [640, 360]\n" + RECORDING),
        SCENE + MODEL,
        r"no recording has boxes and fixes",
    ),
    (
        "one recording to leave out",
        replace("scene.toml", r'\n\[\[recordings\]\]\nname = "02".*', "\n"),
        "compare {h}/scene.toml --models qkr --json {t}/out/c.json",
        r"needs at least two recordings .*; there is 1",
    ),
]

NAMES = [
    ("model", nothing, FIT + " --model bogus", rf"unknown model 'bogus'; {MODELS}"),
    ("model to run", nothing, RUN + " --model bogus", rf"unknown model 'bogus'; {MODELS}"),
    (
        "models",
        nothing,
        "compare {h}/scene.toml --models qkr,bogus --report {t}/out/r.html",
        rf"unknown model 'bogus'; {MODELS}",
    ),
    ("no models", nothing, "compare {h}/scene.toml --models ,", rf"no model is named; {MODELS}"),
    ("detector", nothing, VIDEO + " --detector yolo", r"unknown detector 'yolo'; known are motion"),
    (
        "detector to run",
        nothing,
        RUN + " --detector yolo",
        r"unknown detector 'yolo'; known are motion",
    ),
    *(
        (
            f"trajectory to {command.split()[0]}",
            nothing,
            f"{command} --trajectory kalman",
            r"unknown trajectory method 'kalman'; known are paper, rts",
        )
        for command in (
            TRACK,
            RUN,
            "compare {h}/scene.toml --models qkr",
            SCENE + MODEL + " --smooth",
        )
    ),
    (
        "format of tracks",
        nothing,
        "track {h}/boxes/01.csv -o {t}/out/t.shp" + MODEL + CLOCK,
        r"ends in '\.shp'; known are \.geojson, \.gpx, \.kml, \.csv, \.parquet, \.gpkg",
    ),
    (
        "format of tracks, read",
        write("t.kml", "<kml/>"),
        "evaluate {h}/t.kml --fixes {h}/target.gpx",
        r"ends in '\.kml'; known are \.geojson",
    ),
    (
        "clock",
        nothing,
        "simulate -o {t}/out --clock sundial --no-video",
        r"unknown clock 'sundial'; known are start, exact, stepped",
    ),
    ("command", nothing, "georeference", r"[Nn]o such command 'georeference'"),
    ("option", nothing, FIT + " --colour", r"[Nn]o such option:? '?--colour"),
    ("no value", nothing, "fit {h}/scene.toml", r"[Mm]issing option '--output'"),
    ("no number", nothing, FIT + " --seed x", r"'--seed'"),
    ("a negative seed", nothing, FIT + " --seed -1", r"'--seed'.*greater than or equal to 0"),
]

BOXES = [
    ("empty", write("boxes/01.csv", ""), FIT, r"01\.csv: is empty"),
    ("binary", write("boxes/01.csv", b"frame\0x1"), FIT, r"01\.csv: is not text"),
    (
        "no column",
        write("boxes/01.csv", "frame,x1,y1,x2\n1,2,3,4\n"),
        FIT,
        r"01\.csv: lacks the column y2; found frame, x1, y1, x2",
    ),
    (
        "NaN",
        write("boxes/01.csv", "frame,x1,y1,x2,y2\n0,1,2,3,4\n1,2,nan,3,4\n"),
        FIT,
        r"01\.csv, line 3: nan is no number \(y1\)",
    ),
    (
        "infinite",
        write("boxes/01.csv", "frame,x1,y1,x2,y2\n0,1,2,inf,4\n"),
        TRACK + CLOCK,
        r"01\.csv: none of its 1 rows is of use: 1 with a coordinate .* \(line 2: 1,2,inf,4\)",
    ),
    (
        "reversed",
        write("boxes/01.csv", "frame,x1,y1,x2,y2\n0,100,2,30,4\n"),
        RUN,
        r"01\.csv, line 2: the box 100,2,30,4 is empty or reversed; expected x1 < x2",
    ),
    (
        "outside the picture",
        write("boxes/01.csv", "frame,x1,y1,x2,y2\n0,1,2,3,4\n3,700,20,730,40\n"),
        FIT,
        r"01\.csv: the box of frame 3 \(700,20,730,40\) lies wholly outside the picture of 640 x",
    ),
    (
        "outside the picture, to track",
        write("boxes/01.csv", "frame,x1,y1,x2,y2\n0,1,2,3,4\n3,700,20,730,40\n"),
        TRACK + CLOCK,
        r"01\.csv: the box of frame 3 \(700,20,730,40\) lies wholly outside the picture of 640 x",
    ),
    (
        "confidence",
        write("boxes/01.csv", "frame,x1,y1,x2,y2,confidence\n0,1,2,3,4,187\n"),
        FIT,
        r"line 2: 187\S* is no confidence between 0 and 1",
    ),
    (
        "a frame beyond all numbers",
        boxes_table("", "1e30,1,2,3,4"),
        FIT,
        r"01\.csv, line 2: 1e\+30 is too large a number \(frame\)",
    ),
    (
        "a track beyond all numbers",
        boxes_table(",track_id", "0,1,2,3,4,9223372036854775808"),
        TRACK + CLOCK,
        r"01\.csv, line 2: 9\S+ is too large a number \(track_id\)",
    ),
    (
        "a time beyond all times",
        boxes_table(",time_utc", "0,1,2,3,4,1e300"),
        TRACK,
        r"01\.csv, line 2: 1e\+300 is no time",
    ),
    ("few pairs", few_pairs, FIT, r"2 pairs of a box and a fix; a camera needs at least 3"),
    (
        "few pairs for the paper's model",
        few_pairs,
        FIT_QKR,
        r"qkr needs at least 7 boxes with a place, not 2",
    ),
    ("no pairs", lambda h: [lines(f"boxes/0{i}.csv", 0, 0)(h) for i in (1, 2, 3)], FIT, r"no pair"),
    ("one place", one_place, FIT, r"one place|same place"),
    ("one place for the paper's model", one_place, FIT_QKR, r"one place|same place"),
    ("no time", nothing, TRACK, r"01\.csv: nothing tells the time of frame 0; give a clock"),
    (
        "a start for a table",
        nothing,
        TRACK + " --start-utc 2020-09-30T19:36:24Z",
        r"boxes in a table have no presentation times",
    ),
    (
        "a format of boxes",
        write("boxes/01.xml", "<boxes/>"),
        "track {h}/boxes/01.xml -o {t}/out/t.csv" + MODEL,
        r"01\.xml: cannot be read as a video",
    ),
]

LOGS = [
    ("empty", write("target.gpx", ""), FIT, r"target\.gpx: is empty"),
    ("missing", remove("target.gpx"), FIT, r"fixes names .*target\.gpx, which does not exist"),
    (
        "without times",
        lambda h: (
            (h / "target.gpx").write_text(
                re.sub("<time>[^<]*</time>", "", (h / "target.gpx").read_text())
            )
            and None
        ),
        FIT,
        r"target\.gpx: none of its \d+ points has a time",
    ),
    ("cut short", cut("target.gpx", 0.5), FIT, r"target\.gpx: is no GPX file, is damaged, or is c"),
    ("no points", write("target.gpx", GPX.format("")), RUN, r"target\.gpx: has no track points"),
    (
        "another day",
        lambda h: (
            (h / "target.gpx").write_text(
                re.sub(r"<time>\d{4}", "<time>1999", (h / "target.gpx").read_text())
            )
            and None
        ),
        FIT,
        r"recording 01: its log does not overlap it; the recording runs from .* the log from 1999",
    ),
    (
        "latitude",
        write("target.gpx", GPX.format(POINT.format(97, 1))),
        FIT,
        r"target\.gpx.*(97|[Ll]atitude)",
    ),
    (
        "decreasing times",
        write("target.gpx", GPX.format(POINT.format(32, 5) + POINT.format(32, 1))),
        FIT,
        r"target\.gpx, point 2: .*:21.*Z is earlier than the fix before it",
    ),
    (
        "decreasing times in a table",
        both(
            write(
                "log.csv",
                "time_utc,latitude_deg,longitude_deg\n"
                "2023-01-01T00:00:05Z,32,-117\n2023-01-01T00:00:01Z,32,-117\n",
            ),
            replace("scene.toml", r"target\.gpx", "log.csv"),
        ),
        FIT,
        r"log\.csv, line 3: .*00:00:01.*Z is earlier than the fix before it",
    ),
    (
        "latitude in a table",
        both(
            write("log.csv", "time_utc,latitude_deg,longitude_deg\n2023-01-01,-117,32\n"),
            replace("scene.toml", r"target\.gpx", "log.csv"),
        ),
        FIT,
        r"log\.csv, line 2: latitude -117, longitude 32 is not on the earth.*swapped",
    ),
    *(
        (f"the time {time}", log_table(f"{time},32,-117"), FIT, rf"line 2: {shown} is no time")
        for time, shown in [
            ("1e300", "1e300"),
            ("-1e12", "-1e12"),
            ("inf", "inf"),
            ("9999-12-31", "9999-12-31"),
        ]
    ),
    (
        "a cell without end",
        log_table(f"{100_000 * 'x'},32,-117"),
        FIT,
        r"log\.csv, line 2: x{77}\.\.\. is no time",
    ),
    (
        "nothing but noise",
        both(
            write("log.nmea", "$GPRMC,100000,A,5419.4,N,01008.4,E,1,1,010624,,*00\n"),
            replace("scene.toml", r"target\.gpx", "log.nmea"),
        ),
        FIT,
        r"log\.nmea: no sentence gives a fix; left out: 1 sentences with a wrong checksum \(line 1",
    ),
    (
        "nothing but noise from AIS",
        both(
            write("log.nmea", "!AIVDM,1,1,,A,zzzzzzz,0*00\n"),
            replace("scene.toml", r"target\.gpx", "log.nmea"),
        ),
        FIT,
        r"log\.nmea: holds no usable AIS position report; left out: 1 AIS sentences with a wrong",
    ),
    (
        "several vessels",
        both(nothing, replace("scene.toml", r"target\.gpx", "ais.nmea")),
        FIT,
        r"ais\.nmea: .*(mmsi|MMSI)",
    ),
]

CLOCKS = [
    ("empty", write("clock/01.csv", ""), FIT, r"clock/01\.csv: is empty"),
    ("missing", remove("clock/01.csv"), FIT, r"clock names .*01\.csv, which does not exist"),
    ("missing, to track", nothing, TRACK + " --clock {h}/no.csv", r"no\.csv: there is no such"),
    (
        "decreasing",
        write("clock/01.csv", "frame,utc\n0,2023-01-01T00:00:05Z\n9,2023-01-01T00:00:01Z\n"),
        FIT,
        r"clock/01\.csv: .*(decrease|before|backwards|earlier)",
    ),
    (
        "a frame twice",
        write("clock/01.csv", "frame,utc\n0,2023-01-01T00:00:05Z\n0,2023-01-01T00:00:06Z\n"),
        FIT,
        r"clock/01\.csv: .*frame",
    ),
    (
        "no time",
        write("clock/01.csv", "frame,utc\n0,noon\n"),
        FIT,
        r"clock/01\.csv, line 2: noon is no time \(utc\)",
    ),
    (
        "too short",
        lines("clock/01.csv", 0, 20),
        FIT,
        r"boxes/01\.csv: frame \d+ has no time: the clock runs from frame 0 to frame 19",
    ),
    ("start", nothing, VIDEO + " --start-utc noon", r"--start-utc 'noon' is no time"),
]

PICTURES = [
    ("missing", remove("boat.mp4"), VIDEO, r"boat\.mp4: there is no such video, folder or table"),
    ("empty", write("boat.mp4", ""), VIDEO, r"boat\.mp4: is empty"),
    ("cut short", cut("boat.mp4", 0.6), VIDEO, r"boat\.mp4: .*(damaged|cut short|breaks off)"),
    ("no video", write("boat.mp4", "hello"), VIDEO, r"boat\.mp4: cannot be read as a video"),
    (
        "cut short in a scene",
        both(
            cut("boat.mp4", 0.6),
            replace("scene.toml", "$", '\n[[recordings]]\nname = "v"\nvideo = "boat.mp4"\n'),
        ),
        RUN + " --model qkr",
        r"boat\.mp4: .*(damaged|cut short|breaks off)",
    ),
    (
        "no pictures",
        lambda h: [path.unlink() for path in (h / "frames").iterdir()] and None,
        FRAMES,
        r"frames: holds no picture; expected FRAME\.jpg or FRAME\.png",
    ),
    (
        "a damaged picture",
        cut("frames/007.png", 0.5),
        FRAMES + " --clock {h}/frames.csv",
        r"007\.png: is no picture that can be read, or is damaged",
    ),
    (
        "a frame beyond all numbers",
        lambda h: (h / "frames/007.png").rename(h / f"frames/{20 * '9'}.png") and None,
        FRAMES,
        r"9\.png: its number is too large for that of a frame",
    ),
    (
        "a name that is too long",
        nothing,
        VIDEO.replace("boat", 300 * "a"),
        r"aaa\.mp4: there is no such video, folder or table",
    ),
    (
        "a name that is too long, to detect",
        nothing,
        f"detect {{h}}/{300 * 'a'}.mp4 -o {{t}}/out/d.csv",
        r"aaa\.mp4: there is no such video or folder",
    ),
    ("no time", nothing, FRAMES, r"frames: nothing tells the time of frame 0"),
    (
        "seldom",
        write("slow.csv", "frame,utc\n0,1700000000\n39,1700000312\n"),
        FRAMES + " --clock {h}/slow.csv",
        r"the pictures are 8\.0 s apart, and a target can be followed only where they are at most",
    ),
    (
        "another size",
        both(
            replace("scene.toml", r"\[640, 360\]", "[1280, 720]"),
            replace("scene.toml", "$", '\n[[recordings]]\nname = "v"\nvideo = "boat.mp4"\n'),
        ),
        "run {h}/scene.toml -o {t}/out --model qkr",
        r"boat\.mp4: has pictures of 640 x 360 px, and image_size_px says 1280 x 720",
    ),
    ("a start for pictures", nothing, FRAMES + " --start-utc 2020-09-30", r"give a clock"),
]
FILES = [
    ("no model", remove("camera.safetensors"), TRACK + CLOCK, r"there is no such model file"),
    ("an empty model", write("camera.safetensors", ""), TRACK + CLOCK, r"camera\.safetensors: is "),
    ("a cut model", cut("camera.safetensors", 0.5), TRACK + CLOCK, r"is damaged or no model"),
    ("another version", another_version, TRACK + CLOCK, r"is of format version 99, this release r"),
    ("another program's", another_model, SCENE + MODEL, r"is no model of sightline"),
    ("without content", empty_model_content, TRACK + CLOCK, r"camera\.safetensors: is damaged"),
    (
        "a pickle",
        write("camera.safetensors", pickle.dumps({"model": "camera"})),
        TRACK + CLOCK,
        r"camera\.safetensors: is damaged or no model of sightline",
    ),
    (
        "a scene for a model",
        nothing,
        "track {h}/boxes/01.csv -o {t}/out/t.csv --model {h}/scene.toml",
        r"scene\.toml: is damaged",
    ),
    ("no tracks", nothing, TRACKS, r"t\.csv: there is no such file"),
    ("no rows", tracks_file(), TRACKS, r"t\.csv: holds no point of a track"),
    (
        "a time twice",
        tracks_file("1," + ROW.format(1), "1," + ROW.format(1)),
        TRACKS,
        r"t\.csv: track 1: .*(increase|twice)",
    ),
    (
        "decreasing times",
        tracks_file("1," + ROW.format(5), "1," + ROW.format(1)),
        TRACKS,
        r"t\.csv: track 1: .*increase",
    ),
    (
        "latitude of a track",
        tracks_file("1,2023-11-14T22:13:20Z,-117,32"),
        TRACKS,
        r"t\.csv, row 2: latitude -117, longitude 32 is not on the earth",
    ),
    (
        "no column",
        write("t.csv", "track_id,time\n1,2\n"),
        TRACKS,
        r"t\.csv: lacks the columns time",
    ),
    (
        "another day",
        tracks_file("1,1999-01-01T00:00:00Z,32.7,-117.2"),
        TRACKS,
        r"no position falls",
    ),
    (
        "cut short",
        write("t.geojson", '{"type": "FeatureCollection", "features": ['),
        "evaluate {h}/t.geojson --fixes {h}/target.gpx",
        r"t\.geojson: is no JSON, is damaged, or is cut short",
    ),
    (
        "damaged Parquet",
        write("t.parquet", b"PAR1" + bytes(50) + b"PAR1"),
        "evaluate {h}/t.parquet --fixes {h}/target.gpx",
        r"t\.parquet: is no Parquet file, is damaged",
    ),
    (
        "a damaged GeoPackage",
        write("t.gpkg", b"SQLite format 3\0" + bytes(500)),
        "evaluate {h}/t.gpkg --fixes {h}/target.gpx",
        r"t\.gpkg: is no GeoPackage",
    ),
    (
        "a track beyond all numbers",
        tracks_file("1e30," + ROW.format(1)),
        TRACKS,
        r"t\.csv, line 2: 1e\+30 is too large a number \(track_id\)",
    ),
    ("no log", tracks_file("1," + ROW.format(1)), "evaluate {h}/t.csv", r"give --fixes LOG"),
    (
        "no such track",
        tracks_file("1," + ROW.format(1)),
        TRACKS + " --track-id 9",
        r"there is no track 9; known are 1",
    ),
]

PLACES = [
    (
        "a file for a folder",
        nothing,
        "run {h}/scene.toml -o {h}/target.gpx",
        r"is a file; give a f",
    ),
    ("a file to simulate", nothing, "simulate -o {h}/target.gpx", r"is a file; give a folder"),
    ("a file for a demo", nothing, "demo -o {h}/target.gpx", r"is a file; give a folder"),
    ("below a file", nothing, "run {h}/scene.toml -o {h}/target.gpx/out", r"out: cannot be made"),
    ("a folder for a model", nothing, "fit {h}/scene.toml -o {h}", r"'--output'.* is a directory"),
    ("a folder for tracks", nothing, TRACK + " -o {h}" + CLOCK, r"'--output'.* is a directory"),
    ("a folder for JSON", nothing, FIT + " --json {h}", r"'--json'.* is a directory"),
    (
        "tracks below a file",
        nothing,
        TRACK + " -o {h}/target.gpx/t.csv" + CLOCK,
        r"target\.gpx/t\.csv: cannot be written",
    ),
    (
        "tracks over their boxes",
        nothing,
        "track {h}/boxes/01.csv -o {h}/frames/../boxes/01.csv" + MODEL + CLOCK,
        r"boxes/01\.csv: is read by this command; give the result another name",
    ),
    (
        "a model over its scene",
        nothing,
        "fit {h}/scene.toml -o {h}/scene.toml",
        r"scene\.toml: is read by this command",
    ),
    (
        "a report over its tracks",
        nothing,
        "evaluate {h}/t.csv --fixes {h}/target.gpx --json {h}/target.gpx",
        r"target\.gpx: is read by this command",
    ),
    ("no time at all", nothing, TRACK + CLOCK + " --interval 0", r"interval_s is 0 s; it must be"),
    ("no interval", nothing, TRACK + CLOCK + " --interval nan", r"interval_s is nan s"),
    ("an endless interval", nothing, RUN + " --interval inf", r"interval_s is inf s"),
    ("an endless video", nothing, "simulate -o {t}/out --duration inf", r"inf s is not to be had"),
    ("a day and more", nothing, "simulate -o {t}/out --duration 1e6", r"give 1 to 86400 s"),
    ("a forecast of years", nothing, TRACK + CLOCK + " --forecast 1e9", r"may be 500000 s at most"),
    (
        "JSON below a file, with a folder of results",
        nothing,
        RUN + " --model qkr --json {h}/scene.toml/x.json",
        r"scene\.toml/x\.json: cannot be written",
    ),
    (
        "JSON below a file, with a harbour",
        nothing,
        "simulate -o {t}/out --no-video --duration 5 --json {h}/scene.toml/x.json",
        r"scene\.toml/x\.json: cannot be written",
    ),
    (
        "a name of a result that is too long",
        nothing,
        TRACK.replace("t.csv", 300 * "a" + ".csv") + CLOCK,
        r"aaa\.csv: cannot be written",
    ),
    (
        "a file where tracks go",
        write("out/tracks", ""),
        "run {h}/scene.toml -o {h}/out --model qkr",
        r"out/tracks: is a file, where a folder has to go",
    ),
    (
        "a folder where the report goes",
        lambda h: (h / "out" / "report.html").mkdir(parents=True),
        "run {h}/scene.toml -o {h}/out --model qkr",
        r"out/report\.html: is a folder, where a file has to go",
    ),
    ("no videos", nothing, "simulate -o {t}/out --recordings 0", r"at least one is needed"),
]

TABLES = {
    "scene": SCENES,
    "name": NAMES,
    "boxes": BOXES,
    "log": LOGS,
    "clock": CLOCKS,
    "pictures": PICTURES,
    "file": FILES,
    "place": PLACES,
}


def everything(folder: Path) -> dict[str, bytes | None]:
    """All files and folders, hidden ones too, and what is in them."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


@pytest.mark.parametrize(
    ("spoil", "command", "message"),
    [
        pytest.param(*case, id=f"{kind}: {name}")
        for kind, cases in TABLES.items()
        for name, *case in cases
    ],
)
def test_one_line_and_nothing_left(
    sightline: Command, harbour: Path, tmp_path: Path, spoil: Spoil, command: str, message: str
) -> None:
    spoil(harbour)
    before = everything(tmp_path)
    done = sightline(*(part.format(h=harbour, t=tmp_path) for part in command.split()))
    assert done.status == 2
    assert done.out == ""
    assert re.match(rf"error: .*{message}.*\n\Z", done.err), done.err
    assert everything(tmp_path) == before


@pytest.mark.parametrize(
    "command",
    [
        FIT_QKR,
        "compare {h}/scene.toml --models qkr --report {t}/out/r.html",
        "compare {h}/scene.toml --models qkr --map {t}/out/m.png",
        "compare {h}/scene.toml --models qkr --json {t}/out/c.json",
        SCENE + MODEL,
        *(
            f"track {{h}}/boxes/01.csv -o {{t}}/out/t.{ending}{MODEL}{CLOCK} --interval 0.05"
            for ending in ("csv", "geojson", "gpx", "kml", "parquet")
        ),
        "simulate -o {t}/out --no-video --recordings 1",
        "simulate -o {t}/out --recordings 1 --duration 1",
    ],
)
def test_a_full_disk(sightline: Command, harbour: Path, tmp_path: Path, command: str) -> None:
    before = everything(tmp_path)
    with room_for(6000):
        done = sightline(*(part.format(h=harbour, t=tmp_path) for part in command.split()))
    assert done.status == 2
    assert re.fullmatch(r"error: .*: cannot be written: .*File too large.*\n", done.err), done.err
    assert everything(tmp_path) == before


def test_a_full_disk_keeps_what_fits_of_a_run(
    sightline: Command, harbour: Path, tmp_path: Path
) -> None:
    """Each file of a new folder is there as it would be with room, or not at all."""
    run = ("run", harbour / "scene.toml", "--model", "qkr", "-o")
    assert sightline(*run, tmp_path / "whole").status == 0
    with room_for(40_000):
        done = sightline(*run, tmp_path / "out", "--json", tmp_path / "run.json")
    assert done.status == 2
    assert re.fullmatch(r"error: .*out/report\.html: cannot be written: .*\n", done.err), done.err
    whole, kept = everything(tmp_path / "whole"), everything(tmp_path / "out")
    assert {"model.safetensors", "tracks/01.gpx"} <= set(kept) < set(whole)
    assert all(whole[name] == content for name, content in kept.items())
    files = json.loads((tmp_path / "run.json").read_text())["files"].values()
    assert all(Path(file).exists() for file in files)


def test_a_full_disk_for_what_is_printed(
    sightline: Command, harbour: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("only Linux has a device that is always full")
    scene, out = harbour / "scene.toml", tmp_path / "m.safetensors"
    file = full.open("w")
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", file)
        done = sightline("fit", scene, "-o", out, "--model", "qkr")
    with suppress(OSError):
        file.close()
    assert done.status == 2
    assert done.err == "error: the output cannot be written: No space left on device\n"


def test_whoever_has_read_enough_may_stop(
    sightline: Command, harbour: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in ``sightline compare ... | head``."""
    reader, writer = os.pipe()
    os.close(reader)
    file = os.fdopen(writer, "w")
    scene, out = harbour / "scene.toml", tmp_path / "c.json"
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", file)
        done = sightline("compare", scene, "--models", "qkr", "--json", out)
    with suppress(OSError):
        file.close()
    assert (done.status, done.err) == (0, "")
    assert list(json.loads(out.read_text())["models"]) == ["qkr"]


@pytest.mark.slow
def test_a_full_disk_leaves_an_earlier_run_as_it_was(
    sightline: Command, harbour: Path, tmp_path: Path
) -> None:
    run = ("run", harbour / "scene.toml", "-o", tmp_path / "out", "--model", "qkr")
    assert sightline(*run).status == 0
    before = everything(tmp_path)
    # The tracks fit, the map and the report do not.
    with room_for(40_000):
        done = sightline(*run)
    assert done.status == 2
    assert everything(tmp_path) == before


def test_a_bug_in_the_report_costs_nothing_but_the_report(
    sightline: Command, harbour: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("a bug")

    monkeypatch.setattr("sightline.reporting.run_report.run_page", fail)
    out = tmp_path / "a" / "b"
    with pytest.raises(RuntimeError, match="a bug"):
        sightline("run", harbour / "scene.toml", "-o", out, "--model", "qkr")
    assert {path.name for path in out.iterdir()} == {
        *("map.png", "model.safetensors", "report.json", "tracks")
    }
    assert len(list((out / "tracks").iterdir())) == 12


def test_a_bug_in_the_work_leaves_nothing(
    sightline: Command, harbour: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("a bug")

    before = everything(tmp_path)
    monkeypatch.setattr("sightline.pipeline.run.run", fail)
    with pytest.raises(RuntimeError, match="a bug"):
        sightline("run", harbour / "scene.toml", "-o", tmp_path / "a" / "b", "--model", "qkr")
    assert everything(tmp_path) == before


def test_debug_shows_where_an_error_came_from(sightline: Command, tmp_path: Path) -> None:
    done = sightline("--debug", "fit", tmp_path / "no.toml", "-o", tmp_path / "m.safetensors")
    assert done.status == 2
    assert done.err.startswith("Traceback (most recent call last):")
    assert "in check_scene_is_there" in done.err
    assert done.err.endswith("no.toml: there is no such scene file\n")


@pytest.mark.slow
def test_a_bug_shows_its_traceback_and_exits_with_1(harbour: Path, tmp_path: Path) -> None:
    script = f"""
import sys
import sightline.pipeline.fit_unlabelled
import sightline.cli

def bug(*_, **__):
    raise RuntimeError("a bug")

sightline.pipeline.fit_unlabelled.fit_scene = bug
sightline.cli.main(["fit", {str(harbour / "scene.toml")!r}, "-o", {str(tmp_path / "out")!r}])
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 1
    assert done.stderr.startswith("Traceback (most recent call last):")
    assert done.stderr.endswith("RuntimeError: a bug\n")
    assert not (tmp_path / "out").exists()


def test_two_boxes_of_a_target_at_one_time_are_two_measurements(
    sightline: Command, harbour: Path, tmp_path: Path
) -> None:
    """As where two people have drawn the same boat."""
    boxes = Scene.load(harbour / "scene.toml")["01"].boxes()
    twice = boxes[np.repeat(np.arange(len(boxes)), 2)]
    write_boxes(twice.with_columns(track_id=np.full(len(twice), 3)), tmp_path / "twice.csv")
    out, model = tmp_path / "t.json", harbour / "camera.safetensors"
    done = sightline(
        *("track", tmp_path / "twice.csv", "--model", model),
        *("-o", tmp_path / "t.csv", "--json", out),
    )
    assert (done.status, done.err) == (0, "")
    result = json.loads(out.read_text())
    assert (result["tracks"], result["points"]) == (1, len(boxes))


def test_a_table_of_nothing_has_no_tracks(
    sightline: Command, harbour: Path, tmp_path: Path
) -> None:
    (tmp_path / "none.csv").write_text("frame,time_utc,x1,y1,x2,y2\n")
    out = tmp_path / "t.geojson"
    model = harbour / "camera.safetensors"
    done = sightline("track", tmp_path / "none.csv", "--model", model, "-o", out)
    assert (done.status, done.err) == (0, "")
    assert done.out.startswith("0 tracks, 0 points")
    assert json.loads(out.read_text())["features"] == []


def test_what_the_system_forbids_is_no_bug(
    sightline: Command, harbour: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def forbidden(*_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(harbour / "scene.toml"))

    monkeypatch.setattr(Scene, "load", forbidden)
    done = sightline("fit", harbour / "scene.toml", "-o", tmp_path / "m.safetensors")
    assert done.status == 2
    assert re.fullmatch(r"error: \S*scene\.toml: cannot be used: Permission denied\n", done.err)


def test_too_little_memory_is_no_bug(
    sightline: Command, harbour: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise MemoryError("Unable to allocate 1.46 TiB")

    monkeypatch.setattr(Scene, "load", full)
    done = sightline("fit", harbour / "scene.toml", "-o", tmp_path / "m.safetensors")
    assert done.status == 2
    assert done.err == "error: there is not enough memory for this: Unable to allocate 1.46 TiB\n"


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_names_in_any_script_are_taken(sightline: Command, harbour: Path, tmp_path: Path) -> None:
    """The font of the plots has no Chinese letters, which nobody needs to be told."""
    replace("scene.toml", '"01"', '"Süd 北"')(harbour)
    replace("scene.toml", '"02"', '"Süd_北"')(harbour)
    done = sightline("run", harbour / "scene.toml", "-o", tmp_path / "out", "--model", "qkr")
    assert (done.status, done.err) == (0, "")
    assert (tmp_path / "out" / "map.png").stat().st_size > 0
    assert len(list((tmp_path / "out" / "tracks").glob("*.geojson"))) == 3
