"""Expected boxes of a logged target, projected by a fitted camera, with their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import nnls

from sightline.camera.parameters import CAMERA
from sightline.camera.pinhole import project_with_jacobian
from sightline.errors import InputError
from sightline.georeferencing.camera_regressor import CameraRegressor
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.scene import Recording, Scene
from sightline.scene.correspondences import scene_correspondences
from sightline.synchronisation import LARGEST_GAP_S, Synchronised, synchronise
from sightline.types import BoolArray, FloatArray, IntArray

_UNDER_WAY_MPS = 0.5
"""Below this speed a log does not tell where the bow points to."""
_FEWEST_BOXES = 5
_RECEIVER_SIGMA_M = 1.5
"""Of a good receiver either way. It is correlated over minutes, so it is no scatter of boxes."""
_TURN_MPS2 = 0.5
"""How much a small boat speeds up or turns: in a gap of ``g`` seconds between two fixes it leaves
the straight line between them by up to ``a g² / 8``."""


@dataclass(frozen=True)
class TargetSize:
    """Size of a target, as its boxes show it.

    Attributes:
        length_m: Width of its box when it crosses the line of sight.
        beam_m: Width of its box when it comes or goes.
        height_m: Height of its box.
    """

    length_m: float = 6.5
    beam_m: float = 2.5
    height_m: float = 2.2


@dataclass(frozen=True, eq=False)
class Expected:
    """Expected boxes of a logged target, one row a frame.

    Attributes:
        xyxy_px: (N, 4) float64, the expected box; NaN where the log has a gap or the target lies
            behind the camera.
        sigma_px: (N, 2) float64, standard deviations of its column and row: of the camera's
            parameters, the receiver and the clock.
        range_m: (N,) float64, from the camera; NaN where not known.
        in_gap: (N,) bool, True where the log has no fixes at both sides that are close enough.
    """

    xyxy_px: FloatArray
    sigma_px: FloatArray
    range_m: FloatArray
    in_gap: BoolArray

    def __len__(self) -> int:
        return int(self.xyxy_px.shape[0])

    def __getitem__(self, rows: IntArray | BoolArray) -> Expected:
        return Expected(
            self.xyxy_px[rows], self.sigma_px[rows], self.range_m[rows], self.in_gap[rows]
        )


def camera_of(georeferencer: Georeferencer) -> CameraRegressor:
    """The fitted camera of a georeferencer.

    Raises:
        InputError: It has none: the paper's models go from a box to a place, and not back.
    """
    if georeferencer.calibrated is None:
        raise InputError(
            f"a {georeferencer.model} model cannot say where in the image a place lies; fit "
            "camera or camera+gpr"
        )
    return georeferencer.calibrated


def learn_size(scene: Scene, georeferencer: Georeferencer) -> TargetSize:
    """Estimate the size of the logged target from the boxes drawn of it.

    The width of a box is that of the hull turned to the line of sight,
    ``length |sin| + beam |cos|``, by non-negative least squares; the height is the median. What
    too few boxes tell is what is usual for a small motor boat.

    Raises:
        InputError: The model has no camera, or a file of the scene cannot be used.
    """
    usual = TargetSize()
    camera = camera_of(georeferencer).camera_
    if not any(r.boxes_path is not None and r.fixes_path is not None for r in scene.recordings):
        return usual
    pairs = scene_correspondences(scene, georeferencer.plane).certain()
    if len(pairs) < _FEWEST_BOXES:
        return usual
    east, north = (
        pairs.east_north_m[:, 0] - camera.east_m,
        pairs.east_north_m[:, 1] - camera.north_m,
    )
    metres_per_px = np.hypot(east, north) / camera.focal_px
    size = (pairs.boxes.xyxy_px[:, 2:] - pairs.boxes.xyxy_px[:, :2]) * metres_per_px[:, None]
    height = float(np.median(size[:, 1]))
    speed = np.hypot(*pairs.velocity_mps.T)
    rows = speed > _UNDER_WAY_MPS
    if int(rows.sum()) < _FEWEST_BOXES:
        width = float(np.median(size[:, 0]))
        return TargetSize(width, min(width, usual.beam_m), height)
    aspect = _aspect(east[rows], north[rows], *pairs.velocity_mps[rows].T)
    (length, beam), _ = nnls(aspect, size[rows, 0])
    return TargetSize(max(float(length), height), max(float(beam), 0.2 * float(length)), height)


def place_of(
    recording: Recording,
    georeferencer: Georeferencer,
    time_utc_s: FloatArray,
    *,
    largest_gap_s: float = LARGEST_GAP_S,
) -> Synchronised:
    """Positions of the logged target at the times of frames, corrected for the clock offset.

    Args:
        recording: Whose log.
        georeferencer: Has the clock offset of the recording.
        time_utc_s: (N,) POSIX seconds by the recording's clock.
        largest_gap_s: As in `synchronise`.

    Raises:
        InputError: The recording has no log, or it cannot be used.
    """
    taken_off_s = recording.clock_offset_s
    known = georeferencer.report.clock_offset_s.get(recording.name, -taken_off_s)
    late_s = known + taken_off_s
    return synchronise(
        recording.fixes(), time_utc_s + late_s, georeferencer.plane, largest_gap_s=largest_gap_s
    )


def expect(
    place: Synchronised,
    georeferencer: Georeferencer,
    size: TargetSize,
    water_level_m: ArrayLike | None = None,
) -> Expected:
    """Project the expected boxes of a target from the positions of its log.

    Args:
        place: (N,) where it was.
        georeferencer: Has a camera.
        size: Of the target.
        water_level_m: (N,) or one value; see `Georeferencer.locate`.

    Raises:
        InputError: The model has no camera, or the water level does not fit it.
    """
    regressor = camera_of(georeferencer)
    fit, camera = regressor.fit_, regressor.camera_
    above = georeferencer.above_m(water_level_m)
    n = place.east_m.size
    known = place.matched
    east, north = np.nan_to_num(place.east_m), np.nan_to_num(place.north_m)
    velocity_east = np.nan_to_num(place.velocity_east_mps)
    velocity_north = np.nan_to_num(place.velocity_north_mps)
    off_east, off_north = east - camera.east_m, north - camera.north_m
    range_m = np.hypot(off_east, off_north)
    pixel = camera.project(east, north, above)
    _, by_parameter, by_point = project_with_jacobian(
        fit.vector[CAMERA], georeferencer.image_size_px, east, north, above
    )
    variance = np.einsum(
        "nij,jk,nik->ni", by_parameter, fit.covariance[CAMERA, CAMERA], by_parameter
    )
    # The receiver is off by as much either way, and the clock moves the target along its course.
    known_m = np.hypot(fit.noise.place_m, _RECEIVER_SIGMA_M)
    off_m = np.hypot(known_m, _TURN_MPS2 * np.where(known, place.gap_s, 0.0) ** 2 / 8.0)
    variance += off_m[:, None] ** 2 * np.sum(by_point[:, :, :2] ** 2, axis=2)
    moved = by_point[:, :, 0] * velocity_east[:, None] + by_point[:, :, 1] * velocity_north[:, None]
    variance += (fit.clock_sigma_s * moved) ** 2
    slant = np.hypot(range_m, camera.height_m)
    pixels_per_metre = camera.focal_px / np.maximum(slant, 1.0)
    aspect = _aspect(off_east, off_north, velocity_east, velocity_north)
    still = np.hypot(velocity_east, velocity_north) < _UNDER_WAY_MPS
    aspect[still] = 2.0 / np.pi
    width = (aspect @ np.array([size.length_m, size.beam_m])) * pixels_per_metre
    height = size.height_m * pixels_per_metre
    # The foot of a box lies where the near side of the hull meets the water: nearer by half of it.
    near = 0.5 * (aspect[:, ::-1] @ np.array([size.length_m, size.beam_m]))
    share = 1.0 - np.minimum(near / np.maximum(range_m, 1.0), 0.5)
    foot = camera.project(
        camera.east_m + off_east * share, camera.north_m + off_north * share, above
    )
    box = np.stack(
        [pixel[:, 0] - 0.5 * width, foot[:, 1] - height, pixel[:, 0] + 0.5 * width, foot[:, 1]],
        axis=1,
    )
    box[~known] = np.nan
    return Expected(
        xyxy_px=box.reshape(n, 4),
        sigma_px=np.sqrt(variance),
        range_m=np.where(known, range_m, np.nan),
        in_gap=np.asarray(~known),
    )


def _aspect(
    east_m: FloatArray, north_m: FloatArray, velocity_east: FloatArray, velocity_north: FloatArray
) -> FloatArray:
    """(N, 2) shares of the length and of the beam across the line of sight."""
    size = np.maximum(np.hypot(east_m, north_m) * np.hypot(velocity_east, velocity_north), 1e-9)
    along = np.abs(velocity_east * east_m + velocity_north * north_m) / size
    across = np.sqrt(np.maximum(1.0 - along**2, 0.0))
    return np.stack([across, np.minimum(along, 1.0)], axis=1)
