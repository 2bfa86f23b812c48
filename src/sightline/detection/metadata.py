"""Metadata of the detector in an ONNX file.

Files that `sightline` exports carry a JSON object under ``metadata_props["sightline"]``. Those of
Ultralytics carry the names of their classes; others say nothing.
"""

from __future__ import annotations

import ast
import json
from collections.abc import Mapping
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from sightline.detection.tiling import TilingSettings
from sightline.errors import InputError
from sightline.types import FloatArray

KEY = "sightline"
"""The key of the metadata under which the JSON object lies."""

FORMAT = 1
"""The newest version of the object that can be read, and the one that is written."""

_LONGEST_NAMES = 100_000

Three = tuple[float, float, float]
Pixels = Annotated[int, Field(gt=0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, allow_inf_nan=False)


class InputFormat(_Table):
    """Input format of a network: ``(pixel * scale - mean) / std``.

    Attributes:
        color: Order of the channels.
        scale: Times the pixel, 0 to 255.
        mean: Of each channel, in that order, after scaling.
        std: Of each channel.
        pad: Grey value of the padding, before scaling.
        size: Width and height; None: any multiple of the stride.
        stride: Of which width and height are multiples.
        centred: Whether padding goes to both sides, or to the right and below.
    """

    color: Literal["rgb", "bgr"] = "rgb"
    scale: Annotated[float, Field(gt=0.0)] = 1.0 / 255.0
    mean: Three = (0.0, 0.0, 0.0)
    std: tuple[
        Annotated[float, Field(gt=0.0)],
        Annotated[float, Field(gt=0.0)],
        Annotated[float, Field(gt=0.0)],
    ] = (1.0, 1.0, 1.0)
    pad: Annotated[int, Field(ge=0, le=255)] = 114
    size: tuple[Pixels, Pixels] | None = None
    stride: Pixels = 32
    centred: bool = False


class LowerEdge(_Table):
    """Measured lower-edge bias of a detector.

    Attributes:
        px: Pixels by which boxes end below the waterline; negative where they end above it.
        share: And this share of the height of what is seen of the boat.
        spread_px: Standard deviation, from one place and day to another.
    """

    px: float
    share: float = 0.0
    spread_px: Annotated[float, Field(gt=0.0)] = 1.0

    def hull_px(self, box_height_px: FloatArray) -> FloatArray:
        """Heights of boats from heights of boxes, the bias being the same above as below."""
        return np.maximum((box_height_px - 2.0 * self.px) / (1.0 + 2.0 * self.share), 0.0)


class DetectorMetadata(_Table):
    """Metadata of a detector in a file of this project; unknown keys are ignored.

    Attributes:
        format: Version of this object.
        decoder: Name of the decoder of its outputs.
        classes: Names, in the order of the outputs.
        default_classes: Those that are looked for when nobody says which; None: all.
        input: What the network wants to be shown.
        anchors: Width and height, px of the input, of each anchor of each output; for Darknet's
            raw heads.
        scale_xy: Of each output, how far centres may leave their cell (Darknet's ``scale_x_y``);
            None: 1.
        score_threshold: Least confidence of a box; None: the usual one.
        views: Tiles of a frame; None: the usual ones.
        lower_edge: Its lower-edge bias; None: not measured.
        class_lower_edges: Lower-edge biases of classes whose boxes end elsewhere than the others';
            each is a source of its own, see `source_of`.
        calibration: Scores of the network, and the probability that a box of that score is right,
            both rising from 0 to 1: its confidence, linear between them. None: the score.
    """

    format: int = FORMAT
    decoder: str
    classes: Annotated[tuple[str, ...], Field(min_length=1)]
    default_classes: tuple[str, ...] | None = None
    input: InputFormat = InputFormat()
    anchors: tuple[tuple[tuple[float, float], ...], ...] | None = None
    scale_xy: tuple[float, ...] | None = None
    score_threshold: Share | None = None
    views: TilingSettings | None = None
    lower_edge: LowerEdge | None = None
    class_lower_edges: Mapping[str, LowerEdge] | None = None
    calibration: Annotated[tuple[tuple[Share, Share], ...], Field(min_length=2)] | None = None

    @model_validator(mode="after")
    def _known_defaults(self) -> DetectorMetadata:
        for name in self.default_classes or ():
            if name not in self.classes:
                raise ValueError(f"default_classes names {name!r}, which is no class")
        for name in self.class_lower_edges or {}:
            if name not in self.classes:
                raise ValueError(f"class_lower_edges names {name!r}, which is no class")
        if self.calibration is not None:
            scores, shares = np.array(self.calibration).T
            if not (np.diff(scores) > 0.0).all() or not (np.diff(shares) >= 0.0).all():
                raise ValueError("calibration does not rise")
        return self

    def source_of(self, detector: str, label: str) -> str:
        """Source of the boxes of a class: the detector, or ``DETECTOR/CLASS``."""
        return f"{detector}/{label}" if label in (self.class_lower_edges or {}) else detector

    def to_json(self) -> str:
        """The value of ``metadata_props["sightline"]``."""
        return self.model_dump_json(exclude_none=True)


def read_metadata(where: str, properties: Mapping[str, str]) -> DetectorMetadata | None:
    """Read a file's metadata; None for files of others.

    Args:
        where: The file, for messages.
        properties: All that stands in the file's metadata.

    Raises:
        InputError: It is of a newer version, or damaged.
    """
    text = properties.get(KEY)
    if text is None:
        return None
    try:
        version = json.loads(text).get("format", FORMAT)
    except (ValueError, AttributeError, RecursionError) as error:
        raise InputError(
            f"{where}: what it says of its detector is no JSON object; export the file again"
        ) from error
    if isinstance(version, int) and version > FORMAT:
        raise InputError(
            f"{where}: describes its detector in version {version}, and this sightline reads "
            f"versions up to {FORMAT}; install a newer sightline"
        )
    try:
        return DetectorMetadata.model_validate_json(text)
    except (ValidationError, InputError) as error:
        raise InputError(
            f"{where}: what it says of its detector cannot be used ({_first(error)}); export the "
            "file again"
        ) from error


def _first(error: Exception) -> str:
    if not isinstance(error, ValidationError):
        return str(error)
    problem = error.errors()[0]
    return f"{'.'.join(str(step) for step in problem['loc'])}: {problem['msg']}".removeprefix(": ")


def ultralytics_names(properties: Mapping[str, str]) -> tuple[str, ...] | None:
    """Class names in a file of Ultralytics: a Python dictionary from 0; or None."""
    text = properties.get("names", "")
    if not text or len(text) > _LONGEST_NAMES:
        return None
    try:
        # Literals alone: nothing in the text is run.
        names = ast.literal_eval(text)
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        return None
    if isinstance(names, dict) and set(names) == set(range(len(names))):
        return tuple(str(names[i]) for i in range(len(names)))
    return None
