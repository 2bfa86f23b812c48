from __future__ import annotations

import contextlib
import functools
import json
import re
import runpy
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import cv2
import pandas as pd
import pytest

import sightline

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
GALLERY = EXAMPLES / "gallery"
PICTURES = ROOT / "docs" / "images" / "gallery"


def run(
    name: str, folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> str:
    monkeypatch.setattr("sys.argv", [name, str(folder)])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    return capsys.readouterr().out


def test_every_example_is_run_here() -> None:
    here = Path(__file__).read_text(encoding="utf-8")
    for example in EXAMPLES.rglob("*.py"):
        assert f'"{example.name}"' in here


@pytest.mark.slow
def test_fit_and_locate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = run("fit_and_locate.py", tmp_path, capsys, monkeypatch)
    ranges = [float(r) for r in re.findall(r"(\d+) m away", out)]
    assert len(ranges) == 2
    assert ranges[0] < ranges[1]
    assert out.count("no position") == 1
    assert sightline.load(tmp_path / "model.safetensors").model == "camera+gpr"


@pytest.mark.slow
def test_write_tracks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = run("write_tracks.py", tmp_path, capsys, monkeypatch)
    tracks = sightline.Tracks.read(tmp_path / "tracks.geojson")
    assert len(tracks) == out.count("track ") > 1
    table = pd.read_csv(tmp_path / "tracks.csv", parse_dates=["time_utc"])
    assert len(table) == sum(len(track) for track in tracks)
    for name in ("tracks.gpx", "tracks.kml"):
        assert (tmp_path / name).stat().st_size > 1000


def test_smooth_a_track(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = run("smooth_a_track.py", tmp_path, capsys, monkeypatch)
    rmse = {name: float(v) for name, v in re.findall(r"^([\w ]+): ([\d.]+) m RMSE", out, re.M)}
    assert rmse["rts"] < rmse["paper"] < rmse["single boxes"]
    kinds = re.findall(r"(measured|interpolated|extrapolated)$", out, re.M)
    assert kinds == ["measured", "interpolated", "extrapolated"]


@pytest.mark.slow
def test_evaluate_a_track(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = run("evaluate_a_track.py", tmp_path, capsys, monkeypatch)
    compared = re.search(r"(\d+) points compared, ([\d.]+) m RMSE", out)
    assert compared is not None
    assert int(compared[1]) > 100
    assert float(compared[2]) < 20.0
    assert (tmp_path / "report.json").exists()


def draw(
    name: str,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    **fewer: int,
) -> str:
    """What a script of the gallery prints; its picture is one that the documentation shows."""
    script = runpy.run_path(str(GALLERY / name))
    script["main"](folder, **fewer)
    picture = f"{name.removesuffix('.py').replace('_', '-')}.png"
    drawn, shown = cv2.imread(str(folder / picture)), cv2.imread(str(PICTURES / picture))
    assert drawn.shape == shown.shape
    assert drawn.std() > 10.0
    assert (PICTURES / picture).stat().st_size < 150_000
    page = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    assert f"images/gallery/{picture}" in page
    assert f"`{name}`" in page
    return capsys.readouterr().out


@pytest.mark.slow
def test_range_rings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = draw("range_rings.py", tmp_path, capsys)
    found = re.search(r"height ([\d.]+) m \(true ([\d.]+) m\)\n([\d.]+) m RMSE", out)
    assert found is not None
    assert float(found[1]) == pytest.approx(float(found[2]), rel=0.1)
    assert float(found[3]) < 4.0


@pytest.mark.slow
def test_whose_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = draw("whose_log.py", tmp_path, capsys, recordings=2)
    found = re.search(r"(\d+) tracks; the log is that of track \d+\n([\d.]+) m RMSE", out)
    assert found is not None
    assert int(found[1]) > 5
    assert float(found[2]) < 6.0


@pytest.mark.slow
def test_trust(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = draw("trust.py", tmp_path, capsys, harbours=4)
    found = re.search(r"ellipses hold (\d+)% of the true", out)
    assert found is not None
    assert int(found[1]) >= 85


@pytest.mark.slow
def test_gaps_and_forecast(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = draw("gaps_and_forecast.py", tmp_path, capsys)
    rmse = {name: float(v) for name, v in re.findall(r"^(\w+): \d+ points, ([\d.]+) m", out, re.M)}
    assert set(rmse) == {"seen", "hidden", "forecast"}
    assert max(rmse["seen"], rmse["hidden"]) < rmse["forecast"] < 60.0


@pytest.mark.slow
def test_road_traffic(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = draw("road_traffic.py", tmp_path, capsys)
    found = re.findall(r"^lane (\d): speed ([\d.]+) km/h RMSE, near end ([\d.]+) m off", out, re.M)
    assert sorted(lane for lane, _, _ in found) == ["0", "1", "2", "2", "3"]
    for _, speed_kmh, near_end_m in found:
        assert float(speed_kmh) < 5.0
        assert float(near_end_m) < 2.0


@pytest.mark.slow
def test_live_demo(tmp_path: Path) -> None:
    """Boats are on the map, and one of them has a name, while a made camera is watched."""
    pytest.importorskip("uvicorn", reason="the extra live is not installed")
    ports = [free_port() for _ in range(3)]
    command = [sys.executable, EXAMPLES / "live_demo.py", tmp_path / "demo", "--seconds", "120"]
    for name, port in zip(("--serve", "--pictures", "--ais"), ports, strict=True):
        command += [name, f"127.0.0.1:{port}"]
    # Whatever started the tests in a shell's background has it ignore interrupts.
    heard = functools.partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    demo = subprocess.Popen(command, preexec_fn=heard)
    named = False
    address = f"http://127.0.0.1:{ports[0]}/api/moment"
    try:
        for _ in range(900):
            with contextlib.suppress(OSError):
                targets = json.loads(urllib.request.urlopen(address, timeout=1).read())["targets"]
                named = any((one["name"] or "").startswith("LAUNCH") for one in targets)
            if named or demo.poll() is not None:
                break
            time.sleep(0.1)
    finally:
        demo.send_signal(signal.SIGINT)
        ended = demo.wait(30.0)
    assert named
    assert ended == 0
    assert sightline.load(tmp_path / "demo" / "model.safetensors").model == "camera"


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as made:
        return int(made.getsockname()[1])


@pytest.mark.slow
def test_first_tracks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The pictures of the tutorial; what it says of them is what the script prints."""
    script = runpy.run_path(str(GALLERY / "first_tracks.py"))
    script["main"](tmp_path)
    page = (ROOT / "docs" / "first-tracks.md").read_text(encoding="utf-8")
    for name in ("whose", "box", "fit", "map"):
        picture = f"first-tracks-{name}.jpg"
        drawn, shown = cv2.imread(str(tmp_path / picture)), cv2.imread(str(PICTURES / picture))
        assert drawn.shape == shown.shape
        assert drawn.std() > 10.0
        assert (PICTURES / picture).stat().st_size < 150_000
        assert f"images/gallery/{picture}" in page
    odds = [float(one) for one in re.findall(r"odds ([\d.e-]+) : 1", capsys.readouterr().out)]
    assert odds[0] == pytest.approx(3.0, abs=1.0)
    assert odds[1] < 1e-3
