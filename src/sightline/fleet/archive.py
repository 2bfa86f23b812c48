"""All recordings of a fleet: each once, whole or not at all, and resumed by doing it again.

What is finished is known by a small file for each recording, ``finished/CAMERA/RECORDING.json``,
that is written after its tracks have taken their places. Whoever finds tracks without it takes them
for what a killed run has left.
"""

from __future__ import annotations

import functools
import hashlib
import os
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from sightline.atomic import own_folder
from sightline.errors import InputError, OutputError
from sightline.evaluation.report import write_json
from sightline.fleet.config import Fleet
from sightline.fleet.engines import Engine, Outcome
from sightline.fleet.tasks import Finished, Task, TaskResult, perform, tasks_of
from sightline.georeferencing.georeferencer import Georeferencer, load_model
from sightline.pipeline.sources import is_table, make_detector
from sightline.progress import Progress
from sightline.threads import on_one_thread
from sightline.video.mask import read_mask

_WORK = ".batch.unfinished"
_FINISHED = "finished"
_TRACKS = "tracks"


@dataclass
class BatchResult:
    """What a run over a fleet has done.

    Attributes:
        recordings: Of the fleet.
        done: Recordings that were tracked by this run.
        before: That had been tracked by an earlier run.
        failed: Why each of the others could not be, by its name.
        stopped: Whether somebody asked for an end before all were done.
        bug: Whether one failed by an error that is not the user's.
    """

    recordings: int
    done: int = 0
    before: int = 0
    failed: dict[str, str] = field(default_factory=dict)
    stopped: bool = False
    bug: bool = False

    def to_dict(self) -> dict[str, object]:
        """As JSON has it."""
        return {
            "recordings": self.recordings,
            "done": self.done,
            "before": self.before,
            "failed": dict(self.failed),
            "complete": not self.failed and not self.stopped,
        }


def run_batch(
    fleet: Fleet,
    output: Path,
    engine: Callable[[], Engine],
    *,
    retries: int = 2,
    progress: Progress | None = None,
    stop: threading.Event | None = None,
) -> BatchResult:
    """Track every recording of a fleet that has not been tracked yet, with the same settings.

    Args:
        fleet: Its cameras.
        output: The folder of results. Tracks go to
            ``tracks/camera=NAME/day=YYYY-MM-DD/RECORDING.parquet``.
        engine: Makes what performs the tasks, once they are known to be good; with several
            machines they all need to reach ``output``.
        retries: How often more a recording is tried that fails by no fault of its own.
        progress: Told how far it is.
        stop: Ends the run when it is set; what is finished stays.

    Raises:
        InputError: A model or a detector cannot be used, ``output`` holds other files, or
            another run writes to it.
    """
    models = _models(fleet)
    digests = {path: hashlib.sha256(content).hexdigest() for path, content in models.items()}
    output = _made(output)
    tasks = tasks_of(fleet)
    result = BatchResult(len(tasks))
    with own_folder(output / _WORK, output) as work:
        todo: list[tuple[Task, str]] = []
        for task in tasks:
            fingerprint = task.fingerprint(digests)
            if _is_finished(output, task, fingerprint):
                result.before += 1
            else:
                todo.append((task, fingerprint))
        _remove_leftovers(output, [task for task, _ in todo])
        marks = {task.name: fingerprint for task, fingerprint in todo}
        if not todo:
            return result
        performs = engine()
        try:
            function = _Perform(work, models)
            for outcome in performs.map(function, (task for task, _ in todo), retries, stop):
                _keep(output, work, outcome, marks[outcome.item.name], result)
                if progress is not None:
                    count = result.done + len(result.failed)
                    progress(f"{count} of {len(todo)} recordings", count / len(todo))
        finally:
            performs.close()
        result.stopped = result.done + len(result.failed) < len(todo)
    return result


def finished(output: Path, tasks: Iterable[Task]) -> Iterator[tuple[Task, TaskResult]]:
    """The recordings that are finished in a folder of results, with what was made of them."""
    for task in tasks:
        kept = _read(output, task)
        if kept is not None:
            yield task, kept.result


@dataclass(frozen=True)
class _Perform:
    """Performs a task, in whichever process: it carries the models along.

    Attributes:
        work: Where each task gets a folder of its own.
        models: The content of each model file.
    """

    work: Path
    models: Mapping[Path, bytes]

    def __call__(self, task: Task) -> TaskResult:
        folder = self.work / task.name
        _empty(folder)
        return _performed(task, _loaded(self.models[task.camera.model]), folder)


_performed = on_one_thread(perform)


@functools.lru_cache(maxsize=8)
def _loaded(content: bytes) -> Georeferencer:
    with tempfile.NamedTemporaryFile(suffix=".safetensors") as file:
        file.write(content)
        file.flush()
        return load_model(file.name)


def _made(output: Path) -> Path:
    """The folder of results, which is made where it is not there."""
    mark = output / _FINISHED
    if output.is_dir() and not mark.is_dir() and any(output.iterdir()):
        raise InputError(
            f"{output}: holds files, and none of an earlier batch; give a new or an empty folder"
        )
    try:
        mark.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{output}: cannot be made: {error.strerror}") from error
    return output.resolve()


def _models(fleet: Fleet) -> dict[Path, bytes]:
    """The content of each model file, after a look whether it can be used."""
    contents: dict[Path, bytes] = {}
    for camera in fleet.cameras:
        model = load_model(camera.model)
        contents[camera.model] = camera.model.read_bytes()
        if camera.mask is not None:
            read_mask(camera.mask).check_size(model.image_size_px, "the model")
        if any(not is_table(recording.source) for recording in camera.recordings):
            make_detector(camera.detector, model)
    return contents


def _is_finished(output: Path, task: Task, fingerprint: str) -> bool:
    kept = _read(output, task)
    if kept is None or kept.fingerprint != fingerprint:
        return False
    return all((output / name).is_file() for name in kept.result.files)


def _file(output: Path, task: Task) -> Path:
    return output / _FINISHED / f"{task.name}.json"


def _read(output: Path, task: Task) -> Finished | None:
    """What is known of a finished recording; None where nothing is, or it is none of ours."""
    try:
        return Finished.model_validate_json(_file(output, task).read_bytes())
    except (OSError, ValueError):
        return None


def _remove_leftovers(output: Path, tasks: list[Task]) -> None:
    """Remove tracks of recordings that are about to be tracked (again)."""
    wanted: dict[str, set[str]] = {}
    for task in tasks:
        wanted.setdefault(task.camera.name, set()).add(f"{task.recording.name}.parquet")
        _file(output, task).unlink(missing_ok=True)
    for camera, names in wanted.items():
        for day in sorted((output / _TRACKS / f"camera={camera}").glob("day=*")):
            for path in day.iterdir():
                if path.name in names:
                    path.unlink()


def _keep(
    output: Path,
    work: Path,
    outcome: Outcome[Task, TaskResult],
    fingerprint: str,
    result: BatchResult,
) -> None:
    """Let the files of a task take their places, and say that it is finished."""
    task = outcome.item
    if outcome.result is None:
        result.failed[task.name] = outcome.line or "nothing is known of it"
        result.bug |= outcome.bug
        return
    for name in outcome.result.files:
        place = output / name
        place.parent.mkdir(parents=True, exist_ok=True)
        os.replace(work / task.name / name, place)
    kept = Finished(fingerprint=fingerprint, result=outcome.result)
    write_json(_file(output, task), kept.model_dump())
    _empty(work / task.name)
    result.done += 1


def _empty(folder: Path) -> None:
    """Remove a folder with all that is in it, where there is one."""
    shutil.rmtree(folder, ignore_errors=True)
