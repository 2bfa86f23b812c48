"""Networks that were trained before, from the files that a training or Darknet left."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from sightline.detection.classes import COCO
from sightline.errors import InputError
from sightline.training.architecture import ARCHITECTURES, Trainable, build
from sightline.training.darknet.cfg import PUBLISHED, published, read_cfg
from sightline.training.darknet_family import DarknetDetector, from_files
from sightline.training.loop import CONFIGURATION, WEIGHTS, load_weights

_LONGEST_NAMES = 1_000_000


def load_trained(path: str | os.PathLike[str]) -> Trainable:
    """The network that `detector train` left.

    Args:
        path: Its folder, or the weights in it.

    Raises:
        InputError: There is no such training, or a part of it is damaged.
    """
    path = Path(path)
    folder, weights = (path, path / WEIGHTS) if path.is_dir() else (path.parent, path)
    configuration = folder / CONFIGURATION
    try:
        content: Any = json.loads(configuration.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(
            f"{configuration}: cannot be read: {error.strerror}; it says what network the weights "
            "are of, so keep them together"
        ) from error
    except ValueError as error:
        raise InputError(f"{configuration}: is damaged: no JSON ({error})") from error
    try:
        name, classes = content["architecture"], content["classes"]
        options = dict(content.get("options") or {})
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise InputError(f"{configuration}: does not say which network was trained") from error
    if name not in ARCHITECTURES or not _are_names(classes):
        raise InputError(f"{configuration}: does not say which network was trained")
    # What it began with is not needed for what became of it.
    options.pop("weights", None)
    try:
        trainable = build(name, tuple(classes), **options)
    except TypeError as error:
        raise InputError(f"{configuration}: has options that {name} does not know") from error
    load_weights(weights, trainable)
    trainable.module.eval()
    return trainable


def load_mean(paths: Sequence[str | os.PathLike[str]]) -> Trainable:
    """The mean of the weights of several trainings that began with the same ones.

    Its errors are less those of one training than of what all have in common (Wortsman et al. 2022,
    "model soups").

    Args:
        paths: As for `load_trained`; at least one.

    Raises:
        InputError: As `load_trained`, or they are not of one network.
    """
    first, *others = (load_trained(path) for path in paths)
    mean = first.module.state_dict()
    for path, other in zip(paths[1:], others, strict=True):
        same = {name: value.shape for name, value in other.module.state_dict().items()} == {
            name: value.shape for name, value in mean.items()
        }
        if not same or (other.name, other.class_names) != (first.name, first.class_names):
            raise InputError(
                f"{path}: is not of the same network and classes as {paths[0]}, so their weights "
                "have no mean"
            )
    states = [one.module.state_dict() for one in (first, *others)]
    for name, value in mean.items():
        # Counters of steps are no weights.
        if value.is_floating_point():
            value.copy_(torch.stack([state[name].double() for state in states]).mean(dim=0))
    return first


def load_darknet(
    cfg: str | os.PathLike[str],
    weights: str | os.PathLike[str],
    names: str | os.PathLike[str] | None = None,
) -> DarknetDetector:
    """A network that Darknet trained.

    Args:
        cfg: A ``.cfg``, or the name of a published one.
        weights: The ``.weights`` that belongs to it.
        names: A ``.names``: a class in a line. Absent: COCO's, if there are 80 classes.

    Raises:
        InputError: A file cannot be used, they do not fit each other, or nothing says what the
            classes are.
    """
    network = published(str(cfg)) if str(cfg) in PUBLISHED else read_cfg(cfg)
    if names is not None:
        class_names: Sequence[str] = read_names(names)
        if len(class_names) != network.classes:
            raise InputError(
                f"{names}: has {len(class_names)} names, and {network.source} tells "
                f"{network.classes} classes apart"
            )
    elif network.classes == len(COCO):
        class_names = COCO
    else:
        raise InputError(
            f"{network.source}: tells {network.classes} classes apart, and nothing says which; "
            "name a file with a class in a line: --names FILE"
        )
    return from_files(cfg, weights, class_names)


def read_names(path: str | os.PathLike[str]) -> tuple[str, ...]:
    """The names in a ``.names``: one a line; blank lines at the end are none.

    Raises:
        InputError: It cannot be read, or has no names.
    """
    path = Path(path)
    try:
        content = path.read_bytes() if path.stat().st_size <= _LONGEST_NAMES else b"\0"
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    try:
        lines = [line.strip() for line in content.decode("utf-8-sig").rstrip().splitlines()]
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is no text") from error
    if not lines or b"\0" in content:
        raise InputError(f"{path}: has no names; expected a class in a line")
    if not all(lines) or len(set(lines)) != len(lines):
        raise InputError(f"{path}: has an empty line among the names, or a name twice")
    return tuple(lines)


def _are_names(value: object) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(name, str) for name in value)
