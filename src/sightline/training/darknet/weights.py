"""Darknet's ``.weights``: a short header, then every number of a network, float32.

The file does not say which network it belongs to, so nothing but the count of its numbers tells
whether it fits a ``.cfg``.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sightline.atomic import atomic_path
from sightline.errors import InputError
from sightline.training.darknet.cfg import Convolutional, Network

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Header:
    """The head of a file.

    Attributes:
        major: With ``minor``: of the format; from 0.2 on ``seen`` takes eight bytes.
        minor: See ``major``.
        revision: Of the format.
        seen: Pictures that the network was trained on.
    """

    major: int = 0
    minor: int = 2
    revision: int = 5
    seen: int = 0

    @property
    def _layout(self) -> str:
        # As Darknet asks: major * 10 + minor, where both are sane.
        long = self.major * 10 + self.minor >= 2 and self.major < 1000 and self.minor < 1000
        return "<q" if long else "<i"

    @property
    def size(self) -> int:
        """Bytes."""
        return 12 + struct.calcsize(self._layout)

    def pack(self) -> bytes:
        """As it stands in a file."""
        return struct.pack("<3i", self.major, self.minor, self.revision) + struct.pack(
            self._layout, self.seen
        )

    @classmethod
    def unpack(cls, content: bytes) -> Header:
        """From the beginning of a file, which must be long enough."""
        version = cls(*struct.unpack_from("<3i", content))
        (seen,) = struct.unpack_from(version._layout, content, 12)
        return cls(version.major, version.minor, version.revision, seen)


@dataclass(frozen=True)
class LayerWeights:
    """What a convolution has learned, in the order of the file.

    Attributes:
        biases: (F,); with batch normalisation: its shift.
        scales: (F,), of batch normalisation; absent without.
        means: (F,), of batch normalisation; absent without.
        variances: (F,), of batch normalisation; absent without.
        kernels: (F, C / groups, rows, columns).
    """

    biases: Floats
    scales: Floats | None
    means: Floats | None
    variances: Floats | None
    kernels: Floats

    @property
    def arrays(self) -> tuple[Floats, ...]:
        """All that is there, in the order of the file."""
        parts = (self.biases, self.scales, self.means, self.variances, self.kernels)
        return tuple(part for part in parts if part is not None)


@dataclass(frozen=True)
class Weights:
    """A file: its header, and what each convolution learned, by the layer's index."""

    header: Header
    layers: Mapping[int, LayerWeights] = field(repr=False)


def read_weights(path: str | os.PathLike[str], network: Network) -> Weights:
    """Read the weights of a network.

    Args:
        path: A ``.weights``.
        network: What it belongs to.

    Raises:
        InputError: The file cannot be read, or has not as many numbers as the network; says how
            many it has and how many it should have.
    """
    path = Path(path)
    header, values = _numbers(path)
    if len(values) != network.count:
        more = ""
        classes = _classes_of(len(values), network)
        if classes is not None:
            more = (
                f"; it would fit with classes={classes} in place of {network.classes}, and the "
                "filters before each [yolo] to match"
            )
        raise InputError(
            f"{path}: does not fit {network.source}: expected {network.count} numbers, found "
            f"{len(values)}{more}"
        )
    return Weights(header, _split(values, network, path))


def read_pretrained(path: str | os.PathLike[str], network: Network) -> Weights:
    """Read what can be used of weights for other classes, or for the first layers alone.

    Args:
        path: A ``.weights`` of the same network for any number of classes, of which all but the
            heads is used where the number is another; or the first N layers of it, which its name
            says as in ``darknet53.conv.74``.
        network: What is to begin with these weights.

    Raises:
        InputError: The file cannot be read, or is of another network.
    """
    path = Path(path)
    header, values = _numbers(path)
    first = re.search(r"\.conv\.(\d+)$", path.name)
    if first is not None:
        upto = int(first.group(1))
        wanted = {index: layer for index, layer in network.convolutions if index < upto}
        expected = sum(layer.count for layer in wanted.values())
        if not wanted or len(values) != expected:
            raise InputError(
                f"{path}: does not fit the first {upto} layers of {network.source}: expected "
                f"{expected} numbers, found {len(values)}"
            )
        layers = _split(values, network, path, upto)
        kept = {index for index in layers if index not in network.head_convolutions}
        return Weights(header, {index: layers[index] for index in kept})
    classes = _classes_of(len(values), network)
    if classes is None:
        raise InputError(
            f"{path}: is of another network than {network.source}, or of an unknown number of "
            f"classes: found {len(values)} numbers; expected {network.count} for "
            f"{network.classes} class{'es' * (network.classes != 1)}, and no other number of "
            "classes gives as many"
        )
    layers = _split(values, network.with_classes(classes), path)
    if classes != network.classes:
        layers = {i: layer for i, layer in layers.items() if i not in network.head_convolutions}
    return Weights(header, layers)


def write_weights(
    path: str | os.PathLike[str], weights: Weights, network: Network | None = None
) -> Path:
    """Write weights as Darknet reads them, whole or not at all.

    Args:
        path: Where.
        weights: Of every convolution.
        network: What they belong to, if they are to be held to it.

    Raises:
        InputError: The file cannot be written, or the weights are not those of the network.
    """
    if network is not None:
        wanted = {index: layer.weights_shape for index, layer in network.convolutions}
        given = {index: layer.kernels.shape for index, layer in weights.layers.items()}
        if wanted != given:
            raise InputError(f"{path}: not written; the weights are not those of {network.source}")
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(weights.header.pack())
        for index in sorted(weights.layers):
            for array in weights.layers[index].arrays:
                file.write(np.ascontiguousarray(array, dtype="<f4").tobytes())
    return Path(path)


def _numbers(path: Path) -> tuple[Header, Floats]:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    if len(content) < 20:
        raise InputError(f"{path}: is no Darknet .weights; it ends within its header")
    header = Header.unpack(content)
    body = len(content) - header.size
    if header.major < 0 or header.minor < 0 or header.major > 1000 or body % 4:
        raise InputError(
            f"{path}: is no Darknet .weights, or is cut off: behind its header there are {body} "
            "bytes, and each number takes 4"
            if body % 4
            else f"{path}: is no Darknet .weights; its header says version "
            f"{header.major}.{header.minor}"
        )
    return header, np.frombuffer(content, dtype="<f4", offset=header.size)


def _classes_of(count: int, network: Network) -> int | None:
    """For how many classes a network has so many numbers, if for any."""
    one, two = network.with_classes(1).count, network.with_classes(2).count
    classes, rest = divmod(count - one, two - one)
    return None if rest or classes < 0 else classes + 1


def _split(
    values: Floats, network: Network, path: Path, upto: int | None = None
) -> dict[int, LayerWeights]:
    layers: dict[int, LayerWeights] = {}
    at = 0
    for index, layer in network.convolutions:
        if upto is not None and index >= upto:
            break
        part = values[at : at + layer.count]
        if not np.isfinite(part).all():
            raise InputError(
                f"{path}: is damaged; layer {index} of {network.source} would have weights that "
                "are no finite numbers"
            )
        layers[index] = _layer(part, layer)
        at += layer.count
    return layers


def _layer(values: Floats, layer: Convolutional) -> LayerWeights:
    filters = layer.filters
    rows = 4 if layer.batch_normalize else 1
    vectors = values[: rows * filters].reshape(rows, filters)
    kernels = values[rows * filters :].reshape(layer.weights_shape)
    if not layer.batch_normalize:
        return LayerWeights(vectors[0], None, None, None, kernels)
    return LayerWeights(vectors[0], vectors[1], vectors[2], vectors[3], kernels)
