"""What is done to pixels, against closed forms and other implementations."""

from __future__ import annotations

import colorsys
import io
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

pytest.importorskip("torch")

import torch
from torch import Tensor

from sightline.training import photometric
from sightline.training.augmentation import Augmentation, distort

NONE = Augmentation(
    rotation=False, brightness=False, exposure=False, blur=False, noise=False, mosaic=False,
    flip=False, color=False, compression=False, paste=False, wash=False,
)  # fmt: skip


def _ramp() -> Tensor:
    """Every level once, the channels in other orders."""
    levels = torch.arange(256, dtype=torch.uint8).reshape(16, 16)
    return torch.stack([levels, levels.flip(0), levels.T.contiguous()])


def _scene(seed: int = 0, height: int = 48, width: int = 64) -> Tensor:
    """Smooth, and of all colours."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width] / 16.0
    waves = [np.sin(x * a + y * b + c) for a, b, c in rng.uniform(0.3, 1.2, (3, 3))]
    return torch.from_numpy(np.array([127.5 + 110.0 * wave for wave in waves]).astype(np.uint8))


def _impulse(size_px: int = 15) -> Tensor:
    image = torch.zeros(3, size_px, size_px, dtype=torch.uint8)
    image[:, size_px // 2, size_px // 2] = 255
    return image


def _float(image: Tensor) -> NDArray[np.float64]:
    return np.asarray(image.numpy(), dtype=np.float64)


@pytest.mark.parametrize("offset", [-0.2, -0.05, 0.0, 0.13, 0.2])
def test_brightness_is_an_offset(offset: float) -> None:
    wanted = np.clip(_float(_ramp()) + 255.0 * offset, 0.0, 255.0)
    assert np.abs(_float(photometric.brighten(_ramp(), offset)) - wanted).max() <= 0.501


@pytest.mark.parametrize("factor", [0.65, 0.9, 1.0, 1.35])
def test_exposure_is_a_factor(factor: float) -> None:
    wanted = np.clip(factor * _float(_ramp()), 0.0, 255.0)
    assert np.abs(_float(photometric.expose(_ramp(), factor)) - wanted).max() <= 1.0


@pytest.mark.parametrize("gamma", [0.6, 1.0, 1.6])
def test_gamma_is_a_power(gamma: float) -> None:
    changed = _float(photometric.gamma_correct(_ramp(), gamma))
    wanted = 255.0 * (_float(_ramp()) / 255.0) ** gamma
    assert np.abs(changed - wanted).max() <= 1.0
    assert {changed.min(), changed.max()} == {0.0, 255.0}


@pytest.mark.parametrize(("sigma_px", "size_px"), [(0.5, 3), (1.2, 5), (3.0, 5)])
def test_a_point_is_blurred_to_a_gaussian_that_is_cut_off(sigma_px: float, size_px: int) -> None:
    steps = np.arange(15) - 7
    profile = np.where(np.abs(steps) <= size_px // 2, np.exp(-0.5 * (steps / sigma_px) ** 2), 0.0)
    wanted = 255.0 * np.outer(profile, profile) / profile.sum() ** 2
    blurred = _float(photometric.blur(_impulse(), sigma_px, size_px))
    assert np.abs(blurred - wanted).max() <= 0.51
    # What has no detail has none to lose, at the borders neither.
    even = torch.full((3, 9, 9), 77, dtype=torch.uint8)
    assert torch.equal(photometric.blur(even, sigma_px, size_px), even)


@pytest.mark.parametrize(
    ("length_px", "profile"),
    [(2.0, [1 / 4, 1 / 2, 1 / 4]), (4.0, [1 / 8, 1 / 4, 1 / 4, 1 / 4, 1 / 8])],
)
@pytest.mark.parametrize("upright", [False, True])
def test_a_point_that_moves_along_the_rows_is_a_line(
    length_px: float, profile: list[float], upright: bool
) -> None:
    """A point between two pixels is shared by them: a box of the length over a triangle of 2 px."""
    blurred = _float(photometric.motion_blur(_impulse(), length_px, 90.0 if upright else 0.0))
    wanted = np.zeros((15, 15))
    reach = len(profile) // 2
    wanted[7, 7 - reach : 8 + reach] = 255.0 * np.array(profile)
    assert np.abs(blurred - (wanted.T if upright else wanted)).max() <= 1.0


@pytest.mark.parametrize("angle_deg", [0.0, 25.0, 45.0, 110.0])
def test_motion_goes_its_way_and_moves_nothing(angle_deg: float) -> None:
    length_px = 4.0
    kernel = photometric.line_kernel(length_px, angle_deg)
    middle = len(kernel) // 2
    rows, columns = np.mgrid[: len(kernel), : len(kernel)] - middle
    assert kernel.sum() == pytest.approx(1.0)
    assert (kernel * rows).sum() == pytest.approx(0.0, abs=1e-9)
    assert (kernel * columns).sum() == pytest.approx(0.0, abs=1e-9)
    # Rows count downwards, so a line that rises to the right has a negative moment.
    angle = np.deg2rad(angle_deg)
    wanted = -(length_px**2) / 12.0 * np.sin(angle) * np.cos(angle)
    assert (kernel * rows * columns).sum() == pytest.approx(wanted, abs=0.1)
    # A line of that length has a twelfth of its square as variance; a pixel adds up to a quarter.
    spread = (kernel * (rows**2 + columns**2)).sum() - length_px**2 / 12.0
    assert 0.0 <= spread <= 0.5


def test_noise_is_of_its_deviation_in_each_channel_by_itself() -> None:
    image = torch.full((3, 120, 160), 128, dtype=torch.uint8)
    noise = _float(photometric.add_noise(image, 0.04, np.random.default_rng(3))) - 128.0
    # Rounding to levels adds a twelfth to the variance.
    wanted = np.sqrt((0.04 * 255.0) ** 2 + 1.0 / 12.0)
    for channel in noise:
        assert channel.mean() == pytest.approx(0.0, abs=0.3)
        assert channel.std() == pytest.approx(wanted, rel=0.03)
    together = np.corrcoef(noise.reshape(3, -1))
    assert np.abs(together - np.eye(3)).max() < 0.03
    along = np.corrcoef(noise[0, :, 1:].ravel(), noise[0, :, :-1].ravel())[0, 1]
    assert abs(along) < 0.03
    again = photometric.add_noise(image, 0.04, np.random.default_rng(3))
    assert torch.equal(again, photometric.add_noise(image, 0.04, np.random.default_rng(3)))


@pytest.mark.parametrize(
    ("hue_deg", "saturation"), [(0.0, 0.0), (20.0, 0.0), (-20.0, 0.1), (120, 0)]
)
def test_colours_turn_as_on_the_circle_of_hues(hue_deg: float, saturation: float) -> None:
    image = _scene(4)
    changed = _float(photometric.recolor(image, hue_deg, saturation))
    for row, column in np.random.default_rng(0).integers(0, 48, (60, 2)):
        hue, share, value = colorsys.rgb_to_hsv(*(_float(image)[:, row, column] / 255.0))
        share = min(max(share + saturation, 0.0), 1.0)
        wanted = colorsys.hsv_to_rgb((hue + hue_deg / 360.0) % 1.0, share, value)
        # OpenCV's hues are steps of two degrees: half a step of them is four levels.
        assert np.abs(changed[:, row, column] - 255.0 * np.array(wanted)).max() <= 6.0


def test_grey_stays_grey() -> None:
    image = torch.arange(256, dtype=torch.uint8).reshape(1, 16, 16).repeat(3, 1, 1)
    assert torch.equal(photometric.recolor(image, 20.0, 0.14), image)


def test_channels_are_shifted_each_by_its_own() -> None:
    wanted = np.clip(_float(_ramp()) + np.array([14.0, -9.0, 18.0])[:, None, None], 0.0, 255.0)
    assert np.array_equal(_float(photometric.shift_channels(_ramp(), (14.0, -9.0, 18.0))), wanted)


@pytest.mark.parametrize("quality", [45, 95])
def test_compression_is_that_of_pillow(quality: int) -> None:
    image = _scene(1)
    file = io.BytesIO()
    pixels = np.ascontiguousarray(image.permute(1, 2, 0).numpy())
    Image.fromarray(pixels).save(file, "JPEG", quality=quality)
    wanted = np.asarray(Image.open(file), dtype=np.float64).transpose(2, 0, 1)
    ours = _float(photometric.compress(image, quality))
    assert np.abs(ours - wanted).mean() < 0.5
    # Red and blue have other weights in it: confusing them is not a question of rounding.
    red = torch.tensor([220, 30, 60], dtype=torch.uint8)[:, None, None].repeat(1, 16, 16)
    assert np.abs(_float(photometric.compress(red, quality)) - _float(red)).max() <= 6.0


@pytest.mark.parametrize(
    "name", ["brightness", "exposure", "blur", "noise", "color", "compression"]
)
def test_each_augmentation_is_switched_by_its_own_setting(name: str) -> None:
    image = _scene()
    only = replace(NONE, **{name: True})
    changed = 0
    for seed in range(60):
        assert torch.equal(distort(np.random.default_rng(seed), image, NONE), image)
        made = distort(np.random.default_rng(seed), image, only)
        assert torch.equal(made, distort(np.random.default_rng(seed), image, only))
        assert (made.shape, made.dtype) == (image.shape, torch.uint8)
        changed += not torch.equal(made, image)
    assert 5 <= changed <= 50


def test_augmentations_are_drawn_one_by_one() -> None:
    """On an even picture brightness is the shift of the mean, and noise the deviation."""
    image = torch.full((3, 24, 24), 128, dtype=torch.uint8)
    both = replace(NONE, brightness=True, noise=True)
    seen = np.zeros((2, 2))
    for seed in range(1500):
        made = _float(distort(np.random.default_rng([9, seed]), image, both))
        seen[int(abs(made.mean() - 128.0) > 1.0), int(made.std() > 1.0)] += 1
    # Half of them with another brightness (a fiftieth of which is too little to be seen) and a
    # quarter with noise; three standard deviations of a binomial share.
    bright, noisy = 0.5 * 0.98, 0.25
    for row, p in enumerate([1.0 - bright, bright]):
        for column, q in enumerate([1.0 - noisy, noisy]):
            margin = 3.0 * np.sqrt(p * q * (1.0 - p * q) / 1500)
            assert seen[row, column] / 1500 == pytest.approx(p * q, abs=margin)


def test_augmentations_span_what_they_are_said_to_span() -> None:
    image = torch.full((3, 16, 16), 120, dtype=torch.uint8)

    def levels(name: str) -> NDArray[np.float64]:
        only = replace(NONE, **{name: True})
        made = [distort(np.random.default_rng([1, i]), image, only) for i in range(800)]
        return np.array([_float(one).mean() for one in made])

    brightness = levels("brightness") - 120.0
    assert np.abs(brightness).max() == pytest.approx(0.2 * 255.0, abs=1.5)
    assert brightness.min() < -48.0
    assert brightness.max() > 48.0
    exposure = levels("exposure") / 255.0
    level = 120.0 / 255.0
    # Gamma reaches 1.6 and 0.6, the factor 0.65 and 1.35: here the factor and 0.6 are the extremes.
    assert exposure.min() == pytest.approx(min(level**1.6, 0.65 * level), abs=0.01)
    assert exposure.max() == pytest.approx(max(level**0.6, 1.35 * level), abs=0.01)
