"""The detector that ships: a small network without anchors, for small boats in wide pictures.

Three scales of features (8, 16 and 32 px a cell) come out of a short stack of dense 3 x 3
convolutions, which are what runs fast on a CPU; each cell says what is there and how far the edges
of its box are. What a cell is taught follows how well it already does (task alignment, Feng et
al. 2021), its class score is also its quality (Li et al. 2020), and boxes are fitted by their
complete overlap (Zheng et al. 2020).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import cast

import torch
import torchvision
from torch import Tensor, nn
from torch.nn import functional

from sightline.errors import InputError
from sightline.training.architecture import ExportInfo, InputFormat, Prediction, Target, Trainable

STRIDES = (8, 16, 32)
"""Pixels a cell, at the three scales."""

_PRIOR = 0.01
_CANDIDATES = 9
_ALPHA, _BETA = 0.5, 4.0
_BOX_WEIGHT, _EDGE_WEIGHT = 2.0, 0.25
_OVERLAP = 0.5
_MOST_BOXES = 100


def build(
    name: str, class_names: Sequence[str], *, width: float = 1.0, score_threshold: float = 0.3
) -> Trainable:
    """A new network with random weights.

    Args:
        name: ``"harbour"``.
        class_names: What it is to tell apart.
        width: Factor for the number of channels.
        score_threshold: From where on an exported network's boxes count.

    Raises:
        InputError: The width is not positive.
    """
    if not isinstance(width, int | float) or not width > 0.0:
        raise InputError(f"{name}: a width of {width} is not positive; 1 is what ships")
    return HarbourDetector(class_names, width=width, score_threshold=score_threshold)


class _Convolution(nn.Sequential):  # type: ignore[misc]
    """Convolution, normalisation, rectifier."""

    def __init__(self, inputs: int, outputs: int, size: int = 3, stride: int = 1) -> None:
        super().__init__(
            nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False),
            nn.BatchNorm2d(outputs, momentum=0.03),
            nn.ReLU(inplace=True),
        )


class _Stage(nn.Module):  # type: ignore[misc]
    """Halves the picture, then refines a half of the channels and keeps what each step gave."""

    def __init__(self, inputs: int, outputs: int, steps: int) -> None:
        super().__init__()
        half = outputs // 2
        self.down = _Convolution(inputs, outputs, stride=2)
        self.steps = nn.ModuleList(_Convolution(half, half) for _ in range(steps))
        self.merge = _Convolution(outputs + steps * half, outputs, size=1)

    def forward(self, x: Tensor) -> Tensor:
        x = self.down(x)
        last = x[:, x.shape[1] // 2 :]
        parts = [x]
        for step in self.steps:
            last = last + step(last)
            parts.append(last)
        return cast(Tensor, self.merge(torch.cat(parts, dim=1)))


class _Context(nn.Module):  # type: ignore[misc]
    """Adds what is around: maxima over growing windows."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        half = channels // 2
        self.reduce = _Convolution(channels, half, size=1)
        self.merge = _Convolution(4 * half, channels, size=1)

    def forward(self, x: Tensor) -> Tensor:
        parts = [self.reduce(x)]
        for _ in range(3):
            parts.append(functional.max_pool2d(parts[-1], 5, 1, 2))
        return cast(Tensor, self.merge(torch.cat(parts, dim=1)))


class HarbourNetwork(nn.Module):  # type: ignore[misc]
    """Pictures in; logits and edge distances of every cell out."""

    def __init__(self, classes: int, width: float = 1.0) -> None:
        """A network with random weights.

        Args:
            classes: How many it tells apart.
            width: Factor for the number of channels.
        """
        super().__init__()
        c2, c4, c8, c16, c32, neck = (
            max(8, 8 * round(width * channels / 8)) for channels in (16, 24, 48, 96, 128, 48)
        )
        self.classes = classes
        self.stem = _Convolution(3, c2, stride=2)
        self.stage4 = _Stage(c2, c4, 1)
        self.stage8 = _Stage(c4, c8, 2)
        self.stage16 = _Stage(c8, c16, 2)
        self.stage32 = _Stage(c16, c32, 1)
        self.context = _Context(c32)
        # Fine features of 4 px a cell help to place the edges of things that are 10 px high.
        self.fine = _Convolution(c4, neck // 2, stride=2)
        self.lateral = nn.ModuleList(nn.Conv2d(c, neck, 1) for c in (c8, c16, c32))
        self.smooth = nn.ModuleList(
            _Convolution(neck + (neck // 2 if i == 0 else 0), neck) for i in range(3)
        )
        self.class_branch = nn.ModuleList(_Convolution(neck, neck) for _ in STRIDES)
        self.box_branch = nn.ModuleList(_Convolution(neck, neck) for _ in STRIDES)
        self.class_output = nn.ModuleList(nn.Conv2d(neck, classes, 1) for _ in STRIDES)
        self.box_output = nn.ModuleList(nn.Conv2d(neck, 4, 1) for _ in STRIDES)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        for output in self.class_output:
            nn.init.normal_(cast(Tensor, output.weight), std=0.01)
            nn.init.constant_(cast(Tensor, output.bias), -math.log((1.0 - _PRIOR) / _PRIOR))
        for output in self.box_output:
            nn.init.normal_(cast(Tensor, output.weight), std=0.01)
            nn.init.constant_(cast(Tensor, output.bias), 1.0)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Look at pictures.

        Args:
            images: (B, 3, H, W), RGB, 0 to 1, sides a multiple of 32.

        Returns:
            Logits (B, N, classes); boxes (B, N, 4), corners in px; cells (N, 3), centre and
            stride in px.
        """
        f4 = self.stage4(self.stem(images * 4.0 - 2.0))
        f8 = self.stage8(f4)
        f16 = self.stage16(f8)
        f32 = self.context(self.stage32(f16))
        p32 = self.lateral[2](f32)
        p16 = self.lateral[1](f16) + functional.interpolate(p32, scale_factor=2.0)
        p8 = self.lateral[0](f8) + functional.interpolate(p16, scale_factor=2.0)
        levels = [torch.cat([p8, self.fine(f4)], dim=1), p16, p32]
        logits, boxes, cells = [], [], []
        for i, stride in enumerate(STRIDES):
            level = self.smooth[i](levels[i])
            logit = self.class_output[i](self.class_branch[i](level))
            edges = functional.softplus(self.box_output[i](self.box_branch[i](level))) * stride
            height, width = level.shape[2], level.shape[3]
            y = (torch.arange(height, device=images.device) + 0.5) * stride
            x = (torch.arange(width, device=images.device) + 0.5) * stride
            centre_y, centre_x = torch.meshgrid(y, x, indexing="ij")
            centre = torch.stack([centre_x, centre_y], dim=-1).reshape(1, -1, 2)
            distance = edges.flatten(2).transpose(1, 2).float()
            boxes.append(torch.cat([centre - distance[..., :2], centre + distance[..., 2:]], -1))
            logits.append(logit.flatten(2).transpose(1, 2).float())
            cells.append(functional.pad(centre[0], (0, 1), value=float(stride)))
        return torch.cat(logits, 1), torch.cat(boxes, 1), torch.cat(cells, 0)


class _Exported(nn.Module):  # type: ignore[misc]
    """One output (B, 4 + classes, N): centre, width and height in px, and scores."""

    def __init__(self, network: HarbourNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> Tensor:
        logits, boxes, _ = self.network(images)
        low, high = boxes[..., :2], boxes[..., 2:]
        parts = [(low + high) * 0.5, high - low, logits.sigmoid()]
        return torch.cat(parts, dim=-1).transpose(1, 2)


class HarbourDetector:
    """The network with its losses; see `Trainable`."""

    name = "harbour"
    stride = STRIDES[-1]

    def __init__(
        self, class_names: Sequence[str], *, width: float = 1.0, score_threshold: float = 0.3
    ) -> None:
        """A network with random weights; see `build`."""
        self.class_names = tuple(class_names)
        self.score_threshold = score_threshold
        self.network = HarbourNetwork(len(self.class_names), width)
        self.module: nn.Module = self.network

    def losses(self, images: Tensor, targets: Sequence[Target]) -> dict[str, Tensor]:
        """Quality focal loss of the classes, overlap and edges of the boxes."""
        logits, boxes, cells = self.network(images)
        quality = torch.zeros_like(logits)
        weight = torch.ones_like(logits[..., 0])
        chosen_boxes, wanted_boxes, shares = [], [], []
        for i, target in enumerate(targets):
            with torch.no_grad():
                cell, box, share = _assign(logits[i].detach(), boxes[i].detach(), cells, target)
                weight[i] = ~_ignored(cells, target)
                taught = share if target.worth is None else share * target.worth[box]
                quality[i, cell, target.labels[box]] = taught
                weight[i, cell] = 1.0
            chosen_boxes.append(boxes[i, cell])
            wanted_boxes.append(target.boxes_xyxy_px[box])
            shares.append(share)
        share = torch.cat(shares)
        total = share.sum().clamp(min=1.0)
        error = (quality - logits.sigmoid()).abs().pow(2)
        entropy = functional.binary_cross_entropy_with_logits(logits, quality, reduction="none")
        found, wanted = torch.cat(chosen_boxes), torch.cat(wanted_boxes)
        overlap = torchvision.ops.complete_box_iou_loss(found, wanted)
        # Of tiny boxes the overlap says little until they touch, so their edges count as well.
        size = (wanted[:, 2:] - wanted[:, :2]).clamp(min=4.0).repeat(1, 2)
        edges = functional.smooth_l1_loss(
            found / size, wanted / size, beta=0.05, reduction="none"
        ).sum(dim=1)
        return {
            "class": (entropy * error * weight[..., None]).sum() / total,
            "box": _BOX_WEIGHT * (overlap * share).sum() / total,
            "edge": _EDGE_WEIGHT * (edges * share).sum() / total,
        }

    def predict(self, images: Tensor, threshold: float) -> list[Prediction]:
        """What is in a batch; see `Trainable`."""
        with torch.no_grad():
            logits, boxes, _ = self.network(images)
            scores = logits.sigmoid()
        found = []
        for score, box in zip(scores, boxes, strict=True):
            cell, label = (score > threshold).nonzero(as_tuple=True)
            kept = torchvision.ops.batched_nms(box[cell], score[cell, label], label, _OVERLAP)
            kept = kept[:_MOST_BOXES]
            found.append(Prediction(box[cell[kept]], score[cell, label][kept], label[kept]))
        return found

    def export_module(self) -> tuple[nn.Module, ExportInfo]:
        """A module with one output of boxes and scores; see `Trainable`."""
        info = ExportInfo(
            decoder="yolov8",
            input_format=InputFormat(stride=self.stride),
            score_threshold=self.score_threshold,
        )
        return _Exported(self.network).eval(), info


def _ignored(cells: Tensor, target: Target) -> Tensor:
    """(N,) bool: the middle of a cell lies in a box that was not labelled with care."""
    boxes = target.boxes_xyxy_px[target.ignore]
    x, y = cells[:, :1], cells[:, 1:2]
    x1, y1, x2, y2 = boxes.T
    inside = (x > x1) & (x < x2) & (y > y1) & (y < y2)
    return inside.any(dim=1)


def _assign(
    logits: Tensor, boxes: Tensor, cells: Tensor, target: Target
) -> tuple[Tensor, Tensor, Tensor]:
    """Which cells are to find which boxes (Feng et al. 2021, equations 1 and 4).

    Candidates are the cells whose middle lies in a box or within one and a half cells of its
    middle. Each box takes those that agree best with it in score and overlap; a cell that several
    boxes want goes to the one that it overlaps most.

    Args:
        logits: (N, C).
        boxes: (N, 4) px.
        cells: (N, 3) centre and stride, px.
        target: What is there.

    Returns:
        (P,) cells, (P,) positions of their boxes in ``target``, (P,) scores that they are to have.
    """
    wanted = (~target.ignore).nonzero(as_tuple=True)[0]
    if not len(wanted):
        return wanted, wanted, boxes.new_zeros(0)
    truth, labels = target.boxes_xyxy_px[wanted], target.labels[wanted]
    centre, stride = cells[None, :, :2], cells[None, :, 2]
    middle = 0.5 * (truth[:, None, :2] + truth[:, None, 2:])
    inside = ((centre > truth[:, None, :2]) & (centre < truth[:, None, 2:])).all(dim=-1)
    near = ((centre - middle).abs() < 1.5 * stride[..., None]).all(dim=-1)
    overlap = torchvision.ops.box_iou(truth, boxes)
    score = logits.sigmoid()[:, labels].T
    # The small constants keep an order among cells that do not overlap yet: the nearest first.
    distance = (centre - middle).norm(dim=-1) / (truth[:, None, 2:] - truth[:, None, :2]).norm(
        dim=-1
    ).clamp(min=8.0)
    aligned = score.pow(_ALPHA) * overlap.pow(_BETA) + 1e-6 * torch.exp(-distance)
    aligned = torch.where(inside | near, aligned, aligned.new_zeros(()))
    best, order = aligned.topk(min(_CANDIDATES, aligned.shape[1]), dim=1)
    taken = torch.zeros_like(aligned, dtype=torch.bool).scatter_(1, order, best > 0.0)
    several = taken.sum(dim=0) > 1
    if several.any():
        owner = torch.where(taken, overlap + 1e-6, overlap.new_zeros(())).argmax(dim=0)
        only = functional.one_hot(owner, len(wanted)).T.bool()
        taken = taken & (only | ~several)
    box, cell = taken.nonzero(as_tuple=True)
    strength = torch.where(taken, aligned, aligned.new_zeros(()))
    most = strength.amax(dim=1, keepdim=True).clamp(min=1e-12)
    best_overlap = torch.where(taken, overlap, overlap.new_zeros(())).amax(dim=1, keepdim=True)
    share = (strength / most * best_overlap.clamp(min=0.05))[box, cell]
    return cell, wanted[box], share
