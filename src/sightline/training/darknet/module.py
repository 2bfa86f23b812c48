"""A Darknet network in PyTorch."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from sightline.training.darknet.cfg import (
    Convolutional,
    Dropout,
    Layer,
    MaxPool,
    Network,
    Route,
    Shortcut,
    Upsample,
    Yolo,
)
from sightline.training.darknet.weights import Floats, Header, LayerWeights, Weights

_EPSILON = 1e-5
"""Beside the variance, as in the implementation of YOLOv4. YOLOv3's first one added 1e-6 to the
deviation."""
_PRIOR = 0.01
"""How likely an untrained head takes any anchor for an object (Lin et al. 2017, section 4.1)."""

_ACTIVATIONS: dict[str, type[nn.Module]] = {
    "linear": nn.Identity,
    "mish": nn.Mish,
    "relu": nn.ReLU,
    "relu6": nn.ReLU6,
    "logistic": nn.Sigmoid,
    "swish": nn.SiLU,
}


def _activation(name: str) -> nn.Module:
    return nn.LeakyReLU(0.1) if name == "leaky" else _ACTIVATIONS[name]()


class _Convolution(nn.Module):  # type: ignore[misc]
    def __init__(self, layer: Convolutional) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(
            layer.inputs,
            layer.filters,
            layer.size,
            layer.stride,
            layer.padding,
            layer.dilation,
            layer.groups,
            bias=not layer.batch_normalize,
        )
        self.normalisation = (
            nn.BatchNorm2d(layer.filters, eps=_EPSILON) if layer.batch_normalize else None
        )
        self.activation = _activation(layer.activation)
        nn.init.kaiming_normal_(self.convolution.weight, a=0.1, nonlinearity="leaky_relu")
        if self.convolution.bias is not None:
            nn.init.zeros_(self.convolution.bias)

    def forward(self, images: Tensor) -> Tensor:
        out = self.convolution(images)
        if self.normalisation is not None:
            out = self.normalisation(out)
        activated: Tensor = self.activation(out)
        return activated

    def load(self, weights: LayerWeights) -> None:
        targets = [self.convolution.bias]
        if self.normalisation is not None:
            norm = self.normalisation
            targets = [norm.bias, norm.weight, norm.running_mean, norm.running_var]
        with torch.no_grad():
            for target, values in zip(
                [*targets, self.convolution.weight], weights.arrays, strict=True
            ):
                target.copy_(torch.from_numpy(np.array(values, dtype=np.float32)))

    def dump(self) -> LayerWeights:
        kernels = _array(self.convolution.weight)
        if self.normalisation is None:
            return LayerWeights(_array(self.convolution.bias), None, None, None, kernels)
        norm = self.normalisation
        return LayerWeights(
            _array(norm.bias),
            _array(norm.weight),
            _array(norm.running_mean),
            _array(norm.running_var),
            kernels,
        )


def _array(tensor: Tensor) -> Floats:
    return np.array(tensor.detach().cpu().numpy(), dtype=np.float32)


class _MaxPool(nn.Module):  # type: ignore[misc]
    def __init__(self, layer: MaxPool) -> None:
        super().__init__()
        less, more = layer.padding // 2, layer.padding - layer.padding // 2
        self._even = less == more and 2 * less <= layer.size
        self._pad = (less, more, less, more)
        self._pool = nn.MaxPool2d(layer.size, layer.stride, less if self._even else 0)

    def forward(self, images: Tensor) -> Tensor:
        # What lies beyond the picture is never the greatest.
        if not self._even:
            images = functional.pad(images, self._pad, value=torch.finfo(images.dtype).min)
        pooled: Tensor = self._pool(images)
        return pooled


class _Upsample(nn.Module):  # type: ignore[misc]
    def __init__(self, layer: Upsample) -> None:
        super().__init__()
        self._stride, self._scale = layer.stride, layer.scale

    def forward(self, images: Tensor) -> Tensor:
        larger: Tensor = functional.interpolate(
            images, scale_factor=float(self._stride), mode="nearest"
        )
        return larger if self._scale == 1.0 else larger * self._scale


class _Shortcut(nn.Module):  # type: ignore[misc]
    def __init__(self, layer: Shortcut) -> None:
        super().__init__()
        self.activation = _activation(layer.activation)

    def forward(self, before: Tensor, others: Sequence[Tensor]) -> Tensor:
        out = before
        for other in others:
            both = min(out.shape[1], other.shape[1])
            if both == out.shape[1]:
                out = out + other[:, :both]
            else:
                out = torch.cat([out[:, :both] + other[:, :both], out[:, both:]], dim=1)
        activated: Tensor = self.activation(out)
        return activated


class DarknetModule(nn.Module):  # type: ignore[misc]
    """A network as its ``.cfg`` has it."""

    def __init__(self, network: Network) -> None:
        """Begin with random weights.

        Args:
            network: What is to be built.
        """
        super().__init__()
        self.network = network
        self.layers = nn.ModuleList(_module(layer) for layer in network.layers)
        self._kept = frozenset(
            source
            for layer in network.layers
            if isinstance(layer, (Route, Shortcut))
            for source in layer.sources
        )
        for index in network.head_convolutions:
            self._set_prior(index)

    def _set_prior(self, index: int) -> None:
        """Let a head say at first that there is nothing, or the many cells drown all else."""
        head, convolution = self.network.layers[index + 1], self.layers[index]
        assert isinstance(head, Yolo)
        assert isinstance(convolution, _Convolution)
        bias = convolution.convolution.bias
        if bias is None or head.new_coords:
            return
        with torch.no_grad():
            nn.init.normal_(convolution.convolution.weight, std=0.01)
            bias.view(len(head.mask), -1)[:, 4] = math.log(_PRIOR / (1.0 - _PRIOR))

    def forward(self, images: Tensor) -> list[Tensor]:
        """What goes into each ``[yolo]``.

        Args:
            images: (B, 3, H, W) float, RGB, 0 to 1; H and W multiples of the network's stride.

        Returns:
            One a head: (B, anchors * (5 + classes), H / stride, W / stride).
        """
        kept: dict[int, Tensor] = {}
        heads: list[Tensor] = []
        out = images
        for index, (layer, module) in enumerate(zip(self.network.layers, self.layers, strict=True)):
            if isinstance(layer, Shortcut):
                out = module(out, [kept[source] for source in layer.sources])
            elif isinstance(layer, Route):
                parts = [_part(kept[source], layer) for source in layer.sources]
                out = torch.cat(parts, dim=1) if len(parts) > 1 else parts[0]
            elif isinstance(layer, Yolo):
                heads.append(out)
            else:
                out = module(out)
            if index in self._kept:
                kept[index] = out
        return heads

    def load(self, weights: Weights) -> None:
        """Take over weights, of those layers that there are some for."""
        for index, layer in weights.layers.items():
            module = self.layers[index]
            assert isinstance(module, _Convolution)
            module.load(layer)

    def dump(self, *, seen: int = 0) -> Weights:
        """All weights, as a ``.weights`` has them.

        Args:
            seen: Pictures that the network was trained on.
        """
        layers: dict[int, LayerWeights] = {}
        for index, _ in self.network.convolutions:
            module = self.layers[index]
            assert isinstance(module, _Convolution)
            layers[index] = module.dump()
        return Weights(Header(seen=seen), layers)


def _part(tensor: Tensor, layer: Route) -> Tensor:
    if layer.groups == 1:
        return tensor
    width = tensor.shape[1] // layer.groups
    return tensor[:, layer.group_id * width : (layer.group_id + 1) * width]


def _module(layer: Layer) -> nn.Module:
    if isinstance(layer, Convolutional):
        return _Convolution(layer)
    if isinstance(layer, MaxPool):
        return _MaxPool(layer)
    if isinstance(layer, Upsample):
        return _Upsample(layer)
    if isinstance(layer, Shortcut):
        return _Shortcut(layer)
    if isinstance(layer, Dropout):
        return nn.Dropout(layer.probability)
    return nn.Identity()


def split_head(output: Tensor, head: Yolo) -> Tensor:
    """What goes into a head, by anchor.

    Args:
        output: (B, A * (5 + C), rows, columns).
        head: Which.

    Returns:
        (B, A, rows, columns, 5 + C): x, y, width, height, objectness, classes, as they are.
    """
    batch, _, rows, columns = output.shape
    parts = output.reshape(batch, len(head.mask), 5 + head.classes, rows, columns)
    return parts.permute(0, 1, 3, 4, 2)


def decode_boxes(values: Tensor, head: Yolo) -> Tensor:
    """Boxes that a head says.

    A centre is the cell's corner plus a sigmoid, stretched about the middle of the cell by
    ``scale_x_y``; a side is the anchor's times an exponential (YOLOv3, section 2.1).

    Args:
        values: (B, A, rows, columns, 4 or more) as `split_head` gives them.
        head: Which.

    Returns:
        (B, A, rows, columns, 4): centre x and y, width and height in px of the input.
    """
    rows, columns = values.shape[2:4]
    like = {"dtype": values.dtype, "device": values.device}
    y, x = torch.meshgrid(torch.arange(rows, **like), torch.arange(columns, **like), indexing="ij")
    anchors = torch.tensor([head.anchors_px[index] for index in head.mask], **like)
    anchors = anchors.view(1, len(head.mask), 1, 1, 2)
    offset, size = values[..., 0:2], values[..., 2:4]
    if head.new_coords:
        size = (2.0 * size) ** 2 * anchors
    else:
        # An untrained network may say anything; e^20 anchors is more than any picture.
        offset, size = offset.sigmoid(), size.clamp(max=20.0).exp() * anchors
    offset = offset * head.scale_x_y - 0.5 * (head.scale_x_y - 1.0)
    centre = (offset + torch.stack([x, y], dim=-1)) * head.stride
    return torch.cat([centre, size], dim=-1)


def decode(outputs: Sequence[Tensor], heads: Sequence[Yolo]) -> Tensor:
    """What a network found.

    Args:
        outputs: As `DarknetModule` gives them.
        heads: Of the network.

    Returns:
        (B, N, 5 + C): centre x and y, width and height in px of the input, objectness and the
        probability of each class given that there is an object, all 0 to 1.
    """
    parts = []
    for output, head in zip(outputs, heads, strict=True):
        values = split_head(output, head)
        certain = values[..., 4:] if head.new_coords else values[..., 4:].sigmoid()
        found = torch.cat([decode_boxes(values, head), certain], dim=-1)
        parts.append(found.reshape(found.shape[0], -1, 5 + head.classes))
    return torch.cat(parts, dim=1)
