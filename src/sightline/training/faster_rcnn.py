"""Faster R-CNN (Ren et al. 2015) with a feature pyramid (Lin et al. 2017), from torchvision."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from torch import Tensor, nn
from torchvision.models.detection import FasterRCNN
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.backbone_utils import resnet_fpn_backbone
from torchvision.models.detection.roi_heads import RoIHeads
from torchvision.models.detection.rpn import RegionProposalNetwork

from sightline.errors import InputError, unknown_name
from sightline.training.architecture import ExportInfo, Prediction, Target
from sightline.training.darknet.loss import inside
from sightline.training.pretrained import load_matching

BACKBONES = ("resnet18", "resnet34", "resnet50")
"""With one class: 28.3, 38.4 and 41.4 million parameters. The paper's has 27.6."""

_STRIDE = 32
_INSIDE_IGNORED = 0.5
_LEAST_SCORE = 0.05
_SAMPLES = 512
_SMALLEST_PX = 32.0
_LEVELS = 5
_ASPECTS = (0.5, 1.0, 2.0)
_NOTHING_SAID = -1
"""torchvision's label of an anchor or a proposal that is neither right nor wrong."""


class FasterRcnnDetector:
    """Faster R-CNN; see `Trainable`."""

    stride = _STRIDE

    def __init__(
        self,
        name: str,
        class_names: Sequence[str],
        backbone: str = "resnet18",
        samples: int = _SAMPLES,
        smallest_anchor_px: float = _SMALLEST_PX,
    ) -> None:
        """Begin with random weights.

        Args:
            name: Of the architecture.
            class_names: What it is to tell apart.
            backbone: One of `BACKBONES`.
            samples: Proposals of a picture that the second stage learns from.
            smallest_anchor_px: Side of the anchors of the finest level.
        """
        if samples < 1:
            raise InputError(f"{name}: cannot learn from {samples} proposals; give 1 or more")
        if not (math.isfinite(smallest_anchor_px) and smallest_anchor_px > 0.0):
            raise InputError(
                f"{name}: anchors of {smallest_anchor_px:g} px cannot be; published are "
                f"{_SMALLEST_PX:g}"
            )
        if backbone not in BACKBONES:
            raise unknown_name("backbone", backbone, BACKBONES)
        self.name = name
        self.class_names = tuple(class_names)
        body = resnet_fpn_backbone(
            backbone_name=backbone,
            weights=None,
            # Without published weights there are no statistics to be frozen.
            norm_layer=nn.BatchNorm2d,
            trainable_layers=5,
        )
        # The loop says how large pictures are.
        self._rcnn = FasterRCNN(
            body,
            num_classes=1 + len(class_names),
            box_batch_size_per_image=samples,
            rpn_anchor_generator=AnchorGenerator(
                tuple((float(smallest_anchor_px) * 2.0**level,) for level in range(_LEVELS)),
                (_ASPECTS,) * _LEVELS,
            ),
            _skip_resize=True,
        )
        self._rcnn.rpn.__class__ = _Proposals
        self._rcnn.roi_heads.__class__ = _Heads
        self.module: nn.Module = self._rcnn

    def losses(self, images: Tensor, targets: Sequence[Target]) -> dict[str, Tensor]:
        """The four parts of the loss as published; see `Trainable`."""
        asked = [
            {
                "boxes": target.boxes_xyxy_px[~target.ignore],
                # Of torchvision's classes 0 is the background.
                "labels": target.labels[~target.ignore] + 1,
                "ignored": target.boxes_xyxy_px[target.ignore],
            }
            for target in targets
        ]
        with _telling_losses(self._rcnn):
            losses: dict[str, Tensor] = self._rcnn(list(images), asked)
        return losses

    def predict(self, images: Tensor, threshold: float) -> list[Prediction]:
        """What is in a batch; see `Trainable`."""
        self._rcnn.roi_heads.score_thresh = threshold
        return [
            Prediction(found["boxes"], found["scores"], found["labels"] - 1)
            for found in self._rcnn(list(images))
        ]

    def export_module(self) -> tuple[nn.Module, ExportInfo]:
        """Boxes, labels and scores of one picture; see `Trainable`."""
        self._rcnn.roi_heads.score_thresh = _LEAST_SCORE
        info = ExportInfo(
            "torchvision",
            output_names=("boxes", "labels", "scores"),
            dynamic_batch=False,
        )
        return _One(self._rcnn).eval(), info


class _One(nn.Module):  # type: ignore[misc]
    """Takes a picture; classes are counted from 1, as the decoder knows it of torchvision."""

    def __init__(self, rcnn: nn.Module) -> None:
        super().__init__()
        self.rcnn = rcnn

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        (found,) = self.rcnn([images[0]])
        return found["boxes"], found["labels"], found["scores"]


class _Proposals(RegionProposalNetwork):  # type: ignore[misc]
    """Says nothing about anchors on what was not labelled with care."""

    def assign_targets_to_anchors(
        self, anchors: list[Tensor], targets: list[dict[str, Tensor]]
    ) -> tuple[list[Tensor], list[Tensor]]:
        labels, boxes = super().assign_targets_to_anchors(anchors, targets)
        for label, anchor, target in zip(labels, anchors, targets, strict=True):
            _leave_out(label, anchor, target["ignored"])
        return labels, boxes


class _Heads(RoIHeads):  # type: ignore[misc]
    """Says nothing about proposals on what was not labelled with care."""

    _ignored: Sequence[Tensor] = ()

    def select_training_samples(
        self, proposals: list[Tensor], targets: list[dict[str, Tensor]]
    ) -> Any:
        self._ignored = [target["ignored"] for target in targets]
        return super().select_training_samples(proposals, targets)

    def assign_targets_to_proposals(
        self, proposals: list[Tensor], gt_boxes: list[Tensor], gt_labels: list[Tensor]
    ) -> Any:
        matched, labels = super().assign_targets_to_proposals(proposals, gt_boxes, gt_labels)
        for label, proposal, ignored in zip(labels, proposals, self._ignored, strict=True):
            _leave_out(label, proposal, ignored)
        return matched, labels


def _leave_out(labels: Tensor, boxes_xyxy_px: Tensor, ignored_xyxy_px: Tensor) -> None:
    """Change the labels of background on what is ignored."""
    if len(ignored_xyxy_px):
        unsaid = inside(boxes_xyxy_px, ignored_xyxy_px) > _INSIDE_IGNORED
        labels[unsaid & (labels == 0)] = _NOTHING_SAID


@contextmanager
def _telling_losses(rcnn: Any) -> Iterator[None]:
    """Torchvision tells losses in training alone; batch normalisation stays as it is."""
    parts = (rcnn, rcnn.rpn, rcnn.roi_heads)
    before = [part.training for part in parts]
    for part in parts:
        part.training = True
    try:
        yield
    finally:
        for part, training in zip(parts, before, strict=True):
            part.training = training


def build(
    name: str,
    class_names: Sequence[str],
    *,
    weights: str = "",
    backbone: str = "resnet18",
    samples: int = _SAMPLES,
    smallest_anchor_px: float = _SMALLEST_PX,
) -> FasterRcnnDetector:
    """A Faster R-CNN.

    Args:
        name: ``"faster-rcnn"``.
        class_names: What it is to tell apart.
        weights: A ``.safetensors``, or a ``.pth`` with nothing but tensors, of torchvision's for
            any classes; empty: random weights.
        backbone: One of `BACKBONES`; ``"resnet50"`` is the one that torchvision publishes weights
            of.
        samples: Proposals of a picture that the second stage learns from, as published 512. On a
            CPU most of a step's time goes there.
        smallest_anchor_px: Side of the anchors of the finest level, each next one twice as large:
            32 as published; boats of 12 px want 8.

    Raises:
        InputError: A file or an option cannot be used.
    """
    if not class_names:
        raise InputError(f"{name}: needs the name of a class at least")
    detector = FasterRcnnDetector(name, class_names, backbone, samples, smallest_anchor_px)
    if weights:
        load_matching(detector.module, weights)
    return detector
