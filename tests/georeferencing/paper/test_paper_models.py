from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file
from sklearn.exceptions import NotFittedError

from sightline.errors import FitError, InputError, ModelFileError
from sightline.georeferencing.paper.model import FEWEST_PAIRS, PAPER_MODELS, PaperModel, paper_model

SIZE = (1280, 720)


def pairs(n: int = 60, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Boxes, and places that a quadratic in their normalised middles maps them to."""
    rng = np.random.default_rng(seed)
    centre = rng.uniform([100.0, 350.0], [1180.0, 600.0], (n, 2))
    half = rng.uniform([10.0, 5.0], [60.0, 20.0], (n, 2))
    u, v = (centre / SIZE).T
    east = 40.0 + 150.0 * u - 90.0 * v + 60.0 * u * v
    north = -20.0 + 80.0 * v**2 - 35.0 * u
    return np.hstack([centre - half, centre + half]), np.column_stack([east, north])


@pytest.mark.parametrize("name", PAPER_MODELS)
def test_places_boxes_by_their_middle(name: str) -> None:
    boxes, places = pairs()
    model = paper_model(name).fit(boxes, places, image_size_px=SIZE)
    new_boxes, new_places = pairs(200, seed=2)
    predicted, covariance = model.predict(new_boxes)
    assert predicted.shape == (200, 2)
    assert covariance.shape == (200, 2, 2)
    if name == "nn":  # its penalty bends it a little; the others can be exact
        unexplained = ((predicted - new_places) ** 2).mean(axis=0) / new_places.var(axis=0)
        assert (unexplained < 0.01).all()
    else:
        assert np.hypot(*(predicted - new_places).T).max() < 0.5
    # The size of a box does not matter to the paper's models, only its middle.
    grown = new_boxes + np.array([-5.0, -3.0, 5.0, 3.0])
    np.testing.assert_allclose(model.predict(grown)[0], predicted, atol=1e-6)


@pytest.mark.parametrize("name", PAPER_MODELS)
def test_metres_and_pixels_are_only_a_matter_of_scale(name: str) -> None:
    boxes, places = pairs()
    predicted, covariance = (
        paper_model(name).fit(boxes, places, image_size_px=SIZE).predict(boxes[:9])
    )
    larger, larger_covariance = (
        paper_model(name)
        .fit(2.0 * boxes, 4.0 * places, image_size_px=(2560, 1440))
        .predict(2.0 * boxes[:9])
    )
    np.testing.assert_allclose(larger, 4.0 * predicted, rtol=1e-9)
    np.testing.assert_allclose(larger_covariance, 16.0 * covariance, rtol=1e-6, atol=1e-12)


def test_estimator_sees_normalised_middles_and_distances() -> None:
    boxes, places = pairs()
    model = paper_model("qkr").fit(boxes, places, image_size_px=SIZE)
    middles = np.column_stack(
        [(boxes[:, 0] + boxes[:, 2]) / 2 / 1280, (boxes[:, 1] + boxes[:, 3]) / 2 / 720]
    )
    normalised = model.estimator.predict(middles)
    np.testing.assert_allclose(normalised, places / np.abs(places).max(axis=0), atol=1e-9)
    assert np.abs(normalised).max() == pytest.approx(1.0)


@pytest.mark.parametrize("name", PAPER_MODELS)
def test_a_stored_model_predicts_the_same(name: str, tmp_path: Path) -> None:
    boxes, places = pairs()
    places = places + np.random.default_rng(3).normal(0.0, 2.0, places.shape)
    model = paper_model(name, seed=3).fit(boxes, places, image_size_px=SIZE)
    arrays, settings = model.state()
    save_file(arrays, tmp_path / "model.safetensors")
    again = PaperModel.from_state(
        load_file(tmp_path / "model.safetensors"), json.loads(json.dumps(settings))
    )
    new_boxes, _ = pairs(100, seed=4)
    for one, other in zip(model.predict(new_boxes), again.predict(new_boxes), strict=True):
        np.testing.assert_allclose(other, one, rtol=0.0, atol=1e-10)
    assert again.name == name
    assert {k: a.tolist() for k, a in again.state()[0].items()} == {
        k: a.tolist() for k, a in arrays.items()
    }
    assert again.state()[1] == settings


@pytest.mark.parametrize("name", PAPER_MODELS)
def test_a_damaged_state_is_refused(name: str) -> None:
    boxes, places = pairs()
    arrays, settings = paper_model(name).fit(boxes, places, image_size_px=SIZE).state()
    for missing in arrays:
        with pytest.raises(ModelFileError, match="fit it again"):
            PaperModel.from_state({k: a for k, a in arrays.items() if k != missing}, settings)
    for missing in settings:
        with pytest.raises(ModelFileError, match="fit it again"):
            PaperModel.from_state(arrays, {k: s for k, s in settings.items() if k != missing})
    with pytest.raises(ModelFileError, match="fit it again"):
        PaperModel.from_state({k: a[..., :-1] for k, a in arrays.items() if a.ndim}, settings)


def test_a_state_of_an_unknown_model_is_refused() -> None:
    with pytest.raises(ModelFileError, match="known are nn, gpr, qkr"):
        PaperModel.from_state({}, {"name": "camera", "image_size_px": [1, 1], "estimator": {}})


@pytest.mark.parametrize("name", ["", "QKR", "quadratic", "gpr+qkr", "camera"])
def test_an_unknown_name_lists_the_known(name: str) -> None:
    with pytest.raises(InputError, match=r"known are nn, gpr, qkr, qkr\+nn, qkr\+gpr"):
        paper_model(name)


@pytest.mark.parametrize("name", PAPER_MODELS)
def test_no_boxes_have_no_places(name: str) -> None:
    boxes, places = pairs()
    model = paper_model(name).fit(boxes, places, image_size_px=SIZE)
    predicted, covariance = model.predict(np.empty((0, 4)))
    assert predicted.shape == (0, 2)
    assert covariance.shape == (0, 2, 2)


@pytest.mark.parametrize("name", PAPER_MODELS)
def test_few_pairs_are_enough_and_fewer_are_refused(name: str) -> None:
    boxes, places = pairs(FEWEST_PAIRS)
    model = paper_model(name).fit(boxes, places, image_size_px=SIZE)
    predicted, covariance = model.predict(boxes)
    assert np.isfinite(predicted).all()
    assert np.isfinite(covariance).all()
    with pytest.raises(FitError, match="at least 7 boxes with a place, not 6"):
        paper_model(name).fit(boxes[:-1], places[:-1], image_size_px=SIZE)


def test_boxes_in_one_place_are_refused() -> None:
    boxes, places = pairs()
    with pytest.raises(FitError, match="same middle"):
        paper_model("qkr").fit(np.tile(boxes[:1], (60, 1)), places, image_size_px=SIZE)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda boxes, places: (boxes[:, [2, 1, 0, 3]], places), "reversed"),
        (lambda boxes, places: (np.where(boxes == boxes[3, 1], np.nan, boxes), places), "box 4"),
        (lambda boxes, places: (boxes, np.where(places == places[3], np.nan, places)), "pair 4"),
        (lambda boxes, places: (boxes, places[:-1]), r"shape \(60, 2\)"),
        (lambda boxes, places: (boxes[:, :3], places), r"shape \(N, 4\)"),
    ],
)
def test_bad_pairs_are_refused(spoil, message: str) -> None:
    boxes, places = spoil(*pairs())
    with pytest.raises(InputError, match=message):
        paper_model("qkr").fit(boxes, places, image_size_px=SIZE)


def test_an_image_without_size_is_refused() -> None:
    with pytest.raises(InputError, match="0 x 720"):
        paper_model("qkr").fit(*pairs(), image_size_px=(0, 720))


def test_unfitted_says_so() -> None:
    with pytest.raises(NotFittedError):
        paper_model("qkr+gpr").predict([[0.0, 0.0, 1.0, 1.0]])
    with pytest.raises(NotFittedError):
        paper_model("nn").state()
