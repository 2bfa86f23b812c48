"""What YOLOv3 and YOLOv4 minimise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional
from torchvision.ops import (
    box_convert,
    box_iou,
    complete_box_iou_loss,
    generalized_box_iou_loss,
)

from sightline.errors import InputError, unknown_name
from sightline.training.architecture import Target
from sightline.training.darknet.cfg import Yolo
from sightline.training.darknet.module import decode_boxes, split_head

BOX_LOSSES = ("mse", "giou", "ciou")

_INSIDE_IGNORED = 0.5
"""Of a box that is found, in one that was not labelled with care, from where on nothing is said."""


@dataclass(frozen=True)
class YoloLoss:
    """The settings of a loss.

    The sums over anchors and cells are divided by the number of anchors that have an object, or of
    pictures where that is larger, so that they do not depend on the size of a batch. Darknet
    divides by pictures alone.

    Attributes:
        box: ``"mse"``: cross-entropy of the centre's place in its cell and squared error of the
            sides' logarithms, small boxes weighing up to twice as much (YOLOv3); ``"giou"``:
            Rezatofighi et al. 2019; ``"ciou"``: Zheng et al. 2020 (YOLOv4).
        label_smoothing: Share of certainty taken from the classes, 0 to 1.
        box_weight: Of the box's part of the sum.
        objectness_weight: Of the objectness's part.
        class_weight: Of the classes' part.
    """

    box: str = "ciou"
    label_smoothing: float = 0.0
    box_weight: float = 1.0
    objectness_weight: float = 1.0
    class_weight: float = 1.0

    def __post_init__(self) -> None:
        if self.box not in BOX_LOSSES:
            raise unknown_name("box loss", self.box, BOX_LOSSES)
        if not 0.0 <= self.label_smoothing < 1.0:
            raise InputError(
                f"label smoothing must be at least 0 and less than 1, got {self.label_smoothing:g}"
            )

    def __call__(
        self, outputs: Sequence[Tensor], heads: Sequence[Yolo], targets: Sequence[Target]
    ) -> dict[str, Tensor]:
        """The parts of the loss.

        Args:
            outputs: Of the network, as `DarknetModule` gives them.
            heads: Of the network.
            targets: One a picture.

        Returns:
            ``box``, ``objectness``, ``classification``: scalars, to be added.
        """
        area_px2 = float(outputs[0].shape[2] * outputs[0].shape[3] * heads[0].stride ** 2)
        truth = _Truth.of(targets, heads[0].anchors_px, area_px2)
        parts = [
            self._of_head(output.float(), head, truth)
            for output, head in zip(outputs, heads, strict=True)
        ]
        positives = sum(part[3] for part in parts)
        divisor = float(max(positives, len(targets), 1))
        box, objectness, classes = (
            torch.stack([part[index] for part in parts]).sum() / divisor for index in range(3)
        )
        return {
            "box": self.box_weight * box,
            "objectness": self.objectness_weight * objectness,
            "classification": self.class_weight * classes,
        }

    def _of_head(
        self, output: Tensor, head: Yolo, truth: _Truth
    ) -> tuple[Tensor, Tensor, Tensor, int]:
        values = split_head(output, head)
        rows, columns = values.shape[2:4]
        found = decode_boxes(values, head)
        image, anchor, index = truth.assigned(head)
        row, column = truth.cells(index, head.stride, rows, columns)

        # Not zeros_like: that would lie in memory as the output does, and have no flat view.
        wanted = torch.zeros(values.shape[:4], device=values.device)
        wanted[image, anchor, row, column] = 1.0
        counted = torch.ones(values.shape[:4], device=values.device)
        with torch.no_grad():
            corners = box_convert(found.detach(), "cxcywh", "xyxy")
            for number in range(len(values)):
                passed = truth.passed_over(number, corners[number].reshape(-1, 4), head)
                counted[number].view(-1)[passed] = 0.0
        counted[image, anchor, row, column] = 1.0
        objectness = functional.binary_cross_entropy_with_logits(
            values[..., 4], wanted, counted, reduction="sum"
        )

        chosen = values[image, anchor, row, column]
        if self.box == "mse":
            box = _squared(chosen, anchor, index, head, truth).sum()
        else:
            loss = generalized_box_iou_loss if self.box == "giou" else complete_box_iou_loss
            corners = box_convert(found[image, anchor, row, column], "cxcywh", "xyxy")
            box = loss(corners, truth.boxes_xyxy_px[index], reduction="sum")
        classes = functional.one_hot(truth.labels[index], head.classes).to(chosen.dtype)
        # Each class is a question of its own, so certainty is taken from yes and no alike.
        classes = classes * (1.0 - self.label_smoothing) + 0.5 * self.label_smoothing
        classification = functional.binary_cross_entropy_with_logits(
            chosen[:, 5:], classes, reduction="sum"
        )
        return box, objectness, classification, len(index)


def _squared(chosen: Tensor, anchor: Tensor, index: Tensor, head: Yolo, truth: _Truth) -> Tensor:
    """(P,) how far what was said of boxes is from what should be, as in YOLOv3."""
    centre, size = truth.centres_px[index] / head.stride, truth.sizes_px[index]
    # What decoding does is undone: the stretch about the middle of the cell, and the anchor.
    inside_cell = (centre - centre.floor() - 0.5) / head.scale_x_y + 0.5
    place = functional.binary_cross_entropy_with_logits(
        chosen[:, :2], inside_cell, reduction="none"
    )
    anchors_px = size.new_tensor([head.anchors_px[number] for number in head.mask])
    sides = (size / anchors_px[anchor]).log()
    error = place.sum(dim=1) + 0.5 * ((chosen[:, 2:4] - sides) ** 2).sum(dim=1)
    return truth.small_box_weights[index] * error


@dataclass(frozen=True)
class _Truth:
    """All objects of a batch, and which anchors are to find them."""

    images: Tensor
    labels: Tensor
    boxes_xyxy_px: Tensor
    overlaps: Tensor
    best: Tensor
    ignored: Sequence[Tensor]
    area_px2: float

    @classmethod
    def of(
        cls,
        targets: Sequence[Target],
        anchors_px: Sequence[tuple[float, float]],
        area_px2: float,
    ) -> _Truth:
        device = targets[0].boxes_xyxy_px.device
        kept = [~target.ignore for target in targets]
        boxes = torch.cat(
            [target.boxes_xyxy_px[keep] for target, keep in zip(targets, kept, strict=True)]
        ).float()
        labels = torch.cat(
            [target.labels[keep] for target, keep in zip(targets, kept, strict=True)]
        )
        images = torch.cat(
            [
                torch.full((int(keep.sum()),), number, dtype=torch.int64, device=device)
                for number, keep in enumerate(kept)
            ]
        )
        anchors = torch.tensor(anchors_px, dtype=torch.float32, device=device)
        # Shapes alone are compared: as if both had the same upper left corner.
        sizes = boxes[:, 2:] - boxes[:, :2]
        solid = (sizes > 0.0).all(dim=1)
        boxes, labels, images, sizes = boxes[solid], labels[solid], images[solid], sizes[solid]
        overlaps = box_iou(
            torch.cat([torch.zeros_like(sizes), sizes], dim=1),
            torch.cat([torch.zeros_like(anchors), anchors], dim=1),
        )
        return cls(
            images,
            labels,
            boxes,
            overlaps,
            overlaps.argmax(dim=1),
            [target.boxes_xyxy_px[target.ignore].float() for target in targets],
            area_px2,
        )

    @property
    def sizes_px(self) -> Tensor:
        return self.boxes_xyxy_px[:, 2:] - self.boxes_xyxy_px[:, :2]

    @property
    def centres_px(self) -> Tensor:
        return 0.5 * (self.boxes_xyxy_px[:, 2:] + self.boxes_xyxy_px[:, :2])

    @property
    def small_box_weights(self) -> Tensor:
        """(M,) 2 for a point, 1 for a box as large as the picture."""
        return 2.0 - (self.sizes_px.prod(dim=1) / self.area_px2).clamp(max=1.0)

    def assigned(self, head: Yolo) -> tuple[Tensor, Tensor, Tensor]:
        """Which anchors of a head are to find which objects.

        Returns:
            Of each pair: (P,) the picture, (P,) the anchor's place in the mask, (P,) the object.
        """
        mask = torch.tensor(head.mask, device=self.best.device)
        fits = self.best[:, None] == mask[None, :]
        if head.iou_thresh < 1.0:
            fits = fits | (self.overlaps[:, mask] > head.iou_thresh)
        index, anchor = fits.nonzero(as_tuple=True)
        return self.images[index], anchor, index

    def cells(self, index: Tensor, stride: int, rows: int, columns: int) -> tuple[Tensor, Tensor]:
        """Row and column of the cell in which the centre of each object lies."""
        cell = (self.centres_px[index] / stride).long()
        return cell[:, 1].clamp(0, rows - 1), cell[:, 0].clamp(0, columns - 1)

    def passed_over(self, image: int, found_xyxy_px: Tensor, head: Yolo) -> Tensor:
        """(N,) whether a box that was found is neither right nor wrong."""
        boxes = self.boxes_xyxy_px[self.images == image]
        passed = torch.zeros(len(found_xyxy_px), dtype=torch.bool, device=found_xyxy_px.device)
        if len(boxes):
            passed |= (box_iou(found_xyxy_px, boxes) > head.ignore_thresh).any(dim=1)
        if len(self.ignored[image]):
            passed |= inside(found_xyxy_px, self.ignored[image]) > _INSIDE_IGNORED
        return passed


def inside(boxes_xyxy_px: Tensor, others_xyxy_px: Tensor) -> Tensor:
    """The largest share of each box that lies in one of the others.

    Args:
        boxes_xyxy_px: (N, 4).
        others_xyxy_px: (M, 4), at least one.

    Returns:
        (N,) 0 to 1.
    """
    low = torch.maximum(boxes_xyxy_px[:, None, :2], others_xyxy_px[None, :, :2])
    high = torch.minimum(boxes_xyxy_px[:, None, 2:], others_xyxy_px[None, :, 2:])
    common = (high - low).clamp(min=0.0).prod(dim=2)
    area = (boxes_xyxy_px[:, 2:] - boxes_xyxy_px[:, :2]).clamp(min=1e-6).prod(dim=1)
    return (common / area[:, None]).amax(dim=1)
