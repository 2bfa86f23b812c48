"""A detector from somebody else reaches nothing but what lies in its folder."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from sightline.detection._onnx_file import check_onnx_file
from sightline.detection.onnx import OnnxDetector
from sightline.errors import InputError

onnx = pytest.importorskip("onnx", reason="needs the package onnx")


def network(location: str | None, *, where: str = "initializer", bytes_: int = 16) -> bytes:
    """A network with one tensor, whose values lie in another file if one is named."""
    from onnx import TensorProto, helper

    tensor = helper.make_tensor("w", TensorProto.FLOAT, [2, 2], np.eye(2, dtype=np.float32).ravel())
    if location is not None:
        tensor.ClearField("float_data")
        tensor.data_location = TensorProto.EXTERNAL
        for key, value in (("offset", "0"), ("location", location), ("length", str(bytes_))):
            entry = tensor.external_data.add()
            entry.key, entry.value = key, value
    inputs = [helper.make_tensor_value_info("x", TensorProto.FLOAT, [2, 2])]
    outputs = [helper.make_tensor_value_info("y", TensorProto.FLOAT, [2, 2])]
    nodes = [helper.make_node("MatMul", ["x", "w"], ["y"])]
    initializers = [tensor]
    if where == "constant":
        nodes.insert(0, helper.make_node("Constant", [], ["w"], value=tensor))
        initializers = []
    elif where == "branch":
        inner = helper.make_graph(nodes, "inner", [], outputs, [tensor])
        condition = helper.make_tensor("c", TensorProto.BOOL, [], [True])
        nodes = [
            helper.make_node("Constant", [], ["c"], value=condition),
            helper.make_node("If", ["c"], ["y"], then_branch=inner, else_branch=inner),
        ]
        initializers = []
    elif where == "function":
        constant = helper.make_node("Constant", [], ["w"], value=tensor)
        opsets = [helper.make_opsetid("", 17)]
        body = [constant, helper.make_node("MatMul", ["a", "w"], ["b"])]
        function = helper.make_function("own", "F", ["a"], ["b"], body, opsets)
        graph = helper.make_graph(
            [helper.make_node("F", ["x"], ["y"], domain="own")], "g", inputs, outputs
        )
        opsets.append(helper.make_opsetid("own", 1))
        made = helper.make_model(graph, opset_imports=opsets, functions=[function], ir_version=9)
        return made.SerializeToString()
    graph = helper.make_graph(nodes, "g", inputs, outputs, initializers)
    opsets = [helper.make_opsetid("", 17)]
    return helper.make_model(graph, opset_imports=opsets, ir_version=9).SerializeToString()


@pytest.mark.parametrize("where", ["initializer", "constant", "branch", "function"])
@pytest.mark.parametrize(
    "location",
    [
        "../weights",
        "../../etc/hostname",
        "/etc/hostname",
        "a/../../weights",
        "link",
        "C:\\w",
        "a\\w",
    ],
)
def test_weights_outside_of_the_folder_are_refused(
    tmp_path: Path, location: str, where: str
) -> None:
    folder = tmp_path / "model"
    folder.mkdir()
    (tmp_path / "weights").write_bytes(b"\0" * 16)
    (folder / "link").symlink_to(tmp_path / "weights")
    path = folder / "a.onnx"
    path.write_bytes(network(location, where=where))
    with pytest.raises(InputError, match="keeps weights outside of its folder") as caught:
        OnnxDetector(path)
    assert str(caught.value).startswith(str(path))


def test_weights_beside_the_file_are_taken(tmp_path: Path) -> None:
    (tmp_path / "weights").write_bytes(np.eye(2, dtype=np.float32).tobytes())
    path = tmp_path / "a.onnx"
    path.write_bytes(network("weights"))
    check_onnx_file(path)
    (tmp_path / "links").mkdir()
    for name in ("a.onnx", "weights"):
        (tmp_path / "links" / name).symlink_to(tmp_path / name)
    # As a store of files keeps them, whose names lead to their contents.
    check_onnx_file(tmp_path / "links" / "a.onnx")
    os.remove(tmp_path / "weights")
    with pytest.raises(InputError, match="its weights are in 'weights', which is not there"):
        check_onnx_file(path)


def test_a_file_in_one_piece_names_no_other(tmp_path: Path) -> None:
    path = tmp_path / "a.onnx"
    for where in ("initializer", "constant", "branch", "function"):
        path.write_bytes(network(None, where=where))
        check_onnx_file(path)


def test_a_compiled_program_is_refused(tmp_path: Path) -> None:
    from onnx import helper

    node = helper.make_node(
        "EPContext", [], ["y"], domain="com.microsoft", ep_cache_context="../a.so"
    )
    path = tmp_path / "a.onnx"
    graph = helper.make_graph([node], "g", [], [])
    path.write_bytes(helper.make_model(graph).SerializeToString())
    with pytest.raises(InputError, match="it holds a compiled program"):
        OnnxDetector(path)


@pytest.mark.parametrize("seed", range(8))
def test_damaged_files_are_refused_in_a_line(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    whole = network("weights")
    path = tmp_path / "a.onnx"
    for _ in range(40):
        data = bytearray(whole)
        for _ in range(int(rng.integers(1, 6))):
            data[int(rng.integers(len(data)))] = int(rng.integers(256))
        path.write_bytes(bytes(data[: int(rng.integers(1, len(data) + 1))]))
        try:
            check_onnx_file(path)
        except InputError as error:
            assert "\n" not in str(error)  # noqa: PT017 - some are whole enough
