"""How well a fit holds before other cameras: splits, scores, and a homography to compare with.

A split is a folder with two scenes: ``train.toml`` to learn from, and ``test.toml``, whose logs are
the truth at the times of its boxes. Splits whose names differ in ``-seed1``, ``-seed2`` and so on
are one, made anew.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from sightline.camera.calibration import CameraFit
from sightline.camera.parameters import LOG_FOCAL, LOG_HEIGHT
from sightline.camera.pinhole import Camera
from sightline.evaluation.metrics import ScoredPairs, absolute_error, coverage
from sightline.geodesy import LocalPlane
from sightline.georeferencing.camera_regressor import CameraRegressor
from sightline.georeferencing.correspondences import Correspondences
from sightline.georeferencing.fit import FitInputs, FitSettings, fit
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.scene import Scene
from sightline.scene.correspondences import collect, scene_correspondences
from sightline.types import Boxes, ControlPoints, FloatArray

_SEED = re.compile(r"-seed\d+$")
# A point counts as fitting within so many median residuals of the least squares solution.
_RANSAC_MEDIANS = 3.0
_WITHIN = 3.0
_FEWEST = 4

SPEED_BOXES_EACH = 16
SPEED_CAMERA = Camera(8.0, 6.0, 1.0, 20.0, 1200.0, -0.05, 0.0, 0.0, 0.0, (1280, 720))
"""Before which the targets of the speed test pass."""


@dataclass(frozen=True)
class Truth:
    """True height and focal length of a camera.

    Attributes:
        height_m: Above the plane.
        focal_px: Focal length.
    """

    height_m: float
    focal_px: float


@dataclass(frozen=True)
class Score:
    """Places of the single boxes of a split, against the truth.

    Attributes:
        n: How many boxes have a true place.
        rmse_m: Of those that were placed.
        median_m: Of those that were placed.
        covered: Share of them whose truth lies in the stated 95 % ellipse.
        placed: Share of the boxes that have a place.
        fit_s: How long the fit took, seconds.
        homography_m: RMSE of the better homography, all boxes.
    """

    n: int
    rmse_m: float
    median_m: float
    covered: float
    placed: float
    fit_s: float
    homography_m: float


@dataclass(frozen=True)
class Held:
    """How often a parameter lies where a fit says.

    Attributes:
        within: Within three stated standard deviations of the truth, and determined.
        undetermined: Marked as not determined by the data.
        outside: Determined, and further off.
    """

    within: int = 0
    undetermined: int = 0
    outside: int = 0

    def __add__(self, other: Held) -> Held:
        return Held(
            self.within + other.within,
            self.undetermined + other.undetermined,
            self.outside + other.outside,
        )

    def __str__(self) -> str:
        return f"{self.within} / {self.undetermined} / {self.outside}"


def splits(folder: Path) -> dict[str, list[Path]]:
    """By camera and split, the folders of its seeds."""
    out: dict[str, list[Path]] = {}
    for path in sorted(folder.glob("*/*/train.toml")):
        if (path.parent / "test.toml").is_file():
            name = f"{path.parent.parent.name} {_SEED.sub('', path.parent.name)}"
            out.setdefault(name, []).append(path.parent)
    return out


def feet(boxes: Boxes) -> FloatArray:
    """(N, 2) middles of the lower edges, pixels."""
    xyxy = boxes.xyxy_px
    return np.stack([0.5 * (xyxy[:, 0] + xyxy[:, 2]), xyxy[:, 3]], axis=1)


def homography_rmse_m(train: Correspondences, test: Correspondences) -> float:
    """RMSE of OpenCV's homography of feet, metres: least squares or RANSAC, whichever is better.

    The choice is made by the truth that it is scored with, in its favour.
    """
    if len(train) < _FEWEST:
        return float("nan")
    pixel, place = feet(train.boxes), np.asarray(train.east_north_m, dtype=np.float64)

    def off_m(matrix: FloatArray, pairs: Correspondences) -> FloatArray:
        found = cv2.perspectiveTransform(feet(pairs.boxes)[:, None], matrix)[:, 0]
        return np.asarray(np.hypot(*(found - pairs.east_north_m).T))

    least, _ = cv2.findHomography(pixel, place, 0)
    if least is None:
        return float("nan")
    limit_m = _RANSAC_MEDIANS * float(np.median(off_m(least, train)))
    robust, _ = cv2.findHomography(pixel, place, cv2.RANSAC, max(limit_m, 1e-6))
    found = [one for one in (least, robust) if one is not None]
    return min(float(np.sqrt(np.mean(off_m(one, test) ** 2))) for one in found)


def scored(model: Georeferencer, test: Correspondences) -> ScoredPairs:
    """The places of boxes, one by one, beside the true ones; those without a place left out."""
    found = model.locate(test.boxes.xyxy_px, test.boxes.source)
    known = found.known
    return ScoredPairs(
        time_utc_s=test.boxes.time_utc_s[known],
        east_m=found.east_m[known],
        north_m=found.north_m[known],
        covariance_m2=found.covariance_m2[known],
        true_east_m=test.east_north_m[known, 0],
        true_north_m=test.east_north_m[known, 1],
        segment=np.zeros(int(known.sum()), dtype=np.int64),
        asked=len(test),
        without_position=int((~known).sum()),
    )


def score(folder: Path, models: Sequence[str]) -> dict[str, tuple[Score, Georeferencer]]:
    """Fit models to a split's ``train.toml``, and score them on its ``test.toml``.

    Clocks are fitted, but the truth is taken at the times that the test states.

    Args:
        folder: Of the split.
        models: Their names.
    """
    inputs = collect(Scene.load(folder / "train.toml"))
    scene = Scene.load(folder / "test.toml")
    test = scene_correspondences(scene, inputs.correspondences.plane)
    homography_m = homography_rmse_m(inputs.correspondences, test)
    out = {}
    for name in models:
        begin = time.perf_counter()
        model = fit(inputs, FitSettings(model=name))
        fit_s = time.perf_counter() - begin
        pairs = scored(model, test.in_plane(model.plane))
        error = absolute_error(pairs)
        placed = 1.0 - pairs.without_position / len(test)
        out[name] = (
            Score(
                n=len(test),
                rmse_m=error.rmse,
                median_m=error.median,
                covered=coverage(pairs).p95,
                placed=placed,
                fit_s=fit_s,
                homography_m=homography_m,
            ),
            model,
        )
    return out


def camera_fit(model: Georeferencer) -> CameraFit:
    """The fitted camera of a model that has one."""
    assert isinstance(model.regressor, CameraRegressor)
    return model.regressor.camera_fit


def held(found: CameraFit, truth: Truth) -> dict[str, Held]:
    """Whether height and focal length are where the fit says."""
    sigma, determined = np.sqrt(np.diag(found.covariance)), found.determined()
    out = {}
    for name, slot, true in (
        ("height", LOG_HEIGHT, truth.height_m),
        ("focal length", LOG_FOCAL, truth.focal_px),
    ):
        if not determined[slot]:
            out[name] = Held(undetermined=1)
        elif abs(found.vector[slot] - np.log(true)) <= _WITHIN * sigma[slot]:
            out[name] = Held(within=1)
        else:
            out[name] = Held(outside=1)
    return out


def total(parts: Iterable[Mapping[str, Held]]) -> dict[str, Held]:
    """Sums over fits."""
    out: dict[str, Held] = {}
    for part in parts:
        for name, one in part.items():
            out[name] = out.get(name, Held()) + one
    return out


def passing_targets(targets: int, boxes: int, seed: int = 0) -> FitInputs:
    """Targets that pass before `SPEED_CAMERA`, each in a recording of its own.

    Each log is off by half a metre for as long as it lasts, and each box by half a pixel. Targets
    are 4.5 m long and 1.8 m wide within a fifth, and go straight in any direction.

    Args:
        targets: How many.
        boxes: Of all of them together.
        seed: Of all that is random.
    """
    rng = np.random.default_rng(seed)
    camera = SPEED_CAMERA
    each, plane = np.full(targets, boxes // targets), LocalPlane(54.0, 10.0)
    each[: boxes % targets] += 1
    of = np.repeat(np.arange(targets), each)
    since_s = np.concatenate([0.4 * np.arange(count) for count in each])
    bearing = np.radians(camera.heading_deg) + rng.uniform(-0.35, 0.35, targets)
    range_m = np.exp(rng.uniform(np.log(30.0), np.log(120.0), targets))
    course, speed_mps = rng.uniform(0.0, 2.0 * np.pi, targets), rng.uniform(1.0, 4.0, targets)
    velocity = speed_mps[:, None] * np.stack([np.sin(course), np.cos(course)], axis=1)
    middle = range_m[:, None] * np.stack([np.sin(bearing), np.cos(bearing)], axis=1)
    half_s = 0.2 * (each - 1.0)
    true = middle[of] + (since_s - half_s[of])[:, None] * velocity[of]
    size = np.exp(rng.normal(0.0, 0.2, targets))[of]
    distance = np.hypot(*true.T)
    ahead = np.abs(np.sum(true * velocity[of], axis=1)) / (distance * speed_mps[of])
    abeam = np.sqrt(1.0 - np.minimum(ahead, 1.0) ** 2)
    near = 1.0 - size * (2.25 * ahead + 0.9 * abeam) / distance
    foot = camera.project(*(true * near[:, None]).T) + rng.normal(0.0, 0.5, (of.size, 2))
    half_px = 0.5 * size * (1.8 * ahead + 4.5 * abeam) * camera.focal_px / distance
    top = foot[:, 1] - 1.5 * size * camera.focal_px / distance
    xyxy = np.stack([foot[:, 0] - half_px, top, foot[:, 0] + half_px, foot[:, 1]], axis=1)
    times = 1_700_000_000.0 + 120.0 * of + since_s
    pairs = Correspondences(
        boxes=Boxes.of(xyxy, time_utc_s=times),
        recording=np.char.add("target ", of.astype(np.str_)),
        east_north_m=true + rng.normal(0.0, 0.5, (targets, 2))[of],
        velocity_mps=velocity[of],
        asked=of.size,
        plane=plane,
        fix_time_utc_s=np.stack([times, times + 0.4], axis=1),
    )
    return FitInputs(
        pairs, camera.image_size_px, ControlPoints(np.empty((0, 2)), *[np.empty(0)] * 2)
    )
