"""Fits to logs with a fix every 10, 20 or 30 s, scored against the whole log.

    python benchmarks/sparse_logs.py [--scene SCENE] [--every 1 10 20 30] [--phases 1]

Recordings of the AI Tracks at Sea challenge, whose log has a fix a second. Of it are kept the fixes
of each k-th second, and nothing else is told to the fit; each recording is left out in turn. Its
boxes are placed one by one and compared with the whole log, where that has fixes near enough on
both sides. With several phases the figures are those of all of them together: which second of k
the log happened to keep is chance. The last columns say how many boxes had a place in the thinned
log, all recordings together, of those that a fix a second gives one.
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


def kept(log: Fixes, every_s: int, phase_s: int) -> Fixes:
    """The fixes of each k-th second of a log."""
    return log[np.floor(log.time_utc_s).astype(np.int64) % every_s == phase_s]


def thinned(scene: Scene, every_s: int, phase_s: int, folder: Path) -> Scene:
    """A scene whose logs are thinned; they are written to a folder."""
    recordings = []
    for one in scene.recordings:
        if one.fixes_path is not None and every_s > 1:
            path = folder / f"{one.fixes_path.stem}-{every_s}-{phase_s}.csv"
            if not path.is_file():
                formats.write_fixes_csv(kept(one.fixes(), every_s, phase_s), path)
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


def row(every_s: int, model: str, parts: Iterable[ScoredPairs], share: float) -> str:
    whole = ScoredPairs.concatenate(list(parts))
    error = absolute_error(whole)
    return (
        f"| {every_s} | `{model}` | {error.n} | {error.rmse:.2f} | {error.median:.2f} "
        f"| {coverage(whole).p95:.0%} | {share:.0%} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", help="the scene file of the recordings")
    parser.add_argument("--every", nargs="*", type=int, default=(1, 10, 20, 30), metavar="S")
    parser.add_argument("--phases", type=int, default=1, help="so many of the k ways to thin a log")
    chosen = parser.parse_args()
    logging.disable(logging.WARNING)
    scene = Scene.load(challenge_scene(chosen.scene))
    whole = collect(scene, pictures=False).correspondences
    truth = whole[whole.fix_sigma_m == 0.0]
    print("| a fix every, s | model | boxes | RMSE, m | median, m | in 95 % | used |")
    print("|---:|---|---:|---:|---:|---:|---:|", flush=True)
    with TemporaryDirectory() as folder:
        for every_s in chosen.every:
            phases = np.unique(np.arange(chosen.phases) * every_s // chosen.phases)
            parts: dict[str, list[ScoredPairs]] = {model: [] for model in MODELS}
            used = []
            for phase_s in phases.tolist():
                own, count = left_out_scores(thinned(scene, every_s, phase_s, Path(folder)), truth)
                used.append(count / len(whole))
                for model in MODELS:
                    parts[model] += own[model]
            for model in MODELS:
                print(row(every_s, model, parts[model], float(np.mean(used))), flush=True)


if __name__ == "__main__":
    main()
