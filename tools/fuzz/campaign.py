"""Many inputs, by a seed: the same ones however many processes take part."""

from __future__ import annotations

import gc
import json
import multiprocessing
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from fuzz import readers as known
from fuzz.isolation import READ, Limits, Outcome, call_apart
from fuzz.readers import Reader

_BATCH = 25
_LARGEST_BYTES = 8_000_000


@dataclass(frozen=True)
class Input:
    """A spoilt example.

    Attributes:
        number: In the campaign.
        reader: That is given it.
        name: Of its file.
        content: Its bytes.
        spoilt_by: Names of the mutators, in order.
    """

    number: int
    reader: Reader
    name: str
    content: bytes
    spoilt_by: tuple[str, ...]


@dataclass(frozen=True)
class Result:
    """What became of an input."""

    number: int
    reader: str
    name: str
    spoilt_by: tuple[str, ...]
    outcome: Outcome


@dataclass
class Tallied:
    """What became of the inputs of a reader."""

    tried: int = 0
    read: int = 0
    refused: int = 0
    findings: int = 0
    longest_s: float = 0.0
    peak_mb: float = 0.0

    def add(self, outcome: Outcome) -> None:
        """Count an outcome."""
        self.tried += 1
        self.findings += outcome.is_finding
        self.read += outcome.end == READ
        self.refused += not outcome.is_finding and outcome.end != READ
        self.longest_s = max(self.longest_s, outcome.seconds)
        self.peak_mb = max(self.peak_mb, outcome.peak_mb)


@dataclass
class Summary:
    """What became of a campaign.

    Attributes:
        readers: By name.
        findings: Results, by what happened; the first of each is kept with its input.
        seconds: How long it took.
    """

    readers: dict[str, Tallied] = field(default_factory=dict)
    findings: dict[str, list[Result]] = field(default_factory=dict)
    seconds: float = 0.0


def make_input(seed: int, number: int, examples: Path, readers: Sequence[Reader]) -> Input:
    """The input of a number: it depends on the seed and on what comes with the arguments alone.

    Args:
        seed: Of the campaign.
        number: Of the input.
        examples: The folder of unspoilt examples.
        readers: Among which one is drawn.
    """
    rng = np.random.default_rng([seed, number])
    turns = [reader for reader in readers for _ in range(reader.weight)]
    # In turn rather than by chance, so that a short campaign leaves none out.
    reader = turns[_stride(number, len(turns))]
    name = reader.examples[int(rng.integers(len(reader.examples)))]
    content = (examples / name).read_bytes()
    spoilt_by = []
    if rng.random() < 0.01:
        foreign = sorted((examples / "foreign").iterdir())
        other = foreign[int(rng.integers(len(foreign)))]
        content = other.read_bytes()
        spoilt_by.append(f"replaced by {other.name}")
    for _ in range(1 + min(int(rng.geometric(0.6)) - 1, 4)):
        mutator = reader.mutators[int(rng.integers(len(reader.mutators)))]
        spoilt_by.append(mutator.__name__)
        content = mutator(rng, content)[:_LARGEST_BYTES]
    return Input(number, reader, Path(name).name, content, tuple(spoilt_by))


def _stride(number: int, length: int) -> int:
    """A place among some, each once in as many numbers, neighbours far apart."""
    step = max(int(length * 0.618), 1)
    while np.gcd(step, length) != 1:
        step += 1
    return number * step % length


def try_input(one: Input, examples: Path, limits: Limits) -> Result:
    """Give an input to its reader, in a process of its own."""
    with tempfile.TemporaryDirectory(prefix="fuzz-", ignore_cleanup_errors=True) as folder:
        path = Path(folder) / one.name
        path.write_bytes(one.content)
        outcome = call_apart(partial(one.reader.read, path, examples), limits)
    return Result(one.number, one.reader.name, one.name, one.spoilt_by, outcome)


def try_file(path: Path, reader: Reader, examples: Path, limits: Limits) -> Outcome:
    """Give a file to a reader, under its own name and in a folder of its own."""
    one = Input(0, reader, path.name, path.read_bytes(), ())
    return try_input(one, examples, limits).outcome


def unread_examples(
    examples: Path, readers: Sequence[Reader], limits: Limits
) -> dict[tuple[str, str], Outcome]:
    """The unspoilt examples that are not read, by reader and name: there must be none."""
    out = {}
    for reader in readers:
        for name in reader.examples:
            outcome = try_file(examples / name, reader, examples, limits)
            if outcome.end != READ:
                out[reader.name, name] = outcome
    return out


_chosen: tuple[Reader, ...] = known.READERS


def _prepare(names: tuple[str, ...] | None) -> None:
    """Set a worker up: what children inherit is loaded once, and not looked at by the collector."""
    global _chosen
    if names is not None:
        _chosen = tuple(known.reader_by_name(name) for name in names)
    with suppress(ImportError):
        import pyarrow

        pyarrow.set_cpu_count(1)
    gc.collect()
    gc.freeze()


def _try_batch(seed: int, examples: Path, limits: Limits, numbers: Sequence[int]) -> list[Result]:
    return [
        try_input(make_input(seed, number, examples, _chosen), examples, limits)
        for number in numbers
    ]


def results(
    seed: int,
    numbers: Sequence[int],
    examples: Path,
    *,
    readers: Sequence[str] | None = None,
    workers: int = 1,
    limits: Limits | None = None,
) -> Iterator[Result]:
    """Try inputs, and yield what became of each, in their order.

    Args:
        seed: Of the campaign.
        numbers: Of the inputs.
        examples: The folder of unspoilt examples.
        readers: Names of the readers; None: all.
        workers: How many processes fork.
        limits: Of each input.
    """
    limits = limits or Limits()
    batches = [numbers[i : i + _BATCH] for i in range(0, len(numbers), _BATCH)]
    task = partial(_try_batch, seed, examples, limits)
    names = None if readers is None else tuple(readers)
    if workers == 1:
        _prepare(names)
        for batch in batches:
            yield from task(batch)
        return
    with ProcessPoolExecutor(
        workers, multiprocessing.get_context("spawn"), initializer=_prepare, initargs=(names,)
    ) as pool:
        for found in pool.map(task, batches):
            yield from found


def run_campaign(
    seed: int,
    numbers: Sequence[int],
    examples: Path,
    kept: Path,
    *,
    readers: Sequence[str] | None = None,
    workers: int = 1,
    limits: Limits | None = None,
) -> Summary:
    """Try inputs, keep those that are findings, and count.

    Args:
        seed: As `results`.
        numbers: As `results`.
        examples: As `results`.
        kept: The folder in which findings are kept.
        readers: As `results`.
        workers: As `results`.
        limits: As `results`.
    """
    summary = Summary()
    chosen = known.READERS
    if readers is not None:
        chosen = tuple(known.reader_by_name(name) for name in readers)
    summary.readers = {reader.name: Tallied() for reader in chosen}
    began = shown = time.monotonic()
    every = results(seed, numbers, examples, readers=readers, workers=workers, limits=limits)
    for done, result in enumerate(every, start=1):
        summary.readers[result.reader].add(result.outcome)
        if result.outcome.is_finding:
            alike = summary.findings.setdefault(result.outcome.end, [])
            alike.append(result)
            _keep(make_input(seed, result.number, examples, chosen), seed, result, kept)
        if time.monotonic() - shown > 20.0:
            shown = time.monotonic()
            count = sum(map(len, summary.findings.values()))
            print(f"{done} of {len(numbers)}, {count} findings", file=sys.stderr, flush=True)
    summary.seconds = time.monotonic() - began
    return summary


def _keep(one: Input, seed: int, result: Result, kept: Path) -> None:
    folder = kept / f"{seed}-{one.number:06d}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    (folder / one.name).write_bytes(one.content)
    again = f'PYTHONPATH=tools .venv/bin/python -m fuzz --reader "{one.reader.name}" --try FILE'
    content = {"seed": seed, "again": again, **asdict(result)}
    (folder / "finding.json").write_text(json.dumps(content, indent=1), encoding="utf-8")


def table(summary: Summary) -> str:
    """What became of the inputs of each reader, a line a reader."""
    columns = ("tried", "read", "refused", "findings", "longest, s", "peak, MB")
    lines = [f"{'reader':27}" + "".join(f"{column:>12}" for column in columns)]
    total = Tallied()
    for name, one in summary.readers.items():
        lines.append(_line(name, one))
        for key in ("tried", "read", "refused", "findings"):
            setattr(total, key, getattr(total, key) + getattr(one, key))
        total.longest_s = max(total.longest_s, one.longest_s)
        total.peak_mb = max(total.peak_mb, one.peak_mb)
    lines.append(_line("all", total))
    return "\n".join(lines)


def _line(name: str, one: Tallied) -> str:
    counts = (one.tried, one.read, one.refused, one.findings)
    return (
        f"{name:27}"
        + "".join(f"{count:12}" for count in counts)
        + f"{one.longest_s:12.1f}{one.peak_mb:12.0f}"
    )
