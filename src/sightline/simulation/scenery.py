"""What does not move: sky, hills, a port on the far shore, and the posts before the camera.

All is painted in bearing and elevation, and then looked up through the lens.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.simulation.camera import SimulatedCamera
from sightline.types import FloatArray

Image = NDArray[np.uint8]
Image32 = NDArray[np.float32]

_PIXELS_PER_DEG = 56
_LOWEST_DEG, _HIGHEST_DEG = -0.8, 5.2

_HAZE = np.array([206.0, 212.0, 216.0])
_ZENITH = np.array([192.0, 156.0, 124.0])


@dataclass(frozen=True)
class Light:
    """Where the sun stands.

    Attributes:
        azimuth_deg: Clockwise from north.
        elevation_deg: Above the horizon.
        cloud_cover: 0 to 1.
    """

    azimuth_deg: float
    elevation_deg: float
    cloud_cover: float

    @classmethod
    def random(cls, rng: np.random.Generator, camera: SimulatedCamera) -> Light:
        """A sun to one side, so that it glitters in part of the image and lights the boats."""
        side = -1.0 if rng.random() < 0.5 else 1.0
        return cls(
            azimuth_deg=camera.heading_deg + side * float(rng.uniform(25.0, 75.0)),
            elevation_deg=float(rng.uniform(30.0, 50.0)),
            cloud_cover=float(rng.uniform(0.25, 0.65)),
        )

    @property
    def direction(self) -> FloatArray:
        """(3,) unit vector to the sun, east, north, up."""
        azimuth, elevation = np.radians([self.azimuth_deg, self.elevation_deg])
        return np.array(
            [
                np.sin(azimuth) * np.cos(elevation),
                np.cos(azimuth) * np.cos(elevation),
                np.sin(elevation),
            ]
        )


def pixel_rays(camera: SimulatedCamera) -> FloatArray:
    """(H, W, 3) unit vectors through the middles of all pixels."""
    width, height = camera.image_size_px
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return camera.directions(np.stack([columns, rows], axis=-1))


def noise_tile(rng: np.random.Generator, size: int, roughness: float) -> Image32:
    """(size, size) float32 of zero mean and unit variance that repeats without a seam.

    Args:
        rng: Where the randomness comes from.
        size: Pixels.
        roughness: The amplitude of a wave number k falls as ``k ** -roughness``.
    """
    k = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None, :]) * size
    k[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal((size, size))) * k**-roughness
    tile = np.fft.irfft2(spectrum, s=(size, size))
    return np.asarray((tile - tile.mean()) / tile.std(), dtype=np.float32)


def sample_tile(tile: Image32, u: FloatArray, v: FloatArray) -> Image32:
    """Values of a repeating tile at coordinates in pixels of the tile, any shape."""
    size = tile.shape[0]
    padded = np.pad(tile, ((0, 1), (0, 1)), mode="wrap")
    return cv2.remap(
        padded, (u % size).astype(np.float32), (v % size).astype(np.float32), cv2.INTER_LINEAR
    ).astype(np.float32, copy=False)


def backdrop(
    rng: np.random.Generator,
    camera: SimulatedCamera,
    light: Light,
    rays: FloatArray,
    near: Panorama | None = None,
) -> tuple[Image32, Image32]:
    """Sky and far shore.

    Args:
        rng: Where the randomness comes from.
        camera: Through which it is seen.
        light: The sun.
        rays: (H, W, 3) from `pixel_rays`.
        near: A shore that is nearer than the far one.

    Returns:
        (H, W, 3) float32, blue, green, red, and (H, W, 1) float32, how far it hides the water:
        1 above the horizon, and below it the opacity of the shore.
    """
    picture = _sky(rng, light, rays)
    cover = np.zeros((*rays.shape[:2], 1), np.float32)
    for painting in (_shore(rng, camera), *([] if near is None else [near])):
        seen = _looked_up(painting, camera, rays)
        opacity = seen[..., 3:]
        picture = np.asarray(picture * (1.0 - opacity) + seen[..., :3], dtype=np.float32)
        cover = np.asarray(opacity + cover * (1.0 - opacity), dtype=np.float32)
    return picture, np.where(rays[..., 2:] >= 0.0, np.float32(1.0), cover)


def _looked_up(painting: Panorama, camera: SimulatedCamera, rays: FloatArray) -> Image32:
    """(H, W, 4) a panorama as the camera sees it."""
    shore = painting.layer
    bearing = np.degrees(np.arctan2(rays[..., 0], rays[..., 1])) - camera.heading_deg
    bearing = (bearing + 180.0) % 360.0 - 180.0
    elevation = np.degrees(np.arcsin(np.clip(rays[..., 2], -1.0, 1.0)))
    columns = bearing * _PIXELS_PER_DEG + 0.5 * shore.shape[1] - 0.5
    rows = (painting.highest_deg - elevation) * _PIXELS_PER_DEG - 0.5
    # A pixel spans several of the panorama's; without the blur thin things would flicker away.
    across = _PIXELS_PER_DEG * np.degrees(1.0 / camera.focal_length_px)
    blurred = cv2.GaussianBlur(shore, (0, 0), max(0.45 * across, 0.3))
    return np.asarray(
        cv2.remap(
            blurred,
            columns.astype(np.float32),
            rows.astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(0, 0, 0, 0),
        ),
        dtype=np.float32,
    )


def vignette(camera: SimulatedCamera, rays: FloatArray) -> Image32:
    """(H, W, 1) float32, what the lens leaves of the light towards its corners."""
    off_axis = rays @ camera.rotation[2]
    return np.asarray(0.5 + 0.5 * off_axis**1.5, dtype=np.float32)[..., None]


def _sky(rng: np.random.Generator, light: Light, rays: FloatArray) -> Image32:
    up = np.maximum(rays[..., 2], 0.0)
    warm = np.exp(-up / 0.05)[..., None] * np.array([-10.0, -1.0, 8.0])
    sky = _ZENITH + (_HAZE - _ZENITH) * np.exp(-up / 0.22)[..., None] + warm
    towards = np.clip(rays @ light.direction, 0.0, 1.0)
    sky += 34.0 * (towards[..., None] ** 6)
    # Clouds hang in a layer, so they grow smaller and closer together towards the horizon.
    layer = np.maximum(up, 0.02)
    u, v = 120.0 * rays[..., 0] / layer, 120.0 * rays[..., 1] / layer
    tile = noise_tile(rng, 512, 1.55)
    veil = sample_tile(tile, 0.6 * u, 0.6 * v) + 0.35 * sample_tile(tile, 2.3 * u + 90, 2.3 * v)
    cover = np.clip((veil - 1.6 + 2.4 * light.cloud_cover) / 1.8, 0.0, 1.0)
    cover = cover * np.clip((up - 0.03) / 0.12, 0.0, 1.0) * 0.75
    lit = 232.0 - 18.0 * np.clip(veil, 0.0, 2.0)[..., None] * np.array([0.8, 0.95, 1.0])
    return np.asarray(sky + cover[..., None] * (lit - sky), dtype=np.float32)


def random_profile(
    rng: np.random.Generator, count: int, scale_px: float, octaves: int
) -> FloatArray:
    """(count,) a smooth random line of about zero mean and unit spread."""
    line = np.zeros(count)
    for octave in range(octaves):
        step = scale_px / 2.0**octave
        knots = rng.standard_normal(int(count / step) + 4)
        position = np.arange(count) / step
        index = position.astype(int)
        weight = position - index
        weight = weight * weight * (3.0 - 2.0 * weight)
        line += 0.55**octave * (knots[index] * (1.0 - weight) + knots[index + 1] * weight)
    return line


class Panorama:
    """Premultiplied colour and opacity in bearing and elevation, painted from far to near.

    Attributes:
        layer: (H, W, 4) float32, blue, green, red and opacity.
        highest_deg: Elevation of its upper edge.
    """

    def __init__(
        self, width: int, lowest_deg: float = _LOWEST_DEG, highest_deg: float = _HIGHEST_DEG
    ) -> None:
        """Begin with nothing.

        Args:
            width: Of the panorama.
            lowest_deg: Elevation of its lower edge.
            highest_deg: Elevation of its upper edge.
        """
        height = round((highest_deg - lowest_deg) * _PIXELS_PER_DEG)
        self.layer: Image32 = np.zeros((height, width, 4), np.float32)
        self.highest_deg = highest_deg

    @classmethod
    def around(
        cls,
        camera: SimulatedCamera,
        lowest_deg: float = _LOWEST_DEG,
        highest_deg: float = _HIGHEST_DEG,
    ) -> Panorama:
        """A panorama that is somewhat wider than what a camera sees."""
        width = round((camera.field_of_view_deg + 40.0) * _PIXELS_PER_DEG)
        return cls(width, lowest_deg, highest_deg)

    def row(self, elevation_deg: float | FloatArray) -> NDArray[np.int64]:
        """Rows of elevations."""
        return np.asarray(
            np.round((self.highest_deg - np.asarray(elevation_deg)) * _PIXELS_PER_DEG),
            dtype=np.int64,
        )

    def column(self, off_deg: float) -> int:
        """The column of a bearing, degrees to the right of the heading."""
        return int(np.round(off_deg * _PIXELS_PER_DEG + 0.5 * self.layer.shape[1]))

    def fill(
        self, top_deg: FloatArray, bottom_deg: FloatArray, colour: FloatArray, grain: Image32
    ) -> None:
        """All between two lines, in one colour with a grain."""
        first = max(int(self.row(top_deg).min()), 0)
        last = min(int(self.row(bottom_deg).max()), self.layer.shape[0])
        rows = np.arange(first, last)[:, None]
        inside = (rows >= self.row(top_deg)[None, :]) & (rows < self.row(bottom_deg)[None, :])
        height, width = inside.shape
        texture = np.tile(grain, (1 + height // grain.shape[0], 1 + width // grain.shape[1]))
        painted = colour + texture[:height, :width, None] * (0.10 * colour)
        part = self.layer[first:last]
        part[inside, :3] = painted[inside]
        part[inside, 3] = 1.0

    def rectangle(self, left: int, right: int, top: int, bottom: int, colour: FloatArray) -> None:
        """An opaque rectangle."""
        block = self.layer[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)]
        block[..., :3] = colour
        block[..., 3] = 1.0

    def line(
        self, start: tuple[int, int], end: tuple[int, int], colour: FloatArray, px: int
    ) -> None:
        """A straight line."""
        cv2.line(self.layer, start, end, (*colour.tolist(), 1.0), px, cv2.LINE_AA)

    def polygon(self, corners: Sequence[tuple[int, int]], colour: FloatArray) -> None:
        """An opaque polygon."""
        points = np.array(corners, dtype=np.int32)
        cv2.fillPoly(self.layer, [points], (*colour.tolist(), 1.0), cv2.LINE_AA)

    def disc(self, centre: tuple[int, int], axes: tuple[int, int], colour: FloatArray) -> None:
        """A filled ellipse."""
        cv2.ellipse(self.layer, centre, axes, 0, 0, 360, (*colour.tolist(), 1.0), -1)


def hazy(colour: tuple[float, float, float], haze: float) -> FloatArray:
    """A colour as haze leaves it."""
    return np.array(colour) * (1.0 - haze) + _HAZE * haze


def _shore(rng: np.random.Generator, camera: SimulatedCamera) -> Panorama:
    """Hills, a town, a port with cranes and sheds, trees and a breakwater with a light."""
    painting = Panorama.around(camera)
    width = painting.layer.shape[1]
    grain = noise_tile(rng, 256, 0.8)
    degrees = np.full(width, 1.0)
    # The shore is two to five kilometres off: its foot lies that little below the horizon.
    distance = 3200.0 * np.exp(0.25 * np.clip(random_profile(rng, width, 1600.0, 2), -1.5, 1.5))
    foot = -np.degrees(camera.height_m / distance)

    far = np.clip(0.85 + 0.55 * random_profile(rng, width, 1500.0, 5), 0.12, 2.6)
    painting.fill(far, foot, hazy((150.0, 132.0, 118.0), 0.55), 0.12 * grain)
    middle = np.clip(0.42 + 0.30 * random_profile(rng, width, 900.0, 5), 0.05, 1.4)
    painting.fill(middle, foot, hazy((98.0, 112.0, 96.0), 0.40), 0.4 * grain)

    _houses(rng, painting, foot, middle)
    near = np.clip(0.06 + 0.05 * random_profile(rng, width, 260.0, 5), 0.0, 0.3)
    painting.fill(near * degrees, foot, hazy((70.0, 92.0, 74.0), 0.28), grain)
    _port(rng, painting, foot)
    _trees(rng, painting, foot)
    quay = hazy((120.0, 132.0, 140.0), 0.25)
    painting.fill(foot + 0.035, foot, quay, 0.5 * grain)
    _breakwater(rng, painting, camera, grain)
    return painting


def _houses(
    rng: np.random.Generator, painting: Panorama, foot: FloatArray, hills: FloatArray
) -> None:
    width = foot.size
    walls = [(216, 222, 226), (190, 204, 216), (168, 180, 198), (140, 154, 182), (196, 196, 196)]
    density = np.clip(0.7 + 0.7 * random_profile(rng, width, 1200.0, 2), 0.08, 1.5)
    for left in range(0, width - 60, 7):
        if rng.random() > 0.8 * density[left]:
            continue
        # Houses climb the hills; tall ones stand in the middle of a town.
        base = foot[left] + float(rng.uniform(0.0, 0.5)) * (hills[left] - foot[left])
        tall = rng.random() < 0.05 * density[left]
        high = float(rng.uniform(0.35, 0.85)) if tall else float(rng.uniform(0.09, 0.26))
        wide = int(rng.integers(9, 20)) if tall else int(rng.integers(8, 30))
        colour = hazy(walls[int(rng.integers(len(walls)))], 0.38) * float(rng.uniform(0.8, 1.05))
        top, bottom = int(painting.row(base + high)), int(painting.row(base))
        painting.rectangle(left, left + wide, top, bottom, colour)
        painting.rectangle(left + 2 * wide // 3, left + wide, top, bottom, 0.86 * colour)
        if tall:
            for row in range(top + 3, bottom - 2, 4):
                painting.rectangle(left + 1, left + wide - 1, row, row + 1, 0.8 * colour)
        else:
            roof = hazy((96, 104, 150), 0.42) if rng.random() < 0.6 else 0.8 * colour
            painting.rectangle(left, left + wide, top - 2, top, roof)


def _port(rng: np.random.Generator, painting: Panorama, foot: FloatArray) -> None:
    width = foot.size
    centre = int(width * rng.uniform(0.35, 0.65))
    sheds = [(200, 206, 210), (150, 160, 190), (190, 160, 130), (120, 150, 196), (214, 218, 216)]
    for _ in range(16):
        left = centre + int(rng.normal(0.0, 0.09 * width))
        if not 0 <= left < width - 120:
            continue
        wide, high = int(rng.integers(28, 110)), float(rng.uniform(0.14, 0.34))
        colour = hazy(sheds[int(rng.integers(len(sheds)))], 0.26)
        top, bottom = int(painting.row(foot[left] + high)), int(painting.row(foot[left]))
        painting.rectangle(left, left + wide, top, bottom, colour)
        painting.rectangle(left, left + wide, top, top + 2, 0.75 * colour)
    for _ in range(3):
        left = centre + int(rng.normal(0.0, 0.07 * width))
        if not 120 <= left < width - 120:
            continue
        _crane(painting, left, float(foot[left]), float(rng.uniform(0.9, 1.5)))
    for _ in range(40):
        column = int(np.clip(centre + rng.normal(0.0, 0.16 * width), 0, width - 1))
        top = int(painting.row(foot[column] + float(rng.uniform(0.1, 0.3))))
        bottom = int(painting.row(foot[column]))
        painting.line((column, top), (column, bottom), hazy((214, 216, 216), 0.2), 1)


def _crane(painting: Panorama, left: int, foot_deg: float, high_deg: float) -> None:
    """A gantry crane: two legs, a beam over the water, and stays to its head."""
    colour = hazy((150, 110, 70), 0.35)
    ground = int(painting.row(foot_deg))
    beam = int(painting.row(foot_deg + 0.62 * high_deg))
    head = int(painting.row(foot_deg + high_deg))
    span = int(0.45 * high_deg * _PIXELS_PER_DEG)
    for column in (left, left + span):
        painting.line((column, ground), (column, beam), colour, 2)
    painting.line((left - span, beam), (left + 3 * span // 2, beam), colour, 2)
    painting.line((left, beam), (left, head), colour, 2)
    painting.line((left, head), (left - span, beam), colour, 1)
    painting.line((left, head), (left + 3 * span // 2, beam), colour, 1)


def _trees(rng: np.random.Generator, painting: Panorama, foot: FloatArray) -> None:
    width = foot.size
    density = np.clip(random_profile(rng, width, 700.0, 2), 0.0, 1.5)
    for column in range(0, width, 4):
        if rng.random() > 0.5 * density[column]:
            continue
        size = float(rng.uniform(0.04, 0.12))
        colour = hazy((58, 84, 62), 0.22) * float(rng.uniform(0.8, 1.1))
        centre = (column, int(painting.row(foot[column] + 0.8 * size)))
        radius = max(int(size * _PIXELS_PER_DEG), 1)
        painting.disc(centre, (radius + 1, radius), colour)


def _breakwater(
    rng: np.random.Generator, painting: Panorama, camera: SimulatedCamera, grain: Image32
) -> None:
    """A mole of stones that comes in from one side, with a light at its head."""
    width = painting.layer.shape[1]
    reach = int(width * rng.uniform(0.24, 0.34))
    columns = np.arange(reach)
    distance = 1300.0
    foot = np.full(width, -np.degrees(camera.height_m / distance))
    top = foot.copy()
    stones = 0.03 * np.abs(random_profile(rng, reach, 12.0, 2))
    top[columns] += np.degrees(3.2 / distance) + stones
    if rng.random() < 0.5:
        top, flipped = top[::-1].copy(), True
    else:
        flipped = False
    painting.fill(top, foot, hazy((96.0, 104.0, 108.0), 0.15), grain)
    column = width - reach + 6 if flipped else reach - 6
    base = int(painting.row(float(foot[0]) + np.degrees(3.0 / distance)))
    head = int(painting.row(float(foot[0]) + np.degrees(13.0 / distance)))
    colour = hazy((60, 60, 190) if flipped else (90, 140, 60), 0.12)
    painting.rectangle(column - 4, column + 4, head, base, hazy((226, 230, 232), 0.1))
    painting.rectangle(column - 4, column + 4, head, head + (base - head) // 3, colour)
    painting.rectangle(column - 2, column + 2, head - 6, head, 0.6 * colour)
