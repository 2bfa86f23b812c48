"""GPX as other programs write it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sightline.errors import InputError
from sightline.formats import read_fixes, read_tracks
from sightline.formats.gpx import read_gpx_table
from sightline.tally import Tally

START_S = 1_717_236_000.0
GPX11 = "http://www.topografix.com/GPX/1/1"
PLACES = [(54.3, 10.1), (54.30001, 10.10002), (54.30002, 10.10004)]


def points(tag: str = "trkpt", inside: str = "<{0}time>{1}</{0}time>", prefix: str = "") -> str:
    return "".join(
        f'<{prefix}{tag} lat="{latitude}" lon="{longitude}">'
        + inside.format(prefix, f"2024-06-01T10:00:0{second}Z")
        + f"</{prefix}{tag}>"
        for second, (latitude, longitude) in enumerate(PLACES)
    )


TRACK = "<trk><trkseg>{}</trkseg></trk>"
ROOT = f'<gpx version="1.1" creator="x" xmlns="{GPX11}" xmlns:a="urn:a">'
TIMED = "<time>{1}</time>"

FORMS = {
    "plain": f"{ROOT}{TRACK.format(points())}</gpx>",
    "no namespace, no version": f"<gpx>{TRACK.format(points())}</gpx>",
    "1.0": (
        '<gpx version="1.0" xmlns="http://www.topografix.com/GPX/1/0">'
        + TRACK.format(points(inside="<time>{1}</time><course>90</course><speed>3.1</speed>"))
        + "</gpx>"
    ),
    "a version to come": (
        '<gpx version="2.0" xmlns="http://www.topografix.com/GPX/2/0">'
        + TRACK.format(points())
        + "</gpx>"
    ),
    "prefixed": (
        f'<g:gpx xmlns:g="{GPX11}"><g:trk><g:trkseg>'
        + points(prefix="g:")
        + "</g:trkseg></g:trk></g:gpx>"
    ),
    "default namespace of an extension": (
        f'<g:gpx xmlns="urn:ext" xmlns:g="{GPX11}"><g:trk><g:trkseg>'
        + points(
            prefix="g:",
            inside="<{0}time>{1}</{0}time><{0}extensions><hr>70</hr><time>1</time></{0}extensions>",
        )
        + "</g:trkseg></g:trk></g:gpx>"
    ),
    "single quotes and blanks": (
        f"<?xml version='1.0' encoding='UTF-8'?>\n<gpx version='1.1' xmlns='{GPX11}'>"
        + TRACK.format(points(inside="\n <time>\n  {1}\n </time>\n"))
        + "</gpx>\n"
    ),
    "times and speeds of extensions": ROOT
    + TRACK.format(
        points(
            inside=TIMED + "<a:time>1999-01-01T00:00:00Z</a:time><extensions>"
            "<a:speed>3,1</a:speed><time>1999-01-01T00:00:00Z</time></extensions>"
        )
    )
    + "</gpx>",
    "an extension of a track with points of its own": ROOT
    + "<trk><extensions><l xmlns='urn:l'><trkpt lat='1' lon='2'/></l></extensions><trkseg>"
    + points()
    + "</trkseg></trk></gpx>",
    "another default namespace within": ROOT
    + "<trk><extensions><line xmlns='urn:style'><color>ff</color></line></extensions><trkseg>"
    + points()
    + "</trkseg></trk></gpx>",
    "CDATA and entities": ROOT
    + TRACK.format(points(inside="<time><![CDATA[{1}]]></time><name>&amp;</name>"))
    + "</gpx>",
    "decimal commas": f"{ROOT}{TRACK.format(points().replace('.', ','))}</gpx>",
    "segments out of order": ROOT
    + "".join(TRACK.format(part + "</trkpt>") for part in points().split("</trkpt>")[2::-1])
    + "</gpx>",
    "a time of its metadata and waypoints beside": ROOT
    + "<metadata><time>1999-01-01T00:00:00Z</time></metadata><wpt lat='1' lon='2'/>"
    + TRACK.format(points())
    + "</gpx>",
    "a track that stands twice": f"{ROOT}{TRACK.format(points()) * 2}</gpx>",
    "routes": f"{ROOT}<metadata/><rte><name>r</name>{points('rtept')}</rte></gpx>",
    "waypoints": f"{ROOT}{points('wpt')}</gpx>",
}


@pytest.mark.parametrize("form", FORMS)
def test_forms_of_gpx(tmp_path: Path, form: str) -> None:
    path = tmp_path / "log.gpx"
    path.write_text(FORMS[form])
    tally = Tally(path)
    fixes = read_fixes(path, tally=tally)
    np.testing.assert_array_equal(fixes.time_utc_s - START_S, [0.0, 1.0, 2.0])
    np.testing.assert_array_equal(fixes.latitude_deg, [latitude for latitude, _ in PLACES])
    np.testing.assert_array_equal(fixes.longitude_deg, [longitude for _, longitude in PLACES])
    assert tally.read["fixes"] == 3
    of_no_track = form in ("routes", "waypoints")
    assert ("it has no track; its" in "".join(tally.notes)) == of_no_track
    assert (tally.total_left_out > 0) == (form == "a track that stands twice")


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "iso-8859-1", "cp1252"])
def test_encodings_of_gpx(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "log.gpx"
    declared = {"utf-8-sig": "UTF-8", "utf-16-le": "UTF-16", "cp1252": "windows-1252"}
    head = f'<?xml version="1.0" encoding="{declared.get(encoding, encoding)}"?>\n'
    track = TRACK.format(points()).replace("<trkseg>", "<name>Möwe</name><trkseg>")
    path.write_bytes(f"{head}{ROOT}{track}</gpx>".encode(encoding))
    fixes = read_fixes(path)
    assert fixes.name == "Möwe"
    assert len(fixes) == 3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (FORMS["plain"] + FORMS["plain"], "junk after document element"),
        (FORMS["plain"].replace("xmlns:a", "xmlns:b").replace("<trk>", "<trk><a:b/>"), "prefix"),
        (
            "<osm><node/></osm>",
            "its first element is osm; expected GPX, KML with a gx:Track, or TCX",
        ),
        (ROOT + "<trk>" * 100_000, "its elements lie too deep"),
        (ROOT + "<a:b>" * 150 + "</a:b>" * 150 + "</gpx>", "has no track points"),
        (FORMS["plain"].replace("54.3000", "north"), r"point 2: north1 is no number \(lat\)"),
        (
            ROOT + TRACK.format(points().replace("10.1", "1" * 4000)) + "</gpx>",
            r"\.\.\. is no number \(lon\)|not on the earth",
        ),
        ('<!DOCTYPE gpx SYSTEM "file:///etc/passwd">' + FORMS["plain"], "declares a document type"),
        (
            '<!DOCTYPE gpx [<!ENTITY a "b">]>' + FORMS["plain"].replace('version="1.1"', 'v="&a;"'),
            "declares a document type",
        ),
        (FORMS["plain"].replace("<time>", "<time>&b;"), "undefined entity"),
        ('<?xml version="1.0" encoding="punycode"?>' + FORMS["plain"], "encoding punycode"),
        (ROOT + TRACK.format(points(inside="")) + "</gpx>", "none of its 3 points has a time"),
        (ROOT + points("wpt", inside="") + "</gpx>", "has no track points"),
        (ROOT + f"<trkseg>{points()}</trkseg></gpx>", "has no track points"),
        (ROOT + f"<extensions>{TRACK.format(points())}</extensions></gpx>", "has no track points"),
        (
            FORMS["plain"].replace("10:00:0", "10:\n\x85\n00:0"),
            "point 1: 2024-06-01T10: .* is no",
        ),
    ],
)
def test_what_is_no_gpx_is_refused_by_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "log.gpx"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_fixes(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 600


def test_the_line_of_a_fault_is_that_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "log.gpx"
    path.write_text(f'<?xml version="1.0"?>\n{ROOT}\n<trk>\n<trkseg>\n</trk></gpx>')
    with pytest.raises(InputError, match="mismatched tag: line 5"):
        read_fixes(path)


def test_points_without_a_place_are_left_out_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "log.gpx"
    path.write_text(ROOT + TRACK.format(points().replace("54.30001", "NaN")) + "</gpx>")
    tally = Tally(path)
    assert len(read_fixes(path, tally=tally)) == 2
    assert tally.reasons() == "1 without a place (point 2: NaN, 10.10002)"


def test_compressed_logs_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.gpx"
    path.write_bytes(b"\x1f\x8b\x08" + bytes(range(3, 60)))
    with pytest.raises(InputError, match="is a compressed file or a spreadsheet; unpack it"):
        read_fixes(path)


def test_points_of_a_track_that_share_a_time_across_the_date_line(tmp_path: Path) -> None:
    path = tmp_path / "tracks.gpx"
    text = "".join(
        f'<trkpt lat="0" lon="{longitude}"><time>2024-06-01T10:00:0{second}Z</time></trkpt>'
        for second, longitude in ((0, 179.98), (1, 179.99), (1, -179.97), (2, -179.96))
    )
    path.write_text(ROOT + TRACK.format(text) + "</gpx>")
    rows = read_gpx_table(path)
    np.testing.assert_allclose(rows["longitude_deg"], [179.98, -179.99, -179.96], atol=1e-9)
    (track,) = read_tracks(path)
    # 0.03 degrees of the equator are 3.34 km.
    assert np.hypot(np.diff(track.east_m), np.diff(track.north_m))[0] == pytest.approx(3340, abs=2)


def test_tracks_keep_what_a_log_would_lose(tmp_path: Path) -> None:
    path = tmp_path / "tracks.gpx"
    jump = points().replace('lat="54.30001"', 'lat="54.9"')
    path.write_text(ROOT + TRACK.format(jump) + "</gpx>")
    (track,) = read_tracks(path)
    assert len(track) == 3
    assert len(read_fixes(path)) == 2


def two_tracks(path: Path, first_m: np.ndarray, second_m: np.ndarray, late_s: float) -> Tally:
    """Read two tracks, each (N, 2) metres east and north at whole seconds, the second later."""
    text = ""
    for name, begin_s, east_north_m in (("Anna", 0.0, first_m), ("Elsa", late_s, second_m)):
        rows = "".join(
            f'<trkpt lat="{54.3 + north / 111_320.0:.8f}" lon="{10.1 + east / 64_960.0:.8f}">'
            f"<time>{np.datetime64(int((START_S + begin_s + i) * 1000), 'ms')}Z</time></trkpt>"
            for i, (east, north) in enumerate(east_north_m)
        )
        text += f"<trk><name>{name}</name><trkseg>{rows}</trkseg></trk>"
    path.write_text(f"{ROOT}{text}</gpx>", encoding="utf-8")
    tally = Tally(path)
    fixes = read_fixes(path, tally=tally)
    tally.count("read", len(fixes))
    return tally


def lap(radius_m: float, phase: float, seconds: int = 200) -> np.ndarray:
    angle = phase + np.arange(seconds) * 4.0 / radius_m
    return radius_m * np.stack([np.sin(angle), np.cos(angle)], axis=1)


def test_laps_of_one_device_are_all_read(tmp_path: Path) -> None:
    tally = two_tracks(tmp_path / "log.gpx", lap(80.0, 0.0), lap(60.0, 1.0), 230.0)
    assert tally.read["read"] == 400
    assert not tally.left_out
    assert tally.notes == ["its 2 tracks (Anna, Elsa) are read as those of one vessel"]


@pytest.mark.parametrize("late_s", [0.0, 60.0])
def test_two_boats_near_each_other_are_refused(tmp_path: Path, late_s: float) -> None:
    """They sail laps of their own, 20 to 180 m apart; one log would leap from one to the other."""
    with pytest.raises(InputError, match=r"track Elsa is of the same times as another .* in the"):
        two_tracks(tmp_path / "log.gpx", lap(100.0, 0.0), lap(80.0, 2.0), late_s)


@pytest.mark.parametrize("apart_m", [3.0, 25.0, 200.0])
def test_two_receivers_on_board_of_one_ship_are_not_mixed(tmp_path: Path, apart_m: float) -> None:
    """One at the bow and one astern: the ship turns, and they keep their distance."""
    noise = np.random.default_rng(1).normal(0.0, 1.5, (2, 200, 2))
    middle, ahead = lap(400.0, 0.0), lap(400.0, 0.5 * np.pi) / 400.0
    bow, stern = middle + 0.5 * apart_m * ahead, middle - 0.5 * apart_m * ahead
    astern = (stern + noise[1])[100:]
    tally = two_tracks(tmp_path / "log.gpx", bow + noise[0], astern, 100.0)
    assert tally.left_out["of a track of the same times as a longer one"].count in (98, 99)


def test_two_receivers_of_a_ship_at_anchor_are_not_mixed(tmp_path: Path) -> None:
    noise = np.random.default_rng(1).normal(0.0, 1.5, (2, 200, 2))
    tally = two_tracks(tmp_path / "log.gpx", noise[0], noise[1] + (80.0, 0.0), 0.0)
    assert tally.left_out["of a track of the same times as a longer one"].count in (198, 199)
