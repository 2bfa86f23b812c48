"""The water: waves that run, glitter under the sun, and a colour that changes with the range.

A few seconds of it are painted once and shown again and again, so that a frame costs a copy.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from sightline.simulation.camera import SimulatedCamera
from sightline.simulation.scenery import Image, Image32, Light, noise_tile, sample_tile
from sightline.types import FloatArray

_GRAVITY_MPS2 = 9.81
_TILE_PX = 256


@dataclass(frozen=True)
class _Waves:
    """Waves of some lengths on a square of water that repeats in space and time.

    Attributes:
        side_m: Of the square.
        shortest_m: Wave length.
        longest_m: Wave length.
        strength: Of their share in the light.
    """

    side_m: float
    shortest_m: float
    longest_m: float
    strength: float


# What one pixel can still resolve grows with the square of the range; each band fades out there.
_BANDS = (
    _Waves(side_m=9.0, shortest_m=0.22, longest_m=1.6, strength=0.8),
    _Waves(side_m=47.0, shortest_m=1.2, longest_m=6.0, strength=0.8),
    _Waves(side_m=260.0, shortest_m=6.0, longest_m=24.0, strength=0.42),
)

# The loop's length, and how many pictures it has a second.
_PERIOD_S = 6.0
_RATE_HZ = 12.0


class Sea:
    """A loop of the water as the camera sees it.

    Attributes:
        top_row: First row of the image that the loop covers.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        camera: SimulatedCamera,
        light: Light,
        rays: FloatArray,
        backdrop: Image32,
        cover: Image32,
        shading: Image32,
    ) -> None:
        """Paint the loop.

        Args:
            rng: Where the randomness comes from.
            camera: Through which it is seen.
            light: The sun.
            rays: (H, W, 3) unit vectors through the pixels.
            backdrop: (H, W, 3) what is seen above the water.
            cover: (H, W, 1) how far that hides the water.
            shading: (H, W, 1) what the lens leaves of the light.
        """
        self._count = round(_PERIOD_S * _RATE_HZ)
        below = rays[..., 2] < 0.0
        self.top_row = int(np.argmax(below.any(axis=1)))
        rays = rays[self.top_row :]
        below = below[self.top_row :]
        depression = np.where(below, -rays[..., 2], np.nan)
        distance = camera.height_m / depression
        heading = np.radians(camera.heading_deg)
        right = (rays[..., 0] * np.cos(heading) - rays[..., 1] * np.sin(heading)) * distance
        ahead = (rays[..., 0] * np.sin(heading) + rays[..., 1] * np.cos(heading)) * distance
        self.right_m = np.nan_to_num(right).astype(np.float32)
        self.ahead_m = np.nan_to_num(ahead).astype(np.float32)
        above, cover = backdrop[self.top_row :], cover[self.top_row :]
        rows = slice(0, int(np.flatnonzero(cover.any(axis=(1, 2)))[-1]) + 1)
        hidden = (cover * above * shading[self.top_row :])[rows]
        self._frames = []
        for picture in self._water(rng, camera, light, rays, distance, shading[self.top_row :]):
            picture[rows] = hidden + (1.0 - cover[rows]) * picture[rows]
            self._frames.append(picture)

    def at(self, time_s: float) -> Image:
        """(H - top_row, W, 3) uint8, the water and what shows above it."""
        phase = (time_s / _PERIOD_S) % 1.0
        return self._frames[int(phase * self._count) % self._count]

    def _water(
        self,
        rng: np.random.Generator,
        camera: SimulatedCamera,
        light: Light,
        rays: FloatArray,
        distance: FloatArray,
        shading: Image32,
    ) -> Iterator[Image]:
        seen = np.isfinite(distance)
        reach = np.where(seen, distance, 1e6)
        footprint = reach**2 / (camera.height_m * camera.focal_length_px)
        base = _base_colour(camera, reach)
        # Gusts roughen the water in patches; between them it mirrors the sky.
        gusts = sample_tile(noise_tile(rng, 256, 1.3), self.right_m / 1.6, self.ahead_m / 2.6)
        gusts = np.clip(0.85 + 0.28 * gusts, 0.25, 1.6) / (1.0 + reach / 2500.0)
        base += (14.0 * (0.85 - gusts) * np.clip(reach / 120.0, 0.1, 1.0))[..., None]

        lookups = []
        for band in _BANDS:
            scale = _TILE_PX / band.side_m
            maps = cv2.convertMaps(
                (self.right_m * scale) % _TILE_PX,
                (self.ahead_m * scale) % _TILE_PX,
                cv2.CV_16SC2,
            )
            fade = 1.0 / (1.0 + (footprint / (0.6 * band.longest_m)) ** 2)
            lookups.append((maps, (band.strength * fade * gusts).astype(np.float32)))
        # What is too far for single waves still shimmers, in streaks along the horizon.
        bearing = np.arctan2(self.right_m, np.maximum(self.ahead_m, 1e-3))
        streak_u = (bearing * camera.focal_length_px / 9.0) % _TILE_PX
        streak_v = (camera.focal_length_px * camera.height_m / reach / 1.1) % _TILE_PX
        streak_maps = cv2.convertMaps(
            streak_u.astype(np.float32), streak_v.astype(np.float32), cv2.CV_16SC2
        )
        far = (0.55 * gusts * footprint / (footprint + 1.5)).astype(np.float32)
        lookups.append((streak_maps, np.asarray(far, dtype=np.float32)))

        loops = [_wave_loop(rng, band, camera, _PERIOD_S, self._count) for band in _BANDS] + [
            _shimmer_loop(rng, self._count)
        ]
        # A slope that leans back mirrors the bright sky, one that leans forward shows the deep.
        contrast = (6.0 + 8.0 * np.exp(-reach / 70.0)).astype(np.float32)
        off_sun = np.degrees(np.arctan2(rays[..., 0], rays[..., 1])) - light.azimuth_deg
        off_sun = np.abs((off_sun + 180.0) % 360.0 - 180.0)
        glitter_from = (1.1 + (off_sun / 17.0) ** 2).astype(np.float32)
        # Close to the horizon glitter is too fine to see.
        covered = np.clip(camera.height_m / reach * camera.focal_length_px, 0.0, 1.0)
        covered = covered.astype(np.float32)
        lit = shading[..., 0]
        weights = [weight * contrast * lit for _, weight in lookups]
        glitter_from *= contrast * lit
        gain = 110.0 * covered / contrast
        base8 = np.clip(base * shading, 0.0, 255.0).astype(np.uint8)
        for step in range(self._count):
            waves = np.zeros(reach.shape, np.float32)
            for (maps, _), weight, loop in zip(lookups, weights, loops, strict=True):
                slopes = cv2.remap(
                    loop[step], maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
                )
                cv2.accumulateProduct(slopes, weight, waves)
            waves += gain * np.maximum(waves - glitter_from, 0.0)
            grey = waves.astype(np.int16)
            lit_water = cv2.add(base8, cv2.merge([grey, grey, grey]), dtype=cv2.CV_8U)
            yield np.asarray(lit_water, dtype=np.uint8)


def _base_colour(camera: SimulatedCamera, reach: FloatArray) -> FloatArray:
    """(..., 3): green where one looks down into it, grey-blue where it mirrors the sky."""
    angle = np.degrees(np.arctan2(camera.height_m, reach))
    angles = np.array([0.0, 0.4, 1.5, 4.0, 9.0, 20.0, 40.0])
    blue = np.interp(angle, angles, [172.0, 160.0, 144.0, 126.0, 108.0, 88.0, 74.0])
    green = np.interp(angle, angles, [168.0, 156.0, 142.0, 128.0, 114.0, 98.0, 84.0])
    red = np.interp(angle, angles, [158.0, 144.0, 124.0, 106.0, 90.0, 74.0, 62.0])
    return np.stack([blue, green, red], axis=-1)


def _wave_loop(
    rng: np.random.Generator,
    waves: _Waves,
    camera: SimulatedCamera,
    period_s: float,
    count: int,
) -> list[Image32]:
    """Slopes of a random sea along the line of sight, unit variance, that end as they begin.

    Each wave runs at the speed of deep water, its frequency rounded to whole turns in the period.
    """
    k_step = 2.0 * np.pi / waves.side_m
    kx = np.fft.fftfreq(_TILE_PX) * _TILE_PX * k_step
    k_right, k_ahead = np.meshgrid(kx, kx)
    k = np.hypot(k_right, k_ahead)
    inside = (k > 2.0 * np.pi / waves.longest_m) & (k < 2.0 * np.pi / waves.shortest_m)
    wind = np.radians(camera.heading_deg % 70.0 - 35.0) + np.pi
    along = np.cos(np.arctan2(k_right, k_ahead) - wind)
    spread = np.where(along > 0.0, along**2, 0.04)
    amplitude = np.where(inside, np.maximum(k, 1e-6) ** -1.6 * np.sqrt(spread), 0.0)
    random = rng.standard_normal((2, _TILE_PX, _TILE_PX))
    spectrum = amplitude * (random[0] + 1j * random[1]) * (1j * k_ahead + 0.3j * k_right)
    turns = np.round(np.sqrt(_GRAVITY_MPS2 * k) * period_s / (2.0 * np.pi))
    advance = np.exp(-2j * np.pi * turns / count)
    loop = []
    for _ in range(count):
        loop.append(np.fft.ifft2(spectrum).real.astype(np.float32))
        spectrum = spectrum * advance
    spread_all = float(np.std(loop[0]))
    # Crests are sharper than troughs.
    return [_sharpen(picture / spread_all) for picture in loop]


def _sharpen(slopes: Image32) -> Image32:
    return np.asarray(slopes + 0.22 * (slopes**2 - 1.0), dtype=np.float32)


def _shimmer_loop(rng: np.random.Generator, count: int) -> list[Image32]:
    """Noise that changes a few times a second and ends as it begins."""
    one, two, three, four = (noise_tile(rng, _TILE_PX, 0.35) for _ in range(4))
    loop = []
    for step in range(count):
        angle = 2.0 * np.pi * step / count
        mixed = one * np.cos(5 * angle) + two * np.sin(5 * angle)
        mixed += three * np.cos(8 * angle) + four * np.sin(8 * angle)
        loop.append(np.asarray(mixed / np.sqrt(2.0), dtype=np.float32))
    return loop
