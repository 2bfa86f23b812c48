"""EfficientDet-D0 (Tan, Pang and Le 2020), from effdet, behind the seam of training."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from sightline.errors import InputError
from sightline.formats import _extras
from sightline.training.architecture import ExportInfo, InputFormat, Prediction, Target
from sightline.training.darknet.loss import inside
from sightline.training.pretrained import load_matching
from sightline.training.suppression import predictions

_MODEL = "efficientdet_d0"
_STRIDE = 128
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_MATCH = 0.5
"""Overlap from where on an anchor is to find an object, as published."""
_NOTHING_SAID = -2
"""effdet's class of an anchor that is neither right nor wrong."""
_INSIDE_IGNORED = 0.5


class EfficientDetDetector:
    """EfficientDet-D0; see `Trainable`."""

    stride = _STRIDE

    def __init__(self, name: str, class_names: Sequence[str]) -> None:
        """Begin with random weights.

        Args:
            name: Of the architecture.
            class_names: What it is to tell apart.
        """
        effdet = _extras.module("effdet", "train")
        config = effdet.get_efficientdet_config(_MODEL)
        config.num_classes = len(class_names)
        self.name = name
        self.class_names = tuple(class_names)
        self._config = config
        # The backbone's published weights would come over the network.
        self._effdet = effdet.EfficientDet(config, pretrained_backbone=False)
        for part in self._effdet.modules():
            # As it is, it takes pictures of one size only; each level is twice the next.
            if type(part).__name__ == "Interpolate2d":
                part.size, part.scale_factor = None, 2.0
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
        bench = _extras.module("effdet.anchors", "train")
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
        return _Flat(self.module).eval(), info

    def _labeller(self, images: Tensor) -> nn.Module:
        """What tells each anchor of pictures of this size what to find."""
        height, width = (int(side) for side in images.shape[2:])
        if height % _STRIDE or width % _STRIDE:
            raise InputError(
                f"{self.name}: pictures of {width} x {height} px; width and height must be "
                f"multiples of {_STRIDE}"
            )
        if (height, width) not in self._labellers:
            parts = _extras.module("effdet.anchors", "train")
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
    """Puts the levels one after the other."""

    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        self.module = module

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        return _flat(*self.module(images))


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


def build(name: str, class_names: Sequence[str], *, weights: str = "") -> EfficientDetDetector:
    """An EfficientDet-D0.

    Args:
        name: ``"efficientdet-d0"``.
        class_names: What it is to tell apart.
        weights: A ``.safetensors``, or a ``.pth`` with nothing but tensors, of effdet's
            ``efficientdet_d0`` for any classes; empty: random weights.

    Raises:
        InputError: The file cannot be used, or effdet is not installed.
    """
    if not class_names:
        raise InputError(f"{name}: needs the name of a class at least")
    detector = EfficientDetDetector(name, class_names)
    if weights:
        load_matching(detector.module.network, weights)
    return detector
