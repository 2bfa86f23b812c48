"""A fit is looked at before it is kept: wrong fixes, sparse logs, and stages that fail."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from sightline.camera.calibration import CameraFit
from sightline.camera.mixed_model import MixedModel
from sightline.camera.parameters import HEADING, LOG_FOCAL, LOG_HEIGHT, PITCH
from sightline.camera.priors import PixelNoise
from sightline.errors import FitError
from sightline.formats import write_boxes, write_fixes
from sightline.georeferencing.fit import FitInputs, FitSettings, fit
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.georeferencing.models import BoxModel, Observations
from sightline.georeferencing.paper.estimator import Arrays, Settings
from sightline.georeferencing.placement import Placement
from sightline.georeferencing.stages import Quality
from sightline.scene import Recording, Scene
from sightline.scene.correspondences import collect
from sightline.simulation import BoxNoise, Harbour, HarbourSettings, ReceiverNoise, SimulatedCamera
from sightline.types import BoolArray, Fixes, FloatArray, StrArray

DURATION_S = 200.0
TOLD = (LOG_HEIGHT, PITCH, HEADING, LOG_FOCAL)


@dataclass(frozen=True)
class World:
    """A harbour with a camera, whose boat is drawn twice a second and logs every second."""

    folder: Path
    harbour: Harbour

    @property
    def log(self) -> Fixes:
        return self.harbour.fixes(ReceiverNoise())

    def inputs(self, log: Fixes) -> FitInputs:
        """What a fit learns from with a log that no reader has looked at."""
        scene = Scene.load(self.folder / "scene.toml")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Recording, "fixes", lambda _: log)
            return collect(scene, pictures=False)

    def rmse_m(self, model: Georeferencer) -> float:
        """Of the true places of boxes that were not learned from; infinite without a place."""
        boxes = self.harbour.boxes(self.harbour.times(1.0), noise=BoxNoise(std_px=1.0), seed=1)
        found = model.locate(boxes.xyxy_px, boxes.source)
        truth = self.harbour.truth(boxes.time_utc_s)
        off = np.hypot(found.east_m - truth.east_m, found.north_m - truth.north_m)
        return float(np.sqrt(np.mean(np.nan_to_num(off, nan=np.inf) ** 2)))


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory, small_camera: SimulatedCamera) -> World:
    folder = tmp_path_factory.mktemp("stages")
    harbour = Harbour.random(
        5, HarbourSettings(duration_s=DURATION_S, camera=small_camera, gulls=0)
    )
    boxes = harbour.boxes(harbour.times(2.0), noise=BoxNoise(std_px=1.0, source="drawn"))
    write_boxes(boxes, folder / "boxes.csv")
    write_fixes(harbour.fixes(), folder / "log.csv")
    (folder / "scene.toml").write_text(
        f"""[camera]
latitude_deg = {harbour.plane.latitude_deg}
longitude_deg = {harbour.plane.longitude_deg}
image_size_px = [1280, 720]
[[recordings]]
name = "one"
boxes = "boxes.csv"
fixes = "log.csv"
""",
        encoding="utf-8",
    )
    return World(folder, harbour)


@pytest.fixture(scope="module")
def clean(world: World) -> Georeferencer:
    """The model of a log without faults."""
    return fit(world.inputs(world.log), FitSettings(model="camera"))


def fit_of(model: Georeferencer) -> CameraFit:
    found = model.regressor.camera_fit
    assert found is not None
    return found


def in_sigmas(model: Georeferencer, other: Georeferencer) -> FloatArray:
    """How far two cameras are from one another, in stated standard deviations."""
    one, two = fit_of(model), fit_of(other)
    sigma = np.sqrt(np.diag(two.covariance))
    return np.abs(one.vector - two.vector)[list(TOLD)] / sigma[list(TOLD)]


def moved(log: Fixes, rows: slice, east_m: float, north_m: float, world: World) -> Fixes:
    """A log some of whose fixes are elsewhere."""
    east, north = world.harbour.plane.to_plane(log.latitude_deg, log.longitude_deg)
    east[rows] += east_m
    north[rows] += north_m
    latitude, longitude = world.harbour.plane.to_geographic(east, north)
    return replace(log, latitude_deg=latitude, longitude_deg=longitude)


def seen(log: Fixes, world: World) -> int:
    """Index of a fix that boxes on either side tell of."""
    times = world.harbour.boxes(world.harbour.times(2.0)).time_utc_s
    count = [np.sum(np.abs(times - time) < 1.0) for time in log.time_utc_s]
    full = np.flatnonzero(np.array(count) >= 3)
    return int(full[full.size // 2])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("off_m", "along"), [(15.0, 0.0), (15.0, 1.2), (60.0, 2.6), (300.0, 1.2), (3000.0, 0.0)]
)
def test_one_wrong_fix_does_not_move_the_camera(
    world: World, clean: Georeferencer, off_m: float, along: float
) -> None:
    log = world.log
    at = seen(log, world)
    wrong = moved(log, slice(at, at + 1), off_m * np.sin(along), off_m * np.cos(along), world)
    model = fit(world.inputs(wrong), FitSettings(model="camera"))
    assert (in_sigmas(model, clean) < 2.0).all()
    assert world.rmse_m(model) < 1.1 * world.rmse_m(clean)
    named = [said for said in model.report.statements if "left out" in said]
    when = str(np.datetime64(int(log.time_utc_s[at]), "s")).replace("T", " ")
    assert any(when in said for said in named)
    assert 0.95 * clean.report.n < model.report.n


@pytest.mark.slow
@pytest.mark.parametrize("off_m", [60.0, 3000.0])
def test_two_wrong_fixes_in_a_row_do_not_move_the_camera(
    world: World, clean: Georeferencer, off_m: float
) -> None:
    """They do not leap off and back at once: here the boxes tell."""
    log = world.log
    at = seen(log, world)
    wrong = moved(log, slice(at, at + 2), 0.8 * off_m, -0.6 * off_m, world)
    model = fit(world.inputs(wrong), FitSettings(model="camera"))
    assert (in_sigmas(model, clean) < 2.0).all()
    assert world.rmse_m(model) < 1.1 * world.rmse_m(clean)
    assert any("from where the boxes say" in said for said in model.report.statements)


@pytest.mark.slow
def test_a_stretch_of_a_log_that_is_elsewhere_does_not_move_the_camera(
    world: World, clean: Georeferencer
) -> None:
    log = world.log
    at = seen(log, world)
    model = fit(
        world.inputs(moved(log, slice(at - 8, at + 9), -40.0, 30.0, world)),
        FitSettings(model="camera"),
    )
    assert (in_sigmas(model, clean) < 2.0).all()
    assert any("The fixes from" in said for said in model.report.statements)


def test_of_a_log_without_faults_nothing_is_left_out(world: World, clean: Georeferencer) -> None:
    clean_inputs = world.inputs(world.log)
    inside = np.diff(clean_inputs.correspondences.fix_time_utc_s, axis=1)[:, 0] <= 8.0
    assert clean.report.n >= inside.sum() > 0.85 * clean.report.asked
    assert not any("left out" in said for said in clean.report.statements)


@pytest.mark.slow
@pytest.mark.parametrize(("every", "share"), [(10, 1.2), (30, 1.5)])
def test_a_sparse_log_gives_a_model_near_that_of_the_full_one(
    world: World, clean: Georeferencer, every: int, share: float
) -> None:
    log = world.log
    inputs = world.inputs(log[np.arange(0, len(log), every)])
    assert inputs.correspondences.fix_sigma_m.max() > 1.0
    model = fit(inputs, FitSettings(model="camera"))
    one, two = fit_of(model), fit_of(clean)
    sigma = np.sqrt(np.diag(one.covariance))[list(TOLD)]
    assert (np.abs(one.vector - two.vector)[list(TOLD)] < 2.0 * sigma).all()
    assert world.rmse_m(model) < share * world.rmse_m(clean)
    assert any("gaps of the log" in said for said in model.report.statements)


def test_noise_that_runs_away_is_not_kept(
    world: World, clean: Georeferencer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the log's error is driven to its bound the camera means nothing any more."""
    bound = PixelNoise(row_px=16.0, column_px=30.0, place_m=10.0, correlated_m=16.0)
    bound = replace(bound, correlation_time_s=150.0)
    estimates: list[PixelNoise] = []

    def runs_away(self: MixedModel, found: object, before: PixelNoise) -> PixelNoise:
        estimates.append(before)
        return bound

    def to_nonsense(
        self: MixedModel,
        start: FloatArray,
        noise: PixelNoise,
        left_out: BoolArray | None = None,
    ) -> object:
        found = plain(self, start, noise, left_out)
        if found is not None and noise is bound:
            found.vector[LOG_HEIGHT] -= 1.5
        return found

    plain = MixedModel.refine
    monkeypatch.setattr(MixedModel, "estimate_noise", runs_away)
    monkeypatch.setattr(MixedModel, "refine", to_nonsense)
    model = fit(world.inputs(world.log), FitSettings(model="camera+gpr"))
    assert estimates
    assert world.rmse_m(model) < 1.3 * world.rmse_m(clean)
    assert any("first solution" in said for said in model.report.statements)


def test_a_fit_that_breaks_off_leaves_the_first_solution(
    world: World, clean: Georeferencer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def breaks_off(self: MixedModel, found: object, before: PixelNoise) -> PixelNoise:
        raise np.linalg.LinAlgError("7-th leading minor of the array is not positive definite")

    monkeypatch.setattr(MixedModel, "estimate_noise", breaks_off)
    model = fit(world.inputs(world.log), FitSettings(model="camera+gpr"))
    assert world.rmse_m(model) < 1.3 * world.rmse_m(clean)


@dataclass(frozen=True)
class Placing:
    """A kind of model that places a share of the boxes at one point, and the others nowhere."""

    share: float
    sigma_m: float = 5.0
    name: str = "placing"
    camera: None = None
    camera_fit: None = None
    reference_sigma_m: float = 0.0

    def fit(self, observations: Observations, *, seed: int = 0) -> BoxModel:
        return self

    def load(self, arrays: Arrays, settings: Settings) -> BoxModel:
        return self

    def locate(
        self, boxes_xyxy_px: FloatArray, source: StrArray | None, above_m: FloatArray
    ) -> Placement:
        n = len(boxes_xyxy_px)
        place = np.full((n, 2), 50.0)
        place[round(self.share * n) :] = np.nan
        return Placement(place, np.tile(self.sigma_m**2 * np.eye(2), (n, 1, 1)))

    def state(self) -> tuple[Arrays, Settings]:
        return {}, {}


def test_a_model_that_places_few_of_its_boxes_is_no_success(world: World) -> None:
    inputs = world.inputs(world.log)
    assert np.isfinite(fit(inputs, FitSettings(model=Placing(0.6))).report.rmse_m)
    with pytest.raises(FitError, match="places 40 % of the boxes"):
        fit(inputs, FitSettings(model=Placing(0.4)))
    with pytest.raises(FitError, match="places 0 %"):
        fit(inputs, FitSettings(model=Placing(0.0)))


def test_a_model_with_a_number_that_is_none_is_no_success(world: World) -> None:
    with pytest.raises(FitError, match="not a number"):
        fit(world.inputs(world.log), FitSettings(model=Placing(1.0, sigma_m=np.nan)))


@pytest.mark.parametrize("model", ["camera+gpr", "qkr"])
def test_a_log_with_latitude_and_longitude_swapped_is_told(world: World, model: str) -> None:
    log = world.log
    swapped = replace(log, latitude_deg=log.longitude_deg, longitude_deg=log.latitude_deg)
    with pytest.raises(FitError, match=r"km from the camera.*swapped") as caught:
        fit(world.inputs(swapped), FitSettings(model=model))
    assert "\n" not in str(caught.value)


def quality(change: Callable[[FloatArray], FloatArray]) -> Quality:
    """Of places whose errors of one metre east are changed, in units of a metre."""
    true = np.zeros((40, 2))
    placed = change(np.tile([1.0, 0.0], (40, 1)))
    unit = np.tile(np.eye(2), (40, 1, 1))
    return Quality.of(Placement(placed, unit), true, unit)


def test_a_later_stage_has_to_hold_against_the_first() -> None:
    def gone(places: FloatArray) -> FloatArray:
        return np.where(np.arange(40)[:, None] < 10, np.nan, places)

    first = quality(lambda places: places)
    assert first.success
    assert first.typical == pytest.approx(np.sqrt(0.5))
    assert quality(lambda places: 1.2 * places).holds_against(first)
    assert not quality(lambda places: 2.0 * places).holds_against(first)
    # A quarter without a place is a success for itself, and none after one that places all.
    assert quality(gone).success
    assert not quality(gone).holds_against(first)
    assert quality(gone).holds_against(quality(gone))
