"""Ships whose sizes and antennas the scene states, before a simulated camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sightline.camera.pinhole import Camera
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.pipeline.fit import fit
from sightline.scene import Scene
from sightline.types import FloatArray

pytestmark = pytest.mark.slow

SIZE = (1920, 1080)
LATITUDE, LONGITUDE = 54.0, 10.0
# Of WGS 84 at 54 degrees north.
LATITUDE_M, LONGITUDE_M = 111_305.0, 65_576.0
TRUE = Camera(
    height_m=25.0,
    pitch_deg=2.5,
    roll_deg=0.3,
    heading_deg=70.0,
    focal_px=1800.0,
    k1=0.0,
    k2=0.0,
    east_m=0.0,
    north_m=0.0,
    image_size_px=SIZE,
    curvature=6.0 / 7.0,
)
SHIPS = ((160.0, 24.0), (14.0, 4.5), (90.0, 14.0), (14.0, 4.5), (190.0, 28.0), (45.0, 9.0))
"""Length and beam."""

RANGES_M = (900.0, 450.0, 700.0, 300.0, 1400.0, 550.0)
# Wakes and masts: by so much are boxes wider than hulls.
WIDER = 1.7


def write_scene(
    folder: Path, *, stated: bool, ships: int = len(SHIPS), coming: bool = False, seed: int = 0
) -> tuple[Scene, FloatArray]:
    """Ships that pass or come, their antennas near their sterns; and where their middles were."""
    folder.mkdir()
    rng = np.random.default_rng([seed, 31])
    facing = np.radians(TRUE.heading_deg)
    lines = [
        f"[camera]\nlatitude_deg = {LATITUDE}\nlongitude_deg = {LONGITUDE}",
        f"image_size_px = [{SIZE[0]}, {SIZE[1]}]",
    ]
    middles = []
    for number, ((long, wide), range_m) in enumerate(
        list(zip(SHIPS, RANGES_M, strict=True))[:ships]
    ):
        course = facing + (0.5 + number % 2) * np.pi + rng.uniform(-1.0, 1.0)
        if coming:
            course = facing + np.pi + rng.uniform(-0.15, 0.15)
        bow = np.array([np.sin(course), np.cos(course)])
        along = 5.0 * (np.arange(80) - 40.0)
        place = range_m * np.array([np.sin(facing), np.cos(facing)]) + along[:, None] * bow
        distance, bearing = np.hypot(*place.T), np.arctan2(*place.T)
        across, ahead = np.abs(np.sin(course - bearing)), np.abs(np.cos(course - bearing))
        near = 1.0 - 0.5 * (long * ahead + wide * across) / distance
        foot = TRUE.project(place[:, 0] * near, place[:, 1] * near)
        half = 0.5 * WIDER * (long * across + wide * ahead) * TRUE.focal_px / distance
        foot += rng.normal(0.0, (2.0, 1.0), foot.shape)
        seen = (foot > 0.0).all(axis=1) & (foot < SIZE).all(axis=1)
        start = 1_700_000_000.0 + 1000.0 * number
        boxes = ["frame,x1,y1,x2,y2,time_utc"]
        for i in np.flatnonzero(seen).tolist():
            x, y = foot[i]
            boxes.append(
                f"{i},{x - half[i]:.2f},{y - 30:.2f},{x + half[i]:.2f},{y:.2f},{start + i}"
            )
        middles.append(place[seen])
        (folder / f"boxes{number}.csv").write_text("\n".join(boxes) + "\n")
        antenna_at = place - 0.4 * long * bow
        fixes = ["time_utc,latitude_deg,longitude_deg"]
        fixes += [
            f"{start + i},{LATITUDE + north / LATITUDE_M:.8f},{LONGITUDE + east / LONGITUDE_M:.8f}"
            for i, (east, north) in enumerate(antenna_at.tolist())
        ]
        (folder / f"log{number}.csv").write_text("\n".join(fixes) + "\n")
        lines += [
            f'[[recordings]]\nname = "{number}"',
            f'boxes = "boxes{number}.csv"\nfixes = "log{number}.csv"',
        ]
        if stated:
            lines.append(f"antenna_m = [{0.9 * long}, {0.1 * long}, {0.5 * wide}, {0.5 * wide}]")
    path = folder / "scene.toml"
    path.write_text("\n".join(lines) + "\n")
    return Scene.load(path), np.concatenate(middles)


TRUE_AT = np.array([(x, y) for y in (300.0, 700.0, 1500.0) for x in (-120.0, 0.0, 150.0)])
"""Where the camera is asked, metres to starboard and ahead of it."""


def camera_off(model: Georeferencer) -> float:
    """RMSE of the bare camera, as a share of the distances."""
    assert model.camera is not None
    facing = np.radians(TRUE.heading_deg)
    east = TRUE_AT[:, 0] * np.cos(facing) + TRUE_AT[:, 1] * np.sin(facing)
    north = -TRUE_AT[:, 0] * np.sin(facing) + TRUE_AT[:, 1] * np.cos(facing)
    found = np.stack(model.camera.locate(TRUE.project(east, north)))
    off = np.hypot(*(found - [east, north])) / np.hypot(east, north)
    return float(np.sqrt(np.mean(off**2)))


def test_the_log_is_that_of_the_middle(tmp_path: Path) -> None:
    scene, middle_m = write_scene(tmp_path / "stated", stated=True)
    model = fit(scene, "camera")
    boxes = np.concatenate([one.boxes().xyxy_px for one in scene.recordings])
    places = model.locate(boxes)
    east, north = model.plane.to_plane(places.latitude_deg, places.longitude_deg)
    error = np.hypot(east - middle_m[:, 0], north - middle_m[:, 1])
    np.testing.assert_allclose([box.error_m for box in model.report.boxes], error, atol=0.5)
    assert not any(box.outlier for box in model.report.boxes)
    bare, _ = write_scene(tmp_path / "bare", stated=False)
    assert model.report.rmse_m < 0.7 * fit(bare, "camera").report.rmse_m


@pytest.mark.parametrize(("ships", "coming", "bound"), [(1, True, 0.03), (2, False, 0.01)])
def test_few_ships_are_as_long_as_is_stated(
    tmp_path: Path, ships: int, coming: bool, bound: float
) -> None:
    """From ahead a box tells the beam, and it ends half a length before the middle."""
    off = []
    for seed in range(3):
        for stated in (False, True):
            scene, _ = write_scene(
                tmp_path / f"{seed}{stated}", stated=stated, ships=ships, coming=coming, seed=seed
            )
            model = fit(scene, "camera")
            off.append(camera_off(model))
            if stated:
                (height,) = [p for p in model.report.parameters if p.name == "height_m"]
                assert abs(height.value - 25.0) < 3.0 * height.sigma
    assert max(off[1::2]) < bound
    assert np.mean(off[1::2]) < 0.3 * np.mean(off[::2])
