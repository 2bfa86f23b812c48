from __future__ import annotations

import doctest
import importlib
import inspect
from pathlib import Path

import pytest

import sightline
from sightline.formats import write_boxes
from sightline.simulation import SimulationSettings, simulate

SOURCE = Path(sightline.__file__).parent


def modules_with_examples() -> list[str]:
    names = []
    for path in sorted(SOURCE.rglob("*.py")):
        if ">>> " in path.read_text(encoding="utf-8"):
            parts = path.relative_to(SOURCE.parent).with_suffix("").parts
            names.append(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
    return names


def docstrings(module: str) -> list[doctest.DocTest]:
    """Those of a module that have examples; a reader has typed no more than the import."""
    finder = doctest.DocTestFinder(exclude_empty=True)
    found = finder.find(importlib.import_module(module), globs={"sightline": sightline})
    return [one for one in found if one.examples]


EXAMPLES = [one for module in modules_with_examples() for one in docstrings(module)]


@pytest.fixture(scope="module")
def surroundings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a small scene, a model fitted to it, and tracks."""
    folder = tmp_path_factory.mktemp("docstrings")
    made = simulate(folder, SimulationSettings(seed=3, duration_s=30.0, video=False, clock="exact"))
    scene = sightline.Scene.load(made.scene)
    model = sightline.fit(scene)
    model.save(folder / "model.safetensors")
    seen = scene["02"].detections()
    write_boxes(seen, folder / "harbour.csv")
    sightline.track(seen, model).write(folder / "tracks.geojson")
    return folder


@pytest.fixture
def inside(surroundings: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(surroundings)
    return surroundings


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda one: one.name)
def test_examples_of_docstrings_give_what_they_say(example: doctest.DocTest, inside: Path) -> None:
    report: list[str] = []
    result = doctest.DocTestRunner(verbose=False).run(example, out=report.append, clear_globs=False)
    assert result.attempted == len(example.examples)
    assert result.failed == 0, "".join(report)


def test_every_public_name_has_an_example() -> None:
    shown = {one.name for one in EXAMPLES}
    for name in sightline.__all__:
        value = getattr(sightline, name)
        if not (inspect.isclass(value) or inspect.isfunction(value)):
            continue
        full = f"{value.__module__}.{value.__qualname__}"
        own = [one for one in shown if one == full or one.startswith(f"{full}.")]
        assert own, f"sightline.{name} has no example in its docstring"
