r"""Camera rotation between static intervals, estimated and compensated in boxes.

A bumped camera stands as well as before, only otherwise. The static scene tells how: a rotation
about the camera's axes takes each of its places to where it is seen now, through the lens. The
reverse rotation takes boxes to where they would be for the camera that the model knows, as swell is
taken off (`sightline.camera.stabilisation`). What is not known of the rotation is an error that a
target has in common with itself a moment later.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from sightline.camera.motion import StaticInterval
from sightline.camera.pinhole import Camera
from sightline.camera.registration import Displacement, ReferenceView, displacement
from sightline.camera.static_intervals import least_turn_deg
from sightline.types import BoolArray, FloatArray, Positions, rfc3339

_LEAST_SIGMAS = 4.0
# Strips are no surer than this, however well they agree.
_LEAST_SIGMA_PX = 0.15
# Views of the same shore fit a turn to 0.2 px, two of different ones to some 3 px.
_MOST_SIGMA_PX = 1.0
# A turn that is not seen is of the order of this; one about the vertical of as much as the others.
_UNSEEN_DEG = 1.0
_ENOUGH = 0.5
_MOST_DEG = 3.0
_FEWEST = 4
_NO_SUCH_TURN_PX = 1e4


@dataclass(frozen=True, eq=False)
class CameraRotation:
    """Camera rotation in the K static intervals of a recording, against the model's camera.

    It is a rotation vector: by it, in radians, the static scene has turned about the camera's
    axes to the right, downwards and forward.

    Attributes:
        before_utc_s: (K,) time of the last look before the static interval; minus infinity for the
            first.
        since_utc_s: (K,) time of the first look of the static interval; minus infinity for the
            first.
        rotation_rad: (K, 3).
        covariance_rad2: (K, 3, 3).
        heading_known: (K,) bool, whether the rotation about the vertical was seen.
        camera: The camera of the model.
        log_focal_sigma: Standard deviation of the logarithm of its focal length. It makes the
            angles of a rotation unsure, and not where compensated boxes lie: the same lens measures
            the rotation and takes it off.
    """

    before_utc_s: FloatArray
    since_utc_s: FloatArray
    rotation_rad: FloatArray
    covariance_rad2: FloatArray
    heading_known: BoolArray
    camera: Camera
    log_focal_sigma: float = 0.0

    @classmethod
    def of(
        cls,
        static_intervals: Sequence[StaticInterval],
        camera: Camera,
        reference: ReferenceView | None = None,
        *,
        log_focal_sigma: float = 0.0,
    ) -> CameraRotation | None:
        """The camera rotation of a recording; None where there is none, or it cannot be estimated.

        Args:
            static_intervals: Of the recording.
            camera: Of the model.
            reference: What the camera of the model saw; None, or not to be compared: the first
                static interval is taken to be the model's.
            log_focal_sigma: Of the camera.
        """
        if not static_intervals:
            return None
        first = None if reference is None else _turn(reference, static_intervals[0].view, camera)
        if reference is None or first is None:
            reference = static_intervals[0].view
        rotations, covariances, known = [np.zeros(3)], [np.zeros((3, 3))], [True]
        turned = False
        for k, static_interval in enumerate(static_intervals):
            told = first if k == 0 else _turn(reference, static_interval.view, camera)
            start, doubt = np.zeros(3), np.zeros((3, 3))
            if told is None and k:
                # Too far from the model's to be compared: from one static interval to the next.
                told = _turn(static_intervals[k - 1].view, static_interval.view, camera)
                start, doubt = rotations[k], covariances[k]
            if told is None:
                # It was turned, and nobody knows how; the first is taken for the model's.
                unsure = np.radians(_UNSEEN_DEG) ** 2 * np.eye(3) if k else 0.0
                rotations.append(start)
                covariances.append(doubt + unsure)
                known.append(k == 0)
                turned |= k > 0
                continue
            rotation, covariance, landmarks = told
            turned |= _is_turn(rotation, covariance, camera)
            both = Rotation.from_rotvec(rotation) * Rotation.from_rotvec(start)
            rotations.append(both.as_rotvec())
            covariances.append(covariance + doubt)
            known.append(landmarks and (known[k] or not start.any()))
        if not turned:
            return None
        return cls(
            before_utc_s=np.array(
                [static_interval.before_utc_s for static_interval in static_intervals]
            ),
            since_utc_s=np.array(
                [static_interval.since_utc_s for static_interval in static_intervals]
            ),
            rotation_rad=np.array(rotations[1:]),
            covariance_rad2=np.array(covariances[1:]),
            heading_known=np.array(known[1:]),
            camera=camera,
            log_focal_sigma=log_focal_sigma,
        )

    def __len__(self) -> int:
        return int(self.since_utc_s.size)

    @property
    def angles_deg(self) -> FloatArray:
        """(K, 3) rotation angles: heading to the right, pitch downwards, roll clockwise.

        A roll is positive where the right end of the horizon is lower than before.
        """
        return np.degrees(self.rotation_rad[:, [1, 0, 2]] * [-1.0, 1.0, 1.0])

    @property
    def sigma_deg(self) -> FloatArray:
        """(K, 3) standard deviations of `angles_deg`."""
        variance = np.diagonal(self.covariance_rad2, axis1=1, axis2=2)[:, [1, 0, 2]]
        # A roll is an angle in the picture itself.
        lens = self.log_focal_sigma * self.angles_deg * [1.0, 1.0, 0.0]
        return np.hypot(np.degrees(np.sqrt(variance)), lens)

    def at(self, time_utc_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rotation vectors (N, 3) at times, radians, and their covariances (N, 3, 3).

        NaN between the last look before a turn and the first one after it, when nobody knows how
        the camera lay.
        """
        static_interval = np.searchsorted(self.since_utc_s[1:], time_utc_s, side="right")
        after = np.append(self.before_utc_s[1:], np.inf)[static_interval]
        sure = time_utc_s <= after
        return (
            np.where(sure[:, None], self.rotation_rad[static_interval], np.nan),
            self.covariance_rad2[static_interval],
        )

    def sentences(self) -> tuple[str, ...]:
        """The rotations in words, each against the camera of the model."""
        out = []
        for k, (angles, sigmas) in enumerate(zip(self.angles_deg, self.sigma_deg, strict=True)):
            as_model = self._is_small(k)
            if as_model and (k == 0 or self._is_small(k - 1)):
                continue
            when = "from its beginning"
            if k:
                when = f"from {rfc3339(float(self.since_utc_s[k]))} on"
            if sigmas[1] > 0.5 * _UNSEEN_DEG:
                out.append(f"{when} the camera lay otherwise, and its pictures do not tell how.")
                continue
            if as_model:
                out.append(f"{when} the camera lay as for the model.")
                continue
            heading = f"{angles[0]:+.2f} ± {sigmas[0]:.2f} degrees in heading"
            if not self.heading_known[k]:
                heading = (
                    f"an unknown angle in heading (taken for {angles[0]:.1f} ± {sigmas[0]:.1f} "
                    "degrees)"
                )
            out.append(
                f"{when} the camera lay turned by {heading}, {angles[1]:+.2f} ± {sigmas[1]:.2f} "
                f"in pitch and {angles[2]:+.2f} ± {sigmas[2]:.2f} in roll against the model's."
            )
        return tuple(out)

    def _is_small(self, k: int) -> bool:
        """Whether a static interval's rotation against the model is negligible."""
        rotation, covariance = self.rotation_rad[k], self.covariance_rad2[k]
        told = np.sqrt(covariance[0, 0]) < 0.5 * np.radians(_UNSEEN_DEG)
        return bool(told and not _is_turn(rotation, covariance, self.camera))


def compensate_rotation(
    xyxy_px: FloatArray, rotation_rad: FloatArray, camera: Camera
) -> tuple[FloatArray, BoolArray]:
    """Compensate the camera rotation in boxes.

    Args:
        xyxy_px: (N, 4) boxes.
        rotation_rad: (N, 3) rotation vectors; NaN where nobody knows how the camera lay.
        camera: Of the model.

    Returns:
        (N, 4) the boxes moved, NaN where they cannot be; and (N,) whether they can.
    """
    foot = np.stack([xyxy_px[:, [0, 2]].mean(axis=1), xyxy_px[:, 3]], axis=1)
    rays = camera.rays(foot)
    seen = np.isfinite(rays).all(axis=1) & np.isfinite(rotation_rad).all(axis=1)
    moved = np.full_like(foot, np.nan)
    if seen.any():
        back = Rotation.from_rotvec(rotation_rad[seen]).inv()
        moved[seen] = camera.pixels(back.apply(rays[seen]))
    return xyxy_px + np.tile(moved - foot, 2), np.isfinite(moved).all(axis=1)


def widen(
    positions: Positions,
    covariance_rad2: FloatArray,
    camera: Camera,
    above_m: ArrayLike = 0.0,
) -> Positions:
    """Add the uncertainty of the rotation to the covariances of compensated boxes.

    Args:
        positions: N rows, in the model's plane.
        covariance_rad2: (N, 3, 3) of the rotation vectors.
        camera: Of the model.
        above_m: (N,) or one value: how high the water stood above the plane that the camera's
            height is over.
    """
    place = np.stack([positions.east_m - camera.east_m, positions.north_m - camera.north_m], 1)
    height = np.broadcast_to(camera.height_m - np.asarray(above_m), len(place))[:, None]
    sight = np.concatenate([place, -height], axis=1)
    # A small turn w takes a sight d to d + w x d, and that meets the water elsewhere.
    by_axis = np.cross(camera.rotation[None, :, :], sight[:, None, :])
    moved = by_axis[..., :2] + by_axis[..., 2:] * (place / height)[:, None, :]
    own = np.einsum("nai,nab,nbj->nij", moved, covariance_rad2, moved)
    assert positions.shared_covariance_m2 is not None, "positions fill it in"
    return replace(
        positions,
        covariance_m2=positions.covariance_m2 + own,
        shared_covariance_m2=positions.shared_covariance_m2
        + np.where(positions.known[:, None, None], own, 0.0),
    )


def _is_turn(rotation: FloatArray, covariance: FloatArray, camera: Camera) -> bool:
    """Whether a rotation is large and significant enough to count."""
    half_width = 0.5 * camera.image_size_px[0] / camera.focal_px
    moved_rad = max(float(np.hypot(*rotation[:2])), half_width * abs(float(rotation[2])))
    doubt = np.diag(covariance)
    with np.errstate(divide="ignore", invalid="ignore"):
        sure = np.abs(rotation) > _LEAST_SIGMAS * np.sqrt(doubt)
    return bool(moved_rad >= np.radians(least_turn_deg(camera.focal_px)) and sure.any())


def seen_again(reference: ReferenceView, other: ReferenceView, camera: Camera) -> bool:
    """Whether one view shows the static scene of another, wherever it lies in it now.

    Args:
        reference: Of one time.
        other: Of another.
        camera: With the lens of both.
    """
    return _turn(reference, other, camera) is not None


def _turn(
    reference: ReferenceView, other: ReferenceView, camera: Camera
) -> tuple[FloatArray, FloatArray, bool] | None:
    """As `_rotation`, from one view to another, and whether landmarks determine it."""
    moved = displacement(reference, other)
    told = None if moved is None else _rotation(moved, camera)
    return None if moved is None or told is None else (*told, moved.landmarks)


def _rotation(moved: Displacement, camera: Camera) -> tuple[FloatArray, FloatArray] | None:
    """The rotation (3,) of the static scene that fits the displacements, and its covariance.

    None where the lens has no rays for enough of the places, or no turn explains what was measured:
    then the two views do not show the same.
    """
    there = moved.at_px + moved.moved_px
    rays = camera.rays(moved.at_px)
    # Where only a horizon is seen, where it lies counts, and not where along it.
    axes = slice(None) if moved.landmarks else slice(1, 2)
    usable = np.isfinite(rays).all(axis=1) & np.isfinite(camera.rays(there)).all(axis=1)
    if usable.sum() < _FEWEST:
        return None
    rays, there = rays[usable], there[usable]
    unseen = np.radians(_UNSEEN_DEG)

    def residual(turn: FloatArray) -> FloatArray:
        seen = camera.pixels(Rotation.from_rotvec(turn).apply(rays))
        left = np.nan_to_num((seen - there)[:, axes].ravel(), nan=_NO_SUCH_TURN_PX)
        return left if moved.landmarks else np.append(left, _LEAST_SIGMA_PX * turn[1] / unseen)

    # The first step is by a degree at most; further off, rays may leave the picture.
    found = least_squares(
        residual, np.zeros(3), loss="soft_l1", f_scale=2.0 * _LEAST_SIGMA_PX, x_scale=unseen
    )
    left = residual(found.x)
    sigma_px = max(_LEAST_SIGMA_PX, 1.4826 * float(np.median(np.abs(left))))
    if sigma_px > _MOST_SIGMA_PX:
        return None
    design = _jacobian(residual, found.x)
    scale = np.full(len(left), sigma_px)
    if not moved.landmarks:
        scale[-1] = _LEAST_SIGMA_PX / max(1.0, float(np.hypot(*found.x[[0, 2]])) / unseen)
    weighted = design / scale[:, None]
    known = weighted.T @ weighted + np.eye(3) / np.radians(_MOST_DEG) ** 2
    return np.asarray(found.x), np.asarray(np.linalg.inv(known))


def _jacobian(residual: Callable[[FloatArray], FloatArray], turn: FloatArray) -> FloatArray:
    step = 1e-5
    return np.stack(
        [
            (residual(turn + step * axis) - residual(turn - step * axis)) / (2.0 * step)
            for axis in np.eye(3)
        ],
        axis=1,
    )


def reference_view(
    static_intervals: Mapping[str, Sequence[StaticInterval]],
) -> ReferenceView | None:
    """The view that most others can be registered to; the latest that half of them can be.

    Args:
        static_intervals: By recording.
    """
    ordered = sorted(static_intervals.values(), key=_when)
    views = [static_interval.view for one in ordered for static_interval in one][::-1]
    best: tuple[int, ReferenceView] | None = None
    for view in views:
        others = sum(displacement(view, other) is not None for other in views)
        if others >= _ENOUGH * len(views):
            return view
        if best is None or others > best[0]:
            best = (others, view)
    return None if best is None else best[1]


def _when(static_intervals: Sequence[StaticInterval]) -> float:
    return static_intervals[-1].since_utc_s
