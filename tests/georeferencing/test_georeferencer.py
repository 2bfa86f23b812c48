from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sightline
from sightline.errors import FitError, InputError
from sightline.formats import write_fixes
from sightline.georeferencing.correspondences import Correspondences
from sightline.georeferencing.fit import FitInputs, FitSettings, fit
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.georeferencing.support import Support
from sightline.scene import Scene
from sightline.scene.camera_state import scene_static_intervals
from sightline.scene.correspondences import scene_correspondences
from sightline.simulation import BoxNoise, Harbour, HarbourSettings, SimulatedCamera

MODELS_OF_CAMERAS = ("camera", "camera+gpr")


@pytest.fixture(scope="module")
def pairs(small_scene: Scene) -> Correspondences:
    plane = small_scene.plane
    assert plane is not None
    return scene_correspondences(small_scene, plane)


def box_at(*feet: tuple[float, float]) -> np.ndarray:
    """Boxes of an ordinary size with given feet."""
    foot = np.array(feet)
    return np.column_stack([foot[:, 0] - 20, foot[:, 1] - 18, foot[:, 0] + 20, foot[:, 1]])


def learn(model: str, pairs: Correspondences, scene: Scene) -> Georeferencer:
    return fit(
        FitInputs(
            pairs, (1280, 720), scene.control_points, static_intervals=scene_static_intervals(scene)
        ),
        FitSettings(model),
    )


@pytest.mark.parametrize("model", sightline.MODELS)
@pytest.mark.parametrize(
    ("box", "message"),
    [
        ([np.nan, 300.0, 700.0, 400.0], "not a number"),
        ([600.0, 300.0, 700.0, np.inf], "not a number"),
        ([700.0, 300.0, 600.0, 400.0], "reversed"),
        ([600.0, 400.0, 700.0, 300.0], "reversed"),
        ([600.0, 400.0, 700.0, 400.0], "empty"),
    ],
)
def test_boxes_that_are_none_are_refused(
    fitted: Any, model: str, box: list[float], message: str
) -> None:
    with pytest.raises(InputError, match=f"box 2: .*{message}") as caught:
        fitted(model).locate([[600.0, 300.0, 700.0, 400.0], box])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("model", sightline.MODELS)
@pytest.mark.parametrize("nothing", [[], np.empty((0, 4))], ids=["list", "table"])
def test_no_boxes_have_no_positions(fitted: Any, model: str, nothing: Any) -> None:
    positions = fitted(model).locate(nothing)
    assert len(positions) == 0
    assert positions.covariance_m2.shape == (0, 2, 2)
    assert positions.extrapolated.shape == positions.latitude_deg.shape == (0,)
    if model in MODELS_OF_CAMERAS:
        assert fitted(model).locate(nothing, source="first").shared_covariance_m2.shape == (0, 2, 2)


@pytest.mark.parametrize("model", sightline.MODELS)
def test_a_single_box_needs_no_table(fitted: Any, model: str, pairs: Correspondences) -> None:
    box = pairs.boxes.xyxy_px[7]
    one, table = fitted(model).locate(box), fitted(model).locate(box[None])
    assert len(one) == 1
    np.testing.assert_array_equal(one.east_m, table.east_m)
    np.testing.assert_array_equal(one.covariance_m2, table.covariance_m2)
    # It lies about where the log says.
    off = np.hypot(one.east_m[0] - pairs.east_north_m[7, 0], one.north_m - pairs.east_north_m[7, 1])
    assert off[0] < 0.25 * np.hypot(*pairs.east_north_m[7])


@pytest.mark.parametrize("model", sightline.MODELS)
def test_beyond_the_training_boxes_it_says_that_it_extrapolates(
    fitted: Any, model: str, pairs: Correspondences
) -> None:
    boxes = pairs.boxes.xyxy_px
    positions = fitted(model).locate(boxes)
    assert not positions.extrapolated[positions.known].any()
    foot = np.column_stack([0.5 * (boxes[:, 0] + boxes[:, 2]), boxes[:, 3]])
    middle = foot.mean(axis=0)
    inside = box_at((middle[0], middle[1]))
    lowest = foot[:, 1].max()
    outside = box_at((middle[0], lowest + 40.0), (30.0, lowest), (1250.0, lowest + 5.0))
    assert not fitted(model).locate(inside).extrapolated.any()
    assert fitted(model).locate(outside).extrapolated.all()


@pytest.mark.parametrize("model", MODELS_OF_CAMERAS)
def test_above_the_horizon_there_is_no_place(fitted: Any, model: str) -> None:
    georeferencer = fitted(model)
    assert georeferencer.camera is not None
    columns = np.array([200.0, 640.0, 1100.0])
    horizon = georeferencer.camera.horizon_y_px(columns)
    boxes = np.concatenate(
        [box_at(*zip(columns, horizon + off, strict=True)) for off in (-30.0, -3.0, 60.0)]
    )
    positions = georeferencer.locate(boxes, source="first")
    for values in (
        positions.east_m,
        positions.north_m,
        positions.latitude_deg,
        positions.covariance_m2[:, 0, 0],
        positions.shared_covariance_m2[:, 1, 1],
    ):
        np.testing.assert_array_equal(np.isfinite(values), [False] * 6 + [True] * 3)
    assert positions.extrapolated[:6].all()


@pytest.mark.parametrize("model", MODELS_OF_CAMERAS)
def test_a_box_without_a_place_is_beyond_what_was_learned(fitted: Any, model: str) -> None:
    """Control points may reach above the horizon; nothing was learned of boxes there."""
    corners = [(0.0, 0.0), (1280.0, 0.0), (0.0, 720.0), (1280.0, 720.0)]
    georeferencer = replace(fitted(model), support=Support.of(corners, (1280, 720)))
    columns = np.array([200.0, 640.0, 1100.0])
    horizon = georeferencer.camera.horizon_y_px(columns)
    boxes = np.concatenate(
        [box_at(*zip(columns, horizon + off, strict=True)) for off in (-30.0, 0.3, 60.0)]
    )
    together = georeferencer.locate(boxes, source="first")
    np.testing.assert_array_equal(together.known, [False] * 6 + [True] * 3)
    np.testing.assert_array_equal(together.extrapolated, ~together.known)
    alone = [georeferencer.locate(box, source="first").extrapolated[0] for box in boxes]
    np.testing.assert_array_equal(alone, ~together.known)


@pytest.mark.parametrize("model", MODELS_OF_CAMERAS)
def test_a_source_that_nobody_knows_is_less_certain(
    fitted: Any, model: str, pairs: Correspondences
) -> None:
    boxes = pairs.boxes.xyxy_px
    known, unknown = (fitted(model).locate(boxes, source=name) for name in ("first", "somebody"))
    both = known.known & unknown.known
    assert both.mean() > 0.9
    trace = [np.trace(p.covariance_m2[both], axis1=1, axis2=2) for p in (known, unknown)]
    assert (trace[1] > trace[0]).all()
    # A source for each box says the same as one for all.
    names = np.where(np.arange(len(boxes)) % 2 == 0, "first", "somebody")
    mixed = fitted(model).locate(boxes, source=names)
    np.testing.assert_allclose(mixed.east_m[::2], known.east_m[::2], rtol=1e-6)
    np.testing.assert_allclose(mixed.covariance_m2[1::2], unknown.covariance_m2[1::2], rtol=1e-4)


@pytest.mark.parametrize("model", MODELS_OF_CAMERAS)
@pytest.mark.parametrize("source", ["first", "somebody"])
def test_what_moments_share_is_a_part_of_the_whole_covariance(
    fitted: Any, model: str, source: str, pairs: Correspondences
) -> None:
    extremes = box_at((20.0, 500.0), (640.0, 700.0), (1270.0, 460.0))
    positions = fitted(model).locate(np.concatenate([pairs.boxes.xyxy_px, extremes]), source=source)
    whole, shared = (
        matrix[positions.known]
        for matrix in (positions.covariance_m2, positions.shared_covariance_m2)
    )
    size = np.trace(whole, axis1=1, axis2=2)
    assert len(size) > 100
    for part in (whole, shared, whole - shared):
        np.testing.assert_allclose(part, part.swapaxes(1, 2), rtol=1e-12)
        assert (np.linalg.eigvalsh(part)[:, 0] >= -1e-9 * size).all()
    assert (np.trace(whole - shared, axis1=1, axis2=2) > 0.0).all()


@pytest.mark.parametrize("model", MODELS_OF_CAMERAS)
def test_covariances_cover_the_errors_that_truth_shows(
    fitted: Any, small_camera: SimulatedCamera, model: str
) -> None:
    squares = []
    for seed in (77, 78, 79):
        world = Harbour.random(seed, HarbourSettings(duration_s=120.0, camera=small_camera))
        boxes = world.boxes(world.times(1.0), noise=BoxNoise(std_px=1.0))
        truth = world.truth(boxes.time_utc_s)
        found = fitted(model).locate(boxes.xyxy_px, source="first")
        known = found.known
        error = np.column_stack([found.east_m - truth.east_m, found.north_m - truth.north_m])[known]
        solved = np.linalg.solve(found.covariance_m2[known], error[:, :, None])[:, :, 0]
        squares.append(np.sum(error * solved, axis=1))
    square = np.concatenate(squares)
    assert (square < 5.99).mean() >= 0.95
    # Nor are they much longer than need be. They answer for a clock and a log that are off, as
    # none is here, which makes a square of 2, that of two true standard deviations, less than half
    # of it.
    assert np.mean(square) > 0.4


def test_an_unknown_model_lists_the_known(small_scene: Scene) -> None:
    with pytest.raises(InputError, match="unknown model 'oracle'; known are ") as caught:
        sightline.fit(small_scene, "oracle")
    for name in sightline.MODELS:
        assert name in str(caught.value)


@pytest.mark.parametrize("model", sightline.MODELS)
def test_too_few_pairs_are_refused(model: str, pairs: Correspondences, small_scene: Scene) -> None:
    with pytest.raises(FitError, match=r"at least \d") as caught:
        learn(model, pairs[:2], small_scene)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("model", sightline.MODELS)
@pytest.mark.parametrize("still", ["boxes", "fixes", "both"])
def test_a_target_that_stays_in_one_place_is_refused(
    model: str, still: str, pairs: Correspondences, small_scene: Scene
) -> None:
    n = 20
    boxes, places = pairs.boxes[:n], pairs.east_north_m[:n]
    if still != "fixes":
        boxes = boxes.with_columns(xyxy_px=np.tile(boxes.xyxy_px[:1], (n, 1)))
    if still != "boxes":
        places = np.tile(places[:1], (n, 1))
    with pytest.raises(FitError, match=r"one place|same middle") as caught:
        learn(model, replace(pairs[:n], boxes=boxes, east_north_m=places), small_scene)
    assert "\n" not in str(caught.value)


def test_logs_that_do_not_overlap_state_both_spans(small_scene: Scene, tmp_path: Path) -> None:
    folder = small_scene.path.parent
    late = Harbour.random(3, HarbourSettings(duration_s=60.0, start_utc_s=1_717_336_000.0))
    write_fixes(late.fixes(), tmp_path / "late.csv")
    text = small_scene.path.read_text(encoding="utf-8")
    for i in range(2):
        (tmp_path / f"boxes-{i}.csv").write_bytes((folder / f"boxes-{i}.csv").read_bytes())
        text = text.replace(f"fixes-{i}.csv", "late.csv")
    path = tmp_path / "scene.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="does not overlap") as caught:
        sightline.fit(Scene.load(path), "camera")
    message = str(caught.value)
    assert "\n" not in message
    assert "recording first run" in message
    for moment in ("2024-06-01 10:0", "2024-06-02 13:46:40", "2024-06-02 13:47:40"):
        assert moment in message


def test_a_scene_with_nothing_to_learn_from_is_refused(small_scene: Scene, tmp_path: Path) -> None:
    (tmp_path / "boxes.csv").write_bytes((small_scene.path.parent / "boxes-0.csv").read_bytes())
    path = tmp_path / "scene.toml"
    site = "latitude_deg = 54.3\nlongitude_deg = 10.1\nimage_size_px = [1280, 720]\n"
    path.write_text(
        f'[camera]\n{site}[[recordings]]\nname = "silent"\nboxes = "boxes.csv"\n', encoding="utf-8"
    )
    with pytest.raises(FitError, match="no pairs of a box and a fix") as caught:
        sightline.fit(Scene.load(path), "camera")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("model", MODELS_OF_CAMERAS)
@pytest.mark.parametrize("source", [None, "first", "nobody"])
def test_one_box_lies_where_it_lies_among_many(fitted: Any, model: str, source: str | None) -> None:
    """A single box goes a way of its own: the same place, above the horizon none as well."""
    rng = np.random.default_rng(4)
    corner = rng.uniform([-20.0, -20.0], [1290.0, 730.0], (300, 2))
    boxes = np.column_stack([corner, corner + rng.uniform(2.0, 200.0, (300, 2))])
    georeferencer = fitted(model)
    together = georeferencer.locate(boxes, source=source)
    assert 50 < together.known.sum() < 295
    for i in range(len(boxes)):
        one = georeferencer.locate(boxes[i : i + 1], source=source)
        for name in ("east_m", "north_m", "extrapolated"):
            np.testing.assert_allclose(
                getattr(one, name), getattr(together, name)[i : i + 1], rtol=1e-9, atol=1e-9
            )
        size = np.trace(together.covariance_m2[i])
        for name in ("covariance_m2", "shared_covariance_m2"):
            # Of the residual's variance seven digits are kept.
            tolerance = 1e-9 if model == "camera" else 1e-6
            difference = getattr(one, name)[0] - getattr(together, name)[i]
            np.testing.assert_allclose(
                difference / size, np.where(size > 0.0, 0.0, np.nan), atol=tolerance
            )
    named = np.array(["second"])
    np.testing.assert_allclose(
        georeferencer.locate(boxes[:1], source=named).east_m,
        georeferencer.locate(boxes[:2], source="second").east_m[:1],
    )
