"""What a reader of the code may count on: functions that can be taken in, and types that say."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "sightline"

_MOST_LINES = 80
_MOST_PARAMETERS = 8

# Where nothing says what a value is, with the reason.
_JSON = "reads what JSON holds"
_SKLEARN = "scikit-learn has no types"
_TORCH = "checks read torch and what is made of it as untyped"
_UNTYPED = {
    "__init__.py": "names that are loaded when they are asked for",
    "_optional.py": "modules of extras",
    "_plugins.py": "objects of other packages",
    "camera/pinhole.py": "a number or a column of them: no type is both",
    "cli/__init__.py": "typer does not export the class of its errors",
    "cli/track.py": "typer does not export the class of a command's context",
    "detection/_onnxruntime.py": "onnxruntime has no types",
    "detection/quantization.py": "onnx and onnxruntime have no types",
    "detection/onnx.py": "onnxruntime has no types",
    "fleet/ray_engine.py": "ray has no types",
    "formats/_files.py": "options of pandas",
    "formats/_json_logs.py": _JSON,
    "formats/area_geojson.py": _JSON,
    "formats/ais.py": "pyais has no types",
    "formats/geojson.py": _JSON,
    "formats/otanalytics.py": _JSON,
    "formats/otvision.py": _JSON,
    "formats/parquet.py": "pyarrow has no types",
    "georeferencing/camera_regressor.py": _SKLEARN,
    "georeferencing/fit_report.py": _JSON,
    "georeferencing/georeferencer.py": _JSON,
    "georeferencing/model_file.py": _JSON,
    "georeferencing/paper/estimator.py": _SKLEARN,
    "georeferencing/paper/gaussian_process.py": _SKLEARN,
    "georeferencing/paper/neural.py": _SKLEARN,
    "georeferencing/paper/quadratic.py": _SKLEARN,
    "georeferencing/paper/two_layer.py": _SKLEARN,
    "tracking/targets.py": _JSON,
    "training/architecture.py": _TORCH,
    "training/comparison.py": _JSON,
    "training/efficientdet.py": _TORCH,
    "training/export.py": _TORCH,
    "training/faster_rcnn.py": _TORCH,
    "training/gated.py": _TORCH,
    "training/loop.py": _TORCH,
    "training/photometric.py": _TORCH,
    "training/pretrained.py": _TORCH,
    "training/trained.py": _JSON,
    "trajectory/__init__.py": "settings of methods of other packages",
}

_Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True)
class Function:
    """A function or method of the source.

    Attributes:
        name: Its file and name.
        node: Itself.
        owner: The class that it is a method of.
    """

    name: str
    node: _Function
    owner: ast.ClassDef | None

    @property
    def parameters(self) -> int:
        """How many there are, ``self`` and those by name alone among them."""
        every = self.node.args
        named = len(every.posonlyargs) + len(every.args) + len(every.kwonlyargs)
        return named + (every.vararg is not None) + (every.kwarg is not None)

    @property
    def lines(self) -> int:
        """From its first line to its last."""
        return (self.node.end_lineno or self.node.lineno) - self.node.lineno + 1

    @property
    def builds_an_estimator(self) -> bool:
        """Whether it is the constructor of an estimator of scikit-learn's, which asks for them."""
        bases = [] if self.owner is None else [ast.unparse(base) for base in self.owner.bases]
        return self.node.name == "__init__" and "BaseEstimator" in bases


def functions(tree: ast.Module, file: str) -> Iterator[Function]:
    """All functions of a module, those within others and within classes too."""
    waiting: list[tuple[ast.AST, ast.ClassDef | None]] = [(tree, None)]
    while waiting:
        node, owner = waiting.pop()
        if isinstance(node, _Function):
            prefix = "" if owner is None else f"{owner.name}."
            yield Function(f"{file}: {prefix}{node.name}", node, owner)
        inside = node if isinstance(node, ast.ClassDef) else None
        waiting += [(child, inside) for child in ast.iter_child_nodes(node)]


@cache
def _trees() -> dict[str, ast.Module]:
    return {
        path.relative_to(SOURCE).as_posix(): ast.parse(path.read_text(encoding="utf-8"))
        for path in sorted(SOURCE.rglob("*.py"))
    }


def _of_the_library() -> list[Function]:
    """All functions but commands, whose parameters are the options of the command line."""
    return [
        function
        for file, tree in _trees().items()
        if not file.startswith("cli/")
        for function in functions(tree, file)
    ]


def silent(every: list[Function]) -> list[str]:
    """Functions too long to be read at once that do not say what they are for."""
    return [
        f"{one.name}: {one.lines} lines"
        for one in every
        if one.lines > _MOST_LINES and ast.get_docstring(one.node) is None
    ]


def crowded(every: list[Function]) -> list[str]:
    """Functions with more parameters than anybody keeps apart."""
    return [
        one.name
        for one in every
        if one.parameters > _MOST_PARAMETERS and not one.builds_an_estimator
    ]


def test_long_functions_say_what_they_are_for() -> None:
    every = _of_the_library()
    assert len(every) > 1000
    assert silent(every) == []


def test_functions_have_few_parameters() -> None:
    """More belong together in a table or in settings."""
    assert crowded(_of_the_library()) == []


def untyped(tree: ast.Module) -> list[int]:
    """Lines on which something may be anything; an array of whichever numbers is an array."""
    arrays = [
        node.slice
        for node in ast.walk(tree)
        if isinstance(node, ast.Subscript) and ast.unparse(node.value) in ("NDArray", "np.ndarray")
    ]
    allowed = {id(node) for inside in arrays for node in ast.walk(inside)}
    return [
        node.lineno
        for node in ast.walk(tree)
        if isinstance(node, ast.Name | ast.Attribute)
        and ast.unparse(node) in ("Any", "typing.Any")
        and id(node) not in allowed
    ]


def test_what_may_be_anything_is_at_a_border() -> None:
    """Inside, everything has a type; a module that has come to have one leaves the list."""
    assert sorted(file for file, tree in _trees().items() if untyped(tree)) == sorted(_UNTYPED)


@pytest.mark.parametrize(
    ("code", "lines"),
    [
        ("def f(a: Any) -> int: ...", [1]),
        ("a = 1\ndef f() -> dict[str, typing.Any]: ...", [2]),
        ("def f(a: NDArray[Any], b: np.ndarray[Any, Any]) -> None: ...", []),
        ("def f(a: list[NDArray[Any]] | Any) -> None: ...", [1]),
    ],
)
def test_what_may_be_anything_is_found(code: str, lines: list[int]) -> None:
    assert untyped(ast.parse(code)) == lines


@pytest.mark.parametrize(
    ("code", "found"),
    [
        ("def f(a, b, c, d, e, f, g, h): ...", []),
        ("def f(a, b, c, d, e, f, g, h, i): ...", ["a.py: f"]),
        ("def f(a, /, b, c, d, e, *f, g, h, **i): ...", ["a.py: f"]),
        ("class A:\n  def f(self, a, b, c, d, *, e, f, g, h): ...", ["a.py: A.f"]),
        ("class A:\n  def f(self):\n    def g(a, b, c, d, e, f, g, h, i): ...", ["a.py: g"]),
        ("class A(BaseEstimator):\n  def __init__(self, a, b, c, d, e, f, g, h): ...", []),
        ("class A:\n  def __init__(self, a, b, c, d, e, f, g, h): ...", ["a.py: A.__init__"]),
    ],
)
def test_parameters_are_counted(code: str, found: list[str]) -> None:
    assert crowded(list(functions(ast.parse(code), "a.py"))) == found


@pytest.mark.parametrize(("lines", "docstring"), [(79, False), (80, False), (80, True)])
def test_lines_are_counted(lines: int, docstring: bool) -> None:
    body = ['    """What."""'] if docstring else []
    body += ["    pass"] * (lines - len(body))
    every = list(functions(ast.parse("\n".join(["def f():", *body])), "a.py"))
    assert len(silent(every)) == (lines == 80 and not docstring)
