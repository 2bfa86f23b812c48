"""Tracks of other cameras as logs: where each of their targets was, and how unsure that is."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from sightline.errors import InputError
from sightline.formats import _files
from sightline.formats.ais import AisVessel
from sightline.types import Fixes, Track

_TABLES = (".parquet", ".gpkg")
_PLACED = ("var_east_m2", "semi_major_m")


def holds_tracks(path: str | os.PathLike[str]) -> bool:
    """Whether a log is a file of tracks that say how unsure they are, as sightline writes them.

    Raises:
        InputError: The file is missing or cannot be read.
    """
    suffix = Path(path).suffix.lower()
    if suffix in _TABLES:
        return True
    if suffix not in (".csv", ".geojson"):
        return False
    head = _files.beginning(path)
    if suffix == ".csv":
        columns = (head.splitlines() or [""])[0].split(",")
        return "track_id" in columns and any(name in columns for name in _PLACED)
    return '"track_id"' in head and '"semi_major_m"' in head


def track_logs(path: str | os.PathLike[str], tracks: tuple[Track, ...]) -> tuple[AisVessel, ...]:
    """The logs that tracks are to another camera, one a target that moves.

    Args:
        path: Where they are from, for messages.
        tracks: What `read_tracks` has read.

    Raises:
        InputError: A track does not say how unsure it is, or none moves.
    """
    out = []
    for track in tracks:
        if track.never_moves or len(track) < 2:
            continue
        if not np.isfinite(track.covariance_m2).all():
            raise InputError(
                f"{path}: its track {track.track_id} does not say how unsure it is, so nothing can "
                "be learned from it; give tracks with covariances or ellipses"
            )
        fixes = Fixes(
            track.time_utc_s,
            track.latitude_deg,
            track.longitude_deg,
            name=f"track {track.track_id}",
        )
        velocity = np.stack([track.velocity_east_mps, track.velocity_north_mps], axis=1)
        sigma_m = np.sqrt(0.5 * np.trace(track.covariance_m2, axis1=1, axis2=2))
        out.append(AisVessel(fixes, velocity, sigma_m))
    if not out:
        raise InputError(f"{path}: no target in these tracks moves; nothing can be learned from it")
    return tuple(out)
