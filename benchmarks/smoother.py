"""How fast tracks are smoothed.

    python benchmarks/smoother.py [--tracks 40]

Boats of `harbour_tracks`, seen 10 to 25 times a second for one to three minutes, and sparse ones.
Seconds of processor time of one core, for everything: from positions to points with covariances.
Beside the smoother stands the paper's chain, on the same boats in the same run; it learns nothing
from a track. (The 10 Hz of the paper's section 5.2 are those of a Jetson TX2, and nothing to
compare with.)
"""

from __future__ import annotations

import argparse
import time

from harbour_tracks import Scene, scene

from sightline.trajectory import PaperChain, RtsSmoother, TrajectoryMethod


def seconds(method: TrajectoryMethod, boats: list[Scene]) -> float:
    """Processor time for all boats, the best of three runs."""
    runs = []
    for _ in range(3):
        start = time.process_time()
        for boat in boats:
            method.apply(boat.time_utc_s, boat.positions)
        runs.append(time.process_time() - start)
    return min(runs)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tracks", type=int, default=40)
    count = parser.parse_args().tracks
    dense = [scene(seed, correlation_time_s=1.0) for seed in range(count)]
    sparse = [scene(seed, sparse=True) for seed in range(count)]
    learned = RtsSmoother().smooth(dense[0].time_utc_s, dense[0].positions).noise
    print(f"{'':44s}{'points/s':>12s}{'tracks/s':>10s}{'ms a track':>12s}{'paper: 1':>10s}")
    of_paper: dict[int, float] = {}
    for name, method, boats in (
        ("paper, 10 to 25 Hz", PaperChain(), dense),
        ("rts, learns its noise from each track", RtsSmoother(), dense),
        ("rts, noise given", RtsSmoother(noise=learned), dense),
        ("paper, one box each 4 s", PaperChain(), sparse),
        ("rts, one box each 4 s", RtsSmoother(), sparse),
    ):
        took = seconds(method, boats)
        points = sum(len(boat.time_utc_s) for boat in boats)
        each = 1e3 * took / len(boats)
        ratio = took / of_paper.setdefault(id(boats), took)
        print(
            f"{name:44s}{points / took:12,.0f}{len(boats) / took:10,.0f}{each:12.1f}{ratio:10.1f}"
        )


if __name__ == "__main__":
    main()
