"""A simulated harbour before three cameras: whether the fused picture is better than each alone."""

from __future__ import annotations

import numpy as np
import pytest
from _support.fleet import TruePlaces, as_cameras, camera_tracks, learned, score, true_places

from sightline.errors import InputError
from sightline.fusion import CameraTracks, Fusion, cameras_of, fuse
from sightline.simulation import SeveralSettings, harbours
from sightline.simulation.harbour import DOCK


def test_all_cameras_see_the_same_boats_at_the_same_places() -> None:
    views = harbours(3, SeveralSettings(cameras=3, vessels=6, duration_s=30.0))
    times = views[0].times(0.5)
    places = []
    for view in views:
        truth = view.truth(times, view.boats)
        places.append(np.stack(DOCK.to_plane(truth.latitude_deg, truth.longitude_deg), axis=1))
        assert len(view.boxes(times, of="all")) > 0
    assert np.abs(places[1] - places[0]).max() < 0.1
    assert np.abs(places[2] - places[0]).max() < 0.1


def test_water_too_small_is_refused() -> None:
    with pytest.raises(InputError, match="too small"):
        SeveralSettings(water_m=50.0)
    with pytest.raises(InputError, match="at least one camera"):
        SeveralSettings(cameras=0)


@pytest.fixture(scope="module")
def picture() -> tuple[list[CameraTracks], TruePlaces, Fusion]:
    views = harbours(2, SeveralSettings(vessels=10, duration_s=90.0))
    tracks = [
        camera_tracks(view, learned(view, 200 + k), 20 + k + 1) for k, view in enumerate(views)
    ]
    cameras = as_cameras(views, tracks)
    return cameras, true_places(views), fuse(cameras, DOCK)


@pytest.mark.slow
def test_identities_are_kept_better_than_by_the_best_camera(
    picture: tuple[list[CameraTracks], TruePlaces, Fusion],
) -> None:
    cameras, truth, fused = picture
    best = max(score(truth, camera.tracks).idf1 for camera in cameras)
    assert score(truth, fused.tracks).idf1 > best + 0.1
    assert fused.shared >= 6
    assert fused.scatter < 1.5


@pytest.mark.slow
def test_places_are_better_and_ellipses_hold(
    picture: tuple[list[CameraTracks], TruePlaces, Fusion],
) -> None:
    cameras, truth, fused = picture
    errors, inside = [], []
    for track in fused.tracks:
        if len(cameras_of(track)) < 2:
            continue
        rows = np.round(track.time_utc_s - truth.time_utc_s[0]).astype(int)
        rows = rows[(rows >= 0) & (rows < truth.time_utc_s.size)]
        place = np.stack([track.east_m, track.north_m], axis=1)[: rows.size]
        off = place[:, None] - truth.place_m[rows]
        whose = np.bincount(np.hypot(off[..., 0], off[..., 1]).argmin(axis=1)).argmax()
        own = off[:, whose]
        errors.append(np.hypot(*own.T))
        inverse = np.linalg.inv(track.covariance_m2[: rows.size])
        inside.append(np.einsum("ni,nij,nj->n", own, inverse, own) < 5.991)
    single = [
        np.sqrt(np.trace(track.covariance_m2, axis1=1, axis2=2)).mean()
        for camera in cameras
        for track in camera.tracks
    ]
    assert np.median(np.concatenate(errors)) < 0.6 * np.median(single)
    assert 0.85 <= np.concatenate(inside).mean() <= 1.0
