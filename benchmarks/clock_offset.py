"""Tracks and scores where the camera's clock is ahead of the log's, beside those of a right clock.

    python benchmarks/clock_offset.py [SEEDS]

Simulated harbours of known truth: two recordings in which somebody drew the logged boat, and one
recording of which there are only a detector's boxes of everything. The camera's clock is ahead by
nothing, some seconds, and an hour (a wrong time zone). A row says the RMSE of the smoothed tracks
beside that of the right clock, and the offset that was found less the true one, in seconds and in
stated standard deviations.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from _support.clocks import drawn_scene, unlabelled_scene

import sightline
from sightline.errors import SightlineError
from sightline.scene import Scene

OFFSETS_S = (0.0, 1.0, 2.0, 5.0, 10.0, 40.0, -40.0, 3600.0, -3585.0)


def table(kind: str, seeds: range, write: Callable[[Path, float, int], Scene]) -> None:
    """A row an offset, over all seeds that the right clock lets be fitted."""
    right: dict[int, float] = {}
    print(f"{kind}\n{'ahead, s':>10s}{'RMSE, m':>10s}{'right':>10s}{'off, s':>10s}{'sigmas':>10s}")
    for offset_s in OFFSETS_S:
        rmse, off, sigmas, refused = [], [], [], 0
        for seed in seeds:
            with TemporaryDirectory() as folder:
                try:
                    result = sightline.run(write(Path(folder), offset_s, seed))
                except SightlineError:
                    refused += 1
                    continue
            if result.smoothed is None:
                refused += 1
                continue
            if offset_s == 0.0:
                right[seed] = result.smoothed.ape.rmse
            rmse.append(result.smoothed.ape.rmse / right.get(seed, np.nan))
            for clock in result.clocks.values():
                off.append(clock.offset_s - offset_s)
                sigmas.append(off[-1] / clock.sigma_s)
        middle = float(np.median(list(right.values())))
        print(
            f"{offset_s:10.0f}{middle * np.nanmedian(rmse):10.2f}{middle:10.2f}"
            f"{np.sqrt(np.mean(np.square(off))):10.2f}{np.abs(sigmas).max():10.1f}"
            f"   worst ratio {np.nanmax(rmse):.2f}" + (f", {refused} refused" if refused else ""),
            flush=True,
        )


def drawn(folder: Path, offset_s: float, seed: int) -> Scene:
    """Two recordings with drawn boxes."""
    return drawn_scene(folder, {"01": offset_s, "02": offset_s}, seed=100 + 2 * seed)


def unlabelled(folder: Path, offset_s: float, seed: int) -> Scene:
    """One recording without."""
    return unlabelled_scene(folder, offset_s, seed=seed)


if __name__ == "__main__":
    count = range(int(sys.argv[1]) if len(sys.argv) > 1 else 5)
    table("boxes drawn, each recording left out in turn", count, drawn)
    table("\nno boxes drawn", count, unlabelled)
