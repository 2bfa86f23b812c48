"""From scored boxes to predictions, by every family in the same way."""

from __future__ import annotations

from torch import Tensor
from torchvision.ops import batched_nms

from sightline.training.architecture import Prediction

_MOST = 300


def predictions(
    boxes_xyxy_px: Tensor, scores: Tensor, threshold: float, *, overlap: float = 0.45
) -> list[Prediction]:
    """The boxes that remain of each picture, after non-maximum suppression within each class.

    Args:
        boxes_xyxy_px: (B, N, 4).
        scores: (B, N, C), 0 to 1.
        threshold: Least score.
        overlap: Intersection over union from where on the less sure of two boxes is left out.

    Returns:
        One a picture, with 300 boxes at most.
    """
    found = []
    for boxes, certain in zip(boxes_xyxy_px, scores, strict=True):
        index, label = (certain >= threshold).nonzero(as_tuple=True)
        score = certain[index, label]
        kept = batched_nms(boxes[index].float(), score.float(), label, overlap)[:_MOST]
        found.append(Prediction(boxes[index[kept]].float(), score[kept].float(), label[kept]))
    return found
