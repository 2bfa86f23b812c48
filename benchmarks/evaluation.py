"""Evaluation of a long trajectory: time beside evo's, on the same poses, in the same run.

Run with ``python benchmarks/evaluation.py``; about two minutes.

Both are timed twice, with as many repeats: from tables that were made before (`ScoredPairs`, evo's
paths), so that the error alone counts, and from bare arrays, so that making the tables counts.
Times are the processor's, so that other programs do not count.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from evo.core.metrics import APE, RPE, PoseRelation, Unit
from evo.core.trajectory import PoseTrajectory3D
from rich.console import Console
from rich.table import Table

from sightline.evaluation import ScoredPairs, absolute_error, evaluate_tracks, relative_error
from sightline.geodesy import LocalPlane
from sightline.types import Fixes, Track

POSES = 100_000
STEP_S = 0.0625
EvoPaths = tuple[PoseTrajectory3D, PoseTrajectory3D]
REPEATS = 5


def best_of(action: Callable[[], float], repeats: int) -> tuple[float, float]:
    """The shortest time of the processor in seconds of several runs, and what the last returned."""
    shortest, result = np.inf, np.nan
    for _ in range(repeats):
        start = time.process_time()
        result = action()
        shortest = min(shortest, time.process_time() - start)
    return float(shortest), result


def evo_path(time_utc_s: np.ndarray, positions_m: np.ndarray) -> PoseTrajectory3D:
    n = time_utc_s.size
    return PoseTrajectory3D(
        positions_xyz=np.column_stack([positions_m, np.zeros(n)]),
        orientations_quat_wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        timestamps=time_utc_s,
    )


def main() -> None:
    rng = np.random.default_rng(0)
    times = 1_601_494_584.0 + STEP_S * np.arange(POSES)
    true = np.cumsum(rng.normal(0.0, 0.2, (POSES, 2)), axis=0)
    estimate = true + rng.normal(0.0, 3.0, (POSES, 2))
    covariance = np.tile(9.0 * np.eye(2), (POSES, 1, 1))

    def our_pairs() -> ScoredPairs:
        return ScoredPairs(
            time_utc_s=times,
            east_m=estimate[:, 0],
            north_m=estimate[:, 1],
            covariance_m2=covariance,
            true_east_m=true[:, 0],
            true_north_m=true[:, 1],
            segment=np.zeros(POSES, np.int64),
            asked=POSES,
        )

    plane = LocalPlane(32.70297, -117.234631)
    track = Track(
        track_id=1,
        time_utc_s=times,
        east_m=estimate[:, 0],
        north_m=estimate[:, 1],
        velocity_east_mps=np.zeros(POSES),
        velocity_north_mps=np.zeros(POSES),
        covariance_m2=covariance,
        velocity_covariance_m2ps2=covariance,
        kind=np.zeros(POSES, np.int8),
        plane=plane,
    )
    fixes = Fixes(times[::16], *plane.to_geographic(true[::16, 0], true[::16, 1]))

    def evo_ape(paths: EvoPaths) -> float:
        metric = APE(PoseRelation.translation_part)
        metric.process_data(paths)
        return metric.get_all_statistics()["rmse"]

    def evo_rpe(paths: EvoPaths) -> float:
        metric = RPE(PoseRelation.translation_part, 1.0 / STEP_S, Unit.frames, all_pairs=True)
        metric.process_data(paths)
        return metric.get_all_statistics()["rmse"]

    def evo_paths() -> EvoPaths:
        return evo_path(times, true), evo_path(times, estimate)

    pairs, paths = our_pairs(), evo_paths()
    rows = (
        (
            "absolute error",
            best_of(lambda: absolute_error(pairs).rmse, REPEATS),
            best_of(lambda: evo_ape(paths), REPEATS),
        ),
        (
            "absolute error, from arrays",
            best_of(lambda: absolute_error(our_pairs()).rmse, REPEATS),
            best_of(lambda: evo_ape(evo_paths()), REPEATS),
        ),
        (
            "relative error, 1 s",
            best_of(lambda: relative_error(pairs, 1.0).rmse, REPEATS),
            best_of(lambda: evo_rpe(paths), REPEATS),
        ),
        (
            "relative error, 1 s, from arrays",
            best_of(lambda: relative_error(our_pairs(), 1.0).rmse, REPEATS),
            best_of(lambda: evo_rpe(evo_paths()), REPEATS),
        ),
        (
            "whole report from track and log",
            best_of(lambda: evaluate_tracks([track], fixes).ape.rmse, REPEATS),
            None,
        ),
    )
    table = Table(title=f"evaluation of {POSES:,} poses, processor time, best of {REPEATS}")
    for heading in ("", "sightline, ms", "evo, ms", "times faster", "RMSE, relative difference"):
        table.add_column(heading, justify="left" if not heading else "right")
    for name, (seconds, rmse), peer in rows:
        if peer is None:
            table.add_row(name, f"{1e3 * seconds:.1f}", "", "", "")
            continue
        peer_seconds, peer_rmse = peer
        table.add_row(
            name,
            f"{1e3 * seconds:.1f}",
            f"{1e3 * peer_seconds:.0f}",
            f"{peer_seconds / seconds:.0f}",
            f"{abs(rmse / peer_rmse - 1.0):.0e}",
        )
    Console().print(table)


if __name__ == "__main__":
    main()
