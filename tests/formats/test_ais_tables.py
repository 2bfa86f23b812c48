"""AIS as tables of authorities: a row a report, of one vessel among many."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from sightline.errors import InputError
from sightline.formats import holds_ais, read_ais_feed, read_fixes
from sightline.tally import Tally

START_S = 1_709_287_200.0  # 2024-03-01T10:00:00Z: the first of March, or the third of January.
MMSI = (211_000_001, 366_000_002)
SECONDS = np.arange(0, 300, 10)


def north_deg(second: float, vessel: int) -> float:
    """The first goes north at 10 knots, the second at 20."""
    return 54.3 + vessel + second * (vessel + 1) * 10.0 / 3600.0 / 60.0


def on(second: float, form: str) -> str:
    return datetime.fromtimestamp(START_S + float(second), UTC).strftime(form)


def marine_cadastre(second: float, vessel: int) -> str:
    when, knots = on(second, "%Y-%m-%dT%H:%M:%S"), 10.0 * (vessel + 1)
    return f"{MMSI[vessel]},{when},{north_deg(second, vessel):.7f},10.1,{knots},0.0,511.0,NAME,,,0"


def danish(second: float, vessel: int) -> str:
    when, knots = on(second, "%d/%m/%Y %H:%M:%S"), 10.0 * (vessel + 1)
    place = f"{north_deg(second, vessel):.7f},10.1"
    return f"{when},Class A,{MMSI[vessel]},{place},Under way using engine,0.0,{knots},0.0,358,IMO"


HEADS = {
    "MarineCadastre": (
        "MMSI,BaseDateTime,LAT,LON,SOG,COG,Heading,VesselName,IMO,CallSign,VesselType",
        marine_cadastre,
    ),
    "Denmark": (
        "# Timestamp,Type of mobile,MMSI,Latitude,Longitude,Status,ROT,SOG,COG,Heading,IMO",
        danish,
    ),
    "metres a second": (
        "mmsi;time;lat;lon;speed (m/s);course",
        lambda s, v: (
            f"{MMSI[v]};{START_S + s:.0f};{north_deg(s, v):.7f};10.1;{(v + 1) * 5.144444444:.6f};0"
        ),
    ),
    "km/h": (
        "mmsi,time,lat,lon,speed_kmh,course_deg",
        lambda s, v: f"{MMSI[v]},{START_S + s:.0f},{north_deg(s, v):.7f},10.1,{(v + 1) * 18.52},0",
    ),
}


def write(path: Path, form: str, vessels: tuple[int, ...] = (0, 1)) -> Path:
    head, row = HEADS[form]
    rows = [row(second, vessel) for second in SECONDS for vessel in vessels]
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


@pytest.mark.parametrize("form", HEADS)
def test_one_vessel_is_chosen_by_its_mmsi(tmp_path: Path, form: str) -> None:
    path = write(tmp_path / "ais.csv", form)
    assert holds_ais(path)
    for vessel, mmsi in enumerate(MMSI):
        fixes = read_fixes(path, mmsi=mmsi)
        assert fixes.name == str(mmsi)
        np.testing.assert_allclose(fixes.time_utc_s - START_S, SECONDS, rtol=0, atol=1e-6)
        north = [north_deg(second, vessel) for second in SECONDS]
        np.testing.assert_allclose(fixes.latitude_deg, north, rtol=0, atol=1e-7)
    with pytest.raises(InputError, match=r"2 vessels, say which MMSI: 211000001 \(30 fixes\), 36"):
        read_fixes(path)
    with pytest.raises(InputError, match="holds no vessel with the MMSI 7; it holds 211000001"):
        read_fixes(path, mmsi=7)


@pytest.mark.parametrize("form", HEADS)
def test_speeds_have_their_units(tmp_path: Path, form: str) -> None:
    feed = read_ais_feed(write(tmp_path / "ais.csv", form))
    assert sorted(feed) == sorted(MMSI)
    for vessel, mmsi in enumerate(MMSI):
        # A knot is a minute of latitude an hour.
        expected = np.tile([0.0, (vessel + 1) * 10.0 * 1852.0 / 3600.0], (SECONDS.size, 1))
        np.testing.assert_allclose(feed[mmsi].velocity_mps, expected, rtol=0, atol=1e-4)


def test_a_speed_without_a_unit_is_not_used(tmp_path: Path) -> None:
    path = write(tmp_path / "ais.csv", "km/h")
    path.write_text(path.read_text().replace("speed_kmh", "speed"))
    tally = Tally(path)
    feed = read_ais_feed(path, tally=tally)
    assert all(np.isnan(vessel.velocity_mps).all() for vessel in feed.values())
    assert "call it speed_kn, speed_mps or speed_kmh" in "".join(tally.notes)


def test_a_table_of_one_vessel_needs_no_choice(tmp_path: Path) -> None:
    assert len(read_fixes(write(tmp_path / "ais.csv", "Denmark", (1,)))) == SECONDS.size
    path = tmp_path / "log.csv"
    path.write_text("time,lat,lon,mmsi\n2024-03-01T10:00:00Z,54.3,10.1,\n")
    assert len(read_fixes(path)) == 1
    with pytest.raises(InputError, match="no AIS sentence and no column mmsi"):
        read_fixes(path, mmsi=MMSI[0])


def test_what_no_transponder_knows_is_left_out(tmp_path: Path) -> None:
    path = write(tmp_path / "ais.csv", "Denmark")
    lines = path.read_text().splitlines()
    base = lines[1].split(",")
    lines[5:5] = [
        ",".join([*base[:3], "91", "181", *base[5:]]),
        ",".join([*base[:2], "", *base[3:]]),
        ",".join([*base[:3], "0.0", "0.0", *base[5:]]),
        ",".join(["01/03/2080 10:00:00", *base[1:]]),
        ",".join([*base[:2], "not known", *base[3:]]),
        base[0],
    ]
    path.write_text("\n".join(lines) + "\n")
    tally = Tally(path)
    fixes = read_fixes(path, mmsi=MMSI[0], tally=tally)
    assert len(fixes) == SECONDS.size
    assert {why: (left.count, left.row) for why, left in tally.left_out.items()} == {
        "cut short": (1, "line 11"),
        "without an MMSI": (2, "line 7"),
        "position reports without a place": (2, "line 6"),
        "with a time that is years from the others": (1, "line 9"),
    }
