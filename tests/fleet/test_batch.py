"""`sightline batch`: each recording once, whole or not at all, and resumed by the same command."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import sightline
from sightline import Scene, fit
from sightline.cli import main
from sightline.errors import InputError
from sightline.fleet import read_fleet
from sightline.fleet.engines import Outcome, attempt
from sightline.fleet.partitions import TrackPartitions, by_day
from sightline.formats import read_clock, read_tracks
from sightline.geodesy import LocalPlane
from sightline.pipeline.track import TrackSettings
from sightline.simulation.simulate import SimulationSettings, simulate
from sightline.types import Track

parquet = pytest.importorskip("pyarrow.parquet", reason="needs sightline[parquet]")

ALL = {"pier/01", "pier/02", "mole/late"}
CAMERA = '[[cameras]]\nname = "a"\nmodel = "harbour/model.safetensors"\n'
ONE = 'recordings = ["harbour/detections/01.csv"]\n'


FLEET = """
[tracks]
interval_s = 1.0

[[cameras]]
name = "pier"
model = "harbour/model.safetensors"
recordings = [
  { source = "harbour/detections/01.csv", clock = "harbour/clock/01.csv", log = "LOG" },
  { source = "harbour/detections/02.csv", clock = "harbour/clock/02.csv" },
]

[[cameras]]
name = "mole"
model = "harbour/model.safetensors"
recordings = [
  { source = "harbour/detections/03.csv", name = "late", clock = "harbour/clock/03.csv" },
]
""".replace("LOG", "harbour/target.gpx")


@pytest.fixture(scope="session")
def made_archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("archive")
    settings = SimulationSettings(video=False, recordings=3, duration_s=20.0, seed=1, clock="exact")
    made = simulate(folder / "harbour", settings)
    fit(Scene.load(made.scene)).save(folder / "harbour" / "model.safetensors")
    (folder / "fleet.toml").write_text(FLEET)
    return folder


@pytest.fixture
def archive(made_archive: Path, tmp_path: Path) -> Path:
    """A copy of a small archive, to be spoilt: `fleet.toml`, and what it names."""
    folder = tmp_path / "archive"
    shutil.copytree(made_archive, folder)
    return folder


class Inline:
    """An engine without processes, whose start takes longer than the work of these tests."""

    def map(self, function, items, retries=2, stop=None) -> Iterator[Outcome]:
        for item in items:
            answer = attempt(function, item)
            yield Outcome(item, answer.result, answer.line, 1, answer.bug)

    def close(self) -> None:
        pass


@pytest.fixture(autouse=True)
def no_processes(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    if "slow" not in request.keywords:
        monkeypatch.setattr("sightline.fleet.engines.LocalEngine", lambda _: Inline())


def call(*arguments: object) -> int:
    with pytest.raises(SystemExit) as stopped:
        main([str(argument) for argument in arguments])
    assert isinstance(stopped.value.code, int)
    return stopped.value.code


def batch(archive: Path, *more: object) -> int:
    arguments = (archive / "fleet.toml", "-o", archive / "out", "--workers", 2)
    return call("batch", *arguments, "--json", archive / "result.json", *more)


def result(archive: Path) -> dict[str, object]:
    return json.loads((archive / "result.json").read_text())


def tracked(archive: Path) -> pd.DataFrame:
    from pyarrow import dataset

    return dataset.dataset(archive / "out" / "tracks", partitioning="hive").to_table().to_pandas()


def files(archive: Path) -> dict[str, bytes]:
    out = archive / "out"
    return {
        str(path.relative_to(out)): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.is_file()
    }


def append(archive: Path, text: str) -> None:
    with (archive / "fleet.toml").open("a") as file:
        file.write(text)


@pytest.mark.slow
def test_the_tracks_are_those_of_track(archive: Path) -> None:
    assert batch(archive) == 0
    folder = archive / "harbour"
    for camera, recording, number in (("pier", "01", "01"), ("mole", "late", "03")):
        alone = sightline.track(
            folder / "detections" / f"{number}.csv",
            sightline.load(folder / "model.safetensors"),
            clock=read_clock(folder / "clock" / f"{number}.csv"),
            settings=TrackSettings(interval_s=1.0),
        ).to_dataframe()
        (path,) = (archive / "out/tracks").glob(f"camera={camera}/day=*/{recording}.parquet")
        kept = pd.read_parquet(path)[list(alone.columns)]
        pd.testing.assert_frame_equal(
            kept.sort_values(["track_id", "time_utc"], ignore_index=True),
            alone.sort_values(["track_id", "time_utc"], ignore_index=True),
            check_dtype=False,
        )


def test_the_catalogue_has_a_row_a_recording(archive: Path) -> None:
    assert batch(archive) == 0
    table = pd.read_parquet(archive / "out/catalogue.parquet").set_index(["camera", "recording"])
    assert {"/".join(name) for name in table.index} == ALL
    assert (table["status"] == "tracked").all()
    whole = tracked(archive)
    assert table["points"].sum() == len(whole)
    assert table.loc[("pier", "01"), "rmse_m"] < 20.0
    assert table["rmse_m"].notna().sum() == 1
    for names in table["files"]:
        assert all((archive / "out" / name).is_file() for name in names)
    summary = json.loads((archive / "out/summary.json").read_text())
    assert summary["all"]["recordings"] == 3
    assert summary["all"]["rmse_m"] == pytest.approx(table.loc[("pier", "01"), "rmse_m"])


def test_geopandas_reads_places_and_partitions(archive: Path) -> None:
    geopandas = pytest.importorskip("geopandas", reason="needs sightline[geopackage]")
    assert batch(archive) == 0
    (path,) = (archive / "out/tracks").glob("camera=pier/day=*/01.parquet")
    read = geopandas.read_parquet(path)
    assert np.allclose(read.geometry.x, read["longitude_deg"], atol=0.0)
    assert np.allclose(read.geometry.y, read["latitude_deg"], atol=0.0)
    assert read.crs.to_string() == "OGC:CRS84"


def test_the_same_command_does_nothing_twice(archive: Path) -> None:
    assert batch(archive) == 0
    before = {path: path.stat().st_mtime_ns for path in (archive / "out/tracks").rglob("*.parquet")}
    assert batch(archive) == 0
    assert result(archive) == {
        "recordings": 3,
        "done": 0,
        "before": 3,
        "failed": {},
        "complete": True,
    }
    assert before == {
        path: path.stat().st_mtime_ns for path in (archive / "out/tracks").rglob("*.parquet")
    }


def test_what_was_changed_is_done_again_and_nothing_else(archive: Path) -> None:
    assert batch(archive) == 0
    source = archive / "harbour/detections/02.csv"
    source.write_text("".join(source.read_text().splitlines(keepends=True)[:400]))
    assert batch(archive) == 0
    assert (result(archive)["done"], result(archive)["before"]) == (1, 2)
    text = (archive / "fleet.toml").read_text().replace("interval_s = 1.0", "interval_s = 2.0")
    (archive / "fleet.toml").write_text(text)
    assert batch(archive) == 0
    assert result(archive)["done"] == 3
    assert (
        len(tracked(archive)) == pd.read_parquet(archive / "out/catalogue.parquet")["points"].sum()
    )


def test_a_lost_file_of_tracks_is_made_again(archive: Path) -> None:
    assert batch(archive) == 0
    before = files(archive)
    (path,) = (archive / "out/tracks").glob("camera=mole/day=*/late.parquet")
    path.unlink()
    assert batch(archive) == 0
    assert result(archive)["done"] == 1
    assert files(archive) == before


@pytest.mark.slow
def test_a_killed_run_is_resumed_by_the_same_command(archive: Path) -> None:
    command = [*(sys.executable, "-m", "sightline", "batch", str(archive / "fleet.toml"))]
    command += ["-o", str(archive / "out"), "--workers", "1"]
    killed = 0
    for _ in range(20):
        process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
        before = len(list((archive / "out/finished").rglob("*.json")))
        until = time.monotonic() + 60.0
        while process.poll() is None and time.monotonic() < until:
            if len(list((archive / "out/finished").rglob("*.json"))) > before:
                break
            time.sleep(0.005)
        if process.poll() is not None:
            break
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        killed += 1
    assert killed >= 1
    assert batch(archive) == 0
    again = archive.parent / "again"
    shutil.copytree(archive, again, ignore=shutil.ignore_patterns("out"))
    assert batch(again) == 0
    assert _content(archive) == _content(again)
    assert not list((archive / "out").glob(".batch*"))


def _content(archive: Path) -> dict[str, bytes]:
    return {name: content for name, content in files(archive).items() if name.startswith("tracks")}


def test_what_a_killed_run_has_left_is_no_result(archive: Path) -> None:
    stray = archive / "out/tracks/camera=pier/day=2001-01-01/01.parquet"
    stray.parent.mkdir(parents=True)
    stray.write_bytes(b"half")
    (archive / "out/finished").mkdir()
    others = archive / "out/tracks/camera=pier/day=2001-01-01/mine.parquet"
    others.write_bytes(b"not ours")
    assert batch(archive) == 0
    assert not stray.exists()
    assert others.read_bytes() == b"not ours"


def test_one_that_fails_is_named_and_spoils_no_other(
    archive: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    source = archive / "harbour/detections/02.csv"
    whole = source.read_text()
    source.write_text("frame,x1\n")
    assert batch(archive) == 2
    err = capfd.readouterr().err
    assert "pier/02: " in err
    assert "lacks the columns y1" in err
    assert "1 of 3 recordings could not be tracked" in err
    table = pd.read_parquet(archive / "out/catalogue.parquet").set_index("recording")
    assert table["status"].to_dict() == {"01": "tracked", "02": "failed", "late": "tracked"}
    source.write_text(whole)
    assert batch(archive) == 0
    assert result(archive)["done"] == 1


def test_a_hostile_name_is_text_in_the_summary(archive: Path) -> None:
    name = "<img src=x onerror=alert(1)>.csv"
    (archive / name).write_text("frame,x1\n")
    append(
        archive,
        f'\n[[cameras]]\nname="c"\nmodel="harbour/model.safetensors"\nrecordings=["{name}"]\n',
    )
    assert batch(archive) == 2
    page = (archive / "out/summary.html").read_text()
    assert "<img" not in page
    assert "&lt;img" in page


def test_a_folder_with_other_files_is_refused(
    archive: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (archive / "out").mkdir()
    (archive / "out/catalogue.parquet").write_bytes(b"mine")
    assert batch(archive) == 2
    assert "holds files, and none of an earlier batch" in capfd.readouterr().err
    assert (archive / "out/catalogue.parquet").read_bytes() == b"mine"


def test_two_runs_into_one_folder_are_refused(
    archive: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    from sightline.atomic import own_folder

    (archive / "out/finished").mkdir(parents=True)
    with own_folder(archive / "out" / ".batch.unfinished", archive / "out"):
        assert batch(archive) == 2
    assert "another run is writing it" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("", "cameras is missing"),
        ("cameras = []\n", "cameras: list should have at least 1 item"),
        (CAMERA, r"cameras\[1\]: give recordings, that batch tracks"),
        (CAMERA + ONE + "fps = 2\n", r"unknown key cameras\[1\]\.fps; known are name, model"),
        (CAMERA + "recordings = [{ sauce = 1 }]\n", "sauce"),
        (CAMERA + 'recordings = ["none/*.mp4"]\n', r"camera a: none/\*\.mp4 matches no file"),
        (CAMERA + 'recordings = ["none.mp4"]\n', "none.mp4: there is no such file"),
        (CAMERA.replace('"a"', '"../a"') + ONE, r"cameras\[1\]\.name: string should match"),
        (CAMERA + ONE + CAMERA + ONE, "two cameras are called a; rename one of them"),
        (
            CAMERA + ONE + CAMERA.replace('"a"', '"b"') + ONE,
            "is a recording of camera a and of camera b; one of them names another's file",
        ),
        (
            CAMERA + 'recordings = ["harbour/detections/01.csv", "harbour/clock/01.csv"]\n',
            "two recordings are called 01",
        ),
        (CAMERA.replace("model.saf", "moddel.saf") + ONE, "there is no such file"),
        ("cameras = 1 2\n", "is no TOML"),
    ],
)
def test_fleets_that_are_refused(archive: Path, text: str, line: str) -> None:
    path = archive / "fleet.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=line):
        read_fleet(path)


def test_a_pattern_names_recordings_by_what_is_below_it(archive: Path) -> None:
    for day in ("2026-05-01", "2026-05-02"):
        folder = archive / "videos" / day
        folder.mkdir(parents=True)
        (folder / "08 00.mp4").touch()
    text = CAMERA + 'recordings = ["videos/*/*.mp4"]\n'
    (archive / "fleet.toml").write_text(text)
    (camera,) = read_fleet(archive / "fleet.toml").cameras
    assert [one.name for one in camera.recordings] == ["2026-05-01-08-00", "2026-05-02-08-00"]


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("--engine", "spark"), "unknown engine 'spark'; known are local, ray"),
        (("--address", "a:1"), "--address and --memory are of a cluster; give --engine ray"),
    ],
)
def test_options_that_do_not_fit_are_refused(
    archive: Path, arguments: tuple[str, ...], line: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert batch(archive, *arguments) == 2
    assert line in capfd.readouterr().err
    assert not (archive / "out").exists()


def test_a_result_that_is_the_fleet_is_refused(
    archive: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    fleet = archive / "fleet.toml"
    assert call("batch", fleet, "-o", archive / "out", "--json", fleet) == 2
    assert "is read by this command" in capfd.readouterr().err


def test_a_track_over_midnight_goes_on_in_the_next_days_file(tmp_path: Path) -> None:
    # 2 June 2024, 00:00 UTC by `date -u -d 2024-06-02 +%s`.
    time_utc_s = 1_717_286_400.0 + np.arange(-3.0, 3.0)
    n = len(time_utc_s)
    nothing, none = np.zeros(n), np.zeros((n, 2, 2))
    track = Track(
        7, time_utc_s, np.arange(n) * 1.0, *(nothing,) * 3, none, none,
        np.zeros(n, dtype=np.int8), LocalPlane(54.3, 10.1),
    )  # fmt: skip
    assert [len(part) for _, part in by_day(track)] == [3, 3]
    with TrackPartitions(tmp_path, "night") as partitions:
        partitions.add(track)
        paths = partitions.finish()
    assert [path.parent.name for path in paths] == ["day=2024-06-01", "day=2024-06-02"]
    for path, times in zip(paths, (time_utc_s[:3], time_utc_s[3:]), strict=True):
        (part,) = read_tracks(path)
        assert part.track_id == 7
        assert np.allclose(part.time_utc_s, times, atol=1e-3)
