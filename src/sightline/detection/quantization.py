"""Detectors in eight-bit integers or half precision, for boards that are quicker in those."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sightline import _optional
from sightline.atomic import atomic_path
from sightline.detection import _onnxruntime
from sightline.detection.metadata import KEY
from sightline.detection.onnx import DetectorOptions, OnnxDetector
from sightline.errors import InputError
from sightline.overlap import iou
from sightline.types import Boxes, Frame

PRECISIONS = ("int8", "fp16")
"""Of what `quantize` writes."""

_SAME = 0.5
_BOUNDED = ("Relu", "Clip", "LeakyRelu")


@dataclass(frozen=True)
class Quantized:
    """How a quantised detector compares with the one that it was made from.

    Attributes:
        layers: Convolutions that were quantised; in half precision, all nodes.
        of: Convolutions that there are; in half precision, all nodes.
        boxes: That the original finds in the pictures.
        found_again: Of these, how many the new one finds with more than half an overlap.
        more: That only the new one finds.
        original_s: Least time of the original over the pictures, seconds, on one thread.
        quantized_s: The same of the new one.
        original_bytes: Size of its file.
        quantized_bytes: Size of the new file.
    """

    layers: int
    of: int
    boxes: int
    found_again: int
    more: int
    original_s: float
    quantized_s: float
    original_bytes: int
    quantized_bytes: int


def quantize(
    source: Path, path: Path, pictures: Sequence[NDArray[np.uint8]], *, precision: str = "int8"
) -> Quantized:
    """Write a detector in eight-bit integers or in half precision, with its metadata.

    ``int8`` is static quantisation with a scale a channel of the weights, and unsigned bytes of
    the activations, whose ranges are those of the pictures in the detector's own tiles (Jacob et
    al., Quantization and Training of Neural Networks for Efficient Integer-Arithmetic-Only
    Inference, 2018, as ONNX Runtime has it). Only convolutions with a bounded activation behind are
    quantised: with SiLU (``x * sigmoid(x)``) what the convolution wins is lost again, since the
    runtime fuses that in single precision alone, and depthwise convolutions with it lose their
    boxes. ``fp16`` stores and computes in half precision; pictures and boxes stay in single.

    Args:
        source: The ONNX file.
        path: Where the new one goes.
        pictures: (H, W, 3) each, blue, green, red: what ranges are measured on, and compared.
        precision: One of `PRECISIONS`.

    Raises:
        InputError: The library ``onnx`` is missing, the file is no detector, nothing of it can be
            quantised, or there is no picture.
    """
    onnx = _optional.module("onnx", "quantize")
    if not pictures:
        raise InputError("there is no picture to measure ranges on; give some")
    original = OnnxDetector(source, options=DetectorOptions(threads=1))
    with TemporaryDirectory() as folder, atomic_path(path) as temporary:
        if precision == "fp16":
            model, layers, of = _half(onnx, source)
        else:
            model, layers, of = _integers(onnx, source, Path(folder), _Shown(original, pictures))
        _describe(model, onnx.load(str(source), load_external_data=False), precision)
        onnx.save(model, str(temporary))
        made = OnnxDetector(temporary, name=original.name, options=DetectorOptions(threads=1))
        found, original_s = _look(original, pictures)
        again, quantized_s = _look(made, pictures)
        sizes = source.stat().st_size, temporary.stat().st_size
    common = sum(_common(a, b) for a, b in zip(found, again, strict=True))
    return Quantized(
        layers=layers,
        of=of,
        boxes=sum(map(len, found)),
        found_again=common,
        more=sum(map(len, again)) - common,
        original_s=original_s,
        quantized_s=quantized_s,
        original_bytes=sizes[0],
        quantized_bytes=sizes[1],
    )


class _Shown:
    """What the network is shown of pictures, one tile at a time, as ONNX Runtime reads it."""

    def __init__(self, detector: OnnxDetector, pictures: Sequence[NDArray[np.uint8]]) -> None:
        self._tiles = self._all(detector, pictures)

    @staticmethod
    def _all(
        detector: OnnxDetector, pictures: Sequence[NDArray[np.uint8]]
    ) -> Iterator[dict[str, NDArray[Any]]]:
        for picture in pictures:
            detector.reset()
            yield from detector.inputs(Frame(0, 0.0, picture))

    def get_next(self) -> Mapping[str, NDArray[Any]] | None:
        """The next tile; None: there is no more."""
        return next(self._tiles, None)


def _integers(onnx: Any, source: Path, folder: Path, shown: _Shown) -> tuple[Any, int, int]:
    """The model with quantised convolutions, how many those are, and of how many."""
    _onnxruntime.load()
    from onnxruntime import quantization  # noqa: TID251 - loaded without telemetry above
    from onnxruntime.quantization.shape_inference import quant_pre_process  # noqa: TID251

    plain, made = folder / "plain.onnx", folder / "made.onnx"
    try:
        # Shapes of pictures of any size are not known before they are seen.
        quant_pre_process(str(source), str(plain), skip_symbolic_shape=True)
        graph = onnx.load(str(plain)).graph
        behind: dict[str, set[str]] = {}
        for node in graph.node:
            for name in node.input:
                behind.setdefault(name, set()).add(node.op_type)
        convolutions = [node for node in graph.node if node.op_type == "Conv"]
        chosen = [
            node.name for node in convolutions if behind.get(node.output[0], set()) & {*_BOUNDED}
        ]
        if chosen:
            quantization.quantize_static(
                str(plain),
                str(made),
                shown,
                quant_format=quantization.QuantFormat.QDQ,
                per_channel=True,
                activation_type=quantization.QuantType.QUInt8,
                weight_type=quantization.QuantType.QInt8,
                nodes_to_quantize=chosen,
            )
    except Exception as error:  # what is wrong with a file has no class of its own there
        raise InputError(f"{source}: cannot be quantised ({str(error)[:200]})") from error
    if not chosen:
        raise InputError(
            f"{source}: none of its {len(convolutions)} convolutions has one of "
            f"{', '.join(_BOUNDED)} behind it, so nothing would be gained in integers; "
            "--precision fp16 is for GPUs"
        )
    return onnx.load(str(made)), len(chosen), len(convolutions)


def _half(onnx: Any, source: Path) -> tuple[Any, int, int]:
    _onnxruntime.load()
    from onnxruntime.transformers.float16 import (  # noqa: TID251
        convert_float_to_float16,
    )

    try:
        model = convert_float_to_float16(onnx.load(str(source)), keep_io_types=True)
    except Exception as error:  # as above
        raise InputError(f"{source}: cannot be converted ({str(error)[:200]})") from error
    count = len(model.graph.node)
    return model, count, count


def _describe(model: Any, original: Any, precision: str) -> None:
    """Take over the metadata, and say the precision in it."""
    del model.metadata_props[:]
    for one in original.metadata_props:
        value = one.value
        if one.key == KEY:
            value = json.dumps({**json.loads(value), "precision": precision})
        model.metadata_props.add(key=one.key, value=value)


def _look(
    detector: OnnxDetector, pictures: Sequence[NDArray[np.uint8]]
) -> tuple[list[Boxes], float]:
    """Boxes in each picture, and the least of three times, seconds."""
    least_s = float("inf")
    for _ in range(3):
        found = []
        begun_s = time.perf_counter()
        for picture in pictures:
            detector.reset()
            found.append(detector.detect(Frame(0, 0.0, picture)))
        least_s = min(least_s, time.perf_counter() - begun_s)
    return found, least_s


def _common(found: Boxes, again: Boxes) -> int:
    """How many boxes are in both, each taken once."""
    free = np.ones(len(again), dtype=bool)
    count = 0
    for xyxy, label in zip(found.xyxy_px, found.label, strict=True):
        overlap = np.where(free & (again.label == label), iou(again.xyxy_px, xyxy), 0.0)
        if overlap.size and overlap.max() > _SAME:
            free[int(overlap.argmax())] = False
            count += 1
    return count
