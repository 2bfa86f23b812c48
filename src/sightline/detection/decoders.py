"""Decoders of detector outputs, one a family of networks.

A decoder turns the outputs for one picture into boxes in pixels of the network's input and a score
for each class. Which one fits is seen from the names, shapes and types of the outputs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sightline.detection.metadata import InputFormat
from sightline.errors import InputError, unknown_name
from sightline.types import FloatArray

Array = NDArray[Any]
_IMAGENET = InputFormat(mean=(0.485, 0.456, 0.406), std=(0.229, 0.224, 0.225))
_YOLO_STRIDES = ((8, 16, 32), (8, 16, 32, 64))
_DETR_WITH_NOTHING = 92
_MOST_CLASSES = 100_000
_QUERIES = 300


@dataclass(frozen=True, eq=False)
class Outputs:
    """Raw outputs of a network for one picture, or for a batch of them.

    Attributes:
        names: Of the outputs.
        arrays: The outputs.
        input_px: Width and height of the picture that was shown.
        anchors: See `DetectorMetadata`.
        scale_xy: See `DetectorMetadata`.
        labelled: Whether the file names its classes itself, counted from 0.
        description: What the file says of itself, for people.
    """

    names: tuple[str, ...]
    arrays: tuple[Array, ...]
    input_px: tuple[int, int]
    anchors: tuple[tuple[tuple[float, float], ...], ...] | None = None
    scale_xy: tuple[float, ...] | None = None
    labelled: bool = False
    description: str = ""

    @property
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        """Shapes of the outputs."""
        return tuple(array.shape for array in self.arrays)

    def describe(self) -> str:
        """Names, shapes and types in a line."""
        each = (
            f"{name} {'x'.join(map(str, array.shape)) or 'a number'} {array.dtype}"
            for name, array in zip(self.names, self.arrays, strict=True)
        )
        return ", ".join(each)

    def cells(self, strides: Sequence[int]) -> int:
        """Number of cells of the grids with these strides."""
        width, height = self.input_px
        return sum((width // stride) * (height // stride) for stride in strides)


@dataclass(frozen=True, eq=False)
class Scored:
    """Decoded boxes and class scores of one picture.

    Attributes:
        xyxy_px: (N, 4) float64, px of the network's input.
        scores: (N, C) float64, of each class, 0 to 1.
        listed: Whether the network gave each box one class by its number; then ``scores`` has no
            more columns than there happened to be classes.
    """

    xyxy_px: FloatArray
    scores: FloatArray
    listed: bool = False

    def __post_init__(self) -> None:
        if self.xyxy_px.ndim != 2 or self.xyxy_px.shape[1] != 4 or self.scores.ndim != 2:
            raise ValueError("these are no boxes with scores")
        if len(self.xyxy_px) != len(self.scores) or not self.scores.shape[1]:
            raise ValueError("the scores are not those of the boxes")


@dataclass(frozen=True)
class Decoder:
    """Decoder of a family of detectors.

    Attributes:
        name: As in ``--decoder``.
        fits: Whether the outputs for a batch of one look like this family's.
        decode: What was found, from the outputs for one picture, without the batch's axis.
            Classes count from 0, whatever the network does.
        input: What such networks are shown where the file does not say.
        batched: Whether the outputs have the batch for their first axis.
        by_category: Whether networks trained on COCO keep the gaps in its numbers.
        several: Whether a thing may have several boxes, among which the best is to be chosen.
    """

    name: str
    fits: Callable[[Outputs], bool]
    decode: Callable[[Outputs], Scored]
    input: InputFormat = field(default_factory=InputFormat)
    batched: bool = True
    by_category: bool = False
    several: bool = True

    def of_one(self, outputs: Outputs, row: int) -> Scored:
        """Decode boxes and scores for one picture of a batch.

        Raises:
            InputError: The outputs are of another family.
        """
        if self.batched:
            arrays = tuple(array[row] if array.ndim else array for array in outputs.arrays)
            outputs = replace(outputs, arrays=arrays)
        try:
            # What overflows is no number, and no box is made of it.
            with np.errstate(all="ignore"):
                return self.decode(outputs)
        except (ValueError, IndexError, StopIteration, TypeError) as error:
            raise InputError(
                f"the outputs are not those of the decoder {self.name!r}: {outputs.describe()}"
            ) from error


def _sigmoid(x: Array) -> FloatArray:
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * x.astype(np.float64))), dtype=np.float64)


def _float(x: Array) -> FloatArray:
    return np.asarray(x, dtype=np.float64)


def _corners(cx_cy_w_h: FloatArray) -> FloatArray:
    middle, half = cx_cy_w_h[:, :2], 0.5 * cx_cy_w_h[:, 2:4]
    return np.concatenate([middle - half, middle + half], axis=1)


def _grid(columns: int, rows: int) -> FloatArray:
    """(rows * columns, 2) x and y of cells, row by row."""
    y, x = np.divmod(np.arange(rows * columns), max(columns, 1))
    return np.column_stack([x, y]).astype(np.float64)


def _one_hot(label: Array, score: Array) -> FloatArray:
    """(N, C) one-hot scores; none for what is of no class that counts."""
    index = label.astype(np.int64).ravel()
    kept = (index >= 0) & (index < _MOST_CLASSES)
    scores = np.zeros((index.size, int(index[kept].max(initial=0)) + 1))
    scores[np.flatnonzero(kept), index[kept]] = _float(score).ravel()[kept]
    return scores


# --- Darknet -----------------------------------------------------------------------------------

YOLOV3_ANCHORS = (
    ((10, 13), (16, 30), (33, 23)),
    ((30, 61), (62, 45), (59, 119)),
    ((116, 90), (156, 198), (373, 326)),
)
YOLOV4_ANCHORS = (
    ((12, 16), (19, 36), (40, 28)),
    ((36, 75), (76, 55), (72, 146)),
    ((142, 110), (192, 243), (459, 401)),
)
_TINY_ANCHORS = (
    ((23, 27), (37, 58), (81, 82)),
    ((81, 82), (135, 169), (344, 319)),
)


def _is_darknet(outputs: Outputs) -> bool:
    """Whether the outputs are raw heads: a map of A (5 + C) channels a scale."""
    shapes = outputs.shapes
    if outputs.anchors is None or len(shapes) != len(outputs.anchors):
        return False
    if any(len(shape) != 4 for shape in shapes):
        return False
    each = {shape[1] / len(anchors) for shape, anchors in zip(shapes, outputs.anchors, strict=True)}
    return len(each) == 1 and each.pop() >= 6


def _darknet(outputs: Outputs) -> Scored:
    """Decode raw heads (Redmon and Farhadi 2018, sec. 2.1; `scale_xy`: Bochkovskiy et al. 2020)."""
    if outputs.anchors is None or len(outputs.anchors) != len(outputs.arrays):
        raise ValueError("there are no anchors")
    scales = outputs.scale_xy or (1.0,) * len(outputs.arrays)
    boxes, scores = [], []
    for array, anchors, stretch in zip(outputs.arrays, outputs.anchors, scales, strict=True):
        count = len(anchors)
        channels, rows, columns = array.shape
        head = _float(array).reshape(count, channels // count, rows * columns)
        step = np.array(outputs.input_px) / (columns, rows)
        grid = _grid(columns, rows).T
        inside = _sigmoid(head[:, :2]) * stretch - 0.5 * (stretch - 1.0)
        middle = (inside + grid) * step[:, None]
        size = np.exp(np.minimum(head[:, 2:4], 20.0)) * np.array(anchors, dtype=float)[..., None]
        flat = np.concatenate([middle, size], axis=1).transpose(0, 2, 1).reshape(-1, 4)
        boxes.append(_corners(flat))
        score = _sigmoid(head[:, 4:5]) * _sigmoid(head[:, 5:])
        scores.append(score.transpose(0, 2, 1).reshape(boxes[-1].shape[0], -1))
    return Scored(np.concatenate(boxes), np.concatenate(scores))


def _with_anchors(
    anchors: tuple[tuple[tuple[int, int], ...], ...], scale_xy: tuple[float, ...]
) -> Callable[[Outputs], Scored]:
    """Raw heads with the published anchors; the finest grid has the smallest anchors."""

    def decode(outputs: Outputs) -> Scored:
        order = np.argsort([-array.shape[-1] for array in outputs.arrays], kind="stable")
        ordered = Outputs(
            tuple(outputs.names[i] for i in order),
            tuple(outputs.arrays[i] for i in order),
            outputs.input_px,
            anchors,
            scale_xy,
        )
        return _darknet(ordered)

    return decode


def _is_darknet_boxes(outputs: Outputs) -> bool:
    """Whether the outputs are boxes (1, N, 1, 4) and confidences (1, N, C)."""
    shapes = sorted(outputs.shapes, key=len)
    return (
        len(shapes) == 2
        and len(shapes[0]) == 3
        and len(shapes[1]) == 4
        and shapes[1][2:] == (1, 4)
        and shapes[0][1] == shapes[1][1]
    )


def _darknet_boxes(outputs: Outputs) -> Scored:
    confidences, boxes = sorted(outputs.arrays, key=lambda array: array.ndim)
    width, height = outputs.input_px
    xyxy = _float(boxes).reshape(-1, 4) * (width, height, width, height)
    return Scored(xyxy, _float(confidences))


# --- YOLOX and Ultralytics ----------------------------------------------------------------------


def _single(outputs: Outputs) -> tuple[int, int] | None:
    """Shape of the only output, (1, A, B), without its batch axis."""
    if len(outputs.arrays) != 1 or len(outputs.shapes[0]) != 3:
        return None
    return outputs.shapes[0][1], outputs.shapes[0][2]


def _is_yolox(outputs: Outputs) -> bool:
    shape = _single(outputs)
    counts = [outputs.cells(strides) for strides in _YOLO_STRIDES]
    return shape is not None and shape[0] in counts and shape[1] >= 6


def _yolox(outputs: Outputs) -> Scored:
    """Decode YOLOX (Ge et al. 2021): offsets from cells, in strides; logarithms of sizes."""
    (head,) = (_float(array) for array in outputs.arrays)
    counts = [outputs.cells(strides) for strides in _YOLO_STRIDES]
    strides = _YOLO_STRIDES[counts.index(len(head))]
    width, height = outputs.input_px
    cells = np.concatenate([_grid(width // s, height // s) for s in strides])
    step = np.concatenate([np.full(outputs.cells([s]), float(s)) for s in strides])[:, None]
    middle = (head[:, :2] + cells) * step
    size = np.exp(np.minimum(head[:, 2:4], 20.0)) * step
    boxes = _corners(np.concatenate([middle, size], axis=1))
    return Scored(boxes, head[:, 4:5] * head[:, 5:])


def _is_yolov8(outputs: Outputs) -> bool:
    shape = _single(outputs)
    return shape is not None and 5 <= shape[0] < shape[1] and shape[1] != 6


def _yolov8(outputs: Outputs) -> Scored:
    (head,) = (_float(array) for array in outputs.arrays)
    return Scored(_corners(head[:4].T), head[4:].T)


def _is_yolov5(outputs: Outputs) -> bool:
    shape = _single(outputs)
    counts = [3 * outputs.cells(strides) for strides in _YOLO_STRIDES]
    return shape is not None and shape[0] in counts and shape[1] >= 6


def _yolov5(outputs: Outputs) -> Scored:
    (head,) = (_float(array) for array in outputs.arrays)
    return Scored(_corners(head[:, :4]), head[:, 4:5] * head[:, 5:])


def _is_yolo_end_to_end(outputs: Outputs) -> bool:
    shape = _single(outputs)
    return shape is not None and shape[1] == 6 and outputs.labelled and not _says_rtdetr(outputs)


def _says_rtdetr(outputs: Outputs) -> bool:
    return "rtdetr" in outputs.description.lower().replace("-", "")


def _is_rtdetr(outputs: Outputs) -> bool:
    """Whether the outputs are queries with their scores, as Ultralytics writes RT-DETR.

    Two classes make six columns, as boxes that were chosen have; only words tell these apart.
    """
    shape = _single(outputs)
    if shape is None or not outputs.labelled or not shape[1] >= 5:
        return False
    return _says_rtdetr(outputs) or (shape[0] == _QUERIES and shape[1] != 6)


def _rtdetr(outputs: Outputs) -> Scored:
    (rows,) = (_float(array) for array in outputs.arrays)
    return Scored(_normalised_boxes(outputs, rows[:, :4]), rows[:, 4:])


def _yolo_end_to_end(outputs: Outputs) -> Scored:
    (rows,) = (_float(array) for array in outputs.arrays)
    return Scored(rows[:, :4], _one_hot(rows[:, 5], rows[:, 4]), listed=True)


# --- queries, torchvision -----------------------------------------------------------------------


def _parts(outputs: Outputs, rank: int) -> tuple[Array, Array, Array] | None:
    """Find boxes, labels and scores among the outputs, by their ranks, types and names."""
    boxes = [a for a in outputs.arrays if a.ndim == rank and a.shape[-1:] == (4,)]
    flat = [
        (name, a)
        for name, a in zip(outputs.names, outputs.arrays, strict=True)
        if a.ndim == rank - 1
    ]
    labels = [a for name, a in flat if a.dtype.kind in "iu" or "label" in name.lower()]
    scores = [a for name, a in flat if a.dtype.kind == "f" and "label" not in name.lower()]
    if len(boxes) == 1 and len(labels) == 1 and len(scores) == 1:
        return boxes[0], labels[0], scores[0]
    return None


def _detr(outputs: Outputs) -> Scored:
    boxes, labels, scores = _three(outputs)
    return Scored(_float(boxes), _one_hot(labels, scores), listed=True)


def _torchvision(outputs: Outputs) -> Scored:
    boxes, labels, scores = _three(outputs)
    # Number 0 is the background, and never put out.
    return Scored(_float(boxes), _one_hot(labels.astype(np.int64) - 1, scores), listed=True)


def _three(outputs: Outputs) -> tuple[Array, Array, Array]:
    parts = _parts(outputs, 2)
    if parts is None:
        raise ValueError("there are no boxes, labels and scores")
    return parts


def _queries(outputs: Outputs) -> tuple[Array, Array]:
    """Find the outputs with logits and with boxes."""
    if len(outputs.arrays) != 2:
        raise ValueError("there are not two outputs")
    boxes = next(
        (
            i
            for i, name in enumerate(outputs.names)
            if ("box" in name.lower() or name == "dets") and outputs.arrays[i].shape[-1] == 4
        ),
        None,
    )
    if boxes is None:
        boxes = next(i for i, array in enumerate(outputs.arrays) if array.shape[-1] == 4)
    return outputs.arrays[1 - boxes], outputs.arrays[boxes]


def _is_queries(outputs: Outputs) -> bool:
    shapes = outputs.shapes
    return (
        len(shapes) == 2
        and all(len(shape) == 3 for shape in shapes)
        and shapes[0][1] == shapes[1][1]
        and any(shape[2] == 4 for shape in shapes)
    )


def _normalised_boxes(outputs: Outputs, boxes: Array) -> FloatArray:
    return _corners(_float(boxes) * np.tile(outputs.input_px, 2))


def _detr_logits(outputs: Outputs) -> Scored:
    """Decode DETR with independent class scores, as trained with the focal loss."""
    logits, boxes = _queries(outputs)
    return Scored(_normalised_boxes(outputs, boxes), _sigmoid(logits))


def _detr_softmax(outputs: Outputs) -> Scored:
    """Decode DETR with a softmax over classes (Carion et al. 2020); the last is background."""
    logits, boxes = _queries(outputs)
    shifted = _float(logits) - _float(logits).max(axis=-1, keepdims=True)
    share = np.exp(shifted)
    share /= share.sum(axis=-1, keepdims=True)
    return Scored(_normalised_boxes(outputs, boxes), share[:, :-1])


# --- EfficientDet -------------------------------------------------------------------------------

_LEVELS = tuple(8 * 2**i for i in range(5))
_OCTAVES = (1.0, 2.0 ** (1.0 / 3.0), 2.0 ** (2.0 / 3.0))
_ASPECTS = ((1.0, 1.0), (1.4, 0.7), (0.7, 1.4))
_ANCHORS_A_CELL = len(_OCTAVES) * len(_ASPECTS)
_ANCHOR_SCALE = 4.0


def _level_cells(outputs: Outputs) -> list[tuple[int, int]]:
    """Columns and rows of each level; a stride of 2 rounds up."""
    return [(-(-outputs.input_px[0] // s), -(-outputs.input_px[1] // s)) for s in _LEVELS]


def _efficientdet_anchors(outputs: Outputs) -> FloatArray:
    """(N, 4) anchors x1, y1, x2, y2, px: Tan et al. 2020 in the order of their implementation."""
    width, height = outputs.input_px
    levels = []
    for columns, rows in _level_cells(outputs):
        step = np.array([width / columns, height / rows])
        middle = (_grid(columns, rows) + 0.5) * step
        size = np.array(
            [
                _ANCHOR_SCALE * step * octave * aspect
                for octave, aspect in product(_OCTAVES, map(np.array, _ASPECTS))
            ]
        )
        low = middle[:, None] - 0.5 * size[None]
        levels.append(np.concatenate([low, low + size[None]], axis=2).reshape(-1, 4))
    return np.concatenate(levels)


def _is_efficientdet(outputs: Outputs) -> bool:
    shape = _single(outputs)
    if shape is not None:
        return shape[1] == 6 and not outputs.labelled
    cells = _level_cells(outputs)
    if len(outputs.arrays) == 2 and _is_queries(outputs):
        return outputs.shapes[0][1] == _ANCHORS_A_CELL * sum(c * r for c, r in cells)
    maps = [shape[2:] for shape in outputs.shapes if len(shape) == 4]
    return len(outputs.arrays) == 2 * len(_LEVELS) and sorted(maps) == sorted(
        2 * [(rows, columns) for columns, rows in cells]
    )


def _efficientdet(outputs: Outputs) -> Scored:
    """Decode EfficientDet: chosen boxes, or raw heads: all in two outputs, or a map a level."""
    if len(outputs.arrays) == 1:
        rows = _float(outputs.arrays[0])
        if rows.shape[1:] != (6,):
            raise ValueError("these are not x1, y1, x2, y2, score, class")
        # They count classes from 1.
        return Scored(rows[:, :4], _one_hot(rows[:, 5] - 1.0, rows[:, 4]), listed=True)
    if len(outputs.arrays) == 2:
        logits, offsets = (_float(array) for array in _queries(outputs))
    else:
        logits, offsets = _efficientdet_heads(outputs)
    anchors = _efficientdet_anchors(outputs)
    size = anchors[:, 2:] - anchors[:, :2]
    middle = anchors[:, :2] + 0.5 * size
    # Rows come before columns: y, x, height, width.
    middle = offsets[:, [1, 0]] * size + middle
    size = np.exp(np.minimum(offsets[:, [3, 2]], 20.0)) * size
    # Some files end in the sigmoid, others leave it to the reader.
    probable = bool(logits.size) and logits.min() >= 0.0 and logits.max() <= 1.0
    scores = logits if probable else _sigmoid(logits)
    return Scored(_corners(np.concatenate([middle, size], axis=1)), scores)


def _efficientdet_heads(outputs: Outputs) -> tuple[FloatArray, FloatArray]:
    """Logits (N, C) and offsets (N, 4) of maps (A C, H, W) and (A 4, H, W), level by level."""
    half = len(_LEVELS)
    first, second = outputs.arrays[:half], outputs.arrays[half:]
    if first[0].shape[0] == 4 * _ANCHORS_A_CELL != second[0].shape[0]:
        first, second = second, first

    def flat(maps: Sequence[Array]) -> FloatArray:
        each = (np.moveaxis(_float(m), 0, -1) for m in maps)
        return np.concatenate([m.reshape(-1, m.shape[-1] // _ANCHORS_A_CELL) for m in each])

    return flat(first), flat(second)


# --- FastestDet ---------------------------------------------------------------------------------


def _is_fastestdet(outputs: Outputs) -> bool:
    if len(outputs.arrays) != 1 or len(outputs.shapes[0]) != 4:
        return False
    _, channels, rows, columns = outputs.shapes[0]
    return channels >= 6 and (columns * 16, rows * 16) == outputs.input_px


def _fastestdet(outputs: Outputs) -> Scored:
    """Decode FastestDet: one map of objectness, box relative to its cell, and class."""
    (head,) = (_float(array) for array in outputs.arrays)
    channels, rows, columns = head.shape
    head = head.reshape(channels, rows * columns).T
    step = np.array(outputs.input_px) / (columns, rows)
    middle = (np.tanh(head[:, 1:3]) + _grid(columns, rows)) * step
    size = _sigmoid(head[:, 3:5]) * np.array(outputs.input_px)
    something, classes = np.maximum(head[:, :1], 0.0), np.maximum(head[:, 5:], 0.0)
    boxes = _corners(np.concatenate([middle, size], axis=1))
    return Scored(boxes, something**0.6 * classes**0.4)


_DECODERS = (
    Decoder("darknet", _is_darknet, _darknet),
    Decoder("darknet-boxes", _is_darknet_boxes, _darknet_boxes),
    Decoder("yolov3", lambda _: False, _with_anchors(YOLOV3_ANCHORS, (1.0, 1.0, 1.0))),
    Decoder("yolov4", lambda _: False, _with_anchors(YOLOV4_ANCHORS, (1.2, 1.1, 1.05))),
    Decoder("yolov3-tiny", lambda _: False, _with_anchors(_TINY_ANCHORS, (1.0, 1.0))),
    Decoder("yolov4-tiny", lambda _: False, _with_anchors(_TINY_ANCHORS, (1.05, 1.05))),
    Decoder("rtdetr", _is_rtdetr, _rtdetr, several=False),
    Decoder("yolox", _is_yolox, _yolox, InputFormat(color="bgr", scale=1.0)),
    Decoder("yolov5", _is_yolov5, _yolov5, InputFormat(centred=True)),
    Decoder("yolov8", _is_yolov8, _yolov8, InputFormat(centred=True)),
    Decoder(
        "yolo-end-to-end",
        _is_yolo_end_to_end,
        _yolo_end_to_end,
        InputFormat(centred=True),
        several=False,
    ),
    Decoder("efficientdet", _is_efficientdet, _efficientdet, _IMAGENET, by_category=True),
    Decoder(
        "detr",
        lambda outputs: _parts(outputs, 3) is not None,
        _detr,
        several=False,
    ),
    Decoder(
        "detr-softmax",
        lambda outputs: _is_queries(outputs) and _DETR_WITH_NOTHING in _last(outputs),
        _detr_softmax,
        _IMAGENET,
        by_category=True,
        several=False,
    ),
    Decoder(
        "rf-detr",
        lambda outputs: _is_queries(outputs) and "dets" in outputs.names,
        _detr_logits,
        _IMAGENET,
        by_category=True,
        several=False,
    ),
    Decoder("detr-logits", _is_queries, _detr_logits, several=False),
    Decoder(
        "torchvision",
        lambda outputs: _parts(outputs, 2) is not None,
        _torchvision,
        batched=False,
        by_category=True,
    ),
    Decoder("fastestdet", _is_fastestdet, _fastestdet, InputFormat(color="bgr", stride=32)),
)

DECODERS = tuple(decoder.name for decoder in _DECODERS)
"""Names of the families whose outputs are understood."""


def _last(outputs: Outputs) -> list[int]:
    return [shape[-1] for shape in outputs.shapes]


def decoder_by_name(name: str) -> Decoder:
    """A decoder by the name of its family.

    Raises:
        InputError: There is none of that name.
    """
    for decoder in _DECODERS:
        if decoder.name == name:
            return decoder
    raise unknown_name("decoder", name, DECODERS)


def decoder_for(outputs: Outputs) -> Decoder:
    """The first decoder that fits the outputs for a batch of one.

    Raises:
        InputError: It looks like none.
    """
    for decoder in _DECODERS:
        if decoder.fits(outputs):
            return decoder
    heads = all(len(shape) == 4 for shape in outputs.shapes) and len(outputs.arrays) in (2, 3)
    more = (
        "; if these are the raw heads of a Darknet network, name the one whose anchors they have: "
        "--decoder yolov3, yolov4, yolov3-tiny or yolov4-tiny"
        if heads
        else "; name a decoder if one fits: " + ", ".join(DECODERS)
    )
    raise InputError(f"no decoder is known for its outputs: {outputs.describe()}{more}")
