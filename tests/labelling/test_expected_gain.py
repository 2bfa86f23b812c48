"""What more boxes will teach, said before they are drawn, against fits with these boxes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose

from sightline import Scene
from sightline.camera.parameters import CAMERA, EAST, HALF_BEAM, HALF_LENGTH, NORTH
from sightline.camera.pinhole import Camera
from sightline.georeferencing.fit import FitSettings, fit
from sightline.labelling.advice import Advice
from sightline.labelling.expected_gain import Design, axes_95_m, spread_rows
from sightline.labelling.logged_frames import LoggedFrames
from sightline.labelling.refit import MORE_BOXES, Frames, Situation, advise
from sightline.labelling.suggestions import by_information, by_spread
from sightline.scene.correspondences import collect
from sightline.simulation import SimulationSettings, simulate

pytestmark = pytest.mark.slow

SEEDS = range(1, 6)
FIRST = 6


class Harbour:
    """A simulated scene of which some boxes are drawn."""

    def __init__(self, folder: Path, seed: int) -> None:
        simulate(
            folder,
            SimulationSettings(
                seed=seed, recordings=1, duration_s=150.0, rate_hz=2.0, video=False, clock="exact"
            ),
        )
        self.scene, self.table = folder / "scene.toml", folder / "boxes" / "01.csv"
        self.all = pd.read_csv(self.table)
        self.frame = self.all["frame"].to_numpy()

    def advice(self, drawn: np.ndarray) -> tuple[Advice, Situation]:
        self.all[self.all["frame"].isin(drawn)].to_csv(self.table, index=False)
        frames = Frames("01", "annotator", self.frame, (1280, 720))
        return advise(Scene.load(self.scene), frames)


@pytest.fixture(scope="module")
def harbours(tmp_path_factory: pytest.TempPathFactory) -> list[Harbour]:
    return [Harbour(tmp_path_factory.mktemp(f"gain{seed}"), seed) for seed in SEEDS]


def test_the_gain_is_that_of_boxes_that_are_then_drawn(harbours: list[Harbour]) -> None:
    """Under the same noise: what is estimated of that scatters, and is nobody's gain."""
    expected, reached = [], []
    for harbour in harbours:
        few = harbour.frame[spread_rows(harbour.frame.size, FIRST)]
        before, situation = harbour.advice(few)
        views, design = situation.views, situation.design
        assert design is not None
        drawn = np.isin(views.logged.frame, few)
        best = by_information(
            design, situation.georeferencer, views, ~drawn, views[drawn], MORE_BOXES
        )
        assert np.unique(best).size == MORE_BOXES
        assert not drawn[best].any()
        _, then = harbour.advice(np.concatenate([few, views.logged.frame[best]]))
        old, new = situation.georeferencer.calibrated, then.georeferencer.calibrated
        assert old is not None
        assert new is not None
        alike = new.with_fit(replace(new.fit_, noise=old.fit_.noise))
        seen = views.box_xyxy_px[spread_rows(len(views), 120)]
        axes = [
            np.median(axes_95_m(model, seen, "annotator", None))
            for model in (
                situation.georeferencer,
                replace(then.georeferencer, regressor=alike),
            )
        ]
        assert_allclose(axes[0], before.axis_m, rtol=1e-6)
        expected.append(before.gain)
        reached.append(1.0 - axes[1] / axes[0])
    # In the mean over scenes; that of one scatters.
    assert 0.05 < np.mean(expected) < 0.25
    assert_allclose(np.mean(expected), np.mean(reached), rtol=0.35)


def test_many_boxes_are_enough_and_few_are_not(harbours: list[Harbour]) -> None:
    for harbour in harbours[1:3]:
        few, _ = harbour.advice(harbour.frame[spread_rows(harbour.frame.size, FIRST)])
        many, _ = harbour.advice(harbour.frame[spread_rows(harbour.frame.size, 60)])
        assert not few.enough
        assert many.enough
        assert many.gain < 0.05 < few.gain
        assert "More boxes will not help" in many.reason


def test_errors_of_left_out_boxes_are_those_of_fits_without_them(harbours: list[Harbour]) -> None:
    """In the root mean square; a fit without a box estimates the noise anew as well."""
    ratios = []
    for harbour in harbours[1:3]:
        advice, _ = harbour.advice(harbour.frame[spread_rows(harbour.frame.size, 14)])
        assert advice.left_out
        inputs = collect(Scene.load(harbour.scene), pictures=False)
        pairs, errors = inputs.correspondences, []
        for i in range(len(pairs)):
            others = pairs[np.delete(np.arange(len(pairs)), i)]
            model = fit(replace(inputs, correspondences=others), FitSettings(model="camera"))
            where = model.locate(pairs.boxes.xyxy_px[[i]], source="annotator")
            off = np.array([where.east_m[0], where.north_m[0]]) - pairs.east_north_m[i]
            errors.append(float(np.hypot(*off)))
        ratios.append(advice.rmse_m / np.sqrt(np.mean(np.square(errors))))
    assert 0.75 < np.exp(np.mean(np.log(ratios))) < 1.33


def test_the_odd_box_is_the_one_that_was_moved(harbours: list[Harbour]) -> None:
    harbour = harbours[0]
    drawn = harbour.frame[spread_rows(harbour.frame.size, 30)]
    kept = harbour.all.copy()
    wrong = drawn[11]
    row = harbour.all["frame"] == wrong
    harbour.all["y1"] = harbour.all["y1"].astype(float)
    harbour.all.loc[row, ["y1", "y2"]] += 25.0
    try:
        advice, _ = harbour.advice(drawn)
    finally:
        harbour.all = kept
    assert [one.frame for one in advice.odd][:1] == [wrong]
    assert "look at its lower edge" in advice.odd[0].why
    sound, _ = harbour.advice(drawn)
    assert wrong not in [one.frame for one in sound.odd]


def test_parts_of_the_picture_without_boxes_are_thin(harbours: list[Harbour]) -> None:
    harbour = harbours[1]
    middle = 0.5 * (harbour.all["x1"] + harbour.all["x2"]).to_numpy()
    left = harbour.frame[middle < 500.0]
    advice, situation = harbour.advice(left[spread_rows(left.size, 15)])
    assert advice.thin
    assert max(cell.x2 for cell in advice.thin) > 640.0
    foot = dict(zip(situation.views.logged.frame.tolist(), situation.views.foot_px, strict=True))
    for cell in advice.thin:
        assert cell.boxes == 0
        for number in cell.frames:
            x, y = foot[number]
            assert cell.x1 <= x <= cell.x2
            assert cell.y1 <= y <= cell.y2


def test_information_never_grows_the_covariance(harbours: list[Harbour]) -> None:
    _, situation = harbours[0].advice(harbours[0].frame[::30])
    design, views = situation.design, situation.views
    assert design is not None
    added = design.information(views.logged[::40], views.above_m[::40])
    shrunk = design.covariance - design.after(added)
    scale = np.sqrt(np.diag(design.covariance))
    assert np.linalg.eigvalsh(shrunk / np.outer(scale, scale)).min() > -1e-9
    # A closed form: for a covariance that can be inverted, the inverses add up.
    regular = Design.__new__(Design)
    regular.covariance = design.covariance + np.diag(scale**2)
    whole = np.linalg.inv(np.linalg.inv(regular.covariance) + added)
    assert_allclose(
        Design.after(regular, added) / np.outer(scale, scale),
        whole / np.outer(scale, scale),
        atol=1e-6,
    )


def feet_px(
    design: Design, at: LoggedFrames, above_m: np.ndarray, late_s: float = 0.0
) -> np.ndarray:
    """Where a camera of the design's parameters sees the near side of the hull."""
    v = design.vector
    place = at.east_north_m + late_s * at.velocity_mps
    off = place - v[[EAST, NORTH]]
    bearing, course = np.arctan2(*off.T), np.arctan2(*at.velocity_mps.T)
    reach = np.abs(np.cos(bearing - course)) * v[HALF_LENGTH]
    reach = reach + np.abs(np.sin(bearing - course)) * v[HALF_BEAM]
    foot = place - reach[:, None] * np.stack([np.sin(bearing), np.cos(bearing)], axis=1)
    camera = Camera.from_vector(v[CAMERA], (1280, 720))
    seen = camera.project(foot[:, 0], foot[:, 1], above_m + v[HALF_BEAM + 2])
    return seen + np.stack([np.zeros(len(at)), np.full(len(at), v[HALF_BEAM + 1])], axis=1)


def test_derivatives_are_those_of_differences(harbours: list[Harbour]) -> None:
    _, situation = harbours[0].advice(harbours[0].frame[::20])
    design, views = situation.design, situation.views
    assert design is not None
    rows = np.arange(0, len(views), 25)
    at, above = views.logged[rows], views.above_m[rows]
    found = design.derivatives(at, above)
    foot = feet_px(design, at, above)
    for slot in range(design.vector.size):
        step = 1e-5 * max(1.0, abs(design.vector[slot]))
        design.vector[slot] += step
        # The last is the clock, which the places have been corrected for.
        late_s = step if slot == design.vector.size - 1 else 0.0
        moved = (feet_px(design, at, above, late_s) - foot) / step
        design.vector[slot] -= step
        size = np.abs(found.jacobian[:, :, slot]).max() + 1.0
        # That another side of the hull is seen, and less of it, is left out.
        assert_allclose(found.jacobian[:, :, slot] / size, moved / size, atol=0.02)


def test_first_frames_are_spread_where_the_log_tells(harbours: list[Harbour]) -> None:
    _, situation = harbours[0].advice(harbours[0].frame[::30])
    logged = situation.views.logged
    free = np.ones(len(logged), dtype=bool)
    free[::2] = False
    chosen = by_spread(logged, free, logged.frame[:3], True, 12)
    assert free[chosen].all()
    assert np.unique(chosen).size == 12
    place = logged.east_north_m
    bearing, distance = np.arctan2(*place.T), np.log(np.hypot(*place.T))
    for values in (bearing, distance):
        assert np.ptp(values[chosen]) > 0.85 * np.ptp(values[free])
