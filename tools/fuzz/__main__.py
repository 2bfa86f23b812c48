"""The command line of the campaign."""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

# Each process is one of many, and threads do not outlive a fork.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")


def main(arguments: list[str] | None = None) -> int:
    """Run a campaign, or try, replay or minimise one input; 1 where there are findings."""
    options = _parser().parse_args(arguments)
    from fuzz.examples import make_examples
    from fuzz.isolation import Limits

    limits = Limits(options.seconds, options.memory)
    with tempfile.TemporaryDirectory(prefix="fuzz-examples-") as folder:
        examples = Path(folder)
        make_examples(examples)
        if options.file is not None:
            return _try(options, examples, limits)
        return _campaign(options, examples, limits)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="fuzz", description=__doc__)
    parser.add_argument("--count", type=int, default=300, help="how many inputs")
    parser.add_argument("--seed", type=int, default=0, help="the same seed gives the same inputs")
    parser.add_argument("--first", type=int, default=0, help="the number of the first input")
    parser.add_argument("--workers", type=int, default=1, help="how many processes")
    parser.add_argument("--reader", action="append", help="only this reader; several are allowed")
    parser.add_argument("--seconds", type=float, default=10.0, help="that an input may take")
    parser.add_argument("--memory", type=float, default=1536.0, help="MB that an input may take")
    parser.add_argument("--kept", type=Path, default=Path("fuzz-findings"), help="for findings")
    parser.add_argument("--try", dest="file", type=Path, help="a file for --reader to try")
    parser.add_argument("--minimise", type=Path, help="with --try: write the smallest like it here")
    return parser


def _campaign(options: argparse.Namespace, examples: Path, limits: object) -> int:
    from fuzz.campaign import run_campaign, table, unread_examples
    from fuzz.readers import READERS, reader_by_name

    names = options.reader
    readers = READERS if names is None else tuple(map(reader_by_name, names))
    unread = unread_examples(examples, readers, limits)
    for (reader, name), outcome in unread.items():
        print(f"{reader}: the example {name} is not read: {outcome.end}: {outcome.detail}")
    if unread:
        return 2
    numbers = range(options.first, options.first + options.count)
    summary = run_campaign(
        options.seed,
        numbers,
        examples,
        options.kept,
        readers=names,
        workers=options.workers,
        limits=limits,
    )
    print(table(summary))
    for end, found in sorted(summary.findings.items(), key=lambda pair: -len(pair[1])):
        first = found[0]
        print(f"{len(found):4} {end} ({first.reader}; {options.seed}-{first.number:06d})")
    print(f"{options.count} inputs of seed {options.seed} in {summary.seconds:.0f} s")
    if summary.findings:
        print(f"The inputs lie in {options.kept}", file=sys.stderr)
    return 1 if summary.findings else 0


def _try(options: argparse.Namespace, examples: Path, limits: object) -> int:
    from fuzz.campaign import try_file
    from fuzz.minimise import minimised
    from fuzz.readers import reader_by_name

    if not options.reader:
        raise SystemExit("--try needs --reader")
    reader = reader_by_name(options.reader[0])
    outcome = try_file(options.file, reader, examples, limits)
    print(f"{outcome.end} in {outcome.seconds:.1f} s, {outcome.peak_mb:.0f} MB\n{outcome.detail}")
    if options.minimise is not None:
        options.minimise.mkdir(parents=True, exist_ok=True)
        at = options.minimise / options.file.name

        def shows(content: bytes) -> bool:
            at.write_bytes(content)
            return try_file(at, reader, examples, limits).end == outcome.end

        at.write_bytes(minimised(options.file.read_bytes(), shows))
        print(at.read_bytes()[:2000])
    return 1 if outcome.is_finding else 0


if __name__ == "__main__":
    sys.exit(main())
