"""From a scene to a detector file: the pictures, the split, the training, and the export."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch

from sightline.errors import InputError
from sightline.scene import Scene
from sightline.training.architecture import build
from sightline.training.augmentation import Augmentation, Batches, BatchSettings
from sightline.training.collage import BatchOf, Collage, CollageBatches, joined
from sightline.training.data import (
    Labels,
    Picture,
    Sprite,
    backgrounds,
    check_folders,
    check_split,
    digest,
    scene_pictures,
    sprites,
    synthetic_pictures,
    vanishing_row_px,
)
from sightline.training.export import export_onnx
from sightline.training.loop import (
    TrainingResult,
    TrainingSettings,
    find_device,
    load_weights,
    train,
)
from sightline.training.photographs import (
    Photograph,
    cut_outs,
    digest_photographs,
    read_backgrounds,
    read_yolo_folder,
)

Tell = Callable[[str, float], None]


@dataclass(frozen=True)
class Photographs:
    """Folders of photographs that a detector learns from besides a scene.

    Attributes:
        pictures: Folders with ``images`` and ``labels`` as YOLO has them; boats in them are cut
            out, and laid on harbours that are made of all the others.
        class_names: Of the folders' labels, by number. Those of the recipe's own names are to be
            found, of ``ignore`` nothing is said, all others are to be told from them.
        backgrounds: Folders of pictures without anything that is to be found.
        share: Of each batch that is made of photographs.
    """

    pictures: tuple[Path, ...] = ()
    class_names: tuple[str, ...] = ("boat", "sailboat")
    backgrounds: tuple[Path, ...] = ()
    share: float = 0.6

    def __post_init__(self) -> None:
        if not 0.0 < self.share < 1.0:
            raise InputError(
                f"a share of {self.share:g} of photographs cannot be; give one between 0 and 1"
            )
        if self.backgrounds and not self.pictures:
            raise InputError(
                "backgrounds are for boats to be laid on; name a folder of pictures with boats too"
            )


@dataclass(frozen=True)
class Recipe:
    """What a detector is made of; the same recipe and data give the same detector.

    Attributes:
        architecture: One of `ARCHITECTURES`.
        train: Names of the recordings that it learns from.
        validation: Names of those by which the best weights are chosen; may be none.
        labels: How boxes become what is learned.
        synthetic: How many rendered pictures there are besides.
        size_px: Width and height of the crops, rounded up to multiples of the network's stride.
        batch: Crops in a batch.
        augmentation: What is done to the pictures.
        training: The loop's settings.
        options: Of the architecture.
        initial: Weights to begin with, as an earlier training wrote them.
        photographs: Folders of photographs to learn from besides.
    """

    architecture: str
    train: tuple[str, ...]
    validation: tuple[str, ...] = ()
    labels: Labels = field(default_factory=Labels)
    synthetic: int = 0
    size_px: tuple[int, int] = (320, 192)
    batch: int = 16
    augmentation: Augmentation = field(default_factory=Augmentation)
    training: TrainingSettings = field(default_factory=TrainingSettings)
    options: Mapping[str, object] = field(default_factory=dict)
    initial: Path | None = None
    photographs: Photographs = field(default_factory=Photographs)

    def __post_init__(self) -> None:
        both = sorted(set(self.train) & set(self.validation))
        if both:
            raise InputError(
                f"recording {both[0]!r} is both for training and for validation; a recording can "
                "be in one part only"
            )
        if self.batch < 1 or min(self.size_px) < 32:
            raise InputError("a batch needs a crop or more, and crops 32 px or more a side")
        if self.photographs.pictures and not 0 < self.from_photographs < self.batch:
            raise InputError(
                f"of a batch of {self.batch}, a share of {self.photographs.share:g} of photographs "
                "leaves one of both without any; take a larger batch, or another share"
            )
        if self.synthetic < 0:
            raise InputError(f"{self.synthetic} synthetic pictures cannot be rendered")

    @property
    def from_photographs(self) -> int:
        """How many pictures of a batch are made of photographs."""
        return round(self.photographs.share * self.batch) if self.photographs.pictures else 0


@dataclass(frozen=True)
class TrainedDetector:
    """What a recipe came to.

    Attributes:
        path: The ONNX file.
        parameters: How many the network has.
        export_difference: Largest difference of the file's outputs from the network's.
        training: How it went.
        data: Pictures, boxes and hashes by part of the split and recording.
    """

    path: Path
    parameters: int
    export_difference: float
    training: TrainingResult
    data: Mapping[str, object]


def train_detector(
    scene: Scene, recipe: Recipe, folder: Path, *, progress: Tell | None = None
) -> TrainedDetector:
    """Train a detector on a scene, and export it.

    The folder gets ``config.json`` (all that is needed to repeat the run), ``history.csv`` (a row a
    validation), ``checkpoint.safetensors``, ``weights.safetensors`` (the best) and ``NAME.onnx``.
    A folder with a checkpoint of the same recipe and data is gone on with.

    Args:
        scene: Camera and recordings.
        recipe: What to do.
        folder: Where the results go; made if it is not there.
        progress: Told what is done, and the share.

    Raises:
        InputError: A part of the split has no boxes, a file or a setting cannot be used, or the
            extra ``train`` is not installed.
        ExportError: The exported file does not agree with the network.
    """
    tell = progress if progress is not None else _silent
    # What is not there is said before pictures are read and folders made.
    find_device(recipe.training.device)
    torch.manual_seed(recipe.training.seed)
    trainable = build(recipe.architecture, recipe.labels.class_names, **recipe.options)
    if recipe.initial is not None:
        load_weights(recipe.initial, trainable)
    stride = trainable.stride
    size = tuple(stride * math.ceil(side / stride) for side in recipe.size_px)
    check_folders(recipe.labels, (*recipe.train, *recipe.validation))
    tell("reading pictures", 0.0)
    train_pictures = scene_pictures(
        scene, recipe.train, recipe.labels, progress=lambda share: tell("reading pictures", share)
    )
    check_split(train_pictures, recipe.train, "train")
    validation = scene_pictures(scene, recipe.validation, recipe.labels)
    if recipe.validation:
        check_split(validation, recipe.validation, "validation")
    rendered = synthetic_pictures(
        recipe.synthetic,
        recipe.training.seed,
        recipe.labels,
        image_size_px=scene.image_size_px,
        progress=lambda share: tell("rendering the synthetic harbour", share),
    )
    tell("cutting out boats", float("nan"))
    pasted = sprites(train_pictures) if recipe.augmentation.paste else []
    data = {
        "train": digest([*train_pictures, *rendered]),
        "validation": digest(validation),
    }
    batches = _scene_batches(recipe, train_pictures, rendered, pasted, (size[0], size[1]))
    if recipe.photographs.pictures:
        boats, others = _read_photographs(recipe)
        data |= {"pictures": digest_photographs(boats), "backgrounds": digest_photographs(others)}
        material = Collage(
            boats,
            others,
            [one.image for one in backgrounds(train_pictures)],
            [*cut_outs(boats), *pasted],
        )
        batches = joined(batches, _made_batches(recipe, material, (size[0], size[1])))
    folder.mkdir(parents=True, exist_ok=True)
    configuration = {
        "scene": scene.path.name,
        "data": data,
        "sprites": len(pasted),
        "margins": {name: str(one) for name, one in recipe.labels.margins.items()},
        "others": recipe.labels.others,
        "size_px": list(size),
        "batch": recipe.batch,
        "augmentation": recipe.augmentation.to_dict(),
        "options": dict(recipe.options),
        "initial": None if recipe.initial is None else _sha256(recipe.initial),
        **_of_photographs(recipe),
    }
    result = train(
        trainable, batches, validation, recipe.training, folder, configuration, progress=progress
    )
    tell("exporting", float("nan"))
    path = folder / f"{recipe.architecture}.onnx"
    difference = export_onnx(
        trainable,
        path,
        size_px=(size[0], size[1]),
        about={
            "trained_on": _listed(recipe.train, scene, recipe),
            "steps": result.best_step,
        },
        pictures=[picture.image for picture in train_pictures[:: -(-len(train_pictures) // 4)]],
    )
    return TrainedDetector(
        path=path,
        parameters=sum(parameter.numel() for parameter in trainable.module.parameters()),
        export_difference=difference,
        training=result,
        data=data,
    )


def _scene_batches(
    recipe: Recipe,
    pictures: Sequence[Picture],
    rendered: Sequence[Picture],
    pasted: Sequence[Sprite],
    size_px: tuple[int, int],
) -> BatchOf:
    return Batches(
        [*pictures, *rendered],
        backgrounds(pictures) if recipe.augmentation.paste else [],
        pasted,
        recipe.augmentation,
        BatchSettings(
            size_px=size_px,
            batch=recipe.batch - recipe.from_photographs,
            seed=recipe.training.seed,
            vanishing_row_px=vanishing_row_px(pictures),
        ),
    )


def _read_photographs(recipe: Recipe) -> tuple[list[Photograph], list[Photograph]]:
    given, wanted = recipe.photographs, recipe.labels.class_names
    boats = [
        one
        for folder in given.pictures
        for one in read_yolo_folder(folder, given.class_names, wanted)
    ]
    return boats, [one for folder in given.backgrounds for one in read_backgrounds(folder)]


def _made_batches(recipe: Recipe, material: Collage, size_px: tuple[int, int]) -> BatchOf:
    return CollageBatches(
        material,
        recipe.augmentation,
        size_px=size_px,
        batch=recipe.from_photographs,
        seed=recipe.training.seed,
    )


def _of_photographs(recipe: Recipe) -> dict[str, object]:
    """What a result depends on; nothing without photographs, as before there were any."""
    if not recipe.photographs.pictures:
        return {}
    return {"made": {"share": recipe.photographs.share}}


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _silent(_what: str, _share: float) -> None:
    return


def _listed(names: Sequence[str], scene: Scene, recipe: Recipe) -> str:
    rendered = f" and {recipe.synthetic} rendered pictures" if recipe.synthetic else ""
    photographs = " and photographs" if recipe.photographs.pictures else ""
    return f"{scene.camera.name} {' '.join(names)}{rendered}{photographs}"
