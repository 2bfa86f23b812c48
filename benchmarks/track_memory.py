"""Peak memory of `track` against the length of its input: it is to stay flat.

    python benchmarks/track_memory.py [--trajectory rts]

Each row is a process of its own that reads a source, tracks what is in it and writes the tracks
as CSV; its peak is what the operating system counted. The first row only loads what the others
load. A table in no order can only be held as a whole, so its memory grows. The paper's chain
makes the trajectories, since it takes a tenth of the smoother's time; both see a track at a time.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rich.console import Console
from rich.table import Table

import sightline
from sightline import formats
from sightline.pipeline.track import TrackSettings
from sightline.simulation.simulate import SimulationSettings, simulate
from sightline.types import Frame
from sightline.video import write_video

SIZE_PX = (640, 360)
START_S = 1_700_000_000.0
RATE_HZ = 5.0
STAYS_S = 40.0
AT_ONCE = 10


def write_table(path: Path, rows: int, *, ids: bool, shuffled: bool = False) -> None:
    """Boats that cross the picture, ten at a time, each of which stays for 40 s."""
    rng = np.random.default_rng(0)
    moment = np.arange(rows) // AT_ONCE
    lane = np.arange(rows) % AT_ONCE
    time_s = moment / RATE_HZ
    # Boats of neighbouring lanes do not come and go together.
    turn, since_s = np.divmod(time_s + lane * STAYS_S / AT_ONCE, STAYS_S)
    x = 20.0 + 14.0 * since_s + rng.normal(0.0, 0.3, rows)
    y = 200.0 + 14.0 * lane + rng.normal(0.0, 0.3, rows)
    track_id = 1 + lane + AT_ONCE * turn.astype(int)
    order = rng.permutation(rows) if shuffled else np.arange(rows)
    with path.open("w", encoding="utf-8") as file:
        file.write("frame,time_utc,x1,y1,x2,y2" + (",track_id\n" if ids else "\n"))
        for i in order:
            end = f",{track_id[i]}\n" if ids else "\n"
            corners = f"{x[i]:.2f},{y[i] - 8:.2f},{x[i] + 20:.2f},{y[i]:.2f}"
            file.write(f"{moment[i]},{START_S + time_s[i]:.3f},{corners}{end}")


def pictures(count: int) -> Iterator[Frame]:
    """Four boats that cross a grey sea again and again."""
    sea = np.random.default_rng(0).integers(150, 160, (*SIZE_PX[::-1], 3), dtype=np.uint8)
    for index in range(count):
        image = sea.copy()
        for lane in range(4):
            left = (3 * index + 170 * lane) % SIZE_PX[0]
            top = 210 + 32 * lane
            image[top : top + 16, left : left + 50] = 20
        yield Frame(index, START_S + 0.1 * index, image)


def measured(source: str, model: Path, trajectory: str) -> tuple[float, float, int]:
    """Peak memory, MB, time, s, and number of tracks of a process of its own."""
    command = [sys.executable, __file__, "--source", source, "--model", str(model)]
    started = time.perf_counter()
    done = subprocess.run(
        [*command, "--trajectory", trajectory], capture_output=True, text=True, check=True
    )
    taken_s = time.perf_counter() - started
    peak, tracks = done.stdout.split()
    return float(peak), taken_s, int(tracks)


def one(source: str, model: Path, trajectory: str) -> None:
    """Track a source, and print the peak memory of this process and the number of tracks."""
    loaded, count = sightline.load(model), 0
    if source:
        settings = TrackSettings(trajectory=trajectory)
        out = Path(source).with_suffix(".tracks.csv")
        with formats.track_writer(out) as writer:
            for track in sightline.iter_tracks(source, loaded, settings=settings):
                writer.add(track)
                count += 1
    print(peak_mb(), count)


def peak_mb() -> float:
    """The most memory that this process has held so far."""
    status = Path("/proc/self/status")
    if status.exists():
        # What getrusage tells includes the process that started this one.
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return float(line.split()[1]) / 2**10
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--trajectory", default="paper")
    parser.add_argument("--source", help=argparse.SUPPRESS)
    parser.add_argument("--model", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.model is not None:
        one(options.source, options.model, options.trajectory)
        return
    table = Table(title="Peak memory of track")
    for name in ("source", "length", "tracks", "peak, MB", "time, s"):
        table.add_column(name, justify="left" if name == "source" else "right")
    with TemporaryDirectory() as name:
        folder = Path(name)
        made = simulate(
            folder / "harbour",
            SimulationSettings(video=False, duration_s=20.0, seed=1, image_size_px=SIZE_PX),
        )
        model = folder / "camera.safetensors"
        sightline.fit(sightline.Scene.load(made.scene), "camera").save(model)
        table.add_row("nothing", "", "0", f"{measured('', model, options.trajectory)[0]:.0f}", "")
        for what, ids, shuffled, lengths in (
            ("boxes with track ids", True, False, (10_000, 100_000, 1_000_000)),
            ("boxes without", False, False, (10_000, 50_000)),
            ("boxes with ids in no order", True, True, (10_000, 100_000)),
        ):
            for length in lengths:
                path = folder / "boxes.csv"
                write_table(path, length, ids=ids, shuffled=shuffled)
                peak, taken_s, tracks = measured(str(path), model, options.trajectory)
                table.add_row(what, f"{length}", f"{tracks}", f"{peak:.0f}", f"{taken_s:.0f}")
        for count in (300, 3_000):
            path = folder / "boats.mp4"
            write_video(path, pictures(count))
            peak, taken_s, tracks = measured(str(path), model, options.trajectory)
            table.add_row(
                "frames of video", f"{count}", f"{tracks}", f"{peak:.0f}", f"{taken_s:.0f}"
            )
    Console().print(table)


if __name__ == "__main__":
    main()
