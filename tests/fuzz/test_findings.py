"""Inputs that a campaign once found to end in a traceback, a hang or a process without bounds.

Each is as small as it still shows the fault, and is read or refused since. A reader that refuses
says so in one line, which names the file.
"""

from __future__ import annotations

import json
import os
import sqlite3
from pathlib import Path

import numpy as np
import onnx
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fuzz.examples import make_examples, with_checksum
from fuzz.isolation import READ, REFUSED, Limits, call_apart
from fuzz.readers import reader_by_name
from safetensors.numpy import load, save

from sightline.errors import SightlineError

HUGE = "1" + "0" * 400
"""Beyond any floating-point number."""


@pytest.fixture(scope="module")
def examples(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("examples")
    make_examples(folder)
    return folder


def sentences(*lines: str) -> bytes:
    """A log of sentences whose checksums are right; what stands before one stays there."""
    out = []
    for line in lines:
        at = max(line.find("$"), line.find("!"))
        out.append(line[:at] + with_checksum(line[at:]))
    return ("\r\n".join(out) + "\r\n").encode()


def geojson(**properties: object) -> bytes:
    """A track of two points with other properties."""
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": [10.14, 54.32 + 1e-4 * i]},
            "properties": {"track_id": 1, "time": f"2024-06-01T10:00:0{i}Z", **properties},
        }
        for i in range(2)
    ]
    return json.dumps({"type": "FeatureCollection", "features": features}).encode()


def point(**values: object) -> bytes:
    """OTVision's file of one point with other values."""
    good = {"x_px": 14, "y_px": 259, "zone_utm": 32, "lon_utm": 844098.58, "lat_utm": 5673186.1}
    return json.dumps({"1": good | values}).encode()


RMC = "$GPRMC,100000.00,A,5419.39800,N,01008.36400,E,10.20,081.6,010624,,,A"
AIS = "2024-06-01T10:00:00Z !AIVDO,1,1,,A,{},0"

TEXTS = {
    # A year that no calendar has, one beyond the whole numbers of C, and a place without one.
    "zda of the year 0": ("log: NMEA 0183", "a.nmea", sentences("$GPZDA,100000.00,01,06,0,00,00")),
    "zda of a huge year": (
        "log: NMEA 0183",
        "a.nmea",
        sentences(f"$GPZDA,100000.00,01,06,{2**70},00,00", RMC),
    ),
    "headings after a huge year": (
        "headings: NMEA 0183",
        "a.nmea",
        sentences(f"$GPZDA,100000.00,01,06,{2**70},00,00", "$HEHDT,081.2,T"),
    ),
    "a longitude that is no number": (
        "log: NMEA 0183",
        "a.nmea",
        sentences(RMC, RMC.replace("01008.36400", "NaN"), RMC.replace("100000", "100001")),
    ),
    # Texts that no encoding can hold.
    "gpsd with lone surrogates": (
        "log: JSON lines",
        "a.json",
        b'{"class":"TPV","mode":3,"device":"\\udcff","time":"\\ud800","lat":"\\ud800","lon":1}\n',
    ),
    "geojson of lone surrogates": (
        "log: GeoJSON",
        "a.geojson",
        (
            b'{"type":"Feature","properties":{"coordTimes":["\\ud800"]},'
            b'"geometry":{"type":"LineString","coordinates":[["\\udcff",1]]}}'
        ),
    ),
    # A text of thousands of letters in a message.
    "geojson with a long kind": ("tracks: GeoJSON", "a.geojson", geojson(kind="a" * 5000)),
    # Messages of AIS that end before the place, and before the second.
    "ais without a place": ("log: AIS", "a.nmea", sentences(AIS.format("139>JhO"))),
    "ais without a second": (
        "log: AIS",
        "a.nmea",
        sentences(AIS.replace("VDO", "VDM").format("B39>Jh@0KH;VQrWiFc")),
    ),
    "ais of the year 10000": (
        "log: AIS",
        "a.nmea",
        sentences(
            AIS.replace("2024", "9999").format("139>JhOP1J0fJ9HO5Jc3:P09P000"),
            "\\c:99999999999999\\!AIVDO,1,1,,A,139>JhOP1J0fJ9HO5Jc3:P09P000,0",
        ),
    ),
    # Whole numbers that no floating-point number reaches.
    "boxes of a huge frame": (
        "boxes: CSV",
        "a.csv",
        f"frame,x1,y1,x2,y2\n{HUGE},1,2,3,4\n".encode(),
    ),
    "boxes of MOT with a huge frame": (
        "boxes: MOTChallenge",
        "a.txt",
        f"{HUGE},1,1,2,3,4,1\n".encode(),
    ),
    "boxes of empty cells": ("boxes: MOTChallenge", "a.txt", b",,,,,,\n,,,,,,\n"),
    "clock of a huge frame": (
        "clock",
        "a.csv",
        f"frame,utc\n0,2024-06-01T10:00:00Z\n{HUGE},2024-06-01T10:00:01Z\n".encode(),
    ),
    "log with a huge time": (
        "log: CSV",
        "a.csv",
        f"time_utc,latitude_deg,longitude_deg\n{HUGE},1,2\n".encode(),
    ),
    "a huge water level": (
        "water levels",
        "a.csv",
        f"time_utc,water_level_m\n2024-06-01T10:00Z,0\n2024-06-01T11:00Z,{HUGE}\n".encode(),
    ),
    "tracks with a huge number": (
        "tracks: CSV",
        "a.csv",
        "track_id,time_utc,latitude_deg,longitude_deg\n"
        f"{HUGE},2024-06-01T10:00:00Z,54,10\n".encode(),
    ),
    "a huge zone": ("control points: OTVision", "a.otrfpts", point(zone_utm=10**400)),
    "a zone that is no number": (
        "control points: OTVision",
        "a.otrfpts",
        point(zone_utm=float("nan")),
    ),
    "an easting beyond the earth": (
        "control points: OTVision",
        "a.otrfpts",
        point(lon_utm=1e300, lat_utm=float("nan")),
    ),
    "a point that is deeply nested": (
        "control points: OTVision",
        "a.otrfpts",
        b'{"1":' + b"[" * 100_000 + b"]" * 100_000 + b"}",
    ),
    # What JSON can hold and a column cannot.
    "a kind that is a list": ("tracks: GeoJSON", "a.geojson", geojson(kind=[])),
    "a kind that is a table": ("tracks: GeoJSON", "a.geojson", geojson(kind={"a": 1})),
    "a number that is half a letter": (
        "tracks: GeoJSON",
        "a.geojson",
        geojson(track_id="\udcff"),
    ),
    "a time that is half a letter": ("tracks: GeoJSON", "a.geojson", geojson(time="\ud800")),
    "a label that is half a letter": ("tracks: GeoJSON", "a.geojson", geojson(label="\ud800")),
    "a speed that is a list": ("tracks: GeoJSON", "a.geojson", geojson(speed_mps=[1.0])),
    "a huge track number": ("tracks: GeoJSON", "a.geojson", geojson(track_id=10**400)),
    # A line that a message would repeat.
    "a key of a long scene": (
        "scene",
        "scene.toml",
        b"[camera]\n" + b"x" * 200_000 + b" = 1\n",
    ),
    "a name of a long file": (
        "scene",
        "scene.toml",
        b'[[recordings]]\nname = "a"\nboxes = "' + b"a" * 5000 + b'"\n',
    ),
    "points of a track in a route": (
        "log: GPX",
        "a.gpx",
        b'<gpx><rte><trkseg><trkpt lat="54" lon="10"/></trkseg></rte></gpx>',
    ),
    "a fleet of a recording whose name is too long for a file": (
        "batch: fleet",
        "fleet.toml",
        b'[[cameras]]\nname = "a"\nmodel = "camera-gpr.safetensors"\nrecordings = ["'
        + b"x" * 300
        + b'.csv"]\n',
    ),
    "a configuration that names a file by more letters than fit into a line": (
        "command: live",
        "played.toml",
        b'model = "' + b"a" * 20_000 + b'"\n[source]\naddress = "played.mp4"\nas_live = true\n',
    ),
    "a row of a drawn table that says NA": (
        "draw: control points",
        "points.csv",
        b"x_px,y_px,latitude_deg,longitude_deg\n100,250,54.324,10.139\nNA\n",
    ),
    "a drawn table of words that pandas takes for numbers": (
        "draw: control points",
        "points.csv",
        b"x_px,y_px,latitude_deg,longitude_deg\nTRUE,TRUE,TRUE,TRUE\n",
    ),
    "a long longitude": (
        "log: GPX",
        "a.gpx",
        b'<gpx><trk><trkseg><trkpt lat="54" lon="1' + b"[" * 100_000 + b'"/></trkseg></trk></gpx>',
    ),
}


@pytest.mark.parametrize("name", TEXTS)
def test_texts_are_read_or_refused(name: str, examples: Path, tmp_path: Path) -> None:
    reader, file, content = TEXTS[name]
    read_or_refuse(reader, tmp_path / file, content, examples)


def read_or_refuse(reader: str, path: Path, content: bytes, examples: Path) -> str:
    """The line of a refusal, or nothing where it is read; anything else that is raised gets out."""
    path.write_bytes(content)
    try:
        reader_by_name(reader).read(path, examples)
    except SightlineError as error:
        line = str(error)
        assert len(line) < 3000
        return line
    return ""


def test_parquet_of_other_types(examples: Path, tmp_path: Path) -> None:
    good = pq.read_table(examples / "tracks.parquet")
    n = good.num_rows
    columns = {
        "kind": pa.array([[1.0]] * n),
        "label": pa.array([b"\xff"] * n),
        "time_utc": pa.array([True] * n),
        "track_id": pa.array([{"a": 1}] * n),
        "latitude_deg": pa.array([1] * n, pa.duration("ns")),
        "longitude_deg": pa.array([None] * n),
        "speed_mps": pa.array([-(2**62)] * n, pa.timestamp("us")),
    }
    path = tmp_path / "tracks.parquet"
    for name, values in columns.items():
        pq.write_table(good.set_column(good.column_names.index(name), name, values), path)
        read_or_refuse("tracks: Parquet", path, path.read_bytes(), examples)
    never = pa.array([-(2**62)] * n, pa.timestamp("us"))
    pq.write_table(good.set_column(good.column_names.index("time_utc"), "time_utc", never), path)
    assert read_or_refuse("tracks: Parquet", path, path.read_bytes(), examples)
    pq.write_table(good.append_column("track_id", good.column("track_id")), path)
    assert read_or_refuse("tracks: Parquet", path, path.read_bytes(), examples)


def test_parquet_whose_description_of_pandas_is_damaged(examples: Path, tmp_path: Path) -> None:
    good = pq.read_table(examples / "tracks.parquet")
    path = tmp_path / "tracks.parquet"
    pq.write_table(good.replace_schema_metadata({"pandas": '{"index_columns": ['}), path)
    read_or_refuse("tracks: Parquet", path, path.read_bytes(), examples)


@pytest.mark.parametrize(
    "statement",
    [
        "DELETE FROM gpkg_geometry_columns",
        "UPDATE gpkg_contents SET data_type = 'attributes'",
        "UPDATE tracks SET geom = NULL",
        "UPDATE tracks SET label = CAST(x'ff' AS TEXT)",
        "UPDATE tracks SET kind = x'ff'",
        "UPDATE tracks SET time_utc = 'never'",
    ],
)
def test_geopackages_of_others(statement: str, examples: Path, tmp_path: Path) -> None:
    path = tmp_path / "tracks.gpkg"
    path.write_bytes((examples / "tracks.gpkg").read_bytes())
    connection = sqlite3.connect(path)
    found = connection.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall()
    for (trigger,) in found:
        # They ask for functions that only GDAL knows.
        connection.execute(f'DROP TRIGGER "{trigger}"')
    connection.execute(statement)
    connection.commit()
    connection.close()
    read_or_refuse("tracks: GeoPackage", path, path.read_bytes(), examples)


def header_of(path: Path) -> dict[str, dict[str, str]]:
    """The header of a safetensors file."""
    content = path.read_bytes()
    return json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])


@pytest.mark.skipif(not hasattr(os, "fork"), reason="what hangs is ended in a process of its own")
def test_a_model_with_an_infinite_sum_is_refused(examples: Path, tmp_path: Path) -> None:
    """LAPACK seeks the singular values of such a matrix for ever."""
    source = examples / "qkr.safetensors"
    head = json.loads(
        source.read_bytes()[8 : 8 + int.from_bytes(source.read_bytes()[:8], "little")]
    )
    arrays = load(source.read_bytes())
    (name,) = [name for name in arrays if name.endswith("A")]
    for value in (np.inf, np.nan, 1e308):
        arrays[name] = arrays[name].copy()
        arrays[name][1, 2] = value
        path = tmp_path / "model.safetensors"
        path.write_bytes(save(arrays, head["__metadata__"]))
        outcome = call_apart(
            lambda path=path: reader_by_name("model").read(path, examples), Limits()
        )
        assert outcome.end == REFUSED, outcome.detail
        assert "is damaged" in outcome.detail


@pytest.mark.parametrize("name", ["camera-gpr", "qkr-gpr", "nn", "qkr"])
def test_models_whose_parts_do_not_fit_each_other(
    name: str, examples: Path, tmp_path: Path
) -> None:
    """Every part of the file in turn with another shape: the file is whole, the model is not."""
    source = examples / f"{name}.safetensors"
    head = header_of(source)
    arrays = load(source.read_bytes())
    for part, array in arrays.items():
        for other in (array[..., :0], array[None], np.zeros(array.shape, np.uint8), array[:1]):
            path = tmp_path / "model.safetensors"
            content = save(
                {**arrays, part: np.ascontiguousarray(other)}, metadata=head["__metadata__"]
            )
            read_or_refuse("model", path, content, examples)


def test_a_network_for_very_many_pictures_is_refused(examples: Path, tmp_path: Path) -> None:
    model = onnx.load(examples / "constant.onnx")
    model.graph.input[0].type.tensor_type.shape.dim[0].dim_value = 100_000
    path = tmp_path / "many.onnx"
    line = read_or_refuse("detector: ONNX", path, model.SerializeToString(), examples)
    assert "takes 100000 pictures of 64 x 64 px at once" in line


def test_a_network_whose_names_are_no_text_is_refused(examples: Path, tmp_path: Path) -> None:
    content = (examples / "constant.onnx").read_bytes().replace(b"output0", b"\xff\xfe\xffput0")
    path = tmp_path / "names.onnx"
    assert read_or_refuse("detector: ONNX", path, content, examples)


def test_a_map_whose_tables_have_no_names_is_refused(examples: Path, tmp_path: Path) -> None:
    """SQLite complains in the letters that it found, which are none."""
    content = (examples / "map.mbtiles").read_bytes()
    assert content.count(b"CREATE TABLE tiles") == 1
    content = content.replace(b"CREATE TABLE tiles", b"CREATE \xffABLE tiles")
    line = read_or_refuse("map: MBTiles", tmp_path / "map.mbtiles", content, examples)
    assert "is no MBTiles that can be used" in line


def test_videos_whose_words_are_in_another_encoding(examples: Path, tmp_path: Path) -> None:
    """What a camera of twenty years ago wrote of itself; the pictures are as they were."""
    source = (examples / "clip.mp4").read_bytes()
    assert source.count(b"VideoHandler") == 1
    path = tmp_path / "clip.mp4"
    content = source.replace(b"VideoHandler", b"Kamera\xe4\xf6\xfc\xdf12")
    assert read_or_refuse("video: MP4, MOV", path, content, examples) == ""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="what hangs is ended in a process of its own")
@pytest.mark.parametrize(
    ("reader", "name", "header"),
    [
        ("water levels", "a.csv", b"time_utc,water_level_m," + b"1," * 200_000),
        ("water levels", "a.csv", b"time_utc,water_level_m"),
        ("boxes: MOTChallenge", "a.txt", b"1,1,1,1,1,1"),
        ("boxes: CSV", "a.csv", b"frame,x1,y1,x2,y2" + b",1" * 200_000),
    ],
)
def test_a_table_of_very_many_columns_is_refused(
    reader: str, name: str, header: bytes, examples: Path, tmp_path: Path
) -> None:
    """Each column of a table costs pandas a millisecond."""
    path = tmp_path / name
    path.write_bytes(header + b"\n" + b"1," * 200_002 + b"\n")
    outcome = call_apart(lambda: reader_by_name(reader).read(path, examples), Limits(patience=6.0))
    assert outcome.end in (READ, REFUSED), outcome.detail
