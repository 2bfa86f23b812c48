"""The clock offsets of a scene's recordings, from their boxes and logs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sightline.camera.calibration import CameraFitSettings
from sightline.camera.clock_search import (
    MOST_BOXES,
    CameraBeliefs,
    ClockedBoxes,
    search_clocks,
)
from sightline.camera.observations import Landmarks, PointCorrespondences
from sightline.camera.priors import HEAVE_M, CameraPrior, PixelNoise
from sightline.camera.stabilisation import horizons_at, nominal_camera, stabilise
from sightline.clock_offset import ClockOffset
from sightline.errors import InputError
from sightline.geodesy import LocalPlane
from sightline.georeferencing.models import control_landmarks
from sightline.platform import HEADING_SIGMA_DEG, Platform, to_bow, turned
from sightline.plausibility import FASTEST_MPS
from sightline.reference_trajectory import ReferenceTrajectory
from sightline.scene.camera_state import scene_horizons
from sightline.scene.scene import Recording, Scene
from sightline.threads import on_one_thread
from sightline.types import Boxes, Fixes, FloatArray
from sightline.water import WaterLevels

_FEWEST = 5
_STARTS_UNKNOWN = 24


@on_one_thread
def settle_clocks(scene: Scene, plane: LocalPlane, prior: CameraPrior | None = None) -> Scene:
    """The scene in the logs' time, as far as drawn boxes and logs tell it.

    Recordings whose clock is settled already stay as they are, and so do those without drawn boxes
    or a log.

    Args:
        scene: With drawn boxes.
        plane: The plane of the places.
        prior: Of the camera. Absent: that of an ordinary one, with what the scene states but the
            heading: a wrong one is as a wrong clock where a vessel crosses the picture.

    Raises:
        InputError: A file of the scene cannot be used.
    """
    asked = [r for r in scene.recordings if r.boxes_path and r.fixes_path]
    if not asked or all(r.clock_found is not None for r in asked):
        return scene
    read = [_Drawn.of(recording, scene) for recording in asked]
    read = [one for one in read if len(one.boxes) >= _FEWEST]
    # The others were not asked, and never will be.
    if all(one.recording.clock_found is not None for one in read):
        return scene
    sources = sorted({name for one in read for name in one.boxes.source.tolist()})
    level_m = _middle_level(read) if scene.tidal else 0.0
    control = scene.control_points
    places = np.stack(plane.to_plane(control.latitude_deg, control.longitude_deg), axis=1)
    known = scene.plane is not None or scene.moves
    stated = replace(scene.stated, heading_deg=None)
    beliefs = CameraBeliefs(
        image_size_px=scene.image_size_px,
        n_sources=len(sources),
        prior=prior or stated.prior(CameraPrior(), scene.image_size_px),
        landmarks=control_landmarks(control.pixel_px, places) if len(control) else Landmarks.none(),
        settings=CameraFitSettings(
            position_known=known,
            heaving=scene.moves,
            starts=4 if known else _STARTS_UNKNOWN,
        ),
        noise=_noise_on_board(scene.image_size_px) if scene.moves else PixelNoise(),
    )
    recordings = [one.clocked(plane, sources, level_m) for one in read]
    found = search_clocks(recordings, beliefs)
    by_name = {one.recording.name: offset for one, offset in zip(read, found, strict=True)}
    return replace(scene, recordings=tuple(_settled(r, by_name) for r in scene.recordings))


def _noise_on_board(image_size_px: tuple[int, int]) -> PixelNoise:
    """Noise of a foot that a camera on a vessel sees: it heaves, and its compass is off.

    What a compass is off lasts for minutes, and may be another for each recording.
    """
    usual = PixelNoise()
    swung_px = nominal_camera(image_size_px).focal_px * np.radians(HEADING_SIGMA_DEG)
    return replace(usual, column_px=float(np.hypot(usual.column_px, swung_px)), heave_m=HEAVE_M)


def _settled(recording: Recording, found: dict[str, ClockOffset]) -> Recording:
    if recording.name not in found:
        return recording
    own = found[recording.name]
    return replace(recording, clock_offset_s=own.used_s, clock_found=own)


@dataclass(frozen=True, eq=False)
class _Drawn:
    """Drawn boxes of a recording, by the camera's clock, with all that is timed by the log's.

    Attributes:
        recording: Whose boxes.
        boxes: Some of them, with the swell taken off.
        fixes: The log.
        platform: Of the camera, where that moves.
        water: How high the water stood.
    """

    recording: Recording
    boxes: Boxes
    fixes: Fixes
    platform: Platform | None
    water: WaterLevels | None

    @classmethod
    def of(cls, recording: Recording, scene: Scene) -> _Drawn:
        """Read the files of a recording."""
        bare = recording.by_camera()
        boxes = bare.boxes()
        boxes = boxes[np.argsort(boxes.time_utc_s, kind="stable")]
        boxes = boxes[np.flatnonzero(np.isfinite(boxes.time_utc_s))]
        if len(boxes) > MOST_BOXES:
            rows = np.linspace(0, len(boxes) - 1, MOST_BOXES).round().astype(np.int64)
            boxes = boxes[rows]
        horizons = scene_horizons(bare)
        if horizons is not None and len(horizons) and len(boxes):
            typical = float(np.median(horizons.left_y_px)), float(np.median(horizons.right_y_px))
            xyxy_px, known = stabilise(
                boxes.xyxy_px,
                horizons_at(horizons, boxes.time_utc_s),
                typical,
                nominal_camera(scene.image_size_px),
            )
            boxes = boxes.with_columns(xyxy_px=xyxy_px)[np.flatnonzero(known)]
        return cls(recording, boxes, bare.fixes(), bare.platform(), bare.water_levels())

    def clocked(self, plane: LocalPlane, sources: list[str], level_m: float) -> ClockedBoxes:
        """The boxes beside the log at any clock offset."""
        xyxy_px = self.boxes.xyxy_px
        foot_px = np.stack([0.5 * (xyxy_px[:, 0] + xyxy_px[:, 2]), xyxy_px[:, 3]], axis=1)
        width_px = xyxy_px[:, 2] - xyxy_px[:, 0]
        source = np.searchsorted(sources, self.boxes.source).astype(np.int64)
        log = ReferenceTrajectory.of(self.fixes, plane)

        def at(offset_s: float) -> PointCorrespondences:
            times = self.boxes.time_utc_s - offset_s
            place = log.at(times)
            en_m, velocity_mps = place.east_north_m, log.smooth_velocity(times)
            if self.platform is not None:
                pose = self.platform.pose(times, plane)
                en_m, velocity_mps = to_bow(en_m, pose), turned(velocity_mps, pose.heading_rad)
            above_m = self._above(times, level_m)
            known = np.isfinite(en_m).all(axis=1) & np.isfinite(above_m)
            # Beside a leap of the log the velocity is that of the leap, and would settle the clock.
            known &= ~(np.hypot(*place.velocity_mps.T) > FASTEST_MPS)
            rows = np.flatnonzero(known)
            return PointCorrespondences(
                pixel_px=foot_px[rows],
                east_m=en_m[rows, 0],
                north_m=en_m[rows, 1],
                source=source[rows],
                group=np.zeros(rows.size, dtype=np.int64),
                velocity_mps=np.nan_to_num(velocity_mps[rows]),
                sigma_m=place.sigma_m[rows],
                time_s=times[rows],
                width_px=width_px[rows],
                gap_s=place.fix_time_utc_s[rows],
                above_m=above_m[rows],
            )

        return ClockedBoxes(
            at,
            len(self.boxes),
            float(np.ptp(self.boxes.time_utc_s)),
            self.recording.clock_prior,
        )

    def _above(self, times: FloatArray, level_m: float) -> FloatArray:
        if self.water is None:
            return np.zeros(times.size)
        try:
            return self.water.at(times) - level_m
        except InputError:
            return np.full(times.size, np.nan)


def _middle_level(read: list[_Drawn]) -> float:
    levels: list[FloatArray] = []
    for one in read:
        if one.water is None:
            continue
        try:
            levels.append(one.water.at(one.boxes.time_utc_s - one.recording.clock_offset_s))
        except InputError:
            levels.append(one.water.level_m)
    return float(np.median(np.concatenate(levels)))
