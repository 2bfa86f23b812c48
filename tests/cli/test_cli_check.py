from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from conftest import Outcome

Command = Callable[..., Outcome]


def test_check_says_what_there_is(sightline: Command, harbour: Path, tmp_path: Path) -> None:
    result = tmp_path / "check.json"
    done = sightline("check", harbour / "scene.toml", "--json", result)
    assert (done.status, done.err) == (0, "")
    lines = done.out.splitlines()
    assert len(lines) <= 20
    assert lines[0].endswith("pictures of 640 x 360 px, 3 recordings")
    assert lines[1].startswith("recording 01: ")
    assert lines[-1] == "Nothing stands in the way of a run."
    content = json.loads(result.read_text())
    assert content["refused"] is False
    assert [one["name"] for one in content["recordings"]] == ["01", "02", "03"]


def test_check_refuses_what_a_run_refuses(
    sightline: Command, harbour: Path, tmp_path: Path
) -> None:
    (harbour / "boxes" / "01.csv").unlink()
    (harbour / "clock" / "02.csv").unlink()
    scene, result = harbour / "scene.toml", tmp_path / "check.json"
    done = sightline("check", scene, "--json", result)
    assert done.status == 2
    assert done.out.count("problem: ") == 1
    assert "Nothing stands" not in done.out
    # Each is said once.
    for named in ("recordings[1].boxes names ", "clock names "):
        assert (done.out + done.err).count(named) == 1
    assert done.err.startswith(f"error: {scene}: recordings[1].boxes names ")
    assert done.err.endswith("(and 1 more, above)\n")
    assert len(done.err.splitlines()) == 1
    assert json.loads(result.read_text())["refused"] is True


def test_check_says_the_only_problem_once(sightline: Command, tmp_path: Path) -> None:
    (tmp_path / "notes.csv").write_text("a,b\n1,2\n")
    (tmp_path / "empty.gpx").touch()
    (tmp_path / "broken.mp4").write_bytes(bytes(range(256)))
    (tmp_path / "scene.toml").write_text("[camera\n")
    for path in sorted(tmp_path.iterdir()):
        done = sightline("check", path)
        assert done.status == 2
        said = done.err.removeprefix("error: ").strip()
        assert said.startswith(str(path))
        assert done.out == ""


@pytest.mark.slow
def test_run_begins_with_the_check(sightline: Command, harbour: Path, tmp_path: Path) -> None:
    """It refuses before any work is done, and says what might go wrong where it goes on."""
    scene = harbour / "scene.toml"
    text = scene.read_text()
    scene.write_text(text.replace("latitude_deg = 54.3233", "latitude_deg = -54.3233"))
    done = sightline("run", scene, "-o", tmp_path / "out")
    assert done.status == 2
    assert "the sign of its latitude differs from the camera's" in done.err
    assert not (tmp_path / "out").exists()

    scene.write_text(text)
    for name in ("01", "02", "03"):
        table = harbour / "boxes" / f"{name}.csv"
        table.write_text("".join(table.read_text().splitlines(keepends=True)[:6]))
    done = sightline("run", scene, "-o", tmp_path / "out", "--model", "camera")
    assert done.status == 0
    assert "only 15 of 15 boxes have a place in a log" in done.err


def test_check_of_single_files(sightline: Command, harbour: Path) -> None:
    done = sightline("check", harbour / "target.gpx", harbour / "boat.mp4")
    assert done.status == 0
    assert f"log {harbour / 'target.gpx'}: " in done.out
    assert f"video {harbour / 'boat.mp4'}: 40 frames of 640 x 360 px" in done.out
    assert "does not overlap" in done.out


@pytest.mark.parametrize("name", ["scene.toml", "target.gpx", "boxes/01.csv"])
def test_check_overwrites_nothing_that_it_reads(
    sightline: Command, harbour: Path, name: str
) -> None:
    before = (harbour / name).read_bytes()
    done = sightline("check", harbour / "scene.toml", "--json", harbour / name)
    assert done.status == 2
    assert (harbour / name).read_bytes() == before


@pytest.mark.parametrize("name", ["nothing.toml", "nothing.gpx"])
def test_check_of_what_is_not_there(sightline: Command, tmp_path: Path, name: str) -> None:
    done = sightline("check", tmp_path / name)
    assert done.status == 2
    assert done.err.startswith(f"error: {tmp_path / name}: there is no such")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("log.txt", "time\tlatitude\tlongitude\n2024-06-01T10:00:00Z\t54.3\t10.1\n"),
        ("log.csv", "# unit 7\n# time,lat,lon\n2024-06-01T10:00:00Z,54.3,10.1\n"),
        ("ais.csv", "MMSI,BaseDateTime,LAT,LON\n211000001,2024-06-01T10:00:00,54.3,10.1\n"),
        (
            "log.json",
            '{"class":"TPV","mode":3,"time":"2024-06-01T10:00:00Z","lat":54.3,"lon":10.1,"id":"ö"}\n',
        ),
    ],
)
def test_logs_are_known_by_what_is_in_them(
    sightline: Command, tmp_path: Path, name: str, text: str
) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    done = sightline("check", tmp_path / name)
    assert done.status == 0
    assert "1 fixes, 2024-06-01 10:00:00" in done.out
