"""The seam of training: a network that tells its losses, finds boxes, and can be exported."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from inspect import Parameter, signature
from typing import TYPE_CHECKING, Any, Protocol

from sightline import _optional
from sightline.errors import unknown_name

if TYPE_CHECKING:
    from torch import Tensor, nn

ARCHITECTURES = ("yolov3", "yolov4", "efficientdet-d0", "faster-rcnn", "harbour", "yolox-nano")
"""What `build` knows."""

_MODULES = {
    "yolov3": "sightline.training.darknet_family",
    "yolov4": "sightline.training.darknet_family",
    "efficientdet-d0": "sightline.training.efficientdet",
    "faster-rcnn": "sightline.training.faster_rcnn",
    "harbour": "sightline.training.harbour",
    "yolox-nano": "sightline.training.yolox",
}
"""Where each family lives. Such a module has ``build(name, class_names, **options)``."""


@dataclass(frozen=True)
class Target:
    """What is to be found in one picture.

    Attributes:
        boxes_xyxy_px: (M, 4) float32, corners in px of the picture.
        labels: (M,) int64, positions in ``class_names``.
        ignore: (M,) bool: something is there that was not labelled with care. Such a box is
            neither to be found nor wrong to find.
        worth: (M,) float32, the share of the full score that is taught; None: all of it. An
            architecture may pass it over.
    """

    boxes_xyxy_px: Tensor
    labels: Tensor
    ignore: Tensor
    worth: Tensor | None = None

    def to(self, device: Any) -> Target:
        """The same on another device."""
        return Target(
            self.boxes_xyxy_px.to(device),
            self.labels.to(device),
            self.ignore.to(device),
            None if self.worth is None else self.worth.to(device),
        )


@dataclass(frozen=True)
class Prediction:
    """What was found in one picture, after non-maximum suppression, the surest first.

    Attributes:
        boxes_xyxy_px: (K, 4) float32, corners in px of the picture.
        scores: (K,) float32, 0 to 1.
        labels: (K,) int64, positions in ``class_names``.
    """

    boxes_xyxy_px: Tensor
    scores: Tensor
    labels: Tensor


@dataclass(frozen=True)
class InputFormat:
    """How a picture is to be fed to an exported network.

    Attributes:
        color: ``"rgb"`` or ``"bgr"``.
        scale: What a byte is multiplied with.
        mean: Of each channel, after scaling; taken away.
        std: Of each channel, after scaling; divided by.
        pad: The byte that fills what a picture leaves of the input.
        stride: Width and height are a multiple of it.
    """

    color: str = "rgb"
    scale: float = 1.0 / 255.0
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    pad: int = 114
    stride: int = 32

    def to_dict(self) -> dict[str, object]:
        """As the metadata of an exported network has it."""
        return {
            "color": self.color,
            "scale": self.scale,
            "mean": list(self.mean),
            "std": list(self.std),
            "pad": self.pad,
            "stride": self.stride,
        }


@dataclass(frozen=True)
class ExportInfo:
    """What an exported network must say of itself.

    Attributes:
        decoder: The name of the decoder in `sightline.detection.decoders` that reads its outputs.
        input_names: Of the graph; the first is the picture, (B, 3, H, W).
        output_names: Of the graph.
        input_format: How a picture is fed.
        dynamic_batch: Whether B may be any number; else it is 1.
        dynamic_size: Whether H and W may be any multiple of the stride; else they are those of
            the picture that it is exported with.
        input_size_px: Width and height that it is exported with, or None: the training's.
        score_threshold: From where on a box counts, unless the user says otherwise.
        views: Where in the picture to search, for `sightline.detection`; empty: the whole frame.
        extra: More for the decoder.
    """

    decoder: str
    input_names: tuple[str, ...] = ("images",)
    output_names: tuple[str, ...] = ("output",)
    input_format: InputFormat = field(default_factory=InputFormat)
    dynamic_batch: bool = True
    dynamic_size: bool = True
    input_size_px: tuple[int, int] | None = None
    score_threshold: float = 0.3
    views: Mapping[str, Any] = field(default_factory=dict)
    extra: Mapping[str, Any] = field(default_factory=dict)


class Trainable(Protocol):
    """A network that the training loop can train, whatever its family.

    Attributes:
        name: One of `ARCHITECTURES`.
        class_names: What it tells apart.
        module: The network, with all that is learned; its ``state_dict`` is what is saved.
        stride: Widths and heights of pictures are multiples of it.
    """

    name: str
    class_names: tuple[str, ...]
    module: nn.Module
    stride: int

    def losses(self, images: Tensor, targets: Sequence[Target]) -> dict[str, Tensor]:
        """The parts of the loss of a batch; their sum is minimised.

        Args:
            images: (B, 3, H, W) float32, RGB, 0 to 1. Mean and deviation are the network's affair.
            targets: One a picture; pictures without anything are common.

        Returns:
            Scalars by name, all finite for pictures without boxes as well.
        """
        ...

    def predict(self, images: Tensor, threshold: float) -> list[Prediction]:
        """What is in a batch.

        The module must be in evaluation mode.

        Args:
            images: (B, 3, H, W) as for `losses`.
            threshold: Least score.

        Returns:
            One a picture.
        """
        ...

    def export_module(self) -> tuple[nn.Module, ExportInfo]:
        """A module to export, whose outputs a decoder of `sightline.detection` understands.

        It shares its weights with `module`, takes pictures as `ExportInfo.input_format` says, and
        is in evaluation mode.
        """
        ...


def build(name: str, class_names: Sequence[str], **options: Any) -> Trainable:
    """A new network of a family, with random or pretrained weights as the family has them.

    Args:
        name: One of `ARCHITECTURES`.
        class_names: What it is to tell apart.
        **options: Of the family; all are numbers, texts, booleans or lists of these.

    Raises:
        InputError: The name is none of them, an option is unknown, or the libraries of the extra
            ``train`` are not installed.
    """
    if name not in _MODULES:
        raise unknown_name("architecture", name, ARCHITECTURES)
    _optional.module("torch", "train")
    make: Callable[..., Trainable] = import_module(_MODULES[name]).build
    known = [
        parameter.name
        for parameter in signature(make).parameters.values()
        if parameter.kind is Parameter.KEYWORD_ONLY
    ]
    for option in options:
        if option not in known:
            raise unknown_name(f"option of {name}", option, known)
    return make(name, tuple(class_names), **options)
