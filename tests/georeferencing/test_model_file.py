from __future__ import annotations

import copy
import errno
import json
import os
import pickle
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

import sightline
from sightline.camera.priors import CameraPrior
from sightline.errors import InputError, ModelFileError
from sightline.georeferencing.residual_gp import Hyperparameters


@pytest.fixture(scope="module")
def saved(fitted: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(fitted("camera").save(tmp_path_factory.mktemp("models") / "camera.model"))


def some_boxes() -> np.ndarray:
    """All over the image, the sky included."""
    rng = np.random.default_rng(5)
    centre = rng.uniform([20.0, 200.0], [1260.0, 700.0], (400, 2))
    half = rng.uniform([3.0, 2.0], [40.0, 20.0], (400, 2))
    return np.hstack([centre - half, centre + half])


def header_of(path: Path) -> dict[str, str]:
    with safe_open(path, framework="numpy") as file:
        return dict(file.metadata())


def refused(path: Path) -> str:
    """The one line with which a file is refused, which names it."""
    with pytest.raises(ModelFileError) as caught:
        sightline.load(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message


@pytest.mark.parametrize("model", sightline.MODELS)
def test_what_is_read_is_what_was_written(fitted: Any, tmp_path: Path, model: str) -> None:
    before = fitted(model)
    path = before.save(tmp_path / "new folder" / "harbour.model")
    after = sightline.load(str(path))
    assert after.model == model
    assert after.plane == before.plane
    assert after.image_size_px == before.image_size_px
    assert after.report.to_dict() == before.report.to_dict()
    assert after.report.n > 100
    assert (after.camera is None) == (not model.startswith("camera"))
    if after.camera is not None:
        assert after.camera == before.camera
    for source in (None, "second", "nobody"):
        one, other = (g.locate(some_boxes(), source=source) for g in (before, after))
        assert one.known.any()
        for name in ("east_m", "north_m", "covariance_m2", "extrapolated"):
            np.testing.assert_array_equal(getattr(other, name), getattr(one, name))
        if model.startswith("camera"):
            np.testing.assert_array_equal(other.shared_covariance_m2, one.shared_covariance_m2)
    # Equal models are equal files.
    again = after.save(tmp_path / "again.model")
    assert again.read_bytes() == path.read_bytes()


def test_hyperparameters_come_back_bit_for_bit(fitted: Any, tmp_path: Path) -> None:
    """Through a logarithm a third of all numbers come back another, on any processor."""
    rng = np.random.default_rng(0)
    values = rng.uniform(0.1, 3.0, 200)
    changed = values[np.exp(np.log(values)) != values][:7].tolist()
    assert len(changed) == 7
    before = copy.deepcopy(fitted("camera+gpr"))
    before.regressor.range_process_.hyperparameters = Hyperparameters.from_list(changed)
    after = sightline.load(before.save(tmp_path / "harbour.model"))
    assert after.regressor.range_process_.hyperparameters.to_list() == changed


def test_a_model_of_release_0_1_is_read(fitted: Any, tmp_path: Path) -> None:
    """It kept the logarithms of hyperparameters, and places come out to within their rounding."""
    model = fitted("camera+gpr")
    path = model.save(tmp_path / "new.model")
    metadata, tensors = header_of(path), load_file(path)
    content = json.loads(metadata["content"])
    for key in ("range", "bearing"):
        own = content["settings"][key]
        own["hyperparameters"] = np.log(own["hyperparameters"]).tolist()
    noise = content["settings"]["noise"]
    noise["drift_m"], noise["drift_s"] = noise.pop("correlated_m"), noise.pop("correlation_time_s")
    prior = {name: getattr(CameraPrior(), name) for name in CameraPrior.__dataclass_fields__}
    for quantity in ("focal", "height"):
        prior[f"{quantity}_log_sigma"] = prior.pop(f"log_{quantity}_sigma")
    content["settings"]["prior"] = prior
    old = tmp_path / "old.model"
    save_file(tensors, old, {**metadata, "format_version": "1", "content": json.dumps(content)})
    one, other = (g.locate(some_boxes()) for g in (model, sightline.load(old)))
    np.testing.assert_allclose(other.east_m, one.east_m, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(other.covariance_m2, one.covariance_m2, rtol=1e-9)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.1, 0.5, 0.9, 0.9999])
def test_a_truncated_file_is_refused(saved: Path, tmp_path: Path, share: float) -> None:
    content = saved.read_bytes()
    path = tmp_path / "cut.model"
    path.write_bytes(content[: int(share * len(content))])
    assert "damaged" in refused(path)


def test_a_file_that_goes_on_is_refused(saved: Path, tmp_path: Path) -> None:
    path = tmp_path / "long.model"
    path.write_bytes(saved.read_bytes() + b"more")
    assert "damaged" in refused(path)


@pytest.mark.parametrize("place", [0, 3, 7, 8, 9])
def test_a_flipped_byte_at_the_beginning_is_refused(
    saved: Path, tmp_path: Path, place: int
) -> None:
    content = bytearray(saved.read_bytes())
    content[place] ^= 0xFF
    path = tmp_path / "flipped.model"
    path.write_bytes(content)
    refused(path)


def test_a_flipped_byte_anywhere_breaks_nothing_else(saved: Path, tmp_path: Path) -> None:
    whole = saved.read_bytes()
    header = 8 + struct.unpack("<Q", whole[:8])[0]
    path = tmp_path / "flipped.model"
    rng = np.random.default_rng(2)
    messages = []
    # A changed digit is a number as good as any other; what is no model is refused.
    for place in rng.integers(8, header, 200).tolist():
        content = bytearray(whole)
        content[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(content)
        try:
            sightline.load(path)
        except ModelFileError as error:
            messages.append(str(error))
    assert len(messages) > 20
    assert all(message.startswith(f"{path}: ") for message in messages)
    assert not any("\n" in message for message in messages)


def test_numbers_that_are_none_are_refused(saved: Path, tmp_path: Path) -> None:
    tensors = load_file(saved)
    tensors["regressor.vector"][2] = np.nan
    path = tmp_path / "nan.model"
    save_file(tensors, path, metadata=header_of(saved))
    assert "not a number" in refused(path)


def test_what_a_library_says_in_several_lines_is_one_line(fitted: Any, tmp_path: Path) -> None:
    path = fitted("gpr").save(tmp_path / "gpr.model")
    tensors, header = load_file(path), header_of(path)
    tensors["regressor.inputs"] = tensors["regressor.inputs"].ravel()
    save_file(tensors, path, metadata=header)
    assert "Expected 2D array" in refused(path)


@pytest.mark.parametrize("name", ["regressor.vector", "regressor.covariance", "support"])
def test_a_missing_or_a_misshapen_table_is_refused(saved: Path, tmp_path: Path, name: str) -> None:
    path = tmp_path / "changed.model"
    tensors = load_file(saved)
    short = {**tensors, name: np.ascontiguousarray(tensors[name].ravel()[:-1])}
    save_file(short, path, metadata=header_of(saved))
    assert "damaged" in refused(path)
    del tensors[name]
    save_file(tensors, path, metadata=header_of(saved))
    assert "damaged" in refused(path)


@pytest.mark.parametrize(
    "change",
    [
        {"model": "oracle"},
        {"plane": [95.0, 10.0]},
        {"plane": None},
        {"image_size_px": [1280]},
        {"settings": {}},
        {"settings": []},
        {"settings": {"prior": "none"}},
        {"settings": {"noise": []}},
        {"settings": {"noise": {"row_px": "wide"}}},
        {"report": {"surprise": 1}},
        {"report": None},
    ],
    ids=str,
)
def test_content_that_is_no_model_is_refused(
    saved: Path, tmp_path: Path, change: dict[str, Any]
) -> None:
    header = header_of(saved)
    content = json.loads(header["content"])
    if change.get("settings"):
        change = {"settings": {**content["settings"], **change["settings"]}}
    header["content"] = json.dumps({**content, **change})
    path = tmp_path / "changed.model"
    save_file(load_file(saved), path, metadata=header)
    assert "damaged" in refused(path)


@pytest.mark.parametrize("content", ["", "{", "[]", "null", "7", "[" * 100_000], ids=range(6))
def test_content_that_is_no_table_is_refused(saved: Path, tmp_path: Path, content: str) -> None:
    path = tmp_path / "changed.model"
    save_file(load_file(saved), path, metadata={**header_of(saved), "content": content})
    assert "damaged" in refused(path)


def test_a_newer_format_version_is_named(saved: Path, tmp_path: Path) -> None:
    path = tmp_path / "newer.model"
    save_file(load_file(saved), path, metadata={**header_of(saved), "format_version": "3"})
    message = refused(path)
    assert "format version 3" in message
    assert "reads versions 1 and 2" in message


def test_a_safetensors_file_of_somebody_else_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    for metadata in (None, {"format": "pt"}):
        save_file({"layer.weight": np.ones((3, 2), dtype=np.float32)}, path, metadata=metadata)
        assert "no model of sightline" in refused(path)


class Explosive:
    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, ("exploded",)


def test_a_pickle_is_refused_and_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "friendly.model"
    path.write_bytes(pickle.dumps(Explosive()))
    refused(path)
    assert [entry.name for entry in tmp_path.iterdir()] == ["friendly.model"]


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    assert "no such model file" in refused(tmp_path / "nowhere.model")
    refused(tmp_path)


def test_a_full_disk_leaves_the_old_file_and_nothing_else(
    fitted: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "harbour.model"
    fitted("camera").save(path)
    before = path.read_bytes()

    def no_room(file: Path, content: bytes) -> int:
        with file.open("wb") as stream:
            stream.write(content[:100])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", no_room)
    for target in (path, tmp_path / "new" / "other.model"):
        with pytest.raises(InputError, match="cannot be written: No space left") as caught:
            fitted("gpr").save(target)
        assert "\n" not in str(caught.value)
        assert str(target) in str(caught.value)
    assert list(tmp_path.iterdir()) == [path]
    assert path.read_bytes() == before
    assert sightline.load(path).model == "camera"


def test_a_folder_is_not_written_over(fitted: Any, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="it is a folder"):
        fitted("camera").save(tmp_path)
