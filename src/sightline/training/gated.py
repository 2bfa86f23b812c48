"""Two detectors in one file: one of a place where pictures look like it, a general one elsewhere.

A detector that was trained at one place knows that place best and sees boats on roofs elsewhere;
one that was trained on everything is good anywhere and best nowhere. A gate decides for each
picture whose boxes count (a mixture of experts, Jacobs et al. 1991). It looks at the mean and the
spread of the general network's features, which are there anyway, and asks three things: whether
they are nearer to the place's than to those of other pictures (logistic regression), whether they
are as near as the place's own are to each other (distance in and from their principal subspace, as
in Lee et al. 2018: what else there is in the world was not shown), and whether the place's detector
finds no more that is no vessel to the general one than it does at its place.
"""

from __future__ import annotations

import io
import json
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from sightline import _optional
from sightline.atomic import atomic_path
from sightline.detection import _onnxruntime
from sightline.detection.metadata import (
    KEY,
    DetectorMetadata,
    InputFormat,
    LowerEdge,
    read_metadata,
)
from sightline.detection.onnx import OnnxDetector
from sightline.detection.tiling import place as placed
from sightline.errors import InputError
from sightline.scene import Recording
from sightline.training.augmentation import Augmentation
from sightline.training.collage import Collage, CollageBatches
from sightline.training.export import OPSET, TOLERANCE, ExportError
from sightline.training.photographs import Photograph
from sightline.training.yolox import GENERAL_PREFIX, YoloxDetector, YoloxNetwork
from sightline.types import FloatArray, Frame, IntArray

if TYPE_CHECKING:
    from onnx import ModelProto
    from sklearn.linear_model import LogisticRegression

GENERAL_CLASS = "vessel"
"""Class of the boxes of the general detector, whose boxes end elsewhere than the other's."""

GENERAL_EDGE = LowerEdge(px=-0.48, share=0.005, spread_px=0.46)
"""Lower-edge bias of YOLOX-nano with its published weights, on 332 rendered boats."""

REMAINS = 0.1
"""What a score of the general detector is worth where the other one is asked: its boxes do not
outrank those of a detector that knows the place, and are there for who lowers the threshold."""

STRENGTHS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3)
"""Inverse penalties of the regression's weights among which left-out groups choose."""

MISSED = 0.005
"""Share of crops of left-out recordings that the gate may take for another place."""

_CROP_WIDTHS_PX, _CROP_HEIGHTS_PX = (320, 416, 640, 960, 1280), (128, 192, 224, 320, 416)
_SCALES = (0.4, 1.6)
_ROW_SIZES_PX = ((1280, 224), (1280, 192), (960, 320), (640, 320), (1920, 416), (416, 416))
_LEAST_OF_A_KIND = 20
_PAD = 114
_FOLDS = 5
_LEAST_VARIANCE = 1e-12
_SURE, _NO_VESSEL = 0.25, 0.03
"""Scores from where the detector of the place is believed as it ships, and up to where the general
one says that there is nothing (its recall of boats of 10 px is nine tenths there)."""
_CELLS_A_THING = 9.0
_AXES, _LEAST_SPREAD = 30, 1e-9
_SPARE, _STEEP = 1.5, 6.0
"""How much more than at the place is still believed, as a factor, and how sharply that ends."""
_SCORE_DIGITS = 0.1

Image = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Likeness:
    """How far pictures are from those of one place: in their principal subspace and from it.

    Attributes:
        mean: (F,) of the place's features.
        scale: (F,) their standard deviations.
        axes: (K, F) principal axes of what is so standardised.
        variance: (K,) along them.
        noise: Mean squared distance from the subspace.
        limit: Distance up to which a picture is of the place.
    """

    mean: FloatArray
    scale: FloatArray
    axes: FloatArray
    variance: FloatArray
    noise: float
    limit: float

    def distance(self, features: FloatArray) -> FloatArray:
        """(N,) distance of features (N, F); 2 in the mean of what it was made from."""
        z = (features - self.mean) / self.scale
        along = z @ self.axes.T
        away = (z**2).sum(axis=1) - (along**2).sum(axis=1)
        distance = (along**2 / self.variance).mean(axis=1) + away / self.noise
        return np.asarray(distance, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Gate:
    """Whether a picture is of the place.

    Attributes:
        weights: (F,) of a logistic regression on `Described.features`.
        offset: Added to them.
        places: What its pictures are like, one for each kind of them; to be like one is enough.
        most_alone: At the place, what the detector of the place finds alone; see `Described`.
        strength: Inverse penalty of the weights that was chosen.
        inside_missed: Share of crops of left-out groups from inside that it takes for outside.
        outside_passed: Share of those from outside that it takes for inside.
    """

    weights: FloatArray
    offset: float
    places: tuple[Likeness, ...]
    most_alone: float
    strength: float
    inside_missed: float
    outside_passed: float


@dataclass(frozen=True, eq=False)
class Described:
    """A crop of a picture, as the gate sees it.

    Attributes:
        features: (F,) mean and spread of each channel of the general network's features.
        alone: How much the detector of the place finds that is no vessel to the general one: sum
            of its scores over cells, in things.
    """

    features: FloatArray
    alone: float


class Describer:
    """Describes pictures for the gate, by both networks."""

    def __init__(self, network: YoloxNetwork, specialist: Path) -> None:
        """Load the detector of the place.

        Args:
            network: The general one, with one class.
            specialist: ONNX file of the other; see `check_specialist`.
        """
        self._network = network
        self._session = _onnxruntime.load().InferenceSession(
            str(specialist), providers=["CPUExecutionProvider"]
        )
        self._input = self._session.get_inputs()[0].name

    def __call__(self, image_rgb: Image) -> Described:
        """Describe a picture, (H, W, 3), sides a multiple of 32."""
        pixels = np.ascontiguousarray(image_rgb.transpose(2, 0, 1)[None], dtype=np.float32)
        place = self._session.run(None, {self._input: pixels / np.float32(255.0)})[0]
        with torch.no_grad():
            levels = self._network.features(torch.from_numpy(pixels).flip(1))
            _, something, kinds, _ = self._network.decode(*levels)
            alone = _alone(torch.from_numpy(place), _vessel(something, kinds), levels)
            pooled = _pooled(levels)
        return Described(cast(FloatArray, pooled[0].double().numpy()), float(alone[0]))


def _vessel(something: Tensor, kinds: Tensor) -> Tensor:
    """(B, N) scores of the general network."""
    return kinds[..., 0].sigmoid() * something.sigmoid()


def _alone(place: Tensor, vessel: Tensor, levels: Sequence[Tensor]) -> Tensor:
    """(B,) what the detector of the place finds alone; see `Described`.

    Args:
        place: (B, 4 + C, N) its boxes and scores.
        vessel: (B, N) scores of the general one, of the same cells.
        levels: Features, from which the rows and columns of each scale are.
    """
    own = place[:, 4:].amax(dim=1)
    begin = 0
    found, support = [], []
    fine = levels[0].shape[2:]
    for level in levels:
        rows, columns = level.shape[2], level.shape[3]
        part = slice(begin, begin + rows * columns)
        begin = begin + rows * columns
        shape = (-1, 1, rows, columns)
        found.append(functional.interpolate(own[:, part].reshape(shape), size=fine))
        near = functional.max_pool2d(vessel[:, part].reshape(shape), 5, 1, 2)
        support.append(functional.interpolate(near, size=fine))
    score = torch.cat(found, dim=1).amax(dim=1)
    supported = torch.cat(support, dim=1).amax(dim=1)
    alone = (score > _SURE).float() * (supported < _NO_VESSEL).float()
    return (score * alone).flatten(1).sum(dim=1) / _CELLS_A_THING


def _pooled(features: Sequence[Tensor]) -> Tensor:
    """(B, F) mean and standard deviation of each channel of each scale."""
    parts = []
    for level in features:
        flat = level.flatten(2)
        mean = flat.mean(dim=2)
        variance = (flat - mean[..., None]).square().mean(dim=2)
        parts += [mean, variance.clamp(min=_LEAST_VARIANCE).sqrt()]
    return torch.cat(parts, dim=1)


def crop(image_rgb: Image, rng: np.random.Generator) -> Image:
    """Cut a part out of a picture at some scale, as large as what a network is shown.

    Args:
        image_rgb: (H, W, 3).
        rng: Of where, how large and at which scale.
    """
    width, height = int(rng.choice(_CROP_WIDTHS_PX)), int(rng.choice(_CROP_HEIGHTS_PX))
    rows, columns = image_rgb.shape[:2]
    low, high = np.log(_SCALES)
    scale = max(float(np.exp(rng.uniform(low, high))), width / columns, height / rows)
    how = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
    sized = cv2.resize(image_rgb, None, fx=scale, fy=scale, interpolation=how).astype(np.uint8)
    spare = (sized.shape[1] - width, sized.shape[0] - height)
    x, y = (int(rng.integers(0, max(free, 0) + 1)) for free in spare)
    part = sized[y : y + height, x : x + width]
    out = np.full((height, width, 3), _PAD, np.uint8)
    out[: part.shape[0], : part.shape[1]] = part
    return out


def fit_gate(
    inside: Sequence[tuple[str, Sequence[Described], Sequence[str]]],
    outside: Sequence[Described],
    others: Sequence[str],
) -> Gate:
    """Fit the gate, and judge it by groups of pictures that it was not fitted to.

    Args:
        inside: Of each kind of pictures of the place its name, what it is shown, and what of that
            goes together, such as a recording.
        outside: Parts of anything else.
        others: Of each what goes together, likewise.

    Raises:
        InputError: There are fewer than two groups of a kind.
    """
    groups = [group for _, _, own in inside for group in own]
    few = [name for name, _, own in inside if len(set(own)) < 2]
    if few or len(set(others)) < 2:
        raise InputError(
            f"{few[0] if few else 'outside'}: a gate is judged by recordings and kinds of pictures "
            "that are left out in turn; give at least two"
        )
    shown = [one for _, own, _ in inside for one in own]
    X = np.stack([one.features for one in (*shown, *outside)])
    alone = np.array([one.alone for one in (*shown, *outside)])
    y = np.repeat([1, 0], [len(shown), len(outside)])
    fold = np.concatenate([_folds(groups), _folds(others)])
    strength, logit = _chosen_strength(X, y, fold)
    # As strict as recordings that were left out allow.
    margin = max(float(np.quantile(logit[y == 1], MISSED)), 0.0)
    mean, spread = X.mean(axis=0), np.maximum(X.std(axis=0), _LEAST_SPREAD)
    final = _regression(strength, (X - mean) / spread, y)
    weights = final.coef_[0] / spread
    places, near, begin = [], np.zeros(len(X), dtype=bool), 0
    for _, own, _ in inside:
        rows = slice(begin, begin + len(own))
        begin += len(own)
        likeness, left_out = _likeness(X[rows], fold[rows])
        places.append(likeness)
        near[rows] |= left_out < likeness.limit
        near[y == 0] |= likeness.distance(X[y == 0]) < likeness.limit
    most_alone = _SPARE * max(float(np.quantile(alone[y == 1], 1.0 - MISSED)), 1.0)
    passes = (logit >= margin) & near & (alone < most_alone)
    return Gate(
        weights=weights,
        offset=float(final.intercept_[0] - weights @ mean) - margin,
        places=tuple(places),
        most_alone=most_alone,
        strength=strength,
        inside_missed=float((~passes[y == 1]).mean()),
        outside_passed=float(passes[y == 0].mean()),
    )


def _regression(strength: float, z: FloatArray, y: IntArray) -> LogisticRegression:
    from sklearn.linear_model import LogisticRegression

    # Both sides weigh the same, however many pictures each has.
    return LogisticRegression(C=strength, max_iter=5000, class_weight="balanced").fit(z, y)


def _chosen_strength(X: FloatArray, y: IntArray, fold: IntArray) -> tuple[float, FloatArray]:
    """The strength that tells left-out folds apart best, and (N,) logits of those."""
    z = (X - X.mean(axis=0)) / np.maximum(X.std(axis=0), _LEAST_SPREAD)
    best: tuple[float, float, FloatArray] | None = None
    for strength in STRENGTHS:
        logit = np.full(len(z), np.nan)
        for number in np.unique(fold):
            out = fold == number
            logit[out] = _regression(strength, z[~out], y[~out]).decision_function(z[out])
        each = np.logaddexp(0.0, (1 - 2 * y) * logit)
        loss = float(each[y == 1].mean() + each[y == 0].mean())
        if best is None or loss < best[0]:
            best = (loss, strength, logit)
    assert best is not None, "there are strengths to choose from"
    return best[1], best[2]


def _likeness(features: FloatArray, fold: IntArray) -> tuple[Likeness, FloatArray]:
    """What pictures of a place are like, and (N,) distances of those of left-out folds."""
    left_out = np.full(len(features), np.nan)
    for number in np.unique(fold):
        out = fold == number
        left_out[out] = _subspace(features[~out]).distance(features[out])
    limit = _SPARE * float(np.quantile(left_out, 1.0 - 2.0 * MISSED))
    return replace(_subspace(features), limit=limit), left_out


def _subspace(features: FloatArray) -> Likeness:
    mean, scale = features.mean(axis=0), np.maximum(features.std(axis=0), _LEAST_SPREAD)
    z = (features - mean) / scale
    count = min(_AXES, max(len(z) // 4, 1))
    _, singular, axes = np.linalg.svd(z, full_matrices=False)
    variance = np.maximum(singular[:count] ** 2 / len(z), _LEAST_SPREAD)
    away = float(np.maximum((singular[count:] ** 2).sum() / len(z), _LEAST_SPREAD))
    return Likeness(mean, scale, axes[:count], variance, away, float("inf"))


def _folds(groups: Sequence[str]) -> IntArray:
    names = list(dict.fromkeys(groups))
    return np.array([names.index(name) % _FOLDS for name in groups], dtype=np.int64)


def made_small(
    photographs: Sequence[Photograph], count: int, rng: np.random.Generator
) -> Iterator[tuple[str, Image]]:
    """Photographs of a kind side by side, as small as what a camera of a harbour sees.

    Args:
        photographs: Of a folder.
        count: So many pictures of each kind, where there are several photographs of it.
        rng: Of which, where and how large.

    Yields:
        The kind and a picture.
    """
    kinds: dict[str, list[Photograph]] = {}
    for one in photographs:
        kinds.setdefault(kind_of(one.name), []).append(one)
    for kind, own in kinds.items():
        if len(own) < _LEAST_OF_A_KIND:
            continue
        material = Collage(own, own, (), (), side_by_side=1.0, bare=0.4)
        for number in range(count):
            size = _ROW_SIZES_PX[number % len(_ROW_SIZES_PX)]
            made = CollageBatches(material, Augmentation(), size_px=size, batch=1, seed=0)
            yield kind, made.picture(rng)[0].numpy().transpose(1, 2, 0)


def shown_parts(detector: OnnxDetector, image_rgb: Image) -> list[Image]:
    """What a network is shown of a frame, (h, w, 3) each, red, green, blue.

    Args:
        detector: Whose views are taken.
        image_rgb: (H, W, 3).
    """
    image = np.ascontiguousarray(image_rgb[..., ::-1])
    parts = []
    for view in detector.views(Frame(0, 0.0, image)):
        box = placed(view, None, InputFormat().stride, InputFormat().centred)
        part = image_rgb[view.y : view.y + view.height, view.x : view.x + view.width]
        parts.append(np.ascontiguousarray(box.apply(part, _PAD)))
    return parts


def spread_frames(recording: Recording, count: int) -> list[Image]:
    """Frames of a recording, (H, W, 3) red, green, blue, spread evenly over all of it.

    Args:
        recording: With pictures.
        count: At least half as many and at most so many, where it has as many.

    Raises:
        InputError: The pictures cannot be read.
    """
    kept: list[Image] = []
    step = 1
    for number, frame in enumerate(recording.frames()):
        if number % step:
            continue
        kept.append(np.ascontiguousarray(frame.image_bgr[..., ::-1]))
        if len(kept) > count:
            kept, step = kept[::2], 2 * step
    return kept


def kind_of(name: str) -> str:
    """What pictures of a folder belong together by their names: all before the first digit or dash.

    Args:
        name: Of the picture's file.
    """
    return re.split(r"[\d\-_]", name, maxsplit=1)[0]


def _within(value: Tensor, limit: float) -> Tensor:
    """1 where a value is far below its limit, 0 where it is far above."""
    return (_STEEP * (1.0 - value / limit)).sigmoid()


class _Near(nn.Module):  # type: ignore[misc]
    """Whether features are like those of a place; see `Likeness`."""

    def __init__(self, place: Likeness) -> None:
        super().__init__()
        single = {
            "mean": place.mean,
            "scale": 1.0 / place.scale,
            "axes": place.axes.T,
            "precision": 1.0 / (place.variance * len(place.variance)),
        }
        for name, value in single.items():
            self.register_buffer(name, torch.tensor(value.copy(), dtype=torch.float32))
        self.noise, self.limit = place.noise, place.limit

    def forward(self, pooled: Tensor) -> Tensor:
        z = (pooled - self.mean) * self.scale
        along = (z @ self.axes).square()
        away = (z.square().sum(dim=1) - along.sum(dim=1)) / self.noise
        return _within((along * self.precision).sum(dim=1) + away, self.limit)


class _General(nn.Module):  # type: ignore[misc]
    """Boxes (B, 4 + 1, N) of the general network, and how far a picture is inside (B, 1, 1)."""

    def __init__(self, general: YoloxDetector, gate: Gate) -> None:
        super().__init__()
        self.network = general.network
        self.register_buffer("weights", torch.tensor(gate.weights, dtype=torch.float32))
        self.offset = gate.offset
        self.most_alone = gate.most_alone
        self.places = nn.ModuleList(_Near(place) for place in gate.places)

    def forward(self, images: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
        levels = self.network.features(images.flip(1) * 255.0)
        boxes, something, kinds, _ = self.network.decode(*levels)
        vessel = _vessel(something, kinds)
        pooled = _pooled(levels)
        alike = ((pooled * self.weights).sum(dim=1) + self.offset).sigmoid()
        near = torch.stack([one(pooled) for one in self.places]).amax(dim=0)
        alone = _within(_alone(place, vessel, levels), self.most_alone)
        inside = (alike * near * alone)[:, None, None]
        low, high = boxes[..., :2], boxes[..., 2:]
        scores = vessel[..., None] * (1.0 - (1.0 - REMAINS) * inside)
        found = torch.cat([(low + high) * 0.5, high - low, scores], dim=-1).transpose(1, 2)
        return found, inside


def check_specialist(path: Path) -> DetectorMetadata:
    """What the file of the detector of a place says of it.

    Raises:
        InputError: It is missing, damaged, or none that can be joined with another.
    """
    onnx = _optional.module("onnx", "train")
    if not path.is_file():
        raise InputError(f"{path}: is not there; give the ONNX file of a detector of your own")
    try:
        model = onnx.load(str(path), load_external_data=False)
    except Exception as error:  # protobuf's own errors share no base with onnx's
        raise InputError(f"{path}: is no whole ONNX file") from error
    metadata = read_metadata(str(path), {one.key: one.value for one in model.metadata_props})
    opset = {one.domain: one.version for one in model.opset_import}
    fits = (
        metadata is not None
        and metadata.decoder == "yolov8"
        and metadata.input == InputFormat()
        and opset == {"": OPSET}
        and (len(model.graph.input), len(model.graph.output)) == (1, 1)
    )
    if metadata is None or not fits:
        raise InputError(
            f"{path}: cannot be joined with another; expected what detector train and export make "
            "of --arch harbour, for pictures of any size"
        )
    if GENERAL_CLASS in metadata.classes:
        raise InputError(f"{path}: is joined with another already; give the file from before")
    return metadata


def join(
    specialist: Path,
    general: YoloxDetector,
    gate: Gate,
    path: Path,
    *,
    about: dict[str, object] | None = None,
    pictures: Sequence[Image] = (),
) -> float:
    """Write both detectors and the gate as one file, and check it against both.

    Args:
        specialist: ONNX file of the detector of a place; see `check_specialist`.
        general: With one class.
        gate: Which of them counts.
        path: The file.
        about: More for the metadata.
        pictures: (H, W, 3) each, red, green, blue, sides a multiple of 32, to check with.

    Returns:
        The largest difference that the check found: of a score, or a tenth of that of an edge as a
        share of where it lies.

    Raises:
        ExportError: It was more than `TOLERANCE` of a value.
        InputError: The specialist is none that can be joined, or the file cannot be written.
    """
    onnx = _optional.module("onnx", "train")
    metadata = check_specialist(specialist)
    branch = _General(general, gate).eval()
    classes = (*metadata.classes, GENERAL_CLASS)
    default = (*(metadata.default_classes or metadata.classes), GENERAL_CLASS)
    content = json.loads(metadata.to_json()) | {
        "classes": list(classes),
        "default_classes": list(default),
        "architecture": "gated",
        "class_lower_edges": {GENERAL_CLASS: GENERAL_EDGE.model_dump()},
        **(about or {}),
    }
    with atomic_path(path) as temporary:
        model = _joined(
            onnx, specialist, _exported(onnx, branch, len(metadata.classes)), len(classes)
        )
        model.metadata_props.add(key=KEY, value=json.dumps(content))
        onnx.checker.check_model(model)
        onnx.save(model, str(temporary))
        difference = _difference(temporary, specialist, branch, pictures)
        if not difference <= TOLERANCE:
            raise ExportError(
                f"{path}: the joined network differs by {difference:.2g} from the two that it was "
                f"made from, more than {TOLERANCE:g}; it was not written"
            )
    return difference


def _exported(onnx: Any, branch: _General, classes: int) -> ModelProto:
    """The general branch as a graph of its own."""
    content = io.BytesIO()
    with warnings.catch_warnings(), torch.no_grad():
        # Tracing warns of every shape that becomes a constant; the check finds those that must not.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            branch,
            (torch.rand(1, 3, 192, 320), torch.rand(1, 4 + classes, 24 * 40 + 12 * 20 + 6 * 10)),
            content,
            input_names=["images", "boxes"],
            output_names=["found", "inside"],
            dynamic_axes={
                "images": {0: "batch", 2: "height", 3: "width"},
                "boxes": {0: "batch", 2: "count"},
                "found": {0: "batch", 2: "count"},
                "inside": {0: "batch"},
            },
            opset_version=OPSET,
            dynamo=False,
        )
    return cast("ModelProto", onnx.load_from_string(content.getvalue()))


def _joined(onnx: Any, specialist: Path, general: ModelProto, classes: int) -> ModelProto:
    """One graph: both networks, the gate's product, and all boxes in one list."""
    helper, numbers = onnx.helper, onnx.numpy_helper
    place = onnx.compose.add_prefix(onnx.load(str(specialist)), "place/")
    other = onnx.compose.add_prefix(general, GENERAL_PREFIX)
    nodes = [*place.graph.node, *other.graph.node]
    boxes = place.graph.output[0].name
    given = {
        place.graph.input[0].name: "images",
        "general/images": "images",
        "general/boxes": boxes,
    }
    for node in nodes:
        for i, name in enumerate(node.input):
            node.input[i] = given.get(name, name)
    values = {"zero": [0], "one": [1], "four": [4], "end": [4 + classes - 1]}
    constants = [numbers.from_array(np.array(v, np.int64), k) for k, v in values.items()]

    def slice_of(source: str, first: str, last: str, name: str) -> Any:
        return helper.make_node("Slice", [source, first, last, "one"], [name])

    # The scores of the other's classes are none: a row that is subtracted from itself, and so has
    # the right size whatever the picture's.
    nodes += [
        slice_of(boxes, "zero", "four", "place/box"),
        slice_of(boxes, "four", "end", "place/score"),
        helper.make_node("Mul", ["place/score", "general/inside"], ["place/weighed"]),
        slice_of("place/score", "zero", "one", "place/row"),
        helper.make_node("Sub", ["place/row", "place/row"], ["place/none"]),
        helper.make_node(
            "Concat", ["place/box", "place/weighed", "place/none"], ["place/all"], axis=1
        ),
        slice_of("general/found", "zero", "four", "general/box"),
        slice_of("general/found", "four", "five", "general/score"),
        helper.make_node("Sub", ["general/score", "general/score"], ["general/none"]),
        helper.make_node(
            "Concat",
            ["general/box", *["general/none"] * (classes - 1), "general/score"],
            ["general/all"],
            axis=1,
        ),
        helper.make_node("Concat", ["place/all", "general/all"], ["output"], axis=2),
    ]
    constants.append(numbers.from_array(np.array([5], np.int64), "five"))
    real = onnx.TensorProto.FLOAT
    graph = helper.make_graph(
        nodes,
        "gated",
        [helper.make_tensor_value_info("images", real, ["batch", 3, "height", "width"])],
        [helper.make_tensor_value_info("output", real, ["batch", 4 + classes, "count"])],
        [*place.graph.initializer, *other.graph.initializer, *constants],
    )
    opset = [helper.make_opsetid("", OPSET)]
    return cast("ModelProto", helper.make_model(graph, opset_imports=opset, ir_version=8))


def _difference(path: Path, specialist: Path, branch: _General, pictures: Sequence[Image]) -> float:
    """How far the file is from both networks, relative where values are above 1."""
    runtime = _onnxruntime.load()
    providers = ["CPUExecutionProvider"]
    joined = runtime.InferenceSession(str(path), providers=providers)
    alone = runtime.InferenceSession(str(specialist), providers=providers)
    rng = np.random.default_rng(0)
    shown = [np.ascontiguousarray(one.transpose(2, 0, 1)[None]) for one in pictures]
    if not shown:
        rough = rng.integers(0, 256, (8, 12, 3), dtype=np.uint8)
        smooth = cv2.resize(rough, (320, 192)).astype(np.uint8)
        shown = [smooth.transpose(2, 0, 1)[None]]
    largest = 0.0
    for pixels in shown:
        fed = pixels.astype(np.float32) / 255.0
        got = joined.run(None, {"images": fed})[0]
        own = alone.run(None, {alone.get_inputs()[0].name: fed})[0]
        with torch.no_grad():
            parts = branch(torch.from_numpy(fed), torch.from_numpy(own))
        found, inside = (part.numpy() for part in parts)
        weighed = np.concatenate([own[:, :4], own[:, 4:] * inside], axis=1)
        count = own.shape[2]
        expected = np.zeros_like(got)
        expected[:, : weighed.shape[1], :count] = weighed
        expected[:, :4, count:], expected[:, -1:, count:] = found[:, :4], found[:, 4:]
        apart = np.abs(got - expected) / np.maximum(np.abs(expected), 1.0)
        # Sides are exponentials, which in single precision lose a digit that scores keep.
        apart[:, :4] *= _SCORE_DIGITS
        largest = max(largest, float(apart.max()))
    return largest
