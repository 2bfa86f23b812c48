"""Detectors in eight-bit integers and in half precision, beside what they were made from."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from sightline.cli import main
from sightline.detection import OnnxDetector
from sightline.detection.metadata import KEY
from sightline.detection.quantization import quantize
from sightline.detection.registry import shipped_file
from sightline.errors import InputError
from sightline.simulation import Harbour, HarbourSettings, Renderer
from sightline.types import Frame


def pictures(count: int) -> list[NDArray[np.uint8]]:
    harbour = Harbour.random(4, HarbourSettings(duration_s=100.0))
    renderer = Renderer(harbour)
    return [renderer.image(harbour.start_utc_s + 20.0 * k) for k in range(count)]


@pytest.fixture(scope="module")
def shown() -> list[NDArray[np.uint8]]:
    return pictures(3)


def described(path: Path) -> dict[str, object]:
    (told,) = [one.value for one in onnx.load(str(path)).metadata_props if one.key == KEY]
    return dict(json.loads(told))


@pytest.mark.slow
@pytest.mark.parametrize(("precision", "of_size"), [("int8", 0.8), ("fp16", 0.6)])
def test_the_shipped_detector_finds_the_same_in_less(
    precision: str, of_size: float, shown: list[NDArray[np.uint8]], tmp_path: Path
) -> None:
    path = tmp_path / "small.onnx"
    with shipped_file() as shipped:
        result = quantize(shipped, path, shown[:2], precision=precision)
        assert described(path) == {**described(shipped), "precision": precision}
        assert path.stat().st_size < of_size * shipped.stat().st_size
        before, after = OnnxDetector(shipped), OnnxDetector(path)
    assert result.boxes > 10
    assert result.found_again >= 0.9 * result.boxes
    assert after.lower_edge == before.lower_edge
    # A picture that its ranges were not measured on.
    frame = Frame(0, 0.0, shown[2])
    ours, same = (one.detect(frame).xyxy_px for one in (after, before))
    near = np.abs(ours[:, None] - same).max(axis=2).min(axis=0) < 4.0
    assert near.mean() >= 0.9
    kinds = Counter(node.op_type for node in onnx.load(str(path)).graph.node)
    assert (kinds["QuantizeLinear"] > 0) == (precision == "int8")


def bright(path: Path, activation: str | None) -> Path:
    """A network whose boxes are cells of 8 x 8 px, scored by their mean brightness."""
    weights = np.full((1, 3, 8, 8), 1.0 / 192.0, np.float32)
    nodes = [helper.make_node("Conv", ["images", "w"], ["c"], strides=[8, 8], name="conv")]
    if activation:
        nodes.append(helper.make_node(activation, ["c"], ["a"]))
    nodes += [
        helper.make_node("Reshape", ["a" if activation else "c", "flat"], ["score"]),
        helper.make_node("Concat", ["cells", "score"], ["output"], axis=1),
    ]
    y, x = np.mgrid[:40, :40] * 8.0 + 4.0
    cells = np.stack([x, y, np.full_like(x, 8.0), np.full_like(x, 8.0)]).reshape(1, 4, -1)
    stored = {"w": weights, "flat": np.array([1, 1, 1600]), "cells": cells.astype(np.float32)}
    graph = helper.make_graph(
        nodes,
        "bright",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, 320, 320])],
        [helper.make_tensor_value_info("output", TensorProto.FLOAT, [1, 5, 1600])],
        [numpy_helper.from_array(array, name) for name, array in stored.items()],
    )
    opset = [helper.make_opsetid("", 17)]
    onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=8), str(path))
    return path


def test_scores_are_off_by_no_more_than_a_step_of_a_byte(tmp_path: Path) -> None:
    """The mean of a cell in closed form: brightness from 0 to 1 in steps of 1/255."""
    rng = np.random.default_rng(0)
    picture = np.kron(rng.integers(0, 256, (40, 40), np.uint8), np.ones((8, 8), np.uint8))
    colour = np.repeat(picture[..., None], 3, axis=2)
    source = bright(tmp_path / "bright.onnx", "Relu")
    result = quantize(source, tmp_path / "small.onnx", [colour])
    assert (result.layers, result.of) == (1, 1)
    detector = OnnxDetector(tmp_path / "small.onnx")
    found = detector.detect(Frame(0, 0.0, colour))
    row, column = (found.xyxy_px[:, [1, 0]] // 8.0).astype(int).T
    true = picture[::8, ::8][row, column] / 255.0
    assert len(found) > 500
    assert np.abs(found.confidence - true).max() < 1.5 / 255.0
    assert np.abs(found.confidence - true).max() > 0.0


def test_what_cannot_be_quantised_is_told(tmp_path: Path, constant_file: object) -> None:
    picture = np.zeros((320, 320, 3), np.uint8)
    source = bright(tmp_path / "plain.onnx", None)
    with pytest.raises(InputError, match="none of its 1 convolutions has one of Relu"):
        quantize(source, tmp_path / "small.onnx", [picture])
    with pytest.raises(InputError, match="there is no picture"):
        quantize(source, tmp_path / "small.onnx", [])
    assert not (tmp_path / "small.onnx").exists()


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("harbour -o a.onnx", "there is no picture"),
        ("harbour -o a.bin --synthetic 1", "must end in .onnx"),
        ("harbour -o a.onnx --pictures none", "none: is no folder of pictures"),
        ("harbour -o a.onnx --pictures empty", "empty: holds no picture"),
        ("none.onnx -o a.onnx --synthetic 1", "none.onnx: there is no such ONNX file"),
        ("harbour -o a.onnx --synthetic 1 --precision int4", "unknown precision 'int4'"),
        ("bright.onnx -o bright.onnx --synthetic 1", "is read by this command"),
    ],
)
def test_bad_input_is_told_in_a_line(
    asked: str,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    bright(tmp_path / "bright.onnx", "Relu")
    with pytest.raises(SystemExit) as stopped:
        main(["detector", "quantize", *asked.split()])
    assert stopped.value.code == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


def test_the_command_says_what_was_gained_and_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "seen").mkdir()
    grey = np.full((320, 320, 3), 128, np.uint8)
    grey[:160] = 40
    for k in range(3):
        cv2.imwrite(str(tmp_path / "seen" / f"{k}.png"), grey)
    bright(tmp_path / "bright.onnx", "Relu")
    asked = "detector quantize bright.onnx --pictures seen --most 2 -o small.onnx --json r.json"
    with pytest.raises(SystemExit) as stopped:
        main(asked.split())
    assert stopped.value.code == 0
    said = capsys.readouterr().out
    assert "1 of 1 convolutions in int8, by 2 pictures" in said
    result = json.loads((tmp_path / "r.json").read_text())
    # The lower half of 40 x 40 cells is above the threshold, in each of two pictures.
    assert (result["boxes"], result["found_again"], result["more"]) == (1600, 1600, 0)
