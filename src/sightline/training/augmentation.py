"""Batches of crops: at all scales, with boats pasted in, varied as cameras and weather vary them.

Batch number i of a seed is always the same, so that a run that was killed goes on as if it had not
been.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torchvision.transforms.v2 import functional

from sightline.errors import InputError
from sightline.training import photometric
from sightline.training.architecture import Target
from sightline.training.data import Image, Picture, Sprite
from sightline.training.wash import Hull, draw_wash, hull_of, inner
from sightline.types import BoolArray, FloatArray, IntArray

_LEAST_SHARE = 0.5
"""Of a box that a crop must hold for the box to count; of smaller parts nothing is said."""

_FILL = 114
_TRIES = 8

_WASH_PASTED, _WASH_END_ON, _WASH_SEEN, _WASH_ALONE = 0.6, 0.9, 0.35, 0.12
"""How often boats that are pasted in, those of them that are seen from ahead or astern, a boat that
is there already, and water without a boat get a wash."""

_END_ON_ASPECT = 1.35
_NEAR_LEAST_PX = 16.0
_END_ON_SHARE = 0.35
"""Boats seen from ahead or astern have boxes about as wide as high. They are rare, and it is them
that a wash surrounds: so often one of them is pasted in, or one that is seen from the side and made
as narrow. They are taken where they are large enough to be near."""

_LARGEST_RESIZE, _LARGEST_RESIZE_END_ON = 1.8, 2.5


@dataclass(frozen=True)
class Augmentation:
    """What is done to pictures.

    The first five are the paper's, ``mosaic`` is YOLOv4's own; the rest is what a small set of
    pictures wants besides.

    Attributes:
        rotation: By up to ``rotation_deg``.
        brightness: An offset.
        exposure: A factor and a gamma.
        blur: Gaussian, or of motion.
        noise: Of the sensor.
        mosaic: Four crops in one picture, half of the time.
        flip: Left to right.
        color: Shifts of hue and saturation, and of the balance of the channels.
        compression: As JPEG does it.
        paste: Boats cut out of other pictures.
        wash: Foam rendered on the water, around boats and without any; pictures that are rendered
            have their own. Of the boats that are pasted in, more are seen from ahead or astern.
        rotation_deg: The largest.
        scales: Of crops: the least and the largest.
        native_share: Share of crops that are near the pictures' own scale, if it is in the range.
    """

    rotation: bool = True
    brightness: bool = True
    exposure: bool = True
    blur: bool = True
    noise: bool = True
    mosaic: bool = False
    flip: bool = True
    color: bool = True
    compression: bool = True
    paste: bool = True
    wash: bool = True
    rotation_deg: float = 4.0
    scales: tuple[float, float] = (0.2, 1.5)
    native_share: float = 0.6

    def __post_init__(self) -> None:
        low, high = self.scales
        if not 0.02 <= low <= high <= 8.0:
            raise InputError(
                f"scales of crops from {low:g} to {high:g} cannot be; give two between 0.02 and 8, "
                "the smaller one first"
            )

    def to_dict(self) -> dict[str, object]:
        """All settings, as JSON has them."""
        return asdict(self) | {"scales": list(self.scales)}


@dataclass(frozen=True)
class _Boxes:
    corners: FloatArray
    labels: IntArray
    ignore: BoolArray
    worth: NDArray[np.float32]


@dataclass(frozen=True)
class BatchSettings:
    """Which crops make a batch.

    Attributes:
        size_px: Width and height of a crop.
        batch: Crops in a batch.
        seed: Another seed, other crops.
        vanishing_row_px: Where boats would be without size; None: they keep theirs.
        synthetic_share: Of the crops, where there are rendered pictures.
        smallest_px: Boxes that a scale makes narrower or lower are ignored.
    """

    size_px: tuple[int, int]
    batch: int
    seed: int
    vanishing_row_px: float | None = None
    synthetic_share: float = 0.3
    smallest_px: tuple[float, float] = (6.0, 4.0)


class Batches:
    """An endless row of batches, each made of the pictures, its number and the seed alone."""

    def __init__(
        self,
        pictures: Sequence[Picture],
        backgrounds: Sequence[Picture],
        sprites: Sequence[Sprite],
        augmentation: Augmentation,
        settings: BatchSettings,
    ) -> None:
        """Prepare.

        Args:
            pictures: Real and rendered.
            backgrounds: Pictures without boats, to paste them into.
            sprites: Boats to paste.
            augmentation: What is done.
            settings: Which crops make a batch.
        """
        self._real = [picture for picture in pictures if picture.real]
        self._rendered = [picture for picture in pictures if not picture.real]
        self._backgrounds = list(backgrounds)
        self._sprites = list(sprites) if augmentation.paste else []
        self._near = [sprite for sprite in self._sprites if augmentation.wash and _is_near(sprite)]
        self._end_on = [sprite for sprite in self._near if _aspect(sprite) < _END_ON_ASPECT]
        self._settings = augmentation
        self._size = settings.size_px
        self._batch = settings.batch
        self._seed = settings.seed
        self._vanishing = settings.vanishing_row_px
        share = settings.synthetic_share if self._real else 1.0
        self._synthetic_share = share if self._rendered else 0.0
        self._smallest = settings.smallest_px

    def __call__(self, number: int) -> tuple[Tensor, list[Target]]:
        """A batch: (B, 3, H, W) float32, 0 to 1, and what is in each picture."""
        images, targets = [], []
        for k in range(self._batch):
            rng = np.random.default_rng([self._seed, number, k])
            image, boxes = self._sample(rng)
            images.append(image)
            targets.append(
                Target(
                    torch.from_numpy(boxes.corners.astype(np.float32)),
                    torch.from_numpy(boxes.labels),
                    torch.from_numpy(boxes.ignore),
                    torch.from_numpy(boxes.worth),
                )
            )
        return torch.stack(images).float() / 255.0, targets

    def _sample(self, rng: np.random.Generator) -> tuple[Tensor, _Boxes]:
        if self._settings.mosaic and rng.random() < 0.5:
            image, boxes = self._mosaic(rng)
        else:
            image, boxes = self._crop(rng)
        return self._vary(rng, image, boxes)

    def _mosaic(self, rng: np.random.Generator) -> tuple[Image, _Boxes]:
        """Four crops around a point (Bochkovskiy et al. 2020)."""
        width, height = self._size
        cut_x = int(width * rng.uniform(0.3, 0.7))
        cut_y = int(height * rng.uniform(0.3, 0.7))
        image = np.full((height, width, 3), _FILL, np.uint8)
        parts = []
        for left, right, top, bottom in (
            (0, cut_x, 0, cut_y),
            (cut_x, width, 0, cut_y),
            (0, cut_x, cut_y, height),
            (cut_x, width, cut_y, height),
        ):
            crop, boxes = self._crop(rng)
            # The part of the crop that goes here keeps its middle in view.
            x = (width - (right - left)) // 2
            y = (height - (bottom - top)) // 2
            image[top:bottom, left:right] = crop[y : y + bottom - top, x : x + right - left]
            moved = boxes.corners + np.array([left - x, top - y] * 2)
            parts.append(_clipped(moved, boxes, (left, top, right, bottom), self._smallest))
        return image, _joined(parts)

    def _crop(self, rng: np.random.Generator) -> tuple[Image, _Boxes]:
        picture, paste = self._choose(rng)
        low, high = self._settings.scales
        native = low <= 1.0 <= high and rng.random() < self._settings.native_share
        if native:
            scale = float(np.clip(np.exp(rng.normal(0.0, 0.12)), max(low, 0.8), min(high, 1.3)))
        else:
            scale = float(np.exp(rng.uniform(np.log(low), np.log(high))))
        width, height = self._size
        x, y = self._corner(rng, picture, scale)
        image = _cropped(picture.image, x, y, scale, self._size)
        corners = (picture.boxes_xyxy_px.astype(float) - [x, y, x, y]) * scale
        boxes = _Boxes(corners, picture.labels, picture.ignore, picture.worth)
        boxes = _clipped(corners, boxes, (0, 0, width, height), self._smallest)
        if self._settings.wash and picture.real:
            image = self._washed(rng, image, boxes, y, scale)
        if paste:
            image, boxes = self._paste(rng, image, boxes, y, scale)
        return image, boxes

    def _choose(self, rng: np.random.Generator) -> tuple[Picture, bool]:
        """A picture, and whether boats are pasted into it."""
        if rng.random() < self._synthetic_share:
            return self._rendered[int(rng.integers(len(self._rendered)))], False
        paste = bool(self._sprites) and rng.random() < 0.5
        if paste and self._backgrounds and rng.random() < 0.25:
            return self._backgrounds[int(rng.integers(len(self._backgrounds)))], True
        return self._real[int(rng.integers(len(self._real)))], paste

    def _corner(
        self, rng: np.random.Generator, picture: Picture, scale: float
    ) -> tuple[float, float]:
        """Where in a picture a crop begins: often such that a box is in it."""
        width, height = self._size[0] / scale, self._size[1] / scale
        full_height, full_width = picture.image.shape[:2]
        kind = rng.random()
        boxes = picture.boxes_xyxy_px[~picture.ignore].astype(float)
        if kind < 0.65 and len(boxes):
            box = boxes[int(rng.integers(len(boxes)))]
            x = 0.5 * (box[0] + box[2]) - width * rng.uniform(0.08, 0.92)
            y = 0.5 * (box[1] + box[3]) - height * rng.uniform(0.1, 0.9)
        elif kind < 0.9 and self._vanishing is not None and picture.real:
            # Where boats can be: from the horizon downwards.
            x = rng.uniform(*sorted((-0.05 * full_width, 1.05 * full_width - width)))
            y = self._vanishing - height * rng.uniform(0.2, 0.8)
        else:
            x = rng.uniform(min(0.0, full_width - width), max(0.0, full_width - width))
            y = rng.uniform(min(0.0, full_height - height), max(0.0, full_height - height))
        # At most a quarter of a crop is filled up, unless the picture is smaller than that.
        slack_x, slack_y = 0.15 * width, 0.15 * height
        x = _within(x, -slack_x, full_width - width + slack_x)
        y = _within(y, -slack_y, full_height - height + slack_y)
        return x, y

    def _horizon(self, y: float, scale: float) -> float | None:
        """Its row in a crop."""
        return None if self._vanishing is None else (self._vanishing - y) * scale

    def _washed(
        self, rng: np.random.Generator, image: Image, boxes: _Boxes, y: float, scale: float
    ) -> Image:
        """A crop with wash around one of its boats, or where there is none."""
        # By numbers of its own, so that the crops are the same without any wash.
        rng = rng.spawn(1)[0]
        horizon = self._horizon(y, scale)
        kind = rng.random()
        boats = boxes.corners[~boxes.ignore & (boxes.labels == 0)]
        hull, gap_m = None, 0.0
        if kind < _WASH_SEEN:
            if len(boats):
                hull = hull_of(rng, boats[int(rng.integers(len(boats)))], horizon)
        elif kind < _WASH_SEEN + _WASH_ALONE:
            hull, gap_m = self._passed(rng, horizon), float(rng.exponential(4.0))
        if hull is None:
            return image
        image = image.copy()
        kept = boxes.corners[~boxes.ignore]
        draw_wash(rng, image, hull, kept_xyxy_px=kept, scale=scale, gap_m=gap_m)
        return image

    def _wash_under(
        self,
        rng: np.random.Generator,
        image: Image,
        box: FloatArray,
        known: _Boxes,
        y: float,
        scale: float,
        often: float,
    ) -> None:
        """Wash, in place, of a boat that is about to be pasted over it."""
        hull = hull_of(rng, box, self._horizon(y, scale)) if rng.random() < often else None
        if hull is not None:
            kept = known.corners[~known.ignore]
            draw_wash(rng, image, hull, kept_xyxy_px=kept, scale=scale)

    def _passed(self, rng: np.random.Generator, horizon: float | None) -> Hull:
        """A boat that is not to be seen, in a crop or beside it."""
        width, height = self._size
        above = 0.2 * height if horizon is None else horizon
        rise = max(height - above, 8.0) * float(rng.uniform(0.05, 1.3))
        px_per_m = rise / float(rng.uniform(2.5, 7.0))
        return Hull(
            x_px=float(rng.uniform(-0.3, 1.3)) * width,
            row_px=above + rise,
            px_per_m=px_per_m,
            rise_px=rise,
            heading_rad=float(rng.uniform(-np.pi, np.pi)),
        )

    def _paste(
        self,
        rng: np.random.Generator,
        image: Image,
        boxes: _Boxes,
        y: float,
        scale: float,
    ) -> tuple[Image, _Boxes]:
        image = image.copy()
        parts = [boxes]
        known = boxes
        for _ in range(1 + int(rng.random() < 0.35)):
            end_on = bool(self._near) and rng.random() < _END_ON_SHARE
            sprite = self._boat_end_on(rng) if end_on else _one_of(rng, self._sprites)
            for _ in range(_TRIES):
                placed = self._place(rng, sprite, known, y, scale, near=end_on)
                if placed is not None:
                    resize, left, top = placed
                    if self._settings.wash and sprite.label == 0:
                        box = sprite.box_xyxy_px * resize + [left, top, left, top]
                        often = _WASH_END_ON if end_on else _WASH_PASTED
                        self._wash_under(rng.spawn(1)[0], image, box, known, y, scale, often)
                    # A boat that comes out of the sun shows its dark side.
                    shade = float(rng.uniform(0.0, 0.5)) if end_on else 0.0
                    corners = _laid(rng, image, sprite, resize, left, top, shade=shade)
                    one = _Boxes(
                        corners[None],
                        np.array([sprite.label]),
                        np.array([False]),
                        np.array([sprite.worth], np.float32),
                    )
                    window = (0, 0, *self._size)
                    parts.append(_clipped(corners[None], one, window, self._smallest))
                    known = _joined(parts)
                    break
        return image, _joined(parts)

    def _boat_end_on(self, rng: np.random.Generator) -> Sprite:
        if self._end_on and rng.random() < 0.5:
            return _one_of(rng, self._end_on)
        return _narrowed(_one_of(rng, self._near), float(rng.uniform(0.9, 1.6)))

    def _place(
        self,
        rng: np.random.Generator,
        sprite: Sprite,
        boxes: _Boxes,
        y: float,
        scale: float,
        *,
        near: bool,
    ) -> tuple[float, float, float] | None:
        """Size factor, left and top of a sprite in a crop; None where it would not fit there."""
        width, height = self._size
        factor = float(np.exp(rng.normal(0.0, 0.2)))
        if self._vanishing is not None and sprite.waterline_px > self._vanishing + 3.0:
            # Near boats are rare, and are what is small in a crop of small scale.
            lowest = y + height / scale
            first = max(self._vanishing + 4.0, y + 4.0)
            if lowest <= first:
                return None
            depth = rng.random() ** (2.0 if scale > 0.6 and not near else 1.0)
            row = first + (lowest - first) * depth
            factor *= (row - self._vanishing) / (sprite.waterline_px - self._vanishing)
        else:
            row = sprite.waterline_px + rng.normal(0.0, 12.0)
        resize = factor * scale
        box_width, box_height = (sprite.box_xyxy_px[2:] - sprite.box_xyxy_px[:2]) * resize
        largest = _LARGEST_RESIZE_END_ON if near else _LARGEST_RESIZE
        if not 0.12 <= resize <= largest or box_height < self._smallest[1] + 1.0:
            return None
        bottom = (row - y) * scale
        middle = rng.uniform(-0.2 * box_width, width + 0.2 * box_width)
        corners = np.array(
            [middle - box_width / 2, bottom - box_height, middle + box_width / 2, bottom]
        )
        if bottom > height + 0.3 * box_height:
            return None
        real = boxes.corners[~boxes.ignore]
        low = np.maximum(real[:, :2], corners[:2] - 2.0)
        high = np.minimum(real[:, 2:], corners[2:] + 2.0)
        if len(real) and (np.maximum(high - low, 0.0).prod(axis=1) > 0.0).any():
            return None
        return (
            resize,
            corners[0] - sprite.box_xyxy_px[0] * resize,
            corners[1] - sprite.box_xyxy_px[1] * resize,
        )

    def _vary(self, rng: np.random.Generator, image: Image, boxes: _Boxes) -> tuple[Tensor, _Boxes]:
        """Flip, rotate and change the pixels: (3, H, W) uint8, and the boxes."""
        width, height = self._size
        if self._settings.flip and rng.random() < 0.5:
            image = np.ascontiguousarray(image[:, ::-1])
            flipped = boxes.corners[:, [2, 1, 0, 3]] * [-1.0, 1.0, -1.0, 1.0]
            flipped[:, [0, 2]] += width
            boxes = _Boxes(flipped, boxes.labels, boxes.ignore, boxes.worth)
        varied = torch.from_numpy(image.transpose(2, 0, 1))
        if self._settings.rotation and rng.random() < 0.4:
            angle_deg = float(rng.uniform(-1.0, 1.0)) * self._settings.rotation_deg
            varied = rotate_image(varied, angle_deg)
            turned = rotate_boxes(boxes.corners, angle_deg, self._size)
            boxes = _clipped(turned, boxes, (0, 0, width, height), self._smallest)
        return distort(rng, varied, self._settings), boxes


def rotate_image(image: Tensor, angle_deg: float) -> Tensor:
    """Rotate a picture about its middle; what comes into view is grey.

    Args:
        image: (3, H, W) uint8.
        angle_deg: Counter-clockwise.
    """
    fill = [float(_FILL)] * 3
    return functional.rotate(image, angle_deg, functional.InterpolationMode.BILINEAR, fill=fill)


def rotate_boxes(
    xyxy_px: FloatArray, angle_deg: float, image_size_px: tuple[int, int]
) -> FloatArray:
    """Boxes around the ellipses that boxes hold, when their picture is rotated about its middle.

    A box around its own turned corners would grow with every angle; boats do not fill theirs.

    Args:
        xyxy_px: (N, 4).
        angle_deg: Counter-clockwise.
        image_size_px: Width and height.

    Returns:
        (N, 4), some of them partly or wholly outside the picture.
    """
    angle = np.deg2rad(angle_deg)
    # Rows count downwards.
    rotation = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    middle = 0.5 * np.array(image_size_px, dtype=float)
    centres = middle + (0.5 * (xyxy_px[:, :2] + xyxy_px[:, 2:]) - middle) @ rotation.T
    radii = 0.5 * (xyxy_px[:, 2:] - xyxy_px[:, :2])
    reach = np.sqrt(radii**2 @ rotation.T**2)
    return np.concatenate([centres - reach, centres + reach], axis=1)


def distort(rng: np.random.Generator, image: Tensor, settings: Augmentation) -> Tensor:
    """Change pixels, and leave boxes where they are; (3, H, W) uint8."""
    if settings.brightness and rng.random() < 0.5:
        image = photometric.brighten(image, float(rng.uniform(-0.2, 0.2)))
    if settings.exposure and rng.random() < 0.6:
        if rng.random() < 0.5:
            image = photometric.gamma_correct(image, float(rng.uniform(0.6, 1.6)))
        else:
            image = photometric.expose(image, float(rng.uniform(0.65, 1.35)))
    if settings.color:
        if rng.random() < 0.4:
            hue_deg, saturation = rng.uniform(-20.0, 20.0), rng.uniform(-0.14, 0.14)
            image = photometric.recolor(image, float(hue_deg), float(saturation))
        if rng.random() < 0.4:
            red, green, blue = rng.uniform(-1.0, 1.0, 3) * [14.0, 14.0, 18.0]
            image = photometric.shift_channels(image, (float(red), float(green), float(blue)))
    if settings.blur and rng.random() < 0.2:
        if rng.random() < 0.5:
            size_px = 3 if rng.random() < 1.0 / 3.0 else 5
            image = photometric.blur(image, float(rng.uniform(0.5, 3.0)), size_px)
        else:
            length_px = rng.integers(1, 3) * rng.uniform(1.0, 2.0)
            image = photometric.motion_blur(image, float(length_px), float(rng.uniform(0.0, 180.0)))
    if settings.noise and rng.random() < 0.25:
        image = photometric.add_noise(image, float(rng.uniform(0.01, 0.04)), rng)
    if settings.compression and rng.random() < 0.3:
        image = photometric.compress(image, int(rng.integers(45, 96)))
    return image


def _one_of(rng: np.random.Generator, sprites: Sequence[Sprite]) -> Sprite:
    return sprites[int(rng.integers(len(sprites)))]


def _is_near(sprite: Sprite) -> bool:
    height = sprite.box_xyxy_px[3] - sprite.box_xyxy_px[1]
    return bool(sprite.label == 0 and height >= _NEAR_LEAST_PX)


def _aspect(sprite: Sprite) -> float:
    width, height = sprite.box_xyxy_px[2:] - sprite.box_xyxy_px[:2]
    return float(width / height)


def _narrowed(sprite: Sprite, aspect: float) -> Sprite:
    """A boat turned towards the camera, as far as its length in the picture tells.

    Args:
        sprite: The boat.
        aspect: Width by height that its hull is to have; it gets no wider.
    """
    hull = inner(sprite.box_xyxy_px)
    wide = aspect * (hull[3] - hull[1])
    width = max(2, round(sprite.image.shape[1] * min(wide / (hull[2] - hull[0]), 1.0)))
    factor = width / sprite.image.shape[1]
    size = (width, sprite.image.shape[0])
    # The margin around the hull keeps its width.
    margin = hull[0] - sprite.box_xyxy_px[0]
    x1, x2 = factor * hull[0] - margin, factor * hull[2] + margin
    return replace(
        sprite,
        image=np.asarray(cv2.resize(sprite.image, size, interpolation=cv2.INTER_AREA)),
        opacity=np.asarray(cv2.resize(sprite.opacity, size, interpolation=cv2.INTER_AREA)),
        box_xyxy_px=np.array([x1, sprite.box_xyxy_px[1], x2, sprite.box_xyxy_px[3]]),
    )


def _cropped(image: Image, x: float, y: float, scale: float, size_px: tuple[int, int]) -> Image:
    """A part of a picture, scaled; what lies outside the picture is grey."""
    width, height = size_px
    left, top = int(np.floor(x)), int(np.floor(y))
    right, bottom = int(np.ceil(x + width / scale)), int(np.ceil(y + height / scale))
    part = image[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)]
    part_x, part_y = max(left, 0), max(top, 0)
    if scale < 0.7 and min(part.shape[:2]) > 2:
        # Averaged first, as whole pixels, so that nothing small is skipped.
        reduced = (
            max(1, round(part.shape[1] * scale)),
            max(1, round(part.shape[0] * scale)),
        )
        factor_x, factor_y = reduced[0] / part.shape[1], reduced[1] / part.shape[0]
        part = np.asarray(cv2.resize(part, reduced, interpolation=cv2.INTER_AREA))
    else:
        factor_x = factor_y = 1.0
    matrix = np.array(
        [
            [scale / factor_x, 0.0, (part_x - x) * scale],
            [0.0, scale / factor_y, (part_y - y) * scale],
        ]
    )
    # OpenCV counts from the middle of a pixel.
    matrix[:, 2] += 0.5 * np.array([matrix[0, 0], matrix[1, 1]]) - 0.5
    warped = cv2.warpAffine(
        part,
        matrix,
        (width, height),
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(_FILL, _FILL, _FILL),
    )
    return np.asarray(warped, dtype=np.uint8)


def _laid(
    rng: np.random.Generator,
    image: Image,
    sprite: Sprite,
    resize: float,
    left: float,
    top: float,
    *,
    shade: float = 0.0,
) -> FloatArray:
    """Lay a sprite on a picture, in place; returns its box.

    A share of about ``shade`` of its light may be missing.
    """
    height, width = image.shape[:2]
    size = (
        max(2, round(sprite.image.shape[1] * resize)),
        max(2, round(sprite.image.shape[0] * resize)),
    )
    how = cv2.INTER_AREA if resize < 1.0 else cv2.INTER_LINEAR
    colour = np.asarray(cv2.resize(sprite.image, size, interpolation=how)).astype(np.float32)
    opacity = np.asarray(cv2.resize(sprite.opacity, size, interpolation=how))
    factor = np.array(size) / [sprite.image.shape[1], sprite.image.shape[0]]
    box = sprite.box_xyxy_px * np.tile(factor, 2)
    if rng.random() < 0.5:
        colour, opacity = colour[:, ::-1], opacity[:, ::-1]
        box = np.array([size[0] - box[2], box[1], size[0] - box[0], box[3]])
    light = np.exp(rng.normal(0.0, 0.12)) * (1.0 - shade)
    colour = colour * float(light) + float(rng.normal(0.0, 6.0))
    x, y = round(left), round(top)
    x1, y1, x2, y2 = max(x, 0), max(y, 0), min(x + size[0], width), min(y + size[1], height)
    if x2 > x1 and y2 > y1:
        own = (slice(y1 - y, y2 - y), slice(x1 - x, x2 - x))
        share = opacity[own][..., None]
        region = image[y1:y2, x1:x2].astype(np.float32)
        mixed = region * (1.0 - share) + colour[own] * share
        image[y1:y2, x1:x2] = np.clip(mixed, 0.0, 255.0).astype(np.uint8)
    return np.asarray(box + np.array([x, y, x, y]))


def _clipped(
    corners: FloatArray,
    boxes: _Boxes,
    window: tuple[float, float, float, float],
    smallest_px: tuple[float, float],
) -> _Boxes:
    """Boxes within a window; those mostly outside, or too small, are ignored."""
    low, high = np.array(window[:2], dtype=float), np.array(window[2:], dtype=float)
    inside = corners.copy().reshape(-1, 4)
    inside[:, [0, 2]] = inside[:, [0, 2]].clip(low[0], high[0])
    inside[:, [1, 3]] = inside[:, [1, 3]].clip(low[1], high[1])
    sides = inside[:, 2:] - inside[:, :2]
    full = np.maximum((corners[:, 2:] - corners[:, :2]).prod(axis=1), 1e-9)
    kept = (sides > 0.0).all(axis=1)
    doubtful = (sides.prod(axis=1) / full < _LEAST_SHARE) | (sides < smallest_px).any(axis=1)
    return _Boxes(
        inside[kept], boxes.labels[kept], (boxes.ignore | doubtful)[kept], boxes.worth[kept]
    )


def _joined(parts: Sequence[_Boxes]) -> _Boxes:
    return _Boxes(
        np.concatenate([part.corners for part in parts]),
        np.concatenate([part.labels for part in parts]),
        np.concatenate([part.ignore for part in parts]),
        np.concatenate([part.worth for part in parts]),
    )


def _within(value: float, low: float, high: float) -> float:
    """A value in a range, or the middle of an empty range."""
    return 0.5 * (low + high) if low > high else float(min(max(value, low), high))
