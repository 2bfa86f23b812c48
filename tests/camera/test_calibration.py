from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import chi2

from sightline.camera.calibration import CameraFit, CameraFitSettings, fit_camera
from sightline.camera.mixed_model import MixedModel
from sightline.camera.observations import PointCorrespondences
from sightline.camera.parameters import (
    CAMERA,
    HEADING,
    LOG_FOCAL,
    NORTH,
    PARAMETERS,
    PITCH,
    POSITION,
    TARGET,
)
from sightline.camera.pinhole import Camera
from sightline.camera.priors import CameraPrior, PixelNoise, SourcePrior
from sightline.errors import FitError
from sightline.georeferencing.camera_regressor import CameraRegressor
from sightline.georeferencing.observations import CameraObservations
from sightline.georeferencing.residual_gp import ResidualProcess
from sightline.types import FloatArray

SIZE = (1280, 720)
NOISE = PixelNoise(row_px=1.0, row_m=0.1, column_px=2.0, place_m=0.5)
SEEDS = range(10)
QUICK = CameraFitSettings(starts=2)


@dataclass(frozen=True)
class World:
    """A planted camera and what it sees of targets whose place is known."""

    camera: Camera
    sightings: PointCorrespondences
    hull_m: FloatArray
    bias: FloatArray
    clock_s: FloatArray


def draw_camera(rng: np.random.Generator) -> Camera:
    """A camera as the prior believes it to be, level enough to see the water."""
    prior = CameraPrior()
    return Camera(
        height_m=prior.height_m * float(np.exp(rng.normal(0.0, 0.4))),
        pitch_deg=float(rng.uniform(2.0, 12.0)),
        roll_deg=float(rng.normal(0.0, 2.0)),
        heading_deg=float(rng.uniform(0.0, 360.0)),
        focal_px=prior.focal_widths * SIZE[0] * float(np.exp(rng.normal(0.0, 0.2))),
        k1=float(rng.normal(-0.1, 0.05)),
        k2=float(rng.normal(0.02, 0.01)),
        east_m=float(rng.normal(0.0, prior.position_sigma_m)),
        north_m=float(rng.normal(0.0, prior.position_sigma_m)),
        image_size_px=SIZE,
    )


def places(camera: Camera, rng: np.random.Generator, n: int) -> tuple[FloatArray, FloatArray]:
    """Places that are evenly seen all over the image, below the horizon, 20 to 400 m away."""
    pixel = rng.uniform((20.0, 20.0), (SIZE[0] - 20.0, SIZE[1] - 20.0), (80 * n, 2))
    east, north = camera.locate(pixel)
    distance = np.hypot(east - camera.east_m, north - camera.north_m)
    chosen = np.flatnonzero((distance > 20.0) & (distance < 400.0))[:n]
    assert chosen.size == n
    return east[chosen], north[chosen]


def plant(
    seed: int,
    *,
    n: int = 150,
    sources: int = 1,
    recordings: int = 5,
    speed_mps: float = 4.0,
    camera: Camera | None = None,
    at: tuple[FloatArray, FloatArray] | None = None,
    bias: FloatArray | None = None,
    clock_s: FloatArray | None = None,
    hull_m: FloatArray | None = None,
    bow_rad: FloatArray | None = None,
    drift_mps: float | None = None,
    widths: bool = False,
    noise: PixelNoise = NOISE,
) -> World:
    """Boxes of a moving target, whose hull, biases and clocks are drawn from what is believed.

    It goes where its bow points, or drifts anywhere at a speed. Its boxes have no widths, or those
    of its hull.
    """
    rng = np.random.default_rng([seed, 71])
    prior = CameraPrior()
    camera = camera or draw_camera(rng)
    east, north = at or places(camera, rng, n)
    n = east.size
    source, group = np.arange(n) % sources, np.arange(n) % recordings
    hull = np.abs(rng.normal(0.0, (prior.half_length_m[1], prior.half_beam_m[1])))
    if hull_m is not None:
        hull = hull_m
    if bias is None:
        bias = rng.normal(0.0, (prior.bias_px_sigma, prior.bias_m_sigma), (sources, 2))
    if clock_s is None:
        clock_s = rng.normal(0.0, prior.clock_sigma_s, recordings)
    course = rng.uniform(0.0, 2.0 * np.pi, n)
    if bow_rad is not None:
        course = bow_rad
    velocity = speed_mps * np.stack([np.sin(course), np.cos(course)], axis=1)
    if drift_mps is not None:
        angle = np.random.default_rng([seed, 89]).uniform(0.0, 2.0 * np.pi, n)
        velocity = drift_mps * np.stack([np.sin(angle), np.cos(angle)], axis=1)

    # The near side of the hull lies between the target and the camera.
    sight = np.stack([east - camera.east_m, north - camera.north_m], axis=1)
    sight /= np.hypot(*sight.T)[:, None]
    cosine = np.abs(np.sin(course) * sight[:, 0] + np.cos(course) * sight[:, 1])
    sine = np.sqrt(1.0 - np.minimum(cosine, 1.0) ** 2)
    near = (hull[0] * cosine + hull[1] * sine)[:, None] * sight
    pixel = camera.project(east - near[:, 0], north - near[:, 1], bias[source, 1])
    pixel[:, 1] += bias[source, 0]

    slant = np.hypot(np.hypot(east - camera.east_m, north - camera.north_m), camera.height_m)
    row = np.hypot(noise.row_px, noise.row_m * camera.focal_px / slant)
    pixel += rng.normal(size=(n, 2)) * np.stack([np.full(n, noise.column_px), row], axis=1)
    width = 2.0 * (hull[0] * sine + hull[1] * cosine) * camera.focal_px / slant
    log = np.stack([east, north], axis=1) - clock_s[group][:, None] * velocity
    log += rng.normal(0.0, noise.place_m, (n, 2))
    return World(
        camera,
        PointCorrespondences(
            pixel_px=pixel,
            east_m=log[:, 0],
            north_m=log[:, 1],
            source=source.astype(np.int64),
            group=group.astype(np.int64),
            velocity_mps=velocity,
            sigma_m=np.zeros(n),
            width_px=width if widths else np.full(n, np.nan),
        ),
        hull,
        bias,
        clock_s,
    )


def fit_world(world: World, sources: int = 1, starts: int = 3) -> CameraFit:
    return fit_camera(
        world.sightings, SIZE, n_sources=sources, settings=CameraFitSettings(starts=starts)
    )


def difference(fit: CameraFit, camera: Camera) -> FloatArray:
    """(9,) fitted minus true parameters, as the fit sees them."""
    off = fit.vector[CAMERA] - camera.to_vector()
    off[HEADING] = np.arctan2(np.sin(off[HEADING]), np.cos(off[HEADING]))
    return off


def squared(off: FloatArray, covariance: FloatArray) -> float:
    """The squared error in standard deviations of a covariance."""
    return float(off @ np.linalg.solve(covariance, off))


def boxes_of(pixel: FloatArray) -> FloatArray:
    """(N, 4) boxes whose feet are the pixels."""
    x, y = pixel.T
    return np.stack([x - 5.0, y - 9.0, x + 5.0, y], axis=1)


@pytest.fixture(scope="module")
def fitted() -> list[tuple[World, CameraFit]]:
    worlds = [plant(seed) for seed in SEEDS]
    return [(world, fit_world(world)) for world in worlds]


def test_a_planted_camera_is_found_as_surely_as_stated(
    fitted: list[tuple[World, CameraFit]],
) -> None:
    total = 0.0
    for world, fit in fitted:
        off, covariance = difference(fit, world.camera), fit.covariance[CAMERA, CAMERA]
        assert (np.abs(off) < 3.5 * np.sqrt(np.diag(covariance))).all()
        assert fit.starts_agreeing == fit.starts
        total += squared(off, covariance)
    low, high = chi2.ppf([0.005, 0.995], len(PARAMETERS) * len(fitted))
    assert low < total < high


def test_hulls_and_clocks_are_found_as_surely_as_stated(
    fitted: list[tuple[World, CameraFit]],
) -> None:
    total, count = 0.0, 0
    for world, fit in fitted:
        clocks = fit.clock_offset_s - world.clock_s
        hull = fit.vector[TARGET] - world.hull_m
        n = clocks.size
        assert n == 5
        total += squared(clocks, fit.covariance[fit.layout.clocks, fit.layout.clocks])
        total += squared(hull, fit.covariance[TARGET, TARGET])
        count += n + hull.size
    low, high = chi2.ppf([0.005, 0.995], count)
    assert low < total < high


def test_the_noise_is_found(fitted: list[tuple[World, CameraFit]]) -> None:
    # Pixels and metres trade against each other; the place, seen nearby, does not.
    found = np.array([(fit.noise.place_m, fit.noise.row_px) for _, fit in fitted])
    np.testing.assert_allclose(np.median(found, axis=0), (NOISE.place_m, NOISE.row_px), rtol=0.3)


LONG_HULL_M = np.array([5.0, 1.75])
"""Half of the length and of the beam of a boat of common proportions."""


@pytest.mark.parametrize(
    ("off_deg", "told"), [(0.0, 1), (90.0, 0)], ids=["beam from ahead", "length from abeam"]
)
def test_a_hull_is_as_wide_as_its_aspect_shows_it(off_deg: float, told: int) -> None:
    found = []
    for seed in range(6):
        rng = np.random.default_rng([seed, 97])
        camera = draw_camera(rng)
        east, north = at = places(camera, rng, 150)
        bow = np.arctan2(east - camera.east_m, north - camera.north_m) + np.radians(off_deg)
        bow += np.pi * rng.integers(0, 2, 150) + rng.normal(0.0, 0.05, 150)
        world = plant(
            seed,
            camera=camera,
            at=at,
            hull_m=LONG_HULL_M,
            bow_rad=bow,
            widths=True,
            clock_s=np.zeros(5),
        )
        found.append(fit_world(world, starts=2).vector[len(PARAMETERS) + told])
    assert np.median(found) == pytest.approx(LONG_HULL_M[told], rel=0.2)


@pytest.mark.parametrize("drift_mps", [0.0, 0.3])
def test_a_target_at_anchor_heads_anywhere(drift_mps: float) -> None:
    """Its velocity says nothing of its bow; its places are as near as those of one under way."""
    along, lengths = [], []
    for seed in range(4):
        world = plant(
            seed,
            hull_m=LONG_HULL_M,
            bias=np.zeros((1, 2)),
            clock_s=np.zeros(5),
            drift_mps=drift_mps,
            widths=True,
        )
        seen = world.sightings
        wide = boxes_of(seen.pixel_px)
        wide[:, 0], wide[:, 2] = seen.pixel_px[:, 0] + np.outer([-0.5, 0.5], seen.width_px)
        model = CameraRegressor(SIZE, residual=False, starts=2).fit_observations(
            CameraObservations(
                wide,
                np.stack([seen.east_m, seen.north_m], axis=1),
                velocity_mps=seen.velocity_mps,
                recording=seen.group,
            )
        )
        lengths.append(model.fit_.vector[len(PARAMETERS)])
        camera, truth = world.camera, world.sightings
        away = np.stack([truth.east_m - camera.east_m, truth.north_m - camera.north_m], axis=1)
        near = np.hypot(*away.T) < 150.0
        off = model.predict(wide) - (camera.east_m, camera.north_m) - away
        along.append(np.nanmedian(np.sum(off * away, axis=1)[near] / np.hypot(*away.T)[near]))
    assert abs(np.mean(along)) < 0.6
    np.testing.assert_allclose(np.mean(lengths), LONG_HULL_M[0], rtol=0.25)


def test_what_a_log_is_off_by_is_not_counted_twice() -> None:
    """Without times nothing tells what lasts, and all of it is of single fixes."""
    total, lasting = [], []
    for seed in SEEDS:
        world = plant(seed)
        noise = fit_world(world, starts=2).noise
        total.append(np.hypot(noise.place_m, noise.correlated_m))
        lasting.append(noise.correlated_m)
    assert np.median(total) == pytest.approx(NOISE.place_m, rel=0.3)
    np.testing.assert_array_equal(lasting, 0.0)


def test_planted_clock_offsets_are_told_apart() -> None:
    clocks = np.array([-1.5, 0.0, 0.7, 2.0])
    for seed in SEEDS:
        fit = fit_world(plant(seed, recordings=4, clock_s=clocks), starts=2)
        np.testing.assert_array_equal(fit.clock_groups, np.arange(4))
        np.testing.assert_allclose(fit.clock_offset_s, clocks, atol=0.25)


def test_sources_that_end_at_other_heights_are_told_apart() -> None:
    """Of a height that both share the camera's own takes a part; of their difference none."""
    planted = np.array([[0.0, 0.0], [0.0, 0.5]])
    total = 0.0
    for seed in SEEDS:
        fit = fit_world(plant(seed, sources=2, bias=planted), sources=2, starts=2)
        one, other = fit.layout.source(0), fit.layout.source(1)
        apart = fit.vector[other] - fit.vector[one]
        take = np.zeros((2, fit.vector.size))
        take[:, one], take[:, other] = -np.eye(2), np.eye(2)
        covariance = take @ fit.covariance @ take.T
        assert np.sqrt(covariance[1, 1]) < 0.2
        off = apart - planted[1]
        assert (np.abs(off) < 3.5 * np.sqrt(np.diag(covariance))).all()
        total += squared(off, covariance)
    assert total < chi2.ppf(0.995, 2 * len(SEEDS))


@pytest.mark.slow
def test_a_habit_that_is_known_is_not_taken_for_the_pitch() -> None:
    """Boxes that all end 6 px too low look like a camera that is turned up."""
    planted = np.array([[6.0, -0.2]])
    belief = SourcePrior(bias_px=(6.0, 0.5), bias_m=(-0.2, 0.1))
    believed, untold = [], []
    for seed in SEEDS:
        world = plant(seed, bias=planted)
        for beliefs, off in (({0: belief}, believed), (None, untold)):
            fit = fit_camera(world.sightings, SIZE, n_sources=1, beliefs=beliefs, settings=QUICK)
            # The row of the horizon: of the pitch the principal point may take a part.
            middle = [0.5 * SIZE[0]]
            level = fit.camera.horizon_y_px(middle) - world.camera.horizon_y_px(middle)
            off.append(float(level[0]))
            if beliefs:
                turned = difference(fit, world.camera)[PITCH]
                assert abs(turned) < 3.5 * np.sqrt(fit.covariance[PITCH, PITCH])
    assert np.median(np.abs(believed)) < 0.5 * np.median(np.abs(untold))


def test_outliers_are_flagged_and_do_not_pull_the_camera() -> None:
    for seed in SEEDS:
        world = plant(seed)
        rng = np.random.default_rng([seed, 73])
        struck = rng.choice(len(world.sightings), 8, replace=False)
        pixel = world.sightings.pixel_px.copy()
        per_metre = world.camera.focal_px / np.hypot(
            world.sightings.east_m[struck] - world.camera.east_m,
            world.sightings.north_m[struck] - world.camera.north_m,
        )
        pixel[struck, 0] += rng.choice([-1.0, 1.0], 8) * (60.0 + 6.0 * per_metre)
        fit = fit_world(
            replace(world, sightings=replace(world.sightings, pixel_px=pixel)), starts=2
        )
        assert fit.outlier[struck].all()
        assert np.delete(fit.outlier, struck).sum() <= 1
        moved = difference(fit, world.camera)
        assert (np.abs(moved) < 3.5 * np.sqrt(np.diag(fit.covariance)[: moved.size])).all()


def test_too_few_sightings_are_refused() -> None:
    for n in (0, 2):
        few = plant(0).sightings
        few = PointCorrespondences(*(getattr(few, name)[:n] for name in few.__dataclass_fields__))
        with pytest.raises(FitError, match=f"{n} pairs of a box and a fix"):
            fit_camera(few, SIZE, n_sources=1)


def test_a_target_that_never_moves_is_refused() -> None:
    here = np.full(30, 12.0), np.full(30, 80.0)
    still = plant(0, camera=AHEAD, at=here).sightings
    with pytest.raises(FitError, match="in one place"):
        fit_camera(replace(still, east_m=here[0], north_m=here[1]), SIZE, n_sources=1)
    one_pixel = np.full((30, 2), 300.0)
    with pytest.raises(FitError, match="in one place"):
        fit_camera(replace(still, pixel_px=one_pixel), SIZE, n_sources=1)


AHEAD = Camera(5.0, 4.0, 0.5, 0.0, 1000.0, -0.1, 0.02, 0.0, 0.0, SIZE)
"""A camera that looks north from the origin."""

AWAY = np.zeros(80), np.geomspace(30.0, 300.0, 80)
ALONG = np.linspace(-30.0, 30.0, 80), np.full(80, 60.0)


def fit_path(seed: int, path: tuple[FloatArray, FloatArray], noise: PixelNoise) -> CameraRegressor:
    nothing = np.zeros(2)
    sightings = plant(
        seed,
        camera=AHEAD,
        at=path,
        recordings=1,
        bias=nothing[None],
        clock_s=nothing[:1],
        hull_m=nothing,
        noise=noise,
    ).sightings
    return CameraRegressor(SIZE, residual=False, starts=2).fit_observations(
        CameraObservations(
            boxes_of(sightings.pixel_px),
            np.stack([sightings.east_m, sightings.north_m], axis=1),
            velocity_mps=sightings.velocity_mps,
        )
    )


def undetermined(model: CameraRegressor) -> set[str]:
    return {
        name for name, known in zip(PARAMETERS, model.fit_.determined(), strict=True) if not known
    }


def look_beside(
    path: tuple[FloatArray, FloatArray], on: tuple[float, float], off: tuple[float, float]
) -> tuple[list[set[str]], FloatArray, int]:
    """Fits to a path: what they leave open, by how much the stated error grows, how often it holds.

    Args:
        path: East and north of the targets.
        on: A place on it.
        off: A place beside it.
    """
    accurate = PixelNoise(row_px=1.0, row_m=0.05, column_px=2.0, place_m=0.05)
    where = np.array([on, off])
    pixel = AHEAD.project(*where.T)
    opened, growth, held = [], [], 0
    for seed in SEEDS:
        model = fit_path(seed, path, accurate)
        places, covariance, shared = model.predict(boxes_of(pixel), return_shared=True)
        opened.append(undetermined(model))
        sigma = np.sqrt(np.linalg.eigvalsh(shared)[:, 1])
        assert np.isfinite(sigma[0])
        # Where so little is known that there is no place, nothing is claimed.
        unknown = not np.isfinite(places[1]).all()
        growth.append(np.inf if unknown else sigma[1] / sigma[0])
        held += unknown or squared(places[1] - where[1], covariance[1]) < chi2.ppf(0.95, 2)
    return opened, np.array(growth), held


def test_a_path_straight_away_leaves_the_sides_open() -> None:
    opened, growth, held = look_beside(AWAY, (0.0, 50.0), (-22.0, 45.0))
    assert all({"roll_deg", "k2"} <= names for names in opened)
    assert (growth > 3.0).all()
    assert held >= 8


def test_a_path_along_the_image_leaves_near_and_far_open() -> None:
    opened, growth, held = look_beside(ALONG, (0.0, 60.0), (-5.0, 25.0))
    assert all({"k2", "north_m"} <= names for names in opened)
    assert (growth > 3.0).all()
    assert held >= 8


def test_an_inexact_log_of_a_path_straight_away_leaves_the_focal_length_open() -> None:
    """Its scatter across the line of sight makes metres look small, and the fit says so."""
    for seed in range(3):
        model = fit_path(seed, AWAY, NOISE)
        fit = model.fit_
        assert {"height_m", "focal_px"} <= undetermined(model)
        sigma = np.sqrt(fit.covariance[LOG_FOCAL, LOG_FOCAL])
        z = (fit.vector[LOG_FOCAL] - np.log(AHEAD.focal_px)) / sigma
        assert np.abs(z) < 3.5


def test_boxes_of_a_source_that_nobody_knows_lie_in_their_ellipses() -> None:
    """A detector ends its boxes eight pixels too high: none of the sources learned from does."""
    held = []
    for seed in range(4):
        world = plant(seed, sources=2, hull_m=np.zeros(2))
        sightings = world.sightings
        model = CameraRegressor(SIZE, residual=False, starts=2).fit_observations(
            CameraObservations(
                boxes_of(sightings.pixel_px),
                np.stack([sightings.east_m, sightings.north_m], axis=1),
                source=np.array(["one", "other"])[sightings.source],
                velocity_mps=sightings.velocity_mps,
            )
        )
        truth = np.stack(places(world.camera, np.random.default_rng([seed, 79]), 60), axis=1)
        pixel = world.camera.project(*truth.T) - (0.0, 8.0)
        found, covariance = model.predict(boxes_of(pixel), source="detector", return_cov=True)
        off = found - truth
        known = np.isfinite(off[:, 0])
        solved = np.linalg.solve(covariance[known], off[known][:, :, None])[:, :, 0]
        held.append(np.einsum("ni,ni->n", off[known], solved) < chi2.ppf(0.95, 2))
    assert np.mean(np.concatenate(held)) > 0.9


def test_a_source_that_nobody_knows_ends_where_the_prior_says_that_such_do() -> None:
    """The camera learned from a detector whose bias was measured; somebody draws with a margin."""
    margin = np.array([2.0, -0.3])
    prior = CameraPrior(unseen_px=margin[0], unseen_m=margin[1])
    belief = SourcePrior(bias_px=(3.0, 0.1), bias_m=(-0.2, 0.05))
    off = {}
    for told in (prior, CameraPrior()):
        world = plant(1, bias=np.array([[3.0, -0.2]]), hull_m=np.zeros(2))
        sightings = world.sightings
        model = CameraRegressor(
            SIZE, residual=False, prior=told, source_priors={"detector": belief}, starts=2
        ).fit_observations(
            CameraObservations(
                boxes_of(sightings.pixel_px),
                np.stack([sightings.east_m, sightings.north_m], axis=1),
                source=np.full(len(sightings), "detector"),
                velocity_mps=sightings.velocity_mps,
            )
        )
        truth = np.stack(places(world.camera, np.random.default_rng(83), 60), axis=1)
        pixel = world.camera.project(*truth.T, np.full(60, margin[1]))
        pixel[:, 1] += margin[0]
        found = model.predict(boxes_of(pixel), source="somebody")
        off[told.unseen_px] = np.nanmedian(np.hypot(*(found - truth).T))
        # One box at a time goes another way.
        single = model.predict(boxes_of(pixel[:1]), source="somebody")
        np.testing.assert_allclose(single[0], found[0], rtol=1e-6)
    assert off[2.0] < 0.5 * off[0.0]


def test_boxes_of_one_moment_are_of_one_place() -> None:
    """The same boxes once more, under another name, tell nothing new of the camera."""
    world = plant(3, recordings=1)
    once = replace(world.sightings, time_s=10.0 * np.arange(len(world.sightings), dtype=float))
    rows = np.tile(np.arange(len(once)), 2)
    twice = once[rows]
    apart = replace(twice, time_s=twice.time_s + 5.0 * (np.arange(len(twice)) >= len(once)))
    # No source has a bias here, so that nothing is to be learned of a second one.
    known = CameraPrior(bias_px_sigma=1e-6, bias_m_sigma=1e-6)
    noise = replace(NOISE, correlated_m=0.0)
    sigmas = [
        np.sqrt(
            np.diag(
                fit_camera(
                    s, SIZE, n_sources=1, prior=known, noise=noise, settings=QUICK
                ).covariance
            )[CAMERA]
        )
        for s in (once, twice, apart)
    ]
    np.testing.assert_allclose(sigmas[1], sigmas[0], rtol=0.03)
    # Five seconds later they would.
    assert (sigmas[2] < 0.9 * sigmas[0]).sum() >= 4


# Of these boxes nothing is to be learned but the camera.
JUST_THE_CAMERA = CameraPrior(
    bias_px_sigma=0.05,
    bias_m_sigma=0.01,
    half_length_m=(0.0, 0.05),
    half_beam_m=(0.0, 0.05),
    principal_sigma_widths=1e-4,
    curvature=(0.0, 1e-3),
)


def plant_still(seed: int, recordings: int) -> World:
    """Boxes of points that lie still, ten recordings or so."""
    world = plant(
        seed,
        recordings=recordings,
        hull_m=np.zeros(2),
        bias=np.zeros((1, 2)),
        clock_s=np.zeros(recordings),
    )
    still = np.zeros_like(world.sightings.velocity_mps)
    return replace(world, sightings=replace(world.sightings, velocity_mps=still))


@pytest.mark.parametrize("alike_px", [0.0, 4.0])
def test_boxes_that_err_alike_within_a_recording_tell_less(alike_px: float) -> None:
    """Whoever drew a recording drew all of it too low or too high; the stated error answers."""
    # What is held is off by nothing.
    count, total = NORTH + 1, 0.0
    for seed in range(12):
        world = plant_still(seed, recordings=10)
        pixel = world.sightings.pixel_px.copy()
        alike = np.random.default_rng([seed, 101]).normal(0.0, alike_px, 10)
        pixel[:, 1] += alike[world.sightings.group]
        fit = fit_camera(
            replace(world.sightings, pixel_px=pixel),
            SIZE,
            n_sources=1,
            prior=JUST_THE_CAMERA,
            settings=QUICK,
        )
        off = difference(fit, world.camera)[:count]
        total += squared(off, fit.covariance[:count, :count])
    low, high = chi2.ppf([0.005, 0.995], 12 * count)
    assert low < total < high


def test_the_same_boxes_again_in_the_same_recording_tell_nothing_new() -> None:
    """Two boxes a recording whose errors are the same are one."""
    world = plant_still(3, recordings=1)
    each = np.arange(len(world.sightings))
    once = replace(world.sightings, group=each, log=each)
    twice = once[np.tile(each, 2)]
    others = np.arange(len(twice))
    sigmas = [
        np.sqrt(
            np.diag(
                fit_camera(
                    sightings,
                    SIZE,
                    n_sources=1,
                    prior=JUST_THE_CAMERA,
                    noise=replace(NOISE, correlated_m=0.0),
                    settings=QUICK,
                ).covariance
            )[: NORTH + 1]
        )
        for sightings in (once, twice, replace(twice, group=others, log=others))
    ]
    np.testing.assert_allclose(sigmas[1], sigmas[0], rtol=0.03)
    # In recordings of their own they would.
    assert (sigmas[2] < 0.93 * sigmas[0]).all()


@pytest.mark.parametrize("off_px", [-7.0, 7.0])
def test_a_source_that_nobody_knows_may_be_further_off_than_those_that_draw_well(
    off_px: float,
) -> None:
    """Of people who end their boxes at the water one learns nothing of a detector's bias."""
    careful = SourcePrior(bias_px=(0.0, 0.3), bias_m=(0.0, 0.03))
    accurate = PixelNoise(row_px=1.0, row_m=0.05, column_px=2.0, place_m=0.1)
    held = []
    for seed in range(4):
        world = plant(
            seed,
            sources=2,
            hull_m=np.zeros(2),
            bias=np.zeros((2, 2)),
            clock_s=np.zeros(5),
            noise=accurate,
        )
        sightings = world.sightings
        model = CameraRegressor(
            SIZE, residual=False, source_priors={"one": careful, "other": careful}, starts=2
        ).fit_observations(
            CameraObservations(
                boxes_of(sightings.pixel_px),
                np.stack([sightings.east_m, sightings.north_m], axis=1),
                source=np.array(["one", "other"])[sightings.source],
            )
        )
        truth = np.stack(places(world.camera, np.random.default_rng([seed, 79]), 60), axis=1)
        pixel = world.camera.project(*truth.T)
        pixel[:, 1] += off_px
        found, covariance = model.predict(boxes_of(pixel), source="detector", return_cov=True)
        held += [
            squared(*one) < chi2.ppf(0.95, 2) for one in zip(found - truth, covariance, strict=True)
        ]
    assert np.mean(held) > 0.94


def test_the_residual_is_of_places_by_clocks_that_were_put_right(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Most targets go east, and all clocks are late: that must not become a bias of the place."""
    # There is nothing to learn here, and a process that learns nothing would be dropped.
    monkeypatch.setattr(ResidualProcess, "gain", lambda _: (1.0, 0.0))
    for seed in range(4):
        bow = np.radians(90.0) + np.random.default_rng([seed, 103]).normal(0.0, 1.05, 150)
        world = plant(
            seed,
            recordings=4,
            clock_s=np.full(4, 1.5),
            hull_m=np.zeros(2),
            bias=np.zeros((1, 2)),
            bow_rad=bow,
            speed_mps=6.0,
        )
        seen = world.sightings
        model = CameraRegressor(
            SIZE, prior=CameraPrior(clock_sigma_s=3.0), starts=2
        ).fit_observations(
            CameraObservations(
                boxes_of(seen.pixel_px),
                np.stack([seen.east_m, seen.north_m], axis=1),
                velocity_mps=seen.velocity_mps,
                recording=seen.group,
            )
        )
        assert model.range_process_ is not None
        truth = np.stack(places(world.camera, np.random.default_rng([seed, 79]), 100), axis=1)
        off = model.predict(boxes_of(world.camera.project(*truth.T))) - truth
        assert np.nanmedian(np.hypot(*off.T)) < 0.5


def test_logs_of_something_further_away_do_not_become_a_habit_of_the_place() -> None:
    """A dozen logs in a corner are of another vessel, behind the one that is seen there."""
    camera = replace(AHEAD, height_m=2.5)
    accurate = PixelNoise(row_px=1.0, row_m=0.02, column_px=2.0, place_m=0.3)
    for seed in range(4):
        rng = np.random.default_rng([seed, 11])
        distance = np.exp(rng.uniform(np.log(25.0), np.log(250.0), 250))
        bearing = np.radians(rng.uniform(-30.0, 30.0, 250))
        seen = plant(
            seed,
            recordings=6,
            camera=camera,
            at=(distance * np.sin(bearing), distance * np.cos(bearing)),
            hull_m=np.zeros(2),
            bias=np.zeros((1, 2)),
            clock_s=np.zeros(6),
            noise=accurate,
        ).sightings
        logged = np.stack([seen.east_m, seen.north_m], axis=1)
        corner = np.flatnonzero((bearing < np.radians(-8.0)) & (distance > 140.0))
        logged[corner[:12]] *= 2.2
        bearing, distance = np.radians(rng.uniform(-30, -8, 200)), rng.uniform(140, 250, 200)
        pixel = camera.project(distance * np.sin(bearing), distance * np.cos(bearing))
        off = []
        for residual in (False, True):
            model = CameraRegressor(SIZE, residual=residual, prior=JUST_THE_CAMERA, starts=2)
            model.fit_observations(
                CameraObservations(boxes_of(seen.pixel_px), logged, recording=seen.group)
            )
            found = np.hypot(*model.predict(boxes_of(pixel)).T)
            off.append(np.nanmedian(np.abs(np.log(found / distance))))
        # A tenth of the range is what these logs turn the camera by; more is the residual's.
        assert off[1] < 1.2 * off[0] < 0.12


def problem_of(world: World, *, position_known: bool) -> MixedModel:
    return MixedModel(world.sightings, SIZE, 1, CameraPrior(), position_known, None)


def test_a_camera_whose_place_is_unknown_is_sought_all_around_the_targets() -> None:
    world = plant(3)
    problem = problem_of(world, position_known=False)
    count = 12
    starts = problem.starts(count, np.random.default_rng(0))
    log = np.stack([world.sightings.east_m, world.sightings.north_m], axis=1)
    away = np.array([start[POSITION] for start in starts]) - log.mean(axis=0)
    spread = np.sqrt(np.mean(np.sum((log - log.mean(axis=0)) ** 2, axis=1)))
    times_spread = np.hypot(*away.T) / spread
    # Never among the targets, and not out of sight of them.
    assert (times_spread >= 1.0 - 1e-9).all()
    assert (times_spread <= np.exp(1.6) + 1e-9).all()
    sector = np.floor(np.arctan2(away[:, 0], away[:, 1]) % (2.0 * np.pi) / (2.0 * np.pi) * count)
    assert sorted(sector.astype(int).tolist()) == list(range(count))
    # Each looks at them: the middle of the targets is within a right angle of its axis.
    for start, offset in zip(starts, away, strict=True):
        axis = np.array([np.sin(start[HEADING]), np.cos(start[HEADING])])
        assert axis @ -offset > 0.0


@pytest.mark.parametrize(("turned_deg", "ahead"), [(0.0, True), (180.0, False)])
def test_a_camera_with_its_back_to_most_targets_is_no_solution(
    turned_deg: float, ahead: bool
) -> None:
    world = plant(5)
    problem = problem_of(world, position_known=True)
    vector = problem.mean.copy()
    vector[CAMERA] = world.camera.to_vector()
    vector[HEADING] += np.radians(turned_deg)
    # By hand: the share of the targets on the side of the optical axis.
    axis = np.sin(vector[HEADING]), np.cos(vector[HEADING])
    forward = axis[0] * (world.sightings.east_m - world.camera.east_m) + axis[1] * (
        world.sightings.north_m - world.camera.north_m
    )
    assert (np.mean(forward > 0.0) > 0.9) == ahead
    assert problem.ahead(vector) == ahead


def test_the_first_start_looks_where_the_camera_looked() -> None:
    prior = CameraPrior()
    camera = replace(
        draw_camera(np.random.default_rng(2)),
        focal_px=prior.focal_widths * SIZE[0],
        pitch_deg=3.0,
        roll_deg=0.0,
        k1=0.0,
        k2=0.0,
        east_m=0.0,
        north_m=0.0,
    )
    world = plant(2, camera=camera, hull_m=np.zeros(2), clock_s=np.zeros(5))
    (start,) = problem_of(world, position_known=True).starts(1, np.random.default_rng(0))
    # A level camera would be right to the arc second; a pitch of three degrees costs little.
    off_deg = np.degrees(start[HEADING]) - camera.heading_deg
    assert abs((off_deg + 180.0) % 360.0 - 180.0) < 1.0
