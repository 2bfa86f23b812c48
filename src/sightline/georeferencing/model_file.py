"""Model files: safetensors with JSON in its header, so that a stranger's model runs no code."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from sightline.atomic import atomic_path
from sightline.errors import ModelFileError, no_model_file
from sightline.types import FloatArray

FORMAT = "sightline-model"
FORMAT_VERSION = 2
"""Version 1, of release 0.1, kept hyperparameters as logarithms; it is still read."""

_READABLE = (1, FORMAT_VERSION)
_LENGTH_BYTES = 8
_LONGEST_REASON = 300


def write_model_file(
    path: str | os.PathLike[str],
    content: Mapping[str, Any],
    tensors: Mapping[str, NDArray[Any]],
) -> Path:
    """Write a model file, atomically; equal models are equal files.

    Args:
        path: Of the file.
        content: As JSON can hold it, finite numbers only.
        tensors: Arrays by name.

    Raises:
        InputError: The file cannot be written.
    """
    with atomic_path(path) as temporary:
        metadata = {
            "format": FORMAT,
            "format_version": str(FORMAT_VERSION),
            "content": json.dumps(content, allow_nan=False),
        }
        arrays = {name: np.ascontiguousarray(array) for name, array in tensors.items()}
        temporary.write_bytes(_in_order(save(arrays, metadata)))
    return Path(path)


def _in_order(file: bytes) -> bytes:
    """The same file with its header sorted, so that it is reproducible.

    The library writes the metadata in an order that changes from one run to the next.
    """
    start = _LENGTH_BYTES + int.from_bytes(file[:_LENGTH_BYTES], "little")
    header = json.dumps(
        json.loads(file[_LENGTH_BYTES:start]), sort_keys=True, separators=(",", ":")
    ).encode()
    header += b" " * (-len(header) % _LENGTH_BYTES)
    return len(header).to_bytes(_LENGTH_BYTES, "little") + header + file[start:]


def read_model_file(
    path: str | os.PathLike[str],
) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Content and tensors of a model file; nothing in it is executed or unpickled.

    Returns:
        The content, with the file's ``"format_version"`` among it, and the arrays by name.

    Raises:
        ModelFileError: There is no such file, it is damaged, of another kind, or of a format
            version that this release does not know.
    """
    metadata, tensors = _read(Path(path))
    if metadata.get("format") != FORMAT:
        raise ModelFileError(f"{path}: is no model of sightline; expected what `fit` has written")
    version = metadata.get("format_version", "")
    if version not in map(str, _READABLE):
        raise ModelFileError(
            f"{path}: is of format version {version or 'unknown'}, this release reads versions "
            f"{' and '.join(map(str, _READABLE))}; fit the model again, or use the release that "
            "wrote it"
        )
    try:
        content = json.loads(
            metadata["content"], parse_constant=_no_number, parse_float=_finite_number
        )
        if not isinstance(content, dict):
            raise TypeError("its content is no table of keys and values")
    except (LookupError, RecursionError, TypeError, ValueError) as error:
        raise damaged(path, error) from error
    return {**content, "format_version": int(version)}, tensors


def _no_number(text: str) -> float:
    raise ValueError(f"{text} is no number")


def _finite_number(text: str) -> float:
    value = float(text)
    return value if math.isfinite(value) else _no_number(text)


def damaged(path: str | os.PathLike[str], error: Exception) -> ModelFileError:
    """One-line message about a model file of which a part does not fit the others."""
    # What libraries say about an array can run over several lines.
    reason = " ".join(str(error).split())
    if len(reason) > _LONGEST_REASON:
        reason = f"{reason[:_LONGEST_REASON]}..."
    return ModelFileError(f"{path}: is damaged ({reason}); fit the model again")


def numbers_of_shape(array: NDArray[Any], name: str, shape: tuple[int, ...]) -> FloatArray:
    """An array of a model file as float64.

    Args:
        array: The array.
        name: Its name, for the message.
        shape: What it must have.

    Raises:
        ValueError: It is of another shape, or holds what is no finite number.
    """
    if array.shape != shape:
        raise ValueError(f"{name} is of shape {array.shape}, not {shape}")
    values = np.array(array, dtype=np.float64)
    if not np.isfinite(values).all():
        raise ValueError(f"{name} holds what is no number")
    return values


def _read(path: Path) -> tuple[dict[str, str], dict[str, NDArray[Any]]]:
    if not path.is_file():
        raise no_model_file(path)
    try:
        with safe_open(path, framework="numpy") as file:
            return file.metadata() or {}, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
    except (SafetensorError, OSError, ValueError, TypeError, LookupError, AttributeError) as error:
        # Types of numbers that NumPy has not are told by a missing attribute.
        reason = " ".join(str(error).split())
        if len(reason) > _LONGEST_REASON:
            reason = f"{reason[:_LONGEST_REASON]}..."
        raise ModelFileError(
            f"{path}: is damaged or no model of sightline ({reason}); fit the model again"
        ) from error
