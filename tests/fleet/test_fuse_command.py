"""`sightline fuse` from files to files, and what it refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sightline.cli import main
from sightline.errors import InputError
from sightline.fleet import read_fleet
from sightline.formats import read_tracks, write_tracks
from sightline.geodesy import LocalPlane
from sightline.types import Track

PLANE = LocalPlane(54.3233, 10.1394)
START = 1_717_236_000.0


def track(number: int, north_m: float, span: tuple[int, int], mmsi: int | None = None) -> Track:
    """A vessel that goes east."""
    times = np.arange(span[0], span[1] + 1, dtype=float)
    n = times.size
    return Track(
        track_id=number,
        time_utc_s=START + times,
        east_m=3.0 * times,
        north_m=np.full(n, north_m),
        velocity_east_mps=np.full(n, 3.0),
        velocity_north_mps=np.zeros(n),
        covariance_m2=np.tile(np.diag([4.0, 9.0]), (n, 1, 1)),
        velocity_covariance_m2ps2=np.tile(0.1 * np.eye(2), (n, 1, 1)),
        kind=np.zeros(n, dtype=np.int8),
        plane=PLANE,
        label="vessel",
        mmsi=mmsi,
        name="Anna" if mmsi else "",
    )


PIER = (track(1, 0.0, (0, 60)), track(2, 80.0, (0, 60)))
MOLE = (track(5, 80.0, (30, 90), 211000001), track(6, 0.0, (30, 90)))


def fleet(folder: Path, suffix: str = ".csv", more: str = "") -> Path:
    """Two cameras with their tracks in files."""
    write_tracks(PIER, folder / f"pier{suffix}")
    write_tracks(MOLE, folder / f"mole{suffix}", fused=True)
    path = folder / "fleet.toml"
    path.write_text(
        "".join(
            f'[[cameras]]\nname = "{name}"\ntracks = ["{name}{suffix}"]\n'
            for name in ("pier", "mole")
        )
        + more
    )
    return path


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as end:
        main([str(one) for one in arguments])
    return int(end.value.code or 0)


@pytest.mark.parametrize("suffix", [".csv", ".geojson", ".parquet", ".gpkg"])
def test_two_cameras_from_files_to_files(tmp_path: Path, suffix: str) -> None:
    outputs = [tmp_path / f"fused{ending}" for ending in (suffix, ".gpx", ".kml", ".mfjson")]
    options = [part for path in outputs for part in ("-o", path)]
    code = run("fuse", fleet(tmp_path, suffix), *options, "--json", tmp_path / "result.json")
    assert code == 0
    found = read_tracks(outputs[0], plane=PLANE)
    assert [len(one) for one in found] == [91, 91]
    south, north = sorted(found, key=lambda one: one.north_m[0])
    assert (south.mmsi, south.name) == (None, "")
    assert (north.mmsi, north.name) == (211000001, "Anna")
    assert north.east_m == pytest.approx(3.0 * np.arange(91), abs=0.01)
    assert north.covariance_m2[45, 0, 0] < 0.7 * north.covariance_m2[10, 0, 0]
    result = json.loads((tmp_path / "result.json").read_text())
    assert (result["targets"], result["shared"], result["handovers"]) == (2, 2, 0)
    assert [one["name"] for one in result["cameras"]] == ["pier", "mole"]
    assert result["identities"] == [{"track_id": north.track_id, "mmsi": 211000001, "name": "Anna"}]
    assert all(path.is_file() for path in outputs)
    # What it wrote it may replace, and what it reads it never does.
    assert run("fuse", tmp_path / "fleet.toml", *options, "--json", tmp_path / "result.json") == 0
    assert run("fuse", tmp_path / "fleet.toml", "-o", tmp_path / f"pier{suffix}") == 2


def test_tables_say_which_cameras_saw_a_target(tmp_path: Path) -> None:
    assert run("fuse", fleet(tmp_path), "-o", tmp_path / "fused.csv", "--interval", "0.5") == 0
    table = pd.read_csv(tmp_path / "fused.csv")
    by = table[table["track_id"] == 1].set_index("time_utc")["cameras"]
    assert list(by.unique()) == ["pier", "pier mole", "mole"]
    assert (by == "pier mole").sum() == 61
    assert set(table.loc[table["name"] == "Anna", "mmsi"]) == {211000001}


def test_a_camera_is_where_the_fleet_file_says(tmp_path: Path) -> None:
    path = fleet(tmp_path)
    text = path.read_text().replace(
        'name = "pier"', 'name = "pier"\nlatitude_deg = 54.32\nlongitude_deg = 10.14'
    )
    path.write_text(text + "[fusion]\nbias_m = 1.0\nlongest_gap_s = 20.0\n")
    assert run("fuse", path, "-o", tmp_path / "a.csv", "--json", tmp_path / "a.json") == 0
    pier, mole = json.loads((tmp_path / "a.json").read_text())["cameras"]
    assert pier["bias_heading_deg"] is not None
    assert mole["bias_heading_deg"] is None
    assert pier["bias_sigma_m"] < 1.0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("mole.csv", "pier.csv"), "is a file of tracks of camera pier and of camera mole"),
        (("mole.csv", "none.csv"), "there is no such file"),
        (("mole.csv", "mole.txt"), "no format of tracks ends in '.txt'"),
        (("mole.csv", "empty.csv"), "holds no point of a track"),
        (("mole.csv", "plain.csv"), "does not say how unsure it is"),
        (("mole.csv", "late.csv"), "no two cameras have tracks at the same time"),
        (('"mole"', '"pier"'), "two cameras are called pier"),
        (('tracks = ["mole.csv"]', ""), "give recordings, that batch tracks, or tracks"),
        (('tracks = ["mole.csv"]', 'recordings = ["mole.csv"]'), "give model"),
        (('[[cameras]]\nname = "mole"\ntracks = ["mole.csv"]\n', ""), "two are the least"),
        (('"mole"\n', '"mole"\nlatitude_deg = 3.0\n'), "give both latitude_deg and longitude_deg"),
    ],
)
def test_refusals_are_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], change: tuple[str, str], said: str
) -> None:
    path = fleet(tmp_path)
    (tmp_path / "mole.txt").write_text("1\n")
    header = (tmp_path / "mole.csv").read_text().splitlines()[0]
    (tmp_path / "empty.csv").write_text(header + "\n")
    pd.read_csv(tmp_path / "mole.csv")[
        ["track_id", "time_utc", "latitude_deg", "longitude_deg"]
    ].to_csv(tmp_path / "plain.csv", index=False)
    late = [replace(one, time_utc_s=one.time_utc_s + 3600.0) for one in MOLE]
    write_tracks(late, tmp_path / "late.csv")
    text = path.read_text()
    assert change[0] in text
    path.write_text(text.replace(*change))
    assert run("fuse", path, "-o", tmp_path / "fused.csv") == 2
    line = capfd.readouterr().err
    assert said in " ".join(line.split())
    assert not (tmp_path / "fused.csv").exists()


def test_a_fleet_without_recordings_is_none_for_batch(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no camera has recordings"):
        read_fleet(fleet(tmp_path))
