"""One picture from the tracks of several cameras, which a fleet file names."""

from __future__ import annotations

from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from sightline.errors import InputError
from sightline.evaluation.report import without_nan
from sightline.fleet.config import FusedFleet, TracksOfCamera
from sightline.formats import read_tracks
from sightline.fusion import CameraTracks, FuseSettings, Fusion, fuse
from sightline.fusion.fuse import check_covariances
from sightline.geodesy import LocalPlane
from sightline.georeferencing.georeferencer import load_model
from sightline.types import FloatArray, Track, utc_text


def fuse_fleet(fleet: FusedFleet, *, interval_s: float | None = None) -> Fusion:
    """Fuse the tracks of a fleet's cameras.

    Args:
        fleet: The cameras with their files, and how they are fused.
        interval_s: Time between the points of a track; None: as the fleet file says.

    Raises:
        InputError: A file cannot be used, tracks do not say how unsure they are, or no two cameras
            have tracks at times that are near to each other.
    """
    settings = fleet.settings
    if interval_s is not None:
        settings = replace(settings, interval_s=interval_s)
    places = [_place(camera) for camera in fleet.cameras]
    plane = next((LocalPlane(*place) for place in places if place is not None), None)
    cameras = []
    for camera, place in zip(fleet.cameras, places, strict=True):
        tracks: list[Track] = []
        for path in camera.tracks:
            found = read_tracks(path, plane=plane)
            plane = plane or found[0].plane
            for track in found:
                check_covariances(track, str(path))
            tracks += found
        assert plane is not None, "a file of tracks has points"
        cameras.append(CameraTracks(camera.name, tuple(tracks), _in_plane(plane, place)))
    assert plane is not None, "there are cameras"
    _check_times(fleet.path, cameras, settings)
    try:
        return fuse(cameras, plane, settings)
    except InputError as error:
        raise InputError(f"{fleet.path}: {error}") from error


def summary(fusion: Fusion) -> dict[str, object]:
    """What was fused, as JSON has it."""
    return {
        "targets": len(fusion.tracks),
        "points": sum(map(len, fusion.tracks)),
        "shared": fusion.shared,
        "handovers": fusion.handovers,
        "scatter": without_nan(fusion.scatter),
        "cameras": [asdict(camera) for camera in fusion.cameras],
        "identities": [
            {"track_id": one.track_id, "mmsi": one.mmsi, "name": one.name}
            for one in fusion.tracks
            if one.mmsi is not None or one.name
        ],
    }


def _place(camera: TracksOfCamera) -> tuple[float, float] | None:
    if camera.place is not None or camera.model is None:
        return camera.place
    plane = load_model(camera.model).plane
    return plane.latitude_deg, plane.longitude_deg


def _in_plane(plane: LocalPlane, place: tuple[float, float] | None) -> FloatArray | None:
    if place is None:
        return None
    east, north = plane.to_plane([place[0]], [place[1]])
    return np.array([east[0], north[0]])


def _check_times(path: Path, cameras: list[CameraTracks], settings: FuseSettings) -> None:
    """Raise InputError where no two cameras have tracks at times that are near to each other."""
    spans = sorted(
        (
            min(track.time_utc_s[0] for track in camera.tracks),
            max(track.time_utc_s[-1] for track in camera.tracks),
            camera.name,
        )
        for camera in cameras
    )
    for before, after in pairwise(spans):
        if after[0] <= before[1] + settings.handover.longest_s:
            return
    raise InputError(
        f"{path}: no two cameras have tracks at the same time: those of camera {spans[0][2]} end "
        f"at {utc_text(spans[0][1])} UTC, and those of camera {spans[1][2]} begin at "
        f"{utc_text(spans[1][0])} UTC; give files of one time, or check the cameras' clocks"
    )
