"""Who is who without drawn boxes: a feed of 50 vessels of which five are in view, and refusals.

    python benchmarks/association.py [SEEDS [SCENE]]

Simulated traffic before a camera of unknown height, pitch, roll, heading, focal length and
distortion: clock offset of -37 s, 20 % of the reports missing, clutter, two vessels without AIS.
Then with the log of a single vessel that was never in view, and with the feed less the vessels in
view: both must be refused. Last, recording 07 of the AI Tracks at Sea challenge, from another
team's motion tracker and the log alone, where the recordings are at hand.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from _recordings import challenge_scene
from _support.traffic import Traffic

from sightline.association import Association, associate
from sightline.association.observations import observe
from sightline.association.search import RecordingObservations
from sightline.errors import FitError
from sightline.pipeline.evaluate import place_boxes, score
from sightline.pipeline.fit_unlabelled import associate_scene, fit_association
from sightline.scene import Scene


def try_to(watch: RecordingObservations, traffic: Traffic) -> Association | None:
    """The association, or None where it is refused."""
    try:
        return associate([watch], traffic.camera.image_size_px)
    except FitError:
        return None


def feeds(seeds: int) -> None:
    """Simulated feeds."""
    all_found = none_invented = never = without = 0
    for seed in range(seeds):
        began = time.perf_counter()
        traffic = Traffic.random(seed)
        seen, paths = observe(traffic.boxes()), traffic.paths()
        found = try_to(RecordingObservations("one", seen, tuple(paths.values())), traffic)
        names = {int(one.vessel) for one in found.found} if found else set()
        in_view = set(traffic.in_view)
        all_found += in_view <= names
        none_invented += names <= in_view
        elsewhere = [mmsi for mmsi in paths if mmsi not in in_view]
        one = try_to(
            RecordingObservations("one", seen, (paths[elsewhere[seed % len(elsewhere)]],)), traffic
        )
        rest = try_to(
            RecordingObservations("one", seen, tuple(paths[mmsi] for mmsi in elsewhere)), traffic
        )
        never += one is None
        without += rest is None
        offset = found.offset_s["one"] if found else np.nan
        evidence, lead = (
            (found.evidence, found.evidence - found.runner_up) if found else (np.nan, np.nan)
        )
        print(
            f"seed {seed:2d}: {len(names & in_view)} of {len(in_view)} found, "
            f"{len(names - in_view)} invented, offset {offset:.1f} s, evidence {evidence:.1f}, "
            f"lead {lead:.1f}; one that was never in view: "
            f"{'refused' if one is None else f'ACCEPTED ({one.evidence:.1f})'}; the feed less "
            f"those in view: {'refused' if rest is None else f'ACCEPTED ({rest.evidence:.1f})'}; "
            f"{time.perf_counter() - began:.0f} s",
            flush=True,
        )
    print(
        f"of {seeds} seeds: all found in {all_found}, none invented in {none_invented}, "
        f"refused in {never} (one log) and {without} (the rest of the feed)"
    )


def real(path: Path) -> None:
    """Recording 07 from a motion tracker's boxes and the log alone."""
    scene = Scene.load(path)
    recording = replace(scene["07"], boxes_path=None)
    for pictures in (True, False):
        one = recording if pictures else replace(recording, frames_path=None)
        only = replace(scene, recordings=(one,))
        found = associate_scene(only)
        fitted = fit_association(only, found)
        report = score(place_boxes(scene.without(["07"]), lambda _, m=fitted: m))
        print(
            f"recording 07, {'with' if pictures else 'without'} pictures: "
            f"{int(found.found[0].taken.sum())} boxes taken, clock "
            f"{fitted.report.clock_offset_s['07']:+.2f} s, evidence {found.evidence:.1f}, the next "
            f"best {found.runner_up:.1f}; hand-drawn boxes of the others: RMSE "
            f"{report.ape.rmse:.1f} m, median {report.ape.median:.1f} m"
        )


if __name__ == "__main__":
    feeds(int(sys.argv[1]) if len(sys.argv) > 1 else 20)
    real(challenge_scene(*sys.argv[2:3]))
