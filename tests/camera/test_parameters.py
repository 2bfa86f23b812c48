from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import sightline
from sightline.camera import parameters
from sightline.camera.parameters import (
    CAMERA,
    HALF_BEAM,
    HALF_LENGTH,
    PARAMETERS,
    POSITION,
    PRINCIPAL,
    TARGET,
    TARGET_PARAMETERS,
    ParameterLayout,
    camera_vector,
)
from sightline.camera.priors import CameraPrior

SOURCE = Path(sightline.__file__).parent
VECTORS = {"vector", "prior_sigma", "by_parameter"}
"""What holds parameters in its last axis."""
OFTEN_VECTORS = {"state", "mean", "_mean", "sigma", "jacobian"}
"""What does so where a module knows the slots of a camera."""
PACKAGES = ("association", "camera", "georeferencing", "labelling", "pipeline", "reporting")


@pytest.mark.parametrize(("n_sources", "n_clocks"), [(0, 0), (1, 0), (0, 3), (2, 3)])
def test_every_slot_of_a_vector_is_of_one_part(n_sources: int, n_clocks: int) -> None:
    layout = ParameterLayout(n_sources, n_clocks)
    parts = [CAMERA, TARGET, *map(layout.source, range(n_sources)), layout.clocks]
    taken = np.concatenate([np.arange(layout.size)[part] for part in parts])
    np.testing.assert_array_equal(taken, np.arange(layout.size))
    assert layout.size == len(PARAMETERS) + len(TARGET_PARAMETERS) + 2 * n_sources + n_clocks
    assert layout.middle == layout.size
    assert ParameterLayout.of(layout.size, n_clocks) == layout


def test_slots_of_single_parameters_lie_in_those_of_their_part() -> None:
    layout = ParameterLayout(2, 3)
    slots = np.arange(layout.size)
    np.testing.assert_array_equal(slots[TARGET], [HALF_LENGTH, HALF_BEAM])
    np.testing.assert_array_equal(slots[POSITION], slots[CAMERA][[7, 8]])
    np.testing.assert_array_equal(slots[PRINCIPAL], slots[CAMERA][[9, 10]])
    for index in range(2):
        own = [layout.bias_px(index), layout.bias_m(index)]
        np.testing.assert_array_equal(slots[layout.source(index)], own)
    np.testing.assert_array_equal(
        slots[layout.sources], np.concatenate([slots[layout.source(i)] for i in range(2)])
    )
    np.testing.assert_array_equal(slots[layout.clocks], layout.clock(np.arange(3)))


def test_slots_of_the_camera_have_the_names_of_its_parameters() -> None:
    """LOG_HEIGHT is the slot of height_m, and so on."""
    for slot, name in enumerate(PARAMETERS):
        field, _, unit = name.partition("_")
        prefix = "log_" if (field, unit) in (("height", "m"), ("focal", "px")) else ""
        short = name.removesuffix("_px") if field == "principal" else f"{prefix}{field}"
        assert getattr(parameters, short.upper()) == slot


def test_a_camera_is_zero_where_nothing_else_is_said() -> None:
    found = camera_vector({parameters.K1: -0.1, parameters.NORTH: 3.0})
    np.testing.assert_array_equal(found, [0, 0, 0, 0, 0, -0.1, 0, 0, 3.0, 0, 0, 0])


def test_beliefs_about_a_source_and_a_clock_lie_in_their_slots() -> None:
    prior = CameraPrior(
        half_length_m=(3.0, 2.5), half_beam_m=(1.5, 1.25), bias_px=-1.0, clock_sigma_s=0.75
    )
    layout = ParameterLayout(2, 3)
    mean, sigma = prior.moments((1280, 720), 2, 3, position_known=False)
    assert (mean[HALF_LENGTH], sigma[HALF_LENGTH]) == (3.0, 2.5)
    assert (mean[HALF_BEAM], sigma[HALF_BEAM]) == (1.5, 1.25)
    for index in range(2):
        np.testing.assert_array_equal(mean[layout.source(index)], [-1.0, 0.0])
        assert sigma[layout.bias_px(index)] == prior.bias_px_sigma
        assert sigma[layout.bias_m(index)] == prior.bias_m_sigma
    np.testing.assert_array_equal(sigma[layout.clocks], 0.75)
    np.testing.assert_array_equal(
        np.flatnonzero(np.isinf(sigma)), [parameters.HEADING, parameters.EAST, parameters.NORTH]
    )


def _numbered(tree: ast.Module) -> Iterator[ast.Subscript]:
    """Parameters that are addressed by a number instead of a name."""
    modules = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    vectors = VECTORS | (OFTEN_VECTORS if "sightline.camera.parameters" in modules else set())
    for node in ast.walk(tree):
        if not isinstance(node, ast.Subscript):
            continue
        base = node.value
        name = base.id if isinstance(base, ast.Name) else getattr(base, "attr", "")
        square = name == "covariance" and isinstance(base, ast.Attribute)
        if name not in vectors and not square:
            continue
        axes = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        bounds = [
            bound
            for axis in (axes if square else axes[-1:])
            for bound in ([axis.lower, axis.upper] if isinstance(axis, ast.Slice) else [axis])
        ]
        if any(isinstance(bound, ast.Constant) and bound.value is not None for bound in bounds):
            yield node


@pytest.mark.parametrize("package", PACKAGES)
def test_no_parameter_is_addressed_by_its_number(package: str) -> None:
    paths = sorted((SOURCE / package).rglob("*.py"))
    assert paths
    found = [
        f"{path.relative_to(SOURCE)}:{node.lineno} {ast.unparse(node)}"
        for path in paths
        for node in _numbered(ast.parse(path.read_text(encoding="utf-8")))
    ]
    assert found == []


@pytest.mark.parametrize(
    "code", ["vector[4]", "fit.vector[7:9]", "jacobian[:, :, 7:9]", "fit.covariance[:9, :9]"]
)
def test_a_number_would_be_noticed(code: str) -> None:
    known = "from sightline.camera.parameters import POSITION\n"
    assert len(list(_numbered(ast.parse(known + code)))) == 1
