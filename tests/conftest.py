from __future__ import annotations

import os
from functools import cache
from pathlib import Path
from typing import Protocol

import hypothesis
import pytest

from sightline.formats import write_boxes, write_fixes
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.pipeline.fit import fit
from sightline.scene import Scene
from sightline.simulation import BoxNoise, Harbour, HarbourSettings, SimulatedCamera

CAMERA = SimulatedCamera(
    height_m=7.0,
    pitch_deg=4.0,
    roll_deg=0.8,
    heading_deg=30.0,
    focal_length_px=1000.0,
    k1=-0.12,
    k2=0.01,
)


class Fitted(Protocol):
    def __call__(self, model: str) -> Georeferencer: ...


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real recordings; the test is skipped where there is none."""
    named = os.environ.get("SIGHTLINE_DATA")
    folder = Path(named) if named else Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(
            f"no real data: {folder} does not exist; set SIGHTLINE_DATA to the folder that has it"
        )
    return folder


# How long an example takes is the machine's affair; speed is measured in benchmarks/.
hypothesis.settings.register_profile("sightline", deadline=None)
hypothesis.settings.load_profile("sightline")


@pytest.fixture(scope="session")
def small_camera() -> SimulatedCamera:
    """The true camera of the small scene."""
    return CAMERA


@pytest.fixture(scope="session")
def small_scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Two short recordings of one simulated harbour, each annotated by somebody else."""
    folder = tmp_path_factory.mktemp("scene")
    lines = []
    for i, annotator in enumerate(("first", "second")):
        start_utc_s = 1_717_236_000.0 + 3600.0 * i
        harbour = Harbour.random(
            21 + i,
            HarbourSettings(duration_s=120.0, camera=CAMERA, start_utc_s=start_utc_s, gulls=0),
        )
        noise = BoxNoise(std_px=1.0, source=annotator)
        write_boxes(harbour.boxes(harbour.times(0.5), noise=noise), folder / f"boxes-{i}.csv")
        write_fixes(harbour.fixes(), folder / f"fixes-{i}.csv")
        lines += [
            "[[recordings]]",
            f'name = "{annotator} run"',
            f'boxes = "boxes-{i}.csv"',
            f'fixes = "fixes-{i}.csv"',
        ]
    site = [
        "[camera]",
        f"latitude_deg = {harbour.plane.latitude_deg}",
        f"longitude_deg = {harbour.plane.longitude_deg}",
        "image_size_px = [1280, 720]",
    ]
    path = folder / "scene.toml"
    path.write_text("\n".join(site + lines), encoding="utf-8")
    return Scene.load(path)


@pytest.fixture(scope="session")
def fitted(small_scene: Scene) -> Fitted:
    """The small scene's georeferencer by the name of its model, each fitted once."""

    @cache
    def one(model: str) -> Georeferencer:
        return fit(small_scene, model)

    return one
