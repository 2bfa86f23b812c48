"""Engines: every item has one outcome, whatever happens to the processes."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from sightline.errors import InputError
from sightline.fleet.engines import LocalEngine, Outcome


def square(number: int) -> int:
    return number * number


def what_is_asked(item: tuple[str, Path]) -> str:
    """Fails as it is asked to, and notes each time that it was called."""
    what, folder = item
    tried = folder / f"{what}-{time.monotonic_ns()}-{os.getpid()}"
    tried.touch()
    times = len(list(folder.glob(f"{what}-*")))
    if what == "killed" and times == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    if what == "always killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if what == "disk" and times < 3:
        raise OSError(5, "Input/output error")
    if what == "memory":
        raise MemoryError
    if what == "user":
        raise InputError("a.mp4: is no video")
    if what == "bug":
        raise ZeroDivisionError("division\nby zero")
    if what == "sleeps":
        time.sleep(600.0)
    return what


@pytest.fixture
def engine() -> Iterator[LocalEngine]:
    engine = LocalEngine(2)
    yield engine
    engine.close()


def outcomes(
    engine: LocalEngine, folder: Path, *what: str, retries: int = 2
) -> dict[str, Outcome[tuple[str, Path], str]]:
    found = list(engine.map(what_is_asked, [(one, folder) for one in what], retries))
    assert len(found) == len(what)
    return {outcome.item[0]: outcome for outcome in found}


def tried(folder: Path, what: str) -> int:
    return len(list(folder.glob(f"{what}-*")))


def test_every_item_has_its_result_once(engine: LocalEngine) -> None:
    found = list(engine.map(square, iter(range(50))))
    assert sorted(outcome.item for outcome in found) == list(range(50))
    assert all(outcome.result == outcome.item**2 for outcome in found)
    assert all(outcome.line is None and outcome.attempts == 1 for outcome in found)


def test_an_item_whose_process_is_killed_is_tried_again_and_no_other(
    engine: LocalEngine, tmp_path: Path
) -> None:
    found = outcomes(engine, tmp_path, "a", "killed", "b", "c")
    assert {name: outcome.result for name, outcome in found.items()} == {
        name: name for name in ("a", "killed", "b", "c")
    }
    assert found["killed"].attempts == 2
    assert [tried(tmp_path, name) for name in ("a", "b", "c", "killed")] == [1, 1, 1, 2]


def test_what_fails_every_time_is_given_up_and_says_why(
    engine: LocalEngine, tmp_path: Path
) -> None:
    found = outcomes(engine, tmp_path, "always killed", "memory", "a", retries=1)
    assert "signal 9" in (found["always killed"].line or "")
    assert found["memory"].line == "there was not enough memory"
    assert [tried(tmp_path, name) for name in ("always killed", "memory", "a")] == [2, 2, 1]
    assert found["always killed"].result is None


def test_an_error_of_the_system_is_tried_again(engine: LocalEngine, tmp_path: Path) -> None:
    assert outcomes(engine, tmp_path, "disk")["disk"].attempts == 3


def test_what_is_wrong_with_an_item_is_not_tried_again(engine: LocalEngine, tmp_path: Path) -> None:
    found = outcomes(engine, tmp_path, "user", "bug")
    assert found["user"].line == "a.mp4: is no video"
    assert not found["user"].bug
    assert found["bug"].line == "ZeroDivisionError: division by zero"
    assert found["bug"].bug
    assert tried(tmp_path, "user") == tried(tmp_path, "bug") == 1


def test_items_are_taken_as_they_are_needed(engine: LocalEngine) -> None:
    taken: list[int] = []

    def items() -> Iterator[int]:
        for number in range(1000):
            taken.append(number)
            yield number

    found = engine.map(square, items())
    for _ in range(5):
        next(found)
    assert len(taken) <= 5 + engine.workers


def test_a_stop_ends_what_is_at_work(engine: LocalEngine, tmp_path: Path) -> None:
    stop = threading.Event()
    threading.Timer(0.5, stop.set).start()
    assert list(engine.map(what_is_asked, [("sleeps", tmp_path)], stop=stop)) == []
    assert not multiprocessing.active_children()


def test_no_workers_are_refused() -> None:
    with pytest.raises(InputError, match="workers is -1; give 1 or more"):
        LocalEngine(-1)


@pytest.mark.slow
def test_ray_has_the_same_outcomes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray", reason="needs sightline[ray]")
    # Its processes are to find the function of this module.
    paths = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))
    from sightline.fleet.ray_engine import RayEngine

    engine = RayEngine(workers=2)
    try:
        what = ("a", "killed", "b", "user", "bug", "disk")
        found = outcomes(engine, tmp_path, *what)
    finally:
        engine.close()
    assert {name for name, outcome in found.items() if outcome.result == name} == {
        *("a", "b", "killed", "disk")
    }
    assert found["user"].line == "a.mp4: is no video"
    assert found["bug"].bug
    assert [tried(tmp_path, name) for name in what] == [1, 2, 1, 1, 1, 3]
