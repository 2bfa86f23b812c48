"""YOLOX-nano (Ge et al. 2021), written anew after the authors' description and published files.

The network is that of https://github.com/Megvii-BaseDetection/YOLOX (Apache-2.0): a CSP backbone
and neck of depthwise convolutions, and a head without anchors that tells apart whether there is
something, what it is, and how large. The published files have each normalisation folded into the
convolution before it, so there is none here: this is a network to go on with from such weights
rather than one to begin with.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional
from torchvision.ops import box_iou, generalized_box_iou_loss

from sightline import _optional
from sightline.detection.classes import COCO
from sightline.errors import InputError
from sightline.training.architecture import ExportInfo, InputFormat, Prediction, Target, Trainable
from sightline.training.suppression import predictions

GENERAL_PREFIX = "general/"
"""Of the names of its nodes in a file in which it is joined with another detector."""

STRIDES = (8, 16, 32)
"""Pixels a cell, at the three scales."""

_PRIOR = 0.01
_BOX_WEIGHT = 5.0
_NEAR_STRIDES = 2.5
_CANDIDATES = 10
_COST_OF_OVERLAP, _COST_OF_DISTANCE = 3.0, 1e5
_LONGEST = 6.0
"""Of the logarithm of a side, in strides: beyond, a box is larger than any picture."""
_LIKE = {"sailboat": "boat", "ferry": "boat", "ship": "boat"}
"""Classes that begin with the weights of one that COCO has."""


def build(
    name: str,
    class_names: Sequence[str],
    *,
    weights: str = "",
    frozen: bool = False,
    width: float = 0.25,
    score_threshold: float = 0.3,
) -> Trainable:
    """A new network, with published weights or random ones.

    Args:
        name: ``"yolox-nano"``.
        class_names: What it is to tell apart.
        weights: An ONNX file of YOLOX-nano with COCO's classes to begin with; empty: random.
        frozen: Whether the backbone stays as it is, so that what it tells apart is not forgotten.
        width: Factor for the number of channels.
        score_threshold: From where on an exported network's boxes count.

    Raises:
        InputError: The width is not positive, or the file is of another network.
    """
    if not isinstance(width, int | float) or not width > 0.0:
        raise InputError(f"{name}: a width of {width} is not positive; 0.25 is the published one")
    made = YoloxDetector(name, class_names, width=width, score_threshold=score_threshold)
    if weights:
        load_onnx_weights(made.network, weights, class_names)
    for part in made.network.backbone if frozen else ():
        part.requires_grad_(False)
    return made


class _Convolution(nn.Sequential):  # type: ignore[misc]
    """Convolution with its normalisation folded in, and a smooth rectifier."""

    def __init__(
        self, inputs: int, outputs: int, size: int = 1, stride: int = 1, groups: int = 1
    ) -> None:
        super().__init__(
            nn.Conv2d(inputs, outputs, size, stride, size // 2, groups=groups),
            nn.SiLU(inplace=True),
        )


class _Separable(nn.Sequential):  # type: ignore[misc]
    """A 3 x 3 convolution of each channel, then one of all channels at each pixel."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__(
            _Convolution(inputs, inputs, 3, stride, groups=inputs), _Convolution(inputs, outputs)
        )


class _Bottleneck(nn.Module):  # type: ignore[misc]
    """Two convolutions, added to what came in."""

    def __init__(self, channels: int, *, shortcut: bool) -> None:
        super().__init__()
        self.first = _Convolution(channels, channels)
        self.second = _Separable(channels, channels)
        self.shortcut = shortcut

    def forward(self, x: Tensor) -> Tensor:
        refined: Tensor = self.second(self.first(x))
        return refined + x if self.shortcut else refined


class _Partial(nn.Module):  # type: ignore[misc]
    """Refines one half of the channels, and joins it with the other (Wang et al. 2020)."""

    def __init__(self, inputs: int, outputs: int, steps: int, *, shortcut: bool = True) -> None:
        super().__init__()
        half = outputs // 2
        self.refined = _Convolution(inputs, half)
        self.other = _Convolution(inputs, half)
        self.steps = nn.Sequential(*(_Bottleneck(half, shortcut=shortcut) for _ in range(steps)))
        self.merge = _Convolution(2 * half, outputs)

    def forward(self, x: Tensor) -> Tensor:
        # In the order of the published file, by which weights are found.
        refined, other = self.refined(x), self.other(x)
        return cast(Tensor, self.merge(torch.cat([self.steps(refined), other], dim=1)))


class _Pyramid(nn.Module):  # type: ignore[misc]
    """Adds what is around: maxima over growing windows."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.reduce = _Convolution(channels, channels // 2)
        self.merge = _Convolution(2 * channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        x = self.reduce(x)
        parts = [x, *(functional.max_pool2d(x, size, 1, size // 2) for size in (5, 9, 13))]
        return cast(Tensor, self.merge(torch.cat(parts, dim=1)))


class _Head(nn.Module):  # type: ignore[misc]
    """What is at each cell of one scale: edges, whether there is something, what it is."""

    def __init__(self, inputs: int, channels: int, classes: int) -> None:
        super().__init__()
        self.stem = _Convolution(inputs, channels)
        self.kind = nn.Sequential(_Separable(channels, channels), _Separable(channels, channels))
        self.place = nn.Sequential(_Separable(channels, channels), _Separable(channels, channels))
        self.kind_output = nn.Conv2d(channels, classes, 1)
        self.box_output = nn.Conv2d(channels, 4, 1)
        self.something_output = nn.Conv2d(channels, 1, 1)
        for output in (self.kind_output, self.something_output):
            nn.init.constant_(cast(Tensor, output.bias), -math.log((1.0 - _PRIOR) / _PRIOR))

    def forward(self, x: Tensor) -> Tensor:
        """(B, 5 + classes, H, W): centre and logarithm of the sides, in strides; logits."""
        x = self.stem(x)
        # In the order of the published file, by which weights are found.
        kind = self.kind_output(self.kind(x))
        place = self.place(x)
        return torch.cat([self.box_output(place), self.something_output(place), kind], dim=1)


class YoloxNetwork(nn.Module):  # type: ignore[misc]
    """Pictures in; boxes and logits of every cell out."""

    def __init__(self, classes: int, width: float = 0.25) -> None:
        """A network with random weights.

        Args:
            classes: How many it tells apart.
            width: Factor for the number of channels.
        """
        super().__init__()
        c2, c4, c8, c16, c32 = (
            max(8, 8 * round(width * channels / 8)) for channels in (64, 128, 256, 512, 1024)
        )
        self.stem = _Convolution(12, c2, 3)
        self.stage4 = nn.Sequential(_Separable(c2, c4, 2), _Partial(c4, c4, 1))
        self.stage8 = nn.Sequential(_Separable(c4, c8, 2), _Partial(c8, c8, 3))
        self.stage16 = nn.Sequential(_Separable(c8, c16, 2), _Partial(c16, c16, 3))
        self.stage32 = nn.Sequential(
            _Separable(c16, c32, 2), _Pyramid(c32), _Partial(c32, c32, 1, shortcut=False)
        )
        self.lateral32 = _Convolution(c32, c16)
        self.up16 = _Partial(2 * c16, c16, 1, shortcut=False)
        self.lateral16 = _Convolution(c16, c8)
        self.up8 = _Partial(2 * c8, c8, 1, shortcut=False)
        self.down8 = _Separable(c8, c8, 2)
        self.out16 = _Partial(2 * c8, c16, 1, shortcut=False)
        self.down16 = _Separable(c16, c16, 2)
        self.out32 = _Partial(2 * c16, c32, 1, shortcut=False)
        self.heads = nn.ModuleList(_Head(c, c8, classes) for c in (c8, c16, c32))

    @property
    def backbone(self) -> tuple[nn.Module, ...]:
        """What makes features of pictures, without what joins their scales."""
        return self.stem, self.stage4, self.stage8, self.stage16, self.stage32

    def features(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Features of pictures, (B, channels, H / stride, W / stride) for each of `STRIDES`.

        Args:
            images: (B, 3, H, W), BGR, 0 to 255, sides a multiple of 32.
        """
        parts = [images[..., y::2, x::2] for x in (0, 1) for y in (0, 1)]
        f8 = self.stage8(self.stage4(self.stem(torch.cat(parts, dim=1))))
        f16 = self.stage16(f8)
        return f8, f16, self.stage32(f16)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Look at pictures.

        Args:
            images: (B, 3, H, W), BGR, 0 to 255, sides a multiple of 32.

        Returns:
            As `decode`.
        """
        return self.decode(*self.features(images))

    def decode(self, f8: Tensor, f16: Tensor, f32: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Find things in features.

        Args:
            f8: As `features` gives them.
            f16: Likewise.
            f32: Likewise.

        Returns:
            Boxes (B, N, 4), corners in px; logits of something being there (B, N); logits
            (B, N, classes); cells (N, 3), corner and stride in px.
        """
        f32 = self.lateral32(f32)
        p16 = self.lateral16(
            self.up16(torch.cat([functional.interpolate(f32, scale_factor=2.0), f16], dim=1))
        )
        p8 = self.up8(torch.cat([functional.interpolate(p16, scale_factor=2.0), f8], dim=1))
        q16 = self.out16(torch.cat([self.down8(p8), p16], dim=1))
        q32 = self.out32(torch.cat([self.down16(q16), f32], dim=1))
        boxes, something, kinds, cells = [], [], [], []
        for head, level, stride in zip(self.heads, (p8, q16, q32), STRIDES, strict=True):
            out = head(level)
            cell = _cells(out.shape[2], out.shape[3], stride, out.device)
            flat = out.flatten(2).transpose(1, 2).float()
            middle = flat[..., :2] * stride + cell[:, :2]
            half = flat[..., 2:4].clamp(max=_LONGEST).exp() * (0.5 * stride)
            boxes.append(torch.cat([middle - half, middle + half], dim=-1))
            something.append(flat[..., 4])
            kinds.append(flat[..., 5:])
            cells.append(cell)
        return (
            torch.cat(boxes, 1),
            torch.cat(something, 1),
            torch.cat(kinds, 1),
            torch.cat(cells, 0),
        )


def _cells(rows: int, columns: int, stride: int, device: torch.device) -> Tensor:
    y = torch.arange(rows, device=device) * float(stride)
    x = torch.arange(columns, device=device) * float(stride)
    corner_y, corner_x = torch.meshgrid(y, x, indexing="ij")
    corner = torch.stack([corner_x, corner_y], dim=-1).reshape(-1, 2)
    return functional.pad(corner, (0, 1), value=float(stride))


class _Exported(nn.Module):  # type: ignore[misc]
    """One output (B, 4 + classes, N): centre, width and height in px, and scores."""

    def __init__(self, network: YoloxNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> Tensor:
        boxes, something, kinds, _ = self.network(images)
        low, high = boxes[..., :2], boxes[..., 2:]
        scores = kinds.sigmoid() * something.sigmoid()[..., None]
        return torch.cat([(low + high) * 0.5, high - low, scores], dim=-1).transpose(1, 2)


class YoloxDetector:
    """The network with its losses; see `Trainable`."""

    stride = STRIDES[-1]

    def __init__(
        self,
        name: str,
        class_names: Sequence[str],
        *,
        width: float = 0.25,
        score_threshold: float = 0.3,
    ) -> None:
        """A network with random weights; see `build`."""
        self.name = name
        self.class_names = tuple(class_names)
        self.score_threshold = score_threshold
        self.network = YoloxNetwork(len(self.class_names), width)
        # Depthwise convolutions are far faster so.
        self.module: nn.Module = self.network.to(memory_format=torch.channels_last)

    def losses(self, images: Tensor, targets: Sequence[Target]) -> dict[str, Tensor]:
        """Overlap of the boxes, and cross-entropies of something and of its kind."""
        boxes, something, kinds, cells = self.network(_fed(images))
        there = torch.zeros_like(something)
        weight = torch.ones_like(something)
        found, wanted, logits, quality = [], [], [], []
        for i, target in enumerate(targets):
            with torch.no_grad():
                cell, box, overlap = assign(
                    boxes[i].detach(), something[i].detach(), kinds[i].detach(), cells, target
                )
                weight[i] = 1.0 - _ignored(cells, target)
                weight[i, cell] = 1.0
                there[i, cell] = 1.0
                taught = overlap if target.worth is None else overlap * target.worth[box]
                kind = functional.one_hot(target.labels[box], kinds.shape[2])
                quality.append(kind * taught[:, None])
            found.append(boxes[i, cell])
            wanted.append(target.boxes_xyxy_px[box])
            logits.append(kinds[i, cell])
        count = max(1, sum(len(part) for part in found))
        entropy = functional.binary_cross_entropy_with_logits
        overlaps = generalized_box_iou_loss(torch.cat(found), torch.cat(wanted), reduction="sum")
        return {
            "box": _BOX_WEIGHT * overlaps / count,
            "something": (entropy(something, there, reduction="none") * weight).sum() / count,
            "class": entropy(torch.cat(logits), torch.cat(quality).float(), reduction="sum")
            / count,
        }

    def predict(self, images: Tensor, threshold: float) -> list[Prediction]:
        """What is in a batch; see `Trainable`."""
        with torch.no_grad():
            boxes, something, kinds, _ = self.network(_fed(images))
        return predictions(boxes, kinds.sigmoid() * something.sigmoid()[..., None], threshold)

    def export_module(self) -> tuple[nn.Module, ExportInfo]:
        """A module with one output of boxes and scores; see `Trainable`."""
        info = ExportInfo(
            decoder="yolov8",
            input_format=InputFormat(color="bgr", scale=1.0, stride=self.stride),
            score_threshold=self.score_threshold,
        )
        return _Exported(self.network).eval(), info


def _fed(images: Tensor) -> Tensor:
    """Pictures as the published weights want them."""
    return images.flip(1) * 255.0


def _ignored(cells: Tensor, target: Target) -> Tensor:
    """(N,) 1 where the middle of a cell lies in a box that was not labelled with care."""
    x1, y1, x2, y2 = target.boxes_xyxy_px[target.ignore].T
    x, y = (cells[:, i : i + 1] + 0.5 * cells[:, 2:] for i in (0, 1))
    return ((x > x1) & (x < x2) & (y > y1) & (y < y2)).any(dim=1).float()


def assign(
    boxes: Tensor, something: Tensor, kinds: Tensor, cells: Tensor, target: Target
) -> tuple[Tensor, Tensor, Tensor]:
    """Which cells are to find which boxes (SimOTA, Ge et al. 2021).

    Candidates are the cells whose middle lies in a box, or near its middle. A box takes as many of
    the cheapest as its best ten overlaps add up to, at least one; a cell that several boxes want
    goes to the one for which it is cheapest.

    Args:
        boxes: (N, 4) px.
        something: (N,) logits.
        kinds: (N, C) logits.
        cells: (N, 3) corner and stride, px.
        target: What is there.

    Returns:
        (P,) cells, (P,) positions of their boxes in ``target``, (P,) overlaps.
    """
    wanted = (~target.ignore).nonzero(as_tuple=True)[0]
    if not len(wanted):
        return wanted, wanted, boxes.new_zeros(0)
    truth, labels = target.boxes_xyxy_px[wanted], target.labels[wanted]
    stride = cells[None, :, 2:]
    centre = cells[None, :, :2] + 0.5 * stride
    middle = 0.5 * (truth[:, None, :2] + truth[:, None, 2:])
    inside = ((centre > truth[:, None, :2]) & (centre < truth[:, None, 2:])).all(dim=-1)
    near = ((centre - middle).abs() < _NEAR_STRIDES * stride).all(dim=-1)
    rows = (inside | near).any(dim=0).nonzero(as_tuple=True)[0]
    if not len(rows):
        return wanted[:0], wanted[:0], boxes.new_zeros(0)
    overlap = box_iou(truth, boxes[rows])
    score = (kinds[rows].sigmoid() * something[rows, None].sigmoid()).sqrt()
    entropy = functional.binary_cross_entropy(
        score[None].expand(len(truth), -1, -1),
        functional.one_hot(labels, kinds.shape[1])[:, None].expand(-1, len(rows), -1).float(),
        reduction="none",
    ).sum(dim=-1)
    central = (inside & near)[:, rows]
    cost = entropy - _COST_OF_OVERLAP * (overlap + 1e-8).log() + _COST_OF_DISTANCE * ~central
    taken = _cheapest(cost, overlap)
    box, cell = taken.nonzero(as_tuple=True)
    return rows[cell], wanted[box], overlap[box, cell]


def _cheapest(cost: Tensor, overlap: Tensor) -> Tensor:
    """(M, N) bool: which cells each box takes."""
    best = overlap.topk(min(_CANDIDATES, overlap.shape[1]), dim=1).values
    counts = best.sum(dim=1).int().clamp(min=1)
    taken = torch.zeros_like(cost, dtype=torch.bool)
    for row, count in enumerate(counts.tolist()):
        taken[row, cost[row].topk(count, largest=False).indices] = True
    several = taken.sum(dim=0) > 1
    if several.any():
        only = functional.one_hot(cost[:, several].argmin(dim=0), len(cost)).T.bool()
        taken[:, several] = only
    return taken


# ---- published weights --------------------------------------------------------------------------


def load_onnx_weights(network: YoloxNetwork, path: str | Path, class_names: Sequence[str]) -> None:
    """Take over the weights in an ONNX file of YOLOX-nano, whose normalisations are folded.

    Convolutions are matched in the order in which both run. Class rows are those of COCO's class
    of the same name; a class that COCO does not have begins with random ones. Of a file in which
    it is joined with a detector of one place (`sightline.training.gated`) it is taken alone, and
    its single class is the first.

    Args:
        network: What begins with them.
        path: The file; numbers are read from it, and nothing is run.
        class_names: What the network tells apart.

    Raises:
        InputError: The file is missing, damaged, or of another network.
    """
    published = _convolutions(path)
    ours = _in_order(network)
    if len(ours) != len(published):
        raise _other_network(path, f"it has {len(published)} convolutions, not {len(ours)}")
    state: list[tuple[nn.Conv2d, Tensor, Tensor]] = []
    kinds = {id(module) for name, module in network.named_modules() if name.endswith("kind_output")}
    for own, (weight, bias) in zip(ours, published, strict=True):
        if id(own) in kinds and len(weight) == len(COCO):
            weight, bias = _class_rows(own, weight, bias, class_names)
        elif id(own) in kinds and len(weight) > len(class_names):
            # Of several classes of its own the first comes first here as well.
            weight, bias = weight[: len(class_names)], bias[: len(class_names)]
        if own.weight.shape != weight.shape:
            shapes = f"{tuple(weight.shape)} where {tuple(own.weight.shape)} are expected"
            raise _other_network(path, f"weights of {shapes}")
        state.append((own, weight, bias))
    with torch.no_grad():
        for own, weight, bias in state:
            own.weight.copy_(weight)
            cast(Tensor, own.bias).copy_(bias)


def _other_network(path: str | Path, what: str) -> InputError:
    return InputError(f"{path}: is of another network than YOLOX-nano: {what}")


def _class_rows(
    own: nn.Conv2d, weight: Tensor, bias: Tensor, class_names: Sequence[str]
) -> tuple[Tensor, Tensor]:
    """The rows of the classes that are told apart, out of those of COCO."""
    rows, offsets = own.weight.detach().clone(), cast(Tensor, own.bias).detach().clone()
    if rows.shape[1] != weight.shape[1]:
        return weight, bias
    for i, name in enumerate(class_names):
        name = _LIKE.get(name, name)
        if name in COCO:
            rows[i], offsets[i] = weight[COCO.index(name)], bias[COCO.index(name)]
    return rows, offsets


def _in_order(network: YoloxNetwork) -> list[nn.Conv2d]:
    """The convolutions in the order in which they run."""
    order: list[nn.Conv2d] = []
    hooks = [
        module.register_forward_pre_hook(lambda one, _: order.append(one))
        for module in network.modules()
        if isinstance(module, nn.Conv2d)
    ]
    device = next(network.parameters()).device
    with torch.no_grad():
        network(torch.zeros(1, 3, STRIDES[-1], STRIDES[-1], device=device))
    for hook in hooks:
        hook.remove()
    return order


def _convolutions(path: str | Path) -> list[tuple[Tensor, Tensor]]:
    """Weights and biases of the convolutions in an ONNX file, in the order in which they run."""
    onnx = _optional.module("onnx", "train")
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: is not there; give an ONNX file of YOLOX-nano")
    try:
        graph = onnx.load(str(path), load_external_data=False).graph
        values = {one.name: onnx.numpy_helper.to_array(one) for one in graph.initializer}
    except Exception as error:  # protobuf's own errors share no base with onnx's
        raise InputError(f"{path}: is no whole ONNX file") from error
    for node in graph.node:
        # Weights that are the same are in a file once.
        if node.op_type == "Identity" and node.input[0] in values:
            values[node.output[0]] = values[node.input[0]]
    found = []
    nodes = [node for node in graph.node if node.op_type == "Conv"]
    joined = [node for node in nodes if node.name.startswith(GENERAL_PREFIX)]
    for node in joined or nodes:
        if len(node.input) < 3 or not all(name in values for name in node.input[1:3]):
            raise _other_network(path, "a convolution has no weights or no bias in the file")
        weight, bias = (np.array(values[name], dtype=np.float32) for name in node.input[1:3])
        found.append((torch.from_numpy(weight), torch.from_numpy(bias)))
    return found
