"""Fits to logs with a fix every 10, 20 or 30 s, scored against the whole log.

    python benchmarks/sparse_logs.py [--scene SCENE] [--every 1 10 20 30] [--phases 1]

Recordings of the AI Tracks at Sea challenge, whose log has a fix every one or two seconds, with
gaps. Of it are kept the first fix in each k seconds, as a tracker logs that is set to k seconds
("first"), or only those whose second k divides, which leaves gaps of several times k ("divided").
Nothing else is told to the fit; each recording is left out in turn. Its boxes are placed one by one
and compared with the whole log, where that has fixes near enough on both sides. With several phases
the figures are those of all of them together: which fix of k seconds a log happens to keep is
chance. The last column says how many boxes had a place in the thinned log.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from _recordings import challenge_scene
from _support.cameras import scored

from sightline import formats
from sightline.errors import SightlineError
from sightline.evaluation.metrics import ScoredPairs, absolute_error, coverage
from sightline.georeferencing.correspondences import Correspondences
from sightline.georeferencing.fit import FitSettings, fit
from sightline.scene import Scene
from sightline.scene.correspondences import collect
from sightline.types import Fixes

MODELS = ("camera+gpr", "camera")
KEPT = ("first", "divided")


def kept(log: Fixes, how: str, every_s: int, phase_s: int) -> Fixes:
    """Some fixes of a log; see the top of this file."""
    second = np.floor(log.time_utc_s).astype(np.int64) - phase_s
    if how == "divided":
        return log[second % every_s == 0]
    return log[np.flatnonzero(np.diff(second // every_s, prepend=second[0] // every_s - 1))]


def thinned(scene: Scene, how: str, every_s: int, phase_s: int, folder: Path) -> Scene:
    """A scene whose logs are thinned; they are written to a folder."""
    recordings = []
    for one in scene.recordings:
        if one.fixes_path is not None and every_s > 1:
            path = folder / f"{one.fixes_path.stem}-{how}-{every_s}-{phase_s}.csv"
            if not path.is_file():
                formats.write_fixes_csv(kept(one.fixes(), how, every_s, phase_s), path)
            one = replace(one, fixes_path=path)
        recordings.append(one)
    return replace(scene, recordings=tuple(recordings))


def left_out_scores(
    scene: Scene, truth: Correspondences
) -> tuple[dict[str, list[ScoredPairs]], int]:
    """Places of each recording's boxes by what the others teach; and how many boxes teach."""
    inputs = collect(scene, pictures=False)
    pairs = inputs.correspondences
    out: dict[str, list[ScoredPairs]] = {model: [] for model in MODELS}
    for name in np.unique(truth.recording):
        test = truth[truth.recording == name]
        rest = replace(inputs, correspondences=pairs[pairs.recording != name])
        for model in MODELS:
            try:
                fitted = fit(rest, FitSettings(model=model))
            except SightlineError as error:
                print(f"{model}, without {name}: {error}")
                continue
            out[model].append(scored(fitted, test.in_plane(fitted.plane)))
    return out, len(pairs)


def row(how: str, every_s: int, model: str, parts: Iterable[ScoredPairs], share: float) -> str:
    whole = ScoredPairs.concatenate(list(parts))
    error = absolute_error(whole)
    return (
        f"| {every_s} | {how} | `{model}` | {error.n} | {error.rmse:.2f} | {error.median:.2f} "
        f"| {coverage(whole).p95:.0%} | {share:.0%} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", help="the scene file of the recordings")
    parser.add_argument("--every", nargs="*", type=int, default=(1, 10, 20, 30), metavar="S")
    parser.add_argument("--phases", type=int, default=1, help="so many of the k ways to thin a log")
    parser.add_argument("--kept", nargs="*", choices=KEPT, default=KEPT, help="which fixes")
    chosen = parser.parse_args()
    logging.disable(logging.WARNING)
    scene = Scene.load(challenge_scene(chosen.scene))
    whole = collect(scene, pictures=False).correspondences
    truth = whole[whole.fix_sigma_m == 0.0]
    print("| a fix every, s | kept | model | boxes | RMSE, m | median, m | in 95 % | used |")
    print("|---:|---|---|---:|---:|---:|---:|---:|", flush=True)
    asked = sum(len(r.boxes()) for r in scene.recordings if r.boxes_path and r.fixes_path)
    with TemporaryDirectory() as folder:
        for how in chosen.kept:
            for every_s in chosen.every if how == KEPT[0] else [k for k in chosen.every if k > 1]:
                phases = np.unique(np.arange(chosen.phases) * every_s // chosen.phases)
                parts: dict[str, list[ScoredPairs]] = {model: [] for model in MODELS}
                used = []
                for phase_s in phases.tolist():
                    sparse = thinned(scene, how, every_s, phase_s, Path(folder))
                    own, count = left_out_scores(sparse, truth)
                    used.append(count / asked)
                    for model in MODELS:
                        parts[model] += own[model]
                for model in MODELS:
                    share = float(np.mean(used))
                    print(row(how, every_s, model, parts[model], share), flush=True)


if __name__ == "__main__":
    main()
