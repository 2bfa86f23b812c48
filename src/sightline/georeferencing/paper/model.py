"""The paper's five models as it uses them: from box centres to distances from the camera."""

from __future__ import annotations

from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.utils.validation import check_is_fitted

from sightline.errors import FitError, InputError, ModelFileError, unknown_name
from sightline.georeferencing.paper.estimator import (
    Arrays,
    CovarianceRegressor,
    Settings,
    with_covariance,
)
from sightline.georeferencing.paper.gaussian_process import GaussianProcessRegression
from sightline.georeferencing.paper.neural import NeuralNetworkRegression
from sightline.georeferencing.paper.quadratic import QuadraticKernelRegression
from sightline.georeferencing.paper.two_layer import TwoLayerRegressor
from sightline.georeferencing.placement import Placement
from sightline.types import FloatArray, StrArray, check_boxes

PAPER_MODELS = ("nn", "gpr", "qkr", "qkr+nn", "qkr+gpr")
"""The names that `paper_model` knows."""

FEWEST_PAIRS = 7
"""A quadratic in two features has six coefficients; one pair more tells how well they fit."""


class PaperModel:
    """One of the paper's estimators between pixels and metres (section 4.2).

    The estimator sees the middle of a box divided by the image's width and height, origin at the
    upper left, and learns the distances east and north of the camera, each divided by its largest
    absolute value among the pairs of the fit.

    Args:
        name: One of `PAPER_MODELS`.
        seed: Of the neural network's first weights; the others have no use for it.

    Attributes:
        name: As given.
        estimator: The scikit-learn estimator, which works on normalised data.

    Raises:
        InputError: The name is not known.
    """

    def __init__(self, name: str, *, seed: int = 0) -> None:
        self.name = name
        self.estimator = _estimator(name, seed)

    def fit(
        self,
        boxes_xyxy_px: ArrayLike,
        east_north_m: ArrayLike,
        *,
        image_size_px: tuple[int, int],
    ) -> Self:
        """Fit to correspondences.

        Args:
            boxes_xyxy_px: (N, 4) pixels.
            east_north_m: (N, 2) metres east and north of the camera.
            image_size_px: Width and height.

        Raises:
            InputError: A box is none, a place is not finite, or the shapes do not fit.
            FitError: There are fewer than `FEWEST_PAIRS` pairs, or all boxes have one middle.
        """
        boxes = _checked_boxes(boxes_xyxy_px)
        places = np.asarray(east_north_m, dtype=np.float64)
        if places.shape != (len(boxes), 2):
            raise InputError(
                f"{len(boxes)} boxes need places of the shape ({len(boxes)}, 2), "
                f"metres east and north; these have {places.shape}"
            )
        if not np.isfinite(places).all():
            i = int(np.argmin(np.isfinite(places).all(axis=1)))
            raise InputError(f"pair {i + 1}: the place is not a number; leave such pairs out")
        if min(image_size_px) <= 0:
            raise InputError(
                f"image size {image_size_px[0]} x {image_size_px[1]} px: both must be positive"
            )
        if len(boxes) < FEWEST_PAIRS:
            raise FitError(
                f"{self.name} needs at least {FEWEST_PAIRS} boxes with a place, not {len(boxes)}; "
                "add boxes, or fixes at their times"
            )
        self._image_size_px = (int(image_size_px[0]), int(image_size_px[1]))
        centres = self._normalised_centres(boxes)
        if (np.ptp(centres, axis=0) == 0.0).all():
            raise FitError(
                f"all {len(boxes)} boxes have the same middle; "
                "a model needs boxes from different parts of the image"
            )
        if (np.ptp(places, axis=0) == 0.0).all():
            raise FitError(
                f"all {len(boxes)} fixes lie in one place; a model needs a target that moves"
            )
        largest = np.abs(places).max(axis=0)
        self._distance_scale_m = np.where(largest > 0.0, largest, 1.0)
        self.estimator.fit(centres, places / self._distance_scale_m)
        return self

    def predict(self, boxes_xyxy_px: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Positions of boxes.

        Args:
            boxes_xyxy_px: (N, 4) pixels.

        Returns:
            (N, 2) metres east and north of the camera, and their (N, 2, 2) covariances, square
            metres.

        Raises:
            InputError: A box is none.
            NotFittedError: The model has not been fitted.
        """
        check_is_fitted(self.estimator)
        boxes = _checked_boxes(boxes_xyxy_px)
        if len(boxes) == 0:
            return np.empty((0, 2)), np.empty((0, 2, 2))
        normalised, covariance = with_covariance(self.estimator, self._normalised_centres(boxes))
        scale = self._distance_scale_m
        return normalised * scale, covariance * np.outer(scale, scale)

    camera = None
    """The paper's models go from a box to a place, and know of no camera."""
    camera_fit = None
    reference_sigma_m = 0.0
    """They do not tell a log's correlated error from a box's."""

    def locate(
        self, boxes_xyxy_px: FloatArray, source: StrArray | None, above_m: FloatArray
    ) -> Placement:
        """As `predict`; sources and water levels are ignored."""
        del source, above_m
        return Placement(*self.predict(boxes_xyxy_px))

    def state(self) -> tuple[Arrays, Settings]:
        """State that `from_state` restores: arrays, and the rest as JSON can hold it."""
        check_is_fitted(self.estimator)
        arrays, settings = self.estimator.state()
        return (
            {**arrays, "distance_scale_m": self._distance_scale_m},
            {
                "name": self.name,
                "image_size_px": list(self._image_size_px),
                "estimator": settings,
            },
        )

    @classmethod
    def from_state(cls, arrays: Arrays, settings: Settings) -> Self:
        """Restore the model from its `state`.

        Raises:
            ModelFileError: Something is missing or does not fit together.
        """
        try:
            model = cls(settings["name"])
            width, height = settings["image_size_px"]
            model._image_size_px = (int(width), int(height))
            model._distance_scale_m = np.array(arrays["distance_scale_m"])
            model.estimator = type(model.estimator).from_state(arrays, settings["estimator"])
            # A box in the middle goes through all that was stored.
            model.predict([[0.0, 0.0, width, height]])
        except (LookupError, TypeError, ValueError, ArithmeticError, InputError) as error:
            raise ModelFileError(
                f"the stored model is damaged or of another kind ({error}); fit it again"
            ) from error
        return model

    def _normalised_centres(self, boxes_xyxy_px: FloatArray) -> FloatArray:
        return (boxes_xyxy_px[:, :2] + boxes_xyxy_px[:, 2:]) / 2.0 / self._image_size_px


def paper_model(name: str, *, seed: int = 0) -> PaperModel:
    """An unfitted model by the paper's name for it.

    Args:
        name: One of `PAPER_MODELS`.
        seed: Of whatever is random in it.

    Raises:
        InputError: The name is not known; the message lists those that are.
    """
    return PaperModel(name, seed=seed)


def _estimator(name: str, seed: int) -> CovarianceRegressor:
    match name:
        case "nn":
            return NeuralNetworkRegression(random_state=seed)
        case "gpr":
            return GaussianProcessRegression()
        case "qkr":
            return QuadraticKernelRegression()
        case "qkr+nn":
            return TwoLayerRegressor(_estimator("qkr", seed), _estimator("nn", seed))
        case "qkr+gpr":
            return TwoLayerRegressor(_estimator("qkr", seed), _estimator("gpr", seed))
    raise unknown_name("model", name, PAPER_MODELS)


def _checked_boxes(boxes_xyxy_px: ArrayLike) -> FloatArray:
    boxes = np.asarray(boxes_xyxy_px, dtype=np.float64)
    if boxes.size == 0:
        boxes = boxes.reshape(0, 4)
    if boxes.ndim != 2 or boxes.shape[1] != 4:
        raise InputError(
            f"boxes must have the shape (N, 4), x1, y1, x2, y2; these have {boxes.shape}"
        )
    check_boxes(boxes)
    return boxes
