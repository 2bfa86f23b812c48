"""Train a detector for any harbour: published weights, photographs of boats, and one bay.

    python benchmarks/general_detector.py prepare BOATS YOLOX PHOTOS
    python benchmarks/general_detector.py train SCENE YOLOX PHOTOS BACKGROUNDS OUT [--minutes 38]
        [--steps 2400] [--rate 0.0004] [--mean-decay 0.997] [--share 0.6] [--side-by-side 0.35]
        [--bare 0.3] [--frozen] [--seed 1] [--initial FILE]

BOATS is a folder of photographs of vessels with labels as YOLO has them, YOLOX the published
`yolox_nano.onnx`, BACKGROUNDS a folder of pictures without boats. `prepare` parts the photographs
into those that are learned from and a twelfth that is held out, and marks the vessels that the
published weights find in them and nobody labelled as neither right nor wrong. `train` validates on
harbours that are made of what was held out, and on recordings 10 and 19.
"""

from __future__ import annotations

import argparse
import hashlib
import shutil
from pathlib import Path

import cv2
import numpy as np

from sightline.detection import DetectorOptions, OnnxDetector, TilingSettings
from sightline.overlap import shared_area
from sightline.scene import Scene
from sightline.types import Frame

CLASSES = ("boat", "sailboat")
FOLDER_CLASSES = (*CLASSES, "buoy", "ignore")
LABELS = Path(__file__).parent / "tracks-at-sea"
MARGINS = ("sightline=2.5+16%", "voc=-2", "manual=1", "truth=2.5+16%")
TRAIN, VALIDATION = ("06", "07", "09", "15", "18", "11", "20"), ("10", "19")
FROM_ABOVE = "labeling"
"""Most of these photographs are taken from above, where no camera of a harbour stands."""

SIZE_PX, BATCH = (416, 416), 12
SYNTHETIC, SYNTHETIC_SHARE = 60, 0.2


def prepare(arguments: argparse.Namespace) -> None:
    """Part the photographs, and leave open what nobody labelled."""
    detector = OnnxDetector(
        arguments.yolox,
        options=DetectorOptions(
            classes=("boat",), threshold=0.15, views=TilingSettings(kind="whole")
        ),
    )
    for path in sorted((arguments.boats / "images").glob("*.jpg")):
        number = int(hashlib.sha256(path.stem.encode()).hexdigest(), 16)
        part = arguments.photos / ("held" if number % 12 == 0 else "train")
        image = np.asarray(cv2.imread(str(path)), dtype=np.uint8)
        size = np.tile(image.shape[1::-1], 2)
        text = (arguments.boats / "labels" / f"{path.stem}.txt").read_text(encoding="utf-8")
        lines = [line for line in text.splitlines() if line.strip()]
        shares = np.array([line.split()[1:5] for line in lines], dtype=float).reshape(-1, 4)
        half = shares[:, 2:] / 2.0
        drawn = np.hstack([shares[:, :2] - half, shares[:, :2] + half]) * size
        detector.reset()
        for box in detector.detect(Frame(0, 0.0, image)).xyxy_px.clip(0.0, size):
            area = (box[2:] - box[:2]).prod()
            if (shared_area(drawn, box) < 0.5 * area).all() and area < 0.25 * size[0] * size[1]:
                low, high = box[:2] / size[:2], box[2:] / size[:2]
                values = (*(0.5 * (low + high)), *(high - low))
                lines.append(" ".join(["3", *(f"{value:.5f}" for value in values)]))
        for name in ("images", "labels"):
            (part / name).mkdir(parents=True, exist_ok=True)
        shutil.copy(path, part / "images" / path.name)
        (part / "labels" / f"{path.stem}.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


def train(arguments: argparse.Namespace) -> None:
    """Train, and export."""
    # Heavy, and needed by nothing else.
    from sightline.training.architecture import build
    from sightline.training.augmentation import Augmentation, Batches, BatchSettings
    from sightline.training.collage import Collage, CollageBatches, joined
    from sightline.training.data import (
        Labels,
        Picture,
        backgrounds,
        parse_margins,
        scene_pictures,
        sprites,
        synthetic_pictures,
        vanishing_row_px,
    )
    from sightline.training.export import export_onnx
    from sightline.training.loop import TrainingSettings, load_weights
    from sightline.training.loop import train as learn
    from sightline.training.photographs import cut_outs, read_backgrounds, read_yolo_folder

    scene = Scene.load(arguments.scene)
    labels = Labels(CLASSES, (LABELS,), margins=parse_margins(MARGINS))
    pictures = scene_pictures(scene, TRAIN, labels)
    validation = scene_pictures(scene, VALIDATION, labels)[::3]
    rendered = synthetic_pictures(SYNTHETIC, 0, labels)
    boats, held = (
        [
            one
            for one in read_yolo_folder(arguments.photos / part, FOLDER_CLASSES, CLASSES)
            if not one.name.startswith(FROM_ABOVE)
        ]
        for part in ("train", "held")
    )
    others = read_backgrounds(arguments.backgrounds)
    medians = backgrounds(pictures)
    plain = Augmentation()

    def made(material: Collage, batch: int, seed: int) -> CollageBatches:
        return CollageBatches(material, plain, size_px=SIZE_PX, batch=batch, seed=seed)

    unseen = made(Collage(held, others[::6], [], cut_outs(held)), 8, 99)
    for number in range(8):
        images, targets = unseen(number)
        for i, (image, target) in enumerate(zip(images, targets, strict=True)):
            validation.append(
                Picture(
                    "made",
                    8 * number + i,
                    (image.numpy().transpose(1, 2, 0) * 255.0).astype(np.uint8),
                    target.boxes_xyxy_px.numpy(),
                    target.labels.numpy(),
                    target.ignore.numpy(),
                    np.ones(len(target.labels), np.float32),
                    real=False,
                )
            )
    from_photographs = round(arguments.share * BATCH)
    settings = BatchSettings(
        size_px=SIZE_PX,
        batch=BATCH - from_photographs,
        seed=arguments.seed,
        vanishing_row_px=vanishing_row_px(pictures),
        synthetic_share=SYNTHETIC_SHARE,
    )
    own = sprites(pictures)
    bay = Batches([*pictures, *rendered], medians, own, plain, settings)
    material = Collage(
        boats,
        [one for i, one in enumerate(others) if i % 6],
        [one.image for one in medians],
        [*cut_outs(boats), *own],
        arguments.side_by_side,
        arguments.bare,
    )
    trainable = build("yolox-nano", CLASSES, weights=str(arguments.yolox), frozen=arguments.frozen)
    if arguments.initial:
        load_weights(arguments.initial, trainable)
    arguments.out.mkdir(parents=True, exist_ok=True)
    result = learn(
        trainable,
        joined(bay, made(material, from_photographs, arguments.seed)),
        validation,
        TrainingSettings(
            steps=arguments.steps,
            minutes=arguments.minutes,
            rate=arguments.rate,
            warmup=100,
            mean_decay=arguments.mean_decay,
            validate_every=300,
            checkpoint_every=50,
            seed=arguments.seed,
            precision="bfloat16",
            threads=1,
        ),
        arguments.out,
        {"share": arguments.share},
        progress=lambda line, _: print(line, flush=True),
    )
    print(result.history[-1])
    export_onnx(
        trainable,
        arguments.out / "yolox-nano.onnx",
        size_px=SIZE_PX,
        pictures=[one.image for one in pictures[::20]],
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parts = parser.add_subparsers(required=True)
    first = parts.add_parser("prepare")
    for name in ("boats", "yolox", "photos"):
        first.add_argument(name, type=Path)
    first.set_defaults(run=prepare)
    second = parts.add_parser("train")
    for name in ("scene", "yolox", "photos", "backgrounds", "out"):
        second.add_argument(name, type=Path)
    second.add_argument("--minutes", type=float, default=38.0)
    second.add_argument("--steps", type=int, default=2400)
    second.add_argument("--rate", type=float, default=4e-4)
    second.add_argument("--mean-decay", type=float, default=0.997)
    second.add_argument("--share", type=float, default=0.6)
    second.add_argument("--side-by-side", type=float, default=0.35)
    second.add_argument("--bare", type=float, default=0.3)
    second.add_argument("--frozen", action="store_true")
    second.add_argument("--seed", type=int, default=1)
    second.add_argument("--initial", type=Path)
    second.set_defaults(run=train)
    arguments = parser.parse_args()
    arguments.run(arguments)


if __name__ == "__main__":
    main()
