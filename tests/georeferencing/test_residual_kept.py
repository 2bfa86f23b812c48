"""Whether a fit keeps the process on the camera's residual."""

from __future__ import annotations

import pytest

import sightline
from sightline import Scene
from sightline.georeferencing.camera_regressor import CameraRegressor
from sightline.georeferencing.residual_gp import ResidualProcess


@pytest.mark.slow
@pytest.mark.parametrize(
    ("gain", "too_rough", "kept"),
    [
        ((0.1, 0.05), False, True),
        ((-0.05, 0.1), False, True),
        ((-0.2, 0.1), False, False),
        ((0.1, 0.05), True, False),
    ],
    ids=["better", "by chance", "worse", "rough"],
)
def test_a_process_is_kept_where_left_out_places_do_not_speak_against_it(
    small_scene: Scene,
    monkeypatch: pytest.MonkeyPatch,
    gain: tuple[float, float],
    too_rough: bool,
    kept: bool,
) -> None:
    monkeypatch.setattr(ResidualProcess, "gain", lambda _: gain)
    monkeypatch.setattr(ResidualProcess, "too_rough", too_rough)
    regressor = sightline.fit(small_scene, "camera+gpr").regressor
    assert isinstance(regressor, CameraRegressor)
    assert (regressor.range_process_ is not None) is kept
    assert (regressor.bearing_process_ is not None) is kept
