"""A model file of which a part does not fit the others is refused in a line, when it is loaded."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.numpy import save_file

from sightline.errors import ModelFileError
from sightline.georeferencing.georeferencer import Georeferencer, load_model

Fitted = Callable[[str], Georeferencer]
Arrays = dict[str, NDArray[Any]]
Change = Callable[[Arrays, dict[str, Any]], object]


def changed(fitted: Fitted, model: str, path: Path, change: Change, text: str = "") -> Path:
    """A model file with a part changed; or with another text for its content."""
    fitted(model).save(path)
    with safe_open(path, framework="numpy") as file:
        metadata = file.metadata()
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    content = json.loads(metadata["content"])
    change(arrays, content)
    metadata["content"] = text or json.dumps(content)
    save_file(arrays, path, metadata)
    return path


def shaped(name: str, form: Callable[[NDArray[Any]], NDArray[Any]]) -> Change:
    def change(arrays: Arrays, _: dict[str, Any]) -> None:
        arrays[name] = np.ascontiguousarray(form(arrays[name]))

    return change


GP = "regressor.range"
CHANGES: dict[str, tuple[str, Change]] = {
    "a row": ("camera+gpr", shaped(f"{GP}.targets", lambda a: a[None])),
    "half": ("camera+gpr", shaped(f"{GP}.noise", lambda a: a[::2])),
    "one for all": ("camera+gpr", shaped(f"{GP}.noise", lambda a: a[:1])),
    "a number": ("camera+gpr", shaped(f"{GP}.noise", lambda a: a[0])),
    "other inputs": ("camera+gpr", shaped(f"{GP}.inputs", lambda a: a[:, :2])),
    "transposed": ("camera+gpr", shaped(f"{GP}.inputs", lambda a: a.T)),
    "no number": ("camera+gpr", shaped(f"{GP}.targets", lambda a: a * np.nan)),
    "nothing": ("camera+gpr", shaped(f"{GP}.targets", lambda a: a[:0])),
    "no camera": ("camera", shaped("regressor.vector", lambda a: a[:-1])),
    "unsure": ("camera", shaped("regressor.covariance", lambda a: a * np.inf)),
    "support": ("camera", shaped("support", lambda a: a * np.nan)),
    "missing": ("camera", lambda arrays, _: arrays.pop("regressor.vector")),
    "size": ("camera", lambda _, content: content.update(image_size_px=[0, 720])),
    "huge size": ("camera", lambda _, content: content.update(image_size_px=[10**15, 720])),
    "size in words": ("camera", lambda _, content: content.update(image_size_px="ab")),
    "place": ("camera", lambda _, content: content.update(plane=[None, 3])),
    "source": ("camera", lambda _, content: content["settings"].update(sources=[[], {}])),
    "scales": ("camera+gpr", lambda _, c: c["settings"]["range"].update(length_scales=[1.0])),
    "amplitude": (
        "camera+gpr",
        lambda _, c: c["settings"]["range"]["hyperparameters"].__setitem__(0, -1.0),
    ),
    "kernel": ("gpr", lambda _, c: c["settings"]["estimator"].update(length_scale=-1.0)),
    "weights": ("nn", shaped("regressor.coefs_0", lambda a: a[None])),
    "moments": ("qkr", shaped("regressor.target_moments", lambda a: a[None])),
    "report": ("camera", lambda _, content: content.update(report=[])),
}


@pytest.mark.parametrize(("model", "change"), CHANGES.values(), ids=CHANGES)
def test_a_part_that_does_not_fit_is_refused(
    fitted: Fitted, tmp_path: Path, model: str, change: Change
) -> None:
    path = changed(fitted, model, tmp_path / "a.safetensors", change)
    with pytest.raises(ModelFileError, match="fit the model again") as caught:
        load_model(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < len(str(path)) + 500


@pytest.mark.parametrize("dtype", [np.float32, np.float16])
def test_numbers_of_less_precision_are_read(fitted: Fitted, tmp_path: Path, dtype: type) -> None:
    path = changed(
        fitted,
        "qkr",
        tmp_path / "a.safetensors",
        shaped("support", lambda array: array.astype(dtype)),
    )
    assert load_model(path).image_size_px == fitted("qkr").image_size_px


@pytest.mark.parametrize(
    "text",
    ["[" * 100_000, '{"a":' * 100_000, '{"model": NaN}', '{"model": 1e999}', "null", "{", "\x00"],
)
def test_a_content_that_is_no_object_of_numbers_is_refused(
    fitted: Fitted, tmp_path: Path, text: str
) -> None:
    path = changed(fitted, "camera", tmp_path / "a.safetensors", lambda *_: None, text)
    with pytest.raises(ModelFileError, match="is damaged"):
        load_model(path)


def test_a_header_that_says_it_is_huge_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    for length in (2**63, 2**40, 200_000_000, 8):
        path.write_bytes(length.to_bytes(8, "little") + b"{}      ")
        with pytest.raises(ModelFileError):
            load_model(path)


def test_types_of_numbers_that_numpy_has_not_are_refused(tmp_path: Path) -> None:
    header = json.dumps({"a": {"dtype": "BF16", "shape": [1], "data_offsets": [0, 2]}}).encode()
    header += b" " * (-len(header) % 8)
    path = tmp_path / "a.safetensors"
    path.write_bytes(len(header).to_bytes(8, "little") + header + b"\0\0")
    with pytest.raises(ModelFileError):
        load_model(path)
