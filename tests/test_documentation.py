from __future__ import annotations

import importlib.util
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer

import sightline
from sightline.camera.pinhole import Camera
from sightline.cli import app
from sightline.evaluation import evaluate_tracks
from sightline.formats import track_table, write_boxes, write_fixes
from sightline.geodesy import LocalPlane
from sightline.simulation import SimulationSettings, simulate
from sightline.trajectory import METHODS
from sightline.types import Fixes, Track

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]


def blocks(page: Path, language: str) -> list[str]:
    text = page.read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\b[^\n]*\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def command_lines(page: Path) -> list[list[str]]:
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    lines = re.findall(r"^    (sightline .+)$", text, re.MULTILINE)
    return [shlex.split(line)[1:] for line in lines]


def in_code(page: Path) -> str:
    """All that a page has between backticks, in one string."""
    return " ".join(re.findall(r"`([^`\n]+)`", page.read_text(encoding="utf-8")))


def documented_names(page: Path) -> list[str]:
    """What a page of the reference has its docstrings from."""
    names = []
    for part in re.split(r"^::: ", page.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]:
        root = part.split()[0]
        members = re.search(r"members: \[(.+)\]", part)
        hidden = "show_root_heading: false" in part
        names += [] if hidden else [root]
        names += [f"{root}.{name}" for name in members[1].split(", ")] if members else []
    return names


@pytest.fixture(scope="module")
def track() -> Track:
    n = 40
    return Track(
        track_id=1,
        time_utc_s=1_717_236_000.0 + 0.5 * np.arange(n),
        east_m=2.0 * np.arange(n),
        north_m=np.full(n, 100.0),
        velocity_east_mps=np.full(n, 4.0),
        velocity_north_mps=np.zeros(n),
        covariance_m2=np.tile(np.diag([1.0, 9.0]), (n, 1, 1)),
        velocity_covariance_m2ps2=np.tile(np.eye(2), (n, 1, 1)),
        kind=np.zeros(n, dtype=np.int8),
        plane=LocalPlane(54.3233, 10.1394),
    )


@pytest.fixture(scope="module")
def surroundings(tmp_path_factory: pytest.TempPathFactory, track: Track) -> Path:
    """A folder with all files that the code in the documentation names."""
    folder = tmp_path_factory.mktemp("documentation")
    made = simulate(
        folder,
        SimulationSettings(seed=3, recordings=2, duration_s=30.0, video=False, clock="exact"),
    )
    scene = sightline.Scene.load(made.scene)
    for name in ("harbour.csv", "evening.csv"):
        write_boxes(scene["02"].boxes(), folder / name)
    sightline.Tracks((track,)).write(folder / "tracks.geojson")
    return folder


CODE = [(page, i) for page in PAGES for i in range(len(blocks(page, "python")))]


@pytest.mark.parametrize(
    ("page", "number"), CODE, ids=[f"{p.relative_to(ROOT)}-{i + 1}" for p, i in CODE]
)
def test_code_runs(
    page: Path, number: int, surroundings: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A table of boxes with their times stands in for a video, which would take long to render.
    code = blocks(page, "python")[number].replace(".mp4", ".csv")
    code = re.sub(r", start_utc_s=[\d.]+", "", code)
    monkeypatch.chdir(surroundings)
    namespace: dict[str, Any] = {}
    exec(compile(code, str(page), "exec"), namespace)
    assert len(namespace) > 1


def test_signal_k_messages_are_json_with_positions_and_radians(
    tmp_path: Path,
    track: Track,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    sightline.Tracks((track,)).write(tmp_path / "tracks.geojson")
    (code,) = (b for b in blocks(DOCS / "how-to/use-the-tracks.md", "python") if "delta" in b)
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "signal-k", "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(track)
    update = json.loads(lines[0])["updates"][0]
    values = {one["path"]: one["value"] for one in update["values"]}
    assert update["timestamp"] == "2024-06-01T10:00:00.000Z"
    assert values["navigation.position"]["latitude"] == pytest.approx(track.latitude_deg[0])
    assert values["navigation.speedOverGround"] == pytest.approx(4.0)
    assert values["navigation.courseOverGroundTrue"] == pytest.approx(np.pi / 2.0)


COMMANDS = [(page, line) for page in PAGES for line in command_lines(page)]


@pytest.mark.parametrize(("page", "line"), COMMANDS, ids=[" ".join(c[1][:2]) for c in COMMANDS])
def test_commands_are_understood(page: Path, line: list[str]) -> None:
    group: Any = typer.main.get_command(app)
    context = typer.Context(group, info_name="sightline")
    # What stands before the command is of all of them.
    _, line, _ = group.make_parser(context).parse_args(list(line))
    command = group.get_command(context, line[0])
    assert command is not None, f"{page.name} names the unknown command {line[0]}"
    while hasattr(command, "list_commands"):
        context = typer.Context(command, info_name=line[0], parent=context)
        line = line[1:]
        command = command.get_command(context, line[0])
        assert command is not None, f"{page.name} names the unknown command {line[0]}"
    # Refuses unknown options, and required ones that are missing.
    command.make_context(line[0], line[1:], parent=context)


def test_scene_file_of_the_documentation_loads(tmp_path: Path) -> None:
    page = DOCS / "how-to/prepare-a-scene.md"
    text = blocks(page, "toml")[0]
    for name in re.findall(r'^(?:video|clock|boxes|detections|fixes) = "(.+)"', text, re.M):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "frames/noon").mkdir(parents=True)
    (tmp_path / "scene.toml").write_text(text, encoding="utf-8")
    scene = sightline.Scene.load(tmp_path / "scene.toml")
    assert [recording.name for recording in scene.recordings] == ["morning", "noon"]
    assert scene.recordings[0].start_utc_s == 1_717_236_000.0
    assert len(scene.control_points) == 1


def test_control_points_may_stand_in_a_file(tmp_path: Path) -> None:
    page = DOCS / "how-to/prepare-a-scene.md"
    (tmp_path / "points.csv").write_text(
        "x_px,y_px,latitude_deg,longitude_deg\n652,136,54.326,10.1402\n", encoding="utf-8"
    )
    text = blocks(page, "toml")[1] + '\n[camera]\nname = "dock"\n'
    (tmp_path / "scene.toml").write_text(text, encoding="utf-8")
    assert len(sightline.Scene.load(tmp_path / "scene.toml").control_points) == 1


@pytest.mark.parametrize("table", ["camera", "detection", "recordings", "control_points"])
def test_all_keys_of_a_scene_are_documented(table: str, tmp_path: Path) -> None:
    brackets = f"[{table}]" if table in ("camera", "detection") else f"[[{table}]]"
    (tmp_path / "scene.toml").write_text(f"{brackets}\nno_such_key = 1\n", encoding="utf-8")
    with pytest.raises(sightline.InputError, match="known are") as error:
        sightline.Scene.load(tmp_path / "scene.toml")
    page = DOCS / "how-to/prepare-a-scene.md"
    documented = in_code(page) + blocks(page, "toml")[0]
    keys = str(error.value).split("known are ")[1].split(", ")
    assert len(keys) >= 3
    for key in keys:
        assert re.search(rf"\b{key}\b", documented), f"{key} is not documented"


def test_all_keys_of_a_report_are_documented(track: Track) -> None:
    log = Fixes(track.time_utc_s, track.latitude_deg, track.longitude_deg)
    documented = in_code(DOCS / "how-to/read-the-report.md")

    def keys(value: Any) -> set[str]:
        if isinstance(value, dict):
            return set(value) | {k for inner in value.values() for k in keys(inner)}
        return {k for inner in value for k in keys(inner)} if isinstance(value, list) else set()

    found = keys(evaluate_tracks([track], log).to_dict())
    assert {"ape", "rpe", "coverage", "per_range", "recordings"} <= found
    for key in found:
        assert re.search(rf"\b{key}\b", documented), f"{key} is not documented"


def test_all_models_and_trajectories_are_documented() -> None:
    models = in_code(DOCS / "how-to/choose-a-model.md").replace(",", " ").split()
    assert set(sightline.MODELS) <= set(models)
    assert set(METHODS) <= set(in_code(DOCS / "how-it-works.md").split())


def test_names_in_the_glossary_are_those_of_the_code() -> None:
    code = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "src").rglob("*.py"))
    words = set(re.findall(r"[A-Za-z_]\w+", in_code(DOCS / "glossary.md")))
    assert len(words) > 50
    assert [word for word in sorted(words) if not re.search(rf"\b{word}\b", code)] == []


def test_all_columns_and_formats_of_tracks_are_documented(track: Track, tmp_path: Path) -> None:
    documented = in_code(DOCS / "how-to/use-the-tracks.md")
    for column in track_table([track]).columns:
        assert column in documented
    with pytest.raises(sightline.InputError, match="known are") as error:
        sightline.Tracks((track,)).write(tmp_path / "tracks.xyz")
    for ending in str(error.value).split("known are ")[1].split(", "):
        assert ending in documented


def test_worth_of_a_pixel_is_that_of_a_camera() -> None:
    text = (DOCS / "how-to/mount-a-camera.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) m \|(.+)\|$", text, re.MULTILINE)
    heading = re.search(r"^\| height \|(.+)\|$", text, re.MULTILINE)
    assert heading is not None
    ranges_m = [float(cell.strip().removesuffix(" m")) for cell in heading[1].split("|")]
    assert len(rows) == 5
    for height, cells in rows:
        # So high an image that the horizon and the nearest boat are both in it.
        camera = Camera(float(height), 0.0, 0.0, 0.0, 1000.0, 0.0, 0.0, 0.0, 0.0, (1280, 4000))
        for range_m, cell in zip(ranges_m, cells.split("|"), strict=True):
            foot = camera.project([0.0], [range_m])[0]
            around = camera.locate(np.array([[0.0, -0.5], [0.0, 0.5]]) + foot)[1]
            if range_m < 0.1 * float(height) * 1000.0:
                # Further out a pixel is no longer small against the way to the horizon.
                assert float(cell) == pytest.approx(around[0] - around[1], rel=0.04, abs=0.051)
            worth = range_m**2 / (float(height) * 1000.0)
            assert float(cell) == pytest.approx(worth, rel=0.04, abs=0.051)


def test_log_written_for_the_documentation_is_read_back(track: Track, tmp_path: Path) -> None:
    log = Fixes(track.time_utc_s, track.latitude_deg, track.longitude_deg)
    write_fixes(log, tmp_path / "boat.gpx")
    report = sightline.evaluate(sightline.Tracks((track,)), fixes=tmp_path / "boat.gpx")
    assert report.ape.max == pytest.approx(0.0, abs=1e-3)


@pytest.mark.slow
@pytest.mark.skipif(
    importlib.util.find_spec("mkdocs") is None or importlib.util.find_spec("mkdocstrings") is None,
    reason="the dependency group docs is not installed",
)
def test_site_builds_without_a_warning_and_has_all_commands(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "reference/command-line/index.html").read_text(encoding="utf-8")
    for command in app.registered_commands:
        assert command.callback is not None
        assert f"sightline {command.callback.__name__}" in page
    for reference in sorted((DOCS / "reference").glob("*.md")):
        built = (tmp_path / "reference" / reference.stem / "index.html").read_text(encoding="utf-8")
        for name in documented_names(reference):
            assert f'id="{name}"' in built, f"{reference.name} lacks {name}"
    everything = "".join(p.read_text(encoding="utf-8") for p in tmp_path.rglob("*.html"))
    assert not re.findall(r"<(?:script|link|img)[^>]+(?:src|href)=\"https?://", everything)
