from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

MakeFile = Callable[..., Path]


@pytest.fixture
def constant_file(tmp_path: Path) -> MakeFile:
    """Make an ONNX file that puts out the same whatever it is shown."""

    def make(
        outputs: Mapping[str, Any],
        *,
        shape: Sequence[int | str] = (1, 3, 320, 320),
        inputs: Mapping[str, tuple[int, Sequence[int | str]]] | None = None,
        input_type: int = TensorProto.FLOAT,
        metadata: Mapping[str, str] | None = None,
        name: str = "constant.onnx",
    ) -> Path:
        given = {"images": (input_type, shape)} if inputs is None else inputs
        nodes, described = [], []
        for output, array in outputs.items():
            value = numpy_helper.from_array(np.ascontiguousarray(array), output)
            nodes.append(helper.make_node("Constant", [], [output], value=value))
            described.append(helper.make_tensor_value_info(output, value.data_type, array.shape))
        pictures = [
            helper.make_tensor_value_info(one, kind, list(size))
            for one, (kind, size) in given.items()
        ]
        graph = helper.make_graph(nodes, "constant", pictures, described)
        return _saved(graph, tmp_path / name, metadata)

    return make


@pytest.fixture
def bright_cells_file(tmp_path: Path) -> MakeFile:
    """Make a detector of bright cells of 8 x 8 px: the score of a cell is its mean brightness.

    Its outputs are (B, 5, N), as Ultralytics has them.
    """

    def make(
        *,
        shape: Sequence[int | str] = ("batch", 3, "height", "width"),
        metadata: Mapping[str, str] | None = None,
        name: str = "bright.onnx",
    ) -> Path:
        constants = {
            "nothing": np.array(0.0, np.float32),
            "one": np.array(1.0, np.float32),
            "half": np.array(0.5, np.float32),
            "cell": np.array(8.0, np.float32),
            "down": np.array(2, np.int64),
            "right": np.array(3, np.int64),
            "flat": np.array([0, 5, -1], np.int64),
        }
        node = helper.make_node
        nodes = [
            node("ReduceMean", ["images", "channel"], ["grey"], keepdims=1),
            node("AveragePool", ["grey"], ["score"], kernel_shape=[8, 8], strides=[8, 8]),
            node("Mul", ["score", "nothing"], ["zeros"]),
            node("Add", ["zeros", "one"], ["ones"]),
            node("Mul", ["ones", "cell"], ["size"]),
        ]
        for axis in ("right", "down"):
            nodes += [
                node("CumSum", ["ones", axis], [f"count_{axis}"]),
                node("Sub", [f"count_{axis}", "half"], [f"middle_{axis}"]),
                node("Mul", [f"middle_{axis}", "cell"], [f"at_{axis}"]),
            ]
        parts = ["at_right", "at_down", "size", "size", "score"]
        nodes += [
            node("Concat", parts, ["map"], axis=1),
            node("Reshape", ["map", "flat"], ["output"]),
        ]
        constants["channel"] = np.array([1], np.int64)
        stored = [numpy_helper.from_array(array, key) for key, array in constants.items()]
        picture = helper.make_tensor_value_info("images", TensorProto.FLOAT, list(shape))
        found = helper.make_tensor_value_info("output", TensorProto.FLOAT, [shape[0], 5, "cells"])
        graph = helper.make_graph(nodes, "bright", [picture], [found], stored)
        return _saved(graph, tmp_path / name, metadata)

    return make


def _saved(graph: onnx.GraphProto, path: Path, metadata: Mapping[str, str] | None) -> Path:
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 21)], ir_version=10)
    for key, value in (metadata or {}).items():
        model.metadata_props.add(key=key, value=value)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))
    return path
