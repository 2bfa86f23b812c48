"""How long the command line takes to answer, and in how much memory: whole processes.

python benchmarks/start.py [runs]
"""

from __future__ import annotations

import os
import statistics
import sys
import tempfile
import time

ANSWERS = (
    "--version",
    "--help",
    "run --help",
    "detector train --help",
    "run nothing.toml -o out",
    "fit nothing.toml -o model.safetensors",
    "compare nothing.toml",
    "track harbour.mp4 --model nothing.safetensors -o tracks.geojson",
    "detect nothing.mp4 -o boxes.csv",
)
RUNS = 11


def measured(arguments: list[str], folder: str) -> tuple[float, float, float]:
    """Seconds that a process lives, those that it computes, and the most memory it has, MiB."""
    started = time.perf_counter()
    child = os.fork()
    if child == 0:
        os.chdir(folder)
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, 1)
        os.dup2(nothing, 2)
        os.execv(sys.executable, arguments)
    _, status, used = os.wait4(child, 0)
    elapsed_s = time.perf_counter() - started
    if os.waitstatus_to_exitcode(status) not in (0, 2):
        raise SystemExit(f"{' '.join(arguments)}: neither answered nor refused")
    # Kilobytes on Linux, bytes on macOS.
    memory_mib = used.ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
    return elapsed_s, used.ru_utime + used.ru_stime, memory_mib


def main() -> None:
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else RUNS
    head = f"python -m sightline ... ({runs} runs)"
    print(f"{head:66} {'least':>8} {'median':>8} {'CPU':>8} {'memory':>9}")
    cases = {"(python -c pass)": [sys.executable, "-c", "pass"]}
    cases |= {line: [sys.executable, "-m", "sightline", *line.split()] for line in ANSWERS}
    with tempfile.TemporaryDirectory() as folder:
        for line, arguments in cases.items():
            measured(arguments, folder)  # the first reads files that the others find in memory
            made = [measured(arguments, folder) for _ in range(runs)]
            elapsed_s, computed_s, memory_mib = zip(*made, strict=True)
            print(
                f"{line:66} {min(elapsed_s):6.3f} s {statistics.median(elapsed_s):6.3f} s "
                f"{min(computed_s):6.3f} s {max(memory_mib):5.0f} MiB"
            )


if __name__ == "__main__":
    main()
