from __future__ import annotations

import json
import sys
import xml.etree.ElementTree as ET
from datetime import datetime
from pathlib import Path

import gpxpy
import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sightline.errors import InputError
from sightline.formats import read_fixes, read_tracks, track_writer, write_tracks
from sightline.geodesy import LocalPlane
from sightline.tracks import Tracks
from sightline.types import PointKind, Track

PLANE = LocalPlane(32.70297, -117.234631)


def make_track(
    seed: int = 0, n: int = 5, track_id: int = 7, label: str = "boat", plane: LocalPlane = PLANE
) -> Track:
    rng = np.random.default_rng(seed)
    roots = rng.normal(0.0, 3.0, (2, n, 2, 2))
    return Track(
        track_id=track_id,
        time_utc_s=1_601_467_200.0 + np.cumsum(rng.integers(1, 5000, n)) / 1000.0,
        east_m=rng.normal(0.0, 800.0, n),
        north_m=rng.normal(0.0, 800.0, n),
        velocity_east_mps=rng.normal(0.0, 5.0, n),
        velocity_north_mps=rng.normal(0.0, 5.0, n),
        covariance_m2=roots[0] @ roots[0].swapaxes(1, 2),
        velocity_covariance_m2ps2=roots[1] @ roots[1].swapaxes(1, 2),
        kind=rng.integers(0, 3, n).astype(np.int8),
        plane=plane,
        label=label,
    )


def same(read: Track, written: Track) -> None:
    """All that a table carries: nine places of a degree, milliseconds, micrometres a second."""
    assert (read.track_id, read.label, len(read)) == (written.track_id, written.label, len(written))
    np.testing.assert_array_equal(
        np.round(read.time_utc_s * 1000.0), np.round(written.time_utc_s * 1000.0)
    )
    np.testing.assert_allclose(read.latitude_deg, written.latitude_deg, rtol=0, atol=6e-10)
    np.testing.assert_allclose(read.longitude_deg, written.longitude_deg, rtol=0, atol=6e-10)
    np.testing.assert_allclose(read.velocity_east_mps, written.velocity_east_mps, atol=1e-5)
    np.testing.assert_allclose(read.velocity_north_mps, written.velocity_north_mps, atol=1e-5)
    np.testing.assert_array_equal(read.kind, written.kind)


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".gpkg"])
def test_tables_carry_everything(tmp_path: Path, suffix: str) -> None:
    if suffix == ".parquet":
        pytest.importorskip("pyarrow", reason="needs sightline[parquet]")
    if suffix == ".gpkg":
        pytest.importorskip("geopandas", reason="needs sightline[geopackage]")
    written = [make_track(0, 4, 3, ""), make_track(1, 1, 9, "ferry"), make_track(2, 30, 4)]
    path = tmp_path / f"tracks{suffix}"
    write_tracks(written, path)
    read = read_tracks(path, plane=PLANE)
    assert len(read) == 3
    for one, other in zip(read, written, strict=True):
        same(one, other)
        np.testing.assert_allclose(one.covariance_m2, other.covariance_m2, rtol=1e-14)
        np.testing.assert_allclose(
            one.velocity_covariance_m2ps2, other.velocity_covariance_m2ps2, rtol=1e-14
        )
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_parquet_is_read_as_geoparquet(tmp_path: Path) -> None:
    """By geopandas, which takes the geometry and its system of coordinates from the metadata."""
    geopandas = pytest.importorskip("geopandas", reason="needs sightline[geopackage]")
    pytest.importorskip("pyarrow", reason="needs sightline[parquet]")
    path = tmp_path / "tracks.parquet"
    written = [make_track(0, 4, 3, ""), make_track(1, 1, 9, "ferry")]
    write_tracks(written, path)
    table = geopandas.read_parquet(path)
    assert table.crs.to_authority() == ("OGC", "CRS84")
    assert set(table.geometry.geom_type) == {"Point"}
    np.testing.assert_array_equal(table.geometry.x, table["longitude_deg"])
    np.testing.assert_array_equal(table.geometry.y, table["latitude_deg"])
    np.testing.assert_allclose(table.geometry.y[:4], written[0].latitude_deg, rtol=0, atol=6e-10)
    # Without points it is one as well.
    write_tracks([], tmp_path / "none.parquet")
    assert len(geopandas.read_parquet(tmp_path / "none.parquet")) == 0


@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(1, 12),
    latitude=st.floats(-80.0, 80.0),
    longitude=st.floats(-179.0, 179.0),
    label=st.text("abcÄØ,\"'<&", max_size=6),
)
def test_tracks_survive_csv_and_geojson(
    tmp_path_factory: pytest.TempPathFactory,
    seed: int,
    n: int,
    latitude: float,
    longitude: float,
    label: str,
) -> None:
    written = make_track(seed, n, 5, label, LocalPlane(latitude, longitude))
    folder = tmp_path_factory.mktemp("tracks")
    for name in ("a.csv", "a.geojson"):
        write_tracks([written], folder / name)
        (read,) = read_tracks(folder / name, plane=written.plane)
        same(read, written)
        # GeoJSON has the 95 % ellipse, to a micrometre, instead of the covariance.
        np.testing.assert_allclose(read.covariance_m2, written.covariance_m2, atol=1e-4, rtol=1e-5)


def test_geojson_as_its_standard_has_it(tmp_path: Path) -> None:
    track = make_track()
    path = tmp_path / "tracks.geojson"
    write_tracks([track, make_track(1, 2, 8)], path)
    document = json.loads(path.read_text())
    assert document["type"] == "FeatureCollection"
    assert [f["properties"]["track_id"] for f in document["features"]] == [7] * 5 + [8] * 2
    feature = document["features"][2]
    assert feature["type"] == "Feature"
    assert feature["geometry"]["type"] == "Point"
    assert feature["geometry"]["coordinates"] == [
        round(track.longitude_deg[2], 9),
        round(track.latitude_deg[2], 9),
    ]
    known = feature["properties"]
    assert set(known) == {
        *("track_id", "time", "speed_mps", "course_deg", "kind", "state", "label"),
        *("semi_major_m", "semi_minor_m", "ellipse_bearing_deg"),
    }
    assert len(known["time"]) == len("2020-09-30T12:00:00.000Z")
    assert datetime.fromisoformat(known["time"]).timestamp() == track.time_utc_s[2]
    assert known["kind"] == PointKind(track.kind[2]).name.lower()
    # The chi-square quantile of 95 % with two degrees of freedom is 5.991.
    largest = np.linalg.eigvalsh(track.covariance_m2[2])[1]
    assert known["semi_major_m"] == pytest.approx(np.sqrt(5.9915 * largest), rel=1e-4)
    assert known["speed_mps"] == pytest.approx(
        np.hypot(track.velocity_east_mps[2], track.velocity_north_mps[2]), abs=1e-6
    )


def test_what_is_not_known_is_null_in_geojson(tmp_path: Path) -> None:
    track = make_track()
    unknown = np.full((5, 2, 2), np.nan)
    path = tmp_path / "tracks.geojson"
    write_tracks([Track(**{**vars(track), "covariance_m2": unknown})], path)
    assert json.loads(path.read_text())["features"][0]["properties"]["semi_major_m"] is None
    assert np.isnan(read_tracks(path)[0].covariance_m2).all()


@pytest.mark.parametrize("label", ["50 % full", '"%s", \\ {}\n', "100%%", "Fähre, 渡船", ""])
def test_a_label_of_any_characters_is_itself_again(tmp_path: Path, label: str) -> None:
    track = make_track(label=label, n=3)
    for suffix in (".geojson", ".csv"):
        write_tracks([track, make_track(1, track_id=8, n=1)], tmp_path / f"t{suffix}")
    features = json.loads((tmp_path / "t.geojson").read_text(encoding="utf-8"))["features"]
    assert [f["properties"]["label"] for f in features] == [label] * 3 + ["boat"]
    rows = pd.read_csv(tmp_path / "t.csv", keep_default_na=False)
    assert rows["label"].tolist() == [label] * 3 + ["boat"]


def test_gpx_is_read_by_others(tmp_path: Path) -> None:
    track = make_track(label="<sail>")
    path = tmp_path / "tracks.gpx"
    write_tracks([track, make_track(1, 2, 8)], path)
    gpx = gpxpy.parse(path.read_text())
    assert [t.number for t in gpx.tracks] == [7, 8]
    points = gpx.tracks[0].segments[0].points
    np.testing.assert_allclose([p.latitude for p in points], track.latitude_deg, atol=6e-10, rtol=0)
    times = [p.time.timestamp() for p in points if p.time]
    np.testing.assert_allclose(times, track.time_utc_s, rtol=0, atol=5e-4)
    read = read_tracks(path, plane=PLANE)
    assert [(t.track_id, t.label) for t in read] == [(7, "<sail>"), (8, "boat")]
    np.testing.assert_allclose(read[0].east_m, track.east_m, atol=1e-3)
    np.testing.assert_allclose(
        read[0].velocity_east_mps, np.gradient(track.east_m, track.time_utc_s), atol=1e-2
    )


def test_a_real_log_is_a_track(data_dir: Path) -> None:
    path = data_dir / "tracks-at-sea" / "target.gpx"
    (track,) = read_tracks(path)
    log = read_fixes(path)
    assert len(track) == np.unique(log.time_utc_s).size
    assert track.plane == LocalPlane(log.latitude_deg[0], log.longitude_deg[0])
    assert track.track_id == 1
    alone = np.flatnonzero(np.diff(log.time_utc_s, prepend=0, append=np.inf)[:-1] > 0)[0]
    assert track.latitude_deg[0] == pytest.approx(log.latitude_deg[alone], abs=1e-9)


KML, GX = "{http://www.opengis.net/kml/2.2}", "{http://www.google.com/kml/ext/2.2}"


def test_kml_has_a_time_for_every_place(tmp_path: Path) -> None:
    # Places of 1e-7 degrees would be written with an exponent, which not every reader takes.
    written = [
        make_track(label="ferry"),
        make_track(1, 1, 9, ""),
        make_track(2, 30, 4, plane=LocalPlane(0.0, 0.0)),
        make_track(3, 4, 5, plane=LocalPlane(-45.0, 179.0)),
    ]
    path = tmp_path / "tracks.kml"
    write_tracks(written, path)
    root = ET.parse(path).getroot()
    assert root.tag == f"{KML}kml"
    (document,) = root
    assert document.tag == f"{KML}Document"
    title, *placemarks = document
    assert (title.tag, title.text) == (f"{KML}name", "sightline")
    assert [mark.tag for mark in placemarks] == [f"{KML}Placemark"] * 4
    names = ["ferry 7", "track 9", "boat 4", "boat 5"]
    for track, mark, name in zip(written, placemarks, names, strict=True):
        assert [part.tag for part in mark] == [f"{KML}name", f"{GX}Track"]
        assert mark[0].text == name
        # The order of https://developers.google.com/kml/schema/kml22gx.xsd.
        mode, *rest = mark[1]
        assert (mode.tag, mode.text) == (f"{KML}altitudeMode", "clampToGround")
        times, places = rest[: len(track)], rest[len(track) :]
        assert {part.tag for part in times} == {f"{KML}when"}
        assert {part.tag for part in places} == {f"{GX}coord"}
        seconds = [datetime.fromisoformat(part.text or "").timestamp() for part in times]
        np.testing.assert_allclose(seconds, track.time_utc_s, rtol=0, atol=5e-4)
        assert not any("e" in (part.text or "") for part in places)
        read = np.array([(part.text or "").split() for part in places], dtype=float)
        expected = [track.longitude_deg, track.latitude_deg, np.zeros(len(track))]
        np.testing.assert_allclose(read, np.transpose(expected), rtol=0, atol=6e-10)


@pytest.mark.parametrize(
    ("label", "read"),
    [
        ("a <![CDATA[ b", "a <![CDATA[ b"),
        ("<![CDATA[<i>x</i>]]>", "<![CDATA[<i>x</i>]]>"),
        ("]]>", "]]>"),
        ("fish & chips &amp; &#60;", "fish & chips &amp; &#60;"),
        ("</name><name>", "</name><name>"),
        ("<?xml?><!-- ", "<?xml?><!-- "),
        ("\x00\x1b[31mred", "\ufffd\ufffd[31mred"),
        ("\ud800\uffff", "\ufffd\ufffd"),
        (" a\r\nb\tc ", " a\r\nb\tc "),
    ],
)
def test_any_label_is_text_in_kml(tmp_path: Path, label: str, read: str) -> None:
    path = tmp_path / "tracks.kml"
    write_tracks([make_track(label=label)], path)
    names = [element.text for element in ET.parse(path).getroot().iter(f"{KML}name")]
    assert names == ["sightline", f"{read} 7"]


@pytest.mark.parametrize("suffix", [".gpx", ".kml"])
def test_a_label_of_any_characters_makes_good_xml(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"tracks{suffix}"
    write_tracks([make_track(label="<b>&\x01\x0b 北 \ud800")], path)
    text = "".join(ET.parse(path).getroot().itertext())
    assert "<b>&\ufffd\ufffd 北 \ufffd 7" in text


@pytest.mark.parametrize("suffix", [".csv", ".geojson", ".gpx", ".kml", ".parquet", ".gpkg"])
def test_no_tracks_are_a_file_all_the_same(tmp_path: Path, suffix: str) -> None:
    if suffix == ".parquet":
        pytest.importorskip("pyarrow", reason="needs sightline[parquet]")
    if suffix == ".gpkg":
        pytest.importorskip("geopandas", reason="needs sightline[geopackage]")
    path = tmp_path / f"tracks{suffix}"
    write_tracks([], path)
    assert path.stat().st_size > 0
    if suffix != ".kml":
        with pytest.raises(InputError, match="holds no"):
            read_tracks(path)


def test_tracks_of_others_need_only_time_and_place(tmp_path: Path) -> None:
    path = tmp_path / "tracks.csv"
    path.write_text(
        "track_id,time_utc,latitude_deg,longitude_deg\n"
        "4,2020-09-30T12:00:00Z,32.7,-117.2\n9,0,1,1\n4,2020-09-30T12:00:02Z,32.70009,-117.2\n"
    )
    first, second = read_tracks(path)
    assert (first.track_id, second.track_id) == (4, 9)
    # 0.00009 degrees of a meridian are ten metres.
    np.testing.assert_allclose(first.velocity_north_mps, 9.98 / 2.0, atol=0.01)
    assert (first.kind == PointKind.MEASURED).all()
    assert np.isnan(first.covariance_m2).all()
    assert second.speed_mps.tolist() == [0.0]


@pytest.mark.parametrize("suffix", [".geojson", ".gpx", ".kml", ".csv"])
def test_a_failure_half_way_leaves_nothing(tmp_path: Path, suffix: str) -> None:
    def fail_after_one() -> None:
        with track_writer(tmp_path / f"tracks{suffix}") as writer:
            writer.add(make_track())
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail_after_one()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("suffix", "extra"), [("parquet", "parquet"), ("gpkg", "geopackage")])
def test_a_missing_extra_says_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str, extra: str
) -> None:
    for name in ("pyarrow", "geopandas"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError, match=rf'pip install "sightline\[{extra}\]"'):
        write_tracks([make_track()], tmp_path / f"tracks.{suffix}")
    assert list(tmp_path.iterdir()) == []


HEAD = "track_id,time_utc,latitude_deg,longitude_deg"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.shp", "x", r"ends in '\.shp'; known are \.geojson, \.gpx, \.csv"),
        ("a.csv", "track_id,time_utc\n1,2\n", "lacks the columns latitude_deg, longitude_deg"),
        ("a.csv", HEAD + "\n", "holds no point"),
        ("a.csv", HEAD + "\n1,5,0,0\n1,5,0,0\n", "track 1: point 2 is not later"),
        ("a.csv", HEAD + "\n1,5,91,0\n", "latitude 91, longitude 0 is not on the earth"),
        ("a.csv", HEAD + ",kind\n1,5,0,0,guessed\n", "unknown kind 'guessed'; known are measured"),
        ("a.geojson", '{"type": "FeatureColl', "is no JSON, is damaged, or is cut short"),
        ("a.geojson", "[1]", "is no GeoJSON FeatureCollection"),
        ("a.geojson", '{"features": [{"geometry": null}]}', "feature 1: is no Point"),
        ("a.geojson", "[" * 100_000, "is no JSON"),
        ("a.gpx", '<gpx version="1.1"></gpx>', "holds no track"),
    ],
)
def test_refused_tracks(tmp_path: Path, name: str, content: str, message: str) -> None:
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(InputError, match=message) as caught:
        read_tracks(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("time_utc", "noon", r"row \d: noon is no time \(time_utc\)"),
        ("track_id", "x", r"x is no number \(track_id\)"),
        ("latitude_deg", "north", r"row \d: north is no number \(latitude_deg\)"),
        ("speed_mps", "fast", r"row \d: fast is no number \(speed_mps\)"),
        ("var_east_m2", "much", r"row \d: much is no number \(var_east_m2\)"),
    ],
)
@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_text_where_a_number_belongs(
    tmp_path: Path, column: str, value: str, message: str, suffix: str
) -> None:
    path = tmp_path / f"tracks{suffix}"
    rows = Tracks((make_track(),)).to_dataframe().astype({column: str})
    rows.loc[1, column] = value
    if suffix == ".csv":
        rows.to_csv(path, index=False)
        message = message.replace("row", "(row|line)")
    else:
        rows.to_parquet(path, index=False)
    with pytest.raises(InputError, match=message):
        read_tracks(path)


def test_an_unknown_ending_lists_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"known are \.geojson, \.gpx, \.kml, \.csv, \.parquet"):
        write_tracks([], tmp_path / "tracks.shp")


def test_a_set_of_tracks(tmp_path: Path) -> None:
    tracks = Tracks((make_track(), make_track(1, 3, 8, "ferry")))
    assert len(tracks) == 2
    assert [track.track_id for track in tracks] == [7, 8]
    assert tracks[1].label == "ferry"
    tracks.write(tmp_path / "tracks.csv")
    read = Tracks.read(tmp_path / "tracks.csv", plane=PLANE)
    same(read[1], tracks[1])


def test_tracks_as_a_data_frame() -> None:
    table = Tracks((make_track(), make_track(1, 3, 8))).to_dataframe()
    assert len(table) == 8
    assert str(table["time_utc"].dt.tz) == "UTC"
    moments = (table["time_utc"] - pd.Timestamp(0, tz="UTC")).dt.total_seconds()
    np.testing.assert_allclose(moments[:5], make_track().time_utc_s, rtol=0, atol=5e-4)
    np.testing.assert_allclose(table["var_east_m2"][:5], make_track().covariance_m2[:, 0, 0])
    assert Tracks(()).to_dataframe().columns.equals(table.columns)
