"""Folders of photographs to learn from: boats with boxes as YOLO has them, and what is no boat."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.errors import InputError
from sightline.overlap import iou, shared_area
from sightline.training.data import Image, Sprite
from sightline.types import BoolArray, FloatArray, IntArray

_logger = logging.getLogger(__name__)

IGNORED = -2
"""Label of what is neither to be found nor wrong to find."""

_NO_BOAT = -1
_ENDINGS = (".jpg", ".jpeg", ".png", ".webp", ".bmp")
_LONGEST_PX = 1600
"""Photographs are kept no larger: what is learned from is small."""

_MOST_SHARE = 1.1
"""Of the picture: boxes that are turned with it reach a little beyond; pixels are far above."""

_CUT_PX = 128
_MARGIN = 0.2
_LEAST_PX = (70.0, 20.0)
_LEAST_FIT, _FILL_RANGE = 0.75, (0.2, 0.93)
_TOUCHES_PX = 2.0
_SHARED = 0.05
_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph, packed, and the boxes in it.

    Attributes:
        name: Of its file.
        packed: As JPEG, since thousands of them are kept.
        size_px: Width and height.
        boxes_xyxy_px: (M, 4) float32.
        labels: (M,) int64, positions in the class names; -1: something else than is looked for;
            `IGNORED`.
    """

    name: str
    packed: NDArray[np.uint8]
    size_px: tuple[int, int]
    boxes_xyxy_px: NDArray[np.float32]
    labels: IntArray

    @property
    def image(self) -> Image:
        """(H, W, 3) uint8, red, green, blue."""
        return np.asarray(cv2.imdecode(self.packed, cv2.IMREAD_COLOR_RGB), dtype=np.uint8)


def read_yolo_folder(
    folder: Path, class_names: Sequence[str], wanted: Sequence[str]
) -> list[Photograph]:
    """Photographs with boxes: ``images/NAME.jpg`` and ``labels/NAME.txt``.

    Args:
        folder: With both folders; each line of a label is ``class x y width height``, as shares of
            the picture.
        class_names: Of the folder's classes, by their numbers.
        wanted: What is to be told apart; boxes of other classes are no boats, but for those of
            the class ``ignore``, of which nothing is said.

    Raises:
        InputError: There are no pictures, a picture or a label cannot be read, or a class has no
            name.
    """
    images, labels = folder / "images", folder / "labels"
    if not labels.is_dir():
        raise InputError(
            f"{folder}: has no folder labels; expected images/NAME.jpg, labels/NAME.txt"
        )
    position = {name: i for i, name in enumerate(wanted)} | {"ignore": IGNORED}
    found = []
    for path in _pictures(images):
        packed, size = _packed(path)
        numbers, boxes = _labels(labels / f"{path.stem}.txt", len(class_names), size)
        kinds = [position.get(class_names[number], _NO_BOAT) for number in numbers]
        found.append(
            Photograph(path.name, packed, size, boxes, np.array(kinds, dtype=np.int64).reshape(-1))
        )
    return found


def read_backgrounds(folder: Path) -> list[Photograph]:
    """Photographs in which nothing of what is looked for is to be seen.

    Args:
        folder: With pictures, in folders of its own or not.

    Raises:
        InputError: There are no pictures, or one cannot be read.
    """
    nothing = np.zeros((0, 4), np.float32)
    return [
        Photograph(str(path.relative_to(folder)), *_packed(path), nothing, np.zeros(0, np.int64))
        for path in _pictures(folder)
    ]


def digest_photographs(photographs: Sequence[Photograph]) -> dict[str, object]:
    """How many photographs and boxes there are, and a hash of them all."""
    joined = hashlib.sha256()
    for one in photographs:
        for part in (one.packed, one.boxes_xyxy_px, one.labels):
            joined.update(np.ascontiguousarray(part).tobytes())
    boxes = int(sum(len(one.labels) for one in photographs))
    return {"pictures": len(photographs), "boxes": boxes, "sha256": joined.hexdigest()}


def _pictures(folder: Path) -> list[Path]:
    found = sorted(p for p in folder.rglob("*") if p.suffix.lower() in _ENDINGS and p.is_file())
    if not found:
        raise InputError(f"{folder}: has no pictures; expected some that end in .jpg or .png")
    return found


def _packed(path: Path) -> tuple[NDArray[np.uint8], tuple[int, int]]:
    """A picture as JPEG, with its width and height."""
    try:
        content = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    image = cv2.imdecode(content, cv2.IMREAD_COLOR) if len(content) else None
    if image is None:
        raise InputError(f"{path}: is no whole picture; remove it, or save it anew")
    longest = max(image.shape[:2])
    if longest > _LONGEST_PX:
        factor = _LONGEST_PX / longest
        image = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        content = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
    elif path.suffix.lower() not in (".jpg", ".jpeg"):
        content = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
    return np.asarray(content).reshape(-1), (image.shape[1], image.shape[0])


def _labels(
    path: Path, classes: int, size_px: tuple[int, int]
) -> tuple[list[int], NDArray[np.float32]]:
    """Classes and boxes of a picture; without a file there are none."""
    numbers: list[int] = []
    boxes: list[FloatArray] = []
    if not path.exists():
        return numbers, np.zeros((0, 4), np.float32)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: is no text that can be read") from error
    for number, line in enumerate(lines, start=1):
        if not line.split():
            continue
        where = f"{path}, line {number}"
        try:
            kind, x, y, width, height = (float(part) for part in line.split()[:5])
        except ValueError as error:
            raise InputError(f"{where}: expected class x y width height, got {line!r}") from error
        if not (kind.is_integer() and 0 <= kind < classes):
            raise InputError(f"{where}: class {kind:g} has no name; there are {classes} names")
        shares = np.array([x, y, width, height])
        if not (
            np.isfinite(shares).all() and (shares[2:] > 0.0).all() and (shares <= _MOST_SHARE).all()
        ):
            raise InputError(f"{where}: expected shares of the picture from 0 to 1, got {line!r}")
        numbers.append(int(kind))
        low, high = shares[:2] - shares[2:] / 2.0, shares[:2] + shares[2:] / 2.0
        boxes.append(np.concatenate([low, high]).clip(0.0, 1.0) * np.tile(size_px, 2))
    return numbers, np.array(boxes, dtype=np.float32).reshape(-1, 4)


# ---- cutting out --------------------------------------------------------------------------------


def cut_outs(photographs: Sequence[Photograph]) -> list[Sprite]:
    """The boats of photographs, cut out along colour edges (GrabCut, Rother et al. 2004).

    Those that the border of the picture or another box cuts, and those whose outline does not fill
    their box, are left out.
    """
    found = []
    for one in photographs:
        image = one.image
        for i, label in enumerate(one.labels.tolist()):
            if label < 0 or not _stands_free(one, i):
                continue
            sprite = _cut_out(one.name, image, one.boxes_xyxy_px[i].astype(float), label)
            if sprite is not None:
                found.append(sprite)
    return found


def _stands_free(one: Photograph, i: int) -> bool:
    box = one.boxes_xyxy_px[i].astype(float)
    width, height = box[2:] - box[:2]
    if max(width, height) < _LEAST_PX[0] or min(width, height) < _LEAST_PX[1]:
        return False
    inner = np.array([one.size_px[0], one.size_px[1]]) - _TOUCHES_PX
    if box[0] < _TOUCHES_PX or (box[2:] > inner).any():
        return False
    others = np.delete(one.boxes_xyxy_px.astype(float), i, axis=0)
    return not (shared_area(others, box) > _SHARED * width * height).any()


def _cut_out(name: str, image: Image, box: FloatArray, label: int) -> Sprite | None:
    factor = min(1.0, _CUT_PX / float((box[2:] - box[:2]).max()))
    small = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    box = box * factor
    margin = _MARGIN * (box[2:] - box[:2]).max()
    low = np.floor(np.maximum(box[:2] - margin, 0.0)).astype(int)
    high = np.ceil(np.minimum(box[2:] + margin, small.shape[1::-1])).astype(int)
    part = np.ascontiguousarray(small[low[1] : high[1], low[0] : high[0]], dtype=np.uint8)
    own = np.round(box - np.tile(low, 2)).astype(int)
    mask = _first_guess(part.shape[:2], own)
    try:
        cv2.setRNGSeed(0)
        cv2.grabCut(
            part,
            mask,
            (0, 0, 1, 1),
            np.zeros((1, 65)),
            np.zeros((1, 65)),
            _ROUNDS,
            cv2.GC_INIT_WITH_MASK,
        )
    except cv2.error:
        # Nothing of the neighbourhood is in the picture.
        return None
    solid = _largest(np.isin(mask, (cv2.GC_FGD, cv2.GC_PR_FGD)))
    rows, columns = np.nonzero(solid)
    if not len(rows):
        return None
    tight = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], dtype=float)
    area = float((own[2:] - own[:2]).prod())
    if (
        iou(tight, own.astype(float)) < _LEAST_FIT
        or not _FILL_RANGE[0] <= solid.sum() / area <= _FILL_RANGE[1]
    ):
        return None
    soft = cv2.GaussianBlur(solid.astype(np.float32), (0, 0), 0.7)
    opacity = np.asarray(soft, dtype=np.float32)
    return Sprite(name, part, opacity, tight, float(tight[3]), label)


def _first_guess(shape: tuple[int, ...], own: IntArray) -> NDArray[np.uint8]:
    """Outside the box is no boat, low in its middle is hull, its upper corners are mostly sky."""
    x1, y1, x2, y2 = (int(value) for value in own)
    width, height = x2 - x1, y2 - y1
    mask = np.full(shape, cv2.GC_BGD, np.uint8)
    mask[max(y1, 0) : y2, max(x1, 0) : x2] = cv2.GC_PR_FGD
    sky, side = slice(max(y1, 0), y1 + max(1, height // 4)), width // 6
    mask[sky, max(x1, 0) : x1 + side] = cv2.GC_PR_BGD
    mask[sky, x2 - side : x2] = cv2.GC_PR_BGD
    hull = slice(y2 - int(0.3 * height), y2 - int(0.08 * height) - 1)
    mask[hull, x1 + int(0.2 * width) : x2 - int(0.2 * width)] = cv2.GC_FGD
    return mask


def _largest(solid: BoolArray) -> BoolArray:
    """The largest part that hangs together, and those that are not much smaller."""
    count, parts, statistics, _ = cv2.connectedComponentsWithStats(solid.astype(np.uint8))
    areas = statistics[:, cv2.CC_STAT_AREA]
    kept = [i for i in range(1, count) if areas[i] > 0.03 * areas[1:].max()]
    return np.isin(parts, kept)
