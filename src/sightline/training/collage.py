"""Batches of made harbours: photographed boats made small, before land and on the water of others.

What a photograph of a ship shows is large; what a harbour camera sees is small, and most of it is
no boat. So boats that were cut out of photographs are laid, small and many, along the waterline of
other pictures, among things that are as sharply cut out and are no boats; and whole photographs
are made small and put side by side, where a boat has the surroundings that are its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sightline.overlap import shared_area
from sightline.training.architecture import Target
from sightline.training.augmentation import Augmentation, distort
from sightline.training.data import Image, Sprite
from sightline.training.photographs import IGNORED, Photograph
from sightline.types import FloatArray

_Item = TypeVar("_Item")

BatchOf = Callable[[int], tuple[Tensor, list[Target]]]

_WIDTHS_PX = (9.0, 110.0)
_SMALLEST_PX = (5.0, 4.0)
_LEAST_SHARE = 0.5
_TRIES = 8
_LEAST_CONTRAST = 20.0
_APART_PX, _LEAST_PART_PX = 3, 40
"""How far from all boats a part of a photograph is that counts as bare, and its least side."""
_HIDDEN = 0.45
"""Share of a box that nearer boats may cover; what is covered more is neither right nor wrong."""
_SOFT = 0.45
"""How often a picture is made smaller and larger again, as where a frame is enlarged."""


@dataclass(frozen=True)
class Collage:
    """What made harbours are made of.

    Attributes:
        photographs: Of boats.
        backgrounds: Without anything that is looked for.
        scenes: Pictures of a scene without boats, red, green, blue.
        cut_outs: Boats.
        side_by_side: How often photographs are put side by side, of those pictures that have boats.
        bare: How often a picture has no boat at all, but what stands around them.
    """

    photographs: Sequence[Photograph]
    backgrounds: Sequence[Photograph]
    scenes: Sequence[Image]
    cut_outs: Sequence[Sprite]
    side_by_side: float = 0.35
    bare: float = 0.3


class _Boxes:
    """Boxes in a picture that is being made."""

    def __init__(self) -> None:
        self.corners: list[FloatArray] = []
        self.labels: list[int] = []
        self.ignore: list[bool] = []

    def add(self, corners: FloatArray, label: int, *, ignore: bool = False) -> None:
        self.corners.append(np.asarray(corners, dtype=float))
        self.labels.append(max(label, 0))
        self.ignore.append(ignore or label == IGNORED)

    def array(self) -> FloatArray:
        return np.array(self.corners, dtype=float).reshape(-1, 4)


class CollageBatches:
    """An endless row of batches, each made of the material, its number and the seed alone."""

    def __init__(
        self,
        material: Collage,
        augmentation: Augmentation,
        *,
        size_px: tuple[int, int],
        batch: int,
        seed: int,
    ) -> None:
        """Prepare.

        Args:
            material: What the pictures are made of.
            augmentation: What is done to them.
            size_px: Width and height.
            batch: Pictures in a batch.
            seed: Another seed, other pictures.
        """
        self._material = material
        self._augmentation = augmentation
        self._size = size_px
        self._batch = batch
        self._seed = seed

    def __call__(self, number: int) -> tuple[Tensor, list[Target]]:
        """A batch: (B, 3, H, W) float32, 0 to 1, and what is in each picture."""
        images, targets = [], []
        for k in range(self._batch):
            image, boxes = self.picture(np.random.default_rng([self._seed, number, k, 5]))
            images.append(image)
            targets.append(boxes)
        return torch.stack(images).float() / 255.0, targets

    def picture(self, rng: np.random.Generator) -> tuple[Tensor, Target]:
        """A picture, (3, H, W) uint8, and what is in it."""
        boxes = _Boxes()
        if rng.random() < self._material.bare:
            image = self._bare(rng)
        elif rng.random() < self._material.side_by_side and self._material.photographs:
            image = self._side_by_side(rng, boxes)
        else:
            image, waterline = self._scene(rng, boxes)
            self._lay(rng, image, boxes, waterline)
        if self._augmentation.flip and rng.random() < 0.5:
            image = np.ascontiguousarray(image[:, ::-1])
            for corners in boxes.corners:
                corners[[0, 2]] = self._size[0] - corners[[2, 0]]
        image = _hazy(rng, _softened(rng, image))
        varied = distort(rng, torch.from_numpy(image.transpose(2, 0, 1).copy()), self._augmentation)
        return varied, self._target(boxes)

    def _target(self, boxes: _Boxes) -> Target:
        corners = boxes.array()
        limits = np.tile(self._size, 2).astype(float)
        inside = corners.clip(0.0, limits)
        sides = inside[:, 2:] - inside[:, :2]
        full = np.maximum((corners[:, 2:] - corners[:, :2]).prod(axis=1), 1e-9)
        kept = (sides > 0.5).all(axis=1)
        doubtful = (sides.prod(axis=1) / full < _LEAST_SHARE) | (sides < _SMALLEST_PX).any(axis=1)
        ignore = np.array(boxes.ignore, dtype=bool) | doubtful
        return Target(
            torch.from_numpy(inside[kept].astype(np.float32)),
            torch.from_numpy(np.array(boxes.labels, dtype=np.int64)[kept]),
            torch.from_numpy(ignore[kept]),
        )

    # ---- photographs side by side ---------------------------------------------------------------

    def _side_by_side(self, rng: np.random.Generator, boxes: _Boxes) -> Image:
        width, height = self._size
        image = np.full((height, width, 3), 114, np.uint8)
        columns, rows = int(rng.integers(1, 7)), int(rng.integers(2, 7))
        x_cuts, y_cuts = _cuts(rng, width, columns), _cuts(rng, height, rows)
        for x1, x2 in pairwise(x_cuts):
            for y1, y2 in pairwise(y_cuts):
                self._put(rng, image, boxes, (x1, y1, x2, y2))
        return image

    def _bare(self, rng: np.random.Generator) -> Image:
        """What stands around boats, and what is far from any, side by side."""
        width, height = self._size
        image = np.empty((height, width, 3), np.uint8)
        columns, rows = int(rng.integers(1, 4)), int(rng.integers(1, 5))
        x_cuts, y_cuts = _cuts(rng, width, columns), _cuts(rng, height, rows)
        for x1, x2 in pairwise(x_cuts):
            for y1, y2 in pairwise(y_cuts):
                part = self._around(rng)
                scale = float(np.exp(rng.uniform(np.log(0.3), np.log(1.5))))
                image[y1:y2, x1:x2] = _random_crop(rng, part, scale, (x2 - x1, y2 - y1))
        return image

    def _around(self, rng: np.random.Generator) -> Image:
        """A picture without boats, or the part of one that is above or beside all of its boats."""
        backgrounds, photographs = self._material.backgrounds, self._material.photographs
        if backgrounds and rng.random() < 0.25:
            return _one_of(rng, backgrounds).image
        for _ in range(_TRIES):
            one = _one_of(rng, photographs)
            if not len(one.labels):
                return one.image
            low, high = one.boxes_xyxy_px[:, :2].min(axis=0), one.boxes_xyxy_px[:, 2:].max(axis=0)
            left, top = (int(value) - _APART_PX for value in low)
            right = int(high[0]) + _APART_PX
            parts = [(slice(0, top), slice(None))] if top >= _LEAST_PART_PX else []
            if left >= _LEAST_PART_PX:
                parts.append((slice(None), slice(0, left)))
            if one.size_px[0] - right >= _LEAST_PART_PX:
                parts.append((slice(None), slice(right, None)))
            if parts:
                part = np.ascontiguousarray(one.image[_one_of(rng, parts)])
                # Most of what is above boats is sky, in which there is little to learn.
                if part[:, :, 1].std() > _LEAST_CONTRAST:
                    return part
        return self._water(rng, self._size)

    def _put(
        self,
        rng: np.random.Generator,
        image: Image,
        boxes: _Boxes,
        window: tuple[int, int, int, int],
    ) -> None:
        """A photograph that fills a window, and its boxes."""
        x1, y1, x2, y2 = window
        backgrounds = self._material.backgrounds
        empty = bool(backgrounds) and rng.random() < 0.2
        one = _one_of(rng, backgrounds if empty else self._material.photographs)
        picture = one.image
        part, factor, left, top = _filling(rng, picture, (x2 - x1, y2 - y1))
        image[y1:y2, x1:x2] = part
        for corners, label in zip(one.boxes_xyxy_px, one.labels.tolist(), strict=True):
            moved = corners.astype(float) * factor - np.tile([left, top], 2)
            inside = moved.clip(0.0, np.tile([x2 - x1, y2 - y1], 2))
            area = (inside[2:] - inside[:2]).prod()
            if area <= 0.0 or label == -1:
                continue
            cut = area < _LEAST_SHARE * (moved[2:] - moved[:2]).prod()
            boxes.add(inside + np.tile([x1, y1], 2), label, ignore=bool(cut))

    # ---- boats laid on the water ----------------------------------------------------------------

    def _scene(self, rng: np.random.Generator, boxes: _Boxes) -> tuple[Image, float]:
        """A picture to lay boats on, and the row where its water begins."""
        width, height = self._size
        scenes, backgrounds = self._material.scenes, self._material.backgrounds
        kind = rng.random()
        if scenes and kind < 0.25:
            picture = scenes[int(rng.integers(len(scenes)))]
            scale = float(np.exp(rng.uniform(np.log(0.45), np.log(1.6))))
            return _random_crop(rng, picture, scale, self._size), height * rng.uniform(0.15, 0.7)
        if kind < 0.45 and self._material.photographs:
            image = np.empty((height, width, 3), np.uint8)
            self._put(rng, image, boxes, (0, 0, width, height))
            return image, height * rng.uniform(0.3, 0.7)
        sources = backgrounds if backgrounds and rng.random() < 0.5 else self._material.photographs
        one = _one_of(rng, sources or backgrounds)
        land, _, _, _ = _filling(rng, one.image, self._size)
        image = land.copy()
        waterline = height * float(rng.uniform(0.05, 0.85))
        row = round(waterline)
        if len(one.labels):
            # The upper part of a photograph of boats: what stands behind them.
            top = max(float(one.boxes_xyxy_px[:, 1].min()), 12.0)
            behind = one.image[: int(top)]
            image[:row] = _random_crop(rng, behind, max(row / len(behind), 0.3), (width, row))
        if row < height and self._material.photographs:
            image[row:] = self._water(rng, (width, height - row))
            if rng.random() < 0.5:
                # A shore is seldom a straight cut.
                band = slice(max(row - 3, 0), min(row + 4, height))
                image[band] = cv2.GaussianBlur(image[band], (0, 0), 1.2)
        return image, waterline

    def _water(self, rng: np.random.Generator, size_px: tuple[int, int]) -> Image:
        """What lies below the boats of a photograph."""
        for _ in range(4):
            one = _one_of(rng, self._material.photographs)
            below = float(one.boxes_xyxy_px[:, 3].max()) if len(one.labels) else 0.0
            free = one.size_px[1] - below
            if free > 14.0:
                part = one.image[int(below) + 3 :]
                factor = max(size_px[1] / len(part), 0.35) * float(rng.uniform(1.0, 1.3))
                return _random_crop(rng, part, factor, size_px)
        color = np.array([rng.integers(40, 140), rng.integers(60, 150), rng.integers(70, 170)])
        noise = rng.normal(0.0, 6.0, (size_px[1], size_px[0], 1))
        return (color + noise).clip(0.0, 255.0).astype(np.uint8)

    def _lay(self, rng: np.random.Generator, image: Image, boxes: _Boxes, waterline: float) -> None:
        """Boats, and what is cut out like boats and is none."""
        if not self._material.cut_outs:
            return
        height = self._size[1]
        count = int(rng.integers(0, 4)) if rng.random() < 0.55 else int(rng.integers(4, 16))
        rows = np.sort(waterline + (height * 1.02 - waterline) * rng.random(count) ** 2.0)
        typical = float(np.exp(rng.uniform(np.log(10.0), np.log(50.0))))
        for row in rows:
            depth = (row - waterline) / max(height - waterline, 1.0)
            wide = typical * (0.6 + 1.6 * depth) * float(np.exp(rng.normal(0.0, 0.45)))
            wide = float(np.clip(wide, *_WIDTHS_PX))
            sprite = _one_of(rng, self._material.cut_outs)
            fake = rng.random() < 0.3
            row = min(float(row), height + 0.2 * wide)
            if fake and rng.random() < 0.6:
                # What is no boat stands on land as well.
                row = float(rng.uniform(0.0, height))
            self._lay_one(rng, image, boxes, sprite, wide, row, fake=fake)

    def _lay_one(
        self,
        rng: np.random.Generator,
        image: Image,
        boxes: _Boxes,
        sprite: Sprite,
        wide: float,
        row: float,
        *,
        fake: bool,
    ) -> None:
        box = sprite.box_xyxy_px
        narrow = float(rng.uniform(0.4, 1.0)) if rng.random() < 0.2 else 1.0
        factor_x = narrow * wide / (box[2] - box[0])
        factor_y = wide / (box[2] - box[0]) * float(np.exp(rng.normal(0.0, 0.12)))
        factor_y = min(factor_y, _WIDTHS_PX[1] / (box[3] - box[1]))
        left = float(rng.uniform(-0.3 * wide, self._size[0] - 0.7 * wide))
        scale = np.array([factor_x, factor_y])
        place = np.array([left, row]) - box[[0, 3]] * scale
        corners = box * np.tile(scale, 2) + np.tile(place, 2)
        known = boxes.array()
        shared = shared_area(corners, known)
        if (shared > 0.6 * (corners[2:] - corners[:2]).prod()).any():
            return
        if not fake:
            for i in np.flatnonzero(shared > _HIDDEN * (known[:, 2:] - known[:, :2]).prod(axis=1)):
                boxes.ignore[int(i)] = True
        elif len(known) and (shared > 0.0).any():
            return
        texture = self._texture(rng, sprite) if fake else sprite.image
        _blend(rng, image, texture, sprite.opacity, scale, place)
        if not fake:
            grown = 0.5 + 0.03 * (corners[2:] - corners[:2])
            boxes.add(np.concatenate([corners[:2] - grown, corners[2:] + grown]), sprite.label)

    def _texture(self, rng: np.random.Generator, sprite: Sprite) -> Image:
        """Something else in the outline of a boat."""
        height, width = sprite.image.shape[:2]
        if self._material.backgrounds:
            one = _one_of(rng, self._material.backgrounds)
            scale = float(np.exp(rng.uniform(np.log(0.15), np.log(1.0))))
            return _random_crop(rng, one.image, scale, (width, height))
        return np.ascontiguousarray(sprite.image[::-1])


def joined(*sources: BatchOf) -> BatchOf:
    """Batches that hold those of several sources, of the same size, one after another."""

    def batch(number: int) -> tuple[Tensor, list[Target]]:
        parts = [source(number) for source in sources]
        targets = [target for _, own in parts for target in own]
        return torch.cat([images for images, _ in parts]), targets

    return batch


def _one_of(rng: np.random.Generator, items: Sequence[_Item]) -> _Item:
    return items[int(rng.integers(len(items)))]


def _cuts(rng: np.random.Generator, length: int, parts: int) -> list[int]:
    shares = rng.uniform(0.6, 1.4, parts)
    return [0, *(int(v) for v in np.round(np.cumsum(shares / shares.sum()) * length))]


def _filling(
    rng: np.random.Generator, picture: Image, size_px: tuple[int, int]
) -> tuple[Image, float, int, int]:
    """A part of a picture that fills a window, its factor, and where it begins, scaled."""
    width, height = size_px
    factor = max(width / picture.shape[1], height / picture.shape[0])
    factor *= float(np.exp(rng.uniform(0.0, 0.35)))
    how = cv2.INTER_AREA if factor < 1.0 else cv2.INTER_LINEAR
    scaled = cv2.resize(
        picture,
        (
            max(width, round(picture.shape[1] * factor)),
            max(height, round(picture.shape[0] * factor)),
        ),
        interpolation=how,
    )
    left = int(rng.integers(scaled.shape[1] - width + 1))
    top = int(rng.integers(scaled.shape[0] - height + 1))
    return np.asarray(scaled[top : top + height, left : left + width]), factor, left, top


def _random_crop(
    rng: np.random.Generator, picture: Image, scale: float, size_px: tuple[int, int]
) -> Image:
    """A part of a picture at about a scale, enlarged where it would not fill the window."""
    width, height = size_px
    scale = max(scale, width / picture.shape[1], height / picture.shape[0])
    wide = min(picture.shape[1], max(1, int(width / scale)))
    high = min(picture.shape[0], max(1, int(height / scale)))
    x = int(rng.integers(picture.shape[1] - wide + 1))
    y = int(rng.integers(picture.shape[0] - high + 1))
    how = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
    part = picture[y : y + high, x : x + wide]
    return np.asarray(cv2.resize(part, (width, height), interpolation=how), dtype=np.uint8)


def _blend(
    rng: np.random.Generator,
    image: Image,
    texture: Image,
    opacity: NDArray[np.float32],
    scale: FloatArray,
    place: FloatArray,
) -> None:
    """Lay a cut-out on a picture, in place, in the light of where it is laid."""
    height, width = image.shape[:2]
    size = np.maximum(np.round(np.array(texture.shape[1::-1]) * scale), 2).astype(int)
    how = cv2.INTER_AREA if scale[1] < 1.0 else cv2.INTER_LINEAR
    colour = cv2.resize(texture, size.tolist(), interpolation=how).astype(np.float32)
    share = cv2.resize(opacity, size.tolist(), interpolation=how)
    x, y = (round(v) for v in place)
    x1, y1 = max(x, 0), max(y, 0)
    x2, y2 = min(x + int(size[0]), width), min(y + int(size[1]), height)
    if x2 <= x1 or y2 <= y1:
        return
    own = (slice(y1 - y, y2 - y), slice(x1 - x, x2 - x))
    region = image[y1:y2, x1:x2].astype(np.float32)
    if rng.random() < 0.6:
        # Some of the light of the surroundings.
        mean, here = colour.mean(axis=(0, 1)), region.mean(axis=(0, 1))
        colour = colour + float(rng.uniform(0.0, 0.5)) * (here - mean)
    if rng.random() < 0.25:
        # Many small boats are white.
        grey = colour.mean(axis=2, keepdims=True)
        white = np.clip(110.0 + 0.75 * grey, 0.0, 255.0)
        colour = colour + float(rng.uniform(0.4, 1.0)) * (white - colour)
    colour = colour * float(np.exp(rng.normal(0.0, 0.15))) + float(rng.normal(0.0, 8.0))
    part = (share[own] * float(rng.uniform(0.85, 1.0)))[..., None]
    mixed = region * (1.0 - part) + colour[own] * part
    image[y1:y2, x1:x2] = np.clip(mixed, 0.0, 255.0).astype(np.uint8)


def _softened(rng: np.random.Generator, image: Image) -> Image:
    if rng.random() >= _SOFT:
        return image
    height, width = image.shape[:2]
    factor = float(rng.uniform(1.2, 2.4))
    small = cv2.resize(
        image, (round(width / factor), round(height / factor)), interpolation=cv2.INTER_AREA
    )
    how = cv2.INTER_LINEAR if rng.random() < 0.5 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(small, (width, height), interpolation=how), dtype=np.uint8)


def _hazy(rng: np.random.Generator, image: Image) -> Image:
    """Air between the camera and the harbour: less contrast, and the colour of the sky."""
    if rng.random() >= 0.35:
        return image
    air = np.full(3, float(rng.uniform(90.0, 235.0))) + rng.normal(0.0, 8.0, 3)
    strength = float(rng.uniform(0.05, 0.5))
    return np.clip(image * (1.0 - strength) + air * strength, 0.0, 255.0).astype(np.uint8)
