"""EfficientDet-D0 (Tan, Pang and Le 2020), from effdet, behind the seam of training."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from sightline import _optional
from sightline.errors import InputError, unknown_name
from sightline.training.architecture import ExportInfo, InputFormat, Prediction, Target
from sightline.training.darknet.loss import inside
from sightline.training.pretrained import load_matching, read_state
from sightline.training.suppression import predictions

_MODEL = "efficientdet_d0"
_STRIDE = 128
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_MATCH = 0.5
"""Overlap from where on an anchor is to find an object, as published."""
_NOTHING_SAID = -2
"""effdet's class of an anchor that is neither right nor wrong."""
_INSIDE_IGNORED = 0.5

NORMS = ("group", "batch")
"""What normalises between convolutions: a group of channels of one picture (Wu and He 2018), or a
channel of the whole batch as published."""
_GROUP = 8
"""Channels in a group: the largest power of two that divides all widths of the network."""
_EPS = 1e-3
"""As published."""
ANCHOR_SCALE = 4.0
"""Side of the smallest anchor of a level, in strides, as published."""


class EfficientDetDetector:
    """EfficientDet-D0; see `Trainable`."""

    stride = _STRIDE

    def __init__(
        self,
        name: str,
        class_names: Sequence[str],
        norm: str = "group",
        anchor_scale: float = ANCHOR_SCALE,
    ) -> None:
        """Begin with random weights.

        Args:
            name: Of the architecture.
            class_names: What it is to tell apart.
            norm: One of `NORMS`.
            anchor_scale: Side of the smallest anchor of a level, in strides.
        """
        if norm not in NORMS:
            raise unknown_name("normalisation", norm, NORMS)
        if not (math.isfinite(anchor_scale) and anchor_scale > 0.0):
            raise InputError(
                f"{name}: anchors of {anchor_scale:g} strides cannot be; published are "
                f"{ANCHOR_SCALE:g}"
            )
        effdet = _optional.module("effdet", "train")
        config = effdet.get_efficientdet_config(_MODEL)
        config.num_classes = len(class_names)
        config.anchor_scale = float(anchor_scale)
        if norm == "group":
            _normalise_by_group(config)
        self.name = name
        self.class_names = tuple(class_names)
        self._config = config
        # The backbone's published weights would come over the network.
        self._effdet = effdet.EfficientDet(config, pretrained_backbone=False)
        for part in self._effdet.modules():
            # As it is, it takes pictures of one size only; each level is twice the next.
            if type(part).__name__ == "Interpolate2d":
                part.size, part.scale_factor = None, 2.0
            if type(part).__name__ == "SqueezeExcite":
                part.forward = partial(_squeezed, part)
        self.module: nn.Module = _Normalised(self._effdet)
        self._loss = effdet.loss.DetectionLoss(config)
        self._labellers: dict[tuple[int, int], nn.Module] = {}

    def losses(self, images: Tensor, targets: Sequence[Target]) -> dict[str, Tensor]:
        """The parts of the loss as published: focal and Huber's; see `Trainable`."""
        logits, offsets = self.module(images)
        labeller = self._labeller(images)
        boxes = [target.boxes_xyxy_px[~target.ignore][:, [1, 0, 3, 2]] for target in targets]
        # Of effdet's classes 0 is the background.
        labels = [target.labels[~target.ignore] + 1 for target in targets]
        classes, places, positives = labeller.batch_label_anchors(boxes, labels)
        anchors = labeller.anchors.boxes[:, [1, 0, 3, 2]]
        for number, target in enumerate(targets):
            if target.ignore.any():
                unsaid = inside(anchors, target.boxes_xyxy_px[target.ignore]) > _INSIDE_IGNORED
                _leave_out([level[number] for level in classes], unsaid)
        _, classification, box = self._loss(logits, offsets, classes, places, positives)
        return {"box": self._config.box_loss_weight * box, "classification": classification}

    def predict(self, images: Tensor, threshold: float) -> list[Prediction]:
        """What is in a batch; see `Trainable`."""
        bench = _optional.module("effdet.anchors", "train")
        logits, offsets = _flat(*self.module(images))
        anchors = self._labeller(images).anchors.boxes
        boxes = torch.stack(
            [bench.decode_box_outputs(each, anchors, output_xyxy=True) for each in offsets.float()]
        )
        return predictions(boxes, logits.float().sigmoid(), threshold)

    def export_module(self) -> tuple[nn.Module, ExportInfo]:
        """Logits and offsets of all anchors; see `Trainable`."""
        info = ExportInfo(
            "efficientdet",
            output_names=("logits", "boxes"),
            input_format=InputFormat(stride=_STRIDE),
            input_size_px=(512, 512),
        )
        return _Flat(self.module, self._config.anchor_scale / ANCHOR_SCALE).eval(), info

    def _labeller(self, images: Tensor) -> nn.Module:
        """What tells each anchor of pictures of this size what to find."""
        height, width = (int(side) for side in images.shape[2:])
        if height % _STRIDE or width % _STRIDE:
            raise InputError(
                f"{self.name}: pictures of {width} x {height} px; width and height must be "
                f"multiples of {_STRIDE}"
            )
        if (height, width) not in self._labellers:
            parts = _optional.module("effdet.anchors", "train")
            config = self._config
            anchors = parts.Anchors(
                config.min_level,
                config.max_level,
                config.num_scales,
                config.aspect_ratios,
                config.anchor_scale,
                (height, width),
            )
            labeller = parts.AnchorLabeler(anchors, config.num_classes, match_threshold=_MATCH)
            self._labellers[height, width] = labeller
        labeller = self._labellers[height, width]
        labeller.anchors.to(images.device)
        return labeller


class _Normalised(nn.Module):  # type: ignore[misc]
    """Takes pictures from 0 to 1."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network
        self.register_buffer("mean", torch.tensor(_MEAN).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(_STD).view(1, 3, 1, 1), persistent=False)

    def forward(self, images: Tensor) -> tuple[list[Tensor], list[Tensor]]:
        logits, offsets = self.network((images - self.mean) / self.std)
        return logits, offsets


class _Flat(nn.Module):  # type: ignore[misc]
    """Puts the levels one after the other, with the offsets from anchors of the published size."""

    def __init__(self, module: nn.Module, anchor_ratio: float) -> None:
        super().__init__()
        self.module = module
        self.anchor_ratio = anchor_ratio

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        logits, offsets = _flat(*self.module(images))
        if self.anchor_ratio == 1.0:
            return logits, offsets
        # Middles count in sides of the anchor, sides in logarithms of them.
        places = offsets[..., :2] * self.anchor_ratio
        return logits, torch.cat([places, offsets[..., 2:] + math.log(self.anchor_ratio)], dim=-1)


def _normalise_by_group(config: Any) -> None:
    """Have a configuration of effdet normalise by groups of channels.

    A mean over the batch is worth little here. Crops of 256 x 128 px leave 2 x 1 px to the coarsest
    level, so its statistics come from eight values of a batch of four. Whole frames differ from
    them, a hundred normalisations in a row multiply that, and the coarse levels put out boxes of
    certainty 1 where nothing is. A group of a picture's own channels needs no statistics.
    """
    config._set_flag("allow_objects", True)
    config.norm_layer = _GroupNorm
    config.norm_kwargs = {}
    config.backbone_args = {**config.backbone_args, "norm_layer": _activated_norm}


class _GroupNorm(nn.GroupNorm):  # type: ignore[misc]
    """Normalises groups of `_GROUP` channels; what it is given may be an activation besides.

    In evaluation the means are taken along one axis after the other: see `_mean`.
    """

    def __init__(self, channels: int, act: nn.Module | None = None) -> None:
        super().__init__(channels // _GROUP, channels, eps=_EPS)
        self.act = act

    def forward(self, values: Tensor) -> Tensor:
        found = super().forward(values) if self.training else self._by_axes(values)
        return found if self.act is None else self.act(found)

    def _by_axes(self, values: Tensor) -> Tensor:
        # Not len(values): that would be a constant of an exported file.
        shape = values.shape
        grouped = values.reshape(shape[0], self.num_groups, _GROUP, shape[2], shape[3])
        centred = grouped - _mean(grouped)
        normal = centred * torch.rsqrt(_mean(centred * centred) + self.eps)
        scale, offset = (each.view(1, -1, 1, 1) for each in (self.weight, self.bias))
        return normal.reshape(shape) * scale + offset


def _mean(values: Tensor) -> Tensor:
    """Of all axes but the first two, one after the other.

    In an exported file ONNX Runtime adds up all that is to be averaged in one single-precision
    number: of half a million values that leaves three or four digits, and fewer where a part of a
    picture is all the same. Of a row at a time it leaves six.
    """
    for axis in range(values.ndim - 1, 1, -1):
        values = values.mean(dim=axis, keepdim=True)
    return values


def _squeezed(part: Any, values: Tensor) -> Tensor:
    """As timm's squeeze and excitation, with that mean."""
    squeezed = part.conv_expand(part.act1(part.conv_reduce(_mean(values))))
    return values * part.gate(squeezed)


def _activated_norm(channels: int, apply_act: bool = True, **_: Any) -> _GroupNorm:
    """As timm makes the normalisations of a backbone; EfficientNet's activation is SiLU."""
    return _GroupNorm(channels, nn.SiLU(inplace=True) if apply_act else None)


def _flat(logits: Sequence[Tensor], offsets: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """(B, N, C) logits and (B, N, 4) offsets: level by level, row by row, anchor by anchor."""
    anchors = offsets[0].shape[1] // 4

    def join(levels: Sequence[Tensor]) -> Tensor:
        width = levels[0].shape[1] // anchors
        flat = [
            # Not len(level): that would be a constant of an exported file.
            level.permute(0, 2, 3, 1).reshape(level.shape[0], -1, width)
            for level in levels
        ]
        return torch.cat(flat, dim=1)

    return join(logits), join(offsets)


def _leave_out(levels: Sequence[Tensor], unsaid: Tensor) -> None:
    """Mark anchors that have nothing to find and are not wrong to find something.

    Args:
        levels: (rows, columns, anchors) each, the class that each anchor is to find; changed.
        unsaid: (N,) bool, for all levels.
    """
    at = 0
    for level in levels:
        part = unsaid[at : at + level.numel()].view(level.shape)
        level[part & (level < 0)] = _NOTHING_SAID
        at += level.numel()


def build(
    name: str,
    class_names: Sequence[str],
    *,
    weights: str = "",
    norm: str = "group",
    anchor_scale: float = ANCHOR_SCALE,
) -> EfficientDetDetector:
    """An EfficientDet-D0.

    Args:
        name: ``"efficientdet-d0"``.
        class_names: What it is to tell apart.
        weights: A ``.safetensors``, or a ``.pth`` with nothing but tensors, of effdet's
            ``efficientdet_d0`` for any classes; empty: random weights. The published ones want
            ``norm="batch"``.
        norm: One of `NORMS`. By groups a small batch of small crops is enough to learn from.
        anchor_scale: Side of the smallest anchor of a level, in strides: 4 as published, for
            objects of 32 px and more; a boat of 12 px wants 1.5. Files hold offsets from the
            published anchors whatever this is.

    Raises:
        InputError: The file or an option cannot be used, or effdet is not installed.
    """
    if not class_names:
        raise InputError(f"{name}: needs the name of a class at least")
    detector = EfficientDetDetector(name, class_names, norm, anchor_scale)
    if weights:
        if norm == "group" and any(one.endswith(".running_var") for one in read_state(weights)):
            raise InputError(
                f"{weights}: belongs to a network that normalises by batch; add the option "
                "norm=batch"
            )
        load_matching(detector.module.network, weights)
    return detector
