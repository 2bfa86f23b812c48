"""A label is text in every format: read back by readers that are not of this project."""

from __future__ import annotations

import csv
import json
import socket
import sqlite3
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from pathlib import Path
from xml.parsers import expat

import numpy as np
import pytest

from sightline.errors import InputError
from sightline.formats import box_writer, read_boxes, read_tracks, write_boxes, write_tracks
from sightline.formats.labels import Labels, read_labels, write_labels
from sightline.geodesy import LocalPlane
from sightline.text import cell_text, text_of_cell
from sightline.types import Boxes, Track

HOSTILE = {
    "network link": "</name><NetworkLink><Link><href>http://127.0.0.1/x</href></Link></NetworkLink>",
    "character data": "<![CDATA[boat",
    "character data ends": "a]]>b<![CDATA[<script>alert(1)</script>]]>",
    "script": "</script><script>alert(1)</script>",
    "attribute": "\"' onload='alert(1)' x=\"",
    "entity": '<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/hostname">]>&b;',
    "comment": "<!-- -- --><?php ?>",
    "formula": '=HYPERLINK("http://127.0.0.1/","boat")',
    "command": "@SUM(1+1)*cmd|' /C calc'!A0",
    "plus": "+1",
    "minus": "-2+3",
    "apostrophe": "'=1",
    "full width": "\uff1d1",
    "rows": 'boat",1,2\r\n9,"x',
    "json": '"}}]}, {"type": "Feature", "x": {"y": "',
    "dollar": r"berth$^$07 \input{x}",
    "format": "%s %d {0} {{x}} ${x}",
    "terminal": "\x1b]0;title\x07\x1b[31mred\x1b[2J",
    "zero": "boat\0hidden",
    "surrogate": "a\ud800b\udfffc",
    "not a character": "a\ufffe\uffffb",
    "direction": "boat\u202etaob",
    "isolates": "\u2067boat\u2069\u061c\u200e\u200f",
    "no width": "b\u200bo\u200ca\u200dt\u2060\ufeff\xad",
    "tags": "boat\U000e0041\U000e007f",
    "lines": "boat\u2028\u2029",
    "eight bits": "\x9b31mred\x85\x7f",
    "long": "x" * 5000,
    "blank": " \t\n ",
}
CONTROLS = dict.fromkeys([*range(9), 11, 12, *range(14, 32)], "\ufffd")
# What has no width or turns the direction: category Cf, and the other half of Cc.
UNSEEN = [*range(0x7F, 0xA0), 0xAD, 0x61C, *range(0x200B, 0x2010), *range(0x202A, 0x202F)]
UNSEEN += [*range(0x2060, 0x2065), *range(0x2066, 0x2070), 0xFEFF, 0xE0041, 0xE007F]


def track(label: str) -> Track:
    n = 3
    return Track(
        track_id=7,
        time_utc_s=1_601_467_200.0 + np.arange(n),
        east_m=np.arange(n, dtype=float),
        north_m=np.full(n, 100.0),
        velocity_east_mps=np.ones(n),
        velocity_north_mps=np.zeros(n),
        covariance_m2=np.tile(np.eye(2), (n, 1, 1)),
        velocity_covariance_m2ps2=np.tile(np.eye(2), (n, 1, 1)),
        kind=np.zeros(n, dtype=np.int8),
        plane=LocalPlane(32.70297, -117.234631),
        label=label,
    )


def encodable(text: str) -> str:
    """What is left of a text where lone surrogates cannot be kept."""
    return "".join("\ufffd" if 0xD800 <= ord(c) <= 0xDFFF else c for c in text)


def in_xml(text: str) -> str:
    bad = {**CONTROLS, **dict.fromkeys([0xFFFE, 0xFFFF, *UNSEEN], "\ufffd")}
    return encodable(text).translate(bad)


def elements(path: Path) -> tuple[list[str], list[str]]:
    """Tags and texts, as expat sees them; entities or a document type are an error."""
    tags: list[str] = []
    texts: dict[int, str] = {}
    parser = expat.ParserCreate()

    def refused(*_: object) -> None:
        raise AssertionError("a document type")

    parser.StartElementHandler = lambda name, _: tags.append(name)
    parser.CharacterDataHandler = lambda data: texts.update(
        {len(tags): texts.get(len(tags), "") + data}
    )
    parser.StartDoctypeDeclHandler = refused
    parser.Parse(path.read_bytes(), True)
    return tags, list(texts.values())


@pytest.mark.parametrize("label", HOSTILE.values(), ids=HOSTILE)
@pytest.mark.parametrize("suffix", [".kml", ".gpx"])
def test_a_label_is_text_in_xml(tmp_path: Path, suffix: str, label: str) -> None:
    path, plain = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
    write_tracks([track(label)], path)
    write_tracks([track("boat")], plain)
    tags, texts = elements(path)
    assert tags == elements(plain)[0]
    written = f"{in_xml(label)} 7".split()
    assert any(text.split() == written for text in texts)
    ET.parse(path)
    if suffix == ".gpx":
        (read,) = read_tracks(path)
        assert read.label.split() == in_xml(label).split()


@pytest.mark.parametrize("label", HOSTILE.values(), ids=HOSTILE)
def test_a_label_is_a_string_in_geojson(tmp_path: Path, label: str) -> None:
    path = tmp_path / "a.geojson"
    write_tracks([track(label)], path)
    features = json.loads(path.read_bytes().decode("utf-8"))["features"]
    assert [f["properties"]["label"] for f in features] == [encodable(label)] * 3
    assert [f["properties"]["track_id"] for f in features] == [7] * 3
    assert read_tracks(path)[0].label == encodable(label)


@pytest.mark.parametrize("label", HOSTILE.values(), ids=HOSTILE)
def test_a_label_is_no_formula_and_no_row_in_a_table(tmp_path: Path, label: str) -> None:
    path = tmp_path / "a.csv"
    write_tracks([track(label)], path)
    text = path.read_bytes().decode("utf-8")
    assert not any(ord(c) < 32 and c not in "\t\r\n" for c in text)
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3
    for row in rows:
        assert row["label"][:1] not in ("=", "+", "-", "@", "\t", "\r", "\uff1d")
        assert row["label"] in (in_xml(label), f"'{in_xml(label)}")
        assert row["track_id"] == "7"
        assert None not in row
    (read,) = read_tracks(path)
    # pandas takes any end of a line for a line feed.
    assert read.label.splitlines() == in_xml(label).splitlines()


@pytest.mark.parametrize("label", HOSTILE.values(), ids=HOSTILE)
def test_a_label_is_itself_in_parquet_and_geopackage(tmp_path: Path, label: str) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs sightline[parquet]")
    pyogrio = pytest.importorskip("pyogrio", reason="needs sightline[geopackage]")
    write_tracks([track(label)], tmp_path / "a.parquet")
    assert parquet.read_table(tmp_path / "a.parquet")["label"].to_pylist() == [encodable(label)] * 3
    write_tracks([track(label)], tmp_path / "a.gpkg")
    rows = pyogrio.read_dataframe(tmp_path / "a.gpkg", layer="tracks")
    held = encodable(label).replace("\0", "\ufffd")
    assert rows["label"].tolist() == [held] * 3
    assert read_tracks(tmp_path / "a.parquet")[0].label == encodable(label)[:1000]
    assert read_tracks(tmp_path / "a.gpkg")[0].label == held


@pytest.mark.parametrize("label", HOSTILE.values(), ids=HOSTILE)
def test_names_of_boxes_are_no_formulas(tmp_path: Path, label: str) -> None:
    boxes = Boxes.of([[1, 2, 30, 40]], frame=[5], source=label, label=label, track_id=[3])

    def whole(path: Path) -> None:
        write_boxes(boxes, path)

    def streamed(path: Path) -> None:
        with box_writer(path) as writer:
            writer.add(boxes)

    def labels(path: Path) -> None:
        write_labels(Labels.of_target(boxes), path)

    writers: tuple[Callable[[Path], None], ...] = (whole, streamed, labels)
    for write in writers:
        path = tmp_path / f"{write.__name__}.csv"
        write(path)
        with path.open(encoding="utf-8", newline="") as file:
            (row,) = csv.DictReader(file)
        for name in ("label", "annotator"):
            assert row[name][:1] not in ("=", "+", "-", "@", "\t", "\r", "\uff1d")
        read = read_labels(path).boxes if write is labels else read_boxes(path)
        for name in (str(read.label[0]), str(read.source[0])):
            assert name.split() == in_xml(label).split()


@pytest.mark.parametrize("text", [*HOSTILE.values(), "", "'", "''=", "boat", "'boat", "'-"])
def test_a_cell_is_the_text_again(text: str) -> None:
    assert text_of_cell(cell_text(text)) == in_xml(text)


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    """A server on this machine that nobody is to connect to."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.0)
        yield server
        with pytest.raises(BlockingIOError):
            server.accept()


VIRTUAL = {
    "vrt": '<OGRVRTDataSource><OGRVRTLayer name="tracks"><SrcDataSource>/vsicurl/{}/a.geojson'
    "</SrcDataSource></OGRVRTLayer></OGRVRTDataSource>",
    "wfs": "<OGRWFSDataSource><URL>{}/wfs?</URL></OGRWFSDataSource>",
    "gml": '<FeatureCollection xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" '
    'xsi:schemaLocation="http://www.opengis.net/gml {}/a.xsd"/>',
    "geojson": '{{"type": "FeatureCollection", "links": [{{"rel": "next", "href": "{}"}}], '
    '"features": []}}',
    "kml": "<kml><NetworkLink><Link><href>{}/a.kml</href></Link></NetworkLink></kml>",
    "entity": '<!DOCTYPE gpx SYSTEM "{}/a.dtd"><gpx version="1.1"/>',
    "address": "/vsicurl/{}/a.gpkg",
}


@pytest.mark.parametrize("suffix", [".gpkg", ".geojson", ".gpx", ".csv", ".parquet"])
@pytest.mark.parametrize("content", VIRTUAL.values(), ids=VIRTUAL)
def test_no_file_makes_a_reader_fetch_an_address(
    tmp_path: Path, listener: socket.socket, suffix: str, content: str
) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_text(content.format(f"http://127.0.0.1:{listener.getsockname()[1]}"))
    with pytest.raises(InputError) as caught:
        read_tracks(path)
    assert "\n" not in str(caught.value)


def test_a_geopackage_computes_nothing(tmp_path: Path) -> None:
    """What stands in its schema is not run: a view, a virtual table, a generated column."""
    columns = "track_id, time_utc, latitude_deg, longitude_deg"
    computed = "label GENERATED ALWAYS AS (hex(zeroblob(400000000)))"
    statements = [
        "CREATE VIEW tracks AS SELECT 1 AS track_id, 2 AS time_utc, 3 AS latitude_deg",
        f"CREATE VIRTUAL TABLE tracks USING fts5({columns})",
        f"CREATE TABLE tracks ({columns}, {computed})",
    ]
    for i, statement in enumerate(statements):
        path = tmp_path / f"{i}.gpkg"
        database = sqlite3.connect(path)
        database.execute(statement)
        if i == 2:
            database.execute("INSERT INTO tracks VALUES (1, '2020-09-30T12:00:00Z', 54.0, 10.0)")
        database.commit()
        database.close()
        if i == 2:
            (read,) = read_tracks(path)
            assert (read.track_id, read.label) == (1, "")
        else:
            with pytest.raises(InputError, match="is no GeoPackage with a layer 'tracks'"):
                read_tracks(path)


def test_a_table_without_places_is_a_layer_all_the_same(tmp_path: Path) -> None:
    geopandas = pytest.importorskip("geopandas", reason="needs sightline[geopackage]")
    import pyogrio

    write_tracks([track("boat")], tmp_path / "a.gpkg")
    rows = geopandas.read_file(tmp_path / "a.gpkg").drop(columns="geometry")
    pyogrio.write_dataframe(rows, tmp_path / "b.gpkg", layer="tracks", driver="GPKG")
    (read,) = read_tracks(tmp_path / "b.gpkg")
    np.testing.assert_allclose(read.latitude_deg, track("boat").latitude_deg, rtol=0, atol=1e-9)
    assert read.label == "boat"


def test_damaged_pandas_metadata_costs_nothing(tmp_path: Path) -> None:
    arrow = pytest.importorskip("pyarrow", reason="needs sightline[parquet]")
    from pyarrow import parquet

    write_tracks([track("boat")], tmp_path / "a.parquet")
    table = parquet.read_table(tmp_path / "a.parquet")
    for i, metadata in enumerate(
        (b"{", b'{"columns": [{"numpy_type": "datetimf64[ms]", "name": "time_utc"}]}', b"\xff\x83")
    ):
        path = tmp_path / f"{i}.parquet"
        parquet.write_table(table.replace_schema_metadata({b"pandas": metadata}), path)
        (read,) = read_tracks(path)
        assert (len(read), read.label) == (3, "boat")
    wrong = table.set_column(0, "track_id", arrow.array([[1], [2], [3]]))
    parquet.write_table(wrong, tmp_path / "wrong.parquet")
    with pytest.raises(InputError, match=r"its track_id are list<.*>, no texts"):
        read_tracks(tmp_path / "wrong.parquet")


def test_a_parquet_file_of_too_many_rows_is_not_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A few kilobytes can say that a value stands in a billion rows."""
    pytest.importorskip("pyarrow", reason="needs sightline[parquet]")
    write_tracks([track("boat")], tmp_path / "a.parquet")
    monkeypatch.setattr("sightline.formats.parquet._MOST_ROWS", 2)
    with pytest.raises(InputError, match="says that it has 3 rows; at most 2 can be read"):
        read_tracks(tmp_path / "a.parquet")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": []}, "feature 1: its kind is no text and no number"),
        ({"label": {"a": 1}}, "feature 1: its label is no text and no number"),
        ({"track_id": [1]}, "feature 1: its track_id is no text and no number"),
        ({"track_id": 10**400}, "feature 1: 10{60}.* is no number"),
        ({"track_id": 10**30}, "feature 1: 10{30} is too large a number"),
        ({"time": "\ud800"}, "feature 1: .* is no time"),
        ({"time": float("nan")}, "feature 1: .* is no time"),
        ({"speed_mps": "fast"}, "fast is no number"),
        ({"kind": "\ud800"}, "unknown kind"),
    ],
)
def test_geojson_of_other_values_is_refused_in_a_line(
    tmp_path: Path, change: dict[str, object], message: str
) -> None:
    path = tmp_path / "a.geojson"
    write_tracks([track("boat")], path)
    document = json.loads(path.read_text())
    document["features"][0]["properties"].update(change)
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=message) as caught:
        read_tracks(path)
    assert "\n" not in str(caught.value)
