"""Contradictions between what is stated of a camera and what boxes and logs say of it.

A wrong value that is stated pulls the whole camera, and what it cannot move it makes noise of. So
residuals hardly show it. A camera is fitted to which none of what is stated is told; how far it is
from each of the values, all others being believed, is measured in standard deviations of the two.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import LinAlgError

from sightline.camera.calibration import CameraFit
from sightline.camera.parameters import CAMERA, HEADING
from sightline.camera.priors import CameraPrior
from sightline.camera.stated import SLOTS, StatedCamera
from sightline.errors import FitError
from sightline.georeferencing.models import CameraModelType, Observations
from sightline.types import FloatArray, IntArray

# Standard deviations. Of eight keys one is beyond by chance in less than one fit of forty.
_CONTRADICTS = 3.0
# A camera that so many boxes disagree with, or by such a share of the picture, explains nothing.
_MOST_OUTLIERS, _FARTHEST_OFF = 0.5, 0.05
_CAMERA = CameraModelType("camera", residual=False)


def contradictions(
    observations: Observations, stated: StatedCamera, usual: CameraPrior, *, seed: int = 0
) -> tuple[str, ...]:
    """Sentences on what is stated of a camera and cannot be true, by the data.

    Args:
        observations: What the camera is fitted to.
        stated: What is stated of it.
        usual: What is believed of all else.
        seed: Of whatever is random.
    """
    if not stated.keys:
        return ()
    # Far from the truth the search may not find its way back, and an ordinary camera is a start.
    free = _fitted(observations, stated, usual, stated.keys, seed)
    if free is None:
        free = _fitted(observations, StatedCamera(), usual, (), seed)
    if free is None:
        return ()
    believed, told = list(stated.keys), []
    while believed:
        off = _standard(free, stated, usual, believed)
        worst = int(np.argmax(off))
        if off[worst] < _CONTRADICTS:
            break
        told.append(believed.pop(worst))
    if not told:
        return ()
    # By how much the others, which are believed, narrow what the data wants.
    found = _fitted(observations, stated, usual, told, seed) if believed else free
    return tuple(_sentence(key, stated, found or free) for key in told)


def _fitted(
    observations: Observations,
    stated: StatedCamera,
    usual: CameraPrior,
    untold: list[str] | tuple[str, ...],
    seed: int,
) -> CameraFit | None:
    """A camera to which some of what is stated is not told; None where none explains the data."""
    prior = stated.prior(usual, observations.image_size_px, wide=untold)
    try:
        found = _CAMERA.fit(replace(observations, prior=prior), seed=seed).camera_fit
    except (FitError, LinAlgError):
        return None
    # Noise that is as large as the picture leaves no outliers.
    off_px = float(np.median(np.hypot(*found.residual_px.T)))
    explained = off_px < _FARTHEST_OFF * observations.image_size_px[0]
    return found if explained and found.outlier.mean() < _MOST_OUTLIERS else None


def _standard(
    free: CameraFit, stated: StatedCamera, usual: CameraPrior, keys: list[str]
) -> FloatArray:
    """(K,) distances of the data from each of some keys, the others believed, in sigmas.

    With d the distances of all and S their covariance, that of one from where the data and the
    others put it is its share of S⁻¹ d.
    """
    prior = stated.prior(usual, free.image_size_px)
    mean, sigma = prior.moments(free.image_size_px, 0, 0, position_known=True)
    slots: IntArray = np.array([slot for key in keys for slot in SLOTS[key]])
    off = free.vector[CAMERA][slots] - mean[slots]
    turn = slots == HEADING
    off[turn] = np.arctan2(np.sin(off[turn]), np.cos(off[turn]))
    whole = free.covariance[np.ix_(slots, slots)] + np.diag(sigma[slots] ** 2)
    inverse = np.linalg.inv(whole)
    out, at = np.empty(len(keys)), 0
    for row, key in enumerate(keys):
        own = slice(at, at + len(SLOTS[key]))
        pull = (inverse @ off)[own]
        squared = float(pull @ np.linalg.solve(inverse[own, own], pull))
        # A point has two chances of being far off.
        out[row] = np.sqrt(squared / len(pull))
        at = own.stop
    return out


def _sentence(key: str, stated: StatedCamera, found: CameraFit) -> str:
    sigma = float(np.sqrt(found.covariance[SLOTS[key][0], SLOTS[key][0]]))
    said, wanted = stated.wanted(key, found.camera, sigma)
    where = f"[camera] {key} is stated as {said}"
    if stated.focal_in_pictures and key == "focal_px":
        where = f"The pictures carry a focal length of {said} px"
    return (
        f"{where}, and without it boxes, logs and control points want {wanted}: check it first, "
        "since it moves every place."
    )
