from __future__ import annotations

import json
import os
import random
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sightline.cli import main
from sightline.errors import InputError
from sightline.formats import read_tracks
from sightline.geodesy import LocalPlane
from sightline.live.state import SmoothedPart
from sightline.live.store import Keeper, Store, check_store, stored_tracks
from sightline.moment import Moment, TargetState
from sightline.types import Track

PLANE = LocalPlane(54.32, 10.14)
START_S = 1_717_236_000.0


def moment(number: int, ids: tuple[int, ...] = (1, 2), **columns: object) -> Moment:
    """The targets go north at 2 m/s, a moment every tenth of a second."""
    targets = []
    for one in ids:
        latitude, longitude = PLANE.to_geographic(50.0 * one, 100.0 + 0.2 * number)
        target = TargetState(
            id=one,
            latitude_deg=float(latitude),
            longitude_deg=float(longitude),
            covariance_m2=np.array([[4.0, 1.0], [1.0, 9.0]]),
            speed_mps=2.0,
            course_deg=0.0,
            state="measured",
            **columns,  # type: ignore[arg-type]
        )
        targets.append(target)
    return Moment(START_S + 0.1 * number, "sender", "quay", tuple(targets))


def part(first: int, last: int, *, final: bool, north_m: float = 100.0) -> SmoothedPart:
    number = np.arange(first, last)
    n = number.size
    track = Track(
        track_id=1,
        time_utc_s=START_S + 0.1 * number,
        east_m=np.full(n, 50.0),
        north_m=north_m + 0.2 * number,
        velocity_east_mps=np.zeros(n),
        velocity_north_mps=np.full(n, 2.0),
        covariance_m2=np.tile(np.eye(2), (n, 1, 1)),
        velocity_covariance_m2ps2=np.tile(np.eye(2), (n, 1, 1)),
        kind=np.zeros(n, dtype=np.int8),
        plane=PLANE,
        label="ferry",
    )
    return SmoothedPart(track, final=final)


def _store(path: Path) -> Store:
    return Store(path, camera="quay", plane=PLANE)


def test_what_was_kept_comes_back(tmp_path: Path) -> None:
    store = _store(tmp_path / "quay.db")
    for k in range(20):
        store.keep([moment(k)])
    tracks = list(stored_tracks(store.path))
    assert [track.track_id for track in tracks] == [1, 2]
    np.testing.assert_allclose(tracks[1].east_m, 100.0, atol=1e-6)
    np.testing.assert_allclose(tracks[1].north_m, 100.0 + 0.2 * np.arange(20), atol=1e-6)
    np.testing.assert_allclose(tracks[0].time_utc_s, START_S + 0.1 * np.arange(20), atol=1e-6)
    np.testing.assert_allclose(tracks[0].covariance_m2[3], [[4.0, 1.0], [1.0, 9.0]])
    np.testing.assert_allclose(tracks[0].velocity_north_mps, 2.0)
    some = list(stored_tracks(store.path, START_S + 0.5, START_S + 1.0))
    np.testing.assert_allclose(some[0].time_utc_s, START_S + np.arange(0.5, 0.95, 0.1), atol=1e-6)
    store.close()


def test_reading_leaves_nothing_beside_a_store(tmp_path: Path) -> None:
    """SQLite would leave a log and a map of it, and could make none on a disk that is full."""
    store = _store(tmp_path / "quay.db")
    for k in range(20):
        store.keep([moment(k)])
    assert len(list(stored_tracks(store.path))) == 2
    store.close()
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert len(list(stored_tracks(store.path))) == 2
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("column", ["latitude_deg", "east_m2", "speed_mps"])
@pytest.mark.parametrize("value", ["9e999", "-1e300"])
def test_what_cannot_be_is_no_track(tmp_path: Path, column: str, value: str) -> None:
    """GeoJSON has no infinity, and the square of a speed may be one."""
    store = _store(tmp_path / "quay.db")
    for k in range(20):
        store.keep([moment(k)])
    store._file.execute(f"UPDATE point SET {column} = {value} WHERE target_id = 1")
    store._file.commit()
    store.close()
    with pytest.raises(InputError, match=r"quay\.db: is damaged"):
        list(stored_tracks(store.path))


def test_smoothed_comes_before_published_and_final_replaces_it(tmp_path: Path) -> None:
    store = _store(tmp_path / "quay.db")
    store.keep([moment(k) for k in range(20)], [part(0, 10, final=False, north_m=101.0)])
    (track, _) = stored_tracks(store.path)
    assert track.label == "ferry"
    np.testing.assert_allclose(track.north_m[:10], 101.0 + 0.2 * np.arange(10), atol=1e-6)
    np.testing.assert_allclose(track.north_m[10:], 100.0 + 0.2 * np.arange(10, 20), atol=1e-6)
    store.keep([], [part(0, 20, final=True, north_m=102.0)])
    (track, _) = stored_tracks(store.path)
    np.testing.assert_allclose(track.north_m, 102.0 + 0.2 * np.arange(20), atol=1e-6)
    store.close()


def test_numbers_go_on_even_where_all_was_forgotten(tmp_path: Path) -> None:
    store = _store(tmp_path / "quay.db")
    store.keep([moment(0, (3, 8), mmsi=211000001, name="=evil()", match=0.9)], state={"a": 1})
    store.close()
    store = _store(tmp_path / "quay.db")
    assert store.highest_id() == 8
    assert store.kept_state() == {"a": 1}
    assert store.forget(START_S - 86_400.0) == 0
    assert store.forget(START_S + 2 * 86_400.0) == 2
    assert list(stored_tracks(store.path)) == []
    assert store.highest_id() == 8
    store.close()


def test_what_is_no_store_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such store"):
        check_store(tmp_path / "none.db")
    (tmp_path / "text.db").write_text("time,id\n" * 100, encoding="utf-8")
    other = sqlite3.connect(tmp_path / "other.db")
    other.execute("CREATE TABLE t (a)")
    other.commit()
    other.close()
    newer = _store(tmp_path / "newer.db")
    newer._file.execute("PRAGMA user_version = 9")
    newer.close()
    for name, why in (("text", "no store"), ("other", "another SQLite"), ("newer", "version 9")):
        with pytest.raises(InputError, match=why):
            _store(tmp_path / f"{name}.db")
    with pytest.raises(InputError, match="cannot be written as a store"):
        _store(tmp_path / "nowhere" / "a.db")


def test_one_program_writes_to_a_store_at_a_time(tmp_path: Path) -> None:
    first = _store(tmp_path / "quay.db")
    with pytest.raises(InputError, match="another sightline live"):
        _store(tmp_path / "quay.db")
    first.keep([moment(0)])
    first.close()
    _store(tmp_path / "quay.db").close()


WRITER = """
import sys
sys.path.insert(0, {tests!r})
from test_store import _store, moment
from pathlib import Path
store = _store(Path({path!r}))
k = int(sys.argv[1])
while True:
    store.keep([moment(k, tuple(range(1, 31)))])
    print(k, flush=True)
    k += 1
"""


@pytest.mark.slow
def test_nothing_acknowledged_is_lost_by_a_kill(tmp_path: Path) -> None:
    path = tmp_path / "quay.db"
    code = WRITER.format(tests=str(Path(__file__).parent), path=str(path))
    rng, acknowledged = random.Random(1), -1
    for _ in range(4):
        process = subprocess.Popen(
            [sys.executable, "-c", code, str(acknowledged + 1)],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert process.stdout is not None
        lines = [process.stdout.readline()]
        end_s = time.monotonic() + rng.uniform(0.05, 0.3)
        while time.monotonic() < end_s:
            lines.append(process.stdout.readline())
        os.kill(process.pid, signal.SIGKILL)
        lines += process.stdout.readlines()
        process.wait()
        acknowledged = int([line for line in lines if line.endswith("\n")][-1])
        tracks = list(stored_tracks(path))
        assert len(tracks) == 30
        # All targets of a moment, or none of them; and all moments without a gap.
        assert len({len(track) for track in tracks}) == 1
        assert len(tracks[0]) >= acknowledged + 1
        np.testing.assert_allclose(np.diff(tracks[0].time_utc_s), 0.1, atol=1e-5)
    with sqlite3.connect(path) as file:
        assert file.execute("PRAGMA integrity_check").fetchone() == ("ok",)


def until(condition: Callable[[], bool], most_s: float = 10.0) -> None:
    end_s = time.monotonic() + most_s
    while not condition():
        assert time.monotonic() < end_s, "it did not come to that"
        time.sleep(0.02)


def test_a_full_disk_is_told_and_what_waits_is_written_later(tmp_path: Path) -> None:
    store = _store(tmp_path / "quay.db")
    (pages,) = store._file.execute("PRAGMA page_count").fetchone()
    store._file.execute(f"PRAGMA max_page_count = {pages + 2}")
    told: list[str] = []
    keeper = Keeper(store, told=told.append, most=400)
    keeper.start()
    for k in range(300):
        keeper.keep(moment(k, tuple(range(1, 21))))
    until(lambda: keeper.problem != "")
    assert "full" in told[0]
    store._file.execute("PRAGMA max_page_count = 1000000")
    until(lambda: keeper.problem == "")
    keeper.close()
    assert keeper.lost == 0
    assert len(next(stored_tracks(store.path))) == 300
    assert keeper.kept_utc_s == pytest.approx(START_S + 29.9)
    assert len(told) == 2


def test_what_cannot_be_written_for_too_long_is_given_up_and_counted(tmp_path: Path) -> None:
    store = _store(tmp_path / "quay.db")
    keeper = Keeper(store, most=10)
    for k in range(25):
        keeper.keep(moment(k))
    assert keeper.lost == 15
    keeper.start()
    keeper.close()
    assert len(next(stored_tracks(store.path))) == 10


class TestExport:
    def test_every_format(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        store = _store(tmp_path / "quay.db")
        store.keep([moment(k) for k in range(20)], [part(0, 20, final=True)])
        # It is exported while live goes on.
        names = ("geojson", "gpx", "kml", "csv", "parquet", "gpkg", "mfjson")
        outputs = [tmp_path / f"out.{name}" for name in names]
        # As many as there are behind one -o.
        options = ["-o", *map(str, outputs)]
        with pytest.raises(SystemExit) as stopped:
            main(["export", str(store.path), *options])
        assert stopped.value.code == 0, capsys.readouterr().err
        # Its own results are replaced.
        with pytest.raises(SystemExit) as stopped:
            main(["export", str(store.path), *options])
        assert stopped.value.code == 0, capsys.readouterr().err
        for path in outputs:
            if path.suffix in (".geojson", ".csv", ".parquet", ".gpkg", ".gpx"):
                tracks = read_tracks(path, plane=PLANE)
                assert [len(track) for track in tracks] == [20, 20]
                np.testing.assert_allclose(tracks[1].east_m, 100.0, atol=0.02)
        moving = json.loads((tmp_path / "out.mfjson").read_text(encoding="utf-8"))
        feature = moving["features"][0]
        assert feature["temporalGeometry"]["type"] == "MovingPoint"
        assert len(feature["temporalGeometry"]["coordinates"]) == 20
        assert feature["temporalGeometry"]["datetimes"][0] == "2024-06-01T10:00:00.000Z"
        assert feature["temporalProperties"][0]["speed"]["values"][0] == 2.0
        store.close()

    def test_bad_input(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        store = _store(tmp_path / "quay.db")
        store.close()
        out = str(tmp_path / "a.csv")
        for arguments, why in (
            ([str(tmp_path / "none.db"), "-o", out], "no such store"),
            ([str(store.path), "-o", str(tmp_path / "a.xyz")], "no format of tracks"),
            ([str(store.path), "-o", out, "--from", "yesterday"], "is no time"),
            ([str(store.path), "-o", out, "--from", "2024-01-02", "--to", "2024-01-01"], "before"),
            ([str(store.path), "-o", str(store.path)], "is read by this command"),
        ):
            with pytest.raises(SystemExit) as stopped:
                main(["export", *arguments])
            error = capsys.readouterr().err
            assert stopped.value.code == 2, arguments
            assert why in error, error
            assert error.count("\n") == 1
