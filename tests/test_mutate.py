from __future__ import annotations

import ast
import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

TOOL = Path(__file__).parents[1] / "tools" / "mutate.py"
AREA = '''\
"""Areas."""


def area_m2(width_m: float, height_m: float) -> float:
    """1 + 1 of this is no fault."""
    if width_m < 0.5 - 1.0:
        raise ValueError("é" + "that is " + str(-width_m))
    return width_m * height_m


def gap_m(one_m: float, other_m: float) -> float:
    return one_m - other_m
'''
LOOP = """\
def down(n: int) -> int:
    while n:
        n -= 1
    return n
"""


@pytest.fixture(scope="module")
def mutate() -> ModuleType:
    spec = importlib.util.spec_from_file_location("mutate", TOOL)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["mutate"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    """A project in which one function is tested and another is only called."""
    package, tests = tmp_path / "src" / "tiny" / "shapes", tmp_path / "tests" / "shapes"
    package.mkdir(parents=True)
    tests.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "area.py").write_text(AREA, encoding="utf-8")
    (tests / "test_area.py").write_text(
        "from tiny.shapes.area import area_m2, gap_m\n\n\n"
        "def test_area() -> None:\n"
        "    assert area_m2(2.0, 3.0) == 6.0\n"
        "    gap_m(2.0, 3.0)\n",
        encoding="utf-8",
    )
    return tmp_path


def run(root: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, TOOL, "shapes", "--root", root, "--source", "src/tiny", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("code", "faults"),
    [
        ("a + b", {"a - b", "a", "b"}),
        ("a - b", {"a + b", "a", "-b"}),
        ("a * b", {"a / b", "a", "b"}),
        ("a / b", {"a * b", "a"}),
        ("a ** b", {"a"}),
        ("a & b", {"a | b", "a", "b"}),
        ("a < b", {"a <= b"}),
        ("a >= b", {"a > b"}),
        ("not a", {"a"}),
        ("a\nx += b", {"a\nx -= b", "a\npass"}),
        ("-a", {"a"}),
        ("a and b", {"a or b", "a", "b"}),
        ("f(a, axis=0)", {"f(a, axis=1)"}),
        ("a[:, 1]", {"a[:, 0]"}),
        ("f(2.5)", {"f(-2.5)"}),
        ("f(1.0)", {"f(0.0)", "f(-1.0)"}),
        ("min(a, b)", {"max(a, b)"}),
        ("np.maximum(a, b)", {"np.minimum(a, b)"}),
        ("a.argmin()", {"a.argmax()"}),
        ("np.sin(a)", {"np.cos(a)"}),
        ("np.sqrt(a)", {"a"}),
        ("'a' + b", set()),
        ("f'{a + b}'", set()),
        ("f(True, 3, None)", set()),
    ],
)
def test_each_fault_changes_one_node(mutate: ModuleType, code: str, faults: set[str]) -> None:
    source = f"# é\nx = {code}\n".encode()
    found = mutate.mutants(Path("x.py"), source)
    planted = {ast.unparse(ast.parse(one.applied(source))).removeprefix("x = ") for one in found}
    assert planted == faults
    assert {one.line for one in found} <= {2 + code.count("\n")}


@pytest.mark.parametrize(
    "code",
    [
        '"""1 + 1"""',
        "def f(a: g[1]) -> h[0]: ...",
        "x: Literal[0] = y",
        "raise ValueError(1 + a)",
        "assert a < b, 1 + a",
        "class C:\n    def __repr__(self): return a + b",
        "if TYPE_CHECKING:\n    x = a + b",
    ],
)
def test_what_changes_no_result_is_left_alone(mutate: ModuleType, code: str) -> None:
    assert mutate.mutants(Path("x.py"), code.encode()) == []


def test_a_fault_that_no_test_notices_survives(tiny: Path) -> None:
    done = run(tiny, "--count", "100", "--verbose", "--at-most", "0.1")
    assert "one_m - other_m -> " in done.stdout, done.stderr
    lines = done.stdout.splitlines()
    noticed = [line for line in lines if "width_m * height_m -> " in line]
    assert noticed
    assert all(line.endswith("noticed by tests/shapes/test_area.py::test_area") for line in noticed)
    [survivor] = [line for line in lines if "one_m - other_m -> " in line and "SURVIVED" in line]
    assert "src/tiny/shapes/area.py:12 " in survivor
    assert "(gap_m)" in survivor
    # The bound and its two numbers survive as well.
    assert "shapes: 5 of 6 survived (83%)" in lines
    assert done.returncode == 1
    assert (tiny / "src/tiny/shapes/area.py").read_text(encoding="utf-8") == AREA


def test_what_hangs_counts_as_noticed(tiny: Path) -> None:
    (tiny / "src/tiny/shapes/area.py").write_text(LOOP, encoding="utf-8")
    (tiny / "tests/shapes/test_area.py").write_text(
        "from tiny.shapes.area import down\n\n\ndef test_end() -> None:\n    assert down(3) == 0\n",
        encoding="utf-8",
    )
    done = run(tiny, "--count", "1", "--timeout", "5", "--verbose")
    assert "noticed by exit status -1 of tests/shapes/test_area.py" in done.stdout, done.stderr
    assert "shapes: 0 of 1 survived (0%)" in done.stdout
    assert done.returncode == 0


def test_faults_that_are_listed_as_equivalent_are_not_tried(tiny: Path) -> None:
    (tiny / "tools").mkdir()
    (tiny / "tools" / "equivalent_mutants.toml").write_text(
        "".join(
            "[[equivalent]]\n"
            f'file = "src/tiny/shapes/area.py"\ninside = "gap_m"\nold = "{old}"\nnew = "{new}"\n'
            'reason = "nobody asks"\n'
            for old, new in [
                ("one_m - other_m", "one_m + other_m"),
                ("one_m - other_m", "one_m"),
                ("one_m - other_m", "-other_m"),
                ("one_m", "other_m"),
            ]
        )
    )
    done = run(tiny, "--count", "100", "--list")
    stale, *lines = done.stdout.splitlines()
    assert "no longer there: src/tiny/shapes/area.py one_m -> other_m (gap_m)" in stale
    assert len(lines) == 5
    assert not any("one_m - other_m" in line for line in lines)


def test_tests_that_fail_without_a_fault_are_refused(tiny: Path) -> None:
    """Else every fault would seem to be noticed."""
    with (tiny / "tests/shapes/test_area.py").open("a") as file:
        file.write("\n\ndef test_nothing() -> None:\n    assert False\n")
    done = run(tiny, "--count", "1")
    assert done.returncode != 0
    assert "without a fault, tests/shapes/test_area.py fails" in done.stderr


def test_a_sample_is_the_same_for_the_same_seed(tiny: Path) -> None:
    one, same, other = (
        run(tiny, "--count", "3", "--list", "--seed", seed).stdout for seed in ("1", "1", "4")
    )
    assert len(one.splitlines()) == 3
    assert one == same != other
