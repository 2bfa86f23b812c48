"""Three cameras before one harbour with twenty vessels: their tracks, fused, against the truth.

    python benchmarks/fusion.py --seeds 5

Each camera has a model that learned from one boat's log on another day; its tracks are made of the
boxes of a detector that misses some, through piles and boats that hide one another. The truth is
where vessels are while at least one camera sees them.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from _support.fleet import (
    MATCH_M,
    TruePlaces,
    as_cameras,
    camera_tracks,
    learned,
    logged,
    place_errors,
    score,
    taught,
    true_places,
)

from sightline.errors import FitError
from sightline.fusion import CameraTracks, FuseSettings, Fusion, fuse
from sightline.simulation import SeveralSettings, harbours
from sightline.simulation.harbour import DOCK
from sightline.types import Track

CHI2_95 = 5.991
FAR_M = 20.0
"""A wider limit: what one camera alone sees at 500 m, a pixel moves by this."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--fourth", type=int, default=0, help="Seeds of a fourth camera.")
    parser.add_argument("--vessels", type=int, default=20)
    parser.add_argument("--duration", type=float, default=240.0)
    parser.add_argument("--share", type=float, default=FuseSettings.correlated_share)
    options = parser.parse_args()
    if options.seeds:
        pictures(options)
    if options.fourth:
        fourths(options)


def pictures(options: argparse.Namespace) -> None:
    """Print what three cameras see together."""
    names = ("one target", f"in {FAR_M:g} m", "IDF1", "best camera", "RMSE m", "better", "ratio")
    print("seed  " + "  ".join((*names, "in ellipse")))
    rows = []
    for seed in range(options.seeds):
        cameras, truth = world(seed, options.vessels, options.duration)
        begin = time.perf_counter()
        fused = fuse(cameras, DOCK, FuseSettings(correlated_share=options.share))
        took_s = time.perf_counter() - begin
        rows.append(judge(truth, cameras, fused))
        said = "  ".join(f"{value:.3f}" for value in rows[-1])
        print(
            f"{seed:4d}  {said}  ({took_s:.1f} s, scatter {fused.scatter:.2f}, "
            f"{len(fused.tracks)} targets, {fused.handovers} handovers)",
            flush=True,
        )
    mean = np.mean(rows, axis=0)
    print("mean  " + "  ".join(f"{value:.3f}" for value in mean))
    print(f"IDF1 gained: {mean[2] - mean[3]:.3f}")


def fourths(options: argparse.Namespace) -> None:
    """Print how well a fourth camera is calibrated by the three."""
    print("a fourth camera, RMSE m of single boxes:")
    print("seed  taught by the three  a log and drawn boxes  a log without drawn boxes")
    rows = []
    for seed in range(options.fourth):
        rows.append(fourth(seed, options.vessels, options.duration))
        print(f"{seed:4d}  " + "  ".join(f"{value:.2f}" for value in rows[-1]), flush=True)
    print("median  " + "  ".join(f"{value:.2f}" for value in np.nanmedian(rows, axis=0)))


def world(seed: int, vessels: int, duration_s: float) -> tuple[list[CameraTracks], TruePlaces]:
    """Tracks of each camera, and the truth."""
    views = harbours(seed, SeveralSettings(vessels=vessels, duration_s=duration_s))
    tracks = [
        camera_tracks(view, learned(view, 100 * seed + k), 10 * seed + k + 1)
        for k, view in enumerate(views)
    ]
    return as_cameras(views, tracks), true_places(views)


def fourth(seed: int, vessels: int, duration_s: float) -> tuple[float, ...]:
    """Errors of a fourth camera: taught by the others, by a log with drawn boxes, and without.

    NaN where nobody could be recognised.
    """
    views = harbours(seed, SeveralSettings(cameras=4, vessels=vessels, duration_s=duration_s))
    tracks = [
        camera_tracks(view, learned(view, 100 * seed + k), 10 * seed + k + 1)
        for k, view in enumerate(views[:3])
    ]
    fused = fuse(as_cameras(views[:3], tracks), DOCK)
    last, own = views[3], 10 * seed + 4
    out = []
    for make in (
        lambda: taught(last, fused.tracks, own),
        lambda: learned(last, 100 * seed + 3),
        lambda: logged(last, own),
    ):
        try:
            out.append(float(np.sqrt(np.mean(place_errors(last, make(), seed) ** 2))))
        except FitError:
            out.append(float("nan"))
    return tuple(out)


def judge(truth: TruePlaces, cameras: list[CameraTracks], fused: Fusion) -> tuple[float, ...]:
    """The figures of a picture.

    One target each within two limits, IDF1 fused and of the best camera, RMSE fused and of the
    better camera, their ratio, and the share in the ellipse.
    """
    found = score(truth, fused.tracks)
    best = max(score(truth, camera.tracks).idf1 for camera in cameras)
    once, errors, inside = overlap(truth, fused.tracks)
    far = overlap(truth, fused.tracks, FAR_M)[0]
    singles = [overlap(truth, camera.tracks)[1] for camera in cameras]
    both = (truth.seen.sum(axis=2) >= 2) & np.isfinite(errors)
    # While a camera takes one vessel for another, its error says nothing of how well it measures.
    for single, k in zip(singles, range(len(cameras)), strict=True):
        both &= (single < MATCH_M) | ~truth.seen[..., k]
    at_hand = np.stack(singles)
    # The better camera of each vessel: by its error over the whole overlap.
    better, own = [], []
    for j in range(errors.shape[1]):
        rows = both[:, j]
        if rows.sum() < 10:
            continue
        squares = [np.mean(one[rows, j] ** 2) for one in at_hand if np.isfinite(one[rows, j]).all()]
        if squares:
            better.append((rows.sum(), min(squares)))
            own.append((rows.sum(), np.mean(errors[rows, j] ** 2)))
    rms = [np.sqrt(np.average([v for _, v in x], weights=[n for n, _ in x])) for x in (own, better)]
    return (once, far, found.idf1, best, rms[0], rms[1], rms[0] / rms[1], inside)


def overlap(
    truth: TruePlaces, tracks: tuple[Track, ...], limit_m: float = MATCH_M
) -> tuple[float, np.ndarray, float]:
    """Share of target-time with one track, (T, B) errors of the nearest, share in the ellipse.

    A vessel has one target where exactly one track is nearer than the limit to it, and to no other
    vessel nearer.
    """
    times, place = truth.time_utc_s, truth.place_m
    somewhere = truth.seen.any(axis=2)
    count = np.zeros(somewhere.shape, dtype=int)
    errors = np.full(somewhere.shape, np.nan)
    covered = np.zeros(somewhere.shape)
    for one in tracks:
        index = np.round(one.time_utc_s - times[0]).astype(int)
        on = (index >= 0) & (index < times.size)
        index = index[on]
        at = np.stack([one.east_m, one.north_m], axis=1)[on]
        apart = at[:, None] - place[index]
        distance = np.hypot(apart[..., 0], apart[..., 1])
        # Whose it is, the track as a whole tells: the vessel that it is mostly nearest to.
        nearest = np.where(somewhere[index], distance, np.inf).argmin(axis=1)
        whose = np.bincount(nearest, minlength=place.shape[1]).argmax()
        near = distance[np.arange(len(at)), nearest] < limit_m
        np.add.at(count, (index[near], nearest[near]), 1)
        own = distance[:, whose]
        inverse = np.linalg.inv(one.covariance_m2[on])
        off = apart[:, whose]
        squared = np.einsum("ni,nij,nj->n", off, inverse, off)
        better = ~(errors[index, whose] <= own) & (own < 3.0 * MATCH_M)
        errors[index[better], whose] = own[better]
        covered[index[better], whose] = squared[better] < CHI2_95
    known = somewhere & np.isfinite(errors)
    once = float((count == 1)[somewhere].mean())
    return once, np.where(somewhere, errors, np.nan), float(covered[known].mean())


if __name__ == "__main__":
    main()
