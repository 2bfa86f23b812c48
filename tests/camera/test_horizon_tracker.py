from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from sightline.camera.horizon_tracker import HorizonFinder
from sightline.detection.tiling import TilingSettings
from sightline.pipeline.fit import fit
from sightline.scene import Scene
from sightline.simulation import Harbour, HarbourSettings, Renderer


def drawn(
    left: float, right: float, *, size: tuple[int, int] = (640, 360), seed: int = 0
) -> np.ndarray:
    """Sky over water, both noisy, along a line."""
    width, height = size
    rng = np.random.default_rng(seed)
    line = np.linspace(left, right, width)
    water = np.arange(height)[:, None] >= line[None, :]
    image = np.where(water[..., None], [110.0, 95.0, 70.0], [215.0, 205.0, 200.0])
    image += rng.normal(0.0, 8.0, image.shape) * (1.0 + 2.0 * water[..., None])
    return image.clip(0, 255).astype(np.uint8)


def test_where_there_is_no_horizon_none_is_found() -> None:
    rng = np.random.default_rng(0)
    finder = HorizonFinder()
    for _ in range(3):
        assert finder.look(rng.integers(0, 255, (360, 640, 3), dtype=np.uint8)) is None
    assert finder.look(np.full((360, 640, 3), 90, np.uint8)) is None
    assert finder.look(np.zeros((4, 4, 3), np.uint8)) is None
    # And as soon as there is one it is.
    found = finder.look(drawn(150.0, 160.0))
    assert found is not None
    np.testing.assert_allclose(found, (150.0, 160.0), atol=2.0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_synthetic_harbour(seed: int) -> None:
    harbour = Harbour.random(seed, HarbourSettings(duration_s=20.0))
    renderer = Renderer(harbour)
    finder = HorizonFinder()
    for time_s in (0.0, 8.0):
        found = finder.look(renderer.image(harbour.start_utc_s + time_s))
    truth = harbour.camera.horizon_px([0.0, harbour.camera.image_size_px[0]])
    assert found is not None
    np.testing.assert_allclose(found, truth, atol=5.0)


@pytest.mark.slow
def test_real_recordings_agree_with_the_camera_fitted_to_the_log(data_dir: Path) -> None:
    scene = Scene.load(data_dir / "tracks-at-sea" / "scene.toml")
    camera = fit(scene, "camera").camera
    assert camera is not None
    columns = np.linspace(0.0, 1280.0, 41)
    truth = camera.horizon_y_px(columns)
    for recording in scene.recordings:
        finder = HorizonFinder()
        for frame in islice(recording.frames(), 16):
            found = finder.look(frame.image_bgr)
        assert found is not None
        # It is there to say where to search: from so far above the line to so far below it. A near
        # shore has its foot below the horizon, and the lens bends the horizon and not the line.
        line = np.interp(columns, [0.0, 1280.0], found)
        settings = TilingSettings()
        assert (truth > line - settings.above_px).all(), recording.name
        assert (truth < line + 0.5 * settings.below_px).all(), recording.name
        # In the middle, where no shore is near, it is the horizon to the thickness of the shore.
        assert abs(line[20] - truth[20]) < 12.0, recording.name


def test_a_single_frame_that_deceives_does_not_count_for_long() -> None:
    finder = HorizonFinder()
    finder.look(drawn(300.0, 310.0))
    for seed in range(1, 8):
        found = finder.look(drawn(150.0, 152.0, seed=seed))
    np.testing.assert_allclose(found, (150.0, 152.0), atol=2.0)
