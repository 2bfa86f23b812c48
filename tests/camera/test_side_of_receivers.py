from __future__ import annotations

import numpy as np
import pytest

from sightline.georeferencing.camera_regressor import CameraRegressor
from sightline.georeferencing.observations import CameraObservations


def test_where_all_go_one_way_it_is_open_to_which_side_of_a_receiver_its_middle_is() -> None:
    """A receiver that stands ahead of the middle turns the camera, and no other error tells."""
    rng = np.random.default_rng(3)
    spread = {}
    for kind, ways in (("one way", [1.0] * 6), ("both ways", [1.0, -1.0] * 3)):
        time_s = np.linspace(-8.0, 8.0, 9)
        distance_m = rng.uniform(180.0, 220.0, 6)
        east_m = np.concatenate([4.0 * way * time_s for way in ways])
        north_m = np.repeat(distance_m, time_s.size)
        column = 640.0 + 1000.0 * east_m / north_m
        row, half_px = 360.0 + 8000.0 / north_m, 9000.0 / north_m
        boxes = np.stack([column - half_px, row - 30.0, column + half_px, row], axis=1)
        boxes += rng.normal(0.0, 0.5, boxes.shape)
        velocity = np.stack([np.repeat(4.0 * np.array(ways), time_s.size), 0.0 * east_m], axis=1)
        vessel = np.repeat([f"v{i}" for i in range(6)], time_s.size)
        model = CameraRegressor(residual=False, starts=2).fit_observations(
            CameraObservations(
                boxes,
                np.stack([east_m, north_m], axis=1),
                velocity_mps=velocity,
                time_s=np.concatenate([time_s + 100.0 * i for i in range(6)]),
                vessel=vessel,
            )
        )
        assert model.fit_.sizes is not None
        assert model.fit_.sizes.half_length_m == pytest.approx(9.0, rel=0.2)
        spread[kind] = model.fit_.noise.middle_m
    # Before any data it is 0.4 of half a length of 9 m; afterwards the mean of six receivers, each
    # 0.3 of half a length from where such stand, and of six clocks.
    assert 2.5 < spread["one way"] < 4.0
    assert spread["both ways"] < 2.0
