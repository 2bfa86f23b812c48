from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from moments import START, target
from sightline.formats import read_tracks
from sightline.geodesy import LocalPlane
from sightline.live.store import Store
from sightline.moment import Moment

Command = Callable[..., Any]

PLANE = LocalPlane(54.32, 10.14)


def watched(path: Path, mmsi: int, moments: int = 200) -> Path:
    """What a camera, named as the store, kept of a vessel that goes north at 2 m/s."""
    with closing(Store(path, camera=path.stem, plane=PLANE)) as store:
        for k in range(moments):
            latitude, longitude = (float(x) for x in PLANE.to_geographic(50.0, 100.0 + 0.2 * k))
            told = {"latitude_deg": latitude, "longitude_deg": longitude, "course_deg": 0.0}
            seen = target(1, **told, speed_mps=2.0, mmsi=mmsi, name="Anna", match=0.99)
            store.keep([Moment(START + 0.1 * k, "sender", path.stem, (seen,))])
    return path


def test_what_ais_said_of_a_target_goes_with_it_to_other_cameras(
    tmp_path: Path, sightline: Command
) -> None:
    cameras = ""
    for name, mmsi in (("quay", 211_000_001), ("pier", 211_000_002)):
        store, out = watched(tmp_path / f"{name}.db", mmsi), tmp_path / f"{name}.csv"
        assert sightline("export", store, "-o", out).status == 0
        (track,) = read_tracks(out, plane=PLANE)
        assert (track.mmsi, track.name) == (mmsi, "Anna")
        assert set(pd.read_csv(out)["cameras"]) == {name}
        cameras += f'[[cameras]]\nname = "{name}"\ntracks = ["{out.name}"]\n'
    fleet, fused = tmp_path / "fleet.toml", tmp_path / "fused.csv"
    fleet.write_text(cameras, encoding="utf-8")
    assert sightline("fuse", fleet, "-o", fused).status == 0
    # In one place, and two, since AIS says so.
    assert sorted(track.mmsi or 0 for track in read_tracks(fused)) == [211_000_001, 211_000_002]
    pier = tmp_path / "pier.csv"
    text = pier.read_text(encoding="utf-8").replace("211000002", "211000001")
    pier.write_text(text, encoding="utf-8")
    assert sightline("fuse", fleet, "-o", fused).status == 0
    (one,) = read_tracks(fused)
    assert (one.mmsi, one.name) == (211_000_001, "Anna")
    np.testing.assert_allclose(one.speed_mps, 2.0, atol=0.2)


@pytest.mark.parametrize("mmsi", ["'x'", "0", "1000000000", "1.5"])
def test_a_number_that_no_vessel_has_is_damage(
    tmp_path: Path, sightline: Command, mmsi: str
) -> None:
    store, out = watched(tmp_path / "quay.db", 211_000_001, 5), tmp_path / "a.csv"
    with closing(sqlite3.connect(store)) as file, file:
        file.execute(f"UPDATE target SET mmsi = {mmsi}")
    done = sightline("export", store, "-o", out)
    assert done.status == 2
    assert "is no MMSI" in done.err
    assert not out.exists()
