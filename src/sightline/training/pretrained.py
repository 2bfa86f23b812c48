"""Weights to begin with, from files on this machine; nothing in them is run."""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from sightline.errors import InputError

_LEAST_SHARE = 0.5
"""Of a network's tensors: a file with fewer of them is of another network."""


def read_state(path: str | os.PathLike[str]) -> dict[str, Tensor]:
    """Tensors by name.

    Args:
        path: A ``.safetensors``, or a file of PyTorch with nothing but tensors in it.

    Raises:
        InputError: The file cannot be read, or has more in it than tensors.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: is not there; give a file with weights")
    if path.suffix == ".safetensors":
        try:
            return dict(load_file(path))
        except (SafetensorError, OSError) as error:
            raise InputError(f"{path}: is no whole .safetensors file") from error
    try:
        content: Any = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError, KeyError) as error:
        raise InputError(
            f"{path}: is no file of PyTorch with nothing but tensors in it, and other objects are "
            "not loaded, since they can run code; save its state_dict as .safetensors"
        ) from error
    for key in ("state_dict", "model"):
        if isinstance(content, dict) and isinstance(content.get(key), dict):
            content = content[key]
    if not isinstance(content, dict):
        raise InputError(f"{path}: has no tensors by name; save a state_dict as .safetensors")
    return {name: value for name, value in content.items() if isinstance(value, Tensor)}


def load_matching(module: nn.Module, path: str | os.PathLike[str]) -> int:
    """Take over the tensors that have the same name and shape; heads for other classes have not.

    Args:
        module: What begins with them.
        path: As for `read_state`.

    Returns:
        How many tensors were taken over.

    Raises:
        InputError: The file cannot be read, or is of another network.
    """
    given, own = read_state(path), module.state_dict()
    taken = {
        name: value
        for name, value in given.items()
        if name in own and own[name].shape == value.shape
    }
    if len(taken) < _LEAST_SHARE * len(own):
        raise InputError(
            f"{path}: is of another network: of {len(own)} tensors, {len(taken)} have their name "
            f"and shape among the {len(given)} of the file"
        )
    module.load_state_dict(taken, strict=False)
    return len(taken)
