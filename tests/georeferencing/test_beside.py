"""Boxes of a detector beside those that somebody drew."""

from __future__ import annotations

import numpy as np
import pytest

import sightline
from sightline import Georeferencer, Scene
from sightline.georeferencing.camera_regressor import CameraRegressor
from sightline.pipeline.fit import fit
from sightline.types import Boxes


def regressor_of(model: Georeferencer) -> CameraRegressor:
    assert isinstance(model.regressor, CameraRegressor)
    return model.regressor


@pytest.fixture(scope="module")
def found(small_scene: Scene) -> dict[str, Boxes]:
    """A detector whose boxes end the lower the larger they are, and are twice as wide."""
    out = {}
    for recording in small_scene.recordings:
        boxes = recording.boxes()
        xyxy_px = boxes.xyxy_px.copy()
        height_px = xyxy_px[:, 3] - xyxy_px[:, 1]
        xyxy_px[:, 3] += 3.0 + 0.2 * (height_px - height_px.mean())
        half_px = 0.5 * (xyxy_px[:, 2] - xyxy_px[:, 0])
        xyxy_px[:, 0] -= half_px
        xyxy_px[:, 2] += half_px
        out[recording.name] = boxes.with_columns(
            xyxy_px=xyxy_px, source=np.full(len(boxes), "detector")
        )
    return out


@pytest.fixture(scope="module")
def both(small_scene: Scene, found: dict[str, Boxes]) -> Georeferencer:
    return fit(small_scene, "camera+gpr", extra=found)


@pytest.mark.slow
def test_its_lower_edge_is_learned_and_its_residuals_are_not(
    small_scene: Scene, found: dict[str, Boxes], both: Georeferencer
) -> None:
    alone = fit(small_scene, "camera+gpr")
    assert regressor_of(both).sources_ == ("detector", "first", "second")
    process, drawn = regressor_of(both).range_process_, regressor_of(alone).range_process_
    assert process is not None
    assert drawn is not None
    assert both.report.n == 2 * alone.report.n
    assert len(process.inputs) <= alone.report.n
    # The detector's boxes are twice as wide.
    medians = [float(np.median(one.inputs[:, 3])) for one in (process, drawn)]
    assert medians[0] == pytest.approx(medians[1], abs=0.1)
    for recording in small_scene.recordings:
        boxes = recording.boxes()
        one, other = (m.locate(boxes.xyxy_px, boxes.source) for m in (alone, both))
        apart_m = np.hypot(one.east_m - other.east_m, one.north_m - other.north_m)
        sigma_m = np.sqrt(np.trace(one.covariance_m2, axis1=1, axis2=2))
        assert np.nanmedian(apart_m / sigma_m) < 0.5


def test_extra_boxes_need_no_name_of_their_own(small_scene: Scene) -> None:
    """Of a source that drew as well they count as drawn."""
    more = {"first run": small_scene["first run"].boxes()[:10]}
    model = sightline.fit(small_scene, "camera+gpr", extra=more)
    process = regressor_of(model).range_process_
    assert process is not None
    alone = regressor_of(sightline.fit(small_scene, "camera+gpr")).range_process_
    assert alone is not None
    assert len(process.inputs) > len(alone.inputs)
