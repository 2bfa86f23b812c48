"""Detectors in ONNX files."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline import limits
from sightline.camera.horizon_tracker import HorizonFinder
from sightline.detection import _onnxruntime
from sightline.detection._onnx_file import check_onnx_file
from sightline.detection.classes import names_for
from sightline.detection.decoders import Decoder, Outputs, Scored, decoder_by_name, decoder_for
from sightline.detection.letterbox import Letterbox
from sightline.detection.metadata import InputFormat, LowerEdge, read_metadata, ultralytics_names
from sightline.detection.rotation import Found, TileRotation
from sightline.detection.tiling import Horizon, Tile, TilingSettings, merge, place, plan_tiles
from sightline.errors import InputError, unknown_name
from sightline.types import BoolArray, Boxes, FloatArray, Frame, IntArray

PROVIDERS = {
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
}
"""What a network runs on, and ONNX Runtime's name for it."""

DEFAULT_THRESHOLD = 0.25

_MOST_CANDIDATES = 3000
_LARGEST_PX = 16384
_MOST_PX = 2**25
_DUMMY_PX = 320
_TILE_IN_TURN_PX = 416
_MEASURED_TILES = 9
_SIZES_INPUT = "orig_target_sizes"
_TYPES = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(uint8)": np.uint8,
}


@dataclass(frozen=True)
class DetectorOptions:
    """Options of a detector in an ONNX file; what is absent is as the file says, or as is usual.

    Attributes:
        provider: One of `PROVIDERS`. Absent: a GPU where ONNX Runtime has one, or else the CPU.
        decoder: Name of what its outputs mean. Absent: seen from the outputs.
        classes: Names of the classes that are looked for. Absent: those that the file is for.
        threshold: Least confidence of a box.
        overlap: Boxes of a class that overlap by more (intersection over union) are of one thing.
        views: Tiles of a frame. Absent: the strip around the horizon and the scaled frame.
        threads: Of the CPU. Absent: what `sightline.limits` allows, or as many as there are cores.
        enlarge: Pixels that the network is shown for one of the frame. Absent: as the views say.
        frame_width_px: Frames that are wider are scaled down to it. Absent: as the views say.
        budget_ms: Time a frame of a video, milliseconds: as many tiles are looked at as the network
            was measured to take in it; see `sightline.detection.rotation`. Absent: all tiles.
        tiles_per_frame: So many instead, whatever the machine: then nothing is measured.
    """

    provider: str | None = None
    decoder: str | None = None
    classes: tuple[str, ...] | None = None
    threshold: float | None = None
    overlap: float = 0.45
    views: TilingSettings | None = None
    threads: int | None = None
    enlarge: float | None = None
    frame_width_px: int | None = None
    budget_ms: float | None = None
    tiles_per_frame: int | None = None

    def __post_init__(self) -> None:
        if self.provider is not None and self.provider not in PROVIDERS:
            raise unknown_name("provider", self.provider, tuple(PROVIDERS))
        if self.decoder is not None:
            decoder_by_name(self.decoder)
        if self.threshold is not None and not 0.0 <= self.threshold <= 1.0:
            raise InputError(f"threshold is {self.threshold:g}; it must lie between 0 and 1")
        if not 0.0 < self.overlap <= 1.0:
            raise InputError(f"overlap is {self.overlap:g}; it must lie between 0 and 1")
        if self.classes is not None and not self.classes:
            raise InputError("classes names no class; leave it out to look for all")
        if self.budget_ms is not None and not 0.0 < self.budget_ms < float("inf"):
            raise InputError(
                f"budget is {self.budget_ms:g} ms; give the milliseconds that a frame may take"
            )
        if self.tiles_per_frame is not None and self.tiles_per_frame < 1:
            raise InputError(f"tiles_per_frame is {self.tiles_per_frame}; give 1 or more")
        self.tiling(TilingSettings())

    def over(self, usual: DetectorOptions) -> DetectorOptions:
        """These, and of what they do not say how frames are looked at as others do.

        Args:
            usual: A scene's.
        """
        absent = {
            name: getattr(usual, name)
            for name in ("views", "enlarge", "frame_width_px", "budget_ms", "tiles_per_frame")
            if getattr(self, name) is None
        }
        return replace(self, **absent)

    @property
    def rotates(self) -> bool:
        """Whether a part of the tiles is looked at in each frame."""
        return self.budget_ms is not None or self.tiles_per_frame is not None

    def tiling(self, usual: TilingSettings | None) -> TilingSettings:
        """How the tiles of a frame are chosen.

        Args:
            usual: As the file says; None: it does not.
        """
        settings = self.views
        if settings is None and self.rotates:
            settings = TilingSettings(kind="everywhere")
        settings = settings or usual or TilingSettings()
        if self.enlarge is not None:
            settings = replace(settings, enlarge=self.enlarge)
        if self.frame_width_px is not None:
            settings = replace(settings, frame_width_px=self.frame_width_px)
        return settings


class OnnxDetector:
    """A detector in an ONNX file, run by ONNX Runtime.

    Every frame is taken in several tiles (see `TilingSettings`), each scaled to what the network
    takes. Boxes that tiles have in common are merged by non-maximum suppression.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        name: str | None = None,
        options: DetectorOptions | None = None,
        horizon_px: Horizon | None = None,
    ) -> None:
        """Load the file, and run it on an empty picture.

        Args:
            path: The ONNX file.
            name: The source of its boxes. Absent: the file's name without its ending.
            options: How it is run.
            horizon_px: Rows of the horizon at the left and the right edge of the image. Absent: it
                is found in the first frames.

        Raises:
            InputError: The file is missing, damaged or no detector, or an option does not fit it.
        """
        self.name = name if name is not None else Path(path).stem
        self._where = os.fspath(path)
        self._options = options if options is not None else DetectorOptions()
        self._network = _Network(self._where, self._options)
        properties = self._network.properties
        metadata = read_metadata(self._where, properties)
        labels = metadata.classes if metadata else ultralytics_names(properties)
        wanted = self._options.decoder or (metadata.decoder if metadata else None)
        decoder = decoder_by_name(wanted) if wanted else None
        known = metadata.input if metadata else decoder.input if decoder else InputFormat()
        self._network.prepare(known)
        blank = Outputs(
            names=self._network.output_names,
            arrays=tuple(self._network.try_out()),
            input_px=self._network.dummy_px,
            anchors=metadata.anchors if metadata else None,
            scale_xy=metadata.scale_xy if metadata else None,
            labelled=labels is not None,
            description=properties.get("description", ""),
        )
        try:
            self._decoder: Decoder = decoder or decoder_for(blank)
            found = self._decoder.of_one(blank, 0)
        except InputError as error:
            raise InputError(f"{self._where}: {error}") from error
        if metadata is None:
            self._network.prepare(self._decoder.input)
        self._form = replace(blank, arrays=())
        count = None if found.listed else found.scores.shape[1]
        self.classes: tuple[str, ...] = labels or names_for(count, self._decoder.by_category)
        if labels is not None and count is not None and count != len(labels):
            raise InputError(
                f"{self._where}: names {len(labels)} classes and puts out {count}; "
                f"the outputs are {blank.describe()}"
            )
        default = metadata.default_classes if metadata else None
        self._wanted = self._indices(self._options.classes or default)
        usual = metadata.score_threshold if metadata else None
        self.threshold: float = next(
            value
            for value in (self._options.threshold, usual, DEFAULT_THRESHOLD)
            if value is not None
        )
        self._calibration = metadata.calibration if metadata else None
        self._view_settings = self._options.tiling(metadata.views if metadata else None)
        self._sources = {
            label: metadata.source_of(self.name, label) if metadata else self.name
            for label in self.classes
        }
        self.lower_edges: dict[str, LowerEdge | None] = {
            self.name: metadata.lower_edge if metadata else None
        }
        for label, edge in (metadata.class_lower_edges or {} if metadata else {}).items():
            self.lower_edges[self._sources[label]] = edge
        self._given_horizon_px = horizon_px
        self._tile_px = self._network.input_px
        if self._tile_px is None and self._options.rotates:
            # A network that takes any size would be shown too much at once to choose from.
            side = -(-_TILE_IN_TURN_PX // self._network.form.stride) * self._network.form.stride
            self._tile_px = (side, side)
        self._measured_for: tuple[Tile, ...] = ()
        self.tiles_per_frame: int | None = self._options.tiles_per_frame
        self.reset()

    @property
    def decoder(self) -> str:
        """Name of the decoder in use."""
        return self._decoder.name

    @property
    def provider(self) -> str:
        """Execution provider in use, one of `PROVIDERS`."""
        return self._network.provider

    @property
    def lower_edge(self) -> LowerEdge | None:
        """Lower-edge bias of the boxes whose source is `name`; None: not measured."""
        return self.lower_edges[self.name]

    @property
    def remembers(self) -> bool:
        """Whether what it finds in a frame depends on those before, which it is to be shown."""
        return self._options.rotates

    @property
    def tile_count(self) -> int:
        """How many tiles the last frame has."""
        return len(self._views)

    @property
    def wanted(self) -> tuple[str, ...]:
        """Names of the classes that are looked for."""
        if self._wanted is None:
            return tuple(name for name in self.classes if name != "-")
        return tuple(self.classes[i] for i in self._wanted)

    def reset(self) -> None:
        """Forget the detected horizon, and what tiles held; see `Detector`."""
        self._rotation: TileRotation | None = None
        self._finder = HorizonFinder()
        self._planned: tuple[tuple[int, int], Horizon | None] | None = None
        self._views: tuple[Tile, ...] = ()
        self._boxes_of: tuple[Letterbox, ...] = ()

    def detect(self, frame: Frame) -> Boxes:
        """Detect boxes in a frame; see `Detector`."""
        return self.detect_batch([frame])[0]

    def detect_batch(self, frames: Sequence[Frame]) -> list[Boxes]:
        """Detect boxes in each of several frames, in their order, as `detect`.

        Networks that take batches are shown views of the same size at once, which GPUs are quick
        at.
        """
        if self._options.rotates:
            return [self._detect_in_turn(frame) for frame in frames]
        jobs: list[tuple[int, int, Letterbox, NDArray[np.uint8]]] = []
        sizes: list[tuple[int, int]] = []
        plans: list[tuple[Tile, ...]] = []
        for number, frame in enumerate(frames):
            self._plan(frame)
            height, width = frame.image_bgr.shape[:2]
            sizes.append((width, height))
            plans.append(self._views)
            for i, (view, box) in enumerate(zip(self._views, self._boxes_of, strict=True)):
                part = frame.image_bgr[view.y : view.y + view.height, view.x : view.x + view.width]
                jobs.append((number, i, box, box.apply(part, self._network.form.pad)))
        found = self._run([(box.canvas_px, canvas) for _, _, box, canvas in jobs])
        per_frame: list[list[tuple[FloatArray, FloatArray, IntArray, int]]] = [[] for _ in frames]
        for (number, i, box, _), scored in zip(jobs, found, strict=True):
            xyxy, score, label = self._chosen(scored)
            view = plans[number][i]
            xyxy = box.to_picture(xyxy) + np.tile([view.x, view.y], 2)
            per_frame[number].append((xyxy, score, label, i))
        return [
            self._merged(frame, sizes[number], plans[number], per_frame[number])
            for number, frame in enumerate(frames)
        ]

    def _detect_in_turn(self, frame: Frame) -> Boxes:
        """Detect boxes in as many tiles of a frame as there is time for; see `TileRotation`."""
        self._plan(frame)
        assert self._rotation is not None, "planned for every size of frame"
        image = frame.image_bgr
        size_px = (image.shape[1], image.shape[0])
        # Of the first frame all are looked at, and it is measured how long that takes.
        chosen = self._rotation.choose(image, frame.time_utc_s, self.tiles_per_frame or 1)
        known = self._rotation.merge(dict(zip(chosen, self._look(image, chosen), strict=True)))
        parts = [(one.xyxy_px, one.score, one.label, i) for i, one in known.items()]
        if self._measured_for != self._views and self._options.tiles_per_frame is None:
            self.tiles_per_frame = self._measured(frame, parts)
            self._measured_for = self._views
        return self._merged(frame, size_px, self._views, parts)

    def _look(self, image: NDArray[np.uint8], chosen: Sequence[int]) -> list[Found]:
        """What the network finds in some of the tiles, each by itself."""
        canvases = []
        for i in chosen:
            view, box = self._views[i], self._boxes_of[i]
            part = image[view.y : view.y + view.height, view.x : view.x + view.width]
            canvases.append((box.canvas_px, box.apply(part, self._network.form.pad)))
        out = []
        for i, scored in zip(chosen, self._run(canvases), strict=True):
            xyxy, score, label = self._chosen(scored)
            xyxy = self._boxes_of[i].to_picture(xyxy) + np.tile(
                [self._views[i].x, self._views[i].y], 2
            )
            out.append(self._once(Found(xyxy, score, label), (image.shape[1], image.shape[0])))
        return out

    def _once(self, found: Found, frame_px: tuple[int, int]) -> Found:
        """What was found in a tile, each thing once: less to remember, and to merge every time."""
        xyxy = np.clip(found.xyxy_px, 0.0, np.tile(frame_px, 2))
        kept = np.flatnonzero(_has_extent(xyxy))
        found = Found(xyxy[kept], found.score[kept], found.label[kept])
        if not kept.size or not self._decoder.several:
            return found
        one_tile = np.zeros(kept.size, dtype=np.int64)
        best = _suppressed(found.xyxy_px, found.score, found.label, one_tile, self._options.overlap)
        return Found(found.xyxy_px[best], found.score[best], found.label[best])

    def _measured(
        self, frame: Frame, parts: Sequence[tuple[FloatArray, FloatArray, IntArray, int]]
    ) -> int:
        """How many tiles of a frame are looked at within the budget on this machine.

        Args:
            frame: All of whose tiles have been looked at.
            parts: What was found in each.
        """
        image = frame.image_bgr
        assert self._options.budget_ms is not None, "the tiles are counted where there is none"
        spare = TileRotation(self._views, (image.shape[1], image.shape[0]))
        spare.choose(image, float("nan"), 1)
        looking_s, other_s = [], []
        for number in range(_MEASURED_TILES):
            i = number % len(self._views)
            begun_s = time.perf_counter()
            found = self._look(image, [i])
            looking_s.append(time.perf_counter() - begun_s)
            spare.merge({i: found[0]})
            begun_s = time.perf_counter()
            spare.choose(image, float("nan"), 1)
            self._merged(frame, spare.frame_px, self._views, parts)
            other_s.append(time.perf_counter() - begun_s)
        # What else the machine did at that moment made some of them slow.
        other, looking = (float(np.quantile(one, 0.25)) for one in (other_s, looking_s))
        left_s = 1e-3 * self._options.budget_ms - other
        return min(max(int(left_s / looking), 1), len(self._views))

    def inputs(self, frame: Frame) -> list[dict[str, NDArray[Any]]]:
        """What the network is given of a frame, a tile each: arrays by the names of its inputs."""
        given = []
        for view, box in zip(self.views(frame), self._boxes_of, strict=True):
            part = frame.image_bgr[view.y : view.y + view.height, view.x : view.x + view.width]
            given.append(self._network.feed([box.apply(part, self._network.form.pad)]))
        return given

    def views(self, frame: Frame) -> tuple[Tile, ...]:
        """Tiles of a frame that the network is run on."""
        self._plan(frame)
        return self._views

    def _plan(self, frame: Frame) -> None:
        """Plan the tiles anew, where the frame's size or the horizon has changed."""
        height, width = frame.image_bgr.shape[:2]
        horizon = self._given_horizon_px
        if horizon is None and (self._view_settings.kind == "strip" or self._options.rotates):
            horizon = self._finder.look(frame.image_bgr)
        if self._planned == ((width, height), horizon):
            return
        form = self._network.form
        self._views = plan_tiles(
            (width, height),
            self._view_settings,
            horizon_px=horizon,
            input_px=self._tile_px,
            stride_px=form.stride,
        )
        self._boxes_of = tuple(
            place(view, self._tile_px, form.stride, form.centred) for view in self._views
        )
        if self._options.rotates:
            if self._rotation is None or self._rotation.tiles != self._views:
                self._rotation = TileRotation(self._views, (width, height))
            band = None if horizon is None else self._view_settings.band(width, horizon)
            self._rotation.set_band(band)
        self._planned = ((width, height), horizon)

    def _run(self, canvases: list[tuple[tuple[int, int], NDArray[np.uint8]]]) -> list[Scored]:
        """Run the network on each canvas; those of one size in batches where it takes them."""
        out: list[Scored | None] = [None] * len(canvases)
        by_size: dict[tuple[int, int], list[int]] = {}
        for i, (size, _) in enumerate(canvases):
            by_size.setdefault(size, []).append(i)
        for size, rows in by_size.items():
            step = self._network.batch if self._decoder.batched else 1
            for start in range(0, len(rows), step or len(rows)):
                some = rows[start : start + (step or len(rows))]
                arrays = self._network.run([canvases[i][1] for i in some])
                outputs = replace(self._form, arrays=tuple(arrays), input_px=size)
                for row, i in enumerate(some):
                    out[i] = self._decoder.of_one(outputs, row)
        return [scored for scored in out if scored is not None]

    def _chosen(self, scored: Scored) -> tuple[FloatArray, FloatArray, IntArray]:
        """Boxes above the confidence threshold, with their scores and classes."""
        scores, index = scored.scores, None
        if self._wanted is not None:
            index = self._wanted[self._wanted < scores.shape[1]]
            scores = scores[:, index]
        if not scores.size:
            return np.empty((0, 4)), np.empty(0), np.empty(0, dtype=np.int64)
        best = scores.argmax(axis=1)
        score = scores[np.arange(len(scores)), best]
        if self._calibration is not None:
            score = np.interp(score, *np.array(self._calibration).T)
        xyxy = scored.xyxy_px
        # Not-a-number is not at least the threshold either.
        kept = np.flatnonzero((score >= self.threshold) & (score > 0.0))
        kept = kept[np.isfinite(xyxy[kept]).all(axis=1)]
        if kept.size > _MOST_CANDIDATES:
            kept = kept[np.argsort(-score[kept], kind="stable")[:_MOST_CANDIDATES]]
        label = best[kept] if index is None else index[best[kept]]
        return xyxy[kept], np.minimum(score[kept], 1.0), label.astype(np.int64)

    def _merged(
        self,
        frame: Frame,
        frame_px: tuple[int, int],
        views: tuple[Tile, ...],
        parts: Iterable[tuple[FloatArray, FloatArray, IntArray, int]],
    ) -> Boxes:
        parts = list(parts)
        xyxy = np.concatenate([part[0] for part in parts])
        score = np.concatenate([part[1] for part in parts])
        label = np.concatenate([part[2] for part in parts])
        view = np.concatenate([np.full(len(part[0]), part[3]) for part in parts])
        xyxy = np.clip(xyxy, 0.0, np.tile(frame_px, 2))
        kept = np.flatnonzero(_has_extent(xyxy))
        if kept.size and self._decoder.several:
            # Each view by itself first, so that what is cut off is compared with the best.
            kept = kept[
                _suppressed(xyxy[kept], score[kept], label[kept], view[kept], self._options.overlap)
            ]
        stays = merge(views, frame_px, xyxy[kept], score[kept], view[kept], label[kept])
        kept = kept[stays]
        kept = kept[np.argsort(-score[kept], kind="stable")]
        names = [self._class(i) for i in label[kept]]
        return Boxes.of(
            xyxy[kept],
            frame=frame.index,
            time_utc_s=frame.time_utc_s,
            confidence=score[kept],
            source=np.array([self._sources.get(one, self.name) for one in names], dtype=np.str_),
            label=np.array(names, dtype=np.str_),
        )

    def _class(self, index: int) -> str:
        return self.classes[index] if index < len(self.classes) else str(index)

    def _indices(self, names: Sequence[str] | None) -> IntArray | None:
        if names is None:
            return None
        known = [name for name in self.classes if name != "-"]
        for name in names:
            if name not in known:
                raise unknown_name(f"class of {self.name}", name, known)
        return np.array([self.classes.index(name) for name in dict.fromkeys(names)], dtype=np.int64)


def _has_extent(xyxy_px: FloatArray) -> BoolArray:
    """(N,) whether there is anything of a box in the frame."""
    return np.asarray((xyxy_px[:, 2:] - xyxy_px[:, :2] > 0.5).all(axis=1), dtype=bool)


def _suppressed(
    xyxy_px: FloatArray, score: FloatArray, label: IntArray, view: IntArray, overlap: float
) -> IntArray:
    """Non-maximum suppression, for each class and each tile by itself."""
    xywh = np.concatenate([xyxy_px[:, :2], xyxy_px[:, 2:] - xyxy_px[:, :2]], axis=1)
    group = view * (int(label.max(initial=0)) + 1) + label
    # It takes arrays, which its annotations do not say.
    suppress: Any = cv2.dnn.NMSBoxesBatched
    kept = suppress(xywh, score, group.astype(np.int32), 0.0, overlap)
    return np.asarray(kept, dtype=np.int64).ravel()


class _Network:
    """A session of ONNX Runtime with one picture as its input."""

    def __init__(self, where: str, options: DetectorOptions) -> None:
        self._where = where
        self._session = _session(where, options)
        self.provider = _provider(where, self._session, options.provider)
        try:
            inputs = self._session.get_inputs()
            pictures = [one for one in inputs if one.name != _SIZES_INPUT]
            self.output_names = tuple(one.name for one in self._session.get_outputs())
            told = self._session.get_modelmeta().custom_metadata_map or {}
        except UnicodeDecodeError as error:
            raise InputError(
                f"{where}: a name in it is not text in UTF-8 ({error.reason}); export it again"
            ) from error
        if len(pictures) != 1 or len(pictures[0].shape) not in (3, 4):
            given = ", ".join(f"{one.name} {list(one.shape)} {one.type}" for one in inputs)
            raise InputError(
                f"{where}: is no detector that takes a picture; its inputs are {given or 'none'}"
            )
        self._input = pictures[0]
        self._sizes = next((one for one in inputs if one.name == _SIZES_INPUT), None)
        if self._input.type not in _TYPES:
            raise InputError(
                f"{where}: takes pictures as {self._input.type}; known are {', '.join(_TYPES)}"
            )
        shape = list(self._input.shape)
        self._has_batch = len(shape) == 4
        *_, first, second, third = shape
        self._channels_last = third == 3 and first != 3
        height, width = (first, second) if self._channels_last else (second, third)
        channels = third if self._channels_last else first
        if isinstance(channels, int) and channels != 3:
            raise InputError(f"{where}: takes pictures of {channels} channels; expected 3")
        self._fixed_px: tuple[int, int] | None = (
            (width, height) if _whole(width) and _whole(height) else None
        )
        batch = shape[0] if self._has_batch else 1
        self.batch: int | None = batch if _whole(batch) else None
        self.properties: dict[str, str] = dict(told)
        self.form = InputFormat()

    def prepare(self, form: InputFormat) -> None:
        """Set the input format of the network."""
        if form.size and self._fixed_px and form.size != self._fixed_px:
            raise InputError(
                f"{self._where}: says that it takes {form.size[0]} x {form.size[1]} px, and takes "
                f"{self._fixed_px[0]} x {self._fixed_px[1]} px; export it again"
            )
        self.form = form
        self.input_px: tuple[int, int] | None = form.size or self._fixed_px
        if self.input_px and not 1 <= min(self.input_px) <= max(self.input_px) <= _LARGEST_PX:
            raise InputError(
                f"{self._where}: takes pictures of {self.input_px[0]} x {self.input_px[1]} px; "
                f"expected 1 to {_LARGEST_PX} px a side"
            )
        shown_px = self.input_px or (_DUMMY_PX, _DUMMY_PX)
        if (self.batch or 1) * shown_px[0] * shown_px[1] > _MOST_PX:
            raise InputError(
                f"{self._where}: takes {self.batch} pictures of {shown_px[0]} x {shown_px[1]} px "
                "at once, more than the memory holds; export it for a batch of one"
            )
        side = -(-_DUMMY_PX // form.stride) * form.stride
        self.dummy_px: tuple[int, int] = self.input_px or (side, side)
        self._blob = cv2.dnn.Image2BlobParams()
        # OpenCV takes the mean first: (x - mean / scale) * (scale / std).
        self._blob.scalefactor = (*(form.scale / s for s in form.std), 0.0)
        self._blob.mean = (*(m / form.scale for m in form.mean), 0.0)
        self._blob.swapRB = form.color == "rgb"

    def try_out(self) -> list[NDArray[Any]]:
        """Outputs for an empty picture."""
        width, height = self.dummy_px
        return self.run([np.zeros((height, width, 3), dtype=np.uint8)])

    def feed(self, canvases: Sequence[NDArray[np.uint8]]) -> dict[str, NDArray[Any]]:
        """Inputs of the network for pictures of one size, (H, W, 3) BGR."""
        blob = self._prepared(canvases)
        feed: dict[str, NDArray[Any]] = {self._input.name: blob}
        if self._sizes is not None:
            height, width = canvases[0].shape[:2]
            feed[_SIZES_INPUT] = np.tile(
                np.array([[width, height]], dtype=np.int64), (len(blob), 1)
            )
        return feed

    def run(self, canvases: Sequence[NDArray[np.uint8]]) -> list[NDArray[Any]]:
        """Outputs for pictures of one size, (H, W, 3) BGR."""
        feed = self.feed(canvases)
        try:
            return [np.asarray(array) for array in self._session.run(None, feed)]
        except Exception as error:
            raise InputError(
                f"{self._where}: cannot be run on a picture of {canvases[0].shape[1]} x "
                f"{canvases[0].shape[0]} px ({_line(error)}); is it a detector?"
            ) from error

    def _prepared(self, canvases: Sequence[NDArray[np.uint8]]) -> NDArray[Any]:
        dtype = _TYPES[self._input.type]
        if dtype is np.uint8:
            flip = slice(None, None, -1) if self.form.color == "rgb" else slice(None)
            blob: NDArray[Any] = np.stack([c[..., flip] for c in canvases]).transpose(0, 3, 1, 2)
        else:
            blob = np.asarray(cv2.dnn.blobFromImagesWithParams(list(canvases), self._blob))
        if self.batch is not None and len(blob) < self.batch:
            # A file made for batches of one size is given one, filled up.
            missing = np.zeros((self.batch - len(blob), *blob.shape[1:]), dtype=blob.dtype)
            blob = np.concatenate([blob, missing])
        if self._channels_last:
            blob = blob.transpose(0, 2, 3, 1)
        if not self._has_batch:
            blob = blob[0]
        return np.ascontiguousarray(blob, dtype=dtype)


def _whole(length: object) -> bool:
    return isinstance(length, int) and length > 0


def _line(error: Exception) -> str:
    """First line of an error of ONNX Runtime."""
    text = " ".join(str(error).split("\n")[0].split())
    return text if len(text) <= 200 else text[:200] + "..."


def available_providers() -> tuple[str, ...]:
    """Those of `PROVIDERS` that the installed ONNX Runtime has."""
    there = _onnxruntime.load().get_available_providers()
    return tuple(name for name, full in PROVIDERS.items() if full in there)


def _session(where: str, options: DetectorOptions) -> Any:
    path = Path(where)
    if not path.is_file():
        raise InputError(f"{where}: there is no such ONNX file")
    if path.stat().st_size == 0:
        raise InputError(f"{where}: is empty")
    check_onnx_file(path)
    available = available_providers()
    wanted = options.provider
    if wanted is not None and wanted not in available:
        raise _no_provider(where, wanted, available)
    if wanted is None:
        chosen = ["cuda", "cpu"] if "cuda" in available else ["cpu"]
    else:
        # What TensorRT cannot do is done by CUDA, and what that cannot by the CPU.
        order = ("tensorrt", "cuda", "cpu")
        chosen = [name for name in order[order.index(wanted) :] if name in available]
    onnxruntime = _onnxruntime.load()
    settings = onnxruntime.SessionOptions()
    settings.log_severity_level = 4
    threads = options.threads or limits.most_threads()
    if threads is not None:
        settings.intra_op_num_threads = threads
    # Threads that wait in a loop keep the decoding of the next frame from the core.
    settings.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # What was checked is what is run; a file that is of another format is refused.
    settings.add_session_config_entry("session.load_model_format", "ONNX")
    try:
        return onnxruntime.InferenceSession(
            where, sess_options=settings, providers=[PROVIDERS[name] for name in chosen]
        )
    except Exception as error:
        raise InputError(
            f"{where}: is no ONNX file that can be run, or is damaged ({_line(error)})"
        ) from error


def _provider(where: str, session: Any, wanted: str | None) -> str:
    """Execution provider of a session; ONNX Runtime falls back without an error."""
    used = session.get_providers()[0]
    name = next((name for name, full in PROVIDERS.items() if full == used), used)
    if wanted is not None and name != wanted:
        raise _no_provider(
            where,
            wanted,
            tuple(n for n, full in PROVIDERS.items() if full in session.get_providers()),
        )
    return name


def _no_provider(where: str, wanted: str, available: Sequence[str]) -> InputError:
    return InputError(
        f"{where}: cannot be run with {wanted}, which this ONNX Runtime or this machine does not "
        f"have; available are {', '.join(available)} (for a GPU install onnxruntime-gpu)"
    )
