"""YOLOv3, YOLOv4 and their kin behind the seam of training."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from torch import Tensor, nn
from torchvision.ops import box_convert

from sightline.errors import InputError
from sightline.training.architecture import ExportInfo, Prediction, Target
from sightline.training.darknet.cfg import PUBLISHED, Network, published, read_cfg
from sightline.training.darknet.loss import YoloLoss
from sightline.training.darknet.module import DarknetModule, decode
from sightline.training.darknet.weights import read_pretrained, read_weights
from sightline.training.pretrained import load_matching
from sightline.training.suppression import predictions

_BOX_LOSSES = {"yolov3": "mse", "yolov4": "ciou"}
_BOX_WEIGHTS = {"mse": 1.0, "giou": 5.0, "ciou": 5.0}
"""Overlaps say little in numbers beside cross-entropies."""


class DarknetDetector:
    """A network of the Darknet family that can be trained; see `Trainable`."""

    def __init__(
        self,
        name: str,
        class_names: Sequence[str],
        network: Network,
        loss: YoloLoss | None = None,
    ) -> None:
        """Begin with random weights.

        Args:
            name: Of the family, or of its ``.cfg``.
            class_names: As many as the network has classes.
            network: What is to be built.
            loss: What is minimised; absent: YOLOv4's.
        """
        if len(class_names) != network.classes:
            raise InputError(
                f"{network.source}: tells {network.classes} classes apart, and "
                f"{len(class_names)} names were given"
            )
        self.name = name
        self.class_names = tuple(class_names)
        self.network = network
        self.stride = network.stride
        self.loss = loss if loss is not None else YoloLoss(box_weight=_BOX_WEIGHTS["ciou"])
        self._darknet = DarknetModule(network)
        self.module: nn.Module = self._darknet

    @property
    def darknet(self) -> DarknetModule:
        """The network, with what it can do besides being a module."""
        return self._darknet

    def losses(self, images: Tensor, targets: Sequence[Target]) -> dict[str, Tensor]:
        """The parts of the loss; see `Trainable`."""
        if any(head.new_coords for head in self.network.heads):
            raise InputError(
                f"{self.network.source}: has new_coords=1, and such networks are run and exported "
                "here, not trained"
            )
        return self.loss(self.module(images), self.network.heads, targets)

    def predict(self, images: Tensor, threshold: float) -> list[Prediction]:
        """What is in a batch; see `Trainable`."""
        found = decode([output.float() for output in self.module(images)], self.network.heads)
        boxes = box_convert(found[..., :4], "cxcywh", "xyxy")
        return predictions(boxes, found[..., 4:5] * found[..., 5:], threshold)

    def export_module(self) -> tuple[nn.Module, ExportInfo]:
        """The raw heads, as Darknet's exports have them; see `Trainable`."""
        heads = self.network.heads
        if any(head.new_coords for head in heads):
            return _Decoded(self._darknet).eval(), ExportInfo("yolov5", output_names=("output",))
        anchors = [[list(head.anchors_px[index]) for index in head.mask] for head in heads]
        return self._darknet.eval(), ExportInfo(
            "darknet",
            output_names=tuple(f"stride_{head.stride}" for head in heads),
            input_size_px=self.network.size_px,
            extra={"anchors": anchors, "scale_xy": [head.scale_x_y for head in heads]},
        )


class _Decoded(nn.Module):  # type: ignore[misc]
    """Boxes instead of raw heads."""

    def __init__(self, module: DarknetModule) -> None:
        super().__init__()
        self.module = module

    def forward(self, images: Tensor) -> Tensor:
        return decode(self.module(images), self.module.network.heads)


def build(
    name: str,
    class_names: Sequence[str],
    *,
    cfg: str = "",
    weights: str = "",
    box_loss: str = "",
    label_smoothing: float = 0.0,
) -> DarknetDetector:
    """A YOLOv3 or YOLOv4.

    Args:
        name: ``"yolov3"`` or ``"yolov4"``: which loss, and which network unless ``cfg`` says.
        class_names: What it is to tell apart.
        cfg: One of `PUBLISHED`, or a ``.cfg``; its classes are replaced.
        weights: A ``.weights`` for any classes, or of the first layers alone
            (``yolov4.conv.137``), or a ``.safetensors``; empty: random weights.
        box_loss: One of `BOX_LOSSES`; empty: that of the family.
        label_smoothing: See `YoloLoss`.

    Raises:
        InputError: A file or an option cannot be used.
    """
    if not class_names:
        raise InputError(f"{name}: needs the name of a class at least")
    what = cfg or name
    network = published(what) if what in PUBLISHED else read_cfg(what)
    network = network.with_classes(len(class_names))
    kind = box_loss or _BOX_LOSSES.get(name, "ciou")
    loss = YoloLoss(kind, label_smoothing=label_smoothing, box_weight=_BOX_WEIGHTS.get(kind, 1.0))
    detector = DarknetDetector(name, class_names, network, loss)
    if weights and Path(weights).suffix in (".safetensors", ".pt", ".pth"):
        load_matching(detector.module, weights)
    elif weights:
        detector.darknet.load(read_pretrained(weights, network))
    return detector


def from_files(
    cfg: str | os.PathLike[str],
    weights: str | os.PathLike[str],
    class_names: Sequence[str],
) -> DarknetDetector:
    """A network as somebody else trained it.

    Args:
        cfg: One of `PUBLISHED`, or a ``.cfg``.
        weights: The ``.weights`` that belongs to it.
        class_names: As many as the network has classes.

    Raises:
        InputError: A file cannot be used, or they do not fit each other.
    """
    network = published(str(cfg)) if str(cfg) in PUBLISHED else read_cfg(cfg)
    read = read_weights(weights, network)
    detector = DarknetDetector(Path(cfg).stem, class_names, network)
    detector.darknet.load(read)
    detector.module.eval()
    return detector
