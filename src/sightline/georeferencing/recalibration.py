"""Recalibration: priors from an earlier model, and detection of a camera change since.

Where frames show the static scene of the model's reference view, they are registered against it;
see `sightline.camera.rotation`. Elsewhere boxes are compared with a log. A camera that was bumped
shows as a shift of all that it sees: columns say by how much its heading changed, rows its pitch,
and their slope across the picture its roll. The shift is estimated against the model, with the
model's noise, and again over time (a likelihood ratio over all moments at which it may have
happened; Page 1954, Hinkley 1970).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sightline.camera.motion import StaticInterval
from sightline.camera.parameters import (
    CAMERA,
    HEADING,
    LOG_FOCAL,
    LOG_HEIGHT,
    PITCH,
    POSITION,
    PRINCIPAL,
    ROLL,
)
from sightline.camera.pinhole import project_with_jacobian
from sightline.camera.priors import CameraPrior
from sightline.camera.rotation import seen_again
from sightline.errors import InputError
from sightline.georeferencing.correspondences import Correspondences
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.threads import on_one_thread
from sightline.types import FloatArray

_TURNS = (HEADING, PITCH, ROLL)
_SURE = 6.0
_LEAST_DEG = 0.15
_FEWEST = 4
_HUBER = 3.0
# A camera is turned by a degree or so, not by ten.
_MOST_DEG = 3.0


@dataclass(frozen=True)
class CameraChange:
    """A camera rotation since the model was fitted.

    Attributes:
        recording: In which recording it shows.
        since_utc_s: From when on; the recording's first box where it was turned before.
        heading_deg: To the right.
        pitch_deg: Downwards.
        roll_deg: The right end of the horizon downwards.
        sigma_deg: Standard deviations of the three.
        log_likelihood_ratio: By how much likelier the boxes are with the turn than without it, in
            nats.
    """

    recording: str
    since_utc_s: float
    heading_deg: float
    pitch_deg: float
    roll_deg: float
    sigma_deg: tuple[float, float, float]
    log_likelihood_ratio: float

    @property
    def angles(self) -> str:
        """The three angles in words."""
        return (
            f"{self.heading_deg:+.2f} degrees in heading, {self.pitch_deg:+.2f} in pitch and "
            f"{self.roll_deg:+.2f} in roll"
        )


@dataclass(frozen=True)
class CameraChangeReport:
    """Whether the camera has changed since its model was fitted, with reasons in words.

    Attributes:
        turned: Whether the camera was rotated since.
        statements: What is known of it, in words.
    """

    turned: bool
    statements: tuple[str, ...]


def prior_of(model: Georeferencer, *, turned: bool, inflation: float = 2.0) -> CameraPrior:
    """The camera prior for a new fit, from an earlier model.

    Args:
        model: With a camera.
        turned: Whether the camera was rotated since, so that its pitch and roll tell nothing.
        inflation: By how much standard deviations grow: a model is surer of itself than it ought.

    Raises:
        InputError: The model has no camera.
    """
    camera = model.camera
    if camera is None:
        raise InputError(f"model {model.model!r} has no camera, so it cannot be updated")
    fit = model.regressor.camera_fit
    assert fit is not None, "a model with a camera knows how well"
    sigma = inflation * np.sqrt(np.diag(fit.covariance))
    usual, width_px = CameraPrior(), model.image_size_px[0]
    # Zero for early models, which took it to be in the middle.
    centred_px = min(float(sigma[PRINCIPAL].max()), float(fit.prior_sigma[PRINCIPAL].max()))
    prior = replace(
        usual,
        height_m=camera.height_m,
        log_height_sigma=min(float(sigma[LOG_HEIGHT]), usual.log_height_sigma),
        focal_widths=camera.focal_px / width_px,
        log_focal_sigma=min(float(sigma[LOG_FOCAL]), usual.log_focal_sigma),
        principal_widths=(camera.principal_dx_px / width_px, camera.principal_dy_px / width_px),
        principal_sigma_widths=centred_px / width_px or usual.principal_sigma_widths,
    )
    if turned:
        return prior
    pitch, roll = np.degrees(sigma[[PITCH, ROLL]]).tolist()
    return replace(prior, pitch_deg=(camera.pitch_deg, pitch), roll_deg=(camera.roll_deg, roll))


@on_one_thread
def detect_camera_change(
    model: Georeferencer,
    pairs: Correspondences,
    static_intervals: Mapping[str, Sequence[StaticInterval]],
) -> CameraChangeReport:
    """Detect whether the camera was rotated since its model was fitted.

    Frames show it to some hundredths of a degree where they show the static scene of the model's
    reference view; boxes and the log show it elsewhere.

    Args:
        model: With a camera.
        pairs: Boxes and places of a new day, in the model's plane.
        static_intervals: Of the new day's recordings, by their names.

    Raises:
        InputError: The model has no camera.
    """
    by_boxes = {moved.recording: moved for moved in camera_changes(model, pairs)}
    camera, view = model.camera, model.view
    assert camera is not None, "refused by `camera_changes`"
    seen = {
        name: own
        for name, own in static_intervals.items()
        if own and view is not None and seen_again(view, own[0].view, camera)
    }
    said = []
    by_pictures = False
    for name, own in seen.items():
        turns = model.rotation_in(own)
        if turns is not None:
            by_pictures = True
            said.append(
                f"The camera was rotated: in recording {name}, by its pictures, "
                f"{' '.join(turns.sentences())}"
            )
    for name, moved in by_boxes.items():
        if name not in seen:
            said.append(
                f"The camera was rotated: from recording {name} on by {moved.angles} against the "
                f"old model, by its boxes ({moved.log_likelihood_ratio:.0f} nats)."
            )
        elif model.rotation_in(seen[name]) is None:
            said.append(
                f"The boxes of recording {name} lie as if the camera were rotated by "
                f"{moved.angles}, and its pictures show that it is not: it may have been raised, "
                "lowered or put elsewhere, or the log is off."
            )
    if not said:
        what = "pictures" if seen else "boxes"
        said = [
            f"The camera stands as it did when the old model was fitted, as far as the {what} tell."
        ]
    return CameraChangeReport(turned=by_pictures or bool(by_boxes), statements=tuple(said))


@on_one_thread
def camera_changes(
    model: Georeferencer, pairs: Correspondences, *, correlation_time_s: float = 2.0
) -> tuple[CameraChange, ...]:
    """Camera rotations that boxes and logs show; none where there are none.

    Args:
        model: With a camera.
        pairs: Boxes and places of a new day, in the model's plane.
        correlation_time_s: Boxes nearer in time than this have errors in common, and count as one.

    Raises:
        InputError: The model has no camera.
    """
    camera = model.camera
    if camera is None:
        raise InputError(f"model {model.model!r} has no camera, so nothing tells whether it moved")
    out = []
    for name in np.unique(pairs.recording):
        rows = np.flatnonzero(pairs.recording == name)
        rows = rows[np.argsort(pairs.boxes.time_utc_s[rows], kind="stable")]
        if rows.size < _FEWEST:
            continue
        found = _turn(model, pairs[rows], str(name), correlation_time_s)
        if found is not None:
            out.append(found)
    return tuple(out)


def _turn(
    model: Georeferencer, pairs: Correspondences, name: str, correlation_time_s: float
) -> CameraChange | None:
    residual, jacobian, sigma, time_s = _residuals(model, pairs)
    standard = residual / sigma
    assert model.camera is not None, "the caller has looked"
    camera_px = model.camera.focal_px
    # Boxes far off are no vessel's; they must not turn the camera.
    most = 6.0 + np.radians(_MOST_DEG) * camera_px / sigma
    keep = (np.abs(standard) < most).all(axis=1)
    residual, jacobian, sigma, time_s = (a[keep] for a in (residual, jacobian, sigma, time_s))
    if time_s.size < _FEWEST:
        return None
    apart = np.maximum(np.median(np.diff(time_s)), 1e-3)
    weight = min(float(apart) / correlation_time_s, 1.0) if time_s.size > 1 else 1.0
    best: tuple[float, int, FloatArray, FloatArray] | None = None
    for first in range(time_s.size - _FEWEST + 1):
        a = (jacobian[first:] / sigma[first:, :, None]).reshape(-1, 3)
        b = (residual[first:] / sigma[first:]).reshape(-1)
        left = b - np.median(b.reshape(-1, 2), axis=0)[np.arange(b.size) % 2]
        for _ in range(3):
            thin = weight * np.minimum(1.0, _HUBER / np.maximum(np.abs(left), 1e-9))
            normal = a.T @ (a * thin[:, None]) + np.eye(3) / np.radians(_MOST_DEG) ** 2
            turn = np.linalg.solve(normal, a.T @ (b * thin))
            left = b - a @ turn
        ratio = weight * float(np.sum(_huber(b) - _huber(left)))
        if best is None or ratio > best[0]:
            best = (ratio, first, turn, np.linalg.inv(normal))
    assert best is not None, "there are enough boxes"
    ratio, first, turn, covariance = best
    # The moment was chosen among so many.
    ratio -= float(np.log(time_s.size))
    degrees = np.degrees(turn)
    if ratio < _SURE or np.abs(degrees).max() < _LEAST_DEG:
        return None
    heading_deg, pitch_deg, roll_deg = degrees.tolist()
    spread = np.degrees(np.sqrt(np.diag(covariance)))
    return CameraChange(
        recording=name,
        since_utc_s=float(time_s[first]),
        heading_deg=heading_deg,
        pitch_deg=pitch_deg,
        roll_deg=roll_deg,
        sigma_deg=(float(spread[0]), float(spread[1]), float(spread[2])),
        log_likelihood_ratio=ratio,
    )


def _huber(standard: FloatArray) -> FloatArray:
    size = np.abs(standard)
    return np.where(size < _HUBER, 0.5 * size**2, _HUBER * (size - 0.5 * _HUBER))


def _residuals(
    model: Georeferencer, pairs: Correspondences
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Residuals of foot points, Jacobian by the rotation (N, 2, 3), standard deviations, times."""
    regressor = model.calibrated
    assert regressor is not None, "the caller has looked"
    fit = regressor.fit_
    camera = fit.camera
    vector = camera.to_vector()
    size = model.image_size_px
    place = pairs.east_north_m
    above = model.above_m(pairs.water_level_m if model.water_level_m is not None else None)
    pixel, by_parameter, by_point = project_with_jacobian(
        vector, size, place[:, 0], place[:, 1], above
    )
    boxes = pairs.boxes.xyxy_px
    foot = np.stack([0.5 * (boxes[:, 0] + boxes[:, 2]), boxes[:, 3]], axis=1)
    bias = np.array([regressor.bias(str(s))[0] for s in pairs.boxes.source]).reshape(-1, 2)
    foot[:, 1] -= bias[:, 0]
    residual = foot - pixel - by_point[:, :, 2] * bias[:, 1:]
    slant2 = np.sum((place - vector[POSITION]) ** 2, axis=1) + camera.height_m**2
    column, row = fit.noise.variances_px2(camera.focal_px**2 / slant2)
    per_metre = np.hypot(by_point[:, :, 0], by_point[:, :, 1])
    # What the model itself does not know of where it points is no turn.
    own = by_parameter @ fit.covariance[CAMERA, CAMERA]
    unsure = np.einsum("nij,nij->ni", own, by_parameter)
    late = np.einsum("nij,nj->ni", by_point[:, :, :2], pairs.velocity_mps) * 0.5
    hull = 1.5 * per_metre
    variance = np.stack([column, row], axis=1) + unsure + late**2 + hull**2
    variance += (fit.noise.place_m * per_metre) ** 2
    return (
        residual,
        by_parameter[:, :, list(_TURNS)],
        np.sqrt(variance),
        np.asarray(pairs.boxes.time_utc_s),
    )
