"""Logs in KML and TCX, and KML that is no log."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sightline.errors import InputError
from sightline.formats import read_fixes, write_tracks
from sightline.geodesy import LocalPlane
from sightline.tally import Tally
from sightline.types import Track

START_S = 1_717_236_000.0
N = 30
LATITUDE = 54.32 + np.round(2e-5 * np.arange(N), 7)
LONGITUDE = 10.13 + np.round(3e-5 * np.arange(N), 7)
TIMES = [f"2024-06-01T10:00:{i:02d}Z" for i in range(N)]
COORDS = [f"{east:.7f} {north:.7f} 0" for east, north in zip(LONGITUDE, LATITUDE, strict=True)]
NAMES = (
    'xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2" '
    'xmlns:kml="http://www.opengis.net/kml/2.2"'
)


def kml(inner: str) -> str:
    head = f'<?xml version="1.0" encoding="UTF-8"?>\n<kml {NAMES}><Document><name>log</name>'
    return f"{head}{inner}</Document></kml>"


def each(form: str, first: int = 0, last: int = N) -> str:
    rows = range(first, last)
    return "".join(
        form.format(t=TIMES[i], c=COORDS[i], p=COORDS[i].replace(" ", ",")) for i in rows
    )


def whole(first: int = 0, last: int = N) -> str:
    whens, coords = (each(f, first, last) for f in ("<when>{t}</when>", "<gx:coord>{c}</gx:coord>"))
    return f"<gx:Track><altitudeMode>absolute</altitudeMode>{whens}{coords}</gx:Track>"


STYLE = "<TimeStamp><when>1999-01-01T00:00:00Z</when></TimeStamp>"
LOGS = {
    "a track": kml(f"<Placemark><name>boat</name>{whole()}</Placemark>"),
    "by turns": kml(
        "<Placemark><gx:Track>"
        + each("<when> {t} </when>\n<gx:coord>{c}</gx:coord>")
        + "</gx:Track></Placemark>"
    ),
    "tracks in parts": kml(
        f"<Placemark><gx:MultiTrack>{whole(0, 9)}{whole(9)}</gx:MultiTrack></Placemark>"
    ),
    "a time of the folder": kml(f"{STYLE}<Placemark>{whole()}</Placemark>"),
    "version 2.3": kml(f"<Placemark>{whole()}</Placemark>").replace("gx:", ""),
    "a prefix": kml(
        "<kml:Placemark><gx:Track>"
        + each("<kml:when>{t}</kml:when><gx:coord>{c}</gx:coord>")
        + "</gx:Track></kml:Placemark>"
    ),
    "placemarks": kml(
        each(
            "<Placemark><name>{t}</name><TimeStamp><when>{t}</when></TimeStamp>"
            "<Point><coordinates>{p}</coordinates></Point></Placemark>"
        )
    ),
    "a line besides": kml(
        f"<Placemark>{whole()}</Placemark>"
        f"<Placemark><LineString><coordinates>{each('{p} ')}</coordinates></LineString></Placemark>"
    ),
    "TCX": (
        '<?xml version="1.0"?><TrainingCenterDatabase xmlns="http://www.garmin.com/xmlschemas/'
        'TrainingCenterDatabase/v2"><Activities><Activity Sport="Other"><Id>1999</Id>'
        '<Lap StartTime="1999"><Track>'
        + "".join(
            f"<Trackpoint><Time>{t}</Time><Position><LatitudeDegrees>{c.split()[1]}"
            f"</LatitudeDegrees><LongitudeDegrees>{c.split()[0]}</LongitudeDegrees></Position>"
            "<Extensions><Time>1999-01-01T00:00:00Z</Time></Extensions></Trackpoint>"
            for t, c in zip(TIMES, COORDS, strict=True)
        )
        + "</Track></Lap></Activity></Activities></TrainingCenterDatabase>"
    ),
}


@pytest.mark.parametrize("name", ["log.kml", "log.xml", "log"])
@pytest.mark.parametrize("form", LOGS)
def test_logs_in_other_xml(tmp_path: Path, form: str, name: str) -> None:
    (tmp_path / name).write_text(LOGS[form])
    tally = Tally(tmp_path / name)
    fixes = read_fixes(tmp_path / name, tally=tally)
    np.testing.assert_allclose(fixes.time_utc_s - START_S, np.arange(N), rtol=0, atol=1e-6)
    np.testing.assert_allclose(fixes.latitude_deg, LATITUDE, rtol=0, atol=1e-9)
    np.testing.assert_allclose(fixes.longitude_deg, LONGITUDE, rtol=0, atol=1e-9)
    assert tally.format == ("TCX" if form == "TCX" else "KML")
    assert not tally.left_out


def test_a_place_that_is_empty_is_left_out(tmp_path: Path) -> None:
    text = LOGS["a track"].replace(f"<gx:coord>{COORDS[4]}</gx:coord>", "<gx:coord></gx:coord>")
    (tmp_path / "log.kml").write_text(text)
    tally = Tally("log.kml")
    assert len(read_fixes(tmp_path / "log.kml", tally=tally)) == N - 1
    assert tally.left_out["without a place"].row == "point 5"


def test_tracks_that_were_written_are_read_as_a_log(tmp_path: Path) -> None:
    column, still = np.zeros(N), np.tile(np.eye(2), (N, 1, 1))
    times, kind = START_S + np.arange(N), np.zeros(N, dtype=np.int8)
    plane = LocalPlane(54.32, 10.13)
    north = 3.0 * np.arange(N)
    track = Track(1, times, column, north, column, column, still, still, kind, plane)
    write_tracks([track], tmp_path / "tracks.kml")
    fixes = read_fixes(tmp_path / "tracks.kml")
    np.testing.assert_allclose(fixes.time_utc_s, times, rtol=0, atol=1e-3)
    np.testing.assert_allclose(
        plane.to_plane(fixes.latitude_deg, fixes.longitude_deg)[1], north, rtol=0, atol=1e-3
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            LOGS["a track"].replace(f"<when>{TIMES[4]}</when>", ""),
            r"has 29 times \(when\) and 30 places \(gx:coord\) in a track, which are to be as many",
        ),
        (
            kml("<Placemark><LineString><coordinates>10,54</coordinates></LineString></Placemark>"),
            "is KML, and holds no gx:Track and no Placemark .* export the log as GPX",
        ),
        (
            kml("<NetworkLink><Link><href>http://127.0.0.1:9/</href></Link></NetworkLink>"),
            "no gx:T",
        ),
        (LOGS["a track"][:-300], "is damaged, or is cut short"),
        (LOGS["TCX"].replace("<Time>", "<Tide>").replace("</Time>", "</Tide>"), "has a time"),
        (
            '<!DOCTYPE kml [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><kml>&b;</kml>',
            "declares a document type",
        ),
    ],
)
def test_what_is_no_log_is_refused_by_one_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "log.kml").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_fixes(tmp_path / "log.kml")
    assert "\n" not in str(caught.value)
