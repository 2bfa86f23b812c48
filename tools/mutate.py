"""Plant small faults in the code, one at a time, and see whether a test notices.

A fault is one node of the syntax tree changed: a sign, a comparison, an axis, a dropped term.
Each is written into a temporary copy of the project, never into the project itself, and the tests
of the mirrored folder are run on it, those that import the changed module first; what survives
them is tried on the tests of other folders as well. What hangs counts as noticed.

    python tools/mutate.py camera tracking --count 20 --seed 1

Faults that change nothing stand in tools/equivalent_mutants.toml, each with its reason.
"""

from __future__ import annotations

import argparse
import ast
import os
import queue
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[1]
# Where else what a package does shows, after the tests of its own folder.
WIDER = {
    "camera": ("georeferencing", "scene", "pipeline"),
    "georeferencing": ("camera", "labelling", "pipeline"),
    "trajectory": ("tracking", "pipeline"),
    "tracking": ("trajectory", "pipeline"),
    "evaluation": ("reporting", "pipeline"),
}
NOT_COPIED = shutil.ignore_patterns(
    ".git", ".venv", ".*_cache", ".hypothesis", "__pycache__", "site", "results", "*.egg-info"
)
# A stage may take so many times what it takes without a fault; other work shares the machine.
SLOWER, SLOWER_S = 4.0, 60.0

_OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
_COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
}
_PAIRS = [
    ("min", "max"),
    ("minimum", "maximum"),
    ("fmin", "fmax"),
    ("nanmin", "nanmax"),
    ("argmin", "argmax"),
    ("sin", "cos"),
]
_NAMES = {**dict(_PAIRS), **{other: one for one, other in _PAIRS}}
# A call of one of these on one argument may be forgotten.
_FORGOTTEN = {"sqrt", "exp", "log", "log1p", "expm1", "abs", "square", "radians", "degrees"}
_NO_FAULTS = (ast.Raise, ast.Assert, ast.JoinedStr, ast.Import, ast.ImportFrom)
_PLACE = ("lineno", "col_offset", "end_lineno", "end_col_offset")
_LONGEST_SHOWN = 60
_NO_NUMBERS = (ast.List, ast.Tuple, ast.ListComp, ast.JoinedStr)


@dataclass(frozen=True)
class Mutant:
    """One fault.

    Attributes:
        path: Of the file, from the root.
        line: Where the changed expression begins.
        inside: The function or class that holds it, with dots; empty in a module's body.
        old: The expression as it stands, with what is around it where it is short.
        new: As it is changed.
        start: Where what is changed begins in the file, bytes.
        end: Where it ends.
        text: What it becomes.
    """

    path: Path
    line: int
    inside: str
    old: str
    new: str
    start: int
    end: int
    text: str

    @property
    def key(self) -> tuple[str, str, str, str]:
        """What stays the same when lines above it change."""
        return self.path.as_posix(), self.inside, self.old, self.new

    def __str__(self) -> str:
        inside = f" ({self.inside})" if self.inside else ""
        return f"{self.path.as_posix()}:{self.line} {self.old} -> {self.new}{inside}"

    def applied(self, source: bytes) -> bytes:
        """The file with the fault in it."""
        return source[: self.start] + self.text.encode() + source[self.end :]


def _one_line(code: str) -> str:
    return " ".join(code.split())


def mutants(path: Path, source: bytes) -> list[Mutant]:
    """All faults that can be planted in a file."""
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def extent(node: ast.AST) -> tuple[int, int]:
        place = (getattr(node, name) for name in _PLACE)
        line, column, end_line, end_column = place
        return starts[line - 1] + column, starts[end_line - 1] + end_column

    out = []
    for node, inside, above in _expressions(ast.parse(source), "", ()):
        start, end = first, last = extent(node)
        if isinstance(node, ast.Constant | ast.Name | ast.Attribute):
            # Of what `0` is by itself nothing tells.
            for around in reversed(above):
                if not isinstance(around, ast.expr | ast.keyword):
                    break
                one, other = extent(around)
                if other - one > _LONGEST_SHOWN:
                    break
                first, last = one, other
        for new in _faults(node, above[-1]):
            text = ast.unparse(new)
            old = source[first:last].decode()
            shown = source[first:start].decode() + text + source[end:last].decode()
            out.append(
                Mutant(
                    path,
                    node.lineno,
                    inside,
                    _one_line(old),
                    _one_line(shown),
                    start,
                    end,
                    f"({text})" if isinstance(new, ast.expr) else text,
                )
            )
    return out


def _expressions(
    node: ast.AST, inside: str, above: tuple[ast.AST, ...]
) -> Iterator[tuple[ast.expr | ast.AugAssign, str, tuple[ast.AST, ...]]]:
    """Nodes in which a fault may be, with what holds them and the nodes above them."""
    if isinstance(node, _NO_FAULTS) or getattr(node, "name", "") in ("__repr__", "__str__"):
        return
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return
    if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
        return
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        inside = f"{inside}.{node.name}".lstrip(".")
    if isinstance(node, ast.expr | ast.AugAssign):
        yield node, inside, above
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from _expressions(child, inside, (*above, node))


def _faults(
    node: ast.expr | ast.AugAssign, parent: ast.AST
) -> Iterator[ast.expr | ast.AugAssign | ast.Pass]:
    """A node with one plausible fault each."""
    if isinstance(node, ast.AugAssign):
        swapped_by = _OPERATORS.get(type(node.op))
        if swapped_by is not None and not isinstance(node.value, _NO_NUMBERS):
            yield ast.AugAssign(node.target, swapped_by(), node.value)
            yield ast.Pass()
    elif isinstance(node, ast.BinOp):
        yield from _faults_of_operator(node)
    elif isinstance(node, ast.Compare) and len(node.ops) == 1:
        reversed_by = _COMPARISONS.get(type(node.ops[0]))
        if reversed_by is not None:
            yield ast.Compare(node.left, [reversed_by()], node.comparators)
    elif isinstance(node, ast.UnaryOp) and not isinstance(node.op, ast.UAdd):
        yield node.operand
    elif isinstance(node, ast.BoolOp):
        yield ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values)
        for i in range(len(node.values)):
            left = [*node.values[:i], *node.values[i + 1 :]]
            yield ast.BoolOp(node.op, left) if len(left) > 1 else left[0]
    elif isinstance(node, ast.Call):
        name = getattr(node.func, "attr", getattr(node.func, "id", ""))
        if name in _FORGOTTEN and len(node.args) == 1 and not node.keywords:
            yield node.args[0]
    elif isinstance(node, ast.Attribute | ast.Name) and isinstance(parent, ast.Call):
        name = node.attr if isinstance(node, ast.Attribute) else node.id
        if parent.func is node and name in _NAMES:
            other = _NAMES[name]
            yield (
                ast.Attribute(node.value, other)
                if isinstance(node, ast.Attribute)
                else ast.Name(other)
            )
    elif isinstance(node, ast.Constant):
        yield from _faults_of_number(node, parent)


def _faults_of_operator(node: ast.BinOp) -> Iterator[ast.expr]:
    if any(
        isinstance(side, _NO_NUMBERS)
        or (isinstance(side, ast.Constant) and isinstance(side.value, str | bytes | None))
        for side in (node.left, node.right)
    ):
        return
    swapped = _OPERATORS.get(type(node.op))
    if swapped is not None:
        yield ast.BinOp(node.left, swapped(), node.right)
    yield node.left
    if isinstance(node.op, ast.Add | ast.BitAnd | ast.BitOr | ast.Mult):
        yield node.right
    elif isinstance(node.op, ast.Sub):
        yield ast.UnaryOp(ast.USub(), node.right)


def _faults_of_number(node: ast.Constant, parent: ast.AST) -> Iterator[ast.expr]:
    value = node.value
    if isinstance(value, bool) or not isinstance(value, int | float):
        return
    if value in (0, 1):
        yield ast.Constant(type(value)(1 - value))
    # A negative whole number is an index or a size that fails at once.
    if isinstance(value, float) and value != 0.0 and not isinstance(parent, ast.UnaryOp):
        yield ast.UnaryOp(ast.USub(), node)


@dataclass
class Project:
    """A project whose tests are run on copies of it.

    Attributes:
        root: Its folder.
        source: Of its package, from the root.
        equivalent: Faults that change nothing, with their reasons.
        timeout_s: Of each stage; None: by how long it takes without a fault.
    """

    root: Path
    source: Path
    equivalent: dict[tuple[str, str, str, str], str]
    timeout_s: float | None = None
    _took_s: dict[tuple[str, ...], float] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def files(self, package: str) -> list[Path]:
        """Files of a package or a module, from the root."""
        at = self.root / self.source / package
        found = sorted(at.rglob("*.py")) if at.is_dir() else [at.with_suffix(".py")]
        if not found or not found[0].is_file():
            sys.exit(f"{self.source / package} is neither a package nor a module")
        return [path.relative_to(self.root) for path in found]

    def sample(self, package: str, count: int, seed: int) -> list[Mutant]:
        """Some faults of a package, the same for the same seed: one for each place drawn."""
        places: dict[tuple[Path, int, int], list[Mutant]] = {}
        for path in self.files(package):
            for one in mutants(path, (self.root / path).read_bytes()):
                if one.key not in self.equivalent:
                    places.setdefault((one.path, one.start, one.end), []).append(one)
        rng = random.Random(f"{seed} {package}")  # noqa: S311
        drawn = rng.sample(sorted(places), min(count, len(places)))
        return [rng.choice(places[place]) for place in drawn]

    def stages(self, path: Path, wider: bool) -> list[tuple[str, ...]]:
        """Tests to run on a fault in a file, as arguments of pytest, the likeliest first."""
        parts = path.relative_to(self.source).with_suffix("").parts
        module = ".".join((*self.source.parts[1:], *parts)).removesuffix(".__init__")
        own: list[Path] = []
        # Of the folder that mirrors the file's own, then of those above it.
        for depth in range(len(parts) - 1, 0, -1):
            folder = self.root / "tests" / Path(*parts[:depth])
            own += [test for test in sorted(folder.rglob("test_*.py")) if test not in own]
        if len(parts) == 1:
            own = sorted((self.root / "tests").glob(f"test_{parts[0]}.py"))
        asks = {test for test in own if _imports(test, module)}
        groups = [[test for test in own if test in asks], [t for t in own if t not in asks]]
        if wider:
            folders = [self.root / "tests" / name for name in WIDER.get(parts[0], ())]
            groups += [[folder] for folder in folders if folder.is_dir()]
        return [
            tuple(test.relative_to(self.root).as_posix() for test in group)
            for group in groups
            if group
        ]

    def noticed(self, mutant: Mutant, copy: Path, wider: bool) -> str:
        """What noticed a fault: the first test that fails, or empty where none does."""
        source = (self.root / mutant.path).read_bytes()
        for stage in self.stages(mutant.path, wider):
            limit_s = self.timeout_s or SLOWER_S + SLOWER * self._alone_s(stage, copy)
            (copy / mutant.path).write_bytes(mutant.applied(source))
            try:
                code, output = _pytest(copy, stage, limit_s)
            finally:
                (copy / mutant.path).write_bytes(source)
            if code not in (0, 5):
                failed = re.search(r"^(?:FAILED|ERROR) (\S+)", output, re.MULTILINE)
                return failed[1] if failed else f"exit status {code} of {stage[0]}"
        return ""

    def _alone_s(self, stage: tuple[str, ...], copy: Path) -> float:
        """How long tests take without a fault, under which they must pass."""
        with self._lock:
            if stage not in self._took_s:
                began = time.monotonic()
                code, output = _pytest(copy, stage, None)
                if code not in (0, 5):
                    sys.exit(f"without a fault, {' '.join(stage)} fails:\n{output[-2000:]}")
                self._took_s[stage] = time.monotonic() - began
            return self._took_s[stage]


def _imports(test: Path, module: str) -> bool:
    """Whether a test imports a module, or names from it."""
    package, _, name = module.rpartition(".")
    for node in ast.walk(ast.parse(test.read_bytes())):
        if isinstance(node, ast.ImportFrom):
            if node.module == module:
                return True
            if node.module == package and any(one.name == name for one in node.names):
                return True
        elif isinstance(node, ast.Import) and any(one.name == module for one in node.names):
            return True
    return False


def _pytest(copy: Path, tests: tuple[str, ...], limit_s: float | None) -> tuple[int, str]:
    """Exit status and output of the tests in a copy; a status of -1 where they hang."""
    environment = {
        **os.environ,
        # A cached module of the same size and second would be taken for the changed one.
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONPATH": str(copy / "src"),
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }
    # The same examples for each fault: one that chance finds would be taken for it being noticed.
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
    command += ["--hypothesis-seed=0", *tests]
    with tempfile.TemporaryDirectory() as examples, tempfile.TemporaryFile() as file:
        environment["HYPOTHESIS_STORAGE_DIRECTORY"] = examples
        # Tests start processes of their own; all of them end with the session.
        process = subprocess.Popen(
            command,
            cwd=copy,
            env=environment,
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            code = process.wait(limit_s)
        except subprocess.TimeoutExpired:
            code = -1
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        file.seek(0)
        return code, file.read().decode(errors="replace")


def read_equivalent(path: Path) -> dict[tuple[str, str, str, str], str]:
    """The faults that change nothing, by `Mutant.key`, with their reasons."""
    if not path.is_file():
        return {}
    out = {}
    for one in tomllib.loads(path.read_text(encoding="utf-8")).get("equivalent", []):
        out[one["file"], one.get("inside", ""), one["old"], one["new"]] = one["reason"]
    return out


def stale(project: Project) -> list[tuple[str, str, str, str]]:
    """Faults that are listed as equivalent and that can no longer be planted."""
    known: set[tuple[str, str, str, str]] = set()
    for name in {file for file, *_ in project.equivalent}:
        if (project.root / name).is_file():
            path = Path(name)
            known |= {one.key for one in mutants(path, (project.root / path).read_bytes())}
    return sorted(set(project.equivalent) - known)


def try_all(
    project: Project, packages: dict[str, list[Mutant]], workers: int, *, wider: bool, verbose: bool
) -> dict[str, list[Mutant]]:
    """The survivors of each package."""
    waiting = [(package, one) for package, drawn in packages.items() for one in drawn]
    survivors: dict[str, list[Mutant]] = {package: [] for package in packages}
    copies: queue.SimpleQueue[Path] = queue.SimpleQueue()
    done = 0
    lock = threading.Lock()

    def attempt(job: tuple[str, Mutant]) -> None:
        nonlocal done
        package, mutant = job
        copy = copies.get()
        began = time.monotonic()
        try:
            by = project.noticed(mutant, copy, wider)
        finally:
            copies.put(copy)
        with lock:
            done += 1
            if not by:
                survivors[package].append(mutant)
            if verbose or not by:
                said = f"noticed by {by}" if by else "SURVIVED"
                took_s = time.monotonic() - began
                print(f"[{done}/{len(waiting)}, {took_s:.0f} s] {mutant}: {said}", flush=True)

    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        for i in range(workers):
            copy = Path(folder) / str(i)
            shutil.copytree(project.root, copy, ignore=NOT_COPIED)
            copies.put(copy)
        with ThreadPoolExecutor(workers) as pool:
            # Errors of a job are raised where its result is asked for.
            list(pool.map(attempt, waiting))
    return survivors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("packages", nargs="+", help="packages or modules, as in src/sightline")
    parser.add_argument("--count", type=int, default=30, help="faults a package (default 30)")
    parser.add_argument("--seed", type=int, default=0, help="of the sample (default 0)")
    parser.add_argument("--workers", type=int, default=1, help="at the same time (default 1)")
    parser.add_argument("--timeout", type=float, help="seconds a run of tests may take")
    parser.add_argument("--narrow", action="store_true", help="only tests of the mirrored folder")
    parser.add_argument("--at-most", type=float, help="fail where a larger share survives")
    parser.add_argument("--verbose", action="store_true", help="tell of each fault as it is tried")
    parser.add_argument("--list", action="store_true", help="only say which faults would be tried")
    parser.add_argument("--root", type=Path, default=ROOT, help="of the project")
    parser.add_argument("--source", type=Path, default=Path("src/sightline"), help="from the root")
    asked = parser.parse_args()
    equivalent = read_equivalent(asked.root / "tools" / "equivalent_mutants.toml")
    project = Project(asked.root.resolve(), asked.source, equivalent, asked.timeout)
    for file, inside, old, new in stale(project):
        print(f"listed as equivalent, and no longer there: {file} {old} -> {new} ({inside})")
    drawn = {name: project.sample(name, asked.count, asked.seed) for name in asked.packages}
    if asked.list:
        print(*(one for package in drawn.values() for one in package), sep="\n")
        return
    survivors = try_all(
        project, drawn, asked.workers, wider=not asked.narrow, verbose=asked.verbose
    )
    print()
    too_many = False
    for package, sample in drawn.items():
        share = len(survivors[package]) / max(len(sample), 1)
        too_many |= asked.at_most is not None and share > asked.at_most
        print(f"{package}: {len(survivors[package])} of {len(sample)} survived ({share:.0%})")
        for one in sorted(survivors[package], key=lambda one: (one.path, one.line)):
            print(f"  {one}")
    sys.exit(1 if too_many else 0)


if __name__ == "__main__":
    main()
