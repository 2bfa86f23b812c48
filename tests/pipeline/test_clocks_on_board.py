"""The clock of a camera on a vessel under way, beside the truth of a simulated harbour.

Swell, a compass that is off and the vessel's own log shift what is seen from on board for seconds
and minutes, as a clock would.
"""

from __future__ import annotations

import csv
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from sightline.evaluation.metrics import absolute_error
from sightline.pipeline.evaluate import place_boxes
from sightline.pipeline.fit import fit
from sightline.scene import Scene
from sightline.scene.correspondences import settled
from sightline.simulation import ReceiverNoise, Simulation, SimulationSettings, simulate

EXACT = ReceiverNoise(std_m=0.0, interval_s=0.25, interval_jitter=0.0, dropouts_per_minute=0.0)


def at_sea(folder: Path, seed: int) -> Simulation:
    """Three recordings of a minute and a half from a vessel under way, all clocks right."""
    settings = SimulationSettings(
        seed=seed, video=False, moving=True, duration_s=90.0, rate_hz=12.0
    )
    return simulate(folder, settings)


def set_clocks_ahead(scene: Scene, ahead_s: float) -> Scene:
    """The scene with the clocks of its camera set ahead, in its files."""
    for recording in scene.recordings:
        assert recording.clock_path is not None
        with recording.clock_path.open(newline="", encoding="utf-8") as file:
            head, *rows = csv.reader(file)
        late = [
            f"{frame},{(datetime.fromisoformat(utc) + timedelta(seconds=ahead_s)).isoformat()}"
            for frame, utc in rows
        ]
        text = "\n".join([",".join(head), *late, ""])
        recording.clock_path.write_text(text, encoding="utf-8")
    return Scene.load(scene.path)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 6])
def test_what_a_vessel_does_is_taken_for_no_clock(tmp_path: Path, seed: int) -> None:
    """Boxes of a recording that its model never saw are scored at a right clock as it is.

    And at one that is 20 s ahead, as at a right one: the truth is the target's exact path.
    """
    made = at_sea(tmp_path, seed)
    scene, exact = Scene.load(made.scene), made.harbour.fixes(EXACT)
    models = {name: fit(scene.without([name]), "camera") for name in ("01", "03")}
    both = scene.select(models)
    right = {one.recording: one for one in place_boxes(both, models.__getitem__)}
    for one in right.values():
        assert one.clock is not None
        assert one.clock.used_s == 0.0
        assert abs(one.clock.offset_s) < 3.0 * one.clock.sigma_s
    for one in place_boxes(set_clocks_ahead(both, 20.0).select(models), models.__getitem__):
        assert one.clock is not None
        assert one.clock.used_s == one.clock.offset_s
        assert abs(one.clock.offset_s - 20.0) < 3.0 * one.clock.sigma_s
        found, expected = (
            absolute_error(replace(x, fixes=exact).single()) for x in (one, right[one.recording])
        )
        assert found.rmse < 1.2 * expected.rmse


@pytest.mark.slow
@pytest.mark.parametrize("ahead_s", [0.0, 5.0, -40.0])
def test_a_compass_that_drifts_hides_no_clock(tmp_path: Path, ahead_s: float) -> None:
    """From one recording to the next it drifts by as much as boxes are wide."""
    scene = Scene.load(at_sea(tmp_path, 0).scene)
    if ahead_s:
        scene = set_clocks_ahead(scene, ahead_s)
    for recording in settled(scene).recordings:
        clock = recording.clock_found
        assert clock is not None
        assert clock.sigma_s < 0.4
        assert abs(clock.offset_s - ahead_s) < 3.0 * clock.sigma_s
        np.testing.assert_equal(clock.used_s, clock.offset_s if ahead_s else 0.0)
