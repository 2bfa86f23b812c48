from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import approx_fprime
from scipy.stats import multivariate_normal, t
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel

from sightline.georeferencing import residual_gp
from sightline.georeferencing.residual_gp import Hyperparameters, LogLikelihood, ResidualProcess

SCALES = (1.5, 0.8)
H = Hyperparameters(amplitude=0.3, length_scales=SCALES, recording=0.12, noise=1.3)

# What a variance may be too large by, as a share of the process's own, and what its seven digits
# may be off by.
LOST, ROUNDING = 1e-4, 1e-5


def data(n: int = 120, seed: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Inputs, targets, noise and the recordings of four, each with an offset of its own."""
    rng = np.random.default_rng(seed)
    inputs = rng.uniform(-2.0, 2.0, (n, 2))
    group = np.arange(n) * 4 // n
    noise = rng.uniform(0.02, 0.1, n)
    smooth = 0.3 * np.sin(inputs[:, 0]) * np.cos(1.5 * inputs[:, 1])
    targets = smooth + np.array([0.1, -0.15, 0.05, 0.0])[group] + noise * rng.standard_normal(n)
    return inputs, targets, noise, group


def kernel(a: np.ndarray, b: np.ndarray, h: Hyperparameters = H) -> np.ndarray:
    apart = (a[:, None, :] - b[None, :, :]) / np.array(h.length_scales)
    return np.asarray(h.amplitude**2 * np.exp(-0.5 * (apart**2).sum(axis=-1)))


def covariance(
    inputs: np.ndarray, noise: np.ndarray, group: np.ndarray, h: Hyperparameters = H
) -> np.ndarray:
    same = group[:, None] == group[None, :]
    return np.asarray(
        kernel(inputs, inputs, h) + h.recording**2 * same + np.diag((h.noise * noise) ** 2)
    )


def of_another(group: np.ndarray, h: Hyperparameters = H) -> float:
    """The variance of another recording's offset: Student's t by the number of those seen."""
    return float(h.recording**2 * t.var(df=np.unique(group).size))


def check_variance(stated: np.ndarray, exact: np.ndarray, amplitude: float) -> None:
    excess = (stated - exact) / amplitude**2
    assert excess.min() > -ROUNDING
    assert excess.max() < LOST + ROUNDING


def test_one_point_is_predicted_as_among_many() -> None:
    inputs, targets, noise, group = data()
    process = ResidualProcess(
        inputs, targets, noise, group, length_scales=SCALES, hyperparameters=H
    )
    new = np.random.default_rng(6).uniform(-4.0, 4.0, (50, 2))
    mean, variance = process.predict(new, np.zeros(50))
    each = np.array([process.predict_one(tuple(point)) for point in new])
    np.testing.assert_allclose(each[:, 0], mean, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(each[:, 1], variance, rtol=0.0, atol=ROUNDING * H.amplitude**2)


def test_agrees_with_scikit_learn_where_no_two_points_share_a_recording() -> None:
    inputs, targets, noise, _ = data()
    group = np.arange(len(targets))
    process = ResidualProcess(
        inputs, targets, noise, group, length_scales=SCALES, hyperparameters=H
    )
    reference = GaussianProcessRegressor(
        ConstantKernel(H.amplitude**2) * RBF(SCALES),
        alpha=(H.noise * noise) ** 2 + H.recording**2,
        optimizer=None,
    ).fit(inputs, targets)
    new = np.random.default_rng(2).uniform(-4.0, 4.0, (300, 2))
    new_noise = np.random.default_rng(3).uniform(0.0, 0.2, 300)
    mean, variance = process.predict(new, new_noise)
    expected, deviation = reference.predict(new, return_std=True)
    np.testing.assert_allclose(mean, expected, atol=1e-8)
    check_variance(
        variance, deviation**2 + of_another(group) + (H.noise * new_noise) ** 2, H.amplitude
    )


@pytest.mark.parametrize(
    "h",
    [
        H,
        Hyperparameters(0.3, SCALES, recording=1e-6, noise=1.0),
        Hyperparameters(0.05, (0.3, 0.2), recording=0.5, noise=0.7),
    ],
    ids=["ordinary", "no recordings", "recordings above all"],
)
def test_agrees_with_the_closed_form_with_recordings(h: Hyperparameters) -> None:
    inputs, targets, noise, group = data()
    process = ResidualProcess(
        inputs, targets, noise, group, length_scales=SCALES, hyperparameters=h
    )
    new = np.random.default_rng(5).uniform(-3.0, 3.0, (200, 2))
    new_noise = np.full(200, 0.05)
    mean, variance = process.predict(new, new_noise)
    across = kernel(new, inputs, h)
    whole = covariance(inputs, noise, group, h)
    np.testing.assert_allclose(
        mean, across @ np.linalg.solve(whole, targets), atol=1e-6 * h.amplitude
    )
    explained = np.einsum("mn,nm->m", across, np.linalg.solve(whole, across.T))
    expected = h.amplitude**2 - explained + of_another(group, h) + (h.noise * new_noise) ** 2
    check_variance(variance, expected, h.amplitude)


def test_far_from_all_points_only_the_prior_is_left() -> None:
    process = ResidualProcess(*data(), length_scales=SCALES, hyperparameters=H)
    mean, variance = process.predict(np.full((3, 2), 1e3), np.array([0.0, 0.1, 0.4]))
    np.testing.assert_allclose(mean, 0.0, atol=1e-12)
    expected = H.amplitude**2 + of_another(data()[3]) + (H.noise * np.array([0.0, 0.1, 0.4])) ** 2
    np.testing.assert_allclose(variance, expected, rtol=1e-6)


def test_an_offset_that_a_recording_shares_is_not_learned_as_if_it_came_with_the_place() -> None:
    inputs = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 2))
    targets, noise = np.full(40, 0.2), np.full(40, 0.02)
    h = Hyperparameters(0.1, SCALES, recording=0.2, noise=1.0)
    at = np.zeros((1, 2)), np.zeros(1)
    one, many = (
        ResidualProcess(inputs, targets, noise, group, length_scales=SCALES, hyperparameters=h)
        for group in (np.zeros(40, dtype=np.int64), np.arange(40))
    )
    assert one.predict(*at)[0][0] < 0.5 * many.predict(*at)[0][0]
    assert one.predict(*at)[1][0] > many.predict(*at)[1][0]


def test_many_predictions_at_once_are_those_of_single_points(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    process = ResidualProcess(*data(), length_scales=SCALES, hyperparameters=H)
    new = np.random.default_rng(6).uniform(-3.0, 3.0, (50, 2))
    noise = np.full(50, 0.1)
    together = process.predict(new, noise)
    monkeypatch.setattr(residual_gp, "_KERNEL_SIZE", 7 * 120)
    for whole, parts in zip(together, process.predict(new, noise), strict=True):
        np.testing.assert_allclose(whole, parts, rtol=1e-5, atol=1e-9)
    mean, variance = process.predict(new[:0], noise[:0])
    assert mean.shape == variance.shape == (0,)


def test_the_likelihood_is_that_of_a_normal_distribution() -> None:
    inputs, targets, noise, group = data(60)
    likelihood = LogLikelihood(inputs, targets, noise, group)
    for h in (H, Hyperparameters(0.1, (0.5, 3.0), 0.3, 0.8)):
        expected = multivariate_normal(cov=covariance(inputs, noise, group, h)).logpdf(targets)
        constant = -0.5 * len(targets) * np.log(2.0 * np.pi)
        assert likelihood(h.to_log())[0] + constant == pytest.approx(expected, rel=1e-6)


def test_the_gradient_of_the_likelihood_is_its_finite_difference() -> None:
    likelihood = LogLikelihood(*data(60))
    for seed in range(5):
        at = H.to_log() + 0.5 * np.random.default_rng(seed).standard_normal(5)
        expected = approx_fprime(at, lambda t: likelihood(t)[0], 1e-6)
        np.testing.assert_allclose(likelihood(at)[1], expected, rtol=1e-3, atol=1e-3)


def test_the_hyperparameters_of_simulated_data_are_found_again() -> None:
    rng = np.random.default_rng(8)
    n = 280
    inputs = rng.uniform(-3.0, 3.0, (n, 2))
    noise = np.full(n, 0.05)
    group = np.arange(n) * 14 // n
    true = Hyperparameters(0.15, (1.5, 0.8), recording=0.1, noise=1.0)
    whole = covariance(inputs, noise, group, true)
    targets = np.linalg.cholesky(whole) @ rng.standard_normal(n)
    found = ResidualProcess(inputs, targets, noise, group, length_scales=SCALES).hyperparameters
    assert np.abs(found.to_log() - true.to_log()).max() < np.log(2.0)
    # What is found is at least as probable as what made the data.
    likelihood = LogLikelihood(inputs, targets, noise, group)
    assert likelihood(found.to_log())[0] > likelihood(true.to_log())[0] - 3.0


def test_too_many_points_are_thinned_evenly_and_the_ends_stay(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    inputs, targets, noise, group = data(203)
    inputs[:, 0] = np.arange(203)
    monkeypatch.setattr(residual_gp, "MOST_POINTS", 50)
    process = ResidualProcess(
        inputs, targets, noise, group, length_scales=SCALES, hyperparameters=H
    )
    rows = process.inputs[:, 0].astype(int)
    assert len(rows) == 50
    assert rows[0] == 0
    assert rows[-1] == 202
    assert set(np.diff(rows)) == {4, 5}
    np.testing.assert_array_equal(process.targets, targets[rows])
    np.testing.assert_array_equal(process.noise, noise[rows])
    np.testing.assert_array_equal(process.group, group[rows])


@pytest.mark.parametrize(("count", "widened"), [(1, 3.0), (2, 3.0), (3, 3.0), (6, 1.5)])
def test_fewer_recordings_say_less_of_another(count: int, widened: float) -> None:
    inputs, targets, noise, _ = data()
    process = ResidualProcess(
        inputs,
        targets,
        noise,
        np.arange(len(targets)) % count,
        length_scales=SCALES,
        hyperparameters=H,
    )
    _, variance = process.predict(np.full((1, 2), 1e3), np.zeros(1))
    assert variance[0] == pytest.approx(H.amplitude**2 + widened * H.recording**2, rel=1e-12)


@pytest.mark.parametrize(("lengths", "rough"), [(1.0, False), (0.12, True)])
def test_what_wiggles_from_boat_to_boat_is_no_residual_of_the_camera(
    lengths: float, rough: bool
) -> None:
    rng = np.random.default_rng(8)
    inputs = rng.uniform(-2.0, 2.0, (250, 2))
    scaled = inputs / (lengths * np.array(SCALES))
    smooth = np.exp(-0.5 * ((scaled[:, None] - scaled[None]) ** 2).sum(axis=2))
    targets = rng.multivariate_normal(np.zeros(250), 0.1**2 * smooth + 0.01**2 * np.eye(250))
    process = ResidualProcess(
        inputs, targets, np.full(250, 0.01), np.arange(250) % 50, length_scales=SCALES
    )
    assert process.too_rough is rough
