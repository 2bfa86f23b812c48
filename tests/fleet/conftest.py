from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from sightline import Scene, fit
from sightline.simulation.simulate import SimulationSettings, simulate

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
