from __future__ import annotations

import json
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch

from sightline.cli.detector.train import train
from sightline.detection import DetectorOptions, OnnxDetector, TilingSettings
from sightline.errors import InputError
from sightline.scene import Scene
from sightline.training import build
from sightline.training.loop import CONFIGURATION, HISTORY, WEIGHTS, load_weights
from sightline.types import Frame

SMALL: dict[str, Any] = {
    "steps": 2,
    "batch": 2,
    "size": "96x64",
    "classes": "boat",
    "option": ["width=0.5"],
    "validate_every": 1,
    "device": "cpu",
    "threads": 1,
}


def _run(scene: Scene, folder: Path, **settings: Any) -> None:
    train(scene.path, "harbour", folder, **{**SMALL, "train": "a", **settings})


def test_a_run_writes_all_that_is_needed_to_repeat_it(scene: Scene, tmp_path: Path) -> None:
    folder, result = tmp_path / "out", tmp_path / "result.json"
    _run(scene, folder, validation="b", synthetic=1, json=result)
    said = json.loads(result.read_text())
    assert said["steps"] == 2
    assert said["export_difference"] <= 1e-4
    assert [row["step"] for row in said["history"]] == [1, 2]
    about = json.loads((folder / CONFIGURATION).read_text())
    assert about["data"]["train"]["a"] == said["data"]["train"]["a"]
    assert about["data"]["train"]["synthetic"]["pictures"] == 1
    assert set(about["data"]["validation"]) == {"b"}
    assert about["versions"]["torch"] == metadata.version("torch")
    assert about["training"]["seed"] == 0
    assert (folder / HISTORY).read_text().startswith("step,elapsed_s,loss_class")
    model = onnx.load(folder / "harbour.onnx")
    said_by_file = json.loads(model.metadata_props[0].value)
    assert said_by_file["classes"] == ["boat"]
    assert said_by_file["trained_on"] == "pond a and 1 rendered pictures"


def test_the_file_finds_what_the_network_finds(scene: Scene, tmp_path: Path) -> None:
    _run(scene, tmp_path, steps=60, validate_every=60, batch=4, scales="0.9-1.1")
    trainable = build("harbour", ("boat",), width=0.5)
    load_weights(tmp_path / WEIGHTS, trainable)
    trainable.module.eval()
    frame = next(scene["a"].frames())
    rgb = np.ascontiguousarray(frame.image_bgr[..., ::-1].transpose(2, 0, 1))
    expected = trainable.predict(torch.from_numpy(rgb)[None].float() / 255.0, 0.02)[0]
    assert len(expected.scores) > 0
    options = DetectorOptions(
        threshold=0.02, overlap=0.5, views=TilingSettings(kind="tiles"), threads=1
    )
    detector = OnnxDetector(tmp_path / "harbour.onnx", options=options)
    found = detector.detect(Frame(index=0, time_utc_s=0.0, image_bgr=frame.image_bgr))
    assert len(found) == len(expected.scores)
    order = np.argsort(-found.confidence, kind="stable")
    np.testing.assert_allclose(found.confidence[order], expected.scores, atol=1e-4)
    best = expected.boxes_xyxy_px[0].numpy().clip(0, [256, 160, 256, 160])
    np.testing.assert_allclose(found.xyxy_px[order[0]], best, atol=1e-2)


def test_a_finished_run_is_not_done_again(scene: Scene, tmp_path: Path) -> None:
    _run(scene, tmp_path)
    before = (tmp_path / WEIGHTS).read_bytes()
    _run(scene, tmp_path)
    assert (tmp_path / WEIGHTS).read_bytes() == before


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"train": "c"}, r"for train \(c\) have no boxes"),
        ({"validation": "c"}, r"for validation \(c\) have no boxes"),
        ({"train": "a,b", "validation": "b"}, "both for training and for validation"),
        ({"train": "z"}, "unknown recording 'z'"),
        ({"size": "96"}, "--size '96': expected width and height"),
        ({"scales": "a-b"}, "--scales 'a-b': expected two numbers"),
        ({"option": ["width"]}, "expected NAME=VALUE"),
        ({"option": ["depth=2"]}, "unknown option of harbour 'depth'"),
        ({"option": ["width=-1"]}, "a width of -1 is not positive"),
        ({"steps": 0}, "must be 1 or more"),
        ({"batch": 0}, "a batch needs a crop or more"),
        ({"rate": 0.0}, "not positive"),
        ({"precision": "float8"}, "unknown precision"),
        ({"device": "abacus"}, "not to be had here"),
        ({"synthetic": -1}, "cannot be rendered"),
        ({"labels": [Path("nowhere")]}, "nowhere: is no folder"),
        ({"labels": [Path(__file__).parent]}, "has no table of boxes of any recording in hand"),
        ({"initial": Path("none.safetensors")}, "there is no such file"),
    ],
)
def test_bad_input_is_a_line(
    scene: Scene, tmp_path: Path, settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=message) as caught:
        _run(scene, tmp_path / "out", **settings)
    assert "\n" not in str(caught.value)
