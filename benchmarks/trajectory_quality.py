"""How far smoothed tracks are from the truth: the smoother beside the paper's chain.

    python benchmarks/trajectory_quality.py [--seeds 40] [--window-s 2.0]

Each row is one sort of measurement, each seed a boat on another path (`harbour_tracks`). The same
default settings throughout; the smoother is not told what the noise is like.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import Any

import numpy as np
from harbour_tracks import Scene, scene

from sightline.trajectory import PaperChain, RtsSmoother, TrajectoryMethod

CASES: dict[str, dict[str, Any]] = {
    "white noise": {},
    "noise that lasts 0.5 s": {"correlation_time_s": 0.5},
    "noise that lasts 1 s": {"correlation_time_s": 1.0},
    "white, 4 % gross outliers": {"outliers": 0.04},
    "1 s, gaps, changing rate, 3 % outliers": {
        "correlation_time_s": 1.0,
        "dropouts": True,
        "outliers": 0.03,
    },
    "one box each 4 s, 20 to 40 boxes": {"sparse": True},
}


@dataclass(frozen=True)
class Score:
    """Error of one track, metres RMS, and the share of truths in its 95 % ellipses."""

    rmse_m: float
    coverage: float


def score(method: TrajectoryMethod, boat: Scene) -> Score:
    """Scores a method on one boat, at all times at which there was a box."""
    track = method.apply(boat.time_utc_s, boat.positions, at_utc_s=boat.time_utc_s)
    error = np.stack([track.east_m, track.north_m], axis=1) - boat.truth_m
    distance2 = np.einsum("ni,nij,nj->n", error, np.linalg.inv(track.covariance_m2), error)
    return Score(
        rmse_m=float(np.sqrt((error**2).sum(axis=1).mean())),
        coverage=float((distance2 <= -2.0 * np.log(0.05)).mean()),
    )


def table(seeds: int, window_s: float) -> list[str]:
    """The lines of the table."""
    paper, ours = PaperChain(window_s=window_s), RtsSmoother()
    columns = ("paper RMSE", "rts RMSE", "ratio", "pooled", "paper 95 %", "rts 95 %")
    lines = [f"{'':40s}" + "".join(f"{column:>12s}" for column in columns)]
    for name, case in CASES.items():
        boats = [scene(seed, **case) for seed in range(seeds)]
        theirs = [score(paper, boat) for boat in boats]
        mine = [score(ours, boat) for boat in boats]
        a = np.array([s.rmse_m for s in theirs])
        b = np.array([s.rmse_m for s in mine])
        pooled = np.sqrt((b**2).mean() / (a**2).mean())
        held = [np.mean([s.coverage for s in scores]) for scores in (theirs, mine)]
        figures = f"{a.mean():10.2f} m{b.mean():10.2f} m{np.mean(b / a):12.2f}{pooled:12.2f}"
        lines.append(f"{name:40s}{figures}{held[0]:12.2f}{held[1]:12.2f}")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--window-s", type=float, default=2.0)
    chosen = parser.parse_args()
    print(
        f"mean over {chosen.seeds} boats; window of the paper's average {chosen.window_s:g} s; "
        "ratio: mean of the boats' ratios; pooled: of all errors squared"
    )
    for line in table(chosen.seeds, chosen.window_s):
        print(line)


if __name__ == "__main__":
    main()
