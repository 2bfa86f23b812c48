"""What is asked of the command line is answered before the library behind it is loaded."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from sightline.cli import defaults
from sightline.clock_offset import LARGEST_OFFSET_S
from sightline.detection import DEFAULT_DETECTOR, VIEWS
from sightline.detection.decoders import DECODERS
from sightline.detection.onnx import PROVIDERS
from sightline.evaluation.detection import DEFAULT_IOU
from sightline.georeferencing.models import DEFAULT_MODEL, MODELS
from sightline.labelling import DEFAULT_LABEL
from sightline.pipeline.track import DEFAULT_TRAJECTORY
from sightline.training.architecture import ARCHITECTURES
from sightline.training.darknet.cfg import PUBLISHED

# Pydantic is not among them: the library that reads the command line uses it.
HEAVY = {
    *("av", "cv2", "jinja2", "matplotlib", "numpy", "onnxruntime", "pandas", "PIL", "pyais"),
    *("pycocotools", "pyproj", "safetensors", "scipy", "sklearn", "torch"),
}

MISSING_SCENE = "error: nothing.toml: there is no such scene file"
MISSING_MODEL = (
    "error: nothing.safetensors: there is no such model file; `sightline fit` writes one"
)
COMMANDS = (
    *("demo", "check", "run", "fit", "compare", "track", "show", "evaluate", "count", "detect"),
    *("draw", "simulate"),
)
DETECTOR_COMMANDS = ("label", "train", "evaluate", "compare", "export")


def loaded_by(folder: Path, *lines: str) -> tuple[subprocess.CompletedProcess[str], set[str]]:
    """Command lines one after the other in a process of their own, and all that it loaded."""
    code = (
        "import sys\n"
        "from sightline.cli import main\n"
        f"for line in {lines!r}:\n"
        "    try:\n"
        "        main(line.split())\n"
        "    except SystemExit as stopped:\n"
        "        status = stopped.code\n"
        "open('modules', 'w').write('\\n'.join(sys.modules))\n"
        "sys.exit(status)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    return done, {name.split(".")[0] for name in (folder / "modules").read_text().splitlines()}


@pytest.mark.parametrize(
    "lines",
    [
        ["--version"],
        ["--help"],
        [
            *(f"{name} --help" for name in (*COMMANDS, "detector")),
            *(f"detector {name} --help" for name in DETECTOR_COMMANDS),
        ],
    ],
    ids=["version", "help", "help of each command"],
)
def test_version_and_help_load_nothing_heavy(lines: list[str], tmp_path: Path) -> None:
    done, loaded = loaded_by(tmp_path, *lines)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.count("Usage:") == len(lines) - lines.count("--version")
    assert {"sightline", "typer"} <= loaded
    assert not loaded & HEAVY


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("check nothing.toml", MISSING_SCENE),
        ("run nothing.toml -o out", MISSING_SCENE),
        ("draw nothing.toml", MISSING_SCENE),
        ("fit nothing.toml -o m.safetensors", MISSING_SCENE),
        ("compare nothing.toml", MISSING_SCENE),
        ("evaluate nothing.toml --model nothing.safetensors", MISSING_SCENE),
        ("detector evaluate nothing.toml", MISSING_SCENE),
        ("detector label nothing.toml --model m -o out", MISSING_SCENE),
        ("track a.mp4 --model nothing.safetensors -o t.csv", MISSING_MODEL),
        ("show a.mp4 --model nothing.safetensors -o s.mp4", MISSING_MODEL),
        ("count nothing.csv --lines l.json", "error: nothing.csv: there is no such file"),
        ("detect a.mp4 -o b.csv", "error: a.mp4: there is no such video or folder"),
        ("fit nothing.toml", "error: Missing option '--output' / '-o'."),
    ],
)
def test_refusals_of_what_is_not_there_load_nothing_heavy(
    asked: str, said: str, tmp_path: Path
) -> None:
    done, loaded = loaded_by(tmp_path, asked)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == said + "\n"
    assert not loaded & HEAVY
    assert [path.name for path in tmp_path.iterdir()] == ["modules"]


def test_the_package_runs_as_a_module(tmp_path: Path) -> None:
    def call(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "sightline", *arguments],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )

    assert call("--version").stdout.startswith("sightline 0.")
    refused = call("run", "nothing.toml", "-o", "out")
    assert (refused.returncode, refused.stderr) == (2, MISSING_SCENE + "\n")


def test_defaults_of_the_help_are_those_of_the_library() -> None:
    assert defaults.MODELS == MODELS
    assert defaults.DEFAULT_MODEL == DEFAULT_MODEL
    assert defaults.DEFAULT_TRAJECTORY == DEFAULT_TRAJECTORY
    assert defaults.LARGEST_OFFSET_S == LARGEST_OFFSET_S
    assert defaults.DEFAULT_DETECTOR == DEFAULT_DETECTOR
    assert defaults.DECODERS == DECODERS
    assert tuple(PROVIDERS) == defaults.PROVIDERS
    assert defaults.VIEWS == VIEWS
    assert defaults.DEFAULT_IOU == DEFAULT_IOU
    assert defaults.DEFAULT_LABEL == DEFAULT_LABEL
    assert defaults.ARCHITECTURES == ARCHITECTURES
    assert defaults.PUBLISHED == PUBLISHED
