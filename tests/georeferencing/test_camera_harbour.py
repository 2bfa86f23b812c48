from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from sightline.camera.parameters import LOG_FOCAL, LOG_HEIGHT, PITCH
from sightline.georeferencing.camera_regressor import CameraRegressor
from sightline.georeferencing.observations import CameraObservations
from sightline.simulation import BoxNoise, Harbour, HarbourSettings, ReceiverNoise
from sightline.synchronisation import synchronise
from sightline.types import FloatArray

pytestmark = pytest.mark.slow

SEEDS = range(6)
WINDOW_S = 60.0
WINDOWS = 5


@dataclass(frozen=True)
class Learned:
    """What was learned of a synthetic harbour.

    Attributes:
        height_share: How far off the height is, as a share of itself.
        focal_share: How far off the focal length is, as a share of itself.
        horizon_deg: How far off the level line through the middle of the image is: of the pitch
            the principal point may take a part.
        in_sigmas: The three errors over their stated standard deviations.
        squared: (N,) squared errors, in stated standard deviations, of the true positions in a
            window that was not learned from; infinite where there is no position.
    """

    height_share: float
    focal_share: float
    horizon_deg: float
    in_sigmas: FloatArray
    squared: FloatArray


@cache
def draw_harbour(seed: int) -> Harbour:
    return Harbour.random(seed, HarbourSettings(duration_s=WINDOWS * WINDOW_S))


def learn(seed: int, noise: BoxNoise) -> Learned:
    """Learn from four recordings of a minute each, and look at the fifth."""
    harbour = draw_harbour(seed)
    since = np.arange(0.5, WINDOWS * WINDOW_S, 1.0)
    boxes = harbour.boxes(harbour.start_utc_s + since, noise=noise)
    place = synchronise(harbour.fixes(ReceiverNoise()), boxes.time_utc_s, harbour.plane)
    window = ((boxes.time_utc_s - harbour.start_utc_s) // WINDOW_S).astype(np.int64)
    rows = place.matched & (window < WINDOWS - 1)
    observations = CameraObservations(
        boxes.xyxy_px[rows],
        np.stack([place.east_m, place.north_m], axis=1)[rows],
        source=boxes.source[rows],
        recording=window[rows],
        velocity_mps=np.stack([place.velocity_east_mps, place.velocity_north_mps], axis=1)[rows],
        time_s=boxes.time_utc_s[rows],
    )
    model = CameraRegressor(harbour.camera.image_size_px, residual=False, starts=2)
    model.fit_observations(observations)
    unseen = boxes[window == WINDOWS - 1]
    found, covariance = model.predict(unseen.xyxy_px, source=unseen.source, return_cov=True)
    truth = harbour.truth(unseen.time_utc_s)
    off = found - np.stack([truth.east_m, truth.north_m], axis=1)
    known = np.isfinite(off[:, 0])
    squared = np.full(known.size, np.inf)
    solved = np.linalg.solve(covariance[known], off[known][:, :, None])[:, :, 0]
    squared[known] = np.einsum("ni,ni->n", off[known], solved)
    camera, true = model.camera_, harbour.camera
    sigma = np.sqrt(np.diag(model.fit_.covariance))
    errors = np.array(
        [
            np.log(camera.height_m / true.height_m),
            np.log(camera.focal_px / true.focal_length_px),
            np.radians(camera.pitch_deg - true.pitch_deg),
        ]
    )
    return Learned(
        height_share=camera.height_m / true.height_m - 1.0,
        focal_share=camera.focal_px / true.focal_length_px - 1.0,
        horizon_deg=camera.pitch_deg
        - true.pitch_deg
        - np.degrees(np.arctan(camera.principal_dy_px / camera.focal_px)),
        in_sigmas=errors / sigma[[LOG_HEIGHT, LOG_FOCAL, PITCH]],
        squared=squared,
    )


@pytest.fixture(
    scope="module",
    params=[BoxNoise(), BoxNoise(correlation_time_s=1.0)],
    ids=["white", "correlated over 1 s"],
)
def learned(request: pytest.FixtureRequest) -> list[Learned]:
    return [learn(seed, request.param) for seed in SEEDS]


def test_the_camera_of_the_harbour_is_found(learned: list[Learned]) -> None:
    shares = np.abs([(one.height_share, one.focal_share) for one in learned])
    assert (np.mean(shares < 0.05, axis=0) > 0.8).all()
    assert np.abs([one.horizon_deg for one in learned]).max() < 0.3


def test_the_camera_is_as_sure_as_stated(learned: list[Learned]) -> None:
    z = np.array([one.in_sigmas for one in learned])
    assert np.abs(z).max() < 3.0
    # The height shares an unknown with the bias of whoever drew the boxes: it is surer than that.
    assert 0.4 < np.sqrt(np.mean(z[:, 1] ** 2)) < 1.6


def test_ellipses_hold_the_true_places_of_an_unseen_recording(learned: list[Learned]) -> None:
    squared = np.concatenate([one.squared for one in learned])
    assert squared.size > 250
    # They answer for a clock and for a log that are off, as none is here where the truth is known.
    assert np.mean(squared < chi2.ppf(0.95, 2)) >= 0.90
    assert 0.4 < np.median(squared) / chi2.median(2) < 1.5


@pytest.mark.parametrize("seed", range(4))
def test_two_sources_of_one_moment_do_not_make_the_log_absurd(seed: int) -> None:
    """A detector looks where somebody drew: how their boxes differ is no error of the log."""
    harbour = draw_harbour(seed)
    times = harbour.start_utc_s + np.arange(0.5, WINDOW_S, 0.5)
    drawn = harbour.boxes(times, noise=BoxNoise(std_px=1.0, source="annotator"))
    lasting = BoxNoise(std_px=4.0, correlation_time_s=1.0, source="detector")
    found = harbour.boxes(drawn.time_utc_s, noise=lasting, seed=1)
    margin = 2.0 + 0.15 * (found.xyxy_px[:, 3] - found.xyxy_px[:, 1])[:, None]
    boxes = np.concatenate([drawn.xyxy_px, found.xyxy_px + margin * [-1.0, -1.0, 1.0, 1.0]])
    when = np.concatenate([drawn.time_utc_s, found.time_utc_s])
    place = synchronise(harbour.fixes(ReceiverNoise()), when, harbour.plane)
    rows = place.matched
    observations = CameraObservations(
        boxes[rows],
        np.stack([place.east_m, place.north_m], axis=1)[rows],
        source=np.concatenate([drawn.source, found.source])[rows],
        velocity_mps=np.stack([place.velocity_east_mps, place.velocity_north_mps], axis=1)[rows],
        time_s=when[rows],
    )
    model = CameraRegressor(harbour.camera.image_size_px, residual=False)
    model.fit_observations(observations)
    camera, true = model.camera_, harbour.camera
    assert abs(camera.height_m / true.height_m - 1.0) < 0.25
    assert abs(camera.focal_px / true.focal_length_px - 1.0) < 0.15
    assert model.fit_.noise.correlated_m < 4.0
