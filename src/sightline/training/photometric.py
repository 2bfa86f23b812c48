"""Photometric augmentation: brightness, exposure, blur, noise, colour and compression.

Every function takes and returns a (3, H, W) uint8 tensor, red, green, blue, and leaves boxes where
they are. What is random is drawn outside, so that a picture is a function of its numbers.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torchvision.transforms.v2 import functional

from sightline.types import FloatArray

_LINE_POINTS = 64


def brighten(image: Tensor, offset: float) -> Tensor:
    """Add the same to every pixel.

    Args:
        image: The picture.
        offset: As a share of the full scale, -1 to 1.
    """
    return shift_channels(image, (255.0 * offset,) * 3)


def expose(image: Tensor, factor: float) -> Tensor:
    """Multiply every pixel by a factor, as a longer exposure does."""
    return functional.adjust_brightness(image, factor)


def gamma_correct(image: Tensor, gamma: float) -> Tensor:
    """Raise every pixel, as a share of the full scale, to a power."""
    return functional.adjust_gamma(image, gamma)


def blur(image: Tensor, sigma_px: float, size_px: int) -> Tensor:
    """Blur with a Gaussian that is cut off beyond a square.

    Args:
        image: The picture.
        sigma_px: Standard deviation of the Gaussian.
        size_px: Side of the square; odd.
    """
    return functional.gaussian_blur(image, [size_px, size_px], [sigma_px, sigma_px])


def motion_blur(image: Tensor, length_px: float, angle_deg: float) -> Tensor:
    """Blur along a line, as a camera that turns while the shutter is open.

    Args:
        image: The picture.
        length_px: Of the line.
        angle_deg: Of the line, counter-clockwise from the rows.
    """
    kernel = line_kernel(length_px, angle_deg)
    blurred = cv2.filter2D(_pixels(image), -1, kernel)
    return _image(blurred)


def line_kernel(length_px: float, angle_deg: float) -> FloatArray:
    """A line of light on the pixels around its middle; the sum is 1.

    Args:
        length_px: Of the line.
        angle_deg: Counter-clockwise from the rows.

    Returns:
        (K, K) float64, K odd.
    """
    reach = int(np.ceil(0.5 * length_px))
    along = (np.arange(_LINE_POINTS) + 0.5) / _LINE_POINTS - 0.5
    angle = np.deg2rad(angle_deg)
    columns = reach + length_px * along * np.cos(angle)
    rows = reach - length_px * along * np.sin(angle)
    pixels = np.arange(2 * reach + 1)
    # A point between pixels is shared by them, as in bilinear interpolation.
    by_row = np.maximum(1.0 - np.abs(rows[:, None] - pixels), 0.0)
    by_column = np.maximum(1.0 - np.abs(columns[:, None] - pixels), 0.0)
    return np.asarray(by_row.T @ by_column / _LINE_POINTS)


def add_noise(image: Tensor, deviation: float, rng: np.random.Generator) -> Tensor:
    """Add Gaussian noise to every pixel and channel.

    Args:
        image: The picture.
        deviation: Standard deviation, as a share of the full scale.
        rng: The source of the noise; torchvision's own noise can have none.
    """
    noise = torch.from_numpy(rng.standard_normal(tuple(image.shape), dtype=np.float32))
    return _rounded(image + 255.0 * deviation * noise)


def recolor(image: Tensor, hue_deg: float, saturation: float) -> Tensor:
    """Turn the hue and shift the saturation; what is grey stays grey.

    torchvision scales the saturation, which changes next to nothing in pictures of a grey sea.

    Args:
        image: The picture.
        hue_deg: On the circle of hues.
        saturation: Added, as a share of the full scale, -1 to 1.
    """
    # OpenCV has hues from 0 to 179.
    hue, shift = round(0.5 * hue_deg), round(255.0 * saturation)
    levels = cv2.cvtColor(_pixels(image), cv2.COLOR_RGB2HSV).astype(np.int16)
    levels[..., 0] = (levels[..., 0] + hue) % 180
    gray = levels[..., 1] == 0
    levels[..., 1] = np.where(gray, 0, np.clip(levels[..., 1] + shift, 0, 255))
    return _image(cv2.cvtColor(levels.astype(np.uint8), cv2.COLOR_HSV2RGB))


def shift_channels(image: Tensor, offset: tuple[float, float, float]) -> Tensor:
    """Add to red, green and blue, in levels of 255."""
    return _rounded(image + torch.tensor(offset, dtype=torch.float32)[:, None, None])


def compress(image: Tensor, quality: int) -> Tensor:
    """What JPEG leaves of a picture.

    Args:
        image: The picture.
        quality: 1 to 100.
    """
    # torchvision is about to lose its own.
    pixels = cv2.cvtColor(_pixels(image), cv2.COLOR_RGB2BGR)
    _, encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])
    decoded = cv2.imdecode(encoded, cv2.IMREAD_COLOR_RGB)
    return _image(decoded)


def _pixels(image: Tensor) -> NDArray[np.uint8]:
    """(H, W, 3), as OpenCV has pictures."""
    return np.ascontiguousarray(image.permute(1, 2, 0).numpy())


def _image(pixels: Any) -> Tensor:
    return torch.from_numpy(np.asarray(pixels)).permute(2, 0, 1)


def _rounded(image: Tensor) -> Tensor:
    return image.round().clamp(0.0, 255.0).to(torch.uint8)
