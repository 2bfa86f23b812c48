from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sightline.simulation import Harbour, HarbourSettings, SimulatedCamera
from sightline.simulation.platform import SimulatedPlatform, Sway, Warp


def under_way(seed: int = 2) -> SimulatedPlatform:
    camera = SimulatedCamera.random(np.random.default_rng(seed))
    return SimulatedPlatform.random(np.random.default_rng(seed), camera, 60.0)


def test_a_hull_heaves_as_the_wave_whose_slope_it_follows() -> None:
    wave = Sway(np.array([2.0]), np.array([6.0]), np.array([0.4]))
    times = np.linspace(0.0, 12.0, 2401)
    height, slope = wave.elevation_m(times), np.radians(wave.at(times))
    # On deep water g k = w²: the height changes by -(w / k) times the slope, and the wave is as
    # high as its slope over its wave number.
    frequency = 2.0 * np.pi / 6.0
    number = frequency**2 / 9.81
    np.testing.assert_allclose(
        np.gradient(height, times)[1:-1], -(frequency / number * slope)[1:-1], atol=2e-4
    )
    assert height.max() == pytest.approx(np.radians(2.0) / number, rel=1e-4)


def test_a_boat_is_seen_from_where_the_wave_has_lifted_the_camera() -> None:
    harbour = Harbour.random(4, HarbourSettings(duration_s=60.0, moving=True))
    assert harbour.platform is not None
    for time_s in (7.3, 21.0, 44.4):
        heave = float(harbour.platform.heave_m([time_s])[0])
        assert abs(heave) > 0.01
        now = harbour.start_utc_s + time_s
        seen = harbour.outlines_px(harbour.target, [now])[0]
        higher = replace(harbour.camera, height_m=harbour.camera.height_m + heave)
        points = harbour.platform.seen(harbour.target).points_enu_m(np.array([time_s]))
        pixels = higher.project(points, harbour.platform.turn([time_s]))[0]
        np.testing.assert_allclose(seen, [*pixels.min(axis=0), *pixels.max(axis=0)], atol=1e-4)


@pytest.mark.parametrize("heave_m", [-0.3, 0.4])
def test_a_picture_from_higher_up_shows_the_water_where_it_is(heave_m: float) -> None:
    camera = SimulatedCamera(
        height_m=5.0, pitch_deg=2.0, roll_deg=0.5, heading_deg=40.0, focal_length_px=900.0,
        k1=-0.1, k2=0.01, image_size_px=(1280, 720),
    )  # fmt: skip
    warp = Warp(camera)
    bearing = np.radians(40.0 + 15.0)
    buoy = np.array([60.0 * np.sin(bearing), 60.0 * np.cos(bearing), 0.0])
    width, height = warp.still.image_size_px
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    at = warp.still.project(buoy)
    spot = 250.0 * np.exp(-0.5 * ((x - at[0]) ** 2 + (y - at[1]) ** 2) / 3.0**2)
    picture = np.repeat(spot.astype(np.uint8)[:, :, None], 3, axis=2)
    turn = under_way().turn([3.0])[0]
    shown = warp.apply(picture, turn, heave_m)[:, :, 0].astype(float)
    rows, columns = np.mgrid[: shown.shape[0], : shown.shape[1]] + 0.5
    found = np.array([(columns * shown).sum(), (rows * shown).sum()]) / shown.sum()
    higher = replace(camera, height_m=5.0 + heave_m)
    expected = higher.project(buoy[None, None], turn[None])[0, 0]
    np.testing.assert_allclose(found, expected, atol=0.3)
