from __future__ import annotations

import ast
import importlib
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import grimp
import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")], key=lambda page: page.as_posix()
)

_LINK = re.compile(r"\]\(([^)\s]+)\)")
_FENCED = re.compile(r"^(```|~~~).*?^\1", re.MULTILINE | re.DOTALL)
_HEADING = re.compile(r"^#{1,6} +(.+)$", re.MULTILINE)


def _project() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def _requirements() -> list[Requirement]:
    project = _project()
    written = [
        *project["build-system"]["requires"],
        *project["project"]["dependencies"],
        *(one for extra in project["project"]["optional-dependencies"].values() for one in extra),
        *(one for group in project["dependency-groups"].values() for one in group),
    ]
    return [Requirement(one) for one in written if isinstance(one, str)]


def _pins() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [line for line in lines if line and not line.startswith("#")]
    return {canonicalize_name(name): version for name, version in (p.split("==") for p in pins)}


def _anchors(page: Path) -> set[str]:
    text = _FENCED.sub("", page.read_text(encoding="utf-8"))
    plain = [re.sub(r"[`*]|\[([^]]*)\]\([^)]*\)", r"\1", title) for title in _HEADING.findall(text)]
    return {re.sub(r"[\s]+", "-", re.sub(r"[^\w\s-]", "", t.lower()).strip()) for t in plain}


def test_every_dependency_is_pinned_to_a_version_that_it_allows() -> None:
    pins = _pins()
    requirements = _requirements()
    assert len(requirements) > 30
    for requirement in requirements:
        name = canonicalize_name(requirement.name)
        assert name in pins, f"{name} has no pin; run: make constraints"
        assert requirement.specifier.contains(pins[name]), f"{requirement} excludes {pins[name]}"


def test_pins_name_versions_and_no_place() -> None:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    for line in lines:
        assert line.startswith("#") or re.fullmatch(r"[\w.-]+==[\w.+!]+", line), line


def test_base_installation_is_light() -> None:
    heavy = {"torch", "tensorflow", "jax", "ultralytics", "pyarrow", "geopandas", "pycocotools"}
    base: set[str] = set()
    waiting = [Requirement(one) for one in _project()["project"]["dependencies"]]
    while waiting:
        requirement = waiting.pop()
        name = canonicalize_name(requirement.name)
        if name in base or not (requirement.marker is None or requirement.marker.evaluate()):
            continue
        base.add(name)
        waiting += [Requirement(one) for one in distribution(name).requires or []]
    assert len(base) > 30
    assert not base & heavy


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(page: Path) -> None:
    text = _FENCED.sub("", page.read_text(encoding="utf-8"))
    for link in _LINK.findall(text):
        if "://" in link or link.startswith("mailto:"):
            continue
        path, _, anchor = link.partition("#")
        target = page if not path else (page.parent / path).resolve()
        assert target.exists(), f"{page.name} links to {path}, which does not exist"
        if anchor:
            assert anchor in _anchors(target), f"{page.name}: {target.name} has no #{anchor}"


def test_every_page_is_in_the_table_of_contents() -> None:
    contents = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    for page in (ROOT / "docs").rglob("*.md"):
        name = page.relative_to(ROOT / "docs").as_posix()
        assert f": {name}\n" in contents, f"{name} is not in mkdocs.yml"


def test_what_make_is_said_to_do_it_can_do() -> None:
    known = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    said = set()
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        said |= set(re.findall(r"(?:^    |`)make ([a-z-]+)", text, re.MULTILINE))
    assert {"demo", "test", "check", "bench", "docs"} <= said
    assert said <= known, f"not in the Makefile: {sorted(said - known)}"


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
@pytest.mark.parametrize(
    ("python", "folder"),
    [
        ("python3", ".venv"),
        ("python3.12", ".venv-python3.12"),
        ("/opt/python3.13/bin/python3", ".venv-opt-python3.13-bin-python3"),
    ],
)
def test_each_python_has_an_environment_of_its_own(python: str, folder: str) -> None:
    asked = ["make", "--dry-run", "--always-make", "test", f"PYTHON={python}"]
    # What the make that runs these tests was told is not for this one.
    own = {key: value for key, value in os.environ.items() if not key.startswith("MAKE")}
    done = subprocess.run(asked, cwd=ROOT, env=own, capture_output=True, text=True, check=True)
    assert f"{python} -m venv {folder} " in done.stdout
    assert f"{folder}/bin/python -m pytest" in done.stdout


def test_the_changelog_sends_to_modules_that_are_there() -> None:
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    table = text.split("Modules that have moved:")[1].split("## 0.1.0")[0]
    rows = [line.split(" | ") for line in table.splitlines() if line.startswith("| `sightline.")]
    assert len(rows) > 30
    for _, new in rows:
        for module in re.findall(r"`(sightline[\w.]+)`", new):
            assert importlib.util.find_spec(module) is not None, module


def test_layers_of_the_import_contract_are_all_modules() -> None:
    contract = _project()["tool"]["importlinter"]["contracts"][0]
    modules = {
        path.stem
        for path in (ROOT / "src" / "sightline").iterdir()
        if path.suffix == ".py" or (path / "__init__.py").exists()
    }
    named = [name for layer in contract["layers"] for name in layer.split(" | ")]
    # The package itself, and `python -m sightline`, which only calls the command line.
    assert sorted(named) == sorted(modules - {"__init__", "__main__"})


def test_packages_stand_on_at_most_twelve_floors() -> None:
    """A package stands above all that it imports; a circle would have no floor."""
    source = ROOT / "src" / "sightline"
    below: dict[str, set[str]] = {}
    for path in source.rglob("*.py"):
        own = path.relative_to(source).parts[0].removesuffix(".py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("sightline."):
                other = str(node.module).split(".")[1]
                if own not in (other, "__init__"):
                    below.setdefault(own, set()).add(other)
    floor: dict[str, int] = {}

    def visit(name: str, above: tuple[str, ...]) -> int:
        assert name not in above, f"a circle: {' -> '.join((*above, name))}"
        if name not in floor:
            others = (visit(other, (*above, name)) for other in below.get(name, ()))
            floor[name] = 1 + max(others, default=0)
        return floor[name]

    assert max(visit(name, ()) for name in list(below)) <= 12


def test_nothing_is_shipped_that_the_package_does_not_use() -> None:
    """What tests and benchmarks alone want is in `benchmarks/_support`."""
    graph = grimp.build_graph("sightline")
    unused = {
        module
        for module in graph.modules - {"sightline", "sightline.__main__"}
        if not graph.find_children(module) and not graph.find_modules_that_directly_import(module)
    }
    source = "".join(path.read_text("utf-8") for path in (ROOT / "src").rglob("*.py"))
    # Architectures are imported by their name, and the detector that ships is a folder of files.
    assert {module for module in unused if f'"{module}"' not in source} <= {
        "sightline.detection.harbour"
    }


def test_the_package_is_quick_to_import() -> None:
    """What takes seconds to load waits until it is used."""
    heavy = ("sklearn", "torch", "onnxruntime", "matplotlib", "cv2", "av", "pandas", "scipy")
    code = (
        "import sys, sightline\n"
        f"print(*[name for name in {heavy!r} if name in sys.modules])\n"
        "assert all(hasattr(sightline, name) for name in sightline.__all__)\n"
        "assert not hasattr(sightline, 'nothing')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []


def _benchmarks() -> list[Path]:
    return sorted((ROOT / "benchmarks").rglob("*.py"))


@pytest.mark.parametrize("path", _benchmarks(), ids=lambda path: path.stem)
def test_benchmarks_ask_for_what_is_there(path: Path) -> None:
    """They are run seldom, and must not rot in between."""
    asked = [
        (node.module, name.name)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom)
        and (node.module or "").split(".")[0] in ("sightline", "_support")
        for name in node.names
    ]
    for module, name in asked:
        assert module is not None
        if module.startswith("sightline.training") and importlib.util.find_spec("torch") is None:
            continue
        there = hasattr(importlib.import_module(module), name)
        assert there or importlib.util.find_spec(f"{module}.{name}") is not None, (module, name)


OLD_WORDS = (
    "stance",
    "stances",
    "StanceWatch",
    "StandingWatch",
    "Conditions",
    "HorizonWatch",
    "Looker",
    "Placed",
    "Pairs",
    "Sightings",
    "Whereabouts",
    "LoggedPath",
    "SourceBelief",
    "Turns",
    "levelled",
    "drift_m",
    "drift_s",
    "lasting_s",
    "tau_s",
    "alike_s",
    "ALIKE_S",
    "eye_m",
    "agility",
    "manner",
    "prophets",
    "foretell",
    "SeldomError",
    "in_hand",
    "log_sigma_m",
    "focal_log_sigma",
    "height_log_sigma",
    "moved_since",
    "lies_since",
    "correct_turns",
    "habit",
    "habits",
)
"""Words of 0.1 that nobody of the field would search for."""

STILL_SAID = {
    # Keys of files and options of 0.1 are still taken, and a key of reports is as it was.
    ("georeferencer.py", "drift_m"),
    ("georeferencer.py", "drift_s"),
    ("georeferencer.py", "focal_log_sigma"),
    ("georeferencer.py", "height_log_sigma"),
    ("report.py", "log_sigma_m"),
    ("read-the-report.md", "log_sigma_m"),
}


def test_the_words_of_the_field_are_used() -> None:
    pages = [*(ROOT / "docs").rglob("*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
    said = [
        f"{path.relative_to(ROOT)}: {word}"
        for path in [*(ROOT / "src").rglob("*.py"), *pages]
        for word in set(re.findall(r"\w+", path.read_text(encoding="utf-8"))) & set(OLD_WORDS)
        if (path.name, word) not in STILL_SAID
    ]
    assert sorted(said) == []
