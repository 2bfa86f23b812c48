"""A camera that stands still over water that rises and falls."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sightline
from sightline import Georeferencer, Scene
from sightline.camera.pinhole import EARTH_RADIUS_M
from sightline.errors import InputError
from sightline.formats import write_boxes, write_fixes
from sightline.georeferencing.camera_regressor import CameraRegressor
from sightline.pipeline.evaluate import place_boxes, score
from sightline.pipeline.fit_unlabelled import update_scene
from sightline.simulation import BoxNoise, Harbour, HarbourSettings, ReceiverNoise, SimulatedCamera
from sightline.types import NO_TRACK

DATUM_M = 31.0
"""A datum may be anything: an ellipsoid's is far from the water."""
ABOVE_DATUM_M = 36.2
CAMERA = SimulatedCamera(
    height_m=5.0,
    pitch_deg=4.0,
    roll_deg=0.6,
    heading_deg=30.0,
    focal_length_px=950.0,
    k1=-0.1,
    k2=0.01,
)
LEVELS_M = {"ebb": DATUM_M - 0.6, "flood": DATUM_M + 1.4, "half": DATUM_M + 0.3}


def harbour_at(level_m: float, seed: int) -> Harbour:
    """A harbour as the camera sees it when the water stands at a level."""
    camera = replace(CAMERA, height_m=ABOVE_DATUM_M - level_m)
    start_utc_s = 1_717_236_000.0 + 7200.0 * seed
    return Harbour.random(
        seed, HarbourSettings(duration_s=120.0, camera=camera, start_utc_s=start_utc_s, gulls=0)
    )


def write_scene(
    folder: Path,
    levels_m: dict[str, float],
    *,
    told: bool = True,
    seed: int = 40,
    drawn: bool = True,
) -> Scene:
    """A scene of the target's boxes, or of detections of all that is in view."""
    folder.mkdir()
    lines: list[str] = []
    for i, (name, level_m) in enumerate(levels_m.items()):
        harbour = harbour_at(level_m, seed + i)
        noise = BoxNoise(std_px=1.0, source="me")
        if drawn:
            boxes = harbour.boxes(harbour.times(0.5), noise=noise, seed=seed + i)
        else:
            boxes = harbour.boxes(harbour.times(2.0), noise=noise, seed=seed + i, of="all")
            boxes = boxes.with_columns(track_id=np.full(len(boxes), NO_TRACK))
        write_boxes(boxes, folder / f"{name}.csv")
        write_fixes(
            harbour.fixes(ReceiverNoise(std_m=1.0), seed=seed + i), folder / f"{name}-log.csv"
        )
        kind = "boxes" if drawn else "detections"
        lines += ["[[recordings]]", f'name = "{name}"', f'{kind} = "{name}.csv"']
        lines += [f'fixes = "{name}-log.csv"'] + [f"water_level_m = {level_m}"] * told
    site = [
        "[camera]",
        f"latitude_deg = {harbour.plane.latitude_deg}",
        f"longitude_deg = {harbour.plane.longitude_deg}",
        "image_size_px = [1280, 720]",
    ]
    (folder / "scene.toml").write_text("\n".join(site + lines), encoding="utf-8")
    return Scene.load(folder / "scene.toml")


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return write_scene(tmp_path_factory.mktemp("tide") / "learned", LEVELS_M)


@pytest.fixture(scope="module")
def model(learned: Scene) -> Georeferencer:
    return sightline.fit(learned, "camera")


@pytest.fixture(scope="module")
def later(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Another day, with the water higher than it ever was in the fit."""
    levels_m = {"spring": DATUM_M + 2.0, "neap": DATUM_M - 0.9}
    return write_scene(tmp_path_factory.mktemp("tide") / "later", levels_m, seed=60)


@pytest.mark.slow
def test_the_height_is_that_over_the_levels_and_any_datum_will_do(model: Georeferencer) -> None:
    camera = model.camera
    assert camera is not None
    assert model.water_level_m is not None
    assert model.water_level_m == pytest.approx(DATUM_M + 0.3, abs=1.0)
    assert camera.height_m + model.water_level_m == pytest.approx(ABOVE_DATUM_M, abs=0.25)
    assert camera.focal_px == pytest.approx(CAMERA.focal_length_px, rel=0.05)
    assert camera.pitch_deg == pytest.approx(CAMERA.pitch_deg, abs=0.3)


@pytest.mark.slow
def test_places_hold_at_levels_that_were_never_seen(
    model: Georeferencer, learned: Scene, later: Scene, tmp_path: Path
) -> None:
    told = score(place_boxes(later, lambda _: model))
    blind = write_scene(tmp_path / "blind", LEVELS_M, told=False)
    still = sightline.fit(blind, "camera")
    untold = replace(
        later, recordings=tuple(replace(r, water_level_m=None) for r in later.recordings)
    )
    without = score(place_boxes(untold, lambda _: still))
    assert told.ape.rmse < 0.5 * without.ape.rmse
    assert told.coverage.p95 >= 0.9
    for name in ("spring", "neap"):
        assert told.recordings[name].ape.per_range < 0.04


def test_a_level_moves_places_as_the_geometry_says(model: Georeferencer) -> None:
    """With a place at the height h over the water r is r(h) times (h - level) / h."""
    camera, regressor = model.camera, model.regressor
    assert camera is not None
    assert isinstance(regressor, CameraRegressor)
    regressor = CameraRegressor.from_state(*regressor.state())
    regressor.half_m = np.zeros(2)
    regressor.camera_ = camera = replace(camera, curvature=0.0)
    boxes = np.array([[600.0, 420.0, 640.0, 440.0], [200.0, 500.0, 300.0, 560.0]])
    bias_m = regressor.bias("me")[0][1]
    at = np.hypot(*(regressor.predict(boxes) - (camera.east_m, camera.north_m)).T)
    for above_m in (-0.7, 0.9):
        places = regressor.predict(boxes, above_m=above_m) - (camera.east_m, camera.north_m)
        share = (camera.height_m - bias_m - above_m) / (camera.height_m - bias_m)
        np.testing.assert_allclose(np.hypot(*places.T), at * share, rtol=1e-9)


def test_the_residual_is_of_places_on_the_water_as_it_stood(
    model: Georeferencer, learned: Scene, later: Scene
) -> None:
    """Nothing of the tide is left for it to learn: with it places are as sure as without."""
    fitted = sightline.fit(learned, "camera+gpr")
    camera = fitted.camera
    assert camera is not None
    assert isinstance(fitted.regressor, CameraRegressor)
    assert fitted.regressor.range_process_ is not None
    told = score(place_boxes(later, lambda _: fitted))
    assert told.coverage.p95 >= 0.9
    for name in ("spring", "neap"):
        assert told.recordings[name].ape.per_range < 0.04
    boxes = later["spring"].boxes()
    levels_m = (DATUM_M + 1.0, DATUM_M + 2.0)
    near, far = (
        np.hypot(found.east_m - camera.east_m, found.north_m - camera.north_m)
        for level_m in levels_m
        for found in [fitted.locate(boxes.xyxy_px, boxes.source, level_m)]
    )
    share = (ABOVE_DATUM_M - levels_m[1]) / (ABOVE_DATUM_M - levels_m[0])
    np.testing.assert_allclose(far / near, share, rtol=0.025)
    sizes = [
        np.trace(
            one.locate(boxes.xyxy_px, boxes.source, levels_m[1]).covariance_m2, axis1=1, axis2=2
        )
        for one in (model, fitted)
    ]
    assert np.nanmedian(np.sqrt(sizes[1] / sizes[0])) < 1.4


@pytest.mark.parametrize("name", ["camera", "camera+gpr"])
def test_one_box_and_many_and_each_at_its_own_level_agree(learned: Scene, name: str) -> None:
    fitted = sightline.fit(learned, name)
    boxes = learned["ebb"].boxes()
    sources = boxes.source.copy()
    sources[::3] = "somebody else"
    levels_m = DATUM_M + np.linspace(-1.0, 2.0, len(boxes))
    many = fitted.locate(boxes.xyxy_px, sources, levels_m)
    alone = [
        fitted.locate(box, str(source), level_m)
        for box, source, level_m in zip(boxes.xyxy_px, sources, levels_m, strict=True)
    ]
    alike = fitted.locate(boxes.xyxy_px, "me", DATUM_M + 0.5)
    spread = fitted.locate(boxes.xyxy_px, "me", np.full(len(boxes), DATUM_M + 0.5))
    for column in ("east_m", "north_m", "covariance_m2", "shared_covariance_m2"):
        one_by_one = np.concatenate([getattr(one, column) for one in alone])
        # The variance of the residual process is computed in single precision.
        rtol = 1e-6 if "covariance" in column else 1e-7
        np.testing.assert_allclose(one_by_one, getattr(many, column), rtol=rtol, atol=1e-9)
        np.testing.assert_allclose(getattr(spread, column), getattr(alike, column), rtol=1e-12)


def test_what_is_not_known_of_the_level_is_in_the_ellipse(model: Georeferencer) -> None:
    """A tenth of a metre of water is r / h of range; it is common to all boxes of a target."""
    regressor = model.regressor
    assert isinstance(regressor, CameraRegressor)
    assert model.camera is not None
    certain = CameraRegressor.from_state(*regressor.state())
    certain.above_sigma_m = 0.0
    regressor = CameraRegressor.from_state(*regressor.state())
    for one in (regressor, certain):
        one.half_m = np.zeros(2)
    box = np.array([[600.0, 420.0, 640.0, 440.0], [600.0, 421.0, 640.0, 441.0]])
    places, unsure, unsure_shared = regressor.predict(box, return_shared=True)
    _, sure, sure_shared = certain.predict(box, return_shared=True)
    away = places - (model.camera.east_m, model.camera.north_m)
    range_m = np.hypot(*away.T)
    bias_m = regressor.bias("me")[0][1]
    for wide, narrow in ((unsure, sure), (unsure_shared, sure_shared)):
        added = np.trace(wide - narrow, axis1=1, axis2=2)
        dip_m = model.camera.curvature * range_m**2 / (2.0 * EARTH_RADIUS_M)
        expected = (0.1 * range_m / (model.camera.height_m - bias_m - dip_m)) ** 2
        np.testing.assert_allclose(added, expected, rtol=1e-6)


def test_a_model_keeps_its_level(model: Georeferencer, tmp_path: Path) -> None:
    again = sightline.load(model.save(tmp_path / "tide.model"))
    assert again.water_level_m == model.water_level_m
    box = [[600.0, 420.0, 640.0, 440.0]]
    for one, other in ((model, again),):
        np.testing.assert_array_equal(
            other.locate(box, "me", DATUM_M).covariance_m2,
            one.locate(box, "me", DATUM_M).covariance_m2,
        )


def test_a_new_day_improves_a_model_over_the_same_datum(model: Georeferencer, later: Scene) -> None:
    newer = update_scene(later, model)
    assert newer.water_level_m == model.water_level_m
    assert newer.camera is not None
    assert newer.water_level_m is not None
    assert newer.camera.height_m + newer.water_level_m == pytest.approx(ABOVE_DATUM_M, abs=0.25)
    assert "stands as it did" in newer.report.statements[0]


@pytest.mark.slow
def test_vessels_are_recognised_at_all_levels(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "told", LEVELS_M, seed=70, drawn=False)
    found = sightline.fit(scene, "camera", detector=None)
    assert found.camera is not None
    assert found.water_level_m is not None
    assert set(found.report.recordings) == set(LEVELS_M)
    assert found.camera.height_m + found.water_level_m == pytest.approx(ABOVE_DATUM_M, abs=0.25)
    blind = write_scene(tmp_path / "blind", LEVELS_M, seed=70, drawn=False, told=False)
    without = sightline.fit(blind, "camera", detector=None)
    assert found.report.rmse_m < 0.5 * without.report.rmse_m


def test_tracks_need_a_level_and_follow_it(
    model: Georeferencer, later: Scene, tmp_path: Path
) -> None:
    recording = later["spring"]
    boxes = recording.boxes()
    with pytest.raises(InputError, match="say how high the water stands"):
        sightline.track(boxes, model)
    table = tmp_path / "tide.csv"
    first, last = boxes.time_utc_s[[0, -1]]
    table.write_text(
        f"time_utc,water_level_m\n{first},{DATUM_M + 2.0}\n{last},{DATUM_M + 2.0}\n",
        encoding="utf-8",
    )
    by_number = sightline.track(boxes, model, water_levels=DATUM_M + 2.0)
    by_table = sightline.track(boxes, model, water_levels=table)
    report = sightline.evaluate(by_number, fixes=recording.fixes())
    assert report.ape.per_range < 0.04
    for one, other in zip(by_number, by_table, strict=True):
        np.testing.assert_allclose(one.latitude_deg, other.latitude_deg, atol=1e-9)


def test_what_does_not_fit_together_is_refused(
    model: Georeferencer, learned: Scene, later: Scene, tmp_path: Path
) -> None:
    box = [[600.0, 420.0, 640.0, 440.0]]
    with pytest.raises(InputError, match="is not below the camera, which is at 36"):
        model.locate(box, water_level_m=ABOVE_DATUM_M + 1.0)
    with pytest.raises(InputError, match="say how high the water stands"):
        model.locate(box)
    blind = write_scene(tmp_path / "blind", {"one": DATUM_M}, told=False)
    still = sightline.fit(blind, "camera")
    with pytest.raises(InputError, match="fitted without water levels"):
        still.locate(box, water_level_m=0.0)
    with pytest.raises(InputError, match="recording spring: the model was fitted without"):
        place_boxes(later, lambda _: still)
    with pytest.raises(InputError, match="recording one: the model was fitted to water levels"):
        place_boxes(blind, lambda _: model)
    with pytest.raises(InputError, match="the model was fitted to water levels"):
        update_scene(blind, model)
    mixed = replace(learned, recordings=(*learned.recordings, *blind.recordings))
    with pytest.raises(InputError, match="recording one has no water level, and others have"):
        sightline.fit(mixed, "camera")


@pytest.mark.slow
def test_models_without_a_camera_learn_from_the_boxes_as_they_are(
    learned: Scene, tmp_path: Path
) -> None:
    blind = write_scene(tmp_path / "blind", LEVELS_M, told=False)
    box = [[600.0, 420.0, 640.0, 440.0]]
    told, untold = (sightline.fit(scene, "qkr").locate(box) for scene in (learned, blind))
    np.testing.assert_allclose(told.east_m, untold.east_m)
