"""`sightline draw`: what it refuses in a line, what it prints, and how it ends."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sightline.cli import main

SCENE = """\
[camera]
latitude_deg = 54.3233
longitude_deg = 10.1394

[[recordings]]
name = "morning"
frames = "frames"
clock = "clock.csv"

[[recordings]]
name = "blind"
boxes = "boxes.csv"
"""


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    (tmp_path / "frames").mkdir()
    for frame in range(3):
        grey = np.full((48, 64, 3), 60 * frame, dtype=np.uint8)
        Image.fromarray(grey).save(tmp_path / "frames" / f"{frame:06d}.png")
    times = [f"{frame},2024-06-01T10:00:0{frame}Z" for frame in range(3)]
    (tmp_path / "clock.csv").write_text("\n".join(["frame,utc", *times]), encoding="utf-8")
    (tmp_path / "boxes.csv").write_text("frame,x1,y1,x2,y2\n1,2,3,9,9\n", encoding="utf-8")
    path = tmp_path / "scene.toml"
    path.write_text(SCENE, encoding="utf-8")
    return path


@pytest.fixture
def draw(
    scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str]]:
    """The command's exit status and what it says on standard error."""
    monkeypatch.chdir(scene.parent)
    monkeypatch.setenv("SIGHTLINE_TOKEN", "")

    def call(*arguments: str) -> tuple[int, str]:
        with pytest.raises(SystemExit) as ended:
            main(["draw", "--no-browser", *arguments])
        return int(ended.value.code or 0), capsys.readouterr().err

    return call


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nothing.toml"], "nothing.toml: there is no such scene file"),
        (["scene.toml"], "say which recording to draw in; there are morning, blind"),
        (
            ["scene.toml", "--recording", "noon"],
            "unknown recording 'noon'; known are morning, blin",
        ),
        (["scene.toml", "--recording", "blind"], "recording blind: has no pictures to draw in"),
        (
            ["scene.toml", "--serve", "0.0.0.0:0"],
            "shows the recording to the network; give a token",
        ),
        (["scene.toml", "--serve", "8081"], "expected HOST:PORT"),
        (["scene.toml", "--token-file", "none"], "none: cannot be read"),
        (["scene.toml", "--shore", "clock.csv"], "clock.csv: is no JSON"),
        (["scene.toml", "--recording", "morning", "--annotator", " "], "an annotator needs a name"),
        (["scene.toml", "--recording", "morning", "--detector", "eye"], "eye"),
    ],
)
def test_what_cannot_be_drawn_is_refused_in_a_line(
    arguments: list[str], said: str, scene: Path, draw: Callable[..., tuple[int, str]]
) -> None:
    before = {path: path.read_bytes() for path in scene.parent.rglob("*") if path.is_file()}
    status, told = draw(*arguments)
    assert status == 2
    assert said in told
    assert told.startswith("error: ")
    assert told.count("\n") == 1
    assert {path: path.read_bytes() for path in scene.parent.rglob("*") if path.is_file()} == before


def test_a_port_that_is_taken_is_refused(draw: Callable[..., tuple[int, str]]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        status, told = draw("scene.toml", "--recording", "morning", "--serve", address)
    assert status == 2
    assert told.startswith(f"error: cannot serve at {address}")
    assert told.count("\n") == 1


def test_without_the_extra_a_line_says_what_to_install(
    draw: Callable[..., tuple[int, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "fastapi", None)
    assert draw("scene.toml") == (
        2,
        'error: fastapi is not installed; run: pip install "sightline[live]"\n',
    )


@pytest.mark.slow
def test_it_serves_until_ctrl_c_and_keeps_what_was_accepted(scene: Path) -> None:
    command = [sys.executable, "-m", "sightline", "draw", "scene.toml", "--recording", "morning"]
    command += ["--annotator", "ada", "--serve", "127.0.0.1:0", "--no-browser"]
    with subprocess.Popen(
        command,
        cwd=scene.parent,
        env={**os.environ, "SIGHTLINE_TOKEN": "secret of the page", "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            assert process.stdout is not None
            first = process.stdout.readline()
            assert first.startswith("ada draws in recording morning: http://127.0.0.1:")
            assert "secret" not in first
            url = first.split()[-1]
            with pytest.raises(urllib.error.HTTPError, match="401"):
                urllib.request.urlopen(url)
            body = json.dumps({"frame": 1, "box_px": [4.0, 5.0, 20.0, 30.0]}).encode()
            headers = {
                "content-type": "application/json",
                "authorization": "Bearer secret of the page",
            }
            asked = urllib.request.Request(f"{url}api/boxes", body, headers, method="PUT")
            with urllib.request.urlopen(asked) as answer:
                assert answer.status == 200
            process.send_signal(signal.SIGINT)
            rest, wrong = process.communicate(timeout=60)
        finally:
            process.kill()
    assert (process.returncode, wrong) == (0, "")
    assert rest.splitlines()[-1] == "1 boxes in the table of recording morning"
    assert "1,4,5,20,30,ada" in (scene.parent / "boxes/morning.csv").read_text(encoding="utf-8")
