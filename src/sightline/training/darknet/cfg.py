"""Darknet's ``.cfg``: a network as a list of sections, read without running anything.

What changes the numbers that a network gives is either understood or refused; what only tells
Darknet how to train (``jitter``, ``learning_rate``, ...) is passed over.

The grammar is that of the implementation published with YOLOv4 (Bochkovskiy et al. 2020), which
YOLOv3's (Redmon and Farhadi 2018) is a part of.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path

from sightline.errors import InputError, unknown_name

PUBLISHED = ("yolov3", "yolov3-tiny", "yolov4", "yolov4-tiny")
"""The networks whose ``.cfg`` comes along, for the 80 classes of COCO."""

ACTIVATIONS = ("linear", "leaky", "mish", "relu", "relu6", "logistic", "swish")

_ALIASES = {"network": "net", "conv": "convolutional", "max": "maxpool"}

_LONGEST = 1_000_000
"""Bytes; the largest published file has 13 kB."""
_MOST_LAYERS = 2_000
_LARGEST = 65_536
"""Of any number that says a size, a count of channels or a side in px."""


@dataclass(frozen=True)
class Convolutional:
    """``[convolutional]``, with batch normalisation where the section says so.

    Attributes:
        line: Of the section, from 1.
        inputs: Channels that come in.
        filters: Channels that go out.
        size: Side of the kernel.
        stride: The same in both directions.
        padding: Zeros on each side.
        groups: Parts that the channels are split into; as many as channels: depthwise.
        dilation: Distance between the taps of the kernel.
        batch_normalize: Whether a batch normalisation takes the place of the bias.
        activation: One of `ACTIVATIONS`.
    """

    line: int
    inputs: int
    filters: int
    size: int = 1
    stride: int = 1
    padding: int = 0
    groups: int = 1
    dilation: int = 1
    batch_normalize: bool = False
    activation: str = "logistic"

    @property
    def weights_shape(self) -> tuple[int, int, int, int]:
        """Of the kernels: out, in of one group, rows, columns."""
        return self.filters, self.inputs // self.groups, self.size, self.size

    @property
    def count(self) -> int:
        """How many numbers a ``.weights`` holds for it."""
        out, into, rows, columns = self.weights_shape
        return out * (4 if self.batch_normalize else 1) + out * into * rows * columns


@dataclass(frozen=True)
class Shortcut:
    """``[shortcut]``: the output before it plus that of others.

    Attributes:
        line: Of the section.
        sources: Indices of the others. Where they have fewer or more channels, only the first
            that both have are added.
        activation: One of `ACTIVATIONS`.
    """

    line: int
    sources: tuple[int, ...]
    activation: str = "linear"


@dataclass(frozen=True)
class Route:
    """``[route]``: outputs of others, one after the other in channels.

    Attributes:
        line: Of the section.
        sources: Their indices.
        groups: Parts that the channels of each are split into.
        group_id: Which of these parts is taken.
    """

    line: int
    sources: tuple[int, ...]
    groups: int = 1
    group_id: int = 0


@dataclass(frozen=True)
class Upsample:
    """``[upsample]``: every pixel becomes ``stride`` x ``stride`` pixels, times ``scale``."""

    line: int
    stride: int = 2
    scale: float = 1.0


@dataclass(frozen=True)
class MaxPool:
    """``[maxpool]``.

    Attributes:
        line: Of the section.
        size: Side of the window.
        stride: Of the window.
        padding: Rows in all, the lesser half above and the rest below; the same for columns.
    """

    line: int
    size: int
    stride: int
    padding: int


@dataclass(frozen=True)
class Dropout:
    """``[dropout]``: does nothing but in training."""

    line: int
    probability: float = 0.5


@dataclass(frozen=True)
class Yolo:
    """``[yolo]``: the output before it says boxes, by cell and anchor.

    Attributes:
        line: Of the section.
        classes: How many classes.
        mask: Which anchors are this head's.
        anchors_px: Width and height of all anchors, in px of the network's input.
        scale_x_y: How far beyond its cell a centre may lie: 1 not at all, 2 half a cell.
        new_coords: Sides are squared and nothing is put through a sigmoid (Scaled-YOLOv4).
        ignore_thresh: In training, a box that overlaps an object more than this is no mistake.
        iou_thresh: In training, anchors as alike in shape as this to an object are its, besides
            the best one; 1: only the best.
        stride: Pixels of the input per cell.
    """

    line: int
    classes: int
    mask: tuple[int, ...]
    anchors_px: tuple[tuple[float, float], ...]
    scale_x_y: float = 1.0
    new_coords: bool = False
    ignore_thresh: float = 0.5
    iou_thresh: float = 1.0
    stride: int = 1

    @property
    def filters(self) -> int:
        """Channels that must come in: box, objectness and classes, for each anchor of the mask."""
        return len(self.mask) * (5 + self.classes)


Layer = Convolutional | Shortcut | Route | Upsample | MaxPool | Dropout | Yolo


@dataclass(frozen=True)
class Network:
    """A network as its ``.cfg`` has it.

    Attributes:
        source: Where it comes from, for messages.
        size_px: Width and height of the input for which it was made.
        layers: In order; an index counts from 0, ``[net]`` not among them.
        channels: Of each layer's output.
    """

    source: str
    size_px: tuple[int, int]
    layers: tuple[Layer, ...]
    channels: tuple[int, ...] = field(repr=False)

    @property
    def heads(self) -> tuple[Yolo, ...]:
        """The ``[yolo]`` layers, in order."""
        return tuple(layer for layer in self.layers if isinstance(layer, Yolo))

    @property
    def convolutions(self) -> tuple[tuple[int, Convolutional], ...]:
        """The layers that have weights, with their indices."""
        return tuple(
            (index, layer)
            for index, layer in enumerate(self.layers)
            if isinstance(layer, Convolutional)
        )

    @property
    def head_convolutions(self) -> frozenset[int]:
        """Indices of the convolutions whose channels are those of a head."""
        return frozenset(
            index - 1 for index, layer in enumerate(self.layers) if isinstance(layer, Yolo)
        )

    @property
    def classes(self) -> int:
        """How many classes all heads tell apart."""
        return self.heads[0].classes

    @property
    def stride(self) -> int:
        """Widths and heights of pictures are multiples of it."""
        return max(head.stride for head in self.heads)

    @property
    def count(self) -> int:
        """How many numbers a ``.weights`` holds for it."""
        return sum(layer.count for _, layer in self.convolutions)

    def with_classes(self, classes: int) -> Network:
        """The same for another number of classes.

        Args:
            classes: At least 1.
        """
        layers = list(self.layers)
        channels = list(self.channels)
        for index in self.head_convolutions:
            head, before = layers[index + 1], layers[index]
            assert isinstance(head, Yolo)
            assert isinstance(before, Convolutional)
            head = replace(head, classes=classes)
            layers[index] = replace(before, filters=head.filters)
            layers[index + 1] = head
            channels[index] = channels[index + 1] = head.filters
        return replace(self, layers=tuple(layers), channels=tuple(channels))


def published(name: str) -> Network:
    """A network of the YOLO family as published.

    Args:
        name: One of `PUBLISHED`.

    Raises:
        InputError: The name is none of them.
    """
    if name not in PUBLISHED:
        raise unknown_name("Darknet network", name, PUBLISHED)
    text = (resources.files(__package__) / "cfg" / f"{name}.cfg").read_text(encoding="utf-8")
    return parse(text, source=f"{name}.cfg")


def read_cfg(path: str | os.PathLike[str]) -> Network:
    """Read a ``.cfg``.

    Raises:
        InputError: The file cannot be read, or is no network that can be built; says where.
    """
    path = Path(path)
    try:
        content = path.read_bytes() if path.stat().st_size <= _LONGEST else None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    if content is None or b"\0" in content:
        raise InputError(f"{path}: is no Darknet .cfg, which is a text of some kilobytes")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        # Comments are in whatever their author wrote; options are ASCII.
        text = content.decode("latin-1")
    return parse(text, source=str(path))


def parse(text: str, *, source: str) -> Network:
    """A network from the text of its ``.cfg``.

    Args:
        text: Sections in brackets, ``option=value`` lines, comments behind ``#`` or ``;``.
        source: Where the text is from, for messages.

    Raises:
        InputError: A section is unknown, an option is out of place, or layers do not fit each
            other; one line that says where.
    """
    sections = _sections(text, source)
    if not sections or sections[0].kind != "net":
        raise InputError(f"{source}: does not begin with [net], so it is no Darknet .cfg")
    net = sections[0]
    net.refuse(_NET_REFUSED)
    width, height = net.integer("width"), net.integer("height")
    builder = _Builder(source, width, height, net.integer("channels", 3))
    if len(sections) - 1 > _MOST_LAYERS:
        raise InputError(f"{source}: has more than {_MOST_LAYERS} layers")
    for section in sections[1:]:
        builder.add(section)
    return builder.network()


def format_cfg(network: Network) -> str:
    """The text of a ``.cfg`` that `parse` reads as the same network."""
    width, height = network.size_px
    first = network.layers[0]
    inputs = first.inputs if isinstance(first, Convolutional) else 3
    lines = ["[net]", f"width={width}", f"height={height}", f"channels={inputs}"]
    for layer in network.layers:
        kind, options = _options(layer)
        lines += ["", f"[{kind}]", *(f"{key}={value}" for key, value in options.items())]
    return "\n".join(lines) + "\n"


def _options(layer: Layer) -> tuple[str, dict[str, object]]:
    if isinstance(layer, Convolutional):
        options: dict[str, object] = {"batch_normalize": 1} if layer.batch_normalize else {}
        options |= {"filters": layer.filters, "size": layer.size, "stride": layer.stride}
        options["padding"] = layer.padding // layer.dilation
        if layer.groups != 1:
            options["groups"] = layer.groups
        if layer.dilation != 1:
            options["dilation"] = layer.dilation
        return "convolutional", {**options, "activation": layer.activation}
    if isinstance(layer, Shortcut):
        return "shortcut", {"from": _list(layer.sources), "activation": layer.activation}
    if isinstance(layer, Route):
        parts = {"groups": layer.groups, "group_id": layer.group_id} if layer.groups > 1 else {}
        return "route", {"layers": _list(layer.sources), **parts}
    if isinstance(layer, Upsample):
        return "upsample", {"stride": layer.stride, "scale": layer.scale}
    if isinstance(layer, MaxPool):
        return "maxpool", {"size": layer.size, "stride": layer.stride, "padding": layer.padding}
    if isinstance(layer, Dropout):
        return "dropout", {"probability": layer.probability}
    return "yolo", {
        "mask": _list(layer.mask),
        "anchors": ", ".join(f"{width:g},{height:g}" for width, height in layer.anchors_px),
        "classes": layer.classes,
        "num": len(layer.anchors_px),
        "scale_x_y": layer.scale_x_y,
        "new_coords": int(layer.new_coords),
        "ignore_thresh": layer.ignore_thresh,
        "iou_thresh": layer.iou_thresh,
    }


def _list(values: tuple[int, ...]) -> str:
    return ",".join(str(value) for value in values)


# Options that change what comes out, by the values at which they do not.
_NET_REFUSED: Mapping[str, tuple[str, ...]] = {"letter_box": ("0", "1")}
_CONVOLUTIONAL_REFUSED: Mapping[str, tuple[str, ...]] = {
    "antialiasing": ("0",),
    "assisted_excitation": ("0",),
    "binary": ("0",),
    "bin_output": ("0",),
    "coordconv": ("0",),
    "deform": ("0",),
    "flipped": ("0",),
    "grad_centr": ("0", "1"),
    "rotate": ("0",),
    "share_index": ("-1000000000",),
    "stretch": ("0",),
    "stretch_sway": ("0",),
    "sway": ("0",),
    "xnor": ("0",),
}
_SHORTCUT_REFUSED: Mapping[str, tuple[str, ...]] = {"weights_type": ("none",)}
_ROUTE_REFUSED: Mapping[str, tuple[str, ...]] = {"stream": ("0",)}
_MAXPOOL_REFUSED: Mapping[str, tuple[str, ...]] = {
    "antialiasing": ("0",),
    "maxpool_depth": ("0",),
}
_YOLO_REFUSED: Mapping[str, tuple[str, ...]] = {"embedding_layer": ("999999",)}


@dataclass(frozen=True)
class _Section:
    kind: str
    line: int
    source: str
    options: dict[str, str]

    def wrong(self, what: str) -> InputError:
        return InputError(f"{self.source}, line {self.line}, [{self.kind}]: {what}")

    def refuse(self, neutral: Mapping[str, tuple[str, ...]]) -> None:
        for name, values in neutral.items():
            if self.options.get(name, values[0]) not in values:
                raise self.wrong(f"{name}={self.options[name]} is not supported")

    def integer(self, name: str, default: int | None = None, *, least: int = 1) -> int:
        text = self.options.get(name)
        if text is None:
            if default is None:
                raise self.wrong(f"has no {name}")
            return default
        return self._integer(name, text, least)

    def integers(self, name: str, *, least: int) -> tuple[int, ...]:
        text = self.options.get(name)
        if text is None:
            raise self.wrong(f"has no {name}")
        return tuple(self._integer(name, part, least) for part in _parts(text))

    def _integer(self, name: str, text: str, least: int) -> int:
        try:
            value = int(text)
        except ValueError:
            raise self.wrong(f"{name}={text} is no whole number") from None
        if not least <= value <= _LARGEST:
            raise self.wrong(f"{name}={text} must lie between {least} and {_LARGEST}")
        return value

    def number(self, name: str, default: float) -> float:
        return self.numbers(name, (default,))[0]

    def numbers(self, name: str, default: tuple[float, ...]) -> tuple[float, ...]:
        text = self.options.get(name)
        if text is None:
            return default
        try:
            values = tuple(float(part) for part in _parts(text))
        except ValueError:
            raise self.wrong(f"{name}={text} is no number") from None
        if not values or not all(0.0 <= value <= _LARGEST for value in values):
            raise self.wrong(f"{name}={text} must lie between 0 and {_LARGEST}")
        return values

    def activation(self, default: str) -> str:
        name = self.options.get("activation", default)
        if name not in ACTIVATIONS:
            raise self.wrong(str(unknown_name("activation", name, ACTIVATIONS)))
        return name

    def stride(self, default: int) -> int:
        stride = self.integer("stride", default)
        sides = {self.integer(f"stride_{side}", stride) for side in "xy"}
        if len(sides) > 1:
            raise self.wrong("stride_x and stride_y differ, which is not supported")
        return sides.pop()


def _parts(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]


def _sections(text: str, source: str) -> list[_Section]:
    sections: list[_Section] = []
    for number, raw in enumerate(text.splitlines(), start=1):
        # Darknet takes whole lines for comments only, yet nothing that it knows has a # or ; in it.
        line = raw.split("#", 1)[0].split(";", 1)[0].strip()
        if not line:
            continue
        if line.startswith("["):
            if not line.endswith("]"):
                raise InputError(f"{source}, line {number}: {line} lacks its closing bracket")
            kind = line[1:-1].strip().lower()
            sections.append(_Section(_ALIASES.get(kind, kind), number, source, {}))
            continue
        name, equals, value = line.partition("=")
        if not equals:
            raise InputError(
                f"{source}, line {number}: {line[:60]!r} is neither a [section] nor option=value"
            )
        if not sections:
            raise InputError(f"{source}, line {number}: {name.strip()} stands before any [section]")
        sections[-1].options[name.strip().lower()] = value.strip()
    return sections


class _Builder:
    """Layers one after the other, with the shapes of what comes out of each."""

    def __init__(self, source: str, width: int, height: int, channels: int) -> None:
        self._source = source
        self._input = (channels, height, width)
        self._layers: list[Layer] = []
        self._shapes: list[tuple[int, int, int]] = []

    def add(self, section: _Section) -> None:
        if section.kind not in _KINDS:
            known = ", ".join(f"[{kind}]" for kind in _KINDS)
            raise InputError(
                f"{self._source}, line {section.line}: unknown section [{section.kind}]; "
                f"known are [net], {known}"
            )
        layer, shape = _KINDS[section.kind](self, section)
        if min(shape) < 1:
            raise section.wrong("nothing is left of a picture here; width or height is too small")
        self._layers.append(layer)
        self._shapes.append(shape)

    def network(self) -> Network:
        heads = [layer for layer in self._layers if isinstance(layer, Yolo)]
        if not heads:
            raise InputError(f"{self._source}: has no [yolo] section, so it is no detector")
        for head in heads:
            if head.classes != heads[0].classes:
                raise InputError(
                    f"{self._source}, line {head.line}, [yolo]: has {head.classes} classes, but "
                    f"the one in line {heads[0].line} has {heads[0].classes}"
                )
        _, height, width = self._input
        return Network(
            self._source,
            (width, height),
            tuple(self._layers),
            tuple(channels for channels, _, _ in self._shapes),
        )

    @property
    def _before(self) -> tuple[int, int, int]:
        return self._shapes[-1] if self._shapes else self._input

    def convolutional(self, section: _Section) -> tuple[Layer, tuple[int, int, int]]:
        section.refuse(_CONVOLUTIONAL_REFUSED)
        channels, height, width = self._before
        size, stride = section.integer("size", 1), section.stride(1)
        dilation = section.integer("dilation", 1)
        padding = section.integer("padding", 0, least=0)
        if section.integer("pad", 0, least=0):
            padding = size // 2
        padding *= dilation
        groups = section.integer("groups", 1)
        filters = section.integer("filters", 1)
        if channels % groups or filters % groups:
            raise section.wrong(
                f"{channels} channels that come in and {filters} filters cannot be split into "
                f"{groups} groups"
            )
        reach = dilation * (size - 1) + 1
        layer = Convolutional(
            section.line,
            channels,
            filters,
            size,
            stride,
            padding,
            groups,
            dilation,
            bool(section.integer("batch_normalize", 0, least=0)),
            section.activation("logistic"),
        )
        rows, columns = ((side + 2 * padding - reach) // stride + 1 for side in (height, width))
        return layer, (filters, rows, columns)

    def shortcut(self, section: _Section) -> tuple[Layer, tuple[int, int, int]]:
        section.refuse(_SHORTCUT_REFUSED)
        sources = self._sources(section, "from")
        _, height, width = self._before
        for source in sources:
            if self._shapes[source][1:] != (height, width):
                raise section.wrong(
                    f"layer {source} gives {_side(self._shapes[source])}, and the layer before "
                    f"{_side(self._before)}; they cannot be added"
                )
        return Shortcut(section.line, sources, section.activation("linear")), self._before

    def route(self, section: _Section) -> tuple[Layer, tuple[int, int, int]]:
        section.refuse(_ROUTE_REFUSED)
        sources = self._sources(section, "layers")
        groups = section.integer("groups", 1)
        group_id = section.integer("group_id", 0, least=0)
        if group_id >= groups:
            raise section.wrong(f"group_id={group_id} must be less than groups={groups}")
        _, height, width = self._shapes[sources[0]]
        channels = 0
        for source in sources:
            if self._shapes[source][1:] != (height, width):
                raise section.wrong(
                    f"layer {source} gives {_side(self._shapes[source])}, and layer {sources[0]} "
                    f"{_side(self._shapes[sources[0]])}; they cannot be joined"
                )
            if self._shapes[source][0] % groups:
                raise section.wrong(
                    f"the {self._shapes[source][0]} channels of layer {source} cannot be split "
                    f"into {groups} groups"
                )
            channels += self._shapes[source][0] // groups
        return Route(section.line, sources, groups, group_id), (channels, height, width)

    def upsample(self, section: _Section) -> tuple[Layer, tuple[int, int, int]]:
        channels, height, width = self._before
        stride = section.integer("stride", 2)
        layer = Upsample(section.line, stride, section.number("scale", 1.0))
        return layer, (channels, stride * height, stride * width)

    def maxpool(self, section: _Section) -> tuple[Layer, tuple[int, int, int]]:
        section.refuse(_MAXPOOL_REFUSED)
        channels, height, width = self._before
        stride = section.stride(1)
        size = section.integer("size", stride)
        padding = section.integer("padding", size - 1, least=0)
        if padding - padding // 2 >= size:
            raise section.wrong(f"padding={padding} leaves windows of size {size} without a pixel")
        rows, columns = ((side + padding - size) // stride + 1 for side in (height, width))
        return MaxPool(section.line, size, stride, padding), (channels, rows, columns)

    def dropout(self, section: _Section) -> tuple[Layer, tuple[int, int, int]]:
        probability = section.number("probability", 0.5)
        if probability >= 1.0:
            raise section.wrong(f"probability={probability:g} must be less than 1")
        return Dropout(section.line, probability), self._before

    def yolo(self, section: _Section) -> tuple[Layer, tuple[int, int, int]]:
        section.refuse(_YOLO_REFUSED)
        channels, height, width = self._before
        if not self._layers or not isinstance(self._layers[-1], Convolutional):
            raise section.wrong("must stand behind a [convolutional]")
        sides = section.numbers("anchors", ())
        if not sides or len(sides) % 2:
            raise section.wrong("anchors must be pairs of width and height in px")
        anchors = tuple(zip(sides[::2], sides[1::2], strict=True))
        if min(sides) <= 0.0:
            raise section.wrong("anchors must be wider and higher than 0")
        if "mask" in section.options:
            mask = section.integers("mask", least=0)
        else:
            mask = tuple(range(len(anchors)))
        if not mask or max(mask) >= len(anchors):
            raise section.wrong(f"mask names anchors beyond the {len(anchors)} that there are")
        classes = section.integer("classes", 20)
        _, full_height, full_width = self._input
        stride = full_width // width
        if (stride * width, stride * height) != (full_width, full_height):
            raise section.wrong(
                f"its {width} x {height} cells do not fill the {full_width} x {full_height} px of "
                "[net]; width and height must be multiples of the largest stride"
            )
        layer = Yolo(
            section.line,
            classes,
            mask,
            anchors,
            section.number("scale_x_y", 1.0),
            bool(section.integer("new_coords", 0, least=0)),
            section.number("ignore_thresh", 0.5),
            section.number("iou_thresh", 1.0),
            stride,
        )
        if channels != layer.filters:
            raise section.wrong(
                f"{len(mask)} anchors and {classes} classes need {layer.filters} filters in the "
                f"[convolutional] before, which has {channels}"
            )
        return layer, self._before

    def _sources(self, section: _Section, name: str) -> tuple[int, ...]:
        sources = []
        here = len(self._layers)
        for given in section.integers(name, least=-_LARGEST):
            source = given + here if given < 0 else given
            if not 0 <= source < here:
                raise section.wrong(
                    f"{name}={given} leads to no layer before it; this is layer {here}"
                )
            sources.append(source)
        if not sources:
            raise section.wrong(f"has no {name}")
        return tuple(sources)


def _side(shape: tuple[int, int, int]) -> str:
    return f"{shape[2]} x {shape[1]}"


_Add = Callable[[_Builder, _Section], tuple[Layer, tuple[int, int, int]]]
_KINDS: Mapping[str, _Add] = {
    "convolutional": _Builder.convolutional,
    "shortcut": _Builder.shortcut,
    "route": _Builder.route,
    "upsample": _Builder.upsample,
    "maxpool": _Builder.maxpool,
    "dropout": _Builder.dropout,
    "yolo": _Builder.yolo,
}
