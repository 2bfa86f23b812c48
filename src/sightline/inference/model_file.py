"""Models in files: safetensors with JSON in its header, so that a stranger's model runs no code."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from sightline.detection.camera_motion import View
from sightline.errors import ModelFileError, SightlineError, no_model_file
from sightline.formats.atomic import atomic_path
from sightline.geodesy import LocalPlane
from sightline.inference.camera_model import CameraRegressor
from sightline.inference.georeferencer import MODELS, FitReport, Georeferencer
from sightline.inference.paper import PAPER_MODELS, PaperModel
from sightline.inference.support import Support

FORMAT = "sightline-model"
FORMAT_VERSION = 1

_LENGTH_BYTES = 8
_VIEW = ("strips", "top_px", "left_px")
_DAMAGE = (
    ArithmeticError,
    AttributeError,
    LookupError,
    RecursionError,
    TypeError,
    ValueError,
)


def save_model(georeferencer: Georeferencer, path: str | os.PathLike[str]) -> Path:
    """Write a georeferencer, whole or not at all.

    Raises:
        InputError: The file cannot be written.
    """
    arrays, settings = georeferencer.regressor.state()
    content: dict[str, Any] = {
        "model": georeferencer.model,
        "plane": [georeferencer.plane.latitude_deg, georeferencer.plane.longitude_deg],
        "image_size_px": list(georeferencer.image_size_px),
        "settings": settings,
        "report": georeferencer.report.to_dict(),
    }
    # Only where there is something to say: other models stay readable by older releases.
    if georeferencer.horizon_px is not None:
        content["horizon_px"] = list(georeferencer.horizon_px)
    if georeferencer.water_level_m is not None:
        content["water_level_m"] = georeferencer.water_level_m
    if georeferencer.moving:
        content["moving"] = True
    tensors = {f"regressor.{name}": np.ascontiguousarray(a) for name, a in arrays.items()}
    tensors["support"] = np.ascontiguousarray(georeferencer.support.planes)
    if georeferencer.view is not None:
        for name in _VIEW:
            tensors[f"view.{name}"] = np.ascontiguousarray(getattr(georeferencer.view, name))
        content["view_landmarks"] = georeferencer.view.landmarks
    with atomic_path(path) as temporary:
        metadata = {
            "format": FORMAT,
            "format_version": str(FORMAT_VERSION),
            "content": json.dumps(content, allow_nan=False),
        }
        temporary.write_bytes(_in_order(save(tensors, metadata)))
    return Path(path)


def _in_order(file: bytes) -> bytes:
    """The same file with its header sorted: equal models are equal files.

    The library writes the metadata in an order that changes from one run to the next.
    """
    start = _LENGTH_BYTES + int.from_bytes(file[:_LENGTH_BYTES], "little")
    header = json.dumps(
        json.loads(file[_LENGTH_BYTES:start]), sort_keys=True, separators=(",", ":")
    ).encode()
    header += b" " * (-len(header) % _LENGTH_BYTES)
    return len(header).to_bytes(_LENGTH_BYTES, "little") + header + file[start:]


def load_model(path: str | os.PathLike[str]) -> Georeferencer:
    """Read a georeferencer.

    Raises:
        ModelFileError: There is no such file, it is damaged, of another kind, or of a format
            version that this release does not know.
    """
    metadata, tensors = _read(Path(path))
    if metadata.get("format") != FORMAT:
        raise ModelFileError(f"{path}: is no model of sightline; expected what `fit` has written")
    version = metadata.get("format_version", "")
    if version != str(FORMAT_VERSION):
        raise ModelFileError(
            f"{path}: is of format version {version or 'unknown'}, this release reads version "
            f"{FORMAT_VERSION}; fit the model again, or use the release that wrote it"
        )
    try:
        return _build(json.loads(metadata["content"]), tensors)
    except (*_DAMAGE, SightlineError) as error:
        # What libraries say about an array can run over several lines.
        reason = " ".join(str(error).split())
        raise ModelFileError(f"{path}: is damaged ({reason}); fit the model again") from error


def _read(path: Path) -> tuple[dict[str, str], dict[str, Any]]:
    if not path.is_file():
        raise no_model_file(path)
    try:
        with safe_open(path, framework="numpy") as file:
            return file.metadata() or {}, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
    except (SafetensorError, OSError, ValueError) as error:
        raise ModelFileError(
            f"{path}: is damaged or no model of sightline ({error}); fit the model again"
        ) from error


def _build(content: dict[str, Any], tensors: dict[str, Any]) -> Georeferencer:
    name = content["model"]
    if name not in MODELS:
        raise ValueError(f"its model {name!r} is not known")
    prefix = "regressor."
    arrays = {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
    regressor: PaperModel | CameraRegressor
    if name in PAPER_MODELS:
        regressor = PaperModel.from_state(arrays, content["settings"])
    else:
        regressor = CameraRegressor.from_state(arrays, content["settings"])
    width, height = (int(v) for v in content["image_size_px"])
    latitude, longitude = (float(v) for v in content["plane"])
    return Georeferencer(
        model=name,
        regressor=regressor,
        plane=LocalPlane(latitude, longitude),
        image_size_px=(width, height),
        support=Support(np.asarray(tensors["support"], dtype=np.float64).reshape(-1, 3)),
        report=FitReport.from_dict(content["report"]),
        horizon_px=_horizon(content.get("horizon_px")),
        moving=bool(content.get("moving", False)),
        water_level_m=_finite(content.get("water_level_m")),
        view=_view(tensors, bool(content.get("view_landmarks", True))),
    )


def _view(tensors: dict[str, Any], landmarks: bool) -> View | None:
    if "view.strips" not in tensors:
        return None
    strips, *places = (np.asarray(tensors[f"view.{name}"]) for name in _VIEW)
    if strips.dtype != np.uint8:
        raise ValueError("its view is no picture")
    top_px, left_px = (place.astype(np.int64) for place in places)
    return View(strips, top_px, left_px, landmarks)


def _finite(value: Any) -> float | None:
    if value is None:
        return None
    if not math.isfinite(float(value)):
        raise ValueError("its water level is not a number")
    return float(value)


def _horizon(rows: Any) -> tuple[float, float] | None:
    if rows is None:
        return None
    left, right = (float(row) for row in rows)
    return left, right
