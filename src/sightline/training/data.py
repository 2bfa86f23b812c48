"""What a detector learns from: pictures of a scene with boxes, rendered ones, and cut-out boats."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.errors import InputError
from sightline.formats import _files
from sightline.formats._box_table import refuse_empty
from sightline.formats.labels import EMPTY_TABLE, Margin, empty_frames, parse_margins, tables_folder
from sightline.scene import Recording, Scene
from sightline.simulation import Harbour, HarbourSettings, Renderer
from sightline.text import text_of_cell
from sightline.types import BoolArray, Boxes, FloatArray, IntArray, Rows

Image = NDArray[np.uint8]

SYNTHETIC = "synthetic"
"""Recording of rendered pictures."""

_KINDS = {"motorboat": "boat", "ferry": "boat", "dinghy": "boat", "sailboat": "sailboat"}
"""What the boats of the synthetic harbour count as."""

_PICTURES_A_HARBOUR = 12
_RING = 0.75
"""How far around a box its background is known to be empty, in widths and heights of the box."""

_SPRITE_MARGIN = 0.25
_CONTRAST = 26.0
_LEAST_ROWS_PX = 10.0


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture and what is known to be in it.

    Attributes:
        recording: The recording that it is from.
        frame: Its number there.
        image: (H, W, 3) uint8, red, green, blue.
        boxes_xyxy_px: (M, 4) float32.
        labels: (M,) int64, positions in the class names.
        ignore: (M,) bool: regions in which there may be more that nobody labelled.
        worth: (M,) float32, the share of the full score that is taught.
        real: False for rendered pictures.
    """

    recording: str
    frame: int
    image: Image
    boxes_xyxy_px: NDArray[np.float32]
    labels: IntArray
    ignore: BoolArray
    worth: NDArray[np.float32]
    real: bool = True

    @cached_property
    def digest(self) -> str:
        """A hash of the picture and of its boxes."""
        digest = hashlib.sha256(f"{self.recording} {self.frame} {self.image.shape}".encode())
        for part in (self.image, self.boxes_xyxy_px, self.labels, self.ignore, self.worth):
            digest.update(np.ascontiguousarray(part).tobytes())
        return digest.hexdigest()[:16]


@dataclass(frozen=True, eq=False)
class Sprite:
    """A boat cut out of its picture.

    Attributes:
        recording: Where it is from.
        image: (h, w, 3) uint8, red, green, blue.
        opacity: (h, w) float32, 0 to 1.
        box_xyxy_px: (4,) the boat's box in the sprite.
        waterline_px: Row of the lower edge of the box in the picture that it is from.
        label: Position in the class names.
        worth: The share of the full score that is taught.
    """

    recording: str
    image: Image
    opacity: NDArray[np.float32]
    box_xyxy_px: FloatArray
    waterline_px: float
    label: int
    worth: float = 1.0


@dataclass(frozen=True)
class Labels:
    """How boxes become what is learned.

    Attributes:
        class_names: What is told apart; boxes without a label are of the first class.
        folders: With tables ``NAME.csv`` (``frame,x1,y1,x2,y2`` and, where they are known,
            ``annotator``, ``label`` and ``target``) and ``empty.csv`` (``recording,frame``) of
            frames without the target. Where they name a frame, the scene's own boxes of it are not
            used. A table in which every ``target`` is 1 names the target alone; any other names
            all that is to be seen.
        others: The share of the full score that is taught for boxes of the first class whose
            ``target`` is 0. Below 1, what looks like the target is found with more confidence than
            what is merely of its kind.
        margins: By source of boxes, what is added on every side. Annotators differ in how close
            they draw, and a network that learns from several wants one bias.
        ignored_names: Labels of things that are neither to be found nor wrong to find.
    """

    class_names: tuple[str, ...] = ("boat", "sailboat")
    folders: tuple[Path, ...] = ()
    others: float = 1.0
    margins: Mapping[str, Margin] = field(default_factory=dict)
    ignored_names: tuple[str, ...] = ("ignore",)

    def __post_init__(self) -> None:
        if not 0.0 < self.others <= 1.0:
            raise InputError(
                f"other boats cannot be taught {self.others:g} of the full score; give a share "
                "above 0 and up to 1"
            )


@dataclass(frozen=True, eq=False)
class _Known:
    """Columns of `Picture`."""

    boxes_xyxy_px: FloatArray
    labels: IntArray
    ignore: BoolArray
    worth: FloatArray

    def __getitem__(self, rows: Rows) -> _Known:
        return _Known(
            self.boxes_xyxy_px[rows], self.labels[rows], self.ignore[rows], self.worth[rows]
        )

    def with_open(self, regions: FloatArray) -> _Known:
        """And regions of which nothing is known."""
        n = len(regions)
        return _Known(
            np.concatenate([self.boxes_xyxy_px, regions]),
            np.concatenate([self.labels, np.zeros(n, dtype=np.int64)]),
            np.concatenate([self.ignore, np.ones(n, dtype=bool)]),
            np.concatenate([self.worth, np.ones(n)]),
        )


@dataclass(frozen=True, eq=False)
class _Table:
    """Boxes of a recording, and which of them are of the target."""

    boxes: Boxes
    target: BoolArray
    complete: bool


def scene_pictures(
    scene: Scene,
    names: Sequence[str],
    labels: Labels,
    *,
    progress: Callable[[float], None] | None = None,
) -> list[Picture]:
    """The pictures of some recordings about which something is known.

    Args:
        scene: The scene.
        names: Of the recordings.
        labels: How boxes become what is learned.
        progress: Called with the share done.

    Raises:
        InputError: A recording is unknown, cannot be read, or a table of boxes does not fit.
    """
    chosen = [scene[name] for name in names]
    pictures: list[Picture] = []
    for i, recording in enumerate(chosen):
        pictures += _recording_pictures(recording, labels)
        if progress is not None:
            progress((i + 1) / len(chosen))
    return pictures


def check_folders(labels: Labels, names: Sequence[str]) -> None:
    """Refuse a folder of tables in which there is none of the recordings in hand.

    Raises:
        InputError: There is such a folder, or it is none.
    """
    for folder in labels.folders:
        inner = _inner(folder)
        if names and not any((inner / f"{name}.csv").exists() for name in names):
            raise InputError(
                f"{inner}: has no table of boxes of any recording in hand ({', '.join(names)}); "
                f"expected some as {names[0]}.csv"
            )


def check_split(train: Sequence[Picture], names: Sequence[str], what: str) -> None:
    """Refuse a part of a split in which nothing is to be found.

    Raises:
        InputError: There is no box that counts.
    """
    if not any(len(picture.labels) and not picture.ignore.all() for picture in train):
        listed = ", ".join(names) if names else "none"
        raise InputError(
            f"the recordings for {what} ({listed}) have no boxes in pictures that exist; "
            f"name others with --{what}, or add boxes to the scene"
        )


def _recording_pictures(recording: Recording, labels: Labels) -> list[Picture]:
    drawn = recording.boxes() if recording.boxes_path is not None else None
    tables, empty = _tables(recording, labels)
    named = empty.union(*(table.boxes.frame.tolist() for table in tables))
    known = named.union([] if drawn is None else drawn.frame.tolist())
    if recording.source is None or not known:
        return []
    complete = not tables or any(table.complete for table in tables)
    pictures = []
    for frame in recording.frames():
        if frame.index not in known:
            continue
        image = np.ascontiguousarray(frame.image_bgr[..., ::-1])
        if frame.index in named:
            boxes = _frame_boxes(frame.index, tables, labels)
        else:
            # Those of a scene are all of its target, whoever drew them.
            assert drawn is not None
            own = _Table(drawn, np.ones(len(drawn), dtype=bool), complete=False)
            boxes = _merged(_frame_boxes(frame.index, [own], labels))
        whole = complete and frame.index in named
        if whole or len(boxes.labels):
            pictures.append(_picture(recording.name, frame.index, image, boxes, whole))
    return pictures


def _tables(recording: Recording, labels: Labels) -> tuple[list[_Table], set[int]]:
    """The tables of a recording, and its frames without the target."""
    tables: list[_Table] = []
    empty: set[int] = set()
    for folder in labels.folders:
        path = _inner(folder) / f"{recording.name}.csv"
        without: set[int] = set()
        if (folder / EMPTY_TABLE).exists():
            without = set(empty_frames(folder / EMPTY_TABLE, recording.name).tolist())
        if path.exists():
            tables.append(_table(path, may_be_empty=bool(without)))
        empty |= without
    return tables, empty


def _inner(folder: Path) -> Path:
    if not folder.is_dir():
        raise InputError(f"{folder}: is no folder; expected one with tables of boxes, as 07.csv")
    return tables_folder(folder)


def _table(path: Path, may_be_empty: bool) -> _Table:
    corners = ("x1", "y1", "x2", "y2")
    rows = next(_files.table(path, required=("frame", *corners), text=("annotator", "label")))
    if not len(rows) and not may_be_empty:
        raise InputError(
            f"{path}: has a header and no boxes; add some, or remove the file, or name its frames "
            f"without the target in {EMPTY_TABLE}"
        )
    xyxy_px = np.column_stack([_files.numbers(path, rows[name]) for name in corners])
    refuse_empty(path, rows.index, xyxy_px)

    def text(column: str) -> list[str] | str:
        if column not in rows:
            return ""
        return [text_of_cell(cell) for cell in rows[column].fillna("").astype(str).str.strip()]

    frames = _files.whole_numbers(path, rows["frame"])
    boxes = Boxes.of(xyxy_px, frame=frames, source=text("annotator"), label=text("label"))
    if "target" not in rows:
        return _Table(boxes, np.ones(len(boxes), dtype=bool), complete=True)
    target = np.asarray(_files.whole_numbers(path, rows["target"]) != 0)
    return _Table(boxes, target, complete=not target.all())


def _frame_boxes(frame: int, tables: Sequence[_Table], labels: Labels) -> _Known:
    """What is known of a frame."""
    position = {name: i for i, name in enumerate(labels.class_names)}
    corners: list[FloatArray] = []
    kinds: list[int] = []
    ignored: list[bool] = []
    worth: list[float] = []
    for table in tables:
        boxes = table.boxes
        for row in np.flatnonzero(boxes.frame == frame):
            name, source = str(boxes.label[row]), str(boxes.source[row])
            ignore = name in labels.ignored_names
            kind = position.get(name or labels.class_names[0], -1)
            if kind < 0 and not ignore:
                # Something else: to be told from what is looked for, so it is background.
                continue
            corners.append(labels.margins.get(source, Margin()).widened(boxes.xyxy_px[row]))
            kinds.append(max(kind, 0))
            ignored.append(ignore)
            worth.append(labels.others if kind == 0 and not table.target[row] else 1.0)
    return _Known(
        np.array(corners, dtype=float).reshape(-1, 4),
        np.array(kinds, dtype=np.int64),
        np.array(ignored, dtype=bool),
        np.array(worth, dtype=float),
    )


def _merged(known: _Known) -> _Known:
    """One box for those that are of one boat: their mean, or the larger where one is a part."""
    corners = known.boxes_xyxy_px
    used = np.zeros(len(corners), dtype=bool)
    boxes, first = [], []
    areas = (corners[:, 2:] - corners[:, :2]).prod(axis=1)
    for i in np.argsort(-areas, kind="stable"):
        if used[i]:
            continue
        low = np.maximum(corners[:, :2], corners[i, :2])
        high = np.minimum(corners[:, 2:], corners[i, 2:])
        shared = np.maximum(high - low, 0.0).prod(axis=1)
        same = ~used & (shared / (areas + areas[i] - shared) > 0.4)
        part = ~used & (shared > 0.9 * areas)
        used |= same | part
        boxes.append(corners[same].mean(axis=0))
        first.append(int(i))
    chosen = known[np.array(first, dtype=np.int64)]
    return replace(chosen, boxes_xyxy_px=np.array(boxes, dtype=float).reshape(-1, 4))


def _picture(
    recording: str, frame: int, image: Image, known: _Known, whole: bool, real: bool = True
) -> Picture:
    height, width = image.shape[:2]
    if not whole:
        known = known.with_open(_around(known.boxes_xyxy_px[~known.ignore], width, height))
    boxes = known.boxes_xyxy_px.clip(0.0, [width, height, width, height])
    kept = ((boxes[:, 2:] - boxes[:, :2]) > 1.0).all(axis=1)
    return Picture(
        recording=recording,
        frame=frame,
        image=image,
        boxes_xyxy_px=boxes[kept].astype(np.float32),
        labels=known.labels[kept],
        ignore=known.ignore[kept],
        worth=known.worth[kept].astype(np.float32),
        real=real,
    )


def _around(boxes: FloatArray, width: int, height: int) -> FloatArray:
    """(4, 4) what lies left of, right of, above and below the boxes and a ring around them."""
    if not len(boxes):
        return np.array([[0.0, 0.0, width, height]])
    x1, y1 = boxes[:, :2].min(axis=0)
    x2, y2 = boxes[:, 2:].max(axis=0)
    ring_x, ring_y = _RING * (boxes[:, 2:] - boxes[:, :2]).max(axis=0)
    x1, x2, y1, y2 = x1 - ring_x, x2 + ring_x, y1 - ring_y, y2 + ring_y
    return np.array(
        [
            [0.0, 0.0, x1, height],
            [x2, 0.0, width, height],
            [x1, 0.0, x2, y1],
            [x1, y2, x2, height],
        ]
    )


def backgrounds(pictures: Sequence[Picture]) -> list[Picture]:
    """The median of each recording's pictures, which has no boats that move.

    Args:
        pictures: Of recordings; rendered ones and recordings with fewer than five are left out.

    Returns:
        One picture a recording, with nothing in it.
    """
    made = []
    for name in dict.fromkeys(picture.recording for picture in pictures if picture.real):
        own = [picture for picture in pictures if picture.real and picture.recording == name]
        if len(own) >= 5:
            image = _median([picture.image for picture in own])
            made.append(
                Picture(
                    name,
                    -1,
                    image,
                    np.zeros((0, 4), np.float32),
                    np.zeros(0, np.int64),
                    np.zeros(0, bool),
                    np.zeros(0, np.float32),
                )
            )
    return made


def _median(images: list[Image]) -> Image:
    thinned = images[:: max(1, len(images) // 25)]
    parts = []
    # A few rows at a time, so that the stack stays small.
    for top in range(0, thinned[0].shape[0], 64):
        stack = np.stack([image[top : top + 64] for image in thinned])
        parts.append(np.median(stack, axis=0).astype(np.uint8))
    return np.concatenate(parts)


def sprites(pictures: Sequence[Picture]) -> list[Sprite]:
    """The boats of real pictures, cut out along their difference from the recording's median.

    Boats that touch the picture's border, or another box, are left out.
    """
    medians = {picture.recording: picture.image for picture in backgrounds(pictures)}
    found = []
    for picture in pictures:
        background = medians.get(picture.recording)
        if background is None or not picture.real:
            continue
        height, width = picture.image.shape[:2]
        boxes = picture.boxes_xyxy_px[~picture.ignore]
        labels, worth = picture.labels[~picture.ignore], picture.worth[~picture.ignore]
        for i, (x1, y1, x2, y2) in enumerate(boxes.astype(float)):
            inside = x1 > 2 and y1 > 2 and x2 < width - 2 and y2 < height - 2
            others = np.delete(boxes, i, axis=0)
            touches = (
                (others[:, 0] < x2)
                & (others[:, 2] > x1)
                & (others[:, 1] < y2)
                & (others[:, 3] > y1)
            ).any()
            if not inside or touches:
                continue
            sprite = _cut(picture, background, np.array([x1, y1, x2, y2]), int(labels[i]))
            if sprite is not None:
                found.append(replace(sprite, worth=float(worth[i])))
    return found


def _cut(picture: Picture, background: Image, box: FloatArray, label: int) -> Sprite | None:
    height, width = picture.image.shape[:2]
    margin = np.maximum(4.0, _SPRITE_MARGIN * (box[2:] - box[:2]))
    low = np.floor(np.maximum(box[:2] - margin, 0.0)).astype(int)
    high = np.ceil(np.minimum(box[2:] + margin, [width, height])).astype(int)
    window = (slice(low[1], high[1]), slice(low[0], high[0]))
    image = picture.image[window]
    own = box - np.tile(low, 2)
    contrast = cv2.absdiff(image, background[window]).max(axis=2).astype(np.float32)
    contrast = np.asarray(cv2.GaussianBlur(contrast, (0, 0), 1.0))
    solid = (contrast > _CONTRAST).astype(np.uint8)
    solid = np.asarray(cv2.morphologyEx(solid, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)))
    x = np.arange(image.shape[1]) + 0.5
    y = np.arange(image.shape[0]) + 0.5
    # Nothing of the neighbourhood comes along: opacity falls off outside the box.
    reach = 0.5 * margin
    across = np.clip(1.0 - np.maximum(own[0] - x, x - own[2]) / reach[0], 0.0, 1.0)
    along = np.clip(1.0 - np.maximum(own[1] - y, y - own[3]) / reach[1], 0.0, 1.0)
    inside = solid[int(own[1]) : int(own[3]) + 1, int(own[0]) : int(own[2]) + 1]
    if inside.mean() < 0.12:
        return None
    solid = np.asarray(cv2.dilate(solid, np.ones((3, 3), np.uint8)))
    soft = np.asarray(cv2.GaussianBlur(solid.astype(np.float32), (0, 0), 0.9))
    opacity = (soft * across[None, :] * along[:, None]).astype(np.float32)
    return Sprite(picture.recording, image.copy(), opacity, own, float(box[3]), label)


def vanishing_row_px(pictures: Sequence[Picture]) -> float | None:
    """The row where boats would be without size: heights grow about in proportion from there.

    Returns:
        None where the boxes do not tell.
    """
    chosen = [p.boxes_xyxy_px[~p.ignore & (p.labels == 0)] for p in pictures if p.real]
    boxes = np.concatenate([np.zeros((0, 4), np.float32), *chosen]).astype(float)
    if len(boxes) < 8 or np.ptp(boxes[:, 3]) < _LEAST_ROWS_PX:
        return None
    heights, rows = boxes[:, 3] - boxes[:, 1], boxes[:, 3]
    if np.corrcoef(heights, rows)[0, 1] < 0.3:
        return None
    # Both are noisy, so the line is the reduced major axis.
    return float(rows.mean() - rows.std() / heights.std() * heights.mean())


def synthetic_pictures(
    count: int,
    seed: int,
    labels: Labels,
    *,
    image_size_px: tuple[int, int] = (1280, 720),
    progress: Callable[[float], None] | None = None,
) -> list[Picture]:
    """Pictures of several synthetic harbours with every boat's exact box.

    Args:
        count: How many.
        seed: The same seed gives the same pictures.
        labels: Class names and margins; the source of the boxes is ``"truth"``.
        image_size_px: Width and height.
        progress: Called with the share done.
    """
    position = {name: i for i, name in enumerate(labels.class_names)}
    margin = labels.margins.get("truth", Margin())
    made: list[Picture] = []
    rng = np.random.default_rng([seed, 11])
    while len(made) < count:
        harbour = Harbour.random(
            int(rng.integers(2**31)),
            HarbourSettings(
                duration_s=240.0,
                image_size_px=image_size_px,
                motorboats=int(rng.integers(1, 6)),
                sailboats=int(rng.integers(0, 7)),
                ferries=int(rng.integers(0, 2)),
                anchored=int(rng.integers(0, 4)),
                gulls=int(rng.integers(0, 10)),
            ),
        )
        renderer = Renderer(harbour)
        times = harbour.start_utc_s + np.linspace(1.0, 239.0, _PICTURES_A_HARBOUR)
        for time_utc_s in times[: count - len(made)]:
            image = np.ascontiguousarray(renderer.image(float(time_utc_s))[..., ::-1])
            seen = harbour.boxes([time_utc_s], of="all")
            kinds = [_KINDS[str(label)] for label in seen.label]
            numbers = np.array([position.get(kind, -1) for kind in kinds], dtype=np.int64)
            boxes = margin.widened(seen.xyxy_px)
            hidden = [
                harbour.outlines_px(boat, [time_utc_s])[0]
                for boat in harbour.boats
                if boat.identity not in seen.track_id
            ]
            hidden_boxes = np.array(hidden, dtype=float).reshape(-1, 4)
            hidden_boxes = hidden_boxes[np.isfinite(hidden_boxes).all(axis=1)]
            everything = _Known(boxes, numbers, numbers < 0, np.ones(len(numbers)))
            everything = everything[~everything.ignore].with_open(hidden_boxes)
            made.append(_picture(SYNTHETIC, len(made), image, everything, whole=True, real=False))
            if progress is not None:
                progress(len(made) / count)
    return made


def digest(pictures: Sequence[Picture]) -> dict[str, object]:
    """How many pictures and boxes there are, and a hash of them all, by recording."""
    result: dict[str, object] = {}
    for name in dict.fromkeys(picture.recording for picture in pictures):
        own = [picture for picture in pictures if picture.recording == name]
        joined = hashlib.sha256("".join(picture.digest for picture in own).encode())
        result[name] = {
            "pictures": len(own),
            "boxes": int(sum((~picture.ignore).sum() for picture in own)),
            "sha256": joined.hexdigest(),
        }
    return result


__all__ = [
    "SYNTHETIC",
    "Labels",
    "Margin",
    "Picture",
    "Sprite",
    "backgrounds",
    "check_split",
    "digest",
    "parse_margins",
    "scene_pictures",
    "sprites",
    "synthetic_pictures",
    "vanishing_row_px",
]
