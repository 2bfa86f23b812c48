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

# With the reason why a call of it may be given more.
_MANY_PARAMETERS = {
    "pipeline/track.py: track": "what a source may come with, each by its name: the public verb",
    "pipeline/track.py: iter_tracks": "as `track`",
    "simulation/harbour.py: Harbour.random": "what is in a harbour, each by its name: public",
    "simulation/simulate.py: simulate": "what is in a recording, each by its name: public",
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
    """More belong together in a table or in settings; whoever is mended leaves the list."""
    assert sorted(crowded(_of_the_library())) == sorted(_MANY_PARAMETERS)


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
