"""A trained network as an ONNX file that says what it is, checked against the network."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from sightline import _optional
from sightline.atomic import atomic_path
from sightline.detection import _onnxruntime
from sightline.errors import SightlineError
from sightline.training.architecture import ExportInfo, Trainable

OPSET = 17
"""Of the graph: what every ONNX Runtime of the last years reads."""

TOLERANCE = 1e-4
"""Largest difference between file and network, absolute where values are below 1, else relative."""

_FORMAT = 1
_CHOSEN = "torchvision"
"""The decoder of outputs from which boxes that overlap were left out already."""
_SAME_PX = 1.0
"""Corners of what is the same box in two lists."""
_LEAST_SCORE = 0.001
"""Above the lowest score of a list: what is nearer to it may be in one list and not in another."""
_MIDDLE, _SPREAD = 0.45, 0.2
"""Mean and deviation of the noise that stands for a photograph."""


class ExportError(SightlineError):
    """A file whose outputs are not those of the network that it was made from."""


def export_onnx(
    trainable: Trainable,
    path: Path,
    *,
    size_px: tuple[int, int] = (640, 384),
    fixed: bool = False,
    default_classes: tuple[str, ...] | None = None,
    about: Mapping[str, Any] | None = None,
    pictures: Sequence[NDArray[np.uint8]] = (),
    tolerance: float = TOLERANCE,
) -> float:
    """Write a network, and check the file.

    The check wants pictures like those that the network is for. In evaluation batch normalisation
    is linear, so what is far from all that was learned from grows from layer to layer: white noise
    came out of a hundred layers ten thousand times too large, and there the digits of single
    precision are used up, in the network as in the file.

    Args:
        trainable: The network; goes to evaluation mode, on the CPU.
        path: The file.
        size_px: Width and height of the picture that it is traced with, rounded up to strides.
        fixed: Whether the file takes pictures of this size alone. Some runtimes are faster so.
        default_classes: What is looked for when nobody says; absent: the first class.
        about: More for the metadata.
        pictures: (H, W, 3) each, red, green, blue, to check with; absent: noise that has as much
            of each frequency as a photograph has.
        tolerance: Largest difference that is let pass.

    Returns:
        The largest difference that the check found.

    Raises:
        ExportError: It was more than ``tolerance``.
        InputError: The file cannot be written.
    """
    onnx = _optional.module("onnx", "train")
    trainable.module.to("cpu").eval()
    module, info = trainable.export_module()
    module.eval()
    if fixed:
        info = replace(info, dynamic_size=False, dynamic_batch=False, input_size_px=size_px)
    width, height = info.input_size_px or size_px
    stride = info.input_format.stride
    shape = (1, 3, -(-height // stride) * stride, -(-width // stride) * stride)
    content = _metadata(trainable, info, shape, default_classes) | dict(about or {})
    with atomic_path(path) as temporary:
        with warnings.catch_warnings(), torch.no_grad():
            # Tracing warns of every shape that becomes a constant; the check below finds those
            # that must not.
            warnings.simplefilter("ignore")
            torch.onnx.export(
                module,
                (_images(shape, info, pictures, 0),),
                str(temporary),
                input_names=list(info.input_names),
                output_names=list(info.output_names),
                dynamic_axes=_dynamic_axes(module, shape, info, pictures),
                opset_version=OPSET,
                dynamo=False,
            )
        model = onnx.load(str(temporary))
        model.metadata_props.add(key="sightline", value=json.dumps(content))
        onnx.save(model, str(temporary))
        onnx.checker.check_model(str(temporary))
        difference, largest = _difference(module, temporary, shape, info, pictures)
        if not difference <= tolerance:
            raise ExportError(
                f"{path}: the exported network differs by {difference:.2g} from the trained one, "
                f"whose outputs go up to {largest:.2g}, more than {tolerance:g}; it was not "
                "written"
            )
    return difference


def _paired(
    wanted: tuple[torch.Tensor, ...], given: list[np.ndarray[Any, Any]]
) -> tuple[tuple[torch.Tensor, ...], list[np.ndarray[Any, Any]]]:
    """Lists of boxes, labels and scores, the second in the order of the first.

    A difference in the last digit changes the order of boxes that are equally sure.
    """
    boxes, labels, scores = (output.numpy() for output in wanted)
    floor = min(scores.min(initial=1.0), given[2].min(initial=1.0)) + _LEAST_SCORE
    kept, partners = [], []
    free = np.ones(len(given[0]), bool)
    for number in np.flatnonzero(scores > floor):
        apart = np.abs(given[0] - boxes[number]).max(axis=1)
        fits = free & (given[1] == labels[number]) & (apart < _SAME_PX)
        if not fits.any():
            return wanted, [output[:0] for output in given]
        partner = int(np.argmin(np.where(fits, apart, np.inf)))
        free[partner] = False
        kept.append(number)
        partners.append(partner)
    if (free & (given[2] > floor)).any():
        return wanted, [output[:0] for output in given]
    return tuple(output[kept] for output in wanted), [output[partners] for output in given]


def _metadata(
    trainable: Trainable,
    info: ExportInfo,
    shape: tuple[int, ...],
    default_classes: tuple[str, ...] | None,
) -> dict[str, Any]:
    given = info.input_format.to_dict()
    if not info.dynamic_size:
        given["size"] = [shape[3], shape[2]]
    content: dict[str, Any] = {
        "format": _FORMAT,
        "decoder": info.decoder,
        "architecture": trainable.name,
        "classes": list(trainable.class_names),
        "input": given,
        "score_threshold": info.score_threshold,
    }
    default = default_classes or trainable.class_names[:1]
    if set(default) != set(trainable.class_names):
        content["default_classes"] = list(default)
    if info.views:
        content["views"] = dict(info.views)
    return content | dict(info.extra)


def _dynamic_axes(
    module: nn.Module,
    shape: tuple[int, ...],
    info: ExportInfo,
    pictures: Sequence[NDArray[np.uint8]],
) -> dict[str, dict[int, str]]:
    """The axes of the picture that may vary, and those of the outputs that vary with them."""
    axes: dict[str, dict[int, str]] = {info.input_names[0]: {}}
    picture = axes[info.input_names[0]]
    if info.dynamic_batch:
        picture[0] = "batch"
    if info.dynamic_size:
        picture |= {2: "height", 3: "width"}
    stride = info.input_format.stride
    larger = (
        shape[0] + info.dynamic_batch,
        shape[1],
        shape[2] + stride * info.dynamic_size,
        shape[3] + 2 * stride * info.dynamic_size,
    )
    with torch.no_grad():
        before, after = (
            _several(module(_images(one, info, pictures, 0))) for one in (shape, larger)
        )
    for name, small, large in zip(info.output_names, before, after, strict=True):
        differing = [i for i in range(small.ndim) if small.shape[i] != large.shape[i]]
        axes[name] = {
            i: "batch" if i == 0 and info.dynamic_batch else f"{name}_{i}" for i in differing
        }
    return {name: named for name, named in axes.items() if named}


def _several(outputs: Any) -> tuple[torch.Tensor, ...]:
    return tuple(outputs) if isinstance(outputs, tuple | list) else (outputs,)


def _images(
    shape: tuple[int, ...], info: ExportInfo, pictures: Sequence[NDArray[np.uint8]], number: int
) -> torch.Tensor:
    """A batch as the network wants it; another number gives other pictures."""
    count, _, height, width = shape
    if pictures:
        chosen = [pictures[(number + i) % len(pictures)] for i in range(count)]
        cut = np.stack([_cut(one, width, height, info.input_format.pad) for one in chosen])
        pixels = torch.from_numpy(cut.transpose(0, 3, 1, 2).astype(np.float32)) / 255.0
    else:
        pixels = _photograph(shape, number)
    given = info.input_format
    if given.color == "bgr":
        pixels = pixels.flip(1)
    mean = torch.tensor(given.mean).view(1, 3, 1, 1)
    std = torch.tensor(given.std).view(1, 3, 1, 1)
    return (pixels * 255.0 * given.scale - mean) / std


def _cut(picture: NDArray[np.uint8], width: int, height: int, pad: int) -> NDArray[np.uint8]:
    """The middle of a picture, with a border where it is too small."""
    rows, columns = picture.shape[:2]
    top, left = max(0, rows - height) // 2, max(0, columns - width) // 2
    part = picture[top : top + height, left : left + width]
    around = ((0, height - part.shape[0]), (0, width - part.shape[1]), (0, 0))
    return np.pad(part, around, constant_values=pad)


def _photograph(shape: tuple[int, ...], seed: int) -> torch.Tensor:
    """Noise from 0 to 1 whose amplitude falls with frequency, as in photographs (Field 1987)."""
    generator = torch.Generator().manual_seed(seed)
    count, channels, height, width = shape
    # What is grey about it and, less, the colours.
    white = torch.randn((count, 1, height, width), generator=generator)
    white = white + 0.3 * torch.randn((count, channels, height, width), generator=generator)
    frequency = torch.hypot(torch.fft.fftfreq(height)[:, None], torch.fft.rfftfreq(width)[None])
    spectrum = torch.fft.rfft2(white) / frequency.clamp(min=1.0 / max(height, width))
    spectrum[..., 0, 0] = 0.0
    pixels = torch.fft.irfft2(spectrum, s=(height, width))
    spread = pixels.std(dim=(1, 2, 3), keepdim=True)
    return (_MIDDLE + _SPREAD * pixels / spread).clamp(0.0, 1.0)


def _difference(
    module: nn.Module,
    path: Path,
    shape: tuple[int, ...],
    info: ExportInfo,
    pictures: Sequence[NDArray[np.uint8]],
) -> tuple[float, float]:
    """How far file and network are apart, and the largest output."""
    session = _onnxruntime.load().InferenceSession(str(path), providers=["CPUExecutionProvider"])
    stride = info.input_format.stride
    shapes = [shape]
    if info.dynamic_size:
        shapes.append((1, 3, shape[2] + stride, shape[3] + 2 * stride))
    if info.dynamic_batch:
        shapes.append((2, *shapes[-1][1:]))
    worst = largest = 0.0
    for number, one in enumerate(shapes):
        picture = _images(one, info, pictures, number + 1)
        with torch.no_grad():
            wanted = _several(module(picture))
        given = session.run(None, {info.input_names[0]: picture.numpy()})
        if info.decoder == _CHOSEN:
            wanted, given = _paired(wanted, given)
        for ours, theirs in zip(wanted, given, strict=True):
            expected = ours.double().numpy()
            if expected.shape != theirs.shape:
                return float("inf"), largest
            largest = max(largest, float(np.abs(expected).max(initial=0.0)))
            error = np.abs(expected - theirs) / np.maximum(np.abs(expected), 1.0)
            # A maximum would pass over what is not a number.
            worst = float(np.max([worst, error.max(initial=0.0)]))
    return worst, largest
