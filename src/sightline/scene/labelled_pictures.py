"""Labelled pictures of a folder, with the detections in them: no scene, no times, any cameras."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sightline.detection import Detector, OnnxDetector
from sightline.errors import InputError, unknown_name
from sightline.evaluation.detection import JudgedFrame
from sightline.formats.picture_labels import (
    PictureLabels,
    find_class_names,
    read_coco_labels,
    read_yolo_labels,
)
from sightline.tally import Tally
from sightline.types import Boxes, Frame
from sightline.video.pictures import PICTURE_SUFFIXES, read_picture

_IMAGES, _LABELS = "images", "labels"
_PREFIX = re.compile(r"^(.+?)[-_]")


@dataclass(frozen=True, eq=False)
class LabelledPicture:
    """A picture, and the boxes that were drawn in it.

    Attributes:
        name: Its path within the folder, with forward slashes.
        path: The file.
        labels: What was drawn in it.
    """

    name: str
    path: Path
    labels: PictureLabels

    @property
    def prefix(self) -> str:
        """The folder that it lies in, or else its name up to the first hyphen or underscore."""
        folder, _, name = self.name.rpartition("/")
        if folder:
            return folder
        found = _PREFIX.match(name)
        return found[1] if found else Path(name).stem


@dataclass(frozen=True, eq=False)
class LabelledPictures:
    """Pictures with labels, all of which have been read.

    Attributes:
        where: The folder or the file of labels, for messages.
        pictures: In the order of their names.
        tally: What was read, and what was not used.
        files: All files that were read or will be.
    """

    where: str
    pictures: tuple[LabelledPicture, ...]
    tally: Tally
    files: tuple[Path, ...] = field(default=())

    @property
    def classes(self) -> tuple[str, ...]:
        """Classes of all labels, in order."""
        return tuple(sorted({str(name) for one in self.pictures for name in one.labels.label}))


def labelled_pictures(
    path: str | os.PathLike[str],
    labels: str | os.PathLike[str] | None = None,
    classes: Sequence[str] | None = None,
) -> LabelledPictures:
    """The pictures of a folder with YOLO's labels or COCO's, or those that a COCO file lists.

    YOLO's labels, ``NAME.txt``, lie beside the pictures, or in ``labels`` where the pictures are in
    ``images``; a picture without one has nothing in it. COCO's file is the only ``.json`` of the
    folder, or of its ``annotations``.

    Args:
        path: A folder, or a COCO file; its pictures lie beside it, in ``images`` beside it, or in
            the folder above.
        labels: A folder of YOLO's labels or a COCO file, where they lie elsewhere.
        classes: Names of YOLO's classes, in the order of their numbers. Absent: from
            ``classes.txt`` or ``data.yaml``.

    Raises:
        InputError: There are no pictures or no labels, or they cannot be used.
    """
    given = Path(path)
    if not given.exists():
        raise InputError(f"{path}: there is no such folder of pictures, scene or COCO file")
    if labels is not None and not Path(labels).exists():
        raise InputError(f"{labels}: there is no such folder of labels or COCO file")
    if given.is_file():
        if labels is not None:
            raise InputError(f"{path}: is a file of labels itself; leave --labels out")
        return _of_coco(given, _coco_folders(given.parent), classes)
    if labels is not None and Path(labels).is_file():
        return _of_coco(Path(labels), [given / _IMAGES, given], classes)
    if labels is None:
        listed = _coco_file(given)
        if listed is not None:
            return _of_coco(listed, _coco_folders(given), classes)
    return _of_yolo(given, None if labels is None else Path(labels), classes)


def _of_yolo(folder: Path, labels: Path | None, classes: Sequence[str] | None) -> LabelledPictures:
    root = folder / _IMAGES if (folder / _IMAGES).is_dir() else folder
    pictures = _pictures_in(root)
    if not pictures:
        raise InputError(
            f"{folder}: holds no picture; expected {', '.join(PICTURE_SUFFIXES)} in it or in "
            f"{_IMAGES}"
        )
    if labels is None:
        aside = [folder / _LABELS, folder.parent / _LABELS if folder.name == _IMAGES else root]
        labels = next((one for one in aside if one.is_dir()), root)
    names = classes or find_class_names([labels, folder, root, folder.parent])
    tally = Tally(folder)
    found, files = [], []
    for name, path in pictures.items():
        text = (labels / name).with_suffix(".txt")
        if text.is_file():
            known = read_yolo_labels(text, names)
            files.append(text)
        else:
            known = PictureLabels.none()
        found.append(LabelledPicture(name, path, known))
    if not files:
        raise InputError(
            f"{folder}: no picture has labels; expected NAME.txt as YOLO has them beside NAME.jpg "
            f"or in {_LABELS}, or a COCO file (--labels FILE.json)"
        )
    bare = len(pictures) - len(files)
    if bare:
        tally.note(f"{bare} pictures have no labels, and are taken to hold nothing")
    known_texts = {path.resolve() for path in files}
    lonely = [
        path
        for path in sorted(labels.rglob("*.txt"))
        if path.name != "classes.txt" and path.resolve() not in known_texts
    ]
    tally.leave_out("labels without a picture", len(lonely), row=lonely[0].name if lonely else "")
    return LabelledPictures(str(folder), tuple(found), tally, (*pictures.values(), *files))


def _pictures_in(folder: Path) -> dict[str, Path]:
    """Pictures of a folder and those within it, by their paths in it."""
    found = [
        path
        for path in folder.rglob("*")
        if path.suffix.lower() in PICTURE_SUFFIXES
        and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    ]
    return {path.relative_to(folder).as_posix(): path for path in sorted(found)}


def _coco_file(folder: Path) -> Path | None:
    """The COCO file of a folder that has no labels of YOLO's; None where there is none.

    Raises:
        InputError: There are several.
    """
    if (folder / _LABELS).is_dir():
        return None
    for place in (folder, folder / "annotations", folder / _IMAGES):
        several = sorted(place.glob("*.json")) if place.is_dir() else []
        if len(several) == 1:
            return several[0]
        if several:
            raise InputError(
                f"{place}: holds {len(several)} files of labels ({several[0].name}, "
                f"{several[1].name}, ...); name one with --labels"
            )
    return None


def _coco_folders(beside: Path) -> list[Path]:
    return [beside, beside / _IMAGES, beside.parent, beside.parent / _IMAGES]


def _of_coco(
    path: Path, folders: Sequence[Path], classes: Sequence[str] | None
) -> LabelledPictures:
    if classes is not None:
        raise InputError(f"{path}: names its classes itself; leave --label-classes out")
    listed = read_coco_labels(path)
    if not listed:
        raise InputError(f"{path}: lists no picture")
    found = []
    for name, known in sorted(listed.items()):
        at = next((one / name for one in folders if (one / name).is_file()), None)
        if at is None:
            looked = ", ".join(str(one) for one in folders if one.is_dir())
            raise InputError(f"{path}: lists {name}, which is not in {looked}")
        found.append(LabelledPicture(Path(name).as_posix(), at, known))
    files = (path, *(one.path for one in found))
    return LabelledPictures(str(path), tuple(found), Tally(path), files)


def chosen_targets(
    pictures: LabelledPictures, detector: Detector, targets: Sequence[str] | None
) -> tuple[str, ...]:
    """Classes of the labels that are to be found.

    Args:
        pictures: With their labels.
        detector: Whose classes they may share.
        targets: What somebody asks for. Absent: the classes that the detector looks for by the same
            name, or all where there is none.

    Raises:
        InputError: One that is asked for is that of no label.
    """
    known = pictures.classes
    for name in targets or ():
        if name not in known:
            raise unknown_name(f"class of the labels in {pictures.where}", name, known)
    if targets is not None:
        return tuple(targets)
    sought = detector.wanted if isinstance(detector, OnnxDetector) else ()
    return tuple(name for name in known if name in sought) or known


def detect_pictures(
    pictures: LabelledPictures,
    detector: Detector,
    targets: Iterable[str],
    *,
    least_height_px: float = 0.0,
    others_false: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> list[JudgedFrame]:
    """Detections in each of the pictures, which have nothing to do with one another.

    Args:
        pictures: With their labels.
        detector: It forgets each picture before the next.
        targets: Classes that are to be found; boxes of others are neither right nor wrong.
        least_height_px: And so are boxes that are lower.
        others_false: To find a box of another class is an error.
        progress: Told how far it is.

    Raises:
        InputError: A picture cannot be read, or is of another size than its labels say.
    """
    wanted = list(targets)
    judged = []
    for number, one in enumerate(pictures.pictures):
        if progress:
            progress(one.name, number / len(pictures.pictures))
        image = read_picture(one.path)
        try:
            drawn = one.labels.in_pixels((image.shape[1], image.shape[0]))
        except InputError as error:
            raise InputError(f"{one.path}: {error}") from error
        detector.reset()
        found: Boxes = detector.detect(Frame(number, float("nan"), image))
        ours = np.isin(one.labels.label, wanted)
        stays = ours | ~np.full(len(ours), others_false)
        low = drawn[:, 3] - drawn[:, 1] < least_height_px
        judged.append(
            JudgedFrame(
                name=one.name,
                truth_xyxy_px=drawn[stays],
                ignored=(~ours | low | one.labels.crowd)[stays],
                found_xyxy_px=found.xyxy_px,
                confidence=found.confidence,
            )
        )
    return judged
